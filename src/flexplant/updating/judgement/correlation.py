"""How alike model and measurement are: frequencies, MAC, FRAC, FDAC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...checks import ComplexArray, FloatArray, Value, complex_array
from ...errors import ModelError, ShapeError
from ...identification import MeasuredModes
from ...modes import matching
from ..point_model import Point
from ..residuals.frf_residual import FrfResidual
from ..residuals.mode_shapes import ModeShapes
from ..search import Objective, checked_residuals

#: groups of modes in a repr
SHOWN = 4


def mac(X: Any, Y: Any) -> FloatArray:
    """Return the modal assurance criterion (m, m') of each shape of X with each of Y.

    ``|x^H y|^2 / (x^H x  y^H y)``, 1 for shapes that differ by a factor only.

    Parameters
    ----------
    X, Y : (n, m), (n, m') real or complex arrays
        Shapes in columns.

    Raises
    ------
    ShapeError, ModelError
        When sizes differ, entries are not finite, or a shape is zero.

    References
    ----------
    [AllemangBrown1982]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.updating.mac([[1.0], [0.0]], [[1.0, 1.0], [0.0, 1.0]]).round(6)
    array([[1. , 0.5]])
    """
    left, right = _nonzero_shapes(X, "X"), _nonzero_shapes(Y, "Y")
    if left.shape[0] != right.shape[0]:
        raise ShapeError(f"X has {left.shape[0]} rows and Y {right.shape[0]}.")
    return matching.mac_matrix(left, right)


def frac(H: Any, G: Any) -> FloatArray:
    """Return the frequency response assurance criterion of each channel pair, from 0 to 1.

    ``|sum_f H* G|^2 / (sum |H|^2  sum |G|^2)`` over the frequency lines.

    Parameters
    ----------
    H, G : (..., n_freq) complex arrays
        Measured and computed responses.

    Raises
    ------
    ShapeError, ModelError
        When sizes differ or a response is zero.

    References
    ----------
    [HeylenLammens1996]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.updating.frac([[[1.0, 2.0j]]], [[[2.0, 4.0j]]]).round(6)  # scale does not count
    array([[1.]])
    """
    a, b = _checked_responses(H, G)
    product = np.abs(np.sum(a.conj() * b, axis=-1)) ** 2
    size = np.sum(np.abs(a) ** 2, axis=-1) * np.sum(np.abs(b) ** 2, axis=-1)
    if np.any(size == 0):
        raise ModelError("a response is zero at all lines: its FRAC is not defined.")
    return np.asarray(product / size, dtype=np.float64)


def fdac(H: Any, G: Any) -> FloatArray:
    """Return the frequency domain assurance criterion of all pairs of lines, from -1 to 1.

    ``Re(h_f^H g_g) / (|h_f| |g_g|)`` with h_f all channels of H at line f: a frequency shift shows
    as a ridge beside the diagonal.

    Parameters
    ----------
    H, G : (..., n_freq), (..., n_freq') complex arrays
        Measured and computed responses of the same channels.

    Returns
    -------
    (n_freq, n_freq') array

    Raises
    ------
    ShapeError, ModelError
        When sizes differ or a line is zero.

    References
    ----------
    [Pascual1997]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.updating.fdac([[[1.0, 2.0]]], [[[1.0, -1.0]]]).round(6)
    array([[ 1., -1.],
           [ 1., -1.]])
    """
    a, b = complex_array(H, "H"), complex_array(G, "G")
    if a.shape[:-1] != b.shape[:-1] or a.ndim < 1:
        raise ShapeError(f"H has channels {a.shape[:-1]} and G {b.shape[:-1]}: choose the same.")
    a, b = a.reshape(-1, a.shape[-1]), b.reshape(-1, b.shape[-1])
    size = np.outer(np.linalg.norm(a, axis=0), np.linalg.norm(b, axis=0))
    if not np.all(np.isfinite(size)) or np.any(size == 0):
        raise ModelError("a line is zero or not finite at all channels: leave it out.")
    return np.asarray(np.real(a.conj().T @ b) / size, dtype=np.float64)


@dataclass(frozen=True, eq=False, repr=False)
class Correlation(Value):
    """Agreement of a model and a measurement: frequencies, damping, MAC, FRAC and FDAC.

    Parameters
    ----------
    modes : (m,) sequence of int
        Numbers of the measured modes.
    freq_error : (m,) array [-]
        Relative error of the model's undamped frequencies.
    zeta_error : (m,) array [-]
        Error of its damping ratios.
    mac : (m, m) array
        Of measured shapes (rows) with the model's; empty without shapes.
    frac : (n_out, n_in) array
        Of the responses; empty without.
    fdac : (n_freq, n_freq) array
        Of the responses; empty without.
    alike : sequence of groups of int
        Numbers of the model's modes, in the measured range, whose shapes the sensors cannot
        distinguish (a MAC above 0.9 with each other there): they are paired by frequency, and a
        high MAC does not say which of a group was measured.
    """

    modes: tuple[int, ...]
    freq_error: FloatArray
    zeta_error: FloatArray
    mac: FloatArray
    frac: FloatArray
    fdac: FloatArray
    alike: tuple[tuple[int, ...], ...] = ()

    def __repr__(self) -> str:
        parts = []
        if self.freq_error.size:
            parts.append(f"frequencies within {100 * np.abs(self.freq_error).max():.3g} %")
        if self.mac.size:
            parts.append(f"least MAC {np.diag(self.mac).min():.4f}")
        if self.frac.size:
            parts.append(f"least FRAC {self.frac.min():.4f}")
        text = f"<Correlation: {', '.join(parts) or 'nothing compared'}"
        if self.alike:
            text += "\n  the sensors cannot distinguish the shapes of modes "
            text += "; ".join(", ".join(map(str, group)) for group in self.alike[:SHOWN])
            text += "; ..." if len(self.alike) > SHOWN else ""
        return text + ">"


def correlate(model: Any, residuals: Sequence[Any]) -> Correlation:
    """Compare a model with measurements: once before the update, once after.

    Parameters
    ----------
    model : ReducedModel or FEModel
        Before or after an update (`UpdateResult.model`).
    residuals : sequence of Residual
        The measurements: poles, shapes and responses are compared; of several kinds the last.

    Returns
    -------
    Correlation

    Raises
    ------
    ModelError, LabelError
        When a mode or place is unknown to the model.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=3)
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> poles = fx.Eigenvalues(fx.MeasuredModes(poles=[620.0j], modes=[2]))
    >>> fx.updating.correlate(drawing, [poles]).freq_error.round(4)
    array([0.0201])
    """
    listed = checked_residuals(residuals)
    objective = Objective(model, [], listed)
    point = objective.begin(np.zeros(0))
    poles: ComplexArray = np.zeros(0, complex)
    found = poles
    modes: tuple[int, ...] = ()
    shapes = responses = spectrum = np.zeros((0, 0))
    alike: tuple[tuple[int, ...], ...] = ()
    for residual, bound in zip(listed, objective.bounds, strict=True):
        tied: Any = bound
        measured = getattr(residual, "measured", None)
        if isinstance(measured, MeasuredModes):
            modes, poles = measured.modes or (), measured.poles
            columns = point.columns(modes)
            found = point.eigen.poles[columns]
            if isinstance(residual, ModeShapes):
                seen = tied.rows @ point.eigen.X
                shapes = mac(residual.shapes, seen[:, columns])
                alike = _alike(seen, point, columns)
        if isinstance(residual, FrfResidual):
            H = tied.responses(point)
            responses = frac(np.moveaxis(tied.data, 0, 2), np.moveaxis(H, 0, 2))
            spectrum = fdac(np.moveaxis(tied.data, 0, 2), np.moveaxis(H, 0, 2))
    return Correlation(
        modes=modes,
        freq_error=np.abs(found) / np.abs(poles) - 1,
        zeta_error=poles.real / np.abs(poles) - found.real / np.abs(found),
        mac=shapes,
        frac=responses,
        fdac=spectrum,
        alike=alike,
    )


def _alike(seen: ComplexArray, point: Point, columns: list[int]) -> tuple[tuple[int, ...], ...]:
    """Return the numbers of modes in the range of those compared that look alike at the sensors."""
    inside = np.arange(min(columns), max(columns) + 1)
    inside = inside[(point.labels[inside] > 0) & np.any(seen[:, inside] != 0, axis=0)]
    near = matching.likeness(seen[:, inside], np.abs(point.eigen.poles[inside]))
    group = matching.groups_alike(near)
    numbers = point.labels[inside]
    found = [np.sort(numbers[group == first]).tolist() for first in np.unique(group)]
    return tuple(tuple(members) for members in found if len(members) > 1)


def _nonzero_shapes(value: Any, name: str) -> ComplexArray:
    array = complex_array(value, name, (None, None))
    if np.any(np.all(array == 0, axis=0)):
        raise ModelError(f"{name} holds a zero shape: its MAC is not defined.")
    return array


def _checked_responses(H: Any, G: Any) -> tuple[ComplexArray, ComplexArray]:
    a, b = complex_array(H, "H"), complex_array(G, "G")
    if a.shape != b.shape or a.ndim < 1:
        raise ShapeError(
            f"H has shape {a.shape} and G {b.shape}: choose the same channels and lines."
        )
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
        raise ModelError("responses have NaN or infinite entries: leave those lines out.")
    return a, b
