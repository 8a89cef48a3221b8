"""The semidefinite programs of several objectives: one for a bound, one for a controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import SolverError
from ...lti.statespace import StateSpace
from ...plant import StandardPlant
from ..lmi_plant import Plant
from ..lmi_programs import modelling, solve_program
from . import lmis
from .sampled_poles import PoleDisc, PoleEdge, damped, within
from .specifications import H2, PeakGain, PoleRegion

#: largest part by which a reachable set shrinks in one sample
_MOST = 0.9
#: units in which the optimum is sought
_UNITS = 7
#: of the solver, tried in turn
_TOLERANCES = (1e-8, 1e-6, 1e-5)


@dataclass(frozen=True)
class ObjectivePrograms:
    """The semidefinite programs of one design."""

    given: StandardPlant
    plant: Plant
    minimize: Any
    subject_to: tuple[Any, ...]

    def unit(self, spec: Any, bound: float) -> float:
        """Return a bound in the scaled plant: H2 norms depend on the unit of time."""
        return bound / np.sqrt(self.plant.speed) if isinstance(spec, H2) else bound

    def variables(self) -> lmis.Variables:
        """Return the unknowns: no feedthrough where it would make a continuous H2 norm infinite."""
        proper = False
        if not self.given.dt:
            p = self.plant
            for spec in (self.minimize, *self.subject_to):
                if isinstance(spec, H2):
                    own = self.channel(spec, 1.0)
                    proper |= bool(np.any(p.D12[own.rows]) and np.any(p.D21[:, own.columns]))
        root = np.sqrt(self.plant.speed) if self.given.dt else 0.0
        return lmis.Variables(self.plant, root, proper=proper)

    def channel(self, spec: Any, bound: float) -> lmis.Channel:
        """Return which w and z a specification is about, with its bound in the scaled plant."""
        w, z = spec.chosen(self.given)
        columns = [self.given.w.index(name) for name in w]
        rows = [self.given.z.index(name) for name in z]
        return lmis.Channel(columns, rows, self.unit(spec, bound))

    def constraints(
        self, v: lmis.Variables, spec: Any, level: Any, bound: float, rate: float
    ) -> Any:
        """Return the LMIs of a specification, in units of its bound."""
        if isinstance(spec, PoleRegion):
            return lmis.poles(v, self._region(spec))
        own = self.channel(spec, bound)
        if isinstance(spec, H2):
            return lmis.h2(v, own, level)
        if isinstance(spec, PeakGain):
            return lmis.peak(v, own, level, self._shrinking(spec, rate))
        return lmis.hinf(v, own, level)

    def _shrinking(self, spec: PeakGain, rate: float) -> float:
        """Return the rate at which the reachable set shrinks, in the plant's unit of time."""
        speed, dt = self.plant.speed, self.given.dt
        if spec.decay is None:
            return min(rate, _MOST / speed) if dt else rate
        return float(1.0 - np.exp(-spec.decay * dt)) / speed if dt else spec.decay / speed

    def _region(self, spec: PoleRegion) -> lmis.PolesHeld:
        """Return the region of z, or of s in the plant's unit of time."""
        speed, dt = self.plant.speed, self.given.dt
        if not dt:
            edges = []
            if spec.damping is not None:
                edges = [PoleEdge(float(np.sqrt(1.0 - spec.damping**2)), spec.damping, 0.0)]
            top = None if spec.bandwidth is None else 2 * np.pi * spec.bandwidth / speed
            return lmis.PolesHeld(spec.decay / speed, edges, (), top)
        discs = [PoleDisc(0.0, float(np.exp(-spec.decay * dt)))]
        if spec.bandwidth is not None:
            discs.append(within(2.0 * np.pi * spec.bandwidth * dt))
        return lmis.PolesHeld(0.0, [] if spec.damping is None else damped(spec.damping), discs)

    def program(self, v: lmis.Variables, level: Any, unit: float, rate: float) -> list[Any]:
        """Return the LMIs of all specifications, what is minimised in units of `unit`."""
        found = [v.positive(), *self.constraints(v, self.minimize, level, unit, rate)]
        for spec in self.subject_to:
            bound = 1.0 if isinstance(spec, PoleRegion) else float(spec.below)
            found += self.constraints(v, spec, 1.0, bound, rate)
        return found

    def smallest(self, rate: float) -> float:
        """Return the smallest bound of what is minimised, sought again in its own unit."""
        unit, failure = self._guess(), None
        for step in range(_UNITS):
            try:
                found = self._optimum(unit, rate)
            except SolverError as error:  # a unit far from the optimum spoils the numbers
                failure, unit = error, 10.0 * unit
                continue
            if 0.1 < found / unit < 10.0 or step == _UNITS - 1:
                return found
            unit = found
        raise failure or SolverError("the unit of what is minimised did not settle. Report it.")

    def _optimum(self, unit: float, rate: float) -> float:
        """Return the smallest bound from one program, in some unit."""
        cp = modelling()
        v, level = self.variables(), cp.Variable()
        little = 1e-7 * (cp.trace(v.X) + cp.trace(v.Y))
        program = cp.Problem(cp.Minimize(level + little), self.program(v, level, unit, rate))
        self._solve(program)
        found = max(float(level.value), 1e-12)
        return float(unit * (np.sqrt(found) if isinstance(self.minimize, H2) else found))

    def controller(self, bound: float, rate: float) -> StateSpace:
        """Return a moderate controller for a bound on what is minimised."""
        cp = modelling()

        v = self.variables()
        program = cp.Problem(cp.Minimize(lmis.size(v)), self.program(v, 1.0, bound, rate))
        self._solve(program)
        A, B, C, D = v.controller()
        g = self.given
        D22 = g.system.D[len(g.z) :, len(g.w) :]
        loop = np.linalg.inv(np.eye(D.shape[0]) + D @ D22)  # u = K (y - D22 u)
        return StateSpace(
            A - B @ D22 @ loop @ C,
            B @ (np.eye(B.shape[1]) - D22 @ loop @ D),
            loop @ C,
            loop @ D,
            g.dt,
            inputs=g.y,
            outputs=g.u,
            name="lmi",
            units=g.units,
        )

    def _solve(self, program: Any) -> None:
        """Solve a program, less accurately where it stops before its tolerance."""
        for i, tolerance in enumerate(_TOLERANCES, 1):
            names = ("tol_gap_abs", "tol_gap_rel", "tol_feas")
            try:
                settings = dict.fromkeys(names, tolerance)
                # every claim is verified by the closed loop: a little violation is no harm
                solve_program(program, settings, violation=10.0 * tolerance)
            except SolverError:
                if i == len(_TOLERANCES):
                    raise
                continue
            return

    def _guess(self) -> float:
        """Return the open gain of what is minimised, away from its poles."""
        own = self.channel(self.minimize, 1.0)
        p = self.plant
        s = 1.3 + 0.7j
        part = np.linalg.solve(s * np.eye(p.A.shape[0]) - p.A, p.B1[:, own.columns])
        gain = float(np.linalg.norm(p.C1[own.rows] @ part + p.D11[np.ix_(own.rows, own.columns)]))
        return (gain or 1.0) / own.unit
