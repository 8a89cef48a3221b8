"""Model reduction: models with few degrees of freedom that respond like the full model.

A `ReducedModel` has small matrices M, D and K. Its matrix T expands its motion to the whole
structure. With many methods its coordinates are DOFs of the structure.

- `reduce(modes, DesiredDofs(labels))`: the method of the paper, with chosen DOFs and exact modes.
- `select_dofs(modes, count)`: DOFs whose motions distinguish the modes well.
- other methods: `ModalTruncation`, `ModalBalanced`, `Guyan`, `Irs`, `Serep`, `CraigBampton`,
  `Rubin`, `MacNeal`, `Krylov`. Your own method is a class with one function.
- `ReducedModel.quality(model, band=, inputs=, outputs=)`: errors of frequencies, shapes and
  responses, compared with the error bound of the method.
- `rank_modes`: sorts modes by their contribution to the response from inputs to outputs.

Twelve modes of a plate are kept in a model of twelve of its DOFs:

>>> import flexplant as fx
>>> plate = fx.kirchhoff_plate(
...     size=(0.6, 0.4), thickness=0.02, elements=(6, 4),
...     density=2700, youngs_modulus=70e9, poisson_ratio=0.33,
... )
>>> modes = fx.solve_modes(plate, count=12, damping=fx.ModalDamping(0.01))
>>> desired = fx.select_dofs(modes, 12)
>>> small = fx.reduce(modes, fx.DesiredDofs(desired.labels))
>>> print(small)
<ReducedModel: 12 of 105 DOFs by 12 modes, 3 rigid-body motions, cond(phi_kk) 6.19>
>>> bool(abs(small.modes().freq[3:] / modes.freq[3:] - 1).max() < 1e-6)
True

Names elsewhere: superelements and CMS (Ansys), EXTSEOUT and ASET (Nastran), ``pymor``'s
reductors, MATLAB's ``modalfit`` and ``reducespec``. ``examples/reduction_methods.py`` compares
twelve methods.
"""

from ..rooms import public_names as _public_names
from .condensation import CraigBampton as CraigBampton
from .condensation import Guyan as Guyan
from .condensation import Irs as Irs
from .condensation import MacNeal as MacNeal
from .condensation import Rubin as Rubin
from .condensation import Serep as Serep
from .criteria import EffectiveIndependence as EffectiveIndependence
from .criteria import Greedy as Greedy
from .judging import ReductionQuality as ReductionQuality
from .krylov import Krylov as Krylov
from .methods import DesiredDofs as DesiredDofs
from .methods import DofSelection as DofSelection
from .methods import PivotedQr as PivotedQr
from .methods import ReductionMethod as ReductionMethod
from .methods import SelectionCriterion as SelectionCriterion
from .methods import reduce as reduce
from .methods import select_dofs as select_dofs
from .projection import projected_model as projected_model
from .ranking import ErrorBound as ErrorBound
from .ranking import ModeRanking as ModeRanking
from .ranking import rank_modes as rank_modes
from .reduced import ReducedModel as ReducedModel
from .truncation import ModalBalanced as ModalBalanced
from .truncation import ModalTruncation as ModalTruncation

__dir__ = _public_names(__name__)
