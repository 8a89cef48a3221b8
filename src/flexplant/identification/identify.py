"""Poles, mode shapes and their covariance from measured FRFs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    between,
    instance,
    positive,
    real_array,
    several,
    whole,
)
from ..errors import LabelError, ModelError, SolverError, require_known, short, warn
from ..lti.frequency import Frf
from ..parallel import one_thread
from ..tolerances import ROUNDING
from .diagram import (
    BROADEST,
    STEADY,
    PoleSelection,
    StabilisationDiagram,
    diagram_of,
    order_poles,
    parts_of,
    weighted_by_remainder,
)
from .frf_estimation import repetitions, stacked_runs
from .identification_stages import MOST_POLES, RUNS, Task, identified
from .lines import UPPER, PreparedLines, axis, pole_terms, prepared_lines, residual_terms
from .result import IdentifiedModes, of_segments

#: largest number of residual terms on one side of the band: higher powers of a frequency cannot be
#: distinguished in double precision
MOST_TERMS = 20
#: number of times of the impulse response examined on either side of zero
TIMES = 96
#: the main lobe of the spectrum of a Hann window over a band B ends at 2/B
LOBE = 2.0
#: ratio of the residual of stable modes for the conjugate to that for the data, below which the
#: conjugate is used; with noise as large as the responses both are equal
BETTER = 0.8


def stabilisation_diagram(
    frf: Frf,
    *,
    band: tuple[float, float] | None = None,
    orders: Iterable[int] | None = None,
    tolerances: tuple[float, float, float] = STEADY,
    max_zeta: float = BROADEST,
) -> StabilisationDiagram:
    """Return the poles of matrix-fraction models of rising order, by pLSCF.

    pLSCF is the poly-reference least-squares complex frequency-domain method. The model is
    ``H(z) = B(z) A(z)^-1``, where B and A are matrix polynomials in z with complex coefficients.
    When the frequency moves through the band, z moves along the unit circle. The poles follow from
    A. See `flexplant.identification.diagram`.

    Parameters
    ----------
    frf, band
        Measured FRF and its frequency band, as for `identify_modes`. Velocity and acceleration are
        integrated. An FRF without a quantity is taken as displacement.
    orders : iterable of int, optional
        Model orders. A model has order * min(n_in, n_out) poles. None: orders from 2 to 40, but at
        most a quarter of the number of lines, and at most 100 poles. Only every second order is
        used if a wide band and many inputs and outputs make each order costly.
    tolerances : (float, float, float)
        Three limits for a stable pole, from one order to the next: the largest relative change of
        frequency, that of damping, and the smallest MAC (modal assurance criterion) of its shapes.
    max_zeta : float
        Largest damping ratio of a pole.

    Returns
    -------
    StabilisationDiagram
        Diagram, from which `.automatic()` or `.select(freq=[...])` chooses poles. It is drawn by
        `plot.stabilisation`.

    Raises
    ------
    ModelError
        When the band has less than 20 lines, or orders or tolerances are out of range.

    References
    ----------
    [Peeters2004]_.

    Examples
    --------
    The pole of an FRF with a resonance at 20 Hz:

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
    top = between(
        max_zeta, "max_zeta", 0.0, 1.0, "With 1 or more nothing oscillates: pass for example 0.2."
    )
    ready = forward_in_time(frf, band)[1]
    listed = None if orders is None else checked_orders(orders)
    if not ready.known:
        ready = weighted_by_remainder(ready, listed)
    with one_thread():
        return diagram_of(ready, listed, limits, top)


def identify_modes(
    frf: Frf | Sequence[Frf],
    *,
    band: tuple[float, float] | None = None,
    orders: Iterable[int] | None = None,
    start: PoleSelection | None = None,
    lower: int = 2,
    upper: int | None = None,
    hold: float | None = None,
    delay: float = 0.0,
    dofs: Mapping[str, str] | None = None,
    setups: Iterable[Iterable[str]] | None = None,
    refine: bool | None = None,
    most: int = MOST_POLES,
    max_iterations: int = 150,
    progress: bool | None = None,
) -> IdentifiedModes:
    """Return poles, mode shapes and their covariance from measured FRFs.

    A call such as ``found = fx.identify_modes(frf, band=(50.0, 800.0), dofs={"y1": "41:z"})`` gives
    the frequencies `found.freq` [Hz], the damping ratios `found.zeta` and the shapes
    `found.shapes`. `found.rejected` lists poles that were left out, with the reason, and
    `fx.plot.identified` draws the result together with the measurement. For `update`, use
    ``fx.Eigenvalues(fx.numbered(found, model))``. Poles are found by a stabilisation diagram and
    refined by a maximum likelihood fit, without choices by the user. `start=` accepts poles that
    you picked in the diagram. Modes outside the band are taken into account. A warning names
    frequencies that the fit does not explain. The method is described in `algorithms`.

    Parameters
    ----------
    frf : Frf, or list of Frf
        Measured FRF, or a list of several runs with the same channels. Pass a list if the machine
        may have drifted between the runs, since their mean would have broader resonances. Each pole
        is then the mean over the runs, and its standard deviation follows from the differences
        between the runs. If an FRF has a variance, it gives the weights of the fit and the
        covariance of the poles. Correlations of the errors between outputs and between neighbouring
        lines (from the window) are included if they are known. Without a variance, the weights and
        the covariance follow from the residual of the fit, averaged over 41 lines.
    band : (low, high) [Hz], optional
        Frequency band of the fit and of the reported modes. None: all lines.
    orders : iterable of int, optional
        Model orders of the stabilisation diagram. None: those of `stabilisation_diagram`.
    start : PoleSelection, optional
        Poles chosen by hand, for example by `stabilisation_diagram(frf).select(freq=[...])`.
    lower : int
        Number of terms 1/s, 1/s^2, ... in the fit. They represent rigid-body modes and modes below
        the band.
    upper : int, optional
        Number of terms 1, s, s^2, ... in the fit. They represent modes above the band. None: 3, and
        up to 25 if the data require more. Too few terms bias the poles. A bias of up to one
        standard deviation is not visible in the misfit.
    hold : float [Hz], optional
        Rate of the zero-order hold between the inputs and the machine. Give it if the FRF is that
        of a sampled plant. Modes above half the rate then appear folded, as broad modes with
        several per cent of damping, unless a filter removes them.
    delay : float [samples]
        Delay of the response in periods of the hold, as for `StandardPlant.discretized`. It may be
        fractional.
    dofs : mapping {channel: DOF label}, optional
        DOFs of outputs and inputs. They are the labels of the shapes. If an input and an output
        have the same DOF, the shapes are mass-normalised.
    setups : lists of channels, optional
        Groups of outputs (or inputs) that were measured together. They are needed if a sensor (or
        the hammer) was moved, because the poles may then differ between groups. None: every channel
        is a separate group.
    refine : bool, optional
        Whether to refine the poles by maximum likelihood. False: the result without refinement, in
        about a second. None: the poles are refined if this is useful and takes at most one or two
        minutes. It is not useful if separate outputs have different poles (see `setups`). The cost
        of a step is estimated as ``n (m r)^2`` with n values of the FRF, m poles and r references
        (the inputs, or the outputs if there are fewer of them). The limits are 5e7 for each step
        and 5e10 in total.
    most : int
        Largest number of poles of the fit. The strongest poles of the diagram are used, and
        `rejected` lists the others.
    max_iterations : int
        Largest number of iterations of the fit.
    progress : bool, optional
        Whether to show a progress bar. None: a bar is shown on a terminal for work of more than two
        seconds. It is always shown, with the cost, when a costly refinement is requested.

    Returns
    -------
    IdentifiedModes
        Modes sorted by frequency. They have no mode numbers, which `numbered` adds. If the misfit
        (ratio of the squared residual to that of the noise) exceeds 1, the covariance is multiplied
        by it.

    Warns
    -----
    FlexplantWarning
        When the residual of a group of lines exceeds the noise, because a mode was missed or two
        were merged. When a resonance is too narrow for the distance between lines. Its width must
        be at least half of this distance if the fit includes the window (Hann-windowed segments),
        and otherwise about four times this distance. When the FRF has the sign convention of
        ``exp(-i omega t)``, so that its complex conjugate is used.

    Raises
    ------
    ModelError, ShapeError, LabelError
        When an argument is out of range or does not match this FRF.
    SolverError
        When no pole is found, or the fit does not converge.

    References
    ----------
    [GolubPereyra2003]_; [PintelonSchoukens2012]_, ch. 9; [Pintelon2007]_.

    Examples
    --------
    The modes of a chain are identified from its frequency responses:

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
            runs, prepared = zip(*(forward_in_time(run, band) for run in runs), strict=True)
            ready = prepared_lines(stacked_runs(runs), band) if len(runs) > 1 else prepared[0]
            rate = None if hold is None else positive(hold, "hold")
            high = float(ready.freq[-1])
            if rate is not None and high > rate / 2 * (1 + ROUNDING):
                raise ModelError(f"a hold at {rate:g} Hz does not match lines up to {high:g} Hz.")
            if start is not None:
                instance(start, PoleSelection, "start", "Pass diagram.select(freq=[...]).")
            late = positive(delay, "delay", zero=True)
            if late and rate is None:
                raise ModelError(
                    f"delay={late:g} is in samples of a hold: give hold= its rate [Hz], or turn "
                    "the phase of a continuous response back."
                )
            if rate is not None:
                ready = ready.advanced(late / rate)
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
                delay=late,
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


def checked_orders(orders: Iterable[int]) -> list[int]:
    """Return rising model orders."""
    if not several(orders):
        raise ModelError(
            f"orders are whole numbers to compare, got {short(orders)}. Try range(2, 41)."
        )
    listed = sorted({whole(n, "each of orders") for n in orders})
    if len(listed) < 4:
        raise ModelError(
            f"orders must be at least four whole numbers from 1 to compare, got {listed!r:.60}."
        )
    return listed


def _checked_channels(dofs: Any, frf: Frf) -> dict[str, str]:
    """Return {channel: DOF label}, checked."""
    if dofs is None:
        return {}
    instance(dofs, Mapping, "dofs", "Pass {channel: DOF label}.", LabelError)
    require_known("channel", dofs, sorted({*frf.inputs, *frf.outputs}))
    return {str(name): str(label) for name, label in dofs.items()}


def _checked_sides(setups: Any, runs: Sequence[Frf]) -> tuple[str, tuple[IntArray, ...]]:
    """Return what may have separate poles, if stated, and which rows belong together."""
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
                raise ModelError("setups= needs a single measurement, got several: give one.")
            return side, tuple(np.array([names.index(name) for name in one]) for one in listed)
    raise LabelError(
        f"setups are two lists or more that hold each of the outputs {short(list(frf.outputs))}, "
        f"or each of the inputs {short(list(frf.inputs))}, once, got {short(setups)}."
    )


def forward_in_time(frf: Frf, band: Any) -> tuple[Frf, PreparedLines]:
    r"""Return an FRF in the convention exp(i omega t), conjugated if it was in exp(-i omega t).

    The impulse response of a stable machine is zero before the force, that of the conjugate after
    it. Where more energy ``\int |h(t)|^2 dt`` lies before than after the force, the conjugate is
    used if stable modes fit it better than the given FRF.
    """
    ready = prepared_lines(frf, band)
    rows = ready.data.reshape(-1, ready.freq.size)
    if not _earlier(ready.freq, rows):
        return frf, ready
    mean = frf.correlation
    turned = frf.replace(data=frf.data.conj(), correlation=None if mean is None else np.conj(mean))
    other = prepared_lines(turned, band)
    if _stable_misfit(other) > BETTER * _stable_misfit(ready):
        return frf, ready
    warn(
        "the FRF responds before its forces act: it uses the convention exp(-i omega t), which "
        "has the opposite sign of all imaginary parts. Its conjugate is used. Pass "
        "frf.replace(data=frf.data.conj())."
    )
    return turned, other


def _earlier(freq: FloatArray, data: ComplexArray) -> bool:
    """Return whether responses (n, n_freq) on average have more energy before zero than after."""
    # by the trapezoidal rule over lines of any spacing; a Hann window confines the effect of the
    # band ends to times near zero
    step, band = np.gradient(freq), freq[-1] - freq[0]
    rows = data * np.sin(np.pi * (freq - freq[0]) / band) ** 2
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = rows * step / np.where(size > 0, size, 1.0)
    # lines a step apart repeat the response after 1/step: half of that belongs to either side
    time = np.geomspace(LOBE / band, 0.5 / float(np.median(step)), TIMES)
    turn = 2 * np.pi * np.outer(freq, time)
    parts = np.concatenate([rows.real, rows.imag])
    even, odd = (np.split(parts @ one, 2) for one in (np.cos(turn), np.sin(turn)))
    # a quarter of the difference of |even - i odd|^2 before and |even + i odd|^2 after
    return bool(np.sum(even[0] * odd[1] - even[1] * odd[0], axis=0) @ time > 0)


def _stable_misfit(ready: PreparedLines) -> float:
    """Return the weighted squared error that the stable poles of a matrix fraction leave."""
    left = 0.0
    for part in parts_of(ready):
        seen, freq = part.seen, ready.freq[part.seen]
        poles = order_poles(ready, part, part.orders[-1:])[0].poles
        outside = residual_terms(
            axis(freq), lower=2, upper=UPPER[0], hold=None, top=2 * np.pi * freq[-1]
        )
        terms = np.concatenate([pole_terms(poles, axis(freq), None)[0], outside]).T
        for weight, data in zip(ready.line_weight[:, seen], ready.data[:, :, seen], strict=True):
            columns = terms * weight[:, None]
            columns = columns / np.linalg.norm(columns, axis=0)
            due = (weight * data).T
            fitted = columns @ np.linalg.lstsq(columns, due, rcond=None)[0]
            left += float(np.sum(np.abs(due - fitted) ** 2))
    return left
