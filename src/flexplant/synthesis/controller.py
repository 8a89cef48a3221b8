"""The result of every controller design, with its certificate."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np

from ..arrays import ComplexArray, FloatArray
from ..certificates import (
    Certificate,
    Verified,
    deferred,
    one_line,
    stability,
    stability_check,
    stability_name,
)
from ..errors import CertificateError, FlexplantWarning, counted, warn
from ..loop import ClosedLoop, ModeTolerances, SpillOver, close_loop
from ..loop.on_measurement import NOT_MEASURED
from ..loop.other_machines import warn_of_critical
from ..lti.frequency_sweep import highest, largest_gains, resonance_grid, swept_gains
from ..lti.norms import peak_gain
from ..lti.response_solvers import Responder, responder
from ..lti.statespace import StateSpace
from ..plant import AnyPlant
from ..store import Value
from ..tolerances import NEGLIGIBLE
from .preparation import Prepared


@dataclass(frozen=True, eq=False, repr=False)
class Controller(Value):
    """A controller with named channels, and the numbers that verify it.

    Parameters
    ----------
    system : StateSpace
        System from measurements, references or estimates to actuators; it includes the sign of the
        feedback.
    method : str
        Method of the design.
    gamma : float, optional
        Verified upper bound on the norm of the closed loop from w to z. It is the H-infinity norm,
        or for `design_h2` the H2 norm. Other designs, such as `design_mu`, define gamma on their
        page.
    lower : float, optional
        Lower bound on this norm for all controllers. No controller reaches a smaller norm under the
        conditions that the page of the design states.
    certificate : Certificate
        Numbers that verify the design by a second computation.
    reached : Certificate
        For a weighted design, the norm from each group of channels of w to each group of channels
        of z. The weights require that each norm is at most 1. The largest one is close to gamma.
        For `design_lmi`, the norm of each objective in its unit, with its bound.
    left_out : SpillOver, optional
        Stability and margins of the loop on the plant with the truncated modes, if these are known.
        Truncated modes are modes that the design model leaves out.
    tolerances : ModeTolerances, optional
        For an uncertain plant, the error of each modal frequency at which the loop becomes
        unstable, compared with the uncertainty of this frequency. Results on machines that are
        drawn at random from the uncertainty are included.
    notes : sequence of str
        Remarks, such as what the certificate does not cover.
    structure : FixedOrder, TunedLaws or ObserverGains, optional
        Only for `design_structured`: the given structure, with the parameters found.
    tried : Certificate
        Attempts of the design in their order, each with its gamma. For an attempt that failed,
        gamma is infinite.

    Examples
    --------
    >>> import flexplant as fx
    >>> controller = fx.design_h2(fx.testbeds.three_masses())
    >>> controller.system.inputs, controller.system.outputs
    (('y1', 'y2', 'die:ref'), ('u1',))
    """

    system: StateSpace
    method: str
    gamma: float | None = None
    lower: float | None = None
    certificate: Certificate = field(default_factory=Certificate)
    reached: Certificate = field(default_factory=Certificate)
    left_out: SpillOver | None = None
    notes: tuple[str, ...] = ()
    structure: Value | None = None
    tried: Certificate = field(default_factory=Certificate)
    tolerances: ModeTolerances | None = field(default_factory=lambda: None)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(notes=tuple(self.notes))

    def to_control(self) -> Any:
        """Return the controller as a `control.StateSpace` with the same names."""
        return self.system.to_control()

    def __repr__(self) -> str:
        gamma = "" if self.gamma is None else f", gamma {self.gamma:.4g}"
        if self.gamma is not None and self.lower is not None:
            gamma += f" (lower bound {self.lower:.4g})"
        lines = [f"<Controller {self.method}: {counted(self.system.n_states, 'state')}{gamma}>"]
        if self.reached and not self.reached.keys() <= self.certificate.keys():
            shown = ", ".join(f"{key} {value:.3g}" for key, value in self.reached.items())
            lines.append(f"  reached, of 1 that the weights require: {shown}")
        if self.certificate:
            own = {k: v for k, v in self.certificate.items() if "left out" not in k}
            lines.append(f"  verified: {one_line(own)}")
        if self.left_out is not None:
            lines.append(f"  with the truncated modes: {self.left_out.summary}")
        if self.tolerances is not None:
            lines.append(f"  {self.tolerances.summary}")
        lines += [f"  {note}" for note in self.notes]
        return "\n".join(lines)


class SolvedController(NamedTuple):
    """A controller of the prepared problem, with what its method claims."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    gamma: float
    lower: float
    #: figures for the certificate, and sentences, on how it was found
    checks: tuple[Verified, ...] = ()
    notes: tuple[str, ...] = ()
    #: whether the first gamma above the bound of single frequencies was reached
    at_bound: bool = False


class SynthesisMethod(Protocol):
    """A way to solve the prepared problem: `Riccati()` or `Lmi()`."""

    def solve(self, problem: Prepared) -> SolvedController:
        """Return a controller of the prepared problem."""


#: possible reasons why a controller, given or found, does not stabilise its loop
_SIGN = "Is the sign of the feedback u = K y right, and is it the plant that it was made for?"


#: the route of norms that are checked without Hamiltonian matrices
SWEEP = "a refined sweep over frequency"


def required_stability(loop: StateSpace, cause: str = _SIGN) -> float:
    """Return the spectral abscissa or radius of a closed loop that has to be stable."""
    least = stability(loop.poles(), loop.dt)
    if not least < (1.0 if loop.dt else 0.0):
        raise CertificateError(
            f"the closed loop is not stable ({stability_name(loop.dt)} {least:.6g}): the "
            f"controller is refused. {cause}"
        )
    return least


def certified_norm(loop: StateSpace, claim: float, respond: Responder | None = None) -> Certificate:
    """Return the verified figures of a closed loop: its norm by two methods, and its stability."""
    least = required_stability(loop)
    norm, _ = peak_gain(loop)
    if not np.isfinite(norm):
        raise CertificateError(
            "the norm of the closed loop is infinite within its rounding: a pole is too close to "
            "the edge of stability. Bring the sizes of the weights closer together, or give the "
            "mode damping."
        )
    swept = swept_norm(loop, respond)
    if not abs(norm - swept) <= NEGLIGIBLE * norm:
        raise CertificateError(
            f"two routes to the norm disagree: {norm:.6g} with proof, {swept:.6g} by a sweep. "
            "The loop is too badly conditioned to trust; loosen the weights."
        )
    near = 1.0 + NEGLIGIBLE
    if norm > near * claim:
        raise CertificateError(
            f"the closed loop has the norm {norm:.6g}, but {claim:.6g} was claimed: "
            "the controller is refused."
        )
    return Certificate(
        (
            Verified("norm", norm, "Hamiltonian eigenvalues of the closed loop", near * claim),
            Verified("swept norm", swept, SWEEP, near * norm),
            stability_check(least, loop.dt),
            Verified("claim", claim, "the method"),
        )
    )


class ReachedNorms:
    """Responses (p, m, n) of a loop, and the largest gain so far from each group of w to each of z.

    Groups follow the names that `assemble_plant` gives; one group on each side says nothing new.
    """

    def __init__(self, P: AnyPlant, loop: StateSpace) -> None:
        self.respond = responder(loop)
        w = {"references": ":ref", "noises": ":noise"}
        sides = [_grouped(P.z, {"efforts": ":effort"}, "motions"), _grouped(P.w, w, "disturbances")]
        self._places = {
            f"{to} from {source}": np.ix_(rows, columns)
            for to, rows in sides[0].items()
            for source, columns in sides[1].items()
            if len(sides[0]) * len(sides[1]) > 1
        }
        self._largest = dict.fromkeys(self._places, 0.0)

    def __call__(self, freq: FloatArray) -> ComplexArray:
        """Return the responses at frequencies [Hz]."""
        gain = self.respond(freq)
        for name, places in self._places.items():
            most = self._largest[name]
            self._largest[name] = float(largest_gains(gain[places], most).max(initial=most))
        return gain

    @property
    def norms(self) -> Certificate:
        """The largest gain of each pair of groups, of 1 that the weights require."""
        found = self._largest.items()
        return Certificate(tuple(Verified(what, one, SWEEP, 1.0) for what, one in found))


def reached_norms(P: AnyPlant, loop: StateSpace) -> Certificate:
    """Return the largest gain of a loop from each group of w to each group of z, by a sweep."""
    respond = ReachedNorms(P, loop)
    swept_norm(loop, respond)
    return respond.norms


def _grouped(names: Sequence[str], endings: Mapping[str, str], rest: str) -> dict[str, list[int]]:
    """Return the places of names by group, from their endings; empty groups left out."""
    own = [next((g for g, end in endings.items() if name.endswith(end)), rest) for name in names]
    places = {group: [i for i, one in enumerate(own) if one == group] for group in (rest, *endings)}
    return {group: found for group, found in places.items() if found}


def swept_norm(loop: StateSpace, respond: Responder | None = None) -> float:
    """Return the largest gain over a grid that is refined at resonances and at its own peak."""
    if not loop.D.size:
        return 0.0
    respond = respond or responder(loop)
    if not loop.n_states:
        return float(swept_gains(respond, np.zeros(1))[0])
    grid = np.append(0.0, resonance_grid(loop.poles(), loop.dt))
    swept, _ = highest(lambda freq: swept_gains(respond, freq), grid, 3)
    return swept if loop.dt else max(swept, float(np.linalg.norm(loop.D, 2)))


#: what a high peak means
CLOSE = ", and one that differs a little from the model may be unstable"


def checked_loop(plant: AnyPlant, blocks: Sequence[Any]) -> ClosedLoop | None:
    """Return the loop of a design, with warnings of the effect of modes; None if it is not checked.

    Includes truncated modes, if they are known, and the tolerances of the plant's own modes.
    """
    plain, reading = plant.machine, plant.reading
    whole = plain.evaluation_plant
    before = [] if reading is None else [reading]
    # a block that is read in the place of what is measured, under its names: no loop by names
    renamed = any(set(block.outputs) & set(plain.y) for block in before)
    if whole is None and plain.uncertainty is None and (renamed or not plain.has_own_modes):
        return None
    with warnings.catch_warnings():  # one warning is enough, where the user called from
        warnings.simplefilter("ignore", FlexplantWarning)
        loop = close_loop(plain, *before, *blocks)
    return warned(loop)


def warned(loop: ClosedLoop) -> ClosedLoop:
    """Return a loop, with warnings of the effect of its truncated and of its uncertain modes."""
    found = loop.left_out
    if found is not None and not found.is_fine:
        warn(
            f"with the modes that the plant truncates the loop is {found.summary}. The machine has "
            f"these modes{CLOSE if found.is_high else ''}: choose less bandwidth, keep them in "
            "the plant, or weight the efforts (or roll the controller off) before them."
        )
    warn_of_critical(loop)
    return loop


def with_left_out(
    answer: Controller, plant: AnyPlant, block: StateSpace | None = None
) -> Controller:
    """Return a result with its check on the truncated modes, or a note that they are not known."""
    # the block is its part from the plant's y to u, unless all of its system is
    loop = checked_loop(plant, [answer.system if block is None else block])
    return with_checks(answer, plant, loop)


def with_checks(answer: Controller, plant: AnyPlant, loop: ClosedLoop | None) -> Controller:
    """Return a result with the checks of its loop on truncated and on uncertain modes."""

    def checks() -> list[Verified]:
        others = () if loop is None else (loop.left_out, loop.tolerances)
        known = [answer.certificate, *(one.certificate for one in others if one is not None)]
        return [check for one in known for check in one.checks]

    measured = None if loop is None else loop.on_measurement
    said = NOT_MEASURED if measured is None else measured.summary
    found = answer.replace(certificate=deferred(checks))
    checked: Controller = with_modes(found, plant, loop, said)
    return checked


def with_modes(found: Any, plant: AnyPlant, loop: ClosedLoop | None, *further: str) -> Any:
    """Return a result with its loop on truncated and on uncertain modes, and further notes."""
    left_out = None if loop is None else loop.left_out
    unjudged = (plant.unjudged,) if left_out is None and plant.unjudged else ()
    found = found.replace(left_out=left_out, notes=(*found.notes, *unjudged, *further))
    return found if loop is None else found._put_off(tolerances=lambda: loop.tolerances)
