"""The workbench: loops shaped by hand in a browser, on measured responses and on models.

``flexplant.workbench(plant)`` opens the page; what it makes is a `flexplant.synthesis.LoopDesign`.
Needs Panel: ``pip install 'flexplant[workbench]'``.
"""

from ..rooms import called_names as _called_names
from .launch import Workbench as Workbench
from .launch import open_file as open_file
from .launch import workbench as workbench
from .limits import LoopLimits as LoopLimits

__dir__ = _called_names(__name__)
