"""How far the frequency and damping of each mode may be off before a loop fails."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from ..checks import ComplexArray, FloatArray, IntArray, Value, positive, whole
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
from ..tolerances import SETTLED, TINY
from .broken import BrokenLoop, inverted
from .machine_draws import MachineDraws

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
    moved, damped = _changes(plant, modes, "freq"), _changes(plant, modes, "damping")
    for i, (grid, move, damp) in enumerate(zip(grids, moved, damped, strict=True)):
        sweep = channels.at(grid, move)
        stable[i] = _crossings(channels, move, grid, sweep, (-limits[i], limits[i]))
        within[i] = _margins(sweep, stable[i], limits[i], 1.0 / margin)
        sweep = channels.at(grid, damp)
        damping[i] = _crossings(channels, damp, grid, sweep, _DAMPINGS)
    own = _known(known, modes)
    return ModeTolerances(modes, freq, stable, within, damping, margin, limits, own)


def machine_draws(
    loop: Any, uncertain: object, margin: float, count: int, rng: Any = 0
) -> MachineDraws:
    """Return the margins of a closed loop's controller on machines of an uncertain plant."""
    if not isinstance(uncertain, UncertainPlant):
        raise ModelError(
            "machines are drawn from an UncertainPlant: close the loop on "
            "plant.uncertain(frequency=...), or pass it as known=."
        )
    loops = map(loop.around, uncertain.sample(rng, whole(count, "draws")))
    margins = [one.modulus_margin if one.is_stable else 0.0 for one in loops]
    return MachineDraws(np.array(margins), margin)


def reported_tolerances(loop: Any) -> ModeTolerances | None:
    """Return what the modes of a closed loop hold to beside what its plant says of them."""
    uncertain, whole_loop = loop.plant.uncertainty, loop.completed or loop
    if uncertain is None or not uncertain.frequencies or not whole_loop.is_stable:
        return None
    known = uncertain.frequencies
    limit = min(max(_FOLLOWED, 1.25 * _SAFE * max(known.values())), LIMIT)
    try:
        found = mode_tolerances(
            whole_loop.plant, whole_loop.broken, margin=MARGIN, known=known, limit=limit
        )
    except ModelError as error:
        warn(f"what the modes of the loop hold to is not computed: {error}")
        return None
    return found.replace(draws=machine_draws(loop, uncertain, MARGIN, _DRAWS))


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
    fine = freq * (1.0 + 1.2 * limit * np.linspace(-1.0, 1.0, 2 * count + 1))
    near = np.union1d(fine, grid[(grid > 0.5 * freq) & (grid < 2.0 * freq)])
    return np.asarray(near[near < 0.5 / dt] if dt else near)


_Kind: TypeAlias = Literal["freq", "damping"]


class _ModeChange(NamedTuple):
    """A mode of the sampled plant as polynomials in a relative change: coefficients of each power.

    A (k, 2, 2), what feeds it from other states (k, 2, n) and from u (k, 2, m), and C (p, 2).
    """

    states: IntArray
    A: FloatArray
    fed: FloatArray
    B: FloatArray
    C: FloatArray


def _changes(plant: StandardPlant, modes: IntArray, kind: _Kind) -> list[_ModeChange]:
    """Return each mode's part of the plant; all are changed at once, for they are uncoupled."""
    driven = plant.system.input_index(plant.u)
    nodes = np.array([0.0, *_NODES[kind]])
    found = []
    for node in nodes:
        amount = (1.0 + node) ** 2 - 1.0 if kind == "freq" else node
        every = [(Delta("", int(mode), kind, 1.0), float(amount)) for mode in modes]
        found.append(with_changes(plant, every).system if node else plant.system)
    rows = plant.system.output_index(plant.y)
    powers = np.linalg.inv(np.vander(nodes, increasing=True))
    where = plant.modal_states.reshape(-1, 2)
    changes = []
    for mode in modes:
        own = where[mode - 1]
        other = np.setdiff1d(np.arange(plant.system.n_states), own)
        seen = [g.C[np.ix_(rows, own)] for g in found]
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
            np.array([g.B[np.ix_(own, driven)] for g in found]),
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
    driven: IntArray
    read: IntArray

    @classmethod
    def of(cls, plant: StandardPlant, broken: BrokenLoop) -> _LoopChannels:
        g = plant.system
        n = g.n_states
        columns = g.input_index(broken.u)
        to_states = StateSpace(
            g.A, g.B[:, columns], np.eye(n), np.zeros((n, len(columns))), g.dt, blocks=g.blocks
        )
        driven = np.array([plant.u.index(name) for name in broken.u])
        read = np.array([plant.y.index(name) for name in broken.y])
        return cls(plant, broken, responder(to_states), driven, read)

    def at(self, freq: FloatArray, change: _ModeChange) -> _Sweep:
        """Return what a mode's equation is made of at frequencies [Hz]."""
        K, P = self.broken.respond(freq)
        S = inverted(K @ P)
        x = np.moveaxis(self.states(freq), 2, 0)
        Q = S @ K @ change.C[self.read]
        X = x[:, change.states]
        F = [fed @ x + B[:, self.driven] for fed, B in zip(change.fed, change.B, strict=True)]
        return _Sweep(points(self.plant.system, freq), S, Q, X, np.array(F), change.A)


class _Sweep(NamedTuple):
    """S, Q, X, F (k, n, 2, m) and A (k, 2, 2) of a mode at points z (n,)."""

    z: ComplexArray
    S: ComplexArray
    Q: ComplexArray
    X: ComplexArray
    F: ComplexArray
    A: FloatArray

    def parts(self, delta: Any) -> tuple[ComplexArray, ComplexArray]:
        """Return ``z I - A(delta)`` and F(delta) at changes: one, or one for each point."""
        powers = np.power.outer(np.asarray(delta), np.arange(len(self.A)))
        A = np.tensordot(powers, self.A, 1)
        F = (
            np.tensordot(powers, self.F, 1)
            if powers.ndim == 1
            else np.einsum("nk,knij->nij", powers, self.F)
        )
        return self.z[:, None, None] * np.eye(2) - A, F

    def matrix(self, delta: Any) -> tuple[ComplexArray, ComplexArray]:
        """Return H (n, 2, 2), and ``F - (z I - A) X``."""
        own, F = self.parts(delta)
        rest = F - own @ self.X
        return own - rest @ self.Q, rest

    def sensitivity(self, delta: float) -> ComplexArray:
        """Return S at u with the mode changed."""
        H, rest = self.matrix(delta)
        turned = np.empty_like(H)  # H^-1 by its adjugate
        turned[:, 0, 0], turned[:, 1, 1] = H[:, 1, 1], H[:, 0, 0]
        turned[:, 0, 1], turned[:, 1, 0] = -H[:, 0, 1], -H[:, 1, 0]
        turned /= _det(H)[:, None, None]
        return np.asarray(self.S + self.Q @ (turned @ (rest @ self.S)))

    def roots(self) -> ComplexArray:
        """Return the complex change (n,) nearest to none at which there is a pole at each point."""
        delta = np.zeros(self.z.size, dtype=np.complex128)
        aside = 1e-6  # the root of rounding, and some more: the slope is good to as much
        for _ in range(12):
            here = _det(self.matrix(delta)[0])
            slope = (_det(self.matrix(delta + aside)[0]) - here) / aside
            with np.errstate(divide="ignore", invalid="ignore"):
                moved = here / slope
            moved = np.where(np.isfinite(moved), moved, 0.0)
            delta = delta - moved
            if np.all(np.abs(moved) <= SETTLED * np.abs(delta)):
                break
            # far away the polynomials say nothing: it is not followed there
            delta = np.where(np.abs(delta) < 3.0, delta, 3.0 * delta / np.maximum(abs(delta), TINY))
        return delta


def _det(H: ComplexArray) -> ComplexArray:
    return np.asarray(H[:, 0, 0] * H[:, 1, 1] - H[:, 0, 1] * H[:, 1, 0])


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


def _margins(sweep: _Sweep, stable: FloatArray, limit: float, size: float) -> FloatArray:
    """Return the changes, downwards and upwards, at which |S| at u reaches a size."""
    found = np.array([-np.inf, np.inf])
    if _exceeds(sweep, 0.0, size):
        return np.zeros(2)
    for side, sign in enumerate((-1.0, 1.0)):
        end = min(abs(stable[side]), limit)
        below = 0.0
        for step in np.geomspace(min(_LEAST, 0.5 * end), end, _TRIED):
            if _exceeds(sweep, sign * step, size):
                above = step
                for _ in range(_HALVINGS):
                    middle = 0.5 * (below + above)
                    if _exceeds(sweep, sign * middle, size):
                        above = middle
                    else:
                        below = middle
                found[side] = sign * above
                break
            below = float(step)
        else:
            if np.isfinite(stable[side]):  # the peak is narrower than the grid shows
                found[side] = stable[side]
    return found


def _exceeds(sweep: _Sweep, delta: float, size: float) -> bool:
    """Return whether sigma_max of S(delta) reaches a size anywhere.

    Between ``||(S* S)^2||_F^(1/4)`` and that over the eighth root of the size of S lies sigma_max:
    it decides at most points.
    """
    S = sweep.sensitivity(delta)
    square = S.conj().swapaxes(1, 2) @ S
    fourth = square @ square
    norm = np.sum(fourth.real**2 + fourth.imag**2, axis=(1, 2)) ** 0.125
    if np.any(norm >= size * S.shape[1] ** 0.125):
        return True
    open_points = norm >= size
    if not np.any(open_points):
        return False
    return bool(np.any(np.linalg.norm(S[open_points], 2, axis=(1, 2)) >= size))


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
