"""The least mean square of POIs' motion: with states known, and under the best controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, positive
from ..errors import CertificateError, SolverError
from ..estimation import design_kalman
from ..estimation.filter_models import sensors
from ..lti.equations import solve_stein, square_root
from ..lti.riccati import control_dare
from ..lti.sampling import held_exactly
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..store import checked
from ..tolerances import TYPED
from .candidates import Port, side_of
from .convex import Quadratic, chosen_rows, measured, quadratic
from .criterion import Criterion, Scorer
from .poi_variance import (
    Named,
    PoiVariance,
    checked_names,
    factors_of,
    measured_rows,
    plain,
    poi_rows,
    pushed,
    pushed_columns,
    structure_part,
    unit_of,
)


@dataclass(frozen=True, eq=False, repr=False)
class MotionAndEffort(Criterion):
    """A mean square of the motion of POIs and of the effort; the base of such criteria."""

    poi: Named = field(default=None, metadata=checked(checked_names, name="POI"))
    axes: Named = field(default=None, metadata=checked(checked_names, name="axis"))
    effort: float = field(default=1e-9, kw_only=True, metadata=checked(positive))

    def check(self, plant: StandardPlant, candidates: Sequence[Port]) -> None:
        """Raise AssumptionError when w does not excite or the axes miss a rigid-body mode."""
        plant.check().require(("excited",), "a stationary controller")
        factors = self.factors(plant)
        parts = []
        for poi in plant.ports.z:
            axes = tuple(axis for axis in poi.axes if poi.channel(axis) in factors)
            parts += [poi.replace(axes=axes)] if axes else []
        seen = plant.ports.replace(z=parts, references=())
        plant.with_ports(seen).check().require(("performance",), f"a controller for {self!r}")

    def unit(self, plant: StandardPlant) -> str:
        """Return the unit of the square root."""
        return unit_of(plant, self.factors(plant))

    def factors(self, plant: StandardPlant) -> dict[str, float]:
        """Return {z channel: factor}."""
        return factors_of(plant, self.poi, self.axes, every=True)

    def _control(self, plant: StandardPlant) -> tuple[FloatArray, ...]:
        """Return A, B, W, the rows of the POI, R, and S and F of the control Riccati equation."""
        A, B, rows = plant.system.A, plant.B2, poi_rows(plant, self.factors(plant))
        R = self.effort**2 * np.eye(B.shape[1])
        found = control_dare(A, B, Q=rows.T @ rows, R=R)
        return A, B, plant.process_noise, rows, R, found.P, found.gain


def confirmed(cost: float, found: float) -> float:
    """Return the cost by Riccati equations, confirmed by that of the loop's covariance."""
    if not abs(found - cost) <= TYPED * abs(cost):
        raise CertificateError(
            f"the loop costs {found:.9g}, its Riccati equations say {cost:.9g}: the problem is "
            "too badly conditioned. Give a larger effort."
        )
    return cost


@dataclass(frozen=True, eq=False, repr=False)
class PoiLqr(MotionAndEffort):
    """Smallest mean square of POI motion and effort with state feedback (LQR), to place actuators.

    The cost is ``min E[sum_a (f_a z_a)^2 + effort^2 |u|^2]`` over all stabilising state feedbacks,
    where z_a is a POI motion, f_a its factor and u the vector of actuator forces. E is the expected
    value for the plant's disturbances. The delay of u is included. More actuators never increase
    the cost. A POI (point of interest) is a point whose motion matters.

    Parameters
    ----------
    poi : str, sequence of str or mapping {name: factor}, optional
        Names of the POIs, with factors if they differ. By default it is all POIs whose first axis
        has the same unit as the first axis of the first POI.
    axes : str, sequence of str or mapping {axis: factor}, optional
        Axes of each POI; by default all of them. A rotation without a factor is multiplied by 1 m.
        Together the axes must observe every rigid-body mode.
    effort : float [m/N]
        Weight of the actuator forces. It is the POI motion that costs as much as a force of 1 N.
        With a small weight, the disturbance is suppressed as far as the structure and the delay
        allow.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Actuator(f"a{i}", at=f"{i}:x", direction="x") for i in (1, 2, 3)]
    >>> fx.place_actuators(plant, candidates, 1, fx.placement.PoiLqr("die")).chosen  # at the POI
    ('a2',)
    """

    sides = "u"

    def __call__(self, plant: StandardPlant) -> float:
        """Return the cost [m^2] on a sampled plant.

        The cost to go by a Riccati equation, checked against the stationary covariance of the
        closed loop of its gain.
        """
        self.check(plant, ())
        plant.check().require(("stabilisable",), "a stationary controller")
        A, B, noise, rows, _, S, F = self._control(plant)
        cost = float(np.sum(S * noise))
        P = solve_stein(A - B @ F, noise)
        seen = np.vstack([rows, self.effort * F])
        found = float(np.einsum("ij,jk,ik->", seen, P, seen))
        return confirmed(cost, found)

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return the cost as a function of the chosen actuators.

        All terms that do not depend on the choice are computed once. A force acts on the motion one
        sample later at the earliest. With a delay of d whole samples, no controller can therefore
        influence the response to a disturbance in the first d + 1 samples. The cost of this
        response is the constant ``sum_{i<=d} |C1 A^i W|^2``, where W W' is the covariance of the
        process noise. The control acts on the state that is predicted d samples ahead. Only a
        fractional delay adds a state for each actuator.
        """
        if not plain(plant, candidates):
            return super().scorer(plant, candidates)
        A, noise, rows = structure_part(plant, self.factors(plant))
        n = A.shape[0]
        whole, fraction = divmod(plant.delay, 1.0)
        constant = float(np.sum((rows @ noise) ** 2))
        for _ in range(int(whole)):
            noise = A @ noise
            constant += float(np.sum((rows @ noise) ** 2))
        if fraction:
            late = held_exactly(pushed(plant, candidates, rows), 1.0 / plant.dt, delay=fraction)
        else:
            B, own = pushed_columns(plant, candidates), plant.system.A[:n, :n]
            late = StateSpace(own, B, rows, np.zeros((len(rows), B.shape[1])), dt=plant.dt)
        # states that a part of a sample adds, a row for each candidate
        each = (late.n_states - n) // max(len(candidates), 1)
        held = np.arange(n, late.n_states).reshape(len(candidates), each)
        S = np.zeros((noise.shape[1], late.n_states))
        S[:, :n] = noise.T
        H, items = late.C.T @ late.C, late.B.T / self.effort
        try:
            return quadratic(late.A, H, S @ late.A.T, items, constant=constant, owned=held)
        except SolverError as error:
            raise SolverError(
                f"{error} The effort of {self.effort:g} m/N may be too small to distinguish gains: "
                "try a larger one."
            ) from error


@dataclass(frozen=True, eq=False, repr=False)
class ClosedLoopH2(MotionAndEffort):
    """Smallest mean square of POI motion and effort in a closed loop with an LQG controller.

    A POI (point of interest) is a point whose motion matters. The cost is the minimum of
    ``E[sum_a (f_a z_a)^2 + effort^2 |u|^2]`` over all stabilising controllers from y to u. Here z_a
    is a POI motion, f_a its factor and u the vector of actuator forces. The minimum is the square
    of an H2 norm. In its formula, S and F are the solution and the state feedback gain of the
    control Riccati equation, W is the covariance of the process noise, P that of the estimation
    error, and B the input matrix::

        J = tr(S W) + tr(F' (effort^2 I + B' S B) F P)

    More sensors or actuators never increase the cost. The cost is never below `PoiLqr`, which
    assumes that the state is known, nor below `PoiVariance`, which assumes unlimited control.

    Parameters
    ----------
    poi, axes : as for `PoiLqr`
    effort : float [m/N]
        Weight of the actuator forces. It is the POI motion that costs as much as a force of 1 N.

    Examples
    --------
    >>> import flexplant as fx
    >>> round(1e9 * fx.placement.ClosedLoopH2("die")(fx.testbeds.three_masses()) ** 0.5, 1)  # nm
    4.2
    """

    def __call__(self, plant: StandardPlant) -> float:
        """Return the cost [m^2] on a sampled plant.

        The cost follows from the formula. It is checked against the stationary covariance of the
        closed loop of Kalman filter and state feedback.
        """
        self.check(plant, ())
        plant.check().require(("stabilisable", "detectable"), "a stationary controller")
        A, B, W, rows, R, S, F = self._control(plant)
        estimator = design_kalman(plant.replace(evaluation=None))
        P, K = estimator.covariance, estimator.gain
        read = [plant.y.index(name) for name in sensors(plant)]  # without references
        C, noise = plant.C2[read], plant.sensor_noise[np.ix_(read, read)]
        V = F.T @ (R + B.T @ S @ B) @ F
        cost = float(np.sum(S * W) + np.sum(V * P))
        # states and the errors of their prediction: u = -F (x - (I - K C) e) + F K noise
        n, seen = A.shape[0], np.eye(A.shape[0]) - K @ C
        loop = np.block([[A - B @ F, B @ F @ seen], [np.zeros((n, n)), A @ seen]])
        push = np.vstack([-B @ F @ K, -A @ K])
        both = np.block([[W, W], [W, W]]) + push @ noise @ push.T
        X = solve_stein(loop, both)
        out = np.block([[rows, np.zeros_like(rows)], [-self.effort * F, self.effort * F @ seen]])
        found = float(np.einsum("ij,jk,ik->", out, X, out))
        found += float(np.sum((self.effort * F @ K) @ noise * (self.effort * F @ K)))
        return confirmed(cost, found)

    def check(self, plant: StandardPlant, candidates: Sequence[Port]) -> None:
        """Raise AssumptionError if a rigid-body mode is missed or no Kalman filter exists."""
        super().check(plant, candidates)
        seeing = [port for port in candidates if side_of(port) == "y"]
        if candidates and not seeing:  # the plant's own are those of the loop
            plant.check().require(("detectable",), "a stationary controller")
        if candidates and len(seeing) == len(candidates):
            plant.check().require(("stabilisable",), "a stationary controller")
        PoiVariance(self.poi).check(plant, seeing)

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return the function from a choice of candidates to its cost.

        Matrices that all choices share are computed once. With a delay of d whole samples the
        control acts on the state predicted d samples ahead, and the motion in these samples is
        added to the cost. With a fractional delay, or ports with filters or delays, the plant is
        assembled again for each choice.
        """
        if plant.delay % 1.0 or not plain(plant, candidates):
            return super().scorer(plant, candidates)
        A, noise, rows = structure_part(plant, self.factors(plant))
        given = {side: [p for p in candidates if side_of(p) == side] for side in "yu"}
        fixed = {side: list(getattr(plant.ports, side)) for side in "yu"}
        problem = Separation(
            A,
            noise,
            rows,
            measured_rows(plant, given["y"] or fixed["y"]),
            pushed_columns(plant, given["u"] or fixed["u"]).T / self.effort,
            int(plant.delay),
            np.array([side_of(port) == "y" for port in candidates]),
        )
        if not given["u"]:
            return of_sensors(problem)
        return of_actuators(problem) if not given["y"] else problem


@dataclass(frozen=True, eq=False)
class Separation(Scorer):
    """``J = tr(S W) + tr(F' (I + b S b') F P_d) + c``: S, F of the actuators, P_d of the sensors.

    P_d is the covariance of the state predicted d samples ahead, ``A^d P A'^d`` and what is added
    meanwhile, P that of the filter.
    """

    A: FloatArray
    noise: FloatArray
    rows: FloatArray
    sensors: FloatArray
    actuators: FloatArray
    delay: int
    measuring: npt.NDArray[np.bool_]
    counts: tuple[int, int] | None = None

    def value(self, chosen: Sequence[int]) -> float:
        """Return the cost of sensors and actuators."""
        seeing, pushing = self._sides(chosen)
        S, V = self.control(pushing)
        return float(np.sum(S * self.W) + np.sum(V * self.ahead(self.covariance(seeing))))

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return the larger of two bounds: with all sensors, and with all actuators."""
        # without numbers of each, the cost with all candidates
        if self.counts is None:
            return self.value(range(self.measuring.size))
        y, u = self._sides(required)
        return max(
            of_sensors(self).bound(self.counts[0], y), of_actuators(self).bound(self.counts[1], u)
        )

    def _sides(self, chosen: Sequence[int]) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return numbers of the sensors among the sensors, and of actuators, of a choice."""
        kept = chosen_rows([chosen], self.measuring.size)[0] > 0
        both = (np.flatnonzero(kept[own]) for own in (self.measuring, ~self.measuring))
        seeing, pushing = (tuple(part.tolist()) for part in both)
        return seeing, pushing

    @property
    def W(self) -> FloatArray:
        """The process noise."""
        return self.noise @ self.noise.T

    def ahead(self, P: FloatArray) -> FloatArray:
        """Return P_d."""
        for _ in range(self.delay):
            P = self.A @ P @ self.A.T + self.W
        return P

    def control(self, pushing: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
        """Return S and ``F' (I + b S b') F`` = ``H + A' S A - S`` of some actuators."""
        if pushing not in self._controls:
            b, S, _ = self._control.solution(pushing)
            scale = self._control.S.diagonal()
            S, b = S * scale * scale[:, None], b / scale
            seen = b @ S @ self.A
            inner = np.eye(len(b)) + b @ S @ b.T
            self._controls[pushing] = S, seen.T @ np.linalg.solve(inner, seen)
        return self._controls[pushing]

    def covariance(self, seeing: tuple[int, ...]) -> FloatArray:
        """Return the covariance of the estimate after the measurement by some sensors."""
        if seeing not in self._covariances:
            g, X, _ = self._filter.solution(seeing)
            _, after = measured(X, g)
            scale = self._filter.S.diagonal()
            self._covariances[seeing] = after * scale * scale[:, None]
        return self._covariances[seeing]

    @cached_property
    def _filter(self) -> Quadratic:
        return quadratic(self.A.T, self.W, np.eye(len(self.A)), self.sensors)

    @cached_property
    def _control(self) -> Quadratic:
        return quadratic(self.A, self.rows.T @ self.rows, np.eye(len(self.A)), self.actuators)

    @cached_property
    def _controls(self) -> dict[tuple[int, ...], tuple[FloatArray, FloatArray]]:
        return {}

    @cached_property
    def _covariances(self) -> dict[tuple[int, ...], FloatArray]:
        return {}


def of_sensors(p: Separation) -> Quadratic:
    """Return the cost as a function of the sensors, with all actuators of the problem."""
    S, V = p.control(tuple(range(len(p.actuators))))
    constant = float(np.sum(S * p.W) + np.sum(V * p.ahead(np.zeros_like(p.A))))
    looks = square_root(V).T @ np.linalg.matrix_power(p.A, p.delay)
    return quadratic(p.A.T, p.W, looks, p.sensors, constant=constant)


def of_actuators(p: Separation) -> Quadratic:
    """Return the cost as a function of the actuators, with all sensors of the problem."""
    # `tr(S N) + tr(H P_d)` with the innovations' covariance `N = A^d (A P A' + W - P) A'^d`
    P = p.covariance(tuple(range(len(p.sensors))))
    power = np.linalg.matrix_power(p.A, p.delay)
    innovations = square_root(power @ (p.A @ P @ p.A.T + p.W - P) @ power.T).T
    seen = innovations @ p.rows.T
    constant = float(np.einsum("ij,jk,ik->", p.rows, p.ahead(P), p.rows) + np.sum(seen**2))
    H = p.rows.T @ p.rows
    return quadratic(p.A, H, innovations @ p.A.T, p.actuators, constant=constant)
