"""From measured FRFs to poles, mode shapes and their covariance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..arrays import IntArray, between, positive, real_array, whole
from ..errors import LabelError, ModelError, SolverError, require_known, short
from ..lti.frequency import Frf
from ..parallel import one_thread
from ..tolerances import ROUNDING
from ..words import instance, several
from .causality import forward_in_time
from .diagram import (
    PoleSelection,
    StabilisationDiagram,
    affordable,
    checked_orders,
    diagram_of,
    weighted_by_remainder,
)
from .frf_estimation import repetitions, stacked_runs
from .identification_stages import MOST_POLES, RUNS, Task, identified
from .line_weights import prepared_lines
from .result import IdentifiedModes, of_segments

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
    frf, band
        As for `identify_modes`. Velocity and acceleration are integrated; no quantity is taken for
        displacement.
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
    ready = prepared_lines(forward_in_time(frf, band), band)
    listed = None if orders is None else checked_orders(orders)
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

    ``found = fx.identify_modes(frf, band=(50.0, 800.0), dofs={"y1": "41:z"})``: `found.freq` [Hz],
    `found.zeta` and `found.shapes` are the answer, `found.rejected` says which poles were left out
    and why, and `fx.plot.identified` draws it beside the measurement.
    ``fx.Eigenvalues(fx.numbered(found, drawing))`` is what `update` takes. Poles come from a
    stabilisation diagram and a maximum likelihood fit, without choices to make; `start=` takes
    poles picked by eye. Modes outside the band are accounted for; what the
    fit does not explain is warned of, with its frequency. How it works: `algorithms`.

    Parameters
    ----------
    frf : Frf, or list of Frf
        Measured, or runs of the same channels between which the machine may have drifted (a mean of
        these shows broader resonances, and hides it): poles are then means over the runs, with
        deviations from how these differ.
        With a variance, errors are weighted by it and the covariance follows from it (and from the
        correlation between outputs, and between lines by the window, where known); without, both
        come from what the fit leaves, averaged over 41 lines.
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
        Rate of the zero-order hold between the inputs and the machine, where the FRF is that of a
        sampled plant. Modes above half the rate are then seen folded, as broad ones of several per
        cent of damping, where no filter keeps them out.
    dofs : mapping {channel: DOF label}, optional
        Where outputs and inputs are; shapes are labelled by it, and mass-normalised where an
        input and an output share a DOF.
    setups : lists of channels, optional
        Which outputs (or which inputs) were measured together, where a sensor (or a hammer) roved:
        poles may differ from one to the next. Each by itself when not given.
    refine : bool, optional
        Whether to fit by maximum likelihood; when not given, where that is cheap (values of the FRF
        times (poles times references) squared up to 5e7 at each step, 5e10 in all) and worth it:
        not where outputs disagree, which poles of their own explain and shared ones do not. False
        takes about a second.
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
        where the window is not fitted through; when the FRF is of the convention exp(-i omega t),
        whose conjugate is then used.

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
    if refine is not None and not isinstance(refine, bool):
        raise ModelError(f"refine is True, False or None, got {short(refine)}.")
    runs: tuple[Any, ...] = tuple(frf) if isinstance(frf, list | tuple) else (frf,)
    if len(runs) != 1:
        runs = repetitions(runs)
    with one_thread():
        try:
            runs = tuple(forward_in_time(run, band) for run in runs)
            ready = prepared_lines(stacked_runs(runs) if len(runs) > 1 else runs[0], band)
            rate = None if hold is None else positive(hold, "hold")
            high = float(ready.freq[-1])
            if rate is not None and high > rate / 2 * (1 + ROUNDING):
                raise ModelError(
                    f"a hold at {rate:g} Hz and lines up to {high:g} Hz do not go together."
                )
            if start is not None:
                instance(start, PoleSelection, "start", "Pass diagram.select(freq=[...]).")
            side, together = _checked_sides(setups, runs)
            most_terms = upper
            if upper is not None:
                most_terms = whole(upper, "upper", minimum=0, maximum=MOST_TERMS)
            task = Task(
                frf=runs[0],
                runs=len(runs),
                lower=whole(lower, "lower", minimum=0, maximum=MOST_TERMS),
                upper=most_terms,
                hold=rate,
                labels=_checked_channels(dofs, runs[0]),
                side=side,
                together=together,
                refine=refine,
                most=whole(most, "most"),
                steps=whole(max_iterations, "max_iterations"),
            )
            listed = None if orders is None else checked_orders(orders)
            return identified(task, ready, listed, start, progress)
        except SolverError as error:
            raise of_segments(runs[0], error) from None


def _checked_channels(dofs: Any, frf: Frf) -> dict[str, str]:
    """Return {channel: DOF label}, checked."""
    if dofs is None:
        return {}
    instance(dofs, Mapping, "dofs", "Pass {channel: DOF label}.", LabelError)
    require_known("channel", dofs, sorted({*frf.inputs, *frf.outputs}))
    return {str(name): str(label) for name, label in dofs.items()}


def _checked_sides(setups: Any, runs: Sequence[Frf]) -> tuple[str, tuple[IntArray, ...]]:
    """Return what may have poles of its own where that was said, and which rows go together."""
    frf, count = runs[0], len(runs)
    if setups is None:
        if count == 1:
            return "", ()
        return RUNS, tuple(np.split(np.arange(count * len(frf.outputs)), count))
    listed = [[str(name) for name in one] for one in setups if several(one)]
    flat = sorted(name for one in listed for name in one)
    for side, names in (("outputs", frf.outputs), ("inputs", frf.inputs)):
        if flat == sorted(names) and len(listed) > 1 and all(listed):
            if count > 1:
                raise ModelError("setups= are those of one measurement, got several: give one.")
            return side, tuple(np.array([names.index(name) for name in one]) for one in listed)
    raise LabelError(
        f"setups are two lists or more that hold each of the outputs {short(list(frf.outputs))}, "
        f"or each of the inputs {short(list(frf.inputs))}, once, got {short(setups)}."
    )
