"""All pictures: functions that take values and `ax=`, and return the axes they drew on.

Labels that name a thing give it the look of `STYLES`: "measured", "truth" (or "machine", "full
model"), "model" ("updated"), "nominal" ("drawing", "before"), "reduced", "bound"; other lines
follow `CYCLE`. Axes carry SI units with the prefix that brings the largest value to 1 .. 1000;
what is drawn into them later keeps it. Frequencies are in Hz, gains in dB with what 0 dB is.
"""

from ..rooms import public_names as _public_names
from ._axes import CYCLE as CYCLE
from ._axes import STYLES as STYLES
from .bode import bode as bode
from .bode import frf as frf
from .bode import singular_values as singular_values
from .budget import budget as budget
from .budget import spectra as spectra
from .estimation import consistency as consistency
from .estimation import estimate as estimate
from .estimation import lag_report as lag_report
from .estimation import predictions as predictions
from .exposures import error_map as error_map
from .exposures import exposures as exposures
from .identification import identified as identified
from .identification import stabilisation as stabilisation
from .layout import layout as layout
from .localisation import localisation as localisation
from .mode_shapes import animate_mode as animate_mode
from .mode_shapes import mode_shape as mode_shape
from .nyquist import nyquist as nyquist
from .nyquist import pole_map as pole_map
from .placement import pareto_curve as pareto_curve
from .placement import placed as placed
from .placement import sensor_map as sensor_map
from .pole_picker import PolePicker as PolePicker
from .report import report as report
from .response import response as response
from .response import step as step
from .sensitivity import sensitivities as sensitivities
from .sensitivity import sensitivity as sensitivity
from .update_summary import eigenvalues as eigenvalues
from .update_summary import parameters as parameters
from .update_summary import residual as residual
from .update_summary import update as update

__dir__ = _public_names(__name__)
