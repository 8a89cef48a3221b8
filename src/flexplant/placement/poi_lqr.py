"""The least mean square of a POI's motion: where actuators go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..checks import FloatArray, IntArray, checked, positive
from ..errors import CertificateError, SolverError
from ..lti.discretisation import held_exactly
from ..lti.lyapunov import solve_stein
from ..lti.riccati import control_dare
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from .criterion import AGREEMENT, Criterion, Scorer
from .poi_axes import (
    Named,
    checked_names,
    factors_of,
    plain,
    poi_rows,
    pushed,
    pushed_columns,
    shown,
    structure_part,
    unit_of,
)
from .quadratic import quadratic


@dataclass(frozen=True, eq=False, repr=False)
class MotionAndEffort(Criterion):
    """A mean square of the motion of POIs and of the effort; the base of such criteria."""

    poi: Named = field(default=None, metadata=checked(checked_names, name="POI"))
    axes: Named = field(default=None, metadata=checked(checked_names, name="axis"))
    effort: float = field(default=1e-9, kw_only=True, metadata=checked(positive))

    def __repr__(self) -> str:
        given = [*shown(self.poi, self.axes), f"effort={self.effort:g}"]
        return f"{type(self).__name__}({', '.join(given)})"

    def check(self, plant: StandardPlant, candidates: Sequence[Any]) -> None:
        """Raise AssumptionError when w does not excite or the axes miss a rigid-body mode."""
        _require_control(plant, self.factors(plant), repr(self))

    def unit(self, plant: StandardPlant) -> str:
        """Return the unit of the square root."""
        return unit_of(plant, self.factors(plant))

    def factors(self, plant: StandardPlant) -> dict[str, float]:
        """Return {z channel: factor}."""
        return factors_of(plant, self.poi, self.axes, every=True)


def confirmed(cost: float, found: float) -> float:
    """Return the cost by Riccati equations, confirmed by that of the loop's covariance."""
    if not abs(found - cost) <= AGREEMENT * abs(cost):
        raise CertificateError(
            f"the loop costs {found:.9g}, its Riccati equations say {cost:.9g}: the problem is "
            "too badly conditioned. Give a larger effort."
        )
    return cost


@dataclass(frozen=True, eq=False, repr=False)
class PoiLqr(MotionAndEffort):
    """Smallest mean square of POI motion and effort by state feedback (LQR): for actuators.

    ``min E[sum_a (f_a z_a)^2 + effort^2 |u|^2]`` over all stabilising state
    feedbacks, with the plant's disturbances and delay of u. More actuators never make it larger.

    Parameters
    ----------
    poi : str, sequence of str or mapping {name: factor}, optional
        The POIs; not needed when the plant has one only.
    axes : str, sequence of str or mapping {axis: factor}, optional
        Axes of each of them; all when not given, a rotation with the factor 1 m.
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
        A, B = plant.system.A, plant.B2
        rows = poi_rows(plant, self.factors(plant))
        R = self.effort**2 * np.eye(B.shape[1])
        solution = control_dare(A, B, Q=rows.T @ rows, R=R)
        noise = plant.process_noise
        cost = float(np.sum(solution.P * noise))
        P = solve_stein(A - B @ solution.gain, noise)
        seen = np.vstack([rows, self.effort * solution.gain])
        found = float(np.einsum("ij,jk,ik->", seen, P, seen))
        return confirmed(cost, found)

    def scorer(self, plant: StandardPlant, candidates: Sequence[Any]) -> Scorer:
        """Return the cost as a function of the actuators alone; all else is computed once.

        A delay of d whole samples leaves what happens meanwhile to no controller: it is a constant,
        ``sum_{i<d} |C1 A^i W|^2``, and the rest acts on the state predicted d samples ahead. Only a
        fraction of a sample adds a state per actuator.
        """
        if not plain(plant, candidates):
            return super().scorer(plant, candidates)
        A, noise, rows = structure_part(plant, self.factors(plant))
        n = A.shape[0]
        # a plant made elsewhere holds its delay in its states
        whole, fraction = divmod(plant.delay if plant.is_assembled else 0.0, 1.0)
        constant = 0.0
        for _ in range(int(whole)):
            constant += float(np.sum((rows @ noise) ** 2))
            noise = A @ noise
        constant += float(np.sum((rows @ noise) ** 2))
        held, late = _late(plant, rows, candidates, fraction)
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


def _require_control(plant: StandardPlant, factors: Mapping[str, float], what: str) -> None:
    """Raise AssumptionError when w does not excite or the axes miss a rigid-body mode."""
    plant.check().require(("excited",), "a stationary controller")
    if not plant.is_assembled:
        return
    parts = []
    for poi in plant.assembled.ports.z:
        axes = tuple(axis for axis in poi.axes if poi.channel(axis) in factors)
        parts += [poi.replace(axes=axes)] if axes else []
    seen = plant.assembled.ports.replace(z=parts, references=())
    plant.with_ports(seen).check().require(("performance",), f"a controller for {what}")


def _late(
    plant: StandardPlant, rows: FloatArray, candidates: Sequence[Any], fraction: float
) -> tuple[IntArray, StateSpace]:
    """Return the plant of all candidates with a part of a sample of delay, and the states it adds.

    A row (N, m) of states for each candidate.
    """
    n = rows.shape[1]
    if not fraction:
        A = plant.system.A[:n, :n]
        B = pushed_columns(plant, candidates)
        late = StateSpace(A, B, rows, np.zeros((len(rows), len(candidates))), dt=plant.dt)
    else:
        late = held_exactly(pushed(plant, candidates, rows), 1.0 / plant.dt, delay=fraction)
    return n + np.arange(late.n_states - n).reshape(len(candidates), -1), late
