"""Moment matching: the response and its derivatives at chosen frequencies, exactly."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..arrays import FloatArray, real_array, whole
from ..errors import ModelError, SolverError
from ..labels import Place
from ..modes.modes import Modes
from ..modes.solve import labels_of, places, static_response
from ..modes.sparse_modes import held_factor
from ..sparse.factor import DENSE_LIMIT, dynamic_lu
from ..sparse.symmetric import dense
from ..store import checked
from ..structure import FEModel
from ..tolerances import RANK, SAME, TINY, TYPED
from .methods import ReductionMethod
from .projection import fe_model, projected_model
from .reduced import ReducedModel


@dataclass(frozen=True, eq=False, repr=False)
class Krylov(ReductionMethod):
    """Second-order rational Krylov reduction, which matches the response at given frequencies.

    The response to the inputs is ``X(s) = (s^2 M + s D + K)^-1 B`` with ``s = 2 pi i f``. At each
    given frequency f, X and its first `moments` - 1 derivatives with respect to s are computed.
    Their real and imaginary parts, together with the rigid-body motions, span the columns of T.
    These are M-orthonormal, so that the reduced mass matrix is the unit matrix. The coordinates are
    named "krylov 1", "krylov 2" and so on.

    A moment is a coefficient of the Taylor series of the response at s. From the inputs to any
    place, the first `moments` coefficients agree with those of the full model. If the output is at
    the place of an input, twice this number agree, since the matrices are symmetric. Without D, the
    series is taken in s^2. All frequencies of the reduced model are above the true ones
    (Rayleigh-Ritz).

    Parameters
    ----------
    inputs : place or sequence of places
        Places of loads. A place is a DOF label, a point (x, y, z), at which the direction is z, or
        a mapping {label: weight}.
    freq : float or sequence of float [Hz]
        Frequencies at which the response is matched. A resonance of an undamped model is refused. A
        frequency of 0 matches the static response. For a free structure, this is the response to
        the loads together with the inertia forces that balance them.
    moments : int
        Number of moments at each frequency.
    damping : ModalDamping or Rayleigh, optional
        Damping of the modes of the reduced model. T is then computed without damping. None: the
        model's D, which is also used to compute T.

    References
    ----------
    [BaiSu2005]_; [SalimbahramiLohmann2006]_.

    Examples
    --------
    The response is matched at two frequencies, with the rigid-body motion in addition:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> fx.reduce(model, fx.reduction.Krylov(["1:x"], freq=[50.0, 150.0])).n_dof
    3
    """

    inputs: Place | Iterable[Place] = field(metadata=checked(places))
    freq: FloatArray | float
    moments: int = field(default=1, kw_only=True, metadata=checked(whole))

    def __post_init__(self) -> None:
        super().__post_init__()
        freq = np.atleast_1d(real_array(self.freq, "freq"))
        if freq.ndim > 1 or not freq.size or np.any(freq < 0):
            raise ModelError(
                f"freq must be one or more frequencies [Hz] from 0 up, got {self.freq!r:.60}: "
                "choose frequencies in the band of interest."
            )
        if np.unique(freq).size < freq.size:
            raise ModelError("an expansion frequency appears twice: choose more moments instead.")
        if not self.inputs:
            raise ModelError("Krylov needs at least one input: the place of a load.")
        self._set(freq=freq)

    def reduced(self, structure: FEModel | Modes) -> ReducedModel:
        """Return the reduced model. Call `reduce` instead of this method."""
        model = fe_model(structure, self)
        listed: Any = self.inputs
        labels_of(listed, model.dofs)
        B = np.column_stack([model.dofs.row(place) for place in listed])
        D = None if self.damping is not None else model.D
        basis = np.array(model.rigid_body)
        for f in np.atleast_1d(self.freq):
            if D is None or f == 0:
                found = _real_moments(model, B, 2 * np.pi * float(f), self.moments, D)
            else:
                M, s = model.M, 2j * np.pi * float(f)
                solve = _factorised(s**2 * M + s * D + model.K, abs(s))
                moments = _second_order(solve, 2 * s * M + D, M, B, self.moments)
                found = np.hstack([moments.real, moments.imag])
            basis = extended(model, basis, found)
        return projected_model(
            model,
            basis,
            dofs=model.dofs.select(()),
            coordinates=[f"krylov {i}" for i in range(1, basis.shape[1] + 1)],
            method=f"moments at {np.size(self.freq)} frequencies (Krylov)",
            damping=self.damping,
        )


def _real_moments(model: FEModel, B: FloatArray, omega: float, count: int, D: Any) -> FloatArray:
    """Return a basis of the moments of an undamped model, or at 0 Hz."""
    M, K = model.M, model.K
    if omega > 0:
        solve: Any = _factorised(K - omega**2 * M, omega)
    else:
        held = held_factor(model)  # one factor for all moments
        solve = partial(static_response, model) if held is None else held.static
    if D is not None:
        return np.asarray(_second_order(solve, D, M, B, count))
    block = _normed(model, solve(B))
    found = [block]
    for _step in range(count - 1):
        # a new start vector in the same Krylov space: its component in the basis is removed first
        fresh, basis = solve(np.asarray(model.M @ block)), np.hstack(found)
        gram = basis.T @ np.asarray(model.M @ basis)
        for _ in range(2):
            fresh = fresh - basis @ la.lstsq(gram, basis.T @ np.asarray(model.M @ fresh))[0]
        block = _normed(model, fresh)
        found.append(block)
    return np.hstack(found)


def _second_order(
    solve: Callable[[Any], Any], slope: Any, M: Any, B: FloatArray, count: int
) -> Any:
    """Return the upper parts of an orthonormal Krylov basis of the linearised problem (SOAR)."""
    top, (n, m) = solve(B), B.shape
    basis = la.qr(np.vstack([top, np.zeros_like(top)]), mode="economic")[0]
    for _ in range(count - 1):
        last = basis[:, -m:]
        top = -solve(slope @ last[:n] + M @ last[n:])
        state = np.vstack([top, last[:n]])
        for _ in range(2):
            state = state - basis @ (basis.conj().T @ state)
        basis = np.hstack([basis, la.qr(state, mode="economic")[0]])
    return basis[:n]


def _factorised(matrix: Any, omega: float) -> Callable[[Any], Any]:
    """Return a solver of an indefinite or complex symmetric matrix."""
    at = f"{omega / (2 * np.pi):.6g} Hz"
    kind = matrix.dtype
    if matrix.shape[0] <= DENSE_LIMIT or not sp.issparse(matrix):
        full = matrix.toarray() if hasattr(matrix, "toarray") else np.asarray(matrix)
        size = 1.0 / np.sqrt(np.abs(np.diag(full)).clip(TINY))
        factor = la.lu_factor(full * size[:, None] * size)
        pivots = np.abs(np.diag(factor[0]))
        if pivots.min() < RANK * pivots.max():
            raise ModelError(
                f"the expansion frequency {at} is a resonance of the undamped model: its response "
                "is infinite there. Move it a little."
            )
        return lambda loads: la.lu_solve(factor, loads * size[:, None]) * size[:, None]
    lu = dynamic_lu(matrix)

    def solve(loads: Any) -> Any:
        loads = np.ascontiguousarray(np.asarray(loads, dtype=kind))
        found = lu.solve(loads)
        # pivots stay on the diagonal: one refinement restores the accuracy
        found = found + lu.solve(loads - matrix @ found)
        left = np.linalg.norm(loads - matrix @ found, axis=0)
        if not np.all(left <= TYPED * np.linalg.norm(loads, axis=0).clip(TINY)):
            raise SolverError(
                f"the response at {at} leaves a residual of {left.max():.2g}: a resonance is too "
                "near. Move the expansion frequency."
            )
        return found

    return solve


def _normed(model: FEModel, vectors: FloatArray) -> FloatArray:
    square = np.sum(vectors * np.asarray(model.M @ vectors), axis=0)
    return np.asarray(vectors / np.sqrt(square.clip(TINY)))


def extended(model: FEModel, basis: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return an M-orthonormal basis extended by the vectors that are independent of it."""
    size = np.sqrt(np.sum(vectors * np.asarray(model.M @ vectors), axis=0))
    vectors = vectors[:, size > 0] / size[size > 0]
    for _ in range(2):
        vectors = vectors - basis @ (basis.T @ np.asarray(model.M @ vectors))
    values, mix = la.eigh(vectors.T @ np.asarray(model.M @ vectors))
    kept = values > SAME**2 * max(float(values[-1]) if values.size else 0.0, 1.0)
    fresh = vectors @ (mix[:, kept] / np.sqrt(values[kept]))[:, ::-1]
    for _ in range(2):
        fresh = fresh - basis @ (basis.T @ np.asarray(model.M @ fresh))
        gram = dense(fresh.T @ np.asarray(model.M @ fresh))
        values, mix = la.eigh(gram)
        # squared lengths: the others depend on these to 1e-3, and are made orthogonal again
        good = values > 1e-6 * max(float(values[-1]) if values.size else 0.0, TINY)
        fresh = fresh @ (mix[:, good] / np.sqrt(values[good]))
    return np.hstack([basis, fresh])
