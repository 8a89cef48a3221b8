"""Searches: the parameters that make an objective least, each method a value with `.search`."""

from .least_squares import Auto as Auto
from .least_squares import GaussNewton as GaussNewton
from .least_squares import SearchEnd as SearchEnd
from .least_squares import TrustRegion as TrustRegion
from .least_squares import UpdateMethod as UpdateMethod
from .objective import Objective as Objective
from .objective import checked_residuals as checked_residuals
