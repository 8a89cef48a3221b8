"""Damping as a ratio per mode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import ModelError, ShapeError
from ..values import FloatArray, Value, positive, real_array


class Damping(Value):
    """How a structure is damped, as a damping ratio for any frequency."""

    def zeta(self, omega: FloatArray) -> FloatArray:
        """Return the damping ratios of modes; rigid-body modes (omega = 0) are undamped.

        Parameters
        ----------
        omega : (k,) array [rad/s]
            Undamped frequencies.

        Returns
        -------
        (k,) array [-]
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False, repr=False)
class ModalDamping(Damping):
    """A damping ratio for all modes, or one for each: Z in equation (5) of the paper.

    Parameters
    ----------
    ratio : float or (k,) array [-]
        In [0, 1). An array counts rigid-body modes too, which stay undamped.

    Raises
    ------
    ModelError
        When a ratio is negative, or 1 and more.

    Examples
    --------
    >>> ModalDamping(0.01).zeta([0.0, 1500.0])
    array([0.  , 0.01])
    """

    ratio: float | FloatArray

    def __post_init__(self) -> None:
        ratio = real_array(self.ratio, "ratio")
        if ratio.ndim > 1:
            raise ShapeError(f"ratio must be a number or one per mode, got shape {ratio.shape}.")
        if np.any(ratio < 0) or np.any(ratio >= 1):
            worst = ratio.min() if np.any(ratio < 0) else ratio.max()
            raise ModelError(
                f"damping ratios must be in [0, 1), got {worst:g}: 1 % is 0.01. Negative ones feed "
                "energy in, and from 1 on there is no oscillation left."
            )
        self._set(ratio=float(ratio) if ratio.ndim == 0 else ratio)

    def __repr__(self) -> str:
        if isinstance(self.ratio, float):
            return f"<ModalDamping {self.ratio:g}>"
        low, high = np.min(self.ratio, initial=1.0), np.max(self.ratio, initial=0.0)
        return f"<ModalDamping of {np.size(self.ratio)} modes, {low:g} to {high:g}>"

    def zeta(self, omega: FloatArray) -> FloatArray:
        """Return the damping ratios (k,) of modes at `omega` [rad/s]; 0 for rigid-body modes.

        Raises
        ------
        ShapeError
            When there is one ratio per mode and their numbers differ.
        """
        omega = real_array(omega, "omega", (None,))
        if not isinstance(self.ratio, float) and self.ratio.shape != omega.shape:
            raise ShapeError(
                f"{self.ratio.size} damping ratios for {omega.size} modes (rigid-body modes and "
                "vectors counted): give one ratio for all, or exactly one for each."
            )
        return np.where(omega > 0, self.ratio, 0.0)


@dataclass(frozen=True, eq=False, repr=False)
class Rayleigh(Damping):
    """Damping ``D = alpha M + beta K``: ratio ``alpha / (2 omega) + beta omega / 2``.

    Rigid-body modes are left undamped: a structure in free flight has nothing to rub on.

    Parameters
    ----------
    alpha : float [1/s]
        Mass-proportional part.
    beta : float [s]
        Stiffness-proportional part.

    Examples
    --------
    >>> Rayleigh(alpha=2.0, beta=0.0).zeta([0.0, 100.0])
    array([0.  , 0.01])
    """

    alpha: float
    beta: float

    def __post_init__(self) -> None:
        self._set(
            alpha=positive(self.alpha, "alpha", zero=True),
            beta=positive(self.beta, "beta", zero=True),
        )

    def __repr__(self) -> str:
        return f"<Rayleigh alpha {self.alpha:g} 1/s, beta {self.beta:g} s>"

    def zeta(self, omega: FloatArray) -> FloatArray:
        """Return the damping ratios (k,) of modes at `omega` [rad/s]; 0 for rigid-body modes."""
        omega = real_array(omega, "omega", (None,))
        safe = np.where(omega > 0, omega, 1.0)
        ratio = 0.5 * (self.alpha / safe + self.beta * safe)
        return np.asarray(np.where(omega > 0, ratio, 0.0), dtype=np.float64)
