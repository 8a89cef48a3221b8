"""Complex modes of a structure given in its undamped ones: poles, mixes, motions overdamped."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..errors import ModelError, SolverError
from ..structure.negative_stiffness import signed_square
from ..values import ComplexArray, FloatArray, IntArray

#: eigenvalues closer than this (relative) have no eigenvectors of their own
_CLUSTER = 1e-7
#: what modes may leave, relative
_RESIDUAL = 1e-10
#: the part of damping whose rounding that is
_ROUNDED = 1e-4
#: mixing of shapes by rounding that one Newton step takes out
_MIXED = 1e-2
#: what a plant makes of damping that modes cannot express
PLANT = "assemble_plant(model, ports) takes such damping as it is, in dense form."


class ComplexModes(NamedTuple):
    """Solutions of ``(lambda^2 + lambda C + Omega^2) x = 0``."""

    poles: ComplexArray
    mix: ComplexArray
    decaying: FloatArray
    overdamped: FloatArray
    overdamped_mix: FloatArray


def check_oscillating(oscillates: FloatArray | np.ndarray, omega: FloatArray) -> None:
    """Raise ModelError when one of some modes does not oscillate."""
    if not np.all(oscillates):
        i = int(np.argmin(oscillates))
        raise ModelError(
            f"the elastic mode at {omega[i] / (2 * np.pi):.4g} Hz is overdamped: it has two real "
            f"poles and no oscillation, which modes cannot express. {PLANT} Else lower the "
            "damping."
        )


def complex_modes(omega: FloatArray, C: FloatArray, *, lowest: int | None) -> ComplexModes:
    """Return the complex modes of ``p'' + C p' + Omega^2 p = 0``."""
    k, u = omega.size, int(np.count_nonzero(omega < 0))
    values, vectors = _eigen(omega, C, low=lowest is not None)
    up, down, upper = _kinds(values)
    still = down[:0]
    if upper.size < k - u:
        if lowest is None or u:
            real = np.concatenate([up, down])
            share = np.sum(np.abs(vectors[:, real]) ** 2, axis=1)
            share = np.where(omega > 0, share[:k] + share[k:], -1.0)
            check_oscillating(np.arange(k) != np.argmax(share), omega)
        still, down = down[::-1], still
    upper = upper[:lowest]
    listed = np.concatenate([up, down, upper])
    poles, mix = values[listed], vectors[k:, listed] / values[listed]
    poles[: 2 * u] = poles[: 2 * u].real
    mix = mix / np.linalg.norm(mix, axis=0)
    # what x^T (2 lambda + C) x is made: s1 - s2, s2 - s1 and 2 i Im(lambda)
    apart = poles[:u].real - poles[u : 2 * u].real
    scale = np.concatenate([apart, -apart, 2j * poles[2 * u :].imag])
    start = 0
    for i in range(1, listed.size + 1):
        if i == listed.size or abs(poles[i] - poles[i - 1]) > _CLUSTER * abs(poles[i]):
            cluster = slice(start, i)
            mix[:, cluster] = _normalised(poles[cluster], mix[:, cluster], C, scale[cluster])
            start = i
    mix = _polished(poles, mix, C, scale)
    worst = float(_left(poles, mix, omega, C).max(initial=0.0))
    if not worst < _RESIDUAL:
        raise SolverError(
            f"complex modes leave a relative residual of {worst:.2g} (limit {_RESIDUAL:g}): the "
            f"damping is close to critical for two modes at once. {PLANT} Else change D, or lower "
            "it."
        )
    if u:
        pairs = _unstable_pairs(mix[:, :u], mix[:, u : 2 * u])
        mix = np.hstack([pairs, mix[:, 2 * u :]])
    decaying, slow = poles[u : 2 * u].real, vectors[k:, still].real
    poles = np.concatenate([poles[:u], poles[2 * u :]])
    slow = slow / np.linalg.norm(slow, axis=0)
    return ComplexModes(poles, mix, decaying, values[still].real, slow)


def _kinds(values: ComplexArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return which eigenvalues grow, decay, both the fastest first, or oscillate, the slowest."""
    order = np.argsort(np.abs(values), kind="stable")
    sorted_ = values[order]
    real = np.abs(sorted_.imag) <= 1e-9 * np.abs(sorted_)
    up, down = order[real & (sorted_.real > 0)][::-1], order[real & (sorted_.real < 0)][::-1]
    return up, down, order[~real & (sorted_.imag > 0)]


def _unstable_pairs(grow: ComplexArray, decay: ComplexArray) -> ComplexArray:
    """Return shapes (k, u) of which growing and decaying ones are ``Re +- Im``; both are real."""
    both = np.hstack([grow, decay])
    if np.abs(both.imag).max() > 1e-9 * np.abs(both).max():
        raise SolverError(
            f"the real poles of an unstable mode cannot be paired: damping and negative stiffness "
            f"mix them with other motions. {PLANT} Else lower the damping."
        )
    up, down = grow.real, decay.real
    down = down * np.where(np.sum(up * down, axis=0) < 0, -1.0, 1.0)
    return np.asarray(0.5 * (up + down) + 0.5j * (up - down))


def _eigen(omega: FloatArray, C: FloatArray, *, low: bool) -> tuple[ComplexArray, ComplexArray]:
    """Return all poles (2k,) and eigenvectors (2k, 2k) of the states ``(|Omega| p, p')``.

    All entries are rates: nothing to balance. Low ones beside strong damping have digits when they
    are the large eigenvalues of the inverse.
    """
    none, size = np.zeros((omega.size, omega.size)), np.abs(omega)
    if low and np.all(omega > 0):
        soft = C / np.outer(omega, omega)
        slow, vectors = la.eig(np.block([[-soft, -np.diag(1 / omega)], [np.diag(1 / omega), none]]))
        return np.asarray(1 / slow), np.asarray(vectors)
    values, vectors = la.eig(np.block([[none, np.diag(size)], [-np.diag(omega), -C]]))
    return np.asarray(values), np.asarray(vectors)


def _left(poles: ComplexArray, mix: ComplexArray, omega: FloatArray, C: FloatArray) -> FloatArray:
    """Return the relative residual (k,) that modes leave."""
    rest = mix * poles**2 + (C @ mix) * poles + signed_square(omega)[:, None] * mix
    # what damping beside them is rounded to counts as well
    rate = np.abs(omega).max(initial=0.0) + _ROUNDED * np.abs(C).max(initial=0.0)
    size = np.linalg.norm(mix, axis=0) * np.abs(poles) * rate
    return np.asarray(np.linalg.norm(rest, axis=0) / size)


def _normalised(
    poles: ComplexArray, mix: ComplexArray, C: FloatArray, scale: ComplexArray
) -> ComplexArray:
    """Return the shapes of one (nearly) repeated pole with ``x^T (2 lambda + C) x = scale``."""
    mean, goal = poles.mean(), scale.mean()
    gram = mix.T @ (2 * mean * mix + C @ mix)
    if poles.size == 1:
        mix = mix * np.sqrt(goal / gram[0, 0])
    else:
        try:
            mix = mix @ la.inv(la.sqrtm(gram / goal))
        except la.LinAlgError:
            raise SolverError(
                f"the repeated pole {mean:.6g} rad/s has no complete set of shapes: two modes "
                f"coalesce. {PLANT} Else change D, or lower it."
            ) from None
    top = np.argmax(np.abs(mix), axis=0)
    return mix * np.where(mix[top, np.arange(poles.size)].real < 0, -1.0, 1.0)


def _polished(
    poles: ComplexArray, mix: ComplexArray, C: FloatArray, scale: ComplexArray
) -> ComplexArray:
    """Return shapes with ``x_i^T (lambda_i + lambda_j + C) x_j = 0``, by one Newton step.

    Rounding mixes the shapes of slow modes that are close by far more than their own size: by that
    of the fastest mode over their distance.
    """
    root = np.sqrt(scale)
    unit = mix / root
    gram = (unit.T @ unit) * np.add.outer(poles, poles) + unit.T @ (C @ unit)
    off = gram - np.eye(poles.size)
    if not np.abs(off).max() < _MIXED:
        return mix
    return np.asarray((unit - 0.5 * unit @ off) * root)
