"""Elastic modes not below half the sampling rate, and what their samples look like."""

from __future__ import annotations

import numpy as np

from .partition import Partition

#: modes that are named
_SHOWN = 3


def aliased_modes(plant: Partition) -> str:
    """Return, in words, which elastic modes of a sampled plant are not below half its rate.

    A mode at f looks like one at ``|f - m rate|``, m whole, in its samples: a controller of that
    rate cannot distinguish them. Empty when there are none.
    """
    if not plant.dt or not plant.is_assembled:
        return ""
    rate = 1.0 / plant.dt
    count = plant.assembled.realisation.n_modes
    freq = np.sqrt(np.maximum(np.linalg.det(plant.modal_blocks[:count]), 0.0)) / (2 * np.pi)
    above = np.flatnonzero(freq >= 0.5 * rate * (1 - 1e-9))
    if not above.size:
        return ""
    seen = np.round(np.abs(freq - rate * np.round(freq / rate)) / rate, 9) * rate
    named = [f"mode {i + 1} ({freq[i]:.4g} Hz) looks like {seen[i]:.4g} Hz" for i in above[:_SHOWN]]
    more = above.size - len(named)
    return (
        f"not below half the sampling rate of {rate:g} Hz: {', '.join(named)}"
        + (f", and {more} more" if more else "")
        + " in its samples"
    )
