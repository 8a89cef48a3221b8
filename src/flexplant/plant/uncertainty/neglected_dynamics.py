"""Modes that a plant lacks, as an additive dynamic uncertainty with weights that bound them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import scipy.linalg as la

from ...arrays import ComplexArray, FloatArray, name_list, whole
from ...errors import CertificateError, ModelError, counted
from ...lti.conversions import image_freq
from ...lti.frequency import frequency_response
from ...lti.interconnection import among, side_by_side
from ...lti.modal import part_of
from ...lti.statespace import StateSpace, System
from ...store import Value
from ...tolerances import NEGLIGIBLE, PRECISION, RANK, ROUNDING, TINY, TYPED
from ..building import sampled_like
from ..partitioned import Partition, is_plant

#: a plant and the larger one, without rigid-body motions
Pair: TypeAlias = tuple[StateSpace, StateSpace]

#: the weights lie this far above the largest difference found
_MARGIN = 1.05
#: offsets from a resonance, in its half widths, at which the bound is checked as well
_OFFSETS = np.array([0.0, 0.5, -0.5, 2.0, -2.0, 8.0, -8.0])


@dataclass(frozen=True, eq=False, repr=False)
class NeglectedModes(Value):
    """Bound on the effect of neglected modes, as a plant with one dynamic Delta.

    ``[z; y] = (G + W(s) Delta diag(1/scales)) [w; u]``, where G is the plant, and Delta is stable
    with a gain of at most 1. This Delta describes the whole effect of the neglected modes, from
    disturbances and actuators to points of interest and sensors. Its block from u to y acts on the
    loop, the other blocks on the performance.

    Parameters
    ----------
    weights : StateSpace
        Diagonal weight W, continuous, with a separate entry for each output. It is stable and has a
        stable inverse.
    scales : (n_in,) array [input unit]
        Sizes of the inputs, chosen so that each input of its size moves the outputs by about the
        same amount.
    inputs, outputs : sequences of str
        Channels that drive the neglected modes, and channels that these modes move.
    mirrored : mapping {str: str}
        Outputs that equal others with the opposite sign (errors of a reference); they are not
        bounded a second time.
    tightest : float
        Largest singular value, over the frequencies at which the bound was verified, of the Delta
        that gives the larger model exactly. It is at most 1.
    looseness : float
        Median, over the logarithm of frequency, of 1 divided by the largest singular value of this
        Delta. A value of 2 means that the bound is typically twice as large as necessary.
    sampled : NeglectedModes, optional
        The same bound for the sampled plant, which includes the delay and the aliasing of sampling.
        The bilinear map turns the sampled plant into a continuous one, in which the frequency f
        becomes ``tan(pi f dt) / (pi dt)``. The weights are continuous systems at this mapped
        frequency.
    """

    weights: StateSpace
    scales: FloatArray
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    mirrored: Mapping[str, str]
    tightest: float
    looseness: float
    sampled: NeglectedModes | None = None

    def narrowed(self, outputs: Sequence[str]) -> NeglectedModes:
        """Return the bound for some of the outputs, with only the states of their weights."""
        W = self.weights
        heads = tuple(f"{name}:neglected:" for name in name_list(outputs, "outputs"))
        kept = np.array([name.startswith(heads) for name in W.states], dtype=bool)
        weights = part_of(W, kept).select(outputs, outputs)
        mirrored = {name: of for name, of in self.mirrored.items() if of in outputs}
        return self.replace(weights=weights, outputs=tuple(outputs), mirrored=mirrored)

    def __repr__(self) -> str:
        return (
            f"<NeglectedModes: {counted(len(self.inputs), 'input')} -> "
            f"{counted(len(self.outputs), 'output')}, {counted(self.weights.n_states, 'state')}, "
            f"bounded {self.tightest:.3g}, median looseness {self.looseness:.3g}>"
        )


def neglected_modes(
    plant: Partition | System, evaluation: Any, *, resonances: int = 24
) -> NeglectedModes:
    """Return weights that bound the difference between a larger model and a plant.

    The bound is ``sigma_max(W^-1 (G_whole - G) diag(scales)) <= 1`` at all frequencies. Here G and
    G_whole are the responses of the plant and of the larger model from w and u to z and y, and W is
    the diagonal matrix of the weights. The square of each weight is
    ``p_0 + sum_k p_k / |s^2 + 2 zeta_k omega_k s + omega_k^2|^2`` at ``s = i omega``. Linear
    programming finds the coefficients p: the weight must be above the difference at every
    frequency, and as close to it as possible on average over the logarithm of frequency. The first
    terms have the frequencies and damping ratios of the lowest neglected modes. The other terms are
    well damped. The bound is then verified on other frequencies, with points through every
    resonance.

    The rigid-body motions of both are the same and cancel, so that the difference is finite at
    0 Hz.

    Parameters
    ----------
    plant : StandardPlant
        The plant, continuous or sampled. For a sampled plant, the plant before sampling is
        compared.
    evaluation : StandardPlant, FEModel, Modes or ReducedModel
        The larger model. A plant must have the same channels; a structure gets the plant's ports.
    resonances : int
        Number of neglected modes that the weights follow. All others lie below a smooth line. Each
        mode that is followed costs two states for each output.

    Returns
    -------
    NeglectedModes

    Raises
    ------
    ModelError
        When channels differ, the two do not differ, or they differ in their rigid body.
    CertificateError
        When the verification finds a larger difference than the weights.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0] * 4, stiffnesses=[4e5] * 3)
    >>> modes = fx.solve_modes(model, count=4, damping=fx.ModalDamping(0.01))
    >>> ports = fx.testbeds.three_masses().assembled.ports
    >>> plant = fx.assemble_plant(modes.select([0, 1, 2]), ports).discretized(2e3, delay=1)
    >>> found = fx.plant.neglected_modes(plant, modes)
    >>> found.inputs, found.outputs
    (('amp', 'u1'), ('die:x', 'y1', 'y2'))
    """
    given = Partition.of(plant)
    small = given.continuous
    if is_plant(evaluation):
        big = Partition.of(evaluation).continuous
    else:
        judged: Any = small.replace(evaluation=evaluation)
        big = judged.evaluation_plant or small
    follow = whole(resonances, "resonances")
    found = _bounding(_elastic_pair(small, big), follow)
    if not given.dt:
        return found
    return found.replace(sampled=_bounding(_elastic_pair(given, sampled_like(given, big)), follow))


def _bounding(pair: Pair, follow: int) -> NeglectedModes:
    """Return the weights that bound the difference of two systems."""
    pair, mirrored = _distinct(*pair)
    if not pair[0].outputs or not pair[0].inputs:
        raise ModelError("the model does not differ from the plant: nothing is neglected.")
    poles = _upper_poles(*pair)
    grid = _resonance_grid(poles)
    gap = _deviation(pair, grid)
    scales, gap = _evened(gap)
    tall = np.sqrt(gap.shape[0])  # all rows may be at their bound at once, at one resonance
    rows = [covering(grid, tall * np.linalg.norm(row, axis=0), poles, follow) for row in gap]
    weights = side_by_side(rows, pair[0].outputs, ":neglected:")
    height = _height(weights, gap, grid)
    factor = _MARGIN * float(height.max())
    weights = weights.replace(C=factor * weights.C, D=factor * weights.D)
    fine = _verifying(grid, poles)
    found = _height(weights, _deviation(pair, fine) * scales[:, None], fine)
    tightest = float(found.max())
    if not tightest <= 1.0:
        worst = fine[int(np.argmax(found))]
        raise CertificateError(
            f"the difference is {tightest:.4g} times the weights at {worst:.6g} Hz: a resonance is "
            "sharper than the grid. Report this with the two models."
        )
    spacing = np.gradient(np.log(np.maximum(fine, fine[1])))
    order = np.argsort(1.0 / found)
    half = np.searchsorted(np.cumsum(spacing[order]), 0.5 * spacing.sum())
    looseness = float(1.0 / found[order][half])
    inputs, outputs = tuple(pair[0].inputs), tuple(pair[0].outputs)
    return NeglectedModes(weights, scales, inputs, outputs, mirrored, tightest, looseness)


def with_neglected(system: StateSpace, neglected: NeglectedModes, deltas: int) -> StateSpace:
    """Return a system with the channels of neglected modes after its first, those of Deltas."""
    # inputs `y1:neglected:w` pass the weights and add to the outputs; outputs `u1:neglected:z` are
    # the inputs over their scales
    W, mirrored = neglected.weights, neglected.mirrored
    of = W.output_index(mirrored.values())
    ends = [f"{name}:neglected:w" for name in neglected.outputs]
    starts = [f"{name}:neglected:z" for name in neglected.inputs]
    pairs = zip(starts, neglected.inputs, strict=True)
    scales = dict(zip(pairs, 1.0 / neglected.scales, strict=True))
    inputs = [*system.inputs[:deltas], *ends, *system.inputs[deltas:]]
    outputs = [*system.outputs[:deltas], *starts, *system.outputs[deltas:]]
    weights = W.replace(
        C=np.vstack([W.C, -W.C[of]]),
        D=np.vstack([W.D, -W.D[of]]),
        inputs=ends,
        outputs=[*neglected.outputs, *mirrored],
        units={},
    )
    whole = among(system, inputs, outputs, scales) + among(weights, inputs, outputs)
    blocks = None
    if system.blocks is not None and W.blocks is not None:
        blocks = [*system.blocks, *W.blocks]
    return whole.replace(name=system.name, units={}, blocks=blocks)


def _elastic_pair(small: Partition, big: Partition) -> Pair:
    """Return both systems with the channels of the small one, without their rigid-body motions."""
    names = (*small.z, *small.y), (*small.w, *small.u)
    if not set(names[0]) <= set(big.system.outputs) or not set(names[1]) <= set(big.system.inputs):
        raise ModelError(
            f"the other plant has other channels: {big.w + big.u} -> {big.z + big.y}. Assemble "
            "both with the same ports."
        )
    systems, bodies = [], []
    for plant in (small, big):
        g = plant.system.select(*names)
        rigid = np.zeros(g.n_states, dtype=bool)
        if plant.n_rigid:
            rigid[plant.modal_states[: 2 * plant.n_rigid]] = True
        body = part_of(g, rigid)
        bodies.append(body.C @ body.A @ body.B)
        systems.append(part_of(g, ~rigid))
    _same_body(*bodies)
    return systems[0], systems[1]


def _same_body(one: FloatArray, other: FloatArray) -> None:
    size = np.abs(one).max(initial=0.0), np.abs(other).max(initial=0.0)
    if one.shape != other.shape or np.any(
        np.abs(one - other) > TYPED * np.abs(one).max(axis=-1, keepdims=True, initial=0.0)
    ):
        raise ModelError(
            "the difference grows toward low frequencies: the two differ in their rigid body "
            f"(mass or inertia; largest accelerations {size[0]:.6g} and {size[1]:.6g}), which is "
            "no neglected mode. Update the mass first."
        )


def _distinct(small: StateSpace, big: StateSpace) -> tuple[Pair, dict[str, str]]:
    """Return the pair with the channels that differ, each output once, and which are mirrored."""
    probe = _resonance_grid(_upper_poles(small, big))[1::7]
    gap = _deviation((small, big), probe)
    size = np.abs(_bilinear_response(big, probe))
    moved = np.abs(gap).max(axis=2) > ROUNDING * size.max(axis=2).max(initial=0.0)
    rows, columns = np.flatnonzero(moved.any(axis=1)), np.flatnonzero(moved.any(axis=0))
    kept: list[int] = []
    mirrored: dict[str, str] = {}
    for i in rows.tolist():
        same = [j for j in kept if np.array_equal(small.C[i], -small.C[j])
                and np.array_equal(big.C[i], -big.C[j])]  # fmt: skip
        if same:
            mirrored[small.outputs[i]] = small.outputs[same[0]]
        else:
            kept.append(i)
    names = [small.outputs[i] for i in kept], [small.inputs[j] for j in columns.tolist()]
    return (small.select(*names), big.select(*names)), mirrored


def _upper_poles(small: StateSpace, big: StateSpace) -> ComplexArray:
    """Return the poles of both in the upper half plane, slowest first, each once."""
    poles = np.concatenate([_poles(big), _poles(small)])
    # the rounding of delays at z = 0 has no frequency
    poles = poles[(poles.imag > 0) & (-poles.real < 0.99 * np.abs(poles))]
    if not poles.size:
        raise ModelError("neither model has an elastic mode: nothing is neglected.")
    found: list[complex] = []
    for pole in poles[np.argsort(np.abs(poles), kind="stable")].tolist():
        if not any(abs(pole - other) < 0.3 * abs(other.real) for other in found[-4:]):
            found.append(pole)
    return np.array(found)


def _resonance_grid(poles: ComplexArray) -> FloatArray:
    """Return 0 and frequencies [Hz] from a hundredth of the first resonance, through all."""
    own = np.abs(poles) / (2 * np.pi)
    flat = np.geomspace(0.01 * own[0], 10 * own[-1], 500)
    near = (own[:, None] - _OFFSETS * poles.real[:, None] / (2 * np.pi)).ravel()
    grid = np.unique(np.concatenate([flat, near]))
    return np.concatenate([[0.0], grid[(grid >= flat[0]) & (grid <= flat[-1])]])


def _verifying(grid: FloatArray, poles: ComplexArray) -> FloatArray:
    """Return frequencies between those of a grid, and others near the resonances."""
    inner = [grid[:-1] + part * np.diff(grid) for part in (0.29, 0.5, 0.83)]
    own, half = np.abs(poles) / (2 * np.pi), -poles.real / (2 * np.pi)
    near = own[:, None] + np.array([-0.43, 0.11, 0.57]) * half[:, None]
    return np.unique(np.concatenate([[0.0], near.ravel(), *inner]))


def _poles(g: StateSpace) -> ComplexArray:
    """Return the poles [rad/s], of a sampled system in its bilinear frequency."""
    poles = g.poles()
    return np.asarray(2.0 / g.dt * (poles - 1.0) / (poles + 1.0)) if g.dt else poles


def _bilinear_response(g: StateSpace, grid: FloatArray) -> ComplexArray:
    """Return the responses, of a sampled system at bilinear frequencies."""
    return frequency_response(g, image_freq(2.0 * np.pi * grid, g.dt)).data


def _deviation(pair: Pair, grid: FloatArray) -> ComplexArray:
    """Return the difference of the responses (n_out, n_in, n_freq)."""
    return _bilinear_response(pair[1], grid) - _bilinear_response(pair[0], grid)


def _evened(gap: ComplexArray) -> tuple[FloatArray, ComplexArray]:
    """Return scales (n_in,) that make all inputs alike, and the difference per scaled input."""
    most = np.abs(gap).max(axis=2)
    scales = 1.0 / np.max(most / most.max(axis=1, keepdims=True), axis=0)
    return scales, gap * scales[:, None]


def _height(weights: StateSpace, gap: ComplexArray, freq: FloatArray) -> FloatArray:
    """Return the largest singular value (n_freq,) of the difference over the weights."""
    gains = np.array([
        np.abs(frequency_response(weights.select([name], [name]), freq).data[0, 0])
        for name in weights.outputs
    ])  # fmt: skip
    return np.asarray(np.linalg.norm(np.moveaxis(gap / gains[:, None], -1, 0), 2, (1, 2)))


#: well damped terms that every weight may have, over the whole range of frequencies
_SMOOTH = 20
#: steps of the fit, and how much more a weight below the curve counts than one above
_STEPS, _BELOW = 40, 4.0
#: a value of the curve below this fraction of its surroundings is not followed; the width of these
#: surroundings, in logarithms
_VALLEY, _WIDE = 1e-4, 0.1
#: a resonance is worth its states when the curve stands this factor above its surroundings
_PROMINENT = 3.0
#: poles of a hump of unit frequency, and how far its two pairs are apart
_HUMP, _APART = complex(-0.4, np.sqrt(1 - 0.4**2)), 1.1


def covering(
    freq: FloatArray, height: FloatArray, poles: ComplexArray, resonances: int
) -> StateSpace:
    """Return a stable weight w with a stable inverse and ``|w(i omega)| >= height`` at all freq."""
    # `|w|^2 = p_0 + sum_k p_k t_k` with p > 0: t_k is `1 / |d_k(i omega)|^2` of a resonance or of a
    # well damped pair, or a hump `omega^4 / |d_k d_k'|^2`. With `x = omega^2` the right side is a
    # rational function of x, positive for x >= 0; w has its zeros and poles `s = -sqrt(-x)`
    unit = 2 * np.pi * freq[-1]
    own = _peak_poles(freq, height, poles)[:resonances] / unit
    corners = np.geomspace(20 * np.pi * freq[1] / unit, 1.0, _SMOOTH)
    terms = [_Term(0, (pole,)) for pole in own]
    terms += [_Term(0, (corner * np.exp(0.75j * np.pi),)) for corner in corners[::2]]
    # zero at 0 Hz: next to many resonances that are not followed
    terms += [_Term(2, (c * _HUMP, c * _APART * _HUMP)) for c in corners]
    x = (2 * np.pi * freq / unit) ** 2
    square = height**2
    tall = _envelope(freq, square, own[-1:] * unit)
    values = np.column_stack([np.ones(x.size), *(term.at(x) for term in terms)])
    size = values.max(axis=0)
    values = values / size
    spacing = np.gradient(np.log(np.maximum(freq, freq[1])))
    p = _raised(values, _log_fit(values, tall, spacing), square)
    part = np.max(values * p / (values @ p)[:, None], axis=0)
    kept = np.flatnonzero(part[1:] > NEGLIGIBLE)
    gains = p / size
    ends: dict[complex, complex] = {}
    for i in kept.tolist():
        for pole, end in terms[i].residues:
            ends[pole] = ends.get(pole, 0.0) + gains[i + 1] * end
    constant = max(float(gains[0]), RANK * max(map(abs, ends.values()), default=0.0))
    total = constant + sum(gains[i + 1] * terms[i].at(x) for i in kept)
    rise = float(np.max(square / total))
    return _spectral_factor(rise * constant, {at: rise * end for at, end in ends.items()}, unit)


@dataclass(frozen=True)
class _Term:
    """``x^m / prod |(x + l^2)|^2`` of some poles l in the upper half plane, ``x = omega^2``."""

    power: int
    poles: tuple[complex, ...]

    def at(self, x: FloatArray) -> FloatArray:
        """Return the values at x (n,)."""
        found = x**self.power
        for pole in self.poles:
            found = found / np.abs(x + pole**2) ** 2
        return found

    @property
    def residues(self) -> list[tuple[complex, complex]]:
        """Poles l and the residues at ``x = -l^2``; those at conjugates are conjugate."""
        every = [-(one**2) for pole in self.poles for one in (pole, pole.conjugate())]
        found = []
        for pole in self.poles:
            at = -(pole**2)
            others = [one for one in every if one != at]
            found.append((complex(pole), complex(at**self.power / np.prod(at - np.array(others)))))
        return found


def _peak_poles(freq: FloatArray, height: FloatArray, poles: ComplexArray) -> ComplexArray:
    """Return the poles at which the curve is far above its values half an eighth away."""
    at = np.log(np.maximum(freq, freq[1]))
    line = np.log(height + TINY)
    own = np.log(np.abs(poles) / (2 * np.pi))
    top, low, high = (np.interp(own + step, at, line) for step in (0.0, -0.06, 0.06))
    return np.asarray(poles[top - np.minimum(low, high) > np.log(_PROMINENT)])


def _envelope(freq: FloatArray, square: FloatArray, last: ComplexArray) -> FloatArray:
    """Return the curve, its deepest valleys filled, above the last resonance its envelope."""
    at = np.log(np.maximum(freq, freq[1]))
    start = np.searchsorted(at, at[:, None] - _WIDE)[:, 0]
    end = np.searchsorted(at, at[:, None] + _WIDE, side="right")[:, 0]
    around = np.array([square[i:j].max() for i, j in zip(start, end, strict=True)])
    above = freq > 1.02 * np.max(np.abs(last), initial=0.0) / (2 * np.pi)
    return np.asarray(np.maximum(np.where(above, around, square), _VALLEY**2 * around))


def _log_fit(terms: FloatArray, square: FloatArray, spacing: FloatArray) -> FloatArray:
    """Return p > 0 with ``terms p`` near a curve in logarithms: below it counts four times."""
    # least squares over q = log p, weighted half by the logarithm of frequency, half by the points
    # (most of which stand at resonances)
    from scipy.optimize import least_squares  # not loaded with the package

    goal = np.log(square)
    weight = np.sqrt(0.5 * spacing / spacing.sum() + 0.5 / spacing.size)

    def sums(q: FloatArray) -> FloatArray:
        return np.asarray(terms @ np.exp(q))

    def side(q: FloatArray) -> FloatArray:
        return np.asarray(weight * np.where(sums(q) < square, _BELOW, 1.0))

    def error(q: FloatArray) -> FloatArray:
        return np.asarray(side(q) * (np.log(sums(q)) - goal))

    def slope(q: FloatArray) -> FloatArray:
        # what is below the rounding of a sum is zero: on some matrices with such entries LAPACK's
        # singular values do not converge
        share = terms * np.exp(q) / sums(q)[:, None]
        return np.asarray(side(q)[:, None] * np.where(share > PRECISION, share, 0.0))

    # each term as high as it can be below the curve, or nearly so
    start = -np.log(np.quantile(terms / square[:, None], 0.99, axis=0))
    found = least_squares(error, start, jac=slope, max_nfev=_STEPS, x_scale=1.0)
    return np.asarray(np.exp(found.x))


def _raised(terms: FloatArray, p: FloatArray, square: FloatArray) -> FloatArray:
    """Return p with ``terms p >= square``: where it is below, the largest term there is raised."""
    for _ in range(_STEPS):
        parts = terms * p
        short = square / parts.sum(axis=1)
        below = np.flatnonzero(short > 1.0)
        if not below.size:
            break
        raised = np.ones(p.size)
        np.maximum.at(raised, np.argmax(parts[below], axis=1), short[below])
        p = p * raised
    return p


def _spectral_factor(constant: float, ends: dict[complex, complex], unit: float) -> StateSpace:
    """Return the spectral factor of ``constant + sum_k 2 Re(r_k / (x + l_k^2))``, in modal form."""
    # its zeros, as x, are the finite eigenvalues of an arrow matrix
    poles = np.array(list(ends), dtype=np.complex128)
    share = np.array(list(ends.values()), dtype=np.complex128)
    at = -(np.concatenate([poles, poles.conj()]) ** 2)
    root = np.sqrt(np.concatenate([share, share.conj()]))
    n, top = at.size, float(np.abs(root).max(initial=TINY))
    # bordered, not divided by the constant: slow zeros would be lost in the rounding of fast ones
    left, right = np.diag(np.append(at, constant / top**2)), np.diag(np.append(np.ones(n), 0.0))
    left[:n, n] = left[n, :n] = root / top
    values = np.asarray(la.eigvals(left, right, homogeneous_eigvals=True))
    finite = np.argsort(-np.abs(values[1]) / np.abs(values).max(axis=0), kind="stable")[:n]
    zeros = -np.sqrt(-values[0, finite] / values[1, finite])
    zeros = zeros[np.argsort(np.abs(zeros), kind="stable")]
    both = np.concatenate([poles, poles.conj()])
    both = both[np.argsort(np.abs(both), kind="stable")]
    blocks, B, C = [np.zeros((0, 0))], [np.zeros(0)], [np.zeros(0)]
    for pole in poles:
        others = both[both != pole]
        ratio = (pole - zeros[: others.size]) / (pole - others)
        residue = np.sqrt(constant) * np.prod(ratio) * np.prod(pole - zeros[others.size :])
        size = np.sqrt(2 * abs(residue) * unit)
        turn = residue / abs(residue)
        blocks.append(unit * np.array([[pole.real, pole.imag], [-pole.imag, pole.real]]))
        B.append(np.array([size, 0.0]))
        C.append(size * np.array([turn.real, turn.imag]))
    return StateSpace(
        la.block_diag(*blocks[1:]) if poles.size else np.zeros((0, 0)),
        np.concatenate(B)[:, None], np.concatenate(C)[None, :], [[np.sqrt(constant)]],
        blocks=[2] * poles.size,
    )  # fmt: skip
