"""Output-only identification: modes from ambient vibration, with their uncertainty."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, below_half_rate, frequency_band, positive, whole
from ..errors import ModelError, SolverError
from ..lti.sampling import LIGHT
from ..modes.matching import NEAR, assigned, mac_matrix
from ..parallel import Progress, expect, tick
from .diagram import OrderPoles, built_diagram
from .identify import checked_orders
from .measured import MeasuredModes
from .spectra import signals

#: number of periods of the lowest frequency over which covariances are used by default
PERIODS = 2.0
#: the same between two orders; largest relative standard deviation of frequency and of damping:
#: noise poles vary more
SAME, LOOSE = 0.02, 0.6
#: largest differences between orders for a stable pole, and least MAC
TOLERANCES = (0.01, 0.3, 0.9)

#: label of the progress bar
PARTS = "parts of the record"
#: multiplications of a singular value decomposition, relative to the cube of its rows
_DECOMPOSED = 18.0
#: rate relative to the end of the band: the largest that suits, and one that is enough
_HIGHEST, _ENOUGH = 10.0, 5.0


def identify_output_only(
    outputs: Any,
    *,
    rate: float,
    band: tuple[float, float],
    orders: Iterable[int] | None = None,
    lags: int | None = None,
    blocks: int = 20,
    progress: bool | None = None,
) -> MeasuredModes:
    r"""Return poles and shapes from responses only, without a measured excitation.

    The method is covariance-driven stochastic subspace identification. The covariances
    :math:`R_k = \frac{1}{N} \sum_t y_{t+k} y_t^T` of responses to white excitation form the matrix

    .. math:: H = \begin{bmatrix} R_1 & R_2 & \cdots \\ R_2 & R_3 & \cdots \\ \vdots & & \ddots
        \end{bmatrix} = O\,Z, \quad O = [C;\ C A;\ C A^2;\ \ldots].

    A and C are the state and output matrices of a discrete-time model of the machine, O is its
    observability matrix, and Z is the other factor. The leading singular vectors of H give O in
    some basis of the states. A is found from O and the same matrix shifted by one block. The poles
    are :math:`\lambda = rate\,\ln \mu` with the eigenvalues :math:`\mu` of A. This is repeated for
    several model orders (numbers of states). Poles that hardly change from order to order count as
    stable. They are taken from the lowest model order at which the number of stable poles is
    largest, since more states add noise. White sensor noise contributes to :math:`R_0` only, which
    is not used.

    The covariance of each pole is found by a jackknife. The record is divided into b blocks, and
    the poles are computed b times, each time without one block. Their scatter gives the variance.
    The error of a pole, divided by this standard deviation, follows Student's distribution with
    b - 1 degrees of freedom. The variance of this distribution is (b - 1)/(b - 3), and the variance
    of the pole is multiplied by this factor. Poles whose frequency varies by more than 2 % or whose
    damping varies by more than 60 % are taken as noise and left out. A rotating part or mains hum
    appears as a mode with almost no damping. Peaks in the spectrum of an excitation that is not
    white appear as additional modes.

    Parameters
    ----------
    outputs : (n_channel, n_time) array or mapping {name: (n_time,) array}
        Displacements, velocities or accelerations. Several records have the shape
        (n_exp, n_channel, n_time).
    rate : float [Hz]
        Sampling rate. It should be at most ten times the upper end of the band. Otherwise, decimate
        the record first.
    band : (low, high) [Hz]
        Frequency band of the modes.
    orders : iterable of int, optional
        Model orders (numbers of states). None: 4, 6, ..., 40.
    lags : int, optional
        Number of block rows and columns of H. None: two periods of the lowest frequency.
    blocks : int
        Number of blocks of the record, at least 8. Each block should be longer than the slowest
        decay.
    progress : bool, optional
        Whether to show a progress bar. None: a bar is shown on a terminal or in a notebook, for
        work of more than two seconds.

    Returns
    -------
    MeasuredModes
        Modes sorted by frequency, without mode numbers. The shapes have a row for each channel.
        Their scale is not known without the excitation, so that their largest entry is set to 1.
        The covariance is known for each pole separately. Different poles are taken as independent.

    Raises
    ------
    ModelError, ShapeError, SolverError
        When an argument is out of range, the record is too short, or no pole is stable over the
        orders and over the record.

    References
    ----------
    [PeetersDeRoeck1999]_; [Reynders2008]_ (bounds).

    Examples
    --------
    The record is noise that passed through a resonance at 10 Hz:

    >>> import flexplant as fx
    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> noise = np.random.default_rng(0).normal(size=5000)
    >>> r, w = 0.99, 2 * np.pi * 10.0 / 100.0  # a resonance at 10 Hz, sampled at 100 Hz
    >>> y = lfilter([1.0], [1.0, -2 * r * np.cos(w), r**2], noise)[None]
    >>> found = fx.identification.identify_output_only(y, rate=100.0, band=(5.0, 20.0))
    >>> found.freq.round(1)
    array([10.])
    """
    y, names = signals(outputs, "outputs", "y")
    step = 1.0 / positive(rate, "rate")
    low, high = frequency_band(band)
    positive(low, "the lower end of band")
    below_half_rate(high, "the upper end of band", rate)
    listed = checked_orders(range(4, 41, 2) if orders is None else orders)
    wanted = max(2.0, PERIODS * rate / low / 2)
    count = int(np.ceil(wanted)) if lags is None else whole(lags, "lags", minimum=2)
    count = max(count, int(np.ceil(listed[-1] / y.shape[1])) + 1)
    parts = whole(blocks, "blocks", minimum=8)
    long = y.shape[0] * y.shape[2] // parts
    if long < 4 * count:
        raise ModelError(
            f"{parts} blocks of {long} samples are too short for {count} lags: measure longer, or "
            "give fewer blocks= or lags=."
        )
    with Progress(parts, PARTS, progress=progress, advice=_advice(rate, high)):
        expect(_DECOMPOSED * (parts + 1) * (count * y.shape[1]) ** 3)
        share = max(1, round(parts / y.shape[0]))
        pieces = [piece for record in y for piece in np.array_split(record, share, axis=1)]
        means = (piece - piece.mean(axis=1, keepdims=True) for piece in pieces)
        each = np.array([_hankel(block, count) for block in means])
        mean = each.mean(axis=0)
        U, sizes, _ = la.svd(mean)
        inside = (low, high)
        results = [_order_poles(U, sizes, y.shape[1], order, step, inside) for order in listed]
        chosen = built_diagram(results, np.array(inside), TOLERANCES).automatic().poles
        bases = []
        for one in each:
            bases.append(la.svd((parts * mean - one) / (parts - 1)))
            tick(PARTS)
        best: tuple[OrderPoles, FloatArray, Any] | None = None
        for result in results:
            away = np.abs(chosen[:, None] - result.poles) / np.abs(chosen)[:, None]
            like = assigned(away, most=SAME)
            found = result.select(np.sort(like[like >= 0]))
            if found.poles.size <= (0 if best is None else best[2].size):
                continue
            again = (
                _order_poles(left, values, y.shape[1], result.order, step, (0.0, np.inf))
                for left, values, _ in bases
            )
            spread, kept = _jackknife(found, list(again))
            if best is None or kept.size > best[2].size:
                best = found, spread, kept
    if best is None or not best[2].size:
        raise SolverError(
            f"no pole between {low:g} and {high:g} Hz is the same in all parts of the record. "
            "Measure longer, or narrow the band to where resonances stand out of the noise."
        )
    found, spread, kept = best
    covariance, count = np.zeros((2 * kept.size,) * 2), spread.shape[1]
    fair = (count - 1) / (count - 3)
    for i, k in enumerate(kept.tolist()):
        both = [i, i + kept.size]
        covariance[np.ix_(both, both)] = fair * spread[:, :, k] @ spread[:, :, k].T
    shapes = found.shapes[:, kept]
    shapes = shapes / shapes[np.argmax(np.abs(shapes), axis=0), np.arange(kept.size)]
    return MeasuredModes(found.poles[kept], covariance=covariance, shapes=shapes, dofs=names)


def _advice(rate: float, high: float) -> str:
    """Return what makes the work shorter: a lower rate where it is far above the band."""
    factor = int(rate / (_ENOUGH * high))
    if rate <= _HIGHEST * high:
        return "Fewer channels, lags= or blocks= take less."
    return (
        f"The rate is {rate / high:.0f} times the upper end of the band. Decimate the record first "
        f"(scipy.signal.decimate(outputs, {factor}), rate={rate / factor:g}): the work then takes "
        f"about {factor**3} times less."
    )


def _hankel(y: FloatArray, count: int) -> FloatArray:
    """Return H (count n, count n) of one piece."""
    n, long = y.shape
    size = 1 << int(np.ceil(np.log2(2 * long)))
    Y = np.fft.rfft(y, size, axis=1)
    R = np.fft.irfft(Y[:, None] * Y[None].conj(), size, axis=2)[:, :, : 2 * count]
    R = R / (long - np.arange(2 * count))
    rows = [np.hstack([R[:, :, i + j + 1] for j in range(count)]) for i in range(count)]
    return np.vstack(rows).reshape(count * n, count * n)


def _order_poles(
    U: FloatArray, sizes: FloatArray, n: int, order: int, step: float, band: tuple[float, float]
) -> OrderPoles:
    """Return the poles of one order inside the band."""
    O = U[:, :order] * np.sqrt(sizes[:order])  # noqa: E741 - the observability matrix
    A = la.lstsq(O[:-n], O[n:])[0]
    mu, vectors = la.eig(A)
    keep = np.abs(mu) > 0
    poles = np.log(mu[keep]) / step
    shapes = np.asarray(O[:n] @ vectors[:, keep], dtype=np.complex128)
    freq = np.abs(poles) / (2 * np.pi)
    right = (poles.imag > 0) & (poles.real < 0) & (-poles.real < LIGHT * np.abs(poles))
    right &= (freq >= band[0]) & (freq <= band[1])
    chosen = np.flatnonzero(right)[np.argsort(freq[right], kind="stable")]
    shapes = shapes[:, chosen] / np.linalg.norm(shapes[:, chosen], axis=0)
    return OrderPoles(order, poles[chosen], shapes, np.ones((1, chosen.size), complex))


def _jackknife(found: OrderPoles, again: list[OrderPoles]) -> tuple[FloatArray, Any]:
    """Return deviations (2, parts, m) of Re and Im, squared their variance, and which are small."""
    moved = np.array([_like(found, other) for other in again])
    centred = moved - moved.mean(axis=0)
    spread = np.array([centred.real, centred.imag]) * np.sqrt(1 - 1 / len(again))
    std = np.sqrt(np.sum(spread**2, axis=1))
    # NaN where a pole is missing
    small = (std[1] < SAME * np.abs(found.poles)) & (std[0] < LOOSE * -found.poles.real)
    return spread, np.flatnonzero(small)


def _like(found: OrderPoles, other: OrderPoles) -> ComplexArray:
    """Return the poles of another result that match, by frequency and shape, or NaN."""
    moved = np.full(found.poles.size, np.nan + 0j)
    if not other.poles.size:
        return moved
    far = np.abs(other.poles - found.poles[:, None]) / np.abs(found.poles)[:, None]
    like = assigned(far / NEAR - mac_matrix(found.shapes, other.shapes))
    same = (like >= 0) & (far[np.arange(like.size), like] < NEAR)
    moved[same] = other.poles[like[same]]
    return moved
