"""Which standard assumptions a plant meets, in physical words, rigid-body modes first."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..errors import AssumptionError, unknown_label
from ..labels import DIRECTIONS
from ..lti.scaling import state_scale
from ..lti.statespace import StateSpace
from ..lti.zeros import axis_zeros
from ..reduction import ReducedModel
from ..structure.rigid import rigid_motions
from ..values import ComplexArray, FloatArray, Value
from .standard import StandardPlant
from .visibility import WEAK, ModeVisibility, mode_visibility

#: a motion weaker than this beside the strongest one counts as absent
_ABSENT = 1e-8
#: a pole closer to the stability limit than this, relative to its size, counts as on it
_AXIS = 1e-9
#: findings of one kind that are written out
_SHOWN = 3


@dataclass(frozen=True, eq=False)
class Assumption(Value):
    """One assumption: its key, whether it holds, what was found and what to change if not.

    Parameters
    ----------
    key : str
        `excited` (w reaches), `detectable` (y sees), `performance` (z sees), `stabilisable`
        (u reaches) every mode that does not decay by itself; `D12`, `D21` (full rank); `P12`,
        `P21` (u -> z and w -> y have no invariant zeros on the stability limit).
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
    """The standard assumptions of a plant; each is tested when it is asked for.

    Parameters
    ----------
    plant : StandardPlant
        The plant, weighted or not.
    """

    plant: StandardPlant

    @cached_property
    def assumptions(self) -> tuple[Assumption, ...]:
        """All assumptions, in the order in which they matter."""
        return (*self._modal, *self._ranks, *self._zeros)

    @cached_property
    def _modal(self) -> tuple[Assumption, ...]:
        return tuple(_reach_and_sight(self.plant))

    @cached_property
    def _ranks(self) -> tuple[Assumption, ...]:
        return tuple(_ranks(self.plant))

    @cached_property
    def _zeros(self) -> tuple[Assumption, ...]:
        return tuple(_zeros(self.plant))

    @cached_property
    def modes(self) -> tuple[ModeVisibility, ...]:
        """How well each elastic mode is reached and seen, and by which channel: information."""
        return mode_visibility(self.plant.unweighted or self.plant)

    @property
    def ok(self) -> bool:
        """Whether all hold."""
        return all(item.holds for item in self.assumptions)

    def __getitem__(self, key: str) -> Assumption:
        for group in ("_modal", "_ranks", "_zeros"):
            for item in getattr(self, group):
                if item.key == key:
                    found: Assumption = item
                    return found
        raise unknown_label("assumption", key, [item.key for item in self.assumptions])

    def __repr__(self) -> str:
        lines = [f"<AssumptionReport: {'all hold' if self.ok else 'NOT all hold'}>"]
        lines += _lines(self.assumptions)
        if self.plant.form.startswith("dense"):
            lines.append(f"  note the plant is {self.plant.form}")
        weak = [text for mode in self.modes for text in mode.weak]
        lines += [f"  note {text}" for text in weak[:4]]
        if len(weak) > 4:
            lines.append(f"  note {len(weak) - 4} more below {100 * WEAK:g} %: see .modes")
        return "\n".join(lines)

    def require(self, keys: tuple[str, ...], purpose: str) -> None:
        """Raise AssumptionError unless the assumptions of these keys hold.

        Parameters
        ----------
        keys : sequence of str
            What the design needs; a key that does not apply to this plant holds.
        purpose : str
            What it is needed for, for the message.

        Raises
        ------
        AssumptionError
            When one fails; the message says what to change, and holds the report.
        """
        known = (*self._modal, *self._ranks)
        if {"P12", "P21"} & set(keys):
            known = self.assumptions
        failed = [item for item in known if item.key in keys and not item.holds]
        if failed:
            said = " ".join(f"{item.finding} {item.remedy}" for item in failed)
            # what was said is not said again
            short = [item.replace(finding="as said.", remedy="") for item in failed]
            told = tuple(short[failed.index(i)] if i in failed else i for i in known)
            table = "\n".join(["The plant's assumptions:", *_lines(told)])
            raise AssumptionError(f"{purpose} is not possible: {said}\n{table}")


def report(plant: StandardPlant) -> AssumptionReport:
    """Return the assumption report of a plant."""
    return AssumptionReport(plant)


def _lines(items: tuple[Assumption, ...]) -> list[str]:
    return [
        f"  {'yes' if item.holds else 'NO '} {item.key}: {item.finding}"
        + (f" {item.remedy}" if item.remedy else "")
        for item in items
    ]


class _Case(NamedTuple):
    """One question to the modes that do not decay by themselves."""

    key: str
    verb: str
    names: list[str]
    pushes: bool
    remedy: str


class _Pole(NamedTuple):
    """A pole that does not decay, with bases (n, g) of its left and right eigenvectors."""

    value: complex
    left: ComplexArray
    right: ComplexArray


def _reach_and_sight(plant: StandardPlant) -> list[Assumption]:
    """Ask which modes that do not decay w and u reach, and y and z see (Hautus)."""
    bare = plant.unweighted or plant
    bare = bare.continuous or bare
    if bare.realisation is None:  # states of a system made elsewhere have any units
        bare = bare.replace(system=evened(bare.system))
    poles = _undying(bare.system)
    rigid = bare.n_rigid if bare.realisation is not None else 0
    found = []
    for case in _cases(bare, poles):
        texts = [text for pole in poles for text in _lacks(bare, pole, case)]
        texts = list(dict.fromkeys([*texts, *_weights_without(plant, case.key)]))
        listed = f"(channels: {', '.join(case.names) or 'none'})"
        if texts:
            more = len(texts) - _SHOWN
            text = "; ".join(texts[:_SHOWN]) + (f"; and {more} more" if more > 0 else "")
            found.append(Assumption(case.key, False, f"{text} {listed}.", case.remedy))
        else:
            count = sum(pole.left.shape[1] for pole in poles) - rigid
            words = [f"all {rigid} rigid-body modes"] if rigid else []
            words += [f"{count} other poles that are not stable"] if count else []
            text = f"{' and '.join(words)}, by {len(case.names)} channels."
            found.append(
                Assumption(case.key, True, text if words else "every mode decays by itself.")
            )
    return found


def _cases(plant: StandardPlant, poles: list[_Pole]) -> list[_Case]:
    g = plant.system
    noisy = [name for name in plant.w if plant.asd.get(name, 0.0) > 0]
    pushing = [n for n in (noisy or plant.w) if np.any(g.B[:, g.input_index([n])])]

    def seeing(names: tuple[str, ...]) -> list[str]:
        rows = g.C[g.output_index(names)]
        sizes = [np.abs(_part(rows, pole.right)).max(axis=1, initial=0.0) for pole in poles]
        return [n for i, n in enumerate(names) if any(size[i] > 0 for size in sizes)]

    more = "Add a disturbance (with an asd) that does."
    w = _Case("excited", "w does not excite", pushing, True, more)
    more = "Add or move a displacement sensor."
    y = _Case("detectable", "y does not see", seeing(plant.y), False, more)
    more = "Add an axis to a POI, or another POI."
    z = _Case("performance", "z does not see", seeing(plant.z), False, more)
    u = _Case("stabilisable", "u does not reach", list(plant.u), True, "Add or move an actuator.")
    return [w, y, z, u] if plant.realisation is not None else [u, y]


def _undying(g: StateSpace) -> list[_Pole]:
    """Return the poles on or beyond the stability limit, upper half plane, each once."""
    poles = g.poles()
    margin = np.abs(poles) - 1 if g.dt else poles.real / np.maximum(np.abs(poles), 1.0)
    size = max(float(np.linalg.norm(g.A, 2)), 1e-300) if poles.size else 1.0
    near = 1e-7 * float(np.max(np.abs(poles), initial=1e-300))
    found: list[_Pole] = []
    for pole in poles[(margin > -_AXIS) & (poles.imag >= 0)]:
        if any(abs(pole - other.value) < near for other in found):
            continue
        shifted = g.A - (pole if pole.imag else pole.real) * np.eye(g.n_states)
        left, sizes, right = la.svd(shifted)
        count = max(int(np.count_nonzero(sizes <= _ABSENT * size)), 1)
        count = min(count, _most(g, complex(pole), near))
        found.append(_Pole(complex(pole), left[:, -count:], right[-count:].conj().T))
    return found


def _most(g: StateSpace, pole: complex, near: float) -> int:
    """Return how many eigenvectors a pole has at most: one in each 2 x 2 block [[a, b], [c, d]].

    A filter that reads accelerations has rows far larger than those of the modes, beside which
    more than the motions that are free looks like rounding.
    """
    if g.blocks is None:
        return g.n_states
    most, start = 0, 0
    for n in g.blocks:
        block = g.A[start : start + n, start : start + n]
        if np.any(np.abs(np.linalg.eigvals(block) - pole) <= near):
            most += 1 if n == 2 and np.any(block - block[0, 0] * np.eye(2)) else n
        start += n
    return max(most, 1)


def _lacks(plant: StandardPlant, pole: _Pole, case: _Case) -> list[str]:
    """Return, in words, what the channels of a case have no part in at a pole."""
    g = plant.system
    basis = pole.left if case.pushes else pole.right
    rigid = np.zeros(0, dtype=int)
    if plant.realisation is not None and not pole.value:
        rigid = plant.modal_states[(1 if case.pushes else 0) : 2 * plant.n_rigid : 2]
        if rigid.size == basis.shape[1]:  # one vector for each rigid-body mode
            basis = basis @ np.linalg.inv(basis[rigid])
    rows = g.B[:, g.input_index(case.names)].T if case.pushes else g.C[g.output_index(case.names)]
    missing = _missing(_part(rows, basis).T)  # one column for each channel
    if not missing.shape[1]:
        return []
    if rigid.size:
        shapes = (basis @ missing)[rigid].real
        return [f"{case.verb} the rigid-body {' and '.join(_described(plant, shapes))}"]
    return [f"{case.verb} {_named(plant, pole.value)}, which does not decay"]


def _part(rows: FloatArray, basis: ComplexArray) -> ComplexArray:
    """Return rows @ basis, rounding set to zero: a channel without part has exactly none."""
    product = np.asarray(rows @ basis, dtype=np.complex128)
    product[np.abs(product) < 1e-12 * np.linalg.norm(rows, axis=1)[:, None]] = 0.0
    return product


def _named(plant: StandardPlant, pole: complex) -> str:
    """Return a pole as a mode and its frequency, or as a number."""
    if plant.realisation is not None:
        own = np.array([np.linalg.eigvals(pair) for pair in plant.realisation.pairs])
        off = np.abs(own - pole).min(axis=1)
        if off.min() < 1e-6 * abs(pole):
            return f"mode {int(np.argmin(off)) + 1} ({abs(pole) / (2 * np.pi):.4g} Hz)"
    return f"the pole {pole:.4g}"


def _weights_without(plant: StandardPlant, key: str) -> list[str]:
    """Return which weights do not decay: no controller can reach or see their states."""
    side = {"stabilisable": "w", "detectable": "z"}.get(key)
    if side is None or plant.unweighted is None:
        return []
    g, texts = plant.system, []
    for name in getattr(plant, side):
        own = [i for i, state in enumerate(g.states) if f"{name}|" in state]
        poles = np.linalg.eigvals(g.A[np.ix_(own, own)]) if own else np.zeros(0)
        if np.any(np.abs(poles) >= 1 - _AXIS if g.dt else poles.real >= -_AXIS * np.abs(poles)):
            what = "u does not reach" if side == "w" else "y does not see"
            texts.append(f"{what} the weight of {name}, which does not decay (move its pole left)")
    return texts


def _missing(matrix: ComplexArray | FloatArray) -> ComplexArray:
    """Return the combinations (r, missing) that no channel has part in."""
    sizes = np.linalg.norm(matrix, axis=0)
    scaled = matrix[:, sizes > 0] / sizes[sizes > 0]
    if not scaled.size:
        return np.eye(matrix.shape[0], dtype=np.complex128)
    U, s, _ = la.svd(scaled, full_matrices=True)
    return np.asarray(U[:, np.count_nonzero(s > _ABSENT * s[0]) :])


def _described(plant: StandardPlant, combinations: FloatArray) -> list[str]:
    """Return rigid-body combinations (r, missing) in words, `translation z`, `rotation rx`."""
    realisation = plant.realisation
    if realisation is None:
        return ["motion"]
    dofs = realisation.model.dofs
    shapes = realisation.outputs[:, 0 : 2 * plant.n_rigid : 2] @ combinations
    if isinstance(realisation.model, ReducedModel):
        motions = realisation.model.rigid_motions(realisation.model.full_dofs.xyz.mean(axis=0))
    else:
        motions = rigid_motions(dofs.replace(xyz=dofs.xyz - dofs.xyz.mean(axis=0)))
    sizes = np.linalg.norm(motions, axis=0)
    parts = (np.linalg.lstsq(motions, shapes, rcond=None)[0] * sizes[:, None]).T
    # one axis for each motion that is missing, taken out of the others: none is said twice
    for i in range(parts.shape[0]):
        k, axis = np.unravel_index(int(np.argmax(np.abs(parts[i:]))), parts[i:].shape)
        parts[[i, i + k]] = parts[[i + k, i]]
        parts[i] /= parts[i, axis] or 1.0
        others = np.arange(parts.shape[0]) != i
        parts[others] -= np.outer(parts[others, axis], parts[i])
    kinds = {True: "rotation", False: "translation"}
    return [
        " + ".join(
            f"{kinds[name.startswith('r')]} {name}"
            for name, share in zip(DIRECTIONS, np.abs(part) / np.abs(part).max(), strict=True)
            if share > 0.05
        )
        for part in sorted(parts, key=lambda part: int(np.argmax(np.abs(part))))
    ]


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


def _zeros(plant: StandardPlant) -> list[Assumption]:
    """Invariant zeros of u -> z and w -> y on the stability limit: none may be there."""
    found = []
    for key, fro, to, remedy in (
        ("P12", "u", "z", "Add a channel to z that sees it, such as an axis of a POI."),
        ("P21", "w", "y", "Add a disturbance to w that excites it."),
    ):
        names = getattr(plant, to), getattr(plant, fro)
        g = plant.system.select(*names)
        spare = len(names[0]) - len(names[1])
        wide = (spare < 0) if key == "P12" else (spare > 0)
        if wide or not all(names):
            text = f"{key} has {len(names[1])} inputs {fro} and {len(names[0])} outputs {to}."
            found.append(Assumption(key, False, text, "D12 and D21 cannot have full rank."))
            continue
        if plant.realisation is None:
            g = evened(g)
        zeros = axis_zeros(g if key == "P12" else _transposed(g))
        if zeros.size:
            listed = ", ".join(dict.fromkeys(_frequency(plant, zero) for zero in zeros[:3]))
            text = f"{fro} -> {to} has an invariant zero on the stability limit at {listed}."
            found.append(Assumption(key, False, text, remedy))
        else:
            text = f"{fro} -> {to} has no invariant zero on the stability limit."
            found.append(Assumption(key, True, text))
    return found


def evened(g: StateSpace) -> StateSpace:
    """Return the system with its states in even units: judgements then do not depend on them."""
    d = state_scale(g.A, g.B, g.C) if g.n_states else np.ones(0)
    return g.replace(A=g.A * d / d[:, None], B=g.B / d[:, None], C=g.C * d)


def _transposed(g: StateSpace) -> StateSpace:
    return StateSpace(g.A.T, g.C.T, g.B.T, g.D.T, g.dt)


def _frequency(plant: StandardPlant, zero: complex) -> str:
    """Return a zero on the stability limit as a frequency, with the mode it belongs to."""
    omega = abs(np.log(zero)) / plant.dt if plant.dt else abs(zero)
    if omega < 1e-6 * _fastest(plant):
        return "zero frequency (a rigid-body motion or an integrator)"
    text = f"{omega / (2 * np.pi):.4g} Hz"
    if plant.realisation is not None:
        own = np.sqrt(np.abs(np.linalg.det(plant.realisation.pairs)))
        nearest = int(np.argmin(np.abs(own - omega)))
        if abs(own[nearest] - omega) < 1e-4 * omega:
            return f"{text} (mode {nearest + 1})"
    return text


def _fastest(plant: StandardPlant) -> float:
    if plant.dt:
        return float(np.pi / plant.dt)
    return float(np.max(np.abs(plant.system.poles()), initial=1e-300))
