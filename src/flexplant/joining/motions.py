"""Motions of the components as rigid bodies that the rigid joints of a machine allow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..structure.placed import SPANNED
from ..structure.rigid import orthonormalised
from ..values import FloatArray, IntArray
from .component import Component
from .links import Link

#: a stretch below this part of the largest is none
_NONE = 1e-9


def groups_of(links: Sequence[Link], count: int) -> list[IntArray]:
    """Return the components (from 0) of each part of the machine that joints hold together."""
    pairs = [link.owners for link in links if link.holds and len(link.owners) == 2]
    graph = sp.coo_array(
        (np.ones(len(pairs)), ([p[0] for p in pairs], [p[1] for p in pairs])), shape=(count, count)
    )
    label = csgraph.connected_components(graph, directed=False)[1]
    return [np.flatnonzero(label == number) for number in range(int(label.max()) + 1)]


def left_motions(
    parts: Sequence[Component],
    groups: Sequence[IntArray],
    rows: Any,
    M: Any,
    kept: IntArray,
    *,
    free: bool,
) -> FloatArray:
    """Return the M-orthonormal motions (k, m) of components as rigid bodies that stretch no joint.

    For each part of the machine first those of the whole, then those of one component against
    others (a slide, a hinge): all are combinations of the components' own motions.
    """
    starts = np.concatenate([[0], np.cumsum([part.n for part in parts])])
    found = []
    for group in groups:
        several = [parts[i] for i in group]
        own = [_own_motions(part, free=free) for part in several]
        motions = np.zeros((int(starts[-1]), sum(part.shape[1] for part in own)))
        mixes, column, missed = [], 0, np.zeros(6)
        for i, part, body in zip(group, several, own, strict=True):
            motions[starts[i] : starts[i + 1], column : column + body.shape[1]] = body
            column += body.shape[1]
            mixes.append(body.T @ part.model.inertia(part.model.rigid_motions()))
            missed = np.maximum(missed, part.model.missed_motions())
        scale = np.abs(motions).max(axis=0, initial=0.0)
        motions = motions / np.where(scale > 0, scale, 1.0)
        whole = np.vstack(mixes) * scale[:, None]
        stretch = np.asarray(rows @ motions)
        most = np.asarray(abs(rows) @ np.abs(motions)).max(axis=1, initial=0.0)
        stretch[np.abs(stretch) <= _NONE * most[:, None]] = 0.0  # rounding of what cancels
        allowed = null_space(stretch)
        beside = np.linalg.norm(whole - allowed @ (allowed.T @ whole), axis=0)
        size = np.linalg.norm(whole, axis=0)
        clean = (missed < SPANNED) & (size > 0) & (beside <= _NONE * size)
        candidates = motions[kept] @ np.hstack([whole[:, clean], allowed])
        found.append(orthonormalised(M, candidates, dependent="drop"))
    return np.hstack(found)


def _own_motions(part: Component, *, free: bool) -> FloatArray:
    """Return the rigid-body motions (n, r) of a component: without energy, or held as well."""
    rigid: FloatArray = part.model.rigid_body
    if free:
        return rigid
    every: FloatArray = part.model.body_motions
    # those of a reduced model are known better than from its shapes
    return rigid if rigid.shape[1] == every.shape[1] else every


def null_space(stretch: FloatArray) -> FloatArray:
    """Return an orthonormal basis (r, q) of the motions (r,) that stretch (m, r) nothing."""
    if not stretch.size:
        return np.eye(stretch.shape[1])
    size = np.linalg.norm(stretch, axis=1)
    _, values, right = la.svd(stretch / np.where(size > 0, size, 1.0)[:, None])
    full = np.zeros(stretch.shape[1])
    full[: values.size] = values
    return np.asarray(right[full <= _NONE * max(float(full.max(initial=0.0)), 1e-300)].T)
