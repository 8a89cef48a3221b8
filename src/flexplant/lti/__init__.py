"""Linear time-invariant systems: one type for all of control, and its methods.

A `StateSpace` has named inputs and outputs and keeps the block structure of modes, which makes its
frequency responses, norms and sampling exact and fast. Controllers, plants and weights consist of
such systems.

- `tf`, `zpk`, `StateSpace`: make a system; `as_statespace` takes those of python-control and SciPy.
- `frequency_response`: the `Frf` of a system, or of a structure between its ports.
- `merged_frf`: one `Frf` of several measurements, with other sensors or forces in each.
- `discretized`: exact sampling of a plant with a hold and a delay. `tustin` and `matched` sample
  controllers.
- `Delayed`: a system with a delay or a derivative in continuous time, exact on the frequency axis.
- `step`, `impulse`, `lsim`, `step_info`: time responses in numbers; `fx.plot.step` draws them.
- `h2_norm`, `hinf_norm`, `peak_gain`: norms, with a proof for the last two.
- `series`, `parallel`, `feedback`, `connect`, `lft`: connections of systems.
- `balanced`, `minimal`: fewer states. `modal_form`: states in blocks, one for each mode.

>>> import flexplant as fx
>>> g = fx.lti.tf([1.0], [1.0, 0.02, 1.0])
>>> gain, freq = fx.peak_gain(g)
>>> round(gain, 2), round(freq, 4)
(50.0, 0.1591)
>>> round(abs(g(1.0j)), 6)
50.0
>>> sampled = fx.lti.discretized(g, 10.0, delay=1.3)
>>> sampled.n_states, sampled.is_stable
(4, True)
>>> print(fx.lti.feedback(g, 0.5 * fx.lti.low_pass_filter(2.0)))
<StateSpace: 3 states, continuous, in -> out>

**From MATLAB and python-control.** Their systems are accepted wherever a system is expected;
`to_control()` converts back. If you use one of their names (``fx.c2d``), the error message tells
the name in flexplant.

| there | here |
|---|---|
| ``ss``, ``tf``, ``zpk`` | `fx.StateSpace`, `fx.lti.tf`, `fx.lti.zpk` |
| ``sys(s)``, ``dcgain`` | `sys(s)`, `sys.dcgain()` |
| ``pole``, ``tzero`` | `sys.poles()`, `sys.zeros()` |
| ``sys(1, 2)``, ``sys[0, 1]`` | `sys["y1", "u2"]`, `sys[0, 1]`, counted from 0 |
| ``series``, ``feedback``, ``lft`` | the same in `fx.lti`; `g2 * g1`, `g1 + g2`, `1 / (1 + L)` |
| ``freqresp`` | `fx.frequency_response` |
| ``bode``, ``sigma`` | `fx.plot.bode`, `fx.plot.singular_values` |
| ``nyquist``, ``pzmap`` | `fx.plot.nyquist`, `fx.plot.pole_map` |
| ``step``, ``impulse``, ``lsim``, ``stepinfo`` | `fx.lti.step`, `impulse`, `lsim`, `step_info` |
| ``c2d`` | `fx.lti.discretized(sys, rate, delay=)`, `fx.lti.tustin`, `fx.lti.matched` |
| ``InputDelay``, ``exp(-s)`` | `fx.lti.Delayed`, judged by `fx.loop.DelayedLoop` |
| ``d2c``, ``d2d`` | `fx.lti.continuous`, `fx.lti.resampled(sys, rate)` |
| ``dss``, ``stabsep`` | `fx.lti.descriptor`, `fx.lti.split_stable` |
| ``gram``, ``hsvd`` | `fx.lti.controllability_gramian`, `fx.lti.hankel_values` |
| ``norm(sys)``, ``norm(sys, inf)`` | `fx.h2_norm`, `fx.hinf_norm` |
| ``getPeakGain`` | `fx.peak_gain` |
| ``minreal``, ``balred``, ``canon(sys, "modal")`` | `fx.minimal`, `fx.balanced`, `fx.modal_form` |
| ``lyap``, ``dlyap`` | `fx.lti.solve_lyapunov`, `fx.lti.solve_stein` |
| ``care``, ``dare`` | `fx.lti.control_care`, `fx.lti.control_dare` |
| their duals, of a Kalman filter | `fx.lti.filter_care`, `fx.lti.filter_dare` |
"""

from ..rooms import public_names as _public_names
from .balancing import BalancedReduction as BalancedReduction
from .balancing import NormReport as NormReport
from .balancing import balanced as balanced
from .balancing import hankel_norm as hankel_norm
from .balancing import hankel_values as hankel_values
from .balancing import norm_report as norm_report
from .conversions import continuous as continuous
from .conversions import descriptor as descriptor
from .conversions import resampled as resampled
from .conversions import tustin as tustin
from .delays import Delayed as Delayed
from .equations import solve_lyapunov as solve_lyapunov
from .equations import solve_stein as solve_stein
from .filters import high_pass_filter as high_pass_filter
from .filters import inverse_sensitivity as inverse_sensitivity
from .filters import lead_lag_filter as lead_lag_filter
from .filters import low_pass_filter as low_pass_filter
from .filters import matched as matched
from .filters import notch_filter as notch_filter
from .filters import pade as pade
from .filters import tf as tf
from .filters import zpk as zpk
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
from .merged_responses import merged_frf as merged_frf
from .minimal_realisations import minimal as minimal
from .modal import ModalForm as ModalForm
from .modal import StableSplit as StableSplit
from .modal import modal_form as modal_form
from .modal import split_stable as split_stable
from .norms import h2_norm as h2_norm
from .norms import hinf_norm as hinf_norm
from .norms import linf_norm as linf_norm
from .norms import peak_gain as peak_gain
from .riccati import RiccatiSolution as RiccatiSolution
from .riccati import control_care as control_care
from .riccati import control_dare as control_dare
from .riccati import filter_care as filter_care
from .riccati import filter_dare as filter_dare
from .sampling import discretized as discretized
from .statespace import StateSpace as StateSpace
from .statespace import as_statespace as as_statespace
from .time_responses import StepInfo as StepInfo
from .time_responses import TimeResponse as TimeResponse
from .time_responses import impulse as impulse
from .time_responses import lsim as lsim
from .time_responses import step as step
from .time_responses import step_info as step_info

__dir__ = _public_names(__name__)
