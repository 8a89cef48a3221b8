"""The workbench: loops shaped by hand in a browser, on measured responses and on models.

``flexplant.workbench(plant)`` opens the page; what it makes is a `flexplant.synthesis.LoopDesign`.
Needs Panel: ``pip install 'flexplant[workbench]'``.
"""

import sys as _sys
from types import ModuleType as _ModuleType
from typing import Any as _Any

from ..rooms import public_names as _public_names
from .bench import Workbench as Workbench
from .limits import LoopLimits as LoopLimits
from .launch import open_file as open_file
from .launch import workbench as workbench

__dir__ = _public_names(__name__)


class _Room(_ModuleType):
    """The room is called to open its page: `flexplant.workbench(plant)`."""

    def __call__(self, *args: _Any, **options: _Any) -> Workbench:
        return workbench(*args, **options)


_sys.modules[__name__].__class__ = _Room
