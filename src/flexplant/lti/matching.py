"""Matched sampling: poles and zeros of a filter mapped one by one."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ..errors import ModelError
from ..values import ComplexArray, positive
from .interconnection import series
from .scaling import state_scale
from .statespace import StateSpace, System, as_statespace

#: Markov parameters below this of their bound are zero: they count the zeros at infinity
SILENT = 1e-10


def matched(sys: System, rate: float, *, at: float = 0.0) -> StateSpace:
    """Return the sampled filter with matched poles and zeros, ``z = e^(s / rate)``.

    Zeros at infinity go to z = -1, so that a roll-off ends in a zero at half the rate. The gain is
    matched at one frequency. Notches keep their frequency and depth exactly, which Tustin only
    does at one.

    Of one input and one output alone, as in MATLAB's c2d: the zeros of several channels are
    properties of all of them together (with their directions), and no state space with mapped
    poles and mapped transmission zeros keeps the gains of the single entries; entry by entry, the
    poles would be there once for each entry. Sampling the residues of a modal form is impulse
    invariance, another method, which aliases. A filter with a section for each channel is sampled
    section by section: ``append(*(matched(f, rate) for f in sections))``.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous, one input, one output: a filter or a controller; for a plant use `discretized`.
    rate : float [Hz]
        Sampling rate.
    at : float [Hz]
        Where the gain is matched; not 0 for a filter that integrates or differentiates.

    Returns
    -------
    StateSpace
        A cascade of sections of second order, with the same names.

    Raises
    ------
    ModelError
        When `sys` is sampled already or has several channels, or the gain at `at` is zero or
        infinite.

    References
    ----------
    Franklin, Powell, Workman, Digital control of dynamic systems, 3rd ed., sec. 6.2.
    """
    g = as_statespace(sys)
    h = 1.0 / positive(rate, "rate")
    at = positive(at, "at", zero=True)
    if g.dt and g.n_states:
        raise ModelError(f"{g!r} is sampled already. Pass the continuous system.")
    if g.D.shape != (1, 1):
        raise ModelError(
            f"matched needs one input and one output, got {len(g.inputs)} and {len(g.outputs)}: "
            "zeros of several channels cannot be mapped one by one. Use tustin, or sample each "
            "channel by itself: append(matched(g['y1', 'u1'], rate), ...)."
        )
    if at >= 0.5 * rate:
        raise ModelError(f"at must lie below half the rate ({0.5 * rate:g} Hz), got {at:g}.")
    if not g.n_states:
        return g.replace(dt=h)
    wanted = _gain(g, 2j * np.pi * at, at)
    zeros = np.exp(finite_zeros(g) * h)
    poles = np.exp(g.poles() * h)
    zeros = np.concatenate([zeros, -np.ones(poles.size - zeros.size)])
    filtered = _cascade(poles, zeros, h)
    ratio = wanted / _gain(filtered, np.exp(2j * np.pi * at * h), at)
    gain = abs(ratio) * (-1.0 if ratio.real < 0 else 1.0)
    return filtered.replace(
        C=gain * filtered.C,
        D=gain * filtered.D,
        inputs=g.inputs,
        outputs=g.outputs,
        states=(),
        name=g.name,
    )


def finite_zeros(g: StateSpace) -> ComplexArray:
    """Return the finite zeros of a system with one input and one output.

    The zeros at infinity are counted by the Markov parameters D, C B, C A B, ... (in balanced
    states); as many of the largest generalised eigenvalues of the pencil are left out.
    """
    n = g.n_states
    d = state_scale(g.A, g.B, g.C)
    A, b, c = g.A * d / d[:, None], g.B / d[:, None], g.C * d
    speed = float(np.linalg.norm(A, 2)) or 1.0
    A = A / speed
    size = float(np.linalg.norm(b) * np.linalg.norm(c))
    if not size and not g.D.item():
        raise ModelError(f"{g!r} is zero: it has no zeros to match.")
    through = g.D.item() * speed
    infinite, vector = 0, b
    parameter = through
    while abs(parameter) <= SILENT * size and infinite < n:
        infinite += 1
        parameter = (c @ vector).item()
        vector = A @ vector
    if abs(parameter) <= SILENT * size:
        raise ModelError(f"{g!r} has no response: its input does not reach its output.")
    b, c = b / (np.linalg.norm(b) or 1.0), c / (np.linalg.norm(c) or 1.0)
    pencil = np.block([[A, b], [c, np.array([[through / size if size else through]])]])
    mass = np.diag(np.append(np.ones(n), 0.0))
    alpha, beta = np.asarray(la.eigvals(pencil, mass, homogeneous_eigvals=True))
    order = np.argsort(np.abs(beta) / np.maximum(np.abs(alpha), 1e-300))[::-1]
    keep = order[: n - infinite]
    zeros = np.asarray(alpha[keep] / beta[keep], dtype=np.complex128) * speed
    # conjugate pairs exactly
    real = np.abs(zeros.imag) <= 1e-12 * np.abs(zeros)
    return np.where(real, zeros.real + 0j, zeros)


def _gain(g: StateSpace, s: complex, at: float) -> complex:
    try:
        value = complex(g.evaluated(s)[0, 0])
    except np.linalg.LinAlgError:
        value = complex(np.inf)
    if not np.isfinite(value) or value == 0:
        raise ModelError(
            f"the gain of {g!r} at {at:g} Hz is {abs(value):g} and cannot be matched there. Give "
            "another frequency: matched(..., at=)."
        )
    return value


def _cascade(poles: ComplexArray, zeros: ComplexArray, h: float) -> StateSpace:
    """Return a product of sections, each pair of poles with the zeros nearest to it."""
    total: StateSpace | None = None
    left = _paired(zeros)
    # poles nearest to the unit circle choose their zeros first
    for pair in sorted(_paired(poles), key=lambda p: -float(np.max(np.abs(p)))):
        fitting = [z for z in left if z.size == pair.size] or left
        nearest = min(fitting, key=lambda z: float(np.abs(z[0] - pair[0])))
        left = [z for z in left if z is not nearest]
        section = _section(pair, nearest, h)
        total = section if total is None else series(section, total)
    assert total is not None  # noqa: S101 - there is a pole
    return total


def _paired(values: ComplexArray) -> list[ComplexArray]:
    """Return conjugate pairs, pairs of neighbouring real values, and one that is left over."""
    pairs = [np.array([v, np.conj(v)]) for v in values[values.imag > 0]]
    real = np.sort(values[values.imag == 0].real).astype(np.complex128)
    return pairs + [real[i : i + 2] for i in range(0, real.size, 2)]


def _section(poles: ComplexArray, zeros: ComplexArray, h: float) -> StateSpace:
    """Return ``prod (z - zero) / prod (z - pole)`` of order one or two, as many zeros as poles."""
    if poles.size == 1:
        p, q = float(poles[0].real), float(zeros[0].real)
        return StateSpace([[p]], [[1.0]], [[p - q]], [[1.0]], h, blocks=[1])
    # 1 + (n1 z + n0) / den, zeros and poles compared before they are multiplied out
    n1 = float((poles.sum() - zeros.sum()).real)
    n0 = float((np.prod(zeros) - np.prod(poles)).real)
    if poles[0].imag:
        real, imag = float(poles[0].real), abs(float(poles[0].imag))
        A = [[real, imag], [-imag, real]]
        return StateSpace(
            A, [[0.0], [1.0]], [[(n0 + n1 * real) / imag, n1]], [[1.0]], h, blocks=[2]
        )
    first, second = float(poles[0].real), float(poles[1].real)
    A = [[first, 1.0], [0.0, second]]
    return StateSpace(A, [[0.0], [1.0]], [[n0 + n1 * first, n1]], [[1.0]], h, blocks=[2])
