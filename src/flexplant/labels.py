"""Degrees of freedom (DOFs) by name: `"41:z"` is the z-displacement of node 41."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .arrays import (
    LARGEST_NODE,
    FloatArray,
    IntArray,
    as_list,
    check_names,
    instance,
    name_list,
    node_numbers,
    real_array,
)
from .dof_columns import DIRECTIONS as DIRECTIONS
from .dof_columns import Interpolation as Interpolation
from .dof_columns import Place as Place
from .dof_columns import columns_of, in_box, rotation_hint, unknown_dof
from .errors import LabelError, ShapeError, counted, require_known, short, unknown_label
from .store import Value, frozen
from .tolerances import SAME


def direction_names(directions: Any, name: str = "directions") -> tuple[str, ...]:
    """Return directions as a tuple of str; LabelError for a single one."""
    if isinstance(directions, str):
        raise LabelError(
            f"directions must be one for each DOF, got the single {directions!r}: write "
            f"[{directions!r}] * n."
        )
    # the million of a large model are strings already, and few different ones
    given = tuple(as_list(directions, "directions", "a list with one for each DOF"))
    try:
        if all(type(d) is str for d in set(given)):
            return given
    except TypeError:
        pass
    return tuple(str(direction) for direction in given)


def component_columns(
    names: Any, owners: Any, count: int
) -> tuple[tuple[str, ...], IntArray | None]:
    """Return the names of components and which of them (count,) each DOF belongs to."""
    listed_names = name_list(names, "components")
    if owners is None and not listed_names:
        return (), None
    check_names(listed_names, "components")
    wrong = [name for name in listed_names if ":" in name or name != name.strip(" /")]
    if wrong:
        raise LabelError(
            f"{wrong[0]!r} cannot name a component: labels are 'stage/41:z', so that names hold no "
            "':' and neither begin nor end with '/' or a blank. Rename it."
        )
    numbers = np.zeros(0, dtype=np.int64) if owners is None else node_numbers(owners)
    if numbers.shape != (count,) or not np.all((numbers >= 0) & (numbers < len(listed_names))):
        raise LabelError(
            f"component_of must hold the number (from 0) of one of the {len(listed_names)} "
            f"components for each of the {count} DOFs, got {short(owners)}."
        )
    return listed_names, numbers


class _DofIndex:
    """The rows of DOFs, given their node numbers (n,) and kinds (n,), 0 to 5 for x to rz."""

    def __init__(
        self,
        nodes: IntArray,
        kinds: IntArray,
        components: tuple[str, ...] = (),
        component_of: IntArray | None = None,
    ) -> None:
        keys = nodes * len(DIRECTIONS) + kinds
        self._order = np.arange(keys.size)
        self._ends = {"": (0, keys.size)}
        if component_of is not None:
            self._order = np.lexsort((keys, component_of))
            ends = np.searchsorted(component_of[self._order], np.arange(len(components) + 1))
            pairs = zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)
            self._ends = dict(zip(components, pairs, strict=True))
        elif np.any(keys[1:] < keys[:-1]):
            self._order = np.argsort(keys, kind="stable")
        self._keys = keys[self._order]

    @property
    def doubled(self) -> tuple[int, int] | None:
        """Two rows with the same DOF, or None."""
        for start, end in self._ends.values():
            same = np.flatnonzero(np.diff(self._keys[start:end]) == 0)
            if same.size:
                first = start + int(same[0])  # the stable sort keeps equal keys in their order
                return int(self._order[first]), int(self._order[first + 1])
        return None

    def found(self, label: object) -> int:
        """Return the row of a label, or -1; it is found by numbers, without a dictionary."""
        if not isinstance(label, str):
            return -1
        component, _, rest = label.rpartition("/")
        node, _, direction = rest.partition(":")
        if direction not in DIRECTIONS or component not in self._ends:
            return -1
        try:
            number = int(node)
        except ValueError:
            return -1
        if str(number) != node or abs(number) > LARGEST_NODE:  # "07:z" and "1_0:z" are not labels
            return -1
        start, end = self._ends[component]
        key = number * len(DIRECTIONS) + DIRECTIONS.index(direction)
        place = start + int(np.searchsorted(self._keys[start:end], key))
        return int(self._order[place]) if place < end and self._keys[place] == key else -1


def checked_direction(direction: Any, name: str = "direction") -> str:
    """Return one of the six directions."""
    require_known(name, [direction], DIRECTIONS)
    return str(direction)


@dataclass(frozen=True, eq=False, repr=False)
class DofSet(Value):
    """The degrees of freedom of a model, in the order of its matrices.

    Parameters
    ----------
    nodes : (n,) array of int
        Node number of each DOF.
    directions : sequence of n str
        Direction of each DOF: x, y, z [m], rx, ry or rz [rad]. On a plate rx is dz/dy
        and ry is -dz/dx.
    xyz : (n, 3) array [m], optional
        Coordinates of each DOF's node. By default they are unknown and stored as zeros. Places can
        then be given only by labels, and rotations of the whole body are not known.
    interpolation : Interpolation, optional
        Element shape functions, or those of `interpolated`. Without them only points at nodes can
        be used.
    components : sequence of str
        Names of the components of a joined machine. Labels then have the form `"stage/41:z"`.
    component_of : (n,) array of int, optional
        Number of the component, from 0, to which each DOF belongs.

    Raises
    ------
    ShapeError
        When the lengths differ.
    LabelError
        When a direction is unknown, a DOF appears twice, or names of components do not fit.

    Examples
    --------
    >>> dofs = DofSet([1, 1, 2], ["z", "rx", "z"], [[0, 0, 0], [0, 0, 0], [1, 0, 0]])
    >>> dofs.index("2:z"), dofs.nearest((0.9, 0, 0), "z")
    (2, '2:z')
    """

    nodes: IntArray
    directions: tuple[str, ...]
    xyz: FloatArray = None  # type: ignore[assignment]
    interpolation: Interpolation | None = None
    components: tuple[str, ...] = ()
    component_of: IntArray | None = None

    if TYPE_CHECKING:  # what comes in is anything array-like

        def __init__(
            self,
            nodes: npt.ArrayLike,
            directions: Iterable[str],
            xyz: npt.ArrayLike | None = None,
            interpolation: Interpolation | None = None,
            components: Iterable[str] = (),
            component_of: npt.ArrayLike | None = None,
        ) -> None: ...

    def __post_init__(self) -> None:
        nodes = node_numbers(self.nodes)
        directions = direction_names(self.directions)
        if nodes.ndim != 1 or len(directions) != nodes.size:
            raise ShapeError(
                f"a DofSet needs one node and one direction per DOF, got nodes of shape "
                f"{nodes.shape} and {len(directions)} directions. Repeat a node's number once for "
                "each of its directions."
            )
        unknown = sorted(set(directions) - set(DIRECTIONS))
        if unknown:
            raise LabelError(
                f"unknown directions {unknown[:6]}: a DOF moves along {', '.join(DIRECTIONS)}. "
                "Translate the names of the foreign program first."
            )
        given: Any = self.xyz
        xyz = np.zeros((nodes.size, 3)) if given is None else given
        self._set(nodes=nodes, directions=directions, xyz=real_array(xyz, "xyz", (nodes.size, 3)))
        instance(
            self.interpolation,
            Interpolation | None,
            "interpolation",
            "Leave it out, or use flexplant.interpolated.",
            LabelError,
        )
        names, owners = component_columns(self.components, self.component_of, nodes.size)
        self._set(components=names, component_of=owners)
        doubled = self._index.doubled
        if doubled:
            first, second = doubled
            raise LabelError(
                f"DOF '{self._label(first)}' appears twice, in rows {first} and "
                f"{second} (from 0): rows of the matrices would be ambiguous. Drop one of them, or "
                "renumber the node."
            )

    @cached_property
    def kinds(self) -> IntArray:
        """What each DOF is (n,): 0 to 5 for x, y, z, rx, ry, rz."""
        listed = np.array(self.directions, dtype="U2")
        kinds = np.zeros(listed.size, dtype=np.int64)
        for kind, direction in enumerate(DIRECTIONS):
            kinds[listed == direction] = kind
        return np.asarray(frozen(kinds))

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """The labels `"node:direction"` in order; those of a joined machine name the component."""
        return tuple(self._label(row) for row in range(len(self)))

    def _label(self, row: int) -> str:
        label = f"{self.nodes[row]}:{self.directions[row]}"
        if self.component_of is None:
            return label
        return f"{self.components[self.component_of[row]]}/{label}"

    @cached_property
    def node_index(self) -> IntArray:
        """The number (n,) of each DOF's node, from 0; equal numbers in two components differ."""
        index: Any = np.unique(self.nodes, return_inverse=True)[1]
        if self.component_of is not None:
            pairs = index * len(self.components) + self.component_of
            index = np.unique(pairs, return_inverse=True)[1]
        return np.asarray(frozen(index))

    @cached_property
    def _index(self) -> _DofIndex:
        return _DofIndex(self.nodes, self.kinds, self.components, self.component_of)

    def __len__(self) -> int:
        return int(self.nodes.size)

    def __iter__(self) -> Iterator[str]:
        return iter(self.labels)

    def __contains__(self, label: object) -> bool:
        return self._index.found(label) >= 0

    def __repr__(self) -> str:
        counts = np.bincount(self.kinds, minlength=len(DIRECTIONS)).tolist()
        kinds = ", ".join(f"{n} {d}" for n, d in zip(counts, DIRECTIONS, strict=True) if n)
        nodes = int(self.node_index.max(initial=-1)) + 1
        of = f" of {', '.join(self.components)}" if self.components else ""
        return f"<DofSet {counted(len(self), 'DOF')} at {counted(nodes, 'node')}{of}: {kinds}>"

    def index(self, label: str) -> int:
        """Return the row of a DOF in the matrices (from 0).

        Parameters
        ----------
        label : str
            Label of the DOF, such as `"41:z"`.
        """
        row = self._index.found(label)
        if row < 0:
            if self._dependent(label) is not None:
                raise LabelError(
                    f"DOF {label!r} is not a row of the matrices: it follows other DOFs, by a "
                    "joint. Its "
                    "motion is row(label); name a DOF that is there, such as "
                    f"{self._label(0)!r}."
                )
            raise unknown_dof(label, self.nodes, self._label)
        return row

    def _dependent(self, label: str) -> tuple[FloatArray, FloatArray] | None:
        return None if self.interpolation is None else self.interpolation.dependent(label)

    def location(self, label: str) -> FloatArray:
        """Return the coordinates (3,) [m] of a DOF's node, also if the DOF follows others."""
        found = None if label in self else self._dependent(label)
        return self.xyz[self.index(label)] if found is None else found[1]

    def indices(self, labels: Iterable[str]) -> IntArray:
        """Return the rows of several DOFs, in the order given."""
        if isinstance(labels, str):
            labels = [labels]
        labels = as_list(labels, "labels", "a list of DOF labels such as '41:z'")
        return np.array([self.index(label) for label in labels], dtype=np.int64)

    def select(self, labels: Iterable[str]) -> DofSet:
        """Return the DofSet of some of the DOFs, in the order given (no interpolation)."""
        return self._taken(self.indices(labels))

    def _taken(self, rows: IntArray) -> DofSet:
        """Return the DofSet of some rows (n,), in the order given (no interpolation)."""
        names = np.array(DIRECTIONS, dtype=object)
        return DofSet(
            self.nodes[rows],
            tuple(names[self.kinds[rows]]),
            self.xyz[rows],
            components=self.components,
            component_of=None if self.component_of is None else self.component_of[rows],
        )

    def _owned(self, component: str | None) -> Any:
        """Return which DOFs (n,) belong to a component; None: all."""
        if component is None:
            return np.ones(len(self), dtype=bool)
        if self.component_of is None or not (
            isinstance(component, str) and component in self.components
        ):
            raise unknown_label("component", component, self.components)
        return self.component_of == self.components.index(component)

    def where(
        self,
        nodes: Iterable[int] | int | None = None,
        directions: Iterable[str] | str | None = None,
        *,
        box: Sequence[Sequence[float]] | FloatArray | None = None,
        component: str | None = None,
    ) -> DofSet:
        """Return the DOFs at the given nodes, in the given directions, in a box (None: all).

        Parameters
        ----------
        nodes : int or sequence of int, optional
            Node numbers.
        directions : str or sequence of str, optional
            Directions, such as `"z"`.
        box : (2, 3) array [m], optional
            Lowest and highest corner of the box, which belong to it. For example,
            ``[(0, 0, 0), (0, 0.6, 0)]`` is an edge. Infinite entries are allowed.
        component : str, optional
            Component of a joined machine.
        """
        keep = self._owned(component)
        if nodes is not None:
            wanted = node_numbers(nodes if isinstance(nodes, Iterable) else [nodes])
            missing = np.setdiff1d(wanted, self.nodes[keep])
            if missing.size:
                raise LabelError(
                    f"no DOF at nodes {missing[:6].tolist()}: {self!r}. dofs.nodes lists them, "
                    "dofs.nearest((x, y, z)) finds one by its place."
                )
            keep &= np.isin(self.nodes, wanted)
        if directions is not None:
            named = set(name_list(directions, "directions"))
            absent = sorted(str(d) for d in named - set(self.directions))
            if absent:
                raise LabelError(
                    f"no DOF in directions {absent}: {self!r}. "
                    + (rotation_hint(absent, self.directions) or "Use those that are there.")
                )
            keep &= np.isin(self.kinds, [DIRECTIONS.index(direction) for direction in named])
        if box is not None:
            keep &= in_box(self.xyz, box)
            if not keep.any():
                low, high = self.xyz.min(axis=0).tolist(), self.xyz.max(axis=0).tolist()
                raise LabelError(
                    f"no such DOF in the box {np.asarray(box).tolist()!r:.120}: the nodes reach "
                    f"from {low} to {high} m. Coordinates are in metres; make the box larger."
                )
        return self._taken(np.flatnonzero(keep))

    def nearest(
        self,
        xyz: Sequence[float] | FloatArray,
        direction: str = "z",
        *,
        component: str | None = None,
    ) -> str:
        """Return the label of the DOF in `direction` whose node is nearest to a point.

        Parameters
        ----------
        xyz : (3,) array [m]
            The point.
        direction : str
            Direction of the DOF; at least one DOF must have it.
        component : str, optional
            Component of a joined machine; by default all.
        """
        known = isinstance(direction, str) and direction in DIRECTIONS
        kind = DIRECTIONS.index(direction) if known else -1
        rows = np.flatnonzero((self.kinds == kind) & self._owned(component))
        if not rows.size:
            raise LabelError(
                f"no DOF in direction {direction!r}: {self!r}. "
                + (rotation_hint([direction], self.directions) or "Choose one that is there.")
            )
        point = real_array(xyz, "xyz", (3,))
        distance = np.linalg.norm(self.xyz[rows] - point, axis=1)
        return self._label(int(rows[np.argmin(distance)]))

    def row(self, at: Place, direction: str = "z") -> FloatArray:
        """Return the row (n,) that picks the motion at a place from the vector of all DOFs.

        The transpose of the row is the load vector of a unit force (moment) at this place.

        Parameters
        ----------
        at : str, (3,) array [m] or mapping
            A DOF label, a point (interpolated between nodes), or a weighted sum of labels and
            points, {label or (x, y, z): weight}.
        direction : str
            Direction of the motion at a point; labels contain a direction.
        """
        row = np.zeros(len(self))
        if isinstance(at, str):
            dependent = None if at in self else self._dependent(at)
            if dependent is not None:
                return dependent[0]
            row[self.index(at)] = 1.0
            return row
        if isinstance(at, Mapping):
            for place, weight in at.items():
                part = float(real_array(weight, f"weight of {place!r}", ()))
                row += part * self.row(place, direction)
            return row
        point = real_array(at, "at", (3,))
        checked_direction(direction)
        if self.interpolation is not None:
            return self.interpolation.row(point, direction)
        label = self.nearest(point, direction)
        row[self.index(label)] = 1.0
        offset = float(np.linalg.norm(self.xyz[self.index(label)] - point))
        if offset > SAME * max(1.0, float(np.ptp(self.xyz, axis=0).max())):
            raise LabelError(
                f"the point {tuple(point.tolist())} is {offset:.3g} m from the nearest node with "
                f"direction {direction!r} ({label!r}), and this model has no shape functions to "
                f"interpolate with. Use at={label!r}, a mapping {{label: weight}}, or interpolate "
                "the shapes between nodes: flexplant.interpolated(model)."
                f"{self._attached(label, point, direction)}"
            )
        return row

    def _attached(self, label: str, point: FloatArray, direction: str) -> str:
        """Return how a point is given that moves rigidly with the node of a label, if it can be."""
        k, node = DIRECTIONS.index(direction), label.partition(":")[0]
        offset = point - self.xyz[self.index(label)]
        turned = np.cross(np.eye(3), offset)[:, k].tolist() if k < 3 else [0.0, 0.0, 0.0]
        small = SAME * float(np.linalg.norm(offset))
        sizes = {f"{node}:r{axis}": by for axis, by in zip("xyz", turned, strict=True)}
        weights = {name: by for name, by in sizes.items() if abs(by) > small}
        if not weights or not all(name in self for name in weights):
            return ""
        shown = ", ".join(f"{name!r}: {by:.6g}" for name, by in ({label: 1.0} | weights).items())
        return f" Where it moves rigidly with node {node}: at={{{shown}}}."

    def rows(self, points: FloatArray, direction: str = "z") -> FloatArray:
        """Return the rows (p, n) of the motion at many points (p, 3) [m]; see `row`."""
        places = real_array(points, "points", (None, 3))
        if self.interpolation is not None and direction in DIRECTIONS:
            return self.interpolation.rows(places, direction)
        return np.array([self.row(place, direction) for place in places]).reshape(-1, len(self))

    @classmethod
    def from_table(cls, table: str | Path | Iterable[Mapping[str, Any]]) -> DofSet:
        """Return the DofSet of a table with columns node, direction, x, y, z [m].

        Parameters
        ----------
        table : path of a CSV file, or an iterable of mappings
            Table with one row for each DOF, in the order of the matrices.
        """
        return cls(*columns_of(table))


def node_dofs(
    ids: IntArray,
    directions: Sequence[str],
    xyz: FloatArray,
    interpolation: Interpolation | None = None,
) -> DofSet:
    """Return the DOFs of nodes (n,) at places (n, 3), the same directions at each."""
    m = len(directions)
    names, places = tuple(directions) * ids.size, np.repeat(xyz, m, axis=0)
    return DofSet(np.repeat(ids, m), names, places, interpolation)
