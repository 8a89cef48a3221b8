"""A patch of nodes that moves on average: a place to join meshes that do not match."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..arguments import positive_array
from ..dof_columns import node_numbers
from ..errors import LabelError
from ..labels import DIRECTIONS, DofSet
from ..structure.rigid import rigid_motions
from ..values import FloatArray, IntArray, Value, instance, real_array, short

#: a singular value of the motions of a patch below this part of the largest is none
_RANK = 1e-8


@dataclass(frozen=True, eq=False, repr=False)
class Patch(Value):
    """Nodes of a component whose mean motion is joined, as NASTRAN's RBE3 does.

    Displacements u of the nodes have the mean motion ``v = (A^T W A)^-1 A^T W u``, A being the
    rigid-body motions about the point of the patch: the rigid motion nearest to them. A force on
    the patch is spread over its nodes with the same weights; the patch itself may bend. The
    opposite, a patch that stays rigid (RBE2), is too stiff; the truth of a bonded patch lies
    between, and the certificate of `joined` says how far these are apart.

    Parameters
    ----------
    component : str
        Whose nodes; of a component of a joined machine, "machine/stage".
    nodes : sequence of int, optional
        Which; None: those in the box.
    box : (2, 3) array [m], optional
        Lowest and highest corner, in the coordinates of the machine.
    at : (3,) array [m], optional
        The point whose motion is meant, in the coordinates of the machine; None: the mean of the
        nodes.
    weights : (m,) array, optional
        Of the nodes, in the order of `nodes`: the area that each stands for, say. None: equal.

    Raises
    ------
    LabelError, ModelError, ShapeError
        When neither nodes nor a box are given, or weights are not positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> size, mesh = {"size": (0.2, 0.2), "thickness": 0.01}, {"elements": (2, 2)}
    >>> steel = {"density": 7800.0, "youngs_modulus": 2.1e11, "poisson_ratio": 0.3}
    >>> plate = fx.kirchhoff_plate(**size, **mesh, **steel)
    >>> foot = fx.Patch("lower", box=[(0.0, 0.0, 0.0), (0.2, 0.2, 0.0)])
    >>> joint = fx.Joint(foot, "upper/5:z", stiffness=1e6)
    >>> foot, fx.joined({"lower": plate, "upper": plate}, joint)
    (<Patch of lower, in a box>, <FEModel: 54 DOFs, sparse, 5 rigid-body motions, D not given>)
    """

    component: str
    nodes: Iterable[int] | None = None
    box: Sequence[Sequence[float]] | FloatArray | None = field(default=None, kw_only=True)
    at: Sequence[float] | FloatArray | None = field(default=None, kw_only=True)
    weights: Sequence[float] | FloatArray | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        instance(self.component, str, "component of a patch", "Name it.", LabelError)
        if (self.nodes is None) == (self.box is None):
            raise LabelError(
                "a patch needs nodes=[...] or box=[(x, y, z), (x, y, z)], not both: give one."
            )
        nodes = None if self.nodes is None else tuple(node_numbers(self.nodes).tolist())
        if nodes and len(set(nodes)) < len(nodes):
            raise LabelError(
                f"nodes of a patch must be different ones, got {short(nodes)}: name each once, "
                "with the sum of its weights."
            )
        weights = self.weights
        if weights is not None:
            weights = positive_array(weights, "weights of a patch", (len(nodes or ()),))
        self._set(
            nodes=nodes,
            box=None if self.box is None else real_array(self.box, "box", (2, 3)),
            at=None if self.at is None else real_array(self.at, "at", (3,)),
            weights=weights,
        )

    def __repr__(self) -> str:
        where = "in a box" if self.nodes is None else f"{len(tuple(self.nodes))} nodes"
        return f"<Patch of {self.component}, {where}>"

    def rows(self, dofs: DofSet) -> IntArray:
        """Return the rows (m,) of the displacements of its nodes among the component's DOFs."""
        inner = [name for name in dofs.components if self.component.endswith(f"/{name}")]
        if self.nodes is not None and dofs.components and not inner:
            raise LabelError(
                f"{self!r} names nodes by numbers, which {', '.join(dofs.components)} may share. "
                f"Say whose: Patch('{self.component}/{dofs.components[0]}', nodes), or give box=."
            )
        own = max(inner, key=len, default=None)
        chosen = dofs.where(self.nodes, box=self.box, component=own)
        rows = dofs.indices(chosen.labels)
        return np.asarray(rows[dofs.kinds[rows] < 3])

    def point(self, dofs: DofSet) -> FloatArray:
        """Return the point (3,) [m] whose motion is meant."""
        if self.at is not None:
            return np.asarray(self.at, dtype=np.float64)
        rows = self.rows(dofs)
        first = np.unique(dofs.node_index[rows], return_index=True)[1]
        return np.asarray(dofs.xyz[rows[first]].mean(axis=0))

    def mean(self, dofs: DofSet, point: FloatArray) -> tuple[FloatArray, FloatArray, list[str]]:
        """Return the mean motions of the patch at a point.

        Returns
        -------
        (6, m) array
            The six motions by the displacements of the nodes; zero for those it does not make.
        (m, 6) array
            A: the displacements of the nodes by the six motions.
        list of str
            Which of the six it determines.
        """
        rows = self.rows(dofs)
        return mean_motions(dofs._taken(rows), point, self._weight_of(dofs, rows))

    def _weight_of(self, dofs: DofSet, rows: IntArray) -> FloatArray:
        if self.weights is None:
            return np.ones(rows.size)
        known = dict(zip(tuple(self.nodes or ()), np.asarray(self.weights).tolist(), strict=True))
        return np.array([known[node] for node in dofs.nodes[rows].tolist()])


def mean_motions(
    some: DofSet, point: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray, list[str]]:
    """Return the mean motions of some displacements (m,) at a point; see `Patch.mean`."""
    A = rigid_motions(some, point)
    radius = float(np.abs(A[:, 3:]).max(initial=0.0)) or 1.0
    scale = np.array([1.0] * 3 + [radius] * 3)
    root = np.sqrt(weights)[:, None]
    spread = root * A / scale
    inverse = np.linalg.pinv(spread, rcond=_RANK)
    made = np.linalg.norm(inverse @ spread - np.eye(6), axis=0) < _RANK
    by_node = (inverse * root.T) / scale[:, None]
    by_node[~made] = 0.0
    return by_node, A, [name for name, there in zip(DIRECTIONS, made, strict=True) if there]
