"""How a machine was joined, and the checks of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import FloatArray, IntArray, Value
from ..errors import CertificateError, counted
from ..tolerances import TINY, divisor
from .component import Component
from .links import Elimination, Link, machine_size, stretch_rows

#: largest gap, imbalance and error of the inertia, relative
_LIMIT = 1e-7
#: a rigid-body motion that a reduced component misses by less is one of its own
_MADE = 1e-8
#: the part of the largest entry of a motion that counts for the rounding of each
_ENTRY = 1e-3


@dataclass(frozen=True, eq=False, repr=False)
class JoiningCertificate(Value):
    """What `joined` checked.

    Parameters
    ----------
    gap : float
        Largest opening of a rigid joint over all motions of what is left, relative to what cancels
        there.
    balance : float
        Largest resultant of the forces of a joint between two components, relative: what a motion
        of the whole machine stretches it. Springs may have one (they are warned of), rigid joints
        have none.
    mass : float [kg]
        Of the machine; NaN without displacements.
    inertia_error : float
        Largest difference between the machine's inertia against the six rigid-body motions and the
        sum of its components', relative.
    constraints, rank : int
        Axes of rigid joints, and how many of them are independent.
    rigid : mapping {str: int}
        Rigid-body motions of each component before it was joined.
    pieces : mapping {str: int}
        Rigid-body motions of each part of the machine that joints hold together, by the names of
        its components, "stage, frame".
    n_rigid : int
        Rigid-body motions of the machine.
    rigid_force : float
        Largest elastic force of these motions, relative to what cancels.
    patches : mapping {str: float}
        For each joint of a patch, by how much of the compliance of its mean motion a patch that
        stays rigid would be stiffer, at most over its axes: the error of either is below.

    Examples
    --------
    >>> import flexplant as fx
    >>> parts = {n: fx.chain(masses=[1.0, 2.0], stiffnesses=[5e5]) for n in ("stage", "frame")}
    >>> found = fx.joined(parts, fx.Joint("stage/1:x", "frame/1:x")).joining
    >>> found.n_rigid, found.mass, found.gap < 1e-12
    (1, 6.0, True)
    """

    gap: float
    balance: float
    mass: float
    inertia_error: float
    constraints: int
    rank: int
    rigid: Mapping[str, int]
    pieces: Mapping[str, int]
    n_rigid: int
    rigid_force: float
    patches: Mapping[str, float]

    def __repr__(self) -> str:
        before = ", ".join(f"{name} {count}" for name, count in self.rigid.items())
        pieces = "one piece"
        if len(self.pieces) > 1:
            listed = [f"{names}: {count}" for names, count in self.pieces.items()]
            pieces = f"{len(listed)} pieces ({'; '.join(listed)})"
        independent = f"{self.rank} of {counted(self.constraints, 'rigid constraint')} independent"
        errors = f"gap {self.gap:.1g}, balance {self.balance:.1g}, inertia {self.inertia_error:.1g}"
        errors += f", rigid force {self.rigid_force:.1g}"
        head = f"{counted(self.n_rigid, 'rigid-body motion')} (alone: {before}), {pieces}"
        text = [f"<JoiningCertificate: {head}, {self.mass:.6g} kg", f" {independent}, {errors}"]
        text += [f" {name}: compliance to {error:.2g}" for name, error in self.patches.items()]
        return "\n".join(text) + ">"


def certified(
    parts: Sequence[Component],
    links: Sequence[Link],
    done: Elimination,
    matrices: Mapping[str, Any],
    groups: Sequence[IntArray],
    rigid: FloatArray,
    expected: int,
    patches: Mapping[str, float],
) -> JoiningCertificate:
    """Return the checks of a joined machine."""
    B = stretch_rows([link for link in links if link.joint.is_rigid], parts)
    opening: Any = abs(B @ done.T).max(axis=1)
    most: Any = (abs(B) @ abs(done.T)).max(axis=1)
    opening, most = (np.asarray(part.todense()).ravel() for part in (opening, most))
    gap = float(np.max(opening / divisor(most), initial=0.0))
    size = np.array([1.0] * 3 + [machine_size(parts)] * 3)
    felt = [(link.joint.is_rigid, float(np.abs(link.carried / size).max())) for link in links]
    balance = max((part for is_rigid, part in felt if is_rigid), default=0.0)
    apart, error = _inertia(parts, matrices["M"], done.kept)
    found = JoiningCertificate(
        gap=gap,
        balance=max((part for _, part in felt), default=0.0),
        mass=float(max(np.diag(apart)[:3])) or float("nan"),
        inertia_error=error,
        constraints=B.shape[0],
        rank=done.rank,
        rigid={part.name: int(part.model.rigid_body.shape[1]) for part in parts},
        pieces=_by_piece(parts, groups, rigid, done.kept),
        n_rigid=rigid.shape[1],
        rigid_force=_force(matrices["K"], rigid),
        patches=patches,
    )
    if not max(gap, balance, error, found.rigid_force) < _LIMIT:
        raise CertificateError(
            f"the joined machine fails its check (limit {_LIMIT:g}): {found!r}. Join fewer axes, "
            "or look for joints that nearly repeat each other."
        )
    if found.n_rigid != expected:
        raise CertificateError(
            f"the machine has {counted(found.n_rigid, 'rigid-body motion')}, but {expected} of its "
            "components' stretch no joint: a joint is too soft or too stiff for the digits of the "
            "matrices. Look for a wrong unit of a stiffness, or leave the joint out."
        )
    return found


def _by_piece(
    parts: Sequence[Component], groups: Sequence[IntArray], rigid: FloatArray, kept: IntArray
) -> dict[str, int]:
    """Return how many rigid-body motions move each piece."""
    owner = np.repeat(np.arange(len(parts)), [part.n for part in parts])[kept]
    moved = [np.any(rigid[np.isin(owner, group)] != 0, axis=0) for group in groups]
    names = [", ".join(parts[i].name for i in group) for group in groups]
    return {name: int(np.count_nonzero(some)) for name, some in zip(names, moved, strict=True)}


def _force(K: Any, motions: FloatArray) -> float:
    """Return the largest elastic force of motions (k, r), relative to what cancels in it."""
    force = np.linalg.norm(np.asarray(K @ motions), axis=0)
    # a motion that no spring feels has nothing but rounding of its largest entries there
    moved = np.abs(motions) + _ENTRY * np.abs(motions).max(axis=0, initial=0.0)
    most = np.linalg.norm(np.asarray(abs(K) @ moved), axis=0)
    return float(np.max(force / divisor(most), initial=0.0))


def _inertia(parts: Sequence[Component], M: Any, kept: IntArray) -> tuple[FloatArray, float]:
    """Return the inertia (6, 6) of all components, and how far that of the machine is off.

    Motions that a reduced component cannot make (it is held, say) have no inertia of the whole.
    """
    own = [part.model.rigid_motions() for part in parts]
    apart = np.zeros((6, 6))
    missed = np.zeros(6)
    for part, motions in zip(parts, own, strict=True):
        apart += motions.T @ part.model.inertia(motions)
        if part.is_reduced:
            missed = np.maximum(missed, part.model.missed_motions())
    whole = np.vstack(own)[kept]
    size = np.sqrt(np.maximum(np.diag(apart), TINY))
    error = np.abs(whole.T @ np.asarray(M @ whole) - apart) / np.outer(size, size)
    made = missed < _MADE
    return apart, float(error[np.ix_(made, made)].max(initial=0.0))
