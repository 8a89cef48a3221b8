"""What an identification found: poles with their covariance, shapes, and the FRF they make."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import ModelError
from ..lti.frequency import Frf, checked_freq
from ..values import ComplexArray, FloatArray
from .basis import axis, residual_terms, seen_terms
from .diagram import StabilisationDiagram
from .measured import MeasuredModes


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiedModes(MeasuredModes):
    r"""Measured modes with all results of the fit; made by `identify_modes`.

    .. math:: H(s) = \sum_k \frac{\psi_k l_k^T}{s - \lambda_k}
        + \frac{\bar\psi_k \bar l_k^T}{s - \bar\lambda_k} + E(s)

    Parameters
    ----------
    poles, modes, covariance, shapes, dofs
        As in `MeasuredModes`; shapes psi_k at the outputs.
    participation : (n_in, m) complex array
        l_k, of the inputs.
    inputs, outputs : sequences of str
        Names of the channels.
    input_dofs : sequence of n_in str
        Labels of the inputs' DOFs, or their names where no DOF is known.
    terms : (n_out, n_in, lower + upper) array
        E(s), coefficients of powers of s scaled by the largest frequency.
    lower : int
        How many of them are 1/s, 1/s^2, ...
    top : float [Hz]
        The largest frequency.
    hold : float [Hz], optional
        Rate of the zero-order hold in the measurement.
    segment : float [s], optional
        Length of the Hann-windowed segments through which the poles were fitted.
    unreported : complex array
        Poles just outside the band that help the fit, then their shapes and participation.
    mass_normalised : bool
        Whether shapes satisfy phi^T (2 lambda M + D) phi = 2i Im(lambda), as those of a model
        do: where an input and an output share a DOF. Otherwise their largest entry is 1.
    misfit : float
        Cost per degree of freedom; 1 when only noise of the stated variance is left.
    diagram : StabilisationDiagram, optional
        The poles were chosen from.
    channel_covariance : (m, n_out + n_in, n_out + n_in) complex array, optional
        E[n n^H] of the error n of each mode's [shape; participation], that of their scale
        included, from the FRF's variance and the correlation of its outputs' errors (where not
        known, they are taken for independent).

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> freq = np.arange(10.0, 40.0, 0.1)
    >>> H = 1 / (20.0**2 - freq**2 + 0.4j * freq)
    >>> found = fx.identify_modes(fx.Frf(freq, H[None, None]))
    >>> found.freq.round(3), found.zeta.round(4)
    (array([20.]), array([0.01]))
    """

    participation: ComplexArray = field(kw_only=True)
    inputs: tuple[str, ...] = field(kw_only=True)
    outputs: tuple[str, ...] = field(kw_only=True)
    input_dofs: tuple[str, ...] = field(default=(), kw_only=True)
    terms: FloatArray = field(kw_only=True)
    lower: int = field(kw_only=True)
    top: float = field(kw_only=True)
    hold: float | None = field(default=None, kw_only=True)
    segment: float | None = field(default=None, kw_only=True)
    unreported: tuple[ComplexArray, ComplexArray, ComplexArray] = field(kw_only=True)
    mass_normalised: bool = field(default=False, kw_only=True)
    misfit: float = field(kw_only=True)
    diagram: StabilisationDiagram | None = field(default=None, kw_only=True)
    channel_covariance: ComplexArray | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shapes is None:
            raise ModelError("identified modes have shapes at their outputs.")
        self._set(
            input_dofs=tuple(self.input_dofs) or tuple(self.inputs),
            participation=self.participation,
            terms=self.terms,
            channel_covariance=self.channel_covariance,
        )

    @property
    def shape_covariance(self) -> ComplexArray | None:
        """E[n n^H] (m, n_out, n_out) of the error n of each shape, None where not known."""
        count, spread = len(self.outputs), self.channel_covariance
        return None if spread is None else spread[:, :count, :count]

    def frf(self, freq: FloatArray, *, as_measured: bool = False) -> Frf:
        """Return the identified response (displacement per input), to compare or to extend.

        Parameters
        ----------
        freq : (n_freq,) array [Hz]
            Positive; outside the identified band the residual terms do not hold.
        as_measured : bool
            As the lines of the windowed segments show it, where the poles were fitted so: with
            lower and wider resonances than those of the machine.

        Raises
        ------
        ModelError
            When a frequency is not positive.
        """
        freq = checked_freq(freq)
        if freq.size and freq.min() <= 0:
            raise ModelError("freq must be positive: a free machine has no response at zero.")
        s = axis(freq)
        poles, shapes, participation = self.unreported
        assert self.shapes is not None  # noqa: S101 - checked when made
        poles = np.concatenate([self.poles, poles])
        shapes = np.concatenate([self.shapes, shapes], axis=1)
        participation = np.concatenate([self.participation, participation], axis=1)
        segment = self.segment if as_measured else None
        plus, _ = seen_terms(poles, s, self.hold, segment)
        minus, _ = seen_terms(poles.conj(), s, self.hold, segment)
        data = np.einsum("ok,ik,kf->oif", shapes, participation, plus)
        data += np.einsum("ok,ik,kf->oif", shapes.conj(), participation.conj(), minus)
        upper = self.terms.shape[2] - self.lower
        smooth = residual_terms(
            s, lower=self.lower, upper=upper, hold=self.hold, top=2 * np.pi * self.top
        )
        data += self.terms @ smooth
        return Frf(freq, data, inputs=self.inputs, outputs=self.outputs, quantity="displacement")

    def _picked(self, places: list[int]) -> dict[str, Any]:
        spread = self.channel_covariance
        return super()._picked(places) | {
            "participation": self.participation[:, places],
            "channel_covariance": None if spread is None else spread[places],
        }
