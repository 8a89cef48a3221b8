"""Responses as sums over poles, ``D + sum R_i / (s - p_i)``: Taylor series, and bounds on gains."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from ..values import ComplexArray, FloatArray
from .dense_responses import diagonal_form
from .responses import ModalPairs, modal_pairs
from .statespace import StateSpace

#: a distance that counts as none
TINY = 1e-100
#: entries of all residues from which on they are not formed
LARGEST = 5_000_000


class Residues(NamedTuple):
    """Poles (n,) of the upper half plane and what belongs to each, on the axis ``s = j omega``.

    A pole off the real axis stands for its conjugate too; residues of real poles are halved, so
    that every one counts twice.
    """

    poles: ComplexArray
    #: real and imaginary parts of the residues (p m, 2 n)
    parts: FloatArray
    #: norms of the residues (n,)
    sizes: FloatArray
    through: FloatArray

    @property
    def resonances(self) -> FloatArray:
        """The frequencies (n,) beside which peaks lie: ``|p| (1 - 2 zeta^2)^(1/2)``."""
        return np.sqrt(np.maximum(self.poles.imag**2 - self.poles.real**2, 0.0))

    def apart(self, omega: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the distances (n, n_omega) to the poles and to their conjugates."""
        real, swing = self.poles.real[:, None] ** 2, self.poles.imag[:, None]
        near, far = omega - swing, omega + swing
        return np.sqrt(near * near + real), np.sqrt(far * far + real)

    def nearest(self, omega: FloatArray) -> FloatArray:
        """Return the distance of each frequency to its nearest pole."""
        return np.asarray(self.apart(omega)[0].min(axis=0))

    def series(self, omega: FloatArray, order: int) -> list[ComplexArray]:
        """Return T_0 to T_order (n_omega, p, m) of ``G(omega + d) = sum T_k d^k``.

        ``T_k = (-j)^k sum R_i / (j omega - p_i)^(k+1)``, T_0 with the feedthrough.
        """
        upper = 1.0 / (1j * omega - self.poles[:, None])
        lower = 1.0 / (1j * omega - self.poles.conj()[:, None])
        found, u, v = [], upper, lower
        for k in range(order + 1):
            if k:
                u, v = u * (-1j * upper), v * (-1j * lower)
            both = np.concatenate([u + v, 1j * (u - v)])
            flat = (self.parts @ both.view(np.float64)).view(np.complex128)
            found.append(flat.T.reshape(omega.size, *self.through.shape))
        found[0] += self.through
        return found

    def rest(self, omega: FloatArray, radius: FloatArray, order: int) -> FloatArray:
        """Return a bound on ``|sum_(k > order) T_k d^k| / radius^(order + 1)`` for |d| <= radius.

        Of each pole at the distance a: a geometric series, ``1 / (a^(order+1) (a - radius))``;
        next to infinite where a pole is closer than the radius.
        """
        total = np.zeros(omega.size)
        for apart in self.apart(omega):
            free = np.maximum(apart - radius, TINY)
            for _ in range(order + 1):
                free *= apart
            total += self.sizes @ (1.0 / free)
        return total

    @property
    def transposed(self) -> Residues:
        """The transposed system: the same gains."""
        p, m = self.through.shape
        parts = self.parts.reshape(p, m, -1).swapaxes(0, 1).reshape(p * m, -1)
        return self._replace(parts=np.ascontiguousarray(parts), through=self.through.T)


def residues(g: StateSpace) -> tuple[Residues | None, ComplexArray | None]:
    """Return poles and residues, a sampled system mapped by ``z = (1 + s) / (1 - s)``.

    Block by block where A is block diagonal, by the eigenvectors of A otherwise. None where these
    are poor or too many, or a pole lies at z = -1. Beside them the eigenvalues of A where they were
    computed.
    """
    if g.n_states * g.D.size > LARGEST:
        return None, None
    pairs = modal_pairs(g)
    poles, found, known = _of_blocks(pairs) if pairs is not None else _of_eigenvectors(g)
    if found is None or (g.dt and np.any(poles == -1.0)):
        return None, known
    through = g.D
    if g.dt:
        through = through - np.sum(found / (1.0 + poles)[:, None, None], axis=0).real
        found = found * (2.0 / (1.0 + poles) ** 2)[:, None, None]
        poles = (poles - 1.0) / (poles + 1.0)
    upper = (poles.imag >= 0) & np.any(found, axis=(1, 2))
    poles, found = poles[upper], found[upper]
    found[poles.imag == 0] *= 0.5
    flat = found.reshape(poles.size, g.D.size).T
    parts = np.hstack([flat.real, flat.imag])
    return Residues(poles, parts, np.linalg.norm(flat, axis=0), through), known


_Found: TypeAlias = tuple[ComplexArray, ComplexArray | None, ComplexArray | None]


def _of_blocks(pairs: ModalPairs) -> _Found:
    """Return poles p and residues ``C (N + (p - m) I) B / (2 (p - m))`` of each block."""
    root = np.sqrt(pairs.q.astype(np.complex128))
    plain = ~np.any(pairs.N, axis=(1, 2))  # of one state, or a multiple of the identity
    if not np.all(root[~plain]):
        return root, None, None  # defective
    C, N, B = pairs.C.swapaxes(1, 2), pairs.N, pairs.B
    moving, fixed = 0.5 * (C @ B), C @ (N @ B) * (0.5 / np.where(plain, 1.0, root))[:, None, None]
    fixed[plain] = moving[plain]
    return (
        np.concatenate([pairs.mean + root, pairs.mean - root]),
        np.concatenate([moving + fixed, moving - fixed]),
        None,
    )


def _of_eigenvectors(g: StateSpace) -> _Found:
    """Return poles and residues of any A, no residues where its eigenvectors are poor."""
    poles, left, right = diagonal_form(g.A, g.B, g.C)
    if left is None or right is None:
        return poles, None, poles
    return poles, left.T[:, :, None] * right[:, None, :], poles
