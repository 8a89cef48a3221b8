"""Symmetric sparse factors: orderings, Cholesky, LDL', PARDISO."""

from .pardiso import Pardiso as Pardiso
