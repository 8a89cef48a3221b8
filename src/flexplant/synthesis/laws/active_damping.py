"""Active damping: the gain and the filter that give a mode a damping ratio, other modes kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from ...arrays import ComplexArray, FloatArray, between, whole
from ...errors import AssumptionError, LabelError, ModelError, counted, require_known, short
from ...loop import ClosedLoop, close_loop
from ...lti.frequency_sweep import resonance_grid
from ...lti.interconnection import lft, series
from ...lti.response_solvers import continuous_poles, responder
from ...lti.statespace import StateSpace
from ...plant import StandardPlant, standard_plant
from ...plant.uncertainty.uncertain_plants import made_of
from ...store import Value
from ...tolerances import NEGLIGIBLE, ROUNDING
from .damping_elements import KINDS, DampingElement
from .servo_loops import HIGHEST

#: gains that are tried, over that at which the loop gain at the mode is 1; then around the best
_GAINS = np.geomspace(0.02, 50.0, 40)
#: least damping of the other modes, relative to their damping without the loop
_KEPT = 0.7
#: gains around the best
_FINE = 41
#: kinds by their names
Kind = Literal["velocity", "ppf", "irc"]


@dataclass(frozen=True, eq=False, repr=False)
class ActiveDamping(Value):
    """The controller that damps one mode, with its verified results: the result of `damp_modes`.

    Parameters
    ----------
    element : DampingElement
        The tuned element. Its input is the error (minus the measurement), and its output is the
        command.
    controller : StateSpace
        Controller from y to u, including the sign of the feedback. `close_loop` takes it, also
        together with a servo. The commands of both are then added.
    freq : float [Hz]
        Frequency of the mode without the loop.
    before, damping : float
        Damping ratios without and with the loop. `before` is that of the mode without the loop.
        `damping` is the smallest one of the mode and of the poles of the filter with the loop.
    margin : float
        Modulus margin of the loop.
    undamped : StandardPlant
        The plant without the loop.
    """

    element: DampingElement
    controller: StateSpace
    freq: float
    before: float
    damping: float
    margin: float
    undamped: StandardPlant

    @property
    def system(self) -> StateSpace:
        """The controller. `close_loop` reads this attribute."""
        return self.controller

    @cached_property
    def loop(self) -> ClosedLoop:
        """The closed loop of plant and controller.

        If the plant has an evaluation model, which has more modes than the design model, the loop
        is also checked on it.
        """
        others = [name for name in self.undamped.u if name not in self.controller.outputs]
        return close_loop(self.undamped, self.controller, idle=others)

    @cached_property
    def plant(self) -> StandardPlant:
        """The plant with the damping loop closed, to which a servo can add its commands."""
        found = _with_loop(self.undamped, self.controller)
        whole_plant = self.undamped.evaluation_plant
        if whole_plant is None:
            return found
        return found.replace(evaluation=_with_loop(whole_plant, self.controller))

    @property
    def loop_gain(self) -> StateSpace:
        """Loop gain L (negative feedback) of the tuned element.

        `fx.plot.root_locus` multiplies it by a factor. The factor 1 belongs to the tuned gain.
        """
        gain: StateSpace = -series(self.undamped.Gyu.select(
            self.controller.inputs, self.controller.outputs), self.controller)  # fmt: skip
        return gain

    def __repr__(self) -> str:
        return (
            f"<ActiveDamping of {self.freq:.4g} Hz by {self.element!r}: damping ratio "
            f"{self.before:.3g} to {self.damping:.3g}, modulus margin {self.margin:.2f}>"
        )


def damp_modes(
    plant: Any,
    kind: Kind | type[DampingElement],
    *,
    mode: int = 1,
    u: str | None = None,
    y: str | None = None,
    damping: float | None = None,
    margin: float = 0.3,
) -> ActiveDamping:
    """Return a law that damps one mode, to a given damping ratio or as much as possible.

    The search tries filters of the given kind with several corner frequencies. The sign of the gain
    is chosen so that a small gain moves the pole of the mode to the left. For each filter the size
    of the gain is varied along the root locus. The filter adds poles to the loop, and these must be
    damped too. The search therefore maximises the smallest damping ratio of the mode's pole and the
    poles of the filter. A law is accepted only if it keeps the modulus margin, does not move
    rigid-body poles to the right, and keeps at least 70 % of the damping ratio of every other mode.
    If a damping ratio is given, the result is the law that reaches it with the smallest gain of the
    filter at the frequency of the mode.

    Parameters
    ----------
    plant : StandardPlant, or what `standard_plant` takes
        Continuous or sampled plant, whose sensors measure displacement.
    kind : {"velocity", "ppf", "irc"} or a class of DampingElement
        Kind of the law. The three names stand for `VelocityFeedback`, `PositivePositionFeedback`
        and `IntegralResonantControl`.
    mode : int
        Number of the mode, from 1, in the order of frequency. Only oscillating poles of the path
        from u to y are counted, so that rigid-body modes and real poles are left out.
    u, y : str, optional
        Actuator and sensor, at the same place (collocated) or not; needed if the plant has several.
    damping : float, optional
        Damping ratio to be reached, below 1; by default the largest possible one.
    margin : float
        Modulus margin that the loop must keep, between 0 and 1. The modulus margin is one over the
        largest magnitude of the sensitivity S.

    Returns
    -------
    ActiveDamping
        The result is a block for `close_loop`. Its attribute `plant` is the damped plant, for which
        a servo can be designed.

    Raises
    ------
    AssumptionError
        When no law of the kind reaches the given damping ratio, or no law damps the mode.
    LabelError, ModelError
        When u or y is unknown or must be named, the mode does not exist, or a number is out of
        range.

    References
    ----------
    [Preumont2018]_, chapters 5 and 7.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> damped = fx.synthesis.damp_modes(plant, "velocity", y="y1", damping=0.1)
    >>> round(damped.before, 3), round(damped.damping, 2)
    (0.01, 0.1)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=fx.design_kalman(plant))
    >>> fx.close_loop(plant, damped, fx.design_kalman(plant), servo).is_stable
    True
    """
    given = standard_plant(plant)
    chosen = KINDS.get(kind, kind) if isinstance(kind, str) else kind
    if not (isinstance(chosen, type) and issubclass(chosen, DampingElement)):
        raise ModelError(
            f"kind must be one of {', '.join(map(repr, KINDS))} or a class of DampingElement, got "
            f"{short(kind)}."
        )
    wanted = None if damping is None else between(damping, "damping", 0.0, 1.0, "0.1, say.")
    least = between(margin, "margin", 0.0, 1.0, "0.3, say.")
    sensors = [name for name in given.y if name not in given.w]
    ends = _one(y, "sensor", "y", sensors), _one(u, "actuator", "u", given.u)
    g = given.Gyu.select([ends[0]], [ends[1]])
    target = _mode(g, whole(mode, "mode"))
    most = HIGHEST / g.dt if g.dt else np.inf
    tried = [one for one in chosen.candidates(abs(target) / (2 * np.pi)) if _corner(one) < most]
    loci = [_locus(g, one, target) for one in tried]
    best = _best(loci, wanted, least)
    if best is not None:  # gains between those on both sides of it
        locus, i = best
        low, high = np.abs(locus.gains[[max(i - 1, 0), min(i + 1, len(_GAINS) - 1)]])
        fine = np.geomspace(low, high, _FINE) * np.sign(locus.gains[i])
        best = _best([_locus(g, locus.element, target, fine)], wanted, least)
    if best is None:
        raise AssumptionError(_refusal(loci, least, ends, target, chosen))
    locus, i = best
    element = locus.element.replace(gain=float(locus.gains[i]))
    controller = (-_run(element, g.dt)).replace(
        inputs=[ends[0]], outputs=[ends[1]], name="damping", units={}
    )
    return ActiveDamping(
        element, controller, abs(target) / (2 * np.pi), float(-target.real / abs(target)),
        float(locus.damping[i]), float(locus.margins[i]), given,
    )  # fmt: skip


def _one(given: str | None, what: str, side: str, names: Sequence[str]) -> str:
    """Return the name of a channel, that of the only one when none is given."""
    if given is None and len(names) == 1:
        return names[0]
    if given is None:
        raise LabelError(
            f"the plant has {counted(len(names), what)}: name one, {side}={names[0]!r}."
        )
    require_known(what, [given], names)
    return given


class _Locus(NamedTuple):
    """A root locus: the gains, and at each the damping, the modulus margin and what it keeps."""

    element: DampingElement
    gains: FloatArray
    effort: FloatArray
    damping: FloatArray
    margins: FloatArray
    #: whether it is stable, and how much of their damping other modes keep
    stable: npt.NDArray[np.bool_]
    kept: FloatArray


def _corner(element: DampingElement) -> float:
    """Return the fastest pole [Hz] of an element."""
    return float(np.abs(element.system.poles()).max(initial=0.0)) / (2.0 * np.pi)


def _mode(g: StateSpace, mode: int) -> complex:
    """Return the pole of a mode with positive imaginary part [rad/s]."""
    poles = continuous_poles(g)
    upper = poles[poles.imag > NEGLIGIBLE * np.abs(poles).max(initial=0.0)]
    upper = upper[np.argsort(upper.imag)]
    if mode > upper.size:
        raise ModelError(
            f"mode {mode} does not exist: {g!r} has {upper.size} pairs of oscillating poles"
            + (f", up to {upper[-1].imag / (2 * np.pi):.4g} Hz." if upper.size else ".")
        )
    return complex(upper[mode - 1])


def _run(element: DampingElement, dt: float) -> StateSpace:
    """Return an element as it runs: continuous, or at a rate."""
    return element.sampled(1.0 / dt).system if dt else element.system


def _locus(
    g: StateSpace, element: DampingElement, target: complex, gains: FloatArray | None = None
) -> _Locus:
    """Return the root locus of an element of gain one, for gains of the sign that damps."""
    law = _run(element, g.dt)
    L = series(g, law)
    at = np.array([target.imag / (2.0 * np.pi)])
    if gains is None:
        gains = _sign(L, target) * _GAINS / abs(responder(L)(at)[0, 0, 0])
    factors = gains / (1.0 + gains * float(L.D[0, 0]))
    closed = np.linalg.eigvals(L.A - factors[:, None, None] * (L.B @ L.C))
    if g.dt:
        with np.errstate(divide="ignore", invalid="ignore"):
            closed = np.log(closed) / g.dt
    rest, before = NEGLIGIBLE * abs(target), continuous_poles(g)
    others = before[
        np.abs(before.real + 1j * np.abs(before.imag) - target) > ROUNDING * abs(target)
    ]
    others = others[np.abs(others) > rest]
    resting = int(np.count_nonzero(np.abs(before) <= rest))
    damping, kept = np.zeros(gains.size), np.zeros(gains.size)
    stable = np.zeros(gains.size, dtype=bool)
    for i, every in enumerate(closed):
        poles = every[np.isfinite(every)]
        moving = poles[np.abs(poles) > rest]
        stable[i] = np.all(moving.real < 0.0) and poles.size - moving.size <= resting
        damping[i], kept[i] = _shares(moving, others)
    curve = responder(L)(resonance_grid(L.poles(), g.dt))[0, 0]
    margins = np.abs(1.0 + gains[:, None] * curve).min(axis=1)
    effort = np.abs(gains * responder(law)(at)[0, 0, 0])
    return _Locus(element, gains, effort, damping, margins, stable, kept)


def _sign(L: StateSpace, target: complex) -> float:
    """Return the sign of the gain that moves a pole to the left at first."""
    pole = np.exp(target * L.dt) if L.dt else target
    row, column = (_eigenvector(A, pole) for A in (L.A.T, L.A))
    change = -(row @ L.B)[0] * (L.C @ column)[0] / (row @ column)
    return -1.0 if (change / pole if L.dt else change).real > 0.0 else 1.0


def _eigenvector(A: FloatArray, pole: complex) -> ComplexArray:
    """Return the right eigenvector of the eigenvalue nearest to a pole."""
    values, vectors = la.eig(A)
    return np.asarray(vectors[:, np.argmin(np.abs(values - pole))])


def _shares(poles: ComplexArray, others: ComplexArray) -> tuple[float, float]:
    """Return the least damping ratio of the mode and the filter, and what other modes keep."""
    from scipy.optimize import linear_sum_assignment  # not loaded with the package

    ratio = -poles.real / np.abs(poles)
    rows, columns = linear_sum_assignment(np.abs(others[:, None] - poles))
    own = np.setdiff1d(np.arange(poles.size), columns)
    was = -others[rows].real / np.abs(others[rows])
    swing = np.abs(others[rows].imag) > 0
    share = (ratio[columns] + 1e-12) / (was + 1e-12)
    return float(ratio[own].min(initial=1.0)), float(share[swing].min(initial=1.0))


def _best(loci: list[_Locus], wanted: float | None, margin: float) -> tuple[_Locus, int] | None:
    """Return the locus and the place on it of most damping, or of least gain with enough."""
    best, found = -np.inf, None
    for locus in loci:
        good = locus.stable & (locus.kept >= _KEPT) & (locus.margins >= margin)
        if wanted is not None:
            good &= locus.damping >= wanted
        value = locus.damping if wanted is None else -locus.effort
        value = np.where(good, value, -np.inf)
        i = int(np.argmax(value))
        if value[i] > best:
            best, found = float(value[i]), (locus, i)
    return found


def _refusal(
    loci: list[_Locus], margin: float, ends: tuple[str, str], target: complex, kind: Any
) -> str:
    """Return why no law of a kind damps a mode enough."""
    freq, before = abs(target) / (2 * np.pi), -target.real / abs(target)
    free = "rigid-body modes that positive feedback pushes away; take 'velocity' for these, or "
    head = f"{kind.__name__} from {ends[0]} to {ends[1]} cannot damp the mode at {freq:.4g} Hz so: "
    if not loci:
        return head + "all its filters lie above the rate. Sample faster."
    if not any(np.any(one.stable) for one in loci):
        return f"{head}no gain is stable. The plant may have {free}another sensor."
    found = _best(loci, None, margin)
    if found is None:
        return (
            f"{head}every gain leaves a modulus margin below {margin:g} or takes more than "
            f"{100 * (1 - _KEPT):.0f} % of another mode's damping. Place the sensor at the "
            "actuator, or accept a smaller margin=."
        )
    most = float(found[0].damping[found[1]])
    return (
        f"{head}the most is a damping ratio of {most:.3g} (it has {before:.3g}). Ask for less, try "
        "another kind, or place actuator and sensor where the mode moves more."
    )


def _with_loop(plant: StandardPlant, controller: StateSpace) -> StandardPlant:
    """Return a plant with a loop closed, its u what is added to the loop's commands."""
    g, (seen,), (driven,) = plant.system, controller.inputs, controller.outputs
    row, column = g.outputs.index(seen), g.inputs.index(driven)
    ends = f"{seen}:damping", f"{driven}:damping"
    D = np.hstack([g.D, g.D[:, [column]]])
    doubled = StateSpace(
        g.A, np.hstack([g.B, g.B[:, [column]]]), np.vstack([g.C, g.C[[row]]]),
        np.vstack([D, D[[row]]]), g.dt,
        inputs=[*g.inputs, ends[1]], outputs=[*g.outputs, ends[0]], states=g.states,
    )  # fmt: skip
    inner = controller.replace(
        inputs=[ends[0]], outputs=[ends[1]], states=[f"damping|{n}" for n in controller.states]
    )
    return made_of(plant, lft(doubled, inner))
