"""design_lmi: one controller for several objectives, each verified by its own norm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...arrays import below_half_rate, positive, whole
from ...certificates import Certificate, Verified
from ...errors import CertificateError, InfeasibleError, ModelError, SolverError, attempted, short
from ...lti.equations import OnAxisError, mean_speed, state_scale
from ...lti.interconnection import lft
from ...lti.norms import peak_gain
from ...lti.statespace import StateSpace, System
from ...parallel import one_thread
from ...plant import AnyPlant, StandardPlant
from ...store import Value, checked
from ...tolerances import CLOSE, NEGLIGIBLE, TINY
from ..controller import Controller
from ..h2 import design_h2
from ..hinf.hinf_design import design_hinf
from ..hinf.hinf_riccati import Riccati, h2_controller
from ..hinf.singular import regularised
from ..pipeline import Design, Solution, designed, posed
from ..preparation import Prepared, beyond_rounding, require_reach
from ..structured.judges import require_finite_h2
from .lmi_programs import Plant, lqg_balanced
from .objectives import H2, Hinf, ObjectivePrograms, PeakGain, PoleRegion

#: rates of decay that are tried for peak gains, relative to the plant's own speed
_RATES = (0.1, 0.3, 1.0, 3.0)
#: steps from the best of them, the last one so small that the optimum is flat within it
_STEPS = tuple(3.0 ** (0.5**i) for i in range(1, 4))
#: number of back-offs that `AutoBackOff` tries: the last one is 500 times the first
_DOUBLINGS = 10
_KINDS = (H2, Hinf, PeakGain)


@dataclass(frozen=True, eq=False)
class AutoBackOff(Value):
    """Sequence of back-offs that `design_lmi` tries, each twice as large as the one before.

    The back-off is the relative distance of the minimised norm from the optimum of the linear
    matrix inequalities (LMIs). Close to the optimum, the gains of the controller may become very
    large, and rounding may violate a bound. The necessary distance is not known in advance.
    `Controller.tried` lists the back-offs that were tried.

    Parameters
    ----------
    first : float
        First back-off that is tried, as a fraction of the optimum.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.AutoBackOff(0.1)
    AutoBackOff(first=0.1)
    """

    first: float = field(default=0.03, metadata=checked(positive))


@one_thread()
def design_lmi(
    plant: AnyPlant | System,
    *,
    minimize: H2 | Hinf | PeakGain,
    subject_to: Sequence[H2 | Hinf | PeakGain | PoleRegion] = (),
    back_off: float | AutoBackOff | None = None,
    max_states: int = 20,
    u: Sequence[str] | None = None,
    y: Sequence[str] | None = None,
) -> Controller:
    """Return a controller that keeps several norms below bounds and minimises one of them.

    For example, a mixed H2/H-infinity design is ``minimize=H2(...), subject_to=[Hinf(...,
    below=...)]``. The problem is solved by linear matrix inequalities (LMIs), in which all
    objectives share one Lyapunov matrix. This makes the problem convex. Its optimum is however only
    an upper bound, so that a better controller may exist. All results are computed again from the
    closed loop: the H-infinity norm by `hinf_norm`, the H2 norm from Gramians, peak gains from the
    impulse response, and poles as eigenvalues.

    Parameters
    ----------
    plant : StandardPlant
        Plant, usually weighted, with at most max_states states. For a sampled plant, the damping
        and the bandwidth of a PoleRegion define a region that is not convex. The poles are then
        kept in a convex part of this region, the intersection of a polygon and a disc.
    minimize : H2, Hinf or PeakGain
        Objective that is minimised; its `below` is not given.
    subject_to : sequence of H2, Hinf, PeakGain (with `below`) and PoleRegion
        Constraints. Each norm has its bound `below`.
    back_off : float or AutoBackOff, optional
        Relative distance of the minimised norm from its optimum. It is needed because the gains of
        the controller may be infinite at the optimum. A number is used as it is. By default,
        ``AutoBackOff()`` tries 3 %, 6 % and so on until a controller keeps all bounds.
    max_states : int
        Largest number of states. Larger problems are refused, because the time grows with the sixth
        power of this number.
    u, y : sequence of str, optional
        As for `design_hinf`.

    Returns
    -------
    Controller
        The controller. `gamma` is the verified norm of the minimised objective, and `reached` holds
        the norm of every objective. The certificate holds the bound of the LMIs for comparison.
        `tried` lists the back-offs with the norm that each reached. For a back-off whose controller
        did not keep a bound, the list has an infinite norm and the reason.

    Raises
    ------
    AssumptionError
        When an H2 norm of a continuous plant includes a direct feedthrough from w to z. Also when u
        does not excite, or y does not measure, a mode that is not stable.
    CertificateError
        When the closed loop does not keep a bound.
    InfeasibleError
        When a bound cannot be kept even if the others are ignored, or the solver proves that no
        controller keeps all of them with one Lyapunov matrix.
    ModelError, LabelError
        When specifications do not fit the plant.
    SolverError
        When the solver stops early, or its result does not satisfy the LMIs.

    References
    ----------
    [Scherer1997]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> slow = fx.lti.low_pass_filter(0.1)
    >>> sys = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=slow, KS=0.1)
    >>> found = fx.synthesis.design_lmi(sys, minimize=fx.synthesis.Hinf())
    >>> found.gamma < 1
    True
    """
    given = posed(plant, u, y, "synthesis by LMIs")
    _check_specifications(given, minimize, subject_to, whole(max_states, "max_states"))
    design = _ObjectiveDesign(minimize, tuple(subject_to), _back_offs(back_off))
    return designed(design, given, given)


def _back_offs(given: Any) -> tuple[float, ...]:
    """Return the back-offs to try: one number, or those of `AutoBackOff`."""
    if given is None or isinstance(given, AutoBackOff):
        first = (given or AutoBackOff()).first
        return tuple(first * 2.0**k for k in range(_DOUBLINGS))
    return (positive(given, "back_off"),)


class _Kept(NamedTuple):
    """A controller, the optimum of the LMIs, the bound of this controller, and all tries."""

    K: StateSpace
    optimum: float
    bound: float
    tried: tuple[Verified, ...]


@dataclass(frozen=True)
class _ObjectiveDesign(Design):
    """The least bound of a norm with one Lyapunov matrix, other norms kept below theirs."""

    minimize: Any
    subject_to: tuple[Any, ...]
    back_offs: tuple[float, ...]

    def prepare(self, plant: AnyPlant) -> ObjectivePrograms:
        scaled = super().prepare(plant)
        require_reach(scaled)
        require_reachable(plant, self.subject_to)
        unit = _size_reached(plant, scaled, self.minimize)
        return ObjectivePrograms(
            plant, _balanced_plant(plant), self.minimize, self.subject_to, unit
        )

    def solve(self, problem: ObjectivePrograms) -> _Kept:
        claim, rate = _best_rate(problem)
        tried: list[Verified] = []
        for back_off in self.back_offs:
            bound = (1.0 + back_off) * claim
            try:
                K = problem.controller(bound, rate)
                reached = _verified_values(problem.given, K, self.minimize, self.subject_to)
            except (SolverError, CertificateError, InfeasibleError, np.linalg.LinAlgError) as error:
                tried.append(Verified(f"back-off {back_off:.3g}", np.inf, str(error), bound))
                continue
            norm = reached[repr(self.minimize)]
            tried.append(Verified(f"back-off {back_off:.3g}", norm, "the closed loop", bound))
            return _Kept(K, claim, bound, tuple(tried))
        raise CertificateError(
            f"the LMIs claim {claim:.6g}, but no controller kept all bounds (back-off "
            f"{self.back_offs[-1]:.3g}): {tried[-1].route} Loosen bounds, add a little noise to "
            "each sensor, or raise back_off."
        )

    def restore(self, plant: AnyPlant, problem: ObjectivePrograms, found: _Kept) -> StateSpace:
        return found.K

    def certify(self, solution: Solution) -> Controller:
        plant, _, K, (_, claim, bound, tried) = solution
        reached = _verified_values(plant, K, self.minimize, self.subject_to)
        return Controller(
            K,
            "several objectives by LMIs",
            gamma=reached[repr(self.minimize)],
            certificate=Certificate(
                (
                    Verified("LMI optimum", claim, "Clarabel"),
                    Verified("LMI bound", bound, "Clarabel"),
                    *reached.checks,
                )
            ),
            reached=reached,
            tried=Certificate(tried),
        )


def _check_specifications(plant: AnyPlant, minimize: Any, subject_to: Any, most: int) -> None:
    """Refuse specifications that do not fit."""
    if not isinstance(minimize, _KINDS) or minimize.below is not None:
        raise ModelError(
            "minimize takes synthesis.H2(...), synthesis.Hinf(...) or synthesis.PeakGain(...) "
            "without below, got "
            f"{short(minimize)}. Pass one norm; its bound is what is found."
        )
    if not isinstance(subject_to, Sequence) or isinstance(subject_to, str):
        raise ModelError(f"subject_to must be a list of specifications, got {short(subject_to)}.")
    for one in (minimize, *subject_to):
        if isinstance(one, PoleRegion):
            if plant.dt and one.bandwidth is not None:
                below_half_rate(one.bandwidth, "bandwidth of poles", 1.0 / plant.dt)
            continue
        if not isinstance(one, _KINDS) or (one is not minimize and one.below is None):
            raise ModelError(
                f"subject_to takes H2, Hinf and PeakGain with below=, and PoleRegion, got "
                f"{short(one)}. Give it the bound that has to hold."
            )
        w, z = one.chosen(plant)
        if isinstance(one, H2):
            require_finite_h2(plant, w, z)
    n = plant.system.n_states
    if not 0 < n <= most:
        raise ModelError(
            f"design_lmi takes plants of 1 to {most} states, got {n}: time grows as n^6. Reduce "
            "the order first, or raise max_states."
        )


def _size_reached(plant: AnyPlant, problem: Prepared, objective: Any) -> float:
    """Return what the controller of least quadratic cost reaches, with some noise and effort."""
    regular = regularised(problem, CLOSE, modes=True)
    try:
        least = h2_controller(regular)
    except (la.LinAlgError, OnAxisError) as error:
        raise SolverError(
            "no controller of least quadratic cost stabilises in rounding: "
            + beyond_rounding(problem)
        ) from error
    B, C, D = least.B @ regular.y_scale, regular.u_scale @ least.C, np.zeros(least.D.shape)
    w, z = objective.chosen(plant)
    loop = lft(plant.system, problem.restored(least.A, B, C, D))
    size = float(objective.measured(loop.select(z, w))) if loop.is_stable else np.inf
    if not np.isfinite(size):
        raise SolverError(
            "the controller of least quadratic cost does not stabilise in rounding: "
            + beyond_rounding(problem)
        )
    return size or 1.0  # w may reach nothing in z


def _balanced_plant(plant: AnyPlant) -> Plant:
    """Return the plant in balanced states and units, its w and z unchanged."""
    g = plant.system
    d = state_scale(g.A, g.B, g.C)
    m, p = len(plant.w), len(plant.z)
    A, B, C, D = g.A * d / d[:, None], g.B / d[:, None], g.C * d, g.D
    found = Plant(
        A, B[:, :m], B[:, m:], C[:p], C[p:], D[:p, :m], D[:p, m:], D[p:, :m],
        np.ones(B.shape[1] - m), np.ones(C.shape[0] - p),
    )  # fmt: skip
    if not plant.dt:
        found = found.timed(mean_speed(g.poles()))
    found = found.with_unit_channels()
    n = A.shape[0]
    # each channel counts alike
    into = found.B1 / np.maximum(np.linalg.norm(found.B1, axis=0), TINY)
    out = found.C1 / np.maximum(np.linalg.norm(found.C1, axis=1), TINY)[:, None]
    # a little of everything: no rank of z or w is assumed
    Q, W = out.T @ out + 1e-6 * np.eye(n), into @ into.T + 1e-6 * np.eye(n)
    nu, ny = found.B2.shape[1], found.C2.shape[0]
    R, V = 0.1 * np.eye(nu), 0.1 * np.eye(ny)
    return lqg_balanced(found, Q, W, R, V, sampled=bool(plant.dt)).with_unit_channels()


def _best_rate(problem: ObjectivePrograms) -> tuple[float, float]:
    """Return the smallest optimum over the rate of decay of peak gains, and that rate."""
    # the two LMIs of a peak gain are convex only for a given rate
    values: dict[float, float] = {}
    failures: list[Exception] = []

    def attempt(*rates: float) -> None:
        for rate in rates:
            try:
                values[rate] = problem.smallest(rate)
            except (SolverError, InfeasibleError) as error:  # no such rate: others have one
                failures.append(error)

    specs = (problem.minimize, *problem.subject_to)
    free = any(isinstance(one, PeakGain) and one.decay is None for one in specs)
    attempt(*(_RATES if free else (1.0,)))
    if not values:
        raise failures[0]
    for ratio in _STEPS if free else ():
        best = min(values, key=values.__getitem__)
        attempt(best / ratio, best * ratio)
    best = min(values, key=values.__getitem__)
    return values[best], best


def _verified_values(
    plant: AnyPlant, K: StateSpace, minimize: Any, subject_to: Sequence[Any]
) -> Certificate:
    """Return what every objective reaches, computed from the closed loop."""
    closed = lft(plant.system, K)
    if not closed.is_stable:
        raise CertificateError("the closed loop is not stable.")
    reached: list[Verified] = []
    for spec in (minimize, *subject_to):
        if isinstance(spec, PoleRegion):
            outside = spec.outside(closed)
            if outside:
                raise CertificateError(
                    f"a pole of the closed loop lies outside its region: {outside}."
                )
            continue
        w, z = spec.chosen(plant)
        value = spec.measured(closed.select(z, w))
        if spec.below is not None and not value <= spec.below * (1.0 + NEGLIGIBLE):
            raise CertificateError(f"{spec!r} is {value:.6g} in the closed loop.")
        reached.append(Verified(repr(spec), value, "the closed loop", spec.below))
    return Certificate(tuple(reached))


#: part of an H2 norm, found with noise or effort added, that no controller reaches either
_CERTAIN = 0.5


def require_reachable(plant: AnyPlant, subject_to: Sequence[Any]) -> None:
    """Raise InfeasibleError when a bound is below what any controller reaches for it alone."""
    # bounds on peaks and regions of poles are not judged, nor what has no optimum
    for spec in subject_to:
        if not isinstance(spec, H2 | Hinf) or spec.below is None:
            continue
        w, z = spec.chosen(plant)
        alone = StandardPlant.from_statespace(
            plant.system.select([*z, *plant.y], [*w, *plant.u]), u=plant.u, y=plant.y
        )
        best = None
        with attempted(f"the best controller for {spec!r} alone"):  # else nothing is refuted
            best = design_h2(alone) if isinstance(spec, H2) else design_hinf(alone, Riccati())
        if best is None:
            continue
        gamma = float(best.gamma or 0.0)
        # a singular H2 problem has an infimum, which noise and effort added miss by a few per cent
        proved = best.lower is not None
        least = best.lower if best.lower is not None else _CERTAIN * gamma
        if least <= spec.below * (1.0 + NEGLIGIBLE):
            continue
        freq = peak_gain(lft(alone.system, best.system))[1]
        raise InfeasibleError(
            f"{spec!r} is beyond every controller: from {', '.join(w)} to {', '.join(z)} none "
            f"reaches less than {f'{least:.4g}' if proved else f'about {gamma:.4g}'}, even "
            f"without the other objectives (the best loop peaks at {freq:.4g} Hz). Raise below, "
            "take lighter weights there, or name fewer w and z."
        )
