"""flexplant: from finite-element matrices to the closed-loop error at a point of interest."""

from .labels import DofSet as DofSet
from .lti import StateSpace as StateSpace
from .lti import append as append
from .lti import feedback as feedback
from .lti import lft as lft
from .lti import parallel as parallel
from .lti import series as series
from .store import load as load

__version__ = "0.1.0"
