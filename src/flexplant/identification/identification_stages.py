"""The stages of an identification: first poles, first fit, refinement, selection, result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np

from ..arrays import ComplexArray, IntArray
from ..errors import ModelError, ShapeError, SolverError, attempted, counted, warn
from ..lti.frequency import Frf
from ..modes.matching import ALIKE, mac_matrix
from ..parallel import Progress, expect
from ..tolerances import TINY
from .diagram import PoleSelection, StabilisationDiagram, diagram_of, weighted_by_remainder
from .lines import (
    NARROW,
    NEAR,
    UPPER,
    Exhausted,
    Lines,
    PreparedLines,
    Products,
    Rejected,
    afforded_terms,
    mains_multiple,
)
from .model_error import (
    NOISE,
    SAME_RESONANCE,
    Disagreement,
    disagreement,
    gain_due_of_pole,
    outputs_disagree,
    strength,
    supported,
    twin_poles,
    unevenness,
)
from .pole_test import (
    dropped,
    fewer_terms,
    gain_due_of_own_poles,
    improved,
    merged,
    missed_poles,
    more_terms,
    relocated,
    shared,
    split_proposals,
    unexplained,
    unwindowed,
    warned,
)
from .refine import PoleFit, pivoted, refined, scaled_inverse
from .result import IdentifiedModes, answer, hann_segment, leakage_warned


def gated(
    fit: PoleFit, steps: int, *, alone: bool, compare: bool
) -> tuple[PoleFit, IntArray, tuple[Rejected, ...]]:
    """Return the fit without spurious poles, the places of reported poles, and the others."""
    # twins, and poles without information, are removed from the fit one by one; poles at the edge
    # of the band or of mains remain in it, but are not reported. Poles chosen by hand (not `alone`)
    # are not merged
    listed: list[Rejected] = []
    while (found := _needless(fit, steps, alone, compare)) is not None:
        place, reason = found
        listed.append(rejection(fit, place, reason))
        if fit.m == 1:
            raise SolverError(
                f"no pole remains: {listed[-1][0]:.5g} Hz is {reason}. Widen the band, measure "
                "longer, or average more."
            )
        fit = _without(fit, place, steps)
    reasons = [_rejection(fit.lines, pole) for pole in fit.poles]
    listed += [rejection(fit, k, why) for k, why in enumerate(reasons) if why]
    kept = np.array([k for k, why in enumerate(reasons) if why is None], dtype=np.int64)
    if not kept.size:
        raise _none_left(listed)
    return fit, kept, tuple(sorted(listed))


def _without(fit: PoleFit, place: int, steps: int) -> PoleFit:
    """Return the fit without one of its poles."""
    return refined(fit.lines, *fit.rest(place), steps=steps, strict=False)


def steady(
    fit: PoleFit, reported: IntArray, apart: Disagreement
) -> tuple[IntArray, tuple[Rejected, ...]]:
    """Return the poles that inconsistent outputs (or inputs) share, and the others."""
    # a pole close to another one, with a damping at one output that is not significantly above zero
    # (95 %), represents their difference; a pole with a mean damping known no better is without
    # information
    damping, m = -fit.poles.real, fit.m
    close = np.array([
        np.any(np.abs(np.delete(fit.poles.imag, k) - pole.imag) < -pole.real)
        for k, pole in enumerate(fit.poles)
    ])  # fmt: skip
    differs = close & (1.96 * apart.spread[:m] > damping)
    unknown = apart.deviation[:m] >= -apart.poles.real
    side = fit.lines.side
    reasons = (
        f"without information: over the {side} the deviation of its damping exceeds it",
        f"not shared by the {side}: its damping differs by its own size",
    )
    lost = reported[(differs | unknown)[reported]]
    listed = [rejection(fit, int(k), reasons[int(differs[k])]) for k in lost]
    kept = reported[~(differs | unknown)[reported]]
    if not kept.size:
        raise _none_left(listed)
    return kept, tuple(listed)


def _none_left(listed: Sequence[Rejected]) -> SolverError:
    """Return the error for a result without poles."""
    return SolverError(
        "no pole remains within the band: "
        + "; ".join(f"{f:.5g} Hz is {why}" for f, _, why in listed[:3])
        + ". Widen the band, measure longer, or average more."
    )


def rejection(fit: PoleFit, k: int, reason: str) -> Rejected:
    """Return an entry of the list of poles that are not reported."""
    pole = complex(fit.poles[k])
    return abs(pole) / (2 * np.pi), -pole.real / abs(pole), reason


def _needless(fit: PoleFit, steps: int, alone: bool, compare: bool) -> tuple[int, str] | None:
    """Return a pole to be left out, and the reason."""
    size, worse = np.abs(fit.poles), max(1.0, fit.misfit) * fit.lines.inflation
    variance = np.diag(scaled_inverse(fit.gradient()[0]))[: 2 * fit.m] * worse
    std = np.sqrt(variance).reshape(2, -1)
    unknown = np.maximum(std[1] / size, std[0] / np.maximum(-fit.poles.real, TINY))
    inside = [k for k in range(size.size) if _rejection(fit.lines, fit.poles[k]) is None]
    worst = max(inside, key=lambda k: float(unknown[k]), default=None)
    if worst is not None and unknown[worst] >= 1.0:
        return worst, "without information: its deviation of frequency or damping exceeds it"
    if not alone:
        return None

    def is_shared(place: int) -> bool:
        # true where no fit without it exists
        with attempted("a fit without one of its poles", SolverError):
            least = gain_due_of_pole(fit.lines) * max(1.0, fit.misfit)
            return shared(_without(fit, place, steps), fit, least)
        return True

    found = twin_poles(fit)
    if found is not None:
        other, place = found
        alike = mac_matrix(fit.shapes[:, [other]], fit.shapes[:, [place]]) > ALIKE
        if not compare or alike.all() or not is_shared(place):
            return place, f"a twin of the pole at {size[other] / (2 * np.pi):.5g} Hz"
    for place in lesser(fit, fit.shapes) if compare else []:
        if not is_shared(place):
            return place, f"not shared by the {fit.lines.side}: it represents their difference"
    return None


def lesser(fit: PoleFit, vectors: ComplexArray, alike: float = 0.0) -> list[int]:
    """Return the weaker of neighbouring poles with a MAC above a limit, the weakest first."""
    height, found = strength(fit), []
    for k in np.argsort(height):
        reach = SAME_RESONANCE * (-fit.poles.real - fit.poles.real[k])
        near = (np.abs(fit.poles - fit.poles[k]) < reach) & (height > height[k])
        if np.any(mac_matrix(vectors[:, near], vectors[:, [k]]) >= alike):
            found.append(int(k))
    return found


def single(lines: Lines, fit: PoleFit, vectors: ComplexArray, steps: int) -> PoleFit:
    """Return the fit of lines with one pole per resonance and the given participation vectors."""
    # inconsistent rows give each resonance several poles with one participation (or shape, if
    # exchanged). It is held fixed, since poles that the rows do not share would change it
    keep = np.delete(np.arange(fit.m), lesser(fit, vectors, ALIKE))
    start = pivoted(lines, fit.poles[keep], vectors[:, keep])
    now = start.poles, start.participation
    return refined(lines, *now, steps=steps, strict=False, poles_only=True, first=start)


def _rejection(lines: Lines, pole: complex) -> str | None:
    """Return the reason why a pole of the fit is not reported, None where it is reported."""
    freq, width = abs(pole) / (2 * np.pi), -2.0 * pole.real / (2 * np.pi)
    low, high = float(lines.freq[0]), float(lines.freq[-1])
    spacing = lines.spacing
    if not low <= freq <= high:
        return "outside the band"
    if min(freq - low, high - freq) < max(spacing, width / 2):
        return "at the edge of the band"
    if width < NARROW * spacing:
        return mains_multiple(freq, spacing)
    return None


#: what may have separate poles, in addition to outputs and inputs
RUNS = "runs"
#: number of steps of the progress bar: the diagram, fit and extension twice, the result
STAGES = 6
#: largest number of accepted changes of one kind, and of poles of a fit
MOST, MOST_POLES = 6, 60
#: number of lines required on either side of a peak: at the edge of the band only one flank is
#: visible
FLANK = 5
#: ratio of the power of the largest line to the median line above which a response counts as
#: significant: for noise in one channel, the largest of a million lines has a ratio of 20
STANDS_OUT = 20.0
#: number of operations of a step (values of the FRF times (poles times references) squared) up to
#: which the fit is made without a request: a few seconds in total
UNASKED = 5e7
#: total number of operations of a refinement without a request, one or two minutes
BUDGET = 5e10
#: operations of a whole fit and of a first result relative to those of a step, on average
_REFINED, _FIRST = 6e3, 200.0
#: operations of a whole fit and of a first result, relative to those of a step: 260 to 530, and 8
#: to 31, on records of 10 to 14 modes
_WHOLE, _START = 400.0, 20.0
#: misfit of a first result above which a warning is given: deviations are enlarged by its square
#: root
LARGE = 4.0
#: number of steps before fits are compared, since the poles of the diagram have errors beyond noise
QUICK = 2


@dataclass(frozen=True)
class Task:
    """Checked settings of an identification."""

    frf: Frf
    runs: int
    #: number of residual terms of modes below the band; of modes above, None where the data decide
    lower: int
    upper: int | None
    hold: float | None
    #: delay in periods of the hold; the prepared lines are advanced by it
    delay: float
    labels: Mapping[str, str]
    #: what may have separate poles (outputs, inputs, runs), empty where the data decide, and which
    #: rows were measured together
    side: str
    together: tuple[IntArray, ...]
    refine: bool | None
    most: int
    steps: int
    budget: Products = field(default_factory=Products)

    def lines(self, ready: PreparedLines) -> Lines:
        """Return lines with all residual terms, so that no pole replaces a residual term."""
        rows = RUNS if self.side == RUNS and ready.side == "outputs" else ready.side
        upper = self.upper
        if upper is None:
            # modes folded by a hold are too weak for separate poles and too strong for few terms:
            # outputs would seem to disagree
            most = afforded_terms(ready.freq.size, self.lower)
            upper = UPPER[-1] if self.hold is None else max(UPPER[-1], *most, 0)
        known = {one.name: getattr(ready, one.name) for one in fields(PreparedLines)}
        return Lines(
            **(known | {"side": rows}),
            lower=self.lower,
            upper=upper,
            hold=self.hold,
            late=self.delay % 1.0,
            variance_freedom=self.frf.freedom,
            segment=hann_segment(self.frf),
            most=self.most,
            work=self.budget,
            setups=self.together if self.side == rows else (),
        )


class _Begin(NamedTuple):
    """The start poles of a fit."""

    poles: PoleSelection
    diagram: StabilisationDiagram | None = None
    #: whether the diagram chose the poles; a fit may then add and remove poles
    alone: bool = False
    #: whether the poles are those of peaks, which no fit improves
    at_peaks: bool = False


class _Stage(NamedTuple):
    """Lines and their fit."""

    ready: PreparedLines
    fit: PoleFit

    @property
    def lines(self) -> Lines:
        return self.fit.lines


def identified(
    task: Task,
    ready: PreparedLines,
    orders: list[int] | None,
    start: PoleSelection | None,
    progress: bool | None,
) -> IdentifiedModes:
    """Return the modes of prepared lines; `start`: poles chosen by hand."""
    references = ready.data.shape[1]
    if start is not None and start.participation.shape[0] != references:
        raise ShapeError(
            f"start was chosen with {counted(start.participation.shape[0], 'reference')}, this FRF "
            f"has {references}: compute the diagram from the same channels."
        )
    if not ready.known:
        ready = weighted_by_remainder(ready, orders)
    begin = _Begin(start) if start is not None else _begin(task, ready, orders)
    refine = False if begin.at_peaks else task.refine
    work = ready.data.size * (len(begin.poles) * ready.data.shape[1]) ** 2
    costly = work > UNASKED
    with Progress(
        STAGES,
        f"modes, {work:.1e} operations a step" if costly else "modes",
        progress=True if refine and costly and progress is None else progress,
        advice="Fewer lines (band=), fewer channels or refine=False take less.",
    ) as bar:
        bar.advance()
        whole = refine or (refine is None and not costly)
        expect(work * (_REFINED if whole else _FIRST))
        task.budget.expected = work * (_WHOLE if whole else _START)
        # after one step the error is as small as the noise; differences between outputs need more
        # steps
        judged = refine is not False and not begin.at_peaks
        quick = QUICK if judged else int(begin.alone)
        fit, weaker = _first_fit(task.lines(ready), begin.poles, begin.alone, quick)
        now, differ = _by_rows(task, _Stage(ready, fit), begin.alone, judged)
        differ = differ and refine is None
        if refine is False:
            reason = "refine=True for more"
        elif refine is None and costly:
            reason = f"refine=True for more, {work:.1e} operations a step"
        elif differ:
            reason = f"a refinement does not improve poles that {now.lines.side} do not share"
        else:
            now, reason = _second(task, now, begin.alone, bar)
        found = _answered(task, now, begin, weaker, reason, differ)
        bar.advance(STAGES - bar.done)
    leakage_warned(task.frf, found)
    return found


def _begin(task: Task, ready: PreparedLines, orders: list[int] | None) -> _Begin:
    """Return the poles that are stable over the orders of the diagram, else those of the peaks."""
    diagram = diagram_of(ready, orders)
    try:
        return _Begin(diagram.automatic(), diagram, alone=True)
    except SolverError:
        if task.frf.window is not None or task.refine:
            raise
        lines = task.lines(ready)
        peaks = _at_peaks(lines)
        found = peaks or _highest_pole(lines, diagram)
        if found is None:
            raise
    warn(
        "no pole is stable over the orders of the stabilisation diagram: the poles are those "
        + (
            "of the highest peaks, their damping is only an order of magnitude, and their "
            "deviations are half a width of the resonance. A transient that has not decayed or a "
            "single run may be the cause: average over more runs."
            if peaks
            else "nearest the largest response. Widen the band, or choose from the diagram "
            "by hand (start=)."
        )
    )
    return _Begin(found, diagram, at_peaks=peaks is not None)


def _by_rows(task: Task, now: _Stage, alone: bool, judged: bool) -> tuple[_Stage, bool]:
    """Return the fit of shared poles if outputs, inputs or runs disagree, and whether they do.

    Inputs that disagree are compared with inputs and outputs exchanged.
    """
    ready, fit = now
    lines = fit.lines
    if judged and alone and lesser(fit, fit.participation, ALIKE):
        less = single(lines, fit, fit.participation, QUICK)
        fit = less if outputs_disagree(less, fit.cost) else fit
    differ = judged and outputs_disagree(fit)
    asked = task.side not in ("", lines.side)
    # the residual is more than noise, or poles lie close to each other
    odd = fit.misfit > NOISE or bool(lesser(fit, fit.shapes, ALIKE))
    open_ = not task.side and judged and not differ and len(fit.participation) > 1
    if asked or (open_ and odd):
        other = single(task.lines(ready.turned), fit, fit.shapes, QUICK)
        differ = judged and outputs_disagree(other, np.inf if asked else fit.cost)
        if differ or asked:
            return _Stage(ready.turned, other), differ
    return _Stage(ready, fit), differ


def _second(task: Task, first: _Stage, alone: bool, bar: Progress) -> tuple[_Stage, str]:
    """Return the refined fit, or the first one and the reason."""
    task.budget.most = np.inf if task.refine else task.budget.done + BUDGET
    try:
        return _likeliest_fit(task, first, alone, bar), ""
    except Exhausted:
        return first, f"shared poles do not explain the data after {BUDGET:.0e} operations"
    finally:
        task.budget.most = np.inf


def _answered(
    task: Task, now: _Stage, begin: _Begin, weaker: tuple[Rejected, ...], reason: str, differ: bool
) -> IdentifiedModes:
    """Return the accepted modes of a fit; `reason`: why it was not refined."""
    ready, lines, settled = now.ready, now.lines, not reason
    # poles that outputs share are known after a refinement or after separate fits
    compare = settled or differ

    count = task.steps if settled else QUICK * int(compare)
    fit, reported, rejected = gated(now.fit, count, alone=begin.alone, compare=compare)
    apart, uneven = None, 1.0
    if settled:
        fit = _settled(fit, task.steps, fine=True)
    if compare:
        excess, least = fit.cost - lines.freedom(fit.m), gain_due_of_own_poles(fit)
        if fit.misfit < NOISE:
            uneven = unevenness(fit, least)
        else:
            apart = disagreement(fit, least, excess)
        if apart is not None:
            reported, others = steady(fit, reported, apart)
            fit = PoleFit(lines, apart.poles, fit.participation, fit.pivots)
            rejected += others
    # a first result may have some misfit, but deviations must not be enlarged to the double
    if compare or task.budget.done > BUDGET or (begin.alone and fit.misfit > LARGE):
        odd = None if apart is None else (apart.size, lines.side, _odd(task.frf, lines, apart))
        warned(lines.freq, unexplained(fit), odd)
    if task.side == RUNS:
        ready = ready.over_runs(task.runs)
        lines = replace(lines, data=ready.data, weight=ready.weight, setups=())
        fit = PoleFit(lines, fit.poles, fit.participation, fit.pivots)
    found = answer(
        *(task.frf, task.delay, ready, fit, reported, task.labels, begin.diagram),
        *(tuple(sorted(weaker + rejected + ready.mains)), reason, apart),
        uneven,
    )
    if begin.at_peaks:
        half = np.maximum(-found.poles.real, np.pi * lines.spacing)
        found = found.replace(covariance=np.diag(np.tile(half, 2) ** 2))
    return found


def _odd(frf: Frf, lines: Lines, apart: Disagreement) -> str:
    """Return the output, input or run that deviates far more than the others, else empty."""
    if apart.odd is None:
        return ""
    place, off = apart.odd
    names = frf.inputs if lines.side == "inputs" else frf.outputs
    who = f"run {place + 1}" if lines.side == RUNS else names[int(lines.parts[place][0])]
    return f"{who} deviates by {100 * off:.2g} %, far more than the others: check it. "


def _highest_pole(lines: Lines, diagram: StabilisationDiagram) -> PoleSelection | None:
    """Return the diagram's pole closest to the largest response, None without a clear peak."""
    # in a narrow band, which allows few orders, inconsistent outputs have no stable poles
    power = np.sum(np.abs(lines.data * lines.weight) ** 2, axis=(0, 1))
    inner = slice(FLANK, -FLANK)
    place = int(np.argmax(power[inner]))
    if power[inner][place] < STANDS_OUT * np.median(power):
        return None
    with attempted("a pole at the largest response", ModelError):
        return diagram.select([float(lines.freq[inner][place])])
    return None


def _at_peaks(lines: Lines) -> PoleSelection | None:
    """Return poles at the peaks of a response without stable poles, found on a grid.

    Where the phase rises through a resonance (a transient, a record of one run), no pole is stable.
    """
    spacing = 2 * np.pi * lines.spacing
    none = np.zeros((lines.data.shape[1], 0), dtype=np.complex128)
    fit = PoleFit(lines, none[0], none)
    ends = 2 * np.pi * np.array([lines.freq[FLANK], lines.freq[-1 - FLANK]])
    for _ in range(MOST):
        trials = [one for rivals in missed_poles(fit) for one in rivals]
        trials = [
            one
            for one in trials
            if ends[0] < one.poles[-1].imag < ends[1]
            # a peak that is not a linear resonance leaves a remainder, which is not another pole
            and np.all(np.abs(one.poles[-1] - fit.poles) > NEAR * spacing)
        ]
        best = max(trials, key=lambda trial: trial.gain - trial.least, default=None)
        if best is None or best.gain < best.least:
            break
        fit = PoleFit(lines, best.poles, best.participation)
    return PoleSelection(fit.poles, fit.participation) if fit.poles.size else None


def _settled(fit: PoleFit, steps: int, **how: bool) -> PoleFit:
    """Return the refinement of a fit, which is not computed again at the start."""
    return refined(fit.lines, fit.poles, fit.participation, steps=steps, first=fit, **how)


def _first_fit(
    lines: Lines, chosen: PoleSelection, alone: bool, steps: int
) -> tuple[PoleFit, tuple[Rejected, ...]]:
    """Return the fit near the chosen poles, with all residual terms and no search for others."""
    # if there are more poles than requested the strongest are kept; the others are returned too
    if not alone:
        fit = PoleFit(lines, chosen.poles, chosen.participation)
        now = fit.poles, fit.participation
        return (refined(lines, *now, steps=steps, strict=False) if steps else fit), ()
    fit = supported(lines, chosen.poles, chosen.participation)
    height = strength(fit)
    height[lesser(fit, fit.shapes, ALIKE)] *= TINY  # only one of two poles of one resonance counts
    places = np.argsort(-height, kind="stable")
    keep, others = np.sort(places[: lines.most]), places[lines.most :]
    weaker = tuple(rejection(fit, int(k), f"weaker than the {lines.most} of most=") for k in others)
    if weaker:
        fit = pivoted(lines, fit.poles[keep], fit.participation[:, keep])
    return _settled(fit, steps, strict=False), weaker


def _likeliest_fit(task: Task, first: _Stage, alone: bool, bar: Progress) -> _Stage:
    """Return the maximum likelihood fit, with the poles and terms that the data support."""
    (ready, fit), free, steps = first, task.upper is None, task.steps
    reducing = [(unwindowed, 1), (dropped, int(alone))]
    reducing += [(merged, MOST * int(alone)), (fewer_terms, int(free))]
    growing = [
        *((missed_poles, MOST), (merged, MOST), (more_terms, int(free))),
        *((split_proposals, MOST), (relocated, MOST), (merged, MOST), (missed_poles, MOST)),
    ]
    for again in range(1 if ready.known else 2):
        start = pivoted(task.lines(ready), fit.poles, fit.participation) if again else fit
        if alone:
            start = supported(start.lines, start.poles, start.participation, start)
        # spurious poles may prevent convergence, which is therefore judged at the end
        fit = _settled(start, steps, strict=not alone)
        fit = improved(fit, reducing, steps=steps)
        bar.advance()
        if alone:
            fit = improved(fit, growing, steps=steps, rough=True)
            bar.advance()
        if not ready.known:
            share = 1.0 - fit.lines.freedom(fit.m) / (2 * fit.model.size)
            ready = ready.from_residuals(ready.data - fit.model, share)
    return _Stage(ready, fit)
