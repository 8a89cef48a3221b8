"""A PID controller for an ordinary plant: a lag, a motor, a temperature with its dead time."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from ...arrays import FloatArray, between, positive
from ...errors import ModelError, with_unit
from ...loop.report import report_loops
from ...loop.sensitivity_functions import bandwidth
from ...lti.blocks_of_states import trapezoidal
from ...lti.interconnection import loop_poles
from ...lti.response_solvers import continuous_poles, responses
from ...lti.sampling import held_exactly
from ...lti.statespace import StateSpace, System, as_statespace
from ...store import Value
from .law import Pid, Section, tustin_s

#: where integral action ends and where the lead is centred, as fractions of the crossover: from a
#: plant that lags anyway (1) to one that needs all available phase (30); lead of 0 to 67 deg
_INTEGRAL, _LEAD = (1.0, 2.0, 3.0, 5.0, 10.0, 30.0), (1.0, 1.5, 2.0, 3.0, 5.0)
#: crossovers tried from the top, in each decade, and how many decades below the fastest
_STEPS, _DECADES = 24, 6
#: points of a decade, and decades to both sides of the crossover, on which |S| is judged before the
#: exact margin is computed
_POINTS, _AROUND = 60, 3


@dataclass(frozen=True, eq=False, repr=False)
class PidTuning(Value):
    """A tuned PID controller with its verified results: the result of `tune_pid`.

    The controller is ``u = k (1 + w_i / s) (1 + s / w_d) / (1 + s / w_f) (r - y)``, with the
    reference r. For a PI controller, the factors with w_d and w_f (the lead) are left out.

    Parameters
    ----------
    controller : StateSpace
        Controller from y to u, including the sign of the feedback. `close_loop` and `write_c` take
        it.
    gain : float
        Gain k, in the unit of u over that of y.
    integral, lead, roll_off : float [Hz]
        Corner frequencies w_i, w_d and w_f in Hz. Those of lead and roll-off are infinite if they
        are not used.
    crossover : float [Hz]
        Lowest frequency at which the loop gain is 1.
    bandwidth : float [Hz]
        Lowest frequency at which |S| crosses 1, where S is the sensitivity.
    margin : float
        Modulus margin, 1 / max |S|.
    """

    controller: StateSpace
    gain: float
    integral: float
    lead: float
    roll_off: float
    crossover: float
    bandwidth: float
    margin: float

    def __repr__(self) -> str:
        lead = (
            f", lead from {with_unit(self.lead, 'Hz')} to {with_unit(self.roll_off, 'Hz')}"
            if np.isfinite(self.lead)
            else ""
        )
        return (
            f"<PidTuning: gain {self.gain:.4g}, integral action to {with_unit(self.integral, 'Hz')}"
            f"{lead}; crosses 1 at {with_unit(self.crossover, 'Hz')}, |S| < 1 to "
            f"{with_unit(self.bandwidth, 'Hz')}, modulus margin {self.margin:.2f}>"
        )


def tune_pid(
    plant: System,
    *,
    bandwidth: float | None = None,
    margin: float = 0.5,
    rate: float | None = None,
    dead_time: float = 0.0,
) -> PidTuning:
    """Return a PI or PID controller of a plant with one input and one output.

    The loop gain crosses 1 at the given bandwidth. Several corner frequencies of integral action
    and lead keep the modulus margin. Those with the largest integral gain are chosen. Bandwidth and
    margin are verified on the closed loop.

    Parameters
    ----------
    plant : StateSpace, or a system of python-control or SciPy
        Plant with one input and one output. It may have integrators, and its gain may have either
        sign.
    bandwidth : float [Hz], optional
        Frequency at which the loop gain crosses 1 (`crossover` of the result). By default it is the
        largest one that keeps the margin. For a continuous plant there may be no largest one; a
        thousand times the fastest pole is then used.
    margin : float
        Modulus margin to be kept, between 0 and 1. The modulus margin is one over the largest
        magnitude of the sensitivity S.
    rate : float [Hz], optional
        Sampling rate of the controller. The plant is then sampled exactly with its dead time. By
        default the controller is continuous.
    dead_time : float [s]
        Dead time from u to y. If it is not zero, a rate must be given.

    Returns
    -------
    PidTuning
        The `controller` from y to u, its gain and corner frequencies, and its verified `margin`.

    Raises
    ------
    ModelError
        When the plant has several channels, a dead time is given without a rate, or no PID keeps
        the margin.

    References
    ----------
    [AstromMurray2008]_, chapter 10.

    Examples
    --------
    >>> import flexplant as fx
    >>> oven = fx.lti.tf([40.0], [600.0, 1.0])  # 40 K per kW, ten minutes
    >>> found = fx.synthesis.tune_pid(oven, rate=10.0, dead_time=20.0)
    >>> found.margin >= 0.5
    True
    """
    g = as_statespace(plant)
    if (len(g.inputs), len(g.outputs)) != (1, 1):
        raise ModelError(
            f"{g!r} has several channels: pass plant.select([output], [input]), or use tune_loops."
        )
    between(margin, "margin", 0.0, 1.0, "It is the least distance of the loop gain to -1.")
    g = _sampled(g, rate, dead_time)
    if bandwidth is not None:
        found = _tuned(g, positive(bandwidth, "bandwidth"), margin)
        if found is None:
            raise ModelError(
                f"no PID of {with_unit(bandwidth, 'Hz')} keeps a modulus margin of {margin:g}: ask "
                "for less, or leave bandwidth out to see the largest."
            )
        return found
    for freq in _crossovers(g):
        if (found := _tuned(g, float(freq), margin)) is not None:
            return found
    raise ModelError(
        f"no PID keeps a modulus margin of {margin:g} of {g!r}: design_hinf of a mixed sensitivity "
        "says what any controller reaches."
    )


def _sampled(g: StateSpace, rate: float | None, dead_time: float) -> StateSpace:
    late = positive(dead_time, "dead_time", zero=True)
    if rate is None or g.dt:
        if late:
            raise ModelError("dead time needs a rate=, at which the plant is sampled exactly.")
        return g
    return held_exactly(g, positive(rate, "rate"), delay=late * rate)


def _crossovers(g: StateSpace) -> FloatArray:
    """Return crossovers to try [Hz], from the top: a third of the rate, or above all poles."""
    if g.dt:
        top = 1.0 / (3.0 * g.dt)
    else:
        fast = np.abs(np.concatenate([g.poles(), g.zeros()]))
        top = 10.0 ** (_DECADES / 2) * float(np.max(fast, initial=1.0)) / (2.0 * np.pi)
    return np.asarray(top * 10.0 ** (-np.arange(_DECADES * _STEPS) / _STEPS))


def _tuned(g: StateSpace, freq: float, margin: float) -> PidTuning | None:
    """Return the PID of a crossover with the most integral gain that keeps the margin."""
    if g.dt and freq >= 0.5 / g.dt:
        raise ModelError(f"the bandwidth must lie below half the rate, {0.5 / g.dt:g} Hz.")
    lines = np.append(_grid(g, freq), freq)
    response, rate = responses(g, lines)[0, 0], 1.0 / g.dt if g.dt else 0.0
    s = tustin_s(lines, rate)
    kept: list[tuple[float, _Choice]] = []
    for low, lead, sign in product(_INTEGRAL, _LEAD, (1.0, -1.0)):
        choice = _Choice(freq / low, freq / lead, freq * lead)
        L = response * choice.section(rate, freq).gain(s)
        k = sign / float(abs(L[-1]))
        if np.min(np.abs(1.0 + k * L)) >= margin:
            kept.append((k, choice))
    # the largest integral gain first; results on the grid are verified on the closed loop
    for k, choice in sorted(kept, key=lambda one: -abs(one[0]) * one[1].integral):
        found = _verified(g, k, choice, freq, margin)
        if found is not None:
            return found
    return None


class _Choice(NamedTuple):
    """Corner frequencies [Hz]."""

    integral: float
    lead: float
    roll_off: float

    def section(self, rate: float, freq: float) -> Section:
        """Return the controller of gain 1, which sampling keeps at a frequency [Hz]."""
        ahead = self.roll_off > self.lead
        ends = {"zero": self.lead, "pole": self.roll_off} if ahead else {}
        section = Pid.corners(1.0, integrator=self.integral, **ends).section
        return section._replace(centre=2.0 * np.pi * freq).at(rate)

    def law(self, rate: float, freq: float) -> StateSpace:
        """Return the controller of gain 1 as a system."""
        matrices = self.section(rate, freq).matrices
        if not rate:
            return StateSpace(*matrices)
        return StateSpace(*trapezoidal(matrices, 2.0 * rate), 1.0 / rate)


def _grid(g: StateSpace, freq: float) -> FloatArray:
    """Return frequencies [Hz] around a crossover, and those of the plant's modes."""
    top = 0.499 / g.dt if g.dt else freq * 10.0**_AROUND
    around = np.geomspace(freq / 10.0**_AROUND, top, 2 * _AROUND * _POINTS)
    # next to a mode, not on it: an undamped mode has an infinite response
    modes = (1.0 + 1e-3) * np.abs(continuous_poles(g).imag) / (2.0 * np.pi)
    return np.union1d(around, modes[(modes > around[0]) & (modes < top)])


def _verified(
    g: StateSpace, k: float, choice: _Choice, freq: float, margin: float
) -> PidTuning | None:
    """Return the tuning where the closed loop is stable and keeps the margin, by its poles."""
    controller = choice.law(1.0 / g.dt if g.dt else 0.0, freq)
    controller = controller.replace(
        C=-k * controller.C, D=-k * controller.D, inputs=g.outputs, outputs=g.inputs
    )
    poles = loop_poles(g, controller)
    if np.max(np.abs(poles) - 1.0 if g.dt else poles.real) >= 0.0:
        return None
    report = report_loops((g, controller))
    (one,) = report.values()
    if not report.is_stable or one.modulus_margin < margin:
        return None
    ahead = choice.roll_off > choice.lead
    return PidTuning(
        controller.replace(units=g.units),
        k,
        choice.integral,
        choice.lead if ahead else np.inf,
        choice.roll_off if ahead else np.inf,
        one.crossovers[0],
        bandwidth((g, controller)),
        one.modulus_margin,
    )
