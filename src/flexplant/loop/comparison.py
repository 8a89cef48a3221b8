"""Several closed loops side by side: stability, sensitivity at the POI, margin at u."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..checks import FloatArray, Value, instance, short
from ..errors import LabelError, ModelError, require_known
from ..lti.frequency_sweep import climbed_grid
from .blocks import references
from .closed import ClosedLoop
from .sensitivity import first_above

#: share of the bandwidth at which low-frequency suppression is compared
LOW = 0.1


@dataclass(frozen=True, eq=False)
class LoopFigures(Value):
    """What one closed loop reaches; S is the response from the reference to the error at the POI.

    Parameters
    ----------
    stable : bool
        Whether all eigenvalues are strictly inside the stability region.
    decay : float
        The spectral radius of a sampled loop, the spectral abscissa [rad/s] of a continuous one.
    bandwidth : float [Hz]
        Where |S| first crosses 1 from below; NaN without a reference or when unstable.
    peak, peak_freq : float [1], [Hz]
        The largest |S| and where it is.
    low : float [1]
        |S| at `low_freq`.
    low_freq : float [Hz]
        The same for all loops of a comparison.
    margin : float
        Modulus margin, broken at u: ``1 / max_f sigma_max(S_u)``; 0 when unstable.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> row = fx.compare_loops({"servo": fx.close_loop(plant, observer, servo)})["servo"]
    >>> row.stable, round(row.margin, 2)
    (True, 0.57)
    """

    stable: bool
    decay: float
    bandwidth: float
    peak: float
    peak_freq: float
    low: float
    low_freq: float
    margin: float


@dataclass(frozen=True, eq=False, repr=False)
class LoopComparison(Value):
    """The figures of several loops; prints as a table.

    Parameters
    ----------
    rows : mapping {name: LoopFigures}
        One for each loop.
    channel : str
        What S is: ``die:ref to die:error``; empty when the loops have no reference.
    sampled : bool
        Whether `decay` of the rows is a spectral radius.
    """

    rows: Mapping[str, LoopFigures]
    channel: str
    sampled: bool = True

    def __getitem__(self, name: str) -> LoopFigures:
        require_known("loop", [name], self.rows)
        return self.rows[name]

    def __repr__(self) -> str:
        width = max(map(len, self.rows))  # each column after it starts with two spaces
        low_freq = next(iter(self.rows.values())).low_freq  # nan where none is stable
        measure = f"stable ({'spectral radius' if self.sampled else 'largest real part [rad/s]'})"
        low = f"|S| at {low_freq:.3g} Hz" if self.channel and low_freq > 0 else "|S| low"
        head = (measure, "|S| < 1 up to", "max |S|", "at", low, "max |S| at u")
        cells = [_cells(row) for row in self.rows.values()]
        wide = [max(len(h), *(len(c[i]) for c in cells)) + 2 for i, h in enumerate(head)]
        lines = [f"{'':{width}s}" + "".join(f"{h:>{w}s}" for h, w in zip(head, wide, strict=True))]
        for name, cell in zip(self.rows, cells, strict=True):
            shown = "".join(f"{c:>{w}s}" for c, w in zip(cell, wide, strict=True))
            lines.append(f"{name:{width}s}{shown}")
        if self.channel:
            lines.append(f"S is {self.channel}; at u it is 1 / modulus margin.")
        return "\n".join(lines)


def compare_loops(
    loops: Mapping[str, ClosedLoop], *, reference: str | None = None, error: str | None = None
) -> LoopComparison:
    """Return stability, bandwidth and peaks of several loops side by side.

    Parameters
    ----------
    loops : mapping {name: ClosedLoop}
        What to compare: designs on one machine, or one design on a model and the machine.
    reference : str, optional
        The channel of w that S starts from, where there are several; `axis_sensitivities` has all.
    error : str, optional
        The channel of z that S ends at; that of the reference when not given.

    Returns
    -------
    LoopComparison
        |S| at low frequency is read at a tenth of the largest bandwidth of all loops.

    Raises
    ------
    ModelError
        When there is no mapping of closed loops, or some are sampled and some continuous.
    LabelError
        When a loop lacks the channels, or has several references and none is named.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer, loops = fx.design_kalman(plant), {}
    >>> for hz in (10.0, 20.0):
    ...     servo = fx.design_servo(plant, bandwidth=hz, observer=observer)
    ...     loops[f"{hz:g} Hz"] = fx.close_loop(plant, observer, servo)
    >>> {name: row.stable for name, row in fx.compare_loops(loops).rows.items()}
    {'10 Hz': True, '20 Hz': True}
    """
    if not isinstance(loops, Mapping) or not loops:
        raise ModelError(
            f"need a mapping of names to closed loops, got {short(loops)}. Type "
            "{'servo': close_loop(plant, observer, servo)}."
        )
    wrong = [loop for loop in loops.values() if not isinstance(loop, ClosedLoop)]
    if wrong:
        raise ModelError(f"need closed loops, got {short(wrong[0])}. Use close_loop(plant, ...).")
    pair = _reference_pair(next(iter(loops.values())), reference, error)
    for name, loop in loops.items():
        if pair and (pair[0] not in loop.plant.w or pair[1] not in loop.plant.z):
            raise LabelError(
                f"loop {name!r} has no {pair[0]!r} in w or no {pair[1]!r} in z. Compare loops of "
                "the same Ports, or name the channels: reference=, error=."
            )
    sampled = bool(next(iter(loops.values())).plant.dt)
    if any(bool(loop.plant.dt) != sampled for loop in loops.values()):
        raise ModelError(
            "some of the loops are sampled and some continuous: their stability is measured "
            "differently. Compare loops of one kind."
        )
    curves = {
        name: error_sensitivity(loop, *pair) if pair and loop.is_stable else None
        for name, loop in loops.items()
    }
    reached = {name: _bandwidth(curve) for name, curve in curves.items()}
    known = [value for value in reached.values() if np.isfinite(value)]
    low_freq = LOW * max(known, default=np.nan)
    rows = {
        name: _figures(loop, curves[name], reached[name], low_freq, pair)
        for name, loop in loops.items()
    }
    return LoopComparison(rows, f"{pair[0]} to {pair[1]}" if pair else "", sampled)


def _reference_pair(loop: ClosedLoop, reference: str | None, error: str | None) -> tuple[str, ...]:
    """Return reference and error, or nothing when the loop has no reference."""
    for name, given in (("reference", reference), ("error", error)):
        instance(given, str | None, name, "Pass the name of a channel.", LabelError)
    if reference is None:
        known = [name for name in loop.plant.w if name.endswith(":ref")]
        if len(known) > 1:
            raise LabelError(
                f"the loop has {len(known)} references {known}, each with an S of its own: say "
                f"which, reference={known[0]!r}; fx.plot.sensitivity(loop) draws all."
            )
        if not known:
            return ()
        reference = known[0]
    return reference, error if error is not None else f"{reference.removesuffix(':ref')}:error"


def error_sensitivity(
    loop: ClosedLoop, reference: str | None = None, error: str | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return frequencies [Hz] and |S| from reference to error, refined where it is largest."""
    if reference is None or error is None:
        pair = _reference_pair(loop, reference, error)
        if not pair:
            raise LabelError(
                "the loop has no reference, so no sensitivity from it to an error: add "
                "Reference(...) to the ports, or name the channels."
            )
        reference, error = pair
    gain = loop.gain(reference, error)
    return climbed_grid(lambda freq: np.abs(gain(freq)[0, 0]), loop.broken.grid, 4)


def axis_sensitivities(loop: ClosedLoop) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return |S| of each axis that has a reference, by its name: frequencies [Hz] and sizes."""
    pairs = {name: f"{name.removesuffix(':ref')}:error" for name in references(loop.plant)}
    return {
        error.removesuffix(":error"): error_sensitivity(loop, ref, error)
        for ref, error in pairs.items()
        if error in loop.plant.z
    }


def _bandwidth(curve: tuple[FloatArray, FloatArray] | None) -> float:
    """Return where |S| first crosses 1 from below, between two points of the grid by logarithms."""
    if curve is None:
        return float("nan")
    freq, size = curve
    if not np.any(size < 1.0):
        return 0.0
    right = first_above(size)
    if right is None:
        return float("inf")
    pair = slice(right - 1, right + 1)
    return float(np.exp(np.interp(0.0, np.log(size[pair]), np.log(freq[pair]))))


def _figures(
    loop: ClosedLoop,
    curve: tuple[FloatArray, FloatArray] | None,
    reached: float,
    low_freq: float,
    pair: tuple[str, ...],
) -> LoopFigures:
    decay = loop.spectral_radius if loop.plant.dt else loop.spectral_abscissa
    nan = float("nan")
    if curve is None:
        margin = loop.modulus_margin if loop.is_stable else 0.0
        return LoopFigures(loop.is_stable, decay, nan, nan, nan, nan, low_freq, margin)
    top = int(np.argmax(curve[1]))
    low = nan
    if np.isfinite(low_freq):
        low = float(abs(loop.gain(*pair)(np.array([low_freq]))[0, 0, 0]))
    return LoopFigures(
        True, decay, reached, float(curve[1][top]), float(curve[0][top]), low, low_freq,
        loop.modulus_margin,
    )  # fmt: skip


def _cells(row: LoopFigures) -> tuple[str, ...]:
    """Return the row of a table: Hz and dB."""
    if not row.stable:
        return (f"NO ({row.decay:.6f})", "-", "-", "-", "-", "-")
    return (
        f"yes ({row.decay:.6f})",
        _hertz(row.bandwidth),
        _decibel(row.peak),
        _hertz(row.peak_freq),
        _decibel(row.low),
        _decibel(1.0 / row.margin),
    )


def _hertz(freq: float) -> str:
    return "-" if np.isnan(freq) else f"{freq:.{1 if freq < 1e3 else 0}f} Hz"


def _decibel(size: float) -> str:
    return "-" if np.isnan(size) or size <= 0 else f"{20.0 * np.log10(size):.1f} dB"
