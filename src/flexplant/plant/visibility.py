"""How well each elastic mode of a plant is reached and seen, and which modes are aliased."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray
from ..lti.blocks_of_states import block_diagonal
from ..lti.statespace import StateSpace
from ..store import Value
from ..tolerances import SAME, TINY, TYPED
from .partitioned import PartitionedSystem
from .realisation import natural

#: modes, or findings of one kind, that are named
SHOWN = 3


def aliased_modes(plant: PartitionedSystem) -> str:
    """Return, in words, which elastic modes of a sampled plant are not below half its rate."""
    # a mode at f looks like one at |f - m rate|: no controller of that rate distinguishes them
    if not plant.dt:
        return ""
    rate = 1.0 / plant.dt
    count = plant.realisation.n_modes
    freq = natural(plant.modal_blocks[:count])[0] / (2 * np.pi)
    above = np.flatnonzero(freq >= 0.5 * rate * (1 - SAME))
    if not above.size:
        return ""
    seen = np.round(np.abs(freq - rate * np.round(freq / rate)) / rate, 9) * rate
    named = [f"mode {i + 1} ({freq[i]:.4g} Hz) looks like {seen[i]:.4g} Hz" for i in above[:SHOWN]]
    more = above.size - len(named)
    return (
        f"not below half the sampling rate of {rate:g} Hz: {', '.join(named)}"
        + (f", and {more} more" if more else "")
        + " in its samples"
    )


#: a mode reached or seen less than this, relative to the channel's strongest mode, is called weak
WEAK = 0.01


_VERBS = {"w": "excites", "u": "reaches", "y": "sees", "z": "sees"}


@dataclass(frozen=True, eq=False, repr=False)
class ModeVisibility(Value):
    """How well w excites an elastic mode, u reaches it, and y and z see it.

    If damping couples the modes (`plant.form` is then dense), the mode is one of the undamped
    structure, and its damping is the diagonal entry of the modal damping matrix.

    Parameters
    ----------
    mode : int
        Number of the mode, counted from 1 with the rigid-body modes.
    freq : float [Hz]
        Frequency.
    zeta : float
        Modal damping ratio.
    shares : mapping {"w", "u", "y", "z": float}
        Visibility of the mode on each side of the plant, between 0 and 1. For each input, the modal
        force per unit force is divided by its largest value over all elastic modes; for each
        output, the same is done with the motion per unit modal displacement. The share is the
        largest of these ratios over the channels of the side. It is 0 if all channels lie at nodes
        of the mode.
    channels : mapping {"w", "u", "y", "z": str}
        Channel of each side that has this largest ratio.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.testbeds.three_masses().check().modes
    >>> [round(mode.freq, 1) for mode in modes]
    [100.7, 174.3]
    """

    mode: int
    freq: float
    zeta: float
    shares: dict[str, float]
    channels: dict[str, str]

    @property
    def weak(self) -> tuple[str, ...]:
        """Text for each side where the share of the mode is below 1 %."""
        return tuple(
            f"{side} {_VERBS[side]} mode {self.mode} ({self.freq:.4g} Hz, damping "
            f"{100 * self.zeta:.2g} %) "
            + (
                f"at {100 * share:.2g} % of its strongest mode (best: {self.channels[side]})."
                if share > 1e-8
                else "nowhere: it has a node at every channel."
            )
            for side, share in self.shares.items()
            if share < WEAK
        )


def mode_visibility(plant: PartitionedSystem) -> tuple[ModeVisibility, ...]:
    """Return the visibility of every elastic mode; none for a plant without a structure."""
    given, plant = plant, plant.machine.continuous
    if not plant.realisation.n_modes:
        return ()
    # rigid-body modes and unstable ones come first
    g, count = plant.system, plant.assembled.realisation.n_modes
    n_rigid = plant.n_rigid + len(plant.unstable_modes)
    pairs = plant.modal_blocks[n_rigid:count]
    omega, zeta = natural(pairs)
    swinging = pairs.copy()
    swinging[pairs[:, 0, 0] == 0.0, 1, 1] = 0.0  # damping does not bend a real mode
    # filters of ports act at the pole; one that does not swing stands for its frequency
    wanted = omega * (-zeta + 1j * np.sqrt(np.maximum(1.0 - zeta**2, 0.0)))
    wanted = np.where(zeta < 1.0, wanted, 1j * omega)
    # the structure's states first: filters of sensors stand before them
    own_first = [*plant.modal_states, *np.setdiff1d(np.arange(g.n_states), plant.modal_states)]
    inner = g.A[np.ix_(own_first, own_first)]
    elastic = slice(2 * n_rigid, 2 * count)
    inner[elastic, elastic] = block_diagonal(swinging)
    g = g.replace(A=inner, B=g.B[own_first], C=g.C[:, own_first], states=(), blocks=None)
    left, right = _vectors(g.A, wanted, 2 * n_rigid)
    sides: dict[str, tuple[Sequence[str], FloatArray]] = {}
    for side in "wu":
        kept = [n for n in getattr(plant, side) if n in getattr(given, side)]
        names = [n for n in kept if np.any(g.B[:, g.input_index([n])])]
        sides[side] = names, np.abs(left.conj().T @ g.B[:, g.input_index(names)])
    orders = {s.name: s.order for s in plant.assembled.ports.y}
    for side in "yz":
        block = given.reading if side == "y" else None
        kept = [n for n in getattr(plant, side) if n in getattr(given, side)]
        names = [n for n in kept if np.any(g.C[g.output_index([n])])]
        names = names if block is None else list(block.inputs)
        power = np.array([1 - orders.get(name, 0) for name in names])
        motions = (g.C[g.output_index(names)] @ right).T * omega[:, None] ** power
        if block is not None:
            names = list(block.outputs)
            points = np.exp(wanted * given.dt) if given.dt else wanted
            seen = [response_at(block, z) @ m for z, m in zip(points, motions, strict=True)]
            motions = np.array(seen).reshape(omega.size, len(names))
        sides[side] = names, np.abs(motions)
    shares: dict[str, FloatArray] = {}
    best: dict[str, list[str]] = {}
    for side, (own, gains) in sides.items():
        if own and omega.size:
            each = gains / np.maximum(gains.max(axis=0), TINY)
            shares[side], best[side] = each.max(axis=1), [own[i] for i in each.argmax(axis=1)]
    return tuple(
        ModeVisibility(
            n_rigid + 1 + k,
            float(omega[k] / (2 * np.pi)),
            float(zeta[k]),
            {side: float(each[k]) for side, each in shares.items()},
            {side: each[k] for side, each in best.items()},
        )
        for k in range(omega.size)
    )


def untouched_modes(
    plant: PartitionedSystem, *, inputs: str = "wu", outputs: str = "zy"
) -> tuple[int, ...]:
    """Return the numbers of elastic modes that no input moves, or no output sees."""
    # the asymmetry of a symmetric structure whose matrices were typed does not touch a mode
    seen = ((mode.mode, mode.shares.get) for mode in mode_visibility(plant))
    return tuple(
        number
        for number, share in seen
        if min(max(share(side, 0.0) for side in sides) for sides in (inputs, outputs)) < TYPED
    )


def _vectors(A: FloatArray, poles: ComplexArray, first: int) -> tuple[ComplexArray, ComplexArray]:
    """Return left and right eigenvectors (n, k) of modes; right ones of unit size in their states.

    Mode k has the states first + 2 k and the next; other states (of actuators, say) follow.
    """
    n, count = A.shape[0], poles.size
    left = np.zeros((n, count), dtype=np.complex128)
    right = np.zeros((n, count), dtype=np.complex128)
    for k, pole in enumerate(poles.tolist()):
        own = slice(first + 2 * k, first + 2 * k + 2)
        values, rights = np.linalg.eig(A[own, own])
        lefts = la.inv(rights).conj().T
        i = int(np.argmin(np.abs(values - pole)))
        left[own, k], right[own, k] = lefts[:, i], rights[:, i]
    m = first + 2 * count
    for k, pole in enumerate(poles.tolist() if n > m else ()):
        shifted = pole * np.eye(n - m) - A[m:, m:]
        if np.any(A[:m, m:]):
            left[m:, k] = np.linalg.solve(shifted.T, left[:m, k].conj() @ A[:m, m:]).conj()
        if np.any(A[m:, :m]):
            right[m:, k] = np.linalg.solve(shifted, A[m:, :m] @ right[:m, k])
    return left, right


def response_at(block: StateSpace, at: complex) -> ComplexArray:
    """Return the response of a block at a point of the plane, or next to a pole there."""
    eye = np.eye(block.n_states)
    # next to a pole the response is large but finite
    for point in (at, at + 1e-6 * max(abs(at), 1.0)):
        try:
            found = block.D + block.C @ np.linalg.solve(point * eye - block.A, block.B)
        except np.linalg.LinAlgError:
            continue
        return np.asarray(found, dtype=np.complex128)
    return np.full(block.D.shape, np.nan, dtype=np.complex128)
