"""mu: bounds of the structured singular value of a matrix, or of a system over all frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...checks import ComplexArray, FloatArray, Value, generator
from ...errors import AssumptionError, ModelError
from ...lti.discretisation import bilinear, image_freq
from ...lti.norms import obstacle
from ...lti.statespace import StateSpace, System, as_statespace
from ...parallel import one_thread
from ...tolerances import TINY
from .lower import crossing_multiple, destabilising, power_iteration
from .sweep import covered
from .uncertainty_blocks import (
    Block,
    Perturbation,
    RepeatedScalar,
    Scalings,
    block_places,
    filled_blocks,
    matrix_of,
)
from .upper import upper_level

#: frequencies at which a perturbation is sought, starts at each
_SOUGHT, _STARTS = 8, 6
#: part of the upper bound from which a lower one is not raised further: no design hangs on less
_MET = 0.999


@dataclass(frozen=True, eq=False, repr=False)
class MuBounds(Value):
    """Bounds of the structured singular value, and the perturbation that shows the lower one.

    Parameters
    ----------
    upper : float
        No Delta of the structure smaller than 1 / upper makes ``I - M Delta`` singular, at any
        frequency.
    lower : float
        The perturbation of size 1 / lower does; 0 when none was found.
    freq : float [Hz]
        Where the upper bound is largest; NaN of a matrix.
    perturbation : (w, z) complex array
        Of size 1 / lower, at the frequency where it acts; zero when none was found.
    frequencies, bounds : (k,) arrays [Hz, 1]
        Upper bounds that were computed at single frequencies; where they are not near the largest
        they need not be the smallest.
    intervals : int
        Number of intervals that cover the frequency axis, 0 of a matrix.
    """

    upper: float
    lower: float
    freq: float
    perturbation: ComplexArray
    frequencies: FloatArray = field(default_factory=lambda: np.zeros(0))
    bounds: FloatArray = field(default_factory=lambda: np.zeros(0))
    intervals: int = 0

    def __repr__(self) -> str:
        where = f", largest at {self.freq:.5g} Hz" if np.isfinite(self.freq) else ""
        return f"<MuBounds: {self.lower:.5g} <= mu <= {self.upper:.5g}{where}>"


@one_thread()
def mu(M: System | ComplexArray, blocks: Sequence[Block], *, rng: Any = 0) -> MuBounds:
    """Return bounds of the structured singular value: 1 / min |Delta| with I - M Delta singular.

    ::

        mu(M) = 1 / min { |Delta| : det(I - M Delta) = 0 },   Delta = diag(delta_1 I, ..., Delta_F)

    From above by scalings D and G: ``mu^2 D - M* D M + j (G M - M* G) > 0``; of a system these
    hold on intervals whose ends are eigenvalues of a Hamiltonian matrix, and the intervals cover
    all frequencies, so that no peak lies between. From below by power iterations with random
    restarts; of a system the eigenvalues of the closed loop with the perturbation decide.

    Parameters
    ----------
    M : (z, w) array or StateSpace
        Complex matrix; or a stable system, continuous or sampled.
    blocks : sequence of RepeatedScalar and FullBlock
        ``w = Delta z`` in the order of the channels.
    rng : int, SeedSequence, Generator or None
        Of the restarts.

    Returns
    -------
    MuBounds

    Raises
    ------
    AssumptionError
        When the system is not stable.
    ShapeError, ModelError
        When the blocks do not fill M, or M is neither a matrix nor a system.
    SolverError
        When intervals do not cover the frequency axis.

    References
    ----------
    [Fan1991]_; [Young1990]_; [Lawrence2000]_.

    Examples
    --------
    >>> import numpy as np
    >>> from flexplant.synthesis import FullBlock
    >>> found = mu(np.array([[0.0, 2.0], [0.5, 0.0]]), [FullBlock(), FullBlock()])
    >>> print(f"{found.lower:.3f} {found.upper:.2f}")
    1.000 1.00
    """
    chance = generator(rng)
    if isinstance(M, np.ndarray | list | tuple):
        gain = np.asarray(M)
        if gain.ndim != 2 or gain.dtype.kind not in "biufc" or not np.all(np.isfinite(gain)):
            raise ModelError(
                f"M must be a finite matrix (z, w), got an array of shape {gain.shape} and kind "
                f"{gain.dtype}. Pass the response at one frequency."
            )
        return _of_matrix(gain.astype(np.complex128), blocks, chance)
    g = as_statespace(M)
    if not g.n_states:
        return _of_matrix(g.D.astype(np.complex128), blocks, chance)
    listed = filled_blocks(blocks, len(g.inputs), len(g.outputs))
    problem = obstacle(g)
    if problem is not None:
        raise AssumptionError(
            f"M is {problem.reason}: mu bounds what keeps a stable loop stable. Close a "
            "controller that stabilises it first."
        )
    image = bilinear(g, 1.0 / g.dt) if g.dt else g
    found = covered(image, listed)
    upper = float(np.sqrt(found.level))

    best = destabilising(image, listed, sought(image, found), upper, chance)
    delta: ComplexArray = np.zeros((len(g.inputs), len(g.outputs)), dtype=np.complex128)
    if best is not None:
        delta = best.size * matrix_of(best.found, block_places(listed))
    return MuBounds(
        upper,
        0.0 if best is None else min(1.0 / best.size, upper),
        float(image_freq(found.omega, g.dt)),
        delta,
        image_freq(found.frequencies, g.dt),
        np.sqrt(found.bounds),
        found.intervals,
    )


def sought(M: StateSpace, found: Any) -> list[float]:
    """Return the frequencies [rad/s] at which perturbations are sought: the worst and 0."""
    worst = [float(one) for one in found.frequencies[np.argsort(-found.bounds)[:_SOUGHT]]]
    poles = M.poles()
    light = poles[(poles.imag > 0)]
    swing = light[np.argsort(-light.real / np.abs(light))[:_SOUGHT]].imag
    return list(dict.fromkeys([float(found.omega), *worst, *swing.tolist(), 0.0]))


def _of_matrix(M: ComplexArray, blocks: Sequence[Block], rng: np.random.Generator) -> MuBounds:
    """Return the bounds of one matrix."""
    listed = filled_blocks(blocks, M.shape[1], M.shape[0])
    where = block_places(listed)
    upper = float(np.sqrt(upper_level(M, Scalings(listed)).level))
    lower = 0.0
    delta: ComplexArray = np.zeros(M.shape[::-1], dtype=np.complex128)
    for _ in range(_STARTS):
        one = power_iteration(M, where, rng)
        found = crossing_multiple(M, where, one) or _real_multiple(M, where, one)
        if found is not None and 1.0 / found[0] > lower:
            lower = 1.0 / found[0]
            delta = np.asarray(found[0] * matrix_of(found[1], where))
        if lower >= _MET * upper:
            break
    return MuBounds(upper, lower, float("nan"), delta)


def _real_multiple(
    M: ComplexArray, where: Sequence[Any], found: Perturbation
) -> tuple[float, Perturbation] | None:
    """Return t with ``det(I - t M Delta) = 0`` for real Deltas: of a real eigenvalue."""
    if any(not (isinstance(p.block, RepeatedScalar) and p.block.real) for p in where):
        return None
    values = np.linalg.eigvals(M @ matrix_of(found, where))
    # a double eigenvalue comes out complex by the root of rounding
    real = np.abs(values.imag) < 1e-8 * np.abs(values).max(initial=TINY)
    best = float(np.max(values.real[real], initial=0.0))
    return (1.0 / best, found) if best > 0 else None
