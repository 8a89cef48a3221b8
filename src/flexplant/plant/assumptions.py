"""Which standard assumptions hold for a plant, in physical words: Hautus' test, ranks and zeros."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, divisor
from ..errors import AssumptionError, counted, unknown_label
from ..labels import DIRECTIONS
from ..lti.equations import state_scale
from ..lti.statespace import StateSpace
from ..lti.zeros import axis_zeros
from ..store import Value
from ..tolerances import ROUNDING, SAME, SPLIT, TINY
from .partitioned import PartitionedSystem
from .visibility import SHOWN, WEAK, ModeVisibility, aliased_modes, mode_visibility, response_at


class _Case(NamedTuple):
    """One test of the modes that do not decay."""

    key: str
    verb: str
    names: list[str]
    pushes: bool
    remedy: str
    held: bool = True
    block: StateSpace | None = None


class _Pole(NamedTuple):
    """A pole that does not decay, with bases (n, g) of its left and right eigenvectors."""

    value: complex
    left: ComplexArray
    right: ComplexArray


def _swings(pole: _Pole) -> bool:
    """Return whether a pole is that of an undamped mode."""
    return bool(pole.value.imag) and abs(pole.value.real) <= SAME * abs(pole.value)


def reach_and_sight(plant: PartitionedSystem) -> list[Assumption]:
    """Return which modes that do not decay w and u reach, and y and z see (Hautus)."""
    bare = plant.machine.continuous
    if not bare.modal_blocks.size:  # states of foreign matrices have any units
        bare = bare.replace(system=evened(bare.system))
    poles = _persistent(bare.system)
    rate = 1.0 / plant.dt if plant.dt and not bare.dt else 0.0
    sampled, apart = _alias_groups(poles, rate), [[pole] for pole in poles]
    words = _undamped_kinds(bare, poles)
    found = []
    for case in _cases(bare, poles, plant):
        groups = sampled if case.held else apart
        lacks = [(group[0], _lacks(bare, group, case, rate)) for group in groups]
        texts = [text for _, said in lacks for text in said]
        texts = list(dict.fromkeys([*texts, *_weights_without(plant, case.key)]))
        listed = f"(channels: {', '.join(case.names) or 'none'})"
        if texts:
            more = len(texts) - SHOWN
            text = "; ".join(texts[:SHOWN]) + (f"; and {more} more" if more > 0 else "")
            remedy = case.remedy
            if any(said and _swings(pole) for pole, said in lacks):
                remedy += (
                    " Or give undamped modes damping: solve_modes(model, damping=...), or "
                    "model.with_damping(...) before an update."
                )
            found.append(Assumption(case.key, False, f"{text} {listed}.", remedy))
            continue
        text = f"{' and '.join(words)}, by {counted(len(case.names), 'channel')}."
        found.append(Assumption(case.key, True, text if words else "every mode decays."))
    return found


def _undamped_kinds(plant: PartitionedSystem, poles: list[_Pole]) -> list[str]:
    """Return, in words, how many modes of each kind do not decay."""
    rigid, pairs = plant.n_rigid, len(plant.unstable_modes)
    every = f"all {rigid} rigid-body modes" if rigid > 1 else "the rigid-body mode"
    words = [every] if rigid else []
    words += [counted(pairs, "unstable rigid-body pair")] if pairs else []
    count = sum(pole.left.shape[1] for pole in poles) - rigid - pairs
    own = plant.realisation
    freq: list[float] = []
    for pole in poles:
        if own.n_modes and _swings(pole):
            freq += [abs(pole.value) / (2 * np.pi)] * pole.left.shape[1]
    if freq:
        span = f"{min(freq):.4g}" + (f" to {max(freq):.4g}" if len(freq) > 1 else "")
        words.append(f"{counted(len(freq), 'undamped mode')} at {span} Hz")
        count -= len(freq)
    words += [f"{counted(count, 'other pole')} without decay"] if count > 0 else []
    return words


def _cases(bare: PartitionedSystem, poles: list[_Pole], plant: PartitionedSystem) -> list[_Case]:
    """Return the tests: of the channels that weights leave, y through the block that reads it."""
    g, block = bare.system, plant.reading
    left = [name for name in bare.w if name in plant.w]
    noisy = [name for name in left if bare.asd.get(name, 0.0) > 0]
    pushing = [n for n in (noisy or left) if np.any(g.B[:, g.input_index([n])])]

    def seeing(names: list[str]) -> list[str]:
        rows = g.C[g.output_index(names)]
        sizes = [np.abs(_modal_rows(rows, pole.right)).max(axis=1, initial=0.0) for pole in poles]
        return [n for i, n in enumerate(names) if any(size[i] > 0 for size in sizes)]

    more = "Add a disturbance (with an asd) that does."
    w = _Case("excited", "w does not excite", pushing, True, more, held=not noisy)
    more = "Add or move a displacement sensor."
    read = list(plant.y) if block is not None else seeing([n for n in bare.y if n in plant.y])
    y = _Case("detectable", "y does not see", read, False, more, block=block)
    more = "Add an axis to a POI, or another POI."
    shown = seeing([name for name in bare.z if name in plant.z])
    z = _Case("performance", "z does not see", shown, False, more)
    u = _Case("stabilisable", "u does not reach", list(plant.u), True, "Add or move an actuator.")
    return [w, y, z, u] if bare.modal_blocks.size else [u, y]


def _persistent(g: StateSpace) -> list[_Pole]:
    """Return the poles on or beyond the stability limit, upper half plane, each once."""
    poles = g.poles()
    margin = np.abs(poles) - 1 if g.dt else poles.real / np.maximum(np.abs(poles), 1.0)
    size = max(float(np.linalg.norm(g.A, 2)), TINY) if poles.size else 1.0
    # a double pole at the edge comes out at the root of rounding
    near = 1e-7 * float(np.max(np.abs(poles), initial=TINY))
    found: list[_Pole] = []
    for pole in poles[(margin > -SAME) & (poles.imag >= 0)]:
        if any(abs(pole - other.value) < near for other in found):
            continue
        shifted = g.A - (pole if pole.imag else pole.real) * np.eye(g.n_states)
        left, sizes, right = la.svd(shifted)
        count = max(int(np.count_nonzero(sizes <= SAME * size)), 1)
        count = min(count, _most(g, complex(pole), near))
        found.append(_Pole(complex(pole), left[:, -count:], right[-count:].conj().T))
    return found


def _most(g: StateSpace, pole: complex, near: float) -> int:
    """Return how many eigenvectors a pole has at most: one in each 2 x 2 block [[a, b], [c, d]]."""
    # rows of accelerations are so large that more than the free motions would look like rounding
    if g.blocks is None:
        return g.n_states
    most, start = 0, 0
    for n in g.blocks:
        block = g.A[start : start + n, start : start + n]
        if np.any(np.abs(np.linalg.eigvals(block) - pole) <= near):
            most += 1 if n == 2 and np.any(block - block[0, 0] * np.eye(2)) else n
        start += n
    return max(most, 1)


def _alias_groups(poles: list[_Pole], rate: float) -> list[list[_Pole]]:
    """Return the poles, those together whose samples at a rate [Hz] are the same."""
    # exp(lambda / rate) of poles that differ by a multiple of the rate is one pole of the samples
    groups: list[tuple[complex, list[_Pole]]] = []
    for pole in poles:
        mirrored = _Pole(pole.value.conjugate(), pole.left.conj(), pole.right.conj())
        z = _sample(pole.value, rate)
        own = [pole]
        if rate and pole.value.imag and abs(z.imag) < SPLIT:
            own = [pole, mirrored]
        elif rate and z.imag < 0:
            z, own = z.conjugate(), [mirrored]
        same = [members for at, members in groups if rate and abs(at - z) < SPLIT]
        if same:
            same[0].extend(own)
        else:
            groups.append((z, own))
    return [members for _, members in groups]


def _sample(value: complex, rate: float) -> complex:
    return complex(np.exp(value / rate)) if rate else value


def _lacks(plant: PartitionedSystem, group: list[_Pole], case: _Case, rate: float) -> list[str]:
    """Return, in words, what the channels of a case have no part in at poles that look alike."""
    g = plant.system
    bases = [pole.left if case.pushes else pole.right for pole in group]
    if len(group) == 1 and plant.n_rigid and not group[0].value:
        rigid = plant.modal_states[(1 if case.pushes else 0) : 2 * plant.n_rigid : 2]
        if rigid.size == bases[0].shape[1]:  # one vector for each rigid-body mode
            bases[0] = bases[0] @ np.linalg.inv(bases[0][rigid])
    else:
        rigid = np.zeros(0, dtype=int)
    parts = []
    for pole, basis in zip(group, bases, strict=True):
        if case.block is not None:
            seen = _modal_rows(g.C[g.output_index(case.block.inputs)], basis)
            parts.append(_modal_rows(response_at(case.block, _sample(pole.value, rate)), seen))
        elif case.pushes:
            # what is left of an input that is held for a sample, |exp(a) - 1| / |a|
            a = pole.value / rate if rate and case.held else 0.0
            size = abs(np.expm1(a) / a) if a else 1.0
            part = _modal_rows(g.B[:, g.input_index(case.names)].T, basis)
            parts.append(part * (size if size > SPLIT else 0.0))
        else:
            parts.append(_modal_rows(g.C[g.output_index(case.names)], basis))
    missing = _null_combinations(np.hstack(parts).T)  # one column for each channel
    if not missing.shape[1]:
        return []
    if rigid.size:
        shapes = (bases[0] @ missing)[rigid].real
        return [f"{case.verb} the rigid-body {' and '.join(axes_in_words(plant, shapes))}"]
    grows = any(pole.value.real > 0 and not pole.value.imag for pole in group)
    fate = "grows" if grows else "does not decay"
    names = list(dict.fromkeys(_pole_name(plant, pole.value) for pole in group))
    if len(group) == 1:
        return [f"{case.verb} {names[0]}, which {fate}"]
    alike = "they look" if len(names) > 1 else "its two poles look"
    said = f"{case.verb} {' and '.join(names)} apart, which {fate}: at {rate:g} Hz {alike} alike"
    return [said]


def _modal_rows(rows: FloatArray | ComplexArray, basis: ComplexArray) -> ComplexArray:
    """Return rows @ basis, rounding set to zero: a channel without part has exactly none."""
    product = np.asarray(rows @ basis, dtype=np.complex128)
    product[np.abs(product) < ROUNDING * np.linalg.norm(rows, axis=1)[:, None]] = 0.0
    return product


def _pole_name(plant: PartitionedSystem, pole: complex) -> str:
    """Return a pole as a mode and its frequency, or as a number."""
    if plant.n_rigid and not pole:
        return "the rigid-body motions"
    if plant.modal_blocks.size:
        own = np.linalg.eigvals(plant.modal_blocks)
        off = np.minimum(np.abs(own - pole), np.abs(own - pole.conjugate())).min(axis=1)
        if off.min() < SPLIT * abs(pole) and int(np.argmin(off)) + 1 in plant.unstable_modes:
            return f"the unstable rigid-body {plant.unstable_modes[int(np.argmin(off)) + 1]}"
        if off.min() < SPLIT * abs(pole):
            return f"mode {int(np.argmin(off)) + 1} ({abs(pole) / (2 * np.pi):.4g} Hz)"
    return f"the pole {pole:.4g}"


def _weights_without(plant: PartitionedSystem, key: str) -> list[str]:
    """Return which weights do not decay: no controller can reach or see their states."""
    side = {"stabilisable": "w", "detectable": "z"}.get(key)
    if side is None or plant.machine is plant:
        return []
    g, texts = plant.system, []
    for name in getattr(plant, side):
        own = [i for i, state in enumerate(g.states) if f"{name}|" in state]
        poles = np.linalg.eigvals(g.A[np.ix_(own, own)]) if own else np.zeros(0)
        if np.any(np.abs(poles) >= 1 - SAME if g.dt else poles.real >= -SAME * np.abs(poles)):
            what = "u does not reach" if side == "w" else "y does not see"
            texts.append(f"{what} the weight of {name}, which does not decay (move its pole left)")
    return texts


def _null_combinations(matrix: ComplexArray | FloatArray) -> ComplexArray:
    """Return the combinations (r, missing) that no channel has part in."""
    sizes = np.linalg.norm(matrix, axis=0)
    scaled = matrix[:, sizes > 0] / sizes[sizes > 0]
    if not scaled.size:
        return np.eye(matrix.shape[0], dtype=np.complex128)
    U, s, _ = la.svd(scaled, full_matrices=True)
    return np.asarray(U[:, np.count_nonzero(s > SAME * s[0]) :])


def axes_in_words(plant: PartitionedSystem, combinations: FloatArray) -> list[str]:
    """Return rigid-body combinations (r, missing) in words, `translation z`, `rotation rx`."""
    realisation = plant.assembled.realisation
    model = realisation.model
    shapes = realisation.outputs[:, 0 : 2 * plant.n_rigid : 2] @ combinations
    motions = model.rigid_motions(model.full_dofs.xyz.mean(axis=0))
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


def full_ranks(plant: PartitionedSystem) -> list[Assumption]:
    """D12 and D21 of full rank, each row and column scaled to unit size."""
    found = []
    for key, matrix, names, text, remedy in (
        ("D12", plant.D12, plant.u, "costs nothing in z", "Keep its effort in z."),
        ("D21", plant.D21.T, plant.y, "is free of noise in w", "Give the sensor an asd."),
    ):
        sizes = np.linalg.norm(matrix, axis=0)
        free = [name for name, size in zip(names, sizes, strict=True) if not size]
        scaled = matrix / divisor(sizes)
        rank = int(np.linalg.matrix_rank(scaled, tol=SAME)) if scaled.size else 0
        if free:
            found.append(Assumption(key, False, f"{', '.join(free)} {text}.", remedy))
        elif rank < len(names):
            text = f"{key} has rank {rank}, {len(names)} are needed."
            found.append(Assumption(key, False, text, remedy))
        else:
            found.append(Assumption(key, True, f"rank {rank}."))
    return found


def no_zeros(plant: PartitionedSystem) -> list[Assumption]:
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
        if not plant.modal_blocks.size:
            g = evened(g)
        if key != "P12":
            g = StateSpace(g.A.T, g.C.T, g.B.T, g.D.T, g.dt)
        zeros = axis_zeros(g)
        listed = ", ".join(dict.fromkeys(_frequency(plant, zero) for zero in zeros[:3]))
        where = f"an invariant zero on the stability limit at {listed}"
        text = where if zeros.size else "no invariant zero on the stability limit"
        said = f"{fro} -> {to} has {text}."
        found.append(Assumption(key, not zeros.size, said, remedy if zeros.size else ""))
    return found


def evened(g: StateSpace) -> StateSpace:
    """Return the system with its states in even units: judgements then do not depend on them."""
    d = state_scale(g.A, g.B, g.C) if g.n_states else np.ones(0)
    return g.replace(A=g.A * d / d[:, None], B=g.B / d[:, None], C=g.C * d)


def _frequency(plant: PartitionedSystem, zero: complex) -> str:
    """Return a zero on the stability limit as a frequency, with the mode it belongs to."""
    omega = abs(np.log(zero)) / plant.dt if plant.dt else abs(zero)
    top = np.pi / plant.dt if plant.dt else np.abs(plant.system.poles()).max(initial=TINY)
    if omega < SPLIT * top:
        return "zero frequency (a rigid-body motion or an integrator)"
    text = f"{omega / (2 * np.pi):.4g} Hz"
    own = np.sqrt(np.abs(np.linalg.det(plant.modal_blocks)))
    if own.size:
        nearest = int(np.argmin(np.abs(own - omega)))
        if abs(own[nearest] - omega) < 1e-4 * omega:  # one mode and filters
            return f"{text} (mode {nearest + 1})"
    return text


@dataclass(frozen=True, eq=False)
class Assumption(Value):
    """One assumption: its key, whether it holds, what was found and what to change if not.

    Parameters
    ----------
    key : str
        Name of the assumption. Four of them concern the modes that do not decay: w reaches each of
        them (`excited`), y sees it (`detectable`), z sees it (`performance`), and u reaches it
        (`stabilisable`). The keys `D12` and `D21` mean that these matrices have full rank. The keys
        `P12` (u to z) and `P21` (w to y) mean that these transfers have no invariant zeros on the
        imaginary axis or, if sampled, on the unit circle.
    holds : bool
        Whether the assumption holds.
    finding : str
        Result in physical terms.
    remedy : str
        Change by which it would hold; empty when it holds.

    Examples
    --------
    >>> import flexplant as fx
    >>> first = fx.testbeds.three_masses().check().assumptions[0]
    >>> first.holds
    True
    """

    key: str
    holds: bool
    finding: str
    remedy: str = ""


#: tests of a plant, in the order in which they matter
_Tests: TypeAlias = Callable[[PartitionedSystem], list[Assumption]]
_TESTS: tuple[_Tests, ...] = (reach_and_sight, full_ranks, no_zeros)


@dataclass(frozen=True, eq=False, repr=False)
class AssumptionReport(Value):
    """The standard assumptions of a plant; each is tested when it is first read.

    Parameters
    ----------
    plant : StandardPlant
        The plant, weighted or not.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.testbeds.three_masses().check().ok
    True
    """

    plant: PartitionedSystem

    @cached_property
    def assumptions(self) -> tuple[Assumption, ...]:
        """All assumptions, the most important ones first."""
        return tuple(item for tests in _TESTS for item in self._found(tests))

    def _found(self, tests: _Tests) -> list[Assumption]:
        """Return the findings of some tests, which are done once."""
        known: dict[_Tests, list[Assumption]] = self.__dict__.setdefault("_known", {})
        if tests not in known:
            known[tests] = tests(self.plant)
        return known[tests]

    @cached_property
    def modes(self) -> tuple[ModeVisibility, ...]:
        """Visibility of each elastic mode (`ModeVisibility`); for information only."""
        return mode_visibility(self.plant)

    @property
    def ok(self) -> bool:
        """Whether all assumptions hold."""
        return all(item.holds for item in self.assumptions)

    def __getitem__(self, key: str) -> Assumption:
        for tests in _TESTS:
            for item in self._found(tests):
                if item.key == key:
                    return item
        raise unknown_label("assumption", key, [item.key for item in self.assumptions])

    def __repr__(self) -> str:
        lines = [f"<AssumptionReport: {'all hold' if self.ok else 'NOT all hold'}>"]
        lines += _assumption_lines(self.assumptions)
        if self.plant.form.startswith("dense"):
            lines.append(f"  note the plant is {self.plant.form}")
        if self.plant.unstable_modes:
            listed = self.plant.unstable_text
            lines.append(
                f"  note negative stiffness makes rigid-body motion unstable: {listed}; only a "
                "controller holds it"
            )
        folded = aliased_modes(self.plant)
        lines += [f"  note {folded}"] if folded else []
        weak = [text for mode in self.modes for text in mode.weak]
        lines += [f"  note {text}" for text in weak[:4]]
        if len(weak) > 4:
            lines.append(f"  note {len(weak) - 4} more below {100 * WEAK:g} %: see .modes")
        return "\n".join(lines)

    def require(self, keys: tuple[str, ...], purpose: str) -> None:
        """Raise AssumptionError unless all assumptions with the given keys hold; see `Assumption`.

        An assumption that does not apply to this plant counts as satisfied. The message says for
        which `purpose` the assumptions are needed and what to change. The error carries the report.
        """
        needed = _TESTS if {"P12", "P21"} & set(keys) else _TESTS[:2]
        known = tuple(item for tests in needed for item in self._found(tests))
        failed = [item for item in known if item.key in keys and not item.holds]
        if failed:
            said = " ".join(f"{item.finding} {item.remedy}" for item in failed)
            # what was said is not said again
            short = [item.replace(finding="as said.", remedy="") for item in failed]
            listed = tuple(short[failed.index(i)] if i in failed else i for i in known)
            table = "\n".join(["The plant's assumptions:", *_assumption_lines(listed)])
            raise AssumptionError(f"{purpose} is not possible: {said}\n{table}")


def _assumption_lines(items: tuple[Assumption, ...]) -> list[str]:
    return [
        f"  {'yes' if item.holds else 'NO '} {item.key}: {item.finding}"
        + (f" {item.remedy}" if item.remedy else "")
        for item in items
    ]


class CheckedSystem(PartitionedSystem):
    """A partitioned system that tells which standard assumptions hold."""

    def check(self) -> AssumptionReport:
        """Return which standard assumptions hold, in physical terms, rigid-body modes first."""
        return self._report

    @cached_property
    def _report(self) -> AssumptionReport:
        return AssumptionReport(self)
