"""Modes of the result files of all finite-element programs: shapes, masses, units, damping."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray, IntArray, instance, positive, real_array
from ..certificates import Certificate, Verified
from ..errors import FlexplantError, LabelError, ModelError, ShapeError, counted
from ..labels import DofSet
from ..modes import Modes
from ..structure import FEMatrices, FEModel
from ..structure.unit_systems import Units
from ..structure.unit_systems import units as unit_system
from ..tolerances import FOUR_DIGITS
from .files import damaged, file_path, three_units, unread

MISSING = (
    "no residual attachment vectors: the static motion of truncated modes is missing "
    "(write residual vectors as further modes: RESVEC)"
)


@dataclass(frozen=True)
class FileShapes:
    """Mode shapes of a file, in the units of the file."""

    omega: FloatArray
    phi: FloatArray
    dofs: DofSet
    masses: FloatArray | None = None
    zeta: FloatArray | None = None
    notes: tuple[str, ...] = ()
    units: Units | None = None


#: functions that read the shapes of a file, by its suffix; their arguments are the path of the file
#: and that of a file with the nodes. Each reader adds its function
MODE_READERS: dict[str, Callable[[Path, Path | None], FileShapes]] = {}


def scaled_modes(
    shapes: FileShapes,
    *,
    zeta: float | FloatArray | None,
    rigid_below: float | None,
    system: Units,
    path: str,
) -> Modes:
    """Return the Modes with these shapes, scaled to unit generalised mass and to SI units."""
    if not (np.all(np.isfinite(shapes.phi)) and np.all(np.isfinite(shapes.omega))):
        raise damaged(path, "NaN or infinite numbers in its modes")
    shapes = _unit_mass(shapes, path)
    damping = shapes.zeta if zeta is None else zeta
    if damping is None:
        raise unread(
            path, "does not say how modes are damped", "Give zeta=0.01, or one value per mode."
        )
    phi, moved = shapes.phi, np.any(shapes.phi != 0, axis=1)
    notes = shapes.notes
    if not moved.all():
        held = int(np.count_nonzero(~moved))
        notes = (
            *notes,
            f"left out, since no mode moves them: {counted(held, 'DOF')} (held, or not there)",
        )
    rows = np.flatnonzero(moved)
    directions = tuple(shapes.dofs.directions[i] for i in rows.tolist())
    dofs = DofSet(shapes.dofs.nodes[rows], directions, shapes.dofs.xyz[rows])
    # q in SI, of M in SI: phi / sqrt(unit of mass), rotations per unit of length
    unit = np.where([d.startswith("r") for d in directions], system.length, 1.0)
    phi = phi[rows] / (unit * np.sqrt(system.mass))[:, np.newaxis]
    omega, n_rigid, order = frequencies(shapes.omega / system.time, rigid_below, path)
    damping = damping_ratios(damping, order)
    damping[:n_rigid] = 0.0
    return Modes(
        omega, damping, phi[:, order], system.placed(dofs), n_rigid, notes=(*notes, MISSING)
    )


def damping_ratios(zeta: Any, order: IntArray) -> FloatArray:
    """Return the damping ratios (k,) of modes, from one number or from one for each mode."""
    given, k = real_array(zeta, "zeta"), order.size
    if given.shape not in ((), (k,)):
        raise ShapeError(
            f"zeta must be one number or one of each of {counted(k, 'mode')}, got {given.shape}."
        )
    return np.broadcast_to(given, (k,))[order]


def _unit_mass(shapes: FileShapes, path: str) -> FileShapes:
    """Return shapes scaled to generalised mass 1, if the file has generalised masses."""
    masses = shapes.masses
    if masses is None:
        note = "taken as mass-normalised, which the file does not say"
        return replace(shapes, notes=(*shapes.notes, note))
    if np.any(wrong := ~((masses > 0) & np.isfinite(masses))):
        mode = int(np.argmax(wrong)) + 1
        what = f"gives mode {mode} an impossible generalised mass of {masses[mode - 1]:g}"
        raise unread(path, what, "Was it written by a modal analysis?")
    off = float(np.max(np.abs(masses - 1)))
    if off < FOUR_DIGITS:
        note = f"mass-normalised: generalised masses of the file are 1 within {off:.1g}"
        return replace(shapes, notes=(*shapes.notes, note))
    note = f"scaled to unit mass by generalised masses of {masses.min():.3g} to {masses.max():.3g}"
    return replace(shapes, phi=shapes.phi / np.sqrt(masses), notes=(*shapes.notes, note))


def frequencies(omega: FloatArray, rigid_below: float | None, path: str) -> Any:
    """Return ascending frequencies [rad/s], the number of zeros, and the original positions."""
    limit = None if rigid_below is None else 2 * np.pi * positive(rigid_below, "rigid_below")
    rigid = np.abs(omega) < limit if limit is not None else omega == 0
    order = np.argsort(np.where(rigid, -np.inf, omega), kind="stable")
    omega, rigid = omega[order], rigid[order]
    elastic = omega[~rigid]
    if elastic.size and (elastic[0] < 0 or (elastic[0] < 1e-3 * elastic[-1] and limit is None)):
        raise ModelError(
            f"{path!r} has modes at {np.array2string(elastic[:6] / 2 / np.pi, precision=3)} Hz: "
            "some of them seem to be rigid-body modes with a computed frequency near zero. Give "
            "rigid_below=... [Hz]: modes below it are set to exactly 0 (a tiny value keeps them "
            "all)."
        )
    return np.where(rigid, 0.0, omega), int(np.count_nonzero(rigid)), order


def check_mass(phi: FloatArray, M: Any, path: str) -> float:
    """Return the deviation of phi^T M phi from the identity; ModelError above single precision."""
    n = phi.shape[0]
    if M.shape != (n, n):
        raise ShapeError(
            f"M must have shape ({n}, {n}), node by node, got {M.shape}. Give that of the same "
            "nodes and directions."
        )
    gram = phi.T @ np.asarray(M @ phi)
    off = np.abs(gram - np.eye(gram.shape[0]))
    if off.max(initial=0.0) > FOUR_DIGITS:
        mode = int(np.argmax(off.max(axis=0)))
        raise ModelError(
            f"the shapes of {path!r} are not mass-normalised with M: phi^T M phi of mode "
            f"{mode + 1} is {gram[mode, mode]:.6g}, the largest entry off by {off.max():.3g}. "
            "Write them mass-normalised, or check the units and the order of M."
        )
    return float(off.max(initial=0.0))


def read_modes(
    path: str | Path,
    *,
    zeta: float | FloatArray | None,
    nodes: str | Path | None = None,
    rigid_below: float | None = None,
    units: Sequence[str | float] | None = None,
    matrices: FEMatrices | FEModel | None = None,
) -> Modes:
    r"""Return the modes that a finite-element program computed, from any known file format.

    Use it for models that are too large to be solved here: the shapes at all nodes become `Modes`,
    from which plants and reduced models are made. The suffix determines the format: Nastran .op2,
    and .pch of DISPLACEMENT(PUNCH); ANSYS .rst; Exodus .exo, .e (with frequencies in Hz in place of
    the times); universal files .uff, .unv of normal modes.

    Such files contain no residual attachment vectors (static deformations of the truncated modes),
    and these cannot be computed without M and K. The static motion of the truncated modes is
    therefore missing, as `notes` state. Nastran and ANSYS can write residual vectors as further
    modes of high frequency (RESVEC), which provide most of it.

    Parameters
    ----------
    path : str or Path
        Path of the file.
    zeta : float, (k,) array or None
        Damping ratios. Only universal files contain them; None uses those of the file. Rigid-body
        modes are undamped.
    nodes : str or Path, optional
        File with the nodes, if they are not in the first file: the bulk data of Nastran (.bdf,
        .dat), a universal file, or a table `node, x, y, z`.
    rigid_below : float [Hz], optional
        Frequency below which modes count as rigid-body modes and are set to exactly 0 Hz.
    units : (length, mass, time), optional
        Units of the file, for example ("mm", "t", "s"). The modes that are returned are in SI
        units. By default the units are those stated in a universal file (dataset 164), or SI.
    matrices : FEMatrices or FEModel, optional
        Model in SI with the same nodes; its M checks that the shapes are mass-normalised.

    Returns
    -------
    Modes
        Modes in global directions. If the file contains generalised masses (LAMA, dataset 55), the
        shapes are scaled to unit masses; otherwise they are unchanged. If `matrices` are given,
        `certificate["mass"]` is the largest entry of phi^T M phi - I.

    Raises
    ------
    FileNotFoundError
        When the file does not exist, as with every reader.
    FlexplantError
        When the format is not known, holds no modes, or the file is damaged.
    ModelError
        When damping is not given, modes are near zero and `rigid_below` is not given, the file has
        several sets of modes, or the shapes are not mass-normalised with `matrices`.
    LabelError
        When a node has no position or its coordinate system is missing.

    Examples
    --------
    A file of one mode at one node, as Nastran punches it:

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> head = "$EIGENVECTOR\n$EIGENVALUE =  0.4000000E+05  MODE =     1\n"
    >>> row = "".join(f"{number:18.6E}" for number in (0.0, 0.0, 2.0))
    >>> text = f"{head}{7:10}       G{row}\n{'-CONT-':18}{3 * f'{0.0:18.6E}'}\n"
    >>> _ = (folder / "run.pch").write_text(text)
    >>> _ = (folder / "run.bdf").write_text("GRID,7,,0.1,0.2,0.\n")
    >>> modes = read_modes(folder / "run.pch", zeta=0.01, nodes=folder / "run.bdf")
    >>> modes.dofs.labels, modes.omega, modes.phi
    (('7:z',), array([200.]), array([[2.]]))
    """
    path = file_path(path)
    sizes = () if units is None else three_units(units)
    read = MODE_READERS.get(path.suffix.lower())
    if read is None:
        known = ", ".join(MODE_READERS)
        raise FlexplantError(
            f"{path.name!r} is not a known file of modes; known are {known}. Nastran "
            "writes .op2 with DISPLACEMENT=ALL and PARAM,POST,-1, ANSYS .rst; of the others export "
            "a universal file, or matrices, which read_model reads."
        )
    shapes = read(path, None if nodes is None else file_path(nodes, "nodes"))
    system = shapes.units or unit_system() if units is None else unit_system(*sizes)
    modes = scaled_modes(shapes, zeta=zeta, rigid_below=rigid_below, system=system, path=str(path))
    if matrices is None:
        return modes
    instance(matrices, FEMatrices | FEModel, "matrices", "read_matrices(...) reads them.")
    mass = Verified("mass", _with_mass(modes, matrices, str(path)), "phi^T M phi - I")
    return modes.replace(certificate=Certificate((mass,)))


def _with_mass(modes: Modes, matrices: FEMatrices | FEModel, path: str) -> float:
    """Return the error of the mass normalisation of shapes with the M of a model."""
    if matrices.M is None or matrices.dofs is None:
        raise ModelError(
            "matrices need M, and names of their rows, to check the shapes with. Give them: "
            "read_matrices(..., mass=, dofs=)."
        )
    row = {label: i for i, label in enumerate(modes.dofs.labels)}
    known = set(matrices.dofs.labels)
    lost = [label for label in row if label not in known]
    if lost:
        raise LabelError(
            f"the modes of {path!r} move {len(lost)} DOFs that the matrices do not have, the first "
            f"{lost[:4]}. Are both of one model, with the same supports?"
        )
    # rows that no mode moves were left out
    found = [row.get(label, -1) for label in matrices.dofs.labels]
    phi = np.vstack([np.real(modes.phi), np.zeros(modes.n_modes)])[found]
    return check_mass(phi, matrices.M, path)
