"""Two modes that a fit took for one, and residual terms: added where the data require them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.linalg as la

from ..errors import SolverError
from ..values import ComplexArray
from .pole_test import CHANCE, corroborated, freedom, price
from .refine import Fit, Lines, projected_cost, refined

#: half the distance at which a pole is taken apart, in parts of its damping
APART = 0.5
#: numbers of residual terms tried where 9 leave more than noise
MORE = (25, 17, 13)
#: what a weak pole must lower the cost by elsewhere
GAIN = 0.1
#: a pole is weak whose cost is less than so many times the least that is required of one
WEAK = 4.0


def separated(lines: Lines, fit: Fit, *, steps: int) -> Fit:
    r"""Return the fit with those poles taken apart that are two.

    A pole of two modes, repeated or so close that one pole passes for both, requires residues
    of rank two (several inputs), or for a pole of its own at each output (one input):

    .. math:: \frac{\psi l^T}{s-\lambda} \to \frac{\psi l^T + \psi' l_\perp^T}{s-\lambda}
        \quad\text{or}\quad \frac{\psi l^T}{s-\lambda-\delta} + \frac{\psi' l^T}{s-\lambda+\delta}

    Both are tried at every pole; the fit that follows must lower chi-square by more than noise
    does at any of them once in a thousand times.
    """
    for _ in range(fit.poles.size):
        better = _apart(lines, fit, steps)
        if better is None:
            break
        fit = better
    return fit


def least_of(lines: Lines, places: int) -> float:
    """Return by how much a second pole must lower the cost at one of some places."""
    from scipy.special import chdtri

    n_out, n_in, _ = lines.data.shape
    return float(chdtri(2 * (n_out + n_in), CHANCE / places))


def _apart(lines: Lines, fit: Fit, steps: int) -> Fit | None:
    unit = max(1.0, fit.cost / freedom(lines, fit.poles.size))
    least = least_of(lines, fit.poles.size) * unit
    trials = []
    for k in range(fit.poles.size):
        for poles, part in _pairs(fit, k):
            trials.append((fit.cost - projected_cost(lines, poles, part), poles, part))
    trials.sort(key=lambda trial: -trial[0])
    for gain, poles, part in trials[:3]:
        if gain < least / 3:
            break
        try:
            more = refined(lines, poles, part, steps=steps, below=fit.cost - least)
        except SolverError:
            continue
        enough = fit.cost - more.cost > least and _narrow(more, fit)
        if enough and corroborated(lines, fit.model, more.model):
            return more
    return None


def _pairs(fit: Fit, k: int) -> list[tuple[ComplexArray, ComplexArray]]:
    """Return poles and participation with pole k twice: other directions, other places."""
    pole, own = fit.poles[k], fit.participation[:, [k]]
    delta = 1j * APART * abs(pole.real)
    moved = fit.poles.copy()
    moved[k] += delta
    pairs = [(np.append(moved, pole - delta), np.hstack([fit.participation, own]))]
    others = np.asarray(la.null_space(own.conj().T), dtype=np.complex128)
    for other in others.T:
        # a little of its own, so that the fit is free to turn both
        mixed = other[:, None] * la.norm(own) + 1e-3 * own
        pairs.append((np.append(fit.poles, pole), np.hstack([fit.participation, mixed])))
    return pairs


def _narrow(more: Fit, fit: Fit) -> bool:
    """Whether no pole became broader than any was: then it replaced something else."""
    zeta = [-f.poles.real / np.abs(f.poles) for f in (more, fit)]
    return bool(zeta[0].max() <= 1.5 * zeta[1].max())


def relocated(lines: Lines, fit: Fit, *, steps: int) -> Fit:
    """Return the fit with weak poles moved to where they lower the cost most.

    Noise gives the likelihood of a mode that is hardly seen several peaks; the fit climbs the one
    that it is started at. Its neighbourhood of seven half-widths is searched.
    """
    for k in range(fit.poles.size):
        pole = fit.poles[k]
        rest = np.delete(fit.poles, k)
        if not rest.size or -pole.real > 0.05 * abs(pole):
            continue
        without = projected_cost(lines, rest, np.delete(fit.participation, k, axis=1))
        if without - fit.cost > WEAK * price(lines):
            continue
        trials = []
        for shift in np.arange(-7.0, 7.1, 0.7):
            poles = fit.poles.copy()
            poles[k] = pole + 1j * shift * abs(pole.real)
            trials.append((projected_cost(lines, poles, fit.participation), poles))
        for _, poles in sorted(trials, key=lambda trial: trial[0])[:3]:
            if abs(poles[k] - pole) < 1.0 * abs(pole.real):
                continue
            try:
                more = refined(lines, poles, fit.participation, steps=steps, below=fit.cost - GAIN)
            except SolverError:
                continue
            if more.cost < fit.cost - GAIN and _narrow(more, fit):
                fit = more
    return fit


def backed(lines: Lines, fit: Fit, *, steps: int) -> tuple[Lines, Fit]:
    """Return the fit with more residual terms where the data require them.

    Sampling folds modes of more than half the rate into the band: each is weak and as broad as
    its frequency and damping were, many together are no noise. What a first few of these terms
    leave is too little to be seen and enough to bias, and in a wide band they cost next to
    nothing: so as many as the lines afford.
    """
    from scipy.special import chdtri

    channels = lines.data.shape[0] * lines.data.shape[1]
    unit = max(1.0, fit.cost / freedom(lines, fit.poles.size))
    for upper in MORE:
        if lines.freq.size < 8 * (upper + lines.lower) or upper <= lines.upper:
            continue
        more = replace(lines, upper=upper)
        gain = fit.cost - projected_cost(more, fit.poles, fit.participation)
        if gain > unit * chdtri(channels * (upper - lines.upper), CHANCE):
            return more, refined(more, fit.poles, fit.participation, steps=steps, strict=False)
    return lines, fit
