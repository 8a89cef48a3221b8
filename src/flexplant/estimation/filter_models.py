"""The model of a filter with its noises, and the errors of a gain on it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..arrays import FloatArray, IntArray
from ..errors import SolverError
from ..lti.equations import solve_stein, square_root
from ..plant import AnyPlant
from ..store import Value
from .estimator_channels import poi_channels, sensors
from .left_out_modes import LeftOut

#: error text where a covariance cannot be followed sample by sample
FEW_DIGITS = (
    "the noise of the sensors is so small compared with the motion that the covariance of the "
    "error does not give the filter's gain in double precision: deviations of single samples, "
    "delayed and smoothed estimates cannot be computed. The filter itself is correct: run it by "
    "observer.system, "
    "observer.step or close_loop; or give the sensors the asd of their data sheet, checking units."
)

#: entry of a certificate: number of truncated modes
LEFT_OUT = "truncated modes"


@dataclass(frozen=True, eq=False, repr=False)
class FilterModel(Value):
    """The plant model and the noise covariances of a Kalman filter.

    ::

        x[k+1] = A x[k] + B u[k] + G xi[k]            [G xi]   [Q  0  S]
        z[k]   = C1 x[k] + D1 u[k] + n[k]         cov [  n ] = [0  V  N]
        y[k]   = C2 x[k] + D2 u[k] + H xi[k]          [H xi]   [S' N' R]

    The noises xi[k] and n[k] are independent from sample to sample. The matrices ``Q = G G'``,
    ``R = H H'`` and ``S = G H'`` follow from G and H. In the methods, x[k|j] is the estimate of the
    state at sample k from the measurements up to sample j. An innovation is a measurement minus its
    prediction.

    Parameters
    ----------
    A, B, C1, D1, C2, D2 : arrays
        Model from the commands u to the motions z at the POIs and to the sensors y.
    G : (n, r) array
        Gain from xi, white noises of unit variance, to the state x of the next sample. It
        represents the effect of the disturbances on the states.
    H : (ny, r) array
        Gain from xi to the sensors. It represents the noise of the sensors and the motion of
        truncated modes, which counts as noise. Disturbances that are held constant over each sample
        are included as well, because an acceleration sensor responds to them at once.
    V : (nz, nz) array
        Covariance of n, the motion of truncated modes at the POIs.
    N : (nz, ny) array
        Covariance between n and the noise of the sensors.
    dt : float [s]
        Sampling time.
    channels, sensors, commands : tuples of str
        Names of z, y and u.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.design_kalman(fx.testbeds.three_masses()).model
    >>> model.sensors, model.commands, model.A.shape
    (('y1', 'y2'), ('u1',), (7, 7))
    """

    A: FloatArray
    B: FloatArray
    C1: FloatArray
    D1: FloatArray
    C2: FloatArray
    D2: FloatArray
    G: FloatArray
    H: FloatArray
    V: FloatArray
    N: FloatArray
    dt: float
    channels: tuple[str, ...]
    sensors: tuple[str, ...]
    commands: tuple[str, ...]

    @cached_property
    def Q(self) -> FloatArray:
        """Covariance (n, n) of the effect of disturbances on x in one sample."""
        return self.G @ self.G.T

    @cached_property
    def R(self) -> FloatArray:
        """Covariance (ny, ny) of the noise at the sensors in one sample."""
        return self.H @ self.H.T

    @cached_property
    def S(self) -> FloatArray:
        """Covariance (n, ny) between the noises of process and sensors."""
        return self.G @ self.H.T

    def scaled(self, d: FloatArray, s: FloatArray) -> FilterModel:
        """Return the model with states x / d and measurements y / s.

        Parameters
        ----------
        d : (n,) array
            Unit of each new state.
        s : (ny,) array
            Unit of each new measurement.
        """
        return self.replace(
            A=self.A * d / d[:, None],
            B=self.B / d[:, None],
            C1=self.C1 * d,
            C2=self.C2 * d / s[:, None],
            D2=self.D2 / s[:, None],
            G=self.G / d[:, None],
            H=self.H / s[:, None],
            N=self.N / s,
        )

    def innovation(self, P: FloatArray) -> FloatArray:
        """Return the covariance ``C2 P C2' + R`` of the innovations.

        Parameters
        ----------
        P : (n, n) array
            Covariance of the error of x[k|k-1].
        """
        return np.asarray(self.C2 @ P @ self.C2.T + self.R)

    def updated(self, P: FloatArray, gain: FloatArray) -> FloatArray:
        """Return the covariance of the error of x[k|k] for any gain L, by Joseph's form.

        Parameters
        ----------
        P : (n, n) array
            Covariance of the error of x[k|k-1].
        gain : (n, ny) array
            Gain L of the innovations.
        """
        left = np.eye(P.shape[0]) - gain @ self.C2
        updated = left @ P @ left.T + gain @ self.R @ gain.T
        return np.asarray(0.5 * (updated + updated.T))

    def driven(self, gain: FloatArray) -> FloatArray:
        """Return the covariance ``(G - K H)(G - K H)'`` that one sample adds to the error.

        Parameters
        ----------
        gain : (n, ny) array
            Predictor gain K, from the innovation to x[k+1|k].
        """
        entering = self.G - gain @ self.H
        return entering @ entering.T


def weigh(part: FloatArray, spread: FloatArray) -> FloatArray:
    """Return ``part S^-1`` of a covariance S, its channels of unit size inside."""
    size = np.sqrt(spread.diagonal())
    try:
        weighed = np.linalg.solve(spread / size / size[:, None], (part / size).T)
    except np.linalg.LinAlgError as error:
        raise SolverError(FEW_DIGITS) from error
    return np.asarray(weighed.T / size)


def filter_model(plant: AnyPlant, found: LeftOut | None = None) -> FilterModel:
    """Return the model of a sampled plant, with known truncated modes as noise."""
    own = plant if found is None else found.plant
    g = own.system
    y, z = sensors(own), poi_channels(own)
    toward, at = g.select(y, own.u), g.select(z, own.u)
    rows = [own.y.index(name) for name in y]
    H = [own.noise_direct[rows], own.sensor_noise_factor[rows]]
    V, N = np.zeros((len(z), len(z))), np.zeros((len(z), len(y)))
    if found is not None:
        H, V, N = [*H, square_root(found.sensors)], found.pois, found.cross
    silent = [np.zeros((g.n_states, part.shape[1])) for part in H[1:]]
    return FilterModel(
        g.A, toward.B, at.C, at.D, toward.C, toward.D, np.hstack([own.noise_factor, *silent]),
        np.hstack(H), V, N, own.dt, z, y, tuple(own.u),
    )  # fmt: skip


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


def innovation_root(S: FloatArray) -> FloatArray:
    """Return the Cholesky factors of covariances (..., ny, ny) of innovations."""
    try:
        return np.asarray(np.linalg.cholesky(0.5 * (S + np.swapaxes(S, -1, -2))))
    except np.linalg.LinAlgError:
        raise SolverError(FEW_DIGITS) from None


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
