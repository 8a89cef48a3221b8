"""Symmetric sparse factors that know nothing of structures: orderings, Cholesky, LDL', PARDISO."""

from .pardiso import Pardiso as Pardiso
