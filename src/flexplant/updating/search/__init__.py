"""Searches: the parameters that make an objective least, each method a value with `.search`."""

from .gauss_newton import GaussNewton as GaussNewton
from .gauss_newton import Secured as Secured
from .objective import Objective as Objective
from .objective import SearchEnd as SearchEnd
from .objective import UpdateMethod as UpdateMethod
from .objective import checked_residuals as checked_residuals
from .penalised import Lasso as Lasso
from .penalised import Tikhonov as Tikhonov
from .trust_region import TrustRegion as TrustRegion
