"""The pencils ``lambda^2 M + lambda D + K`` of a model over its parameters, well scaled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from ..errors import ModelError
from ..structure.eigen import elastic_modes
from ..structure.factor import dense
from ..structure.rigid import orthonormalised
from ..values import ComplexArray, FloatArray
from .parameters import Parameter

#: modes whose eigenvalues differ by less than this, relatively, count as exactly repeated
REPEATED = 1e-8
#: share of a spring's deflection below which a rigid-body motion leaves it alone
HELD = 1e-9


@dataclass(frozen=True)
class Eigen:
    """Oscillating modes of one pencil, by rising |lambda|, in the coordinates of its family."""

    poles: ComplexArray
    X: ComplexArray
    Y: ComplexArray
    M: FloatArray
    D: FloatArray
    n_rigid: int

    def scale(self, columns: Sequence[int]) -> ComplexArray:
        """Return y^H (2 lambda M + D) x of every mode of `columns` with every other."""
        X, Y, poles = self.X[:, columns], self.Y[:, columns], self.poles[columns]
        scale = Y.conj().T @ (2 * (self.M @ (X * poles)) + self.D @ X)
        return np.asarray(scale, dtype=np.complex128)

    def rotated(self, columns: Sequence[int], Q: ComplexArray) -> Eigen:
        """Return the same modes with those of `columns` replaced by combinations X Q, Y Q^-H."""
        X, Y = self.X.copy(), self.Y.copy()
        X[:, columns] = X[:, columns] @ Q
        Y[:, columns] = Y[:, columns] @ la.inv(Q).conj().T
        return Eigen(self.poles, X, Y, self.M, self.D, self.n_rigid)


class Family:
    """The pencils of a model over its parameters, in coordinates where M = I and K is diagonal.

    In SI a reduced pencil's rigid-body modes come out at 1e-4 rad/s and its lowest elastic modes
    lose digits to the highest; in the modal coordinates of the start, the rigid-body basis
    deflated, neither happens.
    """

    def __init__(self, model: Any, parameters: Sequence[Parameter]) -> None:
        if not all(hasattr(model, part) for part in ("M", "D", "K", "dofs", "rigid_body")):
            raise ModelError(
                f"the model must have M, D, K, a rigid_body basis and dofs, as FEModel and "
                f"ReducedModel do, got {type(model).__name__}."
            )
        M, D, K = (_dense(part, model) for part in (model.M, model.D, model.K))
        rigid = np.asarray(model.rigid_body, dtype=np.float64)
        omega, V = _modal_basis(M, K, rigid)
        self.parameters = tuple(parameters)
        self.n_rigid = rigid.shape[1]
        self.omega2 = omega**2
        self.D = V.T @ D @ V
        self.V = V
        k, q = M.shape[0], len(self.parameters)
        self.physical = [np.zeros((q, k, k)) for _ in range(3)]
        for b, parameter in enumerate(self.parameters):
            for stack, part in zip(self.physical, parameter.matrices(model), strict=True):
                if part is not None:
                    stack[b] = part
        self.dM, self.dD, self.dK = (V.T @ stack @ V for stack in self.physical)

    def text(self, p: FloatArray) -> str:
        """Return the parameters with values and units."""
        return ", ".join(q.text(v) for q, v in zip(self.parameters, p.tolist(), strict=True))

    def changes(self, p: FloatArray) -> list[FloatArray]:
        """Return what the parameters add to M, D and K of the model itself."""
        return [np.tensordot(p, stack, axes=1) for stack in self.physical]

    def rigid_left(self, p: FloatArray) -> FloatArray:
        """Return the rigid-body modes (r, r') that no spring to the ground holds at `p`."""
        r = self.n_rigid
        active = [part[:, :r] / np.abs(part).max() for part in self.dK[p != 0] if np.any(part)]
        if not r or not active:
            return np.eye(r)
        _, sizes, right = la.svd(np.vstack(active))
        return np.asarray(right[int(np.sum(sizes > HELD)) :].T, dtype=np.float64)

    def at(self, p: FloatArray) -> Eigen:
        """Return the oscillating modes at the parameters `p`.

        Raises
        ------
        ModelError
            When M is not positive definite there, or K is indefinite.
        """
        k = self.omega2.size
        M = np.eye(k) + np.tensordot(p, self.dM, axes=1)
        D = self.D + np.tensordot(p, self.dD, axes=1)
        K = np.diag(self.omega2) + np.tensordot(p, self.dK, axes=1)
        rigid = np.zeros((k, 0))
        if self.n_rigid:
            rigid = np.eye(k)[:, : self.n_rigid] @ self.rigid_left(p)
        try:
            omega, W = _modal_basis(M, K, rigid)
        except ModelError as error:
            raise ModelError(f"with {self.text(p)}: {error}") from None
        poles, velocities = _oscillating(omega, W.T @ D @ W, rigid.shape[1])
        X = W @ velocities
        # M, D, K symmetric: the left eigenvectors are the conjugated right ones
        return Eigen(poles, X, X.conj(), M, D, rigid.shape[1])

    def derivatives(self, eigen: Eigen, columns: Sequence[int]) -> ComplexArray:
        """Return y^H (lambda^2 dM + lambda dD + dK) x for all pairs of `columns`, (q, m, m)."""
        X, poles = eigen.X[:, columns], eigen.poles[columns]
        moved = self.dM @ (X * poles**2) + self.dD @ (X * poles) + self.dK @ X
        return np.asarray(eigen.Y[:, columns].conj().T @ moved, dtype=np.complex128)

    def sensitivity(self, eigen: Eigen, columns: Sequence[int]) -> ComplexArray:
        """Return d lambda / d p (m, q) of distinct modes, each by its own vectors."""
        change = np.diagonal(self.derivatives(eigen, columns), axis1=1, axis2=2)
        return np.asarray(-(change / np.diag(eigen.scale(columns))).T, dtype=np.complex128)

    def group_derivative(self, eigen: Eigen, columns: Sequence[int]) -> ComplexArray:
        """Return G (q, s, s): exactly repeated modes move by the eigenvalues of sum dp_b G_b."""
        change = self.derivatives(eigen, columns)
        return np.asarray(-la.solve(eigen.scale(columns), change), dtype=np.complex128)

    def strength(self, omega: float) -> FloatArray:
        """Return (q,) how strongly each parameter can move an eigenvalue near `omega` at most."""
        sizes = [np.linalg.norm(part, axis=(1, 2)) for part in (self.dM, self.dD, self.dK)]
        return np.asarray((sizes[0] * omega + sizes[1] + sizes[2] / omega) / 2, dtype=np.float64)


def groups(poles: ComplexArray, *, gap: float) -> list[list[int]]:
    """Return runs of neighbours in |lambda| that are closer than `gap`, relatively."""
    order = np.argsort(np.abs(poles), kind="stable").tolist()
    runs: list[list[int]] = []
    for i in order:
        if runs and abs(abs(poles[i]) - abs(poles[runs[-1][-1]])) <= gap * abs(poles[i]):
            runs[-1].append(i)
        else:
            runs.append([i])
    return [sorted(run) for run in runs if len(run) > 1]


def repeated_groups(poles: ComplexArray) -> list[list[int]]:
    """Return the groups of exactly repeated modes: equal frequency and damping."""
    found: list[list[int]] = []
    for run in groups(poles, gap=REPEATED):
        # equal |lambda| with different damping has vectors of its own
        left = list(run)
        while left:
            near = [i for i in left if abs(poles[i] - poles[left[0]]) <= REPEATED * abs(poles[i])]
            left = [i for i in left if i not in near]
            if len(near) > 1:
                found.append(near)
    return found


def _dense(part: Any, model: Any) -> FloatArray:
    return np.zeros(model.M.shape) if part is None else dense(part)


def _modal_basis(M: FloatArray, K: FloatArray, rigid: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return omega and M-orthonormal modes [rigid, elastic], the rigid ones deflated."""
    try:
        la.cholesky(M)
    except la.LinAlgError:
        raise ModelError(
            "M is not positive definite: some motion would have no inertia, or a negative one. "
            "Look at negative masses."
        ) from None
    rigid = orthonormalised(M, rigid)
    omega, phi = elastic_modes(M, K, rigid)
    return np.concatenate([np.zeros(rigid.shape[1]), omega]), np.hstack([rigid, phi])


def _oscillating(omega: FloatArray, D: FloatArray, r: int) -> tuple[ComplexArray, ComplexArray]:
    """Return poles in the upper half plane and vectors (k, m) of I lambda^2 + D lambda + Omega^2.

    The states (omega q, dq/dt) make the matrix skew but for the damping, so that all eigenvalues
    are good to rounding; the positions of rigid-body modes, r zero eigenvalues, are left out.
    """
    k = omega.size
    e = k - r
    A = np.zeros((e + k, e + k))
    A[np.arange(e), e + r + np.arange(e)] = omega[r:]
    A[e + r + np.arange(e), np.arange(e)] = -omega[r:]
    A[e:, e:] = -D
    poles, states = la.eig(A, check_finite=False)
    keep = np.flatnonzero(poles.imag > 1e-7 * np.abs(poles).max(initial=0.0))
    keep = keep[np.argsort(np.abs(poles[keep]), kind="stable")]
    # the velocity lambda q of each mode, its length 1, is its shape
    vectors = states[e:, keep]
    vectors = vectors / np.linalg.norm(vectors, axis=0)
    return np.asarray(poles[keep], dtype=np.complex128), np.asarray(vectors, dtype=np.complex128)
