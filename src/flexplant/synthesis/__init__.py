"""Controllers: the servo on the estimated point of interest, H2 and H-infinity, tuned loops.

A `Controller` holds the results of its checks: the norm by two methods, stability, the loop on the
evaluation model of the plant (with the truncated modes), and the allowed error of each mode.

- `design_servo(plant, bandwidth=)`: decoupled PID on the estimate. `servo_bandwidth` gives its
  largest bandwidth.
- `design_stage(plant)`: the fastest H-infinity controller that tolerates errors of the modes.
- `design_hinf(plant.weighted(...))` by `Riccati` or `Lmi`; `design_h2`; `design_ncf`;
  `design_structured` (fixed order, PID and notches; your own objective derives from
  `MeasuredObjective`).
- `design_loops`, `tune_loops` with `Pid`, `Lead`, `Notch`, `LowPass`. A measured FRF without a
  model suffices.
- `damp_modes`: velocity feedback, positive position feedback, integral resonant control.
- `mu`, `robust_stability`, `robust_performance`, `worst_case_gain`, `design_mu`: guarantees for
  uncertain plants. ``plant.uncertain`` makes them from machines, `uncertain_system` from your own
  blocks.

`reduce_controller`, `discretise_controller`, `anti_windup_form` and `second_order_sections` prepare
a controller for implementation. `fx.export.write_c` and `fx.export.write_fmu` write code.

>>> import flexplant as fx
>>> plant = fx.testbeds.three_masses()
>>> errors, weights = fx.reference_errors(plant), fx.stage_weights(plant, 20.0)
>>> hinf = fx.design_hinf(plant.through(errors).weighted(z=weights.z, w=weights.w))
>>> round(hinf.gamma, 1), round(hinf.lower, 1)
(0.7, 0.7)
>>> loop = fx.close_loop(plant, errors, hinf)
>>> loop.is_stable, loop.modulus_margin > 0.5
(True, True)

| MATLAB | here |
|---|---|
| ``lqr``, ``dlqr``, ``lqi``, ``lqg`` | `lqr`, `lqi`, `lqg` |
| ``kalman`` of A, B, C; ``place`` | `lqe`; `place` |
| ``hinfsyn``, ``h2syn`` | `design_hinf`, `design_h2` |
| ``mixsyn``, ``augw`` | `fx.plant.mixed_sensitivity`, then `design_hinf` |
| ``ncfsyn``, ``ncfmargin`` | `design_ncf`, `ncf_margin` |
| ``hinfstruct``, ``systune`` | `design_structured`, `tune_loops` |
| ``pidtune`` | `tune_pid`; of a machine `design_servo` |
| ``allmargin``, ``diskmargin`` | `margins` |
| ``mussv``, ``robstab`` | `mu`, `robust_stability` |
| ``wcgain``, ``musyn`` | `worst_case_gain`, `design_mu` |
| ``ultidyn``, ``uss`` | `fx.plant.UnmodelledDynamics`, `uncertain_system` |

The methods use dense matrices and suit plants of up to about 500 states. `Lmi` and `design_lmi`
accept up to 20 states.
"""

from ..plant.uncertainty.delta_blocks import FullBlock as FullBlock
from ..plant.uncertainty.delta_blocks import RepeatedScalar as RepeatedScalar
from ..rooms import public_names as _public_names
from .aftercare.forms import anti_windup_form as anti_windup_form
from .aftercare.forms import second_order_sections as second_order_sections
from .aftercare.order import discretise_controller as discretise_controller
from .aftercare.order import reduce_controller as reduce_controller
from .controller import Controller as Controller
from .h2 import design_h2 as design_h2
from .hinf.hinf_design import design_hinf as design_hinf
from .hinf.hinf_riccati import Riccati as Riccati
from .hinf.ncf import design_ncf as design_ncf
from .hinf.ncf import ncf_margin as ncf_margin
from .hinf.stage_design import design_stage as design_stage
from .laws.active_damping import ActiveDamping as ActiveDamping
from .laws.active_damping import damp_modes as damp_modes
from .laws.damping_elements import DampingElement as DampingElement
from .laws.damping_elements import IntegralResonantControl as IntegralResonantControl
from .laws.damping_elements import PositivePositionFeedback as PositivePositionFeedback
from .laws.damping_elements import VelocityFeedback as VelocityFeedback
from .laws.hand_design import FixedBlock as FixedBlock
from .laws.hand_design import LoopDesign as LoopDesign
from .laws.hand_design import ShapedAxis as ShapedAxis
from .laws.law import Integrator as Integrator
from .laws.law import Lag as Lag
from .laws.law import Law as Law
from .laws.law import Lead as Lead
from .laws.law import LowPass as LowPass
from .laws.law import Notch as Notch
from .laws.law import Pid as Pid
from .laws.loop_design import DesignedLoops as DesignedLoops
from .laws.loop_design import design_loops as design_loops
from .laws.pid_tuning import PidTuning as PidTuning
from .laws.pid_tuning import tune_pid as tune_pid
from .laws.servo_design import design_servo as design_servo
from .laws.servo_design import servo_bandwidth as servo_bandwidth
from .laws.tune import tune_loops as tune_loops
from .lmi.lmi_programs import Lmi as Lmi
from .lmi.objective_design import AutoBackOff as AutoBackOff
from .lmi.objective_design import design_lmi as design_lmi
from .lmi.objectives import H2 as H2
from .lmi.objectives import Hinf as Hinf
from .lmi.objectives import PeakGain as PeakGain
from .lmi.objectives import PoleRegion as PoleRegion
from .regulators import lqe as lqe
from .regulators import lqg as lqg
from .regulators import lqi as lqi
from .regulators import lqr as lqr
from .regulators import place as place
from .robustness.disk_margins import DiskMargin as DiskMargin
from .robustness.disk_margins import MarginTable as MarginTable
from .robustness.disk_margins import margins as margins
from .robustness.dk import design_mu as design_mu
from .robustness.guarantees import RobustStability as RobustStability
from .robustness.guarantees import WorstCaseGain as WorstCaseGain
from .robustness.guarantees import robust_stability as robust_stability
from .robustness.guarantees import worst_case_gain as worst_case_gain
from .robustness.mu_bounds import MuBounds as MuBounds
from .robustness.mu_bounds import mu as mu
from .robustness.performance_bounds import robust_performance as robust_performance
from .robustness.uncertain_systems import BlockStructure as BlockStructure
from .robustness.uncertain_systems import uncertain_system as uncertain_system
from .structured.judges import Judge as Judge
from .structured.measured_objective import MeasuredObjective as MeasuredObjective
from .structured.structured_design import design_structured as design_structured
from .structured.structures import FixedOrder as FixedOrder
from .structured.structures import ObserverGains as ObserverGains
from .structured.structures import Parametrised as Parametrised
from .structured.structures import TunedLaws as TunedLaws

__dir__ = _public_names(__name__)
