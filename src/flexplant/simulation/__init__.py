"""Set-points, sampled-data runs of a closed loop, and what they say of the error."""

from .estimator_comparison import EstimatorComparison as EstimatorComparison
from .estimator_comparison import compare_estimators as compare_estimators
from .estimator_comparison import reading_along as reading_along
from .response import Response as Response
from .setpoint import SetPoint as SetPoint
from .setpoint import setpoint as setpoint
from .simulate import simulate as simulate
