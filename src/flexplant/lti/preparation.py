"""A standard plant made ready for synthesis, and the way back for its controller.

Equations of machines in SI units (1e-9 m/N beside rates of 1e4 Hz) are hopeless as they stand.
A sampled plant is mapped to continuous time (bilinear, norms are kept), time is scaled to the
plant's own speed, states are balanced, and the channels are turned and scaled so that
D12 = [0; I] and D21 = [0, I] where they have full rank. None of it changes a norm from w to z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from ..values import FloatArray, Value
from .discretisation import bilinear, tustin
from .statespace import StateSpace


@dataclass(frozen=True, eq=False, repr=False)
class Prepared(Value):
    """A continuous, scaled problem ``[w; u] -> [z; y]`` with D22 = 0.

    Parameters
    ----------
    A, B1, B2, C1, C2, D11, D12, D21 : arrays
        Of the scaled problem.
    D22 : (ny, nu) array
        What was taken out, in scaled channels; `restored` puts it back into the controller.
    u_scale : (nu, nu) array
        ``u = u_scale u_scaled``.
    y_scale : (ny, ny) array
        ``y_scaled = y_scale y``.
    speed : float [rad/s]
        Unit of the scaled frequency.
    dt : float [s]
        Of the original plant.
    u, y : sequences of str
        Names of the controller's outputs and inputs.
    """

    A: FloatArray
    B1: FloatArray
    B2: FloatArray
    C1: FloatArray
    C2: FloatArray
    D11: FloatArray
    D12: FloatArray
    D21: FloatArray
    D22: FloatArray
    u_scale: FloatArray
    y_scale: FloatArray
    speed: float
    dt: float
    u: Sequence[str]
    y: Sequence[str]

    def __repr__(self) -> str:
        return f"<Prepared: {self.A.shape[0]} states, unit of frequency {self.speed:.3g} rad/s>"

    @property
    def system(self) -> StateSpace:
        """The scaled problem as one continuous system, inputs w1.., u and outputs z1.., y."""
        return StateSpace(
            self.A,
            np.hstack([self.B1, self.B2]),
            np.vstack([self.C1, self.C2]),
            np.block([[self.D11, self.D12], [self.D21, np.zeros_like(self.D22)]]),
            inputs=[f"w{i}" for i in range(1, self.B1.shape[1] + 1)] + list(self.u),
            outputs=[f"z{i}" for i in range(1, self.C1.shape[0] + 1)] + list(self.y),
        )

    def restored(self, A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray) -> StateSpace:
        """Return the controller of the original plant from that of the scaled problem.

        Parameters
        ----------
        A, B, C, D : arrays
            The controller y -> u of the scaled problem.

        Returns
        -------
        StateSpace
            In the user's channels, units and sampling time; the states are the scaled ones.
        """
        # the plant's own D22 is subtracted: u = K (y - D22 u)
        loop = np.linalg.inv(np.eye(D.shape[0]) + D @ self.D22)
        A, B, C, D = (
            A - B @ self.D22 @ loop @ C,
            B @ (np.eye(B.shape[1]) - self.D22 @ loop @ D),
            loop @ C,
            loop @ D,
        )
        controller = StateSpace(
            self.speed * A,
            np.sqrt(self.speed) * B @ self.y_scale,
            np.sqrt(self.speed) * self.u_scale @ C,
            self.u_scale @ D @ self.y_scale,
            inputs=self.y,
            outputs=self.u,
        )
        return tustin(controller, 1.0 / self.dt) if self.dt else controller


def prepared(P: StateSpace, u: Sequence[str], y: Sequence[str]) -> Prepared:
    """Return a standard plant ``[w; u] -> [z; y]``, made ready for synthesis.

    Parameters
    ----------
    P : StateSpace
        The plant; u are its last inputs, y its last outputs.
    u, y : sequences of str
        Channels of the controller.

    Raises
    ------
    ModelError
        When a sampled plant has a pole at z = -1.
    """
    g = bilinear(P, 1.0 / P.dt) if P.dt else P
    speed = _speed(g.A)
    m1, p1 = len(g.inputs) - len(u), len(g.outputs) - len(y)
    root = np.sqrt(speed)
    A, B, C = _balanced(g.A / speed, g.B / root, g.C / root)
    D12, D21 = g.D[:p1, m1:], g.D[p1:, :m1]
    z_turn, u_scale = _normalised(D12)
    w_turn, y_scale_t = _normalised(D21.T)
    y_scale = y_scale_t.T
    A, B, C = _balanced(
        A,
        np.hstack([B[:, :m1] @ w_turn, B[:, m1:] @ u_scale]),
        np.vstack([z_turn.T @ C[:p1], y_scale @ C[p1:]]),
    )
    return Prepared(
        A,
        B[:, :m1],
        B[:, m1:],
        C[:p1],
        C[p1:],
        z_turn.T @ g.D[:p1, :m1] @ w_turn,
        z_turn.T @ D12 @ u_scale,
        y_scale @ D21 @ w_turn,
        y_scale @ g.D[p1:, m1:] @ u_scale,
        u_scale,
        y_scale,
        speed,
        P.dt,
        tuple(u),
        tuple(y),
    )


def _speed(A: FloatArray) -> float:
    """Return the geometric mean of the plant's frequencies, those near zero left out."""
    sizes = np.abs(la.eigvals(A)) if A.size else np.zeros(0)
    sizes = sizes[sizes > 1e-6 * np.max(sizes, initial=0.0)]
    return float(np.exp(np.mean(np.log(sizes)))) if sizes.size else 1.0


def _normalised(D: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return an orthogonal Z and a scaling S with ``Z' D S = [0; I]`` where D has full rank.

    Columns that D does not see (rank-deficient) are only turned, with unit scale.
    """
    m = D.shape[1]
    left, values, right = la.svd(D, full_matrices=True)
    sizes = np.zeros(m)
    sizes[: values.size] = values
    rank = int(np.count_nonzero(sizes > 1e-10 * max(float(np.max(sizes, initial=0.0)), 1e-300)))
    # columns of Z: what D does not reach first, then what it does
    Z = np.hstack([left[:, rank:], left[:, :rank]])
    S = right.T @ np.diag(np.where(np.arange(m) < rank, 1.0 / np.where(sizes > 0, sizes, 1.0), 1.0))
    return Z, S


def _balanced(
    A: FloatArray, B: FloatArray, C: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the system in states scaled (by powers of two) so that rows and columns match.

    Each state's row of [A, B] and column of [A; C] get equal norms, in turn, as in Osborne's
    balancing; B and C count as a whole, at the size of A.
    """
    n = A.shape[0]
    scale = np.ones(n)
    size_B, size_C = (max(float(np.linalg.norm(X)), 1e-300) for X in (B, C))
    size_A = max(float(np.linalg.norm(A)), 1e-300)
    weight = size_A / np.sqrt(size_B * size_C)
    B_, C_ = weight * B * np.sqrt(size_C / size_B), weight * C * np.sqrt(size_B / size_C)
    off = A - np.diag(np.diag(A))
    for _ in range(60):
        changed = False
        for i in range(n):
            row = np.linalg.norm(np.concatenate([off[i] * scale / scale[i], B_[i] / scale[i]]))
            column = np.linalg.norm(
                np.concatenate([off[:, i] / scale * scale[i], C_[:, i] * scale[i]])
            )
            if row == 0.0 or column == 0.0:
                continue
            factor = 2.0 ** np.round(0.5 * np.log2(row / column))
            if factor != 1.0:
                scale[i] *= factor
                changed = True
        if not changed:
            break
    return A * scale[None, :] / scale[:, None], B / scale[:, None], C * scale[None, :]
