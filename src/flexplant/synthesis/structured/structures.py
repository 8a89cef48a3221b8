"""Structures of a controller: static gain, low order, laws of axes, observer gains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from ...checks import (
    FloatArray,
    Value,
    checked,
    flag,
    function,
    instance,
    name_list,
    real_array,
    rebuild,
    whole,
)
from ...errors import ModelError, ShapeError, attempted, counted, require_known
from ...lti.balancing import balanced
from ...lti.discretisation import bilinear, tustin
from ...lti.preparation import Prepared
from ...lti.riccati import control_care, solve_care
from ...lti.statespace import StateSpace, System
from ...plant import StandardPlant
from ..hinf.hinf_design import design_hinf
from ..laws.law import Law, LawElement, SingleElement, chained
from ..laws.loop_design import axes_of, checked_laws
from .judges import Matrices

#: step of a derivative by differences, and the steps and weights of fourth order
_STEP = 1e-3
_DIFFERENCES = tuple(
    (k * _STEP, w / (12.0 * _STEP)) for k, w in ((-2, 1.0), (-1, -8.0), (1, 8.0), (2, -1.0))
)

#: entries of B and C of a state that is added to a controller of lower order
_COUPLING = 0.1

#: returns the best parameters of a structure; None where it is not stabilised
Minimise: TypeAlias = "Callable[[ControllerFamily], FloatArray | None]"


class ControllerFamily(Protocol):
    """A structure made ready for a plant: from parameters of size 1 to a controller."""

    order: int
    first: FloatArray
    spread: float

    def matrices(self, theta: FloatArray) -> Matrices:
        """Return the controller y -> u; of a sampled plant in the s of Tustin's rule."""

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Return the derivatives (n, rows, columns) of [A, B; C, D] by the parameters."""

    def structure(self, theta: FloatArray) -> Value | None:
        """Return the structure with these parameters as its own, where it is a value."""

    def nested(self, minimise: Minimise) -> FloatArray | None:
        """Return a start that comes from smaller structures, each minimised; None without."""
        return None


class ControllerStructure(Protocol):
    """What `design_structured` takes: a value that makes itself ready for a plant."""

    def family(self, plant: StandardPlant, prepared: Prepared) -> ControllerFamily:
        """Return the structure made ready for a plant."""


@dataclass(frozen=True, eq=False, repr=False)
class FixedOrder(Value):
    """A controller of given order, all entries of A, B, C and (unless left out) D free.

    Starts are the controller of full order, reduced, and the best of each lower order in turn,
    one state added at a time.

    Parameters
    ----------
    order : int
        States; 0 is a static gain.
    pattern : (nu, ny) array of bool, optional
        Of a static gain: which entries are free, the others are zero (decentralised feedback).
    start : StateSpace, optional
        A controller y -> u to begin with, of this order; of an earlier design.
    direct : bool
        Whether D is free; zero when not: a controller that rolls off.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.FixedOrder(2)
    FixedOrder(2)
    """

    order: int = field(default=0, metadata=checked(whole, minimum=0))
    pattern: npt.NDArray[np.bool_] | None = None
    start: StateSpace | None = None
    direct: bool = field(default=True, metadata=checked(flag))

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.direct and not self.order:
            raise ModelError(
                "a controller of order 0 is its D: leave direct out, or give an order."
            )
        if self.pattern is not None:
            if self.order:
                raise ModelError("a pattern is that of a static gain: leave order out, or it.")
            self._set(pattern=real_array(self.pattern, "pattern", (None, None)) != 0)

    def __repr__(self) -> str:
        free = "" if self.pattern is None else f", {int(self.pattern.sum())} entries free"
        rolls = "" if self.direct else ", direct=False"
        return f"FixedOrder({self.order}{free}{rolls})"

    def family(self, plant: StandardPlant, prepared: Prepared) -> _Entries:
        """Return the structure made ready for a plant."""
        nu, ny = len(plant.u), len(plant.y)
        pattern = np.full((nu, ny), self.direct) if self.pattern is None else self.pattern
        if pattern.shape != (nu, ny):
            raise ShapeError(
                f"pattern must have shape ({nu}, {ny}) of (u, y), got {pattern.shape}."
            )
        entries = _Entries(self.order, pattern, prepared, nests=self.start is None)
        known = self.start if self.start is not None else _reduced_controller(plant, self.order)
        if known is None:
            return entries
        if known.n_states != self.order or known.D.shape != (nu, ny):
            raise ModelError(
                f"start is {known!r}: pass {counted(self.order, 'state')}, {ny} y and {nu} u."
            )
        g = bilinear(known, 1.0 / plant.dt) if plant.dt else known
        return entries.starting(Matrices(g.A, g.B, g.C, g.D))


def _reduced_controller(plant: StandardPlant, order: int) -> StateSpace | None:
    """Return the controller of full order, reduced; None where that is not possible."""
    if not order:
        return None
    with attempted("a start from the reduced controller of full order"):
        full = design_hinf(plant).system
        return balanced(full, order=order).system if full.n_states > order else None
    return None


class _Entries(ControllerFamily):
    """Entries in units of the plant's speed and of its u and y; all zero but for decay, first."""

    spread = 1.0

    def __init__(
        self, order: int, pattern: npt.NDArray[np.bool_], p: Prepared, *, nests: bool
    ) -> None:
        self.order, self.pattern, self.dt = order, pattern, p.dt
        self.names, self._p, self._nests = (p.y, p.u), p, nests
        root = np.full(order, np.sqrt(p.speed))
        rows = np.concatenate([root, np.linalg.norm(p.u_scale, axis=1)])
        columns = np.concatenate([root, np.linalg.norm(p.y_scale, axis=0)])
        free = np.ones((rows.size, columns.size), dtype=bool)
        free[order:, order:] = pattern
        self.scale, self.free = np.outer(rows, columns), free
        rest = np.zeros(free.shape)
        rest[range(order), range(order)] = -1.0
        self.first: FloatArray = rest[free]
        self._jacobian = np.zeros((self.first.size, *free.shape))
        at, to = np.nonzero(free)
        self._jacobian[np.arange(self.first.size), at, to] = self.scale[free]

    def nested(self, minimise: Minimise) -> FloatArray | None:
        """Return the best controller of each order in turn, with one state more that acts little.

        The norm of a controller of low order has fewer local minima.
        """
        found: FloatArray | None = None
        least = 0 if self.pattern.any() else 1
        for order in range(least, self.order if self._nests else 0):
            lower = _Entries(order, self.pattern, self._p, nests=False)
            if found is not None:
                lower.first = lower._grown(found)
            found = minimise(lower)
        return None if found is None else self._grown(found)

    def _grown(self, lower: FloatArray) -> FloatArray:
        """Return the parameters of a controller of one state fewer, and a state to begin with."""
        k = self.order
        entries = np.zeros(self.scale.shape)
        others = np.delete(np.arange(k + len(self.names[1])), k - 1)
        columns = np.delete(np.arange(k + len(self.names[0])), k - 1)
        inner = np.zeros((others.size, columns.size))
        inner[self.free[np.ix_(others, columns)]] = lower
        entries[np.ix_(others, columns)] = inner
        rng = np.random.default_rng(k)
        entries[k - 1, k:] = _COUPLING * rng.standard_normal(len(self.names[0]))
        entries[k:, k - 1] = _COUPLING * rng.standard_normal(len(self.names[1]))
        entries[k - 1, k - 1] = -1.0
        return np.asarray(entries[self.free])

    def starting(self, K: Matrices) -> _Entries:
        """Return itself with the parameters of a controller as its first ones."""
        self.first = (K.joined / self.scale)[self.free]
        return self

    def matrices(self, theta: FloatArray) -> Matrices:
        entries = np.zeros(self.scale.shape)
        entries[self.free] = theta
        entries, k = entries * self.scale, self.order
        return Matrices(entries[:k, :k], entries[:k, k:], entries[k:, :k], entries[k:, k:])

    def jacobian(self, theta: FloatArray) -> FloatArray:
        return self._jacobian

    def structure(self, theta: FloatArray) -> FixedOrder:
        return FixedOrder(
            self.order,
            None if self.order else self.pattern,
            as_system(self.matrices(theta), self.names, self.dt),
            bool(self.pattern.any()),
        )


def as_system(K: Matrices, names: tuple[Sequence[str], Sequence[str]], dt: float) -> StateSpace:
    """Return a controller as a system, sampled by Tustin's rule where dt is not 0."""
    g = StateSpace(*K, inputs=names[0], outputs=names[1])
    return tustin(g, 1.0 / dt) if dt else g


@dataclass(frozen=True, eq=False, repr=False)
class ObserverGains(Value):
    """An observer of the plant's states with state feedback: the gains L and F are free.

    ``dx/dt = A x + B2 u - L (y - C2 x - D22 u), u = F x``, with the A, B2, C2 of the (weighted)
    plant; the first gains are those of LQG. A sampled plant's observer is that of its bilinear
    equivalent.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.ObserverGains()
    ObserverGains()
    """

    def family(self, plant: StandardPlant, prepared: Prepared) -> _Gains:
        """Return the structure made ready for a plant."""
        return _Gains(prepared, self)


class _Gains(ControllerFamily):
    spread = 0.1

    def __init__(self, p: Prepared, structure: ObserverGains) -> None:
        self.p, self.order, self._structure = p, p.A.shape[0], structure
        n = self.order
        F = -control_care(p.A, p.B2, Q=np.eye(n), R=np.eye(len(p.u))).gain
        L = -solve_care(p.A, p.C2, Q=np.eye(n), R=np.eye(len(p.y))).gain
        self.first = np.concatenate([F.ravel(), L.ravel()])

    def _parts(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        split = len(self.p.u) * self.order
        return theta[:split].reshape(-1, self.order), theta[split:].reshape(self.order, -1)

    def matrices(self, theta: FloatArray) -> Matrices:
        p, root = self.p, np.sqrt(self.p.speed)
        F, L = self._parts(theta)
        return Matrices(
            p.speed * (p.A + p.B2 @ F + L @ (p.C2 + p.D22 @ F)),
            -root * L @ p.y_scale,
            root * p.u_scale @ F,
            np.zeros((F.shape[0], L.shape[1])),
        )

    def jacobian(self, theta: FloatArray) -> FloatArray:
        p, root, n = self.p, np.sqrt(self.p.speed), self.order
        F, L = self._parts(theta)
        by = np.zeros((theta.size, n + F.shape[0], n + L.shape[1]))
        split, onto = F.size, p.B2 + L @ p.D22
        # an entry of F at (i, j): column j of A by column i of B2 + L D22; of L: a row of A
        on_F, on_L = by[:split].reshape(*F.shape, *by.shape[1:]), by[split:]
        for j in range(n):
            on_F[:, j, :n, j] = p.speed * onto.T
            on_F[:, j, n:, j] = root * p.u_scale.T
        rows = on_L.reshape(*L.shape, *by.shape[1:])
        for i in range(n):
            rows[i, :, i, :n] = p.speed * (p.C2 + p.D22 @ F)
            rows[i, :, i, n:] = -root * p.y_scale
        return by

    def structure(self, theta: FloatArray) -> ObserverGains:
        return self._structure


class Parametrised:
    """Any structure: a function of parameters that gives a controller.

    Parameters
    ----------
    make : function
        Of an (n,) array; returns a StateSpace y -> u, always of the same order, sampled as the
        plant is, and smooth in the parameters.
    start : (n,) array
        Where the search begins; steps are taken in multiples of each entry (of 1 where it is 0).
    spread : float
        Relative size of the differences between starts.

    Raises
    ------
    ModelError, ShapeError
        When make is no function, or start no array.

    Examples
    --------
    >>> import flexplant as fx
    >>> def gain(p):
    ...     return fx.StateSpace([], [], [], [[p[0]]], inputs=["out:error"], outputs=["in"])
    >>> sys = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=fx.lowpass(0.1), KS=0.1)
    >>> structure = fx.synthesis.Parametrised(gain, start=[1.0])
    >>> fx.synthesis.design_structured(sys, structure, starts=1).gamma < 1
    True
    """

    def __init__(
        self,
        make: Callable[[FloatArray], StateSpace],
        start: npt.ArrayLike,
        *,
        spread: float = 0.3,
    ) -> None:
        function(make, "make", "Pass one of the parameters, which returns a StateSpace.")
        self.make, self.start = make, real_array(start, "start", (None,))
        self.spread = float(real_array(spread, "spread", ()))

    def __repr__(self) -> str:
        return f"Parametrised({counted(self.start.size, 'parameter')})"

    def family(self, plant: StandardPlant, prepared: Prepared) -> Differenced:
        """Return the structure made ready for a plant."""
        unit = np.where(self.start != 0, np.abs(self.start), 1.0)

        def matrices(theta: FloatArray) -> Matrices:
            made = instance(self.make(unit * theta), StateSpace, "what make returns", "Return one.")
            g = made.select(plant.u, plant.y)
            g = bilinear(g, 1.0 / plant.dt) if plant.dt and g.n_states else g
            return Matrices(g.A, g.B, g.C, g.D)

        return Differenced(matrices, self.start / unit, self.spread)


def differenced(
    matrices: Callable[[FloatArray], Matrices], theta: FloatArray, number: int
) -> FloatArray:
    """Return the derivative of [A, B; C, D] by one parameter."""
    along = np.eye(theta.size)[number]
    return np.asarray(
        sum(weight * matrices(theta + step * along).joined for step, weight in _DIFFERENCES)
    )


class Differenced:
    """A family whose matrices are differentiated by differences, exact for polynomials up to 4."""

    def __init__(
        self,
        matrices: Callable[[FloatArray], Matrices],
        first: FloatArray,
        spread: float,
    ) -> None:
        self.matrices, self.first, self.spread = matrices, first, spread
        self.order = matrices(first).A.shape[0]

    def nested(self, minimise: Minimise) -> FloatArray | None:
        """Return None: there are no smaller structures."""
        return None

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Return the derivatives (n, rows, columns) of [A, B; C, D] by the parameters."""
        return np.array([differenced(self.matrices, theta, i) for i in range(theta.size)])

    def structure(self, theta: FloatArray) -> None:
        """Return None: a function is no value that could be kept in a file."""


#: what an element may have free; the depth of a notch is not, unless it is named
_NUMBERS = ("p", "i", "d", "pole", "freq", "ratio", "width", "damping", "depth")
_FREE = _NUMBERS[:-1]
#: logarithm of the farthest that a number moves
_FARTHEST = 8.0
#: highest corner beside half the rate; of a continuous plant beside its fastest pole
_HIGHEST, _FASTER = 0.98, 10.0


@dataclass(frozen=True, eq=False, repr=False)
class TunedLaws(Value):
    """A decoupled controller ``u = -before diag(laws) after y`` whose numbers are free.

    Each number that is not zero moves by a factor and keeps its sign: gains, corners, centres of
    notches. No corner moves above half the rate, or ten times the fastest pole of a continuous
    plant; one that was given higher stays at most where it is. The laws given are where the search
    begins.

    Parameters
    ----------
    laws : Law or mapping {axis: Law}
        As for `design_loops`.
    before, after : StateSpace or array, optional
        As for `design_loops`.
    free : sequence of str
        Which numbers of the elements are free, of p, i, d, pole, freq, ratio, width, damping and
        depth; all but the depth unless given.

    Raises
    ------
    LabelError
        When one of these names is unknown.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.TunedLaws(fx.Pid(1.0) * fx.Lead(50.0), free=("p",)).free
    ('p',)
    """

    laws: LawElement | Mapping[str, LawElement]
    before: System | FloatArray | None = None
    after: System | FloatArray | None = None
    free: Sequence[str] = field(default=_FREE, metadata=checked(name_list, name="free numbers"))

    def __post_init__(self) -> None:
        super().__post_init__()
        require_known("number of an element", self.free, _NUMBERS)

    def family(self, plant: StandardPlant, prepared: Prepared) -> _Laws:
        """Return the structure made ready for a plant."""
        axes = axes_of(plant, self.before, self.after, None, 0.0, True)
        laws = checked_laws(axes, self.laws)
        before = np.zeros((len(plant.u), len(axes.names)))
        before[[plant.u.index(name) for name in axes.before.outputs]] = axes.before.D
        after = np.zeros((len(axes.names), len(plant.y)))
        after[:, [plant.y.index(name) for name in axes.after.inputs]] = axes.after.D
        fastest = np.abs(plant.system.poles()).max(initial=0.0) / (2.0 * np.pi)
        highest = 0.5 * _HIGHEST * axes.rate if axes.rate else _FASTER * float(fastest)
        return _Laws(self, laws, before, after, axes.rate, highest)


class _Number(NamedTuple):
    """A number of an element: which axis, factor (-1: the gain of the law) and field it is."""

    axis: int
    factor: int
    name: str


class _Laws(ControllerFamily):
    """Laws whose numbers are ``value exp(theta)``."""

    spread = 0.3

    def __init__(
        self,
        given: TunedLaws,
        laws: Mapping[str, Law],
        before: FloatArray,
        after: FloatArray,
        rate: float,
        highest: float,
    ) -> None:
        self._given, self._laws, self.before, self.after = given, dict(laws), before, after
        self.rate = rate
        self._each = list(laws.values())
        factors = [factor for law in self._each for factor in law.factors]
        self._highest = max([highest, *(corner for one in factors for corner in _corners(one))])
        self.numbers = [n for i, law in enumerate(self._each) for n in _free(i, law, given.free)]
        if not self.numbers:
            raise ModelError(f"no number of the laws is free: name some of {_NUMBERS} in free=.")
        self.first = np.zeros(len(self.numbers))
        self.order = sum(self._matrices(i, self.first)[0].shape[0] for i in range(len(self._each)))

    def matrices(self, theta: FloatArray) -> Matrices:
        """Return the controller y -> u; NaN for corners too high."""
        corners = [
            corner
            for i, law in enumerate(self._each)
            for j in range(len(law.factors))
            for corner in _corners(self._element(i, j, theta))
        ]
        K = self._joined([self._matrices(i, theta) for i in range(len(self._each))])
        return K if max(corners, default=0.0) <= self._highest else K._replace(D=np.nan * K.D)

    def _joined(self, parts: Sequence[tuple[FloatArray, ...]]) -> Matrices:
        A, B, C, D = (la.block_diag(*(part[j] for part in parts)) for j in range(4))
        return Matrices(A, -B @ self.after, self.before @ C, -self.before @ D @ self.after)

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Return the derivatives (n, rows, columns) of [A, B; C, D] by the parameters."""
        parts = [self._matrices(i, theta) for i in range(len(self._each))]

        def moved(axis: int, to: FloatArray) -> Matrices:
            return self._joined([*parts[:axis], self._matrices(axis, to), *parts[axis + 1 :]])

        return np.array(
            [
                differenced(partial(moved, number.axis), theta, i)
                for i, number in enumerate(self.numbers)
            ]
        )

    def structure(self, theta: FloatArray) -> TunedLaws:
        """Return the structure with its laws at these parameters, continuous."""
        laws = {name: self._law(i, theta) for i, name in enumerate(self._laws)}
        return self._given.replace(laws=laws)

    def _element(self, axis: int, factor: int, theta: FloatArray) -> SingleElement:
        element = self._each[axis].factors[factor]
        scaled = {
            name: getattr(element, name) * _clipped_exp(value)
            for value, (i, place, name) in zip(theta, self.numbers, strict=True)
            if (i, place) == (axis, factor)
        }
        return _with(element, scaled)

    def _gain(self, axis: int, theta: FloatArray) -> float:
        own = [v for v, n in zip(theta, self.numbers, strict=True) if n[:2] == (axis, -1)]
        return self._each[axis].gain * _clipped_exp(sum(own))

    def _law(self, axis: int, theta: FloatArray) -> Law:
        law = self._each[axis]
        factors = tuple(self._element(axis, i, theta) for i in range(len(law.factors)))
        return law.replace(factors=factors, gain=self._gain(axis, theta), rate=0.0)

    def _rate(self, axis: int) -> float:
        return self.rate if self._each[axis].prewarped else 0.0

    def _matrices(self, axis: int, theta: FloatArray) -> tuple[FloatArray, ...]:
        """Return the matrices of a law in the s of Tustin's rule."""
        sections = [
            self._element(axis, i, theta).section.at(self._rate(axis)).matrices
            for i in range(len(self._each[axis].factors))
        ]
        return chained(self._gain(axis, theta), sections)


def _clipped_exp(theta: float) -> float:
    return float(np.exp(np.clip(theta, -_FARTHEST, _FARTHEST)))


def _corners(element: SingleElement) -> list[float]:
    """Return the corners [Hz] of an element."""
    given = (getattr(element, name, None) for name in ("pole", "freq"))
    return [float(one) for one in given if one is not None]


def _with(element: SingleElement, numbers: Mapping[str, float]) -> SingleElement:
    """Return an element with other positive numbers, which need no check."""
    made = rebuild(type(element), dict(element._fields()) | dict(numbers))
    assert isinstance(made, SingleElement)  # noqa: S101 - rebuild returns the class it is given
    return made


def _free(axis: int, law: Law, names: Sequence[str]) -> list[_Number]:
    """Return the free numbers of a law; its gain only where no Pid has one."""
    found = []
    for i, factor in enumerate(law.factors):
        own = [f.name for f in fields(factor) if f.name in names]  # type: ignore[arg-type]
        found += [_Number(axis, i, name) for name in own if getattr(factor, name)]
    gains = any(number.name in "pid" for number in found)
    return found if gains or "p" not in names else [_Number(axis, -1, "gain"), *found]
