"""A loop on other machines than its plant: with the modes left out, and drawn at random."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.linalg as la

from ..certificates import one_line, stability_name
from ..checks import FloatArray, IntArray, Value, checked, floats
from ..errors import ModelError
from ..lti.statespace import StateSpace
from ..tolerances import TINY

#: a mode with less than this part of the one that takes part most is not named
_TAKES_PART = 0.3
#: |S| at u above which modes left out are warned of (8 dB), and how much larger than without them
_HIGH, _LARGER = 2.5, 1.1
#: so many modes are named in a message
_NAMED = 4


@dataclass(frozen=True, eq=False, repr=False)
class SpillOver(Value):
    """The check of a loop on the plant with the modes left out, sampled and delayed alike.

    Parameters
    ----------
    stability : float
        Spectral radius of the sampled closed loop there, below 1 when stable; of a continuous one
        the largest real part [rad/s], below 0.
    sampled : bool
        Which of both it is.
    modulus_margin : float
        There, broken at u; 0 when unstable.
    without : float
        Modulus margin on the plant itself, without these modes; 0 when unstable there.
    peak_freq : float [Hz]
        Where |S| at u is largest with them; NaN when unstable.
    states : int
        Of the plant with the modes left out.
    modes : sequence of int
        Numbers (from 1, rigid-body modes included) of the modes of that plant which take part most
        in what grows, or in the peak of |S| at u where this is `high`; empty otherwise.
    freq : sequence of float [Hz]
        Of that, one for each of these modes.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0] * 4, stiffnesses=[4e5] * 3)
    >>> modes = fx.solve_modes(model, count=4, damping=fx.ModalDamping(0.01))
    >>> ports = fx.testbeds.three_masses().assembled.ports
    >>> plant = fx.assemble_plant(modes.select([0, 1, 2]), ports).discretized(2e3, delay=1)
    >>> observer = fx.design_kalman(plant, larger=modes)
    >>> servo = fx.design_servo(plant, bandwidth=10.0, observer=observer, larger=modes)
    >>> fx.close_loop(plant, observer, servo, larger=modes).left_out.is_stable
    True
    """

    stability: float
    sampled: bool
    modulus_margin: float
    without: float
    peak_freq: float
    states: int
    modes: tuple[int, ...] = ()
    freq: tuple[float, ...] = ()

    @property
    def is_stable(self) -> bool:
        """Whether the loop is stable there."""
        return self.stability < (1.0 if self.sampled else 0.0)

    @property
    def is_high(self) -> bool:
        """Whether the loop is stable, but the modes left out bring |S| at u above 8 dB."""
        return self.is_stable and high(self.modulus_margin, self.without)

    @property
    def is_fine(self) -> bool:
        """Whether the modes left out change nothing that a design should be warned of."""
        return self.is_stable and not self.is_high

    @property
    def spectral_radius(self) -> float:
        """Largest magnitude of the closed loop's eigenvalues there; of a sampled loop.

        Raises
        ------
        ModelError
            In continuous time, where `stability` is the largest real part.
        """
        if not self.sampled:
            raise ModelError("the spectral radius belongs to sampled loops: use stability.")
        return self.stability

    @property
    def certificate(self) -> dict[str, float]:
        """The numbers, named for a certificate."""
        return {
            f"{self._measure} with modes left out": self.stability,
            "modulus margin with modes left out": self.modulus_margin,
        }

    @property
    def _measure(self) -> str:
        return stability_name(self.sampled)

    @property
    def named_modes(self) -> str:
        """The modes that take part in what grows or peaks, in words."""
        return modes_in_words(self.modes, self.freq)

    def __repr__(self) -> str:
        return f"<SpillOver: {self.summary}>"

    @property
    def summary(self) -> str:
        """The finding in one line."""
        found = one_line({self._measure: self.stability})
        if not self.is_stable:
            return f"unstable ({self.states} states), {found}: {self.named_modes}"
        there = f"stable ({self.states} states), {found}, |S| at u up to {_db(self.modulus_margin)}"
        if not self.is_high:
            return there
        return (
            f"{there} at {self.peak_freq:.4g} Hz where it is at most {_db(self.without)} without "
            f"them: {self.named_modes}"
        )


def _db(margin: float) -> str:
    return f"{-20.0 * np.log10(margin):.3g} dB"


def modes_in_words(modes: Sequence[int], freq: Sequence[float]) -> str:
    """Return modes in words, the first few of many."""
    listed = [f"mode {n} (at {f:.4g} Hz)" for n, f in zip(modes, freq, strict=True)]
    more = len(listed) - _NAMED
    first = ", ".join(listed[:_NAMED]) or "no mode named"
    return first + (f" and {more} more" if more > 0 else "")


def high(margin: float, without: float) -> bool:
    """Return whether modes make |S| at u larger than 8 dB: margins with and without them."""
    return margin < min(1.0 / _HIGH, without / _LARGER)


def growing_modes(
    loop: StateSpace, states: Sequence[str], near: float | None = None
) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Return the numbers of the modes that take part in what grows, and its frequencies [Hz]."""
    # by participation factors |left_k right_k| [PerezArriaga1982]_, whatever the units of states
    numbers = _mode_of_state(states, loop.n_states)
    if not np.any(numbers):
        return (), ()
    eigen: Any = la.eig(loop.A, left=True, right=True)
    values, left, right = eigen
    edge = np.abs(values) - 1.0 if loop.dt else values.real
    if near is None:
        looked_at = np.flatnonzero((edge >= 0) & (values.imag >= 0))
        looked_at = looked_at[np.argsort(-edge[looked_at], kind="stable")]
    else:
        turn = 2j * np.pi * near
        turned = np.exp(turn * loop.dt) if loop.dt else turn
        looked_at = np.argsort(np.abs(values - turned), kind="stable")[:1]
    found: dict[int, float] = {}
    for i in looked_at:
        part = np.abs(left[:, i] * right[:, i])
        share = _mode_shares(part, numbers)
        pole = np.log(values[i]) / loop.dt if loop.dt else values[i]
        for number in np.flatnonzero(share >= max(_TAKES_PART * share.max(), TINY)).tolist():
            found.setdefault(number, float(abs(pole.imag) / (2.0 * np.pi)))
    return tuple(found), tuple(found.values())


def _mode_of_state(states: Sequence[str], size: int) -> IntArray:
    """Return the mode that each state belongs to, 0 for other states."""
    numbers = np.zeros(size, dtype=np.int64)
    for i, name in enumerate(states):
        head, _, part = name.partition(":")
        if part in ("q", "v") and head.startswith("mode") and head[4:].isdigit():
            numbers[i] = int(head[4:])
    return numbers


def _mode_shares(part: FloatArray, numbers: IntArray) -> FloatArray:
    share = np.bincount(numbers, weights=part)
    share[0] = 0.0
    return np.asarray(share)


@dataclass(frozen=True, eq=False, repr=False)
class MachineDraws(Value):
    """The modulus margins of one controller on machines drawn from an uncertainty.

    Everything that is uncertain is off at once: at delta = 1 two standard deviations unless the
    uncertain plant says otherwise.

    Parameters
    ----------
    margins : (n,) array
        Modulus margin at u on each machine, 0 where the loop is unstable there.
    margin : float
        The one that shall be kept.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.loop.MachineDraws([0.5, 0.4, 0.3, 0.0], margin=0.35)
    <MachineDraws: 3 of 4 stable, 2 keep a modulus margin of 0.35, the least is 0>
    """

    margins: FloatArray = field(metadata=checked(floats))
    margin: float

    @property
    def stable(self) -> float:
        """The share of machines on which the loop is stable."""
        return float(np.mean(self.margins > 0))

    @property
    def kept(self) -> float:
        """The share of machines on which it keeps the margin."""
        return float(np.mean(self.margins >= self.margin))

    @property
    def summary(self) -> str:
        """The counts in words."""
        n = self.margins.size
        stable, kept = (np.count_nonzero(self.margins > 0), round(n * self.kept))
        return (
            f"{stable} of {n} stable, {kept} keep a modulus margin of {self.margin:.3g}, the least "
            f"is {self.margins.min():.3g}"
        )

    def __repr__(self) -> str:
        return f"<MachineDraws: {self.summary}>"
