"""What H-infinity needs around a plant: weights of a stage, its errors, and mixed sensitivity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import Value, positive
from ..errors import AssumptionError, ModelError, only_one
from ..lti.discretisation import tustin
from ..lti.filters import inverse_sensitivity, leadlag
from ..lti.interconnection import connect, series, side_by_side
from ..lti.statespace import StateSpace, System, as_statespace
from .building import at_rate
from .forces import BaseAcceleration
from .ports import Ports
from .rigid_motion import RigidModes, require_weak, rigid_gain, rigid_rows
from .standard import StandardPlant, standard_plant

#: |S| of the finished loop crosses 1 below the weight's crossing by about this factor (measured:
#: the table in the room's docstring)
_HEADROOM = 1.6
#: disturbance and effort: the middle of that table; and where frequencies are
#: uncertain, with which tolerant designs of eleven machines had margins of 0.40 to 0.43
_SURE, _UNSURE = (3.0, 3.0), (20.0, 10.0)


def reference_errors(plant: StandardPlant, *, poi: str | None = None) -> StateSpace:
    """Return the static block from sensors and references to errors at the sensors.

    ``y_i:error = y_i,ref - y_i``, where y_i,ref is where sensor i would be if the whole body were
    rigid and the POI followed its references, its other axes at rest. A controller that reads these
    errors has one degree of freedom: what it does to a reference it does to a disturbance.

    Parameters
    ----------
    plant : StandardPlant
        Assembled from a free or suspended structure, with a reference and displacement sensors.
    poi : str, optional
        The POI whose reference the errors follow; the one that has a reference when not given.

    Returns
    -------
    StateSpace
        Static; use it as `plant.through(block)` for design, and in `close_loop`.

    Raises
    ------
    AssumptionError, LabelError, ModelError
        When the plant has no reference, no displacement sensors, or the POI's axes do not span
        the rigid-body modes; when several POIs have a reference and none is named, or the named
        one has none; when the plant was not assembled from a structure.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> plant.through(fx.reference_errors(plant)).y
    ('y1:error', 'y2:error')
    """
    plant = standard_plant(plant)
    motions, ports = plant.rigid_motions, plant.assembled.ports
    if not ports.references:
        raise AssumptionError("the plant has no reference: add Reference(...) to the ports.")
    known = [reference.poi for reference in ports.references]
    followed = ports.poi(only_one("followed POI", known, poi, "poi="))
    sensors = [s.name for s in ports.y if s.order == 0]
    if not sensors:
        kinds = ", ".join(sorted({s.quantity for s in ports.y})) or "none"
        raise AssumptionError(
            f"there is no displacement sensor in y (its sensors: {kinds}): they do not "
            "determine where the rigid body is. Add Sensor(name, at=...)."
        )
    axes = rigid_rows(plant, motions, [followed.channel(axis) for axis in followed.axes])
    count = motions.modes.size
    if len(followed.axes) < count or np.linalg.matrix_rank(axes) < count:
        raise AssumptionError(
            f"POI {followed.name!r} with axes {followed.axes} does not determine the {count} "
            "rigid-body motions: give the POI all its axes."
        )
    own = [axis for one, axis in ports.followed if one is followed]
    turned = np.linalg.pinv(axes)[:, [followed.axes.index(axis) for axis in own]]
    moved = rigid_rows(plant, motions, sensors) @ turned
    return StateSpace(
        [], [], [], np.hstack([-np.eye(len(sensors)), moved]), plant.dt,
        inputs=[*sensors, *(followed.derived(axis, "ref") for axis in own)],
        outputs=[f"{name}:error" for name in sensors],
        name="reference errors",
        units=plant.units | {f"{n}:error": plant.units[n] for n in sensors if n in plant.units},
    )  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class StageWeights(Value):
    """Weights for `plant.weighted(z=weights.z, w=weights.w)`; print it, change it.

    Parameters
    ----------
    z, w : mapping {channel: StateSpace, float or None}
        None leaves the channel out.
    text : str
        What they mean.
    uncertain : UncertainPlant, optional
        What was stated of the plant's modes, for ``design_hinf(..., uncertain=)``.
    """

    z: Mapping[str, Any]
    w: Mapping[str, Any]
    text: str
    uncertain: Any = None

    def __repr__(self) -> str:
        return f"<StageWeights {self.text}>"


def stage_weights(
    plant: StandardPlant,
    bandwidth: float,
    *,
    poi: str | None = None,
    peak: float = 2.0,
    disturbance: float | None = None,
    effort: float | None = None,
    noise: float = 0.05,
    uncertainty: Any = None,
) -> StageWeights:
    """Return a four-block set of weights for a positioning stage.

    ``plant.weighted(z=weights.z, w=weights.w)`` is what `flexplant.design_hinf` then takes; a
    controller with one degree of freedom reads `reference_errors`. `design_stage` does all three,
    and finds the largest bandwidth. Below a gamma of 1 |T| at u is below `peak`. What the numbers
    do is measured on one machine in a table of ``help(flexplant.plant)``. How it works:
    `algorithms`.

    Parameters
    ----------
    plant : StandardPlant
        Assembled from a structure that is free or on springs that hold it at no more than a third
        of the bandwidth; continuous or sampled.
    bandwidth : float [Hz]
        Below which |S| shall stay under 1.
    poi : str, optional
        The POI whose first axis carries the length scale; needed when there are several. The
        others are left out of z when there is a reference: they move with it.
    peak : float
        Bound on |T| at u where gamma is 1; 1/W_S at high frequencies, beside 1 at f_c.
    disturbance, effort : float, optional
        Sizes of W_d f0^-1 and W_u f0 (before the division): the larger their product, the more
        |T| at u decides, and the less |S|. 3 and 3 when not given; 20 and 10 where frequencies are
        uncertain: modes may then be damped as much as they are pushed.
    noise : float
        Noise of each sensor beside 1 m of reference.
    uncertainty : UncertainPlant, float, (m,) array or {mode: float}, optional
        By what share the modes' frequencies may be off, as for ``plant.uncertain(frequency=)``;
        what the plant says itself when not given.

    Returns
    -------
    StageWeights

    Raises
    ------
    AssumptionError, LabelError, ModelError
        When the structure is not free or weakly suspended, or has no POIs, actuators or sensors;
        when there are several POIs and none is named, or the name is unknown; when the plant was
        not assembled from a structure, or a number is out of range.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> weights = fx.stage_weights(plant, 20.0)
    >>> sorted(weights.z), sorted(weights.w)
    (['die:error', 'die:x', 'u1:effort'], ['amp', 'y1:noise', 'y2:noise'])
    """
    plant = standard_plant(plant)
    motions, ports = plant.rigid_motions, plant.assembled.ports
    if uncertainty is not None and not hasattr(uncertainty, "nominal"):
        uncertainty = plant.uncertain(frequency=uncertainty)
    known = plant.uncertainty if uncertainty is None else uncertainty
    usual = _SURE if known is None else _UNSURE
    push_size = positive(usual[0] if disturbance is None else disturbance, "disturbance")
    push_cost = positive(usual[1] if effort is None else effort, "effort")
    sensed = positive(noise, "noise")
    if not ports.z or not ports.u or not ports.y:
        raise AssumptionError("stage weights need a POI, actuators and sensors in the ports.")
    scale = ports.poi(only_one("POI", [port.name for port in ports.z], poi, "poi="))
    first = scale.channel(scale.axes[0])
    push = np.linalg.norm(rigid_gain(plant, motions, [first], [port.name for port in ports.u]))
    crossing = _HEADROOM * positive(bandwidth, "bandwidth")
    if plant.dt and crossing * plant.dt > 0.2:
        raise ModelError(
            f"bandwidth {bandwidth:g} Hz is not well below the rate, {1 / plant.dt:g} Hz: the "
            "weights could not be sampled. Lower it, or raise the rate."
        )
    require_weak(motions, bandwidth, "a set of weights")
    force = (2.0 * np.pi * crossing) ** 2 / float(push)
    arm = _arm(plant, ports, motions)
    sense = inverse_sensitivity(crossing, peak=peak, floor=0.01)
    unit = 1.0 / (peak * push_size * push_cost)  # of z: gamma is |T| at u beside peak
    rolloff = leadlag(6.0 * crossing, 60.0 * crossing, gain=unit * push_cost / force)

    def turned(direction: str) -> float:
        return arm if direction.startswith("r") else 1.0

    z: dict[str, Any] = {}
    # one rigid body: where a reference takes one POI, the others cannot stay
    left = [goal.name for goal in ports.z if ports.references and goal is not scale]
    for goal in ports.z:
        for axis in goal.axes:
            channel, error = goal.channel(axis), goal.derived(axis, "error")
            z |= {name: None for name in (channel, error) if name in plant.z}
            if goal.name not in left:
                weight = series(sense, np.array([[unit * turned(axis)]]))
                z[error if error in plant.z else channel] = _at_plant_rate(weight, plant)
    z |= {f"{port.name}:effort": _at_plant_rate(rolloff, plant) for port in ports.u}
    w: dict[str, Any] = {}
    for port in ports.w:
        if port.added_to is not None:
            w[port.name] = sensed
        elif isinstance(port, BaseAcceleration):
            w[port.name] = push_size / turned(port.direction) * (2.0 * np.pi * crossing) ** 2
        else:
            w[port.name] = push_size * force * turned(port.direction)
    noisy = [port for port in ports.u if port.asd > 0]
    w |= {f"{port.name}:disturbance": push_size * force * turned(port.direction) for port in noisy}
    w |= {name: sensed for name in plant.w if name.endswith(":noise")}
    text = (
        f"{bandwidth:g} Hz: gamma 1 is |T| < {peak:g} at u, forces in {force:.4g} N, rotations in "
        f"1/{arm:.3g} rad, disturbance {push_size:g}, effort {push_cost:g}, noise {noise:g}"
    )
    if left:
        text += f"; on {scale.name}, left out of z: {', '.join(left)} (moved by the reference)"
    return StageWeights(z, w, text, known)


def _arm(plant: StandardPlant, ports: Ports, motions: RigidModes) -> float:
    """Return the length that makes rotations displacements: how far the sensors are, in shape."""
    # the largest rms displacement of the sensors for a unit rotation of the POI about the axis for
    # which it is least: what is added to it by moving without turning does not count, so that the
    # arbitrary basis of the motions (columns of `t = R v, s = S v`) does not enter
    turning = [p.channel(a) for p in ports.z for a in p.axes if a.startswith("r")]
    if not turning:
        return 1.0
    R = rigid_rows(plant, motions, turning)
    S = rigid_rows(plant, motions, [s.name for s in ports.y]) / np.sqrt(len(ports.y))
    # directions in which no axis turns come out as rounding of the others
    turn = np.linalg.pinv(R, rcond=1e-6)
    straight = S @ (np.eye(R.shape[1]) - turn @ R)
    sheared = S @ turn
    return float(
        np.linalg.norm(sheared - straight @ (np.linalg.pinv(straight, rcond=1e-6) @ sheared), 2)
    )


def _at_plant_rate(weight: StateSpace, plant: StandardPlant) -> StateSpace:
    return tustin(weight, 1.0 / plant.dt) if plant.dt else weight


def mixed_sensitivity(
    system: System,
    *,
    S: System | float | None = None,
    KS: System | float | None = None,
    T: System | float | None = None,
) -> StandardPlant:
    """Return the plant whose H-infinity norm is that of ``[W_S S; W_KS K S; W_T T]``.

    ``e = r - G u, u = K e``: S = (I + G K)^-1 from r to e, T = G K S. What `augw` and `mixsyn` of
    other tools build; `design_hinf` of the result designs K. A rigid-body mode or integrator in
    G is an invariant zero on the limit of [G; weights] from r: add a disturbance at u instead, as
    `stage_weights` does.

    Parameters
    ----------
    system : StateSpace
        G, (p, m): from u to the measured outputs; continuous or sampled.
    S, T : float or StateSpace, optional
        Weights of every output: one by one for all alike, or (p, p).
    KS : float or StateSpace, optional
        Weight of every input: one by one for all alike, or (m, m). Continuous weights are sampled
        at the rate of a sampled system (Tustin).

    Returns
    -------
    StandardPlant
        w are the references `y:ref`, z the weighted signals `S:y`, `KS:u` and `T:y`, y the errors
        `y:error`, for each output y and input u of the system by name.

    Raises
    ------
    ModelError
        When there is no weight, or a weight fits neither one channel nor all.

    References
    ----------
    [Kwakernaak1993]_.

    Examples
    --------
    >>> from flexplant.lti import inverse_sensitivity, tf
    >>> P = mixed_sensitivity(tf([1.0], [1.0, 1.0]), S=inverse_sensitivity(1.0), KS=0.1)
    >>> P.z, P.y
    (('S:out', 'KS:in'), ('out:error',))
    """
    g = as_statespace(system)
    given = {"S": (S, g.outputs), "KS": (KS, g.inputs), "T": (T, g.outputs)}
    weights = {
        key: _weights(weight, key, names, g.dt)
        for key, (weight, names) in given.items()
        if weight is not None
    }
    if not weights:
        raise ModelError("there is no weight: give at least one of S=, KS= and T=.")
    # what each weight reads is an output of the loop of its own name
    p = len(g.outputs)
    refs, errors = ([f"{name}:{side}" for name in g.outputs] for side in ("ref", "error"))
    minus = StateSpace(
        [], [], [], np.hstack([np.eye(p), -np.eye(p)]), inputs=[*refs, *g.outputs], outputs=errors
    )
    reads = {"S": errors, "KS": list(g.inputs), "T": list(g.outputs)}
    named = [
        weight.replace(inputs=reads[key], outputs=[f"{key}:{name}" for name in given[key][1]])
        for key, weight in weights.items()
    ]
    z = [name for weight in named for name in weight.outputs]
    whole = connect([g, minus, *named], [*refs, *g.inputs], [*z, *errors])
    return StandardPlant.from_statespace(whole, u=list(g.inputs), y=errors)


def _weights(weight: System | float, key: str, names: Sequence[str], dt: float) -> StateSpace:
    """Return a weight of all channels."""
    system = as_statespace(weight)
    count = len(names)
    if (len(system.inputs), len(system.outputs)) == (1, 1):
        return side_by_side([at_rate(system, key, dt)] * count, names)
    if (len(system.inputs), len(system.outputs)) != (count, count):
        raise ModelError(
            f"the weight {key} must be one by one or {count} by {count} (channels "
            f"{', '.join(names)}), got {system!r}."
        )
    return at_rate(system, key, dt)
