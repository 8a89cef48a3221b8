"""How far the frequency and damping of each mode may be off before a loop fails."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..checks import (
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    Value,
    generator,
    positive,
    whole,
)
from ..errors import AssumptionError, ModelError, counted, warn
from ..lti.responses import Responder, points, responder
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..plant.uncertainty.uncertain_plant import (
    Delta,
    UncertainPlant,
    modal_realisation,
    with_changes,
)
from ..plant.uncertainty.whole_machines import draws_with_left_out
from ..tolerances import SETTLED, TINY
from .broken import BrokenLoop, inverted
from .spill_over import MachineDraws

#: relative change of frequency up to which a mode is followed
LIMIT = 0.05
#: points of the grid around a mode to a half-width of its resonance (a peak between two is seen
#: to 3 %), and how many at most aside
_TO_A_WIDTH, _ASIDE = 2, 400
#: relative changes at which the sampled plant is computed; between them its matrices are
#: polynomials of degree 4, whose error is (omega dt)^5 LIMIT^5: rounding
_NODES: Mapping[str, tuple[float, ...]] = {
    "freq": (-LIMIT, -0.5 * LIMIT, 0.5 * LIMIT, LIMIT),
    "damping": (-0.9, -0.45, 1.0, 2.0),
}
#: times the largest change about a mode where its resonance passes, with its skirts
_PASSED = 1.2
#: part of the size looked for that |S| has, with the mode where it is or at an end, at all points
#: which the resonance does not pass and which are examined in between
_NEAR = 0.7
#: range of relative changes of damping that is searched: without any, a mode that the loop does
#: not see is marginal
_DAMPINGS = (-0.999, 2.0)
#: least relative change of a frequency that is of interest: poles are not measured better
_LEAST = 1e-6
#: changes tried for a margin before the first that fails is halved in, and halvings
_TRIED, _HALVINGS = 16, 8
#: the tolerance is to be so many times what is known of a mode
_SAFE = 2.0
#: modulus margin to which tolerances are stated: |S| at u of 2.9, 9 dB
MARGIN = 0.35
#: relative change of a frequency to which a report follows a mode (a model that was updated is
#: seldom further off), and machines that it draws: a second of work at most
_FOLLOWED, _DRAWS = 0.01, 20
#: rows of the table
_SHOWN = 5


@dataclass(frozen=True, eq=False, repr=False)
class ModeTolerances(Value):
    """The smallest change of each mode, the others as they are, at which a loop fails.

    Two columns: the change downwards (negative) and upwards; infinite where none is found up to
    `limit`. A frequency changes by its stiffness, the damping force stays as it is.

    Parameters
    ----------
    modes : (m,) array
        Numbers from 1, rigid-body modes included.
    freq : (m,) array [Hz]
        Of the modes in the plant.
    stable : (m, 2) array
        Relative changes of frequency at which the loop becomes unstable.
    within : (m, 2) array
        Relative changes of frequency at which its modulus margin falls to `margin`.
    damping : (m, 2) array
        Relative changes of damping at which it becomes unstable, from -1 to 2.
    margin : float
        Of `within`, broken at u.
    limit : (m,) array
        Largest relative change of frequency examined.
    known : (m,) array, optional
        Relative uncertainty of each frequency.
    draws : MachineDraws, optional
        Machines on which all that is uncertain is off at once.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> fx.close_loop(plant, observer, servo).mode_tolerances()
    <ModeTolerances of 2 modes: no frequency of a mode off by 5 % does harm
      mode       Hz   |S| at u of 2.86       unstable
         2   100.66         ->5 +>5 %        ->5 +>5 %
         3   174.35         ->5 +>5 %        ->5 +>5 %>
    """

    modes: IntArray
    freq: FloatArray
    stable: FloatArray
    within: FloatArray
    damping: FloatArray
    margin: float
    limit: FloatArray
    known: FloatArray | None = None
    draws: MachineDraws | None = None

    @property
    def least(self) -> FloatArray:
        """The smallest relative change of each frequency (m,) that leads to `margin` or beyond."""
        return np.asarray(np.abs(np.hstack([self.within, self.stable])).min(axis=1))

    @property
    def critical(self) -> tuple[int, ...]:
        """Modes that hold to less than twice what is known of them; empty when nothing is known."""
        if self.known is None:
            return ()
        return tuple(self.modes[self.least < _SAFE * self.known].tolist())

    @property
    def summary(self) -> str:
        """The mode that may change least, in words."""
        if not self.modes.size:
            return "no elastic mode"
        worst = int(np.argmin(self.least))
        if not np.isfinite(self.least[worst]):
            return f"no frequency of a mode off by {100 * self.limit.min():.2g} % does harm"
        to = f"a modulus margin of {self.margin:.3g}"
        side = int(np.argmin(np.abs(self.within[worst])))
        change = self.within[worst, side]
        if not np.isfinite(change):
            change = self.stable[worst, int(np.argmin(np.abs(self.stable[worst])))]
            to = "instability"
        return (
            f"mode {self.modes[worst]} ({self.freq[worst]:.4g} Hz) off by {100 * change:+.2g} % "
            f"leads to {to}"
        )

    @property
    def certificate(self) -> dict[str, float]:
        """What the mode that is nearest to what is known of it holds to, and the draws."""
        found: dict[str, float] = {}
        if self.modes.size:
            known = np.ones_like(self.least) if self.known is None else self.known
            with np.errstate(divide="ignore"):
                worst = int(np.argmin(self.least / known))
            name = f"mode {self.modes[worst]}"
            if np.isfinite(self.least[worst]):  # else no change of a mode alone matters
                found[f"{name} holds to"] = float(self.least[worst])
                if self.known is not None:
                    found[f"{name} known to"] = float(self.known[worst])
        if self.draws is not None:
            found |= {"stable of draws": self.draws.stable, "margin kept of draws": self.draws.kept}
        return found

    def warn_of_critical(self) -> None:
        """Warn of modes that hold to less than twice what is known of them."""
        if self.known is None or not self.critical:
            return
        said = [
            f"mode {mode} ({freq:.4g} Hz) holds to {100 * least:.2g} %, is known to "
            f"{100 * known:.2g} %"
            for mode, freq, least, known in zip(
                self.modes, self.freq, self.least, self.known, strict=True
            )
            if mode in self.critical
        ]
        more = f" and {len(said) - _SHOWN} more" if len(said) > _SHOWN else ""
        drawn = "" if self.draws is None else f" Of machines drawn {self.draws.summary}."
        warn(
            "the loop hangs on frequencies that are not known well enough: "
            f"{'; '.join(said[:_SHOWN])}{more}.{drawn} Measure these modes, or design for their "
            "uncertainty: design_stage(plant.uncertain(...))."
        )

    def __repr__(self) -> str:
        lines = [f"<ModeTolerances of {counted(self.modes.size, 'mode')}: {self.summary}"]
        known = "" if self.known is None else "     known to"
        lines.append(f"  mode       Hz   |S| at u of {1 / self.margin:.3g}       unstable{known}")
        for i in np.argsort(self.least, kind="stable")[:_SHOWN]:
            row = [_ends(ends, self.limit[i]) for ends in (self.within[i], self.stable[i])]
            own = "" if self.known is None else f"{100 * self.known[i]:10.2g} %"
            mark = "  !" if self.modes[i] in self.critical else ""
            lines.append(
                f"  {self.modes[i]:4d} {self.freq[i]:8.5g}  {row[0]:>16} {row[1]:>16}{own}{mark}"
            )
        if self.modes.size > _SHOWN:
            lines.append(f"  ... and {self.modes.size - _SHOWN} more")
        if self.draws is not None:
            lines.append(f"  all at once: {self.draws.summary}")
        return "\n".join(lines) + ">"


def _ends(ends: FloatArray, limit: float) -> str:
    """Return two ends of a range in percent."""
    low, high = (
        f"{100 * end:+.2g}" if np.isfinite(end) else f"{sign}>{100 * limit:.2g}"
        for end, sign in zip(ends, "-+", strict=True)
    )
    return f"{low} {high} %"


def mode_tolerances(
    plant: StandardPlant,
    broken: BrokenLoop,
    *,
    margin: float,
    known: Any = None,
    limit: float = LIMIT,
) -> ModeTolerances:
    r"""Return the smallest changes of each mode that harm a stable loop.

    With all of the plant's other modes closed, and mode i of the state x_i driven by F_i u and
    seen by C_i in y, ``S = (I - K P)^-1``, ``Q_i = S K C_i`` and X_i the response from u to x_i,

    .. math:: H_i(z, \delta) = (z I - A_i(\delta)) (I + X_i Q_i) - F_i(z, \delta) Q_i, \quad
        S(\delta) = S + Q_i H_i^{-1} (F_i(z, \delta) - (z I - A_i(\delta)) X_i) S:

    a pole of the changed loop lies at z where ``det H_i = 0``. At each z of the stability boundary
    that is an equation for a complex delta; where its imaginary part changes its sign along the
    boundary, a pole crosses it at a real delta. A_i, F_i are those of the sampled plant, exact.
    """
    modal_realisation(plant)
    margin = positive(margin, "margin")
    if margin >= 1.0:
        raise ModelError(f"margin must be below 1, the largest that a loop can keep, got {margin}.")
    modes, freq, zeta = _elastic(plant)
    if broken.is_unstable:
        raise AssumptionError(
            "the loop is unstable as it is: no mode has a tolerance. Stabilise it first."
        )
    limits = np.minimum(limit, _ASIDE / _TO_A_WIDTH * zeta)
    grids = [
        _around(f, z, end, broken.grid, plant.dt)
        for f, z, end in zip(freq, zeta, limits, strict=True)
    ]
    channels = _LoopChannels.of(plant, broken)
    shape = (modes.size, 2)
    stable, within, damping = np.full(shape, np.inf), np.full(shape, np.inf), np.full(shape, np.inf)
    moved, damped = (_changes(plant, broken, modes, kind) for kind in ("freq", "damping"))
    shared = channels.responses(np.unique(np.concatenate([*grids, np.zeros(0)])))
    for i, (grid, move, damp) in enumerate(zip(grids, moved, damped, strict=True)):
        sweep = shared.sweep(move, grid)
        stable[i] = _crossings(channels, move, grid, sweep, (-limits[i], limits[i]))
        passed = np.abs(grid / freq[i] - 1.0) <= _PASSED * limits[i]
        within[i] = _margins(sweep, passed, stable[i], limits[i], 1.0 / margin)
        damping[i] = _crossings(channels, damp, grid, shared.sweep(damp, grid), _DAMPINGS)
    own = _known(known, modes)
    return ModeTolerances(modes, freq, stable, within, damping, margin, limits, own)


def machine_draws(
    loop: Any, uncertain: object, margin: float, count: int, rng: Any = 0
) -> MachineDraws:
    """Return the margins of a closed loop's controller on machines of an uncertain plant.

    With the modes left out, whose frequencies are off too, where these are known.
    """
    if not isinstance(uncertain, UncertainPlant):
        raise ModelError(
            "machines are drawn from an UncertainPlant: close the loop on "
            "plant.uncertain(frequency=...), or pass it as known=."
        )
    number, chance = whole(count, "draws"), generator(rng)
    around, machines = loop.completed or loop, None
    if loop.completed is not None:
        machines = draws_with_left_out(uncertain, around.plant, chance, number)
    if machines is None:  # what is uncertain is no property of the larger plant's modes
        around, machines = loop, iter(uncertain.sample(chance, number))
    loops = map(around.around, machines)
    margins = [one.modulus_margin if one.is_stable else 0.0 for one in loops]
    return MachineDraws(np.array(margins), margin)


def reported_tolerances(loop: Any) -> ModeTolerances | None:
    """Return what the modes of a closed loop hold to, beside what its plant says of them.

    With the modes left out, where these are known and frequencies are uncertain; of a sure plant
    without: its models are large, and what they add to the answer is little.
    """
    uncertain = loop.plant.uncertainty
    if uncertain is None:
        sure = loop.plant.has_own_modes and loop.is_stable
        return _within(loop, {}) if sure else None
    whole_loop = loop.completed or loop
    if not uncertain.frequencies or not whole_loop.is_stable:
        return None
    found = _within(whole_loop, uncertain.frequencies)
    return found and found.replace(draws=machine_draws(loop, uncertain, MARGIN, _DRAWS))


def _within(loop: Any, known: Mapping[int, float]) -> ModeTolerances | None:
    """Return the tolerances of a stable loop to the changes that a report follows."""
    limit = min(max(_FOLLOWED, 1.25 * _SAFE * max(known.values(), default=0.0)), LIMIT)
    try:
        return mode_tolerances(
            loop.plant, loop.broken, margin=MARGIN, known=known or None, limit=limit
        )
    except ModelError as error:
        if known:
            warn(f"what the modes of the loop hold to is not computed: {error}")
        return None


def _elastic(plant: StandardPlant) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return numbers, frequencies [Hz] and damping ratios of the modes that swing below Nyquist."""
    realisation = plant.assembled.realisation
    trace = np.trace(realisation.pairs, axis1=1, axis2=2)
    square = np.linalg.det(realisation.pairs)
    omega = np.sqrt(np.maximum(square, 0.0))
    zeta = -0.5 * trace / np.maximum(omega, TINY)
    top = np.pi / plant.dt if plant.dt else np.inf
    swings = (np.arange(omega.size) >= realisation.n_rigid) & (zeta < 1.0) & (omega < top)
    keep = np.flatnonzero(swings & (omega > 0))
    return keep + 1, omega[keep] / (2.0 * np.pi), zeta[keep]


def _around(freq: float, zeta: float, limit: float, grid: FloatArray, dt: float) -> FloatArray:
    """Return frequencies [Hz] through the places that a mode may take, and about it."""
    count = int(np.ceil(limit * _TO_A_WIDTH / max(zeta, TINY)))
    count = min(max(count, 2 * _TO_A_WIDTH), _ASIDE)
    fine = freq * (1.0 + _PASSED * limit * np.linspace(-1.0, 1.0, 2 * count + 1))
    near = np.union1d(fine, grid[(grid > 0.5 * freq) & (grid < 2.0 * freq)])
    return np.asarray(near[near < 0.5 / dt] if dt else near)


class _ModeChange(NamedTuple):
    """A mode of the sampled plant as polynomials in a relative change: coefficients of each power.

    A (k, 2, 2), what feeds it from other states (k, 2, n) and from the loop's u (k, 2, m), and the
    rows C (p, 2) of its y.
    """

    states: IntArray
    A: FloatArray
    fed: FloatArray
    B: FloatArray
    C: FloatArray


def _changes(
    plant: StandardPlant, broken: BrokenLoop, modes: IntArray, kind: Any
) -> list[_ModeChange]:
    """Return each mode's part of the plant; all are changed at once, for they are uncoupled."""
    nodes = np.array([0.0, *_NODES[kind]])
    found = []
    for node in nodes:
        amount = (1.0 + node) ** 2 - 1.0 if kind == "freq" else node
        every = [(Delta("", int(mode), kind, 1.0), float(amount)) for mode in modes]
        found.append(with_changes(plant, every).system if node else plant.system)
    powers = np.linalg.inv(np.vander(nodes, increasing=True))
    where = plant.modal_states.reshape(-1, 2)
    changes = []
    for mode in modes:
        own = where[mode - 1]
        other = np.setdiff1d(np.arange(plant.system.n_states), own)
        seen = [g.C[np.ix_(g.output_index(broken.y), own)] for g in found]
        if any(not np.array_equal(one, seen[0]) for one in seen):
            raise ModelError(
                "a sensor of y sees accelerations, in which frequency and damping of a mode "
                "appear: its tolerance is not computed. Leave accelerometers out of y."
            )
        fed = np.zeros((nodes.size, 2, plant.system.n_states))
        fed[:, :, other] = np.array([g.A[np.ix_(own, other)] for g in found])
        parts = (
            np.array([g.A[np.ix_(own, own)] for g in found]),
            fed,
            np.array([g.B[np.ix_(own, g.input_index(broken.u))] for g in found]),
        )
        A, F, B = (np.tensordot(powers, part, 1) for part in parts)
        changes.append(_ModeChange(own, A, F, B, seen[0]))
    return changes


@dataclass(frozen=True)
class _LoopChannels:
    """The loop and the states of the plant, at any frequencies."""

    plant: StandardPlant
    broken: BrokenLoop
    states: Responder

    @classmethod
    def of(cls, plant: StandardPlant, broken: BrokenLoop) -> _LoopChannels:
        g = plant.system
        n = g.n_states
        columns = g.input_index(broken.u)
        to_states = StateSpace(
            g.A, g.B[:, columns], np.eye(n), np.zeros((n, len(columns))), g.dt, blocks=g.blocks
        )
        return cls(plant, broken, responder(to_states))

    def responses(self, freq: FloatArray) -> _Responses:
        """Return the loop's responses at frequencies [Hz]."""
        K, P = self.broken.respond(freq)
        S = inverted(K @ P)
        x = np.moveaxis(self.states(freq), 2, 0)
        return _Responses(freq, points(self.plant.system, freq), S, S @ K, x)

    def at(self, freq: FloatArray, change: _ModeChange) -> _Sweep:
        """Return what a mode's equation is made of at frequencies [Hz]."""
        return self.responses(freq).sweep(change)


class _Responses(NamedTuple):
    """S, S K and the states' responses x (n, states, m) at points z of frequencies [Hz]."""

    freq: FloatArray
    z: ComplexArray
    S: ComplexArray
    SK: ComplexArray
    x: ComplexArray

    def sweep(self, change: _ModeChange, freq: FloatArray | None = None) -> _Sweep:
        """Return what a mode's equation is made of, at some of the frequencies or all."""
        at = slice(None) if freq is None else np.searchsorted(self.freq, freq)
        z, Q = self.z[at], self.SK[at] @ change.C
        fed = np.flatnonzero(np.any(change.fed != 0.0, axis=(0, 1)))
        others, X = self.x[:, fed][at], self.x[:, change.states][at]
        from_others = np.einsum("kij,njm->knim", change.fed[:, :, fed], others)
        F = from_others + change.B[:, None]
        own = np.tile(-change.A[:, None].astype(complex), (1, z.size, 1, 1))
        own[0] += z[:, None, None] * np.eye(2)
        rest = F - own @ X
        return _Sweep(self.S[at], Q, rest, own - rest @ Q)


class _Sweep(NamedTuple):
    """S (n, m, m), Q (n, m, 2) of a mode, and as polynomials in its change two more.

    ``F - (z I - A) X`` (k, n, 2, m) and H (k, n, 2, 2), coefficients of each power.
    """

    S: ComplexArray
    Q: ComplexArray
    rest: ComplexArray
    H: ComplexArray

    def at(self, where: IntArray) -> _Sweep:
        """Return the sweep at some of the points."""
        return _Sweep(self.S[where], self.Q[where], self.rest[:, where], self.H[:, where])

    def sensitivity(self, delta: Any) -> ComplexArray:
        """Return S at u with the mode changed, alike or for each point (n,)."""
        each = np.reshape(delta, (-1, 1, 1))
        H, rest = _value(self.H, each), _value(self.rest, each)
        turned = np.empty_like(H)  # H^-1 by its adjugate
        turned[:, 0, 0], turned[:, 1, 1] = H[:, 1, 1], H[:, 0, 0]
        turned[:, 0, 1], turned[:, 1, 0] = -H[:, 0, 1], -H[:, 1, 0]
        turned /= (H[:, 0, 0] * H[:, 1, 1] - H[:, 0, 1] * H[:, 1, 0])[:, None, None]
        return np.asarray(self.S + self.Q @ (turned @ (rest @ self.S)))

    def roots(self) -> ComplexArray:
        """Return the complex change (n,) nearest to none at which there is a pole at each point.

        By Newton's method: det H is a polynomial of twice the degree of H.
        """
        powers = np.arange(2 * len(self.H) - 1)
        det = np.zeros((powers.size, self.S.shape[0]), dtype=np.complex128)
        for i, a in enumerate(self.H):
            for j, b in enumerate(self.H):
                det[i + j] += a[:, 0, 0] * b[:, 1, 1] - a[:, 0, 1] * b[:, 1, 0]
        slope = powers[1:, None] * det[1:]
        delta = np.zeros(det.shape[1], dtype=np.complex128)
        for _ in range(12):
            with np.errstate(divide="ignore", invalid="ignore"):
                moved = _value(det, delta) / _value(slope, delta)
            moved = np.where(np.isfinite(moved), moved, 0.0)
            delta = delta - moved
            if np.all(np.abs(moved) <= SETTLED * np.abs(delta)):
                break
            # far away the polynomials say nothing: it is not followed there
            delta = np.where(np.abs(delta) < 3.0, delta, 3.0 * delta / np.maximum(abs(delta), TINY))
        return delta


def _value(polynomial: ComplexArray, at: Any) -> ComplexArray:
    """Return a polynomial's value by Horner's rule, its coefficients along the first axis."""
    found = polynomial[-1]
    for coefficient in polynomial[-2::-1]:
        found = found * at + coefficient
    return np.asarray(found)


def _crossings(
    channels: _LoopChannels,
    change: _ModeChange,
    grid: FloatArray,
    sweep: _Sweep,
    ends: tuple[float, float],
) -> FloatArray:
    """Return the real changes next to none, downwards and upwards, at which a pole crosses."""
    found = np.array([-np.inf, np.inf])
    for low, high in _sign_changes(sweep.roots(), ends):
        freq = grid[[low, high]]
        for _ in range(3):  # each narrows the interval by 16
            fine = np.linspace(freq[0], freq[1], 17)
            each = channels.at(fine, change).roots()
            pairs = _sign_changes(each, ends)
            if not pairs:
                break
            first, last = pairs[0]
            freq = fine[[first, last]]
            size = np.abs(each.imag[[first, last]])
            weight = size[0] / max(size.sum(), TINY)
            value = float(np.interp(weight, [0.0, 1.0], each.real[[first, last]]))
        else:
            side = int(value > 0)
            if abs(value) < abs(found[side]):
                found[side] = value
    return found


def _sign_changes(delta: ComplexArray, ends: tuple[float, float]) -> list[tuple[int, int]]:
    """Return neighbours between which Im delta changes its sign, Re delta within a range."""
    turns = np.sign(delta.imag[:-1]) * np.sign(delta.imag[1:]) < 0
    inside = (delta.real > ends[0]) & (delta.real < ends[1])
    where = np.flatnonzero(turns & inside[:-1] & inside[1:])
    return [(int(k), int(k) + 1) for k in where]


def _margins(
    sweep: _Sweep, passed: BoolArray, stable: FloatArray, limit: float, size: float
) -> FloatArray:
    """Return the changes, downwards and upwards, at which |S| at u reaches a size.

    Where the resonance does not pass, |S| changes little and one way: only points are examined
    that come near the size at an end.
    """
    found = np.array([-np.inf, np.inf])
    if _exceeds(sweep, np.zeros(1), size)[0]:
        return np.zeros(2)
    ends = [min(abs(end), limit) for end in stable]
    near = passed.copy()
    for change in (0.0, -ends[0], ends[1]):
        near |= _size(sweep.sensitivity(change)) >= _NEAR * size
    sweep = sweep.at(np.flatnonzero(near))
    for side, sign in enumerate((-1.0, 1.0)):
        steps = np.geomspace(min(_LEAST, 0.5 * ends[side]), ends[side], _TRIED)
        high = np.flatnonzero(_exceeds(sweep, sign * steps, size))
        if high.size:
            below, above = np.concatenate([[0.0], steps])[[high[0], high[0] + 1]]
            for _ in range(_HALVINGS):
                middle = 0.5 * (below + above)
                if _exceeds(sweep, np.array([sign * middle]), size)[0]:
                    above = middle
                else:
                    below = middle
            found[side] = sign * above
        elif np.isfinite(stable[side]):  # the peak is narrower than the grid shows
            found[side] = stable[side]
    return found


def _exceeds(sweep: _Sweep, deltas: FloatArray, size: float) -> BoolArray:
    """Return whether sigma_max of S reaches a size anywhere, for each of some changes (k,)."""
    n = len(sweep.S)
    S = sweep.at(np.tile(np.arange(n), deltas.size)).sensitivity(np.repeat(deltas, n))
    norm = _size(S)
    reached = norm >= size * S.shape[1] ** 0.125
    open_ = np.flatnonzero((norm >= size) & ~reached)
    reached[open_] = np.linalg.norm(S[open_], 2, axis=(1, 2)) >= size
    return np.asarray(np.any(reached.reshape(deltas.size, n), axis=1))


def _size(S: ComplexArray) -> FloatArray:
    """Return ``||(S* S)^2||_F^(1/4)``: at least sigma_max, at most its eighth root of m times."""
    square = S.conj().swapaxes(1, 2) @ S
    fourth = square @ square
    return np.asarray(np.sum(fourth.real**2 + fourth.imag**2, axis=(1, 2)) ** 0.125)


def _known(given: Any, modes: IntArray) -> FloatArray | None:
    """Return the relative uncertainty of each frequency, zero where nothing is said of it."""
    if given is None:
        return None
    if isinstance(given, UncertainPlant):
        given = given.frequencies
    if isinstance(given, Mapping):
        return np.array([float(given.get(int(mode), 0.0)) for mode in modes])
    values = np.asarray(given, dtype=np.float64)
    if values.ndim and values.shape != modes.shape:
        raise ModelError(
            f"known has the shape {values.shape}, the plant {counted(modes.size, 'elastic mode')}: "
            "pass a number, one for each, {mode: number} or an UncertainPlant."
        )
    return np.broadcast_to(values, modes.shape).copy()
