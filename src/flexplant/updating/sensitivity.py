"""Complex eigenvalues of ``lambda^2 M + lambda D + K`` and their derivatives, in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..errors import LabelError, ModelError, ShapeError
from ..structure.eigen import elastic_modes
from ..structure.factor import dense
from ..structure.rigid import orthonormalised
from ..values import ComplexArray, FloatArray, Value, real_array
from .parameters import Parameter

#: modes whose eigenvalues differ by less than this, relatively, count as exactly repeated
REPEATED = 1e-8


@dataclass(frozen=True)
class Eigen:
    """Oscillating modes of one pencil, by rising |lambda|, in the coordinates of its family."""

    poles: ComplexArray
    X: ComplexArray
    Y: ComplexArray
    M: FloatArray
    D: FloatArray
    n_rigid: int

    def scale(self, columns: Sequence[int]) -> ComplexArray:
        """Return y^H (2 lambda M + D) x of every mode of `columns` with every other."""
        X, Y, poles = self.X[:, columns], self.Y[:, columns], self.poles[columns]
        scale = Y.conj().T @ (2 * (self.M @ (X * poles)) + self.D @ X)
        return np.asarray(scale, dtype=np.complex128)

    def rotated(self, columns: Sequence[int], Q: ComplexArray) -> Eigen:
        """Return the same modes with those of `columns` replaced by combinations X Q, Y Q^-H."""
        X, Y = self.X.copy(), self.Y.copy()
        X[:, columns] = X[:, columns] @ Q
        Y[:, columns] = Y[:, columns] @ la.inv(Q).conj().T
        return Eigen(self.poles, X, Y, self.M, self.D, self.n_rigid)


class Family:
    """The pencils of a model over its parameters, in coordinates where M = I and K is diagonal.

    In SI a reduced pencil's rigid-body modes come out at 1e-4 rad/s and its lowest elastic modes
    lose digits to the highest; in the modal coordinates of the start, the rigid-body basis
    deflated, neither happens.
    """

    def __init__(self, model: Any, parameters: Sequence[Parameter]) -> None:
        M, D, K = (_dense(part, model) for part in (model.M, model.D, model.K))
        rigid = np.asarray(model.rigid_body, dtype=np.float64)
        omega, V = _modal_basis(M, K, rigid)
        self.parameters = tuple(parameters)
        self.n_rigid = rigid.shape[1]
        self.omega2 = omega**2
        self.D = V.T @ D @ V
        self.V = V
        k, q = M.shape[0], len(self.parameters)
        self.physical = [np.zeros((q, k, k)) for _ in range(3)]
        for b, parameter in enumerate(self.parameters):
            for stack, part in zip(self.physical, parameter.matrices(model), strict=True):
                if part is not None:
                    stack[b] = part
        self.dM, self.dD, self.dK = (V.T @ stack @ V for stack in self.physical)

    def text(self, p: FloatArray) -> str:
        """Return the parameters with values and units."""
        return ", ".join(q.text(v) for q, v in zip(self.parameters, p.tolist(), strict=True))

    def changes(self, p: FloatArray) -> list[FloatArray]:
        """Return what the parameters add to M, D and K of the model itself."""
        return [np.tensordot(p, stack, axes=1) for stack in self.physical]

    def rigid_left(self, p: FloatArray) -> FloatArray:
        """Return the rigid-body modes (r, r') that no spring to the ground holds at `p`."""
        r = self.n_rigid
        active = self.dK[np.flatnonzero(p), :, :r].reshape(-1, r)
        if not r or not np.any(active):
            return np.eye(r)
        active = active / np.abs(active).max()
        return np.asarray(la.null_space(active, rcond=1e-10), dtype=np.float64)

    def at(self, p: FloatArray) -> Eigen:
        """Return the oscillating modes at the parameters `p`.

        Raises
        ------
        ModelError
            When M is not positive definite there, or K is indefinite.
        """
        k = self.omega2.size
        M = np.eye(k) + np.tensordot(p, self.dM, axes=1)
        D = self.D + np.tensordot(p, self.dD, axes=1)
        K = np.diag(self.omega2) + np.tensordot(p, self.dK, axes=1)
        rigid = np.zeros((k, 0))
        if self.n_rigid:
            rigid = np.eye(k)[:, : self.n_rigid] @ self.rigid_left(p)
        try:
            omega, W = _modal_basis(M, K, rigid)
        except ModelError as error:
            raise ModelError(f"with {self.text(p)}: {error}") from None
        poles, velocities = _oscillating(omega, W.T @ D @ W, rigid.shape[1])
        X = W @ velocities
        # M, D, K symmetric: the left eigenvectors are the conjugated right ones
        return Eigen(poles, X, X.conj(), M, D, rigid.shape[1])

    def derivatives(self, eigen: Eigen, columns: Sequence[int]) -> ComplexArray:
        """Return y^H (lambda^2 dM + lambda dD + dK) x for all pairs of `columns`, (q, m, m)."""
        X, poles = eigen.X[:, columns], eigen.poles[columns]
        moved = self.dM @ (X * poles**2) + self.dD @ (X * poles) + self.dK @ X
        return np.asarray(eigen.Y[:, columns].conj().T @ moved, dtype=np.complex128)

    def sensitivity(self, eigen: Eigen, columns: Sequence[int]) -> ComplexArray:
        """Return d lambda / d p (m, q) of distinct modes, each by its own vectors."""
        change = np.diagonal(self.derivatives(eigen, columns), axis1=1, axis2=2)
        return np.asarray(-(change / np.diag(eigen.scale(columns))).T, dtype=np.complex128)

    def group_derivative(self, eigen: Eigen, columns: Sequence[int]) -> ComplexArray:
        """Return G (q, s, s): exactly repeated modes move by the eigenvalues of sum dp_b G_b."""
        change = self.derivatives(eigen, columns)
        return np.asarray(-la.solve(eigen.scale(columns), change), dtype=np.complex128)

    def strength(self, omega: float) -> FloatArray:
        """Return (q,) how strongly each parameter can move an eigenvalue near `omega` at most."""
        sizes = [np.linalg.norm(part, axis=(1, 2)) for part in (self.dM, self.dD, self.dK)]
        return np.asarray((sizes[0] * omega + sizes[1] + sizes[2] / omega) / 2, dtype=np.float64)


class Rotation(NamedTuple):
    """Repeated modes turned to the vectors in which a change of parameters splits them."""

    eigen: Eigen
    #: (q, s) derivatives along the vectors, by the group's columns
    sensitivity: dict[int, ComplexArray]


def groups(poles: ComplexArray, *, gap: float) -> list[list[int]]:
    """Return runs of neighbours in |lambda| that are closer than `gap`, relatively."""
    order = np.argsort(np.abs(poles), kind="stable").tolist()
    runs: list[list[int]] = []
    for i in order:
        if runs and abs(abs(poles[i]) - abs(poles[runs[-1][-1]])) <= gap * abs(poles[i]):
            runs[-1].append(i)
        else:
            runs.append([i])
    return [sorted(run) for run in runs if len(run) > 1]


def repeated_groups(poles: ComplexArray) -> list[list[int]]:
    """Return the groups of exactly repeated modes: equal frequency and damping."""
    found: list[list[int]] = []
    for run in groups(poles, gap=REPEATED):
        # equal |lambda| with different damping has vectors of its own
        left = list(run)
        while left:
            near = [i for i in left if abs(poles[i] - poles[left[0]]) <= REPEATED * abs(poles[i])]
            left = [i for i in left if i not in near]
            if len(near) > 1:
                found.append(near)
    return found


def split(family: Family, eigen: Eigen, direction: FloatArray) -> Rotation:
    """Return exactly repeated modes turned to the eigenvectors of their derivative.

    Along `direction`; the modes of a group come in the order of the frequencies they move to.
    """
    rows: dict[int, ComplexArray] = {}
    for columns in repeated_groups(eigen.poles):
        G = family.group_derivative(eigen, columns)
        moved, Q = la.eig(np.tensordot(direction, G, axes=1))
        Q = Q[:, np.lexsort((moved.real, moved.imag))]
        eigen = eigen.rotated(columns, Q)
        own = np.diagonal(la.solve(Q, G @ Q), axis1=1, axis2=2)
        rows |= {column: own[:, i] for i, column in enumerate(columns)}
    return Rotation(eigen, rows)


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivities(Value):
    """Derivatives of complex eigenvalues to parameters: S of the paper's (11).

    Parameters
    ----------
    modes : sequence of m int
        Numbers from 1, rigid-body modes included.
    poles : (m,) complex array [rad/s]
        Eigenvalues lambda_a.
    S : (m, q) complex array [rad/s per unit]
        ``S_ab = d lambda_a / d p_b``.
    parameters : sequence of q str
        Names.
    """

    modes: tuple[int, ...]
    poles: ComplexArray
    S: ComplexArray
    parameters: tuple[str, ...]

    def __post_init__(self) -> None:
        self._set(modes=tuple(self.modes), poles=self.poles, S=self.S)

    def __repr__(self) -> str:
        return f"<Sensitivities: {len(self.modes)} modes to {', '.join(self.parameters)}>"


def eigenvalue_sensitivities(
    model: Any,
    parameters: Sequence[Parameter],
    *,
    modes: Sequence[int] | None = None,
    values: Sequence[float] | FloatArray | None = None,
) -> Sensitivities:
    """Return how the complex eigenvalues of a model move with parameters.

    ``d lambda/d p = - y^H (lambda^2 dM + lambda dD + dK) x / (y^H (2 lambda M + D) x)`` with
    right and left eigenvectors x, y of ``lambda^2 M + lambda D + K`` (the paper, eq. (11)).
    Modes that are exactly repeated are first turned to the eigenvectors of the derivative; they
    are given by rising frequency for growing parameters.

    Parameters
    ----------
    model : ReducedModel or FEModel
        The model; an FEModel is treated densely.
    parameters : sequence of q Parameter
        To which the derivatives are taken.
    modes : sequence of int, optional
        Numbers from 1, rigid-body modes included; all elastic modes when not given.
    values : (q,) array, optional
        Values of the parameters to derive at; zeros (the model itself) when not given.

    Returns
    -------
    Sensitivities

    Raises
    ------
    LabelError
        When a mode number or a place is unknown, or names are doubled.
    ModelError
        When the matrices are indefinite at `values`, or several parameters split repeated modes
        along different vectors, so that no derivatives to them all exist.
    """
    listed = checked_parameters(parameters)
    family = Family(model, listed)
    eigen = family.at(checked_values(values, listed, "values"))
    numbers = range(eigen.n_rigid + 1, eigen.n_rigid + eigen.poles.size + 1)
    columns = mode_columns(numbers if modes is None else modes, eigen)
    growing = 1 / _nonzero(family.strength(float(np.abs(eigen.poles[0]))))
    rotation = split(family, eigen, growing)
    S = family.sensitivity(rotation.eigen, columns)
    for group in repeated_groups(eigen.poles):
        if set(group) & set(columns):
            G = family.group_derivative(rotation.eigen, group)
            size = np.abs(G).max(axis=(1, 2), keepdims=True)
            off = np.abs(G) * (1 - np.eye(len(group))) / _nonzero(size)
            if off.max() > 1e-6:
                raise ModelError(
                    f"modes {[i + eigen.n_rigid + 1 for i in group]} are repeated, and "
                    f"{', '.join(p.name for p in listed)} split them along different vectors: "
                    "no derivatives to all of them exist. Ask for one parameter at a time."
                )
    return Sensitivities(
        modes=tuple(i + eigen.n_rigid + 1 for i in columns),
        poles=eigen.poles[columns],
        S=S,
        parameters=tuple(p.name for p in listed),
    )


def mode_columns(modes: Any, eigen: Eigen) -> list[int]:
    """Return the columns of the modes with the given numbers."""
    first, last = eigen.n_rigid + 1, eigen.n_rigid + eigen.poles.size
    if not eigen.poles.size:
        raise ModelError("the model has no oscillating mode: there is no eigenvalue to follow.")
    for number in modes:
        if number not in range(1, last + 1):
            raise LabelError(
                f"no mode {number!r}: the model has {eigen.n_rigid} rigid-body and "
                f"{eigen.poles.size} oscillating modes, numbered from 1 to {last}."
            )
        if number < first:
            raise LabelError(
                f"mode {number} is a rigid-body mode of the start model (1 to {eigen.n_rigid}): "
                "its eigenvalue is zero, and a spring to the ground moves it with infinite "
                "slope. Leave it out, or start from a spring that is not zero (start=)."
            )
    return [int(number) - first for number in modes]


def checked_parameters(parameters: Any) -> tuple[Parameter, ...]:
    """Return the parameters as a tuple, checked."""
    listed = tuple(parameters) if isinstance(parameters, Sequence) else (parameters,)
    for parameter in listed:
        if not isinstance(parameter, Parameter):
            raise ModelError(
                f"parameters must be a list of AddedMass, AddedDamping, AddedStiffness, got "
                f"{type(parameter).__name__} {parameter!r:.60}."
            )
    if not listed:
        raise ModelError("parameters is empty: there is nothing to update.")
    names = [parameter.name for parameter in listed]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise LabelError(
            f"{twice} appear more than once: only their sum could be seen. Drop all but one."
        )
    return listed


def checked_values(values: Any, parameters: Sequence[Parameter], name: str) -> FloatArray:
    """Return one value for each parameter, zeros when none are given."""
    if values is None:
        return np.zeros(len(parameters))
    array = real_array(values, name)
    if array.shape != (len(parameters),):
        raise ShapeError(
            f"{name} needs one value for each of {', '.join(p.name for p in parameters)}, got "
            f"shape {array.shape}."
        )
    return array


def _nonzero(sizes: Any) -> Any:
    return np.where(sizes == 0, 1.0, sizes)


def _dense(part: Any, model: Any) -> FloatArray:
    return np.zeros(model.M.shape) if part is None else dense(part)


def _modal_basis(M: FloatArray, K: FloatArray, rigid: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return omega and M-orthonormal modes [rigid, elastic], the rigid ones deflated."""
    rigid = orthonormalised(M, rigid)
    omega, phi = elastic_modes(M, K, rigid)
    return np.concatenate([np.zeros(rigid.shape[1]), omega]), np.hstack([rigid, phi])


def _oscillating(omega: FloatArray, D: FloatArray, r: int) -> tuple[ComplexArray, ComplexArray]:
    """Return poles in the upper half plane and vectors (k, m) of I lambda^2 + D lambda + Omega^2.

    The states (omega q, dq/dt) make the matrix skew but for the damping, so that all eigenvalues
    are good to rounding; the positions of rigid-body modes, r zero eigenvalues, are left out.
    """
    k = omega.size
    e = k - r
    A = np.zeros((e + k, e + k))
    A[np.arange(e), e + r + np.arange(e)] = omega[r:]
    A[e + r + np.arange(e), np.arange(e)] = -omega[r:]
    A[e:, e:] = -D
    poles, states = la.eig(A, check_finite=False)
    keep = np.flatnonzero(poles.imag > 1e-7 * np.abs(poles).max(initial=0.0))
    keep = keep[np.argsort(np.abs(poles[keep]), kind="stable")]
    # the velocity lambda q of each mode, its length 1, is its shape
    vectors = states[e:, keep]
    vectors = vectors / np.linalg.norm(vectors, axis=0)
    return np.asarray(poles[keep], dtype=np.complex128), np.asarray(vectors, dtype=np.complex128)
