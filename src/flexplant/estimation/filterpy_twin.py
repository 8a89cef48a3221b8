"""A filter of filterpy that takes measurements and commands as 1-D arrays or as columns."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from ..errors import ModelError, ShapeError
from ..values import FloatArray, real_array
from .filter_model import FilterModel


def twin(model: FilterModel, covariance: FloatArray) -> Any:
    """Return filterpy's filter of a model; P is the covariance of x[k|k-1], x is at rest."""
    if np.any(model.D2):
        raise ModelError(
            "filterpy's filter has no feedthrough from u to y, this plant has one. Sample it "
            "with a delay: plant.continuous.discretized(rate, delay=1)."
        )
    if np.any(model.S):
        raise ModelError(
            "filterpy's filter takes the noises of process and sensors as independent, those of "
            "this plant are correlated. Use observer.estimate, which includes the correlation."
        )
    n, m = model.B.shape
    found = twin_class()(dim_x=n, dim_z=model.C2.shape[0], dim_u=m)
    found.F, found.B, found.H = model.A.copy(), model.B.copy(), model.C2.copy()
    found.Q, found.R = model.Q.copy(), model.R.copy()
    found.P = covariance.copy()
    found.x = np.zeros((n, 1))
    return found


@cache
def twin_class() -> Any:
    """Return a subclass of `filterpy.kalman.KalmanFilter` whose y and u are 1-D or columns.

    filterpy adds ``B u`` to the column x as it comes: a 1-D u would make x an (n, n) array. Its
    smoother, which takes no u, inverts covariances: here in states of unit variance, and without
    the states of delay lines, which are known exactly.
    """
    from filterpy.kalman import KalmanFilter

    class Twin(KalmanFilter):  # type: ignore[misc]
        def update(self, z: Any, R: Any = None, H: Any = None) -> None:
            super().update(None if z is None else _column(z, self.dim_z, "y"), R, H)

        def predict(self, u: Any = None, B: Any = None, F: Any = None, Q: Any = None) -> None:
            super().predict(_command(u, self.dim_u), B, F, Q)

        def predict_steadystate(self, u: Any = None, B: Any = None) -> None:
            super().predict_steadystate(_command(u, self.dim_u), B)

        def get_prediction(
            self, u: Any = None, B: Any = None, F: Any = None, Q: Any = None
        ) -> tuple[FloatArray, FloatArray]:
            # 1.4 takes u alone, so that what is not given is not passed on
            given = {"B": B, "F": F, "Q": Q}
            others = {name: value for name, value in given.items() if value is not None}
            x, P = super().get_prediction(_command(u, self.dim_u), **others)
            return x, P

        def rts_smoother(
            self, Xs: Any, Ps: Any, Fs: Any = None, Qs: Any = None, inv: Any = None
        ) -> tuple[Any, ...]:
            found: tuple[Any, ...] = super().rts_smoother(
                Xs, Ps, Fs, Qs, _scaled_inverse if inv is None else inv
            )
            return found

        def __reduce__(self) -> tuple[Any, ...]:
            return _restored, (self.__dict__,)

    return Twin


def _scaled_inverse(P: FloatArray) -> FloatArray:
    """Return the inverse of a covariance in states of unit variance; delay lines have none."""
    inverse, size = np.zeros_like(P), np.sqrt(P.diagonal())
    some = np.flatnonzero(size)
    unit = P[np.ix_(some, some)] / size[some] / size[some][:, None]
    inverse[np.ix_(some, some)] = np.linalg.inv(unit) / size[some] / size[some][:, None]
    return inverse


def _command(u: Any, count: int) -> FloatArray:
    # None and 0 are filterpy's own defaults for no command
    return np.zeros((count, 1)) if u is None or np.array_equal(u, 0) else _column(u, count, "u")


def _column(value: Any, count: int, name: str) -> FloatArray:
    found = real_array(value, name)
    if found.shape not in ((count,), (count, 1)) and not (count == 1 and found.size == 1):
        raise ShapeError(
            f"{name} must have {count} entries, as a 1-D array or a column, got shape "
            f"{found.shape}. Pass all of them, in the order of the plant."
        )
    return found.reshape(count, 1)


def _restored(fields: dict[str, Any]) -> Any:
    """Return an unpickled filter: pickle finds no class that is made inside a function."""
    kind = twin_class()
    twin = kind.__new__(kind)
    twin.__dict__.update(fields)
    return twin
