"""What a linear machine does not explain: outputs that disagree, misfit that is smooth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from ..checks import ComplexArray, FloatArray
from ..tolerances import TINY
from .refine import Fit, Lines

#: MAC from which two shapes are one: they differ by less than what a neighbour's tail makes
ALIKE = 0.9
#: half-widths (mean of two poles) within which poles of different shapes may be one resonance
WITHIN = 1.5
#: part of a misfit that is most of it: a missed mode leaves about half, a shift less than 1e-3
MOSTLY = 0.9
#: misfit near a pole, with its correlation over lines, up to which it is noise
NOISE = 1.5
#: standard deviations by which chi-square may exceed its degrees of freedom by chance
LIMIT = 3.0
#: lines, or half-widths, beside a pole over which misfit is compared
NEAR, WIDE = 20.0, 3.0


def own_cost(fit: Fit) -> float:
    """Return the cost of fits of each output alone, with poles of its own."""
    return sum(one.cost for one in fit.own)


def outputs_disagree(fit: Fit) -> bool:
    """Return whether poles of each output's own leave noise alone, shared ones far more.

    No pole that outputs share explains what is left then, and where the shared poles are is known
    by how the outputs differ, not by the misfit that a refinement lowers.
    """
    lines, (n_out, m) = fit.lines, fit.shapes.shape
    count = n_out * lines.data.shape[1] * (lines.lower + lines.upper) + 4 * m * n_out
    free = max(1.0, 2 * lines.data.size - lines.inflation * count)
    if n_out == 1 or fit.cost < NOISE * free:
        return False
    alone = own_cost(fit)
    return alone < free + LIMIT * np.sqrt(2 * free * lines.inflation) and alone * NOISE < fit.cost


def coherence(lines: Lines, model: ComplexArray, pole: complex) -> float:
    r"""Return by how much more a misfit near a pole lowers the cost by chance than noise does.

    The mean of :math:`|e|^2/\sigma^2` there, times :math:`1 + 2 \sum_k \rho_k` of the correlation
    of e over neighbouring lines up to the first that is noise: misfit that is smooth over so many
    lines counts as one error, not as many.
    """
    spacing = 2 * np.pi * float(np.median(np.diff(lines.freq)))
    reach = max(NEAR * spacing, WIDE * abs(pole.real))
    near = np.abs(2 * np.pi * lines.freq - pole.imag) <= reach
    error = (lines.data - model)[..., near] * lines.weight[..., near]
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


def strength(fit: Fit) -> FloatArray:
    """Return the height of each resonance, weighted as the lines are."""
    power = np.sum(fit.lines.weight**2, axis=(1, 2)) / fit.lines.freq.size
    height = np.sqrt(power @ np.abs(fit.shapes) ** 2) / -fit.poles.real
    return np.asarray(height * np.linalg.norm(fit.participation, axis=0))


def twin(fit: Fit) -> tuple[int, int] | None:
    """Return two poles within a bandwidth with the same shape and participation, the weak one last.

    One resonance that is no straight circle (leakage, an amplitude that matters) becomes such a
    pair. With one input any two shapes pass for it: two modes are proven there by several inputs,
    or by leaving nothing but noise of a known variance.
    """
    height = strength(fit)
    for k in np.argsort(height):
        for j in np.argsort(-height):
            if height[j] <= height[k]:
                continue
            apart, widths = abs(fit.poles[j].imag - fit.poles[k].imag), -fit.poles.real[[j, k]]
            same = min(mac(fit.shapes, j, k), mac(fit.participation, j, k)) > ALIKE
            if apart > (widths.sum() if same else WITHIN * np.sqrt(widths.prod())):
                continue
            single = fit.participation.shape[0] == 1
            if (single and (same or not fit.lines.known)) or (
                (same or single) and coherence(fit.lines, fit.model, fit.poles[k]) > NOISE
            ):
                return int(j), int(k)
    return None


def mac(vectors: ComplexArray, j: int, k: int) -> float:
    """Return the MAC of two columns."""
    a, b = vectors[:, j], vectors[:, k]
    return float(
        abs(np.vdot(a, b)) ** 2 / max(TINY, float(np.vdot(a, a).real * np.vdot(b, b).real))
    )


@dataclass(frozen=True, eq=False)
class Disagreement:
    """By how much outputs differ in the frequencies (relative), and what leaving each out shows.

    `covariance` (2 m, 2 m) is that of [Re lambda; Im lambda].
    """

    size: float
    covariance: FloatArray


def disagreement(lines: Lines, fit: Fit, least: float, excess: float) -> Disagreement | None:
    r"""Return by how much the outputs of a fit differ, and the jackknife covariance of its poles.

    Without output o the optimum moves by :math:`d_o = -(N - N_o)^{-1} g_o` to first order, with
    the normal equations :math:`N = \sum_o N_o` and the gradients of the poles, whose sum is zero
    ([EfronTibshirani1993]_, ch. 11). The covariance :math:`(n-1)/n \sum_o d_o d_o^T` needs nothing
    of the noise; it is made larger by Student's factor of n - 1 degrees, so that 1.96 deviations
    hold 95 %.
    None where poles of their own lower the cost by less than `least`, or do not explain nearly all
    of the cost's `excess` over that of noise: something else is wrong then.
    """
    from scipy.special import stdtrit

    if len(fit.shapes) == 1:
        return None
    own = fit.own
    if fit.cost - sum(one.cost for one in own) < max(least, MOSTLY * excess):
        return None
    count, m = len(own), fit.poles.size
    places = np.array([one.poles for one in own])
    away = (places - np.median(places.imag, axis=0) * 1j).imag / np.abs(fit.poles)
    size = 1.4826 * float(np.median(np.abs(away))) * np.sqrt(count / (count - 1.0))
    parts = [
        Fit(lines.of_output(o), fit.poles, fit.participation, fit.pivots).gradient()
        for o in range(count)
    ]
    kept = slice(0, 2 * m)
    total = sum(N[kept, kept] for N, _ in parts)
    moved = np.array([-la.lstsq(total - N[kept, kept], g[kept])[0] for N, g in parts])
    moved = moved - moved.mean(axis=0)
    factor = float(stdtrit(count - 1.0, 0.975)) / 1.96
    # shifts of a half-width and more are beyond the first order: what the middle of the outputs'
    # own poles is off by counts too
    middle = np.median(places.real, axis=0) + 1j * np.median(places.imag, axis=0) - fit.poles
    off = np.concatenate([middle.real, middle.imag])
    covariance = factor**2 * (count - 1.0) / count * moved.T @ moved + np.outer(off, off)
    return Disagreement(size, covariance)
