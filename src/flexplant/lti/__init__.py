"""Linear time-invariant systems: the control side's one type and what is done with it."""

from .interconnection import append as append
from .interconnection import connect as connect
from .interconnection import feedback as feedback
from .interconnection import lft as lft
from .interconnection import parallel as parallel
from .interconnection import series as series
from .statespace import StateSpace as StateSpace
from .statespace import as_statespace as as_statespace
