"""simulate: runs of a sampled closed loop with its noises and set-points."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ..arrays import (
    MOST_DRAWS,
    FloatArray,
    flag,
    generator,
    instance,
    positive,
    real_array,
    seed_of,
    seed_sequence,
    several,
    whole,
)
from ..errors import AssumptionError, ModelError, only_one, require_known, short, warn
from ..identification.periodic import MOST_SAMPLES
from ..loop import ClosedLoop, ScheduledLoop
from ..loop.blocks import references, with_known
from ..parallel import Progress, one_thread
from ..plant import StandardPlant, standard_plant
from ..plant.building import white_noise
from ..plant.partitioned import require_sampled
from ..plant.port import DERIVATIVES
from ..tolerances import SAME, TYPED
from .motion import SetPointProfile
from .moving_machine import MovingMachine, trajectory
from .nonlinear_elements import Acting, Acts, split_elements, warn_beyond_ranges
from .response import Response, warn_of_opposing_forces
from .runs import Conditions, make_runner

#: a signal over time: a set-point, one value per sample, a constant, or a function of time
Signal: TypeAlias = "SetPointProfile | npt.ArrayLike | Callable[[FloatArray], npt.ArrayLike]"


def simulate(
    loop: ClosedLoop | ScheduledLoop,
    *,
    duration: float,
    reference: Signal | Mapping[str, Signal] | None = None,
    disturbance: Mapping[str, Signal] | None = None,
    elements: Mapping[str, Acts | Sequence[Acts]] | None = None,
    anti_windup: float | None = None,
    moving: Mapping[str, Any] | None = None,
    finer: int = 1,
    noise: bool = True,
    rng: Any = None,
    runs: int | Sequence[int] | None = None,
    start: npt.ArrayLike | None = None,
    progress: bool | None = None,
) -> Response:
    """Return the time response of a sampled closed loop.

    In each sample the sensors are read and the blocks compute the commands. The commands are
    applied after the plant's delay and held for one sample. White disturbances act on the plant
    with their exact covariance per sample, `plant.process_noise`, as in `design_kalman`. The noise
    of a sensor has the variance asd^2 rate / 2.

    Parameters
    ----------
    loop : ClosedLoop or ScheduledLoop
        Loop around a sampled plant. An unstable loop is simulated too. A warning then gives its
        spectral radius and its growth during the run.
    duration : float [s]
        Duration of the run. It has round(duration * rate) samples, and the first one is at 0.
    reference : signal or mapping {name: signal}, optional
        Signals of references such as `die:ref`, or a single signal if the plant has one reference.
        A signal is a SetPoint, an array with one value for each sample, a number, or a function of
        the times [s]. An array (runs, samples) has one row for each run. If blocks read derivatives
        of a reference, these are taken from its SetPoint.
    disturbance : mapping {name: signal}, optional
        Signals of other channels of w, in addition to their noise. They are constant over each
        sample.
    elements : mapping {name: element, or a list of some}, optional
        Nonlinear elements by channel. On a channel of y, elements act before it is read. On a
        driven actuator, they change the command, and u is the value that is applied. Blocks with an
        input that has the name of the actuator, such as observers, receive this value. A
        `Quantiser` acts first, then a `Saturation`, then others in their order: `Hysteresis`,
        `Dropout`, or your own `Element`. `Jitter` shifts the instants of reading or applying, which
        the blocks do not know. On a disturbance, `Friction` (or an `Element` with `reads`) is a
        force that reacts to a motion. If the SetPoints need more than a `Saturation` allows (force
        of an actuator, range of a sensor or of the reference), a warning before the run gives its
        name and the required value.
    anti_windup : float [s], optional
        Time constant of an anti-windup. While the applied value differs from the command, the
        integrators of blocks that drive actuators follow the applied value with this time constant.
        A pole counts as an integrator if it is slower than this time constant.
    moving : mapping {POI or position: path}, optional
        Motion of POIs or positions during the run. For a POI it is its places (n_time, 3) [m] over
        time, or a function of the times that returns them. Its channels in z are then those of its
        place at each sample. For a position of the plant it is the values [m or rad] over time: a
        SetPoint (which may also be a reference), a function, or an array (n_time,). All ports that
        belong to this position then move. The places of forces also change within each sample.
    finer : int
        Number of simulated samples of the plant in each sample of the controller. The commands are
        held meanwhile. The response then also contains z between the samples of the controller.
        Noise and elements act on the sensors at the samples of the controller; between these
        samples y is the motion without noise. Given signals must have values at the finer samples.
    noise : bool
        Whether the white noises of the plant act.
    rng : int, SeedSequence, Generator or None
        Seed of the noises. Run i has a separate seed, derived from this one, so that it does not
        depend on the other runs.
    runs : int or sequence of int, optional
        Number of runs, or numbers of the runs (from 0). The arrays of the response then have an
        additional axis for the runs. With None there is one run without this axis.
    start : (n,) array, optional
        State of the plant, or of plant and controller, at time 0. By default the machine is at
        rest.
    progress : bool, optional
        Whether to show a progress bar. By default (None) it is shown on a terminal for work of more
        than two seconds.

    Returns
    -------
    Response
        All z, y, driven u and monitored outputs of blocks. After a run with a reference or a
        disturbance, a warning names actuators that still push against each other without moving an
        axis of a POI.

    Raises
    ------
    AssumptionError
        When the plant is continuous or weighted, u reaches y within a sample, white noise would
        reach an output directly (its variance would be infinite), or a saturated command depends on
        the value that is applied in the same sample.
    LabelError
        When a reference, a disturbance or the channel of an element is unknown, or must be named.
    ModelError, ShapeError
        When a signal or the state has the wrong length, an element has a wrong type, integrators
        cannot be found from the commands, or the loop diverges beyond floating-point numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from flexplant.loop import close_loop
    >>> from flexplant.lti import StateSpace
    >>> g = StateSpace([[1.0]], [[0.0, 0.1]], [[-1.0], [1.0], [0.0]], [[1, 0], [0, 0], [1, 0]],
    ...     0.1, inputs=["r", "u"], outputs=["e", "y", "r"])
    >>> plant = StandardPlant.from_statespace(g, u=["u"], y=["y", "r"])
    >>> law = StateSpace([], [], [], [[-5.0, 5.0]], inputs=["y", "r"], outputs=["u"])
    >>> simulate(close_loop(plant, law), reference=1.0, duration=0.5)["e"]
    array([1.    , 0.5   , 0.25  , 0.125 , 0.0625])
    """
    loop, schedule = unscheduled(loop)
    _check_sampled(loop)
    closed, loop = loop, finer_loop(loop, finer)
    plant = loop.machine
    steps = round(positive(duration, "duration") / plant.dt)
    if steps > MOST_SAMPLES:
        raise ModelError(
            f"duration {float(duration):g} s is {steps:.3g} samples of {plant.dt:g} s: more than "
            "memory holds. Simulate a part of it."
        )
    if not steps:
        raise ModelError(
            f"duration {float(duration):g} s is less than half a sample ({plant.dt:g} s)."
        )
    time: FloatArray = np.arange(steps, dtype=np.float64) * plant.dt
    positions = _positions(plant, moving)
    if positions and (finer > 1 or len(positions) < len(moving or {})):
        raise ModelError(
            "positions move in runs without finer samples and without paths of single POIs: "
            "leave these out, or keep the machine at rest."
        )
    on_y, on_u, on_w = split_elements(elements, plant, loop.driven)
    met = Conditions(
        on_y,
        on_u,
        on_w,
        None if anti_windup is None else positive(anti_windup, "anti_windup"),
        finer,
        _paths(plant, None if positions else moving, time),
    )
    numbers = _run_numbers(runs)
    signals = named_references(plant, reference)
    given = known_inputs(plant, signals, disturbance, time, 0 if runs is None else len(numbers))
    size = np.maximum(given.max(axis=(0, 1), initial=0.0), -given.min(axis=(0, 1), initial=0.0))
    if not positions:
        warn_beyond_ranges(plant, signals, elements or {}, time)
    silent = plant if flag(noise, "noise") else plant.replace(asd={})
    white = white_noise(silent)
    state = _start(loop, start)
    seed = seed_sequence(rng)
    generators = _generators(seed, numbers)
    grows = _warn_unstable(closed, -(-steps // finer))
    shown = (*plant.z, *plant.y, *loop.driven, *loop.watched)
    record = np.zeros((*([] if runs is None else [len(numbers)]), len(shown), steps))
    data = record.reshape(len(numbers), len(shown), steps)
    # products this small run slower on two threads than on one (5 times, on a busy machine)
    overflow = np.errstate(over="ignore", invalid="ignore")
    with one_thread(), overflow:
        runner: Any
        if positions:
            path = trajectory(plant, positions, time)
            if acted := [*met.on_u, *met.on_w]:
                raise ModelError(
                    f"{acted[0]!r} has an element: elements cannot be combined with moving "
                    "positions. Leave the element out, or keep the machine at rest."
                )
            sensed = Acting(plant.y, met.on_y, float(plant.dt)) if met.on_y else None
            runner = MovingMachine(loop, path, noise=noise, schedule=schedule, sensed=sensed)
        else:
            runner = make_runner(loop, white, size, grows=grows, met=met)
        groups = [slice(i, i + runner.abreast) for i in range(0, len(numbers), runner.abreast)]
        total = len(groups) * -(-steps // runner.stretch)
        with Progress(total, "simulate", progress=progress) as bar:
            for group in groups:
                runner.begin(state, generators[group])
                own = given[group if len(given) > 1 else slice(None)]
                for first in range(0, steps, runner.stretch):
                    stretch = slice(first, min(first + runner.stretch, steps))
                    if not runner.fill(own[:, stretch], data[group, :, stretch]):
                        raise ModelError(
                            "the loop diverged beyond floating-point numbers before "
                            f"{time[stretch][-1]:g} s: "
                            f"it is unstable (spectral radius {closed.spectral_radius:.6g}). Look "
                            "at loop.is_stable first, or simulate a shorter time."
                        )
                    bar.advance()
    drawn = seed_of(seed) if white.factor.size or white.columns.size else None
    record.flags.writeable = False  # a value keeps such an array, and copies others
    run = Response(time, record, shown, loop.units, drawn)
    if not positions and not grows and np.any(size):
        warn_of_opposing_forces(loop, run)
    return run


def finer_loop(loop: ClosedLoop, finer: int) -> ClosedLoop:
    """Return a loop whose plant has several samples in each sample of its controller."""
    # the same plant before sampling, with the same delay in seconds
    if whole(finer, "finer", maximum=10_000) == 1:
        return loop
    plant = loop.machine
    if plant.continuous.dt:
        raise ModelError(
            "finer= needs the plant before it was sampled, which is unknown for this plant. Make "
            "it by assemble_plant(model, ports).discretized(rate), or simulate at "
            "its own samples."
        )
    bare = plant.continuous.replace(evaluation=None)
    fine = bare.discretized(finer / plant.dt, delay=finer * plant.delay)
    fine = standard_plant(with_known(fine, loop.blocks))
    if (fine.w, fine.u, fine.z, fine.y) != (plant.w, plant.u, plant.z, plant.y):
        raise ModelError(
            "the channels of the plant were changed after it was sampled, so that its motion "
            "between samples is not known. Change the ports before plant.discretized(rate)."
        )
    fine = fine.replace(asd={name: level for name, level in plant.asd.items() if name in fine.w})
    return ClosedLoop(fine, loop.blocks, loop.controller, loop.idle)


def _paths(plant: StandardPlant, moving: Any, time: FloatArray) -> dict[str, FloatArray]:
    if moving is None:
        return {}
    instance(moving, Mapping, "moving", "Name the POI: {'die': (n_time, 3) points}.")
    pois = [poi.name for poi in plant.assembled.ports.z]
    found = {}
    for name, path in moving.items():
        require_known("POI to move", [name], pois)
        points: Callable[[FloatArray], Any] | Any = path(time) if callable(path) else path
        found[name] = real_array(points, f"the path of {name!r}", (time.size, 3))
        ends = [*found[name].argmin(axis=0), *found[name].argmax(axis=0)]
        plant.along(name, found[name][ends])  # refuses places off the structure
    return found


def _positions(plant: StandardPlant, moving: Any) -> dict[str, Any]:
    """Return what moves of the plant's positions."""
    if not isinstance(moving, Mapping):
        return {}
    known = [one.name for one in plant.ports.positions]
    return {name: path for name, path in moving.items() if name in known}


def _check_sampled(loop: ClosedLoop) -> None:
    plant = loop.machine
    require_sampled(plant, "simulate runs sampled loops, with blocks designed at their rate")
    D = plant.system.select(plant.y, loop.driven).D
    if np.any(D):
        i, j = np.argwhere(D)[0]
        raise AssumptionError(
            f"{loop.driven[j]!r} reaches {plant.y[i]!r} within the sample (D22 = {D[i, j]:.3g}), "
            "but a measurement is taken before its command goes out. Sample the plant with a "
            "delay: plant.discretized(rate, delay=1)."
        )


def _warn_unstable(loop: ClosedLoop, steps: int) -> bool:
    """Warn of an unstable loop and return whether it is unstable; a free integrator is not."""
    radius = loop.spectral_radius
    if radius <= 1:
        return False
    found = loop.obstacle
    if found is None or not found.reason.startswith("unstable"):
        return False
    with np.errstate(over="ignore"):
        growth = float(np.float64(radius) ** steps)
    by = f"{growth:.3g} times" if np.isfinite(growth) else "beyond all numbers"
    warn(
        f"the loop is unstable (spectral radius {radius:.9g}; {found.reason}): its fastest "
        f"growing part grows {by} in these {steps} samples, so that rms values have no meaning. "
        "Lower the gain or the delay of its controller; loop.modulus_margin shows how far a "
        "loop is from this."
    )
    return True


def named_references(
    plant: StandardPlant, reference: Signal | Mapping[str, Signal] | None
) -> Mapping[str, Signal]:
    """Return signals of references by name; a single signal is for the plant's only reference."""
    if reference is None:
        return {}
    if isinstance(reference, Mapping):
        known = [name for name in plant.w if name in plant.y]
        require_known("reference", reference, known, "the plant's w")
        return reference
    name = only_one("reference", references(plant), None, "reference={name: signal}")
    return {name: reference}


def known_inputs(
    plant: StandardPlant,
    reference: Mapping[str, Signal],
    disturbance: Mapping[str, Signal] | None,
    time: FloatArray,
    runs: int,
) -> FloatArray:
    """Return the known part of w (runs, n_time, nw); (1, n_time, nw) where runs share it."""
    both = [name for name in plant.w if name in plant.y]
    own, others = references(plant), [name for name in plant.w if name not in both]
    if disturbance is not None and not isinstance(disturbance, Mapping):
        raise ModelError(
            f"disturbance must be a mapping, got {short(disturbance)}: name the channel of w, "
            "disturbance={name: signal}."
        )
    given = np.zeros((1, len(plant.w), time.size))
    for kind, known, signals in (
        ("reference", both, {**reference, **_derivatives(reference, both, own, time)}),
        ("disturbance", others, disturbance or {}),
    ):
        for name, signal in signals.items():
            require_known(kind, [name], known, "the plant's w")
            values = _signal_samples(signal, f"{kind} {name!r}", time, runs)
            if values.ndim == 2 and len(given) < len(values):
                given = np.tile(given, (len(values), 1, 1))
            given[:, plant.w.index(name)] = values
    return given.transpose(0, 2, 1)


def _derivatives(
    reference: Mapping[str, Signal], both: Sequence[str], own: Sequence[str], time: FloatArray
) -> dict[str, Signal]:
    """Return the derivatives of set-points that blocks read and that are not given themselves."""
    found: dict[str, Signal] = {}
    for name in both:
        owner, _, kind = name.rpartition(":")
        if owner not in own or name in reference or owner not in reference:
            continue
        move = reference[owner]
        if not isinstance(move, SetPointProfile):
            raise ModelError(
                f"a block reads {name!r}, which follows from a SetPoint only: pass one for "
                f"{owner!r} (setpoint, scan), or give {name!r} as a reference too."
            )
        if move.order < DERIVATIVES.index(kind) + 1:
            raise ModelError(
                f"a block reads {name!r}, but {move!r} is of order {move.order}, so that its "
                f"{kind} consists of impulses. Give the set-point a bound on {kind}, or use "
                "feedforward.up_to of a lower derivative."
            )
        found[name] = getattr(move.at(time), kind)
    return found


def _signal_samples(signal: Any, name: str, time: FloatArray, runs: int) -> FloatArray:
    """Return a signal at the sampling instants: a number, (n_time,) or (runs, n_time)."""
    if isinstance(signal, SetPointProfile):
        _check_setpoint(signal, name, time)
        return signal.at(time).position
    if isinstance(signal, type):
        raise ModelError(f"{name} is a class, {signal.__name__}. Pass a function of time.")
    values = real_array(signal(time) if callable(signal) else signal, name)
    if values.ndim == 0:
        return values
    each = (runs,) if runs and values.ndim == 2 else ()
    return real_array(values, name, (*each, *time.shape))


def _check_setpoint(move: SetPointProfile, name: str, time: FloatArray) -> None:
    """Warn of a set-point that the run cuts off, or that switches between its samples."""
    dt = float(time[1]) if time.size > 1 else 0.0
    end = float(time[-1]) + dt
    if move.duration > end * (1.0 + SAME):
        warn(
            f"{name} lasts {move.duration:.6g} s, longer than the run of {end:.6g} s: it is cut "
            f"off at {float(move.at(end).position):.6g} on its way to {move.stop:.6g}. Simulate "
            f"for duration={move.duration:.6g} or more."
        )
    if move.rate is not None and dt:
        ratio = 1.0 / (move.rate * dt)
        if abs(ratio - round(ratio)) > TYPED * ratio or round(ratio) < 1:
            warn(
                f"{name} switches on a grid of {move.rate:g} Hz, between the samples of the loop's "
                f"{1.0 / dt:g} Hz: its derivatives are not in phase there. Make it with "
                f"rate={1.0 / dt:g}."
            )


def _run_numbers(runs: int | Sequence[int] | None) -> list[int]:
    if runs is None:
        return [0]
    given: Any = runs
    if not several(given):
        return list(range(whole(given, "runs", maximum=MOST_DRAWS)))
    listed = [whole(number, "a run number", minimum=0) for number in given]
    if not listed:
        raise ModelError("runs must be at least 1, or run numbers from 0, got none. Name one.")
    return listed


def _generators(seed: np.random.SeedSequence, numbers: Iterable[int]) -> list[np.random.Generator]:
    """Return the generator of each run, from the child of the seed with the run's number."""
    return [
        np.random.default_rng(
            np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, number))
        )
        for number in numbers
    ]


def _start(loop: ClosedLoop, start: npt.ArrayLike | None) -> FloatArray:
    plant = loop.machine.system.n_states
    total = plant + loop.controller.n_states
    if start is None:
        return np.zeros(total)
    values = real_array(start, "start")
    size = plant if values.shape == (plant,) else total
    values = real_array(values, "start (plant, or plant and controller)", (size,))
    return np.pad(values, (0, total - size))


#: a density over frequency [Hz]: a function, or frequencies and densities
Density: TypeAlias = (
    "Callable[[FloatArray], npt.ArrayLike] | Sequence[npt.ArrayLike] | npt.NDArray[Any]"
)
#: length of the generated record relative to the returned part, so that its ends do not match
_LONGER = 4


def spectral_noise(
    asd: Density, *, rate: float, duration: float, runs: int | None = None, rng: Any = None
) -> FloatArray:
    """Return random Gaussian records with a given spectrum, for `simulate(disturbance=)`.

    The noise can be the measured vibration of a floor, 1/f noise of a sensor or a slow drift. It is
    a sum of sines of random amplitude and phase with ``E |X_k|^2 = asd(f_k)^2 rate n / 2``. X_k is
    the discrete Fourier transform over n samples, where n is four times the length of the record.
    Components slower than a quarter of a period in the record, including the mean, are left out.
    Pass your own array for such a drift. Use ports (`fx.plant.FirstOrder`, `NarrowBand`,
    `RandomWalk`, a shape) for noise that the controller design takes into account.

    Parameters
    ----------
    asd : function or (frequencies [Hz], densities)
        One-sided amplitude spectral density [unit/sqrt(Hz)]. It is a function of an array of
        frequencies, or a pair of arrays such as a measurement. The pair is interpolated on
        logarithmic scales and is zero outside of its band.
    rate : float [Hz]
        Rate of the samples. It is the rate of the plant, or `finer` times this rate.
    duration : float [s]
        Duration of the record.
    runs : int, optional
        Number of records. With None there is one record without this axis.
    rng : int, SeedSequence, Generator or None
        Seed of the noise.

    Returns
    -------
    (n_time,) or (runs, n_time) array

    Raises
    ------
    ModelError, ShapeError
        When a density is negative or not finite, frequencies do not increase, or a number is not
        positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> slow = fx.simulation.spectral_noise(lambda f: 1e-9 / f**0.5, rate=1e3, duration=2.0, rng=1)
    >>> slow.shape, bool(1e-9 < slow.std() < 5e-9)
    ((2000,), True)
    >>> floor = ([1.0, 10.0, 100.0], [1e-5, 1e-4, 1e-6])  # m/s^2/sqrt(Hz), measured
    >>> fx.simulation.spectral_noise(floor, rate=1e3, duration=0.5, runs=3, rng=1).shape
    (3, 500)
    """
    rate = positive(rate, "rate")
    count = whole(round(positive(duration, "duration") * rate), "samples", maximum=10**8)
    number = 1 if runs is None else whole(runs, "runs", maximum=MOST_DRAWS)
    draws = generator(rng)
    n = _LONGER * count
    freq: FloatArray = np.asarray(np.arange(1, n // 2) * (rate / n), dtype=np.float64)
    size = _density_at(asd, freq) * np.sqrt(rate * n / 4.0)
    found = np.empty((number, count))
    for one in found:
        lines = np.zeros(n // 2 + 1, dtype=np.complex128)
        drawn = draws.standard_normal((2, freq.size))
        lines[1 : 1 + freq.size] = size * (drawn[0] + 1j * drawn[1])
        one[:] = np.fft.irfft(lines, n)[:count]
    return found[0] if runs is None else found


def _density_at(asd: Any, freq: FloatArray) -> FloatArray:
    """Return the density at frequencies."""
    if callable(asd):
        values = real_array(asd(freq), "asd")
        values = real_array(values, "asd of the frequencies", freq.shape if values.ndim else ())
    else:
        if isinstance(asd, str) or not hasattr(asd, "__len__") or len(asd) != 2:
            raise ModelError(
                f"asd must be a function of frequency or (frequencies, densities), got {short(asd)}"
                ". Pass lambda f: level / f**0.5, or both arrays."
            )
        at = real_array(asd[0], "frequencies of asd")
        level = real_array(asd[1], "densities of asd", at.shape)
        if at.ndim != 1 or at.size < 2 or at[0] <= 0 or np.any(np.diff(at) <= 0):
            raise ModelError(
                "the frequencies of asd must be positive and rise, and be two or more: they are "
                "interpolated. Sort them, and leave 0 Hz out."
            )
        if np.any(level <= 0):
            raise ModelError(
                f"the densities of asd must be positive, got {level.min():.3g}: they are "
                "interpolated by their logarithms. Leave lines without noise out."
            )
        inside = (freq >= at[0]) & (freq <= at[-1])
        values = np.where(inside, np.exp(np.interp(np.log(freq), np.log(at), np.log(level))), 0.0)
    if np.any(values < 0):
        raise ModelError(f"asd must not be negative, got {values.min():.3g}.")
    return np.asarray(values, dtype=np.float64)


def unscheduled(loop: ClosedLoop | ScheduledLoop) -> tuple[ClosedLoop, ScheduledLoop | None]:
    """Return the loop (of the machine at rest for a schedule) and the schedule."""
    schedule = loop if isinstance(loop, ScheduledLoop) else None
    own = loop.standing if isinstance(loop, ScheduledLoop) else loop
    return instance(own, ClosedLoop, "loop", "Pass close_loop(plant, *blocks)."), schedule
