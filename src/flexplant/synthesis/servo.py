"""design_servo: a rigid-body decoupled PID with roll-off, on the estimated point of interest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..arguments import between
from ..errors import ModelError, SolverError, warn
from ..loop import ClosedLoop
from ..loop.spill_over import growing_modes, named
from ..parallel import one_thread
from ..plant import StandardPlant
from ..plant.rigid.rigid_motion import require_weak
from ..values import positive
from .controller import Controller
from .servo_axis import Axis
from .servo_loop import TARGET
from .servo_task import ServoTask, servo_task
from .spill_over_check import CLOSE, unchecked


@one_thread()
def design_servo(
    plant: StandardPlant,
    *,
    bandwidth: float,
    poi: str | None = None,
    rolloff: float | None = None,
    integrator: float | None = None,
    notches: Sequence[float] | None = None,
    observer: Any = None,
    larger: Any = None,
) -> Controller:
    """Return a decoupled PID controller of the rigid-body motion at a POI.

    Each axis of the POI is a double integrator of the acceleration a commanded there;
    ``u = T_u a`` with T_u the least-force right inverse of the rigid-body gain. Each axis gets
    ``a = k (1 + w_i / s) (1 + 4 s / w_b) / (1 + s / (4 w_b)) F(s) (ref - hat)``, where F is a
    second-order roll-off and the notches, and k makes the open loop of the rigid body cross 1 at
    the bandwidth. On weak springs (`suspend`) it is the same controller, by the geometry of the
    rigid body: its motions are ``1 / (s^2 + w_s^2)`` then, w_s the suspension's frequencies.

    Then the loop that will run is certified: with the observer, the flexible modes and the delay,
    and on the plant with the modes left out where they are known. `servo_bandwidth` gives the
    largest bandwidth at which this loop holds 6 dB.

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
    notches : sequence of float [Hz], optional
        Frequencies of resonances to notch, each below half the rate: a sampled controller has no
        notch above that, where the map would fold it to another frequency. Unless given they are
        placed at the plant's modes, one by one, while |S| at u is above 6 dB (or the loop
        unstable) and a notch lowers it; an empty sequence means none.
    observer : KalmanEstimator, StaticEstimator or StateSpace, optional
        What will give the estimates `die:hat`, ...; unless given, the POI itself.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        A model with the modes that the plant left out, as for `larger_plant`. Unless given, those
        that the plant's reduced model still has.

    Returns
    -------
    Controller
        Inputs: the reference `die:ref` where there is one and the estimates `die:hat`,
        `die:rx:hat`, ...; outputs: the actuators. The certificate holds the spectral radius and the
        modulus margin of the sampled, delayed loop: of the rigid body alone, the worst of its
        motions (on springs, without their damping), of the plant with the observer, and of that
        with the modes left out; where |S| at u exceeds 6 dB, the largest bandwidth that holds it.

    Raises
    ------
    AssumptionError
        When the plant is continuous or held, its springs are too stiff for the bandwidth, or the
        axes or actuators do not span the rigid-body modes.
    LabelError
        When the POI is unknown, or the observer does not give its estimates.
    ModelError
        When the plant is weighted, a frequency is not positive or not below half the rate, or
        `larger` does not go with the plant.
    SolverError
        When the rigid-body loop is unstable (the bandwidth is too high for rate and delay), or the
        loop with the observer is; the message names the modes and the largest bandwidth.

    Warns
    -----
    FlexplantWarning
        When the loop on the POI itself is unstable, or the modes left out make the loop unstable or
        bring |S| at u above 8 dB.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> fx.close_loop(plant, observer, servo).is_stable
    True
    """
    task = servo_task(plant, poi, rolloff, integrator, notches, observer, larger)
    if positive(bandwidth, "bandwidth") >= 0.2 * task.rate:
        raise ModelError(
            f"bandwidth {bandwidth:g} Hz is not well below the rate, {task.rate:g} Hz: the lead "
            f"needs room above it. Stay below {0.2 * task.rate:g} Hz, or raise the rate."
        )
    require_weak(task.motions, bandwidth, "a servo")
    axis = task.notched(task.axis(float(bandwidth)))
    closed = task.closed(axis)
    certificate = {
        "rigid-body spectral radius": task.rigid_radius(axis),
        "rigid-body modulus margin": 1.0 / task.rigid_peak(axis),
        "spectral radius": closed.spectral_radius,
        "modulus margin": closed.modulus_margin,
    }
    left_out = closed.left_out
    if left_out is not None:
        certificate |= left_out.certificate
    worst = min(certificate[key] for key in certificate if key.startswith("modulus margin"))
    advice = ""
    if worst < 1.0 / TARGET:
        try:
            reach = task.largest(TARGET)
        except SolverError as none:
            advice = str(none)
        else:
            certificate["largest bandwidth at 6 dB [Hz]"] = reach
            advice = f"The largest bandwidth that holds 6 dB there is {reach:.3g} Hz."
    if not closed.is_stable:
        _refuse(closed, float(bandwidth), observer is not None, advice)
    elif left_out is not None and not left_out.is_fine:
        warn(
            f"with the modes that the plant left out the servo's loop at {bandwidth:g} Hz is "
            f"{left_out.summary}. The machine has these modes{CLOSE if left_out.is_high else ''}. "
            f"{advice}"
        )
    return Controller(
        task.controller(axis),
        f"servo {bandwidth:g} Hz on {task.poi.name!r}",
        certificate=certificate,
        left_out=left_out,
        notes=_notes(task, axis, left_out is not None),
    )


@one_thread()
def servo_bandwidth(
    plant: StandardPlant,
    *,
    peak: float = TARGET,
    poi: str | None = None,
    rolloff: float | None = None,
    integrator: float | None = None,
    notches: Sequence[float] | None = None,
    observer: Any = None,
    larger: Any = None,
) -> float:
    """Return the largest bandwidth [Hz] at which `design_servo` keeps |S| at u below a peak.

    Plant and observer are swept once over a grid through their resonances; each bandwidth then
    costs the closed form of the axis and small inverses, all frequencies at once. The loop is
    broken at the plant's input, where `modulus_margin` breaks it: what the observer reads of u
    stays closed. What holds there is accepted when it is stable by its eigenvalues and holds the
    peak by `modulus_margin`, with the modes left out too where they are known. Bandwidths are tried
    in steps of 9 %, from the top down, then between the first that holds and the one above it.

    Parameters
    ----------
    plant, poi, rolloff, integrator, notches, observer, larger
        As for `design_servo`.
    peak : float
        Bound on the largest singular value of S at u; 2 is 6 dB.

    Returns
    -------
    float [Hz]

    Raises
    ------
    AssumptionError, LabelError, ModelError
        As `design_servo`; ModelError when peak is not above 1.
    SolverError
        When no bandwidth holds it; the message says what comes nearest, and what limits it.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> fx.servo_bandwidth(plant, observer=fx.design_kalman(plant)) > 20.0
    True
    """
    peak = between(peak, "peak", 1.0, float("inf"), "No loop keeps |S| below 1: try 2.")
    task = servo_task(plant, poi, rolloff, integrator, notches, observer, larger)
    return task.largest(float(peak))


def _refuse(closed: ClosedLoop, bandwidth: float, observed: bool, advice: str) -> None:
    """Raise SolverError for the loop that will run, warn of a loop on the POI itself."""
    modes = named(*growing_modes(closed.monitored, closed.plant.system.states))
    what = "with its observer" if observed else "on the POI itself"
    text = (
        f"the servo's loop at {bandwidth:g} Hz {what} is unstable (spectral radius "
        f"{closed.spectral_radius:.6f}; takes part most: {modes}). {advice} "
        "Lower the bandwidth or the delay, or raise the rate."
    )
    if observed:
        raise SolverError(text)
    warn(f"{text} Pass observer= to check the loop that will run.")


def _notes(task: ServoTask, axis: Axis, checked: bool) -> tuple[str, ...]:
    notes = []
    if axis.notches:
        notes.append(f"notches at {', '.join(f'{f:.4g}' for f in axis.notches)} Hz")
    if task.observer is None:
        notes.append("certified on the POI itself: observer= certifies the loop that will run")
    return (*notes, *(() if checked else unchecked(task.plant)))
