"""Closed loops, connected by channel names; their sensitivities and margins.

- `close_loop(plant, *blocks)`: blocks are connected by the names of their channels.
- `ClosedLoop`: ``is_stable``, ``modulus_margin``, ``rms("die:error")``, ``psd``,
  ``budget`` by source.
- `sensitivity`, `complementary_sensitivity`, `control_sensitivity`, `loop_gain`, `bandwidth`.
- `report_loops`: crossovers, gain, phase and modulus margins of each loop, broken at u or y.
- `DelayedLoop`: loops with a delay in continuous time. They need not be sampled.
- `compare_loops`: several designs, or one design on model and machine, in one table.

The plant may also be a measured `fx.Frf`. `in_axes` transforms it to decoupled axes.

>>> import flexplant as fx
>>> plant = fx.testbeds.three_masses()
>>> observer = fx.design_kalman(plant)
>>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
>>> loop = fx.close_loop(plant, observer, servo)
>>> loop.is_stable, round(loop.modulus_margin, 2)
(True, 0.58)
>>> report = fx.loop.report_loops(loop)
>>> round(report["u1"].phase_margin), round(loop.rms("die:error") * 1e9)
(41, 247)

Names in MATLAB: ``margin`` and ``allmargin`` correspond to `report_loops` and `fx.modulus_margin`.
They take a loop gain L (a system or a measured `fx.Frf`), ``(plant, controller)`` or a closed loop.
``loopsens`` corresponds to `sensitivity` and similar functions.
"""

from ..certificates import Certificate as Certificate
from ..certificates import Verified as Verified
from ..rooms import public_names as _public_names
from .budget import ErrorBudget as ErrorBudget
from .budget import Spectrum as Spectrum
from .closed import ClosedLoop as ClosedLoop
from .closed import close_loop as close_loop
from .delayed_loops import DelayedLoop as DelayedLoop
from .measured_loop import in_axes as in_axes
from .modal_tolerances import ModeTolerances as ModeTolerances
from .on_measurement import OnMeasurement as OnMeasurement
from .other_machines import SpillOver as SpillOver
from .report import LoopComparison as LoopComparison
from .report import LoopFigures as LoopFigures
from .report import LoopMargins as LoopMargins
from .report import LoopReport as LoopReport
from .report import compare_loops as compare_loops
from .report import report_loops as report_loops
from .scheduled import ScheduledLoop as ScheduledLoop
from .scheduled import schedule_loops as schedule_loops
from .sensitivity_functions import bandwidth as bandwidth
from .sensitivity_functions import complementary_sensitivity as complementary_sensitivity
from .sensitivity_functions import control_sensitivity as control_sensitivity
from .sensitivity_functions import loop_gain as loop_gain
from .sensitivity_functions import modulus_margin as modulus_margin
from .sensitivity_functions import sensitivity as sensitivity

__dir__ = _public_names(__name__)
