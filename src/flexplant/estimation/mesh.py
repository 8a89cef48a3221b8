"""Modes that the mesh of a structure resolves badly, and their part in a predicted error."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ..errors import warn
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..structure import FEModel
from ..values import FloatArray, IntArray
from .error import error_variances
from .estimator_channels import poi_channels

#: nodes per wavelength below which a mode is badly resolved: frequencies are off by some 5 %
NODES = 4.0
#: share of a variance up to which errors stay within about 10 % (5 % at 1 % damping), and from
#: which they were up to 65 %: plates of four shapes on 6 x 6 to 16 x 16 elements beside 24 x 24
NOTED, WARNED = 0.15, 0.5


def nodes_per_wavelength(model: FEModel, shapes: FloatArray) -> FloatArray | None:
    """Return how many nodes of a mesh there are per wavelength of each shape; None: no mesh.

    Neighbours i, j are translations in one direction that the mass matrix couples. In a wave of
    wave number k and nodes h apart ``mean (p_i - p_j)^2 / mean (p_i^2 + p_j^2) = 1 - cos(k h)``,
    and ``2 pi / (k h)`` nodes make a wavelength. Diagonals of elements count as neighbours, so that
    this is a mean over all directions. A lumped mass matrix has no neighbours, a full one no mesh.

    Parameters
    ----------
    model : FEModel
        The structure.
    shapes : (n, m, c) array
        Of m modes; c parts each (real and imaginary).
    """
    M = sp.coo_matrix(model.M)
    directions = np.array([label.rpartition(":")[2] for label in model.dofs.labels])
    moves = np.isin(directions, ("x", "y", "z"))
    pair = (
        (M.row < M.col) & (M.data != 0.0) & moves[M.row] & (directions[M.row] == directions[M.col])
    )
    i, j = M.row[pair], M.col[pair]
    count = np.count_nonzero(moves)
    if not i.size or 4 * i.size > count * (count - 1):
        return None
    apart = np.sum((shapes[i] - shapes[j]) ** 2, axis=(0, 2))
    size = np.sum(shapes[i] ** 2 + shapes[j] ** 2, axis=(0, 2))
    turn = np.arccos(np.clip(1.0 - apart / np.where(size > 0, size, 1.0), -1.0, 1.0))
    return np.asarray(2.0 * np.pi / np.maximum(turn, 1e-9))


def unresolved_share(
    plant: StandardPlant, modes: IntArray, observer: StateSpace, variances: FloatArray
) -> float | None:
    """Return the largest share of POI variances from modes left out that the mesh resolves badly.

    Their disturbances are taken away, and the error is computed once more.

    Parameters
    ----------
    plant : StandardPlant
        With the modes left out; None is returned where it is not made of an FEModel on a mesh.
    modes : array of int
        Numbers of the modes left out, from 1.
    observer : StateSpace
        The filter.
    variances : (nz,) array
        Of its errors on the plant.

    Warns
    -----
    FlexplantWarning
        When it is more than half.
    """
    model = plant.model
    if not isinstance(model, FEModel):
        return None
    realisation = plant.assembled.realisation
    shapes = realisation.outputs.reshape(len(model.dofs), -1, 2)
    nodes = nodes_per_wavelength(model, shapes)
    if nodes is None:
        return None
    coarse = modes[nodes[modes - 1] < NODES] - 1
    if not coarse.size:
        return 0.0
    factor = np.array(plant.noise_factor)
    factor[plant.modal_states.reshape(-1, 2)[coarse].reshape(-1)] = 0.0
    still = plant.replace(origin=plant.assembled.replace(noise_factor=factor))
    rest = error_variances(still, observer).values
    shares = 1.0 - rest / np.where(variances > 0, variances, 1.0)
    share = float(np.max(shares))
    if share > WARNED:
        named = [c for c, part in zip(poi_channels(plant), shares, strict=True) if part > WARNED]
        warn(
            f"{share:.0%} of the predicted variance of {', '.join(named)} is from modes "
            f"that the mesh of larger= resolves with fewer than {NODES:g} nodes a wavelength: "
            "these errors may be off by as much. Pass a model with a finer mesh as larger=."
        )
    return max(share, 0.0)
