"""The mean square of POIs' motion under the best controller: for actuators, sensors or both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..estimation import design_kalman
from ..lti.lyapunov import solve_stein
from ..lti.riccati import control_dare
from ..plant import StandardPlant
from .candidates import PlantChannel, Port, side_of
from .criterion import Scorer
from .poi_axes import measured_rows, plain, poi_rows, pushed_columns, sensor_rows, structure_part
from .poi_lqr import MotionAndEffort, confirmed
from .poi_variance import PoiVariance
from .separation import Separation, of_actuators, of_sensors


@dataclass(frozen=True, eq=False, repr=False)
class ClosedLoopH2(MotionAndEffort):
    """Smallest mean square of POI motion and effort in closed loop, with the estimate (LQG).

    The cost of LQG: ``min E[sum_a (f_a z_a)^2 + effort^2 |u|^2]`` over all stabilising
    controllers of y, the square of an H2 norm. With S and F of the control Riccati equation, W the
    process noise and P the covariance of the estimate (on which u acts)::

        J = tr(S W) + tr(F' (effort^2 I + B' S B) F P)

    More sensors or actuators never make it larger. `PoiLqr` is its part without any error of the
    estimate, `PoiVariance` that without any limit of control: it is above both.

    Parameters
    ----------
    poi, axes : optional
        As for `PoiLqr`.
    effort : float [m/N]
        The motion of the POI that one newton of one actuator is worth.

    Raises
    ------
    LabelError
        When a name appears twice; when called, for a POI or an axis that the plant lacks.
    ModelError
        When a factor or the effort is not positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Actuator(f"a{i}", at=f"{i}:x", direction="x") for i in (1, 2, 3)]
    >>> fx.place_actuators(plant, candidates, 1, fx.placement.ClosedLoopH2("die")).chosen
    ('a2',)
    """

    def __call__(self, plant: StandardPlant) -> float:
        """Return the cost [m^2] on a sampled plant.

        By the formula, checked against the stationary covariance of the loop of filter and gain.
        """
        self.check(plant, ())
        plant.check().require(("stabilisable", "detectable"), "a stationary controller")
        rows = poi_rows(plant, self.factors(plant))
        A, B, W = plant.system.A, plant.B2, plant.process_noise
        R = self.effort**2 * np.eye(B.shape[1])
        control = control_dare(A, B, Q=rows.T @ rows, R=R)
        S, F = control.P, control.gain
        estimator = design_kalman(plant, larger=plant)
        P, K = estimator.covariance, estimator.gain
        read = sensor_rows(plant)  # without references
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

    def check(self, plant: StandardPlant, candidates: Sequence[Any]) -> None:
        """Raise AssumptionError when a rigid-body mode is missed or a candidate fits no filter."""
        super().check(plant, candidates)
        sensors = [port for port in candidates if side_of(port) == "y"]
        if candidates and not sensors:  # the plant's own are those of the loop
            plant.check().require(("detectable",), "a stationary controller")
        if candidates and len(sensors) == len(candidates):
            plant.check().require(("stabilisable",), "a stationary controller")
        PoiVariance(self.poi).check(plant, sensors)

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return the cost as a function of the candidates alone; all else is computed once.

        A delay of d whole samples costs what cannot be done meanwhile, and the control acts on the
        state predicted d samples ahead, P_d. A fraction of a sample, filters and delays of ports:
        the plant is made anew for each choice.
        """
        delay = plant.delay if plant.is_assembled else 0.0
        if delay % 1.0 or not plain(plant, candidates):
            return super().scorer(plant, candidates)
        A, noise, rows = structure_part(plant, self.factors(plant))
        own = plant.assembled.ports if plant.is_assembled else None
        given = {side: [p for p in candidates if side_of(p) == side] for side in "yu"}
        fixed = {
            side: list(getattr(own, side)) if own else [PlantChannel(n, side) for n in names]
            for side, names in (("y", [plant.y[i] for i in sensor_rows(plant)]), ("u", plant.u))
        }
        problem = Separation(
            A,
            noise,
            rows,
            measured_rows(plant, given["y"] or fixed["y"]),
            pushed_columns(plant, given["u"] or fixed["u"]).T / self.effort,
            int(delay),
            np.array([side_of(port) == "y" for port in candidates]),
        )
        if not given["u"]:
            return of_sensors(problem)
        return of_actuators(problem) if not given["y"] else problem
