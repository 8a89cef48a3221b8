"""Estimates that use later measurements: the adjoint pass back through a record."""

from __future__ import annotations

import numpy as np

from ..checks import FloatArray, IntArray
from ..lti.lyapunov import solve_stein
from ..lti.recursion import Recursion
from .filter_model import Sight, Steady
from .passage import SETTLED, KnownParameters, Moment, Passage

#: samples whose later measurements are followed side by side
_TOGETHER = 2048


def smoothed(passage: Passage, sight: Sight) -> tuple[FloatArray, FloatArray]:
    """Return estimates and variances (N, nz) from all measurements of a record.

    The adjoint form of Bryson and Frazier, which inverts no covariance of a state::

        r[k-1] = F[k]' r[k] + C2' S^-1 e[k],    M[k-1] = F[k]' M[k] F[k] + C2' S^-1 C2
        hat[k|N] = hat[k|k] + T[k] r[k],        var[k|N] = var[k|k] - T[k] M[k] T[k]'

    F = A - K C2, S the covariance of the innovations e and ``T = C1 P F' - N K'``.
    [BrysonFrazier1963]_; [deJong1989]_ (unknown first states).
    """
    hat, variance = passage.hat.copy(), passage.variance.copy()
    model = passage.steady.model
    n = model.A.shape[0]
    r, M = np.zeros(n), np.zeros((n, n))
    first_seen = passage.moments.get(0)
    count = 0 if first_seen is None else first_seen.seen.shape[1]
    rest = np.zeros((n, count))
    for first, last, stationary in passage.whole():
        if stationary:
            r, M = _backward(passage, sight, (first, last), r, M, hat, variance)
            continue
        for k in range(last - 1, first - 1, -1):
            moment = passage.moments[k]
            g, T = moment.gains, moment.T
            hat[k] = moment.hat + T @ r
            variance[k] = moment.variance - np.einsum("zi,ij,zj->z", T, M, T)
            if moment.found is not None:
                assert passage.found is not None  # noqa: S101
                seen = moment.seen + T @ rest
                hat[k] += seen @ passage.found.value
                variance[k] += passage.found.added(seen)
                v = -g.W.T @ moment.shown - g.K.T @ rest
                rest = model.C2.T @ v + model.A.T @ rest
            v = g.W.T @ passage.white[k] - g.K.T @ r
            r = model.C2.T @ v + model.A.T @ r
            closed, C = model.A - g.K @ model.C2, g.W @ model.C2
            M = closed.T @ M @ closed + C.T @ C
    hat[np.isinf(variance)] = np.nan
    return hat, variance


def _backward(
    passage: Passage,
    sight: Sight,
    span: tuple[int, int],
    r: FloatArray,
    M: FloatArray,
    hat: FloatArray,
    variance: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Fill a stretch of the stationary filter; return r and M before it."""
    steady, at = passage.steady, slice(*span)
    g, F, here = steady.gains, steady.F, sight.part(at)
    onward = steady.onward(steady.P, g)
    added, r = _adjoint_pass(steady, here, passage.white[at], [onward], r)
    hat[at] += added[0]
    C = g.W @ steady.model.C2
    information = C.T @ C
    settled = solve_stein(F.T, information)
    size = np.sqrt(steady.variances(here, steady.P, g, predict=False))
    some = (here.c @ onward / size[:, :, None]).reshape(-1, F.shape[0])
    weight = solve_stein(F, some.T @ some / here.c.shape[0])
    k = span[1]
    while k > span[0] and abs(np.sum(weight * (settled - M))) > SETTLED:
        k -= 1
        T = here.part(slice(k - span[0], k - span[0] + 1)).c[0] @ onward
        variance[k] -= np.einsum("zi,ij,zj->z", T, M, T)
        M = F.T @ M @ F + information
    if k > span[0]:
        M, before = settled, slice(0, k - span[0])
        part = here.part(before)
        T = part.c @ onward
        variance[span[0] : k] -= np.einsum("kzi,ij,kzj->kz", T, M, T)
    return r, M


def _adjoint_pass(
    steady: Steady, here: Sight, white: FloatArray, rows: list[FloatArray], r: FloatArray
) -> tuple[list[FloatArray], FloatArray]:
    """Return ``c rows r[k]`` (N, nz) of a stationary stretch, and r before it."""
    C = steady.gains.W @ steady.model.C2
    fixed = here.c.shape[0] == 1
    see = np.vstack([here.c[0] @ row if fixed else row for row in rows])
    system = Recursion(
        np.ascontiguousarray(steady.F.T), C.T, see, np.zeros((see.shape[0], C.shape[0]))
    )
    out, r = system.run(np.ascontiguousarray(white[::-1]), r)
    parts = np.split(out[::-1], len(rows), axis=1)
    return [part if fixed else here.applied(part) for part in parts], r


def lagged(passage: Passage, sight: Sight, lag: int) -> tuple[FloatArray, FloatArray]:
    """Return estimates and variances (N, nz) from the measurements up to `lag` samples later.

    ``hat[k|k+l] = hat[k|k] + sum_j T[k] F[k+1]' ... F[k+j-1]' C2' S^-1 e[k+j]``, j = 1 ... l. Where
    the filter is stationary the sum is ``T (r[k] - F'^l r[k+l])`` of the adjoint r of `smoothed`.
    """
    hat, variance = passage.hat.copy(), passage.variance.copy()
    steady, N = passage.steady, passage.hat.shape[0]
    onward = steady.onward(steady.P, steady.gains)
    slow = np.ones(N, dtype=bool)
    for first, last, stationary in passage.stretches:
        if not stationary or last - first <= lag:
            continue
        at = slice(first, last - lag)
        slow[at] = False
        here = sight.part(slice(first, last))
        later = onward @ np.linalg.matrix_power(steady.F.T, lag)
        zero = np.zeros(steady.F.shape[0])
        if here.c.shape[0] == 1:
            (now, then), _ = _adjoint_pass(
                steady, here, passage.white[first:last], [onward, later], zero
            )
            hat[at] += now[:-lag] - then[lag:]
        else:
            (r,), _ = _adjoint_pass(
                steady, Sight(np.eye(zero.size)[None], here.D1, here.V),
                passage.white[first:last], [np.eye(zero.size)], zero,
            )  # fmt: skip
            moved = r[:-lag] @ onward.T - r[lag:] @ later.T
            hat[at] += here.part(slice(0, last - lag - first)).applied(moved)
        known = _information(steady, lag)
        T = sight.part(at).c @ onward
        variance[at] -= np.einsum("kzi,ij,kzj->kz", T, known, T)
    listed = np.flatnonzero(slow)
    for start in range(0, listed.size, _TOGETHER):
        _smooth_transient(passage, sight, listed[start : start + _TOGETHER], lag, hat, variance)
    hat[np.isinf(variance)] = np.nan
    return hat, variance


def _information(steady: Steady, lag: int) -> FloatArray:
    """Return what `lag` measurements say, ``sum_j F'^j C2' S^-1 C2 F^j`` over j < lag."""
    C = steady.gains.W @ steady.model.C2
    part, total = C, np.zeros_like(steady.F)
    for _ in range(lag):
        total += part.T @ part
        part = part @ steady.F
    return total


def _smooth_transient(
    passage: Passage,
    sight: Sight,
    ks: IntArray,
    lag: int,
    hat: FloatArray,
    variance: FloatArray,
) -> None:
    """Fill samples from which the gain is not stationary all through the lag."""
    steady, N = passage.steady, passage.hat.shape[0]
    model, g = steady.model, steady.gains
    last = min(int(ks[-1]) + lag + 1, N)
    span = range(int(ks[0]), last)
    plain = Moment(g, np.zeros((0, 0)), np.zeros((model.C2.shape[0], 0)), np.zeros((0, 0)),
                   np.zeros(0), np.zeros(0), None)  # fmt: skip
    listed = [passage.moments.get(k, plain) for k in span]
    K = np.array([one.gains.K for one in listed])
    W = np.array([one.gains.W for one in listed])
    onward = steady.onward(steady.P, g)
    w = np.array([
        passage.moments[k].T if k in passage.moments else sight.part(slice(k, k + 1)).c[0] @ onward
        for k in ks.tolist()
    ])  # fmt: skip
    founds = [_last_found(passage, min(k + lag, N - 1)) for k in ks.tolist()]
    count = max(one.shown.shape[1] for one in listed)
    shown = np.array([
        one.shown if one.shown.shape[1] else np.zeros((one.shown.shape[0], count)) for one in listed
    ])  # fmt: skip
    seen = np.zeros((ks.size, w.shape[1], count))
    for i, k in enumerate(ks.tolist()):
        moment = passage.moments.get(k)
        if moment is not None:
            hat[k], variance[k] = moment.hat, moment.variance
            if moment.found is not None:
                seen[i] = moment.seen
    for age in range(1, lag + 1):
        inside = ks + age < N
        here, at = ks[inside], (ks + age)[inside] - span.start
        rows = w[inside] @ model.C2.T
        white = rows @ W[at].transpose(0, 2, 1)
        hat[here] += np.einsum("kzi,ki->kz", white, passage.white[(ks + age)[inside]])
        variance[here] -= np.sum(white**2, axis=2)
        seen[inside] -= white @ shown[at]
        w[inside] = w[inside] @ model.A.T - rows @ K[at].transpose(0, 2, 1)
    for i, k in enumerate(ks.tolist()):
        moment = passage.moments.get(k)
        if moment is not None and moment.found is not None:
            found = founds[i]
            assert found is not None  # noqa: S101
            hat[k] += seen[i] @ found.value
            variance[k] += found.added(seen[i])


def _last_found(passage: Passage, k: int) -> KnownParameters | None:
    """Return what is known of delta at a sample."""
    moment = passage.moments.get(k)
    return passage.found if moment is None or moment.found is None else moment.found
