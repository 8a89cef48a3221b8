"""Lower bounds of mu: perturbations of power iterations, judged by eigenvalues of the loop."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...arrays import ComplexArray, FloatArray
from ...lti.statespace import StateSpace
from ...plant.uncertainty.delta_blocks import Block, FullBlock, RepeatedScalar
from ...tolerances import CLOSE, FOUR_DIGITS, MOST_STEPS, NEGLIGIBLE, ROOT, ROUNDING, SPLIT, TINY
from .power_starts import power_iterations
from .uncertainty_blocks import Perturbation, Place, block_places, matrix_of, realised_delta

#: sizes at which a loop is closed, from the least possible one to the largest that is of interest
_SIZES, _FARTHEST = 24, 100.0
#: phases of complex blocks that are tried
_PHASES = 25
#: choices of signs of real Deltas that are tried: all of a few Deltas, random ones of more
_CORNERS = 32


class Destabilising(NamedTuple):
    """The smallest multiple of a perturbation that makes the loop unstable."""

    size: float
    found: Perturbation
    omega: float


def smallest_multiple(
    M: StateSpace, blocks: Sequence[Block], found: Perturbation, least: float, sizes: FloatArray
) -> Destabilising | None:
    """Return the multiple t up to some size at which ``t Delta`` makes M's loop unstable."""
    # the loop's eigenvalues decide: on the size before it is stable, on this one it is not
    delta = realised_delta(found, blocks)
    stable = (1.0 - CLOSE) * least
    for unstable in sizes.tolist():
        if _abscissa(M, delta, unstable)[0] >= 0:
            break
        stable = unstable
    else:
        return None
    while unstable - stable > FOUR_DIGITS * unstable:
        middle = 0.5 * (stable + unstable)
        if _abscissa(M, delta, middle)[0] >= 0:
            unstable = middle
        else:
            stable = middle
    return Destabilising(unstable, found, _abscissa(M, delta, unstable)[1])


def crossing_multiple(
    M: ComplexArray, where: Sequence[Place], found: Perturbation
) -> tuple[float, Perturbation] | None:
    """Return t and the perturbation with ``det(I - t M Delta) = 0``, its Deltas made worse.

    Complex blocks are turned, then real Deltas moved to the ends that lower t, as long as it falls.
    """
    best: tuple[float, Perturbation] | None = None
    for _ in range(MOST_STEPS):
        one = _crossing_multiple(M, where, found)
        if one is None or (best is not None and one[0] > best[0] * (1.0 - SPLIT)):
            break
        best = one
        found = _at_worse_ends(M, where, *one)
        if found.scalars == one[1].scalars:
            break
    return best


def _at_worse_ends(
    M: ComplexArray, where: Sequence[Place], t: float, found: Perturbation
) -> Perturbation:
    """Return the perturbation with real Deltas at the ends towards which the eigenvalue grows."""
    if not any(_kinds(where)):
        return found
    delta = t * matrix_of(found, where)
    eigen: Any = la.eig(M @ delta, left=True, right=True)
    values, left, right = eigen
    worst = int(np.argmin(np.abs(values - 1.0)))
    own, r = left[:, worst].conj(), right[:, worst]
    into = own @ M * np.exp(-1j * np.angle(own @ r))  # sizes do not matter, signs do
    scalars = [p for p in where if isinstance(p.block, RepeatedScalar)]
    gains = np.array([into[p.w] @ r[p.z] for p in scalars])
    real, numbers = np.array(_kinds(where)), np.array(found.scalars)
    # a phase common to the complex blocks moves too, so that the eigenvalue stays real
    turned = into @ (delta @ r) - t * np.sum((numbers * gains)[real])
    turn = turned.imag / turned.real if abs(turned.real) > SPLIT * abs(turned) else 0.0
    ends = np.sign(gains.real + turn * gains.imag)
    moved = np.where(real & (ends != 0), ends, numbers)
    return found._replace(scalars=tuple(moved.tolist()))


def _crossing_multiple(
    M: ComplexArray, where: Sequence[Place], found: Perturbation
) -> tuple[float, Perturbation] | None:
    """Return t and the perturbation, its complex blocks turned, with ``det(I - t M Delta) = 0``."""
    # one phase common to all complex blocks is chosen so that an eigenvalue of M Delta is real; a
    # negative one is a positive one of -Delta
    fixed = np.zeros((where[-1].w.stop, where[-1].z.stop), dtype=np.complex128)
    turned = matrix_of(found, where)
    for p in where:
        if isinstance(p.block, RepeatedScalar) and p.block.real:
            fixed[p.w, p.z] = turned[p.w, p.z]
            turned[p.w, p.z] = 0.0
    best = _real_eigenvalue(M, fixed, turned)
    if best is None:
        return None
    value, turn = best
    numbers = [
        number.real * np.sign(value) if real else number * turn
        for real, number in zip(_kinds(where), found.scalars, strict=True)
    ]
    vectors = tuple((a, b * turn) for a, b in found.vectors)
    scalars = tuple(complex(number) for number in numbers)
    return 1.0 / abs(value), found._replace(scalars=scalars, vectors=vectors)


def _kinds(where: Sequence[Place]) -> list[bool]:
    """Return of each scalar block whether it is real."""
    return [p.block.real for p in where if isinstance(p.block, RepeatedScalar)]


def _real_eigenvalue(
    M: ComplexArray, fixed: ComplexArray, turned: ComplexArray
) -> tuple[float, complex] | None:
    """Return the largest real eigenvalue of ``M (fixed + turn turned)`` and that turn, |turn| = 1.

    With a negative eigenvalue the turn is that of ``-fixed``.
    """
    if not np.any(turned):
        value = _largest_real(np.asarray(np.linalg.eigvals(M @ fixed), dtype=np.complex128))
        return (value, 1.0 + 0j) if value else None
    if not np.any(fixed):  # all eigenvalues turn with the phase
        every = np.linalg.eigvals(M @ turned)
        largest = complex(every[np.argmax(np.abs(every))])
        size = abs(largest)
        return (size, largest.conjugate() / size) if size > 0 else None
    best, phases = (0.0, 1.0 + 0j), np.linspace(-np.pi, np.pi, _PHASES)
    for sign in (1.0, -1.0):
        first, second = M @ fixed * sign, M @ turned
        every = np.linalg.eigvals(first + np.exp(1j * phases)[:, None, None] * second)
        values = every[np.arange(_PHASES), np.argmax(every.real, axis=1)]
        for i in np.flatnonzero(np.diff(np.sign(values.imag))).tolist():
            phase, one = _crossing(first, second, phases[i : i + 2], complex(values[i]))
            if abs(one.imag) < SPLIT * abs(one) and one.real > abs(best[0]):
                best = sign * one.real, complex(np.exp(1j * phase))
    return best if best[0] else None


def _crossing(
    first: ComplexArray, second: ComplexArray, between: FloatArray, value: complex
) -> tuple[float, complex]:
    """Return the phase, by bisection, at which an eigenvalue is real, and that eigenvalue."""
    low, high = between.tolist()
    sign, phase = np.sign(value.imag), low
    for _ in range(MOST_STEPS):
        phase = 0.5 * (low + high)
        every = np.linalg.eigvals(first + np.exp(1j * phase) * second)
        value = complex(every[np.argmin(np.abs(every - value))])
        if abs(value.imag) <= ROUNDING * abs(value):
            break
        low, high = (phase, high) if np.sign(value.imag) == sign else (low, phase)
    return phase, value


def _largest_real(values: ComplexArray) -> float:
    """Return the real eigenvalue of the largest size, with its sign; 0 where none is real."""
    # a double eigenvalue comes out complex by the root of rounding
    real = np.abs(values.imag) < ROOT * np.abs(values).max(initial=TINY)
    found = np.where(real, values.real, 0.0)
    return float(found[np.argmax(np.abs(found))]) if found.size else 0.0


def worst_corner(
    M: FloatArray, where: Sequence[Place], starts: Sequence[Perturbation], rng: np.random.Generator
) -> tuple[float, Perturbation] | None:
    """Return t and the signs of real Deltas at their ends with ``det(I - t M Delta) = 0``, M real.

    The determinant is linear in each Delta of one channel, so that the smallest is at a corner:
    all corners of a few Deltas are tried, else one sign after the other is changed from many.
    """
    sizes = [p.block.w for p in where]
    signs = _all_signs(len(where))
    if signs is None:
        first = np.where(np.array([one.scalars for one in starts]).real < 0, -1.0, 1.0)
        signs = np.vstack([first, rng.choice([-1.0, 1.0], (_CORNERS, len(where)))])

    def values(signs: FloatArray) -> FloatArray:
        every = np.linalg.eigvals(M * np.repeat(signs, sizes, axis=-1)[:, None, :])
        return np.array([_largest_real(row) for row in every])

    found, better = values(signs), np.array([True])
    flips = 1.0 - 2.0 * np.eye(len(where))
    while np.any(better):
        moved = (signs[:, None] * flips).reshape(-1, len(where))
        there = values(moved).reshape(len(signs), -1)
        one = np.argmax(np.abs(there), axis=1)
        largest = there[np.arange(len(one)), one]
        better = np.abs(largest) > np.abs(found) * (1.0 + SPLIT)
        signs = np.where(better[:, None], signs * flips[one], signs)
        found = np.where(better, largest, found)
    worst = int(np.argmax(np.abs(found)))
    if not found[worst]:
        return None
    scalars = tuple((signs[worst] * np.sign(found[worst]) + 0j).tolist())
    return 1.0 / abs(found[worst]), Perturbation(scalars, (), 0.0)


def _all_signs(count: int) -> FloatArray | None:
    """Return all signs of a number of Deltas (n, count); None where there are too many."""
    every = itertools.product([1.0, -1.0], repeat=count)
    return np.array(list(every)) if 2**count <= _CORNERS else None


def loop_matrix(M: StateSpace, delta: StateSpace, t: float) -> FloatArray:
    """Return A of the loop ``w = t Delta z, z = M w``."""
    D, DD = M.D, t * delta.D
    back = np.linalg.inv(np.eye(D.shape[0]) - D @ DD)
    z_x, z_d = back @ M.C, back @ D @ (t * delta.C)
    return np.block([
        [M.A + M.B @ DD @ z_x, M.B @ (t * delta.C + DD @ z_d)],
        [delta.B @ z_x, delta.A + delta.B @ z_d],
    ])  # fmt: skip


def _abscissa(M: StateSpace, delta: StateSpace, t: float) -> tuple[float, float]:
    """Return the largest real part of the loop, and the frequency [rad/s] of that pole."""
    poles = la.eigvals(loop_matrix(M, delta, t))
    worst = int(np.argmax(poles.real))
    return float(poles[worst].real), float(abs(poles[worst].imag))


def worse_signs(
    M: StateSpace, blocks: Sequence[Block], one: Destabilising, near: complex | None = None
) -> Perturbation | None:
    """Return the perturbation with real Deltas at the ends that move a pole out most."""
    # the pole with the largest real part, or the one near some value. None where nothing changes
    delta = realised_delta(one.found, blocks)
    A = loop_matrix(M, delta, one.size)
    eigen: Any = la.eig(A, left=True, right=True)
    values, left, right = eigen
    worst = int(np.argmax(values.real if near is None else -np.abs(values - near)))
    n = M.n_states
    own_l, own_r = left[:, worst], right[:, worst]
    # w = t Delta z: a change of delta moves the pole by l* B d(w) with z of the loop
    DD = one.size * delta.D
    back = np.linalg.inv(np.eye(M.D.shape[0]) - M.D @ DD)
    z = back @ (M.C @ own_r[:n] + M.D @ (one.size * delta.C) @ own_r[n:])
    into = own_l[:n].conj() @ M.B @ np.linalg.inv(np.eye(M.D.shape[1]) - DD @ M.D)
    into = into + own_l[n:].conj() @ delta.B @ back @ M.D
    scalars = []
    numbers = iter(one.found.scalars)
    for p in block_places(blocks):
        if isinstance(p.block, FullBlock):
            continue
        number = next(numbers)
        if p.block.real:
            gain = float((into[p.w] @ z[p.z] / np.vdot(own_l, own_r)).real)
            number = complex(np.sign(gain) if gain else number)
        scalars.append(number)
    changed = one.found._replace(scalars=tuple(scalars))
    return None if changed.scalars == one.found.scalars else changed


def destabilising(
    M: StateSpace,
    blocks: Sequence[Block],
    omegas: Sequence[float],
    level: float,
    rng: np.random.Generator,
) -> Destabilising | None:
    """Return the smallest perturbation found that makes a loop unstable."""
    where = block_places(blocks)
    least = 1.0 / max(level, TINY)
    best: Destabilising | None = None
    for omega in omegas:
        gain = M.evaluated(1j * omega)
        starts = power_iterations(gain, where, rng, omega)
        first = Destabilising(0.0, starts[0], omega)
        signs = worse_signs(M, blocks, first, near=1j * omega)
        for start in [*starts, *([] if signs is None else [signs])]:
            best = _worse_signs(M, blocks, start, least, best)
            if best is not None and best.size < (1.0 + NEGLIGIBLE) * least:
                return best
    return _at_corners(M, blocks, least, best)


def _at_corners(
    M: StateSpace, blocks: Sequence[Block], least: float, best: Destabilising | None
) -> Destabilising | None:
    """Return the best so far, after every choice of signs of a few Deltas that are all real."""
    # at many sizes: those that destabilise may be a narrow range, stable on both sides
    real = all(isinstance(block, RepeatedScalar) and block.real for block in blocks)
    signs = _all_signs(len(blocks)) if real else None
    if signs is None:
        return best
    for corner in (signs + 0j).tolist():
        most = _FARTHEST * least if best is None else best.size * (1 - SPLIT)
        sizes = np.geomspace(least, most, _SIZES)
        found = smallest_multiple(M, blocks, Perturbation(tuple(corner), (), 0.0), least, sizes)
        best = best if found is None else found
    return best


def _worse_signs(
    M: StateSpace,
    blocks: Sequence[Block],
    start: Perturbation,
    least: float,
    best: Destabilising | None,
) -> Destabilising | None:
    """Return the best so far, after steps from one start to worse signs of its real Deltas."""
    candidate: Perturbation | None = start
    for _ in range(MOST_STEPS):
        if candidate is None:
            break
        # one loop decides whether this perturbation is worse than the best
        known = np.geomspace(least, _FARTHEST * least, _SIZES) if best is None else [best.size]
        one = smallest_multiple(M, blocks, candidate, least, np.asarray(known))
        if one is None:
            break
        # no change of the perturbation for rounding
        if best is not None and one.size >= best.size * (1 - SPLIT):
            break
        best = one
        candidate = worse_signs(M, blocks, one)
    return best
