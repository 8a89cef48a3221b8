"""From measured FRFs to poles, mode shapes and their covariance."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..checks import (
    ComplexArray,
    IntArray,
    between,
    instance,
    positive,
    real_array,
    several,
    short,
    whole,
)
from ..errors import (
    LabelError,
    ModelError,
    ShapeError,
    SolverError,
    attempted,
    counted,
    require_known,
    warn,
)
from ..lti.frequency import Frf
from ..parallel import Progress, expect, one_thread
from ..tolerances import ROUNDING, TINY
from .diagram import (
    PoleSelection,
    StabilisationDiagram,
    affordable,
    checked_orders,
    diagram_of,
    weighted_by_remainder,
)
from .frf_estimation import repetitions, stacked_runs
from .gate import gated, lesser, rejected, single, steady
from .line_weights import PreparedLines, Rejected, prepared_lines
from .model_error import ALIKE, NOISE, Disagreement, disagreement, outputs_disagree, strength
from .pole_test import (
    UPPER,
    dropped,
    fewer_terms,
    freedom,
    improved,
    merged,
    missed_poles,
    more_terms,
    own_price,
    relocated,
    split_proposals,
    supported,
    unexplained,
    unwindowed,
    warned,
)
from .refine import Exhausted, Fit, Lines, Products, pivoted, refined
from .result import IdentifiedModes, answer, hann_segment, leakage_warned, of_segments

#: what poles of their own may belong to, beside outputs and inputs
RUNS = "runs"
#: of an identification, for its bar: the diagram, twice fit and growth, the answer
STAGES = 6
#: changes of one kind that are accepted, and poles that a fit may have
MOST, MOST_POLES = 6, 60
#: lines apart that poles at peaks have: a peak that is no resonance of a linear machine is
#: explained badly, and what is left of it is no other pole; and lines that a peak has beside it on
#: either side, where the edge of the band shows one flank only
REGION, FLANK = 20, 5
#: power of the largest line for the middle one's, of a response that stands out: of noise in one
#: channel, the largest of a million lines is 20 times the middle one
STANDS_OUT = 20.0
#: values of the FRF times (poles times references) squared, the products of a step of the fit, up
#: to which it is made without a request: some seconds altogether
CHEAP = 5e7
#: products that a refinement without a request may take in all, a minute or two
BUDGET = 5e10
#: multiplications of a whole fit and of a first answer for those of a step, on average
_REFINED, _FIRST = 6e3, 200.0
#: misfit of a first answer that is warned of: deviations are enlarged by its square root
LARGE = 4.0
#: steps that compare fits: the diagram's poles are off by more than noise makes them
QUICK = 2

#: most residual terms on one side of the band: powers of a frequency beyond tell no more apart in
#: double precision
MOST_TERMS = 20


def stabilisation_diagram(
    frf: Frf,
    *,
    band: tuple[float, float] | None = None,
    orders: Iterable[int] | None = None,
    tolerances: tuple[float, float, float] = (0.01, 0.05, 0.95),
    max_zeta: float = 0.2,
) -> StabilisationDiagram:
    """Return the poles of matrix-fraction models of rising order, by pLSCF.

    Model: ``H(z) = B(z) A(z)^-1`` with complex coefficients on the band, see
    `flexplant.identification.diagram`.

    Parameters
    ----------
    frf : Frf
        Measured; weighted by its variance where it has one. Velocity and acceleration are
        integrated; no quantity is taken for displacement.
    band : (low, high) [Hz], optional
        The frequencies used; all by default.
    orders : iterable of int, optional
        Model orders; each has order * min(n_in, n_out) poles. By default 2 to 40, or to a quarter
        of the lines, or to 100 poles; every other one where many references make each costly.
    tolerances : (float, float, float)
        Relative change of frequency and of damping from one order to the next, and the MAC,
        for a pole to be called stable.
    max_zeta : float
        Poles with more damping are left out.

    Returns
    -------
    StabilisationDiagram
        Choose with `.automatic()` or `.select(freq=[...])`; draw with `plot.stabilisation`.

    Raises
    ------
    ModelError
        When the band holds less than 20 lines, or orders or tolerances are out of range.

    References
    ----------
    [Peeters2004]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> freq = np.arange(10.0, 40.0, 0.1)
    >>> H = 1 / (20.0**2 - freq**2 + 0.4j * freq)
    >>> diagram = fx.identification.stabilisation_diagram(fx.Frf(freq, H[None, None]))
    >>> (abs(diagram.automatic().poles.imag) / (2 * np.pi)).round(2)
    array([20.])
    """
    first, second, third = real_array(tolerances, "tolerances", (3,)).tolist()
    limits = (first, second, third)
    if min(limits) <= 0 or third >= 1:
        raise ModelError(
            "tolerances are (frequency, damping, MAC), positive, the MAC below 1, got "
            f"{tolerances!r}."
        )
    top = between(max_zeta, "max_zeta", 0.0, 1.0, "From 1 on nothing oscillates: pass 0.2, say.")
    ready, listed = prepared_lines(frf, band), None if orders is None else checked_orders(orders)
    if not ready.known:
        ready = weighted_by_remainder(ready, affordable(listed, ready)[-1])
    with one_thread():
        return diagram_of(ready, affordable(listed, ready), limits, top)


def identify_modes(
    frf: Frf | Sequence[Frf],
    *,
    band: tuple[float, float] | None = None,
    orders: Iterable[int] | None = None,
    start: PoleSelection | None = None,
    lower: int = 2,
    upper: int | None = None,
    hold: float | None = None,
    dofs: Mapping[str, str] | None = None,
    setups: Iterable[Iterable[str]] | None = None,
    refine: bool | None = None,
    most: int = MOST_POLES,
    max_iterations: int = 150,
    progress: bool | None = None,
) -> IdentifiedModes:
    """Return poles, mode shapes and their covariance from measured FRFs.

    Give the FRF and the band that holds the modes: ``found = fx.identify_modes(frf, band=(50.0,
    800.0), dofs={"y1": "41:z"})``. `found.freq` [Hz], `found.zeta` and `found.shapes` are the
    answer, `found.rejected` says which poles were left out and why, and `fx.plot.identified`
    draws it beside the measurement. ``fx.Eigenvalues(fx.numbered(found, drawing))`` is what
    `update` takes. Modes outside the band are accounted for. Poles come from a stabilisation
    diagram and a maximum likelihood fit, without choices to make; `start=` takes poles picked by
    eye (`fx.plot.PolePicker`), `refine=False` takes a second. What the fit does not explain is
    warned of, with its frequency. How it works: `algorithms`.

    Parameters
    ----------
    frf : Frf, or list of Frf
        Measured, or runs of the same channels between which the machine may have drifted (a mean of
        these shows broader resonances, and hides it): poles are then means over the runs, and their
        deviations come from how these differ.
        With a variance, errors are weighted by it and the covariance follows from it
        (and from the correlation between outputs, and between lines by the window, where known);
        without, both come from what the fit leaves, averaged over 41 lines.
    band : (low, high) [Hz], optional
        What to fit and report; all by default.
    orders : iterable of int, optional
        Of the stabilisation diagram, whose default it is.
    start : PoleSelection, optional
        Poles chosen by hand, `stabilisation_diagram(frf).select(freq=[...])`.
    lower : int
        Number of residual terms of rigid-body modes and modes below the band.
    upper : int, optional
        Number of those of modes above; when not given 3, and up to 25 where the data require them:
        with too few the poles are biased by a standard deviation before the misfit shows it.
    hold : float [Hz], optional
        Rate of the zero-order hold between the inputs and the machine, where the FRF is that of
        a sampled plant. Modes above half the rate are seen folded, as broad ones, where no
        filter keeps them out: a pole of several per cent of damping may be one of these.
    dofs : mapping {channel: DOF label}, optional
        Where outputs and inputs are; shapes are labelled by it, and mass-normalised where an
        input and an output share a DOF.
    setups : lists of channels, optional
        Which outputs (or which inputs) were measured together, where a sensor (or a hammer) roved:
        poles may differ from one to the next. Each by itself when not given.
    refine : bool, optional
        Whether to fit by maximum likelihood; when not given, where that is cheap (values of the FRF
        times (poles times references) squared up to 5e7 at each step, 5e10 in all) and worth it:
        not where poles of each output's own leave noise alone and shared ones far more, as outputs
        that disagree do. False takes about a second.
    most : int
        Poles that the fit may have, the strongest; others of the diagram are in `rejected`.
    max_iterations : int
        Of the fit.
    progress : bool, optional
        A bar of the stages: None shows one on a terminal for work of more than two seconds, and
        anywhere when a costly refinement is requested, with its cost.

    Returns
    -------
    IdentifiedModes
        A `MeasuredModes`, sorted by frequency, without mode numbers (see `numbered`). Its
        covariance is enlarged by the misfit where that exceeds one.

    Warns
    -----
    FlexplantWarning
        When the residual of a stretch of lines is more than noise: a missed or merged mode; or
        when a resonance is narrower than half a line of Hann-windowed segments, or than about four
        where the window is not fitted through.

    Raises
    ------
    ModelError, ShapeError, LabelError
        When an argument is out of range or does not belong to this FRF.
    SolverError
        When no pole is found, or the fit does not settle.

    References
    ----------
    [GolubPereyra2003]_; [PintelonSchoukens2012]_, ch. 9; [Pintelon2007]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[4e5], ground=[1e5, 0.0])
    >>> modes = fx.solve_modes(model, count=2, damping=fx.ModalDamping(0.01))
    >>> sensors = [fx.Sensor(f"y{i}", at=f"{i}:x") for i in (1, 2)]
    >>> plant = fx.assemble_plant(modes, fx.Ports(u=[fx.Actuator("u1", at="1:x")], y=sensors))
    >>> found = fx.identify_modes(fx.frequency_response(plant.Gyu, np.linspace(10.0, 250.0, 400)))
    >>> found.freq.round(2), modes.freq.round(2)
    (array([ 34.46, 147.  ]), array([ 34.46, 147.  ]))
    """
    most, steps = whole(most, "most"), whole(max_iterations, "max_iterations")
    if refine is not None and not isinstance(refine, bool):
        raise ModelError(f"refine is True, False or None, got {short(refine)}.")
    runs: tuple[Any, ...] = tuple(frf) if isinstance(frf, list | tuple) else (frf,)
    if len(runs) != 1:
        runs = repetitions(runs)
    with one_thread():
        try:
            return _identified(
                *(runs, band, orders, start, lower, upper, hold),
                *((dofs, setups), (refine, most, steps), progress),
            )
        except SolverError as error:
            raise of_segments(runs[0], error) from None


def _identified(
    runs: tuple[Frf, ...],
    band: tuple[float, float] | None,
    orders: Iterable[int] | None,
    start: PoleSelection | None,
    lower: int,
    upper: int | None,
    hold: float | None,
    channels: tuple[Any, Any],
    limits: tuple[bool | None, int, int],
    progress: bool | None,
) -> IdentifiedModes:
    frf = runs[0]
    ready = prepared_lines(stacked_runs(runs) if len(runs) > 1 else frf, band)
    high = float(ready.freq[-1])
    lower = whole(lower, "lower", minimum=0, maximum=MOST_TERMS)
    terms = UPPER[-1] if upper is None else whole(upper, "upper", minimum=0, maximum=MOST_TERMS)
    rate = None if hold is None else positive(hold, "hold")
    if rate is not None and high > rate / 2 * (1 + ROUNDING):
        raise ModelError(f"a hold at {rate:g} Hz and lines up to {high:g} Hz do not go together.")
    labels = checked_channels(channels[0], frf)
    side, together = checked_setups(channels[1], frf)
    if len(runs) > 1:
        if side:
            raise ModelError("setups= are those of one measurement, got several: give one of them.")
        side, together = RUNS, tuple(np.split(np.arange(len(runs) * len(frf.outputs)), len(runs)))
    listed = None if orders is None else checked_orders(orders)
    if start is not None:
        instance(start, PoleSelection, "start", "Pass diagram.select(freq=[...]).")
    if not ready.known:
        ready = weighted_by_remainder(ready, affordable(listed, ready)[-1])
    refine, most, steps = limits
    budget = Products()

    def lines_of(ready: PreparedLines) -> Lines:
        rows = RUNS if side == RUNS and ready.side == "outputs" else ready.side
        # with all residual terms, so that no pole is kept or moved to stand in for one
        return Lines(
            *(ready.freq, ready.data, ready.weight, lower, terms, rate, ready.known),
            inflation=ready.inflation,
            variance_freedom=frf.freedom,
            segment=hann_segment(frf),
            most=most,
            work=budget,
            side=rows,
            setups=together if side == rows else (),
        )

    diagram, at_peaks, alone = None, False, start is None
    if start is None:
        diagram = diagram_of(ready, affordable(listed, ready), (0.01, 0.05, 0.95), 0.2)
        try:
            chosen = diagram.automatic()
        except SolverError:
            if frf.window is not None or refine:
                raise
            lines = lines_of(ready)
            found = _at_peaks(lines)
            at_peaks = found is not None
            found = found or _highest_pole(lines, diagram)
            if found is None:
                raise
            chosen, alone, refine = found, False, False if at_peaks else refine
            warn(
                "no pole stays over the orders of the stabilisation diagram: the poles are those "
                + (
                    "of the highest peaks, their damping is no more than its order of magnitude "
                    "and their deviations are half a width of the resonance. A transient that has "
                    "not decayed or a single run looks so: average over more runs."
                    if at_peaks
                    else "nearest the largest response. Widen the band, or choose from the diagram "
                    "by hand (start=)."
                )
            )
    elif start.participation.shape[0] != ready.data.shape[1]:
        raise ShapeError(
            f"start was chosen with {counted(start.participation.shape[0], 'reference')}, this FRF "
            f"has {ready.data.shape[1]}: make the diagram from the same channels."
        )
    else:
        chosen = start
    free = upper is None
    work = ready.data.size * (len(chosen) * ready.data.shape[1]) ** 2
    costly = work > CHEAP
    shown = True if refine and costly and progress is None else progress
    name = f"modes, {work:.1e} operations a step" if costly else "modes"
    advice = "Fewer lines (band=), fewer channels or refine=False take less."
    with Progress(STAGES, name, progress=shown, advice=advice) as bar:
        bar.advance()
        expect(work * (_REFINED if refine or (refine is None and not costly) else _FIRST))
        lines = lines_of(ready)
        judged = refine is not False and not at_peaks
        # one step is as near to a machine as noise is; what outputs disagree in needs more
        fit, weaker = _first_fit(lines, chosen, alone, QUICK if judged else int(alone))
        reason = ""
        if judged and alone and lesser(fit, fit.participation, ALIKE):
            less = single(lines, fit, fit.participation, QUICK)
            fit = less if outputs_disagree(less, fit.cost) else fit
        differ = judged and outputs_disagree(fit)
        asked = side not in ("", lines.side)
        if asked or (not side and judged and not differ and _may_disagree(fit)):
            other = single(lines_of(ready.turned), fit, fit.shapes, QUICK)
            differ = judged and outputs_disagree(other, np.inf if asked else fit.cost)
            if differ or asked:
                ready, lines, fit = ready.turned, other.lines, other
        differ = differ and refine is None
        if refine is False:
            reason = "refine=True for more"
        elif refine is None and costly:
            reason = f"refine=True for more, {work:.1e} operations a step"
        elif differ:
            reason = f"a refinement comes no nearer to poles that {lines.side} do not share"
        else:
            budget.most = np.inf if refine else budget.done + BUDGET
            try:
                ready, lines, fit = _likeliest_fit(ready, lines_of, fit, alone, free, steps, bar)
            except Exhausted:
                reason = f"more is left than shared poles explain after {BUDGET:.0e} operations"
        budget.most, settled = np.inf, not reason

        # poles that outputs are to share are known where a refinement, or own fits, were made
        compare = settled or differ

        def again(poles: ComplexArray, part: ComplexArray) -> Fit:
            count = steps if settled else QUICK * int(compare)
            return refined(lines, poles, part, steps=count, strict=False)

        fit, reported, rejected = gated(lines, fit, again, alone=alone, compare=compare)
        apart = None
        if settled:
            fit = refined(lines, fit.poles, fit.participation, steps=steps, fine=True)
        if compare:
            excess = fit.cost - freedom(lines, fit.poles.size)
            apart = disagreement(lines, fit, own_price(lines, fit), excess)
            if apart is not None:
                reported, others = steady(fit, reported, apart)
                fit = Fit(lines, apart.poles, fit.participation, fit.pivots)
                rejected += others
        # a first answer may leave some misfit, but not so much that deviations are twice as large
        misfit = fit.cost / freedom(lines, fit.poles.size)
        if compare or budget.done > BUDGET or (alone and misfit > LARGE):
            differing = None if apart is None else (apart.size, lines.side, _odd(frf, lines, apart))
            warned(unexplained(lines, fit), differing)
        if side == RUNS:
            ready = ready.over_runs(len(runs))
            lines = replace(lines, data=ready.data, weight=ready.weight, setups=())
            fit = Fit(lines, fit.poles, fit.participation, fit.pivots)
        listed_out = tuple(sorted(weaker + rejected + ready.mains))
        answered = answer(
            frf, ready, lines, fit, reported, labels, diagram, listed_out, reason, apart
        )
        if at_peaks:
            half = np.maximum(-answered.poles.real, np.pi * float(np.median(np.diff(lines.freq))))
            answered = answered.replace(covariance=np.diag(np.tile(half, 2) ** 2))
        bar.advance(STAGES - bar.done)
    leakage_warned(frf, answered)
    return answered


def _odd(frf: Frf, lines: Lines, apart: Disagreement) -> str:
    """Return which output, input or run is off by far more than the others, empty where none is."""
    if apart.odd is None:
        return ""
    place, off = apart.odd
    names = frf.inputs if lines.side == "inputs" else frf.outputs
    who = f"run {place + 1}" if lines.side == RUNS else names[int(lines.parts[place][0])]
    return f"{who} is off by {100 * off:.2g} %, far more than the others: look at it. "


def _highest_pole(lines: Lines, diagram: StabilisationDiagram) -> PoleSelection | None:
    """Return the diagram's pole nearest the largest response, None where nothing stands out.

    In a band little wider than its resonance, whose lines afford few orders, poles of outputs that
    disagree are not the same from one order to the next.
    """
    power = np.sum(np.abs(lines.data * lines.weight) ** 2, axis=(0, 1))
    inner = slice(FLANK, -FLANK)
    place = int(np.argmax(power[inner]))
    if power[inner][place] < STANDS_OUT * np.median(power):
        return None
    with attempted("a pole at the largest response", ModelError):
        return diagram.select([float(lines.freq[inner][place])])
    return None


def _at_peaks(lines: Lines) -> PoleSelection | None:
    """Return poles at the peaks of a response that no stable poles explain, as a grid finds them.

    A response whose phase rises through a resonance (a transient that is not decayed, a record of
    one run) has no pole that is stable there, and its peak is one all the same.
    """
    spacing = 2 * np.pi * float(np.median(np.diff(lines.freq)))
    none = np.zeros((lines.data.shape[1], 0), dtype=np.complex128)
    fit = Fit(lines, none[0], none)
    ends = 2 * np.pi * np.array([lines.freq[FLANK], lines.freq[-1 - FLANK]])
    for _ in range(MOST):
        trials = [one for rivals in missed_poles(lines, fit) for one in rivals]
        trials = [
            one
            for one in trials
            if ends[0] < one.poles[-1].imag < ends[1]
            and np.all(np.abs(one.poles[-1] - fit.poles) > REGION * spacing)
        ]
        best = max(trials, key=lambda trial: trial.gain - trial.least, default=None)
        if best is None or best.gain < best.least:
            break
        fit = Fit(lines, best.poles, best.participation)
    return PoleSelection(fit.poles, fit.participation) if fit.poles.size else None


def _may_disagree(fit: Fit) -> bool:
    """Return whether references may disagree: more than noise is left, or poles stand beside."""
    return len(fit.participation) > 1 and bool(
        lesser(fit, fit.shapes, ALIKE) or fit.cost > NOISE * freedom(fit.lines, fit.m)
    )


def _first_fit(
    lines: Lines, chosen: PoleSelection, alone: bool, steps: int
) -> tuple[Fit, tuple[Rejected, ...]]:
    """Return the fit near the poles chosen, with all residual terms and no search for others.

    Of more poles than are requested the strongest are kept; the others are returned too.
    """
    if not alone:
        fit = Fit(lines, chosen.poles, chosen.participation)
        now = fit.poles, fit.participation
        return (refined(lines, *now, steps=steps, strict=False) if steps else fit), ()
    fit = supported(lines, chosen.poles, chosen.participation)
    height = strength(fit)
    height[lesser(fit, fit.shapes, ALIKE)] *= TINY  # of two poles of one resonance one counts
    places = np.argsort(-height, kind="stable")
    keep, others = np.sort(places[: lines.most]), places[lines.most :]
    weaker = tuple(rejected(fit, int(k), f"weaker than the {lines.most} of most=") for k in others)
    if weaker:
        fit = pivoted(lines, fit.poles[keep], fit.participation[:, keep])
    fit = refined(lines, fit.poles, fit.participation, steps=steps, strict=False, first=fit)
    return fit, weaker


def _likeliest_fit(
    ready: PreparedLines,
    lines_of: Callable[[PreparedLines], Lines],
    first: Fit,
    alone: bool,
    free: bool,
    steps: int,
    bar: Progress,
) -> tuple[PreparedLines, Lines, Fit]:
    """Return the maximum likelihood fit, with the poles and terms that the data support."""
    poles, part = first.poles, first.participation
    reducing = [(unwindowed, 1), (dropped, int(alone))]
    reducing += [(merged, MOST * int(alone)), (fewer_terms, int(free))]
    growing = [
        *((missed_poles, MOST), (merged, MOST), (more_terms, int(free))),
        *((split_proposals, MOST), (relocated, MOST), (merged, MOST), (missed_poles, MOST)),
    ]
    for _ in range(1 if ready.known else 2):
        lines = lines_of(ready)
        start = supported(lines, poles, part) if alone else pivoted(lines, poles, part)
        # poles that turn out to be none may keep it from settling: judged at the end
        fit = refined(
            lines, start.poles, start.participation, steps=steps, strict=not alone, first=start
        )
        lines, fit = improved(lines, fit, reducing, steps=steps)
        bar.advance()
        if alone:
            lines, fit = improved(lines, fit, growing, steps=steps, rough=True)
            bar.advance()
        poles, part = fit.poles, fit.participation
        if not ready.known:
            share = 1.0 - freedom(lines, poles.size) / (2 * fit.model.size)
            ready = ready.from_residuals(ready.data - fit.model, share)
    return ready, lines, fit


def checked_channels(dofs: Any, frf: Frf) -> dict[str, str]:
    """Return {channel: DOF label}, checked."""
    if dofs is None:
        return {}
    instance(dofs, Mapping, "dofs", "Pass {channel: DOF label}.", LabelError)
    require_known("channel", dofs, sorted({*frf.inputs, *frf.outputs}))
    return {str(name): str(label) for name, label in dofs.items()}


def checked_setups(setups: Any, frf: Frf) -> tuple[str, tuple[IntArray, ...]]:
    """Return "outputs", "inputs" or "" of none, and which of them each set-up measured."""
    if setups is None:
        return "", ()
    listed = [[str(name) for name in one] for one in setups if several(one)]
    flat = sorted(name for one in listed for name in one)
    for side, names in (("outputs", frf.outputs), ("inputs", frf.inputs)):
        if flat == sorted(names) and len(listed) > 1 and all(listed):
            return side, tuple(np.array([names.index(name) for name in one]) for one in listed)
    raise LabelError(
        f"setups are two lists or more that hold each of the outputs {short(list(frf.outputs))}, "
        f"or each of the inputs {short(list(frf.inputs))}, once, got {short(setups)}."
    )
