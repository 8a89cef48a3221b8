"""Axes: the motions of a plant that its actuators move, and their decoupling on the real axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np

from ..arrays import ComplexArray, FloatArray, divisor, name_list, positive
from ..errors import AssumptionError, LabelError, ModelError, require_known, some_names, warn
from ..lti.statespace import StateSpace
from ..store import Value
from ..tolerances import KEPT_PLANTS, TYPED
from .assumptions import axes_in_words
from .building import rigid_shapes
from .partitioned import Partition
from .ports import Poi
from .realisation import natural

#: smallest over largest singular value of the gain, rows and columns scaled, from which on axes
#: count as moved apart: below it a machine would have to bend or to push a hundred times as hard
_APART = 1e-2
#: sweeps that scale rows and columns of a gain to one length
_SWEEPS = 20
#: a usual bandwidth as a part of the rate, and of the slowest oscillation of a continuous plant
_OF_RATE, _OF_MODE = 0.01, 0.2
#: factor of the condition number of the decoupling that units of actuators may cost: it is a factor
#: of |S| at u, and 6 dB of it are all that a loop is to have
_UNLIKE = 2.0
#: what counts as rest, relative to a usual bandwidth: squared it is below what tests of rest see
_RESTING = 1e-4


@dataclass(frozen=True, eq=False, repr=False)
class DrivenAxes(Value):
    """Channels of a plant that its actuators move independently, and their decoupling.

    Parameters
    ----------
    channels : sequence of r str
        Channels of z (POIs) or y (sensors).
    actuators : sequence of m str
        Actuators of the plant.
    freq : (r,) array [Hz]
        Frequency at which each axis is decoupled; sigma = 2 pi freq.
    T : (m, r) array
        Matrix from commands of the axes to actuators. It satisfies ``G(sigma) T = I / sigma^2``.
        ``G(sigma)`` is the response of the channels to the actuators at z = exp(sigma dt), without
        the factor ``exp(-sigma dt (delay + 1/2))`` of hold and delay. Where an axis moves as a
        mass, its command is its acceleration, and T contains the mass.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.driven_axes(fx.testbeds.dual_stage(), freq=20.0)
    <DrivenAxes die:x, gap:x by long, short, decoupled at 20 Hz>
    """

    channels: tuple[str, ...]
    actuators: tuple[str, ...]
    freq: FloatArray
    T: FloatArray

    def __repr__(self) -> str:
        at = ", ".join(f"{f:.4g}" for f in np.unique(self.freq))
        by = some_names(list(self.actuators))
        return f"<DrivenAxes {', '.join(self.channels)} by {by}, decoupled at {at} Hz>"


def driven_axes(
    plant: Partition,
    *,
    freq: float | Mapping[str, float] | None = None,
    axes: Sequence[str] | None = None,
    poi: str | None = None,
) -> DrivenAxes:
    """Return the axes of a plant and their decoupling on the real axis.

    The decoupling is ``T = pinv(G(sigma)) / sigma^2``. G is the plant from the actuators to the
    channels, at a real frequency s = sigma instead of an imaginary one. No mode resonates there:
    each mode with shape phi contributes phi phi' / (sigma^2 + omega^2), which has the same sign
    below and above its frequency omega. T is therefore real.

    Parameters
    ----------
    plant : StandardPlant
        Plant of any origin, continuous or sampled.
    freq : float or mapping {channel: float} [Hz], optional
        Frequency at which each axis is decoupled, about its bandwidth. By default it is a hundredth
        of the sampling rate. For a continuous plant it is a fifth of the frequency of the slowest
        oscillation.
    axes : sequence of str, optional
        Channels of z or y. By default these are all axes of the POIs, if the actuators can move
        them independently. Otherwise they are all axes of those POIs that have a reference, if the
        actuators can move these independently. Otherwise they are only the axes that have a
        reference themselves. A free motion that the actuators move and that none of these axes
        shows would drift. For each such motion, the displacement sensor that shows it best is added
        as an axis without a reference.
    poi : str, optional
        POI to whose axes the choice is limited when `axes` is not given.

    Returns
    -------
    DrivenAxes

    Raises
    ------
    AssumptionError
        When the actuators cannot move the axes independently at rest; this does not depend on
        `freq`. Also when neither axes nor POI are given, and the sensors or actuators do not
        suffice to hold a free motion that the axes do not show.
    LabelError
        When a channel is not one of the plant's, or the plant has no POI.

    References
    ----------
    [Skogestad2005]_, section 3.4 (decoupling).

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.driven_axes(fx.testbeds.ball_screw(), axes=["motor_encoder"]).channels
    ('motor_encoder',)
    """
    plant = Partition.of(plant)
    named = freq.keys() if isinstance(freq, Mapping) else None
    sets = _candidates(plant, axes, poi)
    drifts = ""
    for channels in sets:
        # at rest: above its modes a machine may not pass on what it moves apart below them, and
        # that is a matter of the bandwidth, not of the places
        if _apart_at_rest(plant, channels):
            if axes is None and poi is None:
                channels, drifting = _holding(plant, channels)
                if drifting.size:
                    drifts = drifts or _drift(plant, channels, drifting)
                    continue
            sigma = _sigmas(plant, channels, freq, named)
            gains = {s: felt(plant, s, channels, plant.u) for s in np.unique(sigma)}
            inverse = {s: np.linalg.pinv(G) for s, G in gains.items()}
            late = np.exp(-sigma * plant.dt * (plant.delay + 0.5))  # of hold and delay
            columns = [inverse[s][:, i] / s**2 for i, s in enumerate(sigma)]
            T = np.stack(columns, axis=1) * late
            return DrivenAxes(channels, tuple(plant.u), sigma / (2.0 * np.pi), T)
    raise AssumptionError(
        drifts
        or f"the actuators ({some_names(list(plant.u)) or 'none'}) do not move these axes apart: "
        f"{some_names(list(sets[0]))}. Add or move actuators, or choose fewer axes, axes=[...]."
    )


def _candidates(
    plant: Partition, axes: Sequence[str] | None, poi: str | None
) -> list[tuple[str, ...]]:
    """Return sets of axes, of which the first that the actuators move apart is meant."""
    if axes is not None:
        chosen = name_list(axes, "axes")
        known = [name for name in (*plant.z, *plant.y) if not name.endswith((":ref", ":effort"))]
        require_known("axis", chosen, known)
        if not chosen:
            raise LabelError(f"axes names no channel. Choose from {some_names(known)}.")
        return [chosen]
    ports = plant.assembled.ports
    pois = [ports.poi(poi)] if poi is not None else list(ports.z)
    if not pois:
        raise AssumptionError(
            "the plant has no POI, so that there is nothing to move: add Poi(...) to the ports, or "
            "name sensors, axes=[...]."
        )
    every = _channels(pois)
    goals = [one for one, _ in ports.followed]
    led = _channels([one for one in pois if one in goals])
    followed = tuple(one.channel(axis) for one, axis in ports.followed if one in pois)
    sets = [one for one in (every, led, followed) if one]
    return list(dict.fromkeys(sets))


def _holding(plant: Partition, channels: tuple[str, ...]) -> tuple[tuple[str, ...], FloatArray]:
    """Return channels with sensors of free motions that these leave unseen, and what drifts still.

    The second are combinations (k, r) of rigid-body modes that the actuators move.
    """
    sensors = [s.name for s in plant.assembled.ports.y if s.order == 0]
    names, held = [*channels, *sensors], list(channels)
    seen, push = rigid_shapes(plant, names, plant.u)
    motions = _spanned(push)[0]
    moved = seen @ motions.T
    moved[np.abs(moved).max(axis=1, initial=0.0) <= TYPED * np.abs(seen).max(initial=0.0)] = 0.0
    shown = dict(zip(names, moved, strict=True))

    def unseen(among: Sequence[str]) -> FloatArray:
        return _spanned(np.array([shown[name] for name in among]))[1]

    while more := [name for name in sensors if len(unseen([*held, name])) < len(unseen(held))]:
        distances = np.array([_distance(_at_rest(plant, [*held, name])) for name in more])
        if distances.max() <= _APART:
            break
        # the first of equal ones, so that rounding decides nothing
        held.append(more[int(np.argmax(distances >= (1.0 - TYPED) * distances.max()))])
    return tuple(held), unseen(held) @ motions


def _drift(plant: Partition, held: Sequence[str], drifting: FloatArray) -> str:
    """Return which motions (k, r) no axis shows, and what to add, in words."""
    motions = " and ".join(
        f"rigid-body mode {int(np.argmax(np.abs(one))) + 1} "
        f"({axes_in_words(plant, one[:, None])[0]})"
        for one in drifting
    )
    full = len(held) >= len(plant.u)
    add = "an actuator" if full else "a displacement sensor or a POI that shows it"
    return (
        f"the actuators move {motions}, which none of the axes ({some_names(list(held))}) shows, "
        f"so that it would drift. Add {add}, or name the axes that count, axes=[...]."
    )


def _spanned(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return bases of the span of rows (p, r), whatever their units, and of its complement."""
    sizes, basis = np.linalg.svd(rows / divisor(np.linalg.norm(rows, axis=1, keepdims=True)))[1:]
    rank = int(np.sum(sizes > TYPED * sizes.max(initial=0.0)))
    return np.asarray(basis[:rank]), np.asarray(basis[rank:])


def _channels(pois: Sequence[Poi]) -> tuple[str, ...]:
    return tuple(one.channel(axis) for one in pois for axis in one.axes)


def _sigmas(plant: Partition, channels: Sequence[str], freq: Any, named: Any) -> FloatArray:
    """Return 2 pi freq (r,) [rad/s] of each channel."""
    if freq is None:
        freq = usual_frequency(plant)
    if named is not None:
        require_known("axis of a bandwidth", named, channels)
        missing = [name for name in channels if name not in named]
        if missing:
            raise LabelError(
                f"no bandwidth is given for {', '.join(missing)}: give one for each axis, or a "
                "number for all."
            )
        found = [positive(freq[name], f"bandwidth of {name}") for name in channels]
    else:
        found = [positive(freq, "bandwidth")] * len(channels)
    return np.asarray(2.0 * np.pi * np.array(found))


def usual_frequency(plant: Partition) -> float:
    """Return a usual bandwidth [Hz]: a part of the rate, or of the slowest oscillation."""
    if plant.dt:
        return _OF_RATE / plant.dt
    oscillations = elastic(plant)
    poles = np.abs(plant.system.poles()) / (2.0 * np.pi)
    slowest = oscillations if oscillations.size else poles[poles > 0.0]
    return _OF_MODE * float(slowest.min(initial=np.inf if slowest.size else 1.0))


def resting_frequency(plant: Partition) -> float:
    """Return a frequency [Hz] next to rest, far below all that a plant does."""
    return _RESTING * usual_frequency(plant)


def felt(
    plant: Partition, sigma: float, channels: Sequence[str], actuators: Sequence[str]
) -> FloatArray:
    """Return the gain (r, m) of channels to actuators on the real axis, rounding set to zero."""
    g = plant.system
    rows, columns = g.output_index(list(channels)), g.input_index(list(actuators))
    states = states_at(g, g.B[:, columns], complex(sigma)).real
    G = g.C[rows] @ states + g.D[np.ix_(rows, columns)]
    most = np.abs(g.C[rows]) @ np.abs(states)
    return np.asarray(np.where(np.abs(G) > TYPED * most, G, 0.0))


@lru_cache(maxsize=KEPT_PLANTS)
def _apart_at_rest(plant: Partition, channels: tuple[str, ...]) -> bool:
    return apart(_at_rest(plant, channels))


def _at_rest(plant: Partition, channels: Sequence[str]) -> FloatArray:
    """Return the gain (r, m) of channels to the actuators next to rest."""
    return felt(plant, 2.0 * np.pi * resting_frequency(plant), channels, plant.u)


def apart(G: FloatArray) -> bool:
    """Return whether the rows of a gain (r, m) are independent, whatever the channels' units."""
    return _distance(G) > _APART


def _distance(G: FloatArray) -> float:
    """Return how independent the rows of a gain (r, m) are, from 0 to 1."""
    if not G.size or G.shape[0] > G.shape[1] or not np.all(np.any(G, axis=1)):
        return 0.0
    return _evenness(_balanced(G)[0])


def _evenness(G: FloatArray) -> float:
    """Return the smallest over the largest singular value."""
    sizes = np.linalg.svd(G, compute_uv=False)
    return float(sizes[-1] / sizes[0])


def _balanced(G: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a gain (r, m) with rows and columns of one length, and the columns' factors (m,)."""
    scaled, columns = np.array(G), np.ones(G.shape[1])
    for _ in range(_SWEEPS):  # rows last: an actuator may move nothing, an axis may not stay
        each = divisor(np.linalg.norm(scaled, axis=0))
        scaled, columns = scaled / each, columns / each
        scaled = scaled / divisor(np.linalg.norm(scaled, axis=1, keepdims=True))
    return scaled, columns


@lru_cache(maxsize=KEPT_PLANTS)
def force_units(plant: Partition) -> Mapping[str, str]:
    """Return the unit of force of each actuator, as a multiple of its unit, if that matters."""
    # the loop at u is T C G, whose |S| is that of the axes times up to the condition number of T
    try:
        T = driven_axes(plant).T
    except (AssumptionError, ModelError):  # without axes there is nothing to compare by
        return MappingProxyType({})
    scaled, sizes = _balanced(T.T)
    if _evenness(scaled) <= _UNLIKE * _evenness(T / divisor(np.linalg.norm(T, axis=0))):
        return MappingProxyType({})
    forces = sizes.max() / sizes
    units = [plant.units.get(name, "") for name in plant.u]
    texts = (f"{force:.3g} {unit}".strip() for force, unit in zip(forces, units, strict=True))
    return MappingProxyType(dict(zip(plant.u, texts, strict=True)))


def idle_forces(plant: Partition, actuators: Sequence[str]) -> FloatArray:
    """Return a basis (m, k) of forces that move none of the POIs' axes at rest.

    Actuators that move none of them even alone take no part.
    """
    channels = _channels(plant.assembled.ports.z)
    G = felt(plant, 2.0 * np.pi * resting_frequency(plant), channels, actuators)
    moves = np.any(G, axis=0)
    if not channels or not np.any(moves):
        return np.zeros((len(actuators), 0))
    scaled, columns = _balanced(G[:, moves])
    size, directions = np.linalg.svd(scaled)[1:]
    idle = directions[int(np.sum(size > _APART * size[0])) :].T
    basis = np.zeros((len(actuators), idle.shape[1]))
    basis[moves] = columns[:, None] * idle
    return basis


def opposing_part(idle: FloatArray, forces: FloatArray) -> FloatArray:
    """Return the largest part of forces (m,) that could be left out without moving an axis.

    It is a sum of idle forces (m, k) that has the sign of the force, and at most its size, in each
    actuator: an actuator that carries a load alone pushes against none.
    """
    from scipy.optimize import linprog

    size = np.abs(forces)
    if not idle.shape[1] or not np.any(size):
        return np.zeros_like(forces)
    basis = idle / np.abs(idle).max(axis=0)
    signed = np.sign(forces)[:, None] * basis
    limits = np.concatenate([size / size.max(), np.zeros(size.size)])
    still = basis[size == 0.0]
    best = linprog(
        -signed.sum(axis=0), np.vstack([signed, -signed]), limits,
        still, np.zeros(len(still)), bounds=(None, None),
    )  # fmt: skip
    return np.asarray(basis @ best.x * size.max())


def real_gain(
    g: StateSpace, sigma: float, outputs: Sequence[str], inputs: Sequence[str]
) -> FloatArray:
    """Return the gain (p, m) at s = sigma [rad/s] of the real axis."""
    return np.asarray(complex_gain(g, complex(sigma), outputs, inputs).real)


def complex_gain(
    g: StateSpace, s: complex, outputs: Sequence[str], inputs: Sequence[str]
) -> ComplexArray:
    """Return the gain (p, m) at any s [rad/s], of a sampled system at z = exp(s dt)."""
    rows, columns = g.output_index(list(outputs)), g.input_index(list(inputs))
    return np.asarray(g.C[rows] @ states_at(g, g.B[:, columns], s) + g.D[np.ix_(rows, columns)])


def states_at(g: StateSpace, B: FloatArray, s: complex) -> ComplexArray:
    """Return ``(z I - A)^-1 B`` at any s [rad/s], of a sampled system at z = exp(s dt)."""
    # next to z = 1, with the difference of both, no digit of a slow pole is lost
    shift = np.expm1(s * g.dt) if g.dt else s
    eye = np.eye(g.n_states)
    pencil = (shift if np.imag(shift) else np.real(shift)) * eye - (g.A - eye if g.dt else g.A)
    return np.asarray(np.linalg.solve(pencil, B), dtype=np.complex128)


def elastic(plant: Partition) -> FloatArray:
    """Return the frequencies [Hz] of the modes that oscillate below 0.45 of the rate, in order."""
    return oscillations(plant)[0]


def oscillations(plant: Partition) -> tuple[FloatArray, FloatArray]:
    """Return `elastic`, and the damping ratios of these modes."""
    omega, damping = natural(plant.modal_blocks[plant.n_rigid : plant.realisation.n_modes])
    freq = omega / (2.0 * np.pi)
    seen = (freq > 0) & (freq * plant.dt < 0.45)  # unstable pairs do not resonate
    return np.asarray(freq[seen]), np.asarray(damping[seen])


@dataclass(frozen=True, eq=False)
class Reading:
    """What a servo reads for each axis: the estimate of a POI's, or the sensor itself."""

    channels: tuple[str, ...]
    #: of the channel: its estimate or sensor, and its reference where there is one
    reads: Mapping[str, str]
    references: Mapping[str, str]

    @property
    def estimates(self) -> list[str]:
        """What an observer has to give."""
        return [one for channel, one in self.reads.items() if one != channel]

    def warn_of_held(self, axes: Sequence[str] | None) -> None:
        """Warn of sensors that stand for a motion that no POI shows, where axes are not given."""
        held = [channel for channel, one in self.reads.items() if one == channel]
        if axes is None and held and self.references:
            warn(
                "no axis of a POI shows a free motion that the actuators move, so that the servo "
                f"holds {', '.join(held)} at zero, also while references move the POIs. Add a Poi "
                "that shows this motion to move otherwise, or name the axes, axes=[...]."
            )


@lru_cache(maxsize=KEPT_PLANTS)
def reading_of(plant: Partition, channels: tuple[str, ...]) -> Reading:
    """Return what a servo on some channels reads."""
    every = plant.assembled.ports.z
    ports = {poi.channel(axis): (poi, axis) for poi in every for axis in poi.axes}
    hats = {
        name: ports[name][0].derived(ports[name][1], "hat") for name in channels if name in ports
    }
    refs = {name: ports[name][0].derived(ports[name][1], "ref") for name in hats}
    return Reading(
        channels,
        {name: hats.get(name, name) for name in channels},
        {name: ref for name, ref in refs.items() if ref in plant.y},
    )


def gains_at(
    plant: Partition, axes: DrivenAxes, freq: FloatArray | ComplexArray | None = None
) -> ComplexArray:
    """Return the responses (r,) of the decoupled axes, at their frequencies [Hz] or at others."""
    at = 2j * np.pi * (axes.freq if freq is None else freq)
    gains = {s: complex_gain(plant.system, s, axes.channels, axes.actuators) for s in set(at)}
    return np.array([gains[s][i] @ axes.T[:, i] for i, s in enumerate(at)])
