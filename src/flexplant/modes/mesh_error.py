"""What a mesh costs in frequency: two meshes and Richardson's rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import FloatArray, IntArray, Value, positive
from ..errors import ModelError, counted
from .matching import paired

#: places at which shapes of two meshes are compared, at most
_PLACES = 300
#: least ratio of element sizes: the difference of nearer ones is not that to the limit
_RATIO = 1.2


@dataclass(frozen=True, eq=False, repr=False)
class MeshError(Value):
    """Relative errors of the frequencies of a mesh, from a finer one.

    Parameters
    ----------
    modes : (m,) array
        Numbers of elastic modes from 1, rigid-body modes included.
    freq : (m,) array [Hz]
        Of the coarse mesh.
    limit : (m,) array [Hz]
        That both meshes point to, ``f_fine + (f_fine - f_coarse) / (r^p - 1)``.
    ratio : float
        r, of the sizes of elements.

    Examples
    --------
    >>> import flexplant as fx
    >>> def modes(n):
    ...     plate = fx.kirchhoff_plate(size=(0.6, 0.6), thickness=0.02, elements=(n, n),
    ...         density=2700, youngs_modulus=70e9, poisson_ratio=0.3)
    ...     return fx.solve_modes(plate, count=6)
    >>> modes(8).mesh_error(modes(16))
    <MeshError: 3 modes, +0.11 % (mode 5) to +0.19 % (mode 6)>
    """

    modes: IntArray
    freq: FloatArray
    limit: FloatArray
    ratio: float

    @property
    def error(self) -> FloatArray:
        """Frequency of the mesh over that of the limit, less 1 (m,)."""
        return np.asarray(self.freq / self.limit - 1.0)

    def __repr__(self) -> str:
        low, high = int(np.argmin(self.error)), int(np.argmax(self.error))
        ends = " to ".join(
            f"{100 * self.error[i]:+.2g} % (mode {self.modes[i]})" for i in (low, high)
        )
        return f"<MeshError: {counted(self.modes.size, 'mode')}, {ends}>"


def mesh_error(coarse: Any, finer: Any, order: float) -> MeshError:
    """Return the errors of Modes by those of a finer mesh, paired by their shapes."""
    p = positive(order, "order")
    if np.iscomplexobj(coarse.phi) or np.iscomplexobj(finer.phi):
        raise ModelError(
            "complex modes of two meshes are not compared: solve with damping=ModalDamping(...)."
        )
    nodes = [np.unique(modes.dofs.xyz, axis=0) for modes in (coarse, finer)]
    extent = np.ptp(nodes[0], axis=0)
    dimensions = int(np.count_nonzero(extent > 1e-6 * extent.max()))
    ratio = (len(nodes[1]) / len(nodes[0])) ** (1.0 / max(dimensions, 1))
    if ratio < _RATIO:
        raise ModelError(
            f"the finer model has {len(nodes[1])} nodes, this one {len(nodes[0])}: element sizes "
            f"with a ratio of {ratio:.3g} do not show where both lead. Halve the elements."
        )
    shapes = _at_common_places(coarse, finer)
    X, Y = (one / np.linalg.norm(one, axis=0) for one in shapes)
    pairs = paired(
        coarse.freq,
        finer.freq,
        X.T @ X,
        X.T @ Y,
        Y.T @ Y,
        n_rigid=min(coarse.n_rigid, finer.n_rigid),
    )
    found = np.flatnonzero((pairs.partner >= 0) & (np.arange(coarse.n_modes) >= coarse.n_rigid))
    if not found.size:
        raise ModelError(
            "no elastic mode of the two meshes has a shape in common: they are not of one "
            "structure, or its coordinates have other units."
        )
    f, fine = coarse.freq[found], finer.freq[pairs.partner[found]]
    return MeshError(found + 1, f, fine + (fine - f) / (ratio**p - 1.0), float(ratio))


def _at_common_places(coarse: Any, finer: Any) -> tuple[FloatArray, FloatArray]:
    """Return the shapes (p, k) of both at DOFs of the coarse mesh, along x, y and z."""
    dofs = coarse.dofs
    moves = [i for i, direction in enumerate(dofs.directions) if direction in ("x", "y", "z")]
    chosen = np.array(moves)[:: max(len(moves) // _PLACES, 1)]
    rows = np.array([finer.dofs.row(dofs.xyz[i], dofs.directions[i]) for i in chosen])
    return np.real(coarse.phi[chosen]), rows @ np.real(finer.phi)
