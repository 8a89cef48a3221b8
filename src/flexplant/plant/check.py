"""Which standard assumptions a plant meets, in physical words, rigid-body modes first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from ..errors import AssumptionError
from ..labels import DIRECTIONS
from ..structure.rigid import rigid_motions
from ..values import ComplexArray, FloatArray, Value
from .standard import StandardPlant

#: a rigid-body motion weaker than this beside the strongest one counts as absent
_WEAK = 1e-8


@dataclass(frozen=True, eq=False)
class Assumption(Value):
    """One assumption: its key, whether it holds, what was found and what to change if not.

    Parameters
    ----------
    key : str
        `excited` (w reaches), `detectable` (y sees), `performance` (z sees), `stabilisable`
        (u reaches), `D12` or `D21` (full rank).
    holds : bool
        Whether it does.
    finding : str
        In physical words.
    remedy : str
        What to change; empty when it holds.
    """

    key: str
    holds: bool
    finding: str
    remedy: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class AssumptionReport(Value):
    """The standard assumptions of a plant.

    Parameters
    ----------
    assumptions : sequence of Assumption
        In the order in which they matter.
    """

    assumptions: tuple[Assumption, ...]

    @property
    def ok(self) -> bool:
        """Whether all hold."""
        return all(item.holds for item in self.assumptions)

    def __getitem__(self, key: str) -> Assumption:
        return next(item for item in self.assumptions if item.key == key)

    def __repr__(self) -> str:
        lines = [f"<AssumptionReport: {'all hold' if self.ok else 'NOT all hold'}>"]
        for item in self.assumptions:
            remedy = f" {item.remedy}" if item.remedy else ""
            lines.append(f"  {'yes' if item.holds else 'NO '} {item.key}: {item.finding}{remedy}")
        return "\n".join(lines)

    def require(self, keys: tuple[str, ...], purpose: str) -> None:
        """Raise AssumptionError unless the assumptions of these keys hold.

        Parameters
        ----------
        keys : sequence of str
            What the design needs.
        purpose : str
            What it is needed for, for the message.
        """
        failed = [item for item in self.assumptions if item.key in keys and not item.holds]
        if failed:
            raise AssumptionError(
                f"{purpose} is not possible: "
                + " ".join(f"{item.finding} {item.remedy}" for item in failed)
            )


def report(plant: StandardPlant) -> AssumptionReport:
    """Return the assumption report of a plant."""
    bare = plant.unweighted or plant
    found = _rigid_body(bare) if bare.n_rigid else []
    found += _marginal_modes(bare) if bare.realisation is None else []
    found += _ranks(plant)
    return AssumptionReport(tuple(found))


def _rigid_body(plant: StandardPlant) -> list[Assumption]:
    """Reach and sight of the rigid-body modes: all share the eigenvalue 0, so ranks decide."""
    system = (plant.continuous or plant).system
    positions, velocities = (np.arange(plant.n_rigid) * 2 + i for i in (0, 1))
    noisy = [name for name in plant.w if plant.asd.get(name, 0.0) > 0]
    pushing = [n for n in (noisy or plant.w) if np.any(system.B[:, system.input_index([n])])]
    seeing = [n for n in plant.y if np.any(system.C[system.output_index([n])][:, positions])]
    z = [n for n in plant.z if np.any(system.C[system.output_index([n])][:, positions])]
    cases = [
        (
            "excited",
            "w does not excite",
            pushing,
            True,
            "Add a disturbance (with an asd) that does.",
        ),
        ("detectable", "y does not see", seeing, False, "Add or move a displacement sensor."),
        ("performance", "z does not see", z, False, "Add an axis to a POI, or another POI."),
        ("stabilisable", "u does not reach", list(plant.u), True, "Add or move an actuator."),
    ]
    found = []
    for key, verb, names, forces, remedy in cases:
        if forces:
            matrix = system.B[np.ix_(velocities, system.input_index(names))]
        else:
            matrix = system.C[np.ix_(system.output_index(names), positions)].T
        missing = _missing(matrix)
        if missing.shape[1]:
            motions = " and ".join(_described(plant, column) for column in missing.T)
            text = f"{verb} the rigid-body {motions} (channels: {', '.join(names) or 'none'})."
            found.append(Assumption(key, False, text, remedy))
        else:
            text = f"all {plant.n_rigid} rigid-body modes, by {len(names)} channels."
            found.append(Assumption(key, True, text))
    return found


def _missing(matrix: FloatArray) -> FloatArray:
    """Return the rigid-body combinations (r, missing) that no channel has part in."""
    sizes = np.linalg.norm(matrix, axis=0)
    scaled = matrix[:, sizes > 0] / sizes[sizes > 0]
    if not scaled.size:
        return np.eye(matrix.shape[0])
    U, s, _ = la.svd(scaled, full_matrices=True)
    return np.asarray(U[:, np.count_nonzero(s > _WEAK * s[0]) :])


def _described(plant: StandardPlant, combination: FloatArray) -> str:
    """Return a rigid-body combination in words: `translation z`, `rotation rx`."""
    realisation = plant.realisation
    if realisation is None:
        return "motion"
    dofs = realisation.model.dofs
    shape = realisation.outputs[:, 0 : 2 * plant.n_rigid : 2] @ combination
    motions = rigid_motions(dofs.replace(xyz=dofs.xyz - dofs.xyz.mean(axis=0)))
    part = np.linalg.lstsq(motions, shape, rcond=None)[0] * np.linalg.norm(motions, axis=0)
    size = np.abs(part) / max(float(np.abs(part).max()), 1e-300)
    kinds = {True: "rotation", False: "translation"}
    return " + ".join(
        f"{kinds[name.startswith('r')]} {name}"
        for name, share in zip(DIRECTIONS, size, strict=True)
        if share > 0.05
    )


def _marginal_modes(plant: StandardPlant) -> list[Assumption]:
    """Hautus tests of every pole that is not strictly stable, for plants made elsewhere."""
    system = plant.system
    poles = system.poles()
    margin = np.abs(poles) - 1 if plant.dt else poles.real / np.maximum(np.abs(poles), 1.0)
    critical = poles[margin > -1e-9]
    B2, C2 = plant.B2, plant.C2
    unreached = [p for p in critical if _hautus(system.A, B2, p) < _WEAK]
    unseen = [p for p in critical if _hautus(system.A.T, C2.T, p) < _WEAK]
    found = []
    for key, bad, verb, remedy in (
        ("stabilisable", unreached, "u does not reach", "Add or move an actuator."),
        ("detectable", unseen, "y does not see", "Add or move a sensor."),
    ):
        if bad:
            text = f"{verb} the pole {bad[0]:.4g}, which is not stable."
            found.append(Assumption(key, False, text, remedy))
        else:
            found.append(Assumption(key, True, f"all {critical.size} poles that are not stable."))
    return found


def _hautus(A: FloatArray, B: FloatArray, pole: complex) -> float:
    """Return the relative smallest singular value of [A - pole I, B], B scaled like A."""
    size = max(float(np.linalg.norm(A, 2)), abs(pole), 1e-300)
    reach = B / max(float(np.linalg.norm(B, 2)), 1e-300)
    pencil: ComplexArray = np.hstack([(A - pole * np.eye(A.shape[0])) / size, reach])
    return float(la.svdvals(pencil)[-1])


def _ranks(plant: StandardPlant) -> list[Assumption]:
    """D12 and D21 of full rank, each row and column scaled to unit size."""
    found = []
    for key, matrix, names, text, remedy in (
        ("D12", plant.D12, plant.u, "costs nothing in z", "Keep its effort in z."),
        ("D21", plant.D21.T, plant.y, "is free of noise in w", "Give the sensor an asd."),
    ):
        sizes = np.linalg.norm(matrix, axis=0)
        free = [name for name, size in zip(names, sizes, strict=True) if not size]
        scaled = matrix / np.where(sizes > 0, sizes, 1.0)
        rank = int(np.linalg.matrix_rank(scaled, tol=1e-9)) if scaled.size else 0
        if free:
            found.append(Assumption(key, False, f"{', '.join(free)} {text}.", remedy))
        elif rank < len(names):
            text = f"{key} has rank {rank}, {len(names)} are needed."
            found.append(Assumption(key, False, text, remedy))
        else:
            found.append(Assumption(key, True, f"rank {rank}."))
    return found
