"""Matrix equations (Stein, Lyapunov, Sylvester, Riccati), and scaling that limits rounding."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, divisor, real_array
from ..errors import ModelError, SolverError
from ..parallel import one_thread
from ..tolerances import MOST_STEPS, PRECISION, RESIDUAL, ROOT, ROUNDING, SAME, SPLIT, TINY, TYPED


def state_scale(A: FloatArray, B: FloatArray, C: FloatArray) -> FloatArray:
    """Return d (n,), powers of two, for states ``x = d x_scaled``: ``A d / d[:, None]`` is even."""
    # A is bordered by the sizes of B's rows and C's columns and balanced with them: balancing A
    # alone shrinks the entries above its diagonal blocks without limit (a Schur form of 84 states
    # got units of 1e26 and 1e-34), so that B and C lose all digits
    drive, sight = np.linalg.norm(B, axis=1), np.linalg.norm(C, axis=0)
    # borders as large as the balanced A, whatever the units of A, inputs, outputs
    size = float(np.linalg.norm(balanced_matrix(A))) or 1.0
    return bordered_scale(
        A,
        drive * (size / (float(np.linalg.norm(drive)) or 1.0)),
        sight * (size / (float(np.linalg.norm(sight)) or 1.0)),
    )


def scaled_schur(
    A: FloatArray, B: FloatArray, C: FloatArray
) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Return units d of the states, and T, U of the Schur form ``A d / d[:, None] = U T U*``."""
    # units first: the transformation mixes rounding with the norm of all of A
    d = state_scale(A, B, C)
    T, U = la.schur(A * d / d[:, None], output="complex")
    return d, T, U


def bordered_scale(A: FloatArray, drive: FloatArray, sight: FloatArray) -> FloatArray:
    """Return d (n,), powers of two, that balance A bordered by a column and a row (Osborne)."""
    n = A.shape[0]
    bordered = np.zeros((n + 1, n + 1))
    bordered[:n, :n], bordered[:n, n], bordered[n, :n] = A, drive, sight
    found = even_scale(bordered)
    return np.asarray(found[:n] / found[n])


def even_scale(A: FloatArray) -> FloatArray:
    """Return d (n,), powers of two, for which ``A d / d[:, None]`` has even rows and columns."""
    return _gebal(A)[1]


def balanced_matrix(A: FloatArray) -> FloatArray:
    """Return A with even rows and columns (LAPACK's gebal): the same eigenvalues."""
    return np.asarray(_gebal(A)[0].real)


def _gebal(A: FloatArray | ComplexArray) -> tuple[FloatArray | ComplexArray, FloatArray]:
    """Return A with even rows and columns, and the powers of two that make it so."""
    if not A.size:  # LAPACK prints a complaint about a matrix without rows
        return A, np.ones(0)
    # scipy's matrix_balance reads scales above 2^63 as permutations, with a warning
    gebal: Any = la.get_lapack_funcs("gebal", (A,))
    balanced, _, _, scale, _ = gebal(A, scale=1, permute=0)
    return balanced, np.asarray(scale)


def axis_frequencies(hamiltonian: FloatArray | ComplexArray) -> FloatArray:
    """Return the imaginary parts of the eigenvalues that lie, or nearly lie, on the axis."""
    # false candidates do no harm, since the gain is computed there
    balanced = _gebal(hamiltonian)[0]
    values: ComplexArray = np.asarray(la.eigvals(balanced), dtype=np.complex128)
    return values.imag[np.abs(values.real) <= SAME * np.linalg.norm(balanced)]


def mean_speed(poles: ComplexArray) -> float:
    """Return the geometric mean [rad/s] of the sizes of poles, those near zero left out; 1 if none.

    Poles of free masses are computed with rounding size and carry no information.
    """
    sizes = np.abs(poles)
    moving = sizes[sizes > SPLIT * sizes.max(initial=0.0)]
    return float(np.exp(np.mean(np.log(moving)))) if moving.size else 1.0


def reciprocal(size: FloatArray) -> FloatArray:
    """Return ``1 / size``, and 1 where the size is zero."""
    return np.asarray(1.0 / divisor(size))


_Schur = tuple[ComplexArray, ComplexArray]
#: number of examined residuals, with a Newton correction between them, which squares the error
_CORRECTIONS = 4


def relative(residual: FloatArray, *sizes: float) -> float:
    """Return the norm of a residual relative to the sizes of the terms of its equation."""
    return float(np.linalg.norm(residual)) / (sum(sizes) or 1.0)


@np.errstate(over="ignore", invalid="ignore")
def doubled(A: FloatArray, Q: FloatArray) -> FloatArray:
    """Return the sum of ``A^k Q A'^k``, k = 0, 1, ..., by doubling."""
    X, A = Q, A.copy()
    for _ in range(MOST_STEPS):
        step = A @ X @ A.T
        X = symmetrised(X + step)
        size, change = np.linalg.norm(X), np.linalg.norm(step)
        if not np.isfinite(size):
            break
        if change <= PRECISION * size:
            return X
        A = A @ A
    raise SolverError(
        "the Stein series does not end: A is not strictly stable (an eigenvalue on or outside the "
        "unit circle, such as a rigid-body mode that is left open)."
    )


def stein(A: FloatArray, Q: FloatArray) -> FloatArray:
    """Return X of ``X = A X A' + Q``: the series loses digits when A is far from normal."""
    X = doubled(A, Q)
    return X + doubled(A, A @ X @ A.T + Q - X)


def sylvester(A: FloatArray, B: FloatArray, C: FloatArray) -> FloatArray:
    """Return X of ``A X - X B + C = 0``, by Schur forms and one correction."""
    if not C.size:
        return C
    forms = (la.schur(A, output="complex"), la.schur(B, output="complex"))
    X = _by_schur(forms, C)
    return X + _by_schur(forms, A @ X - X @ B + C)


def lyapunov(A: FloatArray, Q: FloatArray) -> FloatArray:
    """Return X of ``A X + X A' + Q = 0`` with A stable, by its Schur form and one correction."""
    form = la.schur(A, output="complex")
    if (largest := float(np.max(form[0].diagonal().real))) >= 0:
        raise SolverError(
            f"A is not strictly stable (largest real part {largest:.2e} rad/s): "
            "A X + X A' + Q = 0 has no meaningful solution. Take rigid-body modes out."
        )
    X = symmetrised(_by_schur((form, None), Q))
    return X + symmetrised(_by_schur((form, None), A @ X + X @ A.T + Q))


def _by_schur(forms: tuple[_Schur, _Schur | None], C: FloatArray) -> FloatArray:
    """Solve the Sylvester equation once; without a second Schur form B is ``-A'``."""
    (T, U), (S, V) = forms[0], forms[1] or forms[0]
    kind = {"isgn": -1} if forms[1] else {"tranb": "C"}
    X, scale, _ = la.lapack.ztrsyl(T, S, -(U.conj().T @ C @ V), **kind)
    return np.asarray((U @ (X / scale) @ V.conj().T).real)


def shifted_columns(A: FloatArray, shifts: ComplexArray, right: ComplexArray) -> ComplexArray:
    """Return X with ``(I - shifts_j A) X_j = right_j``, by one Schur form of A."""
    if not A.size:
        return right
    schur, U = la.schur(A.astype(np.complex128), output="complex")
    turned = U.conj().T @ right
    X = np.empty_like(turned)
    for i in range(A.shape[0] - 1, -1, -1):
        rest = shifts * (schur[i, i + 1 :] @ X[i + 1 :])
        X[i] = (turned[i] + rest) / (1 - shifts * schur[i, i])
    return np.asarray(U @ X)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def doubled_riccati(
    A: FloatArray, G: FloatArray, H: FloatArray, *, quick: bool = False
) -> tuple[FloatArray, int]:
    """Return X of ``X = A' X (I + G X)^-1 A + H`` and the number of doublings [Chu2004]_."""
    # fast test: converged when no variance grows by 1e-8; a barely stable closed loop may pass it,
    # so that the residual must be checked
    n = A.shape[0]
    for k in range(1, MOST_STEPS + 1):
        inner = G @ H
        inner.flat[:: n + 1] += 1.0
        _, _, solution, info = la.lapack.dgesv(inner, np.concatenate([A, G], axis=1), 1, 1)
        if info:
            raise SolverError("the doubling is singular: no stabilising solution was found.")
        left, right = solution[:, :n], solution[:, n:]
        step = A.T @ (H @ left)
        G, H, A = symmetrised(G + A @ right @ A.T), symmetrised(H + step), A @ left
        size = float(np.linalg.norm(H))
        if not np.isfinite(size) or not np.isfinite(G).all():
            raise SolverError("the doubling overflows: no stabilising solution was found.")
        if np.linalg.norm(step) <= PRECISION * size:
            return H, k
        if quick and np.all(step.diagonal() <= ROOT * H.diagonal()):  # the next is its square
            return H, k
    raise SolverError(f"no convergence in {MOST_STEPS} doublings: no stabilising solution.")


class OnAxisError(Exception):
    """A Hamiltonian has eigenvalues on the imaginary axis."""

    def __init__(self, omega: FloatArray) -> None:
        super().__init__(f"its Hamiltonian has eigenvalues on the imaginary axis, at {omega} rad/s")
        self.omega = omega


def stabilising(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return X and F of ``A'X + X A - (X B + S) R^-1 (B'X + S') + Q = 0``, A + B F stable."""
    n = A.shape[0]
    inner = np.linalg.solve(R, np.hstack([B.T, S.T]))
    BR, SR = inner[:, :n], inner[:, n:]
    if not n:
        return np.zeros((0, 0)), np.asarray(-SR)
    drift, spread = A - B @ SR, B @ BR
    rest = Q - S @ SR
    d = state_scale(A, B, np.sqrt(np.abs(Q.diagonal()))[None, :])
    X = stable_subspace(drift, spread, rest, d, Q)
    for _ in range(_CORRECTIONS):
        moved, bent = drift.T @ X, X @ spread @ X
        residual = moved + moved.T - bent + rest
        # relative to Q: where it cancels with S R^-1 S' the solution is zero except for rounding
        if relative(residual, *(float(np.linalg.norm(term)) for term in (moved, bent, Q))) <= TYPED:
            return X, np.asarray(-(BR @ X + SR))
        closed = (drift - spread @ X).T
        X = X + lyapunov(closed * d[:, None] / d, residual * d * d[:, None]) / d / d[:, None]
    raise SolverError("the stabilising solution is too inaccurate.")


def stable_subspace(
    A: FloatArray, G: FloatArray, Q: FloatArray, d: FloatArray, whole: FloatArray
) -> FloatArray:
    """Return X of ``A'X + X A - X G X + Q = 0``, A - G X stable, by Laub's method [Laub1979]_."""
    # from the stable subspace of the Hamiltonian, states x = d x_scaled. Q is a part of `whole`
    # units of the states, and one of the adjoint states: still Hamiltonian
    parts = (A * d / d[:, None], G / d / d[:, None], Q * d * d[:, None], whole * d * d[:, None])
    inner, reach, cost, own = (float(np.linalg.norm(part)) for part in parts)
    if cost <= ROUNDING * own:  # only rounding: X has the size of A over G
        cost = inner**2 / reach if reach else 0.0
    unit = float(2.0 ** np.round(0.5 * np.log2(cost / reach))) if cost and reach else 1.0
    scale = np.concatenate([d, unit / d])
    balanced = np.block([[A, -G], [-Q, -A.T]]) * scale / scale[:, None]
    values, vectors, count = _stable_first(balanced)
    on_axis = np.abs(values.real) <= RESIDUAL * (np.abs(values) + 1e-2 * np.linalg.norm(balanced))
    if count != d.size or np.any(on_axis):
        near = np.argsort(np.abs(values.real))[:2]
        raise OnAxisError(np.unique(np.abs(values.imag[on_axis if np.any(on_axis) else near])))
    top, bottom = np.split(vectors[:, : d.size] * scale[:, None], 2)
    return symmetrised(np.linalg.solve(top.T, bottom.T).T)


def _stable_first(H: FloatArray) -> tuple[ComplexArray, FloatArray, int]:
    """Return eigenvalues and Schur vectors, the stable ones first, and their number."""
    # LAPACK's gees: SciPy's schur keeps the eigenvalues to itself
    gees: Any = la.get_lapack_funcs("gees", (H,))

    def stable(real: float, _: float) -> bool:
        return real < 0.0

    size = int(gees(stable, H, lwork=-1)[-2][0])
    _, count, real, imag, vectors, _, info = gees(stable, H, lwork=size, sort_t=1)
    if info > 0:
        raise la.LinAlgError("the eigenvalues of a Hamiltonian matrix do not converge.")
    return real + 1j * imag, vectors, count


#: shifts of the Cayley transform relative to the mean speed of the closed loop, tried in turn until
#: its condition leaves half of the digits for Newton's steps
SHIFTS, WELL = (1.0, 1.7, 0.6, 3.1, 0.33), 1e8


def cayley(A: FloatArray, G: FloatArray, Q: FloatArray) -> tuple[FloatArray, ...]:
    """Return A, G, Q of the discrete equation with the solution of a continuous one [Chu2005]_."""
    moduli, unit = np.abs(la.eigvals(np.block([[A, -G], [-Q, -A.T]]))), np.eye(len(A))
    # a rigid-body mode has no information on the speed of the closed loop
    typical = np.exp(np.mean(np.log(np.maximum(moduli, SPLIT * np.max(moduli, initial=TINY)))))
    found: dict[float, tuple[FloatArray, ...]] = {}
    for shift in (np.array(SHIFTS) * typical).tolist():
        moved = A - shift * unit
        try:
            inner = moved + G @ np.linalg.solve(moved.T, Q)
            condition = float(np.linalg.cond(moved) * np.linalg.cond(inner))
            inverse, back = np.linalg.inv(inner), np.linalg.inv(moved)
        except np.linalg.LinAlgError:
            continue  # a pole lies at the shift: the next one misses it
        if not np.isfinite(condition):
            continue
        spread, cost = np.linalg.solve(moved, G) @ inverse.T, inverse.T @ Q @ back
        twice = 2 * shift
        found[condition] = (
            unit + twice * inverse, twice * symmetrised(spread), twice * symmetrised(cost)
        )  # fmt: skip
        if condition < WELL:
            break
    if not found:
        raise SolverError("no shift makes its Cayley transform regular: it has no solution.")
    return found[min(found)]


@np.errstate(over="ignore", invalid="ignore")
def accumulated(A: FloatArray, Q: FloatArray) -> FloatArray:
    """Return the diagonal of ``sum |A^k Q A'^k|`` over 256 steps (fewer when it grows)."""
    X = Q.copy()
    size = max(float(np.linalg.norm(A)), 1.0)
    for _ in range(8):
        X = X + A @ X @ A.T
        A = A @ A
        # unstable: its present size is a sufficient scale, and later terms would hide the others
        if not np.isfinite(A).all() or np.linalg.norm(A) > 1e6 * size:
            break
    return np.abs(X.diagonal())


def scale_of(variance: FloatArray) -> FloatArray:
    """Return the square roots as powers of two, which scale without rounding; 1 for zeros."""
    safe = np.where((variance > 0) & np.isfinite(variance), variance, 1.0)
    return np.asarray(np.exp2(np.round(0.5 * np.log2(safe))))


def symmetric(value: FloatArray, name: str, n: int) -> FloatArray:
    """Return `value` as a symmetric (n, n) array."""
    array = real_array(value, name, (n, n))
    scale = np.sqrt(np.abs(array.diagonal()))
    # the last digits of a covariance that went through single precision or a file
    bound = 1e-8 * (np.outer(scale, scale) + 1e-4 * np.max(np.abs(array), initial=0.0))
    if np.any(np.abs(array - array.T) > bound):
        worst = np.unravel_index(np.argmax(np.abs(array - array.T)), array.shape)
        raise ModelError(
            f"{name} must be symmetric, entries {tuple(int(i) for i in worst)} and its mirror are "
            f"{array[worst]:.6g} and {array.T[worst]:.6g}. Symmetrise it where it is made."
        )
    return symmetrised(array)


def symmetrised(X: FloatArray) -> FloatArray:
    """Return the symmetric part of a matrix."""
    return np.asarray(0.5 * (X + X.T))


@one_thread()
def solve_stein(A: FloatArray, Q: FloatArray) -> FloatArray:
    """Return X of the Stein (discrete Lyapunov) equation ``X = A X A' + Q``.

    The method is doubling (the squared Smith method). In scaled states, each step replaces X by
    ``X + A X A'``, then A by ``A A``. Entry (i, j) of the residual is at most 1e-10 times
    ``T_ij + (T_ii T_jj)^(1/2)``, where ``T = |A| |X| |A'| + |Q|`` is the size of the terms before
    cancellation.

    Parameters
    ----------
    A : (n, n) array
        Matrix with a spectral radius below one.
    Q : (n, n) array
        Symmetric matrix.

    Returns
    -------
    (n, n) array
        Solution X, a symmetric matrix.

    Raises
    ------
    SolverError
        When A is not strictly stable, so that the series does not end, or the residual is too
        large.

    References
    ----------
    [Smith1968]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.lti.solve_stein([[0.5]], [[3.0]]).round(9)  # x = x / 4 + 3
    array([[4.]])
    """
    A, Q = _square_pair(A, Q)
    if not A.size:
        return Q
    d = scale_of(accumulated(A, Q))
    As, Qs = A * d / d[:, None], Q / d / d[:, None]
    X = stein(As, Qs)
    residual = np.abs(As @ X @ As.T + Qs - X)
    terms = np.abs(As) @ np.abs(X) @ np.abs(As.T) + np.abs(Qs)
    size = np.sqrt(terms.diagonal())
    _check(float(np.max(residual * reciprocal(terms + np.outer(size, size)))), "X = A X A' + Q")
    return X * d * d[:, None]


@one_thread()
def solve_lyapunov(A: FloatArray, Q: FloatArray) -> FloatArray:
    """Return X of the Lyapunov equation ``A X + X A' + Q = 0``.

    The method is the Schur form (Bartels-Stewart) in scaled states, with one step of correction.

    Parameters
    ----------
    A : (n, n) array
        State matrix; all its eigenvalues have negative real parts.
    Q : (n, n) array
        Symmetric matrix.

    Returns
    -------
    (n, n) array
        Solution X, a symmetric matrix.

    Raises
    ------
    ShapeError, ModelError, SolverError
        As `solve_stein`.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.lti.solve_lyapunov([[-2.0]], [[4.0]]).round(9)  # -2 x - 2 x + 4 = 0
    array([[1.]])
    """
    A, Q = _square_pair(A, Q)
    if not A.size:
        return Q
    # balance A without Q: a chain of lags is solved to 1e-16 in these units, and to 1e-11 with Q
    d = even_scale(A)
    As, Qs = A * d / d[:, None], Q / d / d[:, None]
    X = lyapunov(As, Qs)
    size = 2 * float(np.linalg.norm(As) * np.linalg.norm(X))
    _check(relative(As @ X + X @ As.T + Qs, size), "A X + X A' + Q = 0")
    return X * d * d[:, None]


def _square_pair(A: FloatArray, Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    A = real_array(A, "A", (None, None))
    return real_array(A, "A", (A.shape[0], A.shape[0])), symmetric(Q, "Q", A.shape[0])


def _check(residual: float, equation: str) -> None:
    if not residual <= RESIDUAL:
        raise SolverError(
            f"{equation}: the residual is {residual:.1e} of its terms, more than {RESIDUAL:.0e}. "
            "A is too close to instability, or too badly conditioned, for double precision."
        )


def compressed(L: FloatArray) -> FloatArray:
    """Return a factor with the same ``L L'`` and at most as many columns as rows."""
    return triangular(L) if L.shape[1] > L.shape[0] else L


def triangular(L: FloatArray) -> FloatArray:
    """Return a lower triangular T with ``T T' = L L'``: exact for each row, whatever its size."""
    return np.asarray(la.qr(L.T, mode="r")[0][: L.shape[0]].T)


def square_root(X: FloatArray) -> FloatArray:
    """Return L with ``L L' = X``, which is positive semidefinite apart from rounding."""
    # by its eigenvectors, each row scaled to unit size before
    size = divisor(np.sqrt(np.maximum(X.diagonal(), 0.0)))
    values, vectors = np.linalg.eigh(symmetrised(X) / size / size[:, None])
    return np.asarray(size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def difference_of(claim: FloatArray, truth: FloatArray) -> float:
    """Return the largest relative difference of variances; without end where one is negative."""
    if not np.all(claim >= 0) or not np.all(truth >= 0):
        return np.inf
    return float(np.max(np.abs(claim - truth) / divisor(truth), initial=0.0))
