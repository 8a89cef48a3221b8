"""Mode shapes that move: nodes, the lines between neighbours, and displacements as JSON."""

from __future__ import annotations

import json
from html import escape
from typing import Any

import numpy as np

from ...modes import Modes
from ...values import FloatArray, IntArray

#: nodes and modes that are drawn at most
_NODES, _MODES = 1200, 24
#: neighbours of a node among which its lines are searched
_NEIGHBOURS = 27
_SELECTED = ' selected="selected"'


def moving_shapes(modes: Modes) -> str:
    """Return a figure whose modes move; empty where no DOF is a translation."""
    xyz, shapes = _translations(modes)
    if not len(xyz):
        return ""
    chosen = _thinned(xyz)
    xyz, shapes = xyz[chosen], shapes[chosen]
    centre, size = (xyz.max(axis=0) + xyz.min(axis=0)) / 2, float(np.ptp(xyz, axis=0).max()) or 1.0
    largest = np.linalg.norm(shapes, axis=1).max(axis=0)
    shapes = shapes / np.where(largest > 0, largest, 1.0)
    count = shapes.shape[2]
    data = {
        "xyz": _whole((xyz - centre) / size),
        "edges": neighbours(xyz).tolist(),
        "modes": [_whole(shapes[:, :, k]) for k in range(count)],
    }
    first = min(modes.n_rigid, count - 1)  # the first that deforms
    options = "".join(
        f'<option value="{k}"{_SELECTED if k == first else ""}>{escape(_name(modes, k))}</option>'
        for k in range(count)
    )
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    return (
        '<figure class="shape"><div class="bar">'
        f'<label>mode <select>{options}</select></label><button type="button">pause</button>'
        '<label>amplitude <input type="range" min="0" max="40" value="12"/></label></div>'
        '<canvas role="img" aria-label="moving mode shape"></canvas>'
        "<figcaption>Drag to turn. Colour: size of the displacement, grey to orange; light lines: "
        "at rest. Amplitudes are exaggerated.</figcaption>"
        f'<script type="application/json">{text}</script></figure>\n'
    )


def _name(modes: Modes, k: int) -> str:
    if k < modes.n_rigid:
        return f"{k + 1}: rigid-body"
    return f"{k + 1}: {modes.freq[k]:.4g} Hz, damping {100 * modes.zeta[k]:.2g} %"


def _whole(values: FloatArray) -> list[int]:
    """Return thousandths, row by row."""
    return [int(v) for v in np.rint(1000.0 * values).ravel()]


def _translations(modes: Modes) -> tuple[FloatArray, FloatArray]:
    """Return the nodes (n, 3) that translate, and how they do in each mode (n, 3, modes)."""
    dofs, count = modes.dofs, min(modes.n_modes, _MODES)
    axis = {"x": 0, "y": 1, "z": 2}
    rows = [i for i, direction in enumerate(dofs.directions) if direction in axis]
    nodes = dofs.nodes[rows]
    unique, first, place = np.unique(nodes, return_index=True, return_inverse=True)
    shapes = np.zeros((unique.size, 3, count))
    phi = np.asarray(modes.phi)[:, :count]
    if np.iscomplexobj(phi):  # nearly real shapes, turned so that they are
        largest = phi[np.argmax(np.abs(phi), axis=0), np.arange(count)]
        phi = (phi * np.exp(-1j * np.angle(largest))).real
    shapes[place, [axis[dofs.directions[i]] for i in rows]] = phi[rows]
    return dofs.xyz[rows][first], shapes


def _thinned(xyz: FloatArray) -> IntArray:
    """Return about so many nodes as can be drawn, one for each cell of a grid."""
    cells = 4 * _NODES
    chosen: IntArray = np.arange(len(xyz))
    while chosen.size > _NODES:
        extent = np.maximum(np.ptp(xyz, axis=0), 1e-12)
        present = extent > 1e-6 * extent.max()
        edge = (np.prod(extent[present]) / cells) ** (1.0 / max(int(present.sum()), 1))
        place = np.floor((xyz - xyz.min(axis=0)) / edge).astype(np.int64)
        chosen = np.sort(np.unique(place, axis=0, return_index=True)[1])
        cells = int(0.7 * cells)
    return chosen


def neighbours(xyz: FloatArray) -> IntArray:
    """Return the pairs (m, 2) of nodes between which no other lies (a Gabriel graph).

    A pair is joined when the sphere with it as diameter holds no third node: the lines of a
    regular mesh without its diagonals, whatever its ratio of sides.
    """
    from scipy.spatial import cKDTree

    count = min(len(xyz), _NEIGHBOURS)
    if count < 2:
        return np.zeros((0, 2), dtype=np.int64)
    tree: Any = cKDTree(xyz)
    distance, near = tree.query(xyz, k=count)
    i = np.repeat(np.arange(len(xyz)), count)
    pairs = np.column_stack([i, near.ravel()])[distance.ravel() > 0]
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    a, b = xyz[pairs[:, 0]], xyz[pairs[:, 1]]
    radius = 0.5 * np.linalg.norm(b - a, axis=1)
    closest, _ = tree.query((a + b) / 2, k=min(3, len(xyz)))
    # the pair itself is at the radius; a third node inside or on the sphere is nearer or as near
    inside = np.atleast_2d(closest)[:, : min(3, len(xyz))] < radius[:, None] * (1.0 - 1e-6)
    on = np.sum(closest <= radius[:, None] * (1.0 + 1e-6), axis=1) > 2
    return np.asarray(pairs[~inside.any(axis=1) & ~on], dtype=np.int64)
