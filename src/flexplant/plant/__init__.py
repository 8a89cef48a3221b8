"""Ports, weights and the standard plant: the one bridge from (M, D, K) to (A, B, C, D)."""

from .assembly import assemble_plant as assemble_plant
from .check import Assumption as Assumption
from .check import AssumptionReport as AssumptionReport
from .ports import Actuator as Actuator
from .ports import Disturbance as Disturbance
from .ports import Poi as Poi
from .ports import Ports as Ports
from .ports import Reference as Reference
from .ports import Sensor as Sensor
from .stage import StageWeights as StageWeights
from .stage import reference_errors as reference_errors
from .stage import stage_weights as stage_weights
from .standard import StandardPlant as StandardPlant
from .weights import highpass as highpass
from .weights import inverse_sensitivity as inverse_sensitivity
from .weights import leadlag as leadlag
from .weights import lowpass as lowpass
from .weights import notch as notch
