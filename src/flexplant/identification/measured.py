"""Measured poles and the modes to which they belong."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from ..arrays import (
    BoolArray,
    ComplexArray,
    FloatArray,
    between,
    check_names,
    complex_array,
    instance,
    positive,
    real_array,
    several,
    whole,
)
from ..errors import LabelError, ModelError, ShapeError, counted, short, some_names
from ..modes import Modes
from ..modes.matching import assigned, in_span
from ..store import Value
from ..tolerances import SAME, SPLIT


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredModes(Value):
    """Measured poles of a structure, ``lambda = -zeta omega + i omega sqrt(1 - zeta^2)``.

    Parameters
    ----------
    poles : (m,) complex array [rad/s]
        One pole of each conjugate pair, with either sign of the imaginary part. It is stored with
        the positive sign. (The paper on which flexplant is based prints the negative one.)
    modes : sequence of m int, optional
        Number of each mode in the model. It counts from 1 and includes rigid-body modes. The
        numbers are needed to update a model.
    covariance : (m,) or (2m, 2m) array [(rad/s)^2], optional
        Covariance matrix of the vector [Re lambda; Im lambda], or the variance E|n|^2 of the error
        n of each pole. A variance is divided equally between the real and the imaginary part, which
        are assumed independent. The attribute is always the covariance matrix.
    shapes : (n, m) complex array, optional
        Mode shapes at n measured DOFs. If a pole is stored as its conjugate, its shape is too.
    dofs : sequence of n str, optional
        Labels of these DOFs (`"41:z"`), or names of the channels where no DOF is known.
    xyz : (n, 3) array [m], optional
        Coordinates of these DOFs. `numbered` finds them from the given sensors or points.
    directions : sequence of n str, optional
        Direction of each of these DOFs, such as "z".

    Raises
    ------
    ShapeError, ModelError, LabelError
        When lengths differ, or only one of `shapes` and `dofs` is given. When a pole is not finite,
        is real (overdamped or rigid) or is unstable. When a shape is zero or not finite, or the
        covariance is not positive definite. When mode numbers are not integers from 1, or a number
        or label appears twice.

    Examples
    --------
    Two measured poles and their mode numbers:

    >>> MeasuredModes([-28.5 - 2870j, -39.3 - 3970j], modes=[6, 7])
    <MeasuredModes: 2 poles, modes 6, 7 at 456.8, 631.9 Hz>
    """

    poles: ComplexArray
    modes: tuple[int, ...] | None = field(default=None, kw_only=True)
    covariance: FloatArray | None = field(default=None, kw_only=True)
    shapes: ComplexArray | None = field(default=None, kw_only=True)
    dofs: tuple[str, ...] | None = field(default=None, kw_only=True)
    xyz: FloatArray | None = field(default=None, kw_only=True)
    directions: tuple[str, ...] | None = field(default=None, kw_only=True)

    if TYPE_CHECKING:  # the input is any array-like object

        def __init__(
            self,
            poles: npt.ArrayLike,
            *,
            modes: Iterable[int] | None = None,
            covariance: npt.ArrayLike | None = None,
            shapes: npt.ArrayLike | None = None,
            dofs: Iterable[str] | None = None,
            xyz: npt.ArrayLike | None = None,
            directions: Iterable[str] | None = None,
        ) -> None: ...

    def __post_init__(self) -> None:
        poles = _checked_poles(self.poles)
        shapes, dofs = _checked_shapes(self.shapes, self.dofs, poles)
        numbers = None if self.modes is None else _checked_numbers(self.modes, poles.size)
        covariance = self.covariance
        if covariance is not None:
            covariance = _checked_covariance(covariance, poles.size)
            # a conjugated pole carries the opposite error in its imaginary part
            signs = np.concatenate([np.ones(poles.size), np.sign(poles.imag)])
            covariance = covariance * np.outer(signs, signs)
        poles = poles.real + 1j * np.abs(poles.imag)
        self._set(poles=poles, modes=numbers, covariance=covariance, shapes=shapes, dofs=dofs)

    @staticmethod
    def from_freq(
        freq: npt.ArrayLike,
        zeta: npt.ArrayLike,
        *,
        modes: Iterable[int] | None = None,
        freq_std: npt.ArrayLike | None = None,
        zeta_std: npt.ArrayLike | None = None,
    ) -> MeasuredModes:
        """Return modes from measured frequencies and damping ratios.

        The poles are ``omega (-zeta + i sqrt(1 - zeta^2))``. Their covariance follows from the
        standard deviations to first order.

        Parameters
        ----------
        freq : (m,) array [Hz]
            Undamped natural frequencies.
        zeta : float or (m,) array
            Damping ratios, 0 or more and below 1.
        modes : sequence of m int, optional
            Mode numbers in the model.
        freq_std, zeta_std : float or (m,) arrays [Hz, 1], optional
            Standard deviations of frequencies and damping ratios, which are assumed independent.
            Give both or neither.

        Raises
        ------
        ModelError
            When a damping ratio is not in 0 .. 1, or only one kind of standard deviation is given.

        Examples
        --------
        >>> MeasuredModes.from_freq([456.8, 631.9], 0.01, modes=[6, 7]).poles.round(1)
        array([-28.7+2870.j , -39.7+3970.1j])
        """
        f = np.atleast_1d(real_array(freq, "freq"))
        z = real_array(zeta, "zeta")
        z = np.broadcast_to(z, f.shape) if not z.ndim else real_array(z, "zeta", f.shape)
        if np.any(z < 0) or np.any(z >= 1):
            raise ModelError("zeta must be damping ratios of 0 or more, below 1: 0.01 is 1 %.")
        turn = 2.0 * np.pi * f
        damped = np.sqrt(1.0 - z**2)
        poles = turn * (-z + 1j * damped)
        if freq_std is None and zeta_std is None:
            return MeasuredModes(poles, modes=modes)
        if freq_std is None or zeta_std is None:
            raise ModelError(
                "give both freq_std= and zeta_std=, or neither: one alone does not determine a "
                "covariance."
            )
        spread = [
            np.diag(np.broadcast_to(real_array(s, "a standard deviation"), f.shape) ** 2)
            for s in (freq_std, zeta_std)
        ]
        slope = np.block([
            [np.diag(-2.0 * np.pi * z), np.diag(-turn)],
            [np.diag(2.0 * np.pi * damped), np.diag(-turn * z / damped)],
        ])  # fmt: skip
        covariance = slope @ la.block_diag(*spread) @ slope.T
        return MeasuredModes(poles, modes=modes, covariance=covariance)

    def __len__(self) -> int:
        return int(self.poles.size)

    def __repr__(self) -> str:
        numbers = some_names([*map(str, self.modes or ())], total=False)
        known = f", modes {numbers}" if numbers else ""
        spread = "" if self.covariance is None else ", with covariance"
        return (
            f"<MeasuredModes: {counted(len(self), 'pole')}{known} at "
            f"{some_names([f'{f:.1f}' for f in self.freq], total=False)} Hz{spread}>"
        )

    @property
    def freq(self) -> FloatArray:
        """Undamped natural frequencies |lambda|/(2 pi) [Hz]."""
        return np.abs(self.poles) / (2 * np.pi)

    @property
    def zeta(self) -> FloatArray:
        """Modal damping ratios -Re lambda / |lambda|."""
        return np.asarray(-self.poles.real / np.abs(self.poles), dtype=np.float64)

    @property
    def std(self) -> ComplexArray | None:
        """Standard deviations of the poles [rad/s], as std(Re lambda) + i std(Im lambda)."""
        if self.covariance is None:
            return None
        deviation = np.sqrt(np.diag(self.covariance))
        return np.asarray(deviation[: len(self)] + 1j * deviation[len(self) :])

    def select(self, poles: Iterable[int]) -> Self:
        """Return some of the poles with all their data, in the given order.

        Parameters
        ----------
        poles : iterable of int
            Positions of the poles, from 0.

        Raises
        ------
        LabelError, ModelError
            When a position is not an integer, does not exist or is given twice.
        """
        if not several(poles):
            raise LabelError(f"select takes a list of places of the poles, got {short(poles)}.")
        places = [whole(place, "each place", minimum=0) for place in poles]
        if not places or len(set(places)) < len(places) or not set(places) <= set(range(len(self))):
            raise LabelError(
                f"select takes different places between 0 and {len(self) - 1} of the poles, got "
                f"{places!r:.80}."
            )
        return self.replace(**self._picked(places))

    def merged(self, other: MeasuredModes) -> MeasuredModes:
        """Return the modes of two measurements: of two bands, directions or sets of sensors.

        The modes of this measurement come first. A mode that both contain is taken from `other`.
        The errors of the two are independent. The result has a covariance if both have one, and
        mode shapes if both have them at the same DOFs, in any order.

        Parameters
        ----------
        other : MeasuredModes
            The other measurement, with mode numbers, as this one has them.

        Raises
        ------
        ModelError
            When one of them has no mode numbers.

        Examples
        --------
        >>> low = MeasuredModes([-1 + 20j, -2 + 30j], modes=[1, 2])
        >>> low.merged(MeasuredModes([-2 + 31j, -9 + 900j], modes=[2, 7]))
        <MeasuredModes: 3 poles, modes 1, 2, 7 at 3.2, 4.9, 143.2 Hz>
        """
        instance(other, MeasuredModes, "other", "Pass numbered(identify_modes(frf), model).")
        if self.modes is None or other.modes is None:
            raise ModelError(
                "measurements are merged by their mode numbers, which one of them lacks: pass "
                "numbered(measured, model), or MeasuredModes(poles, modes=[...])."
            )
        own = [i for i, number in enumerate(self.modes) if number not in other.modes]
        if not own:
            return other
        parts: list[MeasuredModes] = [MeasuredModes.select(self, own), other]
        sizes = [len(part) for part in parts]
        covariance = None
        if all(part.covariance is not None for part in parts):
            halves = np.array_split(np.arange(2 * sum(sizes)), 2)
            order = [half[at] for at in (np.s_[: sizes[0]], np.s_[sizes[0] :]) for half in halves]
            both = np.concatenate(order)
            covariance = np.zeros((both.size, both.size))
            blocks: list[Any] = [part.covariance for part in parts]
            covariance[np.ix_(both, both)] = la.block_diag(*blocks)
        found = MeasuredModes(
            np.concatenate([part.poles for part in parts]),
            modes=[number for part in parts for number in part.modes or ()],
            covariance=covariance,
        )
        if self.dofs is None or other.dofs is None or {*self.dofs} != {*other.dofs}:
            return found
        shapes: list[Any] = [part.shapes for part in parts]
        shapes[0] = shapes[0][[self.dofs.index(label) for label in other.dofs]]
        places = {"dofs": other.dofs, "xyz": other.xyz, "directions": other.directions}
        return found.replace(shapes=np.hstack(shapes), **places)

    def _picked(self, places: list[int]) -> dict[str, Any]:
        both = np.array(places + [place + len(self) for place in places])
        return {
            "poles": self.poles[places],
            "modes": None if self.modes is None else tuple(self.modes[i] for i in places),
            "covariance": None if self.covariance is None else self.covariance[np.ix_(both, both)],
            "shapes": None if self.shapes is None else self.shapes[:, places],
        }


def _checked_poles(value: Any) -> ComplexArray:
    poles = complex_array(value, "poles")
    if poles.ndim != 1 or not poles.size:
        raise ShapeError(
            f"poles must have shape (m,) with m of at least one, got {poles.shape}: give one "
            "eigenvalue of each conjugate pair."
        )
    for i, pole in enumerate(poles.tolist()):
        if not np.isfinite(pole):
            raise ModelError(
                f"pole {i} is {pole}: no result could be trusted. Remove it at its source."
            )
        if pole.imag == 0:
            raise ModelError(
                f"pole {i} is {pole:g}, a real one (overdamped, or of a rigid-body mode), but an "
                "oscillating mode is needed. Give poles in rad/s with their "
                "imaginary part, or leave this one out."
            )
        if pole.real > 0:
            raise ModelError(
                f"pole {i} is {pole:g}, unstable: a passive structure's poles have a real part "
                "of at most zero. Check the sign convention (exp(lambda t)) or the fit."
            )
    apart = np.abs(poles[:, None] - poles.conj())
    np.fill_diagonal(apart, np.inf)
    i, j = divmod(int(np.argmin(apart)), len(poles))
    if apart[i, j] <= SAME * abs(poles[i]):
        raise ModelError(
            f"poles {min(i, j)} and {max(i, j)} are a conjugate pair, {poles[i]:g} and "
            f"{poles[j]:g}: one mode, which would count twice. Pass one of each pair: "
            "poles[poles.imag > 0]."
        )
    return poles


def _checked_numbers(value: Any, count: int) -> tuple[int, ...]:
    real_array(value, "modes")  # refuses anything but an array of numbers
    numbers = np.asarray(value)
    if numbers.ndim != 1 or numbers.size != count:
        raise ShapeError(
            f"{count} poles need {count} mode numbers, got modes of shape {numbers.shape}."
        )
    if numbers.dtype.kind not in "iu" or numbers.min() < 1:
        raise LabelError(
            f"modes must be whole numbers from 1 (rigid-body modes included), got "
            f"{numbers.tolist()!r:.80}."
        )
    listed = tuple(int(number) for number in numbers)
    twice = sorted({number for number in listed if listed.count(number) > 1})
    if twice:
        raise LabelError(
            f"modes {twice} have more than one pole each, but a mode has one pole. Average "
            "repeated measurements, or give each its own MeasuredModes."
        )
    return listed


def _checked_covariance(value: Any, count: int) -> FloatArray:
    if real_array(value, "covariance").ndim == 1:
        variance = real_array(value, "covariance", (count,))
        matrix = np.diag(np.concatenate([variance, variance]) / 2)
    else:
        matrix = real_array(value, "covariance", (2 * count, 2 * count))
    if not np.allclose(matrix, matrix.T, rtol=SAME, atol=0.0):
        raise ModelError("covariance must be symmetric: pass (C + C.T)/2 if that is meant.")
    try:
        la.cholesky(matrix)
    except la.LinAlgError:
        raise ModelError(
            "covariance must be positive definite: a pole of zero variance would get infinite "
            "weight. Give every pole a positive variance in (rad/s)^2."
        ) from None
    return (matrix + matrix.T) / 2


def _checked_shapes(
    shapes: Any, dofs: Any, poles: ComplexArray
) -> tuple[ComplexArray | None, tuple[str, ...] | None]:
    if shapes is None and dofs is None:
        return None, None
    if shapes is None or dofs is None or isinstance(dofs, str):
        raise ShapeError("shapes= and dofs=, the labels of their rows, must be given together.")
    labels = tuple(str(label) for label in dofs)
    array = complex_array(shapes, "shapes", (len(labels), poles.size))
    check_names(labels, "dofs")
    if not np.all(np.any(array, axis=0)):
        raise ModelError("every mode shape must not be zero everywhere.")
    return np.where(poles.imag < 0, array.conj(), array), labels


#: relative distance of frequencies below which modes of a model form one family, whose shapes are
#: only known as a span
FAMILY = 5e-3


def numbered(
    measured: MeasuredModes,
    model: Any,
    *,
    at: Any = None,
    tolerance: float = 0.15,
    least_mac: float = 0.7,
    partial: bool = False,
) -> MeasuredModes:
    r"""Return measured modes with the numbers of the corresponding modes of a model.

    Each measured mode is paired with a different mode of the model. The pairs are chosen by the
    Hungarian method: they minimise the sum of ``(ln(f / f_model) / tolerance)^2 + 1 - MAC``. Here f
    and f_model are the frequencies of a pair, and

    .. math:: MAC = \frac{|\phi^H \psi|^2}{(\phi^H\phi)(\psi^H\psi)}

    is the modal assurance criterion of the shapes phi of the model and psi of the measurement at
    the measured DOFs. If the places of the inputs are known on the model, the residues of a pair
    may differ by a factor of at most 30. This excludes modes of the model that the sensors do not
    see, whose shapes at the sensors are only rounding errors. It also excludes folded modes (modes
    above half the sampling rate, seen at a lower frequency) that happen to be near a frequency of
    the model.

    Modes of the model within 0.5 % of each other count as repeated. Their MAC is that of the
    combination of their shapes that is closest to the measured shape. This MAC does not distinguish
    them. Measured modes that are paired with repeated modes are therefore numbered by frequency. If
    there are fewer of them than repeated modes, they get the lowest numbers.

    Parameters
    ----------
    measured : MeasuredModes
        Measured modes. Without shapes they are paired by frequency only.
    model : Modes, or a model with `.modes()`
        Model whose modes are numbered from 1, rigid-body modes included.
    at : Ports, or mapping {label of a shape's row: place or sensor}, optional
        Places on the model where the shapes were measured, one for each row. Ports give the places
        of their sensors and actuators. A mapping gives the place of each row, as a sensor or a
        point. A sensor contains its direction, and at a point the direction is z. None: the labels
        of the rows are labels of DOFs of the model.
    tolerance : float
        Largest relative difference of frequencies in a pair.
    least_mac : float
        Smallest MAC in a pair.
    partial : bool
        Whether to leave out poles without a partner instead of raising an error. Such poles are
        found where modes above half the sampling rate fold into the band of the measurement.

    Returns
    -------
    MeasuredModes
        The measured modes, of the same class and in the same order, with mode numbers in `modes`.

    Raises
    ------
    ModelError, LabelError
        When a pole has no partner, or with `partial` when no pole has one. Also when an argument is
        out of range, or the model does not have the place of a row.

    References
    ----------
    [Allemang2003]_.

    Examples
    --------
    A measured mode has the frequency and the shape of mode 2 of the model:

    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=3)
    >>> model = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> shape = [[1.0], [0.02], [-1.0]]
    >>> measured = fx.MeasuredModes(poles=[-6 + 630j], shapes=shape, dofs=["1:x", "2:x", "3:x"])
    >>> fx.numbered(measured, model).modes
    (2,)
    """
    instance(measured, MeasuredModes, "measured", "Pass identify_modes(frf).")
    modes = model.modes() if hasattr(model, "modes") and not isinstance(model, Modes) else model
    instance(modes, Modes, "model", "Solve it first: solve_modes(model, count=...).")
    width = positive(tolerance, "tolerance")
    least_mac = between(least_mac, "least_mac", 0.0, 1.0, "Try 0.5.", ends="[")
    elastic = np.flatnonzero(modes.omega > 0)
    if not elastic.size:
        raise ModelError("the model has no elastic modes to compare with.")
    distance = np.abs(np.log(measured.freq[:, None] / modes.freq[elastic]))
    alike = _likeness(measured, modes, elastic, at)
    allowed = (distance <= width) & (alike >= least_mac)
    sized = allowed & _sizes_agree(measured, modes, elastic, at)
    if np.any(sized):  # otherwise the response is not calibrated
        allowed = sized
    cost = np.where(allowed, (distance / width) ** 2 + 1.0 - alike, 1e6)
    partner = assigned(cost, most=2.0).tolist()
    pairs = {i: int(elastic[j]) + 1 for i, j in enumerate(partner) if j >= 0}
    lost = [i for i in range(len(measured)) if i not in pairs]
    if lost and (not partial or not pairs):
        worst = lost[0]
        near = elastic[int(np.argmin(distance[worst]))]
        raise ModelError(
            f"no separate mode of the model within {width:.0%}, with a MAC of {least_mac:g} and a "
            "response of like size, for the poles at "
            f"{[round(float(measured.freq[i]), 2) for i in lost[:6]]} Hz; nearest to the first is "
            f" mode {near + 1} at {modes.freq[near]:.5g} Hz with a MAC of "
            f"{alike[worst, int(np.argmin(distance[worst]))]:.2f}. Add modes to the model, loosen "
            "tolerance=, or leave these poles out with partial=True."
        )
    _sort_families(pairs, measured.freq, modes.omega)
    kept = sorted(pairs)
    chosen = measured if len(kept) == len(measured) else measured.select(kept)
    return chosen.replace(modes=tuple(pairs[i] for i in kept), **_points(measured, modes, at))


#: largest ratio of the measured to the modelled residue of a pair: updates and nodes close to a
#: sensor change it by less, folded modes and unseen modes by far more
LIKE_SIZE = 30.0


def _sizes_agree(measured: MeasuredModes, modes: Modes, elastic: Any, at: Any) -> BoolArray:
    """Return which residues are of like size, all of them where inputs have no known places."""
    part, names = getattr(measured, "participation", None), getattr(measured, "input_dofs", ())
    given = {port.name: port for port in at.u} if hasattr(at, "u") else {}
    places = [given.get(name, name) for name in names]
    known = all(not isinstance(place, str) or place in modes.dofs.labels for place in places)
    if part is None or measured.shapes is None or not places or not known:
        return np.ones((len(measured), elastic.size), dtype=bool)
    outputs, inputs = (
        np.linalg.norm(_rows(some, modes)[:, elastic], axis=0)
        for some in (_places(measured, at), places)
    )
    omega = modes.omega[elastic]
    family = np.abs(omega / omega[:, None] - 1.0) <= FAMILY
    size = np.sqrt(family @ (outputs * inputs) ** 2) / (2.0 * omega)
    own = np.linalg.norm(measured.shapes, axis=0) * np.linalg.norm(part, axis=0)
    ratio = size / own[:, None]
    return np.asarray((ratio < LIKE_SIZE) & (ratio > 1.0 / LIKE_SIZE))


def _rows(places: list[Any], modes: Modes) -> FloatArray:
    """Return the entries (n, n_modes) of shapes at places."""
    for place in places:
        if isinstance(place, str) and place not in modes.dofs.labels:
            raise LabelError(
                f"the model has no DOF {place!r}, a row of the measured shapes. Give its place: "
                f"numbered(measured, model, at={{{place!r}: place or sensor}})."
            )
    rows = [
        modes.at(place.at, place.direction) if hasattr(place, "direction") else modes.at(place)
        for place in places
    ]
    return np.array(rows)


def _points(measured: MeasuredModes, modes: Modes, at: Any) -> dict[str, Any]:
    """Return points and directions of the rows of shapes, nothing where one is not at a point."""
    if measured.shapes is None:
        return {}
    xyz, directions = [], []
    for place in _places(measured, at):
        point, direction = getattr(place, "at", place), getattr(place, "direction", "z")
        if isinstance(point, str) and point in modes.dofs.labels:
            row = modes.dofs.index(point)
            point, direction = modes.dofs.xyz[row], modes.dofs.directions[row]
        if isinstance(point, str | Mapping) or np.shape(point) != (3,):
            return {}
        xyz.append([float(x) for x in point])
        directions.append(direction)
    return {"xyz": np.array(xyz), "directions": tuple(directions)}


def _places(measured: MeasuredModes, at: Any) -> list[Any]:
    """Return the place of each row of the shapes: a sensor, a point or a label."""
    given = {port.name: port for port in at.y} if hasattr(at, "y") else at
    given = {} if given is None else given
    if not isinstance(given, Mapping):
        raise LabelError(
            f"at is Ports, or a mapping from the labels of shapes to places, got {at!r:.60}."
        )
    return [given.get(label, label) for label in measured.dofs or ()]


def _sort_families(pairs: dict[int, int], freq: FloatArray, omega: FloatArray) -> None:
    """Assign mode numbers to the poles of each family of modes by frequency."""
    free = sorted(pairs, key=lambda i: pairs[i])
    while free:
        first = pairs[free[0]] - 1
        family = [i for i in free if omega[pairs[i] - 1] <= omega[first] * (1.0 + FAMILY)]
        free = free[len(family) :]
        taken, numbers = set(pairs.values()), []
        for number in [pairs[i] for i in family]:
            # the lowest free mode with its frequency
            taken.discard(number)
            equal = np.flatnonzero(np.abs(omega / omega[number - 1] - 1.0) <= SPLIT) + 1
            numbers.append(next(int(n) for n in equal if n not in taken))
            taken.add(numbers[-1])
        pairs.update(zip(sorted(family, key=lambda i: float(freq[i])), numbers, strict=True))


def _likeness(measured: MeasuredModes, modes: Modes, elastic: Any, at: Any) -> FloatArray:
    if measured.shapes is None or measured.dofs is None:
        return np.ones((len(measured), elastic.size))
    phi = _rows(_places(measured, at), modes).astype(np.complex128)[:, elastic]
    alike = np.zeros((len(measured), elastic.size))
    omega = modes.omega[elastic]
    for j in range(elastic.size):
        family = np.flatnonzero(np.abs(omega / omega[j] - 1.0) <= FAMILY)
        alike[:, j] = in_span(phi[:, family], measured.shapes)
    return alike
