"""Components joined to one machine: `joined`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, overload

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..errors import ModelError, warn
from ..labels import DIRECTIONS, DofSet
from ..lti import Frf
from ..reduction import ReducedModel
from ..sparse.factor import dense
from ..structure import FEModel
from ..structure.rigid import rigid_body_basis
from ..values import FloatArray, frozen
from .component import Component, Model, components_of
from .elimination import Elimination, eliminated
from .frf_coupling import joined_frfs
from .joined_shapes import JoinedShape
from .joining_certificate import certified
from .joint import Joint
from .links import Link, links_of, machine_size, rows_of, warn_of_missing_statics
from .motions import groups_of, left_motions
from .patch_error import patch_errors
from .pose import Pose

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
    B, S = rows_of(rigid, parts), rows_of(soft, parts)
    _check_stiffness(soft, S, parts)
    owners = np.repeat(np.arange(len(parts)), [part.n for part in parts])
    done = eliminated(B, _sizes(parts), owners)
    matrices = _matrices(parts, soft, S, done)
    groups, kept = groups_of(links, len(parts)), done.kept
    motions = left_motions(parts, groups, B, matrices["M"], kept, free=False)
    springs = [i for i, link in enumerate(soft) if link.stiffness]
    every = sp.vstack([B, S[springs]], format="csr")
    rigid_body = left_motions(parts, groups, every, matrices["M"], kept, free=True)
    expected = rigid_body.shape[1]
    if not any(part.is_reduced for part in parts):  # by energy, as the model finds them
        rigid_body = rigid_body_basis(matrices["M"], matrices["K"], motions)
    patches = patch_errors(links, parts)
    certificate = certified(parts, links, done, matrices, groups, rigid_body, expected, patches)
    common = {"joint_motions": motions, "joining": certificate}
    if not any(part.is_reduced for part in parts):
        return _full(parts, done, matrices | common, name)
    return _reduced(parts, done, matrices | common, rigid_body)


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


def _sizes(parts: Sequence[Component]) -> FloatArray:
    """Return how far each coordinate (n,) moves its component at most, rotations times its size."""
    length, found = machine_size(parts), []
    for part in parts:
        weight = np.where(part.dofs.kinds < 3, 1.0, length)
        if part.is_reduced:
            found.append(np.abs(weight[:, None] * part.T).max(axis=0))
        else:
            found.append(weight)
    size = np.concatenate(found)
    return np.where(size > 0, size, 1.0)


def _matrices(
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
    rates = any(link.rate for link in soft)
    if any(damped) and not all(damped):
        bare = [part.name for part, there in zip(parts, damped, strict=True) if not there]
        warn(
            f"components {bare} have no D, others have: they are undamped in the machine. Give "
            "them one first, model.with_damping(ModalDamping(...)), or damp the machine's modes."
        )
    weights = {"K": [link.stiffness for link in soft], "D": [link.rate for link in soft]}
    found: dict[str, Any] = {}
    for name in ("M", "D", "K"):
        if name == "D" and not any(damped) and not rates and not reduced:
            found[name] = None
            continue
        blocks = [_block(part, name) for part in parts]
        whole: Any = sp.block_diag(blocks, format="csc")
        if name in weights and soft:
            whole = whole + S.T @ sp.diags_array(np.array(weights[name])) @ S
        whole = done.T.T @ whole @ done.T
        whole = sp.csc_array(0.5 * (whole + whole.T))
        found[name] = dense(whole) if reduced else whole
    return found


def _block(part: Component, name: str) -> Any:
    matrix = getattr(part.model, name)
    return sp.csc_array((part.n, part.n)) if matrix is None else sp.csc_array(matrix)


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


def _full(
    parts: Sequence[Component], done: Elimination, fields: dict[str, Any], name: str | None
) -> FEModel:
    shape = JoinedShape(
        tuple(part.name for part in parts), tuple(part.dofs for part in parts), done.T
    )
    loads = [part.model.held_inertia for part in parts]
    held = None
    if any(load is not None for load in loads):
        some = [
            np.zeros((part.n, 6)) if load is None else load
            for part, load in zip(parts, loads, strict=True)
        ]
        held = np.asarray(done.T.T @ np.vstack(some))
    # sums of definite matrices are definite, and T has full rank: nothing to check again
    return FEModel._proven(
        **{key: frozen(value) for key, value in fields.items()},
        dofs=_all_dofs(parts)._taken(done.kept).replace(interpolation=shape),
        name=name,
        held_inertia=frozen(held),
    )


def _reduced(
    parts: Sequence[Component], done: Elimination, fields: dict[str, Any], rigid: FloatArray
) -> ReducedModel:
    full = _all_dofs(parts)
    names = np.array([label for part in parts for label in part.coordinates], dtype=object)
    left = names[done.kept].tolist()
    physical = np.concatenate(
        [np.arange(part.n) < len(part.model.dofs) for part in parts],
    )[done.kept]
    # DOFs first, generalised coordinates after them
    order = np.argsort(~physical, kind="stable")
    T = frozen(la.block_diag(*(dense(part.T) for part in parts)) @ done.T[:, order].toarray())
    shape = JoinedShape(
        tuple(part.name for part in parts), tuple(part.dofs for part in parts), motions=T
    )
    full = full.replace(interpolation=shape)
    listed = [left[i] for i in order.tolist()]
    square = np.ix_(order, order)
    return ReducedModel(
        M=fields["M"][square],
        D=fields["D"][square],
        K=fields["K"][square],
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
