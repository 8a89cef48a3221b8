"""H-infinity and L-infinity norms: peaks of the gain with a proof of the maximum."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..arrays import FloatArray
from ..errors import CertificateError, SolverError
from ..parallel import Progress, one_thread
from ..tolerances import MISSED, MOST_STEPS, RANK, SAME, SETTLED
from .blocks_of_states import bilinear_matrices, diagonal_blocks, is_block_diagonal
from .equations import axis_frequencies, state_scale
from .frequency_sweep import POINTS, resonance_grid, swept_gains
from .lyapunov import (
    controllability_factor,
    controllability_gramian,
    observability_factor,
    observability_gramian,
)
from .modal import obstacle
from .peaks import Residues, proved_peak, residues
from .response_solvers import Responder, points, responder
from .statespace import StateSpace, System, as_statespace


def hinf_norm(sys: System, *, progress: bool | None = None) -> float:
    """Return the H-infinity norm: the largest gain over all frequencies and input directions.

    The relative accuracy is 1e-8, or ``eps |A| / |Re p|`` if that is larger. Here p is the pole
    that causes the peak, and eps is the machine precision: rounding moves the poles of a dense
    matrix A by about eps |A|. This matters only for damping ratios below 1e-8. It does not matter
    for systems in modal blocks, which `modal_form` and assembled plants have. See `peak_gain`.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled system with any number of channels.
    progress : as for `peak_gain`, optional

    Returns
    -------
    float
        Infinite when the system is not strictly stable; `norm_report` says why.

    Raises
    ------
    ModelError
        When `sys` is not a system.

    References
    ----------
    [BruinsmaSteinbuch1990]_.

    Examples
    --------
    >>> resonance = StateSpace([[0, 1], [-1, -0.02]], [[0], [1]], [[1, 0]], [[0]])
    >>> print(f"{hinf_norm(resonance):.4f}")  # 1 / (2 zeta sqrt(1 - zeta^2))
    50.0025
    """
    return peak_gain(sys, progress=progress)[0]


def peak_gain(sys: System, *, progress: bool | None = None) -> tuple[float, float]:
    """Return the largest gain over all frequencies, and the frequency of the peak.

    Newton steps start at the resonances and find the peak. Then a proof on intervals of frequency
    shows that the gain exceeds this peak nowhere by more than a relative tolerance of 1e-9. The
    proof uses Taylor series of ``D + sum R_i / (s - p_i)``, with poles p_i and residues R_i; the
    distances to the poles bound the remainder. If the eigenvectors of A are ill-conditioned, or the
    gain is flat, another test replaces this proof: no frequency has a larger gain if the
    Hamiltonian matrix of that gain has no eigenvalue on the imaginary axis. A sampled system is
    first transformed to a continuous one by the bilinear map, which does not change the largest
    gain.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled system with any number of channels.
    progress : bool, optional
        Whether to show a progress bar. By default it is shown on a terminal for work of more than
        two seconds.

    Returns
    -------
    gain : float
        Largest singular value; infinite when the system is not strictly stable.
    freq : float [Hz]
        Frequency of the peak. If the gain is infinite, it is the frequency of the least stable
        pole. It is infinite if the gain is largest towards infinite frequency (the feedthrough).

    Raises
    ------
    SolverError
        When the iteration does not converge.

    References
    ----------
    [BoydBalakrishnan1990]_; [BruinsmaSteinbuch1990]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> gain, freq = fx.peak_gain(fx.lti.tf([1.0], [1.0, 0.02, 1.0]))
    >>> round(gain, 3), round(freq, 4)  # 1 / (2 zeta sqrt(1 - zeta^2)), near 1 / (2 pi) Hz
    (50.003, 0.1591)
    """
    with Progress(MOST_STEPS, "levels of the norm", progress=progress) as bar:
        return _peak_gain(as_statespace(sys), bar)


def linf_norm(sys: System) -> float:
    """Return the L-infinity norm: the largest gain on the frequency axis, stable or not.

    For a stable system it is equal to the H-infinity norm. For an unstable one (a controller, a
    plant with negative stiffness) it is the peak of the frequency response, not a gain from inputs
    to outputs of bounded energy; use it for model errors and measured responses.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled system with any number of channels.

    Returns
    -------
    float
        The norm, with a relative accuracy of 1e-8. It is infinite when a pole lies on the frequency
        axis, as the poles of rigid-body modes do.

    Raises
    ------
    SolverError
        When the iteration does not converge.

    Examples
    --------
    >>> print(f"{linf_norm(StateSpace([[2.0]], [[1.0]], [[1.0]], [[0.0]])):.3f}")
    0.500
    """
    return axis_peak(as_statespace(sys))[0]


def axis_peak(g: StateSpace) -> tuple[float, float]:
    """Return the largest gain on the frequency axis and its frequency [Hz], stable or not."""
    return _peak_gain(g, Progress(0, "", progress=False), axis_only=True)


@one_thread()
def _peak_gain(g: StateSpace, bar: Progress, axis_only: bool = False) -> tuple[float, float]:
    """Return gain and frequency [Hz], infinite with a pole on the axis (or beyond it)."""
    if not g.D.size or not g.n_states:
        return float(np.linalg.norm(g.D, 2)) if g.D.size else 0.0, 0.0
    model, poles = residues(g)
    problem = obstacle(g, axis_only=axis_only, known=poles)
    if problem:
        return float("inf"), problem.freq
    respond = None if model is None or g.dt or g.blocks is not None else model.responses
    return _proved(g, model) or level_set_peak(g, SETTLED, bar, respond)


def _proved(g: StateSpace, model: Residues | None) -> tuple[float, float] | None:
    """Return the peak proved from residues, None without a proof."""
    if model is None or not model.poles.size:
        return None
    found = proved_peak(model, SETTLED)
    if found is None:
        return None
    omega = found[1]
    freq = float(np.arctan(omega) / (np.pi * g.dt) if g.dt else omega / (2.0 * np.pi))
    gain = _gain_at(g, freq)
    return (gain, freq) if abs(found[0] - gain) <= SAME * gain else None


def _gain_at(g: StateSpace, freq: float) -> float:
    """Return the largest singular value at a frequency [Hz]."""
    s = points(g, np.array([freq]))[0]
    if is_block_diagonal(g):
        pairs, slots = diagonal_blocks(g.A, g.blocks or ())
        real = slots >= 0
        moved = np.linalg.solve(s * np.eye(2) - pairs, g.B[slots] * real[:, :, None])
        gain = (g.C[:, slots] * real).reshape(len(g.C), -1) @ moved.reshape(slots.size, -1)
    else:
        d = state_scale(g.A, g.B, g.C)
        shifted = s * np.eye(d.size) - g.A * d / d[:, None]
        gain = (g.C * d) @ np.linalg.solve(shifted, g.B / d[:, None])
    return float(np.linalg.norm(gain + g.D, 2))


#: relative tolerance of H2 norms from two routes: five digits. Squared norms from both Gramians may
#: also differ by the rounding of their terms
SAME_NORM = 1e-5


@one_thread()
def h2_norm(sys: System) -> float:
    """Return the H2 norm: the rms of all outputs together for white inputs of unit intensity.

    The norm is ``trace(C P C')^(1/2)``, and ``trace(C P C' + D D')^(1/2)`` for a sampled system,
    where P is the controllability Gramian. For a system in modal blocks P has a closed form. The
    norm is computed a second time from the observability Gramian Q, by
    ``trace(B' Q B) = trace(C P C')``. Both results must agree to a relative tolerance of 1e-5, or
    within the rounding errors of their terms.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled system.

    Returns
    -------
    float
        The norm. It is infinite when the system is not strictly stable (rigid-body modes are not),
        or when it is continuous and has feedthrough; `norm_report` says which of these.

    Raises
    ------
    SolverError
        When the equation of a Gramian is so badly conditioned that its residual is too large.
    CertificateError
        When the two Gramians give different norms.

    References
    ----------
    [ZhouDoyleGlover1996]_, section 4.6.

    Examples
    --------
    >>> import flexplant as fx
    >>> print(f"{fx.h2_norm(fx.StateSpace([[-2.0]], [[1.0]], [[1.0]], [[0.0]])):.3f}")
    0.500
    """
    g = as_statespace(sys)
    if obstacle(g) is not None or (not g.dt and g.n_states and np.any(g.D)):
        return float("inf")
    if not g.n_states:
        return float(np.linalg.norm(g.D)) if g.dt else (float("inf") if np.any(g.D) else 0.0)
    if is_block_diagonal(g):
        square, terms = _trace(g.C, controllability_gramian(g))
        other, their = _trace(g.B.T, observability_gramian(g))
    else:  # by factors: with slow poles next to fast ones the Gramians lose half of their digits
        square, terms = _trace_of_factor(g.C, controllability_factor(g))
        other, their = _trace_of_factor(g.B.T, observability_factor(g))
    direct = float(np.sum(g.D**2)) if g.dt else 0.0
    allowed = SAME_NORM * (max(square, other) + direct) + RANK * max(terms, their)
    if not abs(square - other) <= allowed:
        raise CertificateError(
            f"the H2 norm of {g!r} is {np.sqrt(max(square, 0.0)):.9g} by the controllability "
            f"Gramian and {np.sqrt(max(other, 0.0)):.9g} by the observability Gramian: a pole is "
            "too close to the edge of stability for double precision. Check the least damped poles."
        )
    return float(np.sqrt(max(square + direct, 0.0)))


def _trace(C: FloatArray, P: FloatArray) -> tuple[float, float]:
    """Return ``trace(C P C')`` and the size of its terms before they cancel."""
    deviation = np.abs(C) @ np.sqrt(np.maximum(P.diagonal(), 0.0))
    return float(np.sum(C @ P * C)), float(np.sum(deviation**2))


def _trace_of_factor(C: FloatArray, L: FloatArray) -> tuple[float, float]:
    """Return the same of ``P = L L'``."""
    deviation = np.abs(C) @ np.linalg.norm(L, axis=1)
    return float(np.sum((C @ L) ** 2)), float(np.sum(deviation**2))


def level_set_peak(
    g: StateSpace, tolerance: float, bar: Progress, respond: Responder | None = None
) -> tuple[float, float]:
    """Return the largest gain and its frequency [Hz] of a system without poles on the axis."""
    # from the midpoints between crossings of its level, until no crossing remains at (1 +
    # tolerance) times it
    top = 0.5 / g.dt if g.dt else np.inf
    answer = respond or responder(g)

    def find(freq: FloatArray) -> FloatArray:
        return swept_gains(answer, freq)

    gain, freq = _swept_peak(g, find, top)
    if not gain:
        return 0.0, 0.0
    level = _Level(g)
    for _ in range(MOST_STEPS):
        bar.advance()
        # just above the feedthrough the Hamiltonian matrix is nearly singular: a level more
        close = gain <= (1 + MISSED) * level.through
        levels = (tolerance, MISSED) if close else (tolerance,)
        found = [level.crossings(gain * (1 + one)) for one in levels]
        middles = np.concatenate([one for c in found for one in (c, 0.5 * (c[1:] + c[:-1]))])
        middles = middles[middles < top]
        sizes = find(middles)
        if not sizes.size or sizes.max() <= gain * (1 + tolerance):
            return gain, freq
        best = int(np.argmax(sizes))
        gain, freq = float(sizes[best]), float(middles[best])
    raise SolverError(
        f"the level set of the H-infinity norm of {g!r} did not converge in {MOST_STEPS} "
        f"levels (last gain {gain:.9g} at {freq:.6g} Hz). Report this system."
    )


def _swept_peak(
    g: StateSpace, find: Callable[[FloatArray], FloatArray], top: float
) -> tuple[float, float]:
    """Return a large gain and its frequency [Hz]: the feedthrough, or one at a resonance."""
    # a step of the level set costs less than a fine sweep
    grid = np.append(0.0, resonance_grid(g.poles(), g.dt, points=POINTS // 4, around=(0.0,)))
    through = np.linalg.norm(g.evaluated(-1.0) if g.dt else g.D, 2)
    sizes = find(grid)
    best = int(np.argmax(sizes))
    return max((float(through), top), (float(sizes[best]), float(grid[best])))


class _Level:
    """The frequencies at which a singular value of a stable system equals a level."""

    def __init__(self, g: StateSpace) -> None:
        self.dt = g.dt
        A, B, C, D = g.A, g.B, g.C, g.D
        if g.dt:  # z = (1 + s) / (1 - s)
            A, B, C, D = bilinear_matrices((A, B, C, D), 1.0)
        self.A, self.B, self.C, self.D = A, B, C, D
        self.through = float(np.linalg.norm(D, 2))

    def crossings(self, gamma: float) -> FloatArray:
        """Return the sorted frequencies [Hz] of eigenvalues on, or nearly on, the axis."""
        root = np.sqrt(gamma)
        A, B, C, D = self.A, self.B / root, self.C / root, self.D / gamma
        # (gamma = 1) R = I - D'D, S = I - D D', through the singular values of D
        U, d, Vh = np.linalg.svd(D, full_matrices=True)
        gap_in, gap_out = np.ones(D.shape[1]), np.ones(D.shape[0])
        gap_in[: d.size] = gap_out[: d.size] = (1 - d) * (1 + d)
        BV, CU = B @ Vh.T, U.T @ C
        mixed = np.zeros(D.T.shape)
        mixed[np.arange(d.size), np.arange(d.size)] = d / gap_in[: d.size]
        F = A + BV @ mixed @ CU
        H = np.block([[F, (BV / gap_in) @ BV.T], [-(CU.T / gap_out) @ CU, -F.T]])
        swing = np.unique(np.abs(axis_frequencies(H)))
        if self.dt:
            return np.asarray(np.arctan(swing) / (np.pi * self.dt))
        return np.asarray(swing / (2 * np.pi))
