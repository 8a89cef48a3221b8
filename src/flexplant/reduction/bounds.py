"""Bounds of the error of a truncation: over all frequencies, and below one of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..checks import FloatArray, Value, checked, name_list, positive, real_array, whole
from ..errors import counted
from .ranking import peak_gains


@dataclass(frozen=True, eq=False, repr=False)
class ErrorBound(Value):
    """A bound of the error of a reduction, known before any response is computed.

    Parameters
    ----------
    value : float [m/N]
        At least the largest singular value, over all frequencies, of full minus reduced
        displacement per force between the channels.
    inputs, outputs : sequence of str
        The channels it holds for.
    rule : str
        Where it comes from.
    terms : (k, 3) array, optional
        Gain ``||c|| ||b||`` [1/kg], frequency [rad/s] and damping ratio of all that differs, mode
        by mode; they make the bound below a frequency.
    static : float [m/N], optional
        What is missed at 0 Hz, exactly.
    covers : int, optional
        How many modes of the structure it covers, where only some were solved: the error of a
        reduction of these. What others add is not in it. None: all modes.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> light = fx.ModalDamping(0.01)
    >>> method = fx.ModalTruncation(2, inputs=["1:x"], outputs=["3:x"], damping=light)
    >>> round(fx.reduce(model, method).bound.value, 9)
    6.945e-06
    """

    value: float = field(metadata=checked(positive, zero=True, unit="m/N"))
    inputs: tuple[str, ...] = field(metadata=checked(name_list))
    outputs: tuple[str, ...] = field(metadata=checked(name_list))
    rule: str
    terms: FloatArray | None = field(
        default=None, kw_only=True, metadata=checked(real_array, shape=(None, 3))
    )
    static: float | None = field(default=None, kw_only=True, metadata=checked(positive, zero=True))
    covers: int | None = field(default=None, kw_only=True, metadata=checked(whole))

    def __repr__(self) -> str:
        some = (
            "" if self.covers is None else f", of the {counted(self.covers, 'mode')} solved alone"
        )
        return (
            f"<ErrorBound {self.value:.4g} m/N, {counted(len(self.inputs), 'input')} to "
            f"{len(self.outputs)} outputs: {self.rule}{some}>"
        )

    def below(self, freq: float) -> float:
        """Return the bound [m/N] for all frequencies up to one.

        Modes above the band are far from their peaks: the sum over the neglected modes of the
        largest ``g_i |h_i(w)|`` there, or, where that is less, the static error and the sum of the
        largest ``g_i |h_i(w) - h_i(0)|``. Never more than `value`.

        Parameters
        ----------
        freq : float [Hz]
            The upper end of the band.

        Raises
        ------
        ModelError
            When it is not positive.
        """
        top = 2 * np.pi * positive(freq, "freq")
        if self.terms is None:
            return self.value
        gain, omega, zeta = np.asarray(self.terms).T
        found = min(self.value, float(gain @ _largest(omega, zeta, top)))
        if self.static is not None:
            found = min(found, self.static + float(gain @ _largest_change(omega, zeta, top)))
        return found


def _largest(omega: FloatArray, zeta: FloatArray, top: float) -> FloatArray:
    """Return the largest ``1 / |omega^2 - w^2 + 2 i zeta omega w|`` for w up to `top`."""
    r = top / omega
    peak = peak_gains(omega, zeta)
    with np.errstate(divide="ignore"):
        at_top = 1 / (omega**2 * np.hypot(1 - r**2, 2 * zeta * r))
    # rising up to the peak, where there is one; else falling from the start
    rising = r**2 < 1 - 2 * zeta**2
    return np.asarray(np.where(rising, at_top, peak), dtype=np.float64)


def _largest_change(omega: FloatArray, zeta: FloatArray, top: float) -> FloatArray:
    """Return the largest departure of the same response from its value at 0, for w up to `top`.

    With ``x = w^2 / omega^2`` and ``a = 4 zeta^2`` its square is, times omega^4,
    ``(x^2 + a x) / ((1 - x)^2 + a x)``, rising up to ``x = (1 + sqrt(1 + 2 a)) / 2``.
    """
    a = 4 * zeta**2
    x = np.minimum((top / omega) ** 2, 0.5 * (1 + np.sqrt(1 + 2 * a)))
    with np.errstate(divide="ignore"):
        return np.asarray(np.sqrt((x**2 + a * x) / ((1 - x) ** 2 + a * x)) / omega**2)
