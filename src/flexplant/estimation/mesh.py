"""Modes that the mesh of a structure resolves badly, and their part in a predicted error."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ..errors import warn
from ..labels import DofSet
from ..lti.statespace import StateSpace
from ..modes import Modes
from ..plant import StandardPlant
from ..reduction import ReducedModel
from ..structure import FEModel
from ..values import FloatArray, IntArray
from .error import error_variances
from .estimator_channels import poi_channels, read_alike

#: nodes per wavelength below which a mode is badly resolved: frequencies are off by some 5 %
NODES = 4.0
#: share of a variance up to which errors stay within about 10 % (5 % at 1 % damping), and from
#: which they were up to 65 %: plates of four shapes on 6 x 6 to 16 x 16 elements beside 24 x 24
NOTED, WARNED = 0.15, 0.5
#: translations
_MOVES = ("x", "y", "z")
_NONE = np.zeros(0, dtype=np.int64)
#: relative: nodes whose extent is less are in a plane, or on a line
_FLAT = 1e-9
#: an edge is of the mesh up to this length beside the mean at its ends: elements of 1 to 3
_LONG = 2.0


def nodes_per_wavelength(
    model: FEModel | Modes | ReducedModel, shapes: FloatArray
) -> FloatArray | None:
    """Return how many nodes of a mesh there are per wavelength of each shape; None: no mesh.

    Neighbours i, j are translations in one direction that the mass matrix couples; of modes, whose
    matrices are not known, those of nodes side by side. In a wave of wave number k and nodes h
    apart ``mean (p_i - p_j)^2 / mean (p_i^2 + p_j^2) = 1 - cos(k h)``, and ``2 pi / (k h)`` nodes
    make a wavelength. Diagonals of elements count as neighbours, so that this is a mean over all
    directions. Both kinds of neighbours differ by 2 % to 7 % on plates and blocks. A full mass
    matrix has no mesh.
    """
    dofs = model.full_dofs if isinstance(model, ReducedModel) else model.dofs
    count = np.count_nonzero(np.isin(dofs.directions, _MOVES))
    i, j = _coupled(model) if isinstance(model, FEModel) else (_NONE, _NONE)
    if not i.size:  # masses are lumped, or not known
        i, j = _side_by_side(dofs)
    if not i.size or 4 * i.size > count * (count - 1):
        return None
    apart = np.sum((shapes[i] - shapes[j]) ** 2, axis=(0, 2))
    size = np.sum(shapes[i] ** 2 + shapes[j] ** 2, axis=(0, 2))
    turn = np.arccos(np.clip(1.0 - apart / np.where(size > 0, size, 1.0), -1.0, 1.0))
    return np.asarray(2.0 * np.pi / np.maximum(turn, 1e-9))


def _coupled(model: FEModel) -> tuple[IntArray, IntArray]:
    """Return the translations that the mass matrix couples."""
    M, directions = sp.coo_matrix(model.M), np.array(model.dofs.directions)
    alike = np.isin(directions, _MOVES)[M.row] & (directions[M.row] == directions[M.col])
    pair = (M.row < M.col) & (M.data != 0.0) & alike
    return M.row[pair].astype(np.int64), M.col[pair].astype(np.int64)


def _side_by_side(dofs: DofSet) -> tuple[IntArray, IntArray]:
    """Return the translations of nodes that a Delaunay triangulation joins, of one component."""
    owner = np.zeros(len(dofs), np.int64) if dofs.component_of is None else dofs.component_of
    kinds, found = np.array(dofs.directions), [np.zeros((2, 0), np.int64)]
    for direction in _MOVES:
        for part in np.unique(owner):
            rows = np.flatnonzero((kinds == direction) & (owner == part))
            found.append(rows[_triangulated(dofs.xyz[rows])])
    i, j = np.hstack(found)
    return i, j


def _triangulated(xyz: FloatArray) -> IntArray:
    """Return pairs (2, e) of nodes side by side on a line, in a plane or in space."""
    offset = xyz - xyz.mean(axis=0) if len(xyz) else xyz
    _, size, axes = np.linalg.svd(offset, full_matrices=False)
    flat = offset @ axes[size > _FLAT * np.max(size, initial=0.0)].T
    if len(flat) <= flat.shape[1] + 1 or not flat.size:
        return np.zeros((2, 0), np.int64)
    if flat.shape[1] == 1:
        order = np.argsort(flat[:, 0])
        pairs = np.vstack([order[:-1], order[1:]])
    else:
        from scipy.spatial import Delaunay

        simplices = Delaunay(flat).simplices
        first, second = np.triu_indices(simplices.shape[1], 1)
        both = np.hstack([simplices[:, [a, b]].T for a, b in zip(first, second, strict=True)])
        pairs = np.unique(np.sort(both, axis=0), axis=1)
    # across a notch or a hole an edge is longer than those of the mesh at both its ends
    length = np.linalg.norm(flat[pairs[0]] - flat[pairs[1]], axis=1)
    total, count = (
        np.bincount(pairs.reshape(-1), weights, len(flat))
        for weights in (np.tile(length, 2), np.ones(2 * length.size))
    )
    usual = total / np.maximum(count, 1)
    near = length <= _LONG * np.minimum(usual[pairs[0]], usual[pairs[1]])
    return np.asarray(pairs[:, near], dtype=np.int64)


def unresolved_share(
    plant: StandardPlant,
    larger: StandardPlant,
    modes: IntArray,
    observer: StateSpace,
    variances: FloatArray,
) -> float | None:
    """Return the largest share of POI variances from modes left out that the mesh resolves badly.

    Their disturbances are taken away, and the error is computed once more.
    """
    if not larger.is_assembled:
        return None
    model, outputs = larger.model, larger.assembled.realisation.outputs
    if not isinstance(model, FEModel | Modes | ReducedModel):
        return None
    if isinstance(model, ReducedModel):
        outputs = model.T @ outputs
    nodes = nodes_per_wavelength(model, outputs.reshape(len(outputs), -1, 2))
    if nodes is None:
        return None
    coarse = modes[nodes[modes - 1] < NODES] - 1
    if not coarse.size:
        return 0.0
    factor = np.array(larger.noise_factor)
    factor[larger.modal_states.reshape(-1, 2)[coarse].reshape(-1)] = 0.0
    still = larger.replace(origin=larger.assembled.replace(noise_factor=factor))
    rest = error_variances(read_alike(plant, still), observer).values
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
