"""Scalings D and G that hold at many frequencies, found without optimisation."""

from __future__ import annotations

import numpy as np

from ...arrays import ComplexArray, FloatArray
from ...plant.uncertainty.delta_blocks import RepeatedScalar
from .uncertainty_blocks import SHARE, Scalings, block_places, osborne


def shared_scalings(M: ComplexArray, scalings: Scalings) -> FloatArray:
    """Return scalings x for the responses (n, z, w) at all frequencies together.

    D is diagonal and evens out the largest responses. G of each real scalar takes the imaginary
    part from the response of its own block where that is largest, at the resonance of its mode. The
    response of a lightly damped mode turns around its resonance on one side of the real axis, so
    that one G holds below, at and above it.
    """
    alone = [
        one
        for block in (place.block for place in scalings.places)
        for one in (
            [RepeatedScalar(1)] * block.size if isinstance(block, RepeatedScalar) else [block]
        )
    ]
    largest = np.abs(M).max(axis=0)
    size = osborne(largest, block_places(alone))
    rows = np.sqrt(np.repeat(size, [one.z for one in alone]))
    columns = np.sqrt(np.repeat(size, [one.w for one in alone]))
    even = rows[:, None] * M / columns
    x = np.zeros(scalings.count)
    blocks = zip(scalings.places, scalings.d_ranges, scalings.ranges, strict=True)
    for place, (own, basis), all_x in blocks:
        if not isinstance(place.block, RepeatedScalar):
            x[own] = columns[place.w.start] ** 2
            continue
        root = columns[place.w]
        x[own] = _coordinates(np.diag(root**2), basis)
        if place.block.real:
            response = even[:, place.z, place.w]
            peak = response[np.argmax(np.linalg.norm(response, axis=(1, 2)))]
            turn = -SHARE * (peak - peak.conj().T) / 2j
            x[own.stop : all_x.stop] = _coordinates(root[:, None] * turn * root, basis)
    return x


def _coordinates(H: ComplexArray | FloatArray, basis: ComplexArray) -> FloatArray:
    """Return the coordinates of a Hermitian matrix in an orthogonal basis (n, size, size)."""
    sizes = np.sum(np.abs(basis) ** 2, axis=(1, 2))
    return np.asarray(np.einsum("nij,ij->n", basis.conj(), H).real / sizes)
