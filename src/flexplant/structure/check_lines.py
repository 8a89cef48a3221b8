"""The lines of a report on a model, in plain words."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np
import scipy.linalg as la

from ..checks import FloatArray
from ..errors import counted, some_names
from ..labels import DIRECTIONS, DofSet
from ..sparse.factor import diagonal
from ..tolerances import TYPED
from .check_facts import Facts
from .rigid import rigid_motions
from .zero_energy import ZeroEnergy, most_moved

#: verdict, subject, finding, next step
Line: TypeAlias = tuple[str, str, str, str]

#: relative to the diagonal: entries differ by less from their mirror images
_SYMMETRY = 1e-9
#: a diagonal that exceeds all it couples to by this much is a penalty
_PENALTY = 1e6


def widest_dofs(found: Facts, motion: FloatArray) -> tuple[str, ...]:
    """Return the DOFs that move most in a motion (n,), the first first."""
    return found.names(most_moved(motion))


def matrices(found: Facts) -> Iterator[Line]:
    """Return the lines on symmetry and definiteness."""
    wrong = {name: skew for name, skew in found.skew.items() if skew[0] > _SYMMETRY}
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
            "M resists no rigid translation as a stiffness does, K every one as a mass does",
            "they are swapped: FEMatrices(K, M), but FEModel(M, K)",
        )
        return
    yield _mass_line(found)
    yield _stiffness_line(found)
    if found.damping:
        yield _damping_line(found)


def _mass_line(found: Facts) -> Line:
    if found.mass_definite is None:
        return ("fail", "mass", "there is no M", "export the mass matrix too")
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
            "mend what the other lines name first",
        )
    if found.n_negative:
        negative = found.lowest.negative
        text = f"K has {counted(found.n_negative, 'negative eigenvalue')}"
        if negative is not None:
            lowest = f", the lowest {negative[0][0]:.3g} 1/s^2" if found.scaled_by_mass else ""
            # displacements and rotations compare by the forces that they take
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
    # of the terms, which cancel to rounding
    if found.damping["drag"] > 1e-9:
        return (
            "note",
            "damping",
            "D drags free rigid-body motions: a damper to ground, or alpha M",
            "assemble_plant takes it, in dense form; modes at 0 need D without: with_damping(law)",
        )
    return ("ok", "definiteness of D", "positive semi-definite", "")


def zero_rows(found: Facts) -> Iterator[Line]:
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
        # a mass by itself is a rigid body: only what is none fails
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


def rigid(found: Facts) -> Iterator[Line]:
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
            f"{text}; coordinates are not known, hence nor are rotations ({expected})",
            "give them: located_at(nodes, xyz)",
        )
        return
    partly = motions.n_rigid > 0 and bool(motions.grounded) and odd is None
    yield (
        "note" if partly else "ok",
        "rigid body",
        f"{text} ({expected})",
        "the supports leave that free: a mode at 0 Hz. Hold it where the machine does"
        if partly
        else "",
    )
    if not extra:
        yield ("ok", "mechanisms", "none", "")
    elif odd is None:
        moved = some_names(widest_dofs(found, found.mechanisms[:, 0]), most=4)
        yield (
            "fail",
            "mechanisms",
            (f"{counted(extra, 'zero-energy motion')} beyond rigid body; the first moves {moved}"),
            "join or hold these; wrong coordinates or directions look alike (all DOFs move)",
        )


def _free_and_held(found: Facts, motions: ZeroEnergy) -> str:
    """Return what moves freely and what is held, in words."""
    free, held = ", ".join(motions.free), ", ".join(motions.grounded)
    combined = motions.n_rigid - len(motions.free)
    absent = f"; no DOFs for {', '.join(motions.absent)}" if motions.absent else ""
    if motions.n_bodies > 1:
        together = f"free in {free}" if free else "held"
        return f"{motions.n_bodies} bodies, each with its own motions; together {together}{absent}"
    if combined > 0 and not held:
        of_joints = f"{counted(combined, 'motion')} of components in their joints"
        return f"free in {free}, and {of_joints}{absent}"
    if combined > 0:
        alone = [f"free in {free}"] if free else []
        if found.given.located and found.given.dofs is not None:
            alone += [f"free {way}" for way in free_axes(motions, found.given.dofs)]
            return f"{', and '.join(alone)}; else grounded in {held}{absent}"
        alone.append(f"free in {counted(combined, 'combination')} of {held}")
        return f"{', and '.join(alone)} (each by itself is held){absent}"
    grounded = f"; grounded in {held}" if held else ""
    return f"{f'free in {free}' if free else 'held'}{grounded}{absent}"


def masses(found: Facts) -> Iterator[Line]:
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
        near = np.where(np.abs(center) < least, 0.0, center)  # a sum that cancels is no place
        at = ", ".join(f"{c:.6g}" if np.isfinite(c) else "?" for c in near)
        yield ("ok", "centre of gravity", f"({at}) m", "")
    turns = np.diag(found.body.inertia)
    if np.isfinite(turns).any():
        of = [
            f"{j:.6g} ({d})" for j, d in zip(turns, DIRECTIONS[3:], strict=True) if np.isfinite(j)
        ]
        yield ("ok", "inertia about it", f"{', '.join(of)} kg m^2", "")


def scales(found: Facts) -> Iterator[Line]:
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
    penalty = np.flatnonzero(coupled & (entries > _PENALTY * np.maximum(coupling, typical)))
    if penalty.size:
        yield (
            "note",
            "penalties",
            f"held by a huge stiffness: {some_names(found.names(penalty))}",
            "their rounding exceeds soft modes; hold them: FEMatrices.without([...])",
        )
    odd = unusual(found)
    if odd is not None:
        yield ("note", "units", *odd)


#: relative: a rotation smaller than this is a translation, a coordinate smaller than it 0
_SMALL = 1e-6


def free_axes(motions: ZeroEnergy, dofs: DofSet) -> list[str]:
    """Return in words the free motions that are combinations of x to rz, one by one.

    A motion ``t + w x (r - r_0)`` turns about the axis along w through ``r_0 + w x t / |w|^2``, and
    moves along it by ``t . w / |w|`` per radian.
    """
    center = dofs.xyz.mean(axis=0)
    every = rigid_motions(dofs, center)
    size = float(np.abs(dofs.xyz - center).max()) or 1.0
    unit = np.array([1.0, 1.0, 1.0, 1 / size, 1 / size, 1 / size])
    made = la.lstsq(every * unit, motions.rigid)[0]
    made[[name in motions.free for name in DIRECTIONS]] = 0.0
    basis, sizes, _ = la.svd(made, full_matrices=False)
    basis = basis[:, sizes > _SMALL * sizes.max(initial=0.0)]
    # echelon form: each motion has one coordinate that the others do not have
    _, _, pivots = la.qr(basis.T, pivoting=True)
    basis = basis @ la.inv(basis[pivots[: basis.shape[1]]])
    return [_axis(column * unit, center, size) for column in basis.T]


def _axis(motion: FloatArray, center: FloatArray, size: float) -> str:
    move, turn = motion[:3], motion[3:]
    angle, length = float(np.linalg.norm(turn)), float(np.linalg.norm(move))
    if angle * size <= _SMALL * length:
        return f"to move along {_vector(move / length)}"
    along = turn / angle
    if along[np.argmax(np.abs(along))] < 0:
        along = -along
    point = center + np.cross(turn, move) / angle**2
    point = np.where(np.abs(point) > _SMALL * size, point, 0.0)
    pitch = float(move @ turn) / angle**2
    screw = f", moving {pitch:.3g} m per radian" if abs(pitch) > _SMALL * size else ""
    return f"to turn about the axis through {_vector(point)} m along {_vector(along)}{screw}"


def _vector(values: FloatArray) -> str:
    shown = np.where(np.abs(values) > _SMALL, values, 0.0)
    return f"({', '.join(f'{value:.4g}' for value in shown)})"


#: nodes that a mesh has at least; lumped models have no waves, and hardly a density
_MESH, _LUMPED = 20, (1e-5, 1e5)
#: density [kg/m^3] in the box around all DOFs, or in the cube of its diagonal where it is flat
_DENSITY, _FLAT = (5.0, 3e4), (1e-2, 3e4)
#: speed of longitudinal waves [m/s] in what machines are made of, and in a plate over its density
_SPEED, _PER_DENSITY = (300.0, 2e4), (0.1, 40.0)
#: sqrt(K_ii / M_ii) times the distance h of nodes, over the speed c, in a mesh of cubes
_SOLID = 2.42
#: sqrt(K_ii / M_ii) h^2 over the thickness times c, of transverse motion in a mesh of plates
_PLATE = 2.02
#: what the numbers may be in place of SI: factors of density and of speed that it would explain
_UNITS = (
    (-9, 3.0, "the coordinates are in mm, the rest in SI", "dofs.replace(xyz=dofs.xyz / 1000)"),
    (-12, 3.0, "all is in mm, t and s (N, MPa)", "converted(length='mm', mass='t')"),
    (-9, 1.5, "lengths are in mm, K in N/mm, but M in kg", "divide M by 1000: mm, t, s"),
    (-9, 0.0, "all is in mm, kg and ms (kN)", "converted(length='mm', mass='kg', time='ms')"),
    (0, -1.5, "K is in N/mm, the rest in SI", "multiply K by 1000"),
    (0, 1.5, "K is 1000 times too large", "divide K by 1000"),
    (-3, 1.5, "M is in t, the rest in SI", "multiply M by 1000"),
    (3, -1.5, "M is in g, the rest in SI", "divide M by 1000"),
)


def unusual(found: Facts) -> tuple[str, str] | None:
    """Return what is odd about density and wave speed, and what to do; None where nothing is.

    The speed follows from neighbours: ``c = sqrt(K_ii / M_ii) h / 2.4`` in solids, h the distance
    of nodes. A plate of areal mass m'' that has transverse motion only shows ``c / density =
    sqrt(K_ii / M_ii) h^2 / (2 m'')``. Both come from local entries: supports do not matter.
    """
    from scipy.spatial import cKDTree

    dofs, M = found.given.dofs, found.given.M
    known = np.isfinite(found.body.mass)
    if dofs is None or M is None or not found.given.located or not known.any():
        return None
    points = np.unique(dofs.xyz, axis=0)
    size, mass = np.ptp(points, axis=0), float(found.body.mass[known].max())
    if len(points) < 2 or mass <= 0:
        return None
    distances: Any = cKDTree(points).query(points, k=2)[0]
    h = float(np.median(distances[:, 1]))
    stiff, heavy = diagonal(found.given.K), diagonal(M)
    straight = (dofs.kinds < 3) & (stiff > 0) & (heavy > 0)
    if not straight.any():
        return None
    rate = float(np.median(np.sqrt(stiff[straight] / heavy[straight])))
    filled = bool(np.all(size > TYPED * size.max()))
    volume = float(np.prod(size)) if filled else float(np.linalg.norm(size)) ** 3
    density, dense = mass / volume, _DENSITY if filled else _FLAT
    kinds = set(dofs.kinds.tolist())
    if len(points) < _MESH:
        dense, kinds = _LUMPED, set()
    if filled and {0, 1, 2} <= kinds:
        speed, range_of = rate * h / _SOLID, _SPEED
        shown = f"waves at {speed:.3g} m/s"
    elif not filled and len(kinds & {0, 1, 2}) == 1 and len(kinds & {3, 4, 5}) == 2:
        area = float(np.prod(np.sort(size)[1:]))
        speed, range_of = rate * h**2 * area / mass / _PLATE, _PER_DENSITY
        shown = f"a wave speed of {speed:.3g} m/s over the density in kg/m^3"
    else:
        speed, range_of, shown = np.nan, (0.0, np.inf), ""
    slow, fast = range_of
    light, solid = dense
    if light <= density <= solid and (np.isnan(speed) or slow <= speed <= fast):
        return None
    within = "the box of all DOFs" if filled else "a cube of its size"
    text = f"{density:.3g} kg/m^3 in {within}" + (f", {shown}" if shown else "")
    # of a plate the speed over the density counts, and its density is that of a thinner one
    explained = [
        (cause, step)
        for mass_power, speed_power, cause, step in _UNITS
        if light <= density / 10.0**mass_power <= solid
        and (
            np.isnan(speed)
            or slow <= speed / 10.0 ** (speed_power - (0 if filled else mass_power)) <= fast
        )
    ]
    if not explained:
        return f"{text}: no material is like that", "K, M and coordinates in different units?"
    return (
        f"{text}: as if {' or '.join(cause for cause, _ in explained[:3])}",
        "; or ".join(step for _, step in explained[:3]),
    )
