"""Guarantees for all machines of an uncertainty: `robust_stability`, `worst_case_gain`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np

from ...arrays import MOST_DRAWS, ComplexArray, FloatArray, between, generator, whole
from ...certificates import Certificate, Verified, stability
from ...errors import AssumptionError, CertificateError, FlexplantError, ModelError, counted
from ...loop import ClosedLoop, SpillOver, close_loop
from ...lti.frequency import frequency_response
from ...lti.frequency_sweep import largest_gains
from ...lti.norms import peak_gain
from ...lti.statespace import StateSpace
from ...parallel import Progress, one_thread
from ...plant import AnyPlant
from ...plant.uncertainty.uncertain_plants import UncertainPlant
from ...store import Value
from ...tolerances import CLOSE, FOUR_DIGITS, MOST_STEPS, NEGLIGIBLE, ROUNDING, TYPED
from ..hinf.tolerated_modes import mode_channels, tolerated, with_mode_channels
from .lower import Destabilising, crossing_multiple, destabilising
from .mu_bounds import INTERVALS, SOUGHT, Cover, Covered, sought
from .power_starts import power_iterations
from .uncertain_loops import UncertainLoop, uncertain_loop
from .uncertainty_blocks import Perturbation, block_places, matrix_of, perturbed

#: frequencies around the worst one at which gains are compared
_BAND = np.concatenate([[0.0], np.geomspace(1e-4, 0.3, 20), -np.geomspace(1e-4, 0.3, 20)])


@dataclass(frozen=True, eq=False, repr=False)
class RobustStability(Value):
    """Bounds on the uncertainty for which a loop stays stable, and the least stable machine.

    Parameters
    ----------
    upper : float
        Upper bound of the structured singular value mu. A Delta is an uncertainty that is scaled to
        size 1. Every machine whose Deltas are smaller than ``1 / upper`` is stable. If `upper` is
        below 1, all machines of the uncertainty are stable. If mu is below the `resolution` of the
        search, `upper` is that resolution.
    lower : float
        Lower bound of mu. A machine with Deltas of size ``1 / lower`` is not stable. The bound is 0
        if no such machine was found. It is also 0 if none was searched for, because all machines of
        the uncertainty are stable.
    freq : float [Hz]
        Frequency at which the upper bound is largest; NaN if it was not refined.
    values : mapping {str: float}
        Values of the Deltas of the machine that belongs to `lower`.
    machine : StandardPlant, optional
        The machine that belongs to `lower`, moved a little beyond its limit of stability. It can be
        simulated. None if no machine was found, or if it cannot exist because a stiffness or
        damping is not positive.
    frequencies, bounds : (k,) arrays [Hz, 1]
        Upper bounds at single frequencies. Only those near the largest one are tight.
    certificate : Certificate
        Checks of the result. It holds the stability of the least stable machine among those drawn
        at random, whose loops are computed exactly. For a sampled plant it holds the error of the
        sampled model with Deltas, compared with exactly sampled machines. It also holds the number
        of frequency intervals that were proven by Hamiltonian matrices. This number is 0 for more
        than 260 states, because samples of the frequency then replace this proof. Finally it holds
        the check with the truncated modes.
    left_out : SpillOver, optional
        Stability and margins of the nominal loop on the plant with the truncated modes, if these
        are known.
    """

    upper: float
    lower: float
    freq: float
    values: Mapping[str, float]
    machine: AnyPlant | None
    frequencies: FloatArray
    bounds: FloatArray
    certificate: Certificate
    left_out: SpillOver | None = None

    @property
    def is_robust(self) -> bool:
        """Whether every machine of the uncertainty is proven stable."""
        return self.upper < 1.0

    def __repr__(self) -> str:
        verdict = "every machine is stable" if self.is_robust else "not proven for every machine"
        if self.lower >= 1.0:
            verdict = "a machine of the uncertainty is unstable"
        bounds = f"{self.lower:.4g} <= mu <= {self.upper:.4g}"
        where = f", largest at {self.freq:.5g} Hz" if np.isfinite(self.freq) else ""
        lines = [f"<RobustStability: {verdict}, {bounds}{where}"]
        if self.lower:
            shown = f": {_largest_deltas(self.values)}" if self.values else ""
            lines.append(f"  unstable at {1 / self.lower:.4g} times the uncertainty{shown}")
        shown = ", ".join(f"{k} {v:.4g}" for k, v in self.certificate.items())
        lines.append(f"  verified: {shown}")
        if self.left_out is not None:
            lines.append(f"  with the truncated modes: {self.left_out.summary}")
        return "\n".join(lines) + ">"


def _largest_deltas(values: Mapping[str, float]) -> str:
    most = sorted(values.items(), key=lambda one: -abs(one[1]))[:4]
    return ", ".join(f"{name} {value:+.3g}" for name, value in most)


@one_thread()
def robust_stability(
    uncertain: UncertainPlant[Any],
    *blocks: Any,
    quick: bool = False,
    resolution: float = 0.25,
    machines: int = 20,
    rng: Any = 0,
    progress: bool | None = None,
) -> RobustStability:
    """Return bounds on the uncertainty for which a loop stays stable, by mu of all its Deltas.

    A Delta is an uncertainty that is scaled to size 1. A machine is the plant with one choice of
    the Deltas. The structured singular value mu is one over the size of the smallest Deltas that
    make the loop unstable. Deltas of frequencies, damping and parameters are real numbers. All
    neglected modes together are one full complex block. Unmodelled dynamics and the blocks of
    `uncertain_system` are real, complex or full, as they were defined. The bound holds at all
    frequencies, also between grid points. A sampled loop is examined with its sampling and delay.
    The result is checked on machines that are drawn from the uncertainty. The loop of each machine
    is computed exactly.

    Parameters
    ----------
    uncertain : UncertainPlant
        Uncertain plant from ``plant.uncertain(fit, fx.plant.Neglected())`` or `uncertain_system(M,
        blocks)`.
    *blocks : StateSpace, or values with a `system`
        Controller, as for `close_loop`.
    quick : bool
        Whether to compute a simpler bound first; only used if all Deltas are frequencies. This
        bound uses one channel for each mode, is valid to first order in the changes, and is
        computed on a frequency grid through the resonances. If it is below 1, it is the result.
        Otherwise the full search follows. For twenty modes the simpler bound takes less than a
        second. The full search takes as long if mu is below `resolution`, otherwise ten seconds or
        more.
    resolution : float
        Smallest mu that is computed to an accuracy of 0.5 %. If mu is smaller, the search ends and
        `upper` is this number. For example, an `upper` of 0.25 proves that all machines of four
        times the uncertainty are stable. At 0.9 the search only decides whether the loop is robust,
        and takes less time.
    machines : int
        Number of machines drawn. Each Delta of a machine is at an end of its interval.
    rng : int, SeedSequence, Generator or None
        Random generator of the machines and of the search for the least stable one, or its seed.
    progress : bool, optional
        Whether to show a progress bar. By default (None) it is shown on a terminal or in a
        notebook, for work of more than two seconds.

    Returns
    -------
    RobustStability
        The bounds `lower` and `upper` of mu. `is_robust` is true if `upper` is below 1: all
        machines of the uncertainty are then stable.

    Raises
    ------
    AssumptionError
        When the nominal loop is not stable.
    CertificateError
        When a machine is unstable although stability was proven. Also, for a sampled plant, when
        its matrices do not depend linearly enough on the Deltas.
    SolverError
        When the proven intervals do not cover all frequencies.

    References
    ----------
    [ZhouDoyleGlover1996]_, chapter 11.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses(rate=None)
    >>> lead = -1e3 * fx.lti.tf([0.05, 1.0], [0.002, 1.0]).replace(inputs=["y1"], outputs=["u1"])
    >>> uncertain = plant.uncertain(frequency=0.01)
    >>> fx.synthesis.robust_stability(uncertain, lead, machines=3).is_robust
    True
    """
    count = whole(machines, "machines", minimum=0, maximum=MOST_DRAWS)
    hint = "A mu between 1 and it would not be decided. Pass 0.25, or less for a sharper bound."
    least = between(resolution, "resolution", 0.0, 1.0, hint)
    chance = generator(rng)
    if quick:
        first = _quick(uncertain, blocks, least, count, chance)
        if first is not None:
            return first
    loop = uncertain_loop(uncertain, blocks)
    with Progress(None, INTERVALS, progress=progress):
        found = Cover(loop.system, loop.blocks, heights=loop.heights, least=least**2).run()
    upper = float(np.sqrt(found.level))
    # below 1 the upper bound is the answer: the worst machine lies outside of the uncertainty
    worst = None if upper < 1.0 else _worst(loop, found, upper, chance)
    values, machine, lower = _worst_machine(loop, worst)
    names = [name for name, _ in loop.channels.deltas]
    # for systems of many states, samples between the frequencies replace the Hamiltonians
    proven = float(found.intervals * found.by_hamiltonian)
    others = [Verified("intervals by Hamiltonians", proven, "eigenvalues of Hamiltonian matrices")]
    if loop.dt:
        route = "sampled channels against sampled machines"
        others.append(Verified("distance of channels", loop.channels.distance, route))
    return RobustStability(
        upper,
        min(lower, upper),
        float(loop.freq(found.omega)) if upper > least else float("nan"),
        values,
        machine,
        loop.freq(found.frequencies),
        np.sqrt(np.maximum(found.bounds, 0.0)),
        *_tried_on(uncertain, loop.loop, names, upper, count, chance, others),
    )


def _worst(
    loop: UncertainLoop, found: Covered, upper: float, rng: np.random.Generator
) -> Destabilising | None:
    """Return the smallest perturbation that destabilises, as far as it was found."""
    omegas = sought(loop.system, found)
    if loop.neglected is None:
        return destabilising(loop.system, loop.blocks, omegas, upper, rng)
    where, best = block_places(loop.blocks), None
    for omega in omegas:
        gain = loop.system.evaluated(1j * omega) * loop.heights(omega, omega)
        for start in power_iterations(gain, where, rng, omega):
            one = crossing_multiple(gain, where, start)
            if one is not None and (best is None or one[0] < best.size):
                best = Destabilising(one[0], one[1], omega)
    return best


def _worst_machine(
    loop: UncertainLoop, worst: Destabilising | None
) -> tuple[dict[str, float], AnyPlant | None, float]:
    """Return the Deltas of the worst machine, that machine and one over its size."""
    # only what is not stable when closed exactly counts
    if worst is None:
        return {}, None, 0.0
    values: dict[str, float] = {}
    for beyond in (TYPED, NEGLIGIBLE, 10 * NEGLIGIBLE, 50 * NEGLIGIBLE):
        size = worst.size * (1.0 + beyond)
        values = loop.deltas(worst.found, size)
        try:
            made = loop.machine(worst.found, size)
        except FlexplantError:  # no stiffness left, say: it can only be computed
            return values, None, 1.0 / worst.size
        if not loop.loop.around(made).is_stable:
            return values, made, 1.0 / size
    return values, None, 0.0


def _quick(
    uncertain: UncertainPlant[Any],
    blocks: tuple[Any, ...],
    least: float,
    count: int,
    rng: np.random.Generator,
) -> RobustStability | None:
    """Return the result with one channel for each mode if it proves stability, otherwise None."""
    if not uncertain.is_of_frequencies:
        return None
    loop = close_loop(uncertain.plant, *blocks)
    if loop.obstacle is not None:
        return None  # the whole search says what is wrong
    channels = mode_channels(uncertain.plant, uncertain)
    opened = with_mode_channels(uncertain.plant, channels)
    controller = loop.controller.select(outputs=loop.driven)
    upper = tolerated(channels, opened, controller)
    if not upper < 1.0:
        return None
    # the grid goes through the places of the modes at Deltas of a size, not beyond
    size = 1.0 / max(upper, least)
    upper = max(1.0 / size, tolerated(channels, opened, controller, size) / size)
    others = [Verified("modes, each by one channel", float(len(channels)), "a grid over frequency")]
    none = np.zeros(0)
    names = [delta.name for delta in uncertain.deltas]
    tried = _tried_on(uncertain, loop, names, upper, count, rng, others)
    return RobustStability(upper, 0.0, float("nan"), {}, None, none, none, *tried)


def _tried_on(
    uncertain: UncertainPlant[Any],
    nominal: ClosedLoop,
    names: Sequence[str],
    upper: float,
    count: int,
    rng: np.random.Generator,
    others: Sequence[Verified],
) -> tuple[Certificate, SpillOver | None]:
    """Return how stable machines at corners are, each closed exactly, and the truncated modes."""
    size, worst, checks = min(1.0, 0.999 / upper), -np.inf, [*others]
    for _ in range(count):
        ends = (size * rng.choice([-1.0, 1.0], len(names))).tolist()
        values = dict(zip(names, ends, strict=True)) | uncertain.drawn_blocks(rng, size)
        loop = nominal.around(uncertain.lft(values))
        worst = max(worst, stability(loop.poles(), loop.plant.dt))
    edge = 1.0 if nominal.plant.dt else 0.0
    if not worst < edge:
        raise CertificateError(
            f"a machine with Deltas of {size:.3g} is unstable ({worst:.9g}), but mu <= "
            f"{upper:.4g} was found: the loop is too badly conditioned. Report it."
        )
    if count:
        kind = "largest spectral radius" if nominal.plant.dt else "largest real part"
        route = "machines at corners, each closed exactly"
        checks.insert(0, Verified(f"{kind} of {counted(count, 'machine')}", worst, route, edge))
    left_out = nominal.left_out
    certificate = Certificate(tuple(checks))
    return certificate if left_out is None else certificate | left_out.certificate, left_out


@dataclass(frozen=True, eq=False, repr=False)
class WorstCaseGain(Value):
    """Bounds on the largest gain from w to z over all machines of an uncertainty.

    Parameters
    ----------
    upper : float
        Upper bound. No machine of the uncertainty has a larger gain at any frequency.
    lower : float
        Lower bound. It is the gain of `machine`, computed from its closed loop.
    nominal : float
        Gain without uncertainty.
    freq : float [Hz]
        Frequency at which `machine` has this gain.
    values : mapping {str: float}
        Values of the Deltas of `machine`.
    machine : StandardPlant
        Machine with the gain `lower`. It can be simulated.
    frequencies, bounds : (k,) arrays [Hz, gain]
        Upper bounds at single frequencies.
    """

    upper: float
    lower: float
    nominal: float
    freq: float
    values: Mapping[str, float]
    machine: AnyPlant
    frequencies: FloatArray
    bounds: FloatArray

    def __repr__(self) -> str:
        return (
            f"<WorstCaseGain: {self.lower:.4g} to {self.upper:.4g}, nominal {self.nominal:.4g}\n"
            f"  reached at {self.freq:.5g} Hz by {_largest_deltas(self.values)}>"
        )


@one_thread()
def worst_case_gain(
    uncertain: UncertainPlant[Any],
    *blocks: Any,
    w: Any,
    z: Any,
    rng: Any = 0,
    progress: bool | None = None,
) -> WorstCaseGain:
    """Return bounds on the largest gain from w to z over an uncertainty, with the machine found.

    A machine is the plant with one choice of the Deltas of the uncertainty, which are scaled to
    ``|Delta| <= 1``. The upper bound is a skewed structured singular value. The gain is represented
    by one more block from z to w. Unlike for mu, only the size of this block is varied, and the
    size of the Deltas stays fixed. The bound is computed on frequency intervals that cover all
    frequencies. The lower bound is the gain of a machine that a search found. The loop of this
    machine is computed exactly, with the sampling and delay of the plant.

    Parameters
    ----------
    uncertain, *blocks : as for `robust_stability`
    w, z : sequence of str, or mapping {name: weight}
        Channels between which the gain is computed, with weights if needed. A weight is a number or
        a system with one input and one output.
    rng : int, SeedSequence, Generator or None
        Random generator of the search, or its seed.
    progress : as for `robust_stability`, optional

    Returns
    -------
    WorstCaseGain
        The bounds `lower` and `upper` of the largest gain, the gain `nominal` without uncertainty,
        and the `machine` with the gain `lower`.

    Raises
    ------
    AssumptionError
        When the nominal loop is not stable, or stability of all machines is not proven.
    CertificateError
        When the machine found has a larger gain than the upper bound allows.
    ModelError, LabelError, SolverError
        As for `robust_stability`; also when channels are missing or unknown.

    References
    ----------
    [FanTits1992]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses(rate=None)
    >>> lead = -1e3 * fx.lti.tf([0.05, 1.0], [0.002, 1.0]).replace(inputs=["y1"], outputs=["u1"])
    >>> uncertain = plant.uncertain(frequency=0.01)
    >>> found = fx.synthesis.worst_case_gain(uncertain, lead, w=["amp"], z=["die:x"])
    >>> found.nominal <= found.lower <= found.upper
    True
    """
    chance = generator(rng)
    if not w or not z:
        raise ModelError(
            "a gain is from some w to some z: name them, w=['die:ref'], z=['die:error']."
        )
    loop = uncertain_loop(uncertain, blocks, w=w, z=z)
    listed = [*loop.blocks, loop.performance]
    nominal, _ = peak_gain(loop.performed(uncertain.plant))
    # in units of its size: a level of 1e-18, from 1e-9 m/N, is not resolved next to Deltas of size
    # 1
    size, g = nominal or 1.0, loop.system
    unit = np.ones((len(g.outputs), 1))
    unit[-loop.performance.z :] = 1.0 / size
    M = g.replace(C=unit * g.C, D=unit * g.D)
    leveled = [*[False] * len(loop.blocks), True]
    # no level is below the nominal gain, which is one in these units
    least = 1.0 if nominal else ROUNDING
    with Progress(None, INTERVALS, progress=progress):
        found = Cover(M, listed, leveled, loop.heights, least).run()
    if not np.isfinite(found.level):
        raise AssumptionError(
            "machines of the uncertainty may be unstable (at "
            f"{loop.freq(found.frequencies[np.argmax(found.bounds)]):.5g} Hz), so that the "
            "largest gain is infinite. See synthesis.robust_stability(uncertain, ...): lower "
            "the bandwidth, notch the mode there, or measure it better."
        )
    upper = size * float(np.sqrt(found.level))
    reached = [_machine_gain(loop, one) for one in _candidates(loop, M, listed, found, chance)]
    lower, freq, values, made = max(reached, key=itemgetter(0))
    if not lower <= upper * (1.0 + CLOSE):
        raise CertificateError(
            f"a machine of the uncertainty has the gain {lower:.6g}, {upper:.6g} was proven as "
            "largest: the loop is too badly conditioned. Report it."
        )
    return WorstCaseGain(
        max(upper, lower),
        lower,
        nominal,
        freq,
        values,
        made,
        loop.freq(found.frequencies),
        size * np.sqrt(np.maximum(found.bounds, 0.0)),
    )


def _machine_gain(
    loop: UncertainLoop, one: Perturbation
) -> tuple[float, float, dict[str, float], AnyPlant]:
    """Return the gain of the machine of a perturbation, where it is, its Deltas, and itself."""
    values, made = loop.deltas(one, 1.0), loop.machine(one, 1.0)
    closed = loop.performed(made)
    if loop.neglected is None:
        return *peak_gain(closed), values, made
    # its weights have many states: the gain at frequencies around the worst
    freqs = np.unique(loop.freq(np.unique(np.abs(one.omega * (1.0 + _BAND)))))
    gains = largest_gains(frequency_response(closed, freqs).data)
    where = int(np.argmax(gains))
    return float(gains[where]), float(freqs[where]), values, made


def _candidates(
    loop: UncertainLoop, M: StateSpace, listed: list[Any], found: Covered, rng: np.random.Generator
) -> list[Perturbation]:
    """Return perturbations of size one that are bad at some frequency, the worst first."""
    where = block_places(listed)
    chosen = [float(found.omega)]
    for omega in found.frequencies[np.argsort(-found.bounds)]:
        if len(chosen) < SOUGHT and all(abs(omega - one) > CLOSE * one for one in chosen):
            chosen.append(float(omega))
    results: list[tuple[float, Perturbation]] = []
    for omega in chosen:
        band = np.abs(omega * (1.0 + _BAND))
        tall = loop.heights(omega, omega)
        gains = np.array([M.evaluated(1j * one) * tall for one in band])
        skewed = gains[0].copy()
        skewed[where[-1].z] /= np.sqrt(found.level)
        starts = power_iterations(skewed, where, rng, omega)
        results += [_corner_gain(gains, where, one) for one in starts]
    return [one for _, one in sorted(results, key=lambda pair: -pair[0])[:2]]


def _corner_gain(
    gains: ComplexArray, where: list[Any], one: Perturbation
) -> tuple[float, Perturbation]:
    """Return the largest gain in a band, real Deltas moved one after the other to an end or 0."""
    one = one._replace(vectors=one.vectors[:-1])
    best = _perturbed_gain(gains, where, one)
    for _ in range(MOST_STEPS):
        before = best
        for i, number in enumerate(one.scalars):
            for value in (-1.0, 1.0, 0.0):
                if value == number:
                    continue
                scalars = (*one.scalars[:i], complex(value), *one.scalars[i + 1 :])
                moved = one._replace(scalars=scalars)
                gain = _perturbed_gain(gains, where, moved)
                if gain > best:
                    best, one = gain, moved
        if best <= before * (1.0 + FOUR_DIGITS):
            break
    return best, one


def _perturbed_gain(gains: ComplexArray, where: list[Any], one: Perturbation) -> float:
    """Return the largest gain over a band of the loop with a perturbation."""
    closed = perturbed(gains, matrix_of(one, where[:-1]))
    return float(np.linalg.norm(closed, 2, axis=(1, 2)).max())
