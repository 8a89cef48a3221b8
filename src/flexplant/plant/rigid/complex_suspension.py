"""Complex modes on springs to ground, within their own shapes."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ...errors import ModelError
from ...modes import Modes
from ...values import ComplexArray, FloatArray
from ..realisation import realised

#: relative: poles closer than this have eigenvectors in common
_CLUSTER = 1e-7
#: relative: a pole with less imaginary part does not oscillate
_REAL = 1e-9
#: relative: what a residue may lack of being symmetric
_SYMMETRIC = 1e-6


def suspended(
    modes: Modes, rows: FloatArray, stiffness: FloatArray, damping: FloatArray, kept: FloatArray
) -> Modes:
    """Return complex modes with springs and dampers at rows (s, n) of DOFs.

    In first-order form, as no mass is known for truncated complex modes: ``x' = A x + N' f``,
    ``q = S x`` and ``f = -rows' (k rows q + d rows q')`` give A', the residues of which,
    ``S v w' N' = phi phi' / (2i Im lambda)``, are the new shapes. Exact within the span.
    """
    given, r = realised(modes), modes.n_rigid
    left = kept.shape[1]
    turned = np.hstack([kept, la.null_space(kept.T)]) if left else np.eye(r)
    turn = la.block_diag(np.kron(turned, np.eye(2)), np.eye(given.A.shape[0] - 2 * r))
    A, N, S = given.A, given.inputs @ turn, given.outputs @ turn  # rigid blocks are all alike
    A, N, S = A[2 * left :, 2 * left :], N[:, 2 * left :], S[:, 2 * left :]
    pull = stiffness[:, None] * (rows @ S) + damping[:, None] * (rows @ (S @ A))
    at_once = np.eye(len(rows)) + damping[:, None] * (rows @ S @ N.T @ rows.T)
    values, right = la.eig(A - (rows @ N).T @ np.linalg.solve(at_once, pull))
    upper = np.flatnonzero(values.imag > _REAL * np.abs(values))
    if 2 * upper.size != values.size:
        raise ModelError(
            "on these springs a mode would not oscillate: it is overdamped, or a negative "
            "stiffness makes it unstable. Complex modes do not express that: suspend the FEModel, "
            "or reduce it and suspend that."
        )
    inverse: ComplexArray = np.asarray(np.linalg.inv(right), dtype=np.complex128)
    upper = upper[np.argsort(np.abs(values[upper]), kind="stable")]
    poles = np.asarray(values[upper], dtype=np.complex128)
    shapes = _shapes(poles, S @ right[:, upper], N @ inverse[upper].T)
    rigid = np.real(modes.phi[:, :r]) @ kept
    size = np.abs(poles)
    return Modes(
        np.concatenate([np.zeros(left), size]),
        np.concatenate([np.zeros(left), -poles.real / size]),
        np.hstack([rigid, shapes]),
        modes.dofs,
        n_rigid=left,
    )


def _shapes(poles: ComplexArray, see: ComplexArray, push: ComplexArray) -> ComplexArray:
    """Return phi (n, k) with ``phi phi' = 2i Im(lambda) see push'`` for each pole."""
    phi, start = np.zeros_like(see), 0
    for i in range(1, poles.size + 1):
        if i < poles.size and abs(poles[i] - poles[i - 1]) <= _CLUSTER * abs(poles[i]):
            continue
        own = slice(start, i)
        ratio = np.linalg.lstsq(see[:, own], push[:, own], rcond=None)[0]
        off = np.linalg.norm(see[:, own] @ ratio - push[:, own]) / np.linalg.norm(push[:, own])
        if off > _SYMMETRIC:
            raise ModelError(
                f"the shapes at the pole {poles[start]:.6g} rad/s are not reciprocal (by {off:.1e})"
                ": these complex modes are not those of symmetric matrices, or two modes coalesce."
            )
        phi[:, own] = see[:, own] @ la.sqrtm(2j * poles[own].imag.mean() * ratio)
        start = i
    return phi
