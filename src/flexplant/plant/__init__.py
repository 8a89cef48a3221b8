"""Ports and the standard plant: the one bridge from (M, D, K) to (A, B, C, D)."""

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
