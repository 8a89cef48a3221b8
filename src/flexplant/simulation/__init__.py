"""Set-points, sampled-data runs of a closed loop, and what they say of the error."""

from .response import Response as Response
from .setpoint import SetPoint as SetPoint
from .setpoint import setpoint as setpoint
from .simulate import simulate as simulate
