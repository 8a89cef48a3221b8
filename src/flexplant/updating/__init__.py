"""The model becomes this machine's: parameters, residuals, sensitivities, update."""

from .parameters import AddedDamping as AddedDamping
from .parameters import AddedMass as AddedMass
from .parameters import AddedStiffness as AddedStiffness
from .parameters import Parameter as Parameter
from .residuals import Eigenvalues as Eigenvalues
from .result import History as History
from .result import UpdateResult as UpdateResult
from .sensitivity import Sensitivities as Sensitivities
from .sensitivity import eigenvalue_sensitivities as eigenvalue_sensitivities
from .update import update as update
