"""Result of an estimator for a record: estimates, their deviations, and innovations.

Those that use later measurements are from the adjoint pass back through the record.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import erfc
from typing import Any

import numpy as np

from ..arrays import BoolArray, FloatArray, IntArray, instance, known_units, real_array
from ..errors import ChannelError, LabelError, SolverError, counted, sizes_of, unknown_label, warn
from ..lti.equations import scale_of, solve_stein
from ..lti.response_solvers import Recursion
from ..parallel import PIECE, one_thread
from ..store import Value
from ..tolerances import TYPED
from .error import estimates, row_of
from .filter_models import FEW_DIGITS, FilterModel, innovation_root
from .passage import STATIONARY, Moment, Start, Walk, recorded, stationary_start
from .steady_filter import Filter, FixedLag, Lag, Predictor, Sight, Smoother, Steady

#: fraction of a sensor's samples above which gated samples are not outliers
_MOST = 0.1


@dataclass(frozen=True, eq=False, repr=False)
class Estimate(Value, Mapping[str, FloatArray]):
    """Estimated motions over a record, by name, with their deviations and the innovations.

    ``result["die:hat"]`` (N,) is an estimate, ``result["y1:innovation"]`` the measurement of y1
    minus its prediction. The result is a Mapping, so that `dict(result)` can be made into a data
    frame. N is the number of samples; nz, ny and nu are the numbers of estimates, sensors and
    commands.

    Parameters
    ----------
    time : (N,) array [s]
        Instants of the samples.
    names : sequence of str
        Names of the estimates.
    data : (nz, N) array [m or rad]
        The estimates; NaN as long as the measurements do not yet determine an estimate.
    deviations : (nz, N) array [m or rad]
        Standard deviations of the errors of the estimates. They hold on the filter's model, in
        which truncated modes count as white noise. Infinite as long as an estimate is not
        determined.
    sensors : sequence of str
        Names of the sensors.
    innovations : (ny, N) array
        Measurements minus their prediction, in the sensors' units; NaN where one is missing or not
        predicted yet.
    innovation_deviations : (ny, N) array
        Standard deviations of the innovations.
    whitened : (ny, N) array
        Whitened innovations ``W e``, where ``W' W`` is the inverse of the covariance of the
        innovations e. They are white noise of unit variance if the model is correct.
    lag : Predictor, Filter, FixedLag or Smoother
        Type of the estimates.
    state : (n,) array
        Prediction of the state for the sample after the record, x[N|N-1], from which
        `estimate(..., start=)` continues with the next record.
    units : mapping {channel: unit}
        Unit of each channel.
    gate : float
        Number of standard deviations above which an innovation was taken for an outlier, so that
        its sample counted as missing. Infinite if no gate was used.
    gated : (ny, N) array of bool
        Whether each sample was rejected by the gate; (ny, 0) without a gate.
    record : (N, ny + nu) array
        Measurements and commands of the record.
    channels : sequence of str
        The POI channels that are estimated, such as `die:z`.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> observer = fx.design_kalman(fx.testbeds.three_masses())
    >>> found = observer.estimate({name: np.zeros(20) for name in ("y1", "y2", "u1")})
    >>> sorted(found)
    ['die:hat', 'y1:innovation', 'y2:innovation']
    """

    time: FloatArray
    names: Sequence[str]
    data: FloatArray
    deviations: FloatArray
    sensors: Sequence[str]
    innovations: FloatArray
    innovation_deviations: FloatArray
    whitened: FloatArray
    lag: Lag
    state: FloatArray
    units: Mapping[str, str] = field(default_factory=dict)
    gate: float = np.inf
    gated: BoolArray = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    record: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    channels: Sequence[str] = ()

    # compared by identity; Mapping's == would compare arrays
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def __repr__(self) -> str:
        missing = int(np.count_nonzero(np.isnan(self.innovations)))
        of = f", {missing} of {counted(self.innovations.size, 'innovation')} missing"
        typical = np.median(self.deviations, axis=1).tolist()
        sizes = sizes_of(dict(zip(self.names, typical, strict=True)), self.units)
        return (
            f"<Estimate by {self.lag!r}: {counted(self.time.size, 'sample')}{of if missing else ''}"
            f";\n  {self._gated()}median deviation {sizes}>"
        )

    def _gated(self) -> str:
        """Return a text of the number of gated samples, and of the number expected by chance."""
        if not np.isfinite(self.gate):
            return ""
        listed = [
            f"{int(count)} of {name}"
            for name, count in zip(self.sensors, self.gated.sum(axis=1), strict=True)
            if count
        ]
        chance = erfc(self.gate / np.sqrt(2.0)) * self.innovations.size
        return (
            f"{counted(int(self.gated.sum()), 'sample')} beyond {self.gate:g} deviations treated "
            f"as missing{': ' if listed else ''}{', '.join(listed)} ({chance:.2g} by chance);\n  "
        )

    def __getitem__(self, channel: str) -> FloatArray:
        side, row = self._found(channel)
        return np.asarray((self.data, self.innovations)[side][row])

    def __iter__(self) -> Iterator[str]:
        yield from self.names
        yield from (f"{name}:innovation" for name in self.sensors)

    def __len__(self) -> int:
        return len(self.names) + len(self.sensors)

    def warn_of_gate(self) -> None:
        """Warn if the gate rejected more samples of a sensor than can be outliers."""
        share = self.gated.mean(axis=1) if self.gated.size else np.zeros(len(self.sensors))
        worst = int(np.argmax(share))
        if share[worst] > max(_MOST, 10 * erfc(self.gate / np.sqrt(2.0))):
            warn(
                f"the gate of {self.gate:g} deviations leaves out {share[worst]:.0%} of the "
                f"samples of {self.sensors[worst]}: these are not outliers, but the model or "
                "noise densities do not match the machine, or a sensor has an offset. Judge the "
                "record without "
                "a gate: flexplant.estimation.consistency."
            )

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        if self.time.size < 2:
            return 0.0
        return float(self.time[-1] - self.time[0]) / (self.time.size - 1)

    def deviation(self, channel: str) -> FloatArray:
        """Return the standard deviation (N,) of an estimate's error, or of an innovation.

        `die`, `die:z`, `die:hat` and `die:error` name the same estimate, as in
        `KalmanEstimator.rms`; `y1:innovation` names an innovation.
        """
        side, row = self._found(channel)
        return np.asarray((self.deviations, self.innovation_deviations)[side][row])

    def _found(self, channel: str) -> tuple[int, int]:
        if channel in self.names:
            return 0, list(self.names).index(channel)
        with suppress(LabelError):
            return 0, row_of(self.channels, channel)
        sensor = channel.removesuffix(":innovation") if isinstance(channel, str) else channel
        if sensor != channel and sensor in self.sensors:
            return 1, list(self.sensors).index(sensor)
        raise ChannelError(str(unknown_label("channel", channel, list(self))))


@one_thread()
def estimated(
    model: FilterModel,
    P: FloatArray,
    K: FloatArray,
    records: Any,
    lag: Any,
    start: Any,
    place: Callable[[int], Sight] | None,
    units: Mapping[str, str],
    gate: float = np.inf,
) -> Estimate:
    """Return the estimate of a record by the filter of a model, stationary covariance P, gain K."""
    # `place` gives the rows of POIs that move, for a number of samples
    instance(
        lag,
        Predictor | Filter | FixedLag | Smoother,
        "lag",
        "Choose for example Filter() or Smoother().",
    )
    record = recorded(records, model)
    steady, sight, d, s = in_unit_states(model, P, K)
    if place is not None:
        moving = place(record.time.size)
        sight = moving._replace(c=moving.c * np.concatenate([d, 1.0 / s]))
    first: Start | FloatArray = (
        stationary_start(steady.model)
        if start is None
        else real_array(start, "start", (d.size,)) / d
    )
    later = isinstance(lag, FixedLag | Smoother)
    walk = Walk(steady, record, s, sight, predict=isinstance(lag, Predictor), keep=later, gate=gate)
    passage = walk.done(first)
    hat, variance = passage.hat, passage.variance
    if isinstance(lag, FixedLag):
        hat, variance = lagged(passage, sight, lag.samples)
    elif later:
        hat, variance = smoothed(passage, sight)
    return Estimate(
        record.time,
        estimates(model.channels),
        _across(hat),
        _across(np.sqrt(np.maximum(variance, 0.0))),
        model.sensors,
        _across(passage.innovations),
        _across(passage.deviation),
        _across(passage.whitened),
        lag,
        passage.state * d,
        known_units(units, estimates(model.channels))
        | {f"{name}:innovation": units[name] for name in model.sensors if name in units},
        gate,
        passage.gated.T,
        record.both,
        model.channels,
    )


def _across(columns: FloatArray) -> FloatArray:
    """Return the transpose as a separate read-only array, which a value stores without a copy."""
    rows = columns.base
    if rows is None or rows.strides != columns.strides[::-1]:
        rows = np.array(columns.T, order="C")
    rows.flags.writeable = False
    return rows


def in_unit_states(
    model: FilterModel, P: FloatArray, K: FloatArray
) -> tuple[Steady, Sight, FloatArray, FloatArray]:
    """Return the stationary filter and the POIs in states x / d and measurements y / s."""
    # covariances are followed from P: SolverError where it has too few digits for the gain K
    d, s = scale_of(P.diagonal()), scale_of(model.innovation(P).diagonal())
    unit = model.scaled(d, s)
    sight = Sight(
        np.hstack([unit.C1, unit.N])[None], unit.D1[None], np.diagonal(unit.V)[None].copy()
    )
    steady = Steady(unit, P / d / d[:, None])
    other = (steady.gains.K - K * s / d[:, None]) @ innovation_root(unit.innovation(steady.P))
    if not np.max(np.abs(other), initial=0.0) <= TYPED:
        raise SolverError(FEW_DIGITS)
    return steady, sight, d, s


def smoothed(passage: Walk, sight: Sight) -> tuple[FloatArray, FloatArray]:
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
    rest = np.zeros((n, 0 if first_seen is None else first_seen.seen.shape[1]))
    for first, last, stationary in reversed(passage.stretches):
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
    passage: Walk,
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
    while k > span[0] and abs(np.sum(weight * (settled - M))) > STATIONARY:
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


def lagged(passage: Walk, sight: Sight, lag: int) -> tuple[FloatArray, FloatArray]:
    """Return estimates and variances (N, nz) from the measurements up to `lag` samples later."""
    # `hat[k|k+l] = hat[k|k] + sum_j T[k] F[k+1]' ... F[k+j-1]' C2' S^-1 e[k+j]`, j = 1 ... l. Where
    # the filter is stationary the sum is `T (r[k] - F'^l r[k+l])` of the adjoint r of `smoothed`
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
    for start in range(0, listed.size, PIECE):
        _smooth_transient(passage, sight, listed[start : start + PIECE], lag, hat, variance)
    hat[np.isinf(variance)] = np.nan
    return hat, variance


def _information(steady: Steady, lag: int) -> FloatArray:
    """Return the information of `lag` measurements, ``sum_j F'^j C2' S^-1 C2 F^j`` over j < lag."""
    C = steady.gains.W @ steady.model.C2
    part, total = C, np.zeros_like(steady.F)
    for _ in range(lag):
        total += part.T @ part
        part = part @ steady.F
    return total


def _smooth_transient(
    passage: Walk, sight: Sight, ks: IntArray, lag: int, hat: FloatArray, variance: FloatArray
) -> None:
    """Fill samples for which the gain is not stationary over the whole lag."""
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
    count = max(one.shown.shape[1] for one in listed)
    shown = np.array([
        one.shown if one.shown.shape[1] else np.zeros((one.shown.shape[0], count)) for one in listed
    ])  # fmt: skip
    seen = np.zeros((ks.size, w.shape[1], count))
    known = [(i, k, passage.moments[k]) for i, k in enumerate(ks.tolist()) if k in passage.moments]
    for i, k, moment in known:
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
    for i, k, moment in known:
        if moment.found is not None:
            later = passage.moments.get(min(k + lag, N - 1))
            found = passage.found if later is None or later.found is None else later.found
            assert found is not None  # noqa: S101
            hat[k] += seen[i] @ found.value
            variance[k] += found.added(seen[i])
