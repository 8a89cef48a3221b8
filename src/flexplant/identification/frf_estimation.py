"""From time records to frequency responses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy.typing as npt

from ..errors import ModelError, unknown_label
from ..lti.frequency import Frf
from ..values import positive
from .periodic import Periodic, periodic_frf
from .records import dropouts_warned, records
from .spectra import H1Estimator, SpectralMethod, spectral_frf

Signals: TypeAlias = npt.ArrayLike | Mapping[str, Any]


def estimate_frf(
    inputs: Signals,
    outputs: Signals,
    rate: float,
    *,
    reference: Signals | None = None,
    method: SpectralMethod | Periodic | None = None,
    quantity: str | None = None,
) -> Frf:
    r"""Return the FRFs from inputs to outputs, with coherence and variance per line.

    ====================  ==========================================================
    ``H1Estimator(...)``  S_yu S_uu^-1: noise on the outputs, open loop
    ``H2Estimator(...)``  S_yy S_uy^-1: noise on the inputs
    ``HvEstimator(...)``  total least squares: noise on both
    ``Periodic(...)``     Y U^-1 of mean periods: no leakage, noise on both
    with ``reference=r``  S_yr S_ur^-1: under feedback (joint input-output)
    ====================  ==========================================================

    A machine that floats is measured under feedback, where noise finds its way back to the
    inputs and H1 is biased towards ``-1/K``. References r that are not correlated with the noise
    give the process sensitivity PS = S_yr S_rr^-1 and the sensitivity S = S_ur S_rr^-1, and the
    plant is their quotient. The estimate of periodic signals averages the noise away first.

    Parameters
    ----------
    inputs : (n_in, n_time) or (n_exp, n_in, n_time) array, or mapping
        What acts on the machine; a mapping {name: (n_time,) or (n_exp, n_time)} names them.
    outputs : (n_out, n_time) or (n_exp, n_out, n_time) array, or mapping
        What was measured, the same way.
    rate : float [Hz]
        Sampling rate.
    reference : array or mapping, optional
        The excitation added inside the loop, one signal per input.
    method : H1Estimator, H2Estimator, HvEstimator or Periodic
        How to average; ``H1Estimator()`` by default.
    quantity : {"displacement", "velocity", "acceleration"}, optional
        What the outputs are; `Frf.converted` changes it.

    Returns
    -------
    Frf
        With `coherence` (multiple, the same for all inputs), `variance` E|error|^2 of every entry
        and `correlation` of the errors of different outputs; the last three are None where a
        single period says nothing about noise; with the `resolution`, and the `window` and
        `overlap` of segments.

    Warns
    -----
    FlexplantWarning
        When an output keeps one value for longer than quantisation explains: a drop-out. With
        `Periodic`: when the inputs do not repeat after the stated period (it or the rate is
        wrong), or when a transient has not died away, with the periods to discard.

    Raises
    ------
    ModelError, ShapeError, LabelError
        When records do not belong together, are too short, or inputs are dependent.

    References
    ----------
    [BendatPiersol2010]_, ch. 6, 7 and 9 (estimators, coherence, variance);
    [PintelonSchoukens2012]_, ch. 2, 3 and 7 (periodic, under feedback).

    Examples
    --------
    >>> from flexplant.identification import Periodic, estimate_frf, multisine
    >>> u = multisine(1, rate=100.0, period=1.0, periods=3, rng=1)
    >>> y = 2.0 * u
    >>> frf = estimate_frf({"force": u[:, 0]}, y, 100.0, method=Periodic(period=1.0))
    >>> print(frf, f"{abs(frf['y1', 'force'][0]):.3f}")
    <Frf: force -> y1, 49 frequencies 1 .. 49 Hz> 2.000
    """
    data = records(inputs, outputs, reference, positive(rate, "rate"))
    if quantity not in (None, "displacement", "velocity", "acceleration"):
        raise unknown_label("quantity", quantity, ["displacement", "velocity", "acceleration"])
    dropouts_warned(data)
    method = H1Estimator() if method is None else method
    if isinstance(method, Periodic):
        return periodic_frf(data, method, quantity)
    if isinstance(method, SpectralMethod):
        return spectral_frf(data, method, quantity)
    raise ModelError(
        "method is H1Estimator(...), H2Estimator(...), HvEstimator(...) or Periodic(...), got "
        f"{type(method).__name__}."
    )
