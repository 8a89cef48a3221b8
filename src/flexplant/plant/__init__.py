"""Ports and the standard plant: the one bridge from (M, D, K) to (A, B, C, D).

`Ports` say where disturbances w, actuators u, points of interest z and sensors y are, once for
every model of a machine. The plant is always ``[w; u] -> [z; y]``, and ``u = K y``.

- `assemble_plant(model, ports)`: a `StandardPlant`; `standard_plant` of systems made elsewhere.
- `StandardPlant.discretized(rate, delay=)`: exact sampling, with the noise of each sample.
- `StandardPlant.weighted(z=, w=)`: with weights for H-infinity; `stage_weights` has a set of them.
- `StandardPlant.uncertain(fit)`, or of stated errors of frequency, damping, gain, delay.
- `decouple`: axes of the rigid body; `frequency_response` of structures between their ports.

>>> import flexplant as fx
>>> chain = fx.chain(masses=[1.0, 0.3], stiffnesses=[2e4])
>>> ports = fx.Ports(
...     w=[fx.Disturbance("amp", at="1:x", asd=1e-3)],
...     u=[fx.Actuator("u1", at="1:x")],
...     z=[fx.Poi("die", at="2:x", axes=("x",))],
...     y=[fx.Sensor("y1", at="1:x", asd=1e-9)],
...     references=[fx.Reference("die")],
... )
>>> plant = fx.assemble_plant(chain, ports).discretized(5e3, delay=1)
>>> print(plant)
<StandardPlant: 5 states, dt 0.0002 s, delay 1>
  w (3) amp  y1:noise  die:ref
  u (1) u1
  z (3) die:x  die:error  u1:effort
  y (2) y1  die:ref

| channel | what it is |
|---|---|
| `die:x`, `die:ref` | a POI's axis, and what it shall follow |
| `die:error`, `die:hat` | reference minus POI, and its estimate |
| `y1:noise`, `u1:effort` | noise of a sensor, force of an actuator |

White noise has the intensity asd^2 / 2, a sensor's sample the variance asd^2 rate / 2. Within a
sample: measure, update, control, hold.

**Weights of a stage.** `stage_weights` makes a four-block set for a wished bandwidth; what its
values do is measured in its table. ``plant.weighted(...)`` takes them, or weights of one's own:
numbers, `fx.lowpass`, `fx.lti.inverse_sensitivity`, any system with one input and one output.

Names elsewhere: ``augw``, ``mixsyn``: `mixed_sensitivity`, then `fx.design_hinf`; ``connect``,
``sumblk``: not needed, channels are found by name.
"""

from ..rooms import public_names as _public_names
from .assumptions import AssumptionReport as AssumptionReport
from .assumptions import ModeVisibility as ModeVisibility
from .force_spectra import FirstOrder as FirstOrder
from .force_spectra import NarrowBand as NarrowBand
from .force_spectra import RandomWalk as RandomWalk
from .force_spectra import RigidForce as RigidForce
from .forces import Actuator as Actuator
from .forces import BaseAcceleration as BaseAcceleration
from .forces import Disturbance as Disturbance
from .forces import OutputDisturbance as OutputDisturbance
from .larger_plant import larger_plant as larger_plant
from .mixed_sensitivity import mixed_sensitivity as mixed_sensitivity
from .moving import Along as Along
from .origin import Assembled as Assembled
from .origin import Foreign as Foreign
from .origin import Weighted as Weighted
from .port import ForcePort as ForcePort
from .port import Seen as Seen
from .port import SensorPort as SensorPort
from .ports import Ports as Ports
from .ports import Reference as Reference
from .reach_and_sight import Assumption as Assumption
from .residual_form import FastStates as FastStates
from .residual_form import Feedthrough as Feedthrough
from .rigid.decoupling import Decoupling as Decoupling
from .rigid.decoupling import decouple as decouple
from .rigid.stage import StageWeights as StageWeights
from .rigid.stage import reference_errors as reference_errors
from .rigid.stage import stage_weights as stage_weights
from .rigid.suspension import GroundSpring as GroundSpring
from .rigid.suspension import suspend as suspend
from .sensors import Poi as Poi
from .sensors import Sensor as Sensor
from .standard import StandardPlant as StandardPlant
from .standard import assemble_plant as assemble_plant
from .standard import standard_plant as standard_plant
from .structure_frf import StructureFrf as StructureFrf
from .structure_frf import frequency_response as frequency_response
from .uncertainty.neglected import NeglectedModes as NeglectedModes
from .uncertainty.neglected import neglected_modes as neglected_modes
from .uncertainty.uncertain_plant import Delta as Delta
from .uncertainty.uncertain_plant import UncertainPlant as UncertainPlant

__dir__ = _public_names(__name__)
