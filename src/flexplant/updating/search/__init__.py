"""Searches: the parameters that make an objective least, each method a value with `.search`."""

from .gauss_newton import GaussNewton as GaussNewton
from .gauss_newton import Secured as Secured
from .lasso import Lasso as Lasso
from .objective import Objective as Objective
from .objective import checked_residuals as checked_residuals
from .tikhonov import Tikhonov as Tikhonov
from .trust_region import TrustRegion as TrustRegion
from .update_method import SearchEnd as SearchEnd
from .update_method import UpdateMethod as UpdateMethod
