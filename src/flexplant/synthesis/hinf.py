"""design_hinf: H-infinity controllers verified by the norm of the closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import (
    AssumptionError,
    CertificateError,
    FlexplantError,
    ModelError,
    SolverError,
    warn,
)
from ..lti.interconnection import lft
from ..lti.norms import hinf_norm
from ..lti.preparation import Prepared, departure_from_normal, prepared
from ..lti.statespace import StateSpace, System
from ..parallel import one_thread
from ..plant import StandardPlant
from ..values import short
from .attempts import Answer, answered, best_answer, idle_answer
from .central import require_shown
from .certificate import reached_norms
from .controller import Controller
from .hinf_riccati import Riccati
from .lmi import Lmi
from .method import SynthesisMethod
from .reach import posed, require_reach
from .spill_over_check import with_left_out
from .structured_lmi import StructuredLmi

#: A beside its poles, from which on coordinates are blamed for a failure
_MIXED = 1e3
#: relative change of gamma by rounding of such a plant for which they are, over so many draws
_SENSITIVE, _DRAWS = 2e-4, 3


@one_thread()
def design_hinf(
    plant: StandardPlant | System,
    method: SynthesisMethod | None = None,
    *,
    u: Sequence[str] | None = None,
    y: Sequence[str] | None = None,
    larger: Any = None,
    progress: bool | None = None,
) -> Controller:
    """Return a controller ``u = K y`` that keeps the H-infinity norm of w -> z small.

    The plant is prepared (scaled, balanced; a sampled one is mapped to continuous time with its
    norms kept), solved by the method, and the controller is brought back to the user's channels
    and units. It is then judged by its own closed loop: stability, and the norm by two routes.

    Parameters
    ----------
    plant : StandardPlant
        Usually weighted; continuous or sampled. A labelled StateSpace (ours or python-control's)
        serves too: by the names of its channels, or with u and y named.
    method : Riccati, StructuredLmi or Lmi, optional
        Unless given they are tried in turn until one is verified close to its lower bound, else
        the best one is taken: `Riccati()`, which adds a little noise and effort where D12 or D21
        is singular; `Riccati(regularised=True)`, which adds them anyway; `StructuredLmi()`, which
        needs none, up to 40 states. `Lmi()` is its readable form for less than 30. Where all fail,
        a stable plant is left without feedback, K = 0, and the notes say why.
    u, y : sequences of str, optional
        Channels of the controller, for a StateSpace.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        A model with the modes that the plant left out, as for `larger_plant`: the loop is checked
        there too, sampled and delayed alike. Unless given, with those that the plant's reduced
        model still has.
    progress : bool, optional
        True shows a bar of the method's steps at once, False never; None after two seconds on a
        terminal.

    Returns
    -------
    Controller
        `gamma` is the verified norm, `lower` a bound from below on what any controller reaches
        (where it comes from LMIs: with Lyapunov matrices up to ten times as large as those that
        they found), `certificate` what was checked, `reached` what is reached of each block of
        the weights, `left_out` the check with the modes left out.

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
        When the plant or the method is of another type, a sampled plant has a pole at z = -1, or
        `larger` does not go with the plant.

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
            f"method must be Riccati(...), StructuredLmi(...) or Lmi(...), got {short(method)}. "
            "Pass one, or none."
        )
    plant = posed(plant, u, y, "H-infinity synthesis")
    problem = prepared(plant.system, plant.u, plant.y)
    try:
        require_reach(problem)
        if plant.is_assembled:  # whatever a method makes of it: this motion would drift
            require_shown(problem)
        if method is None:
            answer = best_answer(plant, problem, progress)
        else:
            if progress is not None and isinstance(method, (Riccati, StructuredLmi, Lmi)):
                method = method.replace(progress=progress)
            answer = answered(plant, problem, method)
        _require_known(plant, problem, answer)
    except (AssumptionError, SolverError, CertificateError) as error:
        blamed = _blamed(problem, error)
        named = isinstance(error, AssumptionError)  # what physically lacks is not for a note
        if named or method is not None or not plant.system.is_stable:
            raise blamed from error
        try:
            answer = idle_answer(plant, problem, blamed)
        except FlexplantError:
            raise blamed from error
        warn(answer.found.notes[0])
    found = answer.found
    one = Controller(
        answer.controller,
        f"H-infinity by {type(answer.method).__name__}" if answer.method else "no feedback",
        gamma=answer.gamma,
        lower=answer.lower,
        certificate=answer.certificate | dict(found.certificate),
        reached=reached_norms(plant, answer.loop, answer.respond),
        notes=found.notes,
        tried=answer.tried,
    )
    return with_left_out(one, plant, larger)


def _require_known(plant: StandardPlant, problem: Prepared, answer: Answer) -> None:
    """Raise SolverError when rounding in the given coordinates may have made another plant."""
    if problem.departure < _MIXED:
        return
    if departure_from_normal(problem.A) > _MIXED or not answer.is_close:
        raise SolverError(
            f"a controller with gamma {answer.gamma:.4g} was found, the lower bound is "
            f"{answer.lower:.4g}, and both hang on rounding."
        )
    change = _moved_by_rounding(plant.system, answer)
    if change > _SENSITIVE:
        raise SolverError(
            f"a controller with gamma {answer.gamma:.4g} was found, but one rounding of each entry "
            f"of A, B and C changes it by {100 * change:.2g} %."
        )


def _moved_by_rounding(P: StateSpace, answer: Answer) -> float:
    """Return by how much the loop's norm changes, relative, with the last digits of the plant."""
    rng, change = np.random.default_rng(0), 0.0
    for _ in range(_DRAWS):
        moved = {
            name: part * (1.0 + np.finfo(float).eps * rng.choice([-1.0, 1.0], size=part.shape))
            for name, part in (("A", P.A), ("B", P.B), ("C", P.C))
        }
        gain = hinf_norm(lft(P.replace(**moved, blocks=None), answer.controller))
        change = max(change, abs(gain / answer.gamma - 1.0) if answer.gamma else 0.0)
    return change


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
