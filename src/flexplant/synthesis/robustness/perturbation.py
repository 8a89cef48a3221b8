"""A perturbation within a structure: at a frequency a matrix, over all of them a system."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ...lti.statespace import StateSpace, as_statespace
from ...values import ComplexArray
from .uncertainty_blocks import Block, FullBlock, Place, places


class Perturbation(NamedTuple):
    """A perturbation of size one, at a frequency.

    A number for each scalar block, and for each full block its vectors: ``Delta = b a*``, |a| =
    |b| = 1.
    """

    scalars: tuple[complex, ...]
    vectors: tuple[tuple[ComplexArray, ComplexArray], ...]
    omega: float


def matrix_of(found: Perturbation, where: Sequence[Place]) -> ComplexArray:
    """Return Delta (w, z) of a perturbation."""
    total = np.zeros((where[-1].w.stop, where[-1].z.stop), dtype=np.complex128)
    scalars, vectors = iter(found.scalars), iter(found.vectors)
    for p in where:
        if isinstance(p.block, FullBlock):
            a, b = next(vectors)
            total[p.w, p.z] = np.outer(b, a.conj())
        else:
            total[p.w, p.z] = next(scalars) * np.eye(p.block.size)
    return total


def realised(found: Perturbation, blocks: Sequence[Block]) -> StateSpace:
    """Return a real, stable system Delta(s) of norm one with the perturbation at its frequency.

    Each entry of a and b is a number times an all-pass ``+-(s - p) / (s + p)`` of its phase, so
    that the gain is one at all frequencies.
    """
    where = places(blocks)
    scalars, vectors = iter(found.scalars), iter(found.vectors)
    parts: list[StateSpace] = []
    for p in where:
        if isinstance(p.block, FullBlock):
            a, b = next(vectors)
            parts.append(_rank_one(a, b, found.omega))
            continue
        number = complex(next(scalars))
        if p.block.real or not number.imag:
            parts.append(as_statespace(number.real * np.eye(p.block.size)))
        else:
            one = [_all_pass(number, found.omega) for _ in range(p.block.size)]
            parts.append(_stacked(one))
    return _stacked(parts)


def _all_pass(number: complex, omega: float) -> StateSpace:
    """Return a real system of gain |number| that is the number at omega [rad/s]."""
    phase, size = float(np.angle(number)), abs(number)
    if abs(np.sin(phase)) < 1e-9 or not omega > 0:
        return as_statespace(np.array([[size * (1.0 if np.cos(phase) >= 0 else -1.0)]]))
    sign = 1.0 if phase > 0 else -1.0
    turn = phase if phase > 0 else phase + np.pi
    p = omega / np.tan(0.5 * (np.pi - turn))
    # sign size (s - p) / (s + p) = sign size (1 - 2 p / (s + p))
    root = np.sqrt(2.0 * p * size)
    return StateSpace([[-p]], [[root]], [[-sign * root]], [[sign * size]])


def _stacked(parts: Sequence[StateSpace]) -> StateSpace:
    D = la.block_diag(*[g.D for g in parts])
    n = sum(g.n_states for g in parts)
    A, B, C = np.zeros((n, n)), np.zeros((n, D.shape[1])), np.zeros((D.shape[0], n))
    i = row = column = 0
    for g in parts:
        j, k, m = i + g.n_states, row + g.D.shape[0], column + g.D.shape[1]
        A[i:j, i:j], B[i:j, column:m], C[row:k, i:j] = g.A, g.B, g.C
        i, row, column = j, k, m
    return StateSpace(A, B, C, D)


def _rank_one(a: ComplexArray, b: ComplexArray, omega: float) -> StateSpace:
    """Return ``b(s) a(s)'`` with the values b and conj(a) at omega."""
    into = [_all_pass(complex(v), omega) for v in a.conj()]
    out = [_all_pass(complex(v), omega) for v in b]
    first, second = _stacked(into), _stacked(out)
    ones_in, ones_out = np.ones((1, len(into))), np.ones((len(out), 1))
    row = StateSpace(first.A, first.B, ones_in @ first.C, ones_in @ first.D)
    column = StateSpace(second.A, second.B @ ones_out, second.C, second.D @ ones_out)
    n1, n2 = row.n_states, column.n_states
    return StateSpace(
        np.block([[row.A, np.zeros((n1, n2))], [column.B @ row.C, column.A]]),
        np.vstack([row.B, column.B @ row.D]),
        np.hstack([column.D @ row.C, column.C]),
        column.D @ row.D,
    )
