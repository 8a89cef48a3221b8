"""Estimation: the motion at a point of interest from sensors elsewhere."""

from .certificate import KalmanCertificate as KalmanCertificate
from .certificate import check_gain as check_gain
from .estimator import KalmanEstimator as KalmanEstimator
from .filter_model import FilterModel as FilterModel
from .kalman import design_kalman as design_kalman
from .left_out import LeftOut as LeftOut
from .static import StaticEstimator as StaticEstimator
from .static import design_static as design_static
