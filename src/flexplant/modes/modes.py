"""Modes of a structure, their static correction, and the error of their mesh."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import scipy.linalg as la

from ..arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    instance,
    positions,
    positive,
    real_array,
    real_or_complex,
)
from ..certificates import Certificate
from ..errors import ModelError, ShapeError, SolverError, counted, require_known
from ..labels import DofSet, Place
from ..store import Value, checked
from ..structure.definite import signed_square
from ..structure.rigid import Placed, relative_miss
from ..tolerances import FOUR_DIGITS, MOST_STEPS, RESIDUAL, SAME
from .matching import calibration_of, pair_modes
from .normal_forms import pole_pairs

#: largest number of places at which shapes of two meshes are compared
PLACES = 300
#: least ratio of element sizes: from closer sizes the limit cannot be extrapolated
_RATIO = 1.2


@dataclass(frozen=True, eq=False, repr=False)
class MeshError(Value):
    """Relative errors of the frequencies of a mesh, estimated from a finer mesh.

    Parameters
    ----------
    modes : (m,) array
        Numbers of the elastic modes. They count from 1 and include rigid-body modes.
    freq : (m,) array [Hz]
        Frequencies of the coarse mesh.
    limit : (m,) array [Hz]
        Frequencies extrapolated to an infinitely fine mesh,
        ``f_fine + (f_fine - f_coarse) / (r^p - 1)`` with the order of convergence p.
    ratio : float
        Ratio r of the element sizes: coarse over fine, above 1.
    partners : (m,) array of int
        Positions, counted from 0, of the same modes in the finer mesh.

    Examples
    --------
    >>> import flexplant as fx
    >>> def modes(n):
    ...     plate = fx.kirchhoff_plate(size=(0.6, 0.6), thickness=0.02, elements=(n, n),
    ...         density=2700, youngs_modulus=70e9, poisson_ratio=0.3)
    ...     return fx.solve_modes(plate, count=6)
    >>> modes(8).mesh_error(modes(16))
    <MeshError: 3 modes, +0.11 % (mode 5) to +0.19 % (mode 6)>
    """

    modes: IntArray
    freq: FloatArray
    limit: FloatArray
    ratio: float
    partners: IntArray

    @property
    def error(self) -> FloatArray:
        """Relative errors (m,) of the coarse mesh: ``freq / limit - 1``."""
        return np.asarray(self.freq / self.limit - 1.0)

    def __repr__(self) -> str:
        low, high = int(np.argmin(self.error)), int(np.argmax(self.error))
        ends = " to ".join(
            f"{100 * self.error[i]:+.2g} % (mode {self.modes[i]})" for i in (low, high)
        )
        return f"<MeshError: {counted(self.modes.size, 'mode')}, {ends}>"


def require_real(modes: Any, why: str) -> None:
    """Refuse complex Modes."""
    if np.iscomplexobj(modes.phi):
        raise ModelError(
            f"these modes are complex, the damping couples them: {why}. Solve with "
            "damping=ModalDamping(...)."
        )


def mesh_error(coarse: Any, finer: Any, order: float) -> MeshError:
    """Return the errors of Modes from the Modes of a finer mesh, paired by their shapes."""
    p = positive(order, "order")
    for modes in (coarse, finer):
        require_real(modes, "those of two meshes are not compared")
    nodes = [np.unique(modes.dofs.xyz, axis=0) for modes in (coarse, finer)]
    extent = np.ptp(nodes[0], axis=0)
    dimensions = int(np.count_nonzero(extent > 1e-6 * extent.max()))
    ratio = (len(nodes[1]) / len(nodes[0])) ** (1.0 / max(dimensions, 1))
    if ratio < _RATIO:
        raise ModelError(
            f"the finer model has {len(nodes[1])} nodes, this one {len(nodes[0])}: element sizes "
            f"with a ratio of {ratio:.3g} are too close for an extrapolation. Halve the elements."
        )
    shapes = _at_common_places(coarse, finer)
    X, Y = (one / np.linalg.norm(one, axis=0) for one in shapes)
    pairs = pair_modes(
        coarse.freq,
        finer.freq,
        X.T @ X,
        X.T @ Y,
        Y.T @ Y,
        n_rigid=min(coarse.n_rigid, finer.n_rigid),
    )
    found = np.flatnonzero((pairs.partner >= 0) & (np.arange(coarse.n_modes) >= coarse.n_rigid))
    if not found.size:
        raise ModelError(
            "no elastic modes of the two meshes have the same shape: the meshes belong to "
            "different structures, or their coordinates have different units."
        )
    partners = pairs.partner[found]
    f, fine = coarse.freq[found], finer.freq[partners]
    limit = fine + (fine - f) / (ratio**p - 1.0)
    return MeshError(found + 1, f, limit, float(ratio), partners)


def sampled_moves(dofs: DofSet) -> IntArray:
    """Return positions of a random sample of the translations, which favours no direction.

    Where the structure only turns, such as a train of gears, its rotations are used.
    """
    moves = [i for i, direction in enumerate(dofs.directions) if direction in ("x", "y", "z")]
    moves = moves or list(range(len(dofs.directions)))
    return np.asarray(np.random.default_rng(0).permutation(moves)[:PLACES])


def _at_common_places(coarse: Any, finer: Any) -> tuple[FloatArray, FloatArray]:
    """Return the shapes (p, k) of both at DOFs of the coarse mesh, along x, y and z."""
    dofs = coarse.dofs
    chosen = sampled_moves(dofs)
    rows = np.array([finer.dofs.row(dofs.xyz[i], dofs.directions[i]) for i in chosen])
    return np.real(coarse.phi[chosen]), rows @ np.real(finer.phi)


def measured_poles(measured: Any, known: range) -> tuple[IntArray, ComplexArray]:
    """Return the positions (m,), from 0, of the measured modes and their poles [rad/s].

    Raises
    ------
    ModelError, LabelError
        When they are not numbered measured poles, or a mode is not among those known.
    """
    poles, numbers = getattr(measured, "poles", None), getattr(measured, "modes", None)
    if poles is None or numbers is None:
        raise ModelError(
            "a model is calibrated by measured poles with the numbers of its modes, got "
            f"{type(measured).__name__}" + (" without numbers" if poles is not None else "") + ". "
            "Pass MeasuredModes(poles, modes=[...]), or flexplant.numbered(measured, model)."
        )
    require_known("elastic mode", numbers, known)
    return np.asarray(numbers, dtype=np.int64) - 1, np.asarray(poles, dtype=np.complex128)


def calibrated_matrices(
    M: FloatArray, D: FloatArray, K: FloatArray, n_rigid: int, places: IntArray, poles: ComplexArray
) -> tuple[FloatArray, FloatArray]:
    """Return D and K that give some modes their measured poles and keep the shapes.

    With phi of (K, M), ``K + M phi diag(omega_m^2 - omega^2) phi^T M`` and the same of D; the
    coupling of modes by D stays, so that the diagonal is searched for.

    Raises
    ------
    SolverError
        When damping couples the modes so much that no such diagonal is found.
    """
    phi = la.eigh(K, M)[1]
    stiff, damp = phi.T @ K @ phi, phi.T @ D @ phi
    square, rate = np.diag(stiff).copy(), np.diag(damp).copy()
    square[:n_rigid] = 0.0  # exactly zero, without the rounding of K
    square[places], rate[places] = np.abs(poles) ** 2, -2.0 * poles.real
    for _ in range(MOST_STEPS):  # coupling by a fraction c leaves c times the error
        now = _poles_near(square, rate, damp, poles)
        if np.all(np.abs(now - poles) <= RESIDUAL * np.abs(poles)):
            moved = M @ phi[:, places]
            change_k = (moved * (square - np.diag(stiff))[places]) @ moved.T
            change_d = (moved * (rate - np.diag(damp))[places]) @ moved.T
            return D + 0.5 * (change_d + change_d.T), K + 0.5 * (change_k + change_k.T)
        square[places] += np.abs(poles) ** 2 - np.abs(now) ** 2
        rate[places] += 2.0 * (now.real - poles.real)
    raise SolverError(
        "damping couples the modes so much that no change of each alone gives them the measured "
        "poles. Update the dampers first (AddedDamping), or measure the coupled modes too."
    )


def _poles_near(
    square: FloatArray, rate: FloatArray, damp: FloatArray, wanted: ComplexArray
) -> ComplexArray:
    """Return the poles of ``p'' + (rate + coupling) p' + square p = 0`` next to those wanted."""
    C, scale = damp.copy(), np.sqrt(np.maximum(square, 0.0))
    np.fill_diagonal(C, rate)
    # balanced states: velocity, and frequency times position (not for rigid-body modes)
    A = np.block([[np.zeros_like(C), np.diag(scale)], [-np.diag(scale), -C]])
    found = np.linalg.eigvals(A)
    return np.asarray(found[np.argmin(np.abs(found[:, None] - wanted), axis=0)])


def _nothing() -> FloatArray:
    return np.zeros(0)


#: field: one number for each attachment vector
_OF_VECTORS = checked(real_array, shape=("vector_dofs",))


@dataclass(frozen=True, eq=False, repr=False)
class Modes(Placed, Value):
    """The first k modes of a structure, mass-normalised (equations (2), (3) and (5) of [paper]_).

    The motion is ``q = phi p``. The modal coordinates p follow from the forces f by equation (5),
    ``p'' + 2 Z Omega p' + Omega^2 p = phi^T f``. Mode numbers count from 1 and include rigid-body
    modes. Mode 4 of a free plate is therefore its first elastic mode.

    Springs of negative stiffness (magnets) make rigid-body modes unstable. The unstable modes stand
    after the modes at 0. Their frequencies are negative, as finite-element programs print them:
    omega = -3 rad/s stands for ``Omega^2 = -9 1/s^2``. Such a mode has the two real poles
    ``|omega| (-zeta +- sqrt(zeta^2 + 1))``.

    Residual attachment vectors extend the basis. Such a vector is the static displacement under a
    unit force at a chosen place, minus the part that the k modes describe. The vectors are made
    M-orthogonal to the modes and to each other, and K is diagonal in them. Equation (5) therefore
    holds for the basis `[phi, vectors]` too, with `vector_omega` as frequencies.

    Parameters
    ----------
    omega : (k,) array [rad/s]
        Undamped frequencies: first the rigid-body modes, at exactly 0, then the unstable modes,
        with negative values, then the elastic modes.
    zeta : (k,) array [-]
        Damping ratios: the diagonal of ``2 Z Omega``, divided by ``2 |omega|``.
    phi : (n, k) array [1/sqrt(kg)]
        Mode shapes. They are complex where the damping is not proportional. They are then scaled
        so that ``phi^T (2 lambda M + D) phi = 2i Im(lambda)`` with the pole lambda. An unstable
        mode has two real poles. The shape of the growing pole is ``Re phi + Im phi`` and that of
        the decaying pole is ``Re phi - Im phi``, both scaled as in `NormalForm`.
    dofs : DofSet
        DOFs of the n rows.
    n_rigid : int
        Number of rigid-body modes at 0.
    vectors, vector_omega, vector_zeta : (n, m), (m,), (m,) arrays
        Residual attachment vectors, with their frequencies [rad/s] and damping ratios.
    vector_dofs : sequence of m str
        Places of the unit forces. Each vector combines the displacements under all these forces.
        The combinations are chosen such that K is diagonal.
    residual : (k,) array
        Error ``||K phi - omega^2 M phi|| / ||K phi||`` of each mode, computed by `solve_modes`. It
        is 0 for rigid-body modes. Empty: not known.
    rounding : (k,) array
        Relative error of each frequency because the entries of K are rounded to double precision.
        It is ``eps |phi|^T |K| |phi| / (2 omega^2)`` with the machine precision eps, for any
        solver, and 0 for rigid-body modes. Empty: not known.
    certificate : Certificate
        Checks made by `solve_modes`. `orthonormality` is the largest entry of phi^T M phi - I.
        `rigid_residual` is ||K R|| / || |K| |R| || with the rigid-body motions R. `rigid_rounding`
        [Hz] is ``sqrt(eps |R|^T |K| |R|) / (2 pi)``: a suspension with a lower frequency cannot be
        distinguished from rounding of K. For a large model, `found` is the number of modes that the
        solver found below the frequency `shift` [Hz], and `counted` is that of a Sturm count.
    notes : sequence of str
        Remarks on modes read from a file: assumptions, changes and missing items.
    calibration : MeasuredModes, optional
        Measured poles that `calibrated` used, if it was called.

    Raises
    ------
    ShapeError, ModelError
        When sizes do not match or the rigid-body modes are not at 0.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0], stiffnesses=[100.0]), count=2)
    >>> modes
    <Modes: 2 of 2 DOFs (1 rigid-body, 1 elastic at 2.251 Hz)>
    >>> modes.at("2:x").round(4)
    array([ 0.7071, -0.7071])
    """

    omega: FloatArray = field(metadata=checked(real_array, shape=(None,)))
    zeta: FloatArray = field(metadata=checked(real_array, shape=("omega",)))
    phi: FloatArray | ComplexArray = field(
        metadata=checked(real_or_complex, shape=("dofs", "omega"))
    )
    dofs: DofSet
    n_rigid: int = 0
    vectors: FloatArray = field(default_factory=_nothing)
    vector_omega: FloatArray = field(default_factory=_nothing, metadata=_OF_VECTORS)
    vector_zeta: FloatArray = field(default_factory=_nothing, metadata=_OF_VECTORS)
    vector_dofs: Sequence[str] = ()
    residual: FloatArray = field(default_factory=_nothing)
    rounding: FloatArray = field(default_factory=_nothing)
    certificate: Certificate = field(default_factory=Certificate)
    notes: Sequence[str] = ()
    calibration: Value | None = None

    def __post_init__(self) -> None:
        dofs = self.vector_dofs
        self._set(vector_dofs=(dofs,) if isinstance(dofs, str) else tuple(map(str, dofs)))
        super().__post_init__()
        omega, k = self.omega, len(self.omega)
        if not 0 <= self.n_rigid <= k or np.any(omega[: self.n_rigid] != 0):
            raise ModelError(
                f"n_rigid is {self.n_rigid}, but the first frequencies of {k} are "
                f"{omega[: max(self.n_rigid, 1)].tolist()} rad/s: rigid-body modes are exactly 0."
            )
        held = omega[self.n_rigid :]
        if np.any(held == 0) or np.any(held[int(np.count_nonzero(held < 0)) :] < 0):
            raise ModelError(
                "elastic modes need frequencies above 0: rigid-body modes, at 0, come first, then "
                "unstable ones, with negative frequencies."
            )
        n, m = len(self.dofs), len(self.vector_dofs)
        if m and np.iscomplexobj(self.phi):
            raise ModelError("attachment vectors go with real modes only.")
        if not m and np.size(self.vectors):
            raise ShapeError("vectors are given, but no vector_dofs that name them.")
        self._set(
            n_rigid=int(self.n_rigid),
            vectors=real_array(self.vectors if m else np.zeros((n, 0)), "vectors", (n, m)),
            residual=real_array(self.residual, "residual", (k if np.size(self.residual) else 0,)),
            rounding=real_array(self.rounding, "rounding", (k if np.size(self.rounding) else 0,)),
            notes=tuple(str(note) for note in self.notes),
        )

    def __repr__(self) -> str:
        freq = self.freq[self.n_rigid + self.n_unstable :]
        parts = [f"{self.n_rigid} rigid-body"] if self.n_rigid else []
        if self.n_unstable:
            growth = max(self.poles[self.n_rigid : self.n_rigid + self.n_unstable].real)
            parts.append(f"{self.n_unstable} unstable growing at up to {growth:.4g} 1/s")
        if freq.size:
            to = f" to {freq[-1]:.4g}" if freq.size > 1 else ""
            parts.append(f"{freq.size} elastic at {freq[0]:.4g}{to} Hz")
        kind = " complex" if np.iscomplexobj(self.phi) else ""
        held = f" ({', '.join(parts)})" if parts else ""
        more = ", ..." if self.n_vectors > 4 else ""
        extra = f", vectors at {', '.join(self.vector_dofs[:4])}{more}" if self.n_vectors else ""
        checked = ""
        soft = self.rounding > FOUR_DIGITS
        if "counted" in self.certificate:
            # relative to the elastic forces, which are themselves rounding in soft modes
            residual = self.residual[~soft] if soft.size == self.residual.size else self.residual
            checked = (
                f",\n  {self.certificate['counted']:.0f} counted below "
                f"{self.certificate['shift']:.4g} Hz, none missing; "
                f"residual {np.max(residual, initial=0.0):.1g}"
            )
        if np.any(soft):
            found = np.flatnonzero(soft) + 1
            which = f"mode {found[0]}" if found.size == 1 else f"{found.size} modes from {found[0]}"
            checked += (
                f",\n  rounding of K may change {which} by up to {self.rounding.max():.1g} of the "
                "frequency"
            )
        checked += "".join(f",\n  {note}" for note in self.notes)
        return (
            f"<Modes: {self.n_modes}{kind} of "
            f"{counted(len(self.dofs), 'DOF')}{held}{extra}{checked}>"
        )

    @property
    def n_modes(self) -> int:
        """Number of modes k, without attachment vectors."""
        return int(self.omega.size)

    @property
    def n_unstable(self) -> int:
        """Number of unstable modes, which stand between the modes at 0 and the elastic modes."""
        return int(np.count_nonzero(self.omega < 0))

    @property
    def n_vectors(self) -> int:
        """Number of attachment vectors m."""
        return len(self.vector_dofs)

    @property
    def freq(self) -> FloatArray:
        """Undamped frequencies (k,) [Hz]."""
        return self.omega / (2 * np.pi)

    @property
    def poles(self) -> ComplexArray:
        """Poles (k,) [rad/s] in the upper half plane; those of rigid-body modes are exactly 0.

        A pole is ``-zeta omega + i omega sqrt(1 - zeta^2)``. An unstable mode has its growing pole.
        """
        return pole_pairs(self.omega, self.zeta)[0]

    @property
    def basis(self) -> FloatArray | ComplexArray:
        """Modes and attachment vectors side by side (n, k + m)."""
        both: Any = np.hstack([self.phi, self.vectors])
        return cast(FloatArray | ComplexArray, both)

    @property
    def basis_omega(self) -> FloatArray:
        """Undamped frequencies (k + m,) [rad/s] of modes and attachment vectors."""
        return np.concatenate([self.omega, self.vector_omega])

    @property
    def basis_squares(self) -> FloatArray:
        """Diagonal (k + m,) of Omega^2 [1/s^2] in equation (5), negative for unstable modes."""
        return signed_square(self.basis_omega)

    @property
    def basis_rates(self) -> FloatArray:
        """Diagonal (k + m,) of 2 Z Omega [1/s] in equation (5)."""
        return np.asarray(2.0 * self.basis_zeta * np.abs(self.basis_omega))

    @property
    def basis_zeta(self) -> FloatArray:
        """Damping ratios (k + m,) of modes and attachment vectors."""
        return np.concatenate([self.zeta, self.vector_zeta])

    def select(self, columns: Sequence[int] | IntArray) -> Modes:
        """Return the modes at the positions `columns` (from 0), without the attachment vectors.

        Raises
        ------
        ModelError
            When elastic modes would stand before rigid-body ones.
        """
        chosen = positions(columns, "columns", self.n_modes)
        return Modes(
            self.omega[chosen],
            self.zeta[chosen],
            self.phi[:, chosen],
            self.dofs,
            n_rigid=int(np.count_nonzero(chosen < self.n_rigid)),
            residual=self.residual[chosen] if self.residual.size else self.residual,
        )

    def calibrated(self, measured: Any) -> Modes:
        """Return the modes with measured frequencies and damping ratios and the same shapes.

        Measured frequencies have relative errors of 1e-5 to 1e-4, and those of a finite-element
        model typically 1e-3 to 1e-2. The shapes of the model are much less affected by its errors.

        Parameters
        ----------
        measured : MeasuredModes
            Measured poles with their mode numbers, which count from 1 and include rigid-body modes.

        Raises
        ------
        ModelError, LabelError
            When `measured` has no numbers, a number is not that of an elastic mode, or the modes
            are complex.
        """
        require_real(self, "a pole is not of one of them alone (a reduced model can be calibrated)")
        known = range(self.n_rigid + self.n_unstable + 1, self.n_modes + 1)
        places, poles = measured_poles(measured, known)
        omega, zeta = self.omega.copy(), self.zeta.copy()
        omega[places], zeta[places] = np.abs(poles), -poles.real / np.abs(poles)
        return self.replace(
            omega=omega,
            zeta=zeta,
            certificate=Certificate(),
            residual=(),
            rounding=(),
            calibration=calibration_of(self, measured),
        )

    def mesh_error(self, finer: Modes, *, order: float = 2.0) -> MeshError:
        """Return the frequency errors of the mesh by Richardson extrapolation.

        Errors are proportional to the element size to the power `order`. The elements of this mesh
        are r times as large as those of the finer mesh. A mode with the frequencies f here and
        f_fine there has ``f_fine + (f_fine - f) / (r^order - 1)`` in an infinitely fine mesh.
        Errors that both meshes share (missing shear or mass, wrong material) are not found.

        Parameters
        ----------
        finer : Modes
            Modes of the same structure with smaller elements, for example half as large.
        order : float
            Order of convergence. It is 2 for plates and for bricks of eight nodes.

        Raises
        ------
        ModelError
            When the meshes are too alike, have no shape in common, or the modes are complex.
        """
        hint = "Solve the finer model with the same damping."
        return mesh_error(self, instance(finer, Modes, "finer", hint), order)

    def extrapolated(self, coarser: Modes, *, order: float = 2.0) -> Modes:
        """Return the modes with frequencies extrapolated from this mesh and a coarser one.

        The coarser mesh has elements r times as large. By Richardson's rule, a mode with the
        frequencies f here and f_coarse there gets ``f + (f - f_coarse) / (r^order - 1)``. A mode
        may have no partner in the coarser mesh, for example when several modes have the same
        frequency. Its relative correction is then interpolated between neighbouring frequencies.
        Mode shapes, damping ratios and rigid-body modes do not change.

        Parameters
        ----------
        coarser : Modes
            Modes of the same structure with larger elements, for example 1.5 or 2 times as large.
            Solve a few more of them than of this mesh, so that each mode here finds a partner.
        order : float
            Order of convergence. It is 2 for plates and for bricks of eight nodes.

        Raises
        ------
        ModelError
            When the meshes are too alike, have no shape in common, or the modes are complex.

        References
        ----------
        [Richardson1911]_.
        """
        found = instance(coarser, Modes, "coarser", "Solve the coarser mesh.").mesh_error(
            self, order=order
        )
        places, share = found.partners, np.log(found.limit / self.freq[found.partners])
        rising = np.argsort(self.freq[places])
        elastic = slice(self.n_rigid + self.n_unstable, None)
        omega = self.omega.copy()
        known = np.interp(self.freq[elastic], self.freq[places][rising], share[rising])
        omega[elastic] *= np.exp(known)
        rank = np.argsort(omega, kind="stable")
        return self.replace(
            omega=omega[rank], zeta=self.zeta[rank], phi=self.phi[:, rank],
            certificate=Certificate(), residual=(), rounding=(),
        )  # fmt: skip

    @property
    def orthonormal_basis(self) -> FloatArray:
        """M-orthonormal real shapes B (n, b) that span the shapes of modes and attachment vectors.

        Complex modes give ``B B^T`` as a sum over modes. A mode of pole s adds ``phi phi^T`` if it
        is a rigid-body mode, and else ``Re(phi phi^T s / (i Im s))``. An unstable mode of poles a
        and b with shapes v and w (see `phi`) adds ``(a v v^T - b w w^T) / (a - b)``.
        """
        if not np.iscomplexobj(self.phi):
            return np.real(self.basis)
        phi, r = np.asarray(self.phi), self.n_rigid
        free, pairs = slice(r), slice(r, r + self.n_unstable)
        elastic, poles = phi[:, pairs.stop :], self.poles[pairs.stop :]
        Q = np.linalg.qr(np.hstack([phi.real, phi[:, r:].imag]))[0]
        inner = Q.T @ elastic
        core = np.real((inner * (poles / (1j * poles.imag))) @ inner.T)
        core = core + (Q.T @ phi[:, free].real) @ (Q.T @ phi[:, free].real).T
        grow, decay = (part[pairs].real for part in pole_pairs(self.omega, self.zeta))
        for sign, rate in ((1.0, grow), (-1.0, decay)):
            own = Q.T @ (phi[:, pairs].real + sign * phi[:, pairs].imag)
            core = core + sign * (own * (rate / (grow - decay))) @ own.T
        values, vectors = np.linalg.eigh(0.5 * (core + core.T))
        kept = values > SAME * values[-1]
        return np.asarray((Q @ vectors[:, kept]) * np.sqrt(values[kept]))

    def inertia(self, motions: FloatArray) -> FloatArray:
        """Return loads f (n, r) with the modal forces ``phi^T f`` of the product ``M @ motions``.

        M is not needed. The motions (n, r) must be combinations of the shapes.
        """
        # any load with these modal forces will do: B' f = c, where motions = B c
        basis = self.orthonormal_basis
        share = np.linalg.lstsq(basis, motions, rcond=None)[0]
        return np.asarray(np.linalg.lstsq(basis.T, share, rcond=None)[0])

    def missed_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        """Return the relative error (6,) of each rigid-body motion as a combination of the shapes.

        The rotations are about the point `about` [m].
        """
        wanted, basis = self.rigid_motions(about), self.orthonormal_basis
        return relative_miss(basis @ np.linalg.lstsq(basis, wanted, rcond=None)[0], wanted)

    def at(self, place: Place, direction: str = "z") -> FloatArray | ComplexArray:
        """Return the values (k,) of the mode shapes at a place.

        Parameters
        ----------
        place : str, (3,) array [m] or mapping
            A DOF label, a point, or {label: weight}.
        direction : str
            Direction of the motion at a point.
        """
        motion: FloatArray | ComplexArray = self.dofs.row(place, direction) @ self.phi
        return motion
