"""Report on a model: errors, unusual findings, and what to do about them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, one_of
from ..errors import ModelError, counted, some_names
from ..labels import DIRECTIONS, DofSet
from ..parallel import Progress
from ..sparse.symmetric import diagonal
from ..store import Value
from ..tolerances import SAME, TYPED
from .check_facts import Facts, facts
from .matrices import FEMatrices
from .model import FEModel
from .rigid import rigid_motions
from .unit_systems import unusual
from .zero_energy_motions import ZeroEnergy, held_by_rounding, most_moved, nearly_free, verdict


@dataclass(frozen=True, eq=False, repr=False)
class ModelCheck(Value):
    """Findings of `check`, which print as a table with one line for each subject.

    Parameters
    ----------
    lines : tuple of (verdict, subject, finding, next step)
        Lines of the table. The verdict is "ok", "note" (the finding deserves attention) or "fail"
        (data are missing or wrong).
    mass : (3,) array [kg]
        Mass in translation along x, y, z. NaN: the direction has no DOF.
    center : (3,) array [m]
        Centre of gravity. NaN: the DOFs do not determine it.
    inertia : (3, 3) array [kg m^2]
        Inertia about the centre of gravity.
    rigid : tuple of str
        Directions x, y, z, rx, ry, rz in which the structure moves freely. Rotations turn about the
        middle of the structure.
    grounded : tuple of str
        Directions in which the structure is held.
    n_rigid : int
        Number of independent rigid-body motions in which the structure is free. These may be
        combinations of directions.
    n_zero : int
        Number of independent motions q without elastic energy, ``K q = 0``.
    mechanisms : tuple of tuple of str
        DOFs that move most in each zero-energy motion that is not a rigid-body motion.
    massless, stiffless : tuple of str
        DOFs without mass, and DOFs without stiffness.
    n_pieces : int
        Number of parts of the structure that are not joined.
    first_freq : float [Hz]
        Frequency of the first elastic mode. NaN: it is not known.
    source : str or None
        Name of the model that was checked.

    Examples
    --------
    A free chain of two masses has one rigid-body motion:

    >>> import flexplant as fx
    >>> report = fx.check(fx.chain(masses=[1.0, 2.0], stiffnesses=[100.0]))
    >>> report.ok, report.n_rigid, float(report.mass[0])
    (True, 1, 3.0)
    """

    lines: tuple[tuple[str, str, str, str], ...]
    mass: FloatArray
    center: FloatArray
    inertia: FloatArray
    rigid: tuple[str, ...]
    grounded: tuple[str, ...]
    n_rigid: int
    n_zero: int
    mechanisms: tuple[tuple[str, ...], ...]
    massless: tuple[str, ...]
    stiffless: tuple[str, ...]
    n_pieces: int
    first_freq: float
    source: str | None = None

    @property
    def ok(self) -> bool:
        """Whether no line has the verdict "fail". Notes are allowed."""
        return not self.of("fail")

    def of(self, verdict: str) -> tuple[str, ...]:
        """Return the subjects of the lines with a given verdict.

        Parameters
        ----------
        verdict : str
            Verdict "ok", "note" or "fail".
        """
        one_of(verdict, "verdict", ("ok", "note", "fail"))
        return tuple(subject for found, subject, _, _ in self.lines if found == verdict)

    def __repr__(self) -> str:
        failed, noted = len(self.of("fail")), len(self.of("note"))
        named = f" {self.source!r}" if self.source else ""
        result = "ok" if self.ok else f"{failed} FAILED"
        head = f"<ModelCheck{named}: {result}, {counted(noted, 'warning')}>"
        text = [head]
        for found, subject, finding, following in self.lines:
            mark = {"ok": "ok  ", "note": "note", "fail": "FAIL"}[found]
            text.append(f"  {mark} {subject:<18} {finding}")
            if following:
                text.append(f"       {'':<18} -> {following}")
        return "\n".join(text)


def check(model: FEModel | FEMatrices) -> ModelCheck:
    """Return the report on a model: errors, unusual findings, and a next step for each.

    The report covers symmetry and definiteness (by factorisation), and the rigid-body motions of K,
    which are compared with those of the geometry. It names mechanisms (motions without elastic
    energy that are not rigid-body motions) and the DOFs that move in them. It gives total mass,
    centre of gravity and inertia. It also lists DOFs without mass or stiffness, parts that are not
    joined, and penalties (very stiff springs that hold DOFs). It shows unusual units, damping to
    ground, and digits that K lost in a text file or in single precision. The model is not changed.

    Parameters
    ----------
    model : FEModel or FEMatrices
        Model or matrices to check. FEMatrices may contain any error.

    Raises
    ------
    ModelError
        When `model` is neither of the two.

    Examples
    --------
    Two masses with a spring move freely along x:

    >>> from flexplant import DofSet
    >>> dofs = DofSet([1, 2], ["x", "x"], [[0, 0, 0], [1, 0, 0]])
    >>> report = check(FEModel([[1, 0], [0, 2]], [[5, -5], [-5, 5]], dofs=dofs))
    >>> report.ok, report.rigid, report.n_zero
    (True, ('x',), 1)
    """
    given: Any = model
    if isinstance(model, FEModel):
        matrices_ = FEMatrices(given.K, given.M, given.D, dofs=given.dofs, source=given.name)
    elif isinstance(model, FEMatrices):
        matrices_ = model
    else:
        hint = "Pass matrices of any quality as fx.structure.FEMatrices(K, M, dofs=...)."
        if hasattr(model, "check"):
            hint = "This one is checked by its method check()."
        raise ModelError(
            f"check needs an FEModel or FEMatrices, got {type(model).__name__}. {hint}"
        )
    with Progress(0, "check"):
        found = facts(matrices_, model if isinstance(model, FEModel) else None)
    parts = (
        *(_matrix_lines, _row_lines, _rigid_lines, _connectivity),
        *(_mass_lines, _scale_lines, _digits),
    )
    # for swapped matrices all other checks would be meaningless
    lines = [line for part in parts[: 1 if found.swapped else None] for line in part(found)]
    lines += [("note", "reader", note, "") for note in matrices_.notes]
    if matrices_.constrained:
        lines.append(("note", "constrained", f"{some_names(matrices_.constrained)} dropped", ""))
    return ModelCheck(
        lines=tuple(lines),
        mass=found.body.mass,
        center=found.body.center,
        inertia=found.body.inertia,
        rigid=found.motions.free if found.motions else (),
        grounded=found.motions.grounded if found.motions else (),
        n_rigid=found.motions.n_rigid if found.motions else 0,
        n_zero=found.n_zero,
        mechanisms=tuple(widest_dofs(found, column) for column in found.mechanisms.T),
        massless=found.names(found.massless),
        stiffless=found.names(found.stiffless),
        n_pieces=int(found.piece.max(initial=-1)) + 1,
        first_freq=found.first_freq,
        source=matrices_.source,
    )


def _connectivity(found: Facts) -> list[Line]:
    count = int(found.piece.max(initial=-1)) + 1
    if count <= 1:
        return [("ok", "connectivity", "one piece", "")]
    if found.given.dofs is None:
        return [("note", "connectivity", f"K joins the rows to {count} separate blocks", "")]
    shown = []
    for piece in range(1, min(count, 4)):
        rows = np.flatnonzero(found.piece == piece)
        shown.append(f"{counted(rows.size, 'DOF')} with {some_names(found.names(rows), most=2)}")
    more = f" and {count - 4} more" if count > 4 else ""
    return [
        (
            "note",
            "connectivity",
            f"{count} separate pieces; in addition to the largest: {'; '.join(shown)}{more}",
            "right where a body floats; otherwise merge coincident nodes, or add the contact",
        )
    ]


def _digits(found: Facts) -> list[Line]:
    digits = found.digits
    if digits is None:
        return []
    said: Any = verdict(found.loss, digits)
    if found.given.digits is None:
        return [
            (
                "note",
                "digits",
                f"K carries about {digits} digits: rigid translations leave forces in every row",
                (
                    "export in double precision; or free what rounding holds: "
                    "FEMatrices(K, M, dofs=dofs).model(free=True)"
                ),
            )
        ]
    notes: list[Line] = []
    for one in (said, _rounding_warning(found, digits)):
        if one:
            text, _, following = one.partition(" Export")
            notes.append(("note", "digits", text, f"export{following}"))
    return notes or [("ok", "digits", f"{digits} digits are enough", "")]


def _rounding_warning(found: Facts, digits: int) -> str | None:
    """Return what `FEMatrices.model` warns of, where rounding alone holds rigid-body motions."""
    given = found.given
    if given.dofs is None or not given.located or found.motions is None:
        return None
    exact = nearly_free(given.K, given.M, given.dofs, None)
    return held_by_rounding(given.K, given.M, given.dofs, digits, exact)


#: verdict, subject, finding, next step
Line: TypeAlias = tuple[str, str, str, str]


def widest_dofs(found: Facts, motion: FloatArray) -> tuple[str, ...]:
    """Return the DOFs that move most in a motion (n,), the first first."""
    return found.names(most_moved(motion))


def _matrix_lines(found: Facts) -> Iterator[Line]:
    """Return the lines on symmetry and definiteness."""
    wrong = {name: skew for name, skew in found.skew.items() if skew[0] > SAME}
    for name, (size, i, j) in wrong.items():
        matrix: Any = getattr(found.given, name)
        yield (
            "fail",
            f"symmetry of {name}",
            (
                f"entries ({i + 1}, {j + 1}) and ({j + 1}, {i + 1}) are {matrix[i, j]:.6g} and "
                f"{matrix[j, i]:.6g} ({size:.2g} of the diagonal)"
            ),
            "gyroscopic, follower or contact terms have no place here; a triangle read twice?",
        )
    if not wrong:
        yield ("ok", "symmetry", f"{', '.join(found.skew)} symmetric", "")
    if found.swapped:
        yield (
            "fail",
            "order of K and M",
            "M resists no rigid translation, as a stiffness; K resists all, as a mass",
            "they are swapped: FEMatrices(K, M), but FEModel(M, K)",
        )
        return
    yield _inertia_line(found)
    yield _stiffness_line(found)
    if found.damping:
        yield _damping_line(found)


def _inertia_line(found: Facts) -> Line:
    if found.mass_definite is None:
        return ("fail", "mass", "M is missing", "export the mass matrix too")
    if found.mass_definite:
        singular = found.massless.size or found.empty.size or found.without_inertia.size
        kind = "positive semi-definite" if singular else "positive definite"
        return ("ok", "definiteness of M", kind, "")
    at = f": zero or negative at {some_names(found.names(found.negative_mass))}"
    return (
        "fail",
        "definiteness of M",
        f"M is not positive definite{at if found.negative_mass.size else ''}",
        "look for a negative or singular mass element; constraints eliminated in K only?",
    )


def _stiffness_line(found: Facts) -> Line:
    if found.lowest is None:
        return (
            "fail",
            "definiteness of K",
            f"not found out: {found.failure}",
            "correct the findings of the other lines first",
        )
    if found.n_negative:
        negative = found.lowest.negative
        text = f"K has {counted(found.n_negative, 'negative eigenvalue')}"
        if negative is not None:
            lowest = f", the lowest {negative[0][0]:.3g} 1/s^2" if found.scaled_by_mass else ""
            # displacements and rotations are compared by their forces
            size = np.sqrt(np.abs(diagonal(found.given.K))) * negative[1][:, 0]
            text += f"{lowest}, moving {some_names(widest_dofs(found, size), most=3)}"
        if found.n_unstable == found.n_negative:
            return (
                "note",
                "definiteness of K",
                f"{text}: springs of negative stiffness, rigid-body motions are unstable",
                "magnets? Else look for a sign; modes of negative frequency follow",
            )
        return (
            "fail",
            "definiteness of K",
            f"{text}: unstable",
            (
                "buckled or prestressed state, a sign, or lost digits? Export the unloaded "
                "stiffness. FEModel takes it where only rigid-body motions are unstable (magnets)"
            ),
        )
    kind = "positive semi-definite" if found.n_zero else "positive definite"
    freq = found.first_freq
    known = f", first elastic mode at {freq:.5g} Hz" if np.isfinite(freq) else ""
    return ("ok", "definiteness of K", f"{kind}{known}", "")


def _damping_line(found: Facts) -> Line:
    if not found.damping["definite"]:
        return (
            "fail",
            "definiteness of D",
            "D is not positive semi-definite: it feeds energy in",
            "look for a sign; gyroscopic terms are not symmetric and do not belong into D",
        )
    # relative to the terms, which cancel to rounding
    if found.damping["drag"] > 1e-9:
        return (
            "note",
            "damping",
            "D drags free rigid-body motions: a damper to ground, or alpha M",
            "assemble_plant takes it, in dense form; modes at 0 need D without: with_damping(law)",
        )
    return ("ok", "definiteness of D", "positive semi-definite", "")


def _row_lines(found: Facts) -> Iterator[Line]:
    """Return the lines on DOFs without mass, without stiffness, without both."""
    if found.empty.size:
        yield (
            "fail",
            "empty rows",
            f"neither mass nor stiffness: {some_names(found.names(found.empty))}",
            "held DOFs that the export kept? Drop them: FEMatrices.without([...])",
        )
    if found.massless.size:
        yield (
            "fail",
            "without mass",
            some_names(found.names(found.massless)),
            "condense them, exactly: FEMatrices.model(massless='condense')",
        )
    if found.without_inertia.size:
        yield (
            "fail",
            "without inertia",
            (
                f"{counted(found.without_inertia.size, 'motion')} that no mass resists, at "
                f"{some_names(found.names(found.without_inertia))}"
            ),
            "offset masses without rotary inertia? FEMatrices.model(massless='condense')",
        )
    if found.stiffless.size:
        # a single mass is a rigid body: only other motions fail
        whole = found.motions is not None and not found.mechanisms.size
        yield (
            "note" if whole and not found.massless.size else "fail",
            "without stiffness",
            f"{some_names(found.names(found.stiffless))}: free to drift away",
            "join them to the structure, or drop them",
        )
    rows = (found.empty, found.massless, found.without_inertia, found.stiffless)
    if not any(some.size for some in rows):
        yield ("ok", "rows", "every DOF has mass and stiffness", "")


def _rigid_lines(found: Facts) -> Iterator[Line]:
    """Return the lines on rigid-body motions, expected and found, and on mechanisms."""
    if found.lowest is None:
        return
    if found.motions is None:
        yield (
            "note",
            "rigid body",
            f"{counted(found.n_zero, 'motion')} without energy; which are rigid is known with DOFs",
            "with_dofs(DofSet(nodes, directions, xyz))",
        )
        return
    motions = found.motions
    text = _free_and_held(found, motions)
    extra = found.mechanisms.shape[1]
    expected = f"{motions.n_rigid} by the geometry, {found.n_zero} found in K"
    odd = motions.length_factor
    if odd is not None:
        yield (
            "fail",
            "coordinates",
            f"rotations cost energy, but would not with coordinates times {odd:.6g}",
            "the coordinates are in another unit than the matrices: converted(...) one of them",
        )
    if not found.given.located:
        yield (
            "note",
            "rigid body",
            f"{text}; coordinates and therefore rotations are not known ({expected})",
            "give them: located_at(nodes, xyz)",
        )
        return
    partly = motions.n_rigid > 0 and bool(motions.grounded) and odd is None
    yield (
        "note" if partly else "ok",
        "rigid body",
        f"{text} ({expected})",
        "rigid-body modes at 0 Hz are kept: a controller holds a stage that floats or slides. If a "
        "support is missing, use fixed(labels) or add a spring"
        if partly
        else "",
    )
    if found.resisted:
        each = [f"{i} (as if rigid at {hertz:.4g} Hz)" for i, hertz in found.resisted.items()]
        yield (
            "note",
            "joint motions",
            f"the structure resists {some_names(each)}",
            "correct for slides that springs hold; mend the entries of those that should be free",
        )
    if not extra:
        yield ("ok", "mechanisms", "none", "")
    elif odd is None:
        moved = some_names(widest_dofs(found, found.mechanisms[:, 0]), most=4)
        yield (
            "fail",
            "mechanisms",
            (f"{counted(extra, 'zero-energy motion')} beyond rigid body; the first moves {moved}"),
            "fx.joined, or hold them; joint_motions of drives: structure.sliding; or a coordinate",
        )


def _free_and_held(found: Facts, motions: ZeroEnergy) -> str:
    """Return what moves freely and what is held, in words."""
    free, held = ", ".join(motions.free), ", ".join(motions.grounded)
    combined = motions.n_rigid - len(motions.free)
    absent = f"; no DOFs for {', '.join(motions.absent)}" if motions.absent else ""
    if motions.n_bodies > 1:
        own = counted(motions.n_rigid, "rigid-body motion")
        whole = f"all move freely together in {free}" if free else "no motion moves all of them"
        return f"{motions.n_bodies} separate bodies have {own} in all; {whole}{absent}"
    if combined > 0 and (not held or combined <= found.n_joint_motions):
        together = f"free in {free}, and {{}}" if free else "free in {}"
        of_joints = f"{counted(combined, 'motion')} of components in their joints"
        rest = f"; else grounded in {held}" if held else ""
        return f"{together.format(of_joints)}{rest}{absent}"
    if combined > 0:
        alone = [f"free in {free}"] if free else []
        if found.given.located and found.given.dofs is not None:
            alone += [f"free {way}" for way in _combined_motions(motions, found.given.dofs)]
            return f"{', and '.join(alone)}; else grounded in {held}{absent}"
        alone.append(f"free in {counted(combined, 'combination')} of {held}")
        return f"{', and '.join(alone)} (each is held separately){absent}"
    grounded = f"; grounded in {held}" if held else ""
    return f"{f'free in {free}' if free else 'held'}{grounded}{absent}"


def _mass_lines(found: Facts) -> Iterator[Line]:
    """Return the lines on mass, centre of gravity and inertia."""
    mass, center = found.body.mass, found.body.center
    known = np.isfinite(mass)
    if not known.any():
        return
    shown = [f"{m:.6g} kg in {d}" for m, d, k in zip(mass, "xyz", known, strict=False) if k]
    same = np.ptp(mass[known]) <= TYPED * np.abs(mass[known]).max()
    if same:
        text = f"{mass[known][0]:.6g} kg in {', '.join(d for d, k in zip('xyz', known) if k)}"  # noqa: B905
        yield ("ok", "total mass", text, "")
    else:
        yield (
            "note",
            "total mass",
            "; ".join(shown) + ": differs between directions",
            "dropped (held) DOFs take their mass along; else look at directions and labels",
        )
    if np.isfinite(center).any():
        turning = np.nanmax(np.diag(found.body.inertia), initial=0.0)
        least = TYPED * np.sqrt(turning / np.abs(mass[known][0]))
        # a sum that cancels does not determine a place
        near = np.where(np.abs(center) < least, 0.0, center)
        at = ", ".join(f"{c:.6g}" if np.isfinite(c) else "?" for c in near)
        yield ("ok", "centre of gravity", f"({at}) m", "")
    turns = np.diag(found.body.inertia)
    if np.isfinite(turns).any():
        turns = np.where(np.abs(turns) < TYPED * np.nanmax(np.abs(turns)), 0.0, turns)
        of = [
            f"{j:.6g} ({d})" for j, d in zip(turns, DIRECTIONS[3:], strict=True) if np.isfinite(j)
        ]
        yield ("ok", "inertia about it", f"{', '.join(of)} kg m^2", "")


def _scale_lines(found: Facts) -> Iterator[Line]:
    """Return the lines on penalties and odd units."""
    K: Any = found.given.K
    entries = np.abs(diagonal(K))
    coupling = np.asarray(abs(K).sum(axis=1)).ravel() - entries
    alone = np.flatnonzero((coupling == 0) & (entries > 0))
    if alone.size and alone.size < entries.size:
        yield (
            "note",
            "uncoupled rows",
            f"joined to nothing but ground: {some_names(found.names(alone))}",
            "rows that a solver put there for held DOFs? FEMatrices.without([...])",
        )
    coupled = coupling > 0
    typical = float(np.median(entries[coupled])) if coupled.any() else 0.0
    penalty = np.flatnonzero(coupled & (entries > (1.0 / TYPED) * np.maximum(coupling, typical)))
    if penalty.size:
        yield (
            "note",
            "penalties",
            f"held by a huge stiffness: {some_names(found.names(penalty))}",
            "their rounding exceeds soft modes; hold them: FEMatrices.without([...])",
        )
    odd = unusual(found.given, found.body)
    if odd is not None:
        yield ("note", "units", *odd)


def _combined_motions(motions: ZeroEnergy, dofs: DofSet) -> list[str]:
    """Return a text for each free motion that combines several of x to rz."""
    # a motion `t + w x (r - r_0)` turns about the axis along w through `r_0 + w x t / |w|^2`, and
    # moves along it by `t . w / |w|` per radian
    center = dofs.xyz.mean(axis=0)
    size = float(np.abs(dofs.xyz - center).max()) or 1.0
    unit = np.array([1.0, 1.0, 1.0, 1 / size, 1 / size, 1 / size])
    every, rigid = rigid_motions(dofs, center) * unit, motions.rigid
    made = _combined(every, rigid)
    if np.linalg.norm(every @ made - rigid) > TYPED * np.linalg.norm(rigid):
        # one part turns, and what carries it stays at rest
        moving = np.any(np.abs(rigid) > TYPED * np.abs(rigid).max(), axis=1)
        made = _combined(every[moving], rigid[moving])
    made[[name in motions.free for name in DIRECTIONS]] = 0.0
    basis, sizes, _ = la.svd(made, full_matrices=False)
    basis = basis[:, sizes > TYPED * sizes.max(initial=0.0)]
    # echelon form: each motion has one coordinate that the others do not have
    _, _, pivots = la.qr(basis.T, pivoting=True)
    basis = basis @ la.inv(basis[pivots[: basis.shape[1]]])
    return [_axis(column * unit, center, size) for column in basis.T]


def _combined(every: FloatArray, motions: FloatArray) -> FloatArray:
    """Return coefficients of motions by as few of six rigid-body motions as possible."""
    Q, R, order = la.qr(every, mode="economic", pivoting=True)
    size = np.abs(np.diag(R))
    rank = int(np.count_nonzero(size > TYPED * size[0]))
    made = np.zeros((every.shape[1], motions.shape[1]))
    made[order[:rank]] = la.solve_triangular(R[:rank, :rank], Q[:, :rank].T @ motions)
    return made


def _axis(motion: FloatArray, center: FloatArray, size: float) -> str:
    move, turn = motion[:3], motion[3:]
    angle, length = float(np.linalg.norm(turn)), float(np.linalg.norm(move))
    if angle * size <= TYPED * length:
        return f"to move along {_vector(move / length)}"
    along = turn / angle
    if along[np.argmax(np.abs(along))] < 0:
        along = -along
    point = center + np.cross(turn, move) / angle**2
    point = np.where(np.abs(point) > TYPED * size, point, 0.0)
    pitch = float(move @ turn) / angle**2
    screw = f", moving {pitch:.3g} m per radian" if abs(pitch) > TYPED * size else ""
    return f"to turn about the axis through {_vector(point)} m along {_vector(along)}{screw}"


def _vector(values: FloatArray) -> str:
    shown = np.where(np.abs(values) > TYPED, values, 0.0)
    return f"({', '.join(f'{value:.4g}' for value in shown)})"
