r"""Changes of a single mode at which a pole of a loop crosses the stability boundary.

With all of the plant's other modes closed, ``S = (I - K P)^-1`` and X_i the response from u to the
two states of mode i, which are driven by ``F_i u`` (also through other states) and appear in y as
``c_i e_i``, the changed mode is the nominal one plus ``T_i(z, delta) Y_i``, its additional input:

.. math:: \det H_i = 0, \quad H_i = z I - A_i(\delta) - T_i(\delta) Y_i q_i e_i, \quad
    q_i = S K c_i

has a pole at z, and ``S(delta) = S + q_i (I - g Y_i q_i)^-1 g Y_i S`` with
``g = e_i (z I - A_i(delta))^-1 T_i(delta)``. Everything is a row of numbers at each z, so that all
modes are computed together.

Filters and latencies of sensors are states R that modes drive:
``c_i(z) = C_i + C_R (z I - A_RR)^-1 A_Ri``. The effect of the change on A_Ri within a sample, of
relative order omega dt delta, is neglected.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..arrays import BoolArray, ComplexArray, FloatArray, IntArray
from ..errors import ModelError
from ..lti.response_solvers import Responder, points, responder
from ..lti.sampling import acting
from ..lti.statespace import StateSpace
from ..plant import AnyPlant
from ..plant.building import sampled_motions
from ..plant.realisation import changed_pairs
from ..tolerances import SAME, SETTLED, SPLIT, TINY
from .broken import BrokenLoop, inverted, log_scaling

#: largest relative change of a frequency whose polynomials are exact
LIMIT = 0.05
#: relative changes at which the sampled plant is computed; between them its matrices are
#: polynomials of degree 4 with an error of (omega dt)^5 LIMIT^5, which is rounding
_NODES: Mapping[str, tuple[float, ...]] = {
    "freq": (-LIMIT, -0.5 * LIMIT, 0.5 * LIMIT, LIMIT),
    "damping": (-0.9, -0.45, 1.0, 2.0),
}
#: multiple of the search range that the first step of Newton's method may leave it
_FIRST_STEP = 3.0
#: number of points within an interval in which a pole crosses, and number of divisions
_WITHIN, _DIVISIONS = 6, 3
#: fraction of the wanted |S|: a point below it with the mode at both ends of its range, and without
#: a resonance between, is not examined
_NEAR = 0.25
#: number of changes tried for a margin, and number of bisections before the first that fails
_TRIED, _HALVINGS = 16, 8
#: number of points between the lines next to the highest one, for the maximum of a peak: in a loop
#: near instability it is a tenth as wide as the mode
_WITHIN_PEAK = 33


class ModeChanges(NamedTuple):
    """Some modes of a sampled plant as polynomials in a relative change, coefficients first.

    A (k, modes, 2, 2), and the additional input of each mode T (k, modes, 2, 2 + r), without power
    zero, from its two states and from r sums of other states and of the loop's u.
    """

    A: FloatArray
    T: FloatArray

    def at(self, delta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return A and T of each mode for a change of each (modes,)."""
        each = delta[:, None, None]
        return _horner(self.A, each), _horner(self.T, each)


@dataclass(frozen=True)
class ModeLoops:
    """A loop and the modes of its plant, at any frequencies.

    `changes` of each kind, `own` states (modes, 2) of each mode, `fed` states that feed any, `sums`
    (modes, r, states fed and u), `seen` c_i (modes, p, k) and e_i (modes, k, 2), `behind` the
    effect of the modes' states on y through other states, (p, 2 modes).
    """

    plant: AnyPlant
    broken: BrokenLoop
    states: Responder
    changes: Mapping[str, ModeChanges]
    own: IntArray
    fed: IntArray
    sums: FloatArray
    seen: tuple[FloatArray, FloatArray]
    behind: Responder | None = None

    @classmethod
    def of(cls, plant: AnyPlant, broken: BrokenLoop, modes: IntArray) -> ModeLoops:
        """Return a loop with modes (numbers from 1), which are uncoupled and computed together."""
        if any(sensor.order == 2 for sensor in plant.assembled.ports.y if sensor.name in broken.y):
            raise ModelError(
                "a sensor of y measures accelerations, which contain frequency and damping of a "
                "mode directly: tolerances are not computed. Leave accelerometers out of y."
            )
        g = plant.system
        n, columns = g.n_states, g.input_index(broken.u)
        to_states = StateSpace(
            g.A, g.B[:, columns], np.eye(n), np.zeros((n, len(columns))), g.dt, blocks=g.blocks
        )
        own = plant.modal_states.reshape(-1, 2)[modes - 1]
        raw = {kind: _polynomials(plant, broken, modes, kind) for kind in _NODES}
        every = np.hstack([fed[1:].swapaxes(0, 1).reshape(len(modes), -1, fed.shape[-1])
                           for _, fed in raw.values()])  # fmt: skip
        used = np.any(every != 0.0, axis=(0, 1))
        used[n:] = True
        every = every[..., used]
        sums = np.zeros((0,))
        if modes.size:
            size, rows = np.linalg.svd(every)[1:]
            rank = int(np.max(np.sum(size > 1e-13 * size.max(initial=TINY), axis=1), initial=1))
            sums = rows[:, :rank]
        changes = {}
        for kind, (A, fed) in raw.items():
            T = np.concatenate([A, fed[..., used] @ sums.swapaxes(1, 2)], axis=-1)
            T[0] = 0.0
            changes[kind] = ModeChanges(A, T)
        rows_y, states = g.C[g.output_index(broken.y)], responder(to_states)
        seen = np.stack([rows_y[:, pair] for pair in own])
        modal = plant.modal_states
        late = np.setdiff1d(np.flatnonzero(acting(g.A != 0)[:, modal].any(axis=1)), modal)
        feeding = np.flatnonzero(used[:n])
        if np.any(rows_y[:, late]):
            A, driven = g.A[np.ix_(late, late)], g.A[np.ix_(late, own.ravel())]
            nothing = np.zeros((len(rows_y), own.size))
            behind = responder(StateSpace(A, driven, rows_y[:, late], nothing, g.dt))
            both = seen, np.tile(np.eye(2), (len(own), 1, 1))
            return cls(plant, broken, states, changes, own, feeding, sums, both, behind)
        left, size, right = np.linalg.svd(seen, full_matrices=False)
        k = 1 + int(np.any(size[:, 1:] > SAME * size[:, :1]))
        parts = left[..., :k] * size[:, None, :k], right[:, :k]
        return cls(plant, broken, states, changes, own, feeding, sums, parts)

    def swept(self, freq: FloatArray) -> SweptLoop:
        """Return the loop's responses at frequencies [Hz]."""
        K, P = self.broken.respond(freq)
        S = inverted(K @ P)
        x = np.moveaxis(self.states(freq), 2, 0)
        D = np.ones(S.shape[:2])
        if self.broken.mixed():  # a bound of the least |D S D^-1|: the same D for changed modes
            D = np.exp(log_scaling(S))
        shown = None
        if self.behind is not None:
            late = self.behind(freq).transpose(2, 1, 0).reshape(freq.size, len(self.own), 2, -1)
            shown = self.seen[0] + late.swapaxes(2, 3)
        left, right = D[:, :, None], 1.0 / D[:, None, :]
        z = points(self.plant.system, freq)
        return SweptLoop(self, z, left * S * right, left * (S @ K), x * right, right, shown)


class SweptLoop(NamedTuple):
    """S, S K and the states' responses x (n, states, m) at points z of the stability boundary.

    Each u is divided by `unit` (n, 1, m). `shown`: c_i (n, modes, p, 2) where it changes along it.
    """

    loops: ModeLoops
    z: ComplexArray
    S: ComplexArray
    SK: ComplexArray
    x: ComplexArray
    unit: FloatArray
    shown: ComplexArray | None = None

    def swept_modes(self, at: IntArray, mode: IntArray) -> SweptModes:
        """Return the terms of a mode's equation, for pairs of a point and a mode."""
        loops = self.loops
        m = self.S.shape[1]
        others = np.concatenate([self.x[:, loops.fed], np.eye(m) * self.unit], axis=1)
        Y = np.concatenate(
            [self.x[at[:, None], loops.own[mode]], loops.sums[mode].astype(complex) @ others[at]],
            axis=1,
        )
        c, e = loops.seen
        # all complex, since mixed products are slow
        q = self.SK[at] @ (c[mode].astype(complex) if self.shown is None else self.shown[at, mode])
        return SweptModes(loops, at, mode, self.z[at], Y, q, Y @ q, e[mode])


class SweptModes(NamedTuple):
    """The equations of modes at points: Y (n, 2 + r, m), q (n, m, k), Y q and e (n, k, 2)."""

    loops: ModeLoops
    at: IntArray
    mode: IntArray
    z: ComplexArray
    Y: ComplexArray
    q: ComplexArray
    Yq: ComplexArray
    e: FloatArray

    def changes(self, kind: str, limits: FloatArray | float) -> ComplexArray:
        """Return the complex change (n,) at which there is a pole at each point, infinite far off.

        Newton's method from zero: det H is a polynomial of twice the degree of H. Where the first
        step leads far beyond `limits` (n,), it stops.
        """
        A, T = self.loops.changes[kind]
        Yqe = self.Yq @ self.e
        first = -A[1][self.mode] - T[1][self.mode] @ Yqe
        start = -A[0][self.mode].astype(np.complex128)
        start[:, 0, 0] += self.z
        start[:, 1, 1] += self.z
        slope = (
            start[:, 0, 0] * first[:, 1, 1]
            + start[:, 1, 1] * first[:, 0, 0]
            - start[:, 0, 1] * first[:, 1, 0]
            - start[:, 1, 0] * first[:, 0, 1]
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            step = -_determinant(start) / slope
        near = np.flatnonzero(np.abs(step) <= _FIRST_STEP * limits)
        found = np.full(self.z.size, np.inf, dtype=np.complex128)
        mode, rest = self.mode[near], Yqe[near]
        H = -A[:, mode] - T[:, mode] @ rest
        H[0] = start[near]
        found[near] = _least_root(H)
        return found

    def take(self, where: BoolArray) -> SweptModes:
        """Return the equations at some of the pairs."""
        at, mode, z = self.at[where], self.mode[where], self.z[where]
        Y, q, Yq, e = self.Y[where], self.q[where], self.Yq[where], self.e[where]
        return SweptModes(self.loops, at, mode, z, Y, q, Yq, e)


class SizeBound(NamedTuple):
    r"""Whether ``|S(delta)| < s`` where ``|S| < s``, without S(delta), at pairs of point and mode.

    With ``W = (s^2 I - S S*)^{-1}``, ``a = s^2 q* W q``, ``b = I - s^2 g Y W q`` and ``c = g Y
    (s^2 W - I) Y* g*``: as long as all eigenvalues of ``a b^-1 c b^-*`` are below 1 (by Schur's
    complement of the Hermitian matrix [[s I, S(delta)], [S(delta)*, s I]]).
    """

    modes: SweptModes
    a: ComplexArray
    y: ComplexArray
    middle: ComplexArray

    @classmethod
    def of(cls, S: ComplexArray, modes: SweptModes, size: float) -> SizeBound:
        """Return the bound of a size that S (n, m, m) at the points is below."""
        eye = np.eye(S.shape[1])
        W = np.linalg.inv(eye - (S @ S.conj().swapaxes(1, 2)) / size**2)[modes.at]
        Wq = W @ modes.q
        a = modes.q.conj().swapaxes(1, 2) @ Wq
        YW = modes.Y @ W
        Ys = modes.Y.conj().swapaxes(1, 2)
        return cls(modes, a, modes.Y @ Wq, YW @ Ys - modes.Y @ Ys)

    def take(self, where: BoolArray) -> SizeBound:
        """Return the bound at some of the pairs."""
        modes, *parts = self
        return SizeBound(modes.take(where), *(part[where] for part in parts))

    def share(self, delta: FloatArray) -> FloatArray:
        """Return the largest eigenvalue, with frequencies changed (modes,)."""
        mode, z, e = self.modes.mode, self.modes.z, self.modes.e
        A, T = (part[mode] for part in self.modes.loops.changes["freq"].at(delta))
        # g = e (z I - A)^-1 T by the adjugate
        a, d = z - A[:, 1, 1], z - A[:, 0, 0]
        det = a * d - A[:, 0, 1] * A[:, 1, 0]
        u = (e[:, :, 0] * a[:, None] + e[:, :, 1] * A[:, 1, 0, None]) / det[:, None]
        v = (e[:, :, 0] * A[:, 0, 1, None] + e[:, :, 1] * d[:, None]) / det[:, None]
        g = u[..., None] * T[:, None, 0] + v[..., None] * T[:, None, 1]
        k = g.shape[1]
        if k == 1:
            row = g[:, 0]
            b = 1.0 - np.sum(row * self.y[:, :, 0], axis=1)
            c = np.sum(np.matmul(row[:, None], self.middle)[:, 0] * row.conj(), axis=1).real
            return np.asarray(self.a[:, 0, 0].real * c / (b.real**2 + b.imag**2))
        b = np.eye(k) - g @ self.y
        c = g @ self.middle @ g.conj().swapaxes(1, 2)
        inverse = np.linalg.inv(b)
        product = self.a @ inverse @ c @ inverse.conj().swapaxes(1, 2)
        return np.asarray(np.linalg.eigvals(product).real.max(axis=1))

    def highest(self, sign: float, change: FloatArray) -> FloatArray:
        """Return the largest fraction (modes,) over the points of each mode, for its change."""
        found = np.full(len(change), -np.inf)
        np.maximum.at(found, self.modes.mode, self.share(sign * change))
        return found


class ModePeaks(NamedTuple):
    """The tops of the resonances of some modes, between the lines of a grid.

    Each lies between two frequencies `between` (modes, 2) [Hz] at a change `there` of the mode, and
    moves with the mode's frequency.
    """

    loops: ModeLoops
    modes: IntArray
    between: FloatArray
    sign: float
    there: FloatArray
    size: float

    def highest(self, change: FloatArray) -> FloatArray:
        """Return the largest fraction (modes,) of the size, for a change of each mode."""
        moved = (1.0 + self.sign * (change - self.there))[self.modes]
        low, high = (self.between * moved[:, None]).T
        freq = np.linspace(low, high, _WITHIN_PEAK)
        fine = self.loops.swept(freq.ravel())
        mode = np.tile(self.modes, _WITHIN_PEAK)
        at_tops = fine.swept_modes(np.arange(mode.size), mode)
        return SizeBound.of(fine.S, at_tops, self.size).highest(self.sign, change)


def _reached_first(
    highest: Callable[[FloatArray], FloatArray], below: FloatArray, above: FloatArray
) -> FloatArray:
    """Return the least changes (modes,) between two at which a function of them reaches one."""
    for _ in range(_HALVINGS):
        middle = 0.5 * (below + above)
        over = highest(middle) >= 1.0
        above, below = np.where(over, middle, above), np.where(over, below, middle)
    return above


def _polynomials(
    plant: AnyPlant, broken: BrokenLoop, modes: IntArray, kind: Any
) -> tuple[FloatArray, FloatArray]:
    """Return A (k, modes, 2, 2) and what feeds each mode (k, modes, 2, states and u) by power."""
    nodes = np.array([0.0, *_NODES[kind]])
    realisation = plant.assembled.realisation
    names = [realisation.names[i] for mode in modes for i in (2 * mode - 2, 2 * mode - 1)]
    n, m = plant.system.n_states, len(broken.u)
    A, fed = np.zeros((nodes.size, len(modes), 2, 2)), np.zeros((nodes.size, len(modes), 2, n + m))
    where = {name: j for j, name in enumerate(plant.system.states)}
    pairs = realisation.pairs
    among = np.isin(np.arange(len(pairs)), modes - 1).astype(np.float64)
    if kind == "freq":
        blocks = [changed_pairs(pairs, ((1.0 + x) ** 2 - 1.0) * among, 0.0) for x in nodes]
    else:
        blocks = [changed_pairs(pairs, 0.0, x * among) for x in nodes]
    for i, g in enumerate(sampled_motions(plant.machine, blocks, broken.y, broken.u)):
        columns = [where[name] for name in g.states]
        rows = [g.states.index(name) for name in names]
        own = np.reshape(rows, (-1, 2))
        A[i] = g.A[own[:, :, None], own[:, None, :]]
        others = g.A[rows].reshape(-1, 2, g.n_states).copy()
        others[np.arange(len(modes))[:, None, None], [[0], [1]], own[:, None, :]] = 0.0
        fed[i][..., columns] = others
        fed[i][..., n:] = g.B[rows].reshape(-1, 2, m)
    powers = np.linalg.inv(np.vander(nodes, increasing=True))
    return np.tensordot(powers, A, 1), np.tensordot(powers, fed, 1)


def _determinant(H: ComplexArray) -> ComplexArray:
    return np.asarray(H[..., 0, 0] * H[..., 1, 1] - H[..., 0, 1] * H[..., 1, 0])


def _least_root(H: ComplexArray) -> ComplexArray:
    """Return the smallest change (n,) at which det H is 0, with H (k, n, 2, 2) by powers."""
    powers = np.arange(2 * len(H) - 1)
    det = np.zeros((powers.size, H.shape[1]), dtype=np.complex128)
    for i, a in enumerate(H):
        for j, b in enumerate(H):
            det[i + j] += a[:, 0, 0] * b[:, 1, 1] - a[:, 0, 1] * b[:, 1, 0]
    slope = powers[1:, None] * det[1:]
    delta = np.zeros(det.shape[1], dtype=np.complex128)
    for _ in range(12):
        with np.errstate(divide="ignore", invalid="ignore"):
            moved = _horner(det, delta) / _horner(slope, delta)
        moved = np.where(np.isfinite(moved), moved, 0.0)
        delta = delta - moved
        if np.all(np.abs(moved) <= SETTLED * np.abs(delta)):
            break
        # far away the polynomials are not valid, and the search stops
        delta = np.where(np.abs(delta) < 3.0, delta, 3.0 * delta / np.maximum(abs(delta), TINY))
    return delta


def _horner(polynomial: Any, at: Any) -> Any:
    """Return a polynomial's value by Horner's rule, its coefficients along the first axis."""
    found = polynomial[-1]
    for coefficient in polynomial[-2::-1]:
        found = found * at + coefficient
    return found


def axis_crossings(
    swept: SweptLoop, modes: SweptModes, freq: FloatArray, kind: str, ends: FloatArray
) -> FloatArray:
    """Return the smallest real changes (modes, 2), down and up, at which a pole crosses."""
    # `freq` [Hz] of each pair, rising within a mode; `ends` (modes, 2) of the changes looked for
    found = np.tile([-np.inf, np.inf], (len(ends), 1))
    limits = np.abs(ends).max(axis=1)[modes.mode]
    delta = modes.changes(kind, limits)
    # a crossing next to an end of the range has a neighbour beyond it: the found change is judged
    inside = np.abs(delta) <= _FIRST_STEP * limits
    same = modes.mode[:-1] == modes.mode[1:]
    low = np.flatnonzero(_sign_changes(delta.imag) & inside[:-1] & inside[1:] & same)
    edges, mode = np.stack([freq[low], freq[low + 1]], axis=1), modes.mode[low]
    value = np.zeros(0)
    for _ in range(_DIVISIONS):
        if not mode.size:
            break
        fine = np.linspace(edges[:, 0], edges[:, 1], _WITHIN, axis=1)
        each = swept.loops.swept(fine.ravel()).swept_modes(
            np.arange(fine.size), np.repeat(mode, _WITHIN)
        )
        most = np.abs(ends).max(axis=1)[mode]
        delta = each.changes(kind, np.repeat(most, _WITHIN)).reshape(fine.shape)
        good = np.abs(delta) <= _FIRST_STEP * most[:, None]
        turns = _sign_changes(delta.imag) & good[:, :-1] & good[:, 1:]
        real = np.any(turns, axis=1)
        mode, fine, delta, k = mode[real], fine[real], delta[real], turns[real].argmax(axis=1)
        row = np.arange(mode.size)
        edges = np.stack([fine[row, k], fine[row, k + 1]], axis=1)
        left, right = delta[row, k], delta[row, k + 1]
        share = np.abs(left.imag) / np.maximum(np.abs(left.imag) + np.abs(right.imag), TINY)
        value = left.real + share * (right.real - left.real)
    for i, change in zip(mode, value, strict=True):
        side = int(change > 0)
        if ends[i, 0] < change < ends[i, 1] and abs(change) < abs(found[i, side]):
            found[i, side] = change
    return found


def _sign_changes(imag: FloatArray) -> BoolArray:
    """Return between which neighbours along the last axis the sign changes."""
    return np.asarray(np.sign(imag[..., :-1]) * np.sign(imag[..., 1:]) < 0)


def size_reached(
    swept: SweptLoop,
    modes: SweptModes,
    freq: FloatArray,
    passed: BoolArray,
    stable: FloatArray,
    limits: FloatArray,
    size: float,
) -> FloatArray:
    """Return the changes of frequency (modes, 2), down and up, at which |S| at u reaches a size."""
    # where the resonance does not pass, |S| changes little and one way: only points are examined
    # that come near the size at an end. `freq` [Hz] of each pair, rising within a mode
    count = len(limits)
    high = np.linalg.norm(swept.S, 2, axis=(1, 2)) >= size
    every = SizeBound.of(np.where(high[:, None, None], 0.0, swept.S), modes, size)
    ends = np.minimum(np.abs(stable), limits[:, None])
    near = passed.copy()
    for side, sign in enumerate((-1.0, 1.0)):
        near |= every.share(sign * ends[:, side]) >= _NEAR
    few, freq = every.take(near), freq[near]
    found = np.array(stable)  # unless the margin is reached before, or the peak is too narrow
    for side, sign in enumerate((-1.0, 1.0)):
        start = np.minimum(SPLIT, 0.5 * ends[:, side])
        steps = np.geomspace(start, ends[:, side], _TRIED)
        highest = np.array([few.highest(sign, step) for step in steps])
        reached = highest >= 1.0
        on_line = np.any(reached, axis=0)
        # a peak between two lines of the grid may reach the size where neither line does
        where = np.flatnonzero(highest.max(axis=0) >= _NEAR)
        if not where.size:
            continue
        each = np.arange(count)
        first = np.where(on_line, np.argmax(reached, axis=0), np.argmax(highest, axis=0))
        below = np.where(first > 0, steps[first - 1, each], 0.0)
        those, change = few.take(np.isin(few.modes.mode, where)), steps[first, each]
        first_over = _reached_first(partial(those.highest, sign), below, change)
        change = np.where(on_line, first_over, change)
        share = few.share(sign * change)
        near_top = np.zeros((count, 2))
        for i in where:
            own = np.flatnonzero(few.modes.mode == i)
            k = int(np.argmax(share[own]))
            near_top[i] = freq[own[max(k - 1, 0)]], freq[own[min(k + 1, own.size - 1)]]
        peak = ModePeaks(modes.loops, where, near_top[where], sign, change, size)
        where = where[(on_line | (peak.highest(change) >= 1.0))[where]]
        change = _reached_first(peak.highest, np.zeros_like(change), change)
        found[where, side] = sign * change[where]
    found[np.bincount(modes.mode[high[modes.at]], minlength=count) > 0] = 0.0
    return found
