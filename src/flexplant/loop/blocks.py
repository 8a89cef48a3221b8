"""The blocks of a controller, connected by name, with each signal driven once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np

from ..arrays import ComplexArray, FloatArray, inner_names
from ..errors import AssumptionError, LabelError, ModelError, unknown_label
from ..lti.blocks_of_states import equal_matrices
from ..lti.interconnection import among, connect
from ..lti.response_solvers import Responder, responder
from ..lti.statespace import StateSpace
from ..plant import AnyPlant, EvaluationModel, Foreign, StandardPlant
from ..plant.axes import Reading
from ..plant.port import DERIVATIVES
from ..tolerances import KEPT_PLANTS, SAME
from .anti_windup import recovery_gain


def driving_blocks(
    plant: AnyPlant,
    systems: Sequence[StateSpace],
    driven: list[str],
    watched: list[str],
    *,
    applied: bool = False,
) -> StateSpace:
    """Return the blocks as one system from y to the driven actuators and monitored outputs."""
    # with `applied`, the applied commands of driven actuators are inputs too, after y: blocks with
    # an input named like an actuator read these, not the commands
    read = [name for name in plant.u if any(name in sys.inputs for sys in systems)]
    silent = [name for name in read if name not in driven]
    used = [name for sys in systems for name in (*sys.inputs, *sys.outputs)]
    apart = inner_names((f"{name}|applied" for name in driven), [*plant.y, *plant.u, *used])
    outer = dict(zip(driven, apart, strict=True)) if applied else {}
    if outer:
        systems = [
            sys.renamed(inputs={name: outer[name] for name in sys.inputs if name in outer})
            for sys in systems
        ]
    if silent:
        still = StateSpace([], [], [], np.zeros((len(silent), 0)), plant.dt, outputs=silent)
        systems = [*systems, still]
    return connect(
        systems, inputs=[*plant.y, *outer.values()], outputs=[*driven, *watched], adding=driven
    )


def commands(
    systems: Sequence[StateSpace], read: Sequence[str], driven: Sequence[str]
) -> Responder:
    """Return the response of the blocks from y to the driven actuators, each by its own structure.

    With G block-diagonal from all blocks: outputs ``v = G (route v + enter y)``, ``u = leave v``.
    """
    needed = {name for sys in systems for name in sys.inputs}
    used = [[n for n in sys.outputs if n in driven or n in needed] for sys in systems]
    outputs = [name for names in used for name in names]

    def same(rows: Sequence[str], columns: Sequence[str]) -> FloatArray:
        return np.array([[float(a == b) for b in columns] for a in rows]).reshape(
            len(rows), len(columns)
        )

    each = [
        (responder(sys), sys.output_index(names), same(sys.inputs, [*outputs, *read]))
        for sys, names in zip(systems, used, strict=True)
    ]
    leave, count = same(driven, outputs), len(outputs)
    # first those outputs that do not depend on each other, all of them without an inner loop
    ends = np.cumsum([len(names) for names in used])
    free = [
        end
        for k, end in enumerate(ends.tolist(), 1)
        if not any(into[:, :end].any() for _, _, into in each[:k])
    ]
    cut = max(free, default=0)

    def found(freq: FloatArray) -> ComplexArray:
        parts = [
            np.ascontiguousarray(find(freq)[rows].transpose(2, 0, 1)) @ into
            for find, rows, into in each
        ]
        R, v = np.split(np.concatenate(parts, axis=1), [count], axis=2)
        if cut < count:
            ab, ba = R[:, :cut, cut:], R[:, cut:, :cut]
            back = np.eye(count - cut) - R[:, cut:, cut:] - ba @ ab
            try:
                v[:, cut:] = np.linalg.solve(back, v[:, cut:] + ba @ v[:, :cut])
            except np.linalg.LinAlgError as error:
                raise ModelError(
                    "the controller has a pole at one of the frequencies: move it."
                ) from error
            v[:, :cut] += ab @ v[:, cut:]
        return np.asarray((leave @ v).transpose(1, 2, 0))

    return found


def as_block(block: Any, name: str, dt: float) -> StateSpace:
    """Return a block as a StateSpace of the plant's dt; messages call it by a name."""
    inner = getattr(block, "system", block)
    if isinstance(block, AnyPlant) or not (
        isinstance(inner, StateSpace) or hasattr(inner, "input_labels")
    ):
        raise ModelError(
            f"{name} is a {type(block).__name__}, not a system with named channels. Pass a "
            "StateSpace with inputs= and outputs=, or a value with such a .system."
        )
    sys = inner if isinstance(inner, StateSpace) else StateSpace.from_control(inner)
    if sys.n_states and not np.isclose(sys.dt, dt, rtol=SAME, atol=0.0):
        raise ModelError(
            f"{name} {sys!r} has dt {sys.dt:g} s, the plant {dt:g} s (0 is continuous). "
            "Design it on plant.discretized(rate), or discretise it at the plant's rate."
        )
    return sys if sys.dt == dt else sys.replace(dt=dt)


def drives(
    plant: AnyPlant, systems: Sequence[StateSpace], idle: tuple[str, ...]
) -> tuple[list[str], list[str]]:
    """Return the driven actuators and the monitored outputs."""
    produced = [name for sys in systems for name in sys.outputs]
    taken = {name: side for side in "wzy" for name in getattr(plant, side)}
    for name in produced:
        if name in taken:
            raise LabelError(
                f"a block drives {name!r}, which is already in the plant's {taken[name]}: the "
                "name would be driven twice. Rename the block's output: "
                f"system.renamed(outputs={...})."
            )
        if name in idle:
            raise LabelError(f"actuator {name!r} is driven by a block, so it cannot be idle.")
        if produced.count(name) > 1 and name not in plant.u:
            raise LabelError(
                f"{name!r} is an output of {produced.count(name)} blocks: only outputs to "
                "actuators add. Rename one: system.renamed(outputs={...})."
            )
    for i, j in combinations(range(len(systems)), 2):
        one, other = systems[i], systems[j]
        if (one.inputs, one.outputs) == (other.inputs, other.outputs) and equal_matrices(
            one, other
        ):
            raise ModelError(
                f"blocks {i + 1} and {j + 1} are the same system: their outputs add, so that the "
                "system acts twice. Pass it once; for twice the gain, scale its matrices C and "
                "D."
            )
    for name in plant.u:
        if name not in produced and name not in idle:
            error = unknown_label("block output", name, produced)
            raise LabelError(
                f"nothing drives actuator {name!r}: {error} Rename the block's output, or pass "
                f"idle=[{name!r}] if it is not used on purpose."
            )
    watched = [name for name in produced if name not in plant.u]
    return [name for name in plant.u if name in produced], watched


def check_inputs(plant: AnyPlant, systems: Sequence[StateSpace]) -> None:
    """Raise LabelError when an input of a block is connected to nothing."""
    produced = [name for sys in systems for name in sys.outputs]
    known = [*plant.y, *plant.u, *produced]
    clash = sorted({*plant.y, *plant.z} & set(plant.u))
    if clash:
        raise LabelError(f"{clash} name both an output and an actuator: rename one of them.")
    for place, sys in enumerate(systems, 1):
        for name in sys.inputs:
            if name in known:
                continue
            owner = f"what can drive block {place}: plant.y, plant.u and outputs of blocks"
            error = unknown_label("signal", name, known, owner)
            hidden = next((side for side in "zw" if name in getattr(plant, side)), None)
            why = ""
            if hidden:
                why = f" It is in the plant's {hidden}, which is not measured: estimate it."
            elif name.endswith(":hat"):
                why = " It is an estimate: give the observer too, close_loop(plant, observer, ...)."
            raise LabelError(f"{error}{why}")


_FORCE = "feedforward"


def force_name(actuator: str) -> str:
    """Return the channel of a force known in advance: `u1:feedforward`."""
    return f"{actuator}:{_FORCE}"


def references(plant: AnyPlant) -> list[str]:
    """Return the channels that are both in w and in y, without derived channels."""
    both = [name for name in plant.w if name in plant.y]
    return [name for name in both if not is_known(name, both, plant.u)]


def is_known(name: str, refs: Sequence[str], actuators: Sequence[str]) -> bool:
    """Return whether a name is a derivative of a reference, or a force on an actuator."""
    owner, _, kind = name.rpartition(":")
    return (kind in DERIVATIVES and owner in refs) or (kind == _FORCE and owner in actuators)


def with_known(plant: AnyPlant, systems: Sequence[StateSpace]) -> AnyPlant:
    """Return the plant with the known signals that blocks read as references, in w and y."""
    read = [name for sys in systems for name in sys.inputs]
    refs = references(plant)
    fresh = [n for n in dict.fromkeys(read) if n not in plant.y and is_known(n, refs, plant.u)]
    if not fresh:
        return plant
    w, y = (*plant.w, *fresh), (*plant.y, *fresh)
    known = {(name, name): 1.0 for name in fresh}
    system = among(plant.system, [*w, *plant.u], [*plant.z, *y], known)
    if (whole := plant.evaluation_plant) is not None:
        plant = plant.replace(evaluation=with_known(whole, systems))
    return plant.replace(system=system, w=w, y=y)


def joined(
    plant: AnyPlant, systems: Sequence[StateSpace], idle: tuple[str, ...] = ()
) -> tuple[AnyPlant, StateSpace]:
    """Return the plant with what blocks read, and the blocks as one controller of it, checked."""
    plant = with_known(plant, systems)
    driven, watched = drives(plant, systems, idle)
    check_inputs(plant, systems)
    return plant, driving_blocks(plant, systems, driven, watched)


def tapped(
    plant: AnyPlant, driven: Sequence[str], watched: Sequence[str], units: Mapping[str, str]
) -> StateSpace:
    """Return [w; driven; watched] -> [z; y; driven; watched; y of the loop], named `y1|loop`."""
    shown, taps = [*plant.z, *plant.y, *driven, *watched], [*driven, *watched]
    back = inner_names((f"{name}|loop" for name in plant.y), shown)
    g, seen = plant.system, [*plant.z, *plant.y, *plant.y]
    rows, columns = g.output_index(seen), g.input_index([*plant.w, *driven])
    g = g.replace(
        B=g.B[:, columns],
        C=g.C[rows],
        D=g.D[np.ix_(rows, columns)],
        inputs=[*plant.w, *driven],
        outputs=[*plant.z, *plant.y, *back],
        units={},
        blocks=None,
    )
    whole = among(g, [*plant.w, *taps], [*shown, *back], {(name, name): 1.0 for name in taps})
    return whole.replace(units=units)


def applied_law(loop: Any, recovery: float | None) -> tuple[StateSpace, FloatArray]:
    """Return the law [y; applied u] -> [u; watched], and L (n, nu) of its anti-windup."""
    # `L (applied - commanded)` is added to its states: slow states of blocks that drive actuators
    # follow with the time constant `recovery` [samples]; without it L is zero
    plant, driven = loop.plant, list(loop.driven)
    law = driving_blocks(plant, loop.blocks, driven, list(loop.watched), applied=True)
    ny, nu = len(plant.y), len(driven)
    if np.any(law.D[:nu, ny:]):
        i, j = np.argwhere(law.D[:nu, ny:])[0]
        raise AssumptionError(
            f"the command {driven[i]!r} depends on the applied {driven[j]!r} of the same sample, "
            "which is only known after the command. Let the block read it one sample later, or "
            "design the observer on a plant with a delay: plant.discretized(rate, delay=1)."
        )
    L = np.zeros((law.n_states, nu))
    if recovery is not None:
        drives = [bool(set(block.outputs) & set(driven)) for block in loop.blocks]
        own = np.flatnonzero(np.repeat(drives, [block.n_states for block in loop.blocks]))
        L[own] = recovery_gain(law.A[np.ix_(own, own)], law.C[:nu, own], recovery, 1.0)
    return law, L


def observer_system(
    observer: Any, plant: StandardPlant, estimates: Sequence[str]
) -> StateSpace | None:
    """Return the observer as a block of the plant, checked to give the estimates."""
    if observer is None:
        return None
    inner = as_block(observer, "the observer", plant.dt)
    missing = [name for name in estimates if name not in inner.outputs]
    if missing:
        raise LabelError(
            f"the observer gives {', '.join(inner.outputs[:6])}, but the servo acts on "
            f"{', '.join(missing)} too. Design it on this plant, or rename its outputs."
        )
    unknown = [name for name in inner.inputs if name not in (*plant.y, *plant.u)]
    if unknown:
        raise LabelError(
            f"the observer reads {', '.join(unknown)}, which the plant has neither in y nor in u."
        )
    return inner


def path_of(plant: StandardPlant, observer: StateSpace | None, reading: Reading) -> StateSpace:
    """Return the system from u to what a servo reads."""
    if observer is None:
        return plant.system.select(reading.channels, plant.u)
    reads = list(reading.reads.values())
    read = [one for one in plant.y if one in (*observer.inputs, *reads)]
    return connect([plant.system.select(read, plant.u), observer], plant.u, reads)


@lru_cache(maxsize=KEPT_PLANTS)
def seeing(plant: StandardPlant, reading: Reading) -> StandardPlant:
    """Return the plant whose y are the references and the axes themselves, named as read."""
    g, nz = plant.system, len(plant.z)
    names = (*plant.z, *plant.y)
    own = [names.index(channel) for channel in reading.channels]
    kept = [i for i, name in enumerate(plant.y) if name.endswith(":ref")]
    rows = [*range(nz), *own, *(nz + i for i in kept)]
    y = (*reading.reads.values(), *(plant.y[i] for i in kept))
    system = g.replace(C=g.C[rows], D=g.D[rows], outputs=[*plant.z, *y])
    whole = plant.evaluation_plant
    return StandardPlant(
        system, plant.w, plant.u, plant.z, y, {}, Foreign(delay=plant.delay),
        evaluation=EvaluationModel.of(whole and seeing(whole, reading)),
    )  # fmt: skip
