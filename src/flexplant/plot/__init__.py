"""All pictures: functions that draw values on the axes ``ax=`` or on new axes, and return the axes.

- `bode`, `frf`, `singular_values`, `nyquist`, `sensitivity`: responses and loops.
- `response`, `exposures`, `budget`, `spectra`: simulated runs, and errors by source.
- `update`, `parameters`, `residual`, `stabilisation`, `identified`: measurements and updates.
- `layout`, `mode_shape`, `sensor_map`, `placed`: the machine, its sensors and its actuators.
- `report(path, ...)`: a whole design as one HTML file, with zoomable pictures, moving mode shapes,
  certificates, seeds and versions.

>>> import flexplant as fx
>>> plant = fx.testbeds.three_masses()
>>> observer = fx.design_kalman(plant)
>>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
>>> loop = fx.close_loop(plant, observer, servo)
>>> axes = fx.plot.sensitivity(loop)
>>> axes.get_xlabel()
'frequency [Hz]'

**Legend.** A line with one of the labels below has the style of this label in `STYLES`. Other lines
have the colours of `CYCLE`, one after the other.

| drawn | label | look |
|---|---|---|
| what was measured | "measured" | black |
| the truth of a virtual machine | "truth", "machine", "full model" | wide green |
| the model | "model", "updated" | blue |
| the drawing | "nominal", "drawing", "before" | grey dashes |
| a reduced model | "reduced" | orange dashes |
| bounds | "bound" | red dots |
| differences | | purple |

In views from above, sensors are black crosses, actuators triangles and POIs circles. Axes have SI
units with the prefix that brings the largest value to 1 .. 1000 (mm, ms, nm, g). Lines that are
added later to the same axes have the same prefix. Frequencies are in Hz. Gains are in dB, and the
axis says which gain is 0 dB. If more than four lines would hide each other, each line has a
separate panel. If there are more than six lines in one panel, they are labelled at their ends.

For ``bode``, ``sigma``, ``nyquist``, ``pzmap``, ``rlocus`` and ``step`` of MATLAB use `bode`,
`singular_values`, `nyquist`, `pole_map`, `root_locus` and `step`.
"""

from ..rooms import public_names as _public_names
from ._axes import CYCLE as CYCLE
from ._axes import STYLES as STYLES
from .bode_diagrams import bode as bode
from .bode_diagrams import frf as frf
from .bode_diagrams import singular_values as singular_values
from .errors import budget as budget
from .errors import error_map as error_map
from .errors import exposures as exposures
from .errors import spectra as spectra
from .estimation import consistency as consistency
from .estimation import estimate as estimate
from .estimation import lag_report as lag_report
from .estimation import predictions as predictions
from .html_report import report as report
from .identification import identified as identified
from .identification import stabilisation as stabilisation
from .loops import nyquist as nyquist
from .loops import pole_map as pole_map
from .loops import sensitivities as sensitivities
from .loops import sensitivity as sensitivity
from .placement import pareto_curve as pareto_curve
from .placement import placed as placed
from .placement import position_map as position_map
from .placement import sensor_map as sensor_map
from .root_loci import root_locus as root_locus
from .run_pictures import response as response
from .run_pictures import step as step
from .shapes import layout as layout
from .shapes import mode_shape as mode_shape
from .updating import eigenvalues as eigenvalues
from .updating import localisation as localisation
from .updating import parameters as parameters
from .updating import residual as residual
from .updating import update as update

__dir__ = _public_names(__name__)
