"""What a controller of several objectives has to keep: norms of channels, and where poles lie."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...checks import FloatArray, Value, between, checked, name_list, positive
from ...errors import require_known
from ...lti.norms import h2_norm, peak_gain
from ...lti.responses import continuous_poles
from ...lti.statespace import StateSpace
from ...plant import StandardPlant
from ...tolerances import TINY
from ..structured.judges import GainJudge, H2Judge, Judge, PeakJudge, problem_on, require_finite_h2

#: samples of an impulse response that are computed together, and at most
_TOGETHER, _LONGEST = 256, 4e6


@dataclass(frozen=True, eq=False, repr=False)
class _ChannelNorm(Value):
    """Some w, some z, and a bound on what happens between."""

    w: tuple[str, ...] | None = field(default=None, metadata=checked(name_list))
    z: tuple[str, ...] | None = field(default=None, metadata=checked(name_list))
    below: float | None = field(default=None, metadata=checked(positive))

    def __repr__(self) -> str:
        sides = f"w={list(self.w or ['all'])}, z={list(self.z or ['all'])}"
        bound = "" if self.below is None else f", below={self.below:g}"
        return f"{type(self).__name__}({sides}{bound})"

    def chosen(self, plant: StandardPlant) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the names of w and z, all where none were given."""
        for side in "wz":
            require_known(f"channel of {side}", getattr(self, side) or (), getattr(plant, side))
        return self.w or plant.w, self.z or plant.z


@dataclass(frozen=True, eq=False, repr=False)
class H2(_ChannelNorm):
    """The H2 norm from w to z: the rms of z for white w of unit intensity.

    Parameters
    ----------
    w, z : sequences of str, optional
        Channels; all when not given.
    below : float, optional
        What it has to stay below; none for what is minimised.

    Examples
    --------
    >>> import flexplant as fx
    >>> sys = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=fx.lowpass(0.1), KS=0.1)
    >>> fx.synthesis.design_lmi(sys, minimize=fx.synthesis.H2()).gamma < 1
    True
    """

    def measured(self, closed: StateSpace) -> float:
        """Return the norm of a closed loop by its Gramians."""
        return h2_norm(closed)

    def judges(self, plant: StandardPlant, order: int) -> list[Judge]:
        """Return what finds the norm for controllers of an order."""
        w, z = self.chosen(plant)
        require_finite_h2(plant, w, z)
        return [H2Judge(problem_on(plant, w, z), order)]


@dataclass(frozen=True, eq=False, repr=False)
class Hinf(_ChannelNorm):
    """The H-infinity norm from w to z: the largest gain over all frequencies.

    Parameters
    ----------
    w, z, below
        As for `H2`.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.Hinf(w=["amp"], z=["die:x"], below=1.0)
    Hinf(w=['amp'], z=['die:x'], below=1)
    """

    def measured(self, closed: StateSpace) -> float:
        """Return the norm of a closed loop."""
        return peak_gain(closed)[0]

    def judges(self, plant: StandardPlant, order: int) -> list[Judge]:
        """Return what finds the norm for controllers of an order."""
        return [GainJudge(problem_on(plant, *self.chosen(plant)), order)]


@dataclass(frozen=True, eq=False, repr=False)
class PeakGain(_ChannelNorm):
    """The largest amplitude of z for w of amplitude one: peak to peak.

    The LMI bounds the length of z for w of length one (the star norm); what is verified is the
    integral (sampled: the sum) of the absolute impulse response of each channel, its gain exactly.

    Parameters
    ----------
    w, z, below
        As for `H2`.
    decay : float [rad/s], optional
        Rate at which the reachable set is taken to shrink; several are tried when not given.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.PeakGain(w=["amp"], z=["die:x"], below=1.0)
    PeakGain(w=['amp'], z=['die:x'], below=1)
    """

    decay: float | None = field(default=None, metadata=checked(positive))

    def measured(self, closed: StateSpace) -> float:
        """Return the largest integral or sum of an absolute impulse response."""
        return impulse_sum(closed) if closed.dt else impulse_integral(closed)

    def judges(self, plant: StandardPlant, order: int) -> list[Judge]:
        """Return what finds the sum of each channel for controllers of an order."""
        w, z = self.chosen(plant)
        return [PeakJudge(problem_on(plant, [i], [o]), order) for i in w for o in z]


@dataclass(frozen=True, eq=False)
class PoleRegion(Value):
    """Where all poles of the closed loop lie, those of the weights that the plant carries too.

    Parameters
    ----------
    decay : float [rad/s]
        Real parts are below -decay; of a sampled plant magnitudes below e^(-decay dt).
    damping : float, optional
        Smallest damping ratio, of a sampled pole z that of ``log(z) / dt``.
    bandwidth : float [Hz], optional
        Largest magnitude of s over 2 pi: no faster poles than the sampling bears; below half the
        rate of a sampled plant.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.PoleRegion(decay=10.0, damping=0.1)
    PoleRegion(decay=10.0, damping=0.1, bandwidth=None)
    """

    decay: float = field(default=0.0, metadata=checked(positive, zero=True))
    damping: float | None = field(
        default=None, metadata=checked(between, low=0.0, high=1.0, hint="It is a ratio below 1.")
    )
    bandwidth: float | None = field(default=None, metadata=checked(positive))

    def outside(self, closed: StateSpace) -> str:
        """Return which pole of a closed loop lies outside, in words; empty when none does."""
        poles = continuous_poles(closed)
        if not poles.size:
            return ""
        slow = poles[np.argmax(poles.real)]
        # a mille of what is required, or rounding of an integrator
        if slow.real > -self.decay * (1 - 1e-3) - (1e-9 if not self.decay else 0.0):
            return f"{slow:.4g} rad/s decays slower than {self.decay:g} rad/s"
        ratio = -poles.real / np.maximum(np.abs(poles), TINY)
        if self.damping is not None and ratio.min() < self.damping * (1 - 1e-3):
            return f"{poles[np.argmin(ratio)]:.4g} rad/s has the damping {ratio.min():.4g}"
        size = np.abs(poles) / (2 * np.pi)
        if self.bandwidth is not None and size.max() > self.bandwidth * (1 + 1e-3):
            return f"a pole lies at {size.max():.4g} Hz"
        return ""


def impulse_integral(closed: StateSpace, *, points: int = 4000) -> float:
    """Return the largest of ``|D_ij| + int |h_ij(t)| dt`` of a stable continuous system."""
    # until the slowest pole has decayed by e^-25; refined until it changes by less than 1e-4
    from scipy.linalg import expm

    poles = closed.poles()
    if not poles.size:
        return float(np.abs(closed.D).max(initial=0.0))
    if not np.max(poles.real) < 0:
        return float("inf")
    end = 25.0 / float(np.min(-poles.real))
    count = int(min(max(points, 20 * end * np.abs(poles.imag).max() / np.pi), 400_000))
    last = np.inf
    for _ in range(4):
        step = expm(closed.A * (end / count))
        x: FloatArray = closed.B.copy()
        total = 0.5 * np.abs(closed.C @ x)
        for _ in range(count):
            x = step @ x
            total += np.abs(closed.C @ x)
        found = float((np.abs(closed.D) + total * (end / count)).max())
        if abs(found - last) < 1e-4 * found or count >= 400_000:
            break
        last, count = found, 2 * count
    return found


def impulse_sum(closed: StateSpace) -> float:
    """Return the largest of ``sum_k |h_ij[k]|`` of a stable sampled system."""
    # until e^-25 of the slowest pole; infinite where that takes more than four million samples
    radius = float(np.abs(closed.poles()).max(initial=0.0))
    # a loop of delays alone is over in a few samples
    speed = -np.log(max(radius, 1e-12))
    if not speed * _LONGEST > 25.0:
        return float("inf")
    count = 1 + int(25.0 / speed) // _TOGETHER
    powers = [np.eye(closed.n_states)]
    for _ in range(_TOGETHER):
        powers.append(closed.A @ powers[-1])
    seen = closed.C @ np.array(powers[:-1])  # C A^k, of a block of samples
    x, total = closed.B.copy(), np.abs(closed.D)
    for _ in range(count + closed.n_states // _TOGETHER + 1):
        total = total + np.sum(np.abs(seen @ x), axis=0)
        x = powers[-1] @ x
    return float(total.max(initial=0.0))
