"""From the shapes that a result file holds to Modes: rigid-body modes, masses, units, damping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import FloatArray, positive, real_array
from ..errors import ModelError, ShapeError, counted
from ..labels import DofSet
from ..modes import Modes
from ..structure.units import Units
from .paths import damaged, unread

#: generalised masses nearer to 1 than this are those of mass-normalised shapes in few digits
_ONE = 1e-5
#: relative: what shapes in single precision may deviate from orthonormality
_SINGLE = 1e-4
MISSING = (
    "no residual attachment vectors: what the modes left out move statically is missing "
    "(write residual vectors as further modes: RESVEC)"
)


@dataclass(frozen=True)
class FileShapes:
    """Mode shapes as a file holds them, in its units."""

    omega: FloatArray
    phi: FloatArray
    dofs: DofSet
    masses: FloatArray | None = None
    zeta: FloatArray | None = None
    notes: tuple[str, ...] = ()
    units: Units | None = None


@dataclass(frozen=True)
class ModesFormat:
    """Files that hold mode shapes, and their reader."""

    suffixes: tuple[str, ...]
    read: Callable[[Path, Path | None], FileShapes]


def scaled_modes(
    shapes: FileShapes,
    *,
    zeta: float | FloatArray | None,
    rigid_below: float | None,
    system: Units,
    path: str,
) -> Modes:
    """Return the Modes of shapes, scaled to unit mass and SI."""
    if not (np.all(np.isfinite(shapes.phi)) and np.all(np.isfinite(shapes.omega))):
        raise damaged(path, "NaN or infinite numbers in its modes")
    shapes = _unit_mass(shapes, path)
    damping = shapes.zeta if zeta is None else zeta
    if damping is None:
        raise unread(path, "does not say how modes are damped", "Say it: zeta=0.01, or one a mode.")
    k = shapes.omega.size
    damping = real_array(damping, "zeta")
    if damping.shape not in ((), (k,)):
        raise ShapeError(
            f"zeta must be one number or one of each of {counted(k, 'mode')}, got {damping.shape}."
        )
    damping = np.array(np.broadcast_to(damping, (k,)))
    phi, moved = shapes.phi, np.any(shapes.phi != 0, axis=1)
    notes = shapes.notes
    if not moved.all():
        held = int(np.count_nonzero(~moved))
        notes = (
            *notes,
            f"left out, as no mode moves them: {counted(held, 'DOF')} (held, or not there)",
        )
    rows = np.flatnonzero(moved)
    directions = tuple(shapes.dofs.directions[i] for i in rows.tolist())
    dofs = DofSet(shapes.dofs.nodes[rows], directions, shapes.dofs.xyz[rows])
    # q in SI, of M in SI: phi / sqrt(unit of mass), rotations per unit of length
    unit = np.where([d.startswith("r") for d in directions], system.length, 1.0)
    phi = phi[rows] / (unit * np.sqrt(system.mass))[:, np.newaxis]
    omega, n_rigid, order = frequencies(shapes.omega / system.time, rigid_below, path)
    damping = damping[order]
    damping[:n_rigid] = 0.0
    return Modes(
        omega, damping, phi[:, order], system.placed(dofs), n_rigid, notes=(*notes, MISSING)
    )


def _unit_mass(shapes: FileShapes, path: str) -> FileShapes:
    """Return shapes of generalised mass 1, as far as the file has them."""
    masses = shapes.masses
    if masses is None:
        note = "taken as mass-normalised, which the file does not say"
        return replace(shapes, notes=(*shapes.notes, note))
    if np.any(~np.isfinite(masses)) or np.any(masses <= 0):
        mode = int(np.argmax(~(masses > 0))) + 1
        what = f"gives mode {mode} a generalised mass of {masses[mode - 1]:g}, not above 0"
        raise unread(path, what, "Was it written by a modal analysis?")
    off = float(np.max(np.abs(masses - 1)))
    if off < _ONE:
        note = f"mass-normalised: generalised masses of the file are 1 within {off:.1g}"
        return replace(shapes, notes=(*shapes.notes, note))
    note = f"scaled to unit mass by generalised masses of {masses.min():.3g} to {masses.max():.3g}"
    return replace(shapes, phi=shapes.phi / np.sqrt(masses), notes=(*shapes.notes, note))


def frequencies(omega: FloatArray, rigid_below: float | None, path: str) -> Any:
    """Return frequencies [rad/s] in order, how many are 0, and which mode each was."""
    limit = None if rigid_below is None else 2 * np.pi * positive(rigid_below, "rigid_below")
    rigid = np.abs(omega) < limit if limit is not None else omega == 0
    order = np.argsort(np.where(rigid, -np.inf, omega), kind="stable")
    omega, rigid = omega[order], rigid[order]
    elastic = omega[~rigid]
    if elastic.size and (elastic[0] < 0 or (elastic[0] < 1e-3 * elastic[-1] and limit is None)):
        raise ModelError(
            f"{path!r} has modes at {np.array2string(elastic[:6] / 2 / np.pi, precision=3)} Hz: "
            "some of them seem to be rigid-body modes that came out near zero. Say which: "
            "rigid_below=... [Hz] sets those below to exactly 0 (a tiny one keeps them all)."
        )
    return np.where(rigid, 0.0, omega), int(np.count_nonzero(rigid)), order


def check_mass(phi: FloatArray, M: Any, path: str) -> float:
    """Return how far phi^T M phi is from the identity, which single precision may explain."""
    n = phi.shape[0]
    if M.shape != (n, n):
        raise ShapeError(
            f"M must have shape ({n}, {n}), node by node, got {M.shape}. Give that of the same "
            "nodes and directions."
        )
    gram = phi.T @ np.asarray(M @ phi)
    off = np.abs(gram - np.eye(gram.shape[0]))
    if off.max(initial=0.0) > _SINGLE:
        mode = int(np.argmax(off.max(axis=0)))
        raise ModelError(
            f"the shapes of {path!r} are not mass-normalised with M: phi^T M phi of mode "
            f"{mode + 1} is {gram[mode, mode]:.6g}, the largest entry off by {off.max():.3g}. "
            "Write them mass-normalised, or check the units and the order of M."
        )
    return float(off.max(initial=0.0))
