"""Fewer degrees of freedom, same input-output behaviour: modes, attachment vectors, reduction."""

from .methods import DesiredDofs as DesiredDofs
from .methods import ReductionMethod as ReductionMethod
from .methods import reduce as reduce
from .modes import Modes as Modes
from .normal_form import NormalForm as NormalForm
from .normal_form import normal_form as normal_form
from .reduced import ReducedModel as ReducedModel
from .selection import DofSelection as DofSelection
from .selection import select_dofs as select_dofs
from .solve import solve_modes as solve_modes
