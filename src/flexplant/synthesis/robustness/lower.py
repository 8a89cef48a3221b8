"""Lower bounds of mu: power iterations give perturbations, eigenvalues of the loop verify them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...checks import ComplexArray, FloatArray
from ...lti.statespace import StateSpace
from ...tolerances import SPLIT, TINY
from .uncertainty_blocks import (
    Block,
    FullBlock,
    Perturbation,
    Place,
    RepeatedScalar,
    block_places,
    matrix_of,
    perturbed,
    realised_delta,
)

#: steps of a power iteration; change at which it has settled
_STEPS, _SETTLED = 60, 1e-6
#: multiples of the smallest size that are tried for instability; relative accuracy of the smallest
_MULTIPLES = np.array([1.0, 1.005, 1.02, 1.05, 1.1, 1.2, 1.5, 2.0, 3.0, 5.0, 10.0, 100.0])
_FINE = 1e-4
#: phases of complex blocks that are tried
_PHASES = 25
#: random starts at each frequency
_RESTARTS = 4
#: real Deltas of which all signs are tried, and the loops that are closed for it
_FEW, _LOOPS = 5, 256
#: steps towards worse signs of the real Deltas
_ASCENTS = 6


def power_iteration(
    M: ComplexArray, where: Sequence[Place], rng: np.random.Generator, omega: float = 0.0
) -> Perturbation:
    """Return a perturbation of size one for which an eigenvalue of ``M Delta`` is large and real.

    The iteration of Young and Doyle for real and complex blocks together. Real Deltas may come out
    inside their interval. It need not converge: what it gives is judged by what it does.
    [Young1990]_; [PackardDoyle1993]_.
    """
    drawn = rng.standard_normal((2, 2, M.shape[1]))
    b, w = (_unit_vector(real + 1j * imag) for real, imag in drawn)
    q = {i: 1.0 + 0j for i, p in enumerate(where) if isinstance(p.block, RepeatedScalar)}
    old, a = b, M @ b
    for _ in range(_STEPS):
        a = M @ b
        if not np.any(a):
            break
        a = _unit_vector(a)
        _update_scalars(q, where, a, b, w)
        w = M.conj().T @ np.concatenate([
            q[i].conjugate() * w[p.w] if i in q else _along(a[p.z], w[p.w])
            for i, p in enumerate(where)
        ])  # fmt: skip
        if not np.any(w):
            break
        w = _unit_vector(w)
        _update_scalars(q, where, a, old, w)
        b = np.concatenate([
            q[i] * a[p.z] if i in q else _along(w[p.w], a[p.z]) for i, p in enumerate(where)
        ])  # fmt: skip
        b = _unit_vector(b)
        if la.norm(b - old) < _SETTLED:
            break
        old = b
    full = [p for p in where if isinstance(p.block, FullBlock)]
    vectors = [(_unit_vector(a[p.z]), _unit_vector(w[p.w])) for p in full]
    return Perturbation(tuple(q.values()), tuple(vectors), omega)


def _update_scalars(
    q: dict[int, complex], where: Sequence[Place], a: ComplexArray, b: ComplexArray, w: ComplexArray
) -> None:
    """Set the next numbers of the scalar blocks, of real ones on their interval."""
    for i, p in enumerate(where):
        if isinstance(p.block, FullBlock):
            continue
        inner = complex(np.vdot(a[p.z], w[p.w]))
        if p.block.real:
            size = la.norm(b[p.w]) / max(la.norm(a[p.z]), TINY)
            moved = (size if q[i].real >= 0 else -size) + inner.real
            q[i] = complex(np.clip(moved, -1.0, 1.0))
        else:
            q[i] = inner / (abs(inner) or 1.0)


def _along(direction: ComplexArray, like: ComplexArray) -> ComplexArray:
    """Return a vector of a direction as long as another one."""
    return np.asarray(direction * (la.norm(like) / max(la.norm(direction), TINY)))


def _unit_vector(v: ComplexArray) -> ComplexArray:
    size = la.norm(v)
    if not size > 0:
        v = np.zeros_like(v)
        v[0] = 1.0
        return v
    return np.asarray(v / size)


class Destabilising(NamedTuple):
    """The smallest multiple of a perturbation that makes the loop unstable."""

    size: float
    found: Perturbation
    omega: float


def smallest_multiple(
    M: StateSpace, blocks: Sequence[Block], found: Perturbation, least: float, most: float
) -> Destabilising | None:
    """Return the multiple t between two sizes at which ``t Delta`` makes M's loop unstable."""
    # the loop's eigenvalues decide: on the size before it is stable, on this one it is not
    delta = realised_delta(found, blocks)
    sizes = least * _MULTIPLES
    if most < sizes[-1]:  # one loop decides whether this perturbation is worse than the best
        sizes = np.array([most])
    stable, unstable = 0.0, np.inf
    for t in sizes:
        if _abscissa(M, delta, t)[0] >= 0:
            unstable = float(t)
            break
        stable = float(t)
    if not np.isfinite(unstable):
        return None
    stable = max(stable, 0.99 * least)
    while unstable - stable > _FINE * unstable:
        middle = 0.5 * (stable + unstable)
        if _abscissa(M, delta, middle)[0] >= 0:
            unstable = middle
        else:
            stable = middle
    return Destabilising(unstable, found, _abscissa(M, delta, unstable)[1])


def crossing_multiple(
    M: ComplexArray, where: Sequence[Place], found: Perturbation
) -> tuple[float, Perturbation] | None:
    """Return t and the perturbation, its complex blocks turned, with ``det(I - t M Delta) = 0``."""
    # one phase common to all complex blocks is chosen so that an eigenvalue of M Delta is real
    fixed = np.zeros((where[-1].w.stop, where[-1].z.stop), dtype=np.complex128)
    turned = matrix_of(found, where)
    for p in where:
        if isinstance(p.block, RepeatedScalar) and p.block.real:
            fixed[p.w, p.z] = turned[p.w, p.z]
            turned[p.w, p.z] = 0.0
    if not np.any(turned):
        return None

    def eigenvalue(phase: float, near: complex | None) -> complex:
        values = la.eigvals(M @ (fixed + np.exp(1j * phase) * turned))
        worst = np.argmax(values.real if near is None else -np.abs(values - near))
        return complex(values[worst])

    best, values = (0.0, 0.0), list[complex]()
    phases = np.linspace(-np.pi, np.pi, _PHASES)
    if np.any(fixed):
        values = [eigenvalue(phase, None) for phase in phases]
    else:  # all eigenvalues turn with the phase
        every = la.eigvals(M @ turned)
        largest = complex(every[np.argmax(np.abs(every))])
        best = abs(largest), -float(np.angle(largest))
    for i in np.flatnonzero(np.diff(np.sign([v.imag for v in values]))).tolist():
        low, high, value = phases[i], phases[i + 1], values[i]
        sign = np.sign(value.imag)
        for _ in range(50):
            middle = 0.5 * (low + high)
            value = eigenvalue(middle, value)
            low, high = (middle, high) if np.sign(value.imag) == sign else (low, middle)
        if abs(value.imag) < SPLIT * abs(value) and value.real > best[0]:
            best = value.real, 0.5 * (low + high)
    if not best[0] > 0:
        return None
    turn = np.exp(1j * best[1])
    kinds = [p.block.real for p in where if isinstance(p.block, RepeatedScalar)]
    numbers = tuple(
        number if real else number * turn for real, number in zip(kinds, found.scalars, strict=True)
    )
    vectors = tuple((a, b * turn) for a, b in found.vectors)
    return 1.0 / best[0], found._replace(scalars=numbers, vectors=vectors)


def smallest_with_block(
    M: ComplexArray, where: Sequence[Place], start: Perturbation, least: float
) -> tuple[float, Perturbation] | None:
    """Return the smallest t for real scalars and one full block, the last, at a frequency."""
    # with the reals closed at t q, the block needs `t sigma_max(F(M, t q)) = 1`: its own worst is
    # known. The reals are moved one after the other to an end of their interval
    repeats = [p.block.w for p in where[:-1]]
    sizes = least * np.geomspace(1.0, 100.0, 60)

    def closed(q: FloatArray, t: FloatArray) -> ComplexArray:
        return perturbed(M, t[:, None, None] * np.diag(np.repeat(q, repeats)))

    def first(q: FloatArray) -> float:
        over = sizes * np.linalg.norm(closed(q, sizes), 2, axis=(1, 2)) >= 1.0
        if not over.any():
            return np.inf
        i = int(np.argmax(over))
        low, high = sizes[max(i - 1, 0)], sizes[i]
        for _ in range(20):
            t = 0.5 * (low + high)
            there = t * np.linalg.norm(closed(q, np.array([t])), 2, axis=(1, 2))[0] >= 1.0
            low, high = (low, t) if there else (t, high)
        return float(high)

    q = np.array([number.real for number in start.scalars])
    best = first(q)
    for _ in range(_ASCENTS):
        before = best
        for i in range(q.size):
            for value in (-1.0, 1.0):
                moved = q.copy()
                moved[i] = value
                if value != q[i] and (found := first(moved)) < best:
                    best, q = found, moved
        if not best < before * (1.0 - 1e-4):  # found to that accuracy
            break
    if not np.isfinite(best):
        return None
    left, _, right = np.linalg.svd(closed(q, np.array([best]))[0])
    pair = (np.asarray(left[:, 0]), np.asarray(right[0].conj()))
    return best, Perturbation(tuple(q.astype(complex).tolist()), (pair,), start.omega)


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
        starts = [power_iteration(gain, where, rng, omega) for _ in range(_RESTARTS)]
        first = Destabilising(0.0, starts[0], omega)
        signs = worse_signs(M, blocks, first, near=1j * omega)
        for start in [*starts, *([] if signs is None else [signs])]:
            best = _worse_signs(M, blocks, start, least, best)
            if best is not None and best.size < 1.001 * least:
                return best
    return _at_corners(M, blocks, least, best)


def _at_corners(
    M: StateSpace, blocks: Sequence[Block], least: float, best: Destabilising | None
) -> Destabilising | None:
    """Return the best so far, after every choice of signs of a few Deltas that are all real."""
    # at many sizes: those that destabilise may be a narrow range, stable on both sides
    real = all(isinstance(block, RepeatedScalar) and block.real for block in blocks)
    if not real or len(blocks) > _FEW:
        return best
    corners = [
        Perturbation(signs, (), 0.0)
        for signs in itertools.product([-1.0 + 0j, 1.0 + 0j], repeat=len(blocks))
    ]
    for corner in corners:
        most = 100.0 * least if best is None else best.size * (1 - 1e-6)
        delta = realised_delta(corner, blocks)
        for t in np.geomspace(least, most, _LOOPS // len(corners) + 1)[1:].tolist():
            if _abscissa(M, delta, t)[0] >= 0:
                found = smallest_multiple(M, blocks, corner, least, t)
                if found is not None and (best is None or found.size < best.size):
                    best = found
                break
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
    for _ in range(_ASCENTS):
        most = best.size if best is not None else 100.0 * least
        one = None if candidate is None else smallest_multiple(M, blocks, candidate, least, most)
        if one is None:
            break
        # no change of the perturbation for rounding
        if best is None or one.size < best.size * (1 - 1e-6):
            best = one
        candidate = worse_signs(M, blocks, one)
    return best
