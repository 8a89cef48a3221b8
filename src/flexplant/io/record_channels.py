"""Channels of time records as files hold them, before units are converted."""

from __future__ import annotations

from typing import NamedTuple

from ..arrays import FloatArray


class RecordedChannels(NamedTuple):
    """Names, labels of units and data (n, n_time) of each run; the rate where the file says it."""

    names: list[str]
    labels: list[str]
    runs: list[FloatArray]
    rate: float | None
    start: float = 0.0
