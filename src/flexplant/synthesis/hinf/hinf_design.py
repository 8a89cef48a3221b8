"""design_hinf: H-infinity controllers verified by the norm of the closed loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...errors import (
    AssumptionError,
    CertificateError,
    FlexplantError,
    ModelError,
    SolverError,
    attempted,
    counted,
    short,
)
from ...lti.interconnection import lft
from ...lti.norms import hinf_norm
from ...lti.response_solvers import remembered, responder
from ...lti.statespace import StateSpace, System
from ...parallel import one_thread
from ...plant import AnyPlant, StandardPlant, stage_weights
from ...plant.uncertainty.uncertain_plants import UncertainPlant
from ...words import instance
from ..controller import (
    Controller,
    SolvedController,
    SynthesisMethod,
    certified_norm,
    reached_norms,
    with_left_out,
)
from ..preparation import Prepared, posed, prepared, require_reach
from ..scaling import departure_from_normal
from .hinf_riccati import Riccati
from .lower_bound import pointwise_bound, raised_bound
from .moved_design import over_positions
from .singular import require_shown
from .tolerated_modes import ModeChannel, mode_channels, rebalanced, tolerated, with_mode_channels

#: ratio of A to its poles above which a failure is attributed to badly scaled coordinates
_MIXED = 1e3
#: in the certificate: the upper bound of real mu of all uncertain frequencies together
TOLERATED = "all frequencies at once"
#: ratio of gamma to its lower bound up to which bad coordinates may have been harmless
_CLOSE = 1.06
#: relative change of gamma by one rounding of the plant above which no controller is given, and the
#: number of draws of it; the loop is examined where its norm by two routes differs by more
_SENSITIVE, _DRAWS, _FELT = 2e-4, 3, 1e-5


@one_thread()
def design_hinf(
    plant: AnyPlant | UncertainPlant[Any] | System | Mapping[float, StandardPlant],
    method: SynthesisMethod | None = None,
    *,
    bandwidth: float | None = None,
    u: Sequence[str] | None = None,
    y: Sequence[str] | None = None,
    uncertain: UncertainPlant[Any] | None = None,
    damped_below: float = 0.0,
    progress: bool | None = None,
) -> Controller:
    """Return a controller ``u = K y`` that keeps the H-infinity norm of w -> z small.

    Weights define the required norms. For a stage they follow from a bandwidth:
    ``weights = fx.stage_weights(plant, 60.0)``, then
    ``K = fx.design_hinf(plant.weighted(z=weights.z, w=weights.w))``; if `K.gamma` is below 1, all
    their requirements are satisfied. (`design_stage` does both and finds the bandwidth.)
    `mixed_sensitivity` builds a plant from weights of S, KS and T. The controller is verified with
    its closed loop in the original channels: stability, and the norm by two methods;
    ``fx.close_loop(plant, K)`` closes it. How it works: `algorithms`.

    Parameters
    ----------
    plant : StandardPlant, UncertainPlant or mapping {position: StandardPlant}
        Usually weighted; continuous or sampled. For a moving machine, a mapping by position
        (``{x: plant.at(x=x) for x in places}``): one controller for all positions is designed on
        the mean plant, with channels that tolerate the motion; `gamma` is then the worst norm, and
        the certificate has those of all positions and half way between. A StateSpace (also of
        python-control) is accepted too, if its channels are named as in a StandardPlant, or if u
        and y are given.
    method : Riccati or Lmi, optional
        By default `Riccati()`, which adds a little noise and effort where D12 or D21 is
        singular, and a little disturbance where w or z misses an undamped mode. `Lmi()` finds
        gamma by a semidefinite program and suits up to 30 states.
    bandwidth : float [Hz], optional
        For a stage without weights: those of `stage_weights` are used, for the POI's only
        reference. `design_stage` finds the largest possible one.
    u, y : sequences of str, optional
        For a StateSpace: inputs that the controller drives, and outputs that it reads.
    uncertain : UncertainPlant, optional
        Uncertainty of the plant that was weighted, ``plant.uncertain(frequency=0.005)``: the design
        tolerates its frequencies. Not needed where the plant itself is uncertain, or was made from
        ``uncertain.nominal`` by weights. Each mode gets a channel through which a change of its
        frequency acts, scaled by the disturbances and with the shift of real mu. The problem is
        solved twice; in between, the scales are balanced in closed loop. `gamma` then includes
        these channels (above 1 is not a failure). `certificate` has ``all frequencies at once``:
        below 1, no machine of the uncertainty has a pole on the grid.
        ``ClosedLoop.mode_tolerances`` gives the allowed error of each.
    damped_below : float [Hz]
        Uncertain modes below it that actuators push are damped, not only tolerated: their channel
        then covers errors of 1 % and of their shapes. `design_stage` has 3.5 times the bandwidth.
    progress : bool, optional
        Whether to show a progress bar of the method's steps. None: on a terminal or in a
        notebook, for work of more than two seconds.

    Returns
    -------
    Controller
        `gamma` is the verified norm, `lower` a lower bound for any controller, `certificate` holds
        the checks, `reached` the norm of each block of the weights, `left_out` the check with
        truncated modes.

    Raises
    ------
    AssumptionError
        When an assumption of the method fails; the message names it in physical terms.
    InfeasibleError, SolverError
        When no stabilising controller was found, or gamma has the infimum zero.
    CertificateError
        When the closed loop exceeds the claimed norm, or its norm is not finite.
    ModelError
        When the plant or the method is of another type, or a sampled plant has a pole at z = -1.

    Warns
    -----
    FlexplantWarning
        When truncated modes make the loop unstable, or raise |S| at u above 8 dB; it names them.

    References
    ----------
    [GloverDoyle1988]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> errors, weights = fx.reference_errors(plant), fx.stage_weights(plant, 20.0)
    >>> controller = fx.design_hinf(plant.through(errors).weighted(z=weights.z, w=weights.w))
    >>> controller.gamma < 1  # all that the weights require is reached
    True
    >>> fx.close_loop(plant, errors, controller).is_stable
    True
    """
    if method is not None and not hasattr(method, "solve"):
        raise ModelError(
            f"method must be Riccati(...) or Lmi(...), got {short(method)}. Pass one, or none."
        )
    if isinstance(plant, Mapping):
        if uncertain is not None:
            raise ModelError(
                "plants by position are designed for as they are: leave out uncertain=, and check "
                "the loop at each position."
            )
        posed_at = {x: posed(one, u, y, "H-infinity synthesis") for x, one in plant.items()}
        if bandwidth is not None and posed_at:
            middle = list(posed_at.values())[len(posed_at) // 2]
            weights = stage_weights(middle, bandwidth)
            posed_at = {x: one.weighted(weights) for x, one in posed_at.items()}
        return over_positions(posed_at, lambda one: _design_one(one, method, progress), progress)
    plant = posed(plant, u, y, "H-infinity synthesis")
    if bandwidth is not None:
        plant = plant.weighted(stage_weights(plant, bandwidth, uncertainty=uncertain))
    known = plant.uncertainty if uncertain is None else uncertain
    if uncertain is not None or (known is not None and known.frequencies):
        instance(known, UncertainPlant, "uncertain", "Make it by plant.uncertain(frequency=0.005).")
        found = tolerant(plant, evened(plant, known, method, damped_below), known, method, progress)
    else:
        found = _design_one(plant, method, progress)
    return with_left_out(found, plant)


class Evened(NamedTuple):
    """Channels for modes, scaled in closed loop, and gamma before they were."""

    channels: tuple[ModeChannel, ...]
    first: float


def tolerant(
    plant: AnyPlant,
    given: Evened,
    uncertain: UncertainPlant[Any],
    method: SynthesisMethod | None = None,
    progress: bool | None = None,
    found: SolvedController | None = None,
) -> Controller:
    """Return the verified controller of a plant with channels for its modes.

    `found`: what the method has found for it already.
    """
    channels = given.channels
    answer = _design_one(with_mode_channels(plant, channels), method, progress, found)
    scales = {one.mode: one.D for one in channels}
    stated = [one.replace(D=scales[one.mode]) for one in mode_channels(plant, uncertain)]
    share = tolerated(stated, with_mode_channels(plant, stated), answer.system)
    return answer.replace(
        certificate=answer.certificate | {TOLERATED: share},
        reached={},  # of the weights, without the channels of modes
        tried={"before the scales were evened out": given.first, "after": answer.gamma},
        notes=(
            *answer.notes,
            f"gamma is with a channel for each of {counted(len(channels), 'mode')}",
        ),
    )


def evened(
    plant: AnyPlant,
    uncertain: UncertainPlant[Any],
    method: SynthesisMethod | None = None,
    damped_below: float = 0.0,
) -> Evened:
    """Return channels for the modes, their scales evened out in closed loop."""
    channels, first = mode_channels(plant, uncertain, damped_below), np.inf
    # only the scales depend on it: if it fails, the design itself reports why
    with attempted("evening out the scales of modes"):
        opened = with_mode_channels(plant, channels)
        # by a whole search: scales of a quick one jump with the weights, and designs with them
        loop, found = solved(opened, method or Riccati(progress=False))
        channels, first = rebalanced(channels, opened, loop), found.gamma
    return Evened(channels, first)


def solved(plant: AnyPlant, method: SynthesisMethod) -> tuple[StateSpace, SolvedController]:
    """Return the controller that a method finds, not verified, and the method's own results."""
    problem = prepared(plant.system, plant.u, plant.y)
    found = method.solve(problem)
    return problem.restored(found.A, found.B, found.C, found.D), found


def _design_one(
    plant: AnyPlant,
    method: SynthesisMethod | None,
    progress: bool | None,
    found: SolvedController | None = None,
) -> Controller:
    """Return the verified controller of a plant."""
    problem = prepared(plant.system, plant.u, plant.y)
    method = method or Riccati()
    if progress is not None and isinstance(method, Riccati):
        method = method.replace(progress=progress)
    try:
        require_reach(problem)
        if plant.modal_blocks.size:  # for any method: this motion would drift
            require_shown(problem)
        if found is None:
            found = method.solve(problem)
        answer = _verified(plant, problem, type(method).__name__, found)
        norm = float(answer.gamma or 0.0)
        lower = raised_bound(problem, norm, max(found.lower, pointwise_bound(problem)))
        _require_known(problem, norm, lower)
    except (AssumptionError, SolverError, CertificateError) as error:
        raise _blamed(problem, error) from error
    return answer.replace(lower=lower)


def _require_known(problem: Prepared, gamma: float, lower: float) -> None:
    """Raise SolverError when rounding in the given coordinates may have made another plant."""
    if problem.departure < _MIXED:
        return
    if gamma > _CLOSE * lower or departure_from_normal(problem.A, 1.0) > _MIXED:
        raise SolverError(
            f"a controller with gamma {gamma:.4g} was found, the lower bound is {lower:.4g}, and "
            "both hang on rounding."
        )


def _require_resolved(P: StateSpace, K: StateSpace) -> None:
    """Raise SolverError when one rounding of each entry of the plant moves the loop's norm."""
    gamma, rng, change = hinf_norm(lft(P, K)), np.random.default_rng(0), 0.0
    for _ in range(_DRAWS):
        moved = {
            name: part * (1.0 + np.finfo(float).eps * rng.choice([-1.0, 1.0], size=part.shape))
            for name, part in (("A", P.A), ("B", P.B), ("C", P.C))
        }
        norm = hinf_norm(lft(P.replace(**moved, blocks=None), K))
        change = max(change, abs(norm / gamma - 1.0) if gamma else 0.0)
    if change > _SENSITIVE:
        raise SolverError(
            f"a controller with gamma {gamma:.4g} was found, but one rounding of each entry of A, "
            f"B and C changes it by {100 * change:.2g} %. Loosen the weights, or leave out states "
            "whose gains 16 digits do not resolve."
        )


def _blamed(problem: Prepared, error: FlexplantError) -> FlexplantError:
    """Return the error, or one that names badly scaled states as the reason."""
    if problem.departure < _MIXED:
        return error
    return SolverError(
        f"the coordinates of the plant's states are badly conditioned: A is "
        f"{problem.departure:.1e} times as large as its poles, and rounding of that size hides "
        "what the plant is. Give it in modal, balanced or physical coordinates. "
        f"(What was found in these: {error})"
    )


def _verified(plant: AnyPlant, problem: Prepared, name: str, found: SolvedController) -> Controller:
    """Return what a method found, its norm verified on the plant."""
    K = problem.restored(found.A, found.B, found.C, found.D)
    K = K.replace(name="hinf", units=plant.units)
    loop = lft(plant.system, K)
    respond = remembered(responder(loop))  # swept twice over the same frequencies
    try:
        certificate = certified_norm(loop, found.gamma, respond)
    except CertificateError:
        _require_resolved(plant.system, K)  # the cause, if it is rounding
        raise
    gamma = certificate["norm"]
    # the loops of the method and of the plant are equal: their difference is the effect of rounding
    if problem.departure >= _MIXED or abs(gamma - found.gamma) > _FELT * gamma:
        _require_resolved(plant.system, K)
    return Controller(
        K,
        f"H-infinity by {name}",
        gamma=gamma,
        certificate=certificate | found.certificate,
        reached=reached_norms(plant, loop, respond),
        notes=found.notes,
        tried={f"{name}()": gamma},
    )
