"""design_servo: a rigid-body decoupled PID with roll-off, on the estimated point of interest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import AssumptionError, LabelError, ModelError, SolverError
from ..lti.discretisation import discretized, tustin
from ..lti.interconnection import append, lft, series
from ..lti.statespace import StateSpace, as_statespace
from ..plant import Poi, StandardPlant, standard_plant
from ..plant.carried import carried_of, require_weak, rigid_gain
from ..plant.weights import leadlag, lowpass, notch
from ..values import FloatArray, positive, real_array
from .controller import Controller

#: the lead's zero lies this factor below the bandwidth, its pole above: |S| of the rigid body
#: then peaks near 4 dB with the roll-off and integrator below
_LEAD = 4.0


def design_servo(
    plant: StandardPlant,
    *,
    bandwidth: float,
    poi: str | None = None,
    rolloff: float | None = None,
    integrator: float | None = None,
    notches: Sequence[float] = (),
) -> Controller:
    """Return a decoupled PID controller of the rigid-body motion at a POI.

    Each axis of the POI is a double integrator of the acceleration a commanded there;
    ``u = T_u a`` with T_u the least-force right inverse of the rigid-body gain. Each axis gets
    ``a = k (1 + w_i / s) (1 + 4 s / w_b) / (1 + s / (4 w_b)) F(s) (ref - hat)``, where F is a
    second-order roll-off and the notches, and k makes the open loop of the rigid body cross 1 at
    the bandwidth. On weak springs (`suspend`) it is the same controller, by the geometry of the
    rigid body: its motions are ``1 / (s^2 + w_s^2)`` then, w_s the suspension's frequencies.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, with a POI whose axes span its rigid-body modes; free, or on springs that hold it
        at no more than a third of the bandwidth.
    bandwidth : float [Hz]
        Where the open loop of each axis crosses 1; below a fifth of the rate.
    poi : str, optional
        Which POI, when the plant has several.
    rolloff : float [Hz], optional
        Corner of the second-order low-pass, below half the rate; unless given 8 bandwidths, or 0.4
        of the rate where that is less.
    integrator : float [Hz], optional
        Corner of the integral action; a tenth of the bandwidth unless given.
    notches : sequence of float [Hz]
        Frequencies of resonances to notch, each below half the rate: a sampled controller has no
        notch above that, where the map would fold it to another frequency.

    Returns
    -------
    Controller
        Inputs: the reference `die:ref` where there is one and the estimates `die:hat`,
        `die:rx:hat`, ...; outputs: the actuators. The certificate holds the spectral radius and the
        modulus margin of the sampled, delayed loop of the rigid body, the worst of its motions
        (on springs, without their damping).

    Raises
    ------
    AssumptionError
        When the plant is continuous or held, its springs are too stiff for the bandwidth, or the
        axes or actuators do not span the rigid-body modes.
    LabelError
        When the POI is unknown.
    ModelError
        When the plant is weighted, or a frequency is not positive or not below half the rate.
    SolverError
        When the rigid-body loop is unstable: the bandwidth is too high for rate and delay.
    """
    plant = standard_plant(plant)
    poi_port = _poi(plant, poi)
    if not plant.dt:
        raise AssumptionError(
            "a servo is designed at its sampling rate: pass plant.discretized(rate, delay=...)."
        )
    rate = 1.0 / plant.dt
    if positive(bandwidth, "bandwidth") >= 0.2 * rate:
        raise ModelError(
            f"bandwidth {bandwidth:g} Hz is not well below the rate, {rate:g} Hz: the lead needs "
            f"room above it. Stay below {0.2 * rate:g} Hz, or raise the rate."
        )
    corner = min(8.0 * bandwidth, 0.4 * rate) if rolloff is None else rolloff
    slow = 0.1 * bandwidth if integrator is None else integrator
    depths = real_array(notches, "notches", (None,)).tolist()
    for name, freq in (("rolloff", corner), ("integrator", slow), *(("notch", f) for f in depths)):
        _below_nyquist(freq, name, rate)
    motions = carried_of(plant)
    require_weak(motions, bandwidth, "a servo")
    decoupling = _decoupling(plant, poi_port, motions.modes.size)
    axis = _axis_controller(
        float(bandwidth),
        float(corner),
        float(slow),
        depths,
        rate,
    )
    certificate = _certified(axis, rate, plant.delay, bandwidth, np.unique(motions.freq))
    return Controller(
        _joined(plant, poi_port, axis, decoupling),
        f"servo {bandwidth:g} Hz on {poi_port.name!r}",
        certificate=certificate,
    )


def _below_nyquist(freq: float, name: str, rate: float) -> None:
    if positive(freq, name) >= 0.5 * rate:
        raise ModelError(
            f"{name} {freq:g} Hz is not below half the rate, {0.5 * rate:g} Hz: sampled, it would "
            "act at another frequency. Leave it out, lower it, or raise the rate."
        )


def _poi(plant: StandardPlant, name: str | None) -> Poi:
    if plant.unweighted is not None:
        raise ModelError(
            "the plant is weighted: a servo acts on physical channels. Use plant.unweighted."
        )
    if plant.ports is None or not plant.ports.z:
        raise AssumptionError(
            "a servo needs a plant with a POI, assembled from a structure: "
            "assemble_plant(model, ports)."
        )
    if name is None and len(plant.ports.z) > 1:
        names = ", ".join(poi.name for poi in plant.ports.z)
        raise LabelError(
            f"the plant has {len(plant.ports.z)} POIs ({names}): say which one the servo moves, "
            f"such as poi={plant.ports.z[0].name!r}."
        )
    return plant.ports.poi(name if name is not None else plant.ports.z[0].name)


def _decoupling(plant: StandardPlant, poi: Poi, r: int) -> FloatArray:
    """Return T_u: accelerations of the POI's axes to actuator forces, of least norm."""
    continuous = plant.continuous or plant
    continuous.check().require(("stabilisable",), "a servo of the rigid body")
    gain = rigid_gain(plant, [poi.channel(axis) for axis in poi.axes], list(plant.u))
    size = np.linalg.norm(gain, axis=1, keepdims=True)
    if len(poi.axes) != r or np.linalg.matrix_rank(gain / np.where(size > 0, size, 1.0)) < r:
        raise AssumptionError(
            f"POI {poi.name!r} has axes {poi.axes}, the plant {r} rigid-body modes: the servo "
            "needs axes that span them, one each (for a plate z, rx, ry). Give the POI these axes."
        )
    return np.asarray(np.linalg.pinv(gain))


def _axis_controller(
    bandwidth: float, rolloff: float, integrator: float, notches: Sequence[float], rate: float
) -> StateSpace:
    """Return error -> acceleration of one axis, sampled, of unit open-loop gain at bandwidth."""
    omega_i = 2.0 * np.pi * integrator
    parts = [
        StateSpace([[0.0]], [[omega_i]], [[1.0]], [[1.0]]),
        leadlag(bandwidth / _LEAD, _LEAD * bandwidth),
        lowpass(rolloff, order=2),
        *(notch(freq, width=0.3) for freq in notches),
    ]
    joined = tustin(parts[0], rate)
    for part in parts[1:]:
        joined = series(joined, tustin(part, rate))
    z = np.exp(2j * np.pi * bandwidth / rate)
    gain = (2.0 * np.pi * bandwidth) ** 2 / abs(joined.evaluated(z)[0, 0])
    return joined.replace(
        C=gain * joined.C, D=gain * joined.D, inputs=["error"], outputs=["acceleration"]
    )


def _certified(
    axis: StateSpace, rate: float, delay: float, bandwidth: float, suspensions: FloatArray
) -> dict[str, float]:
    """Return radius and margin of the worst axis of the rigid body.

    All axes have the same controller, so that the loop falls apart into those of the body's own
    motions, whatever the axes: free ones (0 Hz) and suspension modes.
    """
    found = [_axis_loop(axis, rate, delay, bandwidth, float(freq)) for freq in suspensions]
    radius, margin = max(r for r, _ in found), min(m for _, m in found)
    if not radius < 1.0:
        raise SolverError(
            f"the rigid-body loop at {bandwidth:g} Hz is unstable (spectral radius {radius:.6f}): "
            f"rate {rate:g} Hz and a delay of {delay:g} samples leave too little phase. "
            "Lower the bandwidth or the delay, or raise the rate or the roll-off."
        )
    return {"rigid-body spectral radius": radius, "rigid-body modulus margin": margin}


def _axis_loop(
    axis: StateSpace, rate: float, delay: float, bandwidth: float, suspension: float
) -> tuple[float, float]:
    """Return spectral radius and modulus margin with one sampled, delayed axis of the body."""
    body = StateSpace(
        [[0.0, 1.0], [-((2.0 * np.pi * suspension) ** 2), 0.0]],
        [[0.0], [1.0]],
        [[-1.0, 0.0]],
        [[0.0]],
        inputs=["acceleration"],
        outputs=["error"],
        blocks=[2],
    )
    sampled = discretized(body, rate, delay=delay)
    loop = lft(sampled, axis)
    radius = float(np.max(np.abs(loop.poles())))
    freq = np.geomspace(1e-2 * bandwidth, 0.5 * rate, 2000)
    margin = min(
        abs(1.0 - (sampled.evaluated(z) @ axis.evaluated(z))[0, 0])
        for z in np.exp(2j * np.pi * freq / rate)
    )
    return radius, float(margin)


def _joined(plant: StandardPlant, poi: Poi, axis: StateSpace, decoupling: FloatArray) -> StateSpace:
    """Return [ref, hats] -> u: errors, one controller an axis, decoupling."""
    first = poi.axes[0]
    reference = poi.derived(first, "ref")
    inputs = [reference] if reference in plant.y else []
    hats = [poi.derived(name, "hat") for name in poi.axes]
    errors = -np.eye(len(hats), len(hats) + len(inputs), len(inputs))
    errors[0, : len(inputs)] = 1.0
    comparison = as_statespace(errors).replace(
        dt=plant.dt, inputs=[*inputs, *hats], outputs=[f"{name}:e" for name in hats]
    )
    bank = append(
        *(
            axis.replace(
                inputs=[f"{name}:e"],
                outputs=[f"{name}:a"],
                states=[f"{name}|{state}" for state in axis.states],
            )
            for name in hats
        )
    )
    forces = as_statespace(decoupling).replace(dt=plant.dt, inputs=bank.outputs, outputs=plant.u)
    return series(series(comparison, bank), forces).replace(name="servo", blocks=None)
