"""Channels of uncertain modes in an H-infinity problem: frequencies that a loop shall tolerate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from ...arrays import CACHED, ComplexArray, FloatArray
from ...errors import AssumptionError, ModelError
from ...lti.frequency_sweep import resonance_grid
from ...lti.interconnection import lft
from ...lti.response_solvers import points, responder
from ...lti.statespace import StateSpace
from ...plant import AnyPlant, StandardPlant
from ...plant.realisation import natural
from ...plant.uncertainty.delta_blocks import FullBlock
from ...plant.uncertainty.uncertain_plants import UncertainPlant
from ...store import Value
from ...tolerances import RANK, TINY
from ..robustness.uncertainty_blocks import SHARE, block_places, evened

#: of modes that shall be damped: their least relative error, and the part of the largest modal
#: force of the actuators from which on these push a mode
_DAMPED, _PUSHED = 0.01, 0.1
#: factor by which a scaling is changed at most in closed loop
_REBALANCED = 4.0
#: points at most on each side of a mode, two to a half-width of its resonance
_SWEPT = 100


@dataclass(frozen=True)
class ModeChannel(Value):
    """One mode whose frequency may be off by a share r, scaled by D: d pushes it, q is seen of it.

    ``q = D v x / (1 + c^2)^(1/2)``, driven by ``h d / D``, with v such that the response from d to
    q at the resonance is ``-j r / zeta`` (delta = 1 in ``omega^2 (1 + 2 r delta)``). Deltas are
    real: ``c = 0.7 r / zeta`` is G over D of the upper bound of real mu, added to q as an all-pass
    of the first order whose value at the resonance is j c.
    """

    mode: int
    states: list[int]
    theta: float
    h: FloatArray
    v: FloatArray
    c: float
    D: float
    share: float

    def parts(self, dt: float) -> tuple[FloatArray, FloatArray, float, float, float, float]:
        """Return the input column (2,), output row (2,), and (a, b, c, d) of the all-pass."""
        size = 1.0 / np.hypot(1.0, self.c)
        if dt:
            a = (1.0 - np.sin(self.theta)) / np.cos(self.theta)
            root = np.sqrt(max(1.0 - a * a, 0.0))
            shift = a, root, -self.c * root * size, self.c * a * size
        else:  # c (s - omega) / (s + omega)
            root = np.sqrt(2.0 * self.theta)
            shift = -self.theta, root, -self.c * root * size, self.c * size
        return self.h / self.D, self.D * self.v * size, *shift

    def shift(self, z: ComplexArray, dt: float) -> ComplexArray:
        """Return the all-pass at points, before it is scaled."""
        *_, a, b, c, d = self.parts(dt)
        return np.asarray((d + b * c / (z - a)) * np.hypot(1.0, self.c))


def mode_channels(
    weighted: AnyPlant, uncertain: UncertainPlant[Any], damped_below: float = 0.0
) -> tuple[ModeChannel, ...]:
    """Return a channel for each mode of uncertain frequency that the weighted plant moves."""
    # D is one over the modal force of the weighted disturbances: what a Delta feeds back then
    # counts as a disturbance does. Modes below a frequency [Hz] that actuators push are to be
    # damped, not only tolerated: they are off by 1 % at least, and c = 0 (complex deltas), which
    # also covers errors of their shapes and damping. Modes above half the rate are left out:
    # samples show them folded back, where no change of a force's response by one sample stands for
    # their frequency's
    own: Any = uncertain.plant
    g, dt = weighted.system, weighted.dt
    ranges = uncertain.frequencies
    if not ranges or dt != own.dt:
        raise ModelError(
            "design_hinf(uncertain=) needs Deltas of frequencies on the plant that is weighted, "
            f"got {uncertain!r}. Make them by plant.uncertain(frequency=0.005)."
        )
    names = own.assembled.realisation.names
    if not set(names) <= set(g.states):
        raise ModelError(
            "the weighted plant lacks the modes of the uncertain one: weight uncertain.plant, "
            "uncertain.plant.through(errors).weighted(z=..., w=...)."
        )
    columns = {side: g.input_index(getattr(weighted, side)) for side in "wu"}
    found, forces = [], []
    for mode, share in ranges.items():
        first = g.states.index(names[2 * mode - 2])
        states = [first, first + 1]
        pair = own.assembled.realisation.pairs[mode - 1]
        A, h = _moved_by_force(pair, dt)
        omega, zeta = _pole(pair)
        theta = omega * np.sqrt(1.0 - zeta**2) * (dt or 1.0)
        if dt and theta >= np.pi:
            continue
        z = np.exp(1j * theta) if dt else 1j * theta
        at = np.linalg.solve(z * np.eye(2) - A, h)
        wanted = -1j * share / zeta
        v = np.linalg.solve(np.array([at.real, at.imag]), np.array([wanted.real, wanted.imag]))
        feeds = g.A[states].copy()
        feeds[:, states] = 0.0
        rows = {
            "w": g.B[states][:, columns["w"]],
            "u": np.hstack([g.B[states][:, columns["u"]], feeds]),
        }
        forces.append([la.norm(h @ rows[side]) / (h @ h) for side in "wu"])
        found.append(ModeChannel(mode, states, theta, h, v, SHARE * share / zeta, 1.0, share))
    w, u = np.array(forces).T
    low = [one.theta / (dt or 1.0) < 2.0 * np.pi * damped_below for one in found]
    found = [
        one.replace(v=one.v * max(_DAMPED / one.share, 1.0), c=0.0)
        if below and force > _PUSHED * u.max()
        else one
        for one, below, force in zip(found, low, u, strict=True)
    ]
    if not np.any(w):
        raise AssumptionError(
            "no weighted disturbance moves the uncertain modes: nothing says how large their "
            "forces are. Weight forces on the structure, w={'amp1': ...}."
        )
    # a mode that actuators move and disturbances do not counts as if they stood where these do
    size = np.maximum(w, u * w.max() / max(u.max(), TINY))
    moved = size > RANK * size.max()
    return tuple(
        one.replace(D=1.0 / float(force))
        for one, force, some in zip(found, size, moved, strict=True)
        if some
    )


def _moved_by_force(pair: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return A and the input column of a unit modal force, held over a sample."""
    if not dt:
        return pair, np.array([0.0, 1.0])
    both = np.zeros((3, 3))
    both[:2, :2], both[1, 2] = pair, 1.0
    moved = la.expm(both * dt)
    return moved[:2, :2], moved[:2, 2]


def _pole(pair: FloatArray) -> tuple[float, float]:
    """Return the frequency [rad/s] and damping ratio of a mode."""
    omega, zeta = (float(found[0]) for found in natural(pair[None]))
    if not 0.0 < zeta < 1.0:
        raise AssumptionError(
            f"a mode of uncertain frequency has the damping ratio {zeta:.3g}: its resonance must "
            "be damped, and swing. Give it damping, or leave it out of modes=."
        )
    return omega, zeta


def with_mode_channels(weighted: AnyPlant, channels: Sequence[ModeChannel]) -> AnyPlant:
    """Return a weighted plant with the channels before its own w and z."""
    g, n, m = weighted.system, weighted.system.n_states, len(channels)
    A, D = la.block_diag(g.A, np.zeros((m, m))), la.block_diag(np.zeros((m, m)), g.D)
    B = np.zeros((n + m, m + g.B.shape[1]))
    C = np.zeros((m + g.C.shape[0], n + m))
    B[:n, m:], C[m:, :n] = g.B, g.C
    for k, one in enumerate(channels):
        push, see, *shift = one.parts(weighted.dt)
        B[one.states, k], C[k, one.states] = push, see
        A[n + k, n + k], B[n + k, k], C[k, n + k], D[k, k] = shift
    into, out = (tuple(f"mode{one.mode}:{side}" for one in channels) for side in ("push", "seen"))
    system = StateSpace(
        A, B, C, D, g.dt, inputs=[*into, *g.inputs], outputs=[*out, *g.outputs], units=g.units
    )
    return StandardPlant.from_statespace(
        system, w=[*into, *weighted.w], u=weighted.u, z=[*out, *weighted.z], y=weighted.y
    )


def rebalanced(
    channels: Sequence[ModeChannel], plant: AnyPlant, controller: StateSpace
) -> tuple[ModeChannel, ...]:
    """Return channels whose rows and columns of the closed loop are alike at their resonances."""
    loop = lft(plant.system, controller)
    found = []
    for k, one in enumerate(channels):
        M = loop.evaluated(np.exp(1j * one.theta) if plant.dt else 1j * one.theta)
        row, column = la.norm(np.delete(M[k], k)), la.norm(np.delete(M[:, k], k))
        change = np.sqrt(max(column, TINY) / max(row, TINY))
        found.append(one.replace(D=one.D * float(np.clip(change, 1.0 / _REBALANCED, _REBALANCED))))
    return tuple(found)


def tolerated(
    channels: Sequence[ModeChannel], plant: AnyPlant, controller: StateSpace, times: float = 1.0
) -> float:
    """Return an upper bound of real mu of the channels, the largest over a grid of frequencies."""
    # below 1 no Deltas of a size (`times`), all at once, put a pole on the grid's frequencies
    return times * ModeLoop(channels, plant, controller, times).level(1.0 / times)


class ModeLoop:
    r"""A loop from all d to all q without their shift, after these the weighted w and z.

    With any positive D and real G, both diagonal, and G zero at the weighted w and z,

    .. math:: M^* D M + j (G M - M^* G) \le \beta^2 D

    excludes ``det(I - M \Delta) = 0`` for Deltas up to ``1 / beta`` [Young1990]_. D by Osborne's
    iteration, G the imaginary part of the shift that the design counted on: a smooth function of
    the frequency, unlike the best G of each, with which the frequency of a crossing could lie
    between those of the grid.
    """

    def __init__(
        self,
        channels: Sequence[ModeChannel],
        plant: AnyPlant,
        controller: StateSpace,
        times: float,
        *,
        weighted: bool = False,
    ) -> None:
        # over a grid; with the weighted w and z after the channels, or without
        loop, m = lft(plant.system, controller), len(channels)
        q, p = (len(side) if weighted else m for side in (loop.outputs, loop.inputs))
        part = loop.select(loop.outputs[:q], loop.inputs[:p])
        freq = np.union1d(resonance_grid(loop.poles(), loop.dt), _swept(channels, times, loop.dt))
        z = points(loop, freq)
        M: ComplexArray = np.moveaxis(responder(part)(freq), 2, 0).copy()
        shift = np.array([one.shift(z, loop.dt) for one in channels]).T
        M[:, :m] *= np.hypot(1.0, [one.c for one in channels])[:, None]
        M[:, range(m), range(m)] -= shift
        self.M, self.shift = M, np.asarray(shift.imag)
        blocks = [FullBlock(1, 1) for _ in channels]
        self.where = block_places([*blocks, FullBlock(p - m, q - m)] if weighted else blocks)

    def level(self, near: float) -> float:
        """Return beta, the largest over the grid: the Deltas and gains over it are all shown."""
        # the design's D and G first, D for a beta that is `near`; where that is the largest, D that
        # evens out the loop, with G and without, and the best of the three
        pieces = np.array_split(np.arange(len(self.M)), 1 + self.M.size // CACHED)
        plain = np.concatenate([self._levels(self.M[i], self.shift[i], near) for i in pieces])
        most = 0.0
        for part in np.array_split(np.argsort(-plain), len(pieces)):
            if plain[part[0]] <= most:
                break
            M = evened(self.M[part], self.where)
            ways = [plain[part], self._levels(M, self.shift[part], near)]
            ways.append(self._levels(M, np.zeros_like(self.shift[part]), near))
            most = max(most, float(np.min(ways, axis=0).max()))
        return most

    def _levels(self, M: ComplexArray, shift: FloatArray, near: float) -> FloatArray:
        """Return beta of each matrix, with ``D = (1 + shift^2 / beta^2)^-1/2`` at a beta near."""
        m = shift.shape[1]
        root = (1.0 + (shift / near) ** 2) ** -0.25
        scaled = M.copy()
        scaled[:, :m] *= root[:, :, None]
        scaled[:, :, :m] /= root[:, None]
        with_G = -1j * shift[:, :, None] * scaled[:, :m]
        form = scaled.conj().swapaxes(1, 2) @ scaled
        form[:, :m] += with_G
        form[:, :, :m] += with_G.conj().swapaxes(1, 2)
        return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(form)[:, -1], 0.0)))


def _swept(channels: Sequence[ModeChannel], times: float, dt: float) -> FloatArray:
    """Return frequencies [Hz] through the places that the modes may take, to half a half-width."""
    found = []
    for one in channels:
        freq, width = one.theta / (2.0 * np.pi * (dt or 1.0)), one.share * SHARE / max(one.c, TINY)
        reach = min(1.5 * times * one.share, 0.5)
        count = int(np.clip(2.0 * reach / max(width, TINY), 4, _SWEPT))
        found.append(freq * (1.0 + reach * np.linspace(-1.0, 1.0, 2 * count + 1)))
    whole = np.concatenate(found)
    return np.asarray(whole[whole < 0.5 / dt] if dt else whole)
