"""Fewer degrees of freedom, same input-output behaviour: reductions, their bounds and quality."""

from ..rooms import public_names as _public_names
from .component_modes import CraigBampton as CraigBampton
from .component_modes import MacNeal as MacNeal
from .component_modes import Rubin as Rubin
from .condensation import Guyan as Guyan
from .condensation import Irs as Irs
from .condensation import Serep as Serep
from .criteria import DofSelection as DofSelection
from .criteria import EffectiveIndependence as EffectiveIndependence
from .criteria import Greedy as Greedy
from .criteria import PivotedQr as PivotedQr
from .criteria import SelectionCriterion as SelectionCriterion
from .criteria import select_dofs as select_dofs
from .judging import ReductionQuality as ReductionQuality
from .krylov import Krylov as Krylov
from .methods import DesiredDofs as DesiredDofs
from .methods import ReductionMethod as ReductionMethod
from .methods import reduce as reduce
from .ranking import ErrorBound as ErrorBound
from .ranking import ModeRanking as ModeRanking
from .ranking import rank_modes as rank_modes
from .reduced import ReducedModel as ReducedModel
from .truncation import ModalBalanced as ModalBalanced
from .truncation import ModalTruncation as ModalTruncation

__dir__ = _public_names(__name__)
