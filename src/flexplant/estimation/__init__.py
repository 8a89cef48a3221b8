"""Estimation: the motion at a point of interest from sensors elsewhere."""

from ..rooms import public_names as _public_names
from .consistency import Consistency as Consistency
from .consistency import consistency as consistency
from .estimate import Estimate as Estimate
from .estimator import KalmanEstimator as KalmanEstimator
from .filter_model import FilterModel as FilterModel
from .filter_model import KalmanCertificate as KalmanCertificate
from .filter_model import check_gain as check_gain
from .invertibility import Invertibility as Invertibility
from .invertibility import check_bias as check_bias
from .invertibility import invertibility as invertibility
from .kalman import design_kalman as design_kalman
from .lag_report import Filter as Filter
from .lag_report import FixedLag as FixedLag
from .lag_report import LagReport as LagReport
from .lag_report import Predictor as Predictor
from .lag_report import Smoother as Smoother
from .left_out import LeftOut as LeftOut
from .machine_table import MachineTable as MachineTable
from .machine_table import errors_on_machines as errors_on_machines
from .minimax import design_minimax_filter as design_minimax_filter
from .moved_modes import MovedModes as MovedModes
from .multirate import PeriodicCertificate as PeriodicCertificate
from .multirate import PeriodicEstimator as PeriodicEstimator
from .multirate import design_multirate as design_multirate
from .noise_from_records import NoiseLevels as NoiseLevels
from .noise_from_records import estimate_noise as estimate_noise
from .robust_filter import HinfFilterCertificate as HinfFilterCertificate
from .robust_filter import MinimaxCertificate as MinimaxCertificate
from .robust_filter import RobustFilter as RobustFilter
from .robust_filter import design_hinf_filter as design_hinf_filter
from .static import StaticEstimator as StaticEstimator
from .static import design_static as design_static
from .unknown_inputs import Augmented as Augmented
from .unknown_inputs import InputCertificate as InputCertificate
from .unknown_inputs import InputEstimator as InputEstimator
from .unknown_inputs import Unbiased as Unbiased
from .unknown_inputs import design_input_estimator as design_input_estimator

__dir__ = _public_names(__name__)
