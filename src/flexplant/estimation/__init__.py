"""Estimation: the motion at a point of interest from sensors elsewhere."""

from .certificate import KalmanCertificate as KalmanCertificate
from .certificate import check_gain as check_gain
from .estimate import Estimate as Estimate
from .estimator import KalmanEstimator as KalmanEstimator
from .filter_model import FilterModel as FilterModel
from .hinf_filter import design_hinf_filter as design_hinf_filter
from .input_estimator import InputCertificate as InputCertificate
from .input_estimator import InputEstimator as InputEstimator
from .invertibility import Invertibility as Invertibility
from .invertibility import invertibility as invertibility
from .kalman import design_kalman as design_kalman
from .lags import Filter as Filter
from .lags import FixedLag as FixedLag
from .lags import Predictor as Predictor
from .lags import Smoother as Smoother
from .left_out import LeftOut as LeftOut
from .minimax import design_minimax_filter as design_minimax_filter
from .robust import HinfFilterCertificate as HinfFilterCertificate
from .robust import MinimaxCertificate as MinimaxCertificate
from .robust import RobustFilter as RobustFilter
from .static import StaticEstimator as StaticEstimator
from .static import design_static as design_static
from .unknown_inputs import Augmented as Augmented
from .unknown_inputs import Unbiased as Unbiased
from .unknown_inputs import design_input_estimator as design_input_estimator
