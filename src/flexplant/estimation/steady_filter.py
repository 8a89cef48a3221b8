"""The stationary filter of a model, what it shows of POIs, and which estimates are asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np

from ..arrays import FloatArray, IntArray, whole
from ..lti.equations import solve_stein
from ..store import Value, checked
from .filter_models import FilterModel, innovation_root


class Sight(NamedTuple):
    """Effect of state and noise on the POIs: ``z = C1 x + n + D1 u``, rows c = [C1 N].

    The first axis has one entry, or one for each sample where POIs move.
    """

    c: FloatArray  # (1 or N, nz, n + ny)
    D1: FloatArray  # (1 or N, nz, nu)
    V: FloatArray  # (1 or N, nz) variances of n

    def part(self, at: slice | IntArray) -> Sight:
        """Return the rows at some samples."""
        return self if self.c.shape[0] == 1 else Sight(*(part[at] for part in self))

    def applied(self, watched: FloatArray, u: FloatArray | None = None) -> FloatArray:
        """Return ``c watched + D1 u`` (k, nz) for watched [x; b] (k, n + ny) of moving POIs."""
        found = np.einsum("kzi,ki->kz", self.c, watched)
        return np.asarray(found if u is None else found + np.einsum("kzi,ki->kz", self.D1, u))


class FilterGains(NamedTuple):
    """L, K and the whitening W of the innovations, zeros at sensors that are missing."""

    L: FloatArray
    K: FloatArray
    W: FloatArray


def filter_gains(model: FilterModel, P: FloatArray, seen: FloatArray) -> FilterGains:
    """Return the gains of a covariance P before the measurement, for available sensors."""
    M = P @ model.C2.T
    S = model.C2 @ M + model.R
    W = np.zeros_like(S)
    there = np.flatnonzero(seen)
    if there.size:
        at, size = np.ix_(there, there), np.sqrt(S.diagonal()[there])
        W[at] = np.linalg.inv(innovation_root(S[at] / size / size[:, None])) / size
    weight = W.T @ W
    L = M @ weight
    return FilterGains(L, model.A @ L + model.S @ weight, W)


class Steady:
    """The stationary filter of a model in states and sensors of unit variance."""

    def __init__(self, model: FilterModel, P: FloatArray) -> None:
        self.model, self.P = model, P
        self.gains = filter_gains(model, P, np.ones(model.C2.shape[0], dtype=bool))
        self.F = model.A - self.gains.K @ model.C2

    def variances(
        self, sight: Sight, P: FloatArray, g: FilterGains, *, predict: bool
    ) -> FloatArray:
        """Return the variances (1 or k, nz) of the estimates of a covariance P and its gains."""
        # `(C1 - L_z C2) P (C1 - L_z C2)' + V - L_z N' - N L_z' + L_z R L_z'`: Joseph's form
        m, n = self.model, P.shape[0]
        C1, N = sight.c[:, :, :n], sight.c[:, :, n:]
        L_z = sight.c @ self.entering(g, predict=predict)
        left = C1 - L_z @ m.C2
        own = np.sum((left @ P) * left, axis=2)
        return np.asarray(own + sight.V + np.sum((L_z @ m.R - 2.0 * N) * L_z, axis=2))

    def entering(self, g: FilterGains, *, predict: bool) -> FloatArray:
        """Return how an innovation enters [x; b] (n + ny, ny)."""
        both = np.vstack([g.L, g.W.T @ g.W])
        return np.zeros_like(both) if predict else both

    def onward(self, P: FloatArray, g: FilterGains) -> FloatArray:
        """Return the rows (n + ny, n) by which a later adjoint enters [x; b]."""
        closed = self.model.A - g.K @ self.model.C2
        return np.vstack([P @ closed.T, -g.K.T])

    def weight(self, sight: Sight) -> FloatArray:
        """Return Y: ``trace(Y dP)`` is what dP adds to all later variances, relative to them."""
        n = self.model.A.shape[0]
        some = np.unique(np.linspace(0, sight.c.shape[0] - 1, 50).astype(np.int64))
        chosen = Sight(*(part[some] for part in sight))
        size = np.sqrt(self.variances(chosen, self.P, self.gains, predict=False))
        rows = (chosen.c[:, :, :n] / size[:, :, None] / np.sqrt(some.size)).reshape(-1, n)
        H = np.vstack([self.gains.W @ self.model.C2, rows])
        return solve_stein(self.F.T, H.T @ H)


@dataclass(frozen=True, eq=False)
class Predictor(Value):
    """Choice of estimates that use only the measurements before each sample: x[k|k-1].

    Pass it as the argument `lag` of `KalmanEstimator.estimate`.

    The notation x[k|j] means the estimate of the state at sample k from the measurements of the
    samples 0 to j.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.estimation.Predictor()
    Predictor()
    """


@dataclass(frozen=True, eq=False)
class Filter(Value):
    """Choice of estimates that use the measurements up to and including each sample: x[k|k].

    Pass it as the argument `lag` of `KalmanEstimator.estimate`.

    The notation x[k|j] means the estimate of the state at sample k from the measurements of the
    samples 0 to j.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.estimation.Filter()
    Filter()
    """


@dataclass(frozen=True, eq=False)
class FixedLag(Value):
    """Choice of estimates that use the measurements up to some samples later: x[k|k+lag].

    Pass it as the argument `lag` of `KalmanEstimator.estimate`.

    Each estimate is available only after this lag. The notation x[k|j] means the estimate of the
    state at sample k from the measurements of the samples 0 to j.

    Parameters
    ----------
    samples : int
        Lag, at least 1; shorter at the end of a record.

    References
    ----------
    [AndersonMoore1979]_, chapter 7.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.estimation.FixedLag(5)
    FixedLag(samples=5)
    """

    samples: int = field(metadata=checked(whole))


@dataclass(frozen=True, eq=False)
class Smoother(Value):
    """Choice of estimates that use all N samples of the record: x[k|N-1].

    Pass it as the argument `lag` of `KalmanEstimator.estimate`.

    This is the fixed-interval smoother. The notation x[k|j] means the estimate of the state at
    sample k from the measurements of the samples 0 to j.

    References
    ----------
    [AndersonMoore1979]_, chapter 7.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> observer = fx.design_kalman(fx.testbeds.three_masses())
    >>> records = {"y1": np.zeros(50), "y2": np.zeros(50), "u1": np.zeros(50)}
    >>> from flexplant.estimation import Filter, FixedLag, Predictor, Smoother
    >>> lags = (Predictor(), Filter(), FixedLag(5), Smoother())
    >>> found = [observer.estimate(records, lag).deviation("die:hat")[25] for lag in lags]
    >>> found == sorted(found, reverse=True)
    True
    """


#: types of estimates
Lag: TypeAlias = Predictor | Filter | FixedLag | Smoother
