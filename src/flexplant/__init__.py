"""flexplant: standard plants for flexible machines.

From finite-element matrices and a measurement to the closed-loop error at a point of interest::

    FEModel --solve_modes--> Modes --reduce--> ReducedModel --update--> UpdateResult.model
      (M, D, K, dofs)                           (M*, D*, K*, T)  ^            |
                                              MeasuredModes -----'            |
                                                      assemble_plant(model, ports)
                                                                              v
      +-----------+   [w;u] -> [z;y]      StandardPlant --discretized(rate, delay)--> sampled
    z<|           |<w                          +-----------+-----------+--------------+
    y<|     P     |<u                  design_kalman   design_servo,   score_sensors,
      +-----------+                            |       design_hinf     place_sensors, ...
        +-->K--+                               v           v
                         close_loop(plant, *blocks) --> ClosedLoop --simulate--> Response

Every model of one machine takes the same `Ports`: the drawing, the updated model, the truth. Each
room below has its own page, ``help(fx.plant)``: what it is for, an example, its names elsewhere.

>>> import flexplant as fx
>>> plant = fx.testbeds.three_masses()
>>> observer = fx.design_kalman(plant)
>>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
>>> print(fx.close_loop(plant, observer, servo))
<ClosedLoop: plant 7 states, controller 11 states, dt 0.0005 s>
  stable: spectral radius 0.996842717, modulus margin 0.57
  driven: u1
  monitored: die:hat
  no frequency of a mode off by 1 % does harm

**Conventions**

| convention | |
|---|---|
| units | SI; `freq` in Hz, `omega` in rad/s; rx = dz/dy, ry = -dz/dx |
| spectra | `psd`, `asd` one-sided; white noise has the intensity asd^2 / 2 |
| channels | inputs `[w; u]`, outputs `[z; y]`; `u = K y`: the sign is in the controller |
| names | `die:z` (POI), `die:ref`, `die:error` (reference minus POI), `die:hat` (estimate) |
| time | dt = 0 is continuous; within a sample: measure, update, control, hold |
| modes | numbered from 1, rigid-body modes included; these are undamped unless a damper says so |

**What to rely on**

- Answers carry a check made by another route. A Kalman filter's predicted error is recomputed by a
  Stein equation, an H-infinity controller is verified by the closed-loop norm, found with proof and
  by a sweep; modes by residual and count. A failed check raises.
- Checks go beyond the model. Modes that a reduction left out are noise in a filter's predicted
  error, and every loop is tried on the plant that has them: what they make unstable is named. A fit
  says by chi-square whether the parameters explain the data.
- SI units serve as they are. Gains of 1e-9 m/N, damping of 0.1 %, rigid-body modes at exactly zero,
  repeated modes: scaling happens inside.
- Nothing is repaired silently. Errors say what is wrong, what was got, why it matters and what to
  do next.

**Which example for which task** (``python examples/<name>.py`` in the repository)

- see what a model of this machine buys: `examples/wafer_stage.py`
- read matrices of a finite-element program: `examples/from_nastran.py`; an imported solid in six
  axes: `examples/solid_stage.py`
- reduce: `examples/reduction_methods.py`, twelve ways in one table
- solve a large model: `examples/million_dofs.py`
- identify and update: `examples/measured_frf.py`; a real record: `examples/ruler.py`; the paper's
  numbers and figures: `examples/paper_plate.py`
- estimate from records: `examples/recorded_data.py`; a POI that moves: `examples/moving_poi.py`
- control six axes: `examples/maglev.py`; a stage that scans below sensors on its frame:
  `examples/scanning_stage.py`
- shape loops by hand in a browser, on measured responses: `examples/workbench.py`
- follow set-points: `examples/feedforward.py`
- guarantee robustness: `examples/robust_control.py`
- join components: `examples/joined_machine.py`
- place sensors and actuators: `examples/placement.py`
- design for many machines: `examples/fleet.py`
- write a specification as tests: `examples/test_specifications.py`
- run a controller in C beside the machine, at 10 kHz: `examples/real_time.py`

**Beside its peers.** CPU seconds on one core of a server, ours and a peer's in one run of
``OMP_NUM_THREADS=1 python tests/benchmarks/readme_table.py``. A ratio above 1 means that ours is
faster; the answers are compared first. Figures of another run differ by some 20 %.

| task | flexplant | peer | its time | ratio |
|---|---|---|---|---|
| 24 modes of a solid, 27 783 DOFs | 3.3 s | scipy eigsh | 23 s | 7 |
| all 243 modes of a plate, dense | 16 ms | scipy eigh | 4.7 ms | 0.29 |
| 200 lines of a plate's responses, 30 000 DOFs | 2.4 s | scipy splu (4 of them) | 420 s | 180 |
| 8 x 8 frequency responses, 10 000 lines | 4.5 ms | python-control, slycot | 0.13 s | 28 |
| H-infinity norm, 48 states, 0.1 % damping | 2.4 ms | slycot ab13dd | 2.3 ms | 0.94 |
| the same, A dense | 2.4 ms | slycot ab13dd | 2.2 ms | 0.95 |
| H2 norm, 200 states | 2.2 ms | python-control, slycot | 4.3 ms | 1.9 |
| zero-order hold, 48 states | 0.46 ms | scipy cont2discrete | 0.19 ms | 0.41 |
| a discrete Riccati equation, 48 states | 3.5 ms | scipy solve_discrete_are | 7.9 ms | 2.2 |
| 100 000 samples through a Kalman filter | 29 ms | filterpy (5000 of them) | 5.1 s | 180 |
| 100 000 samples of a loop, 218 states | 60 ms | python-control | 1.5 s | 25 |
| the same, commands saturated | 2.2 s | python-control (2000 of them) | 3.9 s | 1.8 |
| H-infinity, 3 states: norm 0.138 | 37 ms | python-control, slycot: 0.137 | 19 ms | 0.51 |
| H-infinity, 61 states of a stage: norm 0.947 | 0.45 s | slycot: no answer in 10 s | - | - |
| mu of 12 complex scalars, both bounds | 49 ms | slycot ab13md, the upper one | 14 ms | 0.29 |
| poles of a close pair in noise: error 5e-07 | 0.41 s | scikit-rf: 7e-07 | 0.18 s | 0.44 |
| a sparse OUTPUT4 file of Nastran | 7.1 ms | pyYeti | 32 ms | 4.5 |

Peers are better where no check is wanted. Of the 16 ms for all modes of the plate, 5 are residuals
of each, 6 set rigid-body motions apart and find soft modes again to all digits; a hold returns a
labelled system, checked; H-infinity of 3 states is enclosed to 1 %, its norm found twice; mu has a
lower bound too, by a perturbation that reaches it.
``python -m pytest -m benchmark -s tests/benchmarks`` times many more.

**Limits**

- Sizes tried: models of 2 to 998 787 DOFs (24 modes of that one: 39 to 45 s and 4.8 GB on one core;
  of a solid of 292 008: 85 s and 4.1 GB; ``python tests/benchmarks/modes_peers.py solid 45 ours``
  repeats it; memory settings are in `flexplant.sparse`); plants of 2 to 490 states; a Kalman filter
  of 1000 states (18 s and 0.4 GB; time grows with their third power); H-infinity in six axes with
  40 modes (3 s); four of 1024 candidate places (41 s, 0.7 % above what is proven); studies of
  10 000 machines (91 MB from the first thousand to the last); 1e8 samples of a filter in C.
- Dampings tried: 0.01 % to 1 %, none at all, and magnets of negative stiffness.
- Units tried: SI, and files in mm and t or other units of length, mass and time.
- Structures are linear and time-invariant, M, D and K symmetric: no gyroscopic terms, contact or
  temperature. POIs may move.

**Licences.** flexplant has the MIT licence. What it needs at run time: NumPy, SciPy, python-control
and threadpoolctl (BSD-3), cvxpy and Clarabel (Apache-2.0), filterpy (MIT), matplotlib (its own, of
BSD kind), tqdm (MPL-2.0 and MIT). Extras, as in ``pip install -e '.[ansys]'``: ``hdf5`` is h5py and
``workbench`` panel (BSD-3), ``uff`` pyuff and ``ansys`` ansys-mapdl-reader (MIT), ``mkl`` Intel's
own, ``docs`` pdoc (MIT-0). What these need in turn has licences of the same kinds. slycot (GPL-2)
and other peers are used in tests only. Sources are cited by the keys of `flexplant.bibliography`;
the method is that of [paper]_. Its text says 0.1 % modal damping while its printed eigenvalues have
1 %; `examples/paper_plate.py` shows both.
"""

from importlib import import_module as _import_module
from typing import Any as _Any

from . import errors as errors
from . import io as io
from . import testbeds as testbeds
from .errors import FlexplantError as FlexplantError
from .errors import FlexplantWarning as FlexplantWarning
from .estimation import FixedLag as FixedLag
from .estimation import KalmanEstimator as KalmanEstimator
from .estimation import Smoother as Smoother
from .estimation import design_kalman as design_kalman
from .estimation import design_static as design_static
from .identification import MeasuredModes as MeasuredModes
from .identification import average_frfs as average_frfs
from .identification import estimate_frf as estimate_frf
from .identification import identify_modes as identify_modes
from .identification import numbered as numbered
from .io import read_matrices as read_matrices
from .io import read_model as read_model
from .joining import Joint as Joint
from .joining import Patch as Patch
from .joining import Pose as Pose
from .joining import joined as joined
from .joining import uncoupled as uncoupled
from .labels import DofSet as DofSet
from .loop import ClosedLoop as ClosedLoop
from .loop import close_loop as close_loop
from .loop import compare_loops as compare_loops
from .loop import modulus_margin as modulus_margin
from .lti import Frf as Frf
from .lti import StateSpace as StateSpace
from .lti import balanced as balanced
from .lti import discretized as discretized
from .lti import h2_norm as h2_norm
from .lti import hinf_norm as hinf_norm
from .lti import lft as lft
from .lti import lowpass as lowpass
from .lti import minimal as minimal
from .lti import modal_form as modal_form
from .lti import peak_gain as peak_gain
from .modes import Modes as Modes
from .modes import solve_modes as solve_modes
from .placement import Placement as Placement
from .placement import PoiVariance as PoiVariance
from .placement import place_actuators as place_actuators
from .placement import place_both as place_both
from .placement import place_sensors as place_sensors
from .placement import score_actuators as score_actuators
from .placement import score_sensors as score_sensors
from .placement import sensor_map as sensor_map
from .plant import Actuator as Actuator
from .plant import BaseAcceleration as BaseAcceleration
from .plant import Disturbance as Disturbance
from .plant import OutputDisturbance as OutputDisturbance
from .plant import Poi as Poi
from .plant import Ports as Ports
from .plant import Reference as Reference
from .plant import Sensor as Sensor
from .plant import StandardPlant as StandardPlant
from .plant import assemble_plant as assemble_plant
from .plant import decouple as decouple
from .plant import frequency_response as frequency_response
from .plant import reference_errors as reference_errors
from .plant import stage_weights as stage_weights
from .reduction import CraigBampton as CraigBampton
from .reduction import DesiredDofs as DesiredDofs
from .reduction import Guyan as Guyan
from .reduction import Irs as Irs
from .reduction import Krylov as Krylov
from .reduction import MacNeal as MacNeal
from .reduction import ModalBalanced as ModalBalanced
from .reduction import ModalTruncation as ModalTruncation
from .reduction import ReducedModel as ReducedModel
from .reduction import Rubin as Rubin
from .reduction import Serep as Serep
from .reduction import rank_modes as rank_modes
from .reduction import reduce as reduce
from .reduction import select_dofs as select_dofs
from .simulation import Response as Response
from .simulation import Specification as Specification
from .simulation import compare_estimators as compare_estimators
from .simulation import design_feedforward as design_feedforward
from .simulation import reading_along as reading_along
from .simulation import scan as scan
from .simulation import setpoint as setpoint
from .simulation import simulate as simulate
from .simulation import study as study
from .store import load as load
from .structure import Damper as Damper
from .structure import Disc as Disc
from .structure import FEMatrices as FEMatrices
from .structure import FEModel as FEModel
from .structure import Hysteretic as Hysteretic
from .structure import ModalDamping as ModalDamping
from .structure import PointMass as PointMass
from .structure import Rayleigh as Rayleigh
from .structure import Rectangle as Rectangle
from .structure import Rib as Rib
from .structure import Spring as Spring
from .structure import beam as beam
from .structure import chain as chain
from .structure import check as check
from .structure import interpolated as interpolated
from .structure import kirchhoff_plate as kirchhoff_plate
from .structure import solid_block as solid_block
from .synthesis import Controller as Controller
from .synthesis import Lead as Lead
from .synthesis import Lmi as Lmi
from .synthesis import LowPass as LowPass
from .synthesis import Notch as Notch
from .synthesis import Pid as Pid
from .synthesis import Riccati as Riccati
from .synthesis import design_h2 as design_h2
from .synthesis import design_hinf as design_hinf
from .synthesis import design_loops as design_loops
from .synthesis import design_ncf as design_ncf
from .synthesis import design_servo as design_servo
from .synthesis import design_stage as design_stage
from .synthesis import ncf_margin as ncf_margin
from .synthesis import servo_bandwidth as servo_bandwidth
from .synthesis import tune_loops as tune_loops
from .updating import AddedDamping as AddedDamping
from .updating import AddedMass as AddedMass
from .updating import AddedStiffness as AddedStiffness
from .updating import Eigenvalues as Eigenvalues
from .updating import FrfResidual as FrfResidual
from .updating import MatrixParameter as MatrixParameter
from .updating import ModeShapes as ModeShapes
from .updating import UpdateResult as UpdateResult
from .updating import identifiability as identifiability
from .updating import localise as localise
from .updating import sample_posterior as sample_posterior
from .updating import update as update
from .updating import validate as validate
from .versions import show_versions as show_versions

__version__ = "0.1.0"


def __getattr__(name: str) -> _Any:
    """Import the last rooms at their first use (they need more); say which room has a name."""
    if name in ("plot", "workbench"):
        return _import_module(f".{name}", __name__)
    rooms = [n for n, v in globals().items() if hasattr(v, "__path__") and hasattr(v, name)]
    where = "".join(f" Use flexplant.{room}.{name}." for room in rooms)
    ours = _import_module(".foreign_names", __name__).OURS.get(name)
    if ours and not where:
        where = f" What MATLAB or python-control call so is flexplant.{ours}."
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}.{where}")


def __dir__() -> list[str]:
    """Return the public names, and the rooms that hold the others."""
    items = [(name, item) for name, item in globals().items() if not name.startswith("_")]
    names = {n for n, v in items if getattr(v, "__module__", "").startswith(__name__)}
    return sorted(
        names | {n for n, v in items if hasattr(v, "__path__")} | {"errors", "plot", "workbench"}
    )
