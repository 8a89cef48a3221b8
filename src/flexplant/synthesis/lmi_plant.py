"""The plant of the LMIs of H-infinity synthesis: units of its channels, of time, and its states."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..errors import SolverError
from ..lti.preparation import Prepared
from ..lti.riccati import control_care, solve_care
from ..values import FloatArray


class Plant(NamedTuple):
    """The eight matrices of ``[w; u] -> [z; y]``, D22 = 0."""

    A: FloatArray
    B1: FloatArray
    B2: FloatArray
    C1: FloatArray
    C2: FloatArray
    D11: FloatArray
    D12: FloatArray
    D21: FloatArray
    #: its u is u_size times that of the problem, its y that of the problem over y_size
    u_size: FloatArray
    y_size: FloatArray
    #: unit of its frequency, in that of the problem
    speed: float = 1.0

    @classmethod
    def of(cls, p: Prepared) -> Plant:
        """Return the plant of a prepared problem."""
        matrices = (p.A, p.B1, p.B2, p.C1, p.C2, p.D11, p.D12, p.D21)
        return cls(*matrices, np.ones(p.B2.shape[1]), np.ones(p.C2.shape[0])).with_unit_channels()

    def with_unit_channels(self) -> Plant:
        """Return the plant with u and y in units that make columns [B2; D12], rows [C2, D21] one.

        What is not seen of noise or effort has no unit of its own.
        """
        u_size = np.linalg.norm(np.vstack([self.B2, self.D12]), axis=0)
        y_size = np.linalg.norm(np.hstack([self.C2, self.D21]), axis=1)
        u_size, y_size = (np.where(size > 0, size, 1.0) for size in (u_size, y_size))
        return self._replace(
            B2=self.B2 / u_size,
            D12=self.D12 / u_size,
            C2=self.C2 / y_size[:, None],
            D21=self.D21 / y_size[:, None],
            u_size=self.u_size * u_size,
            y_size=self.y_size * y_size,
        )

    def timed(self, speed: float) -> Plant:
        """Return the plant in a unit of frequency larger by speed; norms stay."""
        root = np.sqrt(speed)
        return self._replace(
            A=self.A / speed,
            B1=self.B1 / root,
            B2=self.B2 / root,
            C1=self.C1 / root,
            C2=self.C2 / root,
            speed=self.speed * speed,
        )

    def scaled(self, gamma: float) -> Plant:
        """Return the plant whose norms w -> z are divided by gamma."""
        root = np.sqrt(gamma)
        return self._replace(
            B1=self.B1 / root,
            C1=self.C1 / root,
            D11=self.D11 / gamma,
            D12=self.D12 / root,
            D21=self.D21 / root,
        )

    def balanced(self, X: FloatArray, Y: FloatArray) -> Plant:
        """Return the plant in states where X (of x' X x) and Y (of its dual) are equal, diagonal.

        Moore's balancing, of the LMIs' matrices instead of Gramians.
        """
        Lx, Ly = factor(X), factor(Y)
        left, values, right = la.svd(Lx.T @ Ly)
        root = np.sqrt(np.maximum(values, 1e-12 * values[0]))
        T, back = (left / root).T @ Lx.T, Ly @ right.T / root
        return self._replace(
            A=T @ self.A @ back,
            B1=T @ self.B1,
            B2=T @ self.B2,
            C1=self.C1 @ back,
            C2=self.C2 @ back,
        )

    def size(self) -> float:
        """Return a gamma of the plant's own size: its open gain beside its unit of frequency."""
        shifted = (1.3 + 0.7j) * np.eye(self.A.shape[0]) - self.A
        gain = float(np.linalg.norm(self.C1 @ np.linalg.solve(shifted, self.B1) + self.D11, 2))
        bound = float(np.linalg.norm(self.C1) * np.linalg.norm(self.B1))
        return max(gain, 1e-3 * bound) or 1.0


def same_states(p: Plant) -> Plant:
    """Return the plant as it is."""
    return p


def lqg_states(p: Plant) -> Plant:
    """Return the plant in LQG-balanced states, in the unit of frequency of the LQG loop.

    The Riccati solutions stand in for X and Y.
    """
    n, nu, ny = p.A.shape[0], p.B2.shape[1], p.C2.shape[0]
    # a little of everything: no rank of D12, D21 or observability of z is assumed
    Q, W = p.C1.T @ p.C1, p.B1 @ p.B1.T
    Q = Q + 1e-8 * np.linalg.norm(Q) * np.eye(n)
    W = W + 1e-8 * np.linalg.norm(W) * np.eye(n)
    try:
        control = control_care(p.A, p.B2, Q=Q, R=p.D12.T @ p.D12 + 0.1 * np.eye(nu))
        filtered = solve_care(p.A, p.C2, Q=W, R=p.D21 @ p.D21.T + 0.1 * np.eye(ny))
    except (SolverError, la.LinAlgError) as error:
        raise SolverError("rounding hides every stabilising controller.") from error
    sizes = np.abs(np.concatenate([control.poles, filtered.poles]))
    speed = float(np.exp(np.mean(np.log(np.maximum(sizes, 1e-300)))))
    return p.balanced(control.P, filtered.P).timed(speed)


def factor(P: FloatArray) -> FloatArray:
    """Return L with ``L L' = P``, P kept barely positive definite."""
    values, vectors = la.eigh(half(P))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 1e-13 * max(values[-1], 1e-300))))


def half(M: Any) -> Any:
    """Return the symmetric part."""
    return 0.5 * (M + M.T)


def null_space(M: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the null space."""
    _, values, right = la.svd(M)
    rank = int(np.count_nonzero(values > 1e-10 * max(float(values[0]), 1e-300)))
    return np.asarray(right[rank:].T)
