"""Closing the loop by names, its sensitivities and margins."""

from ..rooms import public_names as _public_names
from .axes import in_axes as in_axes
from .budget import ErrorBudget as ErrorBudget
from .budget import Spectrum as Spectrum
from .closed import ClosedLoop as ClosedLoop
from .closed import close_loop as close_loop
from .comparison import LoopComparison as LoopComparison
from .comparison import LoopFigures as LoopFigures
from .comparison import compare_loops as compare_loops
from .mode_tolerance import ModeTolerances as ModeTolerances
from .report import LoopMargins as LoopMargins
from .report import LoopReport as LoopReport
from .report import report_loops as report_loops
from .sensitivity import bandwidth as bandwidth
from .sensitivity import complementary_sensitivity as complementary_sensitivity
from .sensitivity import control_sensitivity as control_sensitivity
from .sensitivity import loop_gain as loop_gain
from .sensitivity import modulus_margin as modulus_margin
from .sensitivity import sensitivity as sensitivity
from .spill_over import MachineDraws as MachineDraws
from .spill_over import SpillOver as SpillOver

__dir__ = _public_names(__name__)
