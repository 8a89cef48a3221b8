"""Modes of a dense second-order model whose rigid-body motions are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import ComplexArray, FloatArray, IntArray, Matrix, divisor, real_array, whole
from ..errors import ModelError, SolverError, counted, warn
from ..sparse.symmetric import dense, orthonormalised
from ..store import Value
from ..structure.definite import elastic_modes, signed_square
from ..tolerances import CLOSE, FOUR_DIGITS, MISSED, RESIDUAL, SAME
from .matching import runs

#: coupling of modes by D, relative to the largest modal damping, below which it counts as zero
PROPORTIONAL = SAME


@dataclass(frozen=True, eq=False, repr=False)
class NormalForm(Value):
    """Poles and shapes of ``M q'' + D q' + K q = f``.

    Parameters
    ----------
    poles : (k,) complex array [rad/s]
        Poles in the upper half plane, in three groups. The rigid-body poles (exactly 0) come first,
        then the positive real poles of unstable modes, then the others. Each group is sorted by
        magnitude. An unstable mode, caused by a spring of negative stiffness, has two real poles.
        The growing pole s1 > 0 is listed here, and the decaying pole s2 < 0 in `decaying`.
    phi : (n, k) array
        Mode shapes with ``phi^T (2 lambda M + D) phi = 2i Im(lambda)``, where lambda is the pole.
        They are real and mass-normalised when D is proportional, and complex otherwise. Rigid-body
        shapes are real and M-orthonormal. The poles s1 and s2 of an unstable mode have the shapes
        ``v1 = Re phi + Im phi`` and ``v2 = Re phi - Im phi``. They are scaled so that
        ``v1^T (2 s1 M + D) v1 = s1 - s2 = -v2^T (2 s2 M + D) v2``.
    n_rigid : int
        Number of rigid-body modes.
    decaying : (u,) array [1/s]
        Decaying poles s2 < 0 of the unstable modes.
    overdamped : (m,) array [1/s]
        Negative real poles of motions that do not oscillate, sorted by magnitude. They are not
        modes.
    overdamped_phi : (n, m) array
        Shapes of the overdamped motions, without a normalisation.

    Examples
    --------
    Damping that is proportional to the stiffness gives real shapes:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[4e5], dampings=[8.0])
    >>> M, D, K = (part.toarray() for part in (model.M, model.D, model.K))
    >>> fx.modes.normal_form(M, D, K, model.rigid_body).is_real
    True
    """

    poles: ComplexArray
    phi: FloatArray | ComplexArray
    n_rigid: int
    decaying: FloatArray = field(default_factory=lambda: np.zeros(0))
    overdamped: FloatArray = field(default_factory=lambda: np.zeros(0))
    overdamped_phi: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def __repr__(self) -> str:
        kind = "real" if self.is_real else "complex"
        more = f", {counted(self.overdamped.size, 'real pole')}" if self.overdamped.size else ""
        return (
            f"<NormalForm: {counted(self.poles.size, 'mode')}, {self.n_rigid} rigid-body, {kind} "
            f"shapes{more}>"
        )

    @property
    def is_real(self) -> bool:
        """Whether the damping is proportional, so that the shapes are real."""
        return not np.iscomplexobj(self.phi)

    @property
    def omega(self) -> FloatArray:
        """Undamped frequencies (k,) [rad/s]. An unstable mode has ``-sqrt(-s1 s2)``."""
        omega, unstable = np.abs(self.poles), self._unstable
        omega[unstable] = -np.sqrt(-self.decaying * self.poles[unstable].real)
        return omega

    @property
    def zeta(self) -> FloatArray:
        """Damping ratios (k,). An unstable mode has ``-(s1 + s2) / (2 |omega|)``."""
        omega, rate = np.abs(self.omega), -self.poles.real
        rate[self._unstable] = 0.5 * (rate[self._unstable] - self.decaying)
        rate[: self.n_rigid] = 0.0
        return np.asarray(rate / divisor(omega))

    def overdamped_below(self, rate: float) -> str:
        """Return a note on overdamped poles with magnitudes up to `rate` [1/s].

        The note is an empty text if there are no such poles.
        """
        slow = self.overdamped[np.abs(self.overdamped) <= rate]
        if not slow.size:
            return ""
        listed = ", ".join(f"{pole:.4g}" for pole in slow[:3]) + (", ..." if slow.size > 3 else "")
        return (
            f"{counted(slow.size, 'real pole')} of overdamped motions ({listed} 1/s) left out: "
            "modes cannot express them, and a plant of these modes lacks them. "
            "assemble_plant(model, ports) keeps them, in dense form: reduce large models first, by "
            "CraigBampton at the dampers."
        )

    @property
    def _unstable(self) -> slice:
        return slice(self.n_rigid, self.n_rigid + self.decaying.size)


def overdamped_notes(form: NormalForm, rate: float) -> tuple[str, ...]:
    """Warn of overdamped poles up to `rate` [1/s]; return the note, empty without any."""
    note = form.overdamped_below(rate)
    if not note:
        return ()
    warn(note)
    return (note,)


def normal_form(
    M: Matrix,
    D: Matrix | None,
    K: Matrix,
    rigid: FloatArray,
    motions: Callable[[], FloatArray] | None = None,
    *,
    lowest: int | None = None,
) -> NormalForm:
    """Return poles and shapes of a second-order model whose rigid-body motions are known.

    Parameters
    ----------
    M, D, K : (n, n) arrays or sparse matrices
        Symmetric matrices of mass, damping and stiffness. M is positive definite. D may be None,
        for no damping.
    rigid : (n, r) array
        Independent vectors with ``K rigid = 0`` (up to rounding). A held structure has (n, 0).
    motions : function, optional
        Function without arguments that returns the M-orthonormal rigid-body motions (n, m) of the
        geometry, including those that springs hold. K may have negative eigenvalues only for these
        motions.
    lowest : int, optional
        Largest number of oscillating elastic modes. Overdamped motions are then listed separately
        (`overdamped`). None: all modes are returned, and overdamped motions raise an error.

    Returns
    -------
    NormalForm
        Poles and shapes of all n modes, or of the lowest ones.

    Raises
    ------
    ModelError
        When M is not positive definite, when the stiffness of an elastic mode is zero or negative,
        when an elastic mode is overdamped, or when D damps a rigid-body motion.
    SolverError
        When the check of the eigenvalues fails.

    Notes
    -----
    An eigenvalue solver for (K, M) would give small rigid-body frequencies by rounding, some of
    them imaginary. Here the rigid-body motions are removed from the problem first. Rigid-body modes
    are undamped by convention.

    Examples
    --------
    Two masses with a spring and a damper have a rigid-body mode and a damped elastic mode:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[4e5], dampings=[8.0])
    >>> M, D, K = (part.toarray() for part in (model.M, model.D, model.K))
    >>> found = fx.modes.normal_form(M, D, K, model.rigid_body)
    >>> found.n_rigid, found.zeta.round(5)
    (1, array([0.     , 0.00894]))
    """
    M = _square(M, "M")
    K = _square(K, "K", len(M))
    D = None if D is None else _square(D, "D", len(M))
    if lowest is not None:
        whole(lowest, "lowest")
    real = real_form(M, D, K, rigid, motions)
    if D is not None:
        check_drag(real.phi[:, : real.n_rigid], dense(D), real.omega[real.n_rigid :])
    return modal(real, lowest=lowest)


def _square(given: Any, name: str, size: int | None = None) -> FloatArray:
    sparse: Any = given
    matrix = real_array(dense(sparse) if sp.issparse(given) else given, name, (None, None))
    size = len(matrix) if size is None else size
    return real_array(matrix, name, (size, size))


def modal(real: RealForm, *, lowest: int | None = None) -> NormalForm:
    """Return the poles and shapes of a model given in its undamped modes; see `normal_form`."""
    r, rate = real.n_rigid, np.diag(real.C)[real.n_rigid :]
    zero, omega = np.zeros(r, dtype=np.complex128), real.omega[r:]
    if real.is_proportional:
        root = signed_square(omega) - 0.25 * rate**2
        swings = (root > 0) | (omega < 0)
        if lowest is None:
            check_oscillating(swings, omega)
        swing, half = np.sqrt(np.abs(root)), -0.5 * rate
        poles = (half + np.where(omega < 0, 1.0, 1j) * swing)[swings]
        decaying = (half - swing)[omega < 0]
        still = np.stack([half + swing, half - swing], axis=-1)[~swings].ravel()
        order = np.argsort(np.abs(still), kind="stable")
        some = np.concatenate([np.arange(r), r + np.flatnonzero(swings)[:lowest]])
        shapes = np.repeat(real.phi[:, r:][:, ~swings], 2, axis=1)[:, order]
        poles = np.concatenate([zero, poles[:lowest]])
        return NormalForm(poles, real.phi[:, some], r, decaying, still[order], shapes)
    found = _complex_modes(omega, real.C[r:, r:], lowest=lowest)
    return found.replace(
        poles=np.concatenate([zero, found.poles]),
        phi=np.hstack([real.phi[:, :r], real.phi[:, r:] @ found.phi]),
        n_rigid=r,
        overdamped_phi=real.phi[:, r:] @ found.overdamped_phi,
    )


class RealForm(NamedTuple):
    """A model in its undamped modes: ``p'' + C p' + Omega^2 p = phi' f, q = phi p``."""

    omega: FloatArray
    phi: FloatArray
    C: FloatArray
    n_rigid: int

    @property
    def is_proportional(self) -> bool:
        """Whether D damps each elastic mode separately; rigid-body motions are left out."""
        C = self.C[self.n_rigid :, self.n_rigid :]
        rate = np.diag(C)
        coupling = float(np.abs(C - np.diag(rate)).max(initial=0.0))
        return coupling <= PROPORTIONAL * float(np.abs(rate).max(initial=0.0))

    @property
    def drags(self) -> bool:
        """Whether D damps rigid-body motion more than the convention lets pass."""
        return bool(self.drag > FOUR_DIGITS * _first_frequency(self.omega))

    @property
    def drag(self) -> float:
        """Largest damping rate of a rigid-body motion [1/s]."""
        return float(np.abs(self.C[: self.n_rigid, : self.n_rigid]).max(initial=0.0))

    def condition(self, form: NormalForm) -> float:
        """Return the largest condition number of a complex mode, by which rounding grows.

        ``|v|^2 / (2 |lambda| |Im lambda|)`` with ``v = (Omega x, lambda x)``: 1 for real modes,
        without bound where two modes coalesce or one becomes critically damped.
        """
        r = self.n_rigid
        swing = slice(r + form.decaying.size, None)  # real pairs +-s are always separate
        mix = np.linalg.lstsq(self.phi[:, r:], form.phi[:, swing], rcond=None)[0]
        poles = form.poles[swing]
        size = np.linalg.norm(self.omega[r:, None] * mix, axis=0) ** 2
        size += np.abs(poles) ** 2 * np.linalg.norm(mix, axis=0) ** 2
        return float((size / (2.0 * np.abs(poles) * poles.imag)).max(initial=1.0))


def real_form(
    M: Matrix,
    D: Matrix | None,
    K: Matrix,
    rigid: FloatArray,
    motions: Callable[[], FloatArray] | None = None,
) -> RealForm:
    """Return a second-order model in its undamped modes, whatever its damping."""
    M, K = dense(M), dense(K)
    rigid = orthonormalised(M, real_array(rigid, "rigid", (M.shape[0], None)))
    omega, phi = elastic_modes(M, K, rigid, motions=motions)
    phi = np.hstack([rigid, phi])
    omega = np.concatenate([np.zeros(rigid.shape[1]), omega])
    C = np.zeros((omega.size, omega.size)) if D is None else phi.T @ dense(D) @ phi
    return RealForm(omega, phi, 0.5 * (C + C.T), rigid.shape[1])


def check_drag(rigid: FloatArray, D: Matrix, omega: FloatArray) -> None:
    """Raise ModelError when D damps rigid-body motion too much to leave it at 0."""
    if not rigid.shape[1] or not omega.size:
        return
    drag, first = float(np.abs(rigid.T @ np.asarray(D @ rigid)).max()), _first_frequency(omega)
    if drag > FOUR_DIGITS * first:
        raise ModelError(
            f"D damps rigid-body motion at {drag:.3g} 1/s, more than {FOUR_DIGITS:g} of the first "
            f"elastic frequency ({first:.4g} rad/s): dampers to ground, between bodies that no "
            "spring joins, and between places that a rigid rotation moves apart leave no modes at "
            f"0. {PLANT} Else let the damper act along the line between its ends, or close it as a "
            "loop."
        )


def _first_frequency(omega: FloatArray) -> float:
    """Return the lowest frequency above 0, or 0."""
    above = omega[omega > 0]
    return float(above[0]) if above.size else 0.0


def pole_pairs(omega: FloatArray, zeta: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return both poles (k,) of modes ``p'' + 2 zeta |omega| p' + omega |omega| p = 0``."""
    # the first is that in the upper half plane, or the one that grows
    size, unstable = np.abs(omega), omega < 0
    root = np.sqrt((zeta**2 - np.where(unstable, -1.0, 1.0)).astype(np.complex128))
    root = np.where(root.imag < 0, root.conj(), root)
    first, second = size * (-zeta + root), size * (-zeta - root)
    return first.astype(np.complex128), second.astype(np.complex128)


#: advice for damping that modes cannot express
PLANT = "assemble_plant(model, ports) takes such damping as it is, in dense form."


def check_oscillating(oscillates: FloatArray | np.ndarray, omega: FloatArray) -> None:
    """Raise ModelError when one of some modes does not oscillate."""
    if not np.all(oscillates):
        i = int(np.argmin(oscillates))
        raise ModelError(
            f"the elastic mode at {omega[i] / (2 * np.pi):.4g} Hz is overdamped: it has two real "
            f"poles and no oscillation, which modes cannot express. {PLANT} Else lower the "
            "damping."
        )


def _complex_modes(omega: FloatArray, C: FloatArray, *, lowest: int | None) -> NormalForm:
    """Return the complex modes of ``p'' + C p' + Omega^2 p = 0``."""
    k, u = omega.size, int(np.count_nonzero(omega < 0))
    values, vectors = _eigen(omega, C, low=lowest is not None)
    up, down, upper = _kinds(values)
    still = down[:0]
    if upper.size < k - u:
        if lowest is None or u:
            real = np.concatenate([up, down])
            share = np.sum(np.abs(vectors[:, real]) ** 2, axis=1)
            share = np.where(omega > 0, share[:k] + share[k:], -1.0)
            check_oscillating(np.arange(k) != np.argmax(share), omega)
        still, down = down[::-1], still
    upper = upper[:lowest]
    listed = np.concatenate([up, down, upper])
    poles, mix = values[listed], vectors[k:, listed] / values[listed]
    poles[: 2 * u] = poles[: 2 * u].real
    mix = mix / np.linalg.norm(mix, axis=0)
    # what x^T (2 lambda + C) x is made: s1 - s2, s2 - s1 and 2 i Im(lambda)
    apart = poles[:u].real - poles[u : 2 * u].real
    scale = np.concatenate([apart, -apart, 2j * poles[2 * u :].imag])
    for cluster in runs(poles, MISSED):
        mix[:, cluster] = _normalised(poles[cluster], mix[:, cluster], C, scale[cluster])
    mix = _polished(poles, mix, C, scale)
    worst = float(_relative_residual(poles, mix, omega, C).max(initial=0.0))
    if not worst < RESIDUAL:
        raise SolverError(
            f"complex modes leave a relative residual of {worst:.2g} (limit {RESIDUAL:g}): the "
            f"damping is close to critical for two modes at once. {PLANT} Else change D, or lower "
            "it."
        )
    if u:
        pairs = _unstable_pairs(mix[:, :u], mix[:, u : 2 * u])
        mix = np.hstack([pairs, mix[:, 2 * u :]])
    decaying, slow = poles[u : 2 * u].real, vectors[k:, still].real
    poles = np.concatenate([poles[:u], poles[2 * u :]])
    slow = slow / np.linalg.norm(slow, axis=0)
    return NormalForm(poles, mix, 0, decaying, values[still].real, slow)


def _kinds(values: ComplexArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return which eigenvalues grow, decay (fastest first) or oscillate (slowest first)."""
    order = np.argsort(np.abs(values), kind="stable")
    sorted_ = values[order]
    real = np.abs(sorted_.imag) <= SAME * np.abs(sorted_)
    up, down = order[real & (sorted_.real > 0)][::-1], order[real & (sorted_.real < 0)][::-1]
    return up, down, order[~real & (sorted_.imag > 0)]


def _unstable_pairs(grow: ComplexArray, decay: ComplexArray) -> ComplexArray:
    """Return shapes (k, u) whose ``Re + Im`` grow and whose ``Re - Im`` decay, all real."""
    both = np.hstack([grow, decay])
    if np.abs(both.imag).max() > SAME * np.abs(both).max():
        raise SolverError(
            f"the real poles of an unstable mode cannot be paired: damping and negative stiffness "
            f"mix them with other motions. {PLANT} Else lower the damping."
        )
    up, down = grow.real, decay.real
    down = down * np.where(np.sum(up * down, axis=0) < 0, -1.0, 1.0)
    return np.asarray(0.5 * (up + down) + 0.5j * (up - down))


def _eigen(omega: FloatArray, C: FloatArray, *, low: bool) -> tuple[ComplexArray, ComplexArray]:
    """Return all poles (2k,) and eigenvectors (2k, 2k) of the states ``(|Omega| p, p')``."""
    # all entries are rates; slow modes with strong damping are large eigenvalues of the inverse
    none, size = np.zeros((omega.size, omega.size)), np.abs(omega)
    if low and np.all(omega > 0):
        soft = C / np.outer(omega, omega)
        slow, vectors = la.eig(np.block([[-soft, -np.diag(1 / omega)], [np.diag(1 / omega), none]]))
        return np.asarray(1 / slow), np.asarray(vectors)
    values, vectors = la.eig(np.block([[none, np.diag(size)], [-np.diag(omega), -C]]))
    return np.asarray(values), np.asarray(vectors)


def _relative_residual(
    poles: ComplexArray, mix: ComplexArray, omega: FloatArray, C: FloatArray
) -> FloatArray:
    """Return the relative residual (k,) of modes."""
    rest = mix * poles**2 + (C @ mix) * poles + signed_square(omega)[:, None] * mix
    # the rounding of stronger damping counts as well
    rate = np.abs(omega).max(initial=0.0) + FOUR_DIGITS * np.abs(C).max(initial=0.0)
    size = np.linalg.norm(mix, axis=0) * np.abs(poles) * rate
    return np.asarray(np.linalg.norm(rest, axis=0) / size)


def _normalised(
    poles: ComplexArray, mix: ComplexArray, C: FloatArray, scale: ComplexArray
) -> ComplexArray:
    """Return the shapes of one (nearly) repeated pole with ``x^T (2 lambda + C) x = scale``."""
    mean, goal = poles.mean(), scale.mean()
    gram = mix.T @ (2 * mean * mix + C @ mix)
    if poles.size == 1:
        mix = mix * np.sqrt(goal / gram[0, 0])
    else:
        try:
            mix = mix @ la.inv(la.sqrtm(gram / goal))
        except la.LinAlgError:
            raise SolverError(
                f"the repeated pole {mean:.6g} rad/s has no complete set of shapes: two modes "
                f"coalesce. {PLANT} Else change D, or lower it."
            ) from None
    top = np.argmax(np.abs(mix), axis=0)
    return mix * np.where(mix[top, np.arange(poles.size)].real < 0, -1.0, 1.0)


def _polished(
    poles: ComplexArray, mix: ComplexArray, C: FloatArray, scale: ComplexArray
) -> ComplexArray:
    """Return shapes with ``x_i^T (lambda_i + lambda_j + C) x_j = 0``, by one Newton step."""
    # rounding mixes slow close modes by that of the fastest over their distance
    root = np.sqrt(scale)
    unit = mix / root
    gram = (unit.T @ unit) * np.add.outer(poles, poles) + unit.T @ (C @ unit)
    off = gram - np.eye(poles.size)
    if not np.abs(off).max() < CLOSE:
        return mix
    return np.asarray((unit - 0.5 * unit @ off) * root)
