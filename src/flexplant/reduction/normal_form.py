"""Modes of a dense second-order model whose rigid-body motions are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from ..errors import ModelError, SolverError
from ..structure.eigen import elastic_modes
from ..structure.factor import dense
from ..structure.rigid import orthonormalised
from ..values import ComplexArray, FloatArray, Matrix, Value, real_array

#: coupling of modes by D, relative to the largest modal damping, that still counts as rounding
PROPORTIONAL = 1e-9
#: damping rate of a rigid-body motion, relative to the first elastic frequency, that is let pass
_RIGID_DRAG = 1e-4
#: eigenvalues closer than this (relative) have no eigenvectors of their own
_CLUSTER = 1e-7


@dataclass(frozen=True, eq=False, repr=False)
class NormalForm(Value):
    """Poles and shapes of ``M q'' + D q' + K q = f``.

    Parameters
    ----------
    poles : (k,) complex array [rad/s]
        In the upper half plane, by magnitude; the rigid-body ones first and exactly 0.
    phi : (n, k) array
        Normalised to ``phi^T (2 lambda M + D) phi = 2i Im(lambda)``: mass-normalised and real when
        D is proportional, complex else. Rigid-body shapes are real and M-orthonormal.
    n_rigid : int
        How many rigid-body modes there are.
    """

    poles: ComplexArray
    phi: FloatArray | ComplexArray
    n_rigid: int

    def __post_init__(self) -> None:
        self._set(poles=self.poles, phi=self.phi)

    def __repr__(self) -> str:
        kind = "real" if self.is_real else "complex"
        return f"<NormalForm: {self.poles.size} modes, {self.n_rigid} rigid-body, {kind} shapes>"

    @property
    def is_real(self) -> bool:
        """Whether the damping is proportional, so that the shapes are real."""
        return not np.iscomplexobj(self.phi)


def normal_form(M: Matrix, D: Matrix | None, K: Matrix, rigid: FloatArray) -> NormalForm:
    """Return poles and shapes of a second-order model, rigid-body motions deflated.

    Parameters
    ----------
    M, D, K : (n, n) arrays or sparse matrices
        Symmetric; M positive definite; D None for no damping.
    rigid : (n, r) array
        Independent vectors with ``K rigid = 0`` (up to rounding); (n, 0) for a held structure.

    Returns
    -------
    NormalForm
        All n modes.

    Raises
    ------
    ModelError
        When M is not positive definite, an elastic mode has no stiffness or is overdamped, or D
        drags a rigid-body motion.
    SolverError
        When the eigenvalues found fail their check.

    Notes
    -----
    Eigenvalues of (K, M) alone give rigid-body modes at rounding, some of them imaginary; here
    they are taken out of the problem first. Rigid-body modes are undamped by convention.
    """
    M, K = dense(M), dense(K)
    rigid = orthonormalised(M, real_array(rigid, "rigid", (M.shape[0], None)))
    omega, phi = elastic_modes(M, K, rigid)
    r = rigid.shape[1]
    zero = np.zeros(r, dtype=np.complex128)
    shapes = np.hstack([rigid, phi])
    if D is None:
        return NormalForm(np.concatenate([zero, 1j * omega]), shapes, r)
    D = dense(D)
    check_drag(rigid, D, omega)
    C = phi.T @ D @ phi
    rate = np.diag(C)
    coupling = float(np.abs(C - np.diag(rate)).max(initial=0.0))
    if coupling <= PROPORTIONAL * float(np.abs(rate).max(initial=0.0)):
        root = omega**2 - 0.25 * rate**2
        _check_oscillating(root > 0, omega)
        poles = -0.5 * rate + 1j * np.sqrt(np.maximum(root, 0.0))
        return NormalForm(np.concatenate([zero, poles]), shapes, r)
    poles, mix = _complex_modes(omega, C)
    return NormalForm(np.concatenate([zero, poles]), np.hstack([rigid, phi @ mix]), r)


def check_drag(rigid: FloatArray, D: Matrix, omega: FloatArray) -> None:
    """Raise ModelError when D damps rigid-body motion too much to leave it at 0."""
    if not rigid.shape[1] or not omega.size:
        return
    drag = float(np.abs(rigid.T @ np.asarray(D @ rigid)).max())
    if drag > _RIGID_DRAG * omega[0]:
        raise ModelError(
            f"D damps rigid-body motion at {drag:.3g} 1/s, more than {_RIGID_DRAG:g} of the first "
            f"elastic frequency ({omega[0]:.4g} rad/s): with a damper to ground this large they "
            "are no longer rigid-body modes at 0. Put the damper between two DOFs of the "
            "structure, or leave it out of D and close it as a loop."
        )


def _check_oscillating(oscillates: FloatArray | np.ndarray, omega: FloatArray) -> None:
    if not np.all(oscillates):
        i = int(np.argmin(oscillates))
        raise ModelError(
            f"the elastic mode at {omega[i] / (2 * np.pi):.4g} Hz is overdamped: it has two real "
            "poles and no oscillation, which modes cannot express. Lower the damping."
        )


def _complex_modes(omega: FloatArray, C: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return the poles (k,) and mixes (k, k) of ``p'' + C p' + Omega^2 p = 0``."""
    k = omega.size
    # states (Omega p, p'): all entries are rates, nothing to balance
    A = np.block([[np.zeros((k, k)), np.diag(omega)], [-np.diag(omega), -C]])
    values, vectors = la.eig(A)
    upper = np.flatnonzero(values.imag > 1e-9 * np.abs(values))
    _check_oscillating(np.arange(k) < upper.size, omega)
    upper = upper[np.argsort(np.abs(values[upper]), kind="stable")]
    poles, mix = values[upper], vectors[k:, upper] / values[upper]
    mix = mix / np.linalg.norm(mix, axis=0)
    start = 0
    for i in range(1, k + 1):
        if i == k or abs(poles[i] - poles[i - 1]) > _CLUSTER * abs(poles[i]):
            cluster = slice(start, i)
            mix[:, cluster] = _normalised(poles[cluster], mix[:, cluster], C)
            start = i
    residual = mix * poles**2 + (C @ mix) * poles + omega[:, None] ** 2 * mix
    worst = float(
        (np.linalg.norm(residual, axis=0) / np.linalg.norm(mix, axis=0) / np.abs(poles)).max()
        / omega.max()
    )
    if not worst < 1e-10:
        raise SolverError(
            f"complex modes leave a relative residual of {worst:.2g} (limit 1e-10): the damping is "
            "close to critical for two modes at once. Change D slightly, or lower it."
        )
    return poles, mix


def _normalised(poles: ComplexArray, mix: ComplexArray, C: FloatArray) -> ComplexArray:
    """Return the shapes of one (nearly) repeated pole with ``x^T (2 lambda + C) x = 2i Im``."""
    mean = poles.mean()
    gram = mix.T @ (2 * mean * mix + C @ mix)
    if poles.size == 1:
        mix = mix * np.sqrt(2j * mean.imag / gram[0, 0])
    else:
        mix = mix @ la.inv(la.sqrtm(gram / (2j * mean.imag)))
    top = np.argmax(np.abs(mix), axis=0)
    return mix * np.where(mix[top, np.arange(poles.size)].real < 0, -1.0, 1.0)
