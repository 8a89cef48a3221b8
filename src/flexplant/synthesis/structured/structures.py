"""Structures of a controller: static gain, low order, laws of axes, observer gains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import lru_cache
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from ...arrays import FloatArray, flag, function, instance, name_list, real_array, whole
from ...errors import ModelError, ShapeError, attempted, counted, require_known
from ...lti.balancing import balanced
from ...lti.blocks_of_states import Matrices as LawMatrices
from ...lti.conversions import bilinear, tustin
from ...lti.riccati import control_care, filter_care
from ...lti.statespace import StateSpace, System
from ...plant import AnyPlant
from ...store import Value, checked, rebuild
from ..hinf.hinf_design import design_hinf
from ..hinf.hinf_riccati import Riccati
from ..laws.law import Law, LawElement, SingleElement, chained, decoupled
from ..laws.loop_design import axes_of, checked_laws
from ..preparation import Prepared
from .judges import STEP, Matrices

#: relative distance from the least gamma of the controller of full order that is reduced to a
#: start: closer to it a controller has fast poles, whose reduction stabilises on some processors
#: only
_RELAXED = 0.5

#: entries of B and C of a state that is added to a controller of lower order
_COUPLING = 0.1

#: returns the best parameters of a structure; None where it is not stabilised
Minimise: TypeAlias = "Callable[[ControllerFamily], FloatArray | None]"


class ControllerFamily:
    """A structure made ready for a plant: from parameters of size 1 to a controller.

    `matrices` gives the controller y -> u, of a sampled plant in the s of Tustin's rule;
    `structure` the structure with some parameters as its own, where it is a value; `allows`
    says whether parameters are within their limits.
    """

    def __init__(
        self,
        matrices: Callable[[FloatArray], Matrices],
        first: FloatArray,
        spread: float,
        structure: Callable[[FloatArray], Value | None] = lambda _: None,
        allows: Callable[[FloatArray], bool] = lambda _: True,
        slopes: Callable[[FloatArray], FloatArray] | None = None,
    ) -> None:
        self.matrices, self.first, self.spread = matrices, first, spread
        self.structure, self.allows, self.order = structure, allows, matrices(first).A.shape[0]
        self._slopes = slopes

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Return the derivatives (n, rows, columns) of [A, B; C, D] by the parameters."""
        # those of `slopes`; without them by differences
        if self._slopes is not None:
            return self._slopes(theta)
        ends = (
            [self.matrices(theta + step * one).joined for one in np.eye(theta.size)]
            for step in (STEP, -STEP)
        )
        up, down = map(np.array, ends)
        return np.asarray((up - down) / (2.0 * STEP))

    def nested(self, minimise: Minimise) -> FloatArray | None:
        """Return a start that comes from smaller structures, each minimised; None without."""
        return None


class ControllerStructure(Protocol):
    """Structure of a controller for `design_structured`, which it makes ready for a plant."""

    def family(self, plant: AnyPlant, prepared: Prepared) -> ControllerFamily:
        """Return the map from free parameters to the controllers of this structure.

        `design_structured` calls this method with the plant and its scaled matrices.
        """


@dataclass(frozen=True, eq=False, repr=False)
class FixedOrder(Value):
    """A controller of given order, with all entries of A, B, C and (optionally) D free.

    One start of the search is the controller of full order, reduced to this order. Another start is
    built up from the lowest order. For this, the best controller of each order is found, and one
    state is added to it for the next order.

    Parameters
    ----------
    order : int
        Number of states; 0 for a static gain.
    pattern : (nu, ny) array of bool, optional
        Entries of a static gain that are free. The others are zero (decentralised feedback).
    start : StateSpace, optional
        Controller from y to u of this order with which the search begins, for example the result of
        an earlier design.
    direct : bool
        Whether D is free. If not, D is zero, so that the gain of the controller falls at high
        frequency.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.FixedOrder(2)
    FixedOrder(order=2)
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
                raise ModelError("pattern= is for a static gain (order 0): omit one of the two.")
            self._set(pattern=real_array(self.pattern, "pattern", (None, None)) != 0)

    def family(self, plant: AnyPlant, prepared: Prepared) -> _Entries:
        """Return the map from free parameters to the controllers of this structure.

        `design_structured` calls this method with the plant and its scaled matrices.
        """
        nu, ny = len(plant.u), len(plant.y)
        pattern = np.full((nu, ny), self.direct) if self.pattern is None else self.pattern
        if pattern.shape != (nu, ny):
            raise ShapeError(
                f"pattern must have shape ({nu}, {ny}) of (u, y), got {pattern.shape}."
            )
        entries = _Entries(self.order, pattern, prepared, nests=self.start is None)
        known = self.start
        if known is None and self.order:
            # one start of many: without it the search begins at the structure's own
            with attempted("a start from the controller of full order, reduced to this one"):
                lower = self.order < plant.system.n_states
                full = design_hinf(plant, Riccati(back_off=_RELAXED) if lower else None).system
                if full.n_states > self.order:
                    full = balanced(full, order=self.order).system
                known = full if full.n_states == self.order else None
        if known is None:
            return entries
        if known.n_states != self.order or known.D.shape != (nu, ny):
            raise ModelError(
                f"start is {known!r}: pass {counted(self.order, 'state')}, {ny} y and {nu} u."
            )
        K = _continuous_matrices(known, plant.dt)
        entries.first = (K.joined / entries.scale)[entries.free]
        return entries


class _Entries(ControllerFamily):
    """Entries in units of the plant's speed and of its u and y; all zero but for decay, first."""

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
        super().__init__(self._scaled, rest[free], 1.0, self._fixed)
        self._jacobian = np.zeros((self.first.size, *free.shape))
        self._jacobian[np.arange(self.first.size), *np.nonzero(free)] = self.scale[free]

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
        k, rng = self.order, np.random.default_rng(self.order)
        kept = np.delete(np.delete(self.free, k - 1, axis=0), k - 1, axis=1)
        inner = np.zeros(kept.shape)
        inner[kept] = lower
        entries = np.insert(np.insert(inner, k - 1, 0.0, axis=0), k - 1, 0.0, axis=1)
        entries[k - 1, k:] = _COUPLING * rng.standard_normal(len(self.names[0]))
        entries[k:, k - 1] = _COUPLING * rng.standard_normal(len(self.names[1]))
        entries[k - 1, k - 1] = -1.0
        return np.asarray(entries[self.free])

    def _scaled(self, theta: FloatArray) -> Matrices:
        entries, k = np.zeros(self.scale.shape), self.order
        entries[self.free] = theta * self.scale[self.free]
        return Matrices(entries[:k, :k], entries[:k, k:], entries[k:, :k], entries[k:, k:])

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Return the derivatives, which are constant."""
        return self._jacobian

    def _fixed(self, theta: FloatArray) -> FixedOrder:
        return FixedOrder(
            self.order,
            None if self.order else self.pattern,
            as_system(self.matrices(theta), self.names, self.dt),
            bool(self.pattern.any()),
        )


def _continuous_matrices(g: StateSpace, dt: float) -> Matrices:
    """Return a controller in continuous time, a sampled one by Tustin's rule."""
    g = bilinear(g, 1.0 / dt) if dt and g.n_states else g
    return Matrices(g.A, g.B, g.C, g.D)


def as_system(K: Matrices, names: tuple[Sequence[str], Sequence[str]], dt: float) -> StateSpace:
    """Return a controller as a system, sampled by Tustin's rule where dt is not 0."""
    g = StateSpace(*K, inputs=names[0], outputs=names[1])
    return tustin(g, 1.0 / dt) if dt else g


@dataclass(frozen=True, eq=False, repr=False)
class ObserverGains(Value):
    """An observer of the plant's states with state feedback, whose gains L and F are free.

    The controller is ``dx/dt = A x + B2 u + L (C2 x + D22 u - y)`` with ``u = F x``. A, B2, C2 and
    D22 are the matrices of the weighted plant from u to y. The signs of L and F are opposite to
    those of the usual Kalman gain and LQR gain, so that the poles of the loop are those of A + L C2
    and A + B2 F. The search starts with the gains of LQG. For a sampled plant, the observer is that
    of its continuous equivalent by the bilinear transformation.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.ObserverGains()
    ObserverGains()
    """

    def family(self, plant: AnyPlant, prepared: Prepared) -> ControllerFamily:
        """Return the map from free parameters to the controllers of this structure.

        `design_structured` calls this method with the plant and its scaled matrices.
        """
        p, n, root = prepared, prepared.A.shape[0], np.sqrt(prepared.speed)
        first = -control_care(p.A, p.B2, Q=np.eye(n), R=np.eye(len(p.u))).gain
        gain = -filter_care(p.A, p.C2, Q=np.eye(n), R=np.eye(len(p.y))).gain

        def gains(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
            return theta[: first.size].reshape(-1, n), theta[first.size :].reshape(n, -1)

        def matrices(theta: FloatArray) -> Matrices:
            F, L = gains(theta)
            return Matrices(
                p.speed * (p.A + p.B2 @ F + L @ (p.C2 + p.D22 @ F)),
                -root * L @ p.y_scale,
                root * p.u_scale @ F,
                np.zeros((len(p.u), len(p.y))),
            )

        def slopes(theta: FloatArray) -> FloatArray:  # a gain moves one column, or one row
            F, L = gains(theta)
            into = np.vstack([p.speed * (p.B2 + L @ p.D22), root * p.u_scale])
            out = np.hstack([p.speed * (p.C2 + p.D22 @ F), -root * p.y_scale])
            by_F = np.einsum("ri,jc->ijrc", into, np.eye(n, out.shape[1]))
            by_L = np.einsum("ri,jc->ijrc", np.eye(len(into), n), out)
            return np.concatenate([by.reshape(-1, *by.shape[2:]) for by in (by_F, by_L)])

        start = np.concatenate([first.ravel(), gain.ravel()])
        return ControllerFamily(matrices, start, 0.1, lambda _: self, slopes=slopes)


class Parametrised:
    """A structure that you write as a function from parameters to a controller.

    Parameters
    ----------
    make : function
        Function that takes an (n,) array of parameters and returns a StateSpace from y to u. The
        controller has always the same order and the sampling of the plant, and depends smoothly on
        the parameters.
    start : (n,) array
        Parameters at which the search begins. Each parameter is scaled by the magnitude of its
        start value, or by 1 if this value is 0.
    spread : float
        Relative size of the random differences between the starts of the search.

    Examples
    --------
    >>> import flexplant as fx
    >>> def gain(p):
    ...     return fx.StateSpace([], [], [], [[p[0]]], inputs=["out:error"], outputs=["in"])
    >>> slow = fx.lti.low_pass_filter(0.1)
    >>> sys = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=slow, KS=0.1)
    >>> structure = fx.synthesis.Parametrised(gain, start=[1.0])
    >>> fx.synthesis.design_structured(sys, structure, starts=1).gamma < 1
    True
    """

    def __init__(
        self, make: Callable[[FloatArray], StateSpace], start: npt.ArrayLike, *, spread: float = 0.3
    ) -> None:
        function(make, "make", "Pass one of the parameters, which returns a StateSpace.")
        self.make, self.start = make, real_array(start, "start", (None,))
        self.spread = float(real_array(spread, "spread", ()))

    def __repr__(self) -> str:
        return f"Parametrised({counted(self.start.size, 'parameter')})"

    def family(self, plant: AnyPlant, prepared: Prepared) -> ControllerFamily:
        """Return the map from free parameters to the controllers of this structure.

        `design_structured` calls this method with the plant and its scaled matrices.
        """
        unit = np.where(self.start != 0, np.abs(self.start), 1.0)

        def matrices(theta: FloatArray) -> Matrices:
            made = instance(self.make(unit * theta), StateSpace, "what make returns", "Return one.")
            return _continuous_matrices(made.select(plant.u, plant.y), plant.dt)

        return ControllerFamily(matrices, self.start / unit, self.spread)


#: what an element may have free; the depth of a notch is not, unless it is named
_NUMBERS = ("p", "i", "d", "pole", "freq", "ratio", "width", "damping", "depth")
_FREE = tuple(name for name in _NUMBERS if name != "depth")
#: logarithm of the largest factor by which a number changes
_FARTHEST = 8.0
#: highest corner relative to half the rate; for a continuous plant relative to its fastest pole
_HIGHEST, _FASTER = 0.98, 10.0


@dataclass(frozen=True, eq=False, repr=False)
class TunedLaws(Value):
    """A decoupled controller ``u = -before diag(laws) after y`` whose parameters are optimised.

    The search starts with the given laws. It multiplies each free parameter (gain, corner
    frequency, centre of a notch) by a positive factor. Signs therefore do not change, and zeros
    stay zero. Corner frequencies are limited to half the sampling rate, or for a continuous plant
    to ten times its fastest pole. A corner frequency that is given above this limit is not
    increased.

    Parameters
    ----------
    laws : as for `design_loops`
    before, after : as for `design_loops`, optional
    free : sequence of str
        Names of the parameters that the search changes, among p, i, d, pole, freq, ratio, width,
        damping and depth; by default all except depth.

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

    def family(self, plant: AnyPlant, prepared: Prepared) -> ControllerFamily:
        """Return the map from free parameters to the controllers of this structure.

        `design_structured` calls this method with the plant and its scaled matrices.
        """
        axes = axes_of(plant, self.before, self.after, None, 0.0, True)
        laws = checked_laws(axes, self.laws)
        before = np.zeros((len(plant.u), len(axes.names)))
        before[[plant.u.index(name) for name in axes.before.outputs]] = axes.before.D
        after = np.zeros((len(axes.names), len(plant.y)))
        after[:, [plant.y.index(name) for name in axes.after.inputs]] = axes.after.D
        fastest = np.abs(plant.system.poles()).max(initial=0.0) / (2.0 * np.pi)
        highest = 0.5 * _HIGHEST * axes.rate if axes.rate else _FASTER * float(fastest)
        highest = max([highest, *(corner for law in laws.values() for corner in _corners(law))])
        each = [_FreeLaw(law, _free(law, self.free)) for law in laws.values()]
        ends = np.cumsum([len(one.numbers) for one in each])
        if not ends[-1]:
            raise ModelError(f"no number of the laws is free: name some of {_NUMBERS} in free=.")

        @lru_cache(maxsize=2 * len(each))  # differences by a number change one law alone
        def part(i: int, own: tuple[float, ...]) -> tuple[Law, LawMatrices]:
            law = each[i].at(own)
            rate = axes.rate if law.prewarped else 0.0
            sections = [factor.section.at(rate).matrices for factor in law.factors]
            return law, chained(law.gain, sections)

        def found(theta: FloatArray) -> list[tuple[Law, LawMatrices]]:
            split = np.split(theta, ends[:-1])
            return [part(i, tuple(own.tolist())) for i, own in enumerate(split)]

        def matrices(theta: FloatArray) -> Matrices:
            return Matrices(*decoupled((K for _, K in found(theta)), before, after))

        def allows(theta: FloatArray) -> bool:
            return all(corner <= highest for law, _ in found(theta) for corner in _corners(law))

        def structure(theta: FloatArray) -> TunedLaws:
            return self.replace(laws=dict(zip(laws, (law for law, _ in found(theta)), strict=True)))

        return ControllerFamily(matrices, np.zeros(ends[-1]), 0.3, structure, allows)


class _FreeLaw(NamedTuple):
    """A law, and its free numbers: of which factor (-1: the gain of the law), and its field."""

    law: Law
    numbers: list[tuple[int, str]]

    def at(self, theta: tuple[float, ...]) -> Law:
        """Return the law, continuous where its blocks are, with its numbers times exp(theta)."""
        gain, factors = self.law.gain, list(self.law.factors)
        growth = np.exp(np.clip(theta, -_FARTHEST, _FARTHEST)).tolist()
        for (i, name), times in zip(self.numbers, growth, strict=True):
            if i < 0:
                gain *= times
            else:
                factors[i] = _with(factors[i], {name: getattr(factors[i], name) * times})
        rate = max((factor.own_rate for factor in factors), default=0.0)
        return self.law.replace(factors=tuple(factors), gain=gain, rate=rate)


def _corners(law: Law) -> list[float]:
    """Return the corners [Hz] of a law."""
    given = (getattr(one, name, None) for one in law.factors for name in ("pole", "freq"))
    return [float(one) for one in given if one is not None]


def _with(element: SingleElement, numbers: Mapping[str, float]) -> Any:
    """Return an element with other positive numbers, which need no check."""
    return rebuild(type(element), dict(element._fields()) | dict(numbers))


def _free(law: Law, names: Sequence[str]) -> list[tuple[int, str]]:
    """Return the free numbers of a law; its gain only where no Pid has one."""
    found = [
        (i, field.name)
        for i, factor in enumerate(law.factors)
        for field in fields(factor)  # type: ignore[arg-type]
        if field.name in names and getattr(factor, field.name)
    ]
    gains = any(name in "pid" for _, name in found)
    return found if gains or "p" not in names else [(-1, "gain"), *found]
