"""flexplant: standard plants for flexible machines.

From finite-element matrices and a measurement to the closed-loop error at a point of interest::

    FEModel --solve_modes--> Modes --reduce--> ReducedModel --update--> UpdateResult.model
        --assemble_plant--> StandardPlant --design_...--> blocks --close_loop--> --simulate-->
"""

from typing import Any

from . import errors as errors
from . import io as io
from . import parallel as _parallel  # noqa: F401  # before lti's connection takes the name
from . import testbeds as testbeds
from .errors import FlexplantError as FlexplantError
from .errors import FlexplantWarning as FlexplantWarning
from .estimation import KalmanEstimator as KalmanEstimator
from .estimation import StaticEstimator as StaticEstimator
from .estimation import design_kalman as design_kalman
from .estimation import design_static as design_static
from .identification import H1Estimator as H1Estimator
from .identification import H2Estimator as H2Estimator
from .identification import HvEstimator as HvEstimator
from .identification import IdentifiedModes as IdentifiedModes
from .identification import MeasuredModes as MeasuredModes
from .identification import Periodic as Periodic
from .identification import PoleSelection as PoleSelection
from .identification import StabilisationDiagram as StabilisationDiagram
from .identification import average_frfs as average_frfs
from .identification import estimate_frf as estimate_frf
from .identification import identify_modes as identify_modes
from .identification import multisine as multisine
from .identification import numbered as numbered
from .identification import stabilisation_diagram as stabilisation_diagram
from .io import read_matrices as read_matrices
from .io import read_model as read_model
from .labels import DofSet as DofSet
from .loop import ClosedLoop as ClosedLoop
from .loop import bandwidth as bandwidth
from .loop import close_loop as close_loop
from .loop import compare_loops as compare_loops
from .loop import complementary_sensitivity as complementary_sensitivity
from .loop import control_sensitivity as control_sensitivity
from .loop import loop_gain as loop_gain
from .loop import modulus_margin as modulus_margin
from .loop import sensitivity as sensitivity
from .lti import BalancedReduction as BalancedReduction
from .lti import Frf as Frf
from .lti import ModalForm as ModalForm
from .lti import NormReport as NormReport
from .lti import Split as Split
from .lti import StateSpace as StateSpace
from .lti import append as append
from .lti import balanced as balanced
from .lti import connect as connect
from .lti import discretized as discretized
from .lti import feedback as feedback
from .lti import frequency_response as frequency_response
from .lti import h2_norm as h2_norm
from .lti import hankel_norm as hankel_norm
from .lti import hankel_values as hankel_values
from .lti import hinf_norm as hinf_norm
from .lti import lft as lft
from .lti import linf_norm as linf_norm
from .lti import matched as matched
from .lti import minimal as minimal
from .lti import modal_form as modal_form
from .lti import norm_report as norm_report
from .lti import parallel as parallel
from .lti import peak_gain as peak_gain
from .lti import series as series
from .lti import split_stable as split_stable
from .lti import tustin as tustin
from .placement import Exchange as Exchange
from .placement import Exhaustive as Exhaustive
from .placement import Placement as Placement
from .placement import PoiLqr as PoiLqr
from .placement import PoiVariance as PoiVariance
from .placement import Scores as Scores
from .placement import SensorMap as SensorMap
from .placement import place_actuators as place_actuators
from .placement import place_sensors as place_sensors
from .placement import score_actuators as score_actuators
from .placement import score_sensors as score_sensors
from .placement import sensor_map as sensor_map
from .plant import Actuator as Actuator
from .plant import Along as Along
from .plant import AssumptionReport as AssumptionReport
from .plant import BaseAcceleration as BaseAcceleration
from .plant import Decoupling as Decoupling
from .plant import Disturbance as Disturbance
from .plant import FastStates as FastStates
from .plant import Feedthrough as Feedthrough
from .plant import GroundSpring as GroundSpring
from .plant import NeglectedModes as NeglectedModes
from .plant import OutputDisturbance as OutputDisturbance
from .plant import Poi as Poi
from .plant import Ports as Ports
from .plant import Reference as Reference
from .plant import Sensor as Sensor
from .plant import StageWeights as StageWeights
from .plant import StandardPlant as StandardPlant
from .plant import UncertainPlant as UncertainPlant
from .plant import assemble_plant as assemble_plant
from .plant import decouple as decouple
from .plant import highpass as highpass
from .plant import inverse_sensitivity as inverse_sensitivity
from .plant import larger_plant as larger_plant
from .plant import leadlag as leadlag
from .plant import lowpass as lowpass
from .plant import neglected_modes as neglected_modes
from .plant import notch as notch
from .plant import pade as pade
from .plant import reference_errors as reference_errors
from .plant import stage_weights as stage_weights
from .plant import suspend as suspend
from .reduction import CraigBampton as CraigBampton
from .reduction import DesiredDofs as DesiredDofs
from .reduction import EffectiveIndependence as EffectiveIndependence
from .reduction import Greedy as Greedy
from .reduction import Guyan as Guyan
from .reduction import Irs as Irs
from .reduction import Krylov as Krylov
from .reduction import MacNeal as MacNeal
from .reduction import ModalBalanced as ModalBalanced
from .reduction import ModalTruncation as ModalTruncation
from .reduction import Modes as Modes
from .reduction import PivotedQr as PivotedQr
from .reduction import ReducedModel as ReducedModel
from .reduction import Rubin as Rubin
from .reduction import Serep as Serep
from .reduction import rank_modes as rank_modes
from .reduction import reduce as reduce
from .reduction import select_dofs as select_dofs
from .reduction import solve_modes as solve_modes
from .simulation import Response as Response
from .simulation import SetPoint as SetPoint
from .simulation import setpoint as setpoint
from .simulation import simulate as simulate
from .store import load as load
from .structure import Damper as Damper
from .structure import Disc as Disc
from .structure import FEMatrices as FEMatrices
from .structure import FEModel as FEModel
from .structure import Hysteretic as Hysteretic
from .structure import ModalDamping as ModalDamping
from .structure import ModelCheck as ModelCheck
from .structure import Pardiso as Pardiso
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
from .synthesis import Lmi as Lmi
from .synthesis import Riccati as Riccati
from .synthesis import design_hinf as design_hinf
from .synthesis import design_servo as design_servo
from .updating import AddedDamping as AddedDamping
from .updating import AddedMass as AddedMass
from .updating import AddedStiffness as AddedStiffness
from .updating import Antiresonances as Antiresonances
from .updating import Correlation as Correlation
from .updating import Eigenvalues as Eigenvalues
from .updating import FrfResidual as FrfResidual
from .updating import GaussNewton as GaussNewton
from .updating import Identifiability as Identifiability
from .updating import Lasso as Lasso
from .updating import Localisation as Localisation
from .updating import MatrixParameter as MatrixParameter
from .updating import ModeDamping as ModeDamping
from .updating import ModeShapes as ModeShapes
from .updating import Posterior as Posterior
from .updating import ShapeCorrelation as ShapeCorrelation
from .updating import StaticCompliance as StaticCompliance
from .updating import Tikhonov as Tikhonov
from .updating import TrustRegion as TrustRegion
from .updating import UpdateResult as UpdateResult
from .updating import Validation as Validation
from .updating import correlate as correlate
from .updating import eigenvalue_sensitivities as eigenvalue_sensitivities
from .updating import fdac as fdac
from .updating import frac as frac
from .updating import identifiability as identifiability
from .updating import localise as localise
from .updating import mac as mac
from .updating import sample_posterior as sample_posterior
from .updating import split as split
from .updating import update as update
from .updating import validate as validate

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Import the pictures only when they are asked for: they need matplotlib."""
    if name == "plot":
        import importlib

        return importlib.import_module(".plot", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
