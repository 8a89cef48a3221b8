"""Machines drawn from what is not known of a plant and of its evaluation model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from ..arrays import FloatArray, IntArray
from ..errors import LabelError
from ..labels import DofSet, Place
from ..tolerances import SAME
from .realisation import ModalRealisation, Structure, natural
from .remade import rebuilt
from .standard import StandardPlant
from .uncertainty.delta import Delta
from .uncertainty.mode_delta import DampingDelta, FrequencyDelta, changed_pairs, modal_realisation
from .uncertainty.uncertain_plants import UncertainPlant

#: std of the logarithm of the damping of a mode that was not measured (one structure's modes
#: scatter by 20 to 40 %)
_DAMPING = 0.3
#: a frequency that is not known to so many half-widths of its resonance was not measured
_MEASURED = 2.0
#: modes of the plant further off in the larger model, relative, are others: the last ones of a
#: reduced model stand for compliance
_SAME = 0.05


def draws_with_left_out(
    uncertain: UncertainPlant[StandardPlant],
    whole: StandardPlant,
    rng: np.random.Generator,
    count: int,
    *,
    shapes: float = 0.0,
) -> Iterator[StandardPlant] | None:
    """Return machines of a larger plant, drawn one by one; None where no Delta is of its modes."""
    # the plant's own modes are off as its Deltas say, normally with 1 at some deviations. Nothing
    # is measured of the modes left out: each frequency is off like that of the plant's least known.
    # The logarithm of the damping of a mode that was not measured is off by 0.3: a loop may live on
    # it
    unknown = _Unmeasured.of(uncertain, whole)
    if unknown is None:
        return None
    seen = _at_ports(whole) if shapes else modal_realisation(whole)
    deltas, covariance = list(uncertain.deltas), uncertain.covariance
    deviation = np.sqrt(np.diag(covariance))
    root = np.linalg.cholesky(
        # regular, where one repeats others
        covariance / np.outer(deviation, deviation) + 1e-9 * np.eye(deviation.size)
    )

    def one(own_rng: np.random.Generator) -> StandardPlant:
        amounts = np.concatenate([
            deviation * (root @ own_rng.standard_normal(deviation.size)),
            own_rng.standard_normal(len(unknown.frequencies)) / uncertain.deviations,
        ])  # fmt: skip
        (apart,) = own_rng.spawn(1)
        scattered = np.exp(_DAMPING * apart.standard_normal(len(unknown.modes)))
        every = [*deltas, *unknown.frequencies]
        changes = [(d, float(max(d.scale * x, -0.9))) for d, x in zip(every, amounts, strict=True)]
        modes = _changed_modes(seen, [*changes, *unknown.damped(scattered)])
        return rebuilt(whole, realisation=_mixed(modes, own_rng, shapes) if shapes else modes)

    return (one(each) for each in rng.spawn(count))


def _changed_modes(
    realisation: ModalRealisation, changes: Sequence[tuple[Delta, float]]
) -> ModalRealisation:
    return realisation.replace(pairs=changed_pairs(realisation, changes))


@dataclass(frozen=True)
class _SomeCoordinates:
    """A structure of which only those coordinates are held that its ports see or push."""

    model: Structure
    kept: IntArray

    @property
    def full_dofs(self) -> DofSet:
        return self.model.full_dofs

    def row(self, at: Place, direction: str = "z") -> FloatArray:
        row = self.model.row(at, direction)
        if np.count_nonzero(row) > np.count_nonzero(row[self.kept]):
            raise LabelError(
                f"no port is at {at!r}, so that this machine does not hold its motion."
            )
        return row[self.kept]

    def rows(self, points: FloatArray, direction: str = "z") -> FloatArray:
        return np.array([self.row(point, direction) for point in points])

    def rigid_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        return self.model.rigid_motions(about)[self.kept]

    def missed_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        return self.model.missed_motions(about)

    def inertia(self, motions: FloatArray) -> FloatArray:
        whole = np.zeros((self.model.rigid_motions().shape[0], motions.shape[1]))
        whole[self.kept] = motions
        return self.model.inertia(whole)[self.kept]


def _at_ports(plant: StandardPlant) -> ModalRealisation:
    """Return the modes of a plant over the coordinates that its ports see or push."""
    realisation, ports = modal_realisation(plant), plant.assembled.ports
    rows = [poi.row(realisation, axis) for poi in ports.z for axis in poi.axes]
    rows += [sensor.row(realisation) for sensor in ports.y]
    rows += [force.push(realisation) for force in ports.forces]
    kept = np.flatnonzero(np.any(rows, axis=0))
    arrays = ("inputs", "outputs", "static_inputs", "static_outputs")
    return realisation.replace(
        model=_SomeCoordinates(realisation.model, kept),
        **{name: getattr(realisation, name)[kept] for name in arrays},
    )


def damped_less(
    uncertain: UncertainPlant[StandardPlant], whole: StandardPlant
) -> tuple[StandardPlant, dict[int, float]] | None:
    """Return a larger plant whose unmeasured modes have less damping, 0.55 times (two deviations).

    And by what share the frequency of each may be off with it: of the plant's own half of what is
    known, one deviation. None as for `draws_with_left_out`.
    """
    unknown = _Unmeasured.of(uncertain, whole)
    if unknown is None:
        return None
    lower = unknown.damped(np.full(len(unknown.modes), np.exp(-2.0 * _DAMPING)))
    ranges = {delta.mode: 0.5 * delta.scale for delta in unknown.frequencies}
    given = uncertain.frequencies.items()
    own = {mode: 0.5 * share for mode, share in given if mode in unknown.modes}
    modes = _changed_modes(modal_realisation(whole), lower)
    return rebuilt(whole, realisation=modes), ranges | own


@dataclass(frozen=True)
class _Unmeasured:
    """Modes of a larger plant that were not measured, and the frequencies of those left out."""

    modes: tuple[int, ...]
    frequencies: tuple[Delta, ...]

    @classmethod
    def of(cls, uncertain: UncertainPlant[StandardPlant], whole: StandardPlant) -> Self | None:
        """Return them; None where a Delta is of something else than modes."""
        if not uncertain.is_modal or not whole.has_own_modes:
            return None
        realisation, ranges = modal_realisation(whole), uncertain.frequencies
        omega, zeta = natural(realisation.pairs)
        own, _ = natural(modal_realisation(uncertain.plant).pairs)
        least = max(ranges.values(), default=0.0)
        rigid, n = realisation.n_rigid, min(own.size, omega.size)
        same = np.abs(own[:n] - omega[:n]) <= _SAME * omega[:n]
        left = [
            i + 1
            for i in range(rigid, realisation.n_modes)
            if least and i + 1 not in ranges and not (i < n and same[i])
        ]
        wide = [mode for mode, r in ranges.items() if r > _MEASURED * (1.0 + SAME) * zeta[mode - 1]]
        known = {one.mode for one in uncertain.deltas if isinstance(one, DampingDelta)}
        modes = tuple(mode for mode in sorted({*left, *wide} - known) if zeta[mode - 1] < 1.0)
        return cls(modes, tuple(FrequencyDelta.of(mode, 2.0 * least) for mode in left))

    def damped(self, factors: FloatArray) -> list[tuple[Delta, float]]:
        """Return the changes by which the damping of each is a multiple of what it was."""
        return [
            (DampingDelta.of(mode, 1.0), float(factor - 1.0))
            for mode, factor in zip(self.modes, factors, strict=True)
        ]


def _mixed(
    realisation: ModalRealisation, rng: np.random.Generator, size: float
) -> ModalRealisation:
    r"""Return a realisation whose elastic shapes hold a little of all others.

    What a model lacks of mass and stiffness moves shapes, to first order, by

    .. math:: \delta\phi_i = \sum_j \frac{\omega_i \max(\omega_i, \omega_j)}
        {\omega_i^2 - \omega_j^2} E_{ij} \phi_j

    with E_ij as large as the relative errors of omega^2 that it causes.
    """
    n, r = realisation.pairs.shape[0], realisation.n_rigid
    real = ~np.any(realisation.inputs[:, ::2], axis=0)
    omega, _ = natural(realisation.pairs)
    omega[:r] = 0.0
    E = np.triu(size * rng.standard_normal((n, n)), 1)
    E = E + E.T
    gap = omega[:, None] ** 2 - omega**2
    gap[gap == 0] = np.inf  # of rigid-body motions, and each mode of itself
    part = E * omega[:, None] * np.maximum(omega[:, None], omega) / gap
    part /= np.sqrt(1.0 + part**2)  # near each other modes turn, and mix no further
    part[:r] = 0.0
    part[:, ~real], part[~real] = 0.0, 0.0
    inputs, outputs = np.array(realisation.inputs), np.array(realisation.outputs)
    s: FloatArray = realisation.pairs[:, 0, 1]
    phi = inputs[:, 1::2].copy()
    changed = phi + phi @ part.T
    inputs[:, 1::2] = changed
    outputs[:, ::2] += (changed - phi) / s
    return realisation.replace(inputs=inputs, outputs=outputs)
