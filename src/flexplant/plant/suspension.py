"""Weak springs to ground: gravity compensation, which makes rigid-body modes suspension modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, divisor, members, number, positive
from ..errors import ModelError, counted
from ..labels import Place
from ..modes import Modes, normal_form
from ..modes.matching import runs
from ..reduction import ReducedModel
from ..sparse.symmetric import orthonormalised
from ..store import Value, checked
from ..structure import Damper, FEModel, Spring
from ..tolerances import NEGLIGIBLE, SAME, SPLIT, TYPED
from .port import checked_place, port_direction
from .realisation import realise

Suspended = TypeVar("Suspended", FEModel, ReducedModel, Modes)


#: field: a damper, none at all included
_DAMPING = checked(positive, name="damping of a ground spring", zero=True)


@dataclass(frozen=True, eq=False)
class GroundSpring(Value):
    """A spring and a damper between a place of the structure and the ground.

    Parameters
    ----------
    at : str, (3,) array [m] or mapping
        A DOF label, a point, or a sum {label or point: weight}.
    stiffness : float [N/m or N m/rad]
        Stiffness of the spring; negative where a magnet attracts, as in reluctance actuators and
        maglev.
    damping : float [N s/m or N m s/rad]
        Damping of the damper in parallel with it.
    direction : str
        Direction of the motion at a point: x, y, z, rx, ry, rz. Labels contain a direction.

    Raises
    ------
    LabelError, ModelError
        For a bad place or direction, a stiffness of 0 or a negative damping.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.GroundSpring("1:x", -2e3, direction="x").stiffness  # a magnet that attracts
    -2000.0
    """

    at: Place
    stiffness: float = field(metadata=checked(number, name="stiffness of a ground spring"))
    damping: float = field(default=0.0, metadata=_DAMPING)
    direction: str = "z"

    def __post_init__(self) -> None:
        super().__post_init__()
        own = "a ground spring"
        self._set(at=checked_place(own, self.at), direction=port_direction(own, self.direction))
        if not self.stiffness:
            raise ModelError(
                "the stiffness of a ground spring is 0: it holds nothing. Leave it out, or give it "
                "a stiffness; a damper alone is model.with_parts([Damper(...)])."
            )


class _Springs(NamedTuple):
    """Rows (s, n) of the motions that stretch springs, and their constants (s,)."""

    rows: FloatArray
    stiffness: FloatArray
    damping: FloatArray

    @classmethod
    def of(cls, model: Any, springs: Sequence[GroundSpring]) -> _Springs:
        """Return the springs on a structure."""
        constants = np.array([(s.stiffness, s.damping) for s in springs]).T
        return cls(np.array([model.row(s.at, s.direction) for s in springs]), *constants)

    def terms(self, basis: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Return what they add to K and D, over DOFs or the columns of a basis."""
        rows = self.rows if basis is None else self.rows @ basis
        k, d = (rows.T @ (c[:, None] * rows) for c in (self.stiffness, self.damping))
        return k, d

    def untouched(self, rigid: FloatArray) -> FloatArray:
        """Return the combinations (r, left) of rigid-body motions (n, r) that stretch none."""
        if not rigid.shape[1]:
            return np.zeros((0, 0))
        stretch = self.rows @ rigid
        most = np.abs(self.rows).sum(axis=1, keepdims=True) * np.abs(rigid).max()
        stretch[np.abs(stretch) <= SAME * most] = 0.0  # a spring on the axis of a hinge
        size = np.linalg.norm(stretch, axis=1, keepdims=True)
        return np.asarray(la.null_space(stretch / divisor(size), rcond=SAME))


def suspend(model: Suspended, springs: GroundSpring | Sequence[GroundSpring]) -> Suspended:
    """Return a structure on springs to ground.

    The stiffness becomes ``K + sum_s k_s r_s' r_s``. Here k_s is the stiffness of spring s, and the
    row r_s gives the motion at this spring. The damping matrix D changes in the same way.
    Rigid-body motions that stretch a spring become suspension modes, which oscillate at a low
    frequency. The other rigid-body motions stay exactly at 0 Hz. Springs of negative stiffness turn
    the motions that stretch them into pairs of real poles, one of which is unstable. Such springs
    must not bend the structure.

    Parameters
    ----------
    model : FEModel, ReducedModel or Modes
        The structure. Modes and reduced models keep their own mode shapes when they are suspended.
        The relative error of this is about the ratio of the stiffness of the springs to that of the
        structure, so springs should be much softer than the structure. Modes that a reduced model
        left out are stiffened and damped one by one.
    springs : GroundSpring or sequence of GroundSpring
        Springs and dampers to ground.

    Returns
    -------
    FEModel, ReducedModel or Modes
        Model of the same kind. Modes with damping become complex (springs couple modes that were
        damped one by one), and attachment vectors are then modes like the others.

    Raises
    ------
    ModelError
        When springs are missing, the model is of another kind, or a suspension mode of Modes would
        be overdamped; for complex Modes also when one would be unstable.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0], stiffnesses=[4e5]), count=2)
    >>> held = fx.plant.suspend(modes, [fx.plant.GroundSpring("1:x", 1e3, direction="x")])
    >>> held.n_rigid, held.freq[:1].round(2)
    (0, array([3.56]))
    """
    several = [springs] if isinstance(springs, GroundSpring) else springs
    listed = members(several, GroundSpring, "springs", "Pass GroundSpring(...) in [...].")
    given: Any = model
    if isinstance(given, FEModel):
        return _suspend_model(given, listed)  # type: ignore[return-value]
    if isinstance(given, ReducedModel):
        own = _Springs.of(given, listed)
        stiffness, damping = own.terms()
        return given.replace(  # type: ignore[return-value]
            K=given.K + stiffness,
            D=given.D + damping,
            rigid_body=given.rigid_body @ own.untouched(given.rigid_body),
            truncated=None if given.truncated is None else _each(given.truncated, listed),
            method=f"{given.method}, {counted(len(listed), 'ground spring')}",
        )
    if isinstance(given, Modes):
        own = _Springs.of(given, listed)
        way = _suspend_complex if np.iscomplexobj(given.phi) else _suspend_modes
        return way(given, own)  # type: ignore[return-value]
    raise ModelError(
        f"suspend needs an FEModel, ReducedModel or Modes, got {type(model).__name__}."
    )


def _each(modes: Modes, springs: Sequence[GroundSpring]) -> Modes:
    """Return modes that springs change one by one: ``omega^2 + r k r'``, dampers likewise."""
    own = _Springs.of(modes, springs)
    size = np.abs(own.rows @ modes.phi) ** 2
    square = modes.omega**2 + own.stiffness @ size
    rate = 2.0 * modes.zeta * modes.omega + own.damping @ size
    order = np.argsort(square)
    omega = np.sqrt(square)
    return modes.replace(
        omega=omega[order], zeta=(0.5 * rate / omega)[order], phi=modes.phi[:, order]
    )


def _suspend_model(model: FEModel, springs: Sequence[GroundSpring]) -> FEModel:
    dampers = [Damper(s.at, s.damping, direction=s.direction) for s in springs if s.damping]
    stiff = [Spring(s.at, s.stiffness, direction=s.direction) for s in springs]
    suspended = model.with_parts([*stiff, *dampers])
    expected = _Springs.of(model, springs).untouched(model.rigid_body).shape[1]
    if suspended.rigid_body.shape[1] != expected:
        raise ModelError(
            "the springs are so weak that rounding of the structure's matrices exceeds them: "
            f"they leave {counted(suspended.rigid_body.shape[1], 'rigid-body motion')}, not "
            f"{expected} as by geometry. Solve the modes of the free structure first and suspend "
            "those: fx.plant.suspend(solve_modes(model), springs)."
        )
    return suspended


def _suspend_modes(modes: Modes, springs: _Springs) -> Modes:
    basis, r = np.real(modes.basis), modes.n_rigid
    b = basis.shape[1]
    stiffness, damping = springs.terms(basis)
    kept = springs.untouched(basis[:, :r])
    free = np.vstack([kept, np.zeros((b - r, kept.shape[1]))])

    def motions() -> FloatArray:
        made = modes.missed_motions() < NEGLIGIBLE
        part = np.linalg.lstsq(basis, modes.rigid_motions()[:, made], rcond=None)[0]
        return orthonormalised(np.eye(b), part, dependent="drop")

    form = normal_form(
        np.eye(b),
        np.diag(modes.basis_rates) + damping,
        np.diag(modes.basis_squares) + stiffness,
        free,
        motions,
    )
    shapes = basis @ form.phi
    found = Modes(form.omega, form.zeta, shapes, modes.dofs, n_rigid=form.n_rigid)
    if not form.is_real or not modes.n_vectors:
        return found
    # modes that are still mostly attachment vector stay attachment vectors
    share = np.linalg.norm(np.real(form.phi)[modes.n_modes :], axis=0)
    extra = np.sort(np.argsort(share)[-modes.n_vectors :])
    plain = np.setdiff1d(np.arange(b), extra)
    return found.replace(
        omega=form.omega[plain],
        zeta=form.zeta[plain],
        phi=shapes[:, plain],
        vectors=np.real(shapes[:, extra]),
        vector_omega=form.omega[extra],
        vector_zeta=form.zeta[extra],
        vector_dofs=modes.vector_dofs,
    )


def _suspend_complex(modes: Modes, springs: _Springs) -> Modes:
    """Return complex modes on springs."""
    # in first-order form, as no mass is known for truncated complex modes: `x' = A x + N' f`,
    # `q = S x` and `f = -rows' (k rows q + d rows q')` give A', the residues of which,
    # `S v w' N' = phi phi' / (2i Im lambda)`, are the new shapes. Exact within the span
    if modes.n_unstable:
        raise ModelError(
            "complex modes with an unstable pair cannot be suspended once more: suspend the "
            "FEModel, or reduce and suspend that."
        )
    rows, stiffness, damping = springs
    given, r = realise(modes), modes.n_rigid
    kept = springs.untouched(np.real(modes.phi[:, :r]))
    left = kept.shape[1]
    turned = np.hstack([kept, la.null_space(kept.T)]) if left else np.eye(r)
    turn = la.block_diag(np.kron(turned, np.eye(2)), np.eye(given.A.shape[0] - 2 * r))
    A, N, S = given.A, given.inputs @ turn, given.outputs @ turn  # rigid blocks are all alike
    A, N, S = A[2 * left :, 2 * left :], N[:, 2 * left :], S[:, 2 * left :]
    pull = stiffness[:, None] * (rows @ S) + damping[:, None] * (rows @ (S @ A))
    at_once = np.eye(len(rows)) + damping[:, None] * (rows @ S @ N.T @ rows.T)
    values, right = la.eig(A - (rows @ N).T @ np.linalg.solve(at_once, pull))
    upper = np.flatnonzero(values.imag > SAME * np.abs(values))
    if 2 * upper.size != values.size:
        raise ModelError(
            "on these springs a mode would not oscillate: it is overdamped, or a negative "
            "stiffness makes it unstable. Complex modes do not express that: suspend the FEModel, "
            "or reduce it and suspend that."
        )
    inverse: ComplexArray = np.asarray(np.linalg.inv(right), dtype=np.complex128)
    upper = upper[np.argsort(np.abs(values[upper]), kind="stable")]
    poles = np.asarray(values[upper], dtype=np.complex128)
    shapes = _residue_shapes(poles, S @ right[:, upper], N @ inverse[upper].T)
    rigid = np.real(modes.phi[:, :r]) @ kept
    size = np.abs(poles)
    return Modes(
        np.concatenate([np.zeros(left), size]),
        np.concatenate([np.zeros(left), -poles.real / size]),
        np.hstack([rigid, shapes]),
        modes.dofs,
        n_rigid=left,
    )


def _residue_shapes(poles: ComplexArray, see: ComplexArray, push: ComplexArray) -> ComplexArray:
    """Return phi (n, k) with ``phi phi' = 2i Im(lambda) see push'`` for each pole."""
    phi = np.zeros_like(see)
    for own in runs(poles, SPLIT):
        ratio = np.linalg.lstsq(see[:, own], push[:, own], rcond=None)[0]
        off = np.linalg.norm(see[:, own] @ ratio - push[:, own]) / np.linalg.norm(push[:, own])
        if off > TYPED:
            raise ModelError(
                f"the shapes at the pole {poles[own[0]]:.6g} rad/s are not reciprocal (by "
                f"{off:.1e}): these complex modes are not those of symmetric matrices, or two "
                "modes coalesce."
            )
        phi[:, own] = see[:, own] @ la.sqrtm(2j * poles[own].imag.mean() * ratio)
    return phi
