"""Structural damping by a loss factor, and the error of its viscous equivalent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import ModelError
from ..values import FloatArray, positive, real_array
from .damping import Damping


@dataclass(frozen=True, eq=False, repr=False)
class Hysteretic(Damping):
    """Structural damping ``K (1 + i eta)``, as the viscous damping of equal loss at resonance.

    A loss factor has no equation of motion (its free response is not causal), so that modes and
    plants take ``zeta = eta / 2`` in its place. Of a mode's response
    ``1 / (omega_i^2 (1 + i eta) - omega^2)`` the equivalent one is, relatively, off by

        ``eta |1 - r| / sqrt((1 - r^2)^2 + eta^2 r^2)``,  ``r = omega / omega_i``:

    nothing at resonance, eta / (1 + r) away from it, eta at most (statically, where the hysteretic
    response alone has a loss). `error` gives it, `response_error` bounds a whole response.

    Parameters
    ----------
    loss_factor : float [-]
        eta, in [0, 2): the energy lost in a cycle over 2 pi times the largest energy stored.

    Raises
    ------
    ModelError
        When the loss factor is not in [0, 2).

    References
    ----------
    [Ewins2000]_, sections 2.4 and 2.7.

    Examples
    --------
    >>> law = Hysteretic(0.02)
    >>> law.zeta([0.0, 100.0]), law.error([0.0, 50.0, 100.0], [100.0])[:, 0].round(4)
    (array([0.  , 0.01]), array([0.02  , 0.0133, 0.    ]))
    """

    loss_factor: float

    def __post_init__(self) -> None:
        eta = positive(self.loss_factor, "loss_factor", zero=True)
        if eta >= 2:
            raise ModelError(
                f"loss_factor must be below 2, got {eta:g}: the equivalent damping ratio is half "
                "of it, and from 1 on there is no oscillation left. Give 0.02 for 2 %."
            )
        self._set(loss_factor=eta)

    def __repr__(self) -> str:
        return f"<Hysteretic, loss factor {self.loss_factor:g}>"

    def zeta(self, omega: FloatArray) -> FloatArray:
        """Return the damping ratios (k,) of modes at `omega` [rad/s]: eta / 2, 0 for rigid ones."""
        omega = real_array(omega, "omega", (None,))
        return np.where(omega > 0, 0.5 * self.loss_factor, 0.0)

    def error(self, freq: FloatArray, natural: FloatArray) -> FloatArray:
        """Return by how much, relatively, the viscous responses of modes differ (n_freq, k).

        Parameters
        ----------
        freq : (n_freq,) array [Hz]
            Where.
        natural : (k,) array [Hz]
            Natural frequencies; rigid-body modes (0) differ by nothing.

        Raises
        ------
        ModelError
            When a frequency is negative.
        """
        at, own = _frequencies(freq, "freq")[:, None], _frequencies(natural, "natural")
        r = at / np.where(own > 0, own, 1.0)
        eta = self.loss_factor
        size = np.sqrt((1 - r**2) ** 2 + (eta * r) ** 2)
        # without loss both are infinite at resonance, and the same
        found = eta * np.abs(1 - r) / np.where(size > 0, size, 1.0)
        return np.asarray(np.where(own > 0, found, 0.0), dtype=np.float64)

    def response_error(
        self, freq: FloatArray, natural: FloatArray, gains: FloatArray
    ) -> FloatArray:
        """Return a bound (n_freq,) of the difference between hysteretic and viscous responses.

        The sum over the modes of ``|gain_i| |h_viscous - h_hysteretic|``: equality for one mode.

        Parameters
        ----------
        freq : (n_freq,) array [Hz]
            Where; above 0 when there are rigid-body modes.
        natural : (k,) array [Hz]
            Natural frequencies.
        gains : (k,) array [1/kg]
            ``phi_out phi_in`` of each mode, of mass-normalised shapes: receptance [m/N].

        Raises
        ------
        ModelError, ShapeError
            When a frequency is negative or the sizes differ.
        """
        own = _frequencies(natural, "natural")
        weights = np.abs(real_array(gains, "gains", own.shape))
        relative = self.error(freq, own)
        at, omega = 2 * np.pi * real_array(freq, "freq")[:, None], 2 * np.pi * own
        stiffness = np.abs(omega**2 * (1 + 1j * self.loss_factor) - at**2)
        part = relative / np.where(stiffness > 0, stiffness, 1.0)
        return np.asarray(part @ weights, dtype=np.float64)


def _frequencies(value: Any, name: str) -> FloatArray:
    found = real_array(value, name, (None,))
    if np.any(found < 0):
        raise ModelError(f"{name} must not be negative, got {found.min():g} Hz. Take its size.")
    return found
