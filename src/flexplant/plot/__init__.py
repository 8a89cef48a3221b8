"""All pictures: functions that take values and `ax=`, and return the axes they drew on."""

from .bode import bode as bode
from .budget import budget as budget
from .error_map import error_map as error_map
from .estimation import estimate as estimate
from .estimation import lag_report as lag_report
from .estimation import predictions as predictions
from .frequency import frf as frf
from .identification import identified as identified
from .identification import stabilisation as stabilisation
from .localisation import localisation as localisation
from .nyquist import nyquist as nyquist
from .placement import pareto_curve as pareto_curve
from .placement import placed as placed
from .placement import sensor_map as sensor_map
from .pole_map import pole_map as pole_map
from .report import report as report
from .response import response as response
from .sensitivity import sensitivities as sensitivities
from .sensitivity import sensitivity as sensitivity
from .singular_values import singular_values as singular_values
from .structure import layout as layout
from .structure import mode_shape as mode_shape
from .update_summary import update as update
from .updating import eigenvalues as eigenvalues
from .updating import parameters as parameters
from .updating import residual as residual
