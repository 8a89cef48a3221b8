"""design_hinf: H-infinity controllers verified by the norm of the closed loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...checks import instance, short
from ...errors import (
    AssumptionError,
    CertificateError,
    FlexplantError,
    InfeasibleError,
    ModelError,
    SolverError,
    attempted,
    counted,
    warn,
)
from ...lti.interconnection import lft
from ...lti.norms import hinf_norm
from ...lti.responses import remembered, responder
from ...lti.statespace import StateSpace, System
from ...parallel import one_thread
from ...plant import StandardPlant, stage_weights
from ...plant.uncertainty.uncertain_plant import UncertainPlant
from ..controller import (
    Controller,
    SolvedController,
    SynthesisMethod,
    certified_norm,
    reached_norms,
    with_left_out,
)
from ..lmi.lmi_programs import Lmi
from ..preparation import Prepared, departure_from_normal, posed, prepared, require_reach
from .hinf_riccati import Riccati, require_shown
from .lower_bound import pointwise_bound, raised_bound
from .mode_channels import ModeChannel, mode_channels, rebalanced, tolerated, with_mode_channels
from .moved_design import over_positions
from .singular import ADDED

#: A beside its poles, from which on coordinates are blamed for a failure
_MIXED = 1e3
#: in the certificate: the upper bound of real mu of all uncertain frequencies together
TOLERATED = "all frequencies at once"
#: relative change of gamma by rounding of such a plant for which they are, over so many draws
_SENSITIVE, _DRAWS = 2e-4, 3


@one_thread()
def design_hinf(
    plant: StandardPlant | UncertainPlant[Any] | System | Mapping[float, StandardPlant],
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

    Weights say what small is. For a stage they follow from a bandwidth: ``weights =
    fx.stage_weights(plant, 60.0)``, then ``K = fx.design_hinf(plant.weighted(z=weights.z,
    w=weights.w))``; below a `K.gamma` of 1 all that they ask for holds. (`design_stage` does both
    and searches the bandwidth.) `mixed_sensitivity` builds a plant from weights of S, KS and T.
    The controller is judged by its own closed loop, on the user's channels: stability, and the
    norm by two routes; ``fx.close_loop(plant, K)`` closes it. How it works: `algorithms`.

    Parameters
    ----------
    plant : StandardPlant, UncertainPlant or mapping {position: StandardPlant}
        Usually weighted; continuous or sampled. By position, of a machine that moves
        (``{x: plant.at(x=x) for x in places}``): one controller for all, the mean plant with
        channels that tolerate the motion; `gamma` is then the worst norm, the certificate has
        those of all positions and half way between. A labelled StateSpace (ours or
        python-control's) serves too: by the names of its channels, or with u and y named.
    method : Riccati or Lmi, optional
        Unless given `Riccati()`, which adds a little noise and effort where D12 or D21 is singular;
        where what it finds is not close to its lower bound the better of it and
        `Riccati(regularised=True)`, which adds them anyway. `Lmi()` needs no rank and suits up to
        30 states. Where all fail, a stable plant is left without feedback, K = 0, and the notes
        say why.
    bandwidth : float [Hz], optional
        Of a stage that has no weights yet: those of `stage_weights` are used, for the POI's only
        reference. `design_stage` finds the largest that holds.
    u, y : sequences of str, optional
        Channels of the controller, for a StateSpace.
    uncertain : UncertainPlant, optional
        Of the plant that was weighted, ``plant.uncertain(frequency=0.005)``: its frequencies are
        tolerated; not needed where the plant is uncertain itself, or made of
        ``uncertain.nominal`` by weights. Each mode gets a channel by which a change of its
        frequency acts, scaled by the disturbances and with the shift of real mu, and the problem is
        solved twice, the scales evened out in closed loop between. `gamma` is then with these
        channels (above 1 is no failure), `certificate` has ``all frequencies at once``: below 1 no
        machine of the uncertainty has a pole on the grid. ``ClosedLoop.mode_tolerances`` says what
        each may be.
    damped_below : float [Hz]
        Uncertain modes below it that actuators push are damped, not only tolerated: their channel
        then covers errors of 1 % and of their shapes. `design_stage` has 3.5 times the bandwidth.
    progress : bool, optional
        True shows a bar of the method's steps at once, False never; None after two seconds on a
        terminal.

    Returns
    -------
    Controller
        `gamma` is the verified norm, `lower` a bound from below on what any controller reaches,
        `certificate` what was checked, `reached` what is reached of each block of the weights,
        `left_out` the check with the modes left out.

    Raises
    ------
    AssumptionError
        When an assumption of the method fails; the message says which, in physical words.
    InfeasibleError, SolverError
        When no stabilising controller was found; never, but where gamma has the infimum zero, for a
        stable plant when no method is given.
    CertificateError
        When the closed loop misses the norm that was claimed.
    ModelError
        When the plant or the method is of another type, or a sampled plant has a pole at z = -1.

    Warns
    -----
    FlexplantWarning
        When the modes left out make the loop unstable, or bring |S| at u above 8 dB; it names them.
        When a stable plant is left without feedback.

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
        found = tolerant(
            plant, evened(plant, known, method, progress, damped_below), known, method, progress
        )
    else:
        found = _design_one(plant, method, progress)
    return with_left_out(found, plant)


class Evened(NamedTuple):
    """Channels for modes, scaled in closed loop, and gamma before they were."""

    channels: tuple[ModeChannel, ...]
    first: float


def tolerant(
    plant: StandardPlant,
    given: Evened,
    uncertain: UncertainPlant[Any],
    method: SynthesisMethod | None = None,
    progress: bool | None = None,
) -> Controller:
    """Return the verified controller of a plant with channels for its modes."""
    channels = given.channels
    answer = _design_one(with_mode_channels(plant, channels), method, progress)
    scales = {one.mode: one.D for one in channels}
    stated = [one.replace(D=scales[one.mode]) for one in mode_channels(plant, uncertain)]
    share = tolerated(stated, with_mode_channels(plant, stated), answer.system)
    return answer.replace(
        certificate=dict(answer.certificate or {}) | {TOLERATED: share},
        reached={},  # of the weights beside the channels of modes
        tried={"before the scales were evened out": given.first, "after": answer.gamma},
        notes=(
            *answer.notes,
            f"gamma is with a channel for each of {counted(len(channels), 'mode')}",
        ),
    )


def evened(
    plant: StandardPlant,
    uncertain: UncertainPlant[Any],
    method: SynthesisMethod | None = None,
    progress: bool | None = None,
    damped_below: float = 0.0,
) -> Evened:
    """Return channels for the modes, their scales evened out in closed loop."""
    channels, first = mode_channels(plant, uncertain, damped_below), np.inf
    # only the scales hang on it: where it fails, the design itself says all
    with attempted("evening out the scales of modes"):
        opened = with_mode_channels(plant, channels)
        loop, found = solved(opened, method or Riccati(progress=progress))
        channels, first = rebalanced(channels, opened, loop), found.gamma
    return Evened(channels, first)


def solved(plant: StandardPlant, method: SynthesisMethod) -> tuple[StateSpace, SolvedController]:
    """Return the controller that a method finds, not verified, and what it says of it."""
    problem = prepared(plant.system, plant.u, plant.y)
    found = method.solve(problem)
    return problem.restored(found.A, found.B, found.C, found.D), found


def _design_one(
    plant: StandardPlant, method: SynthesisMethod | None, progress: bool | None
) -> Controller:
    """Return the verified controller of a plant."""
    problem = prepared(plant.system, plant.u, plant.y)
    try:
        require_reach(problem)
        if plant.is_assembled:  # whatever a method makes of it: this motion would drift
            require_shown(problem)
        if method is None:
            answer = best_answer(plant, problem, progress)
        else:
            if progress is not None and isinstance(method, (Riccati, Lmi)):
                method = method.replace(progress=progress)
            answer = _certified_answer(plant, problem, method, method.solve(problem))
            lower = max(answer.lower, pointwise_bound(problem))
            answer = answer._replace(lower=raised_bound(problem, answer.gamma, lower))
        _require_known(plant, problem, answer)
    except (AssumptionError, InfeasibleError, SolverError, CertificateError) as error:
        blamed = _blamed(problem, error)
        if isinstance(blamed, InfeasibleError):  # of this plant, whatever its coordinates
            raise
        named = isinstance(error, AssumptionError)  # what physically lacks is not for a note
        if named or method is not None or not plant.system.is_stable:
            raise blamed from error
        try:
            answer = idle_answer(plant, problem, blamed)
        except FlexplantError:
            raise blamed from error
        warn(answer.controller.notes[0])
    return answer.controller.replace(lower=answer.lower)


def _require_known(plant: StandardPlant, problem: Prepared, answer: Answer) -> None:
    """Raise SolverError when rounding in the given coordinates may have made another plant."""
    if problem.departure < _MIXED:
        return
    if departure_from_normal(problem.A) > _MIXED or not answer.is_close:
        raise SolverError(
            f"a controller with gamma {answer.gamma:.4g} was found, the lower bound is "
            f"{answer.lower:.4g}, and both hang on rounding."
        )
    P, rng, change = plant.system, np.random.default_rng(0), 0.0
    for _ in range(_DRAWS):
        moved = {
            name: part * (1.0 + np.finfo(float).eps * rng.choice([-1.0, 1.0], size=part.shape))
            for name, part in (("A", P.A), ("B", P.B), ("C", P.C))
        }
        gain = hinf_norm(lft(P.replace(**moved, blocks=None), answer.controller.system))
        change = max(change, abs(gain / answer.gamma - 1.0) if answer.gamma else 0.0)
    if change > _SENSITIVE:
        raise SolverError(
            f"a controller with gamma {answer.gamma:.4g} was found, but one rounding of each entry "
            f"of A, B and C changes it by {100 * change:.2g} %."
        )


def _blamed(problem: Prepared, error: FlexplantError) -> FlexplantError:
    """Return the error, or one that blames the coordinates of the states where these are bad."""
    if problem.departure < _MIXED:
        return error
    return SolverError(
        f"the coordinates of the plant's states are badly conditioned: A is "
        f"{problem.departure:.1e} times as large as its poles, and rounding of that size hides "
        "what the plant is. Give it in modal, balanced or physical coordinates. "
        f"(What was found in these: {error})"
    )


#: an answer so close to the lower bound is taken at once (`Riccati` stays 1 to 5 % away from it)
_CLOSE = 1.06
#: and one so close to the best, found earlier, is preferred to it
_SAME = 1.02


class Answer(NamedTuple):
    """A controller, the norm of its loop that was verified, and a bound on what any reaches."""

    gamma: float
    lower: float
    controller: Controller

    @property
    def is_close(self) -> bool:
        """Whether no controller can do much better."""
        return self.gamma <= _CLOSE * self.lower


def best_answer(plant: StandardPlant, problem: Prepared, progress: bool | None) -> Answer:
    """Return the answer of `Riccati`, or where it is not close to its bound the better of two."""
    answers: list[Answer] = []
    #: answers whose loop may be stable with a larger norm than the method claims
    broken: list[tuple[SynthesisMethod, SolvedController]] = []
    failures: dict[str, FlexplantError] = {}
    tried: dict[str, float] = {}
    lower = pointwise_bound(problem)
    for name, regularised in (("Riccati()", None), ("Riccati(regularised=True)", True)):
        method = Riccati(regularised=regularised, progress=progress)
        tried[name], found = np.inf, None
        try:
            found = method.solve(problem)
            one = _certified_answer(plant, problem, method, found)
        except FlexplantError as error:
            if found is None and isinstance(error, InfeasibleError) and not answers:
                raise
            failures[name] = error
            if found is not None:
                broken.append((method, found))
        else:
            answers.append(one)
            tried[name] = one.gamma
            lower = raised_bound(problem, one.gamma, max(lower, one.lower))
        added = found is not None and ADDED in found.certificate
        if added or any(one.gamma <= _CLOSE * lower for one in answers):
            break
    if not answers:
        for tried_method, claimed in broken:
            with attempted("another controller than that which was claimed"):
                answers.append(_beyond_claim(plant, problem, tried_method, claimed))
        if not answers:
            raise _failure(failures)
    least = min(one.gamma for one in answers)
    if np.isfinite(least):  # of a broken answer too
        lower = raised_bound(problem, least, lower)
    best = next(one for one in answers if one.gamma <= _SAME * least)
    return Answer(best.gamma, min(lower, best.gamma), best.controller.replace(tried=tried))


def _failure(failures: Mapping[str, FlexplantError]) -> FlexplantError:
    """Return the first failure, which says what failed besides."""
    (_, first), *others = failures.items()
    said = [f"{name}: {'the same' if str(e) == str(first) else e}" for name, e in others]
    return type(first)(str(first) + (f" (Tried besides: {' '.join(said)})" if said else ""))


def _beyond_claim(
    plant: StandardPlant, problem: Prepared, method: SynthesisMethod, found: SolvedController
) -> Answer:
    """Return an answer whose norm is only what was verified, with a note."""
    one = _certified_answer(plant, problem, method, found._replace(gamma=np.inf))
    note = (
        f"rounding costs {100 * (one.gamma / found.gamma - 1.0):.2g} % of gamma: "
        f"{found.gamma:.6g} was found for the scaled plant, {one.gamma:.6g} verified for this "
        "one. Its gains are close to infinite; weight the efforts and give the sensors noise."
    )
    K = one.controller
    certificate = dict(K.certificate or {}) | {"claim": found.gamma}
    return one._replace(controller=K.replace(certificate=certificate, notes=(*K.notes, note)))


def idle_answer(plant: StandardPlant, problem: Prepared, failure: FlexplantError) -> Answer:
    """Return no feedback, K = 0, which a stable plant needs none of, with its verified norm."""
    n_u, n_y = len(plant.u), len(plant.y)
    note = f"no feedback (K = 0), which is stable here, because no other was found: {failure}"
    parts = np.zeros((0, 0)), np.zeros((0, n_y)), np.zeros((n_u, 0)), np.zeros((n_u, n_y))
    one = _certified_answer(
        plant, problem, None, SolvedController(*parts, np.inf, 0.0, {}, (note,))
    )
    if not np.isfinite(one.gamma):  # the poles are stable by no more than their rounding
        raise CertificateError("the norm of the plant without feedback cannot be verified.")
    return one._replace(lower=min(pointwise_bound(problem), one.gamma))


def _certified_answer(
    plant: StandardPlant, problem: Prepared, method: SynthesisMethod | None, found: SolvedController
) -> Answer:
    """Return what a method found as an answer, its norm verified on the plant."""
    K = problem.restored(found.A, found.B, found.C, found.D)
    K = K.replace(name="hinf", units=plant.units)
    loop = lft(plant.system, K)
    respond = remembered(responder(loop))  # swept twice over the same frequencies
    certificate = certified_norm(loop, found.gamma, respond)
    gamma, name = certificate["norm"], type(method).__name__
    controller = Controller(
        K,
        "no feedback" if method is None else f"H-infinity by {name}",
        gamma=gamma,
        certificate=certificate | dict(found.certificate),
        reached=reached_norms(plant, loop, respond),
        notes=found.notes,
        tried={"no feedback" if method is None else f"{name}()": gamma},
    )
    return Answer(gamma, found.lower, controller)
