"""How uncertain identified shapes are, as those of a structure: its directions, for a plant."""

from __future__ import annotations

import numpy as np

from ..errors import ModelError
from ..labels import DofSet
from ..modes import Modes
from ..values import FloatArray, whole
from .identified import IdentifiedModes
from .structural import expansion, places_of


def shape_deviations(
    measured: IdentifiedModes, dofs: DofSet, *, over: Modes | None = None, count: int = 2
) -> FloatArray:
    r"""Return the principal standard deviations of shapes that `structural_modes` makes.

    The error n of a mode's shape and participation gives its place shape (the mean of both where
    a place was driven and measured, expanded over a model's modes where they are given) the error
    :math:`A n`, and its real part, of circular noise, the covariance
    :math:`C = \mathrm{Re}(A\,E[n n^H] A^H)/2 = \sum_j v_j v_j^T`. The largest v_j are kept,
    and made larger so that the sum of all variances is.

    Parameters
    ----------
    measured : IdentifiedModes
        As given to `structural_modes`.
    dofs : DofSet
        As given to `structural_modes`.
    over : Modes, optional
        As given to `structural_modes`.
    count : int
        Directions of each mode; noise that each sensor has for itself needs as many as there are
        places to be shown in full.

    Returns
    -------
    (m, n, count) array
        v_j over the DOFs of the modes: ``plant.uncertain(measured, shapes=...)``.

    Raises
    ------
    ModelError, LabelError
        As `structural_modes`; or when the covariance of the shapes is not known.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[4e5], ground=[1e5, 0.0])
    >>> modes = fx.solve_modes(model, count=2, damping=fx.ModalDamping(0.01))
    >>> sensors = [fx.Sensor(f"y{i}", at=f"{i}:x") for i in (1, 2)]
    >>> plant = fx.assemble_plant(modes, fx.Ports(u=[fx.Actuator("u1", at="1:x")], y=sensors))
    >>> frf = fx.frequency_response(plant.Gyu, np.linspace(10.0, 250.0, 400))
    >>> noisy = frf.replace(variance=np.full(frf.data.shape, 1e-16))
    >>> measured = fx.identify_modes(noisy, dofs={"y1": "1:x", "y2": "2:x", "u1": "1:x"})
    >>> fx.identification.shape_deviations(measured, model.dofs, count=1).shape
    (2, 2, 1)
    """
    at, dofs, rows = places_of(measured, dofs, over)
    kept = whole(count, "count")
    if measured.channel_covariance is None:
        raise ModelError(
            "the covariance of these shapes is not known: identify them from an FRF, "
            "identify_modes(frf, dofs=...)."
        )
    maps = at.maps(measured.poles)
    covariance = np.real(maps @ measured.channel_covariance @ maps.conj().transpose(0, 2, 1)) / 2
    if over is not None:
        E = expansion(over, rows)
        covariance = E @ covariance @ E.T
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values[:, ::-1], 0.0)
    kept = min(kept, values.shape[1])
    part = values[:, :kept].sum(axis=1, keepdims=True)
    more = values.sum(axis=1, keepdims=True) / np.where(part > 0, part, 1.0)
    return np.asarray(vectors[:, :, ::-1][:, :, :kept] * np.sqrt(values[:, :kept] * more)[:, None])
