"""Loops with a continuous delay: stability, margins, norms and responses without sampling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ..arrays import ComplexArray, FloatArray, one_of, real_array
from ..errors import AssumptionError, ModelError, SolverError, counted
from ..lti.delays import Delayed, delayed
from ..lti.peaks import PEAKS
from ..store import Value
from ..tolerances import FOUR_DIGITS, ROUNDING, SETTLED

#: the loop gain below which a loop no longer turns, over its distance to 1 at infinity
_QUIET = 0.1
#: points of a decade, and steps of the delay's phase and of the contour's [rad]
_POINTS, _TURN, _STEP = 200, 0.2, 0.5
#: points of the contour at most
_MOST = 2_000_000


@dataclass(frozen=True, eq=False, repr=False)
class DelayedLoop(Value):
    """The loop ``u = K y`` around a plant, with a delay in the plant, the controller or both.

    The loop gain ``L = -G K`` is computed exactly at every frequency. The number of poles in the
    right half plane follows from the phase of ``det(I + L)`` along the imaginary axis (Nyquist
    criterion). Frequencies are added until this phase changes by less than 0.5 rad between
    neighbours.

    Parameters
    ----------
    plant, controller : StateSpace or Delayed, continuous
        Plant G and controller K; K includes the sign of the feedback. K may be improper
        (differentiate) if G has no direct feedthrough.

    Raises
    ------
    ModelError
        When neither has a delay, or when their product is improper (differentiates) and therefore
        cannot be realised.

    References
    ----------
    [Michiels2014]_, chapters 1 and 3.

    Examples
    --------
    A PD controller for an integrator with a delay of 1 s:

    >>> import flexplant as fx
    >>> plant = fx.lti.Delayed(fx.lti.tf([1.0], [1.0, 0.0]), 1.0)
    >>> loop = fx.loop.DelayedLoop(plant, -fx.lti.Delayed.tf([0.2, 0.6], [1.0]))
    >>> loop.is_stable, round(loop.modulus_margin, 2)
    (True, 0.64)
    """

    plant: Any
    controller: Any

    def __post_init__(self) -> None:
        self._set(plant=delayed(self.plant), controller=delayed(self.controller))
        if not self.gain.delay:
            raise ModelError("neither plant nor controller is delayed: use close_loop or margins.")
        if np.any(self.gain.slope):
            raise ModelError(
                f"the loop gain {self.gain!r} grows without limit: every delay makes it unstable. "
                "Add a filter to the derivative."
            )

    @cached_property
    def gain(self) -> Delayed:
        """Loop gain L = -G K, with the loop opened at y."""
        found: Delayed = -(self.plant * self.controller)
        return found

    @cached_property
    def _at_infinity(self) -> float:
        """Spectral radius of L at infinite frequency."""
        return float(np.abs(np.linalg.eigvals(self.gain.system.D)).max(initial=0.0))

    @cached_property
    def unstable_poles(self) -> int:
        """Number of poles of the loop in the right half plane.

        AssumptionError is raised if there are infinitely many such poles, and SolverError if the
        phase needs too many frequencies.
        """
        if self._at_infinity >= 1.0:
            raise AssumptionError(
                f"the loop gain is {self._at_infinity:.3g} at infinite frequency: with a delay a "
                "gain of 1 or more there has infinitely many unstable poles. Add a filter."
            )
        F = self._contour[1]
        turned = float(np.sum(np.angle(F[1:] / F[:-1]))) - float(np.angle(F[-1]))
        poles = self.gain.system.poles()
        beyond = int(np.count_nonzero(poles.real > self._edge(poles)))
        count = beyond - turned / np.pi
        if abs(count - round(count)) > 0.05 or round(count) < 0:
            raise SolverError(f"the count of unstable poles is {count:.3g}, not whole. Report it.")
        return round(count)

    @property
    def is_stable(self) -> bool:
        """Whether all poles lie in the left half plane."""
        return self._at_infinity < 1.0 and self.unstable_poles == 0

    def _edge(self, poles: ComplexArray) -> FloatArray:
        """Return the real part up to which a pole counts as on the axis."""
        return np.asarray(ROUNDING**0.5 * np.maximum(np.abs(poles), self._slow))

    @cached_property
    def _slow(self) -> float:
        """The slowest frequency that matters [rad/s]."""
        sizes = np.abs(self.gain.system.poles())
        return min(float(sizes[sizes > 0].min(initial=np.inf)), 1.0 / self.gain.delay) * 1e-2

    @cached_property
    def _fast(self) -> float:
        """The frequency [rad/s] from which on L is as good as at infinity."""
        g = self.gain.system
        limit = _QUIET * (1.0 - self._at_infinity)
        w = max(float(np.abs(g.poles()).max(initial=0.0)), 1.0 / self.gain.delay)
        while np.linalg.norm(g.evaluated(1j * w) - g.D, 2) > limit:
            w *= 1.3
            if w * self.gain.delay / _TURN > _MOST:
                raise SolverError(
                    f"the loop gain falls below {limit:.2g} beyond {w / (2 * np.pi):.3g} Hz only, "
                    f"where a delay of {self.gain.delay:g} s turns millions of times. Add a filter."
                )
        return w

    @cached_property
    def lines(self) -> FloatArray:
        """Frequencies [Hz] at which margins and norms are computed before they are refined."""
        low, high = self._slow, self._fast
        decades = np.log10(high / low)
        even = np.geomspace(low, high, int(_POINTS * decades) + 2)
        turns = np.arange(_TURN, high * self.gain.delay, _TURN) / self.gain.delay
        modes = self.gain.system.poles()
        swing = np.abs(modes.imag[:, None]) + np.abs(modes.real[:, None]) * np.linspace(-8, 8, 81)
        every = np.concatenate([even, turns, swing.ravel()])
        every = np.unique(every[(every >= low) & (every <= high)])
        undamped = np.abs(modes.imag[np.abs(modes.real) <= self._edge(modes)])
        away = np.abs(every[:, None] - undamped).min(axis=1, initial=np.inf) > FOUR_DIGITS * low
        return np.asarray(every[away] / (2 * np.pi))

    @cached_property
    def _contour(self) -> tuple[ComplexArray, ComplexArray]:
        """Points from the positive real axis along the imaginary one, and det(I + L) there."""
        poles = self.gain.system.poles()
        on_axis = poles[np.abs(poles.real) <= self._edge(poles)]
        radius = FOUR_DIGITS * self._slow
        s: ComplexArray = np.asarray(2j * np.pi * self.lines, dtype=np.complex128)
        around = [radius * np.exp(0.5j * np.pi * np.linspace(0.0, 1.0, 40))]
        around.append(1j * np.geomspace(radius, self._slow, 400)[1:])
        s = np.concatenate([*around, s]).astype(np.complex128)
        for w in np.unique(np.abs(on_axis.imag[np.abs(on_axis.imag) > radius])):
            arc = 1j * w + radius * np.exp(1j * np.pi * np.linspace(-0.5, 0.5, 60))
            s = np.concatenate([s[np.abs(s - 1j * w) > radius], arc])
            s = s[np.argsort(s.imag, kind="stable")]
        F = self._determinant(s)
        while True:
            steps = np.abs(np.angle(F[1:] / F[:-1]))
            wide = np.flatnonzero(steps > _STEP)
            close = np.abs(s[wide + 1] - s[wide]) <= ROUNDING * np.abs(s[wide + 1])
            if not wide.size or np.all(close):
                return s, F
            if s.size > _MOST:
                raise SolverError(
                    "det(I + L) turns too fast for its path to be followed near "
                    f"{s[wide[0]].imag / (2 * np.pi):.4g} Hz: the loop is at the edge of stability."
                )
            wide = wide[~close]
            middle: ComplexArray = np.asarray(0.5 * (s[wide] + s[wide + 1]), dtype=np.complex128)
            F = np.insert(F, wide + 1, self._determinant(middle))
            s = np.insert(s, wide + 1, middle).astype(np.complex128)

    def _determinant(self, s: ComplexArray) -> ComplexArray:
        """Return det(I + L) (n,) at complex frequencies."""
        L = np.moveaxis(self.gain.at(s), 2, 0)
        return np.asarray(np.linalg.det(np.eye(L.shape[1]) + L))

    def response(self, which: Literal["S", "T", "L", "KS"], freq: npt.ArrayLike) -> ComplexArray:
        """Return the exact response (p, m, n) at n frequencies [Hz].

        S, T and L are those with the loop opened at y; "KS" selects -K S.
        """
        one_of(which, "which", ("S", "T", "L", "KS"))
        s = 2j * np.pi * np.atleast_1d(real_array(freq, "freq"))
        K, G = (np.moveaxis(part.at(s), 2, 0) for part in (self.controller, self.plant))
        L = -G @ K
        if which != "L":
            S = np.linalg.inv(np.eye(L.shape[1]) + L)
        found = L if which == "L" else S if which == "S" else (L if which == "T" else -K) @ S
        return np.asarray(np.moveaxis(found, 0, 2))

    def norm(self, which: Literal["S", "T", "KS"]) -> tuple[float, float]:
        """Return the H-infinity norm of S, T or K S and its frequency [Hz].

        The largest peaks of the response at the frequencies `lines` are refined. The norm of an
        unstable loop is infinite.
        """
        if not self.is_stable:
            return np.inf, np.nan

        def size(freq: npt.ArrayLike) -> FloatArray:
            return np.asarray(np.linalg.norm(self.response(which, freq), 2, axis=(0, 1)))

        return _peak(size, self.lines)

    @property
    def modulus_margin(self) -> float:
        """Smallest distance of L to -1, ``1 / max |S|``; 0 for an unstable loop."""
        return 1.0 / self.norm("S")[0]

    @cached_property
    def margins(self) -> dict[str, tuple[float, float]]:
        """Smallest gain, phase and delay margins of a loop with one channel, and their frequencies.

        The dictionary is ``{"gain": (factor, Hz), "phase": (degrees, Hz), "delay": (s, Hz)}``. With
        a gain margin below 1 the loop becomes unstable when its gain is reduced by this factor. A
        margin that does not exist is infinite.
        """
        if len(self.gain.inputs) != 1 or len(self.gain.outputs) != 1:
            raise ModelError(
                f"the loop has {counted(len(self.gain.inputs), 'channel')}: use modulus_margin."
            )
        lines = self.lines
        L = self.response("L", lines)[0, 0]

        def one(freq: float) -> complex:
            return complex(self.response("L", [freq])[0, 0, 0])

        crossing = _zeros(lambda f: np.log(abs(one(f))), np.log(np.abs(L)), lines)
        turning = [f for f in _zeros(lambda f: one(f).imag, L.imag, lines) if one(f).real < 0]
        phases = [(float(np.degrees(np.angle(-one(f)))), f) for f in crossing]
        # a lag turns the phase clockwise
        delays = [((p % 360.0) / (360.0 * f), f) for p, f in phases]
        gains = [(1.0 / abs(one(f)), f) for f in turning]
        none = (np.inf, np.nan)
        return {
            "gain": min(gains, key=lambda g: abs(np.log(g[0])), default=none),
            "phase": min(phases, key=lambda p: abs(p[0]), default=none),
            "delay": min(delays, default=none),
        }

    def lsim(self, reference: Callable[[float], float], time: npt.ArrayLike) -> FloatArray:
        """Return y (p, n) of the loop that starts at rest and follows a reference.

        The method of steps is used. Time is divided into intervals whose length is the delay. On
        each of them the delayed error is already known, so that an ordinary differential equation
        remains. SciPy's solver of order 8 solves it with a relative tolerance of 1e-9.

        Parameters
        ----------
        reference : function of the time [s]
            Reference of all channels. It must be smooth between multiples of the delay.
        time : (n,) array [s]
            Time instants in increasing order, all at 0 or later.
        """
        from scipy.integrate import solve_ivp  # not loaded with the package

        t = np.atleast_1d(real_array(time, "time"))
        if np.any(np.diff(t) < 0) or t[0] < 0:
            raise ModelError("time must grow from 0: np.linspace(0, 20, 500), say.")
        g, late = self.gain.system, self.gain.delay
        ones = np.ones(len(self.gain.outputs))

        def nothing(_: float) -> FloatArray:
            return np.zeros(len(self.gain.inputs))

        before: Callable[[float], FloatArray] = nothing
        x, found = np.zeros(g.n_states), np.zeros((len(ones), t.size))
        for k in range(int(np.floor(t[-1] / late + 1e-9)) + 1):
            start, end = k * late, (k + 1) * late
            slopes: Any = _driven(g.A, g.B, before, late)
            own = solve_ivp(
                slopes,
                (start, end),
                x,
                method="DOP853",
                rtol=SETTLED,
                atol=1e-12,
                dense_output=True,
            )

            def output(at: float, own: Any = own, v: Any = before) -> FloatArray:
                return np.asarray(g.C @ own.sol(at) + g.D @ v(at - late))

            here = (t >= start - 1e-12) & ((t < end) | (t == t[-1])) & (t <= end + 1e-12)
            found[:, here] = np.array([output(one) for one in t[here]]).reshape(-1, len(ones)).T
            x = own.y[:, -1]
            before = _error(reference, output, ones)
        return found

    def step(self, time: npt.ArrayLike) -> FloatArray:
        """Return y (p, n) after a step of 1 of all references."""
        return self.lsim(lambda _: 1.0, time)

    def __repr__(self) -> str:
        if not self.is_stable:
            return f"<DelayedLoop, {self.gain.delay:g} s: unstable>"
        return (
            f"<DelayedLoop, {self.gain.delay:g} s: stable, modulus margin "
            f"{self.modulus_margin:.3g}>"
        )


def _driven(
    A: FloatArray, B: FloatArray, signal: Callable[[float], FloatArray], late: float
) -> Callable[[float, FloatArray], FloatArray]:
    """Return ``A x + B v(t - late)`` as a function of t and x."""
    return lambda at, x: np.asarray(A @ x + B @ signal(at - late))


def _error(
    reference: Callable[[float], float], output: Callable[[float], FloatArray], ones: FloatArray
) -> Callable[[float], FloatArray]:
    """Return the error over time of an output."""
    return lambda at: float(reference(at)) * ones - output(at)


def _peak(size: Callable[[Any], FloatArray], lines: FloatArray) -> tuple[float, float]:
    """Return the largest value of a function of frequency, and where it is."""
    from scipy.optimize import minimize_scalar  # not loaded with the package

    values = size(lines)
    best = float(values.max()), float(lines[np.argmax(values)])
    inner = 1 + np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:]))
    for i in inner[np.argsort(-values[inner])[:PEAKS]]:
        found = minimize_scalar(
            lambda f: -float(size([f])[0]), bounds=(lines[i - 1], lines[i + 1]), method="bounded",
            options={"xatol": 1e-10 * lines[i]},
        )  # fmt: skip
        best = max(best, (-float(found.fun), float(found.x)))
    return best


def _zeros(one: Callable[[float], float], values: FloatArray, lines: FloatArray) -> list[float]:
    """Return the zeros of a function between lines where it changes its sign."""
    from scipy.optimize import brentq  # not loaded with the package

    places = np.flatnonzero((values[:-1] * values[1:] < 0) | (values[:-1] == 0))
    return [float(brentq(one, lines[i], lines[i + 1])) for i in places]
