"""mu: bounds of the structured singular value of a matrix, or of a system over all frequencies.

Scalings of one frequency hold on the interval around it in which ``F(j omega) > 0``. F is singular
where a Hamiltonian matrix has an eigenvalue j omega, so the interval ends there, not at a grid
point: no peak between frequencies is missed [Lawrence2000]_.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...arrays import ComplexArray, FloatArray, generator
from ...errors import AssumptionError, ModelError, SolverError
from ...lti.conversions import bilinear, image_freq
from ...lti.equations import axis_frequencies, state_scale
from ...lti.frequency_sweep import DRAWN, around_resonance
from ...lti.modal import obstacle
from ...lti.response_solvers import responder
from ...lti.statespace import StateSpace, System, as_statespace
from ...parallel import one_thread, tick
from ...plant.uncertainty.delta_blocks import Block, RepeatedScalar, filled_blocks
from ...store import Value
from ...tolerances import NEGLIGIBLE, ROUNDING, TINY
from .lower import crossing_multiple, destabilising, worst_corner
from .power_starts import power_iterations
from .shared_multipliers import shared_scalings
from .uncertainty_blocks import (
    SAMPLES,
    Perturbation,
    Place,
    Scalings,
    block_places,
    evened,
    matrix_of,
)
from .upper import WIDE, centred, reached_level, reached_levels, upper_level

#: frequencies at which a perturbation is sought, starts at each
SOUGHT, _STARTS = 8, 10
#: relative distance of the level to the largest upper bound found at a frequency
ABOVE = 5e-3
#: what a bar calls the intervals of frequency that are covered
INTERVALS = "intervals of frequency"
#: intervals at most; larger systems are covered by sampling instead of Hamiltonians
_INTERVALS, _LARGE = 3000, 260
#: growth of the heights over an interval that is tried at once, the last if need be
_GROWTH = (3.0, 1.3, 1.03)

#: the largest heights (w,) of the columns of M between two frequencies [rad/s]
Heights = Callable[[float, float], FloatArray]


@dataclass(frozen=True, eq=False, repr=False)
class MuBounds(Value):
    """Bounds of the structured singular value mu, and the perturbation of the lower bound.

    Parameters
    ----------
    upper : float
        Upper bound. If a Delta of the given structure is smaller than 1 / upper, ``I - M Delta`` is
        not singular at any frequency.
    lower : float
        Lower bound. The Delta in `perturbation`, of size 1 / lower, makes ``I - M Delta`` singular.
        The bound is 0 if no such Delta was found.
    freq : float [Hz]
        Frequency at which the upper bound is largest; NaN for a matrix.
    perturbation : (w, z) complex array
        Delta of size 1 / lower, at the frequency where it acts. It is zero if none was found.
    frequencies, bounds : (k,) arrays [Hz, 1]
        Upper bounds at single frequencies. Only those near the largest one are tight, because the
        search does not lower the others further.
    intervals : int
        Number of intervals that cover the frequency axis; 0 for a matrix.
    """

    upper: float
    lower: float
    freq: float
    perturbation: ComplexArray
    frequencies: FloatArray = field(default_factory=lambda: np.zeros(0))
    bounds: FloatArray = field(default_factory=lambda: np.zeros(0))
    intervals: int = 0

    def __repr__(self) -> str:
        where = f", largest at {self.freq:.5g} Hz" if np.isfinite(self.freq) else ""
        return f"<MuBounds: {self.lower:.5g} <= mu <= {self.upper:.5g}{where}>"


@one_thread()
def mu(M: System | ComplexArray, blocks: Sequence[Block], *, rng: Any = 0) -> MuBounds:
    """Return an upper and a lower bound of the structured singular value mu (as ``mussv``).

    ::

        mu(M) = 1 / min { |Delta| : det(I - M Delta) = 0 },   Delta = diag(delta_1 I, ..., Delta_F)

    The size of Delta is its largest singular value. The upper bound uses scaling matrices D and G
    that satisfy ``mu^2 D - M* D M + j (G M - M* G) > 0``. For a system, the bound of each pair (D,
    G) is proven for an interval of frequencies, whose ends follow from the eigenvalues of a
    Hamiltonian matrix. The intervals cover all frequencies, so that no peak is missed. The lower
    bound is found by power iterations with random restarts. For a system it is verified by the
    eigenvalues of the closed loop with the perturbation.

    Parameters
    ----------
    M : (z, w) array or StateSpace
        Complex matrix, or stable system, continuous or sampled.
    blocks : sequence of RepeatedScalar and FullBlock
        Blocks of Delta, ``w = Delta z``, in the order of the channels of M.
    rng : int, SeedSequence, Generator or None
        Random generator of the restarts, or its seed.

    Returns
    -------
    MuBounds
        The bounds `lower` and `upper`, and the perturbation that gives the lower bound.

    Raises
    ------
    AssumptionError
        When the system is not stable.
    ShapeError, ModelError
        When the sizes of the blocks do not match M, or M is neither a matrix nor a system.
    SolverError
        When the proven intervals do not cover all frequencies.

    References
    ----------
    [Fan1991]_; [Young1990]_; [Lawrence2000]_.

    Examples
    --------
    >>> import numpy as np
    >>> from flexplant.synthesis import FullBlock
    >>> found = mu(np.array([[0.0, 2.0], [0.5, 0.0]]), [FullBlock(), FullBlock()])
    >>> print(f"{found.lower:.3f} {found.upper:.2f}")
    1.000 1.00
    """
    chance = generator(rng)
    if isinstance(M, np.ndarray | list | tuple):
        gain = np.asarray(M)
        if gain.ndim != 2 or gain.dtype.kind not in "biufc" or not np.all(np.isfinite(gain)):
            raise ModelError(
                f"M must be a finite matrix (z, w), got an array of shape {gain.shape} and kind "
                f"{gain.dtype}. Pass the response at one frequency."
            )
        return _of_matrix(gain.astype(np.complex128), blocks, chance)
    g = as_statespace(M)
    if not g.n_states:
        return _of_matrix(g.D.astype(np.complex128), blocks, chance)
    listed = filled_blocks(blocks, len(g.inputs), len(g.outputs))
    problem = obstacle(g)
    if problem is not None:
        raise AssumptionError(
            f"M is {problem.reason}: mu bounds what keeps a stable loop stable. Close a "
            "controller that stabilises it first."
        )
    image = bilinear(g, 1.0 / g.dt) if g.dt else g
    found = Cover(image, listed).run()
    upper = float(np.sqrt(found.level))

    best = destabilising(image, listed, sought(image, found), upper, chance)
    delta = np.zeros((len(g.inputs), len(g.outputs)), dtype=np.complex128)
    if best is not None:
        delta += best.size * matrix_of(best.found, block_places(listed))
    return MuBounds(
        upper,
        0.0 if best is None else min(1.0 / best.size, upper),
        float(image_freq(found.omega, g.dt)),
        delta,
        image_freq(found.frequencies, g.dt),
        np.sqrt(found.bounds),
        found.intervals,
    )


def sought(M: StateSpace, found: Covered) -> list[float]:
    """Return the frequencies [rad/s] at which perturbations are sought: the worst and 0."""
    worst = [float(one) for one in found.frequencies[np.argsort(-found.bounds)[:SOUGHT]]]
    poles = M.poles()
    light = poles[poles.imag > 0]
    swing = light[np.argsort(-light.real / np.abs(light))[:SOUGHT]].imag
    return list(dict.fromkeys([float(found.omega), *worst, *swing.tolist(), 0.0]))


def _of_matrix(M: ComplexArray, blocks: Sequence[Block], rng: np.random.Generator) -> MuBounds:
    """Return the bounds of one matrix."""
    listed = filled_blocks(blocks, M.shape[1], M.shape[0])
    where = block_places(listed)
    upper = float(np.sqrt(upper_level(M, Scalings(listed)).level))
    lower, delta = 0.0, np.zeros(M.shape[::-1], dtype=np.complex128)
    starts = power_iterations(M, where, rng, count=_STARTS)
    for found in _multiples(M, where, starts, rng):
        if found is not None and 1.0 / found[0] > lower:
            lower = 1.0 / found[0]
            delta = np.asarray(found[0] * matrix_of(found[1], where))
        if lower >= (1.0 - NEGLIGIBLE) * upper:
            break
    return MuBounds(upper, min(lower, upper), float("nan"), delta)


def _multiples(
    M: ComplexArray, where: Sequence[Place], starts: list[Perturbation], rng: np.random.Generator
) -> Iterator[tuple[float, Perturbation] | None]:
    """Yield t and perturbations with ``det(I - t M Delta) = 0``."""
    for one in starts:
        yield crossing_multiple(M, where, one)
    real = all(isinstance(p.block, RepeatedScalar) and p.block.real for p in where)
    if real and not np.any(M.imag):
        yield worst_corner(M.real, where, starts, rng)


class Interval(NamedTuple):
    """Frequencies [rad/s] between which some scalings hold."""

    low: float
    high: float


@dataclass(frozen=True)
class Covered:
    """What covers the frequency axis.

    ``level`` is mu^2 (of a skewed problem gain^2) from above; `omega` [rad/s] is where the largest
    bound of one frequency was found, `frequencies`, `bounds` those that were computed.
    """

    level: float
    omega: float
    frequencies: FloatArray
    bounds: FloatArray
    intervals: int
    by_hamiltonian: bool


@dataclass
class Cover:
    """The search for a level that holds at all frequencies of a stable continuous M."""

    M: StateSpace
    blocks: Sequence[Block]
    leveled: Sequence[bool] | None = None
    heights: Heights | None = None
    least: float = ROUNDING

    def __post_init__(self) -> None:
        g = self.M
        d = state_scale(g.A, g.B, g.C)
        self.A, self.B, self.C, self.D = g.A * d / d[:, None], g.B / d[:, None], g.C * d, g.D
        self.scalings = Scalings(self.blocks, self.leveled)
        self.where = block_places(self.blocks)
        self.respond = responder(g)
        poles = g.poles()
        self.poles = poles[poles.imag >= 0]
        light = poles[poles.imag > 0]
        light = light[np.argsort(light.imag)]
        #: poles that swing; of those with one peak, as of a mode and its observer, the first
        self.swinging = light[np.diff(light.imag, prepend=-np.inf) > DRAWN[1] * -light.real]
        #: whether some scalings hold for many resonances: with G, all blocks at the level
        self.shares = bool(np.any(self.scalings.of_G)) and not self.scalings.skewed
        self.level = self.least
        self.omega = 0.0
        self.found: list[tuple[float, float]] = []
        self.gaps: list[Interval] = [Interval(0.0, np.inf)]
        self.last: list[tuple[float, FloatArray]] = []
        self.by_hamiltonian = self.A.shape[0] <= _LARGE

    def at(self, omega: FloatArray) -> ComplexArray:
        """Return M without heights (n, z, w)."""
        return np.moveaxis(self.respond(omega / (2 * np.pi)), 2, 0)

    def tall(self, low: float, high: float) -> FloatArray:
        """Return the factors of the columns between two frequencies."""
        return np.ones(self.B.shape[1]) if self.heights is None else self.heights(low, high)

    @property
    def enough(self) -> float:
        """The level that scalings reach at a frequency, so that they hold around it."""
        return (1.0 - ABOVE) * self.level

    def run(self) -> Covered:
        """Cover the axis, from the worst frequencies on."""
        self._start()
        count = 0
        while self.gaps:
            count += 1
            tick(INTERVALS)
            if count > _INTERVALS:
                raise SolverError(
                    f"the frequency axis was not covered by {_INTERVALS} intervals; what is left "
                    f"lies at {self.gaps[0].low / (2 * np.pi):.6g} Hz. A pole of the closed loop "
                    "is too close to the edge of stability there: add damping or loosen the loop."
                )
            gap = self.gaps.pop()
            done = self._certified(gap)
            if not np.isfinite(self.level):
                break
            if done.low > gap.low:
                self.gaps.append(Interval(gap.low, done.low))
            if done.high < gap.high:
                self.gaps.append(Interval(done.high, gap.high))
        frequencies, bounds = np.array(sorted(self.found)).T
        return Covered(self.level, self.omega, frequencies, bounds, count, self.by_hamiltonian)

    def _start(self) -> None:
        """Raise the level to what the most prominent frequencies need."""
        size, swing = np.abs(self.poles), self.poles.imag
        tried = np.unique(np.concatenate([[0.0], swing, size]))
        # sigma_max of the evened M: a bound without optimisation, reals taken as complex
        M = self.at(tried) * np.array([self.tall(w, w) for w in tried])[:, None]
        bounds = np.linalg.norm(evened(M, self.where), 2, axis=(1, 2)) ** 2
        if self.shares:
            W = self._with_identity(M)
            bounds = np.minimum(
                bounds, reached_levels(W, self.scalings, shared_scalings(M, self.scalings))
            )
        for i in np.argsort(-bounds)[:6]:
            if self.found and bounds[i] <= self.enough:
                break
            self._raise(M[i], float(tried[i]))

    def _raise(self, M: ComplexArray, omega: float) -> FloatArray:
        """Return scalings that hold at a frequency; the level is raised where it is too low."""
        # what is closer than twice ABOVE raises the level; once more is left for frequencies around
        enough = (1.0 - 3.0 * ABOVE) * self.level
        found = upper_level(M, self.scalings, self._nearest(omega), enough=enough, widest=WIDE)
        if found.level > enough and self.shares:  # the level is raised only by what no G lowers
            freer = upper_level(M, self.scalings, found.x, enough=enough)
            found = min(found, freer, key=itemgetter(0))
        self.found.append((omega, found.level))
        if not found.level * (1 + ABOVE) ** 2 <= self.level:
            self.level = max(self.level, found.level * (1 + ABOVE) ** 2)
            self.omega = omega
        if np.isfinite(self.level):
            self.last = [*self.last[-30:], (omega, found.x)]
        return found.x

    def _nearest(self, omega: float) -> FloatArray | None:
        """Return the scalings found nearest to a frequency."""
        return min(self.last, key=lambda one: abs(one[0] - omega))[1] if self.last else None

    def _certified(self, gap: Interval) -> Interval:
        """Return an interval within a gap in which scalings hold at the level."""
        omega = self._chosen(gap)
        M = self.at(np.array([omega]))[0]
        near, x = self._nearest(omega), None
        for growth in _GROWTH[-1:] if self.heights is None else _GROWTH:
            tried = self._tried(gap, omega, growth)
            tall = self.tall(*tried)
            shared = self._shared(tried, tall)
            if shared is not None:
                omega, x = shared
                break
            W = np.vstack([np.eye(self.scalings.w), M * tall])
            if near is not None and reached_level(W, self.scalings, near) < self.enough:
                x = near
                break
        if x is None:
            x = self._raise(M * tall, omega)
            if not np.isfinite(self.level):
                return tried
            x = centred(W, self.scalings, x, self.level, steps=12)
        ends = self._holds(x, tall, tried, omega)
        if ends.low >= omega >= ends.high:
            # rounding leaves nothing: take what lies within rounding of the frequency
            width = max(1e-9 * omega, 1e-12 * float(np.abs(self.poles).max(initial=1.0)))
            ends = Interval(max(omega - width, tried.low), min(omega + width, tried.high))
        if ends.low > tried.low or ends.high < tried.high:
            self.last = [*self.last[-30:], (omega, x)]
        return ends

    def _shared(self, tried: Interval, tall: FloatArray) -> tuple[float, FloatArray] | None:
        """Return scalings that hold at several resonances of an interval, and one of these."""
        swing = self.swinging.imag
        omegas = swing[(swing > tried.low) & (swing < tried.high)]
        if not self.shares or omegas.size < 2:
            return None
        M = self.at(omegas) * tall
        x = shared_scalings(M, self.scalings)
        holds = reached_levels(self._with_identity(M), self.scalings, x) < self.enough
        # the longest run of frequencies at which they hold
        ends = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]])))
        if not ends.size:
            return None
        first, last = max(ends.reshape(-1, 2), key=lambda run: run[1] - run[0])
        return (float(omegas[(first + last) // 2]), x) if last - first > 1 else None

    def _with_identity(self, M: ComplexArray) -> ComplexArray:
        """Return [I; M] of each response (n, w + z, w)."""
        w = self.scalings.w
        return np.concatenate([np.broadcast_to(np.eye(w), (len(M), w, w)), M], axis=1)

    def _chosen(self, gap: Interval) -> float:
        """Return a frequency inside a gap: a resonance, or its middle."""
        if gap.low == 0.0 and np.isinf(gap.high):
            return float(self.omega)
        top = 4.0 * float(np.abs(self.poles).max(initial=1.0))
        if np.isinf(gap.high):
            return max(4.0 * gap.low, top)
        inside = self.poles.imag[(self.poles.imag > gap.low) & (self.poles.imag < gap.high)]
        if gap.low == 0.0 and not inside.size:
            return 0.5 * gap.high if any(one == 0.0 for one, _ in self.found) else 0.0
        middle = np.sqrt(max(gap.low, 1e-3 * gap.high) * gap.high)  # in the middle of a logarithm
        if inside.size and gap.high > 1.05 * gap.low:
            return float(inside[np.argmin(np.abs(np.log(np.maximum(inside, TINY) / middle)))])
        return 0.5 * (gap.low + gap.high)

    def _tried(self, gap: Interval, omega: float, growth: float) -> Interval:
        """Return the part of a gap over which the heights grow little."""
        if self.heights is None:
            return gap
        own = self.tall(omega, omega)
        low, high = gap
        for _ in range(60):
            tall = self.tall(low, high)
            if np.all(tall <= growth * own):
                break
            high = omega + 0.5 * (min(high, 4 * omega + TINY) - omega) if high > omega else high
            low = omega - 0.5 * (omega - low)
        return Interval(low, high)

    def _holds(self, x: FloatArray, tall: FloatArray, tried: Interval, omega: float) -> Interval:
        """Return where scalings hold around a frequency, within some bounds."""
        low, high = tried
        S = self.scalings.matrix(x, self.level)
        if self.by_hamiltonian:
            crossings = self._crossings(S, tall)
            low = max([low, *crossings[crossings < omega * (1 - ROUNDING)]])
            high = min([high, *crossings[crossings > omega * (1 + ROUNDING)]])
        points = self._points(low, high, omega)
        M, w = self.at(points) * tall, tall.size
        half = (0.5 * S[w:, w:] @ M + S[:w, w:].conj().T).conj().swapaxes(1, 2) @ M
        bad = points[_indefinite(S[:w, :w] + half + half.conj().swapaxes(1, 2))]
        below, above = bad[bad < omega], bad[bad > omega]
        if below.size:
            good = points[(points > below[-1]) & (points <= omega)]
            low = float(good[0]) if good.size else omega
        if above.size:
            good = points[(points < above[0]) & (points >= omega)]
            high = float(good[-1]) if good.size else omega
        return Interval(low, high)

    def _points(self, low: float, high: float, omega: float) -> FloatArray:
        """Return frequencies in an interval, at and around the resonances."""
        real = self.poles[self.poles.imag == 0]
        kept = np.concatenate([real, self.swinging])
        swing, width = kept.imag, np.abs(kept.real)
        # four times closer at the tops
        near = np.concatenate(
            [width[:, None] * around_resonance() * close for close in (0.25, 1)], 1
        )
        near = (swing[:, None] + near).ravel()
        top = 100.0 * float(np.abs(self.poles).max(initial=1.0))
        end = min(high, max(top, 10 * low))
        base = np.linspace(low, end, SAMPLES)
        # six decades, where the interval begins at 0 Hz
        more = np.geomspace(max(low, 1e-6 * end), end, SAMPLES)
        points = np.unique(np.concatenate([near, base, more, [omega]]))
        return points[(points >= low) & (points <= end)]

    def _crossings(self, S: ComplexArray, tall: FloatArray) -> FloatArray:
        """Return the frequencies [rad/s], positive, at which F is singular."""
        A, B, C, D = self.A, self.B * tall, self.C, self.D * tall
        w = B.shape[1]
        S11, S12, S22 = S[:w, :w], S[:w, w:], S[w:, w:]
        Q = C.T @ S22 @ C
        Y = C.T @ (S12.conj().T + S22 @ D)
        R = S11 + S12 @ D + D.T @ S12.conj().T + D.T @ S22 @ D
        RY, RB = (np.linalg.solve(R, part) for part in (Y.conj().T, B.T))
        F = A - B @ RY
        H = np.block([[F, -B @ RB], [-Q + Y @ RY, -F.conj().T]])
        swing = axis_frequencies(H)
        return np.sort(swing[swing > 0])


def _indefinite(F: ComplexArray) -> NDArray[np.bool_]:
    """Return which of Hermitian matrices (n, w, w) are not positive definite."""
    try:
        np.linalg.cholesky(F)
    except np.linalg.LinAlgError:
        # relative to the sizes of its entries
        size = np.sqrt(np.abs(np.einsum("nii->ni", F)) + TINY)
        return np.asarray(np.linalg.eigvalsh(F / size[:, :, None] / size[:, None, :])[:, 0] <= 0.0)
    return np.zeros(len(F), dtype=bool)
