"""Controllers: the servo on the estimated point of interest."""

from .controller import Controller as Controller
from .servo import design_servo as design_servo
