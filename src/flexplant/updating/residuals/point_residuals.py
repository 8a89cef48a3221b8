"""Residuals of transmission zeros and of static compliance."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg as la

from ...arrays import (
    ComplexArray,
    FloatArray,
    below_half_rate,
    complex_array,
    positive,
    real_array,
    spread_array,
)
from ...errors import ModelError, ShapeError, counted, require_known
from ...labels import DIRECTIONS, Place
from ...modes.matching import assigned
from ...tolerances import NEGLIGIBLE, SPLIT, TINY
from ..family import Family, Point
from ..parameters import named_place
from .residual import Bound, Residual, place_rows, split_parts


class _PointResidual(Residual):
    """A residual between two places."""

    output: Place
    input: Place
    direction: str

    @property
    def loaded(self) -> tuple[tuple[Place, str], ...]:
        """Places and directions of the output and the input."""
        return (self.output, self.direction), (self.input, self.direction)

    def _check_places(self) -> None:
        require_known("direction", [self.direction], DIRECTIONS)
        for what in ("output", "input"):
            named_place(getattr(self, what), self.direction, what)


@dataclass(frozen=True, eq=False, repr=False)
class Antiresonances(_PointResidual):
    """Residuals of complex transmission zeros of one response, ``z_exp - z``.

    The response is ``c P(s)^-1 b`` with ``P(s) = s^2 M + s D + K``. The row c gives the motion at
    the output, and the column b is a unit force at the input. The zeros z of the response are the
    values of s at which ``[P(s) b; c 0]`` is singular. Their derivatives with respect to a
    parameter p are ``dz/dp = -y^T P_p x / (y^T (2 z M + D) x)``. Here P_p is the derivative of P,
    and x and y are right and left eigenvectors. Each measured zero is paired with a different zero
    of the model, the nearest if possible.

    Parameters
    ----------
    zeros : (m,) complex array [rad/s]
        Measured zeros, one of each conjugate pair. They are stored with Im > 0. The real part may
        have any sign.
    output, input : place
        Places between which the response was measured.
    direction : str
        Direction of motion and force at points.
    std : float or (m,) array [rad/s], optional
        Standard deviation of each zero, with ``E|noise|^2 = std^2``. None: not known.
    hold : float, optional [Hz]
        Rate of the zero-order hold of a sampled measurement. The zeros are then those of the
        sampled response. A zero z_d in the z-plane is given as ``hold ln(z_d)``. The zeros differ
        from those of the continuous response. A delay of whole samples does not change them.
        None: the zeros are those of the continuous response.

    Examples
    --------
    An antiresonance that was measured at one end determines a mass at the other end:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> zeros = fx.updating.Antiresonances([390.0j], "1:x", "1:x", direction="x")
    >>> fit = fx.update(drawing, [fx.AddedMass("3:x")], [zeros])
    >>> fit.values.round(4)
    array([0.0062])
    """

    zeros: ComplexArray
    output: Place
    input: Place
    direction: str = field(default="z", kw_only=True)
    std: FloatArray | None = field(default=None, kw_only=True)
    hold: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        zeros = complex_array(self.zeros, "zeros", (None,))
        if not zeros.size:
            raise ShapeError("zeros is empty: leave the residual out.")
        if np.any(zeros.imag == 0):
            raise ModelError("zeros must have an imaginary part: an antiresonance oscillates.")
        std = None if self.std is None else spread_array(self.std, "std", zeros.shape)
        self._set(zeros=zeros.real + 1j * np.abs(zeros.imag), std=std)
        self._check_places()
        if self.hold is not None:
            rate = positive(self.hold, "hold")
            below_half_rate(np.abs(zeros.imag).max() / (2 * np.pi), "one of zeros", rate)
            self._set(hold=rate)

    def __repr__(self) -> str:
        freq = ", ".join(f"{f:.1f}" for f in np.abs(self.zeros[:4]) / (2 * np.pi))
        return f"<Antiresonances: {self.input} -> {self.output} at {freq} Hz>"

    @property
    def top(self) -> float:
        """Highest frequency [rad/s] of the zeros. With a hold, it is the rate of the hold."""
        return max(float(np.max(np.abs(self.zeros))), 2 * np.pi * (self.hold or 0.0))

    def bound(self, family: Family) -> Bound:
        """Return the residual as `update` uses it; see `Residual.bound`."""
        return _BoundZeros(self, family)


class _BoundZeros(Bound):
    kind, usual = "antiresonance", 5e-3

    def __init__(self, residual: Antiresonances, family: Family) -> None:
        places = [residual.output, residual.input]
        self.c, self.b = place_rows(family, places, residual.direction)
        self.target = residual.zeros
        self.noisy = residual.std is not None
        std = np.ones(self.target.size) if residual.std is None else residual.std / np.sqrt(2)
        self.std = std
        self.hold = residual.hold
        self.size = np.tile(np.abs(self.target) / std, 2)
        self.name = f"{counted(self.target.size, 'antiresonance')}"
        self._last: tuple[Point, ComplexArray, ComplexArray] | None = None

    def row_name(self, row: int) -> str:
        zero = self.target[row % self.target.size]
        return f"the antiresonance at {abs(zero) / (2 * np.pi):.4g} Hz"

    def _matched(self, point: Point) -> tuple[ComplexArray, ComplexArray]:
        """Return the zeros nearest to the measured ones and their slopes (m, q)."""
        if self._last is None or self._last[0] is not point:
            if self.hold is None:
                s, slopes = self._continuous(point)
            else:
                B, C = self.b[:, None], self.c[None]
                s, slopes = Held(point, B, C, rate=self.hold, delay=0.0, order=0).zeros()
            if s.size < self.target.size:
                raise ModelError(
                    f"the model has {counted(s.size, 'antiresonance')} there, {self.target.size} "
                    "were measured."
                )
            columns = assigned(np.abs(self.target[:, None] - s))
            self._last = point, s[columns], slopes[columns]
        return self._last[1:]

    def _continuous(self, point: Point) -> tuple[ComplexArray, ComplexArray]:
        """Return the zeros (m,) of the upper half plane and their slopes (m, q)."""
        M, D, K = point.matrices
        k = K.shape[0]
        w0 = float(np.median(np.abs(self.target)))
        c, b = self.c / np.abs(self.c).max(), self.b / np.abs(self.b).max()
        size = np.abs(K).max()
        # states (q, s q / w0, force): first order in s / w0
        E = np.zeros((2 * k + 1, 2 * k + 1))
        A = np.zeros_like(E)
        A[:k, k : 2 * k] = E[:k, :k] = np.eye(k)
        A[k : 2 * k, :k], A[k : 2 * k, k : 2 * k] = -K / size, -D * w0 / size
        A[k : 2 * k, 2 * k], A[2 * k, :k] = b, c
        E[k : 2 * k, k : 2 * k] = M * w0**2 / size
        solve: Any = la.eig
        (alpha, beta), left, right = solve(A, E, left=True, homogeneous_eigvals=True)
        largest = (1.0 / NEGLIGIBLE) * np.sqrt(size / np.abs(M).max())
        finite = np.flatnonzero(np.abs(beta) * largest > np.abs(alpha) * w0)
        s = np.asarray(alpha[finite] / beta[finite] * w0, dtype=np.complex128)
        upper = s.imag > SPLIT * w0
        s, finite = s[upper], finite[upper]
        x, y = right[:k, finite], left[k : 2 * k, finite].conj()
        moved = point.family.moved(x, (s**2, s, np.ones_like(s)))
        scale = np.sum(y * (2 * (M @ (x * s)) + D @ x), axis=0)
        return s, -(np.sum(y * moved, axis=1) / scale).T

    def values(self, point: Point) -> FloatArray:
        return split_parts((self.target - self._matched(point)[0]) / self.std)

    def slopes(self, point: Point) -> FloatArray:
        # measured minus model
        return split_parts(-self._matched(point)[1] / self.std[:, None])


@dataclass(frozen=True, eq=False, repr=False)
class StaticCompliance(_PointResidual):
    """Residuals of a static compliance, ``g_exp - c K^-1 b``.

    The row c gives the motion at the output, and the column b is the load of a unit force at the
    input. For a free structure, the compliance is that of the elastic modes (inertia relief). The
    displacements then follow from a linear system with the matrix ``[K, M R; R^T M, 0]``, where R
    are the rigid-body motions. On a machine the compliance is measured at frequencies between the
    suspension modes and the first elastic mode.

    Parameters
    ----------
    value : float [m/N]
        Measured compliance.
    output, input, direction
        Places of motion and force, as for `Antiresonances`.
    std : float [m/N], optional
        Standard deviation of `value`. None: it is not known, and the residual is divided by
        `value`.

    Examples
    --------
    The machine is softer than the model, so that the added stiffness is negative:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0], stiffnesses=[4e5], ground=1e5)
    >>> soft = fx.updating.StaticCompliance(6e-6, "1:x", "1:x", direction="x")
    >>> fx.update(drawing, [fx.AddedStiffness("1:x")], [soft]).values.round(1)
    array([-13333.3])
    """

    value: float
    output: Place
    input: Place
    direction: str = field(default="z", kw_only=True)
    std: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        value = float(real_array(self.value, "value", ()))
        if value == 0:
            raise ModelError("a compliance of zero cannot be compared relatively: check the value.")
        self._set(value=value, std=None if self.std is None else positive(self.std, "std"))
        self._check_places()

    def __repr__(self) -> str:
        return f"<StaticCompliance: {self.input} -> {self.output}, {self.value:.4g} m/N>"

    def bound(self, family: Family) -> Bound:
        """Return the residual as `update` uses it; see `Residual.bound`."""
        return _BoundStatic(self, family)


class _BoundStatic(Bound):
    kind, usual = "compliance", 0.02

    def __init__(self, residual: StaticCompliance, family: Family) -> None:
        places = [residual.output, residual.input]
        self.c, self.b = place_rows(family, places, residual.direction)
        self.value = residual.value
        self.noisy = residual.std is not None
        self.std = abs(residual.value) if residual.std is None else residual.std
        self.size = np.array([abs(residual.value) / self.std])
        self.name = "a static compliance"

    def _solved(self, point: Point) -> tuple[Any, FloatArray, FloatArray]:
        M, _, K = point.matrices
        k = K.shape[0]
        R = point.family.rigid @ point.family.rigid_left(point.p)
        r = R.shape[1]
        border = M @ R
        size = np.abs(K).max() / max(float(np.abs(border).max(initial=0.0)), TINY) if r else 1.0
        system = np.block([[K, border * size], [border.T * size, np.zeros((R.shape[1],) * 2)]])
        loads = np.zeros((system.shape[0], 2))
        loads[:k, 0], loads[:k, 1] = self.b, self.c
        try:
            solved = la.solve(system, loads, assume_a="sym")
        except la.LinAlgError:
            raise ModelError("K is singular beyond the rigid-body motions.") from None
        return (R * size, k), solved[:, 0], solved[:, 1]

    def values(self, point: Point) -> FloatArray:
        (_, k), u, _ = self._solved(point)
        return np.array([(self.value - self.c @ u[:k]) / self.std])

    def slopes(self, point: Point) -> FloatArray:
        (R, k), u, y = self._solved(point)
        family = point.family
        moved = y[:k] @ (family.dK @ u[:k]).T
        if R.shape[1]:
            loaded = family.dM @ R
            moved = moved + y[:k] @ (loaded @ u[k:]).T + (y[k:] @ np.swapaxes(loaded, 1, 2)) @ u[:k]
        return np.asarray(moved / self.std)[None, :]


class Held:
    """``x[k+1] = A x[k] + Gamma_1 u[k-n] + Gamma_0 u[k-n-1]`` of ``M q'' + D q' + K q = B u``.

    All follow from one exponential of ``S = [0 s 0; -M^-1 K/s -M^-1 D M^-1 B; 0 0 0]``, with the
    states (s q, q', u) of one size, and its Frechet derivatives: exact with real and repeated poles
    too.
    """

    def __init__(
        self, point: Point, B: FloatArray, C: FloatArray, *, rate: float, delay: float, order: int
    ) -> None:
        self.point, self.T = point, 1 / rate
        if point.family.condensed:
            raise ModelError(
                "a zero-order hold needs a mass in every coordinate, and this model has some "
                "without. Reduce it with DesiredDofs or CraigBampton, or divide the hold out of "
                "the measurement and leave hold= out."
            )
        M, D, K = point.matrices
        k, i = B.shape
        self.k, self.i = k, i
        self.whole, self.part = divmod(delay, 1.0)
        self.size = np.maximum(np.sqrt(np.abs(np.diag(K) / np.diag(M))), rate)
        self.factor = la.cho_factor(M, check_finite=False)
        moved = la.cho_solve(self.factor, np.hstack([K, D, B]), check_finite=False)
        self.MK, self.MD, self.MB = moved[:, :k], moved[:, k : 2 * k], moved[:, 2 * k :]
        # inputs in units that make their column as large as the others
        self.unit = max(float(np.abs(self.MB).max(initial=0.0)) * self.T, TINY)
        S = np.zeros((2 * k + i, 2 * k + i))
        S[np.arange(k), k + np.arange(k)] = self.size
        S[k : 2 * k] = np.hstack([-self.MK / self.size, -self.MD, self.MB / self.unit])
        self.S = S * self.T
        self.C = np.zeros((C.shape[0], 2 * k))
        if order:
            self.C[:, k:] = C
        else:
            self.C[:, :k] = C / self.size

    def responses(self, omega: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return H (l, o, i), and what its slopes take: z and the states X (l, 2k, i)."""
        z = np.exp(1j * omega * self.T)
        late = z ** (-self.whole) * self.unit
        A = self.stepped[: 2 * self.k, : 2 * self.k]
        X = np.linalg.solve(z[:, None, None] * np.eye(2 * self.k) - A, self._inputs(z, self._gains))
        X = X * late[:, None, None]
        return np.matmul(self.C, X), z, X

    def slopes(self, z: ComplexArray, X: ComplexArray) -> ComplexArray:
        """Return dH / dp (q, l, o, i) = Y^T (dA X + dGamma)."""
        n = 2 * self.k
        late = z ** (-self.whole) * self.unit
        A = self.stepped[:n, :n]
        turned = z[:, None, None] * np.eye(n) - A.T
        Y = np.linalg.solve(turned, np.broadcast_to(self.C.T + 0j, (z.size, *self.C.T.shape)))
        found = np.zeros((self.point.p.size, z.size, self.C.shape[0], self.i), complex)
        for b, direction in enumerate(self._directions()):
            moved = _expm_derivative(self.S, direction)
            part = moved[:n, n:]
            if self.part:
                share = 1 - self.part
                part = _expm_derivative(share * self.S, share * direction)[:n, n:]
            gains = part, moved[:n, n:] - part
            pushed = np.matmul(moved[:n, :n], X) + late[:, None, None] * self._inputs(z, gains)
            found[b] = np.matmul(Y.transpose(0, 2, 1), pushed)
        return found

    def zeros(self) -> tuple[ComplexArray, ComplexArray]:
        """Return the zeros (m,) of one input to one output as s = ln(z)/T, and ds/dp (m, q)."""
        # those of the upper half plane, below half the rate. `[A - z, Gamma; C, 0] [x; u] = 0` with
        # `y` from the left: `dz = y^T (dA x + dGamma u) / y^T x`
        n = 2 * self.k
        row = self.C / np.abs(self.C).max()
        gain = self.stepped[:n, n:]
        size = max(float(np.abs(gain).max()), TINY)
        system = np.block([[self.stepped[:n, :n], gain / size], [row, np.zeros((1, 1))]])
        unit = np.diag(np.append(np.ones(n), 0.0))
        solve: Any = la.eig
        (alpha, beta), left, right = solve(system, unit, left=True, homogeneous_eigvals=True)
        # infinite values have beta of rounding size
        kept = np.flatnonzero(np.abs(beta) > 1e-10 * np.abs(alpha))
        z = alpha[kept] / beta[kept]
        s = np.log(np.where(z == 0, TINY, z)) / self.T
        # pairs strictly between 0 Hz and half the rate
        upper = (s.imag > 1e-9 / self.T) & (s.imag < (np.pi - 1e-9) / self.T)
        kept, z, s = kept[upper], z[upper], s[upper]
        x, u = right[:n, kept], right[n:, kept] / size
        y = left[:n, kept].conj()
        scale = np.sum(y * x, axis=0) * z * self.T
        slopes = np.zeros((z.size, self.point.p.size), dtype=np.complex128)
        for b, direction in enumerate(self._directions()):
            moved = _expm_derivative(self.S, direction)
            slopes[:, b] = np.sum(y * (moved[:n, :n] @ x + moved[:n, n:] @ u), axis=0) / scale
        return np.asarray(s, dtype=np.complex128), slopes

    @cached_property
    def stepped(self) -> FloatArray:
        """The exponential over one sample."""
        return np.asarray(la.expm(self.S), dtype=np.float64)

    @cached_property
    def _gains(self) -> tuple[FloatArray, FloatArray]:
        """Gamma of the newer input and of the older one, which acts for the delay's fraction."""
        n = 2 * self.k
        all_ = self.stepped[:n, n:]
        newer = la.expm((1 - self.part) * self.S)[:n, n:] if self.part else all_
        return newer, all_ - newer

    def _inputs(self, z: ComplexArray, gains: tuple[FloatArray, FloatArray]) -> ComplexArray:
        newer, older = gains
        return newer[None] + older[None] / z[:, None, None]

    def _directions(self) -> list[FloatArray]:
        """Return dS of every parameter."""
        family, k = self.point.family, self.k
        found = []
        for dM, dD, dK in zip(family.dM, family.dD, family.dK, strict=True):
            right = np.hstack(
                [
                    -(dK - dM @ self.MK) / self.size,
                    -(dD - dM @ self.MD),
                    -(dM @ self.MB) / self.unit,
                ]
            )
            dS = np.zeros_like(self.S)
            dS[k : 2 * k] = self.T * la.cho_solve(self.factor, right, check_finite=False)
            found.append(dS)
        return found


def _expm_derivative(S: FloatArray, dS: FloatArray) -> FloatArray:
    """Return the derivative of e^S in the direction dS."""
    moved: Any = la.expm_frechet(S, dS, compute_expm=False, check_finite=False)
    return np.asarray(moved, dtype=np.float64)
