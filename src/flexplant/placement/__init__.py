"""Where sensors and actuators go: criteria, scores, search and bounds.

- `place_sensors(plant, candidates, count)`: the best choice for the error at the POI.
- `place_actuators`, `place_both`: the same for forces, and for both together.
- `score_sensors`, `score_actuators`: the score of each candidate alone.
- `sensor_map`: the error with one more sensor, for each place of a grid.
- `pareto_curve`: the best score for each number of devices.

Criteria are objects (`PoiVariance`, `ClosedLoopH2`, `ModeInformation`, ...). So are constraints
(`Excluded`, `OffPoi`, `MinimumDistance`, ...) and searches (`Exchange`, `Exhaustive`,
`BranchAndBound`). `BranchAndBound` proves its answer.

>>> import flexplant as fx
>>> plant = fx.testbeds.three_masses()
>>> places = [fx.Sensor(f"at {i}", at=f"{i}:x", asd=1e-9) for i in (1, 2, 3)]
>>> best = fx.place_sensors(
...     plant, places, count=1, constraints=[fx.placement.OffPoi(-1)], progress=False
... )
>>> best.chosen, round(1e9 * best.value**0.5, 1), round(1e9 * best.bound**0.5, 1)  # nm rms
(('at 2',), 20.6, 20.6)

Names elsewhere: effective independence is `ModeInformation` with `RowSelection`.
``examples/placement.py`` chooses four of 48 places with a proof.
"""

from ..rooms import public_names as _public_names
from .branch_and_bound import BranchAndBound as BranchAndBound
from .branch_and_bound import Exchange as Exchange
from .branch_and_bound import Screened as Screened
from .candidates import PlantChannel as PlantChannel
from .closed_loop_h2 import ClosedLoopH2 as ClosedLoopH2
from .closed_loop_h2 import PoiLqr as PoiLqr
from .constraints import Budget as Budget
from .constraints import Constraint as Constraint
from .constraints import CountLimits as CountLimits
from .constraints import Excluded as Excluded
from .constraints import JointGroups as JointGroups
from .constraints import MinimumDistance as MinimumDistance
from .constraints import OffPoi as OffPoi
from .constraints import ZoneLimits as ZoneLimits
from .criterion import Criterion as Criterion
from .criterion import Scorer as Scorer
from .gramian import ModalControllability as ModalControllability
from .gramian import ModalObservability as ModalObservability
from .mode_shapes import ModeInformation as ModeInformation
from .mode_shapes import RowSelection as RowSelection
from .poi_variance import PoiVariance as PoiVariance
from .problem import Placement as Placement
from .problem import Problem as Problem
from .problem import Search as Search
from .problem import SearchResult as SearchResult
from .scores import DeviceWorth as DeviceWorth
from .scores import Scores as Scores
from .scores import SensorMap as SensorMap
from .scores import device_worth as device_worth
from .scores import score_actuators as score_actuators
from .scores import score_sensors as score_sensors
from .scores import sensor_map as sensor_map
from .search import Exhaustive as Exhaustive
from .search import ParetoCurve as ParetoCurve
from .search import pareto_curve as pareto_curve
from .search import place_actuators as place_actuators
from .search import place_both as place_both
from .search import place_sensors as place_sensors
from .wrapping import DeviceLoss as DeviceLoss
from .wrapping import LeftOutModes as LeftOutModes
from .wrapping import OverMachines as OverMachines
from .wrapping import OverPositions as OverPositions
from .zones import Disc as Disc
from .zones import Rectangle as Rectangle

__dir__ = _public_names(__name__)
