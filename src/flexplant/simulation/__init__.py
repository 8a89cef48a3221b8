"""Set-points, sampled-data runs of a closed loop, and error metrics.

- `simulate(loop, reference=, duration=, rng=)` returns a `Response`. The noise is that of
  `fx.design_kalman`. `elements=` adds nonlinear elements: `Saturation`, `Quantiser`, `Hysteresis`,
  `Dropout`, `Jitter`, `Friction` or your own. `finer=` also gives the motion between samples.
- `spectral_noise`: noise with a measured or a 1/f spectrum, for `simulate(disturbance=)`.
- `setpoint`, `scan`: moves of bounded velocity, acceleration and jerk. `input_shaper` (ZV, ZVD, EI)
  and `quiet_setpoint` leave modes at rest. `residual_vibration` predicts the remaining vibration on
  the evaluation model.
- `design_feedforward`, `learn_feedforward`: forces for a move.
- `Specification`: limits on margins and errors. Its verdict compares them with achieved values.
- `rms_along(loop, moving=)`: the errors of a moving machine along its path.
- `study(machines, pipeline, executor=)`: one pipeline for many machines. It continues after a stop.

>>> import flexplant as fx
>>> plant = fx.testbeds.three_masses()
>>> observer = fx.design_kalman(plant)
>>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
>>> loop = fx.close_loop(plant, observer, servo)
>>> move = fx.setpoint(1e-3, velocity=0.05, acceleration=2.0, jerk=200.0)
>>> run = fx.simulate(loop, reference=move, duration=0.5, rng=1)
>>> ma, msd = run.exposure("die:error", window=5e-3, start=0.4)
>>> f"{1e9 * ma:.0f} nm, {1e9 * msd:.1f} nm"
'664 nm, 93.4 nm'

Names elsewhere: ``lsim`` (MATLAB), ``forced_response`` (python-control) and runs of a Simulink
model correspond to `simulate`.

**Many machines.** A pipeline is a plain function that takes one machine and returns a row of the
table. `examples/fleet.py` has the whole chain: measure, update, calibrate, design, verify on the
machine. The pipeline below tries one controller on machines with other masses. It continues the
script of the README and uses its names:

```python
MASSES = [0.3, 0.6]  # kg

def pipeline(mass: float, rng: object) -> dict[str, object]:
    there = fx.testbeds.wafer_stage(added_mass=mass, damping=0.01)
    tried = there.loop(ports, *loop.blocks)
    run = fx.simulate(tried, reference=move, duration=0.3, rng=rng)
    ma, msd = run.exposure("die:error", window=5e-3, start=0.25)
    return {"margin": tried.modulus_margin, "stable": tried.is_stable, "MA": ma, "MSD": msd}
```

The same study runs on a laptop, on a pool of processes and on a cluster. The three tables are equal
to the last bit:

```python
laptop = fx.study(MASSES, pipeline, rng=1, checkpoint="study.jsonl")  # continues after a stop
print(laptop)  # columns of arrays: pandas.DataFrame(dict(laptop)); "failed" says why, or nothing

from concurrent.futures import ProcessPoolExecutor

with ProcessPoolExecutor(2) as executor:
    pool = fx.study(MASSES, pipeline, rng=1, executor=executor)

# python -m pip install distributed; Client("tcp://scheduler:8786") is a cluster that runs
from dask.distributed import Client

with Client(n_workers=2, threads_per_worker=1, dashboard_address=None) as client:
    cluster = fx.study(MASSES, pipeline, rng=1, executor=client.get_executor())
```
"""

from ..rooms import public_names as _public_names
from .errors_along import PathFilters as PathFilters
from .errors_along import PathRms as PathRms
from .errors_along import estimate_along as estimate_along
from .errors_along import filters_along as filters_along
from .errors_along import rms_along as rms_along
from .exposure import ErrorMap as ErrorMap
from .exposure import ExposureErrors as ExposureErrors
from .exposure import error_map as error_map
from .exposure import exposure_errors as exposure_errors
from .exposure import settling_time as settling_time
from .feedforward import Feedforward as Feedforward
from .feedforward import design_feedforward as design_feedforward
from .feedforward import known_forces as known_forces
from .input_shapers import InputShaper as InputShaper
from .input_shapers import input_shaper as input_shaper
from .input_shapers import quiet_setpoint as quiet_setpoint
from .learning import LearnedFeedforward as LearnedFeedforward
from .learning import learn_feedforward as learn_feedforward
from .motion import Motion as Motion
from .motion import SetPointProfile as SetPointProfile
from .motion import scan as scan
from .motion import setpoint as setpoint
from .nonlinear_elements import Dropout as Dropout
from .nonlinear_elements import Element as Element
from .nonlinear_elements import Friction as Friction
from .nonlinear_elements import Hysteresis as Hysteresis
from .nonlinear_elements import Jitter as Jitter
from .nonlinear_elements import Quantiser as Quantiser
from .nonlinear_elements import Saturation as Saturation
from .plant_inverse import inverse_forces as inverse_forces
from .residual_vibrations import ResidualVibration as ResidualVibration
from .residual_vibrations import residual_vibration as residual_vibration
from .response import Response as Response
from .sampled_runs import simulate as simulate
from .sampled_runs import spectral_noise as spectral_noise
from .specification import Specification as Specification
from .specification import Verdict as Verdict
from .studies import EstimatorComparison as EstimatorComparison
from .studies import StudyTable as StudyTable
from .studies import compare_estimators as compare_estimators
from .studies import reading_along as reading_along
from .studies import study as study

__dir__ = _public_names(__name__)
