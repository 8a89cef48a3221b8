"""Noise or model error: outputs that disagree, smooth misfit, and poles that noise may explain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import ComplexArray, FloatArray
from ..errors import SolverError
from ..modes.matching import ALIKE, mac_matrix
from ..tolerances import CERTAIN, CHANCE, MOST_STEPS, NEGLIGIBLE, TINY
from .lines import NEAR, Lines
from .refine import OWN, PoleFit, pivoted, refined, scaled_inverse

#: distance, in half-widths (geometric mean of two poles), within which poles of different shapes
#: may be one resonance; one bandwidth where the weaker pole is the broader: the remainder of a
#: distorted circle is broad, a resonance on a broad background is not
WITHIN, BANDWIDTH = 1.5, 2.0
#: fraction of a misfit that counts as most of it: a missed mode leaves about half, a shift less
#: than 1e-3
MOSTLY = 0.9
#: misfit near a pole, including its correlation over lines, up to which it counts as noise
NOISE = 1.5
#: distance from a pole, in half-widths, within which misfit or another pole may belong to the same
#: resonance; a pole with a larger half-width belongs to another one, since the mass of a sensor
#: changes frequencies, but hardly the damping
SAME_RESONANCE = 3.0


def own_cost(fit: PoleFit) -> float:
    """Return the cost of separate fits of each output, with separate poles."""
    return sum(one.cost for one in fit.own)


def outputs_disagree(fit: PoleFit, least: float = np.inf) -> bool:
    """Return whether separate poles leave only noise, and shared poles far more.

    The remainder must also be less than that of another fit with more poles (`least`). The
    uncertainty of shared poles then follows from the differences between outputs, not from the
    misfit that a refinement reduces.
    """
    lines, (n_out, m) = fit.lines, fit.shapes.shape
    parts = len(lines.parts)
    count = n_out * lines.data.shape[1] * (lines.lower + lines.upper) + 2 * m * (n_out + parts)
    free = max(1.0, 2 * lines.data.size - lines.inflation * count)
    if parts == 1 or fit.cost < NOISE * free:
        return False
    noise = CERTAIN * np.sqrt(2 * free * lines.inflation) + NEGLIGIBLE * (fit.cost - free)
    limit, alone = min(least, free + noise, fit.cost / NOISE), 0.0
    for place in range(parts):
        own = fit.own_below(place, limit - alone)
        alone += np.inf if own is None else own.cost
        if alone >= limit:
            return False
    return True


def unevenness(fit: PoleFit, least: float) -> float:
    """Return the factor by which poles differ between outputs more than by noise, else 1."""
    # where shared poles leave hardly more than noise they are better than means of separate ones,
    # which weak modes lack. The gain of separate poles is 1 for each parameter by noise alone; all
    # of it may be due to one part of one pole
    gain = fit.cost - own_cost(fit)
    return gain / (len(fit.lines.parts) - 1) if gain > least else 1.0


def coherence(fit: PoleFit, pole: complex) -> float:
    """Return the factor by which a misfit near a pole lowers the cost more than noise does."""
    # the mean of `|e|^2/\sigma^2` there, times `1 + 2 \sum_k \rho_k` of the correlation of e over
    # neighbouring lines: misfit that is smooth over some of them counts as one error
    lines = fit.lines
    reach = max(NEAR * 2 * np.pi * lines.spacing, SAME_RESONANCE * abs(pole.real))
    near = np.abs(2 * np.pi * lines.freq - pole.imag) <= reach
    error = (lines.data - fit.model)[..., near] * lines.weight[..., near]
    power = float(np.sum(np.abs(error) ** 2))
    count = error.shape[-1]
    if power <= 0 or count < 4:
        return 1.0
    total, chance = 1.0, 2.0 / np.sqrt(2.0 * error.size)
    for lag in range(1, count // 2):
        alike = float(np.sum(error[..., lag:] * error[..., :-lag].conj()).real) / power
        if alike < chance:
            break
        total += 2.0 * alike
    return max(1.0, power / (2.0 * error.size)) * max(1.0, total / lines.inflation)


def strength(fit: PoleFit) -> FloatArray:
    """Return the height of each resonance with the weights of the lines."""
    power = np.sum(fit.lines.weight**2, axis=(1, 2)) / fit.lines.freq.size
    height = np.sqrt(power @ np.abs(fit.shapes) ** 2) / -fit.poles.real
    return np.asarray(height * np.linalg.norm(fit.participation, axis=0))


def twin_poles(fit: PoleFit) -> tuple[int, int] | None:
    """Return two poles within a bandwidth with equal shape and participation, the weaker last.

    One resonance with a distorted circle (leakage, amplitude) looks like this. With one input two
    modes look the same, unless the residual is only noise of a known variance, or one pole at each
    output explains far less than the two, and separate poles of the outputs hardly more.
    """
    height = strength(fit)
    alike = [mac_matrix(vectors, vectors) > ALIKE for vectors in (fit.shapes, fit.participation)]
    for k in np.argsort(height):
        for j in np.argsort(-height):
            if height[j] <= height[k]:
                continue
            apart, widths = abs(fit.poles[j].imag - fit.poles[k].imag), -fit.poles.real[[j, k]]
            same = alike[0][j, k] and alike[1][j, k]
            reach = BANDWIDTH if widths[1] > widths[0] else WITHIN
            if apart > (widths.sum() if same else reach * np.sqrt(widths.prod())):
                continue
            single = fit.participation.shape[0] == 1
            distorted = (single and (same or not fit.lines.known)) or (
                (same or single) and coherence(fit, fit.poles[k]) > NOISE
            )
            if distorted and (same or not _is_shared_pair(fit, int(k))):
                return int(j), int(k)
    return None


def _is_shared_pair(fit: PoleFit, weaker: int) -> bool:
    """Return whether two shared poles explain most of what one pole at each output leaves."""
    # a second pole that stands for differences between outputs leaves more than noise of them
    if coherence(fit, fit.poles[weaker]) > NOISE or fit.cost > NOISE * own_cost(fit):
        return False
    rest = refined(fit.lines, *fit.rest(weaker), steps=OWN, strict=False)
    return fit.cost < (1 - MOSTLY) * own_cost(rest)


@dataclass(frozen=True, eq=False)
class Disagreement:
    """Relative differences of frequencies between outputs, and their mean poles (m,).

    `spread` (2 m,) of [Re lambda; Im lambda] is the deviation of an output from them, `deviation`
    their own, `correlation` over the outputs. `odd` is an output (or set-up) that deviates far more
    than the others, with its relative deviation, if there is one.
    """

    size: float
    poles: ComplexArray
    spread: FloatArray
    deviation: FloatArray
    correlation: FloatArray
    odd: tuple[int, float] | None = None

    def covariance(self, formal: FloatArray) -> FloatArray:
        """Return the covariance of the poles, with that of the noise alone (2 m, 2 m) in it."""
        rest = np.sqrt(np.maximum(0.0, self.deviation**2 - np.diag(formal)))
        return np.asarray(formal + self.correlation * np.outer(rest, rest))


def disagreement(fit: PoleFit, least: float, excess: float) -> Disagreement | None:
    """Return the differences between outputs of a fit, and the mean of their separate poles."""
    # None where separate poles lower the cost by less than `least`, or do not explain nearly all of
    # the `excess` of the cost over that of noise, which then has another cause
    if len(fit.lines.parts) == 1:
        return None
    own = fit.own
    if fit.cost - own_cost(fit) < max(least, MOSTLY * excess):
        return None
    places = np.array([np.concatenate([one.poles.real, one.poles.imag]) for one in own])
    # an output that hardly sees a mode may have its pole anywhere, with a correspondingly large
    # variance
    parted = [fit.at_rows(rows) for rows in fit.lines.parts]
    seen, alone = (np.array([_variance(one) for one in fits]) for fits in (parted, own))
    elsewhere, broad = (np.tile(squares, 2) for squares in _strayed(fit, own))
    variance = np.maximum(seen, alone) + elsewhere
    # the spread includes all outputs and broad poles, since it shows which poles are not shared
    spread = random_effects(places, variance)[1]
    mean, _, deviation, weighted = random_effects(places, variance + broad)
    power = np.sqrt(np.sum(weighted**2, axis=0))
    weighted = weighted / np.maximum(power, TINY)
    m, count = fit.poles.size, len(own)
    poles = mean[:m] + 1j * mean[m:]
    away = (places[:, m:] - np.median(places[:, m:], axis=0)) / np.abs(poles)
    size = 1.4826 * float(np.median(np.abs(away))) * np.sqrt(count / (count - 1.0))
    off = np.median(away, axis=1)
    worst = int(np.argmax(np.abs(off)))
    odd = (worst, float(off[worst])) if abs(off[worst]) > CERTAIN * size else None
    return Disagreement(size, poles, spread, deviation, weighted.T @ weighted, odd)


def _variance(one: PoleFit) -> FloatArray:
    """Return the variances (2 m,) of the poles of a fit with its participation held fixed."""
    N = one.gradient()[0][: 2 * one.m, : 2 * one.m]
    return np.asarray(one.lines.inflation * np.diag(scaled_inverse(N)))


def _strayed(fit: PoleFit, own: list[PoleFit]) -> tuple[FloatArray, FloatArray]:
    """Return the squared distances (n, m) of separate poles that represent something else."""
    # first poles that are closer to another shared pole, then poles that are much broader than in
    # most outputs: where an output hardly sees a mode, its pole becomes a part of the smooth
    # remainder
    poles = np.array([one.poles for one in own])
    away = np.abs(poles[:, :, None] - fit.poles)
    other = np.argmin(away, axis=2) != np.arange(fit.m)
    usual = np.median(poles.real, axis=0) + 1j * np.median(poles.imag, axis=0)
    broad = -poles.real > SAME_RESONANCE * -usual.real
    return (
        np.where(other, np.einsum("okk->ok", away) ** 2, 0.0),
        np.where(broad, np.abs(poles - usual) ** 2, 0.0),
    )


def random_effects(
    places: FloatArray, variance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    r"""Return means over the first axis, sqrt(t), the means' deviations and weighted differences.

    Each of n values x has a separate variance v about a separate true value, and true values have
    the variance t about the wanted mean: with :math:`w = 1/(v + t)` it is
    :math:`\mu = \sum w x / \sum w`, of variance :math:`1/\sum w`. t is the one at which
    :math:`\sum w (x - \mu)^2` is the median of chi-square with n - 1 degrees of freedom
    ([PauleMandel1982]_ use its mean, which usually makes t too small); it is zero where the sum is
    smaller at zero. Where t is not zero it follows from :math:`(\sum w)^2/\sum w^2` outputs, as
    does the mean. Deviations are enlarged by Student's factor, so that an interval of 1.96
    deviations contains 95 %.
    """
    from scipy.special import chdtri, stdtrit

    def at(extra: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        weight: FloatArray = 1.0 / (variance + extra)
        mean: FloatArray = np.sum(weight * places, axis=0) / np.sum(weight, axis=0)
        root: FloatArray = np.sqrt(weight)
        return weight, mean, root * (places - mean)

    goal = float(chdtri(len(places) - 1.0, 0.5))
    low = np.zeros(places.shape[1])
    # sum (x - mean)^2 / t is below the goal there
    high = np.sum((places - places.mean(axis=0)) ** 2, axis=0) / goal
    for _ in range(MOST_STEPS):
        middle = (low + high) / 2
        above = np.sum(at(middle)[2] ** 2, axis=0) > goal
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    extra = np.where(np.sum(at(np.zeros_like(low))[2] ** 2, axis=0) > goal, high, 0.0)
    weight, mean, weighted = at(extra)
    total = np.sum(weight, axis=0)
    degrees = np.maximum(1.0, total**2 / np.sum(weight**2, axis=0) - 1.0)
    factor = np.where(extra > 0, stdtrit(degrees, 0.975) / 1.96, 1.0)
    return mean, np.sqrt(extra), factor / np.sqrt(total), weighted


def supported(
    lines: Lines, poles: ComplexArray, part: ComplexArray, first: PoleFit | None = None
) -> PoleFit:
    """Remove, one by one, poles that noise may explain; SolverError when no pole remains.

    `first` is the fit at these poles, if it exists already.
    """
    least = gain_due_of_pole(lines)
    fit = pivoted(lines, poles, part) if first is None else first
    kept, now = list(range(poles.size)), fit.cost
    while len(kept) > 1:
        rises = fit.rises(kept)
        weakest = int(np.argmin(rises))
        if rises[weakest] > least * max(1.0, now / lines.freedom(len(kept))):
            break
        kept.pop(weakest)
        now += float(rises[weakest])
    kept = [k for k in kept if len(kept) == 1 or _seen(lines, poles, part, kept, k)]
    if not kept:
        raise SolverError(
            f"no resonance between {lines.freq[0]:.4g} and {lines.freq[-1]:.4g} Hz exceeds the "
            "noise: the poles of the diagram may be due to chance. Move or widen the "
            "band, measure longer, or pick poles by hand with "
            "identification.stabilisation_diagram(frf).select(freq=[...])."
        )
    return fit if len(kept) == poles.size else pivoted(lines, poles[kept], part[:, kept])


def _seen(lines: Lines, poles: ComplexArray, part: ComplexArray, kept: list[int], k: int) -> bool:
    """Return whether a pole narrower than the lines are apart is seen at more than two of them."""
    if -poles[k].real > 2 * np.pi * lines.spacing:
        return True
    rest = [other for other in kept if other != k]
    less, more = (PoleFit(lines, poles[some], part[:, some]).model for some in (rest, kept))
    return corroborated(lines, less, more)


def corroborated(lines: Lines, less: ComplexArray, more: ComplexArray) -> bool:
    """Return whether lines other than the two with most gain confirm a pole."""
    # by a chi-square test of four degrees of freedom, the pole and its size: a disturbance with a
    # single frequency, or a variance that is too small there, changes other lines only by chance
    before, after = (
        np.sum(np.abs((lines.data - model) * lines.weight) ** 2, axis=(0, 1))
        for model in (less, more)
    )
    gain = before - after
    unit = max(1.0, float(np.sum(after)) / (2 * lines.data.size))
    return float(np.sum(np.sort(gain)[:-2])) > unit * gain_due(lines, 4, CHANCE)


def gain_due(lines: Lines, count: int, chance: float) -> float:
    """Return the decrease of the cost by noise for additional parameters: a chi-square quantile."""
    # correlated errors of neighbouring lines have `inflation` times the power of independent ones
    from scipy.special import chdtri

    return lines.inflation * float(chdtri(count, chance))


def gain_due_of_pole(lines: Lines) -> float:
    """Return the decrease of the cost that a pole anywhere in the band must reach."""
    # its pole, shape and participation are 2 (n_out + n_in) numbers. A superfluous pole costs
    # little; a missing pole biases its neighbours by up to the root of this
    n_out, n_in, n_freq = lines.data.shape
    return gain_due(lines, 2 * (n_out + n_in), CHANCE / n_freq)
