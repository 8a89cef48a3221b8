"""Estimation: the motion at a point of interest from sensors elsewhere."""

from .kalman import KalmanCertificate as KalmanCertificate
from .kalman import KalmanEstimator as KalmanEstimator
from .kalman import check_gain as check_gain
from .kalman import design_kalman as design_kalman
from .left_out import LeftOut as LeftOut
from .static import StaticEstimator as StaticEstimator
from .static import design_static as design_static
