"""Components joined to one machine: `joined`, and the checks of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..checks import FloatArray, IntArray, Value, frozen
from ..errors import CertificateError, ModelError, counted, warn
from ..labels import DIRECTIONS, DofSet
from ..lti import Frf
from ..modes.statics import static_response
from ..reduction import ReducedModel
from ..sparse.factor import dense
from ..structure import FEModel
from ..structure.rigid import SPANNED, orthonormalised, rigid_body_basis
from ..tolerances import TINY, divisor
from .component import Component, JoinedShape, Model, Pose, components_of
from .frf_coupling import joined_frfs
from .joint import Joint, Patch, split_end
from .links import (
    Elimination,
    Link,
    eliminated,
    links_of,
    machine_size,
    stretch_rows,
    warn_of_missing_statics,
)

#: more coordinates of a machine with reduced components would not fit the memory comfortably
_LARGEST = 5000
#: a spring above this many times the stiffness of its components leaves these less than six digits
_STIFFEST = 1e10


@overload
def joined(
    components: Mapping[str, Frf],
    joints: Iterable[Joint] | Joint = (),
    *,
    dofs: Mapping[str, DofSet] | None = None,
) -> Frf: ...


@overload
def joined(
    components: Mapping[str, Model],
    joints: Iterable[Joint] | Joint = (),
    *,
    placed: Mapping[str, Pose] | None = None,
    name: str | None = None,
) -> FEModel | ReducedModel: ...


def joined(
    components: Mapping[str, Any],
    joints: Iterable[Joint] | Joint = (),
    *,
    placed: Mapping[str, Pose] | None = None,
    name: str | None = None,
    dofs: Mapping[str, DofSet] | None = None,
) -> FEModel | ReducedModel | Frf:
    """Return a machine of components, held together by joints.

    ``q = T q_k`` fulfils the rigid joints, ``B q = 0``; the machine has ``T^T M T``,
    ``T^T (K + b k b^T) T`` and ``T^T (D + b c b^T) T``, M, K and D being those of all components
    and b the stretch of a spring or damper. Which coordinates follow is found by QR with column
    pivoting, of constraints that share coordinates; joints that repeat others do no harm.

    Parameters
    ----------
    components : mapping {str: FEModel or ReducedModel}, or {str: Frf}
        Labels of the machine begin with their names: "stage/41:z". Of measured responses, all
        must be; their joints are between channels that are outputs "41:z" and inputs "41:z" or
        "u 41:z".
    joints : Joint or sequence of Joint
        What holds them together. The second end of a rigid joint follows the first.
    placed : mapping {str: Pose}, optional
        Where components stand; None: where they were made. Labels and coordinates are those of the
        machine after that.
    name : str, optional
        Of an FEModel, for display.
    dofs : mapping {str: DofSet}, optional
        Of measured responses: where the nodes of components are, in the coordinates of the
        machine, for joints with lever arms and of patches. The mean motion of a `Patch` is that of
        its outputs, and its force acts on its inputs, which may be other channels (virtual point
        transformation).

    Returns
    -------
    FEModel, ReducedModel or Frf
        An FEModel of FEModels, sparse; a ReducedModel when one of them is reduced. DOFs that
        follow others stay known by their labels, as places. `joining` holds the checks: gaps,
        balance of forces, inertia, rigid-body motions, errors of patches. The modes that a
        reduction of a component left out are not kept. Of responses, ``Y - Y B^T (B Y B^T +
        Z)^-1 B Y``, Z being what springs and dampers give way (LM-FBS); variances of independent
        responses give those of the machine to first order.

    Raises
    ------
    LabelError
        When a component, a place or an axis is not there.
    ModelError
        When a rigid joint would hold the machine against the ground, a component is none, a spring
        is so stiff that the digits of its components are lost, or full matrices would be too large.
    CertificateError
        When the machine fails its checks.

    Warns
    -----
    FlexplantWarning
        When springs and dampers hold the machine against the ground, a reduced component has no
        static shape for the load of a joint, joints nearly repeat each other, a component has no
        damping where others have, or errors of responses exceed those of the machine.

    References
    ----------
    [CraigKurdila2006]_, ch. 17.

    Examples
    --------
    >>> from flexplant.structure import chain
    >>> stage, frame = chain(masses=[1, 2], stiffnesses=[5]), chain(masses=[3, 4], stiffnesses=[6])
    >>> machine = joined({"stage": stage, "frame": frame}, Joint("stage/1:x", "frame/1:x"))
    >>> machine.dofs.labels, machine.mass
    (('stage/1:x', 'stage/2:x', 'frame/2:x'), 10.0)
    >>> machine.row("frame/1:x").tolist()
    [1.0, 0.0, 0.0]
    """
    listed = components.values() if isinstance(components, Mapping) else ()
    if any(isinstance(component, Frf) for component in listed):
        if placed is not None or name is not None:
            raise ModelError(
                "measured responses have no place and no name: leave placed= and name= out."
            )
        return joined_frfs(components, joints, dofs)
    if dofs is not None:
        raise ModelError("models have their DOFs: leave dofs= out, which is for responses.")
    parts = components_of(components, placed)
    links = links_of(joints, parts)
    warn_of_missing_statics(links, parts)
    rigid = [link for link in links if link.joint.is_rigid]
    soft = [link for link in links if not link.joint.is_rigid]
    B, S = stretch_rows(rigid, parts), stretch_rows(soft, parts)
    _check_stiffness(soft, S, parts)
    owners = np.repeat(np.arange(len(parts)), [part.n for part in parts])
    done = eliminated(B, _coordinate_reach(parts), owners)
    matrices = _machine_matrices(parts, soft, S, done)
    groups, kept = groups_of(links, len(parts)), done.kept
    motions = left_motions(parts, groups, B, matrices["M"], kept, free=False)
    springs = [i for i, link in enumerate(soft) if link.stiffness]
    every = sp.vstack([B, S[springs]], format="csr")
    rigid_body = left_motions(parts, groups, every, matrices["M"], kept, free=True)
    expected = rigid_body.shape[1]
    if not any(part.is_reduced for part in parts):  # by energy, as the model finds them
        xyz = _all_dofs(parts).xyz[done.kept]
        rigid_body = rigid_body_basis(matrices["M"], matrices["K"], motions, xyz)
    patches = patch_errors(links, parts)
    certificate = certified(parts, links, done, matrices, groups, rigid_body, expected, patches)
    common = {"joint_motions": motions, "joining": certificate}
    if not any(part.is_reduced for part in parts):
        return _joined_model(parts, done, matrices | common, name)
    return _joined_reduced_model(parts, done, matrices | common, rigid_body)


def _check_stiffness(soft: Sequence[Link], S: Any, parts: Sequence[Component]) -> None:
    """Refuse springs beside which the digits of K are lost."""
    if not soft:
        return
    own = np.concatenate([np.abs(part.model.K.diagonal()) for part in parts])
    felt = abs(S)
    there = felt.copy()
    there.data = own[there.indices]
    most, there = (part.max(axis=1).toarray().ravel() for part in (felt, there))
    made = np.abs([link.stiffness for link in soft]) * most**2
    ratio = np.divide(made, there, out=np.zeros(made.size), where=there > 0)
    stiffest = int(np.argmax(ratio))
    if ratio[stiffest] > _STIFFEST:
        raise ModelError(
            f"the spring {soft[stiffest].joint!r} is {ratio[stiffest]:.2g} times "
            f"as stiff as its components there (limit {_STIFFEST:g}): the digits of their K would "
            "be lost beside it. Leave stiffness= out: the joint is rigid."
        )


def _coordinate_reach(parts: Sequence[Component]) -> FloatArray:
    """Return how far each coordinate (n,) moves its component at most, rotations times its size."""
    length, found = machine_size(parts), []
    for part in parts:
        weight = np.where(part.dofs.kinds < 3, 1.0, length)
        found.append(np.abs(weight[:, None] * part.T).max(axis=0) if part.is_reduced else weight)
    return divisor(np.concatenate(found))


def _machine_matrices(
    parts: Sequence[Component], soft: Sequence[Link], S: Any, done: Elimination
) -> dict[str, Any]:
    """Return M, D and K of the machine; D is None where nothing has damping."""
    reduced = any(part.is_reduced for part in parts)
    if reduced and done.kept.size > _LARGEST:
        raise ModelError(
            f"a machine with reduced components has full matrices: {done.kept.size} coordinates "
            f"are too many (limit {_LARGEST}). Reduce the large components first, by "
            "CraigBampton(boundary=[...]) at their joints, or join models and reduce the machine."
        )
    damped = [part.is_damped for part in parts]
    if any(damped) and not all(damped):
        bare = [part.name for part, there in zip(parts, damped, strict=True) if not there]
        warn(
            f"components {bare} have no D, others have: they are undamped in the machine. Give "
            "them one first, model.with_damping(ModalDamping(...)), or damp the machine's modes."
        )
    weights = {"K": [link.stiffness for link in soft], "D": [link.rate for link in soft]}
    found: dict[str, Any] = {"D": None}
    for name in "MDK" if any(damped) or reduced or any(weights["D"]) else "MK":
        own = [(part, getattr(part.model, name)) for part in parts]
        blocks = [sp.csc_array((part.n, part.n) if A is None else A) for part, A in own]
        whole: Any = sp.block_diag(blocks, format="csc")
        if name in weights and soft:
            whole = whole + S.T @ sp.diags_array(np.array(weights[name])) @ S
        whole = done.T.T @ whole @ done.T
        whole = sp.csc_array(0.5 * (whole + whole.T))
        found[name] = dense(whole) if reduced else whole
    return found


def _all_dofs(parts: Sequence[Component]) -> DofSet:
    """Return all DOFs of all components; a machine in a machine brings the names of its own."""
    names: list[str] = []
    owners = []
    for part in parts:
        own = part.dofs.component_of
        inner = part.dofs.components if own is not None else ("",)
        start = len(names)
        names += [f"{part.name}/{name}".rstrip("/") for name in inner]
        owners.append(start + (np.zeros(len(part.dofs), np.int64) if own is None else own))
    kinds = np.concatenate([part.dofs.kinds for part in parts])
    return DofSet(
        np.concatenate([part.dofs.nodes for part in parts]),
        tuple(np.array(DIRECTIONS, dtype=object)[kinds]),
        np.vstack([part.dofs.xyz for part in parts]),
        components=tuple(names),
        component_of=np.concatenate(owners),
    )


def _shape(parts: Sequence[Component], expansion: Any = None, motions: Any = None) -> JoinedShape:
    names, dofs = zip(*((part.name, part.dofs) for part in parts), strict=True)
    return JoinedShape(names, dofs, expansion, motions)


def _joined_model(
    parts: Sequence[Component], done: Elimination, fields: dict[str, Any], name: str | None
) -> FEModel:
    held = None
    if any(part.model.held_inertia is not None for part in parts):
        own = [(part.n, part.model.held_inertia) for part in parts]
        loads = [np.zeros((n, 6)) if load is None else load for n, load in own]
        held = np.asarray(done.T.T @ np.vstack(loads))
    # sums of definite matrices are definite, and T has full rank: nothing to check again
    return FEModel._proven(
        **{key: frozen(value) for key, value in fields.items()},
        dofs=_all_dofs(parts)._taken(done.kept).replace(interpolation=_shape(parts, done.T)),
        name=name,
        held_inertia=frozen(held),
    )


def _joined_reduced_model(
    parts: Sequence[Component], done: Elimination, fields: dict[str, Any], rigid: FloatArray
) -> ReducedModel:
    full = _all_dofs(parts)
    names = np.array([label for part in parts for label in part.coordinates], dtype=object)
    left = names[done.kept].tolist()
    of_dofs = [np.arange(part.n) < len(part.model.dofs) for part in parts]
    physical = np.concatenate(of_dofs)[done.kept]
    # DOFs first, generalised coordinates after them
    order = np.argsort(~physical, kind="stable")
    T = frozen(la.block_diag(*(dense(part.T) for part in parts)) @ done.T[:, order].toarray())
    full = full.replace(interpolation=_shape(parts, motions=T))
    listed = [left[i] for i in order.tolist()]
    return ReducedModel(
        **{name: fields[name][np.ix_(order, order)] for name in "MDK"},
        T=T,
        dofs=full.select(listed[: int(physical.sum())]),
        full_dofs=full,
        rigid_body=rigid[order],
        method=f"components {', '.join(part.name for part in parts)} joined",
        condition=max(part.model.condition if part.is_reduced else 1.0 for part in parts),
        condition_of="their own",
        coordinates=listed,
        n_vectors=sum(part.model.n_vectors for part in parts if part.is_reduced),
        static_at=[
            f"{part.name}/{label}"
            for part in parts
            if part.is_reduced
            for label in part.model.static_at
            if label in part.dofs
        ],
        joint_motions=fields["joint_motions"][order],
        joining=fields["joining"],
    )


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
        mixes = [
            body.T @ part.model.inertia(part.model.rigid_motions())
            for part, body in zip(several, own, strict=True)
        ]
        missed = np.max([part.model.missed_motions() for part in several], axis=0)
        rows_of = np.concatenate([np.arange(starts[i], starts[i + 1]) for i in group])
        motions = np.zeros((int(starts[-1]), sum(part.shape[1] for part in own)))
        motions[rows_of] = la.block_diag(*own)
        scale = np.abs(motions).max(axis=0, initial=0.0)
        motions = motions / divisor(scale)
        whole = np.vstack(mixes) * scale[:, None]
        stretch = np.asarray(rows @ motions)
        most = np.asarray(abs(rows) @ np.abs(motions)).max(axis=1, initial=0.0)
        stretch[np.abs(stretch) <= _NONE * most[:, None]] = 0.0  # rounding of what cancels
        size = np.linalg.norm(stretch, axis=1)
        allowed = la.null_space(stretch / divisor(size)[:, None], rcond=_NONE)
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


#: patches of more displacements are not examined: each is a load of the component
_MOST = 1000
#: singular values of the compliance of a patch below this part of the largest are none
_RANK = 1e-11


def patch_errors(links: Sequence[Link], parts: Sequence[Component]) -> dict[str, float]:
    """Return, for each patch of a joint, how far apart its bounds of the compliance are.

    With u the displacements of the nodes, C their elastic compliance on the component alone, A the
    rigid motions of the patch and W the mean, ``W A = I``: a load on the mean motion meets
    ``W C W^T``, on a patch that stays rigid ``(A^T C^-1 A)^-1``, which is less (Gauss and Markov).
    What is returned is the largest of 1 - rigid / mean over the axes joined; NaN for a patch of
    more than 1000 displacements, or of an unstable component.
    """
    found: dict[str, float] = {}
    joints = list({id(link.joint): link.joint for link in links}.values())
    for number, joint in enumerate(joints, 1):
        # a joint that is listed twice is one
        axes = sorted({DIRECTIONS.index(link.axis) for link in links if link.joint is joint})
        for end in (joint.first, joint.second):
            if isinstance(end, Patch):
                name = split_end(f"{end.component}/", [part.name for part in parts])[0]
                part = next(part for part in parts if part.name == name)
                mean, rigid = compliances(part, end, axes)
                found[f"joint {number}, {end!r}"] = float(np.max(1.0 - rigid / mean))
    return found


def compliances(
    part: Component, patch: Patch, axes: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Return the elastic compliance (k,) along axes: of the mean motion, and of a rigid patch."""
    rows, point = patch.rows(part.dofs), patch.point(part.dofs)
    W, A, _ = patch.mean(part.dofs, point)
    if rows.size > _MOST or part.model.n_unstable:
        return np.full(len(axes), np.nan), np.full(len(axes), np.nan)
    model, loads = part.model, dense(part.T[rows].T)
    C = loads.T @ static_response(model.M, model.K, model.rigid_body, loads)
    C = 0.5 * (C + C.T)
    W, A = W[list(axes)], A[:, list(axes)]
    mean = np.diag(W @ C @ W.T)
    # motions of A cost no energy here, so that C is invertible where the patch can move at all
    beside = float(np.trace(C)) / max(float(np.sum(A**2)), TINY)
    stiffness = la.pinvh(C + beside * A @ A.T, rtol=_RANK)
    rigid = np.diag(la.inv(A.T @ stiffness @ A)) - beside
    return np.asarray(mean), np.asarray(rigid)


#: largest gap, imbalance and error of the inertia, relative
_LIMIT = 1e-7
#: a rigid-body motion that a reduced component misses by less is one of its own
_MADE = 1e-8
#: the part of the largest entry of a motion that counts for the rounding of each
_ENTRY = 1e-3


@dataclass(frozen=True, eq=False, repr=False)
class JoiningCertificate(Value):
    """What `joined` checked.

    Parameters
    ----------
    gap : float
        Largest opening of a rigid joint over all motions of what is left, relative to what cancels
        there.
    balance : float
        Largest resultant of the forces of a joint between two components, relative: what a motion
        of the whole machine stretches it. Springs may have one (they are warned of), rigid joints
        have none.
    mass : float [kg]
        Of the machine; NaN without displacements.
    inertia_error : float
        Largest difference between the machine's inertia against the six rigid-body motions and the
        sum of its components', relative.
    constraints, rank : int
        Axes of rigid joints, and how many of them are independent.
    rigid : mapping {str: int}
        Rigid-body motions of each component before it was joined.
    pieces : mapping {str: int}
        Rigid-body motions of each part of the machine that joints hold together, by the names of
        its components, "stage, frame".
    n_rigid : int
        Rigid-body motions of the machine.
    rigid_force : float
        Largest elastic force of these motions, relative to what cancels.
    patches : mapping {str: float}
        For each joint of a patch, by how much of the compliance of its mean motion a patch that
        stays rigid would be stiffer, at most over its axes: the error of either is below.

    Examples
    --------
    >>> import flexplant as fx
    >>> parts = {n: fx.chain(masses=[1.0, 2.0], stiffnesses=[5e5]) for n in ("stage", "frame")}
    >>> found = fx.joined(parts, fx.Joint("stage/1:x", "frame/1:x")).joining
    >>> found.n_rigid, found.mass, found.gap < 1e-12
    (1, 6.0, True)
    """

    gap: float
    balance: float
    mass: float
    inertia_error: float
    constraints: int
    rank: int
    rigid: Mapping[str, int]
    pieces: Mapping[str, int]
    n_rigid: int
    rigid_force: float
    patches: Mapping[str, float]

    def __repr__(self) -> str:
        before = ", ".join(f"{name} {count}" for name, count in self.rigid.items())
        pieces = "one piece"
        if len(self.pieces) > 1:
            listed = [f"{names}: {count}" for names, count in self.pieces.items()]
            pieces = f"{len(listed)} pieces ({'; '.join(listed)})"
        independent = f"{self.rank} of {counted(self.constraints, 'rigid constraint')} independent"
        errors = f"gap {self.gap:.1g}, balance {self.balance:.1g}, inertia {self.inertia_error:.1g}"
        errors += f", rigid force {self.rigid_force:.1g}"
        head = f"{counted(self.n_rigid, 'rigid-body motion')} (alone: {before}), {pieces}"
        text = [f"<JoiningCertificate: {head}, {self.mass:.6g} kg", f" {independent}, {errors}"]
        text += [f" {name}: compliance to {error:.2g}" for name, error in self.patches.items()]
        return "\n".join(text) + ">"


def certified(
    parts: Sequence[Component],
    links: Sequence[Link],
    done: Elimination,
    matrices: Mapping[str, Any],
    groups: Sequence[IntArray],
    rigid: FloatArray,
    expected: int,
    patches: Mapping[str, float],
) -> JoiningCertificate:
    """Return the checks of a joined machine."""
    B = stretch_rows([link for link in links if link.joint.is_rigid], parts)
    opening: Any = abs(B @ done.T).max(axis=1)
    most: Any = (abs(B) @ abs(done.T)).max(axis=1)
    opening, most = (np.asarray(part.todense()).ravel() for part in (opening, most))
    gap = float(np.max(opening / divisor(most), initial=0.0))
    size = np.array([1.0] * 3 + [machine_size(parts)] * 3)
    felt = [(link.joint.is_rigid, float(np.abs(link.carried / size).max())) for link in links]
    balance = max((part for is_rigid, part in felt if is_rigid), default=0.0)
    apart, error = _inertia(parts, matrices["M"], done.kept)
    found = JoiningCertificate(
        gap=gap,
        balance=max((part for _, part in felt), default=0.0),
        mass=float(max(np.diag(apart)[:3])) or float("nan"),
        inertia_error=error,
        constraints=B.shape[0],
        rank=done.rank,
        rigid={part.name: int(part.model.rigid_body.shape[1]) for part in parts},
        pieces=_by_piece(parts, groups, rigid, done.kept),
        n_rigid=rigid.shape[1],
        rigid_force=_force(matrices["K"], rigid),
        patches=patches,
    )
    if not max(gap, balance, error, found.rigid_force) < _LIMIT:
        raise CertificateError(
            f"the joined machine fails its check (limit {_LIMIT:g}): {found!r}. Join fewer axes, "
            "or look for joints that nearly repeat each other."
        )
    if found.n_rigid != expected:
        raise CertificateError(
            f"the machine has {counted(found.n_rigid, 'rigid-body motion')}, but {expected} of its "
            "components' stretch no joint: a joint is too soft or too stiff for the digits of the "
            "matrices. Look for a wrong unit of a stiffness, or leave the joint out."
        )
    return found


def _by_piece(
    parts: Sequence[Component], groups: Sequence[IntArray], rigid: FloatArray, kept: IntArray
) -> dict[str, int]:
    """Return how many rigid-body motions move each piece."""
    owner = np.repeat(np.arange(len(parts)), [part.n for part in parts])[kept]
    moved = [np.any(rigid[np.isin(owner, group)] != 0, axis=0) for group in groups]
    names = [", ".join(parts[i].name for i in group) for group in groups]
    return {name: int(np.count_nonzero(some)) for name, some in zip(names, moved, strict=True)}


def _force(K: Any, motions: FloatArray) -> float:
    """Return the largest elastic force of motions (k, r), relative to what cancels in it."""
    force = np.linalg.norm(np.asarray(K @ motions), axis=0)
    # a motion that no spring feels has nothing but rounding of its largest entries there
    moved = np.abs(motions) + _ENTRY * np.abs(motions).max(axis=0, initial=0.0)
    most = np.linalg.norm(np.asarray(abs(K) @ moved), axis=0)
    return float(np.max(force / divisor(most), initial=0.0))


def _inertia(parts: Sequence[Component], M: Any, kept: IntArray) -> tuple[FloatArray, float]:
    """Return the inertia (6, 6) of all components, and how far that of the machine is off.

    Motions that a reduced component cannot make (it is held, say) have no inertia of the whole.
    """
    own = [part.model.rigid_motions() for part in parts]
    apart = np.zeros((6, 6))
    missed = np.zeros(6)
    for part, motions in zip(parts, own, strict=True):
        apart += motions.T @ part.model.inertia(motions)
        if part.is_reduced:
            missed = np.maximum(missed, part.model.missed_motions())
    whole = np.vstack(own)[kept]
    size = np.sqrt(np.maximum(np.diag(apart), TINY))
    error = np.abs(whole.T @ np.asarray(M @ whole) - apart) / np.outer(size, size)
    made = missed < _MADE
    return apart, float(error[np.ix_(made, made)].max(initial=0.0))
