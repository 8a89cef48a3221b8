"""Singular problems made regular by a little noise on each sensor and weight on each actuator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ...arrays import ComplexArray
from ...certificates import Verified
from ...errors import FlexplantError, InfeasibleError, SolverError
from ...lti.interconnection import lft
from ...lti.norms import hinf_norm
from ...lti.statespace import StateSpace
from ...tolerances import CLOSE, NEGLIGIBLE, ROOT, ROUNDING, SPLIT
from ..controller import SolvedController
from ..preparation import Prepared

#: sizes of what is added, tried in turn: the largest that costs next to nothing in gamma is taken.
#: What acts on a chain of k integrators costs the k-th root of its size
LEVELS = (NEGLIGIBLE, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
#: where the infimum of gamma is zero, gamma falls at least to this fraction from level to level;
#: where it is reached by infinite gain, the fastest pole grows by the reciprocal
_FALL = 0.5
#: a gamma that grows by less from one level to the next has settled, by more it is rounding
_SETTLED = 1.2

#: what an undamped mode lacks, and what to do about it
_MISSED = {
    "z": "z does not feel all that u moves at {}: an undamped (rigid-body or integrating) mode "
    "there is left out of z, or u -> z (a weight) has a zero there. Keep that motion in z with a "
    "weight of finite gain, or give it damping.",
    "w": "w does not excite all that y sees at {}: an undamped (rigid-body or integrating) mode "
    "there has no disturbance, or w -> y (a weight) has a zero there. Add a disturbance that "
    "reaches it, or give it damping.",
}


class Lacking(NamedTuple):
    """What a problem lacks for its equations to be regular, in words."""

    ranks: tuple[str, ...]
    modes: tuple[str, ...]
    #: whether D12 and D21 have full rank, however small they are
    is_full: bool

    @property
    def words(self) -> str:
        """All of it, without a last stop; empty where the problem is regular as it is."""
        return "; ".join(one.rstrip(".") for one in (*self.ranks, *self.modes))


def lacking(p: Prepared) -> Lacking:
    """Return which of D12 and D21 has not full rank, and which slow modes z or w misses."""
    ranks, is_full = [], True
    for name, A, B, C, D, names, cause in (
        ("D12", p.A, p.B2, p.C1, p.D12, p.u, "costs {}nothing in z at high frequencies"),
        ("D21", p.A.T, p.C2.T, p.B1.T, p.D21.T, p.y, "shows {}no noise of w at high frequencies"),
    ):
        values = np.zeros(D.shape[1])
        values[: min(D.shape)] = la.svdvals(D) if D.size else 0.0
        # in a prepared problem the others are 1
        rank = int(np.count_nonzero(values > CLOSE))
        is_full &= bool(np.all(values > ROUNDING))
        if p.dt and not p.direct:
            # the image of a sampled plant has the answers at half the rate for D, and D where z is
            # infinite: without effort or noise there is only rounding
            states = np.linalg.solve(2.0 / (p.dt * p.speed) * np.eye(len(A)) - A, B)
            size = 1.0 + float(np.linalg.norm(np.abs(C) @ np.abs(states)))
            is_full &= bool(np.all(la.svdvals(C @ states + D) > ROUNDING * size))
        if rank < D.shape[1]:
            little = cause.format("next to " if np.all(values > ROUNDING) else "")
            ranks.append(
                f"{name} has rank {rank} of {D.shape[1]}: a combination of {', '.join(names)} "
                f"{little}"
            )
    return Lacking(tuple(ranks), _missed_modes(p), is_full)


def _missed_modes(p: Prepared) -> tuple[str, ...]:
    """Return in words which slow modes z or w misses; zeros on the limit of stability count too."""
    p = p.measured_in(p.own_gain)  # the unit of z must not matter
    found = []
    sides = ("z", p.A, p.B2, p.C1, p.D12), ("w", p.A.T, p.C2.T, p.B1.T, p.D21.T)
    for side, A, B, C, D in sides:
        # [A - s I, B2; C1, D12] loses rank at poles of A, or of A without what D12 can hide: its
        # least singular value on the limit of stability is at most the distance to that pole then
        inner = A - B @ np.linalg.pinv(D) @ C
        spectra = [np.asarray(la.eigvals(M), dtype=np.complex128) for M in (A, inner)]
        points: dict[complex, float] = {}  # integrating modes of several axes share one
        for s, distance in (point for poles in spectra for point in _limit(p, poles)):
            points[s] = max(distance, points.get(s, 0.0))
        for s, distance in points.items():
            pencil = np.block([[A - s * np.eye(len(A)), B], [C, D]])
            if la.svdvals(pencil)[-1] <= max(distance, ROOT):
                omega = abs(np.angle(s)) / p.dt if p.direct else abs(s.imag)
                found.append(_MISSED[side].format(f"{p.frequency(omega):.3g} Hz"))
                break
    return tuple(found)


def _limit(p: Prepared, poles: ComplexArray) -> list[tuple[complex, float]]:
    """Return points of the limit of stability at slow poles; distances there, zero in chains.

    A pair has one point: the pencil at the other has the same singular values.
    """
    # relative to the loop's speed: a mode that decays more slowly than poles are known is taken for
    # undamped. A chain of modes (lags in a row) is shown by no more than the product of their
    # decays, so that those up to the fourth root of what is shown at all, 1 %, count
    unit = abs(p.point - 1.0) if p.direct else 1.0
    near = poles[np.abs(np.abs(poles) - 1.0 if p.direct else poles.real) <= CLOSE * unit]
    if p.direct:
        limit = np.where(np.abs(near - 1.0) <= SPLIT * unit, 1.0, near / np.abs(near))
    else:
        limit = 1j * np.where(np.abs(near) <= SPLIT, 0.0, near.imag)
    apart = np.abs(limit[:, None] - near) / unit
    distance = np.diagonal(apart)
    single = distance <= SPLIT
    chosen = single | (np.count_nonzero(apart <= CLOSE, axis=1) > 1)
    chosen &= near.imag >= 0.0
    return list(zip(limit[chosen].tolist(), np.where(single, distance, 0.0)[chosen], strict=True))


def _remedy(ranks: Sequence[str]) -> str:
    """Return what to do about what is lacking, that of D21 where only it lacks rank."""
    effort, noise = (any(one.startswith(name) for one in ranks) for name in ("D12", "D21"))
    cures = ["weight the efforts in z"] * (effort or not noise)
    cures += ["give each sensor noise in w"] * (noise or not effort)
    return " and ".join(cures).capitalize() + "."


def regularised(p: Prepared, level: float, *, modes: bool) -> Prepared:
    """Return a problem with noise on each y and effort for each u, `level` of the channel's size.

    With `modes` w also acts where u does, and z sees what y does: no mode that u reaches and y sees
    is missed then.
    """
    n, nu, ny = p.A.shape[0], p.B2.shape[1], p.C2.shape[0]
    # a channel that does nothing has the largest size
    size_u, size_y = (
        np.where(own > 0.0, own, np.max(own, initial=0.0) or 1.0) for own in p.own_sizes
    )
    gain = level * p.own_gain
    drive = (gain * p.B2 / size_u)[:, : nu * modes]
    sight = (gain * p.C2 / size_y[:, None])[: ny * modes]
    mu, my = drive.shape[1], len(sight)
    return p.replace(
        B1=np.hstack([p.B1, drive, np.zeros((n, ny))]),
        C1=np.vstack([p.C1, sight, np.zeros((nu, n))]),
        D11=la.block_diag(p.D11, np.zeros((my + nu, mu + ny))),
        D12=np.vstack([p.D12, np.zeros((my, nu)), level * np.diag(size_u)]),
        D21=np.hstack([p.D21, np.zeros((ny, mu)), level * np.diag(size_y)]),
        u_scale=np.eye(nu),
        y_scale=np.eye(ny),
    ).with_unit_channels()


class _Found(NamedTuple):
    level: float
    K: StateSpace
    gamma: float
    notes: tuple[str, ...] = ()

    @property
    def speed(self) -> float:
        return float(np.max(np.abs(self.K.poles()), initial=0.0))

    def settles(self, finer: _Found) -> bool:
        """Return whether a tenth of what is added gains next to nothing."""
        return self.gamma <= finer.gamma * (1.0 + NEGLIGIBLE)


def made_regular(
    problem: Prepared,
    solve: Callable[[Prepared], SolvedController],
    lack: Lacking,
    norm: Callable[[StateSpace], float] = hinf_norm,
) -> SolvedController:
    """Return the controller of a singular problem, found with a little noise and effort added."""
    found: list[_Found] = []
    for level in LEVELS:
        try:
            regular = regularised(problem, level, modes=bool(lack.modes))
            found.append(_judged(problem, regular, solve(regular), level, norm))
        except FlexplantError:  # rounding hides what is smaller
            if not found:
                raise
            break
        if len(found) > 1 and found[-2].settles(found[-1]):
            break
    _require_positive_infimum(problem, found, lack)
    return _with_notes(found, lack, problem)


def _judged(
    given: Prepared,
    regular: Prepared,
    found: SolvedController,
    level: float,
    norm: Callable[[StateSpace], float],
) -> _Found:
    """Return the controller for one level, judged on the problem itself."""
    u, y = regular.u_scale, regular.y_scale
    parts = found.A, found.B @ y, u @ found.C, u @ found.D @ y
    K = StateSpace(*parts, inputs=given.y, outputs=given.u, dt=given.system.dt)
    gamma = norm(lft(given.system, K))
    if not np.isfinite(gamma):
        raise SolverError(
            f"with noise and effort of {level:.0e} added, the controller does not "
            "stabilise in rounding, or a mode that z and w miss stays on the edge of stability. "
            "Weight the efforts and that motion in z, and give each sensor noise in w."
        )
    return _Found(level, K, gamma, found.notes)


def _require_positive_infimum(problem: Prepared, found: Sequence[_Found], lack: Lacking) -> None:
    gammas = [one.gamma for one in found]
    least = int(np.argmin(gammas))
    settled = any(later < _SETTLED * gammas[least] for later in gammas[least + 1 :])
    gammas = gammas[: least + 1]
    if len(gammas) < 3 or settled or gammas[-1] > CLOSE * gammas[0]:
        return
    # rounding may hold the last one up
    if gammas[-2] > _FALL * gammas[-3] or gammas[-1] * _SETTLED > gammas[-2]:
        return
    raise InfeasibleError(
        f"gamma has no minimum: the infimum is 0. With noise and effort of "
        f"{found[0].level:.0e} to {found[least].level:.0e} added, {gammas[0]:.3g} to "
        f"{gammas[-1]:.3g} are reached by ever larger gains, with which u "
        f"({', '.join(problem.u)}) cancels w in z at no cost. {lack.words}. "
        f"{_remedy(lack.ranks)}"
    )


def _with_notes(found: Sequence[_Found], lack: Lacking, problem: Prepared) -> SolvedController:
    finer = found[-1]
    one = found[-2] if len(found) > 1 and found[-2].settles(finer) else finer
    note = (
        f"{lack.words}. Designed with noise of {one.level:.0e} on each sensor and as much "
        "effort of each actuator, relative to the plant's own channels, and verified without them"
    )
    if finer is not one and finer.gamma:
        cost = max(100.0 * (one.gamma / finer.gamma - 1.0), 0.0)
        note += f"; a tenth of it gives a gamma {cost:.2g} % smaller"
    notes = [note + ".", *one.notes]
    if len(found) < len(LEVELS) and one is finer:
        notes.append(
            f"with less than {one.level:.0e} added the equations are solved in rounding no more: "
            "a smaller gamma may exist."
        )
    if any(not a.settles(b) and a.speed < _FALL * b.speed for a, b in pairwise(found[-3:])):
        notes.append(
            "the smallest gamma is approached by infinite gain only: the controller's fastest pole "
            f"lies at {problem.speed * one.speed:.3g} rad/s and moves on as the added noise falls. "
            f"{_remedy(lack.ranks)[:-1]} to get a slower one."
        )
    K, added = one.K, Verified("added noise", one.level)
    return SolvedController(K.A, K.B, K.C, K.D, one.gamma, 0.0, (added,), tuple(notes))
