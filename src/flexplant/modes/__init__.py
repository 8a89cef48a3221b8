"""Modes of a structure: the eigenvalue problem solved, counted and checked; attachment vectors."""

from ..rooms import public_names as _public_names
from .modes import MeshError as MeshError
from .modes import Modes as Modes
from .normal_form import NormalForm as NormalForm
from .normal_form import normal_form as normal_form
from .solve import solve_modes as solve_modes

__dir__ = _public_names(__name__)
