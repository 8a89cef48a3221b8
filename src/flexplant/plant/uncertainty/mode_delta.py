"""Deltas on the frequency and the damping of a mode."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from ...arrays import FloatArray, real_array
from ...errors import ModelError, require_known, unknown_label
from ...tolerances import ROUNDING, SAME, TINY
from ...updating.matrix_parameters import MatrixParameter
from ..partitioned import Partition
from ..realisation import MODAL, ModalRealisation
from ..remade import MachineParts
from .channels import DeltaChannel, Opened, system_matrix, with_each
from .delta import Delta, with_changes
from .parameter_amounts import ParameterDelta

#: relative change at which the plant's dependence on a Delta is read off
_READ_OFF = 0.25


def modal_realisation(plant: Partition) -> ModalRealisation:
    """Return the modes of a plant, each of which has its own frequency and damping."""
    realisation = plant.assembled.realisation
    if plant.form != MODAL:
        raise ModelError(
            f"the modes of this plant are coupled by damping ({plant.form}): frequency and "
            "damping of one mode are not its own, so that no Delta belongs to it. Deltas on the "
            "parameters of a fit do: plant.uncertain(fit)."
        )
    return realisation


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

    @classmethod
    def of(cls, mode: int, scale: float) -> Self:
        """Return the Delta of a mode by its number."""
        return cls(f"mode{mode}:{cls.kind}", scale, mode)

    def row(self, pair: FloatArray) -> FloatArray:
        """Return what is taken from the second row (2,) of a mode's block per amount."""
        raise NotImplementedError

    def acts(self, realisation: ModalRealisation) -> bool:
        """Return whether a mode has what is uncertain."""
        return bool(np.any(self.row(realisation.pairs[self.mode - 1])))

    def changed(self, machine: MachineParts, amount: float) -> MachineParts:
        """Return a machine with one mode changed."""
        if machine.plant.form != MODAL:
            modal_realisation(machine.plant)
        if not amount > -1:
            raise ModelError(
                f"{self.name} = {amount / self.scale:.4g} leaves mode {self.mode} with negative "
                f"{self.what}."
            )
        pairs = np.array(machine.pairs)
        pairs[self.mode - 1, 1] -= amount * self.row(machine.pairs[self.mode - 1])
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
        size = self._share(realisation.pairs[self.mode - 1])
        change: dict[str, Any] = {self._part: size * np.outer(push, push)}
        parameter = MatrixParameter(self.name, **change)
        return ParameterDelta(self.name, self.scale, self.mode, parameter=parameter)

    _part: ClassVar[str] = ""

    def _share(self, pair: FloatArray) -> float:
        raise NotImplementedError

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
    _part: ClassVar[str] = "dK"

    def row(self, pair: FloatArray) -> FloatArray:
        """Return what is taken from the second row of a mode's block per amount."""
        return np.array([np.linalg.det(pair) / pair[0, 1], 0.0])

    def _share(self, pair: FloatArray) -> float:
        return float(np.linalg.det(pair))

    @property
    def text(self) -> str:
        """Name and amount of the frequency at delta = 1."""
        return f"{self.name} +- {50 * self.scale:.3g} %"


@dataclass(frozen=True, eq=False)
class DampingDelta(ModeDelta):
    """The damping of a mode, ``2 zeta omega (1 + scale delta)``."""

    kind: ClassVar[str] = "damping"
    what: ClassVar[str] = "damping"
    _part: ClassVar[str] = "dD"

    def row(self, pair: FloatArray) -> FloatArray:
        """Return what is taken from the second row of a mode's block per amount."""
        return np.asarray(-np.trace(pair) * np.array([pair[0, 0] / pair[0, 1], 1.0]))

    def _share(self, pair: FloatArray) -> float:
        return -float(np.trace(pair))

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
    realisation, name = modal_realisation(plant), f"{kind.what} of a mode"
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


def changed_pairs(
    realisation: ModalRealisation, changes: Sequence[tuple[Delta, float]]
) -> FloatArray:
    """Return the blocks (b, 2, 2) of modes with stiffness or damping of some changed."""
    pairs = np.array(realisation.pairs)
    for delta, amount in changes:
        if isinstance(delta, ModeDelta):
            pairs[delta.mode - 1, 1] -= amount * delta.row(realisation.pairs[delta.mode - 1])
    return pairs


def _channels(plant: Partition, delta: Delta, base: FloatArray) -> list[DeltaChannel]:
    """Return the channel of a mode's stiffness or damping, two where accelerations need it."""
    # a mode's A is affine in its Deltas, `A0 + sum_j delta_j l_j R_j`, and so are displacements and
    # velocities. An acceleration `S A (A x + N' f)` holds products of them where the damping of a
    # mode is not proportional. With the rate `x'` of the states, which a first copy of the Deltas
    # drives, it is `S A0 x' + sum_j (S l_j) delta_j R_j x'`: a second copy of each Delta that reads
    # `R_j x'` makes it exact. The columns are read off the plant assembled with one mode changed,
    # so that they hold for any port
    n = plant.system.n_states
    changed = system_matrix(with_changes(plant, [(delta, _READ_OFF)]).system)
    change = (changed - base) / _READ_OFF
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
