"""Components joined to one machine: `joined`, and the checks of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, overload

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from ..arrays import FloatArray, IntArray, divisor
from ..certificates import Certificate, Verified
from ..errors import CertificateError, ModelError, counted, warn
from ..labels import DIRECTIONS, DofSet
from ..lti import Frf
from ..modes.solve import static_response
from ..reduction import ReducedModel
from ..sparse.factor import DENSE_LIMIT, LARGEST_FULL
from ..sparse.symmetric import dense, orthonormalised
from ..store import Value, frozen
from ..structure import FEModel
from ..structure.rigid import rigid_body_basis
from ..tolerances import MISSED, NEGLIGIBLE, NULL, RESIDUAL, ROOT, SAME, TINY
from .component import Component, JoinedShape, Model, Pose, components_of
from .frf_coupling import joined_frfs
from .joint import Joint, Patch, split_end
from .links import Link, eliminated, links_of, machine_size, stretch_rows, warn_of_missing_statics


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
    """Return a machine of components that are connected by joints.

    The rigid joints are the constraints ``B q = 0`` on the coordinates q of all components. They
    are fulfilled by ``q = T q_k``, where q_k are the coordinates that remain. The machine then has
    the mass ``T^T M T``, the stiffness ``T^T (K + b k b^T) T`` and the damping
    ``T^T (D + b c b^T) T``. M, K and D are the block-diagonal matrices of all components. The
    stretch of a spring or damper is ``b^T q``, its stiffness is k, and its damping (force per
    velocity) is c. QR with column pivoting finds the coordinates that depend on others. Constraints
    without common coordinates are treated separately. Joints that repeat others are allowed.

    Parameters
    ----------
    components : mapping {str: FEModel or ReducedModel}, or {str: Frf}
        Components by name. Labels of the machine begin with the name, for example "stage/41:z".
        Models and measured responses cannot be joined with each other. A joint of measured
        responses needs two channels at each of its ends: the motion as an output and the force as
        an input. The output is named "41:z", and the input "41:z" or "u 41:z".
    joints : Joint or sequence of Joint
        Joints between the components. If a rigid joint makes two DOFs equal, the machine usually
        keeps the DOF of the component that is listed first.
    placed : mapping {str: Pose}, optional
        Poses of components in the machine. None: no component is moved. The coordinates and
        directions of the result are those of the machine.
    name : str, optional
        Name of the result, if it is an FEModel, as it is printed.
    dofs : mapping {str: DofSet}, optional
        Positions of the nodes of measured components, in the coordinates of the machine. Patches
        and joints with lever arms need them. The mean motion of a `Patch` is computed from the
        outputs on it, and its force is distributed over the inputs on it. The outputs and the
        inputs may be at different places. This is called the virtual point transformation.

    Returns
    -------
    FEModel, ReducedModel or Frf
        A sparse FEModel when all components are FEModels, and a ReducedModel when a component is
        reduced. DOFs that the rigid joints remove can still be used as places, by their labels. The
        attribute `joining` of a model is a `JoiningReport`. The machine does not contain the modes
        that the reduction of a component left out. For measured responses the result is
        ``Y - Y B^T (B Y B^T + Z)^-1 B Y``. Here Y is the block-diagonal matrix of the components'
        responses. When the components move by y, the joints are stretched by ``B y``. Z is the
        compliance of springs and dampers. This method is called LM-FBS, Lagrange multiplier
        frequency-based substructuring. The variance of the result is computed from the variances of
        the responses to first order. It is assumed that the errors of different components are
        independent.

    Raises
    ------
    ModelError
        When a rigid joint would hold the machine against the ground, a component has a wrong type,
        or full matrices would be too large. Also when a spring is so stiff that adding it to the
        stiffness matrix would round off the stiffness of its components.
    CertificateError
        When the machine fails its checks.

    Warns
    -----
    FlexplantWarning
        When springs and dampers hold the machine against the ground, joints nearly repeat each
        other, only some components have damping, or errors exceed the responses of the machine.
        Also when a reduced component has no static shape for the load of a joint.

    References
    ----------
    [CraigKurdila2006]_, ch. 17.

    Examples
    --------
    A rigid joint makes the first masses of two chains one mass:

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
                "placed= and name= do not apply to measured responses: leave them out."
            )
        return joined_frfs(components, joints, dofs)
    if dofs is not None:
        raise ModelError("models have their DOFs: leave dofs= out, which is for responses.")
    parts = components_of(components, placed)
    links = links_of(joints, parts)
    warn_of_missing_statics(links, parts)
    machine = JoinedMachine(parts, links)
    motions = machine.motions(machine.B, free=False)
    springs = [i for i, link in enumerate(machine.soft) if link.stiffness]
    every = sp.vstack([machine.B, machine.S[springs]], format="csr")
    rigid = machine.motions(every, free=True)
    expected = rigid.shape[1]
    if not machine.is_reduced:  # by energy, as the model finds the motions
        xyz = machine.all_dofs.xyz[machine.done.kept]
        rigid = rigid_body_basis(machine.matrices["M"], machine.matrices["K"], motions, xyz)
    certificate = machine.certified(rigid, expected, patch_errors(links, parts))
    if machine.is_reduced:
        return machine.reduced_model(motions, rigid, certificate)
    return machine.model(motions, certificate, name)


class JoinedMachine:
    """Components and the axes of their joints, with the motions that satisfy the rigid ones."""

    def __init__(self, parts: Sequence[Component], links: Sequence[Link]) -> None:
        self.parts, self.links = parts, links
        self.is_reduced = any(part.is_reduced for part in parts)
        self.soft = [link for link in links if not link.joint.is_rigid]
        self.B = stretch_rows([link for link in links if link.joint.is_rigid], parts)
        self.S = stretch_rows(self.soft, parts)
        self._check_stiffness()
        #: the component of each coordinate
        self.owners = np.repeat(np.arange(len(parts)), [part.n for part in parts])
        self.done = eliminated(self.B, self._reach(), self.owners)
        self.matrices = self._matrices()

    def _check_stiffness(self) -> None:
        """Refuse springs so stiff that the digits of K are lost."""
        if not self.soft:
            return
        own = np.concatenate([np.abs(part.model.K.diagonal()) for part in self.parts])
        felt: Any = abs(self.S)
        there = felt.copy()
        there.data = own[there.indices]
        most, there = (part.max(axis=1).toarray().ravel() for part in (felt, there))
        made = np.abs([link.stiffness for link in self.soft]) * most**2
        ratio = np.divide(made, there, out=np.zeros(made.size), where=there > 0)
        stiffest = int(np.argmax(ratio))
        if ratio[stiffest] > 1.0 / RESIDUAL:
            raise ModelError(
                f"the spring {self.soft[stiffest].joint!r} is {ratio[stiffest]:.2g} times as stiff "
                f"as its components there (limit {1.0 / RESIDUAL:g}): the digits of their K would "
                "be lost. Leave out stiffness= for a rigid joint."
            )

    def _reach(self) -> FloatArray:
        """Return the largest motion of a component by each coordinate, rotations times its size."""
        length, found = machine_size(self.parts), []
        for part in self.parts:
            weight = np.where(part.dofs.kinds < 3, 1.0, length)
            size = np.abs(weight[:, None] * part.T).max(axis=0) if part.is_reduced else weight
            found.append(size)
        return divisor(np.concatenate(found))

    def _matrices(self) -> dict[str, Any]:
        """Return M, D and K of the machine; D is None where nothing has damping."""
        if self.is_reduced and self.done.kept.size > LARGEST_FULL:
            raise ModelError(
                f"a machine with reduced components has full matrices: {self.done.kept.size} "
                f"coordinates are too many (limit {LARGEST_FULL}). Reduce the large components "
                "first, by fx.reduction.CraigBampton(boundary=[...]) at their joints, or join "
                "models and reduce the machine."
            )
        bare = [part.name for part in self.parts if not part.is_damped]
        damped = len(bare) < len(self.parts)
        if damped and bare:
            warn(
                f"components {bare} have no D but others do: they are undamped in the machine. "
                "Give them damping first, model.with_damping(ModalDamping(...)), or damp the "
                "machine's "
                "modes."
            )
        soft, T = self.soft, self.done.T
        weights = {"K": [link.stiffness for link in soft], "D": [link.rate for link in soft]}
        found: dict[str, Any] = {"D": None}
        for name in "MDK" if damped or self.is_reduced or any(weights["D"]) else "MK":
            own = [(part.n, getattr(part.model, name)) for part in self.parts]
            blocks = [sp.csc_array((n, n) if A is None else A) for n, A in own]
            whole: Any = sp.block_diag(blocks, format="csc")
            if name in weights and soft:
                whole = whole + self.S.T @ sp.diags_array(np.array(weights[name])) @ self.S
            whole = T.T @ whole @ T
            whole = sp.csc_array(0.5 * (whole + whole.T))
            found[name] = dense(whole) if self.is_reduced else whole
        return found

    @cached_property
    def all_dofs(self) -> DofSet:
        """All DOFs of all components; a machine as a component keeps its own names."""
        names: list[str] = []
        owners = []
        for name, dofs in ((part.name, part.dofs) for part in self.parts):
            own = np.zeros(len(dofs), np.int64) if dofs.component_of is None else dofs.component_of
            owners.append(len(names) + own)
            inner = ("",) if dofs.component_of is None else dofs.components
            names += [f"{name}/{one}".rstrip("/") for one in inner]
        kinds = np.concatenate([part.dofs.kinds for part in self.parts])
        return DofSet(
            np.concatenate([part.dofs.nodes for part in self.parts]),
            tuple(np.array(DIRECTIONS, dtype=object)[kinds]),
            np.vstack([part.dofs.xyz for part in self.parts]),
            components=tuple(names),
            component_of=np.concatenate(owners),
        )

    def _shape(self, expansion: Any = None, motions: Any = None) -> JoinedShape:
        names, dofs = zip(*((part.name, part.dofs) for part in self.parts), strict=True)
        return JoinedShape(names, dofs, expansion, motions)

    def model(self, motions: FloatArray, certificate: JoiningReport, name: str | None) -> FEModel:
        """Return the machine from FEModels."""
        T, held = self.done.T, None
        if any(part.model.held_inertia is not None for part in self.parts):
            own = [(part.n, part.model.held_inertia) for part in self.parts]
            loads = [np.zeros((n, 6)) if load is None else load for n, load in own]
            held = np.asarray(T.T @ np.vstack(loads))
        # sums of definite matrices are definite and T has full rank, so that no new check is needed
        return FEModel._proven(
            **{key: frozen(value) for key, value in self.matrices.items()},
            joint_motions=frozen(motions),
            joining=frozen(certificate),
            dofs=self.all_dofs._taken(self.done.kept).replace(interpolation=self._shape(T)),
            name=name,
            held_inertia=frozen(held),
        )

    def reduced_model(
        self, motions: FloatArray, rigid: FloatArray, certificate: JoiningReport
    ) -> ReducedModel:
        """Return the machine with some reduced components."""
        kept, reduced = self.done.kept, [part for part in self.parts if part.is_reduced]
        names = np.array([x for part in self.parts for x in part.coordinates], dtype=object)[kept]
        of_dofs = [np.arange(part.n) < len(part.model.dofs) for part in self.parts]
        physical = np.concatenate(of_dofs)[kept]
        # DOFs first, generalised coordinates after them
        order = np.argsort(~physical, kind="stable")
        expansion = la.block_diag(*(dense(part.T) for part in self.parts))
        T = frozen(expansion @ self.done.T[:, order].toarray())
        full = self.all_dofs.replace(interpolation=self._shape(motions=T))
        listed = names[order].tolist()
        return ReducedModel(
            **{name: A[np.ix_(order, order)] for name, A in self.matrices.items()},
            T=T,
            dofs=full.select(listed[: int(physical.sum())]),
            full_dofs=full,
            rigid_body=rigid[order],
            method=f"components {', '.join(part.name for part in self.parts)} joined",
            condition=max(part.model.condition for part in reduced),
            condition_of="their own",
            coordinates=listed,
            n_vectors=sum(part.model.n_vectors for part in reduced),
            static_at=[
                f"{part.name}/{label}"
                for part in reduced
                for label in part.model.static_at
                if label in part.dofs
            ],
            joint_motions=motions[order],
            joining=certificate,
        )

    @cached_property
    def groups(self) -> list[IntArray]:
        """The components (from 0) of each part of the machine that joints hold together."""
        pairs = [link.owners for link in self.links if link.holds and len(link.owners) == 2]
        ends = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        shape = (len(self.parts),) * 2
        graph = sp.coo_array((np.ones(len(pairs)), tuple(ends)), shape=shape)
        label = csgraph.connected_components(graph, directed=False)[1]
        return [np.flatnonzero(label == number) for number in range(int(label.max()) + 1)]

    def motions(self, rows: Any, *, free: bool) -> FloatArray:
        """Return the M-orthonormal motions (k, m) of components as rigid bodies along joints."""
        # they stretch no joint. For each part of the machine, motions of the whole come first, then
        # those of one component relative to others (a slide, a hinge). All are combinations of the
        # components' motions without energy and, unless `free`, also of held motions
        found = []
        for group in self.groups:
            several = [part.model for part in (self.parts[i] for i in group)]
            own = [model.rigid_body if free else _body_motions(model) for model in several]
            mixes = [
                body.T @ model.inertia(model.rigid_motions())
                for model, body in zip(several, own, strict=True)
            ]
            missed = np.max([model.missed_motions() for model in several], axis=0)
            motions = np.zeros((self.owners.size, sum(part.shape[1] for part in own)))
            motions[np.isin(self.owners, group)] = la.block_diag(*own)
            scale = np.abs(motions).max(axis=0, initial=0.0)
            motions = motions / divisor(scale)
            whole = np.vstack(mixes) * scale[:, None]
            stretch = np.asarray(rows @ motions)
            most = np.asarray(abs(rows) @ np.abs(motions)).max(axis=1, initial=0.0)
            stretch[np.abs(stretch) <= SAME * most[:, None]] = 0.0  # rounding of terms that cancel
            size = np.linalg.norm(stretch, axis=1)
            allowed = la.null_space(stretch / divisor(size)[:, None], rcond=SAME)
            rest = np.linalg.norm(whole - allowed @ (allowed.T @ whole), axis=0)
            size = np.linalg.norm(whole, axis=0)
            clean = (missed < NEGLIGIBLE) & (size > 0) & (rest <= SAME * size)
            candidates = motions[self.done.kept] @ np.hstack([whole[:, clean], allowed])
            found.append(orthonormalised(self.matrices["M"], candidates, dependent="drop"))
        return np.hstack(found)

    def certified(
        self, rigid: FloatArray, expected: int, patches: Mapping[str, float]
    ) -> JoiningReport:
        """Return the checks of the machine."""
        both: Any = abs(self.B @ self.done.T), abs(self.B) @ abs(self.done.T)
        opening, most = (part.max(axis=1).toarray().ravel() for part in both)
        gap = float(np.max(opening / divisor(most), initial=0.0))
        size = np.array([1.0] * 3 + [machine_size(self.parts)] * 3)
        felt = [(link.joint.is_rigid, np.abs(link.carried / size).max()) for link in self.links]
        balance = max((part for is_rigid, part in felt if is_rigid), default=0.0)
        apart, error = self._inertia()
        owner, pieces = self.owners[self.done.kept], {}
        for group in self.groups:
            moved = np.any(rigid[np.isin(owner, group)] != 0, axis=0)
            names = ", ".join(self.parts[i].name for i in group)
            pieces[names] = int(np.count_nonzero(moved))
        found = JoiningReport(
            gap=gap,
            balance=float(max((part for _, part in felt), default=0.0)),
            mass=float(max(np.diag(apart)[:3])) or float("nan"),
            inertia_error=error,
            constraints=self.B.shape[0],
            rank=self.done.rank,
            rigid={part.name: int(part.model.rigid_body.shape[1]) for part in self.parts},
            pieces=pieces,
            n_rigid=rigid.shape[1],
            rigid_force=_force(self.matrices["K"], rigid),
            patches=patches,
        )
        # springs may have a resultant force, rigid joints may not
        if balance > MISSED or not found.certificate.holds:
            raise CertificateError(
                f"the joined machine fails its check (limit {MISSED:g}): {found!r}. Join fewer "
                "axes, or look for joints that nearly repeat each other."
            )
        if found.n_rigid != expected:
            raise CertificateError(
                f"the machine has {counted(found.n_rigid, 'rigid-body motion')}, but {expected} "
                "motions of its components stretch no joint: a joint is too soft or too stiff "
                "for the digits "
                "of the matrices. Look for a wrong unit of a stiffness, or leave the joint out."
            )
        return found

    def _inertia(self) -> tuple[FloatArray, float]:
        """Return the inertia (6, 6) of all components, and the error of that of the machine."""
        # motions that a reduced component cannot make (because it is held) have no inertia of the
        # whole
        own = [part.model.rigid_motions() for part in self.parts]
        apart, missed = np.zeros((6, 6)), np.zeros(6)
        for part, motions in zip(self.parts, own, strict=True):
            apart += motions.T @ part.model.inertia(motions)
            if part.is_reduced:
                missed = np.maximum(missed, part.model.missed_motions())
        whole = np.vstack(own)[self.done.kept]
        size = np.sqrt(np.maximum(np.diag(apart), TINY))
        error = np.abs(whole.T @ np.asarray(self.matrices["M"] @ whole) - apart)
        error, made = error / np.outer(size, size), missed < ROOT
        return apart, float(error[np.ix_(made, made)].max(initial=0.0))


def _body_motions(model: Any) -> FloatArray:
    """Return the rigid-body motions (n, r) of a component, held ones too."""
    rigid: FloatArray = model.rigid_body
    every: FloatArray = model.body_motions
    # a reduced model knows its motions more accurately than its shapes do
    return rigid if rigid.shape[1] == every.shape[1] else every


def _force(K: Any, motions: FloatArray) -> float:
    """Return the largest elastic force of motions (k, r), relative to the terms that cancel."""
    force = np.linalg.norm(np.asarray(K @ motions), axis=0)
    # a motion without spring forces has only rounding of its largest entries there
    moved = np.abs(motions) + NEGLIGIBLE * np.abs(motions).max(axis=0, initial=0.0)
    most = np.linalg.norm(np.asarray(abs(K) @ moved), axis=0)
    return float(np.max(force / divisor(most), initial=0.0))


#: singular values of the compliance of a patch below this, relative to the largest, count as zero
_RANK = NULL


def patch_errors(links: Sequence[Link], parts: Sequence[Component]) -> dict[str, float]:
    """Return, for each patch of a joint, the distance between the bounds of its compliance."""
    # with u the displacements of the nodes, C their elastic compliance on the component alone, A
    # the rigid motions of the patch and W the mean, `W A = I`: a load on the mean motion sees `W C
    # W^T`, on a rigid patch `(A^T C^-1 A)^-1`, which is smaller (Gauss and Markov). The function
    # returns the largest 1 - rigid / mean over the joined axes; NaN for a patch of more than 1000
    # displacements, or of a component that is unstable or has no elastic modes
    found: dict[str, float] = {}
    joints = list({id(link.joint): link.joint for link in links}.values())
    for number, joint in enumerate(joints, 1):
        # a joint that is listed twice counts once
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
    model = part.model
    # a component with rigid-body modes only has no elastic compliance
    if rows.size > DENSE_LIMIT or model.n_unstable or model.rigid_body.shape[1] == model.K.shape[0]:
        return np.full(len(axes), np.nan), np.full(len(axes), np.nan)
    loads = dense(part.T[rows].T)
    C = loads.T @ static_response(model, loads)
    C = 0.5 * (C + C.T)
    W, A = W[list(axes)], A[:, list(axes)]
    mean = np.diag(W @ C @ W.T)
    # motions of A cost no energy here, so that C is invertible where the patch can move
    weight = float(np.trace(C)) / max(float(np.sum(A**2)), TINY)
    stiffness = la.pinvh(C + weight * A @ A.T, rtol=_RANK)
    rigid = np.diag(la.inv(A.T @ stiffness @ A)) - weight
    return np.asarray(mean), np.asarray(rigid)


@dataclass(frozen=True, eq=False, repr=False)
class JoiningReport(Value):
    """Checks made by `joined`.

    Parameters
    ----------
    gap : float
        Largest opening of a rigid joint over all motions of the machine. The opening is the
        difference of the motions of both ends, divided by the sum of their magnitudes.
    balance : float
        Largest resultant force or moment on the machine when a joint between two components carries
        a unit force. Moments are divided by the size of the machine. The resultant is zero if the
        forces on both components are equal and opposite and act on one line. It is not zero when a
        rigid-body motion of the whole machine stretches the joint. `joined` warns of springs with a
        resultant, and refuses such rigid joints.
    mass : float [kg]
        Mass of the machine. NaN: the machine has no displacement DOFs.
    inertia_error : float
        Largest relative difference between the inertia of the machine in the six rigid-body motions
        and the sum over its components.
    constraints, rank : int
        Number of axes of all rigid joints, and number of these axes that are independent.
    rigid : mapping {str: int}
        Number of rigid-body motions of each component before joining.
    pieces : mapping {str: int}
        Number of rigid-body motions of each connected part of the machine. The key is a text with
        the names of its components, such as "stage, frame".
    n_rigid : int
        Number of rigid-body motions of the machine.
    rigid_force : float
        Largest elastic force K q in a rigid-body motion q of the machine. It should be zero. It is
        given relative to ``|K| |q|``, the same sum with magnitudes, in which no terms cancel.
    patches : mapping {str: float}
        Error of the compliance of each joint with a patch. The compliance is computed with a patch
        that may bend, and with a rigid patch. The value is the relative difference of the two, the
        largest over the axes of the joint. The compliance of a bonded patch lies between them, so
        that the error of either assumption is smaller than this difference.

    Examples
    --------
    Two chains that are joined rigidly have one rigid-body motion:

    >>> import flexplant as fx
    >>> parts = {n: fx.chain(masses=[1.0, 2.0], stiffnesses=[5e5]) for n in ("stage", "frame")}
    >>> found = fx.joined(parts, fx.joining.Joint("stage/1:x", "frame/1:x")).joining
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

    @property
    def certificate(self) -> Certificate:
        """The errors `gap`, `inertia_error`, `rigid_force` and `balance` as a Certificate."""
        return Certificate(
            (
                Verified("gap", self.gap, "opening of the rigid joints", MISSED),
                Verified("inertia", self.inertia_error, "sum over the components", MISSED),
                Verified("rigid force", self.rigid_force, "K times rigid-body motions", MISSED),
                Verified("balance", self.balance, "resultants between components"),
            )
        )

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
        text = [f"<JoiningReport: {head}, {self.mass:.6g} kg", f" {independent}, {errors}"]
        text += [f" {name}: compliance to {error:.2g}" for name, error in self.patches.items()]
        return "\n".join(text) + ">"
