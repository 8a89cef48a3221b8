"""Lower bounds on gamma that hold for every controller, whatever method found one."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from ..errors import FlexplantError
from ..lti.grid import highest, resonance_grid
from ..lti.preparation import Prepared
from ..lti.responses import responses
from ..values import ComplexArray, FloatArray
from .relaxed import relaxed_bound
from .structured_lmi import StructuredLmi

#: points of the sweep, and times that it is refined
_POINTS, _REFINEMENTS = 200, 2
#: a gap between gamma and the bound that is left as it is: methods stay up to 5 % away
_CLOSE = 0.0525
#: up to so many states the LMIs, whose work grows with its sixth power, are solved for a bound
_STATES = 24
#: relative: a pole so close to the axis is taken for undamped, no point lies so close to it
_UNDAMPED = 1e-6


def lower_bound(problem: Prepared, gamma: float, known: float) -> float:
    """Return the best lower bound on what controllers reach, at most gamma.

    The largest of the one that the method gives and the pointwise one; where these are far from
    gamma that of the Riccati equations (`relaxed_bound`), and for small problems that of the LMIs.
    """
    found = raised_bound(problem, gamma, max(known, pointwise_bound(problem)))
    if found * (1.0 + _CLOSE) < gamma and problem.A.shape[0] <= _STATES:
        with suppress(FlexplantError):  # what is known stays
            found = max(found, StructuredLmi().smallest(problem).lower)
    return min(found, gamma)


def raised_bound(problem: Prepared, gamma: float, known: float) -> float:
    """Return a known bound, or where it is far from gamma that of the Riccati equations."""
    return known if known * (1.0 + _CLOSE) >= gamma else relaxed_bound(problem, gamma, known)


def pointwise_bound(problem: Prepared) -> float:
    """Return what no controller undercuts at some frequency, nor by the feedthrough.

    Parrott: at s = j omega the loop's gain is at least that of Pzw on the outputs which u cannot
    reach, ``N_z' Pzw`` with N_z' Pzu = 0, and on the inputs which y does not show, ``Pzw N_w``
    with Pyw N_w = 0.
    """
    m1, p1 = problem.B1.shape[1], problem.C1.shape[0]
    system = problem.system
    poles = system.poles()
    grid = np.concatenate([[0.0], resonance_grid(poles, 0.0, points=_POINTS)])
    undamped = poles[np.abs(poles.real) <= _UNDAMPED * np.max(np.abs(poles), initial=1.0)]
    apart = np.abs(2.0 * np.pi * grid[:, None] - np.abs(undamped.imag))
    grid = grid[np.all(apart > _UNDAMPED * (1.0 + np.abs(undamped.imag)), axis=1)]

    def bounds(freq: FloatArray) -> FloatArray:
        return parrott(np.moveaxis(responses(system, freq), 2, 0), m1, p1)

    swept, _ = highest(bounds, grid, _REFINEMENTS)
    return max(swept, float(parrott(system.D[None], m1, p1)[0]))


def parrott(P: ComplexArray | FloatArray, m1: int, p1: int) -> FloatArray:
    """Return the bound of each of a stack of responses (n_freq, p, m)."""
    Pzw = P[:, :p1, :m1]
    parts = (_beyond(P[:, :p1, m1:], Pzw), _beyond(_adjoint(P[:, p1:, :m1]), _adjoint(Pzw)))
    return np.maximum(*parts)


def _beyond(M: ComplexArray | FloatArray, Pzw: ComplexArray | FloatArray) -> FloatArray:
    """Return the norms of Pzw on what is perpendicular to the columns of M.

    Its dimension is that of M of full rank: more would hang on rounding.
    """
    if M.shape[1] <= M.shape[2]:
        return np.zeros(M.shape[0])
    part = _adjoint(np.linalg.svd(M)[0][:, :, M.shape[2] :]) @ Pzw
    return np.asarray(np.linalg.norm(part, 2, axis=(1, 2)))


def _adjoint(M: ComplexArray | FloatArray) -> ComplexArray:
    return np.asarray(M.conj().swapaxes(1, 2), dtype=np.complex128)
