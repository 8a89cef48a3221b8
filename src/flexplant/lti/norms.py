"""H-infinity and L-infinity norms: peaks of the gain, and the proof that nothing is above."""

from __future__ import annotations

import numpy as np

from ..parallel import Progress, one_thread
from .level_set import LEVELS, level_set_peak
from .peaks import proved_peak
from .residues import Residues, residues
from .responses import points, responder
from .scaling import state_scale
from .stability import obstacle
from .statespace import StateSpace, System, as_statespace

#: the norm lies between the gain found and (1 + TOLERANCE) times it
TOLERANCE = 1e-9
#: the gain from residues and that of the system at the peak agree to this
AGREEMENT = 1e-9


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

    Newton's steps lead from the resonances to a peak. That no frequency exceeds it by 1e-9 is
    proved on intervals: by the series of ``D + sum R_i / (s - p_i)``, whose rest is bounded by the
    distances to the poles. Where the eigenvectors of A are poor or the gain is flat, a
    level set does it: the Hamiltonian matrix of that level has no eigenvalue on the imaginary axis.
    Sampled systems go through the bilinear map, which keeps gains.

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
    with Progress(LEVELS, "levels of the norm", progress=progress) as bar:
        return _peak(as_statespace(sys), bar)


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
    return _peak(g, Progress(0, "", progress=False), axis_only=True)


@one_thread()
def _peak(g: StateSpace, bar: Progress, axis_only: bool = False) -> tuple[float, float]:
    """Return gain and frequency [Hz], infinite with a pole on the axis (or beyond it)."""
    if not g.D.size or not g.n_states:
        return float(np.linalg.norm(g.D, 2)) if g.D.size else 0.0, 0.0
    model, poles = residues(g)
    problem = obstacle(g, axis_only=axis_only, known=poles)
    if problem:
        return float("inf"), problem.freq
    return _proved(g, model) or level_set_peak(g, TOLERANCE, bar)


def _proved(g: StateSpace, model: Residues | None) -> tuple[float, float] | None:
    """Return the peak that residues prove, None where they do not or are not those of g."""
    if model is None or not model.poles.size:
        return None
    found = proved_peak(model, TOLERANCE)
    if found is None:
        return None
    omega = found[1]
    freq = float(np.arctan(omega) / (np.pi * g.dt) if g.dt else omega / (2.0 * np.pi))
    gain = _gain(g, freq)
    return (gain, freq) if abs(found[0] - gain) <= AGREEMENT * gain else None


def _gain(g: StateSpace, freq: float) -> float:
    """Return the largest singular value at a frequency [Hz]."""
    if g.blocks is not None:
        return float(np.linalg.norm(responder(g)(np.array([freq]))[:, :, 0], 2))
    s, d = points(g, np.array([freq]))[0], state_scale(g.A, g.B, g.C)
    shifted = s * np.eye(d.size) - g.A * d / d[:, None]
    return float(np.linalg.norm((g.C * d) @ np.linalg.solve(shifted, g.B / d[:, None]) + g.D, 2))
