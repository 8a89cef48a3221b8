"""design_structured: H-infinity with a controller of given structure, verified on every plant."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import CertificateError, InfeasibleError, ModelError
from ..lti.interconnection import lft
from ..lti.preparation import Prepared, prepared
from ..lti.responses import responder
from ..lti.statespace import System
from ..parallel import Progress, one_thread
from ..plant import StandardPlant, standard_plant
from ..values import FloatArray, Rng, generator, positive, short, whole
from .certificate import certified_norm, reached_norms
from .controller import Controller
from .nonsmooth import Minimum, bfgs, sampled_minimum
from .reach import require_stabilisable
from .spill_over_check import with_left_out
from .structured_loop import DECAY, Matrices, ScaledLoop
from .structures import ControllerFamily, ControllerStructure, as_system

#: steps of BFGS for stability and for the norm
_STEPS = 300
#: what the search adds to the norm, relative to it, for parameters of size 1
_SMALL = 1e-6
#: rounds of gradient sampling and BFGS, and what one has to gain for another
_ROUNDS, _ROUND_GAIN = 10, 1e-4
#: of the time, what is for BFGS; the rest is for gradient sampling
_SHARE = 0.7
#: of the time that is left, what each smaller structure takes at most
_QUARTER = 0.25
#: the norm that the search claims and the one verified on the plant as given agree to this
_AGREEMENT = 1e-3
#: relative decrease that is left above which the end is said to be no local minimum
_SHORT = 1e-2


@one_thread()
def design_structured(
    plant: StandardPlant | System | Sequence[StandardPlant],
    structure: ControllerStructure,
    *,
    u: Sequence[str] | None = None,
    y: Sequence[str] | None = None,
    starts: int = 4,
    rng: Rng = 0,
    time_limit: float = 60.0,
    larger: Any = None,
    progress: bool | None = None,
) -> Controller:
    """Return the controller of a structure with the least H-infinity norm found from w to z.

    From several starts the spectral abscissa of the closed loop is lowered until it is stable, then
    the norm, the largest over all plants, by BFGS with its gradient at the peak frequency
    (``d|T| = Re u* dT v``, u and v the singular vectors there). The best is finished by gradient
    sampling, which goes on at kinks, where several peaks are equally high, and reports how far from
    a local minimum it ends. The problem is not convex: another start may do better.

    Parameters
    ----------
    plant : StandardPlant, or sequence of StandardPlant
        Continuous or sampled; one controller for several plants, such as the plant at several POI
        positions, with the same u, y and rate. A labelled StateSpace serves too.
    structure : FixedOrder, TunedLaws, ObserverGains or Parametrised
        What the controller looks like, and where the search begins.
    u, y : sequences of str, optional
        Channels of the controller, for a StateSpace.
    starts : int
        The first is the structure's own, the others are drawn around it.
    rng : int, SeedSequence or Generator
        Draws starts and samples.
    time_limit : float [s]
        The search ends then with the best that it has.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        A model with the modes that the (first) plant left out, as for `larger_plant`.
    progress : bool, optional
        Show a bar; unless given, on a terminal after a while.

    Returns
    -------
    Controller
        `structure` is the one given with the numbers found, of `TunedLaws` the laws; a further
        design can begin there. `gamma` is the largest verified norm. The certificate holds the norm
        of each plant, and of the local minimum `slope`, the norm of the smallest convex combination
        of gradients within `radius` of the parameters, and `decrease left`, what a step of that
        radius would still lower gamma by to first order, relative to it.

    Raises
    ------
    AssumptionError
        When u does not reach, or y does not see, a mode that is not stable.
    InfeasibleError
        When no start is stabilised; with the frequency of the pole that stays unstable.
    CertificateError
        When the norm of a loop is not the one that the search claims.
    ModelError, ShapeError, LabelError
        When plants and structure do not go together.

    Warns
    -----
    FlexplantWarning
        When the modes left out make the loop unstable, or bring |S| at u above 8 dB; it names them.

    References
    ----------
    [ApkarianNoll2006]_; [Burke2006]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> sys = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=fx.lowpass(0.1), KS=0.1)
    >>> found = fx.synthesis.design_structured(sys, fx.synthesis.FixedOrder(0), starts=1)
    >>> found.system.n_states, found.gamma < 1
    (0, True)
    """
    plants = _plants(plant, u, y)
    if isinstance(structure, type) or not hasattr(structure, "family"):
        raise ModelError(
            "structure must be FixedOrder, TunedLaws, ObserverGains or Parametrised, got "
            f"{short(structure)}. Pass one of them, such as TunedLaws(law) or FixedOrder(2)."
        )
    starts, random = whole(starts, "starts"), generator(rng)
    limit, begun = positive(time_limit, "time_limit"), time.perf_counter()
    problems = [prepared(one.system, one.u, one.y) for one in plants]
    for one, problem in zip(plants, problems, strict=True):
        require_stabilisable(one, problem, "structured synthesis")
    family = structure.family(plants[0], problems[0])
    search = _StructureSearch(
        family, [ScaledLoop(p, family.order) for p in problems], problems, begun + _SHARE * limit
    )
    with Progress(starts + 1, "starts of the search", progress=progress) as bar:
        x, value = search.best(starts, random, bar)
        search.end = begun + limit
        found = search.finished(x, value, random)
        bar.advance()
    final = family.structure(found.x)
    K = as_system(family.matrices(found.x), (plants[0].y, plants[0].u), plants[0].dt)
    K = K.replace(name="structured", units=plants[0].units)
    closed = [lft(one.system, K) for one in plants]
    claim = found.value / (1.0 + _SMALL * float(np.sqrt(1.0 + found.x @ found.x)))
    each = [certified_norm(loop, claim) for loop in closed]
    worst = int(np.argmax([one["norm"] for one in each]))
    if not abs(each[worst]["norm"] - claim) <= _AGREEMENT * claim:
        raise CertificateError(
            f"the closed loop has the norm {each[worst]['norm']:.6g} on the plant as given, "
            f"{claim:.6g} in the scaled problem: it is too badly conditioned to trust. Bring "
            "the weights closer together."
        )
    certificate = dict(each[worst]) | {
        "slope": found.slope,
        "radius": found.radius,
        "decrease left": found.decrease,
    }
    if len(plants) > 1:
        certificate |= {f"norm of plant {i}": one["norm"] for i, one in enumerate(each, 1)}
    notes = search.notes
    if found.decrease > _SHORT:
        notes += ("not yet a local minimum (decrease left): more starts, time or another order",)
    answer = Controller(
        K,
        f"H-infinity of structure {(structure if final is None else final)!r}",
        gamma=each[worst]["norm"],
        certificate=certificate,
        reached=reached_norms(plants[worst], closed[worst], responder(closed[worst])),
        notes=notes,
        structure=final,
    )
    return with_left_out(answer, plants[0], larger)


def _plants(given: Any, u: Sequence[str] | None, y: Sequence[str] | None) -> list[StandardPlant]:
    """Return the plants, all with the same channels and rate.

    Raises
    ------
    ModelError
        When they differ, or there is none.
    """
    many = given if isinstance(given, list | tuple) else [given]
    named = u is not None or y is not None
    plants = [
        StandardPlant.from_statespace(one, u=u, y=y) if named else standard_plant(one)
        for one in many
    ]
    if not plants:
        raise ModelError("plant is an empty list: pass at least one plant.")
    first = plants[0]
    for i, one in enumerate(plants, 1):
        if not (one.w and one.z and one.u and one.y):
            raise ModelError(
                f"synthesis needs channels w, z, u and y, got {one!r}. Name those of a StateSpace "
                "by u= and y=."
            )
        if (one.u, one.y) != (first.u, first.y) or not np.isclose(
            one.dt, first.dt, rtol=1e-9, atol=0.0
        ):
            raise ModelError(
                f"plant {i} has other u, y or rate than the first: one controller cannot serve "
                "both. Assemble all with the same ports and rate."
            )
    return plants


class _StructureSearch:
    """The functions of the parameters, and the search through starts."""

    def __init__(
        self,
        family: ControllerFamily,
        loops: list[ScaledLoop],
        problems: list[Prepared],
        end: float,
    ) -> None:
        self.family, self.loops, self.problems, self.end = family, loops, problems, end
        self.notes: tuple[str, ...] = ()

    def out_of_time(self) -> bool:
        """Whether the time limit has passed."""
        return time.perf_counter() > self.end

    def stability(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Return the largest spectral abscissa of the loops and its gradient."""
        K = self.family.matrices(theta)
        if not all(np.all(np.isfinite(part)) for part in K):
            return np.inf, np.zeros(theta.size)
        value, by, _ = max((loop.stability(K) for loop in self.loops), key=lambda one: one[0])
        return value, self.family.slope(theta, by)

    def norm(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Return the largest norm of the loops, a little more for large parameters; its gradient.

        Some infima are only neared as gains grow without bound: this ends them at finite ones.
        """
        K = self.family.matrices(theta)
        if not all(np.all(np.isfinite(part)) for part in K):
            return np.inf, np.zeros(theta.size)
        best: tuple[float, Matrices | None] = (-1.0, None)
        for loop in self.loops:
            value, by, _ = loop.norm(K)
            if by is None:
                return np.inf, np.zeros(theta.size)
            best = max(best, (value, by), key=lambda one: one[0])
        assert best[1] is not None  # noqa: S101 - there is at least one loop, and none was unstable
        size = float(np.sqrt(1.0 + theta @ theta))
        slope = (1.0 + _SMALL * size) * self.family.slope(theta, best[1])
        return (1.0 + _SMALL * size) * best[0], slope + _SMALL * best[0] / size * theta

    def best(
        self, starts: int, rng: np.random.Generator, bar: Progress
    ) -> tuple[FloatArray, float]:
        """Return the best parameters from all starts and the norm there.

        Raises
        ------
        InfeasibleError
            When none is stabilised.
        """
        ends: list[tuple[float, FloatArray]] = []
        lowest, closest = np.inf, self.family.first
        done = 0
        nested = self.family.nested(self._minimised)
        for i in range(-1 if nested is not None else 0, starts):
            if done and self.out_of_time():
                break
            done += 1
            theta = self.family.first if nested is None or i >= 0 else nested
            if i >= 0:
                bar.advance()
            if i > 0:
                theta = theta + self.family.spread * rng.standard_normal(theta.size)
            value, x, decay = self._descended(theta)
            if decay < lowest:
                lowest, closest = decay, x
            if np.isfinite(value):
                ends.append((value, x))
        if not ends:
            raise self._infeasible(closest, done)
        value, x = min(ends, key=lambda one: one[0])
        same = sum(other <= value * 1.01 for other, _ in ends)
        self.notes = (f"{same} of {done} starts end within 1 % of the best",)
        if self.out_of_time():
            self.notes += ("the time limit ended the search: a later one may find less",)
        return x, value

    def _descended(self, theta: FloatArray) -> tuple[float, FloatArray, float]:
        """Return norm (infinite when not stabilised), parameters and abscissa from one start."""
        theta, decay = bfgs(
            self.stability, theta, enough=-DECAY * 10, steps=_STEPS, out_of_time=self.out_of_time
        )
        if not (decay < -DECAY and np.isfinite(self.norm(theta)[0])):
            return np.inf, theta, decay
        x, value = bfgs(self.norm, theta, enough=0.0, steps=_STEPS, out_of_time=self.out_of_time)
        return value, x, decay

    def _minimised(self, family: ControllerFamily) -> FloatArray | None:
        """Return the best parameters of another structure, from its first start and one beside it.

        In a quarter of the time that is left; None when it is not stabilised.
        """
        now = time.perf_counter()
        loops = [ScaledLoop(p, family.order) for p in self.problems]
        other = _StructureSearch(family, loops, self.problems, now + _QUARTER * (self.end - now))
        # a plant without a controller may be stationary: a free mass is
        draw = np.random.default_rng(family.order).standard_normal(family.first.size)
        starts = (family.first, family.first + family.spread * draw)
        ends = [other._descended(start) for start in starts]
        value, x, _ = min(ends, key=lambda end: end[0])
        return x if np.isfinite(value) else None

    def finished(self, x: FloatArray, value: float, rng: np.random.Generator) -> Minimum:
        """Return the minimum near x: gradient sampling, and BFGS again while that gains."""
        for _ in range(_ROUNDS):
            found = sampled_minimum(self.norm, x, value, rng=rng, out_of_time=self.out_of_time)
            x, value = bfgs(
                self.norm, found.x, enough=0.0, steps=_STEPS, out_of_time=self.out_of_time
            )
            if self.out_of_time() or not value < found.value * (1.0 - _ROUND_GAIN):
                break
        return found

    def _infeasible(self, theta: FloatArray, starts: int) -> InfeasibleError:
        K = self.family.matrices(theta)
        worst = max(range(len(self.loops)), key=lambda i: self.loops[i].stability(K)[0])
        value, _, pole = self.loops[worst].stability(K)
        freq = self.problems[worst].frequency(abs(pole.imag))
        size = self.problems[worst].frequency(abs(pole))
        return InfeasibleError(
            f"no controller of this structure was found that stabilises plant {worst + 1}: of "
            f"{starts} starts the best leaves a pole at {freq:.4g} Hz (size {size:.4g} Hz, real "
            f"part {value:.3g} of the plant's speed). Give the structure more freedom (a higher "
            "order, a lead), the gain of a law the other sign, a start that stabilises, or more "
            "starts and time."
        )
