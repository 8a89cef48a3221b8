"""Nodes that move along axes of their own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..errors import LabelError, ModelError
from ..labels import DofSet
from ..values import instance, real_array


def cosines(dofs: DofSet, rotations: Any) -> Any:
    """Return C (n, n), sparse, ``q_local = C q_global``, from {node: (3, 3) direction cosines}."""
    rows, columns, values = [np.arange(len(dofs))], [np.arange(len(dofs))], [np.ones(len(dofs))]
    instance(rotations, Mapping, "rotations", "Pass {node: (3, 3) cosines}.", LabelError)
    for node, given in rotations.items():
        matrix = real_array(given, f"rotations[{node}]", (3, 3))
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-6:
            raise ModelError(
                f"the direction cosines of node {node} are not orthogonal, got "
                f"{matrix.round(6).tolist()}: row i holds the global components of local axis i."
            )
        found = np.flatnonzero(dofs.nodes == node)
        if not found.size:
            raise LabelError(f"rotations name node {node}, which has no DOF: {dofs!r}.")
        for first in (0, 3):
            kinds = dofs.kinds[found]
            three = found[(kinds >= first) & (kinds < first + 3)]
            if three.size not in (0, 3):
                raise ModelError(
                    f"node {node} has a local coordinate system, but only {three.size} of three "
                    "directions: the held one would be oblique in global directions. Leave its "
                    "DOFs local, place ports elsewhere, or export it unconstrained."
                )
            three = three[np.argsort(dofs.kinds[three])]
            if three.size:
                rows.append(np.repeat(three, 3))
                columns.append(np.tile(three, 3))
                values.append((matrix - np.eye(3)).ravel())
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sp.csc_array(entries, shape=(len(dofs), len(dofs)))
