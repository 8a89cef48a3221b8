"""Symmetric sparse factors: orderings, Cholesky, LDL', CHOLMOD.

Large models are solved by a multifrontal factor in NumPy, without a compiler: nested dissection
orders the unknowns, and the work is done in dense blocks. `fx.solve_modes` and the frequency
responses of structures use it without a separate call. An example is:

>>> import flexplant as fx
>>> plate = fx.kirchhoff_plate(
...     size=(0.6, 0.4), thickness=0.02, elements=(6, 4),
...     density=2700, youngs_modulus=70e9, poisson_ratio=0.33,
... )
>>> fx.solve_modes(plate, count=6).freq.round(1)
array([  0. ,   0. ,   0. , 271.8, 293. , 628.6])

``fx.solve_modes(model, count=24, factor=fx.sparse.Cholmod())`` uses the factor of SuiteSparse
(scikit-sparse) instead. Similar solvers elsewhere are ``scipy.sparse.linalg.splu`` and MUMPS.

**Memory.** On a virtual computer it costs time to return memory to the system and to request it
again. The environment variable
``GLIBC_TUNABLES=glibc.malloc.mmap_threshold=17179869184:glibc.malloc.trim_threshold=34359738368``
makes the C library keep the memory. The modes of a solid of 292 008 DOFs then took 74 to 79 s
instead of 85 s. OpenBLAS chooses its kernels by the type of processor, and these are not always the
fastest. With ``OPENBLAS_CORETYPE=SkylakeX`` in addition, on an AMD processor with AVX-512, the same
modes took 66 s.
"""

from ..rooms import public_names as _public_names
from .other_factors import Cholmod as Cholmod

__dir__ = _public_names(__name__)
