"""flexplant: standard plants for flexible machines.

From finite-element matrices and a measurement to the closed-loop error at a point of interest::

    FEModel --solve_modes--> Modes --reduce--> ReducedModel --update--> UpdateResult.model
        --assemble_plant--> StandardPlant --design_...--> blocks --close_loop--> --simulate-->
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
    """Import the pictures at their first use (they need matplotlib); say which room has a name."""
    if name == "plot":
        return _import_module(".plot", __name__)
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
    return sorted(names | {n for n, v in items if hasattr(v, "__path__")} | {"errors", "plot"})
