"""Set-points, sampled-data runs of a closed loop, and what they say of the error."""

from ..rooms import public_names as _public_names
from .estimator_comparison import EstimatorComparison as EstimatorComparison
from .estimator_comparison import compare_estimators as compare_estimators
from .estimator_comparison import reading_along as reading_along
from .exposure import ErrorMap as ErrorMap
from .exposure import ExposureErrors as ExposureErrors
from .exposure import error_map as error_map
from .exposure import exposure_errors as exposure_errors
from .exposure import settling_time as settling_time
from .feedforward import Feedforward as Feedforward
from .feedforward import design_feedforward as design_feedforward
from .feedforward import inverse_forces as inverse_forces
from .feedforward import known_forces as known_forces
from .learning import LearnedFeedforward as LearnedFeedforward
from .learning import learn_feedforward as learn_feedforward
from .machine_pipeline import MachinePipeline as MachinePipeline
from .machine_pipeline import MachineReport as MachineReport
from .motion import Motion as Motion
from .motion import SetPoint as SetPoint
from .motion import scan as scan
from .motion import setpoint as setpoint
from .nonlinear_elements import Quantiser as Quantiser
from .nonlinear_elements import Saturation as Saturation
from .response import Response as Response
from .simulate import simulate as simulate
from .specification import Specification as Specification
from .specification import Verdict as Verdict
from .study import StudyTable as StudyTable
from .study import study as study

__dir__ = _public_names(__name__)
