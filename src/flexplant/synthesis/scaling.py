"""Units of a synthesis problem in which few digits are lost: of time, of states and of channels."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la
from numpy.lib.stride_tricks import sliding_window_view

from ..arrays import ComplexArray, FloatArray, divisor
from ..lti.equations import bordered_scale, state_scale
from ..lti.modal import eigenvalues_with_error
from ..lti.response_solvers import responses
from ..lti.statespace import StateSpace
from ..tolerances import NEGLIGIBLE, SAME, TINY

#: point at which answers are taken, in the unit of the loop's speed: away from resonances
POINT = complex(np.exp(0.25j * np.pi))
#: where the search for the loop's speed ends, relative to the fastest pole, or to the fastest zero
#: where nothing settles before. A double integrator has lost 14 digits there
_FAR = 1e7
#: the same of a sampled plant [half the rate in rad/s, as mapped]: a third of the rate, since all
#: answers are distorted above it
_THIRD = float(np.tan(np.pi / 3.0))
#: points a decade of the search for the loop's speed, its start relative to the slowest pole (not a
#: whole decade below it: no point may lie on an undamped pole), and the factor a decade that is a
#: fall
_POINTS, _START, _FALL = 8, 0.09, 2.0
#: change of slope [factor a decade] that makes a corner of an answer. Efforts of 1e-3 to 1e-8 of
#: the answers come within 1 % in 40 of 40 trials where the loop's speed is at most the last corner,
#: in 39 with twice as much
_CORNER = 1.5


def balanced(
    A: FloatArray, B: FloatArray, C: FloatArray, s: complex
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the system in states scaled (by powers of two) so that rows and columns match."""
    # Osborne's balancing of A bordered by the sizes of the rows of B and of the columns of C; the
    # border counts as much as it takes to give `C (s I - A)^-1 B` unit size, which no scaling of
    # states or channels changes
    n = A.shape[0]
    if not n:
        return A, B, C
    scale = state_scale(A, B, C)  # never A alone: that shrinks one side of a nearly triangular A
    for _ in range(2):  # the border is weighed anew once the states have sizes alike
        A_, B_, C_ = A * scale / scale[:, None], B / scale[:, None], C * scale
        gain = float(np.linalg.norm(C_ @ np.linalg.solve(s * np.eye(n) - A_, B_)))
        weight = 1.0 / np.sqrt(gain) if 0.0 < gain < np.inf else 1.0
        drive, sight = np.linalg.norm(B_, axis=1), np.linalg.norm(C_, axis=0)
        scale = scale * bordered_scale(A_, weight * drive, weight * sight)
    return A * scale / scale[:, None], B / scale[:, None], C * scale


def answers(A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, s: complex) -> FloatArray:
    """Return the sizes (m,) of ``C (s I - A)^-1 B + D`` by column, at least a part of its terms."""
    # what u moves and z does not show has no size there but rounding
    states = np.linalg.solve(s * np.eye(A.shape[0]) - A, B)
    terms = np.linalg.norm(np.abs(C) @ np.abs(states) + np.abs(D), axis=0)
    return np.asarray(np.maximum(np.linalg.norm(C @ states + D, axis=0), NEGLIGIBLE * terms))


def loop_speed(g: StateSpace, m1: int, p1: int, dt: float = 0.0) -> float:
    """Return the frequency [rad/s] at which the loop of ``[w; u] -> [z; y]`` crosses over."""
    # a loop gains nothing where u costs as much as it does to z, or where y shows as much noise as
    # w: the answers from u to z, and from w to y, have fallen to their feedthrough there. The
    # slowest of all channels counts; the mean pole where no channel has such a frequency
    poles, _, error = eigenvalues_with_error(g.A)
    sizes = np.abs(poles)[np.abs(poles) > error]
    if not sizes.size:
        return 1.0
    start, fastest = _START * float(sizes.min()), float(sizes.max())
    far = max(2.0 * _THIRD / dt, 2.0 * start) if dt else _FAR * fastest
    found = _crossover(g, m1, p1, _points(start, far), fastest)
    if found is None and not dt:
        # the zeros of weights can lie far above all poles, and the crossover above these zeros
        corner = _largest_corner(g, m1, p1)
        if corner > fastest:
            found = _crossover(g, m1, p1, _points(start, _FAR * corner), fastest)
    return float(np.exp(np.mean(np.log(sizes)))) if found is None else found


def _points(start: float, far: float) -> FloatArray:
    """Return the frequencies [rad/s] of the search for the loop's speed."""
    return np.geomspace(start, far, 1 + int(_POINTS * np.log10(far / start)))


def _largest_corner(g: StateSpace, m1: int, p1: int) -> float:
    """Return a bound [rad/s] on the corners of the answers from u to z, and from w to y."""
    # an answer is `m_k s^-(k+1) + m_(k+1) s^-(k+2) + ...` at high frequency: with its first Markov
    # parameter m_k that is not rounding, its largest corner is about the largest
    # `|m_(k+j) / m_k|^(1/j)`
    unit, corner = float(np.linalg.norm(g.A)), 0.0
    A = g.A / unit
    for B, C in ((g.B[:, m1:], g.C[:p1]), (g.B[:, :m1], g.C[p1:])):
        terms, moved, bound = [], B, np.abs(B)
        for _ in range(len(A)):
            found = np.abs(C @ moved)
            terms.append(np.where(found > SAME * (np.abs(C) @ bound), found, 0.0).ravel())
            moved, bound = A @ moved, np.abs(A) @ bound
        for one in np.transpose(terms):
            first, later = np.flatnonzero(one)[:1], np.flatnonzero(one)[1:]
            ratios = (one[later] / one[first]) ** (1.0 / (later - first))
            corner = max(corner, unit * float(np.max(ratios, initial=0.0)))
    return corner


def _crossover(g: StateSpace, m1: int, p1: int, omega: FloatArray, least: float) -> float | None:
    """Return the frequency at which an answer first settles; None where no answer settles."""
    G = responses(g, omega / (2.0 * np.pi))
    # above the fastest pole and the last corner of all answers only gains grow
    plain = np.diff(_log_sizes(G - g.D[:, :, None], m1, p1)) * _POINTS
    corners = np.any(np.abs(plain - plain[:, -1:]) > np.log(_CORNER), axis=0)
    last = int(np.flatnonzero(corners)[-1]) if corners.any() else len(omega) - 1
    sizes_of = _log_sizes(G, m1, p1)
    falls = np.diff(sizes_of) * _POINTS < -np.log(_FALL)
    # the first point after the first fall from which none follows in a decade: between two
    # resonances an answer rises, and falls on. One that falls to rounding has not settled
    ahead = np.pad(sizes_of[:, 1:], [(0, 0), (0, _POINTS - 1)], mode="edge")
    lowest = np.min(sliding_window_view(ahead, _POINTS, axis=1), axis=2)
    settled = lowest >= sizes_of[:, :-1] - np.log(_FALL)
    settled[:, -_POINTS:] &= ~falls[:, -_POINTS:]  # less than a decade is known ahead of these
    settled &= np.logical_or.accumulate(falls, axis=1)
    settled &= lowest > sizes_of[:, [last]] + np.log(SAME)
    found = [omega[np.argmax(one)] for one in settled if one.any()]
    return float(min(*found, max(omega[last], least))) if found else None


def _log_sizes(G: ComplexArray, m1: int, p1: int) -> FloatArray:
    """Return the logarithms of the answers to each u and of each y, over frequency."""
    sides = np.linalg.norm(G[:p1, m1:], axis=0), np.linalg.norm(G[p1:, :m1], axis=1)
    return np.asarray(np.log(np.maximum(np.vstack(sides), TINY)))


def normalised(D: FloatArray, own: FloatArray | float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Return an orthogonal Z and a scaling S with ``Z' D S = [0; I]`` where D has full rank."""
    # columns have unit size before the rank is taken, so that it does not depend on units. A column
    # that is negligible against the plant's response on its channel at the loop's speed, `own`
    # (m,), counts as zero, and `own` is its unit
    m = D.shape[1]
    sizes = np.linalg.norm(D, axis=0)
    felt = sizes > NEGLIGIBLE * own
    columns = divisor(np.where(felt, sizes, own))
    left, values, right = la.svd(np.where(felt, D, 0.0) / columns, full_matrices=True)
    sizes = np.zeros(m)
    sizes[: values.size] = values
    rank = int(np.count_nonzero(sizes > SAME))
    # columns of Z: first the directions that D does not reach, then those it reaches
    Z = np.hstack([left[:, rank:], left[:, :rank]])
    S = right.T @ np.diag(1.0 / np.where(np.arange(m) < rank, sizes, 1.0))
    return Z, S / columns[:, None]


def departure_from_normal(A: FloatArray, speed: float) -> float:
    """Return the size of A relative to that of its poles, or of as many at a speed."""
    # Henrici's measure, 1 for a normal matrix; poles slower than the loop are all the same to it
    if not A.size:
        return 1.0
    poles = float(np.linalg.norm(np.linalg.eigvals(A)))
    return float(np.linalg.norm(A) / np.hypot(poles, speed * np.sqrt(len(A))))
