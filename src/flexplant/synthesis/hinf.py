"""design_hinf: H-infinity controllers verified by the norm of the closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import AssumptionError, CertificateError, FlexplantError, ModelError, SolverError
from ..lti.interconnection import lft
from ..lti.preparation import Prepared, prepared
from ..lti.responses import remembered, responder
from ..lti.statespace import StateSpace, System
from ..parallel import one_thread
from ..plant import StandardPlant, standard_plant
from ..values import short
from .central import require_shown
from .certificate import certified_norm, reached_norms
from .controller import Controller
from .lower_bound import lower_bound
from .method import SolvedController, SynthesisMethod
from .riccati import Riccati
from .spill_over import spill_over, unchecked
from .structured_lmi import StructuredLmi

#: problems of at most so many states go to the LMIs where the Riccati equations fail
_SMALL = 40
#: A beside its poles, from which on coordinates are blamed for a failure
_MIXED = 1e3


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
        Unless given `Riccati()`, which adds a little noise and effort where D12 or D21 is
        singular, and `StructuredLmi()` for small problems on which it fails. `StructuredLmi()`
        needs none of it, up to some 60 states; `Lmi()` is its readable form for less than 30.
    u, y : sequences of str, optional
        Channels of the controller, for a StateSpace.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        A model with the modes that the plant left out, as for `larger_plant`: the loop is checked
        there too, sampled and delayed alike. Unless given, with those that the plant's reduced
        model still has.
    progress : bool, optional
        True shows a bar of the method's steps at once, False never; None after two seconds on a
        terminal. `Lmi()` shows none.

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
        When no stabilising controller was found.
    CertificateError
        When the closed loop does not keep the promise.
    ModelError
        When the plant or the method is of another type, a sampled plant has a pole at z = -1, or
        `larger` does not go with the plant.

    Warns
    -----
    FlexplantWarning
        When the modes left out make the loop unstable, or bring |S| at u above 8 dB; it names them.

    References
    ----------
    Glover, Doyle, State-space formulae for all stabilizing controllers that satisfy an
    H-infinity-norm bound, Systems & Control Letters 11, 1988.
    """
    if u is None and y is None:
        plant = standard_plant(plant)
    elif isinstance(plant, StandardPlant):
        raise ModelError("a StandardPlant names its u and y: leave them out.")
    else:
        plant = StandardPlant.from_statespace(plant, u=u, y=y)
    if method is not None and not hasattr(method, "solve"):
        raise ModelError(
            f"method must be Riccati(...), StructuredLmi(...) or Lmi(...), got {short(method)}. "
            "Pass one, or none."
        )
    _require_channels(plant)
    if plant.is_assembled:  # it can name the rigid-body motion that is missed
        plant.check().require(("stabilisable", "detectable"), "H-infinity synthesis")
    problem = prepared(plant.system, plant.u, plant.y)
    try:
        method, found, controller = _designed(plant, problem, method, progress)
        loop = lft(plant.system, controller)
        respond = remembered(responder(loop))  # swept twice over the same frequencies
        certificate = certified_norm(loop, found.gamma, respond)
    except (AssumptionError, SolverError, CertificateError) as error:
        raise _blamed(problem, error) from error
    reached = reached_norms(plant, loop, respond)
    left_out = spill_over(plant, [controller], larger)
    return Controller(
        controller,
        f"H-infinity by {type(method).__name__}",
        gamma=certificate["norm"],
        lower=lower_bound(problem, certificate["norm"], found.lower),
        certificate=certificate
        | dict(found.certificate)
        | (left_out.certificate if left_out is not None else {}),
        reached=reached,
        left_out=left_out,
        notes=(*found.notes, *(() if left_out is not None else unchecked(plant))),
    )


def _require_channels(plant: StandardPlant) -> None:
    """Raise AssumptionError when there is no w, z, u or y."""
    roles = {
        "w": "disturbance or noise",
        "z": "output to be kept small",
        "u": "actuator",
        "y": "sensor",
    }
    for name, role in roles.items():
        if not getattr(plant, name):
            others = ", ".join(f"{len(getattr(plant, one))} {one}" for one in roles if one != name)
            raise AssumptionError(
                f"H-infinity synthesis needs channels w, z, u and y, got a plant without {name} "
                f"({others}). Add a channel {name} ({role})."
            )


def _designed(
    plant: StandardPlant,
    problem: Prepared,
    method: SynthesisMethod | None,
    progress: bool | None,
) -> tuple[SynthesisMethod, SolvedController, StateSpace]:
    """Return the method, its answer, and the controller in the user's channels and units."""
    _require_reach(problem)
    if plant.is_assembled:  # whatever a method makes of it: this motion would drift
        require_shown(problem)
    if method is None:
        method, found = _solved(problem, progress)
    else:
        if progress is not None and isinstance(method, (Riccati, StructuredLmi)):
            method = method.replace(progress=progress)
        found = method.solve(problem)
    controller = problem.restored(found.A, found.B, found.C, found.D).replace(
        name="hinf", units=plant.units
    )
    return method, found, controller


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


def _solved(problem: Prepared, progress: bool | None) -> tuple[SynthesisMethod, SolvedController]:
    """Return the answer by Riccati equations, of a small problem that they fail on by LMIs."""
    first: SynthesisMethod = Riccati(progress=progress)
    try:
        return first, first.solve(problem)
    except SolverError as error:
        if problem.A.shape[0] > _SMALL:
            raise
        second = StructuredLmi(progress=progress)
        try:
            return second, second.solve(problem)
        except FlexplantError:
            raise error from None


def _require_reach(problem: Prepared) -> None:
    """Raise AssumptionError when u does not reach, or y does not see, a pole that is not stable.

    Weights included. Hautus' rank test in the prepared coordinates, whatever the user's units.
    """
    A = problem.A
    poles = np.linalg.eigvals(A)
    size = max(float(np.linalg.norm(A, 2)) if A.size else 0.0, 1e-300)
    # the poles of a chain of integrators come out of rounding as a ring around zero
    poles = np.where(np.abs(poles) < 1e-6 * size, 0.0, poles)
    for pole in poles[poles.real > -1e-10 * size]:
        for matrix, gain, text in (
            (A, problem.B2, f"u ({', '.join(problem.u)}) does not reach"),
            (A.T, problem.C2.T, f"y ({', '.join(problem.y)}) does not see"),
        ):
            reach = size * gain / max(float(np.linalg.norm(gain, 2)), 1e-300)
            pencil = np.hstack([matrix - pole * np.eye(A.shape[0]), reach])
            if np.linalg.svd(pencil, compute_uv=False)[-1] < 1e-12 * size:
                raise AssumptionError(
                    f"{text} a mode of the plant or of a weight that is not stable "
                    f"({_described(problem, complex(pole))}): no controller can stabilise it. "
                    "Add or move an actuator or a sensor, or give the weight finite gain."
                )


def _described(problem: Prepared, pole: complex) -> str:
    if pole.imag:
        return f"at {problem.frequency(abs(pole.imag)):.3g} Hz"
    if pole.real > 1e-6:
        return f"it grows e-fold in {1.0 / (problem.speed * pole.real):.3g} s"
    return "at 0 Hz: rigid-body or integrating"
