"""The methods of H-infinity synthesis in turn, each answer judged by its own closed loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from ..errors import FlexplantError, InfeasibleError
from ..lti.interconnection import lft
from ..lti.preparation import Prepared
from ..lti.responses import Responder, remembered, responder
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from .certificate import certified_norm
from .hinf_riccati import Riccati
from .lower_bound import lower_bound, pointwise_bound, raised_bound
from .method import SolvedController, SynthesisMethod
from .singular import ADDED
from .structured_lmi import SmallestGamma, StructuredLmi

#: an answer so close to the lower bound is taken at once (the methods stay 1 to 5 % away from it)
_CLOSE = 1.06
#: and one so close to the best, found earlier, is preferred to it
_SAME = 1.02
#: problems of at most so many states go to the LMIs where no answer is close: where there is one
#: already, and where there is none (their work grows with its sixth power)
_SMALL, _LARGER = 30, 40


class Answer(NamedTuple):
    """A controller of the user's plant, what was verified of its loop, and how it was found."""

    method: SynthesisMethod | None
    found: SolvedController
    controller: StateSpace
    loop: StateSpace
    respond: Responder
    certificate: dict[str, float]
    lower: float
    #: what was tried, and the gamma that each reached
    tried: Mapping[str, float]

    @property
    def gamma(self) -> float:
        """The verified norm."""
        return self.certificate["norm"]

    @property
    def is_close(self) -> bool:
        """Whether no controller can do much better."""
        return self.gamma <= _CLOSE * self.lower


def answered(plant: StandardPlant, problem: Prepared, method: SynthesisMethod) -> Answer:
    """Return the answer of one method, verified on the plant."""
    one = _verified(plant, problem, method, method.solve(problem))
    return one._replace(lower=lower_bound(problem, one.gamma, one.lower))


def best_answer(plant: StandardPlant, problem: Prepared, progress: bool | None) -> Answer:
    """Return the first answer that is close to its lower bound, or the best of all methods."""
    search = _Search(plant, problem)
    riccati = Riccati(progress=progress)
    search.attempt("Riccati()", riccati, riccati.solve)
    small = 0 < problem.A.shape[0] <= (_SMALL if search.answers else _LARGER)
    if not search.is_close and small:
        lmi = StructuredLmi(progress=progress)
        bound = search.bounded(lmi)
    if not search.is_close and not search.has_added:
        added = Riccati(regularised=True, progress=progress)
        search.attempt("Riccati(regularised=True)", added, added.solve)
    if not search.is_close and small and bound is not None:
        search.attempt("StructuredLmi()", lmi, lambda p: lmi.controller(p, bound))
    return search.best()


def idle_answer(plant: StandardPlant, problem: Prepared, failure: FlexplantError) -> Answer:
    """Return no feedback, K = 0, which a stable plant needs none of, with its verified norm."""
    n_u, n_y = len(plant.u), len(plant.y)
    note = f"no feedback (K = 0), which is stable here, because no other was found: {failure}"
    parts = np.zeros((0, 0)), np.zeros((0, n_y)), np.zeros((n_u, 0)), np.zeros((n_u, n_y))
    K = StateSpace(*parts, plant.system.dt, inputs=plant.y, outputs=plant.u)
    found = SolvedController(*parts, np.inf, 0.0, {}, (note,))
    one = _of_loop(plant, None, found, K.replace(name="hinf", units=plant.units))
    return one._replace(lower=min(pointwise_bound(problem), one.gamma))


class _Search:
    """The answers so far, the largest lower bound, and what failed."""

    def __init__(self, plant: StandardPlant, problem: Prepared) -> None:
        self.plant, self.problem = plant, problem
        self.answers: list[Answer] = []
        self.failures: list[tuple[str, FlexplantError]] = []
        #: answers whose loop may be stable with a larger norm than the method claims
        self.broken: list[tuple[SynthesisMethod, SolvedController]] = []
        self.lower = pointwise_bound(problem)
        self.tried: dict[str, float] = {}

    @property
    def is_close(self) -> bool:
        return any(one.gamma <= _CLOSE * self.lower for one in self.answers)

    @property
    def has_added(self) -> bool:
        found = [one.found for one in self.answers] + [one for _, one in self.broken]
        return any(ADDED in one.certificate for one in found)

    def attempt(
        self,
        name: str,
        method: SynthesisMethod,
        solve: Callable[[Prepared], SolvedController],
    ) -> None:
        """Keep the answer of a method, or why it failed."""
        self.tried[name] = np.inf
        try:
            found = solve(self.problem)
        except InfeasibleError:
            if not self.answers:
                raise
            return
        except FlexplantError as error:
            self.failures.append((name, error))
            return
        try:
            one = _verified(self.plant, self.problem, method, found)
        except FlexplantError as error:
            self.failures.append((name, error))
            self.broken.append((method, found))
        else:
            self.answers.append(one)
            self.tried[name] = one.gamma
            known = max(self.lower, one.lower)
            self.lower = raised_bound(self.problem, one.gamma, known)

    def bounded(self, lmi: StructuredLmi) -> SmallestGamma | None:
        """Return what the LMIs say of the smallest gamma, and raise the lower bound to it."""
        try:
            found = lmi.smallest(self.problem)
        except FlexplantError as error:
            self.failures.append(("StructuredLmi()", error))
            return None
        self.lower = max(self.lower, found.lower)
        return found

    def best(self) -> Answer:
        """Return the answer with the smallest gamma, or an earlier one that is as good."""
        for method, found in self.broken if not self.answers else ():
            with suppress(FlexplantError):
                self.answers.append(self._beyond_claim(method, found))
        if self.answers:
            least = min(one.gamma for one in self.answers)
            one = next(one for one in self.answers if one.gamma <= _SAME * least)
            return one._replace(lower=min(self.lower, one.gamma), tried=self.tried)
        (_, first), *others = self.failures
        said = [f"{name}: {'the same' if str(e) == str(first) else e}" for name, e in others]
        raise type(first)(str(first) + (f" (Tried besides: {' '.join(said)})" if said else ""))

    def _beyond_claim(self, method: SynthesisMethod, found: SolvedController) -> Answer:
        """Return an answer whose norm is only what was verified, with a note."""
        one = _verified(self.plant, self.problem, method, found._replace(gamma=np.inf))
        note = (
            f"rounding costs {100 * (one.gamma / found.gamma - 1.0):.2g} % of gamma: "
            f"{found.gamma:.6g} was found for the scaled plant, {one.gamma:.6g} verified for this "
            "one. Its gains are close to infinite; weight the efforts and give the sensors noise."
        )
        return one._replace(
            found=found._replace(notes=(*found.notes, note)),
            certificate=one.certificate | {"claim": found.gamma},
        )


def _verified(
    plant: StandardPlant, problem: Prepared, method: SynthesisMethod, found: SolvedController
) -> Answer:
    K = problem.restored(found.A, found.B, found.C, found.D)
    return _of_loop(plant, method, found, K.replace(name="hinf", units=plant.units))


def _of_loop(
    plant: StandardPlant,
    method: SynthesisMethod | None,
    found: SolvedController,
    controller: StateSpace,
) -> Answer:
    loop = lft(plant.system, controller)
    respond = remembered(responder(loop))  # swept twice over the same frequencies
    certificate = certified_norm(loop, found.gamma, respond)
    tried = {f"{type(method).__name__}()": certificate["norm"]}
    return Answer(method, found, controller, loop, respond, certificate, found.lower, tried)
