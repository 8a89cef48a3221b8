"""Ranks of D12 and D21, and invariant zeros of u -> z and w -> y on the stability limit."""

from __future__ import annotations

import numpy as np

from ..lti.scaling import state_scale
from ..lti.statespace import StateSpace
from ..lti.zeros import axis_zeros
from .assumption import Assumption
from .partition import Partition


def full_ranks(plant: Partition) -> list[Assumption]:
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


def no_zeros(plant: Partition) -> list[Assumption]:
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
        if not plant.is_assembled:
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


def _frequency(plant: Partition, zero: complex) -> str:
    """Return a zero on the stability limit as a frequency, with the mode it belongs to."""
    omega = abs(np.log(zero)) / plant.dt if plant.dt else abs(zero)
    if omega < 1e-6 * _fastest(plant):
        return "zero frequency (a rigid-body motion or an integrator)"
    text = f"{omega / (2 * np.pi):.4g} Hz"
    own = np.sqrt(np.abs(np.linalg.det(plant.modal_blocks)))
    if own.size:
        nearest = int(np.argmin(np.abs(own - omega)))
        if abs(own[nearest] - omega) < 1e-4 * omega:
            return f"{text} (mode {nearest + 1})"
    return text


def _fastest(plant: Partition) -> float:
    if plant.dt:
        return float(np.pi / plant.dt)
    return float(np.max(np.abs(plant.system.poles()), initial=1e-300))
