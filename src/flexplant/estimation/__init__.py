"""Estimates of what no sensor sees: the points of interest."""

from .kalman import KalmanEstimator as KalmanEstimator
from .kalman import design_kalman as design_kalman
from .static import StaticEstimator as StaticEstimator
from .static import design_static as design_static
