"""A stable weight of given resonances whose gain lies above a curve, and close to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from ...lti.statespace import StateSpace
from ...values import ComplexArray, FloatArray

#: well damped terms that every weight may have, over the whole range of frequencies
_SMOOTH = 20
#: steps of the fit, and how much more a weight below the curve counts than one above
_STEPS, _BELOW = 40, 4.0
#: a value of the curve below this part of what it is around is not followed; how far around
#: that is, in logarithms
_VALLEY, _WIDE = 1e-4, 0.1
#: a resonance is worth its states when the curve stands this factor above its surroundings
_PROMINENT = 3.0
#: poles of a hump of unit frequency, and how far its two pairs are apart
_HUMP, _APART = complex(-0.4, np.sqrt(1 - 0.4**2)), 1.1
#: terms that add nowhere more than this part of the square of the weight are left out
_NEGLIGIBLE = 1e-3
#: constant term beside the largest residue: with less, rounding moves the zeros
_LEAST = 1e-13


def covering(
    freq: FloatArray, height: FloatArray, poles: ComplexArray, resonances: int
) -> StateSpace:
    """Return a stable weight w with a stable inverse and ``|w(i omega)| >= height`` at all freq.

    ``|w|^2 = p_0 + sum_k p_k t_k`` with p > 0: t_k is ``1 / |d_k(i omega)|^2`` of a resonance or of
    a well damped pair, or a hump ``omega^4 / |d_k d_k'|^2``. With ``x = omega^2`` the right side
    is a rational function of x, positive for x >= 0; w has its zeros and poles ``s = -sqrt(-x)``.
    """
    unit = 2 * np.pi * freq[-1]
    own = _standing_out(freq, height, poles)[:resonances] / unit
    corners = np.geomspace(20 * np.pi * freq[1] / unit, 1.0, _SMOOTH)
    terms = [_Term(0, (pole,)) for pole in own]
    terms += [_Term(0, (corner * np.exp(0.75j * np.pi),)) for corner in corners[::2]]
    # nothing at 0 Hz: beside many resonances that are not followed
    terms += [_Term(2, (c * _HUMP, c * _APART * _HUMP)) for c in corners]
    x = (2 * np.pi * freq / unit) ** 2
    square = height**2
    tall = _followed(freq, square, own[-1:] * unit)
    values = np.column_stack([np.ones(x.size), *(term.at(x) for term in terms)])
    size = values.max(axis=0)
    values = values / size
    spacing = np.gradient(np.log(np.maximum(freq, freq[1])))
    p = _raised(values, _least(values, tall, spacing), square)
    part = np.max(values * p / (values @ p)[:, None], axis=0)
    kept = np.flatnonzero(part[1:] > _NEGLIGIBLE)
    gains = p / size
    ends: dict[complex, complex] = {}
    for i in kept.tolist():
        for pole, end in terms[i].residues:
            ends[pole] = ends.get(pole, 0.0) + gains[i + 1] * end
    constant = max(float(gains[0]), _LEAST * max(map(abs, ends.values()), default=0.0))
    total = constant + sum(gains[i + 1] * terms[i].at(x) for i in kept)
    rise = float(np.max(square / total))
    return _factor(rise * constant, {at: rise * end for at, end in ends.items()}, unit)


@dataclass(frozen=True)
class _Term:
    """``x^m / prod |(x + l^2)|^2`` of some poles l in the upper half plane, ``x = omega^2``."""

    power: int
    poles: tuple[complex, ...]

    def at(self, x: FloatArray) -> FloatArray:
        """Return the values at x (n,)."""
        found = x**self.power
        for pole in self.poles:
            found = found / np.abs(x + pole**2) ** 2
        return found

    @property
    def residues(self) -> list[tuple[complex, complex]]:
        """Poles l and the residues at ``x = -l^2``; those at conjugates are conjugate."""
        every = [-(one**2) for pole in self.poles for one in (pole, pole.conjugate())]
        found = []
        for pole in self.poles:
            at = -(pole**2)
            others = [one for one in every if one != at]
            found.append((complex(pole), complex(at**self.power / np.prod(at - np.array(others)))))
        return found


def _standing_out(freq: FloatArray, height: FloatArray, poles: ComplexArray) -> ComplexArray:
    """Return the poles at which the curve is far above what it is half an eighth away."""
    at = np.log(np.maximum(freq, freq[1]))
    line = np.log(height + 1e-300)
    own = np.log(np.abs(poles) / (2 * np.pi))
    top, low, high = (np.interp(own + step, at, line) for step in (0.0, -0.06, 0.06))
    return np.asarray(poles[top - np.minimum(low, high) > np.log(_PROMINENT)])


def _followed(freq: FloatArray, square: FloatArray, last: ComplexArray) -> FloatArray:
    """Return the curve, its deepest valleys filled, above the last resonance its envelope."""
    at = np.log(np.maximum(freq, freq[1]))
    start = np.searchsorted(at, at[:, None] - _WIDE)[:, 0]
    end = np.searchsorted(at, at[:, None] + _WIDE, side="right")[:, 0]
    around = np.array([square[i:j].max() for i, j in zip(start, end, strict=True)])
    above = freq > 1.02 * np.max(np.abs(last), initial=0.0) / (2 * np.pi)
    return np.asarray(np.maximum(np.where(above, around, square), _VALLEY**2 * around))


def _least(terms: FloatArray, square: FloatArray, spacing: FloatArray) -> FloatArray:
    """Return p > 0 with ``terms p`` near a curve in logarithms: below it counts four times.

    Least squares over q = log p, weighted half by the logarithm of frequency, half by the points
    (most of which stand at resonances).
    """
    from scipy.optimize import least_squares  # not loaded with the package

    goal = np.log(square)
    weight = np.sqrt(0.5 * spacing / spacing.sum() + 0.5 / spacing.size)

    def sums(q: FloatArray) -> FloatArray:
        return np.asarray(terms @ np.exp(q))

    def side(q: FloatArray) -> FloatArray:
        return np.asarray(weight * np.where(sums(q) < square, _BELOW, 1.0))

    def error(q: FloatArray) -> FloatArray:
        return np.asarray(side(q) * (np.log(sums(q)) - goal))

    def slope(q: FloatArray) -> FloatArray:
        return np.asarray((side(q) / sums(q))[:, None] * (terms * np.exp(q)))

    # each term as high as it can be below the curve, or nearly so
    start = -np.log(np.quantile(terms / square[:, None], 0.99, axis=0))
    found = least_squares(error, start, jac=slope, max_nfev=_STEPS, x_scale=1.0)
    return np.asarray(np.exp(found.x))


def _raised(terms: FloatArray, p: FloatArray, square: FloatArray) -> FloatArray:
    """Return p with ``terms p >= square``: where it is below, the largest term there is raised."""
    for _ in range(_STEPS):
        parts = terms * p
        short = square / parts.sum(axis=1)
        below = np.flatnonzero(short > 1.0)
        if not below.size:
            break
        raised = np.ones(p.size)
        np.maximum.at(raised, np.argmax(parts[below], axis=1), short[below])
        p = p * raised
    return p


def _factor(constant: float, ends: dict[complex, complex], unit: float) -> StateSpace:
    """Return the spectral factor of ``constant + sum_k 2 Re(r_k / (x + l_k^2))``, in modal form.

    Its zeros, as x, are the finite eigenvalues of an arrow matrix.
    """
    poles = np.array(list(ends), dtype=np.complex128)
    share = np.array(list(ends.values()), dtype=np.complex128)
    at = -(np.concatenate([poles, poles.conj()]) ** 2)
    root = np.sqrt(np.concatenate([share, share.conj()]))
    n, top = at.size, float(np.abs(root).max(initial=1e-300))
    # bordered, not divided by the constant: slow zeros would be lost in the rounding of fast ones
    left, right = np.diag(np.append(at, constant / top**2)), np.diag(np.append(np.ones(n), 0.0))
    left[:n, n] = left[n, :n] = root / top
    values = np.asarray(la.eigvals(left, right, homogeneous_eigvals=True))
    finite = np.argsort(-np.abs(values[1]) / np.abs(values).max(axis=0), kind="stable")[:n]
    zeros = -np.sqrt(-values[0, finite] / values[1, finite])
    zeros = zeros[np.argsort(np.abs(zeros), kind="stable")]
    both = np.concatenate([poles, poles.conj()])
    both = both[np.argsort(np.abs(both), kind="stable")]
    blocks, B, C = [np.zeros((0, 0))], [np.zeros(0)], [np.zeros(0)]
    for pole in poles:
        others = both[both != pole]
        ratio = (pole - zeros[: others.size]) / (pole - others)
        residue = np.sqrt(constant) * np.prod(ratio) * np.prod(pole - zeros[others.size :])
        size = np.sqrt(2 * abs(residue) * unit)
        turn = residue / abs(residue)
        blocks.append(unit * np.array([[pole.real, pole.imag], [-pole.imag, pole.real]]))
        B.append(np.array([size, 0.0]))
        C.append(size * np.array([turn.real, turn.imag]))
    return StateSpace(
        la.block_diag(*blocks[1:]) if poles.size else np.zeros((0, 0)),
        np.concatenate(B)[:, None], np.concatenate(C)[None, :], [[np.sqrt(constant)]],
        blocks=[2] * poles.size,
    )  # fmt: skip
