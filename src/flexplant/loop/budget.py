"""Error budgets: the variance of a signal in a closed loop by source, in closed form."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..arrays import FloatArray, divisor, instance, real_array
from ..certificates import Certificate, Verified
from ..errors import (
    AssumptionError,
    CertificateError,
    LabelError,
    ModelError,
    aligned,
    in_unit,
    require_known,
    short,
)
from ..lti.frequency_sweep import resonance_grid
from ..lti.lyapunov import controllability_factor, observability_factor
from ..lti.response_solvers import responder
from ..lti.statespace import StateSpace
from ..parallel import PIECE
from ..plant import AnyPlant, standard_plant
from ..plant.building import continuous_factor, white_names
from ..plant.partitioned import NOT_JUDGED
from ..store import Value
from ..tolerances import MOST_STEPS, ROOT, TYPED

#: name of the contribution of a set-point
RESIDUE = "set-point residue"


@dataclass(frozen=True, eq=False, repr=False)
class ErrorBudget(Value):
    """Contributions to the rms of one signal of a closed loop; prints as a table.

    The sources are independent, so that their variances add. `ClosedLoop.budget` makes this object.

    Parameters
    ----------
    channel, unit : str
        Name of the signal and its SI unit; the unit is empty if it is not known.
    names : sequence of str
        Names of the sources: the white disturbances, the sensor noises and the residue of a
        set-point. The residue is the error of a run without noise.
    variances : (n_source,) array [unit^2]
        Variance of each source.
    freq : (n_freq,) array [Hz]
        Frequencies from 0 to half the sampling rate. For a continuous loop the last one is
        infinite.
    cumulative : (n_source, n_freq) array [unit^2]
        Variance of each source below each frequency of `freq`.
    left_out : float [unit]
        RMS with the truncated modes included. It is NaN if these modes are not known, and infinite
        if the loop is unstable with them.
    certificate : Certificate
        Relative differences between the variance and the results of other methods for it.
    interval : str
        Text of the interval of the rms over the machines ``plant.machines``, or the reason why
        there is no such interval. These machines are random draws within the known uncertainty of
        the plant. The text is empty if no uncertainty is known.

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
    certificate: Certificate
    interval: str = ""

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
        """Fraction (n_source,) of each source in the variance."""
        total = float(self.variances.sum())
        return self.variances / total if total else self.variances

    def half_below(self, source: str) -> float:
        """Return the frequency [Hz] below which half of a source's variance lies."""
        half = 0.5 * self[source] ** 2
        row = self.cumulative[self.names.index(source)]
        known = np.isfinite(self.freq)
        return float(np.interp(half, row[known], self.freq[known]))

    def __repr__(self) -> str:
        size, unit = in_unit(self.rms, self.unit)
        head = f"rms of {self.channel}" + (f" [{unit}]" if unit else "")
        rows = []
        for i in np.argsort(-self.variances, kind="stable"):
            name, rms = self.names[i], np.sqrt(self.variances[i]) / size
            shown = f"{rms:.3f}" if rms >= 5e-4 or not rms else "< 0.001"
            rows.append((name, shown, f"{self.shares[i]:.1%}", f"{self.half_below(name):.4g} Hz"))
        rows.append(("total", f"{self.rms / size:.3f}", f"{1:.1%}", ""))
        lines = [f"{head} by source", *aligned(("", "rms", "share", "half below"), rows)]
        if np.isinf(self.left_out):
            lines.append("with the truncated modes the loop is unstable")
        elif np.isnan(self.left_out):
            lines.append(NOT_JUDGED)
        else:
            lines.append(f"with the truncated modes: {self.left_out / size:.5g}")
        lines += [f"total: {self.interval}"] if self.interval else []
        return "\n".join(lines)


def source_variances(
    monitored: StateSpace, row: int, noises: Sequence[Source]
) -> tuple[FloatArray, float]:
    """Return the variance of an output by source, and its largest relative difference."""
    variances = unverified_variances(monitored, row, noises)
    if not noises:
        return variances, 0.0
    driven = _driven(monitored, row, noises)
    other = float(np.sum((driven.C @ controllability_factor(driven)) ** 2) + np.sum(driven.D**2))
    total = float(variances.sum())
    difference = abs(other - total) / total if total else 0.0
    if not difference <= TYPED:
        raise CertificateError(
            f"the variance of {monitored.outputs[row]!r} is {total:.9g} by the observability "
            f"Gramian and {other:.9g} by the covariance of the states: a closed-loop pole is too "
            "close to the edge of stability for double precision. Check the least damped poles."
        )
    return variances, difference


def unverified_variances(monitored: StateSpace, row: int, noises: Sequence[Source]) -> FloatArray:
    """Return the variance of an output by source, by one route: for draws of a verified loop."""
    # trace(G' Q G) + D D' of the observability Gramian Q, by its factor: a slow pole among states
    # of different size costs the entries of a Gramian their digits, and not a sum of squares
    if not noises:
        return np.zeros(0)
    seen = observability_factor(_driven(monitored, row, noises)).T
    found = [np.sum((seen @ one.G) ** 2) + np.sum(one.D[row] ** 2) for one in noises]
    return np.array(found, dtype=np.float64)


def _driven(monitored: StateSpace, row: int, noises: Sequence[Source]) -> StateSpace:
    """Return the system from all noises, as white noise of unit variance, to one output."""
    G, D = (np.hstack(parts) for parts in zip(*((n.G, n.D[[row]]) for n in noises), strict=True))
    return StateSpace(monitored.A, G, monitored.C[[row]], D, monitored.dt)


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
    total = float(variances.sum())
    off = float(np.max(np.abs(cumulative[:, -1] - variances), initial=0.0))
    integral = off / total if total else 0.0
    if not integral <= TYPED:
        raise CertificateError(
            f"the integral of the spectrum of {channel!r} differs from its variance by "
            f"{integral:.1e} of it: a resonance of the closed loop is too narrow to be integrated. "
            "Check the least damped poles."
        )
    names = [one.name for one in noises]
    if residue is not None:
        part = _residue(residue, channel, start, monitored.dt)
        bins, density = periodogram(part, monitored.dt)
        below = np.append(0.0, np.cumsum(density) * bins[1])
        stairs = below[np.searchsorted(bins, freq, side="right")]
        names.append(RESIDUE)
        variances = np.append(variances, float(np.mean(part**2)))
        cumulative = np.vstack([cumulative, stairs])
    route = "the variance computed again, relative difference"
    certificate = Certificate(
        (
            Verified("by both Lyapunov equations", between, route),
            Verified("by the integral of the spectrum", integral, route, TYPED),
        )
    )
    unit = monitored.units.get(channel, "")
    return ErrorBudget(
        channel, unit, tuple(names), variances, freq, cumulative, left_out, certificate
    )


def _residue(residue: Any, channel: str, start: float, dt: float) -> FloatArray:
    """Return the samples of a noise-free run from a time on."""
    if not dt:
        raise ModelError(
            "the residue of a set-point comes from a sampled run, this loop is continuous: close "
            "it around plant.discretized(rate)."
        )
    if isinstance(residue, Mapping):
        require_known("channel", [channel], residue, "the run of the residue")
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


#: function that gives densities (n_source, n_freq) at frequencies [Hz]
Densities = Callable[[FloatArray], FloatArray]
#: number of edges over all frequencies for a picture; distances from resonances in half-widths
_STAIRS, _AROUND = 150, (0.0, 3.0, 20.0)


class Spectrum(NamedTuple):
    """A one-sided power spectral density.

    Parameters
    ----------
    freq : (n_freq,) array [Hz]
        Frequencies.
    psd : (n_freq,) array [unit^2/Hz]
        Power spectral density. Its integral over all frequencies is the mean square of the signal.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> flat = fx.loop.Spectrum(freq=np.array([0.0, 1.0]), psd=np.array([2.0, 2.0]))
    >>> float(np.trapezoid(flat.psd, flat.freq))  # the variance
    2.0
    """

    freq: FloatArray
    psd: FloatArray


def densities(monitored: StateSpace, row: int, noises: Sequence[Source]) -> Densities:
    """Return the function of frequency that gives each source's one-sided density in an output."""
    # 2 h |C (z I - A)^-1 G + D|^2, which includes aliasing; continuous 2 |C (s I - A)^-1 G + D|^2
    n = monitored.n_states
    none = np.zeros((n, 1))
    # from the output back to the states: one column for any number of noises
    dual = StateSpace(monitored.A.T, monitored.C[[row]].T, np.eye(n), none, monitored.dt)
    reach = responder(dual)
    factor = 2.0 * (monitored.dt or 1.0)
    G = np.hstack([none[:, :0], *(one.G for one in noises)])
    D = np.concatenate([none[:0, 0], *(one.D[row] for one in noises)])
    owners = np.repeat(np.eye(len(noises)), [one.G.shape[1] for one in noises], axis=0)

    def found(freq: FloatArray) -> FloatArray:
        out = np.empty((len(noises), freq.size))
        for start in range(0, freq.size, PIECE):
            part = slice(start, start + PIECE)
            # transposed, not conjugated: C (z I - A)^-1 of the same z
            back = reach(freq[part])[:, 0].T
            squares = (back.real @ G + D) ** 2 + (back.imag @ G) ** 2
            out[:, part] = (squares @ owners).T
        return factor * out

    return found


#: largest number of parts of an interval of the grid, on average: in more of them the difference of
#: two rules is the rounding of the responses, and the check of the sum decides
_PARTS = 16


def integrated(
    find: Densities, monitored: StateSpace, variances: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return edges [Hz] and the integrals (n_source, n_edge) of densities from 0 to them."""
    # by adaptive Gauss-Kronrod quadrature:
    # intervals are halved where 7 and 15 points differ; continuous: to infinity, t = f / (f + f_c)
    top = 0.5 / monitored.dt if monitored.dt else np.inf
    grid = resonance_grid(monitored.poles(), monitored.dt, points=_STAIRS, around=_AROUND)
    grid = np.concatenate([[0.0], grid[grid < top], [top]])
    centre = float(np.sqrt(grid[1] * grid[-2]))
    edges = grid if monitored.dt else np.append(grid[:-1] / (grid[:-1] + centre), 1.0)
    nodes, gauss, kronrod = _rule()

    def values(left: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        middle, half = 0.5 * (left + right), 0.5 * (right - left)
        freq = t = middle[:, None] + half[:, None] * nodes
        speed = half[:, None]
        if not monitored.dt:
            freq, speed = centre * t / (1.0 - t), speed * centre / (1.0 - t) ** 2
        density = find(freq.ravel()).reshape(-1, *t.shape) * speed
        fine = density @ kronrod
        return fine, np.abs(fine - density @ gauss)

    known = np.vstack([edges[:-1], edges[1:]])  # the ends of each interval
    fine, error = values(*known)
    size = divisor(variances)[:, None]
    for _ in range(MOST_STEPS):
        share = np.max(error / size, axis=0, initial=0.0)
        if share.sum() <= ROOT or known.shape[1] > _PARTS * edges.size:
            break
        bad = share > ROOT / share.size
        middle = known[:, bad].mean(axis=0)
        halves = np.hstack([[known[0, bad], middle], [middle, known[1, bad]]])
        more, missed = values(*halves)
        known, fine, error = (
            np.hstack([old[:, ~bad], new])
            for old, new in ((known, halves), (fine, more), (error, missed))
        )
    order = np.argsort(known[0])
    ends = np.append(known[0, order], known[1].max())
    if not monitored.dt:
        ends = np.append(centre * ends[:-1] / (1.0 - ends[:-1]), np.inf)
    total = np.cumsum(fine[:, order], axis=1)
    return ends, np.concatenate([np.zeros((total.shape[0], 1)), total], axis=1)


def _rule() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return nodes on (-1, 1) and the weights of Gauss (7 points) and Kronrod (15 points)."""
    # the nodes are those of QUADPACK [Piessens1983]_, Kronrod's weights follow from them
    half = [
        0.991455371120812639206854697526329,
        0.949107912342758524526189684047851,
        0.864864423359769072789712788640926,
        0.741531185599394439863864773280788,
        0.586087235467691130294144838258730,
        0.405845151377397166906606412076961,
        0.207784955007898467600689403773245,
    ]
    nodes: FloatArray = np.array([*(-x for x in half), 0.0, *half[::-1]])
    inner, weights = np.polynomial.legendre.leggauss(7)
    gauss: FloatArray = np.zeros(15)
    gauss[1::2] = weights[np.argsort(inner)]
    legendre = np.polynomial.legendre.legvander(nodes, 14).T
    moments = 2.0 * np.eye(15)[0]
    return nodes, gauss, np.asarray(np.linalg.solve(legendre, moments), dtype=np.float64)


def periodogram(signal: FloatArray, dt: float) -> Spectrum:
    """Return the spectrum of a record whose sum times its spacing is the mean square exactly."""
    n = signal.size
    size: FloatArray = np.abs(np.fft.rfft(signal)) ** 2 * (2.0 * dt / n)
    size[[0, -1] if n % 2 == 0 else [0]] *= 0.5
    return Spectrum(np.fft.rfftfreq(n, dt).astype(np.float64), size)


class Source(NamedTuple):
    """One white noise of unit intensity (continuous) or unit variance (sampled) in a closed loop.

    ``x+ = A x + G n``, ``output = C x + D n`` with G (n, r) and D (n_output, r).
    """

    name: str
    G: FloatArray
    D: FloatArray


def sources(plant: AnyPlant, monitored: StateSpace) -> list[Source]:
    """Return the separate white noises of a plant as they enter its closed loop."""
    white, sensors = white_names(plant)
    found = []
    for name, factor in _disturbance_factors(plant, white).items() if plant.dt else ():
        G = np.zeros((monitored.n_states, factor.shape[1]))
        G[: factor.shape[0]] = factor
        found.append(Source(name, G, np.zeros((len(monitored.outputs), G.shape[1]))))
    root = np.sqrt(0.5 / (plant.dt or 1.0))
    for name in sensors if plant.dt else (*white, *sensors):
        column = [monitored.inputs.index(name)]
        size = plant.asd[name] * root
        found.append(Source(name, monitored.B[:, column] * size, monitored.D[:, column] * size))
    return found


def _disturbance_factors(plant: AnyPlant, white: list[str]) -> dict[str, FloatArray]:
    """Return G of each white disturbance; a common G where they cannot be separated."""
    if not white:
        return {}
    total = continuous_factor(plant)
    if len(white) == 1:
        return {white[0]: total}
    if not plant.machine.continuous.dt:
        found = {}
        for name in white:  # the plant sampled with one of them
            asd = {n: level for n, level in plant.asd.items() if n == name or n in plant.held}
            alone = plant.machine.continuous.replace(asd=asd)
            found[name] = continuous_factor(alone.discretized(1.0 / plant.dt, delay=plant.delay))
        # a plant whose noise was changed after assembly keeps this noise
        if all(factor.shape[0] == total.shape[0] for factor in found.values()):
            own = np.sum(total**2, axis=1)
            added = np.sum([np.sum(factor**2, axis=1) for factor in found.values()], axis=0)
            if np.allclose(added, own, rtol=TYPED, atol=0.0):
                return found
    return {" + ".join(white): total}


def stationary_row(plant: AnyPlant, monitored: StateSpace, problem: object, channel: str) -> int:
    """Return the row of an output of a closed loop that has a stationary state."""
    standard_plant(plant)  # the z and w of a generalized plant are not physical signals
    given: object = channel
    instance(given, str, "a channel", "Pass its name: 'die:error'.", LabelError)
    row = int(monitored.output_index([channel])[0])
    check_stationary(problem, f"the rms of {channel!r}")
    return row


def check_stationary(problem: object, what: str) -> None:
    """Raise AssumptionError when a closed loop has no stationary state."""
    if problem is not None:
        raise AssumptionError(
            f"{what} needs a stable closed loop, this one is {getattr(problem, 'reason', problem)}:"
            " its noise grows without bound. Stabilise it first: see loop.is_stable."
        )


def check_direct(noises: Sequence[Source], row: int, channel: str) -> None:
    """Raise ModelError where continuous white noise passes to an output without rolling off."""
    for one in noises:
        if np.any(one.D[row]):
            raise ModelError(
                f"white noise {one.name!r} passes straight through to {channel!r}, so its variance "
                "in continuous time is infinite. Close the loop around plant.discretized(rate), or "
                "let the controller roll off."
            )
