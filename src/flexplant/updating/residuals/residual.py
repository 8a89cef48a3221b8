"""Base classes of residuals: bound to a family of models, they give r and dr/dp."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...arrays import ComplexArray, FloatArray, Matrix
from ...errors import LabelError
from ...labels import Place
from ...store import Value
from ...words import mapping
from ..family import Family, Point


class Residual(Value):
    """The base class of residuals: a measurement that the model should reproduce.

    A new residual is a subclass that defines `bound`.

    Examples
    --------
    The library's residuals are instances of this class:

    >>> import flexplant as fx
    >>> poles = fx.MeasuredModes(poles=[630.0j], modes=[2])
    >>> isinstance(fx.Eigenvalues(poles), fx.updating.Residual)
    True
    """

    @property
    def loaded(self) -> tuple[tuple[Place, str], ...]:
        """Places and directions of the compared responses. Empty if modes are compared."""
        return ()

    @property
    def top(self) -> float:
        """Highest frequency [rad/s] of the measurement."""
        measured: Any = getattr(self, "measured", None)
        return float(np.max(np.abs(getattr(measured, "poles", [0.0]))))

    @abstractmethod
    def bound(self, family: Family) -> Bound:
        """Return the residual as `update` uses it, for one model with its parameters.

        The argument `family` is this model with its parameters. The result computes the values of
        the residual and their derivatives; see `Bound`.
        """


class Kind(NamedTuple):
    """Independent model errors of one kind, each of which changes the rows by a column."""

    name: str
    #: (m, k) effect of a relative error of one on the whitened rows
    F: FloatArray
    #: usual relative standard deviation of a good model
    usual: float


class Bound(ABC):
    """A residual for one family of models: its values, and their exact gradients.

    A family is a model with its possible values of the parameters. This is the base class of the
    objects that `Residual.bound` returns. The argument "point" is a model of the family, with its
    modes, at given values of the parameters. A row is one real number of the residual. If the noise
    of the measurement is known, the rows are scaled to unit covariance (whitened).
    """

    #: numbers of the modes that it follows
    numbers: tuple[int, ...] = ()
    #: whether the covariance of the measurement is known
    noisy: bool = False
    #: the covariance of the rows where it is known exactly but not the unit matrix
    noise: Matrix | None = None
    #: share of the rows, whitened by `noise`, that count as independent in chi-square
    independent: float = 1.0
    #: directions of the rows in which residuals cannot lie: scale and phase of a shape
    lost: int = 0
    #: the measured value in units of each row
    size: FloatArray | float = 1.0
    name: str = ""
    #: kind of model error, and its usual size relative to the measured value
    kind: str = "value"
    usual: float = 0.01

    @property
    def has_noise(self) -> bool:
        """Whether the covariance of the measurement noise is known."""
        return self.noisy or self.noise is not None

    @abstractmethod
    def values(self, point: Point) -> FloatArray:
        """Return the m rows of the residual at a point, whitened if the noise is known."""

    @abstractmethod
    def slopes(self, point: Point) -> FloatArray:
        """Return the derivatives (m, q) of `values` with respect to the q parameters."""

    def noise_times(self, columns: FloatArray) -> FloatArray:
        """Return ``N columns`` with the best known covariance N of the rows."""
        return columns if self.noise is None else np.asarray(self.noise @ columns)

    def kinds(self) -> list[Kind]:
        """Return the kinds of model error that are assumed when noise does not explain the rows.

        By default there is one kind: each row has an independent error that is proportional to its
        measured value.
        """
        return [Kind(self.kind, np.diag(np.atleast_1d(self.size)), self.usual)]

    def row_name(self, row: int) -> str:
        """Return the name of what was measured in a row, for messages."""
        return self.name

    def assigned(self, point: Point) -> Point:
        """Return the point with its modes paired with the measured ones by their shapes.

        A residual without shapes returns the point unchanged.
        """
        return point


def place_rows(family: Family, places: Sequence[Place], direction: str = "z") -> FloatArray:
    """Return the rows (m, k) of places in the coordinates of the family."""
    model: Any = family.model
    rows = model if hasattr(model, "row") else model.dofs
    return np.array([rows.row(place, direction) for place in places]) @ family.V


def channel_places(
    channels: Sequence[str], places: Mapping[str, Place] | None
) -> tuple[Place, ...]:
    """Return the place of each channel: from `places`, else its name."""
    hint = "Pass {'y1': '41:z'}, channel and place."
    known = {} if places is None else mapping(places, "places", hint, error=LabelError)
    unknown = sorted(set(known) - set(channels))
    if unknown:
        raise LabelError(
            f"places names {unknown}, which are not channels. Known are {', '.join(channels[:6])}."
        )
    return tuple(known.get(channel, channel) for channel in channels)


def split_parts(rows: ComplexArray) -> FloatArray:
    """Return [Re; Im] along the first axis."""
    return np.concatenate([rows.real, rows.imag])
