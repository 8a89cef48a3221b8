"""The workbench: loops shaped by hand in a browser, on measured responses and on models.

- `open_page`: ``fx.workbench.open_page(plant)`` opens the page for a plant, and
  ``python -m flexplant.workbench measured.uff`` opens it for a file. In a notebook the page is
  shown below the cell.
- `WorkbenchServer`: the object that `open_page` returns. Its ``design`` is the current design;
  ``serve`` and ``close`` start and end the page.
- `LoopLimits`: limits that the page draws and checks.
- `open_file`: reads a plant, or a design to continue, from a file.

While a slider moves, the page shows the loop gain L, the Nyquist curve, S, T, KS and PS, the error
over time and by source, the effect of truncated modes, and every machine of a fleet. Its result is
a `fx.synthesis.LoopDesign`, which contains the controller elements of each axis; each element can
be switched off. It can be saved and loaded, and writes a script that repeats the design. The page
needs Panel: ``pip install 'flexplant[workbench]'``. It accepts connections from this computer only,
never reads pickle files, and opens only files whose path you gave. `examples/workbench.py` shows
its use.

>>> import flexplant as fx
>>> mass = fx.lti.discretized(fx.lti.tf([1.0], [1.0, 0.0, 0.0]), 2e3, delay=1)
>>> bench = fx.workbench.open_page(mass, open_browser=False)
>>> design = bench.design.with_axis("out", fx.synthesis.ShapedAxis([fx.Pid(9e4), fx.Lead(50.0)]))
>>> design.loops(mass).report.is_stable
True

`open_page` serves the same purpose as ``controlSystemDesigner`` and ``sisotool`` in MATLAB, and as
ShapeIt.
"""

from ..rooms import public_names as _public_names
from .launch import WorkbenchServer as WorkbenchServer
from .launch import open_file as open_file
from .launch import open_page as open_page
from .verdict import LoopLimits as LoopLimits

__dir__ = _public_names(__name__)
