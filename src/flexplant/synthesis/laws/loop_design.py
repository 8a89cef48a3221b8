"""design_loops: laws made by hand, one for each decoupled axis, and the loops that they make."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...arrays import FloatArray, name_list
from ...errors import LabelError, ModelError, counted, require_known, short, warn
from ...loop import LoopReport, ModeTolerances, SpillOver, in_axes, report_loops
from ...loop.measured_loop import static_map
from ...loop.sensitivity_functions import taken_apart
from ...lti.frequency import Frf
from ...lti.interconnection import series, side_by_side
from ...lti.statespace import StateSpace, System, as_statespace
from ...parallel import one_thread
from ...plant import AnyPlant, decouple
from ...plant.uncertainty.uncertain_plants import UncertainPlant
from ...store import Value
from ..controller import checked_loop, with_modes
from .law import Law, LawElement


@dataclass(frozen=True, eq=False, repr=False)
class DesignedLoops(Value):
    """A decoupled controller ``u = -before diag(laws) after y`` and a report of its loops.

    The matrix `after` transforms y to motions of the axes, and the matrix `before` transforms the
    commands of the axes to u, as in `design_loops`.

    Parameters
    ----------
    system : StateSpace
        Controller from y (and references) to u, for `close_loop` and `frequency_response`.
    laws : mapping {axis: Law}
        Law of each axis from error to command. A positive gain means negative feedback.
    report : LoopReport
        Stability of all loops together, and crossover and margins of the loop of each axis while
        the loops of the other axes are closed.
    left_out : SpillOver, optional
        Stability and margins on the plant with the truncated modes, if these are known.
    notes : sequence of str
        Remarks on the design.
    tolerances : ModeTolerances, optional
        For an uncertain plant: the error of each mode at which the loop becomes unstable.
    """

    system: StateSpace
    laws: Mapping[str, Law]
    report: LoopReport
    left_out: SpillOver | None = None
    notes: tuple[str, ...] = ()
    tolerances: ModeTolerances | None = field(default_factory=lambda: None)

    def __repr__(self) -> str:
        axes = ", ".join(self.laws)
        lines = [f"<DesignedLoops of {axes}: {counted(self.system.n_states, 'state')}>"]
        head, *axes_lines = repr(self.report).splitlines()
        lines += [f"  {head[1:-1].removeprefix('LoopReport: ')}", *axes_lines]
        lines += [f"  law of {axis}: {law!r}" for axis, law in list(self.laws.items())[:4]]
        if self.left_out is not None:
            lines.append(f"  with the truncated modes: {self.left_out.summary}")
        if self.tolerances is not None:
            lines.append(f"  {self.tolerances.summary}")
        return "\n".join([*lines, *(f"  {note}" for note in self.notes)])


@dataclass(frozen=True)
class Axes:
    """A square plant in its axes, and the way there from y and from there to u."""

    plant: Any
    before: StateSpace
    after: StateSpace
    rate: float
    given: AnyPlant | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The axes."""
        return tuple(self.after.outputs)


def axes_controller(axes: Axes, laws: Mapping[str, Law]) -> StateSpace:
    """Return motions to commands of the axes, ``-diag(laws)``."""
    dt = 1.0 / axes.rate if axes.rate else 0.0
    each = [(-laws[name].system).replace(dt=dt) for name in axes.names]
    return side_by_side(each, axes.names).replace(outputs=axes.before.inputs)


def connected(axes: Axes, inner: StateSpace, references: Mapping[str, str]) -> StateSpace:
    """Return [y, references] -> u of a controller in the axes."""
    require_known("axis", references, axes.names)
    names = name_list(references.values(), "references")
    chosen = np.zeros((len(axes.names), len(names)))
    for column, name in enumerate(references):
        chosen[axes.names.index(name), column] = 1.0
    none = np.zeros((len(axes.names), len(axes.after.inputs)))
    if len(inner.inputs) > len(axes.names):
        read = np.block([[none, chosen], [axes.after.D, np.zeros(chosen.shape)]])
    else:
        read = np.hstack([axes.after.D, -chosen])
    inputs = [*axes.after.inputs, *names]
    first = StateSpace([], [], [], read, inner.dt, inputs=inputs)
    system = series(series(first, inner), axes.before.replace(dt=inner.dt))
    return system.replace(inputs=inputs, outputs=axes.before.outputs)


def axes_of(
    plant: Any,
    before: System | FloatArray | None,
    after: System | FloatArray | None,
    rate: float | None,
    delay: float,
    hold: bool,
) -> Axes:
    """Return a plant in its decoupled axes; parameters as for `design_loops`."""
    plant = getattr(plant, "nominal", plant)  # of an uncertain one
    if isinstance(plant, np.ndarray | list | tuple | float | int):
        raise ModelError(
            f"plant must be a plant, a system or an Frf, got {short(plant)}: a gain alone has no "
            "motion to control. Pass fx.lti.as_statespace(gain) where a static plant is meant."
        )
    given = plant if isinstance(plant, AnyPlant) else None
    if hasattr(plant, "frdata"):
        plant = Frf.from_control(plant)
    if given is not None:
        if before is None and after is None and given.ports.z:
            axes = decouple(given.machine)
            before, after = axes.to_actuators, axes.to_motions
            errors = [f"{name}:error" for name in after.inputs]
            if set(errors) <= set(given.y):  # measured as reference minus measurement
                after = (-after).replace(inputs=errors)
        plant = given.Gyu
    if isinstance(plant, Frf):
        inside: Any = in_axes(plant, before=before, after=after, rate=rate, delay=delay, hold=hold)
        inputs, outputs = plant.inputs, plant.outputs
    else:
        plant = as_statespace(plant)
        if rate is not None or delay:
            raise ModelError(
                "rate and delay are those of a measured Frf; a model has them in it: pass "
                "fx.lti.discretized(plant, rate, delay=)."
            )
        rate, inputs, outputs = (1.0 / plant.dt if plant.dt else None), plant.inputs, plant.outputs
    first, last = static_map(before, inputs, "before"), static_map(after, outputs, "after")
    if not isinstance(plant, Frf):
        static = [s.replace(dt=plant.dt) for s in (first, last)]
        inside = series(series(static[0], plant.select(last.inputs, first.outputs)), static[1])
    if len(first.inputs) != len(last.outputs):
        raise ModelError(
            f"{len(first.inputs)} commands act on {len(last.outputs)} motions: a law for each axis "
            "needs as many. Pass before= and after=, such as those of decouple(plant)."
        )
    return Axes(inside, first, last, float(rate or 0.0), given)


@one_thread()
def design_loops(
    plant: AnyPlant | UncertainPlant[Any] | System | Frf,
    laws: LawElement | Mapping[str, LawElement],
    *,
    before: System | FloatArray | None = None,
    after: System | FloatArray | None = None,
    rate: float | None = None,
    delay: float = 0.0,
    hold: bool = True,
    rigid: int = 0,
    unstable: int = 0,
    references: Mapping[str, str] | None = None,
) -> DesignedLoops:
    """Return the controller ``u = -before diag(laws) after y`` of given laws, and a report.

    Each law is a product of elements such as `Pid`, `Lead`, `Notch` and `LowPass`. The plant may
    also be a measured frequency response (Frf). Stability is then determined by the Nyquist
    criterion, which counts encirclements.

    Parameters
    ----------
    plant : StandardPlant, UncertainPlant, StateSpace or Frf
        Plant. For a StandardPlant that was assembled from a structure, the axes are those that the
        actuators move (`decouple`), unless `before` and `after` are given.
    laws : Law or mapping {axis: Law}
        Law from error to command: one law for all axes, or one for each axis. Laws are sampled at
        the rate of the plant.
    before, after : StateSpace or array, optional
        Static transformations. `before` maps the commands of the axes to u, and `after` maps y to
        the motions of the axes.
    rate, delay, hold
        Only for an Frf, as for `in_axes`: the sampling rate of the controller (continuous by
        default), its delay in samples, and whether the zero-order hold must be added.
    rigid, unstable : int
        Only for an Frf, as for `report_loops`: its number of rigid-body modes and its number of
        unstable poles (poles outside the stability region).
    references : mapping {axis: channel of y}, optional
        Reference that each axis follows, such as ``{"die:z": "die:ref"}``.

    Returns
    -------
    DesignedLoops
        The laws as `laws`, their margins as `report`, and the controller as `system`.

    Raises
    ------
    ModelError, ShapeError
        When plant, transformations, laws and rate do not match.
    AssumptionError
        When the axes cannot be decoupled.

    Warns
    -----
    FlexplantWarning
        When the loop is unstable, either on the plant or with the truncated modes.

    References
    ----------
    [Skogestad2005]_, section 3.4 (decoupling).

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.lti.tf([1.0], [1.0, 0.0, 0.0])  # a free mass
    >>> law = fx.Pid(9e4) * fx.Lead(50.0) * fx.LowPass(500.0)
    >>> design = fx.design_loops(plant, law)
    >>> design.report.is_stable
    True
    """
    axes = axes_of(plant, before, after, rate, delay, hold)
    found = made(axes, checked_laws(axes, laws), rigid, unstable, references)
    if found.report.is_stable is False:
        warn(
            f"the loops are unstable ({found.report.poles}){_unstable_at(axes, found)}. Check sign "
            "and unit of the laws against the crossovers, notch what resonates there, add "
            "lead, or change the gain."
        )
    return found


def _unstable_at(axes: Axes, found: DesignedLoops) -> str:
    """Return where a loop is unstable: the frequencies of a model's poles, lines of an Frf."""
    if isinstance(axes.plant, Frf):
        closest = min(found.report.loops, key=lambda loop: loop.modulus_margin)
        return f"; closest to the critical point is {closest.name} at {closest.freq:.4g} Hz"
    poles = taken_apart((axes.plant, axes_controller(axes, found.laws))).poles()
    speed = np.log(poles[np.abs(poles) >= 1.0]) / axes.plant.dt if axes.rate else poles
    freq = np.unique(np.round(np.abs(speed[speed.real >= 0.0]) / (2.0 * np.pi), 6))
    return " at " + ", ".join(f"{f:.4g}" for f in freq[:4]) + " Hz"


def made(
    axes: Axes,
    laws: Mapping[str, Law],
    rigid: int,
    unstable: int,
    references: Mapping[str, str] | None,
) -> DesignedLoops:
    """Return the design of laws that were checked; parameters as for `design_loops`."""
    inner = axes_controller(axes, laws)
    report = report_loops((axes.plant, inner), at="y", rigid=rigid, unstable=unstable)
    system = connected(axes, inner, references or {}).replace(name="loops")
    if axes.given is None:
        return DesignedLoops(system, laws, report)
    feedback = system.select(inputs=axes.after.inputs)  # references take no part in the loop
    loop = checked_loop(axes.given, [feedback])
    found: DesignedLoops = with_modes(DesignedLoops(system, laws, report), axes.given, loop)
    return found


def checked_laws(axes: Axes, laws: LawElement | Mapping[str, LawElement]) -> dict[str, Law]:
    """Return a law for each axis, at the rate of the plant."""
    each = dict.fromkeys(axes.names, laws) if isinstance(laws, LawElement) else laws
    if not isinstance(each, Mapping):
        raise ModelError(
            f"laws must be a law or a mapping {{axis: law}}, got {type(laws).__name__}. Pass a "
            "product of Pid, Lead, Notch and LowPass; a gain alone is Pid(gain)."
        )
    require_known("axis", each, axes.names)
    found = {}
    for name in axes.names:
        if name not in each:
            raise LabelError(f"axis {name!r} has no law: give one for each of {axes.names}.")
        element = each[name]
        if not isinstance(element, LawElement):
            raise ModelError(
                f"the law of {name!r} is not a product of elements: {short(element)}. Pass a "
                "product "
                "of Pid, Lead, Notch and LowPass; a gain alone is Pid(gain)."
            )
        law = element.law
        if law.rate and law.rate != axes.rate:
            runs = f"runs at {axes.rate:g} Hz" if axes.rate else "is continuous"
            raise ModelError(
                f"the law of {name!r} runs at {law.rate:g} Hz, the plant {runs}. Pass the law "
                "continuous: it is sampled here at the rate of the plant (rate= of an Frf)."
            )
        found[name] = law.sampled(axes.rate) if axes.rate else law
    return found
