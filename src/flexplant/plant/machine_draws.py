"""Whole machines, drawn in modal coordinates of an evaluation model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, IntArray
from ..errors import ModelError
from ..labels import Place
from ..modes.matching import assigned
from ..modes.modes import sampled_moves
from ..seeds import REFUSED
from ..sparse.symmetric import dense
from ..structure.rigid import rigid_motions
from ..tolerances import SAME, TINY, TYPED
from ..updating.machines import MIXED, Draw, Machines
from ..updating.parameters import Parameter, PointParameter
from .measured_shapes import MeasuredShapes
from .realisation import MODAL, ModalRealisation, modes_as_states, natural
from .uncertainty.delta import Delta
from .uncertainty.mode_delta import DampingDelta, FrequencyDelta, ModeDelta, changed_pairs

#: angles at which a pair is compared with its measured shapes, a quarter of a degree apart
_ANGLES = 721
#: terms of the series of exp(E / 2): relative rounding for norms of E up to 0.3
_TERMS = 9
#: a drawn mode swings
_MOST_DAMPING = 0.9


@dataclass(frozen=True, eq=False, repr=False)
class DrawnModes(ModalRealisation):
    """Modes of a drawn machine over columns (n, c) of DOFs, which all machines share.

    `rows` are the rows of places over these columns, found once for all machines.
    """

    over: FloatArray = None  # type: ignore[assignment]
    rows: dict[str, FloatArray] = field(default_factory=dict)

    def row(self, at: Place, direction: str) -> FloatArray:
        """Return the row (c,) over the columns for a place."""
        place = at if isinstance(at, str | Mapping) else tuple(map(float, at))
        name = f"{direction} at {place!r}"
        if name not in self.rows:
            self.rows[name] = self.load(super().row(at, direction))
        return self.rows[name]

    def load(self, forces: FloatArray) -> FloatArray:
        """Return forces on the model's DOFs over the columns."""
        return np.asarray(forces @ self.over)


class ModeSpace:
    """The modes of a realisation that may be mixed, and the blocks that stay as they are.

    Mixed are rigid-body motions and real modes that swing. Modes with complex shapes, overdamped
    and unstable ones keep their shapes.
    """

    def __init__(self, whole: ModalRealisation) -> None:
        omega, zeta = natural(whole.pairs)
        r = self.n_rigid = whole.n_rigid
        mixed = (omega > 0.0) & (zeta < 1.0) & ~np.any(whole.inputs[:, ::2], axis=0)
        mixed[:r] = True
        self.whole, self.own, self.rest = whole, np.flatnonzero(mixed), np.flatnonzero(~mixed)
        self.omega, self.zeta = omega[self.own], zeta[self.own]
        self.omega[:r] = 0.0
        self.shapes: FloatArray = np.ascontiguousarray(whole.inputs[:, 1::2][:, self.own])
        self._others = np.repeat(2 * self.rest, 2) + np.tile([0, 1], self.rest.size)
        fixed = (
            whole.inputs[:, self._others],
            whole.outputs[:, self._others],
            whole.static_inputs,
            whole.static_outputs,
        )
        self.over: FloatArray = np.hstack([self.shapes, *fixed])
        self.rows: dict[str, FloatArray] = {}

    def mixed(self, M: FloatArray, K: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return omega (b,) and shapes (b, b) of mass and stiffness over the modes that mix.

        None where either is not positive.
        """
        r = self.n_rigid
        try:
            values, V = la.eigh(K, M)
            V[:, :r] = 0.0
            V[:r, :r] = la.inv(la.cholesky(M[:r, :r])) if r else 0.0
        except la.LinAlgError:
            return None
        if values.size > r and values[r] <= 0.0:
            return None
        return np.append(np.zeros(r), np.sqrt(values[r:])), V

    def realisation(
        self, omega: FloatArray, zeta: FloatArray, V: FloatArray, rest: FloatArray
    ) -> DrawnModes:
        """Return modes by their frequency, with the blocks `rest` (k, 2, 2) that do not mix."""
        whole, r, b = self.whole, self.n_rigid, omega.size
        own = modes_as_states(whole.model, omega, zeta, V, r, whole.n_modes)
        pairs = np.concatenate([own.pairs, rest])
        columns, k, p = self.over.shape[1], 2 * len(rest), whole.static_inputs.shape[1]
        inputs, outputs = np.zeros((columns, 2 * b + k)), np.zeros((columns, 2 * b + k))
        inputs[:b, : 2 * b], outputs[:b, : 2 * b] = own.inputs, own.outputs
        inputs[b : b + k, 2 * b :] = np.eye(k)
        outputs[b + k : b + 2 * k, 2 * b :] = np.eye(k)
        order = np.argsort(np.append(omega, natural(rest)[0]), kind="stable")
        states = np.repeat(2 * order, 2) + np.tile([0, 1], order.size)
        static = np.eye(columns)[:, b + 2 * k :]
        return DrawnModes(
            **whole._fields()
            | {
                "pairs": pairs[order],
                "inputs": inputs[:, states],
                "outputs": outputs[:, states],
                "static_inputs": static[:, :p],
                "static_outputs": static[:, p:],
            },
            over=self.over,
            rows=self.rows,
        )


class _Change(NamedTuple):
    """What one unit of a parameter adds to mass and stiffness (b, b), in modal coordinates."""

    mass: FloatArray
    stiffness: FloatArray


def obstacle(whole: ModalRealisation) -> str:
    """Return why machines cannot be drawn in the modes of a model, empty where they can."""
    if whole.form == MODAL and whole.coupling is None and not np.any(whole.inputs[:, ::2]):
        return ""
    return (
        "machines are drawn in real modes, and damping couples those of the evaluation model: "
        "pass Modes with ModalDamping as evaluation="
    )


class MachineFamily:
    """The machines of an update, in the modes of one evaluation model; see `Machines`."""

    def __init__(self, whole: ModalRealisation, machines: Machines) -> None:
        if reason := obstacle(whole):
            raise ModelError(f"{reason}.")
        self.whole, self.machines = whole, machines
        self.space = ModeSpace(whole)
        self.omega, self.zeta = self.space.omega, self.space.zeta
        self.over = self.space.shapes
        located = zip(machines.located(), machines.fit.values.tolist(), strict=True)
        self.changes = [self._change(q, value) for q, value in located]
        self.measured = self._measured_places()
        self.pairs = self._close_pairs()

    def _measured_places(self) -> IntArray:
        """Return the places of the measured modes among the evaluation model's, by frequency."""
        first = self.whole.n_rigid
        gap = np.log(np.abs(self.machines.measured.poles)[:, None] / self.omega[first:])
        return np.asarray(first + assigned(np.abs(gap)))

    def _close_pairs(self) -> list[tuple[int, int]]:
        """Return places, among the measured modes, of neighbours whose shapes scatter mixes."""
        if self.machines.measured.xyz is None:
            return []
        freq = np.abs(self.machines.measured.poles)
        order = np.argsort(freq)
        near = np.diff(np.log(freq[order])) < MIXED * self.machines.trend.deviation
        return [(int(order[i]), int(order[i + 1])) for i in np.flatnonzero(near)]

    @cached_property
    def _together(self) -> FloatArray:
        """Factors (b, b) of the scatter of stiffness between modes that strain other springs.

        A mode of a body on isolators strains its isolators, and an elastic mode strains the body.
        With u the fraction of a mode's strain energy in bodies, independent scatter of bodies and
        isolators couples two modes by ``sqrt(u_i u_j + (1 - u_i) (1 - u_j))``. A higher mode j also
        moves the isolators: this couples it to a lower mode i by at least omega_i / omega_j.
        """
        r, omega = self.whole.n_rigid, self.omega
        body = self._strained()
        factors = np.sqrt(np.outer(body, body) + np.outer(1.0 - body, 1.0 - body))
        lower, higher = np.minimum.outer(omega, omega), np.maximum.outer(omega, omega)
        least = np.divide(lower, higher, out=np.ones_like(lower), where=higher > 0.0)
        factors = np.maximum(factors, least)
        factors[:r], factors[:, :r] = 1.0, 1.0
        return np.asarray(factors)

    def _strained(self) -> FloatArray:
        """Return the fraction (b,) of each mode's strain energy in bodies, not in isolators.

        It is the strain energy that is left without rigid-body motions, and zero below the measured
        band, whose modes are those of isolators.
        """
        b, stiffness = self.omega.size, self.omega**2
        dofs = self.whole.model.dofs
        moves = sampled_moves(dofs)
        rigid, *_ = la.lstsq(self.over[moves], rigid_motions(dofs)[moves])
        size = np.linalg.norm(rigid, axis=0)
        Q = la.orth(rigid / np.where(size > 0.0, size, 1.0), rcond=SAME)
        rest = np.eye(b) - Q @ Q.T
        left = np.sum(rest * (stiffness[:, None] * rest), axis=0)
        above = self.omega >= np.min(self.omega[self.measured])
        found = np.divide(left, stiffness, out=np.zeros(b), where=above)
        return np.asarray(np.minimum(found, 1.0))

    @cached_property
    def _seen(self) -> FloatArray:
        """Rows (n, b) of the evaluation model's modes where shapes were measured."""
        known = self.machines.measured
        points = zip(known.xyz, known.directions or (), strict=True)  # type: ignore[arg-type]
        rows = [self.whole.row(tuple(at.tolist()), direction) for at, direction in points]
        return np.asarray(np.array(rows) @ self.over)

    @cached_property
    def _shapes(self) -> MeasuredShapes | None:
        """The measured shapes, None without any at known places."""
        known = self.machines.measured
        if known.shapes is None or known.xyz is None:
            return None
        return MeasuredShapes(
            self._seen, known.shapes, self.omega, self.measured, self.pairs,
            2.0 * self._together**2, self.machines.trend.deviation,
        )  # fmt: skip

    def _turned(self, V: FloatArray, own: IntArray) -> FloatArray:
        """Return shapes whose close pairs are turned in their plane to the measured shapes."""
        # two modes of almost one frequency mix by the ratio of scatter to gap: what was measured
        # of their shapes says by how much. Turned in their plane they keep their mass
        shapes: Any = self.machines.measured.shapes
        angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _ANGLES)
        for pair in self.pairs:
            at = own[list(pair)]
            seen = self._seen @ V[:, at]
            turns = np.array([[np.cos(angles), -np.sin(angles)], [np.sin(angles), np.cos(angles)]])
            turned = np.einsum("np,pqa->nqa", seen, turns)
            likeness = np.abs(np.einsum("nq,nqa->qa", shapes[:, list(pair)].conj(), turned)) ** 2
            size = np.maximum(np.sum(turned**2, axis=0), TINY)
            mac = likeness / size / np.sum(np.abs(shapes[:, list(pair)]) ** 2, axis=0)[:, None]
            best = int(np.argmax(mac.sum(axis=0)))
            V[:, at] = V[:, at] @ turns[:, :, best]
        return V

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

        Exactly where they are combinations of the reduced model's modes; above, the median relative
        effect on those: springs move a few modes much, and the others hardly.
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
        moves = sampled_moves(dofs)
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
        usual = float(np.median(np.diag(own)[n_rigid:] / size))
        rest = np.where(known, 0.0, usual * (self.omega**2 if is_stiffness else 1.0))
        return np.asarray(found + np.diag(rest))

    def machine(self, rng: np.random.Generator) -> DrawnModes:
        """Return the modes of one machine; draws without mass or stiffness are refused."""
        for _ in range(REFUSED):
            found = self._modes(self.machines.draw(rng))
            if found is not None:
                return found
        raise ModelError(
            f"{REFUSED} draws in a row have a mass or stiffness that is not positive: what was "
            "measured does not determine the parameters. Measure more modes."
        )

    def _modes(self, draw: Draw) -> DrawnModes | None:
        """Return modes of one machine, None where it has negative mass or stiffness."""
        r, b = self.whole.n_rigid, self.omega.size
        mixed = self.space.mixed(*self._matrices(draw))
        if mixed is None:
            return None
        omega, V = mixed
        parent = np.argmax(np.abs(V), axis=0)
        zeta = np.zeros(b)
        if self.machines.damping_changes.size > 1:
            reference = np.where(self.zeta > TYPED, self.zeta, 1.0)[parent[r:]]
            mean, size = draw.damping
            log = mean + size * draw.rng.standard_normal(b - r)
            zeta[r:] = np.minimum(reference * np.exp(log), _MOST_DAMPING)
        else:
            zeta[r:] = self.zeta[parent[r:]]
        own = r + assigned(-(V[self.measured, r:] ** 2))
        V = self._turned(V, own)
        omega[own] = np.abs(draw.poles)
        zeta[own] = -draw.poles.real / np.abs(draw.poles)
        return self.space.realisation(omega, zeta, V, np.zeros((0, 2, 2)))

    def _matrices(self, draw: Draw) -> tuple[FloatArray, FloatArray]:
        """Return M' and K' of one machine."""
        r, b, rng = self.whole.n_rigid, self.omega.size, draw.rng
        g = self.omega / (2.0 * np.pi * self.machines.trend.highest)
        trend = 0.5 * np.sign(draw.slope) * np.log1p(2.0 * abs(draw.slope) * g)
        E = draw.deviation * self._together * _symmetric(rng, b)
        # nothing holds rigid-body motions: their rows are mass, which nobody weighed
        unweighed = np.zeros((b, b))
        unweighed[:r], unweighed[:, :r] = E[:r], E[:, :r]
        mass = _exponential(unweighed)
        E -= unweighed
        E += np.diag(2.0 * (1.0 - draw.as_mass) * trend)
        K = self.omega[:, None] * _exponential(E) * self.omega
        for change, amount in zip(self.changes, draw.parameters.tolist(), strict=True):
            mass += amount * change.mass
            K += amount * change.stiffness
        lighter = np.exp(-draw.as_mass * trend)
        M = lighter[:, None] * mass * lighter
        if self._shapes is not None:
            M, K = self._shapes.given(M, K, draw.deviation, rng)
        return 0.5 * (M + M.T), 0.5 * (K + K.T)


def _symmetric(rng: np.random.Generator, b: int) -> FloatArray:
    """Return N + N' (b, b) of standard normal N: deviations 2 on the diagonal, sqrt(2) off it."""
    N = rng.standard_normal((b, b))
    return np.asarray(N + N.T)


def _exponential(E: FloatArray) -> FloatArray:
    """Return exp(E) of a small symmetric matrix: the square of a series, five times as fast."""
    found = unit = np.eye(len(E))
    for k in range(_TERMS, 0, -1):
        found = unit + (0.5 / k) * (E @ found)
    return np.asarray(found @ found.T)


class StatedFamily:
    """Machines whose modes are off by stated Deltas: frequencies, shapes with them, and dampings.

    ``K' = Omega exp(E) Omega``, E symmetric with the drawn relative changes of stiffness on its
    diagonal and deviations ``sqrt(2 s_i s_j)`` off it, s the deviations of the frequencies. A
    mode that the plant leaves out is known as well as the mode that is known least.
    """

    def __init__(self, whole: ModalRealisation, uncertain: Any) -> None:
        self.space = ModeSpace(whole)
        std = np.sqrt(np.diag(uncertain.covariance))
        self.scatter: dict[type[ModeDelta], FloatArray] = {}
        for kind in (FrequencyDelta, DampingDelta):
            known = {
                delta.mode - 1: delta.scale * x
                for delta, x in zip(uncertain.deltas, std, strict=True)
                if isinstance(delta, kind)
            }
            size = np.zeros(whole.pairs.shape[0])
            size[uncertain.plant.realisation.n_modes :] = max(known.values(), default=0.0)
            size[list(known)] = list(known.values())
            self.scatter[kind] = size

    def machine(self, rng: np.random.Generator, drawn: Sequence[tuple[Delta, float]]) -> DrawnModes:
        """Return the modes of one machine at drawn values of the Deltas."""
        logs = {kind: size * rng.standard_normal(size.size) for kind, size in self.scatter.items()}
        for delta, x in drawn:
            logs[type(delta)][delta.mode - 1] = delta.scale * x  # type: ignore[index]
        space, (stiffer, damped) = self.space, logs.values()
        root = np.sqrt(0.5 * self.scatter[FrequencyDelta][space.own])
        E = root[:, None] * _symmetric(rng, root.size) * root
        np.fill_diagonal(E, stiffer[space.own])
        K = space.omega[:, None] * _exponential(E) * space.omega
        mixed = space.mixed(np.eye(root.size), 0.5 * (K + K.T))
        if mixed is None:
            raise ModelError("what is stated of the frequencies leaves no stiffness.")
        omega, V = mixed
        # the damping force of a mode stays where its stiffness changes
        force = space.zeta * space.omega * np.exp(damped[space.own])
        if force.size:
            force = force[np.argmax(np.abs(V), axis=0)]
        zeta = np.divide(force, omega, out=np.zeros_like(omega), where=omega > 0.0)
        pairs = changed_pairs(
            space.whole,
            [
                (kind.of(i + 1, 1.0), float(np.expm1(log[i])))
                for kind, log in logs.items()
                for i in space.rest.tolist()
            ],
        )
        return space.realisation(omega, zeta, V, pairs[space.rest])
