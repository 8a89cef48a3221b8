"""The workbench: loops shaped by hand in a browser, on measured responses and on models.

- `open_page`: ``fx.workbench.open_page(plant)`` opens the page on this machine, and ``python -m
  flexplant.workbench measured.uff`` opens it on a file. In a notebook the page is shown below the
  cell.
- `WorkbenchServer`: ``design``, the current design; ``serve``, ``close``.
- `LoopLimits`: limits that the page draws and checks.
- `open_file`: opens a file by its path: a plant, or a design to continue.

The page shows L, Nyquist, S, T, KS, PS, the error in time and by source, the truncated modes, and
every machine of a fleet while a slider moves. Its result is a `fx.synthesis.LoopDesign`: the
elements of each axis, switched on or off. It can be saved and loaded, and writes a script that
repeats the design. The page needs Panel: ``pip install 'flexplant[workbench]'``. It accepts
connections from this computer only, reads no pickle, and opens only files whose path it was given.
`examples/workbench.py` shows its use.

>>> import flexplant as fx
>>> mass = fx.lti.discretized(fx.lti.tf([1.0], [1.0, 0.0, 0.0]), 2e3, delay=1)
>>> bench = fx.workbench.open_page(mass, open_browser=False)
>>> design = bench.design.with_axis("out", fx.synthesis.ShapedAxis([fx.Pid(9e4), fx.Lead(50.0)]))
>>> design.loops(mass).report.is_stable
True

Names elsewhere (MATLAB): ``controlSystemDesigner``, ``sisotool``: `open_page`; ShapeIt likewise.
"""

from ..rooms import public_names as _public_names
from .launch import WorkbenchServer as WorkbenchServer
from .launch import open_file as open_file
from .launch import open_page as open_page
from .verdict import LoopLimits as LoopLimits

__dir__ = _public_names(__name__)
