"""Machines of a fit, drawn in modal coordinates, and what measured shapes say of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..arrays import REFUSED, ComplexArray, FloatArray, IntArray, divisor
from ..errors import ModelError
from ..labels import Place
from ..modes.matching import assigned
from ..modes.modes import sampled_moves
from ..sparse.symmetric import dense
from ..structure.rigid import rigid_motions
from ..tolerances import ROUNDING, SAME, TINY, TYPED
from ..updating.machines import MIXED, Draw, Machines
from ..updating.parameters import Parameter, PointParameter
from .realisation import MODAL, ModalRealisation, modes_as_states, natural

#: angles at which a pair is compared with its measured shapes, a quarter of a degree apart
_ANGLES = 721
#: terms of the series of exp(E / 2): relative rounding for norms of E up to 0.3
_TERMS = 9
#: a drawn mode swings
_MOST_DAMPING = 0.9
#: trial variances of the noise of shapes, over the decades of rounding: 15 % apart
_VARIANCES = 200


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
        E = draw.deviation * self._together * symmetric_draw(rng, b)
        # nothing holds rigid-body motions: their rows are mass, which nobody weighed
        unweighed = np.zeros((b, b))
        unweighed[:r], unweighed[:, :r] = E[:r], E[:, :r]
        mass = small_exponential(unweighed)
        E -= unweighed
        E += np.diag(2.0 * (1.0 - draw.as_mass) * trend)
        K = self.omega[:, None] * small_exponential(E) * self.omega
        for change, amount in zip(self.changes, draw.parameters.tolist(), strict=True):
            mass += amount * change.mass
            K += amount * change.stiffness
        lighter = np.exp(-draw.as_mass * trend)
        M = lighter[:, None] * mass * lighter
        if self._shapes is not None:
            M, K = self._shapes.given(M, K, draw.deviation, rng)
        return 0.5 * (M + M.T), 0.5 * (K + K.T)


def symmetric_draw(rng: np.random.Generator, b: int) -> FloatArray:
    """Return N + N' (b, b) of standard normal N: deviations 2 on the diagonal, sqrt(2) off it."""
    N = rng.standard_normal((b, b))
    return np.asarray(N + N.T)


def small_exponential(E: FloatArray) -> FloatArray:
    """Return exp(E) of a small symmetric matrix: the square of a series, five times as fast."""
    found = unit = np.eye(len(E))
    for k in range(_TERMS, 0, -1):
        found = unit + (0.5 / k) * (E @ found)
    return np.asarray(found @ found.T)


class MeasuredShapes:
    """Mode shapes measured at n places, which condition draws of the scatter E of stiffness.

    A machine of stiffness ``Omega exp(E) Omega`` has, to first order, the mode shapes
    ``phi_i + sum_j g_ij E_ij phi_j`` with ``g_ij = w_i w_j / (w_i^2 - w_j^2)``; a rigid-body motion
    j has ``g_ij = -1``, because its E is mass. The difference r (k,) of the measured shapes and the
    model's is therefore ``r = G E + noise``, with the scale of each shape removed. Close pairs,
    whose shapes mix by more than a small angle, say nothing of the scatter within the pair.
    The noise contains errors of the model's shapes. Its variance v is drawn from its posterior, by
    ``r ~ N(0, G C G' + v I)`` with the covariance C of E.

    Parameters
    ----------
    seen : (n, b) array
        Rows of the places over the modes.
    shapes : (n, m) array
        Measured shapes, each of any scale.
    omega : (b,) array [rad/s]
        Frequencies, rigid-body motions first.
    measured : (m,) array of int
        Places of the measured modes among the modes.
    pairs : sequence of pairs of int
        Places of close pairs among the measured modes.
    covariance : (b, b) array
        Variances of the elements of E for a relative deviation of the frequencies of 1.
    deviation : float
        Relative deviation of the frequencies.
    """

    def __init__(
        self,
        seen: FloatArray,
        shapes: ComplexArray,
        omega: FloatArray,
        measured: IntArray,
        pairs: Sequence[tuple[int, int]],
        covariance: FloatArray,
        deviation: float,
    ) -> None:
        self.measured, self.covariance, self.omega = measured, covariance, omega
        own = omega[measured, None]
        gap = own**2 - omega**2
        gains = np.divide(
            own * omega, gap, out=np.zeros_like(gap), where=np.abs(gap) > SAME * own**2
        )
        gains[:, omega == 0.0] = -1.0
        self._near = np.zeros(gains.shape, dtype=bool)
        places, m = len(seen), len(measured)
        model = seen[:, measured]
        sizes = divisor(la.norm(model, axis=0))
        scales = np.sum(shapes.conj() * model, axis=0) / divisor(la.norm(shapes, axis=0) ** 2)
        scaled = (scales * shapes).real
        self._beyond = 0.0
        if places > omega.size:  # what no mode shows is noise alone, whatever the scatter
            basis = la.qr(seen, mode="economic")[0]
            whole, seen, scaled = scaled, basis.T @ seen, basis.T @ scaled
            self._beyond = float(np.sum(((whole - basis @ scaled) / sizes) ** 2))
        n = len(seen)
        self.rows, self.effects = np.zeros((2, m, n, omega.size))
        self.off, count = np.zeros((m, n)), 0
        for k in range(m):
            near = [k, *(sum(pair) - k for pair in pairs if k in pair)]
            self._near[k, measured[near]] = True
            gains[k, self._near[k]] = 0.0
            plane = la.orth(seen[:, measured[near]])
            apart = (np.eye(n) - plane @ plane.T) / sizes[k]
            self.rows[k] = apart @ seen
            self.effects[k] = self.rows[k] * gains[k]
            self.off[k] = apart @ scaled[:, k]
            count += places - plane.shape[1]
        values, self._vectors = la.eigh(self._prior())
        self._values = np.where(values > ROUNDING * values[-1], values, 0.0)
        self.variances, self.chances = self._noise(count, deviation)

    def _prior(self) -> FloatArray:
        """Return G C G' (m n, m n): two measured modes share one element of E."""
        m, n, _ = self.effects.shape
        of = self.covariance[self.measured]
        A = np.zeros((m, n, m, n))
        each = np.arange(m)
        A[each, :, each, :] = np.einsum("knb,kb,kpb->knp", self.effects, of, self.effects)
        both = self.effects[:, :, self.measured]
        A += np.einsum("knl,kl,lpk->knlp", both, of[:, self.measured], both)
        return A.reshape(m * n, m * n)

    def _noise(self, count: int, deviation: float) -> tuple[FloatArray, FloatArray]:
        """Return trial variances of the noise and their posterior probabilities.

        Its standard deviation has a flat prior between rounding and all of the misfit.
        """
        misfit = (self._vectors.T @ self.off.ravel()) ** 2
        most = max((float(misfit.sum()) + self._beyond) / max(count, 1), TINY)
        v = most * np.geomspace(ROUNDING, 1.0, _VARIANCES)
        of = deviation**2 * self._values[:, None] + v
        # directions along the shapes have no misfit, because their scale was removed
        log = (misfit.size - count + 1) * np.log(v) - self._beyond / v
        log -= np.sum(np.log(of) + misfit[:, None] / of, axis=0)
        chance = np.exp(0.5 * (log - log.max()))
        return v, chance / chance.sum()

    def given(
        self, M: FloatArray, K: FloatArray, deviation: float, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Return mass and stiffness (b, b) of a draw, conditioned on the shapes by Matheron's rule.

        What its shapes miss is taken to first order, with all that moves them.
        """
        own, size = self.measured, np.diag(K) / np.diag(M)
        gap = size[own, None] - size
        mixed = (K[own] - size[own, None] * M[own]) / np.where(gap == 0.0, np.inf, gap)
        mixed[self._near] = 0.0
        v = rng.choice(self.variances, p=self.chances)
        noise = np.sqrt(v) * rng.standard_normal(self.off.shape)
        missed = self.off - np.einsum("knb,kb->kn", self.rows, mixed) - noise
        left = self._vectors.T @ missed.ravel()
        left /= deviation**2 * self._values + v
        left[self._values == 0.0] = 0.0
        weights = (self._vectors @ left).reshape(self.off.shape)
        moved = np.zeros_like(K)
        moved[own] = np.einsum("knb,kn->kb", self.effects, weights)
        E = deviation**2 * self.covariance * (moved + moved.T)
        rigid = (self.omega == 0.0) | (self.omega[:, None] == 0.0)
        return M + np.where(rigid, E, 0.0), K + self.omega[:, None] * E * self.omega
