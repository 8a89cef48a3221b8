"""Searches: the parameters that make an objective least, each method a value with `.search`."""

from .gauss_newton import GaussNewton as GaussNewton
from .lasso import Lasso as Lasso
from .method import Found as Found
from .method import Method as Method
from .objective import Objective as Objective
from .objective import checked_residuals as checked_residuals
from .tikhonov import Tikhonov as Tikhonov
from .trust_region import TrustRegion as TrustRegion
