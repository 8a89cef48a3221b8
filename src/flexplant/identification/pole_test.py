"""Poles and terms that the data support: changes are proposed and accepted by one criterion."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray
from ..errors import SolverError, attempted, warn
from ..tolerances import CERTAIN, CHANCE, CLOSE, NULL, SAME
from .diagram import BROADEST
from .lines import UPPER, Lines, afforded_terms
from .model_error import (
    coherence,
    corroborated,
    gain_due,
    gain_due_of_pole,
    own_cost,
    supported,
    twin_poles,
)
from .refine import PoleFit, pivoted, refined

#: probability that noise is taken for outputs that disagree; real differences are far larger
ALARM = 1e-9


#: half the distance at which a pole is split, relative to its damping
APART = 0.5
#: probability that noise is taken for a residual term: a superfluous term costs almost nothing, a
#: missing one is a bias
FEW = 0.1
#: decrease of the cost that a weak pole must reach at another place
GAIN = 0.1
#: ratio to the required decrease of the cost below which a pole counts as weak
WEAK = 4.0
#: largest width of a new pole relative to all others
BROADER = 1.1
#: number of rivals that are refined, and fraction of the required gain that they need before
RIVALS, BEFORE = 3, 0.25


class Trial(NamedTuple):
    """A changed fit before refinement, its gain, and the required decrease of the cost."""

    lines: Lines
    poles: ComplexArray
    participation: ComplexArray
    gain: float
    least: float
    #: the fit before refinement, if it exists already
    first: PoleFit | None = None


#: rivals of each place of a possible change, the best ones first
Proposals: TypeAlias = Iterable[list[Trial]]
#: function that proposes one kind of change
Kind: TypeAlias = Callable[[PoleFit], Proposals]


def improved(
    fit: PoleFit, kinds: Sequence[tuple[Kind, int]], *, steps: int, rough: bool = False
) -> PoleFit:
    """Return the fit with the changes that lower its cost by more than noise does."""
    # each kind proposes changes, until none is accepted or the limit is reached. A change is
    # accepted if after refinement it lowers the cost as required, no pole becomes broader than a
    # mode, and several lines confirm an additional pole. `rough`: a fit whose residual is only
    # rounding is not changed further
    for propose, most in kinds:
        for _ in range(most):
            if rough and _is_exact(fit):
                return fit
            trials = (one for rivals in propose(fit) for one in rivals[:RIVALS])
            more = next(filter(None, (_accepted(fit, one, steps) for one in trials)), None)
            if more is None:
                break
            fit = more
    return fit


def _accepted(fit: PoleFit, trial: Trial, steps: int) -> PoleFit | None:
    """Return the refined fit of a trial where it is better by more than noise makes it."""
    more_poles = trial.poles.size > fit.m
    if trial.gain < min(trial.least, BEFORE * trial.least) or (
        more_poles and trial.poles.size > fit.lines.most
    ):
        return None
    below = fit.cost - trial.least
    more = None
    with attempted(f"a fit with {trial.poles.size} poles", SolverError):
        more = refined(*trial[:3], steps=steps, strict=more_poles, below=below, first=trial.first)
    if more is None:
        return None
    zeta, before = (-each.poles.real / np.abs(each.poles) for each in (more, fit))
    if more.cost >= below or zeta.max() >= max(BROADEST, BROADER * before.max(initial=0.0)):
        return None
    if more_poles and not (
        corroborated(fit.lines, fit.model, more.model)
        and newest_pole(fit, more) not in (twin_poles(more) or ())
        and shared(fit, more, trial.least)
    ):
        return None
    return more


def shared(fit: PoleFit, more: PoleFit, least: float) -> bool:
    """Return whether the outputs share what an additional pole explains, beyond other errors.

    The pole must lower the cost as required, or by the `coherence` of the residual near it; where
    outputs do not agree on the poles, it must also lower the cost of fits with separate poles.
    """
    lines, new = fit.lines, newest_pole(fit, more)
    least = max(least, gain_due_of_pole(lines) * coherence(more, more.poles[new]))
    if fit.cost - more.cost < least:
        return False
    if len(lines.parts) == 1:
        return True
    if fit.alone.keys() == set(range(len(lines.parts))) and not _disagrees(fit):
        return True
    if _proven(fit, more, least):
        return True
    return not _disagrees(fit) or own_cost(fit) - own_cost(more) > least


def _disagrees(fit: PoleFit) -> bool:
    """Return whether separate poles at each output lower the cost by more than noise does."""
    return fit.cost - own_cost(fit) >= gain_due_of_own_poles(fit)


def _proven(fit: PoleFit, more: PoleFit, least: float) -> bool:
    """Return whether a few outputs with separate poles already prove the additional pole."""
    # this holds for most poles and saves the fits of the other outputs, which take most of the
    # time. Outputs that gain most by the pole come first
    before, after = (
        [sum(float(fit.errors[o] @ fit.errors[o]) for o in rows) for rows in fit.lines.parts]
        for fit in (fit, more)
    )
    gain = 0.0
    for place in np.argsort(np.subtract(after, before), kind="stable").tolist():
        own = more.own_of(place)
        alone = fit.own_below(place, own.cost + least - gain)
        if alone is None:
            return True
        gain += alone.cost - own.cost
        if gain > least:
            return True
    return False


def newest_pole(fit: PoleFit, more: PoleFit) -> int:
    """Return the pole of a larger fit that is farthest from the previous poles."""
    away = [np.min(np.abs(pole - fit.poles), initial=np.inf) for pole in more.poles]
    return int(np.argmax(away))


def gain_due_of_own_poles(fit: PoleFit) -> float:
    """Return the decrease of the cost that separate poles at each output must reach."""
    count = 2 * fit.m * (len(fit.lines.parts) - 1)
    return max(1.0, fit.misfit) * gain_due(fit.lines, max(1, count), ALARM)


def unwindowed(fit: PoleFit) -> Proposals:
    """Propose lines without the effect of a window of segments."""
    # H2, Hv and bursts that end within a segment have no such effect; H1 with a locally white input
    # has
    if fit.lines.segment is not None:
        plain = replace(fit.lines, segment=None)
        yield [Trial(plain, fit.poles, fit.participation, np.inf, 0.0)]


def dropped(fit: PoleFit) -> Proposals:
    """Propose the poles that are modes and that noise alone does not explain."""
    light = np.flatnonzero(-fit.poles.real < BROADEST * np.abs(fit.poles))
    first = fit if light.size == fit.m else None
    less = supported(fit.lines, fit.poles[light], fit.participation[:, light], first)
    if less.m < fit.m:
        yield [Trial(fit.lines, less.poles, less.participation, np.inf, -np.inf)]


def merged(fit: PoleFit) -> Proposals:
    """Propose the fit without the weaker one of two poles of one resonance."""
    pair = twin_poles(fit)
    if pair is not None:
        yield [Trial(fit.lines, *fit.rest(pair[1]), np.inf, -np.inf)]


def _refit_terms(fit: PoleFit, lines: Lines, fewest: PoleFit, chance: float) -> Trial:
    """Return the fit of lines with another number of residual terms of modes above the band.

    `fewest` is the fit at the same poles with no more of these terms than either.
    """
    count = lines.upper - fit.lines.upper
    gain = fit.cost - fewest.cost + _gain_of_terms(fewest, lines)
    channels = lines.data.shape[0] * lines.data.shape[1]
    least = np.sign(count) * max(1.0, fit.misfit) * gain_due(lines, channels * abs(count), chance)
    first = fewest if lines is fewest.lines else None
    return Trial(lines, fit.poles, fit.participation, gain, least, first)


def _gain_of_terms(fit: PoleFit, more: Lines) -> float:
    """Return the decrease of the cost by the further residual terms of other lines."""
    # the terms S are orthogonal to the present ones; with the basis Q of the shapes and the error e
    # it is `b^T (I - M^T M)^-1 b` with `M = Q^T S` and `b = S^T e`
    gain, first = 0.0, fit.lines.lower + fit.lines.upper
    for Q, error, (smooth, _) in zip(fit.bases, fit.errors, more.smooth_bases, strict=True):
        new, n_in = smooth[:, :, first:], len(smooth)
        b = np.concatenate([S.T @ e for S, e in zip(new, error.reshape(n_in, -1), strict=True)])
        parts = zip(Q.reshape(n_in, -1, Q.shape[1]), new, strict=True)
        M = np.hstack([own.T @ S for own, S in parts])
        free = np.eye(b.size) - M.T @ M
        gain += float(b @ np.linalg.pinv(free, rcond=NULL, hermitian=True) @ b)
    return gain


def fewer_terms(fit: PoleFit) -> Proposals:
    """Propose the smallest number of residual terms that the data allow."""
    fewer = [fit.lines.with_upper(upper) for upper in UPPER if upper < fit.lines.upper]
    fewest = pivoted(fewer[0], fit.poles, fit.participation) if fewer else fit
    trials = (_refit_terms(fit, lines, fewest, FEW) for lines in fewer)
    yield [trial for trial in trials if trial.gain > trial.least]


def more_terms(fit: PoleFit) -> Proposals:
    """Propose more residual terms where the data require them, as many as the lines allow."""
    # folded modes are weak and broad: their remainder with few terms is not visible, but causes a
    # bias
    lines = fit.lines
    afforded = afforded_terms(lines.freq.size, lines.lower)
    most = lines.with_upper(max([lines.upper, *afforded]))
    wider = (most.with_upper(upper) for upper in afforded if upper > lines.upper)
    trials = (_refit_terms(fit, other, fit, CHANCE) for other in wider)
    yield [trial for trial in trials if trial.gain > trial.least]


def split_proposals(fit: PoleFit) -> Proposals:
    r"""Propose to split poles that are two poles.

    A pole of two modes, which are repeated or so close that one pole replaces both, requires
    residues of rank two (several inputs), or for a separate pole at each output (one input):

    .. math:: \frac{\psi l^T}{s-\lambda} \to \frac{\psi l^T + \psi' l_\perp^T}{s-\lambda}
        \quad\text{or}\quad \frac{\psi l^T}{s-\lambda-\delta} + \frac{\psi' l^T}{s-\lambda+\delta}
    """
    trials = (trial for k in range(fit.m) for trial in _pairs(fit, k))
    yield sorted(trials, key=lambda trial: -trial.gain)


def _more_poles(
    fit: PoleFit, poles: ComplexArray, part: ComplexArray, instead: int | None = None
) -> Trial:
    """Return the trial of a fit with an additional pole, or with two instead of one."""
    least = gain_due_of_pole(fit.lines) * max(1.0, fit.misfit)
    gain = fit.cost - fit.cost_with(poles, part, instead)
    now = (fit.poles, fit.participation) if instead is None else fit.rest(instead)
    all_poles, all_parts = np.append(now[0], poles), np.hstack([now[1], part])
    return Trial(fit.lines, all_poles, all_parts, gain, least)


def _pairs(fit: PoleFit, k: int) -> Iterator[Trial]:
    """Yield the trials with pole k twice: at other places, in other directions."""
    pole, own = fit.poles[[k]], fit.participation[:, [k]]
    delta = 1j * APART * np.abs(pole.real)
    yield _more_poles(fit, np.append(pole + delta, pole - delta), np.hstack([own, own]), k)
    others = np.asarray(la.null_space(own.conj().T), dtype=np.complex128)
    for other in others.T:
        # a small separate change, so that the fit can change both directions
        yield _more_poles(fit, pole, other[:, None] * la.norm(own) + 1e-3 * own)


def relocated(fit: PoleFit) -> Proposals:
    """Propose other places for weak poles, within seven half-widths."""
    # the likelihood of a hardly visible mode has several peaks; a fit reaches the closest one
    rises = fit.rises(list(range(fit.m)))
    for k, pole in enumerate(fit.poles):
        light = -pole.real <= 0.05 * abs(pole)
        if fit.m == 1 or not light or rises[k] > WEAK * gain_due_of_pole(fit.lines):
            continue
        trials = []
        for shift in np.arange(-7.0, 7.1, 0.7):
            poles = fit.poles.copy()
            poles[k] = pole + 1j * shift * abs(pole.real)
            cost = fit.cost_with(poles[[k]], fit.participation[:, [k]], instead=k)
            trials.append((cost, abs(shift), poles))
        best = sorted(trials, key=lambda trial: trial[0])[:RIVALS]
        # it must lower the cost after refinement; at its start it seldom does
        yield [
            Trial(fit.lines, poles, fit.participation, np.inf, GAIN)
            for _, shift, poles in best
            if shift >= 1.0
        ]


def missed_poles(fit: PoleFit) -> Proposals:
    """Propose a pole at the highest peaks of the residual; single lines are treated separately."""
    for peak in [peak for peak in unexplained(fit) if not peak.isolated][:TRIED]:
        yield [_more_poles(fit, *_pole_at(fit, peak))]


#: lengths [lines] of the examined groups of lines
STRETCHES = (3, 9, 27, 81)
#: number of highest groups of each length, and number of peaks at which a pole is tried
PLACES, TRIED = 4, 6
#: damping ratios tried for a missed pole, in addition to the width of its group
DAMPING = np.geomspace(0.0005, 0.03, 4)
#: for a mode: number of lines around a peak, and standard deviations of their sum without the two
#: highest
AROUND, NEARBY = 6, 2.5


@dataclass(frozen=True)
class Peak:
    """A group of unexplained lines: its centre [Hz], width [Hz] and height [sigma]."""

    freq: float
    width: float
    height: float
    isolated: bool = False  # one or two lines with only noise around them


def unexplained(fit: PoleFit) -> list[Peak]:
    """Return the groups of lines whose residual exceeds noise, each once, the highest first."""
    # over L lines of c channels the sum of `2 |e|^2/\sigma^2` is chi-square with 2 c L degrees of
    # freedom. Its centre and spread are also taken from all groups (median, median absolute
    # deviation): an estimated variance is wrong everywhere, a missed pole only in one place
    lines, model = fit.lines, fit.model
    if _is_exact(fit):
        return []
    error = np.abs(lines.data - model) ** 2 * lines.weight**2
    power = error.sum(axis=(0, 1))
    noiseless = not lines.known and _is_smooth(lines, model)
    measured = np.sum(np.abs(lines.data * lines.weight) ** 2, axis=(0, 1))
    step = float(lines.freq[1] - lines.freq[0])
    found: list[Peak] = []
    for length in STRETCHES:
        if 4 * length > power.size:
            break
        ones = np.ones(length)
        total = np.convolve(power, ones, mode="valid")
        middle = float(np.median(total))
        spread = 1.4826 * float(np.median(np.abs(total - middle)))
        free = lines.freedom(fit.m) / power.size * length
        spread = max(spread, middle / free * np.sqrt(2.0 * free * lines.inflation))
        # chi-square is skewed, its cube root is not (Wilson and Hilferty, 1931)
        height = 3.0 * middle / spread * (np.cbrt(total / middle) - 1.0)
        if noiseless:
            share = total / np.convolve(measured, ones, mode="valid")
            height = np.where(share > CLOSE**2, height, 0.0)
        for _ in range(PLACES):
            best = int(np.argmax(height))
            highest = float(height[best])
            if highest <= CERTAIN:
                break
            height[max(0, best - 2 * length) : best + 2 * length + 1] = 0.0
            seen = slice(best, best + length)
            freq, weight = lines.freq[seen], power[seen]
            alone = _isolated(power, best, length, middle, spread)
            if alone and not _surpassing(lines, model, seen):
                continue
            place = freq[np.argmax(weight)] if alone else freq @ weight / weight.sum()
            found.append(Peak(float(place), step * length, highest, alone))
    kept: list[Peak] = []
    for peak in sorted(found, key=lambda peak: -peak.height):
        if all(abs(peak.freq - other.freq) > max(peak.width, other.width) for other in kept):
            kept.append(peak)
    return kept


def _isolated(power: FloatArray, first: int, length: int, middle: float, spread: float) -> bool:
    """Return whether a peak consists of one or two lines with nothing around them."""
    # a disturbance, or a mode narrower than the distance of lines; other modes are visible at the
    # neighbours too
    aside = max(0, (AROUND - length + 1) // 2)
    near = np.sort(power[max(0, first - aside) : first + length + aside])[:-2]
    share = near.size / length
    rest, wide = middle * share, spread * np.sqrt(share)
    return bool(3.0 * rest / wide * (np.cbrt(np.sum(near) / rest) - 1.0) < NEARBY)


def _surpassing(lines: Lines, model: ComplexArray, where: slice) -> bool:
    """Whether the error of a response at single lines exceeds its estimated variance."""
    # with nu complex degrees of freedom `|e|^2/\sigma^2` exceeds x by chance with probability `(1 +
    # x/\nu)^{-\nu}` (F distribution of 2 and 2 nu degrees), which chi-square, with infinite nu,
    # understates: one in hundreds of variances is several times too small
    nu = lines.variance_freedom
    if nu is None:
        return True
    error = (lines.data[..., where] - model[..., where]) * lines.weight[..., where]
    x = float(np.max(np.abs(error))) ** 2 / 2.0
    return bool(-nu * np.log1p(x / nu) < np.log(CHANCE / lines.data.size))


def _is_exact(fit: PoleFit) -> bool:
    """Whether a fit leaves rounding only."""
    data = fit.lines.data
    return bool(la.norm(data - fit.model) < SAME * la.norm(data))


def _is_smooth(lines: Lines, model: ComplexArray) -> bool:
    """Whether neighbouring lines have similar errors nearly everywhere, unlike noise."""
    error = (lines.data - model) * lines.weight
    alike = np.sum(error[..., 1:] * error[..., :-1].conj(), axis=(0, 1)).real
    power = np.sum(np.abs(error) ** 2, axis=(0, 1))
    window = np.ones(9)
    near = np.convolve(alike, window, mode="valid")
    return bool(np.median(near / np.convolve(power[1:], window, mode="valid")) > 0.5)


def _pole_at(fit: PoleFit, peak: Peak) -> tuple[ComplexArray, ComplexArray]:
    """Return the pole and participation that explain a peak best."""
    # among frequencies across the peak and some damping ratios; the participation is the leading
    # right singular vector of the product of the pole with the residual
    lines = fit.lines
    error = (lines.data - fit.model) * lines.weight**2
    best, pole, part = -1.0, 0j, fit.participation[:, :1]
    # dampings that a resolved peak can have
    own = np.clip(peak.width / (2 * peak.freq) * np.array([0.3, 1.0]), 1e-5, 0.15)
    for zeta in np.unique([*DAMPING, *own.tolist()]):
        for shift in (-0.5, -0.2, 0.0, 0.2, 0.5):
            omega = 2 * np.pi * (peak.freq + shift * peak.width)
            place = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
            term = 1.0 / (2j * np.pi * lines.freq - place)
            gain = np.sum(lines.weight**2 * np.abs(term) ** 2, axis=2)
            sizes, right = la.svd(error @ term.conj() / np.sqrt(gain))[1:]
            if sizes[0] > best:
                best, pole, part = float(sizes[0]), place, right[0][:, None]
    return np.array([pole]), part.astype(np.complex128)


def warned(freq: FloatArray, left: list[Peak], apart: tuple[float, str, str] | None) -> None:
    """Warn of groups of lines without a pole, of single lines, or of outputs that disagree."""
    # for the last: their difference, their kind, and one that deviates far more than the others
    step = float(np.median(np.diff(freq)))
    # lines farther apart than the half-width of the broadest mode resolve no mode
    coarse = [peak.freq for peak in left if peak.freq * BROADEST < step]
    near = (
        f"The lines, {step:.3g} Hz apart, are too coarse for modes there: measure longer segments "
        f"and pass band=({min(coarse) / 2:.3g}, {2 * max(coarse):.3g}). "
        if coarse
        else ""
    )
    stretches = [peak for peak in left if not peak.isolated]
    if apart is not None:
        warn(
            f"{apart[1]} disagree on the frequencies by {100 * apart[0]:.2g} % (standard "
            "deviation), which explains most of the misfit: a moved sensor or hammer with mass, "
            "an amplitude or temperature that changed between measurements, or the delay of a "
            "held response (see hold= and delay=). "
            f"{apart[2]}Poles are means over the {apart[1]}, with deviations from how these "
            "differ."
        )
    elif stretches:
        warn(
            f"the residual exceeds the noise near {_peak_list(stretches)}: a mode may be missed "
            "or merged there, and the errors of its neighbours may exceed their stated "
            f"deviation. {near}Look at "
            "plot.identified and plot.stabilisation, choose poles by hand (start=), or narrow the "
            "band."
        )
    single = [peak for peak in left if peak.isolated]
    if single and apart is None:
        warn(
            "single lines contain more than noise, with only noise around them: "
            f"{_peak_list(single)}"
            ". No pole was fitted to them: a disturbance with a single frequency (mains, a pump) "
            "or a variance from few segments looks like this, and so does a mode narrower than "
            "the distance of lines. Measure with longer segments to distinguish them, or average "
            "more."
        )


def _peak_list(left: list[Peak]) -> str:
    return ", ".join(f"{peak.freq:.4g} Hz ({peak.height:.0f} sigma)" for peak in left[:4])
