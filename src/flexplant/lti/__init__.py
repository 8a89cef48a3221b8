"""Linear time-invariant systems: the control side's one type and what is done with it."""

from .discretisation import discretized as discretized
from .discretisation import tustin as tustin
from .frequency import Frf as Frf
from .frequency import default_freq as default_freq
from .frequency import frequency_response as frequency_response
from .interconnection import append as append
from .interconnection import connect as connect
from .interconnection import feedback as feedback
from .interconnection import lft as lft
from .interconnection import parallel as parallel
from .interconnection import series as series
from .lyapunov import controllability_gramian as controllability_gramian
from .lyapunov import observability_gramian as observability_gramian
from .lyapunov import solve_lyapunov as solve_lyapunov
from .lyapunov import solve_stein as solve_stein
from .norms import h2_norm as h2_norm
from .norms import hinf_norm as hinf_norm
from .norms import peak_gain as peak_gain
from .riccati import RiccatiSolution as RiccatiSolution
from .riccati import control_care as control_care
from .riccati import control_dare as control_dare
from .riccati import solve_care as solve_care
from .riccati import solve_dare as solve_dare
from .statespace import StateSpace as StateSpace
from .statespace import as_statespace as as_statespace
