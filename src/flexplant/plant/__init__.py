"""Ports and the standard plant: from (M, D, K) to (A, B, C, D).

`Ports` define the places of disturbances w, actuators u, points of interest z and sensors y, once
for all models of a machine. The plant is always ``[w; u] -> [z; y]``, and ``u = K y``.

- `assemble_plant(model, ports)`: returns a `StandardPlant`. `standard_plant` makes one from a
  system that you built in another way.
- `StandardPlant.discretized(rate, delay=)`: exact sampling, with the noise of each sample.
- `StandardPlant.weighted(z=, w=)`: the plant with weights for H-infinity, for example those of
  `stage_weights`.
- `StandardPlant.uncertain(Frequencies(0.005), Gains(0.02), fit, ...)`: the plant with its
  uncertainty, as Deltas for analysis and as machines drawn at random. Your own kind of uncertainty
  derives from `Uncertainty`. Two kinds describe dynamics that the model lacks: `Neglected` modes,
  and `UnmodelledDynamics(weight, at="u1")`.
- Your own kind of sensor derives from `SensorPort`, your own kind of force from `ForcePort`.
- `decouple` finds the axes that the actuators move, and `gravity_axes` those of a free body, with
  its mass. `frequency_response` computes the response of a structure between its ports.

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

| channel | meaning |
|---|---|
| `die:x`, `die:ref` | an axis of a POI, and the reference it shall follow |
| `die:error`, `die:hat` | reference minus POI, and its estimate |
| `y1:noise`, `u1:effort` | noise of a sensor, force of an actuator |

White noise of the one-sided density asd has the intensity asd^2 / 2. The noise of one sample of a
sensor has the variance asd^2 rate / 2. In each sample the sensors are read, the estimate is
updated, the controller computes u, and u is held until the next sample.

**Weights of a stage.** ``plant.weighted(...)`` takes the weights of `stage_weights` or your own
ones. A weight is a number or a system with one input and one output, for example
`fx.lti.low_pass_filter` or `fx.lti.inverse_sensitivity`.

The table shows the effect of the arguments of `stage_weights` for the plate of
``examples/wafer_stage.py`` at 0.1 % damping, 10 kHz, with a delay of 1.3 samples. The design uses a
reduced model with measured poles, with ``uncertainty`` for the other modes. The results are those
of a machine that is computed with another plate theory. "changed" is the argument that differs from
its default, and "gamma" is the H-infinity norm of the weighted closed loop. "to" is the frequency
at which |S| from reference to error reaches 1. The other columns are the peak of |S|, the modulus
margin at u, and |S| at 5 Hz::

    bandwidth  changed          gamma   to [Hz]  |S| [dB]  margin at u  |S| at 5 Hz
           60                    1.00      44       5.1        0.53        0.0032
          100                    1.01      67       6.0        0.44        0.0008
          120                    1.03      77       6.1        0.42        0.0005
          140                    1.06      87       6.1        0.39        0.0003
          120  peak 1.3          1.31      88       6.2        0.44        0.0005
          120  peak 6            1.00      58       8.2      unstable      0.0007
          120  disturbance 6     1.03      76       6.3        0.41        0.0005
          120  effort 3          1.45      95       7.7        0.35        0.0002
          120  effort 30         1.00      57       5.5        0.48        0.0014
          120  noise 0.5         1.03      77       6.1        0.42        0.0005

A larger effort makes the loop slower and its margin larger. Disturbance and noise have
little influence here. With peak 6 the loop is unstable, because one mode of the machine has another
frequency than in the model. The defaults of disturbance and effort are 20 and 10 with
``uncertainty``, and 3 and 3 without it. The larger they are, the more the complementary sensitivity
|T| at u determines gamma. Noise below 0.02 gives the controller more gain at the modes that the
model lacks.

Without ``uncertainty``, a design for 80 Hz on the same model is unstable on that machine. At 1 %
damping that design has a margin of 0.44 on the machine (0.34 on the model of the drawing). With
``uncertainty`` the margin is 0.50, but |S| reaches 1 at 62 Hz already. `fx.design_stage` finds the
largest bandwidth with a margin of 0.4.

For MATLAB's ``augw`` and ``mixsyn`` use `mixed_sensitivity`, then `fx.design_hinf`. ``connect`` and
``sumblk`` are not needed, because channels are found by name.
"""

from ..rooms import public_names as _public_names
from .assumptions import Assumption as Assumption
from .assumptions import AssumptionReport as AssumptionReport
from .axes import DrivenAxes as DrivenAxes
from .axes import driven_axes as driven_axes
from .decoupling import Decoupling as Decoupling
from .decoupling import GravityAxes as GravityAxes
from .decoupling import decouple as decouple
from .decoupling import gravity_axes as gravity_axes
from .forces import Actuator as Actuator
from .forces import BaseAcceleration as BaseAcceleration
from .forces import Disturbance as Disturbance
from .forces import FirstOrder as FirstOrder
from .forces import NarrowBand as NarrowBand
from .forces import OutputDisturbance as OutputDisturbance
from .forces import RandomWalk as RandomWalk
from .forces import RigidForce as RigidForce
from .generalized import GeneralizedPlant as GeneralizedPlant
from .inverse import SlowZeros as SlowZeros
from .machine_plants import FigureInterval as FigureInterval
from .machine_plants import MachineParts as MachineParts
from .machine_plants import PlantMachines as PlantMachines
from .moving import PortPath as PortPath
from .moving import PositionMap as PositionMap
from .origins import Assembled as Assembled
from .origins import Foreign as Foreign
from .origins import MeasuredResponse as MeasuredResponse
from .partitioned import EvaluationModel as EvaluationModel
from .port import ForcePort as ForcePort
from .port import MeasuredRow as MeasuredRow
from .port import SensorPort as SensorPort
from .ports import Poi as Poi
from .ports import Ports as Ports
from .ports import Reference as Reference
from .ports import Sensor as Sensor
from .realisation import FastStates as FastStates
from .realisation import Feedthrough as Feedthrough
from .scheduling import PlaceMotion as PlaceMotion
from .scheduling import PlaceTable as PlaceTable
from .scheduling import Position as Position
from .standard import AnyPlant as AnyPlant
from .standard import StandardPlant as StandardPlant
from .standard import assemble_plant as assemble_plant
from .standard import plant_of as plant_of
from .standard import standard_plant as standard_plant
from .structure_frf import StructureFrf as StructureFrf
from .structure_frf import frequency_response as frequency_response
from .suspension import GroundSpring as GroundSpring
from .suspension import suspend as suspend
from .uncertainty.delta import Delta as Delta
from .uncertainty.delta import Known as Known
from .uncertainty.delta import Uncertainty as Uncertainty
from .uncertainty.fit import Fit as Fit
from .uncertainty.gains import Delay as Delay
from .uncertainty.gains import Gains as Gains
from .uncertainty.mode_delta import Dampings as Dampings
from .uncertainty.mode_delta import Frequencies as Frequencies
from .uncertainty.neglected import Neglected as Neglected
from .uncertainty.neglected_dynamics import NeglectedModes as NeglectedModes
from .uncertainty.neglected_dynamics import neglected_modes as neglected_modes
from .uncertainty.parameter_amounts import Parameters as Parameters
from .uncertainty.shape_directions import Shapes as Shapes
from .uncertainty.uncertain_plants import UncertainPlant as UncertainPlant
from .uncertainty.unmodelled import UnmodelledDynamics as UnmodelledDynamics
from .visibility import ModeVisibility as ModeVisibility
from .weights import StageWeights as StageWeights
from .weights import mixed_sensitivity as mixed_sensitivity
from .weights import reference_errors as reference_errors
from .weights import stage_weights as stage_weights

__dir__ = _public_names(__name__)
