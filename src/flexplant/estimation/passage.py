"""A filter applied to a record: sample by sample while its gain changes, then in blocks."""

from __future__ import annotations

from functools import cached_property
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csgraph

from ..arrays import BoolArray, FloatArray, IntArray, floats, real_array
from ..errors import LabelError, ModelError, ShapeError, short, unknown_label
from ..lti.equations import solve_stein, sylvester
from ..lti.response_solvers import Recursion
from ..parallel import PIECE
from ..tolerances import FOUR_DIGITS, RESIDUAL, ROUNDING, TYPED
from .filter_models import FilterModel, innovation_root
from .steady_filter import FilterGains, Sight, Steady, filter_gains

#: number of samples between two tests of stationarity
_LOOK = 16
#: relative distance of a covariance from its limit at which it counts as stationary
STATIONARY = TYPED


class Moment(NamedTuple):
    """Data of a sample with a gain that was not stationary, for a later pass."""

    gains: FilterGains
    T: FloatArray  # (nz, n), effect of the next adjoint on the estimate
    shown: FloatArray  # (ny, r), effect of delta on the whitened innovation
    seen: FloatArray  # (nz, r), effect of delta on the estimate
    hat: FloatArray  # (nz,), for delta = 0
    variance: FloatArray  # (nz,), for delta known
    found: KnownParameters | None


class Walk:
    """The filter on one record; its arrays are filled sample by sample.

    `hat` and `variance` (N, nz) are of the estimates, `white` (N, ny) whitened innovations for
    delta = 0, zeros where missing. `innovations`, their `deviation` and `whitened` (N, ny) are NaN
    where a sample is missing or not predicted yet.
    """

    def __init__(
        self,
        steady: Steady,
        record: Recorded,
        s: FloatArray,
        sight: Sight,
        *,
        predict: bool,
        keep: bool,
        gate: float,
    ) -> None:
        self.s, self.gate = s, gate
        self.steady, self.model, self.sight = steady, steady.model, sight
        self.predict, self.keep = predict, keep
        both, self.there = record.both, np.asarray(np.isfinite(record.y))
        if not self.there.all():
            both = both.copy()
            both[:, : record.ny][~self.there] = 0.0
        self.gated = np.zeros(record.y.shape if gate < np.inf else (0, record.ny), dtype=bool)
        self.whole = np.asarray(np.all(self.there, axis=1))
        self.gaps = np.flatnonzero(~self.whole)
        self.both, self.y, self.u = both, both[:, : record.ny], record.u
        (N, ny), nz = record.y.shape, sight.c.shape[1]
        # channel by channel in memory, so that the estimate stores them without a copy
        self.hat, self.variance = (np.empty((nz, N)).T for _ in range(2))
        self.white = np.zeros((N, ny) if keep else (0, ny))
        self.innovations, self.deviation, self.whitened = (np.empty((ny, N)).T for _ in range(3))
        self.moments: dict[int, Moment] = {}
        self.found: KnownParameters | None = None

    def done(self, start: Start | FloatArray) -> Walk:
        """Filter from a start to the end of the record."""
        N, whole = self.y.shape[0], self.whole
        #: first sample, last + 1, and whether the gain was stationary
        self.stretches: list[tuple[int, int, bool]] = []
        if isinstance(start, Start):
            x, P, Z = np.zeros(start.P.shape[0]), start.P, start.Z
            k, settled = 0, False
        else:
            x, P, Z = start, self.steady.P, np.zeros((start.size, 0))
            k, settled = 0, True
        unknowns = Unknowns(Z.shape[1])
        while k < N:
            first = k
            if settled and whole[k]:
                k, x = self._screened(first, self._until(k), x)
                P = self.steady.P
                if k > first:
                    self.stretches.append((first, k, True))
                continue
            settled = False
            while k < N and not settled:
                x, P, Z = self._step(k, x, P, Z, unknowns)
                k += 1
                if k < N and whole[k] and (k - first) % _LOOK == 0:
                    settled, x, Z = self._settled(x, P, Z)
                    found, Y = self.found if Z.shape[1] else None, None
                    if not settled and not self.keep:
                        Y = excess(self.steady, self._weight[0], P, Z, found)
                    if Y is not None:
                        x = x + Z @ found.value if found else x
                        Z = Z[:, :0]
                        k, x, P, settled = self._fading(k, self._until(k), x, Y)
            self.stretches.append((first, k, False))
        if Z.shape[1] and self.found is not None:
            x = x + Z @ self.found.value
        self.state = x  # x[N|N-1]
        return self

    def _until(self, k: int) -> int:
        """Return the first sample from k on in which one is missing, or the end."""
        later = np.searchsorted(self.gaps, k)
        return int(self.gaps[later]) if later < self.gaps.size else self.whole.size

    def _drop(self, k: int, beyond: BoolArray) -> None:
        """Treat samples of some sensors as missing from now on."""
        self.gated[k] |= beyond
        self.there[k] &= ~beyond
        self.whole[k] = False
        self.gaps = np.union1d(self.gaps, [k])

    def _dropped(self, first: int, last: int) -> int:
        """Return the first of some samples that the gate makes missing, or their end."""
        if not np.isfinite(self.gate):
            return last
        at = slice(first, last)
        beyond = np.abs(self.innovations[at]) > self.gate * self.deviation[at]
        hit = np.flatnonzero(np.any(beyond, axis=1))
        if not hit.size:
            return last
        self._drop(first + int(hit[0]), beyond[hit[0]])
        return first + int(hit[0])

    def _screened(self, k: int, until: int, x: FloatArray) -> tuple[int, FloatArray]:
        """Run the stationary filter up to a sample, or to the first that the gate drops."""
        # later samples are filtered again after it is dropped
        length = until - k if not np.isfinite(self.gate) else LONGEST
        while k < until:
            end = min(k + length, until)
            after = self._steadily(k, end, x)
            cut = self._dropped(k, end)
            if cut < end:
                return cut, self._steadily(k, cut, x) if cut > k else x
            k, x = end, after
        return k, x

    def _step(
        self, k: int, x: FloatArray, P: FloatArray, Z: FloatArray, unknowns: Unknowns
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        m, C = self.model, self.model.C2 @ Z
        before = self.found if Z.shape[1] else None
        e = self.y[k] / self.s - m.C2 @ x - m.D2 @ self.u[k]
        self._innovate(k, e, m.innovation(P), C, before)
        there = self.there[k]
        e = np.where(there, e, 0.0)
        g = filter_gains(m, P, there)
        here = self.sight.part(slice(k, k + 1))
        c = here.c[0]
        enter = self.steady.entering(g, predict=self.predict)
        n = x.size
        hat = c[:, :n] @ x + c @ (enter @ e) + here.D1[0] @ self.u[k]
        variance = self.steady.variances(here, P, g, predict=self.predict)[0]
        white = g.W @ e
        if self.keep:
            self.white[k] = white
        shown, seen = g.W @ C, c[:, :n] @ Z - c @ (enter @ (C * there[:, None]))
        self.hat[k], self.variance[k] = hat, variance
        if Z.shape[1]:
            unknowns.add(shown, white)
            after = unknowns.found()
            used = before if self.predict else after
            self.found = after
            if used is None:
                used = KnownParameters(
                    np.zeros(Z.shape[1]), np.zeros((Z.shape[1], 0)), np.eye(Z.shape[1])
                )
            self.hat[k] += seen @ used.value
            self.variance[k] += used.added(seen)
            self.hat[k][np.isinf(self.variance[k])] = np.nan
        if self.keep:
            T = c @ self.steady.onward(P, g)
            self.moments[k] = Moment(
                g, T, shown, seen, hat, variance, self.found if Z.shape[1] else None
            )
        closed = m.A - g.K @ m.C2
        x = m.A @ x + m.B @ self.u[k] + g.K @ e
        P = closed @ P @ closed.T + m.driven(g.K)
        return x, 0.5 * (P + P.T), closed @ Z

    def _innovate(
        self, k: int, e: FloatArray, S: FloatArray, C: FloatArray, found: KnownParameters | None
    ) -> None:
        """Record the innovation with the knowledge of delta before the measurement; gate it."""
        there = self.there[k]
        self.innovations[k] = self.deviation[k] = self.whitened[k] = np.nan
        if C.shape[1]:
            if found is None:
                return
            known = there & np.isfinite(found.added(C))
            e = e - C @ found.value
            S = S + (C @ found.X) @ (C @ found.X).T
        else:
            known = there.copy()
        size = np.sqrt(S.diagonal())
        beyond = known & (np.abs(e) > self.gate * size)
        if np.any(beyond):
            self._drop(k, beyond)  # from `there` as well
            known &= ~beyond
        self.innovations[k, known] = (self.s * e)[known]
        self.deviation[k, known] = (self.s * size)[known]
        if np.any(known) and np.all(known == there):
            at = np.flatnonzero(known)
            root = innovation_root(S[np.ix_(at, at)])
            self.whitened[k, at] = np.linalg.solve(root, e[at])

    def _settled(
        self, x: FloatArray, P: FloatArray, Z: FloatArray
    ) -> tuple[bool, FloatArray, FloatArray]:
        """Return whether the gain is stationary; delta then becomes part of x."""
        weight, size = self._weight
        if Z.shape[1]:
            assert self.found is not None  # noqa: S101
            X = Z @ self.found.X
            # a backward pass changes delta by the root of its remainder here
            left = STATIONARY * (1e-8 if self.keep else 1.0)
            if self.found.open.size or np.sum((weight @ X) * X) > left:
                return False, x, Z
            x, Z = x + Z @ self.found.value, Z[:, :0]
        excess = float(np.sum(weight * (P - self.steady.P)))
        # compared with the rounding of both covariances
        return abs(excess) < STATIONARY + 1e-13 * size, x, Z

    @cached_property
    def _weight(self) -> tuple[FloatArray, float]:
        weight = self.steady.weight(self.sight)
        return weight, float(np.sum(np.abs(weight) * np.abs(self.steady.P)))

    def _fading(
        self, k: int, until: int, x: FloatArray, Y: FloatArray
    ) -> tuple[int, FloatArray, FloatArray, bool]:
        """Continue in blocks from ``x + Y eta`` until eta no longer matters, or to a gap.

        Returns the sample after it, state and covariance there, and whether it is stationary.
        """
        m, g = self.model, self.steady.gains
        length = FIRST
        while k < until and Y.shape[1]:
            at = slice(k, min(k + length, until))
            count, first = at.stop - k, x
            x = self._steadily(at.start, at.stop, x)
            # F^k Y for k = 0 .. count
            moved = np.array([*accumulate(range(count), lambda Z, _: self.steady.F @ Z, initial=Y)])
            C = m.C2 @ moved[:-1]
            found = shown_so_far(g.W @ C, self.whitened[at])
            before, after = found.value[:-1], found.value[1:]
            here, into = self.sight.part(at), self.steady.entering(g, predict=self.predict)
            enter = (here.c[:, :, : x.size] - here.c @ into @ m.C2) @ moved[:-1]
            value, covariance = (before, found.covariance[:-1])
            if not self.predict:
                value, covariance = after, found.covariance[1:]
            self.hat[at] += np.einsum("kzr,kr->kz", enter, value)
            self.variance[at] += np.sum((enter @ covariance) * enter, axis=2)
            e = self.innovations[at] / self.s - np.einsum("kyr,kr->ky", C, before)
            S = m.innovation(self.steady.P) + C @ found.covariance[:-1] @ C.transpose(0, 2, 1)
            self.innovations[at] = e * self.s
            self.deviation[at] = self.s * np.sqrt(np.diagonal(S, axis1=1, axis2=2))
            self.whitened[at] = np.linalg.solve(innovation_root(S), e[:, :, None])[:, :, 0]
            cut = self._dropped(k, at.stop)
            if cut < at.stop:  # the block up to there again, unless it is its first sample
                x, until = first, cut
                continue
            x = x + moved[-1] @ found.value[-1]
            Y = moved[-1] @ np.linalg.cholesky(found.covariance[-1])
            Y = lasting_part(self._weight[0], Y)
            k, length = at.stop, min(2 * length, LONGEST)
        return k, x, self.steady.P + Y @ Y.T, not Y.shape[1]

    def _steadily(self, first: int, last: int, x: FloatArray) -> FloatArray:
        """Fill a stretch of the stationary filter and return the state after it."""
        m, g, at = self.model, self.steady.gains, slice(first, last)
        here, n = self.sight.part(at), x.size
        enter = self.steady.entering(g, predict=self.predict)
        ny = enter.shape[1]
        fixed = here.c.shape[0] == 1
        see = here.c[0] if fixed else np.eye(n + ny)
        direct = see @ enter
        moved = np.zeros((see.shape[0], self.u.shape[1])) if not fixed else here.D1[0]
        system = Recursion(
            self.steady.F,
            np.hstack([g.K / self.s, m.B - g.K @ m.D2]),
            np.vstack([see[:, :n] - direct @ m.C2, -m.C2 * self.s[:, None]]),
            np.block([
                [direct / self.s, moved - direct @ m.D2],
                [np.eye(ny), -m.D2 * self.s[:, None]],
            ]),
        )  # fmt: skip
        whiten = (g.W / self.s).T
        for piece, out, state in system.pieces(self.both[at], x):
            now, x = slice(first + piece.start, first + piece.stop), state
            e = out[:, -ny:]
            watched = out[:, :-ny]
            if not fixed:
                watched = here.part(piece).applied(watched, self.u[now])
            self.hat[now], self.innovations[now] = watched, e
            white = e @ whiten
            self.whitened[now] = white
            if self.keep:
                self.white[now] = white
        self.variance[at] = self.steady.variances(here, self.steady.P, g, predict=self.predict)
        self.deviation[at] = self.s * np.sqrt(m.innovation(self.steady.P).diagonal())
        return x


#: number of samples of the first and of the longest stretch; it doubles each time
FIRST, LONGEST = 64, 1024


class ShownSoFar(NamedTuple):
    """Knowledge of eta before the first and after each measurement of a stretch."""

    value: FloatArray  # (k + 1, r)
    covariance: FloatArray  # (k + 1, r, r)


def excess(
    steady: Steady, weight: FloatArray, P: FloatArray, Z: FloatArray, found: KnownParameters | None
) -> FloatArray | None:
    """Return Y (n, r) with ``P_k = P + Y Y'``, P_k the covariance now and P the stationary one."""
    # the filter of any first covariance P_k above the stationary P is the stationary filter of a
    # first state `x + Y eta`, eta of zero mean and unit covariance, whose innovations `e = C F^k Y
    # eta + white noise` give eta by least squares: the partitioned filter. None where P_k is not
    # above P, or is so large that digits would be lost. [Lainiotis1975]_
    more = P - steady.P
    if Z.shape[1]:
        if found is None or found.open.size:
            return None
        X = Z @ found.X
        if np.any(np.sum(X**2, axis=1) > (1.0 / FOUR_DIGITS) * steady.P.diagonal().max()):
            return None
        more = more + X @ X.T
    sizes, vectors = np.linalg.eigh(0.5 * (more + more.T))
    below = vectors[:, sizes < 0] * np.sqrt(-sizes[sizes < 0])
    # compared with the rounding of the terms
    if np.sum((weight @ below) * below) > ROUNDING + 1e-13 * np.sum(np.abs(weight * steady.P)):
        return None
    return lasting_part(weight, vectors[:, sizes > 0] * np.sqrt(sizes[sizes > 0]))


def lasting_part(weight: FloatArray, Y: FloatArray) -> FloatArray:
    """Return the combinations of columns of Y that still matter to later estimates."""
    sizes, mix = np.linalg.eigh(Y.T @ weight @ Y)
    gone = np.cumsum(np.maximum(sizes, 0.0)) < ROUNDING
    return np.asarray(Y @ mix[:, ~gone])


def shown_so_far(rows: FloatArray, white: FloatArray) -> ShownSoFar:
    """Return the estimate of eta from whitened innovations ``white = rows eta + noise`` (k, ny)."""
    count, _, r = rows.shape
    information, values = np.zeros((count + 1, r, r)), np.zeros((count + 1, r))
    information[0] = np.eye(r)
    np.matmul(rows.transpose(0, 2, 1), rows, out=information[1:])
    values[1:] = np.einsum("kyr,ky->kr", rows, white)
    covariance = np.linalg.inv(np.cumsum(information, axis=0))
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    return ShownSoFar(np.einsum("krs,ks->kr", covariance, np.cumsum(values, axis=0)), covariance)


class KnownParameters(NamedTuple):
    """Knowledge of the parameters delta: their value, and covariance ``X X'``.

    The columns of `open` are directions that no measurement has shown yet.
    """

    value: FloatArray
    X: FloatArray
    open: FloatArray

    def added(self, rows: FloatArray) -> FloatArray:
        """Return the variance (p,) that delta adds where it enters by rows (p, r)."""
        variance = np.sum((rows @ self.X) ** 2, axis=1)
        missed = np.linalg.norm(rows @ self.open, axis=1)
        # the root of rounding, since an unknown motion enters squared
        return np.where(missed > 1e-8 * np.linalg.norm(rows, axis=1), np.inf, variance)


class Unknowns:
    """The least-squares problem of delta, in triangular form (square root of its information)."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.root = np.zeros((0, count + 1))

    def add(self, rows: FloatArray, values: FloatArray) -> None:
        """Add measurements ``values = rows delta + noise`` of unit variance."""
        both = np.vstack([self.root, np.column_stack([rows, values])])
        self.root = np.asarray(np.linalg.qr(both, mode="r"))

    def found(self) -> KnownParameters:
        """Return the present knowledge."""
        R = self.root[: self.count, : self.count]
        U, sizes, V = np.linalg.svd(R, full_matrices=True)
        rank = int(np.count_nonzero(sizes > RESIDUAL * np.max(sizes, initial=0.0)))
        X = V[:rank].T / sizes[:rank]
        value = X @ (U[:, :rank].T @ self.root[: self.count, self.count])
        return KnownParameters(value, X, V[rank:].T)


class Start(NamedTuple):
    """A first state ``x = Z delta + x'``: delta (r,) is unknown, x' has covariance P."""

    P: FloatArray
    Z: FloatArray


def stationary_start(model: FilterModel) -> Start:
    """Return the state before a record of a machine that ran for a long time, with u = 0."""
    # modes that are damped have the covariance of their stationary motion, `P = A P A' + Q`. Modes
    # on or outside the unit circle (rigid bodies, undamped ones) have none: their states x_r are
    # unknown parameters delta, without any prior. Others that follow them (such as late outputs) do
    # so with the states V x_r, `A_e V - V A_r = -A_er`, so that the rest `x' = x - V x_r` is
    # stationary
    n = model.A.shape[0]
    kept = kept_states(model.A)
    rest = np.setdiff1d(np.arange(n), kept)
    P, Z = np.zeros((n, n)), np.zeros((n, kept.size))
    Z[kept, np.arange(kept.size)] = 1.0
    A, Q = model.A[np.ix_(rest, rest)], model.Q[np.ix_(rest, rest)]
    entering = model.A[np.ix_(rest, kept)]
    if np.any(entering):
        V = sylvester(A, model.A[np.ix_(kept, kept)], entering)
        Z[rest] = V
        A = A - V @ model.A[np.ix_(kept, rest)]
        left = np.zeros((rest.size, n))
        left[:, rest], left[:, kept] = np.eye(rest.size), -V
        Q = left @ model.Q @ left.T
    P[np.ix_(rest, rest)] = solve_stein(A, 0.5 * (Q + Q.T))
    return Start(P, Z)


def kept_states(A: FloatArray) -> IntArray:
    """Return the states of modes on or outside the unit circle."""
    # judged on the parts of A that are coupled both ways, so that the two eigenvalues 1 of a
    # rigid-body mode are exact
    count, owner = csgraph.connected_components(A != 0, directed=True, connection="strong")
    kept = []
    for part in range(count):
        states = np.flatnonzero(owner == part)
        radius = np.max(np.abs(np.linalg.eigvals(A[np.ix_(states, states)])))
        if radius >= (1.0 - ROUNDING):
            kept.append(states)
    return np.sort(np.concatenate(kept)) if kept else np.zeros(0, dtype=np.int64)


class Recorded(NamedTuple):
    """A record: time (N,), measurements y with NaN where missing, and commands u.

    `both` is [y u] (N, ny + nu).
    """

    time: FloatArray
    both: FloatArray
    ny: int

    @property
    def y(self) -> FloatArray:
        """Measurements (N, ny)."""
        return self.both[:, : self.ny]

    @property
    def u(self) -> FloatArray:
        """Commands (N, nu)."""
        return self.both[:, self.ny :]


def recorded(records: Any, model: Any) -> Recorded:
    """Return the sensors and commands of a filter's model from what was recorded."""
    if not hasattr(records, "keys") or not hasattr(records, "__getitem__"):
        raise ModelError(
            f"records must give channels by name, got {short(records)}. Pass a Response, a data "
            "frame, or a mapping such as {'y1': array, 'u1': array}."
        )
    known = [str(name) for name in records.keys()]  # noqa: SIM118 - a data frame iterates so too
    for name in (*model.sensors, *model.commands):
        if name not in known:
            missing = unknown_label("channel", name, known, "the records")
            what = (
                "A sensor that was not recorded is an array of NaN"
                if name in model.sensors
                else "A command that was not given is an array of zeros"
            )
            raise LabelError(f"{missing} {what}: the filter needs all of its channels.")
    names = (*model.sensors, *model.commands)
    parts = [_run_values(records[n], n, missing=n in model.sensors) for n in names]
    sizes = {name: part.size for name, part in zip(names, parts, strict=True)}
    if len(set(sizes.values())) > 1:
        raise ShapeError(
            f"channels of one record have one length, got {short(sizes)}. Cut them to the same "
            "samples, or fill what is missing of a sensor with NaN."
        )
    count, ny = parts[0].size, len(model.sensors)
    if not count:
        raise ShapeError("the record is empty: give at least one sample.")
    both = np.empty((count, len(parts)))
    for first in range(0, count, PIECE):  # a piece of all columns stays in the cache
        piece = slice(first, first + PIECE)
        for i, part in enumerate(parts):
            both[piece, i] = part[piece]
    return Recorded(_time(records, known, count, model.dt), both, ny)


def _run_values(values: Any, name: str, *, missing: bool) -> FloatArray:
    array = floats(values, f"channel {name!r}")
    if array.ndim != 1:
        raise ShapeError(
            f"channel {name!r} must be (N,), one run over time, got {array.shape}. Of several runs "
            "take one: response.replace(data=response.data[0])."
        )
    if missing and not np.any(np.isinf(array)):
        return array
    return real_array(values, f"channel {name!r}")


def _time(records: Any, known: list[str], count: int, dt: float) -> FloatArray:
    """Return the times, which must be in steps of dt."""
    given = records["time"] if "time" in known else getattr(records, "time", None)
    if given is None or callable(given):
        return np.asarray(dt * np.arange(count))
    time = real_array(given, "time", (count,))
    steps = np.diff(time)
    if steps.size and np.max(np.abs(steps - dt)) > 1e-3 * dt:  # clocks of recorders
        k = int(np.argmax(np.abs(steps - dt)))
        raise ModelError(
            f"the record goes from {time[k]:.9g} to {time[k + 1]:.9g} s in one sample, the samples "
            f"of the filter are {dt:.9g} s apart. Design it at the rate of the record, and put NaN "
            "in the place of samples that were lost."
        )
    return time
