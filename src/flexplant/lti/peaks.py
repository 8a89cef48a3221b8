"""The largest gain over all frequencies, proved on intervals without an eigenvalue problem."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..arrays import CACHED, ComplexArray, FloatArray, divisor
from ..tolerances import CLOSE, TINY, TYPED
from .blocks_of_states import block_form, diagonal_form
from .statespace import StateSpace

#: largest number of refined peaks, and their least fraction of the largest gain
PEAKS, PART = 5, 0.7
#: number of Newton steps, and largest remaining distance from a peak [distance to the nearest pole]
STEPS, SETTLED = 12, 1e-5
#: radius of an interval, relative to the distance to the poles, below which its series is used
NEAR = 0.6
#: points from -1 to 1 at which an interval is divided otherwise. The radius of each part but the
#: outermost is at most `NEAR` times its distance to the nearest end, where a pole may lie
CUTS = np.array([-1.0, -0.9, -0.6, 0.6, 0.9, 1.0])
MIDDLES, HALVES = 0.5 * (CUTS[1:] + CUTS[:-1]), 0.5 * np.diff(CUTS)
#: radii tried around a peak, in distances to the nearest pole
ZONES = np.geomspace(0.4, 0.01, 6)


class Peaks(NamedTuple):
    """Frequencies [rad/s], largest gains there, and the radius within which none is larger."""

    omega: FloatArray
    gain: FloatArray
    zone: FloatArray


def proved_peak(model: Residues, tolerance: float) -> tuple[float, float] | None:
    """Return the largest gain and its frequency [rad/s], None where it is not proved."""
    if model.through.shape[0] < model.through.shape[1]:
        model = model.transposed
    start = np.concatenate([[0.0], model.resonances])
    size = _frobenius(model.series(start, 0)[0])
    if start.max() > 0.0 and size.min() > (1.0 - CLOSE) * size.max():
        return None  # flat, as of an optimal loop: intervals prove nothing
    best = np.argsort(size)[: -PEAKS - 1 : -1]
    start = start[best[size[best] >= PART * size[best[0]]]]
    for _ in range(STEPS):
        omega, gain, zone = peaks = newton_maxima(model, start, tolerance)
        highest = int(np.argmax(gain))
        if not zone[highest] > 0.0:
            return None
        higher = exceeding(model, gain[highest] * (1.0 + tolerance), peaks)
        if higher is None:
            return None
        if not higher.size:
            return float(gain[highest]), float(omega[highest])
        start = np.append(omega, higher)
    return None


class _Expansion(NamedTuple):
    """``G* G = A_0 + A_1 d + A_2 d^2`` next to frequencies, in the singular vectors there."""

    values: FloatArray
    A1: ComplexArray
    A2: ComplexArray
    T: list[ComplexArray]

    @property
    def together(self) -> npt.NDArray[np.bool_]:
        """Which eigenvalues (n_omega, m) count as the largest one: modes may be repeated."""
        return np.asarray(self.values >= (1.0 - TYPED) * self.values[:, :1])

    @property
    def slope(self) -> FloatArray:
        """First derivative of the largest eigenvalue."""
        return self.A1[:, 0, 0].real

    @property
    def bend(self) -> FloatArray:
        """Half its second derivative."""
        gaps = np.where(self.together, np.inf, self.values[:, :1] - self.values)
        pull = np.abs(self.A1[:, :, 0]) ** 2 / gaps
        return np.asarray(self.A2[:, 0, 0].real + np.sum(pull, axis=1))


def _expansion(model: Residues, omega: FloatArray) -> _Expansion:
    T = model.series(omega, 2)
    _, sizes, Vh = np.linalg.svd(T[0], full_matrices=False)
    V = Vh.conj().swapaxes(1, 2)
    X = [part @ V for part in T]
    H0 = X[0].conj().swapaxes(1, 2)
    A1, A2 = H0 @ X[1], H0 @ X[2]
    A1 = A1 + A1.conj().swapaxes(1, 2)
    A2 = A2 + A2.conj().swapaxes(1, 2) + X[1].conj().swapaxes(1, 2) @ X[1]
    return _Expansion(sizes**2, A1, A2, T)


def newton_maxima(model: Residues, start: FloatArray, tolerance: float) -> Peaks:
    """Return where Newton's steps lead from frequencies to maxima of the largest gain."""
    omega = start
    for _ in range(STEPS // 2):  # a flat gain does not settle
        one, near = _expansion(model, omega), model.nearest(omega)
        slope, bend, height = one.slope, one.bend, one.values[:, 0]
        uphill = bend < 0.0
        move = -0.5 * slope / np.where(uphill, bend, -1.0)
        move = np.where(uphill, move, np.sign(slope) * near)
        move = np.clip(move, -0.5 * near, 0.5 * near)
        if np.all(np.abs(move) <= SETTLED * near):
            break
        keep = height >= PART * height.max()
        omega = np.abs(omega + move)[keep]
    else:  # the last step has moved or removed points: compute again for the remaining ones
        one, near = _expansion(model, omega), model.nearest(omega)
        height = one.values[:, 0]
    return Peaks(omega, np.sqrt(height), _zone_radii(model, omega, near, one, tolerance))


def _zone_radii(
    model: Residues, omega: FloatArray, near: FloatArray, one: _Expansion, tolerance: float
) -> FloatArray:
    """Return the radius around each frequency within which no gain is higher than there."""
    # with G = T_0 + T_1 d + T_2 d^2 + O(d^3), in the singular vectors of T_0: t - G*G is positive
    # definite when the Schur complement of the block of its largest eigenvalue is, for which bounds
    # of the others suffice
    t0, t1, t2 = (_frobenius(T)[:, None] for T in one.T)
    r = near[:, None] * ZONES  # (n_omega, n_zones)
    apart = np.repeat(model.apart(omega), ZONES.size, axis=1)
    beta = model.rest(apart, r.reshape(-1), 2).reshape(r.shape)
    whole = t0 + t1 * r + t2 * r**2
    cubic = 2 * t1 * t2 + t2**2 * r + 2 * beta * whole + beta**2 * r**3
    top, first = one.values[:, :1], one.together
    size1, size2 = (_frobenius(A)[:, None] for A in (one.A1, one.A2))
    spread = size1 * r + size2 * r**2 + cubic * r**3
    gaps = np.where(first[:, None], np.inf, (top - one.values)[:, None] - spread[:, :, None])
    along1, along2 = (np.linalg.norm(A * first[:, None], axis=2)[:, None] for A in (one.A1, one.A2))
    along = along1 + along2 * r[:, :, None] + (cubic * r**2)[:, :, None]
    pull = np.sum(along**2 / divisor(gaps), axis=2)
    block = first[:, :, None] & first[:, None]
    slope = _frobenius(one.A1 * block)[:, None]
    others = np.eye(first.shape[1]) * np.where(first, 0.0, -2.0 * size2)[:, None]
    bend = np.linalg.eigvalsh(one.A2 * block + others)[:, -1:]
    fall = -(bend + cubic * r + pull)
    fits = np.all(gaps > 0.0, axis=2) & (fall > 0.0) & (slope**2 <= 8.0 * tolerance * top * fall)
    return np.asarray(np.max(np.where(fits, r, 0.0), axis=1))


def exceeding(model: Residues, level: float, peaks: Peaks) -> FloatArray | None:
    """Return frequencies at which the gain is above a level, empty when proven not to exist."""
    # None: undecided after as much work as an eigenvalue problem
    through = float(np.linalg.norm(model.through, 2))
    if not level > through * (1.0 + TYPED):
        return None
    centre, radius = _intervals_left(model, level - through, peaks)
    left = 100 + model.poles.size**2 // 10
    step = max(1, CACHED // max(model.poles.size, model.through.size))
    while centre.size:
        later, wide = centre[step:], radius[step:]
        centre, radius = centre[:step], radius[:step]
        apart = model.apart(centre)
        rough = through + model.rest(apart, radius, -1) > level
        centre, radius, apart = centre[rough], radius[rough], apart[:, rough]
        fine = radius <= NEAR * apart.min(axis=0)
        left -= int(np.count_nonzero(fine))
        if left < 0:
            return None
        higher, passed = _examined(model, centre[fine], radius[fine], apart[:, fine], level)
        if higher.size:
            return higher
        stay = np.ones(centre.size, dtype=bool)
        stay[np.flatnonzero(fine)[passed]] = False
        centre, radius = _divided(centre[stay], radius[stay])
        centre, radius = np.concatenate([centre, later]), np.concatenate([radius, wide])
    return np.zeros(0)


def _intervals_left(model: Residues, room: float, peaks: Peaks) -> tuple[FloatArray, FloatArray]:
    """Return centres and radii of intervals outside the peaks' zones, from zero to an end."""
    # beyond the end |G - D| <= sum 2 |R_i| / (omega - |p_i|) is below the distance to the level
    speed = float(np.abs(model.poles).max())
    end = 1.001 * speed + 2.0 * float(model.sizes.sum()) / room
    beyond = 1.001 * speed * 4.0 ** np.arange(1 + int(np.log2(end / speed)) // 2)
    low, high = peaks.omega - peaks.zone, peaks.omega + peaks.zone
    edges = np.sort(np.concatenate([model.poles.imag, np.maximum(low, 0.0), high, beyond]))
    edges = np.concatenate([[0.0], np.minimum(edges, end), [end]])
    centre, radius = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
    free = np.all((centre < low[:, None]) | (centre > high[:, None]), axis=0) & (radius > 0.0)
    return centre[free], radius[free]


def _divided(centre: FloatArray, radius: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return centres and radii of the parts of intervals."""
    parts, widths = centre[:, None] + radius[:, None] * MIDDLES, radius[:, None] * HALVES
    return parts.reshape(-1), widths.reshape(-1)


def _examined(
    model: Residues, centre: FloatArray, radius: FloatArray, apart: FloatArray, level: float
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return centres with gains above the level, and which intervals certainly stay below it."""
    # |G| <= max |T_0 +- r T_1| + r^2 |T_2| + O(r^3): the norm of a line is convex
    if not centre.size:
        return centre, np.zeros(0, dtype=bool)
    T0, T1, T2 = model.series(centre, 2)
    r = radius[:, None, None]
    rest = radius**2 * _frobenius(T2) + radius**3 * model.rest(apart, radius, 2)
    ends = np.stack([T0 + r * T1, T0 - r * T1])
    bound = _frobenius(ends).max(axis=0) + rest
    unsure = np.flatnonzero((bound > level) & (rest < level))
    bound[unsure] = _largest(ends[:, unsure]).max(axis=0) + rest[unsure]
    unsure = unsure[bound[unsure] > level]
    above = unsure[_frobenius(T0[unsure]) > level]  # else it is below it
    return centre[above[_largest(T0[above]) > level]], bound <= level


def _frobenius(X: ComplexArray) -> FloatArray:
    """Return the Frobenius norm of each of a stack of matrices."""
    *stack, p, m = X.shape
    parts = np.ascontiguousarray(X).reshape(*stack, p * m).view(np.float64)
    return np.asarray(np.sqrt(np.vecdot(parts, parts)))


def _largest(X: ComplexArray) -> FloatArray:
    """Return the largest singular value of each of a stack of matrices."""
    if X.shape[-1] == 1 or not X.size:
        return _frobenius(X)
    return np.asarray(np.linalg.svd(X, compute_uv=False)[..., 0])


#: largest number of entries of all residues that are formed
LARGEST = 5_000_000


class Residues(NamedTuple):
    """Poles (n,) of the upper half plane and what belongs to each, on the axis ``s = j omega``.

    A pole off the real axis stands for its conjugate too; residues of real poles are halved, so
    that every one counts twice.
    """

    poles: ComplexArray
    #: real and imaginary parts of the residues (p m, 2 n)
    parts: FloatArray
    #: norms of the residues (n,)
    sizes: FloatArray
    through: FloatArray

    @property
    def resonances(self) -> FloatArray:
        """The frequencies (n,) next to which peaks lie: ``|p| (1 - 2 zeta^2)^(1/2)``."""
        return np.sqrt(np.maximum(self.poles.imag**2 - self.poles.real**2, 0.0))

    def apart(self, omega: FloatArray) -> FloatArray:
        """Return the distances (2 n, n_omega) to the poles, then to their conjugates."""
        swing, real = np.outer([1.0, -1.0], self.poles.imag), self.poles.real**2
        gap = omega - swing[:, :, None]
        return np.asarray(np.sqrt(gap * gap + real[:, None]).reshape(-1, omega.size))

    def nearest(self, omega: FloatArray) -> FloatArray:
        """Return the distance of each frequency to its nearest pole."""
        near = omega - self.poles.imag[:, None]
        return np.asarray(np.sqrt((near * near + self.poles.real[:, None] ** 2).min(axis=0)))

    def series(self, omega: FloatArray, order: int) -> list[ComplexArray]:
        """Return T_0 to T_order (n_omega, p, m) of ``G(omega + d) = sum T_k d^k``."""
        # `T_k = (-j)^k sum R_i / (j omega - p_i)^(k+1)`, T_0 with the feedthrough
        upper = 1.0 / (1j * omega - self.poles[:, None])
        lower = 1.0 / (1j * omega - self.poles.conj()[:, None])
        found, u, v = [], upper, lower
        for k in range(order + 1):
            if k:
                u, v = u * (-1j * upper), v * (-1j * lower)
            both = np.concatenate([u + v, 1j * (u - v)])
            flat = (self.parts @ both.view(np.float64)).view(np.complex128)
            found.append(flat.T.reshape(omega.size, *self.through.shape))
        found[0] += self.through
        return found

    def responses(self, freq: FloatArray) -> ComplexArray:
        """Return the responses (p, m, n_freq) of a continuous system at frequencies [Hz]."""
        return np.moveaxis(self.series(2.0 * np.pi * freq, 0)[0], 0, 2)

    def rest(self, apart: FloatArray, radius: FloatArray, order: int) -> FloatArray:
        """Return a bound on ``|sum_(k > order) T_k d^k| / radius^(order + 1)`` for |d| <= radius.

        Each pole at the distance a (see `apart`) contributes a geometric series,
        ``1 / (a^(order+1) (a - radius))``; nearly infinite where a pole is closer than the radius.
        """
        free = np.maximum(apart - radius, np.cbrt(TINY))
        for _ in range(order + 1):
            free *= apart
        own, conjugate = (1.0 / free).reshape(2, self.sizes.size, -1)
        return np.asarray(self.sizes @ (own + conjugate))

    @property
    def transposed(self) -> Residues:
        """The transposed system: the same gains."""
        p, m = self.through.shape
        parts = self.parts.reshape(p, m, -1).swapaxes(0, 1).reshape(p * m, -1)
        return self._replace(parts=np.ascontiguousarray(parts), through=self.through.T)


def residues(g: StateSpace) -> tuple[Residues | None, ComplexArray | None]:
    """Return poles and residues, a sampled system mapped by ``z = (1 + s) / (1 - s)``."""
    # block by block where A is block diagonal, by the eigenvectors of A otherwise. None where these
    # are ill-conditioned or too many, or a pole lies at z = -1. Also returns the eigenvalues of A
    # if they were computed; a block of one state gives its eigenvalue twice
    if g.n_states * g.D.size > LARGEST:
        return None, None
    known, left, right = block_form(g) or diagonal_form(g.A, g.B, g.C)
    poles = known
    if left is None or right is None or (g.dt and np.any(poles == -1.0)):
        return None, known
    found, through = left.T[:, :, None] * right[:, None, :], g.D
    if g.dt:
        through = through - np.sum(found / (1.0 + poles)[:, None, None], axis=0).real
        found = found * (2.0 / (1.0 + poles) ** 2)[:, None, None]
        poles = (poles - 1.0) / (poles + 1.0)
    upper = (poles.imag >= 0) & np.any(found, axis=(1, 2))
    poles, found = poles[upper], found[upper]
    found[poles.imag == 0] *= 0.5
    flat = found.reshape(poles.size, g.D.size).T
    parts = np.hstack([flat.real, flat.imag])
    return Residues(poles, parts, np.linalg.norm(flat, axis=0), through), known
