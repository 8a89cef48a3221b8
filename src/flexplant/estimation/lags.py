"""When an estimate is wanted: before a measurement, with it, some samples later, or at the end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from ..values import Value, whole


@dataclass(frozen=True, eq=False)
class Predictor(Value):
    """From the measurements before a sample: x[k|k-1].

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> observer = fx.design_kalman(fx.testbeds.three_masses())
    >>> records = {name: np.zeros(20) for name in ("y1", "y2", "u1")}
    >>> found = [observer.estimate(records, lag) for lag in (fx.estimation.Predictor(), None)]
    >>> bool(found[0].deviation("die:hat")[-1] > found[1].deviation("die:hat")[-1])
    True
    """


@dataclass(frozen=True, eq=False)
class Filter(Value):
    """From the measurements up to a sample, its own among them: x[k|k].

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> observer = fx.design_kalman(fx.testbeds.three_masses())
    >>> records = {name: np.zeros(20) for name in ("y1", "y2", "u1")}
    >>> observer.estimate(records, fx.estimation.Filter())["die:hat"].shape
    (20,)
    """


@dataclass(frozen=True, eq=False)
class FixedLag(Value):
    """From the measurements up to some samples after: x[k|k+lag], known that much later.

    Parameters
    ----------
    samples : int
        The lag, at least 1. At the end of a record what there is.

    Raises
    ------
    ModelError
        When it is no whole number from 1.

    References
    ----------
    [AndersonMoore1979]_, chapter 7.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> observer = fx.design_kalman(fx.testbeds.three_masses())
    >>> records = {"y1": np.zeros(50), "y2": np.zeros(50), "u1": np.zeros(50)}
    >>> observer.estimate(records, fx.FixedLag(5)).lag
    FixedLag(samples=5)
    """

    samples: int

    def __post_init__(self) -> None:
        self._set(samples=whole(self.samples, "samples"))


@dataclass(frozen=True, eq=False)
class Smoother(Value):
    """From all measurements of the record: the fixed-interval smoother x[k|N-1].

    References
    ----------
    [AndersonMoore1979]_, chapter 7.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> observer = fx.design_kalman(fx.testbeds.three_masses())
    >>> records = {"y1": np.zeros(50), "y2": np.zeros(50), "u1": np.zeros(50)}
    >>> filtered, smoothed = (observer.estimate(records, lag) for lag in (None, fx.Smoother()))
    >>> bool(smoothed.deviation("die:hat")[25] < filtered.deviation("die:hat")[25])
    True
    """


#: when an estimate is wanted
Lag: TypeAlias = Predictor | Filter | FixedLag | Smoother
