"""Frequencies and dampings of modes that are known within shares: Deltas and drawn machines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np

from ...arrays import FloatArray, real_array
from ...errors import ModelError, require_known, unknown_label
from ...tolerances import ROUNDING, SAME, TINY
from ...updating.matrix_parameters import MatrixParameter
from ..machine_draws import DrawnModes, ModeSpace, small_exponential, symmetric_draw
from ..machine_plants import MachineParts
from ..partitioned import Partition
from ..realisation import ModalRealisation, changed_pairs
from .channels import DeltaChannel, Opened, system_matrix, with_each
from .delta import Delta, Uncertainty, with_changes
from .parameter_amounts import ParameterDelta


def require_elastic(realisation: ModalRealisation, modes: Iterable[int]) -> None:
    """Raise LabelError unless all numbers are those of elastic modes."""
    for number in modes:
        if number not in realisation.elastic:
            known = map(str, realisation.elastic)
            raise unknown_label("elastic mode of the plant", number, known)


@dataclass(frozen=True, eq=False)
class ModeDelta(Delta):
    """A Delta on one of the two numbers of a mode: its second row of A changes, whatever its form.

    ``q'' + 2 zeta omega (1 + b d_b) q' + omega^2 (1 + a d_a) q = f``.
    """

    what: ClassVar[str] = ""
    of_modes: ClassVar[bool] = True

    @classmethod
    def of(cls, mode: int, scale: float) -> Self:
        """Return the Delta of a mode by its number."""
        return cls(f"mode{mode}:{cls.kind}", scale, mode)

    def pair(self, pairs: FloatArray, amount: float) -> FloatArray:
        """Return the block (2, 2) of the mode with what is uncertain changed."""
        stiffness, damping = (amount * (self.what == name) for name in ("stiffness", "damping"))
        found: FloatArray = changed_pairs(pairs[self.mode - 1, None], stiffness, damping)[0]
        return found

    def acts(self, realisation: ModalRealisation) -> bool:
        """Return whether a mode has what is uncertain."""
        pairs = realisation.pairs
        return not np.array_equal(self.pair(pairs, 1.0), pairs[self.mode - 1])

    def changed(self, machine: MachineParts, amount: float) -> MachineParts:
        """Return a machine with one mode changed."""
        _ = machine.plant.assembled.realisation.uncoupled
        if not amount > -1:
            raise ModelError(
                f"{self.name} = {amount / self.scale:.4g} leaves mode {self.mode} with negative "
                f"{self.what}."
            )
        pairs = np.array(machine.pairs)
        pairs[self.mode - 1] = self.pair(machine.pairs, amount)
        return machine.replace(pairs=pairs)

    def require_in_range(self, deviations: float) -> None:
        """Refuse negative stiffness and damping."""
        if self.scale >= 1:
            raise ModelError(
                f"the {self.what} of mode {self.mode} is uncertain by {100 * self.scale:.3g} % at "
                f"{deviations:g} standard deviations, so it may be negative: no controller is "
                "robust to that. Measure it better, leave the mode out, or lower deviations."
            )

    def of_matrices(self, plant: Partition) -> ParameterDelta:
        """Return the same Delta as a change of K by omega^2 (M phi)(M phi)', or of D."""
        realisation = plant.assembled.realisation
        push = np.asarray(plant.model.M @ realisation.inputs[:, 2 * self.mode - 1])
        pair, force = realisation.pairs[self.mode - 1], np.outer(push, push)
        stiff = self.what == "stiffness"
        change = {"dK": np.linalg.det(pair) * force} if stiff else {"dD": -np.trace(pair) * force}
        parameter = MatrixParameter(self.name, **change)
        return ParameterDelta(self.name, self.scale, self.mode, parameter=parameter)

    @classmethod
    def opened(cls, plant: Partition, opened: Opened, deltas: Sequence[Delta]) -> Opened:
        """Return a system with the channels of modes, exact for all ports."""
        matrix = system_matrix(plant.system)
        found = [(one.name, one.scale, _channels(plant, one, matrix)) for one in deltas]
        return with_each(opened, found)


@dataclass(frozen=True, eq=False)
class FrequencyDelta(ModeDelta):
    """The stiffness of a mode, ``omega^2 (1 + scale delta)``."""

    kind: ClassVar[str] = "freq"
    what: ClassVar[str] = "stiffness"

    @property
    def text(self) -> str:
        """Name and amount of the frequency at delta = 1."""
        return f"{self.name} +- {50 * self.scale:.3g} %"


@dataclass(frozen=True, eq=False)
class DampingDelta(ModeDelta):
    """The damping of a mode, ``2 zeta omega (1 + scale delta)``."""

    kind: ClassVar[str] = "damping"
    what: ClassVar[str] = "damping"

    def amount(self, drawn: float) -> float:
        """Return the amount of a number drawn: of the logarithm, so that damping stays positive."""
        return float(np.expm1(self.scale * drawn))


def stated_by_mode(
    kind: type[ModeDelta],
    plant: Partition,
    given: Any,
    modes: Sequence[int] | None,
    factor: float = 1.0,
) -> list[ModeDelta]:
    """Return Deltas of stated fractions: one for all modes, an array, or {mode: fraction}."""
    realisation, name = plant.assembled.realisation.uncoupled, f"{kind.what} of a mode"
    # modes of negative stiffness (magnets) have no frequency; they are uncertain by name only
    swing = [n for n in realisation.elastic if np.linalg.det(realisation.pairs[n - 1]) > 0]
    if isinstance(given, Mapping):
        chosen = list(given) if modes is None else list(modes)
        require_known("uncertain mode", map(str, given), map(str, {*chosen, *given}))
        given = [given.get(number, 0.0) for number in chosen]
    else:
        chosen = swing if modes is None else list(modes)
    require_elastic(realisation, chosen)
    values = real_array(given, name)
    values = np.full(len(chosen), values) if not values.ndim else values
    values = real_array(values, name, (len(chosen),))
    if np.any(values < 0):
        raise ModelError(
            f"the {name} is uncertain by a share of it, 0 or more, got {values.min()}."
        )
    every = [kind.of(n, factor * float(x)) for n, x in zip(chosen, values, strict=True)]
    return [one for one in every if one.scale > ROUNDING and one.acts(realisation)]


def _channels(plant: Partition, delta: Delta, base: FloatArray) -> list[DeltaChannel]:
    """Return the channel of a mode's stiffness or damping, two where accelerations need it."""
    # a mode's A is affine in its Deltas, `A0 + sum_j delta_j l_j R_j`, and so are displacements and
    # velocities. An acceleration `S A (A x + N' f)` holds products of them where the damping of a
    # mode is not proportional. With the rate `x'` of the states, which a first copy of the Deltas
    # drives, it is `S A0 x' + sum_j (S l_j) delta_j R_j x'`: a second copy of each Delta that reads
    # `R_j x'` makes it exact. The columns are read off the plant assembled with one mode changed,
    # so that they hold for any port
    n = plant.system.n_states
    changed = system_matrix(with_changes(plant, [(delta, 1.0)]).system)
    change = changed - base
    # of a mode's block the second row changes
    R = change[int(plant.modal_states[2 * delta.mode - 1])]
    R = R / np.linalg.norm(R)
    rate = R[:n] @ changed[:n]
    rate_size = float(np.linalg.norm(rate))
    seen = np.linalg.lstsq(np.array([R, rate / rate_size]).T, change.T, rcond=None)[0]
    plain = np.abs(seen[1]) <= SAME * np.linalg.norm(change, axis=1)
    left = np.where(plain, change @ R, seen[0])
    again = np.where(plain, 0.0, seen[1] / rate_size)
    even = np.sqrt(max(float(np.abs(left[:n]).max()), TINY))
    first = DeltaChannel(left / even, even * R)
    if not np.any(again):
        return [first]
    return [first, DeltaChannel(again / even, even * R, ":rate", even * R[:n])]


@dataclass(frozen=True, eq=False, repr=False)
class Frequencies(Uncertainty):
    """Uncertain frequencies of modes: the relative error of each; its Delta changes omega^2.

    Parameters
    ----------
    share : float, (m,) array or {mode: float}
        Relative error of the frequencies at delta = 1: one number for all modes, one for each of
        `modes`, or a mapping by mode. For modes that were not measured, updated models seldom have
        errors below 0.005.
    modes : sequence of int, optional
        Numbers of the modes, counted from 1 with the rigid-body modes included. By default all
        elastic modes are uncertain.

    Raises
    ------
    LabelError, ModelError, ShapeError
        When a plant lacks a mode, its modes are coupled by damping, or a share is negative.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.testbeds.three_masses().uncertain(fx.plant.Frequencies({2: 0.005}))
    <UncertainPlant: 1 real Delta at 2 std
      mode2:freq +- 0.5 %>
    """

    share: Any
    modes: Sequence[int] | None = field(default=None, kw_only=True)

    def deltas(self, plant: Partition) -> Sequence[Delta]:
        """Return a Delta for the stiffness of each mode."""
        # stiffness is omega^2
        return stated_by_mode(FrequencyDelta, plant, self.share, self.modes, 2.0)


@dataclass(frozen=True, eq=False)
class Dampings(Uncertainty):
    """Uncertain damping of modes: the relative error of 2 zeta omega of each mode.

    Parameters
    ----------
    share : float, (m,) array or {mode: float}
        Relative error of the damping at delta = 1: one number for all modes, one for each of
        `modes`, or a mapping by mode.
    modes : sequence of int, optional
        Numbers of the modes, counted from 1 with the rigid-body modes included. By default all
        elastic modes are uncertain.

    Raises
    ------
    LabelError, ModelError, ShapeError
        When a plant lacks a mode, its modes are coupled by damping, or a share is not between 0
        and 1.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.testbeds.three_masses().uncertain(fx.plant.Dampings({2: 0.3}))
    <UncertainPlant: 1 real Delta at 2 std
      mode2:damping +- 30 %>
    """

    share: Any
    modes: Sequence[int] | None = field(default=None, kw_only=True)

    def deltas(self, plant: Partition) -> Sequence[Delta]:
        """Return a Delta for the damping of each mode."""
        return stated_by_mode(DampingDelta, plant, self.share, self.modes)


class StatedFamily:
    """Machines whose modes are off by stated Deltas: frequencies, shapes with them, and dampings.

    ``K' = Omega exp(E) Omega``, E symmetric with the drawn relative changes of stiffness on its
    diagonal and deviations ``sqrt(2 s_i s_j)`` off it, s the deviations of the frequencies. A
    mode that the plant leaves out is known as well as the mode that is known least.
    """

    def __init__(self, whole: ModalRealisation, uncertain: Any) -> None:
        self.space = ModeSpace(whole)
        std = np.sqrt(np.diag(uncertain.covariance))
        self.scatter: dict[type[ModeDelta], FloatArray] = {}
        for kind in (FrequencyDelta, DampingDelta):
            known = {
                delta.mode - 1: delta.scale * x
                for delta, x in zip(uncertain.deltas, std, strict=True)
                if isinstance(delta, kind)
            }
            size = np.zeros(whole.pairs.shape[0])
            size[uncertain.plant.realisation.n_modes :] = max(known.values(), default=0.0)
            size[list(known)] = list(known.values())
            self.scatter[kind] = size

    def machine(self, rng: np.random.Generator, drawn: Sequence[tuple[Delta, float]]) -> DrawnModes:
        """Return the modes of one machine at drawn values of the Deltas."""
        logs = {kind: size * rng.standard_normal(size.size) for kind, size in self.scatter.items()}
        for delta, x in drawn:
            logs[type(delta)][delta.mode - 1] = delta.scale * x  # type: ignore[index]
        space, (stiffer, damped) = self.space, logs.values()
        root = np.sqrt(0.5 * self.scatter[FrequencyDelta][space.own])
        E = root[:, None] * symmetric_draw(rng, root.size) * root
        np.fill_diagonal(E, stiffer[space.own])
        K = space.omega[:, None] * small_exponential(E) * space.omega
        mixed = space.mixed(np.eye(root.size), 0.5 * (K + K.T))
        if mixed is None:
            raise ModelError("what is stated of the frequencies leaves no stiffness.")
        omega, V = mixed
        # the damping force of a mode stays where its stiffness changes
        force = space.zeta * space.omega * np.exp(damped[space.own])
        if force.size:
            force = force[np.argmax(np.abs(V), axis=0)]
        zeta = np.divide(force, omega, out=np.zeros_like(omega), where=omega > 0.0)
        rest = space.rest
        pairs = changed_pairs(
            space.whole.pairs[rest], np.expm1(stiffer[rest]), np.expm1(damped[rest])
        )
        return space.realisation(omega, zeta, V, pairs)
