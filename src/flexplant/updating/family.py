"""The model over its parameters: pencils ``lambda^2 M + lambda D + K`` and the modes at a point."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import CACHED, ComplexArray, FloatArray, IntArray, Matrix
from ..errors import ModelError, attempted
from ..modes import solve_modes
from ..modes.matching import pair
from ..sparse.symmetric import congruence, dense, matrix_sum, orthonormalised
from ..structure.definite import elastic_modes, refuse_unstable, why_indefinite
from ..structure.model import FEModel
from ..tolerances import FOUR_DIGITS, RANK, ROOT, SAME, TINY
from .parameters import Parameter


@dataclass(frozen=True)
class Eigen:
    """Oscillating modes of one pencil, by rising |lambda|, in the coordinates of its family."""

    poles: ComplexArray
    X: ComplexArray
    Y: ComplexArray
    M: FloatArray
    D: FloatArray
    n_rigid: int
    K: FloatArray | None = None

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
        return Eigen(self.poles, X, Y, self.M, self.D, self.n_rigid, self.K)


class Family:
    """The pencils of a model over its parameters, in coordinates where M = I and K is diagonal.

    In SI, rigid-body modes would be computed as 1e-4 rad/s and the lowest elastic modes would lose
    digits. With DOFs that have neither mass nor damper, the coordinates of the model are kept, and
    these DOFs are condensed statically at each value of the parameters.
    """

    def __init__(
        self, model: Any, parameters: Sequence[Parameter], *, highest: int | None = None
    ) -> None:
        if not all(hasattr(model, part) for part in ("M", "D", "K", "dofs", "rigid_body")):
            raise ModelError(
                f"the model must have M, D, K, a rigid_body basis and dofs, as FEModel and "
                f"ReducedModel do, got {type(model).__name__}. Pass one of them; for Modes: "
                "reduce(modes, DesiredDofs(...))."
            )
        refuse_unstable(model, "updating")
        none = np.zeros(model.M.shape)
        M, D, K = (none if A is None else dense(A) for A in (model.M, model.D, model.K))
        rigid = np.asarray(model.rigid_body, dtype=np.float64)
        self.model = model
        self.parameters = tuple(parameters)
        self.n_rigid = rigid.shape[1]
        self.highest = highest
        k = M.shape[0]
        terms = [(b, part) for b, one in enumerate(self.parameters) for part in one.terms(model)]
        #: the parameter of each term: M(p) = M + sum_j g_j(p) M_j, one term where it is affine
        self.owner = [b for b, _ in terms]
        self.terms = [np.zeros((len(terms), k, k)) for _ in range(3)]
        for j, (_, parts) in enumerate(terms):
            for stack, part in zip(self.terms, parts, strict=True):
                if part is not None:
                    stack[j] = dense(part)
        self.massive = np.flatnonzero(np.any(M != 0, axis=0))
        if self.massive.size < k:
            self.V, self.rigid = np.eye(k), rigid
            self.M, self.D, self.K = M, D, K
        else:
            self.massive, self.rigid = np.arange(k), np.eye(k)[:, : self.n_rigid]
            omega, self.V = _modal_basis(M, K, rigid)
            self.M, self.D, self.K = np.eye(k), self.V.T @ D @ self.V, np.diag(omega**2)
            self.terms = [congruence(stack, self.V) for stack in self.terms]
        self.condensed = self.massive.size < k
        self._derive(np.zeros(len(self.parameters)))
        self._weight: FloatArray | None = None
        #: the unchanged modes, shared by all families of some of the parameters
        self._unchanged: list[Eigen] = []

    def of(self, parameters: Sequence[int]) -> Family:
        """Return the family of some of the parameters, by position; coordinates are shared."""
        part = copy(self)
        chosen = list(parameters)
        part.parameters = tuple(self.parameters[b] for b in chosen)
        terms = [j for b in chosen for j, owner in enumerate(self.owner) if owner == b]
        part.owner = [chosen.index(self.owner[j]) for j in terms]
        part.terms = [stack[terms] for stack in self.terms]
        part.__dict__.pop("_holds", None)
        part._derive(np.zeros(len(chosen)))
        return part

    def confined(self, B: FloatArray) -> Family:
        """Return the family in the span of B (k, k'), M-orthonormal and diagonal in K."""
        part = copy(self)
        part.V, part.rigid = self.V @ B, B.T @ self.rigid
        part.massive = np.arange(B.shape[1])
        part.M, part.D, part.K = (B.T @ whole @ B for whole in (self.M, self.D, self.K))
        part.terms = [congruence(stack, B) for stack in self.terms]
        part._unchanged, part._weight = [], None
        part.__dict__.pop("_holds", None)
        part._derive(np.zeros(len(part.parameters)))
        return part

    def tangent(self, p: FloatArray) -> Family:
        """Return the family with derivatives at `p`; itself where the parameters are affine."""
        if len(self.owner) == len(self.parameters):
            return self
        part = copy(self)
        part._derive(p)
        return part

    def _derive(self, p: FloatArray) -> None:
        """Set the derivatives dM, dD and dK (q, k, k) to those at `p`."""
        if len(self.owner) == len(self.parameters):
            self.dM, self.dD, self.dK = self.terms
        else:
            slopes = np.zeros((len(self.parameters), len(self.owner)))
            slopes[self.owner, range(len(self.owner))] = self._curves(p)[1]
            self.dM, self.dD, self.dK = (np.tensordot(slopes, part, axes=1) for part in self.terms)
        self._stacks = [_vertical_stack(stack) for stack in (self.dM, self.dD, self.dK)]

    def _curves(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return g_j and their derivatives at `p`, of all terms."""
        if len(self.owner) == len(self.parameters):
            return p, np.ones_like(p)
        found = [q.curve(v) for q, v in zip(self.parameters, p.tolist(), strict=True)]
        sizes, slopes = zip(*found, strict=True)
        return np.concatenate(sizes), np.concatenate(slopes)

    def text(self, p: FloatArray) -> str:
        """Return the parameters with values and units."""
        return ", ".join(q.text(v) for q, v in zip(self.parameters, p.tolist(), strict=True))

    def rigid_left(self, p: FloatArray) -> FloatArray:
        """Return the rigid-body modes (r, r') that no spring to the ground holds at `p`."""
        r = self.n_rigid
        sizes = self._curves(p)[0]
        active = [
            part for part, size in zip(self._holds, sizes, strict=True) if size and part.any()
        ]
        if not r or not active:
            return np.eye(r)
        _, sizes, right = la.svd(np.vstack(active))
        return np.asarray(right[int(np.sum(sizes > SAME)) :].T, dtype=np.float64)

    def at(self, p: FloatArray) -> Eigen:
        """Return the oscillating modes at the parameters `p`."""
        if np.any(self._curves(p)[0]):
            return self._solved(p)
        if not self._unchanged:
            self._unchanged.append(self._solved(p))
        return self._unchanged[0]

    def _solved(self, p: FloatArray) -> Eigen:
        M, D, K = self.matrices(p)
        try:
            if self.condensed:
                return self._condensed(M, D, K, self.rigid @ self.rigid_left(p))
            # a search tries many impossible masses, which are refused before anything is solved
            _require_inertia(M)
            rigid = self.rigid @ self.rigid_left(p)
            omega, W = _modal_basis(M, K, rigid)
        except ModelError as error:
            raise ModelError(f"with {self.text(p)}: {error}") from None
        poles, velocities = _oscillating(omega, W.T @ D @ W, rigid.shape[1])
        X = np.asarray(W @ velocities, dtype=np.complex128)
        # M, D, K symmetric: the left eigenvectors are the conjugated right ones
        return Eigen(poles, X, X.conj(), M, D, rigid.shape[1], K)

    def matrices(self, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return M, D and K at `p` in the coordinates of the family."""
        sizes = self._curves(p)[0]
        acting = np.flatnonzero(sizes)
        M, D, K = (
            start + np.tensordot(sizes[acting], change[acting], axes=1) if used else start
            for start, used, change in zip(
                (self.M, self.D, self.K), self._used, self.terms, strict=True
            )
        )
        return M, D, K

    @cached_property
    def _holds(self) -> list[FloatArray]:
        """Effect of the stiffness of each term on rigid-body modes (k, r), zero within rounding."""
        found = []
        for part in self.terms[2]:
            force = part @ self.rigid / max(float(np.abs(part).max(initial=0.0)), TINY)
            found.append(force if np.abs(force).max(initial=0.0) > SAME / len(part) else 0 * force)
        return found

    @cached_property
    def _used(self) -> list[bool]:
        """Which of M, D and K the parameters change."""
        return [bool(np.any(part)) for part in self.terms]

    def moved(self, X: ComplexArray, factors: Sequence[ComplexArray]) -> ComplexArray:
        """Return ``f0 dM X + f1 dD X + f2 dK X`` (q, k, m), each column with its own factors."""
        k, m = X.shape
        total = np.zeros((len(self.parameters), k, m), dtype=np.complex128)
        for stack, factor in zip(self._stacks, factors, strict=True):
            if stack is not None:
                part = stack @ X.real
                if np.any(X.imag):
                    part = part + 1j * (stack @ X.imag)
                total += part.reshape(-1, k, m) * factor
        return total

    def _condensed(self, M: FloatArray, D: FloatArray, K: FloatArray, rigid: FloatArray) -> Eigen:
        """Return the modes with the DOFs without mass condensed statically."""
        m = np.flatnonzero(np.any(M != 0, axis=0))
        s = np.setdiff1d(np.arange(M.shape[0]), m)
        rigid = rigid[m]
        damped = s[np.any(D[s] != 0, axis=1)]
        if damped.size:
            names = getattr(self.model, "coordinates", None) or tuple(self.model.dofs)
            raise ModelError(
                f"{', '.join(str(names[i]) for i in damped[:4])} has a damper but no mass, so its "
                "motion is of first order. Give it a mass (a start of AddedMass that is not zero), "
                "or reduce with Rubin or DesiredDofs, which leave mass everywhere."
            )
        try:
            follow = la.cho_solve(la.cho_factor(K[np.ix_(s, s)]), K[np.ix_(s, m)])
        except la.LinAlgError:
            raise ModelError(
                "K is not positive definite in the DOFs without mass: they could move freely. "
                "Look at negative stiffnesses."
            ) from None
        Mm, Dm = M[np.ix_(m, m)], D[np.ix_(m, m)]
        Km = K[np.ix_(m, m)] - K[np.ix_(m, s)] @ follow
        count = None
        if self.highest is not None and not np.any(Dm):
            count = self.highest + 6
        r = rigid.shape[1]
        omega, W = _modal_basis(Mm, (Km + Km.T) / 2, rigid, count)
        poles, velocities = _oscillating(omega, W.T @ Dm @ W, r)
        X = np.zeros((M.shape[0], poles.size), dtype=np.complex128)
        X[m] = W @ velocities
        X[s] = -follow @ X[m]
        return Eigen(poles, X, X.conj(), M, D, r, K)

    def weighted(self, X: ComplexArray) -> ComplexArray:
        """Return shapes in coordinates where the start's mass matrix is the unit matrix."""
        if not self.condensed:
            return X
        if self._weight is None:
            self._weight = la.cholesky(self.M[np.ix_(self.massive, self.massive)])
        return np.asarray(self._weight @ X[self.massive], dtype=np.complex128)

    def sensitivity(self, eigen: Eigen, columns: Sequence[int]) -> ComplexArray:
        """Return d lambda / d p (m, q) of distinct modes, each by its own vectors."""
        X, poles = eigen.X[:, columns], eigen.poles[columns]
        moved = self.moved(X, (poles**2, poles, np.ones_like(poles)))
        change = np.sum(eigen.Y[:, columns].conj() * moved, axis=1)
        return np.asarray(-(change / np.diag(eigen.scale(columns))).T, dtype=np.complex128)

    def group_derivative(self, eigen: Eigen, columns: Sequence[int]) -> ComplexArray:
        """Return G (q, s, s): exactly repeated modes move by the eigenvalues of sum dp_b G_b."""
        X, poles = eigen.X[:, columns], eigen.poles[columns]
        moved = self.moved(X, (poles**2, poles, np.ones_like(poles)))
        change = eigen.Y[:, columns].conj().T @ moved
        return np.asarray(-np.linalg.solve(eigen.scale(columns), change), dtype=np.complex128)

    def strength(self, omega: float) -> FloatArray:
        """Return (q,) the largest effect of each parameter on an eigenvalue near `omega`."""
        sizes = [np.linalg.norm(part, axis=(1, 2)) for part in (self.dM, self.dD, self.dK)]
        return np.asarray((sizes[0] * omega + sizes[1] + sizes[2] / omega) / 2, dtype=np.float64)


def repeated_groups(poles: ComplexArray) -> list[list[int]]:
    """Return the groups of exactly repeated modes: equal frequency and damping."""
    if not poles.size:
        return []
    near = np.abs(poles[:, None] - poles) <= ROOT * np.abs(poles)[:, None]
    first = np.argmax(near, axis=1)
    found = (np.flatnonzero(first == i) for i in np.unique(first))
    return [group.tolist() for group in found if group.size > 1]


def _vertical_stack(stack: FloatArray) -> Any:
    """Return (q, k, k) matrices below each other, sparse where that saves work, None if zero."""
    q, k, _ = stack.shape
    filled = np.count_nonzero(stack)
    if not filled:
        return None
    flat = stack.reshape(q * k, k)
    return sp.csr_array(flat) if k > 60 and filled < 0.2 * flat.size else flat


def _require_inertia(M: FloatArray) -> None:
    """Raise ModelError unless M is positive definite."""
    try:
        la.cholesky(M)
    except la.LinAlgError:
        raise ModelError(
            "M is not positive definite: some motion would have no inertia, or a negative one. "
            "Look at negative masses."
        ) from None


def _modal_basis(
    M: FloatArray, K: FloatArray, rigid: FloatArray, count: int | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return omega and M-orthonormal modes [rigid, elastic], the rigid ones deflated."""
    _require_inertia(M)
    rigid = orthonormalised(M, rigid)
    omega, phi = elastic_modes(M, K, rigid, count)
    return np.concatenate([np.zeros(rigid.shape[1]), omega]), np.hstack([rigid, phi])


def _oscillating(omega: FloatArray, D: FloatArray, r: int) -> tuple[ComplexArray, ComplexArray]:
    """Return poles in the upper half plane and vectors (k, m) of I lambda^2 + D lambda + Omega^2.

    The states (omega q, dq/dt) make the matrix skew except for the damping, so that all eigenvalues
    are accurate to rounding; the positions of rigid-body modes, r zero eigenvalues, are left out.
    """
    k = omega.size
    e = k - r
    size = np.abs(D)
    if np.sum(size) - np.trace(size) <= RANK * np.max(size, initial=0.0):
        half = np.diag(D) / 2
        root = np.sqrt(np.maximum(omega**2 - half**2, 0.0))
        # rigid-body modes are computed as the root of rounding of the highest one
        keep = np.flatnonzero(root > 1e-7 * np.max(omega, initial=0.0))
        keep = keep[keep >= r]
        poles = -half[keep] + 1j * root[keep]
        return poles, np.eye(k, dtype=np.complex128)[:, keep]
    A = np.zeros((e + k, e + k))
    A[np.arange(e), e + r + np.arange(e)] = omega[r:]
    A[e + r + np.arange(e), np.arange(e)] = -omega[r:]
    A[e:, e:] = -D
    poles, states = la.eig(A, check_finite=False)
    # rigid-body modes are computed as the root of rounding of the fastest pole
    keep = np.flatnonzero(poles.imag > 1e-7 * np.abs(poles).max(initial=0.0))
    keep = keep[np.argsort(np.abs(poles[keep]), kind="stable")]
    # the velocity lambda q of each mode, its length 1, is its shape
    vectors = states[e:, keep]
    vectors = vectors / np.linalg.norm(vectors, axis=0)
    return np.asarray(poles[keep], dtype=np.complex128), np.asarray(vectors, dtype=np.complex128)


#: number of DOFs above which an FEModel is updated in such a basis, and above which it is too large
LARGE, TOO_LARGE = 300, 20_000


def is_large(model: Any) -> bool:
    """Return whether a model is an FEModel that is updated in a basis."""
    if not isinstance(model, FEModel) or model.n_dof <= LARGE:
        return False
    if model.n_dof > TOO_LARGE:
        raise ModelError(
            f"updating an FEModel of {model.n_dof} DOFs (limit {TOO_LARGE}) solves it again for "
            "each estimate. Reduce it, rom = reduce(...), and pass update(rom, ..., "
            "full=model), which needs a few solutions."
        )
    return True


def changed_model(
    model: Any,
    parameters: Sequence[Parameter],
    p: FloatArray,
    family: Family | None = None,
    std: FloatArray | None = None,
) -> Any:
    """Return the model with the parameters at `p` and its remaining rigid-body motions."""
    # `family` has the same parameters; `std` are their standard deviations, for an error message
    changes: dict[str, Any] = changed_matrices(model, parameters, p)
    if hasattr(model, "T"):
        # Gram-Schmidt keeps translations first and moves the rotations to the new centre
        family = Family(model, parameters) if family is None else family
        left = model.rigid_body @ family.rigid_left(p)
        changes["rigid_body"] = orthonormalised(changes["M"], left)
    # the joints of a machine were checked with the previous matrices
    gone = {"joining": None} if getattr(model, "joining", None) is not None else {}
    try:
        return model.replace(**changes, **gone)
    except ModelError as error:
        found = _with_drag(model, changes) if isinstance(model, FEModel) else None
        if found is not None:
            return found
        deviations = [None] * p.size if std is None else std.tolist()
        every = zip(parameters, p.tolist(), deviations, strict=True)
        text = ", ".join(q.text(v, deviation) for q, v, deviation in every)
        why = _impossible(model, changes, parameters, p) or error
        raise ModelError(
            f"the update ended at {text}, which the {type(model).__name__} refuses: {why}"
        ) from None


def changed_matrices(
    model: Any, parameters: Sequence[Parameter], p: FloatArray
) -> dict[str, Matrix | None]:
    """Return M, D and K with the parameters at `p`."""
    # add the small changes first, since the matrices of the model are large
    total: dict[str, Matrix | None] = dict.fromkeys("MDK")
    for parameter, value in zip(parameters, p.tolist(), strict=True):
        for name, part in zip("MDK", parameter.change(model, value), strict=True):
            total[name] = matrix_sum(total[name], part)
    return {name: matrix_sum(getattr(model, name), part) for name, part in total.items()}


def _with_drag(model: FEModel, changes: dict[str, Any]) -> FEModel | None:
    """Return the model if its D fails only by a slight negative damping of rigid motion."""
    # its sign does not matter below 1e-4 of the first elastic frequency (`normal_form`)
    D = changes["D"]
    if D is None or not model.rigid_body.shape[1]:
        return None
    held = None
    with attempted("the updated model without its damping", ModelError):
        held = model.replace(M=changes["M"], K=changes["K"], D=None)
    if held is None:
        return None
    rigid = held.rigid_body
    drag = float(np.abs(np.linalg.eigvalsh(rigid.T @ np.asarray(D @ rigid))).max())
    first = solve_modes(held, count=rigid.shape[1] + 1).omega[-1]
    if drag > FOUR_DIGITS * float(first):
        return None
    # the rigid-body part of D + d M is 0 in theory, so that twice d is above rounding
    shifted = matrix_sum(D, 2.0 * drag * held.M)
    try:
        model.replace(D=shifted)
    except ModelError:
        return None
    return held.with_unchecked_damping(D)


def _impossible(
    model: Any, changes: dict[str, Any], parameters: Sequence[Parameter], p: FloatArray
) -> str:
    """Return a text on an indefinite D or K and the parameters that cause it, else empty."""
    for name in "DK":
        said = "" if changes[name] is None else why_indefinite(changes[name], name)
        if not said:
            continue
        at = "MDK".index(name)
        negative = [
            q.name
            for q, v in zip(parameters, p.tolist(), strict=True)
            if v < 0 and q.change(model, v)[at] is not None
        ]
        keep = ", ".join(negative) or "the parameters"
        return (
            f"{said} The measurement alone does not keep {keep} physical: give bounds=, (0.0, "
            "None) for quantities that can only be added, or measure more."
        )
    return ""


class Point:
    """The model at the parameters `p`, its modes labelled by their numbers in the start model."""

    def __init__(self, family: Family, p: FloatArray, eigen: Eigen, labels: IntArray) -> None:
        #: with the derivatives at p
        self.family = family.tangent(p)
        self.p = p
        self.eigen = eigen
        self.labels = labels
        self._known: dict[tuple[int, ...], tuple[ComplexArray, ComplexArray]] = {}
        #: derivatives of eigenvalues of repeated modes, by mode number
        self.turned: dict[int, ComplexArray] = {}

    @cached_property
    def matrices(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """M, D and K in the coordinates of the family."""
        return self.family.matrices(self.p)

    @cached_property
    def _where(self) -> dict[int, int]:
        return {int(n): c for c, n in enumerate(self.labels.tolist()) if n}

    def columns(self, numbers: Sequence[int]) -> list[int]:
        """Return the columns of modes by number."""
        where = self._where
        lost = [n for n in numbers if n not in where]
        if lost:
            raise ModelError(
                f"modes {lost} stop oscillating: with {self.family.text(self.p)} they have no "
                "pole, or no shape, to compare with the measured one. Limit dampers to physical "
                "values (bounds=), or begin closer to the solution (start=)."
            )
        return [where[n] for n in numbers]

    def sensitivity(self, numbers: Sequence[int]) -> ComplexArray:
        """Return d lambda / d p (m, q), the paper's (11)."""
        S = self.family.sensitivity(self.eigen, self.columns(numbers))
        for i, number in enumerate(numbers):
            S[i] = self.turned.get(number, S[i])
        return S

    def subspace(self, numbers: Sequence[int]) -> tuple[ComplexArray, ComplexArray]:
        """Return dX (q, k, s) and dL (q, s, s) of the invariant pair (X, L) of some modes.

        The bordered system, one factor per mode for all parameters::

            [P(lambda_j)  B_j] [dX_j]     [-(lambda_j^2 dM + lambda_j dD + dK) x_j]
            [B_j^T          0] [dL_j]  =  [                  0                    ]

        with ``B_j = [M x_i (lambda_i + lambda_j) + D x_i]_i``: regular for any distance of the
        modes in the group, as long as no other mode comes near. One mode alone gives d lambda and
        the derivative of its vector at fixed ``x^T (2 lambda M + D) dx = 0``.
        """
        return self.subspaces([numbers])[0]

    def subspaces(self, sets: Sequence[Sequence[int]]) -> list[tuple[ComplexArray, ComplexArray]]:
        """Return `subspace` of sets of modes of one size, solved together."""
        keys = [tuple(numbers) for numbers in sets]
        new = [key for key in dict.fromkeys(keys) if key not in self._known]
        if new:
            groups = np.array([self.columns(key) for key in new])
            self._known |= dict(zip(new, _bordered(self, groups), strict=True))
        return [self._known[key] for key in keys]

    def continued(self, p: FloatArray) -> Point:
        """Return the model at other parameters, its modes paired by shape with those here."""
        eigen = self.family.at(p)
        old, new = self.family.weighted(self.eigen.X), self.family.weighted(eigen.X)
        return self.followed(pair(self.eigen.poles, old, new), self.family, p, eigen)

    def followed(self, found: IntArray, family: Family, p: FloatArray, eigen: Eigen) -> Point:
        """Return a point whose modes, in the columns `found`, have the numbers of those here."""
        labels = np.zeros(eigen.poles.size, dtype=np.int64)
        labels[found[found >= 0]] = self.labels[found >= 0]
        return Point(family, p, eigen, labels)


def first_point(family: Family, p: FloatArray) -> Point:
    """Return the model at the start: modes numbered from 1 by rising frequency."""
    eigen = family.at(p)
    labels = np.arange(eigen.n_rigid + 1, eigen.n_rigid + eigen.poles.size + 1, dtype=np.int64)
    return Point(family, p, eigen, labels)


def _bordered(point: Point, groups: IntArray) -> list[tuple[ComplexArray, ComplexArray]]:
    """Return dX (q, k, s) and dL (q, s, s) of groups of modes, columns (g, s)."""
    M, D, K = point.matrices
    count, s = groups.shape
    X, poles = point.eigen.X[:, groups.ravel()], point.eigen.poles[groups.ravel()]
    k, q = X.shape[0], point.p.size
    changes = point.family.moved(X, (poles**2, poles, np.ones_like(poles))).transpose(2, 1, 0)
    MX, DX = M @ X, D @ X
    # undamped: everything is real except the imaginary border and its unknown
    real = not (np.any(DX) or np.any(X.imag) or np.any(poles.real) or np.any(changes.imag))
    turn = -1j if real else 1.0
    kind = np.float64 if real else np.complex128
    dX, dL = np.zeros((count, s, k, q), complex), np.zeros((count, s, s, q), complex)
    together = max(1, CACHED // (k + s) ** 2)
    for first in range(0, count * s, together):
        own = np.arange(first, min(first + together, count * s))
        lam, members = poles[own], (own // s * s)[:, None] + np.arange(s)
        border = MX.T[members] * (poles[members] + lam[:, None])[:, :, None] + DX.T[members]
        size = np.sqrt(np.linalg.norm(K, 1) / np.abs(border).max(axis=(1, 2)))[:, None, None]
        edge = border * size * turn
        whole = lam[:, None, None] ** 2 * M + lam[:, None, None] * D + K
        system = np.zeros((own.size, k + s, k + s), kind)
        system[:, :k, :k] = whole.real if real else whole
        system[:, k:, :k] = edge.real if real else edge
        system[:, :k, k:] = system[:, k:, :k].transpose(0, 2, 1)
        right = np.zeros((own.size, k + s, q), kind)
        right[:, :k] = -changes[own].real if real else -changes[own]
        solved = np.linalg.solve(system, right)
        dX[own // s, own % s], dL[own // s, own % s] = solved[:, :k], solved[:, k:] * size * turn
    return list(zip(dX.transpose(0, 3, 2, 1), dL.transpose(0, 3, 2, 1), strict=True))
