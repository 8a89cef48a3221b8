"""Symmetric sparse factors: orderings, Cholesky, LDL', CHOLMOD.

Large models are solved by a multifrontal factor in NumPy, without a compiler: nested dissection
orders the unknowns, and the work is done in dense blocks. It is used by `fx.solve_modes` and by
frequency responses of structures, and needs no separate call. Another solver can be chosen:

>>> import flexplant as fx
>>> plate = fx.kirchhoff_plate(
...     size=(0.6, 0.4), thickness=0.02, elements=(6, 4),
...     density=2700, youngs_modulus=70e9, poisson_ratio=0.33,
... )
>>> fx.solve_modes(plate, count=6).freq.round(1)
array([  0. ,   0. ,   0. , 271.8, 293. , 628.6])

``fx.solve_modes(model, count=24, factor=fx.sparse.Cholmod())`` takes that of SuiteSparse
(scikit-sparse). Names elsewhere: ``scipy.sparse.linalg.splu``, MUMPS.

**Memory.** On a virtual machine, memory that a process gives back and takes again costs time. The
C library keeps it with
``GLIBC_TUNABLES=glibc.malloc.mmap_threshold=17179869184:glibc.malloc.trim_threshold=34359738368``:
a solid of 292 008 DOFs then took 74 to 79 s in place of 85 s. OpenBLAS chooses its kernels by the
processor, not always the fastest: with ``OPENBLAS_CORETYPE=SkylakeX`` as well, on an AMD processor
with AVX-512, it took 66 s.
"""

from ..rooms import public_names as _public_names
from .other_factors import Cholmod as Cholmod

__dir__ = _public_names(__name__)
