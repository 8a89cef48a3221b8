"""What H-infinity needs around a plant: weights of a stage, its errors, and mixed sensitivity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import divisor, positive, whole
from ..errors import AssumptionError, ModelError, require_known
from ..lti.conversions import tustin
from ..lti.filters import high_pass_filter, inverse_sensitivity, lead_lag_filter
from ..lti.interconnection import connect, series, side_by_side
from ..lti.statespace import StateSpace, System, as_statespace
from ..store import Value
from ..tolerances import SAME
from .axes import DrivenAxes, apart, driven_axes, real_gain, resting_frequency
from .building import at_rate
from .inverse import followed_at_rest
from .port import DERIVATIVES
from .standard import AnyPlant, StandardPlant, plant_of, standard_plant

#: crossing of the weight relative to the bandwidth. |S| of the loop crosses 1 at 1 / 1.24 of it on
#: a free mass without delay and at 1 / 1.6 on plates at 80 Hz, 10 kHz and 1.3 samples of delay, so
#: that these get the bandwidth and machines with more phase get more (maglev block 1.1 to 1.2)
_HEADROOM = 1.6
#: disturbance and effort: the middle of that table; and where frequencies are
#: uncertain, with which tolerant designs of eleven machines had margins of 0.40 to 0.43
_SURE, _UNSURE = (3.0, 3.0), (20.0, 10.0)
#: size of a disturbance elsewhere than at the actuators, relative to one of the same effect there
_ELSEWHERE = 0.01
#: least size of a channel, relative to the largest of its kind: one that takes hardly any part
_IDLE = 0.03


def reference_errors(plant: StandardPlant, *, poi: str | None = None, order: int = 0) -> StateSpace:
    """Return the static block from sensors and references to errors at the sensors.

    The error of sensor i is ``y_i:error = y_i,ref - y_i``. Here y_i,ref is the signal that the
    sensor would have if the machine were at rest, its POIs were at their references r, and the
    other axes (`driven_axes`) were at zero. This signal is ``G_yu T (G_zu T)^-1 r`` at zero
    frequency, where G_yu and G_zu are the plant from u to y and to z, and T gives the actuator
    forces of the axes. For a free body the signal is that of a rigid-body motion. A controller that
    reads these errors has one degree of freedom: it responds to a reference as to a disturbance.

    While the machine moves it bends, so that its sensors differ from their values at rest, and the
    controller opposes the move. With an order above 0, derivatives of the references correct
    y_i,ref for this bending. Use order 0 to design the controller. Use a higher order when you
    close the loop together with its feedforward.

    Parameters
    ----------
    plant : StandardPlant
        Plant of a structure, with a reference and displacement sensors.
    poi : str, optional
        The POI whose references the errors follow; by default all POIs that have references.
    order : int
        Highest derivative of the references that the errors read, 0 to 4.

    Returns
    -------
    StateSpace
        Static block. Use it as `plant.through(block)` for design, and in `close_loop`. If `order`
        is above 0, it also reads `die:ref:velocity` and so on, which a set-point profile provides.

    Raises
    ------
    AssumptionError, LabelError, ModelError
        When the plant has no reference or no displacement sensors, or the named POI has no
        reference. Also when the actuators cannot move the axes independently, the plant was not
        assembled from a structure, or the order is not 0 to 4.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> plant.through(fx.reference_errors(plant)).y
    ('y1:error', 'y2:error')
    """
    plant = standard_plant(plant)
    ports = plant.assembled.ports
    if not ports.references:
        raise AssumptionError("the plant has no reference: add Reference(...) to the ports.")
    if poi is not None:
        require_known("followed POI", [poi], [reference.poi for reference in ports.references])
    sensors = [s.name for s in ports.y if s.order == 0]
    if not sensors:
        kinds = ", ".join(sorted({s.quantity for s in ports.y})) or "none"
        raise AssumptionError(
            f"y has no displacement sensor (its sensors: {kinds}), so that none shows where the "
            "machine rests. Add Sensor(name, at=...)."
        )
    driven = driven_axes(plant, freq=resting_frequency(plant), poi=poi)
    own = [(p, axis) for p, axis in ports.followed if p.channel(axis) in driven.channels]
    columns = [driven.channels.index(p.channel(axis)) for p, axis in own]
    count = 1 + whole(order, "order", minimum=0, maximum=len(DERIVATIVES))
    g, T = plant.system, driven.T
    moved = followed_at_rest(g, T, plant.u, driven.channels, sensors, plant.dt, count)[:, columns]
    refs = [p.derived(axis, "ref") for p, axis in own]
    later = [f"{ref}:{term}" for term in DERIVATIVES[: count - 1] for ref in refs]
    return StateSpace(
        [], [], [], np.hstack([-np.eye(len(sensors)), *np.moveaxis(moved, -1, 0)]), plant.dt,
        inputs=[*sensors, *refs, *later],
        outputs=[f"{name}:error" for name in sensors],
        name="reference errors",
        units=plant.units | {f"{n}:error": plant.units[n] for n in sensors if n in plant.units},
    )  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class StageWeights(Value):
    """Weights for `plant.weighted(z=weights.z, w=weights.w)`, which you may print and change.

    Parameters
    ----------
    z, w : mapping {channel: StateSpace, float or None}
        Weight of each channel; None leaves the channel out.
    text : str
        Meaning of the weights, in words.
    uncertain : UncertainPlant, optional
        Stated uncertainty of the plant's modes, for ``design_hinf(..., uncertain=)``.
    """

    z: Mapping[str, Any]
    w: Mapping[str, Any]
    text: str
    uncertain: Any = None

    def __repr__(self) -> str:
        return f"<StageWeights {self.text}>"


def stage_weights(
    plant: AnyPlant,
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

    Pass ``plant.weighted(z=weights.z, w=weights.w)`` to `flexplant.design_hinf`. A controller with
    one degree of freedom reads the errors of `reference_errors`. `design_stage` does all of this,
    and finds the largest bandwidth. If the design reaches a gamma below 1, |T| at u is below
    `peak`. A table of ``help(flexplant.plant)`` shows the effect of the arguments on one machine.
    `algorithms` explains how the weights are computed.

    Parameters
    ----------
    plant : StandardPlant
        Plant of a structure, continuous or sampled.
    bandwidth : float [Hz]
        Frequency below which |S| shall be less than 1.
    poi : str, optional
        POI whose errors are weighted. By default the errors of all axes that the actuators move
        independently (`driven_axes`) are weighted. Other axes are left out of z, because they move
        together with these. The scale of the weights is that of the first axis.
    peak : float
        Value of the bound 1/W_S on |S| at high frequencies; at the frequency `bandwidth` the bound
        is 1. If gamma is 1, this is also a bound on |T| at u.
    disturbance, effort : float, optional
        Sizes of the weights W_d of disturbances at the actuators and W_u of the efforts, relative
        to the actuator sizes f0 that `algorithms` defines. The larger their product is, the more
        gamma depends on |T| at u, and the less it depends on |S|. By default both are 3. If
        frequencies are uncertain, they are 20 and 10, so that the controller may damp modes as
        strongly as the disturbance drives them.
    noise : float
        Noise of a sensor, relative to its signal for a reference of one unit.
    uncertainty : UncertainPlant, float, (m,) array or {mode: float}, optional
        Relative error of the modes' frequencies, as for ``plant.uncertain(frequency=)``; by default
        the uncertainty of the plant.

    Returns
    -------
    StageWeights

    Raises
    ------
    AssumptionError, LabelError, ModelError
        When POIs, actuators or sensors are missing, or the actuators cannot move the axes
        independently; when the name of the POI is unknown; when the plant was not assembled from a
        structure, or a number is out of range.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> weights = fx.stage_weights(plant, 20.0)
    >>> sorted(weights.z), sorted(weights.w)
    (['die:error', 'die:x', 'u1:effort'], ['amp', 'die:ref', 'y1:noise', 'y2:noise'])
    """
    machine: StandardPlant = plant_of(plant).machine
    plant, ports = machine, machine.assembled.ports
    if uncertainty is not None and not hasattr(uncertainty, "nominal"):
        uncertainty = plant.uncertain(frequency=uncertainty)
    known = plant.uncertainty if uncertainty is None else uncertainty
    usual = _SURE if known is None else _UNSURE
    push_size = positive(usual[0] if disturbance is None else disturbance, "disturbance")
    push_cost = positive(usual[1] if effort is None else effort, "effort")
    sensed = positive(noise, "noise")
    if not ports.z or not ports.u or not ports.y:
        raise AssumptionError("stage weights need a POI, actuators and sensors in the ports.")
    crossing = _HEADROOM * positive(bandwidth, "bandwidth")
    if plant.dt and crossing * plant.dt > 0.2:
        raise ModelError(
            f"bandwidth {bandwidth:g} Hz is not well below the rate, {1 / plant.dt:g} Hz: the "
            "weights could not be sampled. Lower it, or raise the rate."
        )
    sizes = _Sizes.of(machine, driven_axes(machine, freq=crossing, poi=poi), 2.0 * np.pi * crossing)
    sense = inverse_sensitivity(crossing, peak=peak, floor=0.01)
    order = min(sensor.order for sensor in ports.y)
    if order:  # velocities and accelerations do not show where the machine rests
        sense = series(sense, high_pass_filter(crossing, order=order, gain=np.sqrt(2.0)))
    unit = 1.0 / (peak * push_size * push_cost)  # of z: gamma is |T| at u relative to peak
    axes = {(p, axis): p.channel(axis) for p in ports.z for axis in p.axes}
    z: dict[str, Any] = {}
    w: dict[str, Any] = {}
    for (goal, axis), channel in axes.items():
        error, ref = goal.derived(axis, "error"), goal.derived(axis, "ref")
        z |= {name: None for name in (channel, error) if name in plant.z}
        if channel in sizes.axes:
            own = error if error in plant.z else channel
            z[own] = _at_plant_rate(series(sense, unit * sizes.axes[channel]), plant)
            w |= {ref: 1.0 / sizes.axes[channel]} if ref in plant.w else {}
    held = [name for name in sizes.axes if name in sizes.sensors]  # motions that no POI shows
    for name in held:
        z[f"{name}:signal"] = _at_plant_rate(series(sense, unit * sizes.axes[name]), plant)
    for name, force in sizes.forces.items():
        rolloff = lead_lag_filter(6.0 * crossing, 60.0 * crossing, gain=unit * push_cost / force)
        z[f"{name}:effort"] = _at_plant_rate(rolloff, plant)
    noisy = sizes.disturbed
    for port in ports.w:
        if port.added_to:
            w[port.name] = sensed * sizes.sensors[port.added_to]
        else:  # the margin at u asks for disturbances there: those elsewhere excite what u does not
            w[port.name] = push_size * sizes.pushes[port.name] * (_ELSEWHERE if noisy else 1.0)
    w |= {f"{name}:disturbance": push_size * sizes.forces[name] for name in noisy}
    noises = {f"{name}:noise": sensed * size for name, size in sizes.sensors.items()}
    w |= {name: size for name, size in noises.items() if name in plant.w}
    left = [
        goal.name
        for goal in ports.z
        if not any(goal.channel(axis) in sizes.axes for axis in goal.axes)
    ]
    text = (
        f"{bandwidth:g} Hz: gamma 1 is |T| < {peak:g} at u; {sizes.text}; disturbance "
        f"{push_size:g}, effort {push_cost:g}, noise {noise:g}"
    )
    if left:
        text += f"; left out of z: {', '.join(left)}"
        text += " (moved by the reference)" if ports.references else ""
    if held:
        text += f"; {', '.join(held)} held at zero, because no POI shows this motion"
    return StageWeights(z, w, text, known)


@dataclass(frozen=True)
class _Sizes:
    """The sizes of channels that go with a unit of the first axis at the crossing."""

    #: length by which an axis is multiplied, and how far a unit of it shows at sensors
    axes: Mapping[str, float]
    sensors: Mapping[str, float]
    #: of actuators, and of disturbances that move the axes as much as these
    forces: Mapping[str, float]
    pushes: Mapping[str, float]
    #: actuators at which a disturbance acts: those with noise, or all if w leaves an axis at rest
    disturbed: tuple[str, ...]

    @classmethod
    def of(cls, plant: AnyPlant, driven: DrivenAxes, sigma: float) -> _Sizes:
        """Return the sizes by the decoupled response on the real axis."""
        # Y = G_yu T of unit axes, d_i = rms(Y_i) / rms(Y_1); T / d are forces of equal motion
        ports = plant.assembled.ports
        sensors, pushed = [s.name for s in ports.y], [p.name for p in ports.w if not p.added_to]
        T = sigma**2 * driven.T
        held = np.exp(-0.5 * sigma * plant.dt)  # what the hold leaves of an input, without delay
        late = held * np.exp(-sigma * plant.dt * plant.delay)
        Y = real_gain(plant.system, sigma, sensors, plant.u) @ T / late
        shown = np.linalg.norm(Y, axis=0)
        first, r, m = float(shown[0]), len(driven.channels), len(plant.u)
        d = shown / first if first and np.all(shown > SAME * first) else np.ones(r)
        forces = np.sqrt(m / r) * np.linalg.norm(T / d, axis=1)
        # an actuator that the decoupling leaves at rest has a size nevertheless
        forces = np.maximum(forces, _IDLE * forces.max())
        noises = np.linalg.norm(Y / d, axis=1) / np.sqrt(r)
        noises = np.maximum(noises, _IDLE * noises.max(initial=0.0))
        W = real_gain(plant.system, sigma, driven.channels, pushed) / held
        moved = np.linalg.norm(d[:, None] * W, axis=0) * np.sqrt(m / r)
        noisy = tuple(port.name for port in ports.u if port.asd > 0)
        own = real_gain(plant.system, sigma, driven.channels, noisy)
        excited = apart(np.hstack([W, own]))
        equal = dict(zip(pushed, (1.0 / divisor(moved)).tolist(), strict=True))
        # accelerations of the floor are those of unit axes: of a rotation a unit over its arm
        units = plant.units
        arm = max((a for n, a in zip(driven.channels, d, strict=True) if units.get(n) == "rad"),
                  default=1.0)  # fmt: skip
        shaken = {"m/s^2": sigma**2, "rad/s^2": sigma**2 / float(arm)}
        return cls(
            dict(zip(driven.channels, d.tolist(), strict=True)),
            dict(zip(sensors, noises.tolist(), strict=True)),
            dict(zip(plant.u, forces.tolist(), strict=True)),
            _capped(equal, dict(zip(plant.u, forces.tolist(), strict=True)), units, shaken),
            noisy if excited else tuple(plant.u),
        )

    @property
    def text(self) -> str:
        """Forces and arms, in words."""
        forces = sorted({f"{force:.4g}" for force in self.forces.values()}, key=float)
        arms = sorted({f"{arm:.3g}" for arm in self.axes.values()}, key=float)
        return f"efforts in {_ends(forces)}, axes times {_ends(arms)}"


def _capped(
    equal: Mapping[str, float],
    forces: Mapping[str, float],
    units: Mapping[str, str],
    shaken: Mapping[str, float],
) -> dict[str, float]:
    """Return the sizes of disturbances that move the axes as actuators do, bounded by their kind.

    A disturbance that hardly moves the axes, such as a force on a heavy base, is at most as large
    as an actuator's of the same unit or as the smallest of its kind. An acceleration of the floor
    is that of a unit axis.
    """
    found = {}
    for name, size in equal.items():
        unit = units.get(name)
        if unit is not None and unit in shaken:
            found[name] = shaken[unit]
            continue
        alike = [force for own, force in forces.items() if units.get(own) == unit]
        others = [other for own, other in equal.items() if units.get(own) == unit]
        found[name] = min(size, max(alike) if alike else min(others))
    return found


def _ends(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{words[0]} to {words[-1]}"


def _at_plant_rate(weight: StateSpace, plant: AnyPlant) -> StateSpace:
    return tustin(weight, 1.0 / plant.dt) if plant.dt else weight


def mixed_sensitivity(
    system: System,
    *,
    S: System | float | None = None,
    KS: System | float | None = None,
    T: System | float | None = None,
) -> StandardPlant:
    """Return the plant whose H-infinity norm is that of ``[W_S S; W_KS K S; W_T T]``.

    The loop is ``e = r - G u, u = K e``. The sensitivity from r to e is ``S = (I + G K)^-1``, and
    ``T = G K S`` is the complementary sensitivity. MATLAB's `augw` builds the same plant;
    `design_hinf` designs K for it, as `mixsyn` does. If G has a rigid-body mode or an integrator,
    the transfer from r to the outputs of this plant has an invariant zero on the imaginary axis (on
    the unit circle if G is sampled). The standard assumptions exclude such a zero. In this case add
    a disturbance at u, as `stage_weights` does.

    Parameters
    ----------
    system : StateSpace
        System G (p, m) from u to the measured outputs, continuous or sampled.
    S, T : float or StateSpace, optional
        Weights of the outputs: a system with one input and one output that is used for all of them,
        or a system (p, p).
    KS : float or StateSpace, optional
        Weight of the inputs: a system with one input and one output that is used for all of them,
        or a system (m, m). Continuous weights are sampled at the rate of a sampled system (Tustin).

    Returns
    -------
    StandardPlant
        Plant with references as w, weighted signals as z, and errors as y. For an output y and an
        input u of the system, their names are `y:ref`, then `S:y`, `KS:u` and `T:y`, then
        `y:error`.

    Raises
    ------
    ModelError
        When no weight is given, or a weight fits neither one channel nor all.

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
        raise ModelError("no weight is given: give at least one of S=, KS= and T=.")
    # each weight reads an output of the loop, which has the name of the weight
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
