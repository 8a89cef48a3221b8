"""A loop broken between plant and controller: its gain and distance to the critical point."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from ..errors import LabelError
from ..lti.grid import highest, resonance_grid
from ..lti.responses import Responder
from ..lti.statespace import StateSpace
from ..values import ComplexArray, FloatArray, short

Side = Literal["u", "y"]
#: loop gain below which |S| is within 1 / (1 - 0.05)
_SMALL = 0.05
#: change of a loop gain of 1, relative to it, that makes I - L regular
_BESIDE = 1e-15


@dataclass(frozen=True)
class BrokenLoop:
    """A loop broken into plant and controller: y = P u, u = K y.

    Parameters
    ----------
    u, y : tuple of str
        The channels between the two.
    controller, plant : function of frequency [Hz]
        K (nu, ny, n_freq) and P (ny, nu, n_freq).
    poles : function
        Of the closed loop; of the controller when the plant was measured.
    dt : float [s]
        Sampling time, 0 when continuous.
    measured : (n_freq,) array [Hz], optional
        The frequencies of a measured plant.
    units : mapping {channel: unit}
        Of the u and y where they are known.
    """

    u: tuple[str, ...]
    y: tuple[str, ...]
    controller: Responder
    plant: Responder
    poles: Callable[[], ComplexArray]
    dt: float
    measured: FloatArray | None = None
    units: Mapping[str, str] = field(default_factory=dict)

    def respond(self, freq: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return K (n_freq, nu, ny) and P (n_freq, ny, nu)."""
        K, P = self.controller(freq), self.plant(freq)
        return np.ascontiguousarray(K.transpose(2, 0, 1)), np.ascontiguousarray(
            P.transpose(2, 0, 1)
        )

    def gain(self, freq: FloatArray, at: Side = "u") -> ComplexArray:
        """Return K P (broken at u) or P K (at y), frequency first.

        Raises
        ------
        LabelError
            When `at` is neither.
        """
        if at not in ("u", "y"):
            raise LabelError(f"a loop is broken at 'u' or 'y', got {short(at)}. Pass one of them.")
        K, P = self.respond(freq)
        return K @ P if at == "u" else P @ K

    @cached_property
    def grid(self) -> FloatArray:
        """Frequencies [Hz] through the resonances of the closed loop, or those measured."""
        if self.measured is not None:
            return self.measured
        return resonance_grid(self.poles(), self.dt)

    @property
    def is_unstable(self) -> bool:
        """Whether a pole is not strictly inside the stability region; a measured plant has none."""
        if self.measured is not None:
            return False
        poles = self.poles()
        edge = np.abs(poles) - 1.0 if self.dt else poles.real
        return bool(np.max(edge, initial=-1.0) >= 0)

    @cached_property
    def worst(self) -> tuple[float, float]:
        """The largest sigma_max(S_u) and its frequency [Hz], over a grid refined at its peaks."""
        rounds = 6 if self.measured is None else 0
        return highest(lambda freq: sensitivity_size(self.gain(freq)), self.grid, rounds)

    @property
    def modulus_margin(self) -> float:
        """``1 / max_f sigma_max(S_u)``; 0 when unstable."""
        return 0.0 if self.is_unstable else 1.0 / self.worst[0]


def inverted(L: ComplexArray) -> ComplexArray:
    """Return (I - L)^-1, frequency first; on the critical point that of a gain next to it."""
    eye = np.eye(L.shape[-1])
    try:
        return np.asarray(np.linalg.inv(eye - L))
    except np.linalg.LinAlgError:  # a marginal loop at the frequency of its pole
        return np.asarray(np.linalg.inv(eye - (1.0 - _BESIDE) * L))


def largest(S: ComplexArray) -> FloatArray:
    """Return the largest singular value at each frequency: the root of an eigenvalue of S* S."""
    return np.asarray(np.sqrt(np.linalg.eigvalsh(S.conj().swapaxes(1, 2) @ S)[:, -1]))


def sensitivity_size(L: ComplexArray) -> FloatArray:
    """Return sigma_max of ``S = (I - L)^-1`` at each frequency, a lower bound where L is small.

    Where the Frobenius norm of L is l < 0.05, sigma_max lies between 1 / (1 + l), which is given,
    and 1 / (1 - l) < 1.053; when no larger value is found elsewhere, all are computed.
    """
    small = np.sqrt(np.sum(L.real**2 + L.imag**2, axis=(1, 2)))
    acts = small >= _SMALL
    size = 1.0 / (1.0 + small)
    if np.any(acts):
        size[acts] = largest(inverted(L[acts]))
    if size.max(initial=0.0) < 1.0 / (1.0 - _SMALL):
        size[~acts] = largest(inverted(L[~acts]))
    return np.asarray(size)


def moved(g: StateSpace) -> tuple[str, ...]:
    """Return the outputs that can move: their rows see a state or an input."""
    moves = np.any(g.C != 0, axis=1) | np.any(g.D != 0, axis=1)
    return tuple(name for name, one in zip(g.outputs, moves, strict=True) if one)
