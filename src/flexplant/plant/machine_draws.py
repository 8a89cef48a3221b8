"""Whole machines that a measurement allows, drawn in modal coordinates of an evaluation model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, IntArray
from ..errors import ModelError
from ..labels import Place
from ..modes.matching import assigned
from ..sparse.symmetric import dense
from ..updating.machines import Draw, Machines
from ..updating.parameters import Parameter, PointParameter
from ..updating.residuals.modal_residuals import ZETA
from .realisation import MODAL, ModalRealisation, modes_as_states, natural

#: places at which shapes of two meshes are compared, at most
_PLACES = 300
#: draws refused in a row after which there is no such machine
_REFUSED = 50
#: a drawn mode swings
_MOST_DAMPING = 0.9


@dataclass(frozen=True, eq=False, repr=False)
class DrawnModes(ModalRealisation):
    """Modes of a drawn machine over the modes (n, b) of the evaluation model, in place of DOFs."""

    over: FloatArray = None  # type: ignore[assignment]

    def row(self, at: Place, direction: str) -> FloatArray:
        """Return the row (b,) over the evaluation model's modes for a place."""
        return np.asarray(super().row(at, direction) @ self.over)


class _Change(NamedTuple):
    """What one unit of a parameter adds to mass and stiffness (b, b), in modal coordinates."""

    mass: FloatArray
    stiffness: FloatArray


class MachineFamily:
    """What all machines drawn from one evaluation model share."""

    def __init__(self, whole: ModalRealisation, machines: Machines) -> None:
        if whole.form != MODAL or whole.coupling is not None or np.any(whole.inputs[:, ::2]):
            raise ModelError(
                "machines are drawn in real modes, and damping couples those of the evaluation "
                "model. Pass Modes with ModalDamping as evaluation=."
            )
        self.whole, self.machines = whole, machines
        self.omega, self.zeta = natural(whole.pairs)
        self.omega[: whole.n_rigid] = 0.0
        self.over: FloatArray = np.ascontiguousarray(whole.inputs[:, 1::2])
        located = zip(machines.located(), machines.fit.values.tolist(), strict=True)
        self.changes = [self._change(q, value) for q, value in located]
        self.measured = self._measured_places()

    def _measured_places(self) -> IntArray:
        """Return the places of the measured modes among the evaluation model's, by frequency."""
        first = self.whole.n_rigid
        gap = np.log(np.abs(self.machines.measured.poles)[:, None] / self.omega[first:])
        return np.asarray(first + assigned(np.abs(gap)))

    def _change(self, parameter: Parameter, value: float) -> _Change:
        b = self.omega.size
        found = [np.zeros((b, b)), np.zeros((b, b))]
        if isinstance(parameter, PointParameter):
            rows = np.array(parameter.rows(self.whole.model)) @ self.over  # type: ignore[arg-type]
            if parameter.acts_on != 1:
                found[parameter.acts_on // 2] = rows.T @ rows
        else:
            model = self.machines.fit.model
            dM, _, dK = parameter.about(value).matrices(model)
            for i, part in enumerate((dM, dK)):
                if part is None:
                    continue
                same = part.shape[0] == self.over.shape[0]
                found[i] = self.over.T @ (part @ self.over) if same else self._carried(part, i == 1)
        stiffness = found[1]
        stiffness[: self.whole.n_rigid], stiffness[:, : self.whole.n_rigid] = 0.0, 0.0
        return _Change(found[0], stiffness)

    def _carried(self, part: Any, is_stiffness: bool) -> FloatArray:
        """Return a matrix of the reduced model in the evaluation model's modes.

        Exactly where they are combinations of the reduced model's modes; above, the mean relative
        effect on those.
        """
        model = self.machines.fit.model
        K, M = dense(model.K), dense(model.M)
        values, phi = la.eigh(K, M)
        count = phi.shape[1] - getattr(model, "n_vectors", 0)
        values, phi = np.maximum(values[:count], 0.0), phi[:, :count]
        own = phi.T @ dense(part) @ phi
        dofs, shapes = model.dofs, phi
        if hasattr(model, "T"):
            dofs, shapes = model.full_dofs, model.T @ phi
        moves = [i for i, d in enumerate(dofs.directions) if d in ("x", "y", "z")]
        moves = moves[:: max(len(moves) // _PLACES, 1)]
        places = [(tuple(dofs.xyz[i].tolist()), dofs.directions[i]) for i in moves]
        seen = np.array([self.whole.row(at, d) for at, d in places]) @ self.over
        among, *_ = la.lstsq(shapes[moves], seen)
        missed = np.linalg.norm(seen - shapes[moves] @ among, axis=0)
        known = missed**2 < 0.5 * np.sum(seen**2, axis=0)
        known &= self.omega**2 <= values[-1]
        among[:, ~known] = 0.0
        found = np.asarray(among.T @ own @ among)
        n_rigid = self.whole.n_rigid
        size = values[n_rigid:] if is_stiffness else 1.0
        mean = float(np.mean(np.diag(own)[n_rigid:] / size))
        rest = np.where(known, 0.0, mean * (self.omega**2 if is_stiffness else 1.0))
        return np.asarray(found + np.diag(rest))

    def machine(self, rng: np.random.Generator) -> DrawnModes:
        """Return the modes of one machine; draws without mass or stiffness are refused."""
        for _ in range(_REFUSED):
            found = self._modes(self.machines.draw(rng))
            if found is not None:
                return found
        raise ModelError(
            f"{_REFUSED} draws in a row have a mass or stiffness that is not positive: what was "
            "measured does not determine the parameters. Measure more modes."
        )

    def _modes(self, draw: Draw) -> DrawnModes | None:
        """Return modes of one machine, None where it has negative mass or stiffness."""
        r, b = self.whole.n_rigid, self.omega.size
        M, K = self._matrices(draw)
        rigid = M[:r, :r]
        try:
            values, V = la.eigh(K, M)
            V[:, :r] = 0.0
            V[:r, :r] = la.inv(la.cholesky(rigid)) if r else 0.0
        except la.LinAlgError:
            return None
        if b > r and values[r] <= 0.0:
            return None
        omega, zeta = np.zeros(b), np.zeros(b)
        omega[r:] = np.sqrt(values[r:])
        parent = np.argmax(np.abs(V), axis=0)
        reference = np.where(self.zeta > ZETA, self.zeta, 1.0)[parent[r:]]
        mean, size = draw.damping
        log = mean + size * draw.rng.standard_normal(b - r)
        if self.machines.damping_changes.size > 1:
            zeta[r:] = np.minimum(reference * np.exp(log), _MOST_DAMPING)
        else:
            zeta[r:] = self.zeta[parent[r:]]
        own = r + assigned(-(V[self.measured, r:] ** 2))
        omega[own] = np.abs(draw.poles)
        zeta[own] = -draw.poles.real / np.abs(draw.poles)
        order = np.argsort(omega, kind="stable")
        found = modes_as_states(
            self.whole.model, omega[order], zeta[order], V[:, order], r, self.whole.n_modes
        )
        return DrawnModes(**found._fields(), over=self.over)

    def _matrices(self, draw: Draw) -> tuple[FloatArray, FloatArray]:
        """Return M' and K' of one machine."""
        r, b, rng = self.whole.n_rigid, self.omega.size, draw.rng
        g = self.omega / (2.0 * np.pi * self.machines.trend.highest)
        trend = 0.5 * np.sign(draw.slope) * np.log1p(2.0 * abs(draw.slope) * g)
        E = rng.standard_normal((b, b)) * draw.deviation
        E = E + E.T
        mass = np.eye(b)
        mass[:r, :r] = la.expm(E[:r, :r])
        E[:r], E[:, :r] = 0.0, 0.0
        E += np.diag(2.0 * (1.0 - draw.as_mass) * trend)
        K = self.omega[:, None] * la.expm(E) * self.omega
        for change, amount in zip(self.changes, draw.parameters.tolist(), strict=True):
            mass += amount * change.mass
            K += amount * change.stiffness
        lighter = np.exp(-draw.as_mass * trend)
        M = lighter[:, None] * mass * lighter
        return 0.5 * (M + M.T), 0.5 * (K + K.T)


def drawn_modes(whole: ModalRealisation, machines: Machines) -> list[DrawnModes]:
    """Return the machines drawn from an evaluation model's modes: once, shared by all plants."""

    def drawn() -> list[DrawnModes]:
        family = MachineFamily(whole, machines)
        seeds = np.random.default_rng(machines.seed).spawn(machines.count)
        return [family.machine(rng) for rng in seeds]

    return whole.once(machines, drawn)
