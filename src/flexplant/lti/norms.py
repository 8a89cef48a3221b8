"""H-infinity and L-infinity norms: peaks of the gain, verified by a level set."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg as la

from ..errors import SolverError
from ..parallel import Progress, one_thread
from ..values import ComplexArray, FloatArray
from .responses import Responder, continuous_poles, points, responder
from .scaling import balanced_matrix, state_scale
from .stability import obstacle
from .statespace import StateSpace, System, as_statespace

#: the norm lies between the gain found and (1 + TOLERANCE) times it
TOLERANCE = 1e-9
LEVELS = 30
#: how far above the largest gain of the feedthrough a level set is not lost in rounding
CLEAR = 1e-7
#: dense systems of so many states are searched by their eigenvectors, unless their condition is
#: larger; frequencies of a batch of eliminations
QUICK, POOR, STEP = 100, 1e7, 64
#: points across each resonance at first; parabolas from there on, each on an interval so much
#: narrower: the last one is 1e-3 of a resonance wide, its error in the gain below 1e-10
ACROSS, PARABOLAS, NARROWER = 9, 3, 8.0


def hinf_norm(sys: System, *, progress: bool | None = None) -> float:
    """Return the H-infinity norm: the largest gain over all frequencies and input directions.

    Relative accuracy 1e-8, or ``eps |A| / |Re p|`` where that is larger, p the pole of the peak:
    rounding moves the poles of a dense A by eps |A|. It counts at damping ratios below 1e-8, and
    not in modal blocks, as `modal_form` and assembled plants have them. See `peak_gain`.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled, any numbers of channels.
    progress : bool, optional
        As for `peak_gain`.

    Returns
    -------
    float
        Infinite when the system is not strictly stable; `norm_report` says why.

    Raises
    ------
    ModelError
        When `sys` is no system.

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

    A local search from every resonance gives a gain; that no frequency exceeds it by 1e-9 is
    verified by the eigenvalues of the Hamiltonian matrix of that level (none on the imaginary
    axis), and improved from the middles of the crossings otherwise. Sampled systems go through
    the bilinear map, which keeps gains.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled, any numbers of channels.
    progress : bool, optional
        True shows a bar of the search and its levels at once, False never; None after two seconds
        on a terminal.

    Returns
    -------
    gain : float
        Largest singular value; infinite when the system is not strictly stable.
    freq : float [Hz]
        Where it is found; of the least stable pole when the gain is infinite; infinite when the
        peak is the feedthrough.

    Raises
    ------
    ModelError
        When `sys` is no system.
    SolverError
        When the level set does not settle (not seen so far).

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
    g = as_statespace(sys)
    with Progress(LEVELS, "levels of the norm", progress=progress) as bar:
        problem = obstacle(g)
        return (float("inf"), problem.freq) if problem else _peak(g, bar)


def linf_norm(sys: System) -> float:
    """Return the L-infinity norm: the largest gain on the frequency axis, stable or not.

    Equal to the H-infinity norm for a stable system. For an unstable one (a controller, a plant
    with negative stiffness) it is the peak of the frequency response, which is no gain from inputs
    to outputs of bounded energy; use it for model errors and measured responses.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled, any numbers of channels.

    Returns
    -------
    float
        Relative accuracy 1e-8; infinite when a pole lies on the axis (rigid-body modes do).

    Raises
    ------
    ModelError
        When `sys` is no system.
    SolverError
        When the level set does not settle.

    Examples
    --------
    >>> print(f"{linf_norm(StateSpace([[2.0]], [[1.0]], [[1.0]], [[0.0]])):.3f}")
    0.500
    """
    return axis_peak(as_statespace(sys))[0]


def axis_peak(g: StateSpace) -> tuple[float, float]:
    """Return the largest gain on the frequency axis and its frequency [Hz], stable or not."""
    problem = obstacle(g, axis_only=True)
    return (float("inf"), problem.freq) if problem else _peak(g, Progress(0, "", progress=False))


@one_thread()
def _peak(g: StateSpace, bar: Progress) -> tuple[float, float]:
    """Return gain and frequency of a system without poles on the axis."""
    if not g.D.size:
        return 0.0, 0.0
    top = 0.5 / g.dt if g.dt else np.inf
    if not g.n_states:
        return float(np.linalg.norm(g.D, 2)), 0.0
    small = g.blocks is None and g.n_states <= QUICK
    find = _largest(_solved(g)) if small else _largest(responder(g))
    rough = _eigenvectors(g) if small else None
    gain, freq = _searched(g, find if rough is None else _largest(rough), top)
    if rough is not None and np.isfinite(freq):
        gain = float(find(np.array([freq]))[0])
    if not gain:
        return 0.0, 0.0
    level = _Level(g)
    for _ in range(LEVELS):
        bar.advance()
        # just above the feedthrough the Hamiltonian matrix is nearly singular: a level more
        close = gain <= (1 + CLEAR) * level.through
        levels = (TOLERANCE, CLEAR) if close else (TOLERANCE,)
        found = [level.crossings(gain * (1 + one)) for one in levels]
        middles = np.concatenate([one for c in found for one in (c, 0.5 * (c[1:] + c[:-1]))])
        middles = middles[middles < top]
        gains = find(middles)
        if not gains.size or gains.max() <= gain * (1 + TOLERANCE):
            return gain, freq
        best = int(np.argmax(gains))
        gain, freq = float(gains[best]), float(middles[best])
    raise SolverError(
        f"the level set of the H-infinity norm of {g!r} did not settle in {LEVELS} levels (last "
        f"gain {gain:.9g} at {freq:.6g} Hz). Report this system."
    )


def _searched(
    g: StateSpace, find: Callable[[FloatArray], FloatArray], top: float
) -> tuple[float, float]:
    """Return the largest gain that a zoom around every resonance finds, and its frequency [Hz]."""
    poles = continuous_poles(g)
    size, swing = np.abs(poles) / (2 * np.pi), np.abs(poles.imag) / (2 * np.pi)
    width = np.minimum(np.abs(poles.real) / (2 * np.pi), size)
    upper = poles.imag >= 0
    centre = np.concatenate([[0.0], swing[upper], size[upper]])
    half = np.concatenate([[0.0], 3 * width[upper], 0.7 * size[upper]])
    # the peak of |H| lies at |s| (1 - 2 zeta^2)^(1/2), close to the pole; a few of them matter
    first = find(np.minimum(centre, 0.999999 * top))
    keep = np.argsort(first)[::-1][:12]
    keep = keep[first[keep] >= 0.1 * first[keep[0]]]
    centre, half = centre[keep], half[keep]
    best_gain, best_freq = float(np.linalg.norm(g.D, 2)), np.inf
    if g.dt:
        best_gain, best_freq = float(np.linalg.norm(g.evaluated(-1.0), 2)), top
    pattern, spacing = np.linspace(-1.0, 1.0, ACROSS), 2.0 * half / (ACROSS - 1)
    end = min(top, 1e300)
    reach = half
    for _ in range(1 + PARABOLAS):
        grid = np.clip(centre[:, None] + reach[:, None] * pattern, 0.0, end)
        gains = find(grid.reshape(-1)).reshape(grid.shape)
        peak, each = np.argmax(gains, axis=1), np.arange(grid.shape[0])
        largest = gains[each, peak]
        if largest.max() > best_gain:
            where = int(np.argmax(largest))
            best_gain, best_freq = float(largest[where]), float(grid[where, peak[where]])
        # a resolved peak lies a few percent above its best point; the level set is the judge
        close = largest >= 0.8 * largest.max()
        inner = np.clip(peak, 1, grid.shape[1] - 2)
        centre = np.array([_vertex(grid[i], gains[i], inner[i]) for i in each[close]])
        spacing = spacing[close] / NARROWER
        pattern, reach = np.array([-1.0, 0.0, 1.0]), spacing
    centre = np.clip(centre, 0.0, end)
    gains = find(centre)
    where = int(np.argmax(gains))
    if gains[where] > best_gain:
        best_gain, best_freq = float(gains[where]), float(centre[where])
    return best_gain, best_freq


def _vertex(freq: FloatArray, gains: FloatArray, i: int) -> float:
    """Return where 1 / gain^2, a parabola beside a resonance, is least; near point i.

    The best of the three points where they are not on a parabola with a minimum.
    """
    best = float(freq[int(np.argmax(gains[i - 1 : i + 2])) + i - 1])
    left, right = freq[i] - freq[i - 1], freq[i + 1] - freq[i]
    if not (left > 0.0 and right > 0.0 and gains[i - 1 : i + 2].min() > 0.0):
        return best
    a, b, c = (gains[i] / gains[i - 1 : i + 2]) ** 2
    down, up = (b - a) / left, (c - b) / right
    if not up > down:
        return best
    # the slope of the parabola is (down + up) / 2 or so at point i, and grows to both sides
    slope = (down * right + up * left) / (left + right)
    step = -0.5 * slope * (left + right) / (up - down)
    return float(freq[i] + min(max(step, -left), right))


def _largest(respond: Responder) -> Callable[[FloatArray], FloatArray]:
    """Return the function of frequency [Hz] that gives the largest singular values (n_freq,)."""

    def find(freq: FloatArray) -> FloatArray:
        if not freq.size:
            return np.zeros(0)
        H = np.moveaxis(respond(freq), 2, 0)
        if 1 in H.shape[1:]:
            return np.asarray(np.sqrt(np.sum(np.abs(H) ** 2, axis=(1, 2))))
        return np.asarray(np.linalg.svd(H, compute_uv=False)[:, 0])

    return find


def _solved(g: StateSpace) -> Responder:
    """Return the responses of a small system at few frequencies, by elimination at each."""
    d = state_scale(g.A, g.B, g.C)
    A, B, C = g.A * d / d[:, None], g.B / d[:, None], g.C * d

    def respond(freq: FloatArray) -> ComplexArray:
        found = [
            C @ np.linalg.solve(s[:, None, None] * np.eye(d.size) - A, B)
            for s in np.array_split(points(g, freq), 1 + freq.size // STEP)
        ]
        return np.asarray(np.moveaxis(np.concatenate(found) + g.D, 0, 2))

    return respond


def _eigenvectors(g: StateSpace) -> Responder | None:
    """Return the responses of a small system from its eigenvectors, None where these are poor.

    Good enough to search with, and many times as quick.
    """
    d = state_scale(g.A, g.B, g.C)
    poles, V = np.linalg.eig(g.A * d / d[:, None])
    try:
        inverse = np.linalg.inv(V)
    except np.linalg.LinAlgError:
        return None
    if not np.linalg.norm(V) * np.linalg.norm(inverse) < POOR:
        return None
    B, C = inverse @ (g.B / d[:, None]), (g.C * d) @ V

    def respond(freq: FloatArray) -> ComplexArray:
        parts = 1.0 / (points(g, freq)[:, None] - poles)
        return np.asarray(np.moveaxis((C * parts[:, None, :]) @ B + g.D, 0, 2))

    return respond


class _Level:
    """The frequencies at which a singular value of a stable system equals a level."""

    def __init__(self, g: StateSpace) -> None:
        self.dt = g.dt
        A, B, C, D = g.A, g.B, g.C, g.D
        if g.dt:  # z = (1 + s) / (1 - s)
            eye = np.eye(A.shape[0])
            factor = la.lu_factor(A + eye)
            inverse_B = la.lu_solve(factor, B)
            A = la.lu_solve(factor, A - eye)
            D = D - C @ inverse_B
            C = np.sqrt(2.0) * la.lu_solve(factor, C.T, trans=1).T
            B = np.sqrt(2.0) * inverse_B
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
        balanced = balanced_matrix(H)
        values: ComplexArray = np.asarray(la.eigvals(balanced), dtype=np.complex128)
        # eigenvalues that only seem to lie on the axis do no harm: the gain is computed there
        near = np.abs(values.real) <= 1e-9 * np.linalg.norm(balanced)
        swing = np.unique(np.abs(values.imag[near]))
        if self.dt:
            return np.asarray(np.arctan(swing) / (np.pi * self.dt))
        return np.asarray(swing / (2 * np.pi))
