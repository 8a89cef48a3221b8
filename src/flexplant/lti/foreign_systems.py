"""Fields of a system from transfer functions and from the types of python-control and SciPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import ComplexArray, FloatArray, complex_array, positive, real_array
from ..errors import ModelError
from ..tolerances import ROUNDING, SPLIT
from .blocks_of_states import block_matrix, cascaded


def zpk_fields(
    zeros: npt.ArrayLike, poles: npt.ArrayLike, gain: float, dt: float = 0.0
) -> dict[str, Any]:
    """Return A, B, C, D and blocks of ``gain prod(s - zeros) / prod(s - poles)``."""
    # each pair of poles is a block of two states with the zeros nearest to it, the least damped
    # first, so that A keeps its poles to rounding: a companion form of many poles does not
    z, p, dt = _as_roots(zeros, "zeros"), _as_roots(poles, "poles"), positive(dt, "dt", zero=True)
    if z.size > p.size:
        raise ModelError(
            f"the transfer function has {z.size} zeros and {p.size} poles: it differentiates its "
            "input, which a state-space system cannot do. Add poles above the band, such as a "
            "low-pass."
        )
    left = root_pairs(z)
    chain = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1))
    blocks: list[int] = []
    factor = float(real_array(gain, "gain", ()))
    for pair in sorted(root_pairs(p), key=lambda pole: _decay(pole[0], dt)):
        nearest = _near_zeros(pair, left)
        left = [part for part in left if part is not nearest]
        a, b, c, d = _section(pair, nearest)
        # sections of moderate gain: the remaining factor of the poles' size goes to the common
        # factor
        size = float(np.abs(pair).max()) or 1.0
        lacking = size ** (pair.size - nearest.size)
        c, d, factor = c * lacking, d * lacking, factor / lacking
        chain = cascaded(chain, (a, b, c, d))
        blocks = [pair.size, *blocks]
    A, B, C, D = chain
    return {"A": A, "B": B, "C": factor * C, "D": factor * D, "blocks": blocks}


def tf_fields(
    numerator: npt.ArrayLike, denominator: npt.ArrayLike, dt: float = 0.0
) -> dict[str, Any]:
    """Return A, B, C, D and blocks of a ratio of polynomials, highest power first."""
    num, den = (
        np.trim_zeros(np.ravel(real_array(part, name)), "f")
        for part, name in ((numerator, "the numerator"), (denominator, "the denominator"))
    )
    if not den.size:
        raise ModelError(
            "the denominator is zero: a transfer function needs a denominator that is not zero."
        )
    if not num.size:
        return zpk_fields([], [], 0.0)
    return zpk_fields(np.roots(num), np.roots(den), num[0] / den[0], dt)


def matrix_fields(channels: list[list[dict[str, Any]]]) -> dict[str, Any]:
    """Return the fields of a matrix of transfer functions, each with separate states."""
    every = [part for row in channels for part in row]
    inputs = [np.eye(len(row))[j : j + 1] for row in channels for j in range(len(row))]
    outputs = [np.eye(len(channels))[:, i : i + 1] for i, row in enumerate(channels) for _ in row]
    return {
        "A": block_matrix([part["A"] for part in every]),
        "B": np.vstack([part["B"] @ side for part, side in zip(every, inputs, strict=True)]),
        "C": np.hstack([side @ part["C"] for part, side in zip(every, outputs, strict=True)]),
        "D": np.array([[part["D"][0, 0] for part in row] for row in channels]),
        "blocks": [size for part in every for size in part["blocks"]],
    }


def _as_roots(values: npt.ArrayLike, name: str) -> ComplexArray:
    roots = complex_array(values, name).ravel()
    lonely = [root for root in roots if not np.isclose(roots, root.conj(), rtol=SPLIT).any()]
    if lonely:
        raise ModelError(
            f"{name} need the conjugate of {lonely[0]:.6g}: complex ones of a real system come in "
            "pairs."
        )
    return roots


def _decay(pole: complex, dt: float) -> float:
    return 1.0 - abs(pole) if dt else abs(pole.real) / (abs(pole) or 1.0)


def root_pairs(values: ComplexArray) -> list[ComplexArray]:
    """Return conjugate pairs, pairs of neighbouring real values, and one that is left over."""
    upper = values.imag > ROUNDING * np.abs(values)
    pairs = [np.array([v, np.conj(v)]) for v in values[upper]]
    real = np.sort(values[np.abs(values.imag) <= ROUNDING * np.abs(values)].real).astype(complex)
    return pairs + [real[i : i + 2] for i in range(0, real.size, 2)]


def _near_zeros(pair: ComplexArray, left: list[ComplexArray]) -> ComplexArray:
    """Return the zeros nearest to a pair of poles, none where it cannot hold them."""
    fitting = [z for z in left if z.size == pair.size] or [z for z in left if z.size < pair.size]
    if not fitting:
        return np.zeros(0, dtype=np.complex128)
    return min(fitting, key=lambda z: float(np.abs(z[0] - pair[0])))


def _section(
    poles: ComplexArray, zeros: ComplexArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return ``prod (s - zero) / prod (s - pole)`` of order one or two, proper."""
    through = np.array([[float(zeros.size == poles.size)]])
    if poles.size == 1:
        p = float(poles[0].real)
        gain = p - float(zeros[0].real) if zeros.size else 1.0
        return np.array([[p]]), np.array([[1.0]]), np.array([[gain]]), through
    # through + (n1 s + n0) / den, zeros and poles compared before they are multiplied out
    if zeros.size == 2:
        n1 = float((poles.sum() - zeros.sum()).real)
        n0 = float((np.prod(zeros) - np.prod(poles)).real)
    else:
        n1, n0 = (1.0, -float(zeros[0].real)) if zeros.size else (0.0, 1.0)
    B = np.array([[0.0], [1.0]])
    real = float(poles[0].real)
    if poles[0].imag:
        imag = abs(float(poles[0].imag))
        A = np.array([[real, imag], [-imag, real]])
        return A, B, np.array([[(n0 + n1 * real) / imag, n1]]), through
    size = float(np.abs(poles).max()) or 1.0
    A = np.array([[real, size], [0.0, float(poles[1].real)]])
    return A, B, np.array([[(n0 + n1 * real) / size, n1]]), through


def foreign_fields(sys: Any) -> dict[str, Any]:
    """Return the fields of a `StateSpace` that a system of python-control or SciPy has."""
    dt = _sampling_time(sys)
    if all(hasattr(sys, part) for part in ("A", "B", "C", "D")):
        fields = {part: getattr(sys, part) for part in ("A", "B", "C", "D")}
    elif all(hasattr(sys, part) for part in ("zeros", "poles", "gain")):
        fields = zpk_fields(sys.zeros, sys.poles, sys.gain, dt)
    elif hasattr(sys, "input_labels"):
        fields = matrix_fields(
            [
                [tf_fields(*pair, dt) for pair in zip(*row, strict=True)]
                for row in zip(sys.num, sys.den, strict=True)
            ]
        )
    else:
        fields = tf_fields(sys.num, sys.den, dt)
    named = {"inputs": "input_labels", "outputs": "output_labels", "states": "state_labels"}
    labels = {ours: getattr(sys, theirs) for ours, theirs in named.items() if hasattr(sys, theirs)}
    return {**fields, **labels, "dt": dt, "name": getattr(sys, "name", None)}


def _sampling_time(sys: Any) -> float:
    matrices, ratio = (hasattr(sys, "A") and hasattr(sys, "B")), hasattr(sys, "den")
    if not (hasattr(sys, "dt") and (matrices or ratio or hasattr(sys, "gain"))):
        raise ModelError(
            f"need a system of flexplant, python-control or SciPy, got {type(sys).__name__}. "
            "Make one: StateSpace(A, B, C, D), fx.lti.tf(num, den), control.ss(...)."
        )
    if sys.dt is None and type(sys).__module__.startswith("scipy"):
        return 0.0  # SciPy's sign of continuous time
    if sys.dt is None or sys.dt is True:
        raise ModelError(
            f"the sampling time of {getattr(sys, 'name', sys)!r} is {sys.dt}: state it in seconds "
            "(0 for continuous time), frequencies depend on it."
        )
    return float(sys.dt)
