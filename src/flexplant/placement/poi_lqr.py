"""The least mean square of a POI's motion: where actuators go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import CertificateError, SolverError
from ..lti.discretisation import discretized
from ..lti.lyapunov import solve_stein
from ..lti.riccati import control_dare
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..values import positive
from .criterion import Criterion, Scorer
from .poi_axes import (
    Axes,
    checked_axes,
    factors_of,
    plain,
    poi_of,
    poi_rows,
    shown,
    structure_part,
)
from .quadratic import quadratic


@dataclass(frozen=True, eq=False, repr=False)
class PoiLqr(Criterion):
    """Least mean square of a POI's motion and the effort it takes: for actuators.

    ``min E[sum_a (f_a z_a)^2 + effort^2 |u|^2]`` over all stabilising state
    feedbacks, with the plant's disturbances and delay of u. More actuators never make it larger.

    Parameters
    ----------
    poi : str, optional
        The POI's name; not needed when the plant has one only.
    axes : str, sequence of str or mapping {axis: factor}, optional
        The POI's axes to sum over; all of them when not given, a rotation with the factor 1 m.
        Together they must see every rigid-body mode.
    effort : float [m/N]
        The motion of the POI that one newton of one actuator is worth. Small: the disturbance is
        rejected as well as the structure and the delay allow.

    Raises
    ------
    LabelError
        When an axis appears twice; when called, for a POI or an axis that the plant lacks.
    ModelError
        When a factor or the effort is not positive.
    """

    sides = "u"
    poi: str | None = None
    axes: Axes = field(default=None)
    effort: float = field(default=1e-9, kw_only=True)

    def __post_init__(self) -> None:
        self._set(axes=checked_axes(self.axes), effort=positive(self.effort, "effort"))

    def __repr__(self) -> str:
        given = shown(self.poi, self.axes)
        return f"PoiLqr({given}{', ' if given else ''}effort={self.effort:g})"

    def __call__(self, plant: StandardPlant) -> float:
        """Return the cost [m^2] on a sampled plant.

        The cost to go by a Riccati equation, checked against the stationary covariance of the
        closed loop of its gain.

        Raises
        ------
        AssumptionError
            When u does not reach, w does not excite or the axes do not see a rigid-body mode.
        CertificateError
            When the two costs differ.
        """
        self.check(plant, ())
        plant.check().require(("stabilisable",), "a stationary controller")
        factors = factors_of(plant, self.poi, self.axes, every=True)
        A, B = plant.system.A, plant.B2
        rows = poi_rows(plant, factors)
        R = self.effort**2 * np.eye(B.shape[1])
        solution = control_dare(A, B, Q=rows.T @ rows, R=R)
        noise = plant.process_noise
        cost = float(np.sum(solution.P * noise))
        P = solve_stein(A - B @ solution.gain, noise)
        seen = np.vstack([rows, self.effort * solution.gain])
        found = float(np.einsum("ij,jk,ik->", seen, P, seen))
        if not abs(found - cost) <= 1e-6 * abs(cost):
            raise CertificateError(
                f"the gain costs {found:.9g}, its Riccati equation says {cost:.9g}: the problem is "
                "too badly conditioned. Give a larger effort."
            )
        return cost

    def check(self, plant: StandardPlant, candidates: Sequence[Any]) -> None:
        """Raise AssumptionError when w does not excite or the axes miss a rigid-body mode."""
        factors = factors_of(plant, self.poi, self.axes, every=True)
        plant.check().require(("excited",), "a stationary controller")
        poi = poi_of(plant, self.poi)
        axes = tuple(axis for axis in poi.axes if poi.channel(axis) in factors)
        seen = plant.assembled.ports.replace(z=[poi.replace(axes=axes)], references=())
        plant.with_ports(seen).check().require(("performance",), f"a controller for {self!r}")

    def scorer(self, plant: StandardPlant, candidates: Sequence[Any]) -> Scorer:
        """Return the cost as a function of the actuators alone; all else is computed once.

        A delay of d whole samples leaves what happens meanwhile to no controller: it is a constant,
        ``sum_{i<d} |C1 A^i W|^2``, and the rest acts on the state predicted d samples ahead. Only a
        fraction of a sample adds a state per actuator.
        """
        if not plain(plant, candidates):
            return super().scorer(plant, candidates)
        A, noise, rows = structure_part(plant, factors_of(plant, self.poi, self.axes, every=True))
        realisation = plant.assembled.realisation
        n, count = A.shape[0], len(candidates)
        whole, fraction = divmod(plant.delay, 1.0)
        constant = 0.0
        for _ in range(int(whole)):
            constant += float(np.sum((rows @ noise) ** 2))
            noise = A @ noise
        constant += float(np.sum((rows @ noise) ** 2))
        B = [realisation.force(c.push(realisation)) for c in candidates]
        late = discretized(
            StateSpace(
                realisation.A,
                np.array(B).T,
                rows,
                np.zeros((rows.shape[0], count)),
                blocks=[2] * (n // 2),
            ),
            1.0 / plant.dt,
            delay=fraction,
        )
        held = n + np.arange(late.n_states - n).reshape(count, -1)
        S = np.zeros((noise.shape[1], late.n_states))
        S[:, :n] = noise.T
        try:
            return quadratic(
                late.A,
                late.C.T @ late.C,
                S @ late.A.T,
                late.B.T / self.effort,
                constant=constant,
                owned=held,
            )
        except SolverError as error:
            raise SolverError(
                f"{error} The effort of {self.effort:g} m/N may be too small to distinguish gains: "
                "try a larger one."
            ) from error
