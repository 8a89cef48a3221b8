"""Where sensors and actuators go: criteria, scores, search and bounds."""

from .criteria import PoiLqr as PoiLqr
from .criteria import PoiVariance as PoiVariance
from .scores import Scores as Scores
from .scores import score_actuators as score_actuators
from .scores import score_sensors as score_sensors
from .search import Exchange as Exchange
from .search import Exhaustive as Exhaustive
from .search import Placement as Placement
from .search import place_actuators as place_actuators
from .search import place_sensors as place_sensors
from .sensor_map import SensorMap as SensorMap
from .sensor_map import sensor_map as sensor_map
