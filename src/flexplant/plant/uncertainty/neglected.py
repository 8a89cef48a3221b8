"""Modes that a plant lacks, as an additive dynamic uncertainty with a weight that bounds them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import CertificateError, ModelError
from ...lti.frequency import default_freq, frequency_response
from ...lti.interconnection import series
from ...lti.statespace import StateSpace, System
from ...values import ComplexArray, FloatArray, Value
from ..building import with_modes_of
from ..partition import Partition, is_plant
from ..realisation import Structure

#: the weight lies this far above the largest difference found
_MARGIN = 1.05


@dataclass(frozen=True, eq=False, repr=False)
class NeglectedModes(Value):
    """``y = (G + diag(sizes) Delta w(s)) u``, Delta any stable system of gain at most 1.

    The bound is of the loop, u -> y: it answers whether a controller stays stable on the larger
    model. What neglected modes do from w and to z at a point of interest is no part of it (Delta
    would tie forces in N to motions in m of other places, a bound far too wide to be of use):
    judge performance on the larger model itself, or on machines that `sample` draws.

    Parameters
    ----------
    weight : StateSpace
        The scalar w: stable, with a stable inverse; continuous.
    sizes : (ny,) array [output unit / input unit]
        Largest difference of each output.
    u, y : sequences of str
        Actuators and the outputs that they move.
    tightest : float
        Largest ``|difference| / |w|`` over the sweep that verified the bound: at most 1.
    """

    weight: StateSpace
    sizes: FloatArray
    u: tuple[str, ...]
    y: tuple[str, ...]
    tightest: float

    def __post_init__(self) -> None:
        self._set(sizes=self.sizes)

    def __repr__(self) -> str:
        return f"<NeglectedModes: {len(self.u)} u -> {len(self.y)} y, bounded {self.tightest:.3g}>"


def neglected_modes(
    plant: Partition | System, larger: Partition | System | Structure
) -> NeglectedModes:
    """Return a weight that bounds what a larger model has and a plant has not, from u to y.

    ``sigma_max(diag(1/sizes) (G_larger - G)(i omega)) <= |w(i omega)|`` at all frequencies, with
    ``w = g ((1 + s/a) / (1 + s/b))^2``; corners by least mean log distance, a tenth above
    twice the frequency of the highest peak, then verified on
    another grid with points through every resonance.

    Parameters
    ----------
    plant : StandardPlant
        Continuous, or sampled (its continuous plant is compared).
    larger : StandardPlant, FEModel, Modes or ReducedModel
        With the same u and y; a structure gets the plant's ports.

    Returns
    -------
    NeglectedModes

    Raises
    ------
    ModelError
        When channels differ, the two do not differ, or they differ in their rigid body.
    CertificateError
        When the sweep finds a larger difference than the weight.
    """
    small = Partition.of(plant).continuous
    big = Partition.of(larger).continuous if is_plant(larger) else with_modes_of(small, larger)
    moved = _moved(small)
    if set(big.u) != set(small.u) or not set(moved) <= set(big.y):
        raise ModelError(f"the larger plant has other channels: {big.u} -> {big.y}.")
    pair = small.system.select(moved, small.u), big.system.select(moved, small.u)
    grid = _grid(*pair)
    gap = _gap(*pair, grid)
    sizes = np.linalg.norm(gap, axis=1).max(axis=1)
    if not np.all(sizes > 0):
        raise ModelError("the larger model does not differ from the plant: nothing is neglected.")
    height = _height(gap, sizes)
    low = np.searchsorted(grid, 3 * grid[0])
    if height[0] > 3 * height[low]:
        raise ModelError(
            "the difference grows toward low frequencies: the two differ in their rigid body "
            "(mass or inertia), which is no neglected mode. Update the mass first."
        )
    weight = _fitted(grid, height)
    fine = np.unique(np.concatenate([grid[:-1] + f * np.diff(grid) for f in (0.25, 0.5, 0.75)]))
    gain = np.abs(frequency_response(weight, fine).data[0, 0])
    tightest = float(np.max(_height(_gap(*pair, fine), sizes) / gain))
    if tightest > 1:
        raise CertificateError(
            f"the difference is {tightest:.4g} times the weight somewhere: a resonance is "
            "sharper than the grid. Report this with the two models."
        )
    return NeglectedModes(weight, sizes, small.u, tuple(moved), tightest)


def opened(system: StateSpace, neglected: NeglectedModes, deltas: int) -> StateSpace:
    """Return a system with the channels of neglected modes after its first, those of Deltas.

    Inputs `y1:neglected:w` add to the outputs y, times their size; outputs `u1:neglected:z` are
    the inputs u through the weight.
    """
    w, nu = neglected.weight, len(neglected.u)
    columns = system.input_index(neglected.u)
    B = np.vstack([system.B, np.zeros((nu * w.n_states, len(system.inputs)))])
    B[system.n_states :, columns] = np.kron(np.eye(nu), w.B)
    B = np.insert(B, [deltas] * len(neglected.y), 0.0, axis=1)
    C = np.hstack([system.C, np.zeros((len(system.outputs), nu * w.n_states))])
    rows = np.hstack([np.zeros((nu, system.n_states)), np.kron(np.eye(nu), w.C)])
    C = np.insert(C, [deltas] * nu, rows, axis=0)
    D = np.insert(system.D, [deltas] * nu, 0.0, axis=0)
    D[deltas : deltas + nu, columns] = w.D * np.eye(nu)
    D = np.insert(D, [deltas] * len(neglected.y), 0.0, axis=1)
    inputs, outputs = list(system.inputs), list(system.outputs)
    inputs[deltas:deltas] = [f"{name}:neglected:w" for name in neglected.y]
    outputs[deltas:deltas] = [f"{name}:neglected:z" for name in neglected.u]
    for i, name in enumerate(neglected.y):
        D[outputs.index(name), deltas + i] = neglected.sizes[i]
    n, total = system.n_states, system.n_states + nu * w.n_states
    A = np.zeros((total, total))
    A[:n, :n], A[n:, n:] = system.A, np.kron(np.eye(nu), w.A)
    states = [f"{name}:neglected:{state}" for name in neglected.u for state in w.states]
    blocks = None if system.blocks is None else [*system.blocks, *([w.n_states] * nu)]
    return StateSpace(
        A, B, C, D, inputs=inputs, outputs=outputs, states=[*system.states, *states],
        name=system.name, blocks=blocks,
    )  # fmt: skip


def _moved(plant: Partition) -> list[str]:
    """Return the outputs y that u moves: not references."""
    g = plant.Gyu
    seen = np.any(g.C != 0, axis=1) | np.any(g.D != 0, axis=1)
    return [name for name, moves in zip(plant.y, seen, strict=True) if moves]


def _grid(small: StateSpace, big: StateSpace) -> FloatArray:
    """Frequencies [Hz] from a tenth of the first resonance up, through those of both."""
    poles = np.concatenate([small.poles(), big.poles()])
    swinging = np.abs(poles[poles.imag > 0]) / (2 * np.pi)
    if not swinging.size:
        raise ModelError("neither model has an elastic mode: nothing is neglected.")
    top = 10 * swinging.max()
    grids = [default_freq(g) for g in (small, big)]
    flat = np.geomspace(0.1 * swinging.min(), top, 400)
    grid = np.unique(np.concatenate([flat, *grids]))
    return np.asarray(grid[(grid >= flat[0]) & (grid <= top)])


def _gap(small: StateSpace, big: StateSpace, grid: FloatArray) -> ComplexArray:
    """Return the difference of the responses (ny, nu, n_freq)."""
    return frequency_response(big, grid).data - frequency_response(small, grid).data


def _height(gap: ComplexArray, sizes: FloatArray) -> FloatArray:
    """Largest singular value (n_freq,) of the scaled difference."""
    return np.asarray(np.linalg.norm(np.moveaxis(gap / sizes[:, None, None], -1, 0), 2, (1, 2)))


def _fitted(grid: FloatArray, height: FloatArray) -> StateSpace:
    """Return the closest w = g ((1 + s/a) / (1 + s/b))^2 above a height."""
    corners = np.geomspace(grid[0], grid[-1], 61)
    sections = np.log(1 + (grid / corners[:, None]) ** 2)  # of |1 + i f/c|^2, in logs
    step = np.log(np.maximum(height, 1e-12 * height.max()))
    spacing = np.gradient(np.log(grid))
    spacing[grid > 2 * grid[np.argmax(height)]] *= 0.1  # a tight bound matters below the peak
    best, chosen = np.inf, (0, 0)
    for a in range(corners.size):
        shape = sections[a] - sections
        above = np.max(step - shape, axis=1)
        distance = (above[:, None] + shape - step) @ spacing
        if distance.min() < best:
            best, chosen = float(distance.min()), (a, int(np.argmin(distance)))
    a, b = (2 * np.pi * corners[i] for i in chosen)
    gain = float(np.exp(np.max(step - sections[chosen[0]] + sections[chosen[1]])))
    half = StateSpace([[-b]], [[b]], [[1 - b / a]], [[b / a]], inputs=["u"], outputs=["z"])
    both = series(half, half.replace(states=["x2"]))
    return both.replace(C=_MARGIN * gain * both.C, D=_MARGIN * gain * both.D)
