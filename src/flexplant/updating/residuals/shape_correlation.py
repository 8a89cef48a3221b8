"""Residuals of the correlation of mode shapes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...values import FloatArray
from ..family import Family
from ..point_model import Point
from .mode_shapes import BoundShapes, ModeShapes
from .residual import Bound


@dataclass(frozen=True, eq=False, repr=False)
class ShapeCorrelation(ModeShapes):
    """Residuals ``(1 - sqrt(MAC)) / sqrt(MAC)`` of measured mode shapes, one for each mode.

    Without a derivative near a perfect fit: `ModeShapes` says more with the same data. For
    comparison with published studies.

    Parameters
    ----------
    measured : MeasuredModes
        Poles with their mode numbers.
    shapes : (m, modes) real or complex array, optional
        In the order of the poles; any scale. None: those of `measured`.
    at : sequence of m places or mapping, optional
        DOF labels, points or mappings; as in `ModeShapes`.
    direction : str
        Of the motion at points.
    std : float or (m, modes) array, optional
        Weighs the entries in the MAC by 1/std; the residuals themselves have no known noise.
    covariance : (modes, m, m) array, optional
        Instead of `std`.
    assign : bool
        Whether modes are assigned by MAC with the measured shapes.

    Raises
    ------
    ModelError, ShapeError, LabelError
        As `ModeShapes`.

    Examples
    --------
    >>> import flexplant as fx
    >>> shape = {"shapes": [[1.0], [0.0], [-1.0]], "dofs": ["1:x", "2:x", "3:x"]}
    >>> measured = fx.MeasuredModes(poles=[630.0j], modes=[2], **shape)
    >>> fx.updating.ShapeCorrelation(measured)
    <ShapeCorrelation: modes 2 at 3 places, noise not known>
    """

    def bound(self, family: Family) -> Bound:
        """Return the residual tied to a family."""
        return _BoundMac(self, family)


class _BoundMac(BoundShapes):
    """sqrt(MAC) = |Q^H psi| / |psi|; r = 1/sqrt(MAC) - 1."""

    def __init__(self, residual: ModeShapes, family: Family) -> None:
        super().__init__(residual, family)
        self.noisy, self.size, self._rows_each = False, 1.0, 1

    def values(self, point: Point) -> FloatArray:
        found = []
        for group in self.sets:
            for i in group:
                _, Q, psi = self._parts(point, group, i)
                found.append(np.linalg.norm(psi) / np.linalg.norm(Q.conj().T @ psi) - 1)
        return np.array(found)

    def slopes(self, point: Point) -> FloatArray:
        found = []
        for group in self.sets:
            dX, _ = point.subspace([self.own[j] for j in group])
            dY = self.rows @ dX
            for i in group:
                Phi, Q, psi = self._parts(point, group, i)
                dPhi = self.white[i] @ dY
                plus = _inverse(Phi, Q)
                left = psi - Q @ (Q.conj().T @ psi)
                # d |P psi|^2 = 2 Re (left^H dPhi Phi^+ psi)
                change = np.real((dPhi @ (plus @ psi)) @ left.conj())
                inside = float(np.linalg.norm(Q.conj().T @ psi))
                found.append(-float(np.linalg.norm(psi)) * change / inside**3)
        return np.array(found)


def _inverse(Phi: Any, Q: Any) -> Any:
    """Return the pseudo-inverse of shapes, of one with its unit vector Q at once."""
    if Phi.shape[1] > 1:
        return np.linalg.pinv(Phi)
    return Q.conj().T / np.linalg.norm(Phi)
