"""Poles in Hz where rad/s are meant, and the other way round."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import ModelError
from ..values import FloatArray
from .search import Objective

#: how near the ratio of measured poles to those of the model is to 2 pi, all of them
NEAR = 0.15


def check_units(objective: Objective, begin: FloatArray, start: Any = None) -> None:
    """Raise ModelError where all measured poles are 2 pi below or above those of the model.

    Parameters
    ----------
    objective : Objective
        Of the update.
    begin : (q,) array
        Where it began.
    start : (m,) complex array, optional
        The poles there, if they are known.
    """
    data = objective.poles_measured
    if data is None:
        return
    if start is None:
        try:
            start = objective.poles(objective.begin(begin))
        except ModelError:
            return  # the search raises what is wrong at the start
    known = dict(zip(objective.numbers, np.abs(start), strict=True))
    ratio = np.abs(data.target) / np.array([known[n] for n in data.numbers])
    below = bool(np.all(np.abs(2 * np.pi * ratio - 1) < NEAR))
    above = bool(np.all(np.abs(ratio / (2 * np.pi) - 1) < NEAR))
    if below or above:
        advice = "multiply Hz by 2 pi" if below else "look at the units of the model too"
        raise ModelError(
            f"the measured poles are a factor of 2 pi {'below' if below else 'above'} those of the "
            f"model, all {ratio.size} of them ({np.median(np.abs(data.target)):.4g} against "
            f"{np.median(np.abs(start)):.4g} rad/s). MeasuredModes takes poles in rad/s: {advice}."
        )
