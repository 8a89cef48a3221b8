"""Residuals of an update: base classes that give r and dr/dp; eigenvalues, their sensitivities."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg as la

from ...arrays import (
    ComplexArray,
    FloatArray,
    Matrix,
    divisor,
    instance,
    mapping,
    positive,
    positive_array,
    several,
    whole,
)
from ...errors import LabelError, ModelError, counted, short
from ...identification import MeasuredModes
from ...labels import Place
from ...modes.matching import clusters
from ...store import Value
from ...tolerances import TYPED
from ..family import Eigen, Family, Point, repeated_groups
from ..parameters import Parameter, checked_parameters, checked_values


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
    #: ratio of the variance of estimates to the variance if the weights were exact
    scatter: float = 1.0
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


#: relative standard deviations of frequency and damping of a good model: twice these, 0.5 % and 30
#: %, are typical errors of an updated model where nothing was measured
USUAL = (2.5e-3, 0.15)


def growth(omega: FloatArray, measured: FloatArray) -> FloatArray:
    """Return the ratio of the errors of frequencies (m,) of a model to the usual error."""
    # neglected effects (shear, rotary inertia, motion between nodes) cause a relative error that
    # grows with omega, for plates and beams; errors of material or thickness cause a constant one.
    # Both are equal at the middle of the measured frequencies
    return np.asarray(0.5 * (1.0 + omega / np.mean(measured)))


class ModalResidual(Residual):
    """A residual of measured modes."""

    measured: MeasuredModes

    def _checked_numbers(self) -> tuple[int, ...]:
        hint = "Pass MeasuredModes(poles, modes=[...])."
        instance(self.measured, MeasuredModes, "measured", hint)
        if self.measured.modes is None:
            raise LabelError(
                f"{type(self).__name__} needs mode numbers, but {self.measured!r} has none, so "
                "that the mode of each pole is not known. Give modes=[...], "
                "counted from 1 with the rigid-body modes."
            )
        return self.measured.modes

    def _chosen(self, modes: Sequence[int]) -> tuple[MeasuredModes, list[int]]:
        """Return the measured modes of some numbers, and their positions."""
        known = self.measured.modes or ()
        if not isinstance(modes, Iterable) or isinstance(modes, str):
            raise LabelError(
                f"modes must be a list of numbers, got {short(modes)}. Pass for example [6, 7]."
            )
        wanted = [whole(n, "a mode") for n in modes]
        missing = [n for n in wanted if n not in known]
        if missing or not wanted:
            raise LabelError(
                f"modes {missing or '[]'} were not measured; measured are {list(known)}."
            )
        columns = [known.index(n) for n in wanted]
        return self.measured.select(columns), columns


@dataclass(frozen=True, eq=False, repr=False)
class Eigenvalues(ModalResidual):
    """Residuals of complex eigenvalues, ``lambda_exp - lambda_num``, weighted by W.

    Here lambda_exp are the measured poles, and lambda_num are those of the model. The error is
    ``e = d lambda^H W d lambda`` with the vector d lambda of the residuals. W is a real, positive
    and diagonal matrix of weights (equations (10) and (12) of the paper).

    Parameters
    ----------
    measured : MeasuredModes
        Poles with their mode numbers.
    weights : (m,) array [(s/rad)^2], optional
        Diagonal of W. None: one over the variance of each pole if `measured` has a covariance,
        otherwise ones.
    clusters : float
        Relative distance of poles, such as 0.02. Modes that are closer than this form a cluster,
        and only the mean of their poles is compared. The mean does not depend on how the modes mix.
        Zero: each mode is compared separately.

    Raises
    ------
    ModelError, ShapeError, LabelError
        When the weights are not one positive number for each pole, or the poles have no numbers.

    References
    ----------
    [paper]_, equations (9)-(12).

    Examples
    --------
    Two measured poles with equal weights:

    >>> Eigenvalues(MeasuredModes([-28.5 + 2870j, -39.3 + 3970j], modes=[6, 7]))
    <Eigenvalues: modes 6, 7, weights equal>
    """

    measured: MeasuredModes
    weights: FloatArray | None = field(default=None, kw_only=True)
    clusters: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        self._checked_numbers()
        if self.weights is not None:
            why = "W of (12) is positive definite: leave a pole out of the measurement instead."
            shape = (len(self.measured),)
            self._set(weights=positive_array(self.weights, "weights", shape, hint=why))
        self._set(clusters=positive(self.clusters, "clusters", zero=True))

    def __repr__(self) -> str:
        numbers = ", ".join(str(number) for number in self.measured.modes or ())
        known = "equal" if self.measured.covariance is None else "1/variance"
        kind = known if self.weights is None else "given"
        return f"<Eigenvalues: modes {numbers}, weights {kind}>"

    @property
    def W(self) -> FloatArray:
        """The diagonal (m,) of W in equation (12)."""
        m = len(self.measured)
        if self.weights is not None:
            return self.weights
        if self.measured.covariance is None:
            return np.ones(m)
        variance = np.diag(self.measured.covariance)
        return np.asarray(1 / (variance[:m] + variance[m:]), dtype=np.float64)

    def select(self, modes: Sequence[int]) -> Eigenvalues:
        """Return the residual of some of the measured modes, given by their numbers."""
        chosen, columns = self._chosen(modes)
        weights = None if self.weights is None else self.weights[columns]
        return self.replace(measured=chosen, weights=weights)

    def bound(self, family: Family) -> Bound:
        """Return the residual as `update` uses it; see `Residual.bound`."""
        return BoundEigenvalues(self)


class BoundEigenvalues(Bound):
    """Poles (or means of clusters) whitened by the factor of their covariance, or by W^(1/2)."""

    def __init__(self, residual: Eigenvalues) -> None:
        measured = residual.measured
        self.numbers = measured.modes or ()
        m = len(measured)
        close = clusters(measured.poles, residual.clusters) if residual.clusters else []
        self.clusters = [group.tolist() for group in close]
        alone = [[i] for i in range(m) if not any(i in group for group in self.clusters)]
        self._members = [*alone, *self.clusters]
        self.mean = np.zeros((len(self._members), m))
        for row, group in zip(self.mean, self._members, strict=True):
            row[group] = 1 / len(group)
        self.target = measured.poles
        self.noisy = residual.weights is None and measured.covariance is not None
        both = np.kron(np.eye(2), self.mean)
        covariance = np.diag(np.tile(1 / residual.W, 2))
        if self.noisy and measured.covariance is not None:
            covariance = measured.covariance
        factor = la.cholesky(both @ covariance @ both.T, lower=True)
        self.white = la.solve_triangular(factor, both, lower=True)
        if measured.covariance is not None and not self.noisy:
            self.noise = self.white @ measured.covariance @ self.white.T
        self.size = np.abs(self.white) @ np.tile(np.abs(self.target), 2)
        self.name = f"modes {', '.join(map(str, self.numbers))}"

    def kinds(self) -> list[Kind]:
        """Return relative errors of frequency (at constant zeta) and of damping."""
        # of each mode, and an equal one common to all modes (such as that of the material), which
        # no single mode shows
        grown = growth(np.abs(self.target), np.abs(self.target))
        pole = self.target
        zeta = -pole.real / np.abs(pole)
        # d lambda / d ln zeta
        damped = np.abs(pole) * (-zeta - 1j * zeta**2 / np.sqrt(np.maximum(1 - zeta**2, TYPED)))
        return [
            Kind(name, self.whitened(np.column_stack([np.diag(column), column])), usual)
            for name, column, usual in (
                ("frequency", grown * pole, USUAL[0]),
                ("damping", damped, USUAL[1]),
            )
        ]

    def row_name(self, row: int) -> str:
        """Return the mode or modes of a row."""
        members = self._members[row % len(self._members)]
        return f"mode{'s' * (len(members) > 1)} {', '.join(str(self.numbers[i]) for i in members)}"

    def whitened(self, rows: ComplexArray) -> FloatArray:
        """Return weighted [Re; Im] of complex rows, one for each pole."""
        return np.asarray(self.white @ split_parts(rows), dtype=np.float64)

    def values(self, point: Point) -> FloatArray:
        """Return measured minus model, weighted."""
        gap = self.target - point.eigen.poles[point.columns(self.numbers)]
        return self.whitened(gap)

    def slopes(self, point: Point) -> FloatArray:
        """Return their derivatives."""
        S = point.sensitivity(self.numbers)
        for group in self.clusters:
            # the trace does not depend on the basis of the subspace
            _, change = point.subspace([self.numbers[i] for i in group])
            S[group] = np.trace(change, axis1=1, axis2=2) / len(group)
        return -self.whitened(S)


#: matrices that rotate exactly repeated modes to the vectors in which a change of parameters splits
#: them; and the derivatives (q,) along these, by columns of modes
Split: TypeAlias = Callable[[FloatArray], tuple[Eigen, dict[int, ComplexArray]]]


def splitting(family: Family, eigen: Eigen) -> Split:
    """Return the split of repeated modes along a direction, by eigenvectors of the derivative."""
    # the modes of a group have the order of their new frequencies
    groups = [(one, family.group_derivative(eigen, one)) for one in repeated_groups(eigen.poles)]

    def split(direction: FloatArray) -> tuple[Eigen, dict[int, ComplexArray]]:
        turned = eigen
        rows: dict[int, ComplexArray] = {}
        for columns, G in groups:
            moved, Q = la.eig(np.tensordot(direction, G, axes=1))
            Q = Q[:, np.lexsort((moved.real, moved.imag))]
            turned = turned.rotated(columns, Q)
            own = np.diagonal(la.solve(Q, G @ Q), axis1=1, axis2=2)
            rows |= {column: own[:, i] for i, column in enumerate(columns)}
        return turned, rows

    return split


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivities(Value):
    """Derivatives of complex eigenvalues with respect to parameters (equation (11) of [paper]_).

    Parameters
    ----------
    modes : sequence of m int
        Mode numbers, counted from 1 with rigid-body modes.
    poles : (m,) complex array [rad/s]
        Eigenvalues lambda_a.
    S : (m, q) complex array [rad/s per unit]
        ``S_ab = d lambda_a / d p_b``.
    parameters : sequence of q str
        Names of the parameters.
    """

    modes: tuple[int, ...]
    poles: ComplexArray
    S: ComplexArray
    parameters: tuple[str, ...]

    def __repr__(self) -> str:
        return (
            f"<Sensitivities: {counted(len(self.modes), 'mode')} to {', '.join(self.parameters)}>"
        )


def eigenvalue_sensitivities(
    model: Any,
    parameters: Sequence[Parameter],
    *,
    modes: Sequence[int] | None = None,
    values: Sequence[float] | FloatArray | None = None,
) -> Sensitivities:
    """Return the sensitivities of the complex eigenvalues of a model to parameters.

    By equation (11) of the paper, the derivative is
    ``d lambda/d p = - y^H (lambda^2 dM + lambda dD + dK) x / (y^H (2 lambda M + D) x)``. Here x and
    y are right and left eigenvectors of ``lambda^2 M + lambda D + K``. When a parameter changes,
    exactly repeated modes may split into modes of different frequencies. The eigenvectors of
    repeated modes are not unique. The derivatives use those to which the eigenvectors of the split
    modes tend when the parameter tends to its given value. The modes are sorted by the frequencies
    that they have when the parameter increases.

    Parameters
    ----------
    model, parameters
        Model and parameters, as for `update`. Full matrices are used for an FEModel.
    modes : sequence of int, optional
        Mode numbers, which count from 1 and include rigid-body modes. None: all elastic modes.
    values : (q,) array, optional
        Values of the parameters at which derivatives are taken. None: zeros, which is the model
        itself.

    Returns
    -------
    Sensitivities
        Matrix S of the derivatives, with the poles and their mode numbers.

    Raises
    ------
    LabelError, ModelError
        When a mode number or a place is unknown, two parameters have the same name, or the matrices
        are indefinite at `values`. Also when several parameters split repeated modes into different
        shapes, because the derivatives do not exist then.

    References
    ----------
    [paper]_, equation (11).

    Examples
    --------
    Change of the second pole of a chain with a mass at its end:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> found = fx.updating.eigenvalue_sensitivities(drawing, [fx.AddedMass("3:x")], modes=[2])
    >>> found.S.imag.round(2)  # -omega phi^2 / 2 rad/s per kg
    array([[-158.11]])
    """
    listed = checked_parameters(parameters)
    family = Family(model, listed)
    eigen = family.at(checked_values(values, listed, "values"))
    numbers = range(eigen.n_rigid + 1, eigen.n_rigid + eigen.poles.size + 1)
    columns = mode_columns(numbers if modes is None else modes, eigen)
    growing = 1 / divisor(family.strength(float(np.abs(eigen.poles[0]))))
    turned, _ = splitting(family, eigen)(growing)
    S = family.sensitivity(turned, columns)
    for group in repeated_groups(eigen.poles):
        if set(group) & set(columns):
            G = family.group_derivative(turned, group)
            size = np.abs(G).max(axis=(1, 2), keepdims=True)
            off = np.abs(G) * (1 - np.eye(len(group))) / divisor(size)
            # within a group of equal eigenvalues, as accurate as these are equal
            if off.max() > 1e-6:
                raise ModelError(
                    f"modes {[i + eigen.n_rigid + 1 for i in group]} are repeated, and "
                    f"{', '.join(p.name for p in listed)} split them along different vectors: "
                    "derivatives with respect to all of them do not exist. Use one parameter at "
                    "a time."
                )
    return Sensitivities(
        modes=tuple(i + eigen.n_rigid + 1 for i in columns),
        poles=eigen.poles[columns],
        S=S,
        parameters=tuple(p.name for p in listed),
    )


def mode_columns(modes: Any, eigen: Eigen) -> list[int]:
    """Return the columns of the modes with the given numbers."""
    first, last = eigen.n_rigid + 1, eigen.n_rigid + eigen.poles.size
    if not eigen.poles.size:
        raise ModelError("the model has no oscillating mode and therefore no eigenvalue to follow.")
    if not several(modes) or not len(modes):
        raise LabelError(f"modes must be a list of numbers, got {short(modes)}. Pass [6, 7], say.")
    for number in modes:
        if isinstance(number, bool) or number not in range(1, last + 1):
            raise LabelError(
                f"no mode {number!r}: the model has {eigen.n_rigid} rigid-body and "
                f"{counted(eigen.poles.size, 'oscillating mode')}, numbered from 1 to {last}. "
                "Choose among these."
            )
        if number < first:
            raise LabelError(
                f"mode {number} is a rigid-body mode of the start model (1 to {eigen.n_rigid}): "
                "its eigenvalue is zero, and a spring to the ground moves it with infinite "
                "slope. Leave it out, or start from a spring that is not zero (start=)."
            )
    return [int(number) - first for number in modes]
