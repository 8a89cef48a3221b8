"""design_servo: a law for each axis that the actuators move, on the estimated point of interest."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from ...arrays import FloatArray, below_half_rate, between, positive, real_array
from ...certificates import Certificate, Verified, stability_check
from ...errors import ModelError, SolverError, warn
from ...loop import ClosedLoop
from ...loop.blocks import drives, driving_blocks, observer_system, seeing
from ...loop.other_machines import growing_modes, modes_in_words, warn_of_critical
from ...lti.frequency_sweep import resonance_grid
from ...lti.interconnection import loop_poles, series, side_by_side
from ...lti.statespace import StateSpace
from ...parallel import one_thread
from ...plant import StandardPlant, standard_plant
from ...plant.axes import DrivenAxes, Reading, driven_axes, elastic, gains_at, reading_of
from ...plant.partitioned import require_sampled
from ...plant.uncertainty.uncertain_plants import UncertainPlant
from ..controller import CLOSE, Controller, with_checks
from .law import Notch
from .servo_loops import (
    LEADS,
    POWERS,
    TARGET,
    WITHIN,
    Axis,
    ServoLaw,
    ServoLoop,
    combinations,
    highest_bandwidth,
    known_axis,
    lines_of,
    servo_loop,
    verified_suppression,
)

#: what to do where a bandwidth does not hold: that search takes seconds
_ADVICE = "servo_bandwidth finds the largest bandwidth that keeps 6 dB."


@one_thread()
def design_servo(
    plant: StandardPlant | UncertainPlant[Any],
    *,
    bandwidth: float | Mapping[str, float],
    poi: str | None = None,
    axes: Sequence[str] | None = None,
    rolloff: float | None = None,
    integrator: float | None = None,
    notches: Sequence[float] | None = None,
    observer: Any = None,
) -> Controller:
    """Return a controller with one law for each axis that the actuators move.

    The controller is ``u = -T C(z) (hat - ref)``, with the estimates hat and the references ref. T
    decouples the axes: ``T = pinv(G(sigma)) / sigma^2``. G is the transfer matrix from u to the
    axes, at the real number s = sigma = 2 pi bandwidth (see `flexplant.plant.driven_axes`). C has
    one law for each axis. This law depends on how the axis responds at the bandwidth w_b [rad/s]:

    - like a mass, -40 dB per decade: ``k (1 + w_i / s) (1 + 4 s / w_b) / (1 + s / (4 w_b)) F(s)``;
    - like a damper, -20 dB per decade: ``k (1 + w_i / s) F(s)``;
    - like a spring, 0 dB: ``k F(s) / s``; response that is zero at zero frequency: ``k F(s)``.

    Here w_i is the corner of the integral action, and F is a second-order low-pass multiplied by
    the notches. If two of these laws are possible, the one with the smaller peak of |S| at u is
    used. The gain k makes the loop gain of the axis 1 at the bandwidth. A resonance next to the
    bandwidth can make this k unsuitable, so that |S| at u exceeds 6 dB. If so, k is computed from
    the response at s = sigma, where no mode resonates; this k is used only if it keeps 6 dB. If the
    loop resonates between one and four times the bandwidth, or if |S| still exceeds 6 dB, a wide
    lead is tried: each 4 in the law of a mass becomes 16, or 64 if 16 does not keep 6 dB. A wide
    lead suppresses errors up to a higher frequency. It suppresses them less at low frequencies, and
    passes more noise to the actuators. A notch has the damping of its mode. Its frequency is that
    of the mode, or lower for a fast mode, so that errors of the frequency are tolerated.
    `servo_bandwidth` gives the largest bandwidth with a peak of 6 dB.

    Parameters
    ----------
    plant : StandardPlant
        Sampled plant.
    bandwidth : float or mapping {axis: float} [Hz]
        Frequency at which the loop gain of each axis crosses 1; below a fifth of the rate.
        Resonances may limit the suppression of errors to lower frequencies, see the certificate.
    poi : str, optional
        Point of interest (POI) whose axes are controlled; by default all POIs.
    axes : sequence of str, optional
        Channels of z (axes of POIs) or y (sensors) to control, as for
        `flexplant.plant.driven_axes`.
    rolloff : float [Hz], optional
        Corner of the second-order low-pass, below half the rate. By default it is 8 bandwidths (16
        or 64 with a wide lead, 3 for an axis on a spring), at most 0.4 of the rate.
    integrator : float [Hz], optional
        Corner of the integral action; by default a tenth of the bandwidth. With a wide lead it is
        lower if |S| at u would otherwise rise by more than 10 %. On springs it is up to half the
        bandwidth, if |S| at a twentieth of the bandwidth would otherwise exceed 0.3.
    notches : sequence of float [Hz], optional
        Frequencies of resonances to notch, each below half the rate. By default they are up to five
        modes of the plant, those at which the loop resonates most: the fewest notches with which
        |S| at u stays below 6 dB, else those with the lowest peak. If every peak is above
        18 dB, no notches are used. An empty sequence means a law without notches.
    observer : KalmanEstimator, StaticEstimator or StateSpace, optional
        Block whose outputs are the estimates `die:hat`, ...; by default the loop is checked with
        the true motion of the POI in their place.

    Returns
    -------
    Controller
        Controller from the references `die:ref`, ... (if any) and the estimates `die:hat`, ... to
        the actuators. The certificate holds spectral radius and modulus margin of the loop, also
        with truncated modes, and the frequency up to which |S| of every reference is below 1.

    Raises
    ------
    AssumptionError
        When the plant is continuous, or the actuators cannot move the axes independently.
    LabelError
        When the POI or an axis is unknown, or the observer does not give its estimates.
    ModelError
        When the plant is weighted, or a frequency is not positive or not below half the rate.
    SolverError
        When sampling and delay leave no phase margin at the bandwidth, or the loop with the
        observer is unstable. The message names the modes.

    Warns
    -----
    FlexplantWarning
        When the loop without an observer is unstable, or the truncated modes make the loop unstable
        or bring |S| at u above 8 dB. Also when the plant has references, but the actuators move a
        free motion that no axis shows; the servo then holds a sensor of this motion at zero.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> fx.close_loop(plant, observer, servo).is_stable
    True
    """
    task = servo_task(plant, poi, axes, rolloff, integrator, notches, observer)
    law = task.law(bandwidth)
    task.require_phase(law)
    closed = task.closed(law)
    margin = Verified("modulus margin", closed.modulus_margin, "a sweep of |1 + L| at u")
    checks = [stability_check(closed.spectral_radius, sampled=True), margin]
    left_out = closed.left_out
    known = checks if left_out is None else [*checks, *left_out.certificate.checks]
    least = min(one.figure for one in known if one.what.startswith("modulus"))
    advice = "" if least >= 1.0 / TARGET else _ADVICE
    at = _in_words(law)
    if not closed.is_stable:
        _refuse(closed, at, observer is not None, advice)
    elif any(name.endswith(":ref") for name in closed.plant.w):
        what = "|S| of the references below 1 up to [Hz]"
        checks.append(Verified(what, verified_suppression(closed), "a sweep of S"))
    if left_out is not None and not left_out.is_fine and closed.is_stable:
        warn(
            f"with the modes that the plant truncates the loop at {at} is {left_out.summary}. "
            f"The machine has these modes{CLOSE if left_out.is_high else ''}. {advice}"
        )
    warn_of_critical(closed)
    task.reading.warn_of_held(axes)
    centres = ", ".join(f"{notch.freq:.4g}" for notch in law.notches)
    notes = [f"notches at {centres} Hz"] if centres else []
    if advice:
        notes.append(f"|S| at u exceeds 6 dB. {advice}")
    if observer is None:
        notes.append("certified on the POI itself: observer= certifies the loop that will run")
    lines = ", ".join(
        f"{name} {axis.line}" + (f" with a lead of {axis.lead:g}" if axis.lead > LEADS[0] else "")
        for name, axis in zip(law.driven.channels, law.axes, strict=True)
    )
    notes.append(f"lines: {lines}")
    answer = Controller(task.controller(law), f"servo {at}", notes=tuple(notes))
    answer = answer.replace(certificate=Certificate(tuple(checks)))
    return with_checks(answer, task.plant, closed)


def _in_words(law: ServoLaw) -> str:
    """Return the bandwidths of the axes."""
    each = {name: axis.bandwidth for name, axis in zip(law.driven.channels, law.axes, strict=True)}
    if len(set(each.values())) == 1:
        return f"{next(iter(each.values())):g} Hz"
    return ", ".join(f"{f:g} Hz of {name}" for name, f in each.items())


@one_thread()
def servo_bandwidth(
    plant: StandardPlant,
    *,
    peak: float = TARGET,
    poi: str | None = None,
    axes: Sequence[str] | None = None,
    rolloff: float | None = None,
    integrator: float | None = None,
    notches: Sequence[float] | None = None,
    observer: Any = None,
) -> float:
    """Return the largest bandwidth [Hz] at which `design_servo` keeps |S| at u below a peak.

    The responses of plant and observer are computed once on a grid that includes resonances, and
    the loop is opened at the plant's input; the observer still receives u. Bandwidths are tried
    from high to low in steps of 9 %, then by bisection. One holds the peak if the closed loop is
    stable, its modulus margin is at least 1 / peak, and every axis with a reference has |S| of at
    most 0.3 at a twentieth of the bandwidth. The result is verified with the law that
    `design_servo` gives, with the truncated modes if they are known; where these do not allow it,
    the search is repeated with them.

    Parameters
    ----------
    plant, poi, axes, rolloff, integrator, notches, observer : as for `design_servo`
    peak : float
        Upper bound on the largest singular value of S at u; 2 is 6 dB. Axes may be scaled, as in
        `ClosedLoop.modulus_margin`.

    Returns
    -------
    float [Hz]

    Raises
    ------
    AssumptionError, LabelError, ModelError
        As for `design_servo`. ModelError also when `peak` is not above 1.
    SolverError
        When no bandwidth keeps the peak. The message gives the closest result and what limits it.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> fx.servo_bandwidth(plant, observer=fx.design_kalman(plant)) > 20.0
    True
    """
    peak = between(peak, "peak", 1.0, float("inf"), "No loop keeps |S| below 1: try 2.")
    task = servo_task(plant, poi, axes, rolloff, integrator, notches, observer)
    return task.largest(float(peak))


def _refuse(closed: ClosedLoop, at: str, observed: bool, advice: str) -> None:
    """Raise SolverError for the loop that will run, warn of a loop on the POI itself."""
    modes = modes_in_words(*growing_modes(closed.monitored, closed.plant.system.states))
    what = "with its observer" if observed else "on the POI itself"
    text = (
        f"the servo's loop at {at} {what} is unstable (spectral radius "
        f"{closed.spectral_radius:.6f}; takes part most: {modes}). {advice} "
        "Lower the bandwidth or the delay, or raise the rate."
    )
    if observed:
        raise SolverError(text)
    warn(f"{text} Pass observer= to check the loop that will run.")


#: bandwidths that `ServoTask.largest` tries, from 0.19 of the rate down to a part of it below
#: which loops lose digits, before it halves intervals
_TRIALS, _SLOWEST = 80, 2e-4
#: of these trials each eighth is designed to say why none holds
_ASKED = 8
#: roll-off relative to the bandwidth: on a spring the integrator leaves more phase for it; that of
#: a wide lead is its pole
_ROLLOFF = {"mass": 8.0, "damper": 8.0, "speed": 8.0, "spring": 3.0}
#: corner of the integral action relative to the bandwidth, or with a wide lead to its zero
_INTEGRATOR, _BELOW_ZERO = 0.1, 0.32
#: faster corners relative to the bandwidth. Up to that of the usual lead the fastest is taken that
#: raises |S| and lowers the frequency up to which |S| of the references is below 1 by at most this
#: factor. Those above it are for axes on springs that would follow too little otherwise
_CORNERS, _COST = (0.5, 0.2, 0.1, 0.05, 0.02), 1.1
#: wide leads are tried where the loop resonates above the bandwidth within this factor
_NEAR = 4.0
#: |S| on the grid above which no notches are sought: 18 dB
_POOR = 8.0
#: |S| that an axis is to have at this fraction of its bandwidth, as a mass has with the usual lead
_WELL_BELOW, _SUPPRESSED = 20.0, 0.3
#: a bandwidth is next to a resonance when a mode lies within this of it, and the gain of the axis
#: differs by more than this from that on the real axis; in logarithms
_RESONANT = 0.2


@dataclass(frozen=True)
class ServoTask:
    """What does not depend on the bandwidth."""

    plant: StandardPlant
    channels: tuple[str, ...]
    rolloff: float | None
    integrator: float | None
    notches: tuple[float, ...] | None
    observer: StateSpace | None
    #: peak of |S| at u that a search asks for: laws that do not hold it are None
    sought: float | None = None

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return 1.0 / self.plant.dt

    @property
    def reading(self) -> Reading:
        """What the servo reads."""
        return reading_of(self.plant, self.channels)

    @property
    def loop(self) -> ServoLoop:
        """Over frequency, with the truncated modes where they are known."""
        whole = self.plant.evaluation_plant or self.plant
        return servo_loop(whole, self.observer, self.reading, self.plant)

    def law(self, bandwidth: float | Mapping[str, float]) -> ServoLaw:
        """Return the laws of the axes; without notches where none are stable and good enough."""
        driven = self.driven(bandwidth)
        if (found := self.found(driven)) is not None:
            return found
        plain = self._plain(driven, np.abs(gains_at(self.plant, driven)))
        stable = [one for one in plain if self.loop.radius(one) < 1.0]
        return self._lowest(stable) or min(plain, key=self.loop.radius)

    def driven(self, bandwidth: float | Mapping[str, float]) -> DrivenAxes:
        """Return the axes, decoupled at the bandwidth."""
        wanted = bandwidth if isinstance(bandwidth, Mapping) else positive(bandwidth, "bandwidth")
        driven = driven_axes(self.plant, freq=wanted, axes=self.channels)
        for f in driven.freq:
            if f >= 0.2 * self.rate:
                raise ModelError(
                    f"bandwidth {f:g} Hz is not well below the rate, {self.rate:g} Hz: the law "
                    f"needs room above it. Stay below {0.2 * self.rate:g} Hz, or raise the rate."
                )
        return driven

    def found(self, driven: DrivenAxes) -> ServoLaw | None:
        """Return the law that serves best, None without one that is stable and good enough."""
        exact, smooth = np.abs(gains_at(self.plant, driven)), (2.0 * np.pi * driven.freq) ** -2.0
        best, modes = self._law(driven, exact), elastic(self.plant)[:, None]
        # next to a resonance the response says little of the axis: that on the real axis does
        near = np.any(np.abs(np.log(modes / driven.freq)) < _RESONANT, axis=0)
        if np.any(near & (np.abs(np.log(exact / smooth)) > _RESONANT)) and not self._serves(best):
            other = self._law(driven, smooth)
            return other if self._serves(other) else best
        return best

    def _plain(self, driven: DrivenAxes, gains: FloatArray) -> list[ServoLaw]:
        """Return the laws without chosen notches on lines that leave phase, or on the likeliest."""
        notches, level = tuple(map(Notch, self.notches or ())), tuple(gains.tolist())
        tried = [
            ServoLaw(driven, tuple(map(self.axis, lines, driven.freq.tolist())), level, notches)
            for lines in combinations(lines_of(self.plant, driven))
        ]
        return [one for one in tried if self.phase_margins(one).min() > 0.0] or tried[:1]

    def _law(self, driven: DrivenAxes, gains: FloatArray) -> ServoLaw | None:
        """Return the law with lines, notches, lead and integral action, None without a good one."""
        plain = self._plain(driven, gains)
        if self.phase_margins(plain[0]).min() <= 0.0:
            return None
        plain = [one for one in plain if not self.loop.is_hopeless(one)]
        best = self._lowest(map(self._notched, plain))
        best = best and self._settling(best)
        mass = next((one for one in plain if any(axis.line == "mass" for axis in one.axes)), None)
        for lead in LEADS[1:] if mass else ():
            # the widest leads only where the others do not serve: they cost most noise
            resonates = lead == LEADS[1] and self._resonates(plain[0])
            if mass is None or (best and not resonates and self._holds(best, WITHIN * TARGET)):
                break
            axes = (self.axis(a.line, a.bandwidth, lead) for a in mass.axes)
            wide = self._notched(mass.of(axes))
            if wide and self._lowest([best, wide]) is wide and self._runs(wide):
                wide = self._settling(wide)
                serves = best and self._holds(best, TARGET) and self._suppresses(best)
                best = best if serves and not self._suppresses(wide) else wide
        return best

    def _lowest(self, laws: Iterable[ServoLaw | None]) -> ServoLaw | None:
        """Return the law with the lowest peak of |S| at u, None without any."""
        known = [law for law in laws if law]
        return min(known, key=lambda law: self.loop.peak(law)[0], default=None)

    def _resonates(self, law: ServoLaw) -> bool:
        """Return whether the loop of a law resonates a little above the bandwidth."""
        seen = self.loop.modes[self.loop.resonant(law)]
        return bool(np.any(seen < _NEAR * law.driven.freq.min()))

    def _runs(self, law: ServoLaw) -> bool:
        """Return whether the loop is stable with the truncated modes, where they are known.

        A search skips this check: `largest` makes it for the result.
        """
        whole = None if self.sought else self.closed(law).completed
        return whole is None or whole.is_stable

    def _serves(self, law: ServoLaw | None) -> bool:
        """Return whether a law holds 6 dB and follows its references."""
        return law is not None and self._holds(law, TARGET) and self._suppresses(law, followed=True)

    def _holds(self, law: ServoLaw, peak: float) -> bool:
        """Return whether the loop of a law is stable with |S| at u below a peak, on the grid."""
        return self.loop.radius(law) < 1.0 and self.loop.peak(law)[0] <= peak

    def _suppresses(self, law: ServoLaw, followed: bool = False) -> bool:
        """Return whether every axis, or that with a reference, suppresses errors at a twentieth."""
        low = law.driven.freq / _WELL_BELOW
        plant = gains_at(self.plant, law.driven, low)
        far = np.abs(1.0 + np.diag(law.at(low)) * plant) >= 1.0 / _SUPPRESSED
        free = [followed and name not in self.reading.references for name in self.channels]
        return bool(np.all(far | free))

    def _suppressed_up_to(self, law: ServoLaw) -> float:
        """Return `ServoLoop.suppressed_up_to` of the plant, on a grid through its resonances."""
        grid = resonance_grid(loop_poles(self.loop.path, law.matrices), self.plant.dt)
        return replace(self.loop, freq=grid, plant=self.plant).suppressed_up_to(law)

    def _settling(self, law: ServoLaw) -> ServoLaw:
        """Return a law with integral action as fast as suppresses errors and costs little |S|."""
        if self.integrator is not None or not self._holds(law, TARGET):
            return law
        if not self._suppresses(law):
            able = (one for one in map(law.faster, reversed(_CORNERS)) if self._suppresses(one))
            return next((one for one in able if self._holds(one, TARGET)), law)
        most, up_to = _COST * self.loop.peak(law)[0], None
        for one in map(law.faster, (part for part in _CORNERS if part <= _INTEGRATOR)):
            if one.axes == law.axes:
                break
            if self._holds(one, most):
                up_to = up_to or self._suppressed_up_to(law)
                if self._suppressed_up_to(one) >= up_to / _COST:
                    return one
        return law

    def axis(self, line: str, bandwidth: float, lead: float = LEADS[0]) -> Axis:
        """Return the law of an axis on a line."""
        wide = line == "mass" and lead != LEADS[0]
        usual = min((lead if wide else _ROLLOFF[line]) * bandwidth, 0.4 * self.rate)
        rolloff = usual if self.rolloff is None else self.rolloff
        own = (_BELOW_ZERO / lead if wide else _INTEGRATOR) * bandwidth
        slow = own if self.integrator is None else self.integrator
        for name, freq in (("rolloff", rolloff), ("integrator", slow)):
            below_half_rate(freq, name, self.rate)
        own_lead = lead if wide else LEADS[0]
        return known_axis(line, bandwidth, float(rolloff), self.rate, own_lead, float(slow))

    def _notched(self, law: ServoLaw) -> ServoLaw | None:
        """Return a law with notches where they serve, or as given; None if none is good enough."""
        most = max(self.sought, TARGET) if self.sought else _POOR
        return self.loop.notched(law, self.notches is not None, most)

    def phase_margins(self, law: ServoLaw) -> FloatArray:
        """Return the phases [rad] (r,) that remain of -pi at the bandwidth, on each axis's line."""
        # hold and delay turn a line as they turn the plant; its modes are not in it, and the
        # notches at them neither
        late = np.array([2.0 * np.pi * a.bandwidth for a in law.axes]) * self.plant.dt
        given = [law.there(notch) for notch in law.notches if self.notches is not None]
        turned = np.array([a.turn for a in law.axes]) * np.prod(given, axis=0)
        lines = np.array([POWERS.get(a.line, 1.0) for a in law.axes])
        own = np.angle(turned * 1j ** -(lines - 1.0)) - 0.5 * np.pi
        return np.asarray(own - late * (0.5 + self.plant.delay) + np.pi)

    def require_phase(self, law: ServoLaw) -> None:
        """Raise SolverError where rate and delay leave no phase at the bandwidth of an axis."""
        margins = self.phase_margins(law)
        if margins.min() <= 0.0:
            i = int(np.argmin(margins))
            raise SolverError(
                f"the loop of {law.driven.channels[i]} at {law.axes[i].bandwidth:g} Hz is unstable "
                f"(phase margin {np.rad2deg(margins[i]):.3g} deg): rate {self.rate:g} Hz and a "
                f"delay of {self.plant.delay:g} samples leave too little phase. Lower the "
                "bandwidth or the delay, or raise the rate or the roll-off."
            )

    def controller(self, law: ServoLaw) -> StateSpace:
        """Return a law as a system from [refs, readings] to u."""
        reads, followed = tuple(self.reading.reads.values()), self.reading.references
        each = zip(law.axes, law.level, strict=True)
        laws = side_by_side([(axis.law(law.notches) / k).system for axis, k in each], reads)
        direct = np.eye(len(reads))
        referred = direct[:, [reads.index(self.reading.reads[name]) for name in followed]]
        errors, inputs = np.hstack([referred, -direct]), [*followed.values(), *reads]
        before = StateSpace([], [], [], errors, laws.dt, inputs=inputs)
        after = StateSpace([], [], [], law.driven.T, laws.dt, inputs=reads, outputs=self.plant.u)
        system = series(series(before, laws), after)
        return system.replace(name="servo", units=self.plant.units)

    @cached_property
    def closed(self) -> Callable[[ServoLaw], ClosedLoop]:
        """The function of a law that gives the loop that will run."""
        plant = self.plant
        before = () if self.observer is None else (self.observer,)
        if not before and self.reading.estimates:
            plant = seeing(plant, self.reading)

        @cache
        def found(law: ServoLaw) -> ClosedLoop:
            blocks = (*before, self.controller(law))
            controller = driving_blocks(plant, blocks, *drives(plant, blocks, ()))
            return ClosedLoop(plant, blocks, controller)

        return found

    def largest(self, peak: float) -> float:
        """Return the largest bandwidth that holds a peak of |S| at u."""
        # laws above the peak need not be found, but above 18 dB they are others
        task = replace(self, sought=peak if peak <= _POOR else None)

        def fine(loop: ClosedLoop | None) -> bool:
            return loop is None or loop.modulus_margin >= 1.0 / peak

        def holds(law: ServoLaw | None) -> bool:
            if law is None or self.loop.radius(law) >= 1.0 or self.loop.peak(law)[0] > peak:
                return False
            return self._suppresses(law, followed=True) and fine(self.closed(law))

        @cache
        def likely(bandwidth: float) -> bool:
            law = task.found(task.driven(bandwidth)) if task.sought else task.law(bandwidth)
            return holds(law)

        @cache
        def proven(bandwidth: float) -> bool:
            # by the law that is designed: another one where truncated modes allow no wide lead
            law = self.law(bandwidth)
            return holds(law) and fine(self.closed(law).completed)

        trials = np.geomspace(0.19 * self.rate, _SLOWEST * self.rate, _TRIALS).tolist()
        found = highest_bandwidth(trials, likely)
        if found and not proven(found):
            found = highest_bandwidth(trials, lambda one: likely(one) and proven(one))
        if found is None:
            raise SolverError(
                f"no bandwidth from {trials[-1]:.3g} to {trials[0]:.3g} Hz holds |S| at u below "
                f"{20 * np.log10(peak):.2g} dB{self._why(peak, trials[::_ASKED])}"
            )
        return found

    def _why(self, peak: float, trials: Sequence[float]) -> str:
        """Return what is nearest to holding a peak, what stops it and what to change, in words."""
        tried = [(self.law(bandwidth), bandwidth) for bandwidth in trials]
        able = [one for one in tried if self.phase_margins(one[0]).min() > 0.0]
        stable = [one for one in able if self.loop.radius(one[0]) < 1.0]
        if not stable:
            return (
                ": none gives a stable loop. Check the observer's signs and units, or design it "
                "on this plant."
            )
        able = [one for one in stable if self._suppresses(one[0], followed=True)]
        if not able:
            return (
                f": none of {len(trials)} bandwidths that were asked follows its references with "
                f"|S| below {_SUPPRESSED} at a twentieth of the bandwidth. Move the observer's "
                "noise intensities towards the sensors, or control other axes."
            )
        law, bandwidth = min(able, key=lambda one: self.loop.peak(one[0])[0])
        size, at = self.loop.peak(law)
        if margin := self.closed(law).modulus_margin:
            size = max(size, 1.0 / margin)
        left = float(np.rad2deg(self.phase_margins(law).min()))
        taken = 360.0 * bandwidth * self.plant.dt * (0.5 + self.plant.delay)
        asked = float(np.rad2deg(2.0 * np.arcsin(0.5 / peak)))
        cause = (
            f"rate and delay take {taken:.2g} deg of phase and leave {left:.2g} deg on the axes' "
            f"lines, and this peak needs at least {asked:.2g} deg. Raise the rate, lower the delay"
            if left < asked <= left + taken
            else "the cause is the flexible modes, the observer or the law, since rate and delay "
            f"take only {taken:.2g} deg of phase. Place a notch at that frequency, change the "
            "observer's noise intensities, give each axis its bandwidth in design_servo"
        )
        return (
            f"; the least found is {20 * np.log10(size):.3g} dB, of {bandwidth:.3g} Hz, at "
            f"{at:.4g} Hz. There {cause}, or raise peak=."
        )


def servo_task(
    given: StandardPlant | UncertainPlant[Any],
    poi: str | None,
    axes: Sequence[str] | None,
    rolloff: float | None,
    integrator: float | None,
    notches: Sequence[float] | None,
    observer: Any,
) -> ServoTask:
    """Return the task of a servo; parameters as for `design_servo`."""
    plant = standard_plant(given)
    require_sampled(plant, "a servo is designed at its sampling rate")
    driven = driven_axes(plant, axes=axes, poi=poi)
    (plant.continuous or plant).check().require(("stabilisable",), "a servo")
    centres = None if notches is None else real_array(notches, "notches", (None,)).tolist()
    for freq in centres or ():
        below_half_rate(freq, "notch", 1.0 / plant.dt)
    return ServoTask(
        plant,
        driven.channels,
        rolloff,
        integrator,
        None if centres is None else tuple(centres),
        observer_system(observer, plant, reading_of(plant, driven.channels).estimates),
    )
