"""Error budgets: the variance of a closed loop's signal, source by source, in closed form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import CertificateError, ModelError, require_known, unknown_label
from ..lti.lyapunov import solve_lyapunov, solve_stein
from ..lti.statespace import StateSpace
from ..values import FloatArray, Value, in_unit, real_array, short
from .noise_sources import Source
from .spectrum import densities, integrated, periodogram

#: relative: the variance by the two Lyapunov equations, and by the integral of the spectrum
AGREEMENT = 1e-6
#: what the part of a set-point is called
RESIDUE = "set-point residue"


@dataclass(frozen=True, eq=False, repr=False)
class ErrorBudget(Value):
    """Where the rms of one signal of a closed loop comes from; prints as a table.

    Independent sources: their variances add. Made by `ClosedLoop.budget`.

    Parameters
    ----------
    channel, unit : str
        The signal and its SI unit (empty: none known).
    names : sequence of str
        The sources: white disturbances, sensor noises, the residue of a set-point.
    variances : (n_source,) array [unit^2]
        Of each.
    freq : (n_freq,) array [Hz]
        From 0 to half the rate; to infinity for a continuous loop.
    cumulative : (n_source, n_freq) array [unit^2]
        The variance that each source has below a frequency.
    left_out : float [unit]
        The rms on the plant with the modes left out; NaN where these are not known, infinite where
        the loop is unstable with them.
    certificate : mapping {str: float}
        Relative differences of the variance computed in other ways.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> budget = fx.close_loop(plant, observer, servo).budget("die:x")
    >>> dict(zip(budget.names, budget.shares.round(2).tolist()))
    {'amp': 1.0, 'y1:noise': 0.0, 'y2:noise': 0.0}
    """

    channel: str
    unit: str
    names: tuple[str, ...]
    variances: FloatArray
    freq: FloatArray
    cumulative: FloatArray
    left_out: float
    certificate: Mapping[str, float]

    def __getitem__(self, source: str) -> float:
        """Return the rms that one source causes."""
        require_known("source", [source], self.names)
        return float(np.sqrt(self.variances[self.names.index(source)]))

    @property
    def rms(self) -> float:
        """The rms of all sources together."""
        return float(np.sqrt(self.variances.sum()))

    @cached_property
    def shares(self) -> FloatArray:
        """The part (n_source,) of each source in the variance."""
        total = float(self.variances.sum())
        return self.variances / total if total else self.variances

    def half_below(self, source: str) -> float:
        """Return the frequency [Hz] below which half of a source's variance lies.

        Raises
        ------
        LabelError
            When there is no such source.
        """
        half = 0.5 * self[source] ** 2
        row = self.cumulative[self.names.index(source)]
        known = np.isfinite(self.freq)
        return float(np.interp(half, row[known], self.freq[known]))

    def __repr__(self) -> str:
        size, unit = in_unit(self.rms, self.unit)
        factor = 1.0 / size
        order = np.argsort(-self.variances, kind="stable")
        width = max(5, *map(len, self.names)) + 2 if self.names else 7
        head = f"rms of {self.channel}" + (f" [{unit}]" if unit else "")
        lines = [f"{head} by source", f"{'':{width}s}{'rms':>12s}{'share':>9s}{'half below':>14s}"]
        for i in order:
            name, rms = self.names[i], factor * np.sqrt(self.variances[i])
            below = f"{self.half_below(name):.4g} Hz"
            lines.append(f"{name:{width}s}{rms:12.5g}{self.shares[i]:9.1%}{below:>14s}")
        lines.append(f"{'total':{width}s}{factor * self.rms:12.5g}{1:9.1%}")
        if np.isinf(self.left_out):
            lines.append("with the modes left out of the model the loop is unstable")
        elif np.isnan(self.left_out):
            lines.append("modes left out of the model are not in it: none are known")
        else:
            lines.append(f"with the modes left out of the model: {factor * self.left_out:.5g}")
        return "\n".join(lines)


def source_variances(
    monitored: StateSpace, row: int, noises: Sequence[Source]
) -> tuple[FloatArray, float]:
    """Return the variance of an output by source, and its largest relative difference.

    The observability Gramian Q of the output gives all sources at once, ``trace(G' Q G) + D D'``;
    the covariance of the states under all of them gives the sum once more.
    """
    c = monitored.C[[row]]
    solve = solve_stein if monitored.dt else solve_lyapunov
    Q = solve(monitored.A.T, c.T @ c)
    found = [float(np.sum(one.G * (Q @ one.G)) + np.sum(one.D[row] ** 2)) for one in noises]
    variances = np.maximum(np.array(found), 0.0)
    if not noises:
        return np.zeros(0), 0.0
    G = np.hstack([one.G for one in noises])
    direct = sum(float(np.sum(one.D[row] ** 2)) for one in noises)
    other = float((c @ solve(monitored.A, G @ G.T) @ c.T)[0, 0]) + direct
    total = float(variances.sum())
    difference = abs(other - total) / total if total else 0.0
    if not difference <= AGREEMENT:
        raise CertificateError(
            f"the variance of {monitored.outputs[row]!r} is {total:.9g} by the observability "
            f"Gramian and {other:.9g} by the covariance of the states: a closed-loop pole is too "
            "close to the edge of stability for double precision. Check the least damped poles."
        )
    return variances, difference


def error_budget(
    monitored: StateSpace,
    row: int,
    noises: Sequence[Source],
    *,
    residue: Any = None,
    start: float = 0.0,
    left_out: float = float("nan"),
) -> ErrorBudget:
    """Return the budget of an output of a stable closed loop; see `ClosedLoop.budget`."""
    channel = monitored.outputs[row]
    variances, between = source_variances(monitored, row, noises)
    freq, cumulative = integrated(densities(monitored, row, noises), monitored, variances)
    summed = cumulative[:, -1]
    total = float(variances.sum())
    integral = float(np.max(np.abs(summed - variances), initial=0.0)) / total if total else 0.0
    if not integral <= AGREEMENT:
        raise CertificateError(
            f"the integral of the spectrum of {channel!r} differs from its variance by "
            f"{integral:.1e} of it: a resonance of the closed loop is too narrow to be integrated. "
            "Check the least damped poles."
        )
    names = [one.name for one in noises]
    if residue is not None:
        part = _residue(residue, channel, start, monitored.dt)
        bins, density = periodogram(part, monitored.dt)
        below = np.concatenate([[0.0], np.cumsum(density) * (bins[1] if bins.size > 1 else 0.0)])
        stairs = below[np.searchsorted(bins, freq, side="right")]
        names.append(RESIDUE)
        variances = np.append(variances, float(np.mean(part**2)))
        cumulative = np.vstack([cumulative, stairs])
    return ErrorBudget(
        channel,
        monitored.units.get(channel, ""),
        tuple(names),
        variances,
        freq,
        cumulative,
        left_out,
        {"by both Lyapunov equations": between, "by the integral of the spectrum": integral},
    )


def _residue(residue: Any, channel: str, start: float, dt: float) -> FloatArray:
    """Return the samples of a noise-free run from a time on."""
    if not dt:
        raise ModelError(
            "the residue of a set-point comes from a sampled run, this loop is continuous: close "
            "it around plant.discretized(rate)."
        )
    if isinstance(residue, Mapping):
        if channel not in residue:
            raise unknown_label("channel", channel, list(residue), "the run of the residue")
        residue = residue[channel]
    elif isinstance(residue, str | bytes):
        raise ModelError(
            f"residue must be a run or its samples, got {short(residue)}. Pass "
            "simulate(loop, reference=move, noise=False, duration=...)."
        )
    samples = real_array(residue, "residue", (None,))
    late = samples[max(round(float(real_array(start, "start", ())) / dt), 0) :]
    if late.size < 2:
        raise ModelError(
            f"start={float(start):g} s leaves {late.size} samples of a residue of "
            f"{samples.size * dt:g} s. Choose an earlier start, or a longer run."
        )
    return late
