"""The stabilisation diagram: poles over model orders, stable ones, and their selection.

[Peeters2004]_; [Cauberghe2004]_ (constraint).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import (
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    between,
    complex_array,
    real_array,
)
from ..errors import ModelError, SolverError, counted
from ..modes.matching import assigned, in_span, mac_matrix
from ..store import Value, checked
from ..tolerances import NULL, SAME, TINY
from .lines import NEAR, PreparedLines

#: flags of a pole; each includes the previous ones
NEW, FREQUENCY, DAMPING, STABLE = 0, 1, 2, 3


@dataclass(frozen=True, eq=False, repr=False)
class PoleSelection(Value):
    """Poles picked from a stabilisation diagram, with which `identify_modes` starts its fit.

    Parameters
    ----------
    poles : (m,) complex array [rad/s]
        Poles with positive imaginary parts.
    participation : (n_in, m) complex array
        Participation factors. The factor of an input in a pole states how strongly the input
        excites the mode. If there are fewer outputs than inputs, the array has the shape (n_out, m)
        and holds the mode shapes at the outputs instead. Repeated poles have linearly independent
        columns.

    Examples
    --------
    The pole of an FRF with one resonance is selected automatically:

    >>> import flexplant as fx
    >>> import numpy as np
    >>> freq = np.arange(10.0, 40.0, 0.1)
    >>> H = 1 / (20.0**2 - freq**2 + 0.4j * freq)
    >>> diagram = fx.identification.stabilisation_diagram(fx.Frf(freq, H[None, None]))
    >>> diagram.automatic().poles.size
    1
    """

    poles: ComplexArray = field(metadata=checked(complex_array, shape=(None,)))
    participation: ComplexArray = field(metadata=checked(complex_array, shape=(None, "poles")))

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.any(self.poles.imag <= 0) or not np.all(np.any(self.participation, axis=0)):
            raise ModelError(
                "poles need positive imaginary parts, and each needs a non-zero participation."
            )

    def __len__(self) -> int:
        return int(self.poles.size)

    def __repr__(self) -> str:
        listed = ", ".join(f"{pole.imag / 2 / np.pi:.4g}" for pole in self.poles[:6].tolist())
        return (
            f"<PoleSelection: {counted(len(self), 'pole')} at {listed}{', ...' * (len(self) > 6)} "
            "Hz>"
        )


@dataclass(frozen=True, eq=False, repr=False)
class StabilisationDiagram(Value):
    """Poles of models of rising order, and whether each was present at the previous order.

    `stabilisation_diagram` fits models of several orders to an FRF. A pole of the machine appears
    at nearly all orders, and a pole that fits noise changes from order to order. A track is a
    sequence of poles at successive model orders that belong together.

    Parameters
    ----------
    orders : (n,) int array
        Model order of each pole.
    poles : (n,) complex array [rad/s]
        Poles with positive damping ratios inside the band.
    flags : (n,) int array
        Agreement of each pole with a pole of the previous order. 0: the pole is new. 1: it has the
        same frequency. 2: it also has the same damping. 3: it also has the same shape and is called
        stable.
    tracks : (n,) int array
        Number of the track to which each pole belongs.
    shapes, participation : (n_out, n), (n_in, n) complex array
        Shapes and participation vectors of unit length. With fewer outputs than inputs, `shapes`
        holds the participation vectors and `participation` the shapes.
    band : (2,) array [Hz]
        Band of the listed poles.
    highest : (n,) int array
        Highest model order at which each pole could be found. The band is analysed in parts. In a
        part with few lines this order is lower.
    """

    orders: IntArray
    poles: ComplexArray
    flags: IntArray
    tracks: IntArray
    shapes: ComplexArray = field(kw_only=True)
    participation: ComplexArray = field(kw_only=True)
    band: FloatArray = field(kw_only=True)
    highest: IntArray = field(kw_only=True)

    def __len__(self) -> int:
        return int(self.poles.size)

    def __repr__(self) -> str:
        known = np.unique(self.orders)
        span = f"{known[0]} .. {known[-1]}" if known.size else "none"
        return (
            f"<StabilisationDiagram: orders {span}, {counted(len(self), 'pole')}, "
            f"{int(np.sum(self.flags == STABLE))} stable>"
        )

    @property
    def freq(self) -> FloatArray:
        """Frequencies |lambda|/(2 pi) [Hz]."""
        return np.abs(self.poles) / (2 * np.pi)

    @property
    def zeta(self) -> FloatArray:
        """Damping ratios."""
        return np.asarray(-self.poles.real / np.abs(self.poles), dtype=np.float64)

    def automatic(self, *, presence: float = 0.5) -> PoleSelection:
        """Return the poles that are stable over the orders.

        A track is accepted if its pole is stable at four or more orders. It must also be stable at
        no less than the fraction `presence` of the orders from the first order of the track to the
        highest order. All poles are taken from one order, the one with most accepted tracks. The
        participation vectors of repeated poles therefore belong together.

        Parameters
        ----------
        presence : float
            Smallest fraction of the orders at which the pole of a track is stable, between 0 and 1.
        """
        presence = between(presence, "presence", 0.0, 1.0, "Try 0.5.", ends="]")
        kept = []
        for track in np.unique(self.tracks):
            mine = self.tracks == track
            known = np.unique(self.orders[self.highest == self.highest[mine][0]])
            span = np.sum(known >= self.orders[mine].min())
            stable = int(np.sum(mine & (self.flags == STABLE)))
            if stable >= max(4, presence * span):
                kept.append(int(track))
        if not kept:
            known = np.unique(self.orders)
            where = f"over the orders {known[0]} to {known[-1]}" if known.size else "in the band"
            raise SolverError(
                f"no pole is stable {where}: use a band where resonances exceed the noise, "
                "several resonance widths wide (few lines allow few orders), or pick poles by "
                "hand with diagram.select(freq=[...])."
            )
        return self._chosen(kept)

    def select(self, freq: Sequence[float] | FloatArray) -> PoleSelection:
        """Return the poles closest to some frequencies read from the diagram.

        Parameters
        ----------
        freq : (m,) array [Hz]
            Frequencies of the poles. A frequency that is given twice picks two poles.

        Raises
        ------
        ModelError
            When `freq` is empty, or no pole lies within 3 % of a frequency.
        """
        wanted = real_array(freq, "freq", (None,))
        if not wanted.size:
            raise ModelError("select needs at least one frequency.")
        known = np.unique(self.tracks)
        centres = np.array([np.median(self.freq[self.tracks == track]) for track in known])
        lengths = np.array([np.sum(self.tracks == track) for track in known])
        away: Any = np.abs(centres / np.maximum(wanted, TINY)[:, None] - 1.0)
        # a long track is preferred to a short one that is slightly closer
        cost = np.where(away < 0.03, away + 0.01 / lengths, 1e3)
        if cost.shape[1] < wanted.size:
            raise ModelError(f"{wanted.size} frequencies, but only {known.size} poles are there.")
        columns = assigned(cost, most=1.0)
        lost = wanted[columns < 0].tolist()
        if lost:
            raise ModelError(
                f"no separate pole within 3 % of {lost} Hz: look at plot.stabilisation(diagram), "
                "raise the orders or leave these out."
            )
        return self._chosen(known[columns].tolist())

    def _chosen(self, tracks: Sequence[int]) -> PoleSelection:
        inside = np.isin(self.tracks, tracks)
        orders, counts = np.unique(self.orders[inside], return_counts=True)
        best = orders[np.flatnonzero(counts == counts.max())[-1]]
        places = []
        for track in tracks:
            mine = np.flatnonzero(self.tracks == track)
            places.append(mine[np.argmin(np.abs(self.orders[mine] - best))])
        places.sort(key=lambda i: float(self.poles[i].imag))
        return PoleSelection(self.poles[places], self.participation[:, places])


def built_diagram(
    results: Sequence[OrderPoles],
    band: FloatArray,
    tolerances: tuple[float, float, float],
    *,
    first: int = 0,
    spacing: float = 0.0,
) -> StabilisationDiagram:
    """Return the diagram of results by ascending order: flags and tracks, numbered from `first`.

    `spacing`: distance of lines [rad/s] near zero, where fractions of a frequency are below what
    the lines resolve.
    """
    flags: list[IntArray] = []
    tracks: list[IntArray] = []
    for before, result in zip([None, *results], results, strict=False):
        flag = np.zeros(result.poles.size, dtype=np.int64)
        track = np.full(result.poles.size, -1, dtype=np.int64)
        if before is not None and before.poles.size and result.poles.size:
            old, flag = _continued_poles(before, result, tolerances, spacing)
            track = np.where(old >= 0, tracks[-1][old], -1)
        fresh = np.flatnonzero(track < 0)
        track[fresh] = first + np.arange(fresh.size)
        first += fresh.size
        flags.append(flag)
        tracks.append(track)
    sizes = [one.poles.size for one in results]
    return StabilisationDiagram(
        np.repeat([one.order for one in results], sizes),
        np.concatenate([one.poles for one in results]),
        np.concatenate(flags),
        np.concatenate(tracks),
        shapes=np.concatenate([one.shapes for one in results], axis=1),
        participation=np.concatenate([one.participation for one in results], axis=1),
        band=band,
        highest=np.full(sum(sizes), results[-1].order),
    )


def _continued_poles(
    old: OrderPoles, new: OrderPoles, tolerances: tuple[float, float, float], spacing: float
) -> tuple[IntArray, IntArray]:
    """Return the old pole that each new one continues, or -1, and the flags of the new ones."""
    tol_freq, tol_damping, tol_mac = tolerances
    f_old, f_new = np.abs(old.poles), np.abs(new.poles)
    z_old, z_new = -old.poles.real / f_old, -new.poles.real / f_new
    # near zero the lines determine a pole relative to their distance
    coarse = tol_damping * spacing / f_old
    near = np.abs(f_new[:, None] / f_old - 1.0) <= np.maximum(tol_freq, coarse)
    damped = near & (np.abs(z_new[:, None] - z_old) <= np.maximum(tol_damping * z_old, coarse))
    apart = np.abs(new.poles[:, None] - old.poles)
    wide = -3.0 * np.maximum(old.poles.real, new.poles.real[:, None])
    group = near & (apart <= np.maximum(wide, 1e-4 * f_new[:, None]))
    alike = group & (mac_matrix(new.shapes, old.shapes) >= tol_mac)
    for i in np.flatnonzero(np.sum(group, axis=1) > 1):
        # shapes of (nearly) repeated poles are arbitrary within their span
        span = old.shapes[:, group[i]]
        alike[i, group[i]] = in_span(span, new.shapes[:, [i]]) >= tol_mac
    stable = damped & alike
    flag = np.max(near * 1 + damped * 1 + stable * 1, axis=1)
    distance = apart / (f_old + TINY)
    cost = np.where(stable, distance, np.where(near, 10.0 + distance, 1e3))
    # a pole whose damping jumps continues a track, but is not stable
    return assigned(cost, most=100.0), flag


#: largest damping ratio of a mode
BROADEST = 0.2
#: largest changes of frequency and damping of a stable pole from order to order, and its least MAC
STEADY = (0.01, 0.05, 0.95)
#: fraction of the unit circle that the band occupies; the rest separates its two ends
ARC = 0.9


@dataclass(frozen=True, eq=False)
class OrderPoles:
    """Poles of one model order: lambda (n,), shapes (n_out, n), participation (n_in, n)."""

    order: int
    poles: ComplexArray
    shapes: ComplexArray
    participation: ComplexArray

    def select(self, places: IntArray) -> OrderPoles:
        """Return some of them."""
        parts = (self.poles, self.shapes, self.participation)
        return OrderPoles(self.order, *(part[..., places] for part in parts))


class Moments:
    r"""The normal equations of all model orders of a right matrix fraction.

    ``H(s_f) = B(z_f) A(z_f)^{-1}`` with polynomials ``A = sum_r A_r z^r`` (n_in, n_in) and
    ``B_o`` (1, n_in) is made linear by multiplication with A; the error of output o is

    .. math:: e_o(f) = w_o(f)\,\bigl(B_o(z_f) - H_o(z_f) A(z_f)\bigr).

    The band is laid around the unit circle, ``z = exp((s - s_0) \Delta t)``, where powers of z are
    nearly orthogonal, so that high orders need no other basis. Coefficients are complex, so that no
    order is used for the conjugate poles outside the band. Every block of the normal equations is
    Toeplitz, and all orders share its moments.
    """

    def __init__(
        self, freq: FloatArray, data: ComplexArray, weight: FloatArray, order: int
    ) -> None:
        self.centre = np.pi * (freq[0] + freq[-1])
        self.step = 2 * np.pi * ARC / (2 * np.pi * (freq[-1] - freq[0]))
        ahead, squares = self._powers(freq, order), weight**2
        powers = np.hstack([ahead[:, :0:-1].conj(), ahead])
        self.n_out, self.n_in = data.shape[:2]
        R = squares @ powers
        weighted = squares[:, None, :] * data
        n, m = order + 1, self.n_in
        S = -(weighted.reshape(self.n_out * m, -1) @ powers).reshape(self.n_out, m, -1)
        pairs = np.einsum("oif,ojf->ijf", data.conj(), weighted)
        T = (pairs.reshape(m * m, -1) @ powers).reshape(m, m, -1)
        toeplitz = np.arange(n)[None, :] - np.arange(n)[:, None] + order
        #: moments of A; column: coefficient r of A, channel i
        self.big = T[:, :, toeplitz].transpose(2, 0, 3, 1).reshape(n * m, n * m)
        # powers of z on most of the circle are well conditioned for all data. Lower orders are
        # leading blocks, also of the inverse of a triangle
        triangles = np.linalg.cholesky(R[:, toeplitz])
        self.inverse = np.array([la.lapack.ztrtri(L, lower=1)[0] for L in triangles])
        coupled = S[:, :, toeplitz].transpose(0, 2, 3, 1).reshape(self.n_out, n, n * m)
        #: for each output L^{-1} S, which eliminates B
        self.taken = self.inverse @ coupled

    def _powers(self, freq: FloatArray, order: int) -> ComplexArray:
        """Return the powers (n_freq, order + 1) of z at frequencies [Hz]."""
        turn = (2 * np.pi * freq - self.centre) * self.step
        return np.vander(np.exp(1j * turn), order + 1, increasing=True)

    def solve(
        self, orders: Sequence[int], wanted: Callable[[ComplexArray], BoolArray]
    ) -> list[OrderPoles]:
        """Return the wanted poles of rising orders; shapes are computed for these only."""
        return [self._poles(A, wanted) for A in self._denominators(orders)]

    def _poles(self, A: ComplexArray, wanted: Callable[[ComplexArray], BoolArray]) -> OrderPoles:
        """Return the wanted poles of one order with the denominator A."""
        # in v = 1/z the polynomial is monic: its companion matrix needs no inverse
        order, m = len(A) - 1, self.n_in
        companion = np.eye(order * m, k=m, dtype=np.complex128)
        companion[:, :m] = -A[1:].transpose(0, 2, 1).reshape(order * m, m)
        v = np.linalg.eigvals(companion)
        # poles at zero: the leading coefficient is singular except for rounding
        z = 1.0 / v[np.abs(v) > 1e-8]
        poles = np.log(z) / self.step + 1j * self.centre
        keep = wanted(poles)
        z, poles = z[keep], poles[keep]
        powers = z[:, None] ** np.arange(order + 1)
        left, right = _pole_vectors(z, (powers @ A.reshape(-1, m * m)).reshape(-1, m, m))
        rows = (powers[:, :, None] * right[:, None, :]).reshape(z.size, m * (order + 1))
        values = self._numerator(A).reshape(self.n_out, -1) @ rows.T
        size = np.linalg.norm(values, axis=0)
        seen = size > 0
        return OrderPoles(order, poles[seen], values[:, seen] / size[seen], left[seen].T)

    def response(self, order: int, freq: FloatArray) -> ComplexArray:
        """Return the response (n_out, n_in, n_freq) of the matrix fraction of one order."""
        A = next(self._denominators([order]))
        powers, m = self._powers(freq, order), self.n_in
        below = (powers @ A.reshape(-1, m * m)).reshape(-1, m, m).swapaxes(1, 2)
        numerator = self._numerator(A).transpose(1, 2, 0).reshape(order + 1, -1)
        above = (powers @ numerator).reshape(-1, m, self.n_out)
        return np.asarray(np.linalg.solve(below, above).transpose(2, 1, 0))

    def _denominators(self, orders: Sequence[int]) -> Iterator[ComplexArray]:
        """Yield A (order + 1, n_in, n_in) with A_0 = I of rising orders."""
        # this constraint makes the mathematical poles unstable and keeps the physical ones stable,
        # which makes the stabilisation diagram clear [Cauberghe2004]_. Each order only adds rows
        m, done, left = self.n_in, 0, self.big.copy()
        for order in orders:
            n = order + 1
            rows = self.taken[:, done:n].reshape(-1, left.shape[0])
            left -= rows.conj().T @ rows
            done, free = n, _solve_hermitian(left[m : n * m, m : n * m], left[m : n * m, :m])
            yield np.concatenate([np.eye(m), -free]).reshape(n, m, m)

    def _numerator(self, A: ComplexArray) -> ComplexArray:
        """Return B (n_out, order + 1, n_in) of the denominator A."""
        n, m = A.shape[:2]
        below = self.taken[:, :n, : n * m] @ A.reshape(n * m, m)
        return np.asarray(-self.inverse[:, :n, :n].conj().swapaxes(1, 2) @ below)


def _pole_vectors(z: ComplexArray, matrices: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return (n, m) left and right null vectors l, r of A(z) (n, m, m): l A = 0, A r = 0."""
    if matrices.shape[1] == 1:
        return np.ones((z.size, 1), dtype=np.complex128), np.ones((z.size, 1), dtype=np.complex128)
    # null vectors of a pole that is repeated except for rounding are independent
    U, _, Vh = np.linalg.svd(matrices)
    alike = np.abs(z[:, None] - z) < SAME
    first = np.sum(np.cumsum(alike, axis=1) == 0, axis=1)
    number = np.sum(np.tril(alike, -1), axis=1)
    place = np.maximum(U.shape[1] - 1 - number, 0)
    return U[first, :, place].conj(), Vh[first, place].conj()


def _solve_hermitian(matrix: ComplexArray, right: ComplexArray) -> ComplexArray:
    factor, info = la.lapack.zpotrf(matrix)
    if info == 0 and la.lapack.zpocon(factor, np.linalg.norm(matrix, 1))[0] > NULL:
        return np.asarray(la.lapack.zpotrs(factor, right)[0])
    # data without noise do not determine orders above the true one: the smallest solution is used
    return np.asarray(la.lstsq(matrix, right, cond=1e-13, lapack_driver="gelsd")[0])


#: default highest model order, and least number of lines per order
HIGHEST, LINES_OF_ORDER = 40, 4
#: number of references times parts of the band above which only every second order is used, since
#: each order is a large eigenvalue problem
MANY = 4
#: quantile of the gaps between lines that counts as the widest gap: a tenth may be wider
_WIDE = 0.9
#: largest number of poles of an order, conjugates included, which is the size of the eigenvalue
#: problem
POLES = 100


@dataclass(frozen=True)
class Part:
    """A part of the band: its own lines, those used for its poles, and its model orders."""

    own: slice
    seen: slice
    orders: list[int]
    #: whether lines of negative frequencies take part, whose responses are the conjugates: near
    #: zero the conjugate poles are as close as the poles, and real coefficients halve the unknowns
    mirrored: bool


def parts_of(ready: PreparedLines, orders: list[int] | None = None) -> list[Part]:
    """Return the parts of the band; ModelError if their lines do not allow the orders given."""
    windows = _line_windows(ready)
    references = ready.data.shape[1]
    step = 2 if len(windows) * references >= MANY else 1
    parts = []
    for own, seen in windows:
        freq = ready.freq[seen]
        mirrored = own.start == 0 and _last_low(ready, seen.stop) > 0
        # polynomials are determined only where lines exist; single missing lines do not matter
        gap = float(np.quantile(np.diff(freq), _WIDE))
        count = min(freq.size, round(float(freq[-1] - freq[0]) / gap) + 1) * (1 + mirrored)
        # at least four orders are compared, for which twenty lines are enough
        top = max(6, min(HIGHEST, count // LINES_OF_ORDER - 1, max(POLES // references, 10)))
        mine = list(range(2, top + 1, step if top >= 4 * step else 1)) if orders is None else orders
        if 2 * (mine[-1] + 1) > count:
            raise ModelError(
                f"order {mine[-1]} needs more lines than the {freq.size} between {freq[0]:.4g} and "
                f"{freq[-1]:.4g} Hz, which count as {count} where they are widest apart: lower the "
                "orders, or measure lines that are closer and evenly spaced."
            )
        parts.append(Part(own, seen, mine, mirrored))
    return parts


#: number of lines of a part, and fraction of it that is used beyond each of its ends
LINES, OVERLAP = 400, 0.25
#: ratio of the frequencies at the ends of a part above which it is divided, and least number of
#: lines that a part keeps: modes far below the top of a part lie within few lines of it, closer
#: than its orders resolve
WIDEST, FEWEST = 8.0, 40
#: distance outside of the band, relative to it, within which poles are searched, since they affect
#: the responses inside
MARGIN = 0.04


def _line_windows(ready: PreparedLines) -> list[tuple[slice, slice]]:
    """Return the lines of parts of about 400, cut where responses are weakest, and those used."""
    import scipy.ndimage as ndi

    n_freq = ready.freq.size
    count = max(1, round(n_freq / LINES))
    power = np.sum(np.abs(ready.data * ready.weight) ** 2, axis=(0, 1))
    power = ndi.uniform_filter1d(np.log(power + TINY), 9)
    reach = n_freq // (4 * count)
    inner = [_weakest(power, round(i * n_freq / count), reach) for i in range(1, count)]
    cuts = [n_freq, *inner[::-1]]
    low = _last_low(ready, cuts[-1])
    while FEWEST <= low <= cuts[-1] - FEWEST:
        cuts.append(_weakest(power, low, low // 4))
        low = _last_low(ready, cuts[-1])
    cuts.append(0)
    parts = []
    for last, first in pairwise(cuts):
        beyond = round(OVERLAP * (last - first))
        seen = slice(max(0, first - beyond), min(n_freq, last + beyond))
        parts.append((slice(first, last), seen))
    return parts[::-1]


def _last_low(ready: PreparedLines, last: int) -> int:
    """Return the number of lines far below the last one, zero where no line is near zero."""
    if ready.freq[0] > NEAR * ready.spacing:
        return 0
    return int(np.searchsorted(ready.freq, ready.freq[last - 1] / WIDEST))


def _weakest(power: FloatArray, middle: int, reach: int) -> int:
    """Return the line of least power within a reach of another."""
    return middle - reach + int(np.argmin(power[middle - reach : middle + reach]))


def diagram_of(
    ready: PreparedLines,
    orders: list[int] | None,
    tolerances: tuple[float, float, float] = STEADY,
    max_zeta: float = BROADEST,
) -> StabilisationDiagram:
    """Return the diagrams of all parts as one; a track belongs to the part with its median."""
    low, high = float(ready.freq[0]), float(ready.freq[-1])
    edge, band, first = MARGIN * (high - low), np.array([low, high]), 0
    found = []
    for part in parts_of(ready, orders):
        own, freq = part.own, ready.freq[part.seen]
        spacing = 2 * np.pi * float(np.median(np.diff(freq))) if part.mirrored else 0.0
        poles = order_poles(ready, part, part.orders, max_zeta)
        diagram = built_diagram(poles, band, tolerances, first=first, spacing=spacing)
        first += len(diagram)
        ends = (
            low - edge if own.start == 0 else ready.freq[own.start],
            high + edge if own.stop == ready.freq.size else ready.freq[own.stop],
        )
        keep = np.zeros(len(diagram), dtype=bool)
        for track in np.unique(diagram.tracks):
            mine = diagram.tracks == track
            keep[mine] = ends[0] <= np.median(diagram.freq[mine]) < ends[1]
        found.append((diagram, keep))
    parts: dict[str, Any] = {
        name: np.concatenate([getattr(one, name)[..., keep] for one, keep in found], axis=-1)
        for name in ("orders", "poles", "flags", "tracks", "shapes", "participation", "highest")
    }
    return StabilisationDiagram(**parts, band=band)


def weighted_by_remainder(ready: PreparedLines, orders: list[int] | None) -> PreparedLines:
    """Return the same with weights from the residual of matrix fractions of high order."""
    now = ready
    n_out, n_in, n_freq = ready.data.shape
    for _ in range(2):
        error: FloatArray = np.zeros(ready.data.shape)
        coefficients = 0
        for part in parts_of(now, orders):
            own, order = part.own, part.orders[-1]
            fitted: ComplexArray = moments_in(now, part).response(order, now.freq[own])
            error[:, :, own] = np.abs(now.data[:, :, own] - fitted) ** 2
            coefficients += order + 1
        share = coefficients / n_freq * (1 + n_in / n_out)
        now = now.from_errors(error, min(0.5, share))
    return now


def order_poles(
    ready: PreparedLines, part: Part, orders: list[int], max_zeta: float = BROADEST
) -> list[OrderPoles]:
    """Return the poles of a part of the band for some of its orders."""
    low, high = ready.freq[part.seen][[0, -1]].tolist()
    edge = MARGIN * (high - low)

    def counted_there(poles: ComplexArray) -> BoolArray:
        freq, zeta = np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles)
        keep = (freq > max(low - edge, 0.5 * low)) & (freq < high + edge)
        return np.asarray(keep & (zeta > 0) & (zeta < max_zeta) & (poles.imag > 0))

    return moments_in(ready, part).solve(orders, counted_there)


def moments_in(ready: PreparedLines, part: Part) -> Moments:
    """Return the normal equations of the lines of one part."""
    freq, data = ready.freq[part.seen], ready.data[:, :, part.seen]
    weight = ready.line_weight[:, part.seen]
    if part.mirrored:
        freq = np.concatenate([-freq[::-1], freq])
        data = np.concatenate([data[:, :, ::-1].conj(), data], axis=2)
        weight = np.concatenate([weight[:, ::-1], weight], axis=1)
    return Moments(freq, data, weight, part.orders[-1])
