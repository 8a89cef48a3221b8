"""Modes of a structure, computed and checked, with or without residual attachment vectors.

`solve_modes` gives the lowest modes, mass-normalised, with rigid-body modes at exactly 0. A Sturm
count proves that no mode is missing: ``K - omega^2 M`` has as many negative eigenvalues as there
are modes below omega. The residual of each mode shows how well it satisfies the eigenvalue
equation. `compliance_at=` keeps the static compliance of the truncated modes at the places where
forces act, by residual attachment vectors. Modes are numbered from 1.

- `solve_modes(model, count=, damping=, compliance_at=)`: small and large models.
- `Modes.at`: shapes at a label or a point.
- `Modes.freq`: frequencies [Hz]. Damping ratios are ``zeta``, and shapes at all DOFs are ``phi``.
- `Modes.calibrated`: the modes with measured frequencies and damping ratios.
- `Modes.mesh_error`: error of each frequency of a mesh, estimated from a second mesh (`MeshError`).
- `normal_form`: poles and shapes for any matrices M, D and K.

A free plate in bending has three rigid-body modes:

>>> import flexplant as fx
>>> plate = fx.kirchhoff_plate(
...     size=(0.6, 0.4), thickness=0.02, elements=(6, 4),
...     density=2700, youngs_modulus=70e9, poisson_ratio=0.33,
... )
>>> modes = fx.solve_modes(plate, count=12, damping=fx.ModalDamping(0.01))
>>> print(modes)
<Modes: 12 of 105 DOFs (3 rigid-body, 9 elastic at 271.8 to 1671 Hz)>
>>> modes.freq[:5].round(1)
array([  0. ,   0. ,   0. , 271.8, 293. ])

Names elsewhere: Nastran SOL 103 and RESVEC, Ansys MODOPT and RESVEC, ``scipy.sparse.linalg.eigsh``.
"""

from ..rooms import public_names as _public_names
from .modes import MeshError as MeshError
from .modes import Modes as Modes
from .normal_forms import NormalForm as NormalForm
from .normal_forms import normal_form as normal_form
from .solve import solve_modes as solve_modes
from .solve import static_response as static_response

__dir__ = _public_names(__name__)
