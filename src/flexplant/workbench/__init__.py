"""The workbench: loops shaped by hand in a browser, on measured responses and on models.

- `open_page`: ``fx.workbench.open_page(plant)`` opens the page on this machine, and ``python -m
  flexplant.workbench measured.uff`` opens it on a file. In a notebook the answer is the page.
- `WorkbenchServer`: ``design``, what was shaped last; ``serve``, ``close``.
- `LoopLimits`: what the page draws as forbidden, and judges.
- `open_file`: what the page opens by its path: a plant, or a design to go on with.

The page shows L, Nyquist, S, T, KS, PS, the error in time and by source, the modes left out, and
every machine of a fleet while a slider moves. What it makes is a `fx.synthesis.LoopDesign`, the
elements of each axis, on or off: it saves, loads, and writes the script that makes it again. It
needs Panel: ``pip install 'flexplant[workbench]'``. It is served to this machine only, reads no
pickle, and opens no file but those whose path it was given. `examples/workbench.py` is its story.

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
