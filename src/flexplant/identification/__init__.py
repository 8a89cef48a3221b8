"""What was measured: frequency responses, measured poles and mode shapes."""

from ..rooms import public_names as _public_names
from .diagram import PoleSelection as PoleSelection
from .diagram import StabilisationDiagram as StabilisationDiagram
from .frf_estimation import average_frfs as average_frfs
from .frf_estimation import estimate_frf as estimate_frf
from .identify import identify_modes as identify_modes
from .identify import stabilisation_diagram as stabilisation_diagram
from .impact import Blow as Blow
from .impact import ImpactTest as ImpactTest
from .impact import impact_frf as impact_frf
from .measured import MeasuredModes as MeasuredModes
from .measured import numbered as numbered
from .output_only import identify_output_only as identify_output_only
from .periodic import Periodic as Periodic
from .periodic import multisine as multisine
from .result import IdentifiedModes as IdentifiedModes
from .spectra import H1Estimator as H1Estimator
from .spectra import H2Estimator as H2Estimator
from .spectra import HvEstimator as HvEstimator
from .structural import shape_deviations as shape_deviations
from .structural import structural_modes as structural_modes

__dir__ = _public_names(__name__)
