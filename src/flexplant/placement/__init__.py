"""Where sensors and actuators go: criteria, scores, search and bounds."""

from .branch_and_bound import BranchAndBound as BranchAndBound
from .constraints import Budget as Budget
from .constraints import Constraint as Constraint
from .constraints import Excluded as Excluded
from .constraints import MinimumDistance as MinimumDistance
from .constraints import Mirrored as Mirrored
from .constraints import OffPoi as OffPoi
from .constraints import Together as Together
from .constraints import Within as Within
from .criterion import Criterion as Criterion
from .criterion import Scorer as Scorer
from .exchange import Exchange as Exchange
from .exhaustive import Exhaustive as Exhaustive
from .poi_lqr import PoiLqr as PoiLqr
from .poi_variance import PoiVariance as PoiVariance
from .problem import Found as Found
from .problem import Problem as Problem
from .problem import Search as Search
from .scores import Scores as Scores
from .scores import score_actuators as score_actuators
from .scores import score_sensors as score_sensors
from .search import Placement as Placement
from .search import place_actuators as place_actuators
from .search import place_sensors as place_sensors
from .sensor_map import SensorMap as SensorMap
from .sensor_map import sensor_map as sensor_map
