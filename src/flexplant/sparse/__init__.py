"""Symmetric sparse factors: orderings, Cholesky, LDL', PARDISO."""

from ..rooms import public_names as _public_names
from .pardiso import Pardiso as Pardiso

__dir__ = _public_names(__name__)
