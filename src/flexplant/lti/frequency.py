"""Frequency responses: exact, from the blocks of A where it has blocks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from ..arrays import (
    ComplexArray,
    FloatArray,
    between,
    complex_array,
    known_units,
    name_list,
    positive,
    positive_array,
    signal_names,
)
from ..errors import LabelError, ModelError, ShapeError, counted, require_known, short
from ..parallel import Progress, expect
from ..store import Value, checked, rebuild
from ..tolerances import SAME, TINY
from .blocks_of_states import chosen_pair, rows_of, short_list
from .frequency_sweep import checked_freq as checked_freq
from .frequency_sweep import default_freq as default_freq
from .frequency_sweep import sampled_freq as sampled_freq
from .measured_lines import line_correlation
from .response_solvers import responses
from .statespace import StateSpace, System, as_statespace

#: number of multiplications below which a response needs no progress bar
_LONG = 1e9
_NUMBERS = (int, float, complex, np.number)


def checked_correlation(value: Any, shape: tuple[int, ...]) -> ComplexArray:
    """Return the correlation (n_out, n_out, n_freq) of the errors of outputs."""
    correlation = complex_array(value, "correlation")
    if correlation.shape != (shape[0], shape[0], shape[2]):
        raise ShapeError(
            f"correlation must have shape ({shape[0]}, {shape[0]}, {shape[2]}), "
            f"got {correlation.shape}: one row and column for each output."
        )
    unit = np.eye(shape[0])[:, :, None]
    hermitian = np.abs(correlation - correlation.conj().transpose(1, 0, 2))
    wrong = np.maximum(np.abs(correlation * unit - unit), hermitian)
    if not (np.all(np.abs(correlation) <= 1 + SAME) and np.all(wrong <= SAME)):
        raise ModelError(
            "correlation must be Hermitian with ones on the diagonal and none larger than one. "
            "Divide a covariance by the standard deviations of both outputs."
        )
    return correlation


def checked_window(window: Any, name: str = "window") -> str | tuple[Any, ...]:
    """Return a window that `scipy.signal.get_window` takes."""
    from scipy.signal import get_window  # slow import that few users need

    window = tuple(window) if isinstance(window, list) else window
    try:
        get_window(window, 16)
    except (ValueError, TypeError, IndexError) as error:
        raise ModelError(f"{name} {window!r} is not one of scipy.signal: {error}") from error
    return window  # type: ignore[no-any-return]


def checked_overlap(overlap: Any, name: str = "overlap") -> float:
    """Return an overlap below 0.95."""
    return between(
        overlap, name, 0.0, 0.95, "A larger overlap adds no information: try 0.5.", ends="["
    )


def error_statistics(left: ComplexArray, inverse: ComplexArray) -> tuple[FloatArray, ComplexArray]:
    """Return variance (o, i, f) and correlation (o, o, f) from noise and inverse input spectra."""
    noise = np.maximum(np.einsum("foo->fo", left).real, 0.0)
    gain = np.einsum("fii->fi", inverse).real
    variance = noise[:, :, None] * gain[:, None, :]
    size = np.sqrt(np.maximum(noise, TINY))
    correlation = left / (size[:, :, None] * size[:, None, :])
    correlation = (correlation + correlation.conj().transpose(0, 2, 1)) / 2
    correlation /= np.maximum(1.0, np.abs(correlation))
    rows = np.arange(left.shape[1])
    correlation[:, rows, rows] = 1.0
    return variance.transpose(1, 2, 0), correlation.transpose(1, 2, 0)


def _reciprocal(frf: Any) -> Any:
    """Return 1/G, from the output to the input of G; its variance is ``var G / |G|^4``."""
    if frf.data.shape[:2] != (1, 1):
        raise ShapeError(
            f"the quotient needs a response of one input and one output, got {_io_text(frf)}. "
            "Select one pair, or solve line by line: numpy.linalg.solve over data."
        )
    if not np.all(frf.data):
        zero = float(frf.freq[~frf.data[0, 0].astype(bool)][0])
        raise ModelError(
            f"the response is 0 at {zero:g} Hz: its inverse is infinite there. Leave the line out."
        )
    inverse = 1.0 / frf.data
    variance = None if frf.variance is None else frf.variance * np.abs(inverse) ** 4
    return _computed(frf, inverse, variance, inputs=frf.outputs, outputs=frf.inputs, quantity=None)


def _operand(given: Any, frf: Any) -> Any:
    """Return a response, or that of a system, on the lines of an Frf."""
    if not isinstance(given, Frf):
        return _of_system(as_statespace(given), frf.freq)
    lines: FloatArray = given.freq
    if lines.shape != frf.freq.shape or not np.allclose(lines, frf.freq, rtol=SAME, atol=0.0):
        raise ShapeError(
            f"responses are combined line by line, but one has {_line_range(frf)} and the other "
            f"{_line_range(given)}. Compute or measure both at the same frequencies."
        )
    return given


def _multiple(frf: Any, factor: complex) -> Any:
    if not np.isfinite(factor):
        raise ModelError(f"responses are multiplied by a finite number, got {factor:g}.")
    variance = None if frf.variance is None else abs(factor) ** 2 * frf.variance
    return frf.replace(data=factor * frf.data, variance=variance)


def _matrix_product(one: Any, two: Any) -> Any:
    """Return the product of two matrices of responses, line by line."""
    if len(one.inputs) != len(two.outputs):
        raise ShapeError(
            "a product G1 * G2 needs as many outputs of G2 as inputs of G1, got "
            f"{len(two.outputs)} ({short_list(two.outputs)}) and {len(one.inputs)} "
            f"({short_list(one.inputs)})."
        )

    def product(a: Any, b: Any) -> Any:
        return None if a is None or b is None else np.einsum("ijf,jkf->ikf", a, b)

    variance = _optional_sum(
        product(one.variance, np.abs(two.data) ** 2), product(np.abs(one.data) ** 2, two.variance)
    )
    units = {name: unit for name, unit in two.channel_units.items() if name in two.inputs}
    units |= {name: unit for name, unit in one.channel_units.items() if name in one.outputs}
    return _computed(
        one, product(one.data, two.data), variance,
        inputs=two.inputs, outputs=one.outputs, units=units, quantity=None,
    )  # fmt: skip


def _computed(frf: Any, data: ComplexArray, variance: FloatArray | None, **fields: Any) -> Any:
    """Return an Frf on the same lines that no single measurement gave."""
    lost = ("coherence", "correlation", "resolution", "window", "freedom")
    return frf.replace(data=data, variance=variance, overlap=0.0, **dict.fromkeys(lost), **fields)


def _optional_sum(a: FloatArray | None, b: FloatArray | None) -> FloatArray | None:
    return b if a is None else a if b is None else a + b


def _io_text(one: Any) -> str:
    return f"{short_list(one.inputs)} -> {short_list(one.outputs)}"


def _line_range(frf: Any) -> str:
    span = f" from {frf.freq[0]:.4g} to {frf.freq[-1]:.4g} Hz" if frf.freq.size else ""
    return f"{counted(frf.freq.size, 'line')}{span}"


Quantity: TypeAlias = Literal["displacement", "velocity", "acceleration"]
#: in the order of their time derivatives, with what these add to the unit of a motion
QUANTITIES: tuple[Quantity, ...] = ("displacement", "velocity", "acceleration")
PER_TIME = ("", "/s", "/s^2")
ORDERS: dict[str, int] = {name: order for order, name in enumerate(QUANTITIES)}
#: ends of the DOF labels of rotations
ROTATIONS = (":rx", ":ry", ":rz")


@dataclass(frozen=True, eq=False, repr=False)
class Frf(Value, Mapping[tuple[str, str], ComplexArray]):
    """Frequency response functions between named channels, computed or measured.

    Parameters
    ----------
    freq : (n_freq,) array [Hz]
        Frequencies, increasing and not negative.
    data : (n_out, n_in, n_freq) complex array [output unit / input unit]
        Responses, by output, input and frequency.
    inputs, outputs : sequences of str, optional
        Names; `u1`..., `y1`... when not given.
    quantity : str, optional
        Quantity of a measurement: displacement, velocity or acceleration.
    coherence : (n_out, n_in, n_freq) array, optional
        Coherence of a measurement, between 0 and 1.
    variance : (n_out, n_in, n_freq) array, optional
        Variance of a measurement, E|error|^2 of each entry.
    freedom : float, optional
        Number nu of complex degrees of freedom of each variance. Give it when the variances were
        estimated from few runs: R runs have ``nu = R - 1``. The estimated variance is then
        uncertain, and the mean of |error|^2 / variance is ``nu / (nu - 1)`` instead of 1.
    correlation : (n_out, n_out, n_freq) complex array, optional
        Correlation of the errors of different outputs of a measurement under the same input (a
        disturbance reaches all of them), with ones on the diagonal.
    resolution : float [Hz], optional
        Resolution of a measurement: inverse of the length of the transformed segment or period.
    window : str or tuple, optional
        Window of the segments over which a measurement was averaged, as `scipy.signal.get_window`
        takes it; needs `resolution`. A window causes leakage between neighbouring frequency lines,
        so that their errors are correlated (`line_correlation`). None is for responses without
        leakage: those that were computed, or measured over whole periods.
    overlap : float
        Fraction of a segment that overlaps with the next one, from 0 to below 0.95.
    units : mapping {channel: unit}, optional
        SI units of the inputs and outputs that have a known one.

    Notes
    -----
    Responses can be added to and multiplied by numbers, systems, and other responses at the same
    frequencies. Errors of two responses are assumed independent. The variance of a sum is therefore
    the sum of the variances, and that of a product is ``|G2|^2 var G1 + |G1|^2 var G2`` to first
    order. A system adds no variance. Data of a single measurement (coherence, correlation of
    outputs, segments) are left out of sums and products.

    Raises
    ------
    ShapeError, ModelError, LabelError
        When sizes do not match, entries are not finite, freq does not increase, or names occur
        twice.

    Examples
    --------
    >>> frf = Frf([1.0, 2.0], [[[1.0, 0.5j]]], inputs=["f"], outputs=["x"])
    >>> frf
    <Frf: f -> x, 2 frequencies 1 .. 2 Hz>
    >>> complex(frf["x", "f"][1])
    0.5j
    """

    #: arrays leave `2.0 * frf` with a numpy number to this class
    __array_ufunc__ = None

    freq: FloatArray = field(metadata=checked(positive_array, shape=(None,), zero=True))
    data: ComplexArray = field(metadata=checked(complex_array, shape=(None, None, "freq")))
    inputs: Sequence[str] = ()
    outputs: Sequence[str] = ()
    quantity: str | None = None
    coherence: FloatArray | None = None
    variance: FloatArray | None = None
    correlation: ComplexArray | None = None
    resolution: float | None = field(default=None, metadata=checked(positive))
    window: str | tuple[Any, ...] | None = field(default=None, metadata=checked(checked_window))
    overlap: float = field(default=0.0, metadata=checked(checked_overlap))
    freedom: float | None = field(default=None, metadata=checked(positive))
    units: Mapping[str, str] = field(default_factory=dict)

    if TYPE_CHECKING:  # the input is any array-like object

        def __init__(
            self,
            freq: npt.ArrayLike,
            data: npt.ArrayLike,
            inputs: Sequence[str] = (),
            outputs: Sequence[str] = (),
            quantity: str | None = None,
            coherence: npt.ArrayLike | None = None,
            variance: npt.ArrayLike | None = None,
            correlation: npt.ArrayLike | None = None,
            resolution: float | None = None,
            window: str | tuple[Any, ...] | None = None,
            overlap: float = 0.0,
            freedom: float | None = None,
            units: Mapping[str, str] = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        super().__post_init__()
        sampled_freq(self.freq, 0.0)
        shape = self.data.shape
        coherence, variance = self.coherence, self.variance
        if coherence is not None:
            coherence = positive_array(coherence, "coherence", shape, zero=True)
            if coherence.max(initial=0.0) > 1 + SAME:
                raise ModelError("coherence must lie between 0 and 1.")
        if variance is not None:
            why = "It is E|error|^2."
            variance = positive_array(variance, "variance", shape, zero=True, hint=why)
        if self.correlation is not None:
            self._set(correlation=checked_correlation(self.correlation, shape))
        if self.window is not None and self.resolution is None:
            raise ModelError(
                f"window={self.window!r} needs the length of its segments: give resolution= too, "
                "the inverse of that length [Hz]."
            )
        inputs = signal_names(self.inputs, shape[1], "u", "inputs")
        outputs = signal_names(self.outputs, shape[0], "y", "outputs")
        units = self._rotations(inputs, outputs)
        units |= known_units(self.units, (*inputs, *outputs))
        self._set(
            inputs=inputs, outputs=outputs, units=units, coherence=coherence, variance=variance
        )

    def _rotations(self, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> dict[str, str]:
        """Return the units of measured rotations and moments, which DOF labels show."""
        if self.quantity not in ORDERS:
            return {}
        angle = "rad" + PER_TIME[ORDERS[self.quantity]]
        units = {name: "N m" for name in inputs if name.endswith(ROTATIONS)}
        return units | {name: angle for name in outputs if name.endswith(ROTATIONS)}

    def _completed_changes(self, changes: dict[str, Any]) -> dict[str, Any]:
        """Return the changes of `replace`, with the units of renamed channels."""
        # with other data the order of the channels may be another one, too
        if not {"units", "data"} & changes.keys():
            units: dict[str, str] = {}
            for side in ("inputs", "outputs"):
                before = getattr(self, side)
                after = changes.get(side, before)
                if isinstance(after, list | tuple):
                    pairs = zip(after, before, strict=False)
                    units |= {new: self.units[old] for new, old in pairs if old in self.units}
            return changes | {"units": units}
        return changes

    def __repr__(self) -> str:
        span = f"{self.freq[0]:.4g} .. {self.freq[-1]:.4g} Hz" if self.freq.size else ""
        units = {self.unit(*channel) for channel in self}
        unit = units.pop() if len(units) == 1 else None
        sides = _io_text(self) + (f" [{unit}]" if unit is not None else "")
        return f"<{type(self).__name__}: {sides}, {self.freq.size} frequencies {span}>"

    def __getitem__(self, key: tuple[str, str]) -> ComplexArray:
        """Return the response (n_freq,) of `frf["output", "input"]` or `frf[0, 1]`."""
        row, column = self._place(key)
        return np.asarray(self.data[row, column])

    def __iter__(self) -> Iterator[tuple[str, str]]:
        return ((output, name) for output in self.outputs for name in self.inputs)

    def __len__(self) -> int:
        return len(self.outputs) * len(self.inputs)

    @property
    def mag(self) -> FloatArray:
        """Magnitude (n_out, n_in, n_freq)."""
        return np.asarray(np.abs(self.data))

    @property
    def phase(self) -> FloatArray:
        """Phase (n_out, n_in, n_freq) [rad], between -pi and pi."""
        return np.asarray(np.angle(self.data))

    def __neg__(self) -> Any:
        """Return the responses negated."""
        return self * -1.0

    def __add__(self, other: Any) -> Any:
        """Return the sum of two responses between the same channels."""
        one, two = self, _operand(other, self)
        if (tuple(one.inputs), tuple(one.outputs)) != (tuple(two.inputs), tuple(two.outputs)):
            raise LabelError(
                f"a sum needs the same channels, got {_io_text(one)} and {_io_text(two)}. "
                "Select or rename them first."
            )
        variance = _optional_sum(one.variance, two.variance)
        quantity = one.quantity if two.quantity in (None, one.quantity) else None
        return _computed(self, one.data + two.data, variance, quantity=quantity)

    __radd__ = __add__

    def __rsub__(self, other: Any) -> Any:
        """Return a system minus these responses."""
        return -self + other

    def __sub__(self, other: Any) -> Any:
        """Return the difference of two responses between the same channels."""
        return self + (-other if isinstance(other, Frf) else -as_statespace(other))

    def __mul__(self, other: Any) -> Any:
        """Return ``G1 G2``, the second one's outputs driving this one's inputs; or a multiple."""
        if isinstance(other, _NUMBERS):
            return _multiple(self, complex(other))
        return _matrix_product(self, _operand(other, self))

    def __rmul__(self, other: Any) -> Any:
        """Return a multiple, or the product of a system before this one."""
        if isinstance(other, _NUMBERS):
            return _multiple(self, complex(other))
        return _matrix_product(_operand(other, self), self)

    def __truediv__(self, other: Any) -> Any:
        """Return the responses divided by a number, or by a response of one channel."""
        if isinstance(other, Frf):
            return self * _reciprocal(other)
        if not isinstance(other, _NUMBERS) or other == 0:
            raise ModelError(
                f"responses are divided by a number other than 0 or by a response of one input "
                f"and one output, got {short(other)}. Pass one of these."
            )
        return self * (1.0 / complex(other))

    def __rtruediv__(self, other: Any) -> Any:
        """Return a number divided by a response of one channel."""
        return _reciprocal(self) * other

    def select(
        self, outputs: Sequence[str] | str | None = None, inputs: Sequence[str] | str | None = None
    ) -> Frf:
        """Return the responses between some channels, in the order given."""
        chosen_out = name_list(self.outputs if outputs is None else outputs, "outputs")
        chosen_in = name_list(self.inputs if inputs is None else inputs, "inputs")
        rows = rows_of(self.outputs, chosen_out, "output", None)
        columns = rows_of(self.inputs, chosen_in, "input", None)
        picked = np.ix_(rows, columns)
        return self.replace(
            data=self.data[picked],
            inputs=chosen_in,
            outputs=chosen_out,
            coherence=None if self.coherence is None else self.coherence[picked],
            variance=None if self.variance is None else self.variance[picked],
            correlation=None if self.correlation is None else self.correlation[np.ix_(rows, rows)],
        )

    def line_correlation(self) -> sp.csr_array | None:
        r"""Return the correlation (n_freq, n_freq) of errors of different lines, or None.

        A line is the response at one frequency. Lines that are averaged over windowed segments
        share data with their neighbours. Under a Hann window the errors of neighbours have the
        correlation 4/9, and those of lines two apart 1/36. The mean over many lines then has 1 + 2
        (4/9 + 1/36) = 1.94 times the variance that it has for independent lines. The result is None
        if the lines are independent, which is the case for computed responses and for responses
        that were measured over whole periods.
        """
        if self.window is None or self.resolution is None:
            return None
        return line_correlation(
            self.freq, window=self.window, resolution=self.resolution, overlap=self.overlap
        )

    def converted(self, quantity: str) -> Frf:
        """Return the responses of another quantity: a time derivative is a factor 2 pi i f.

        Parameters
        ----------
        quantity : {"displacement", "velocity", "acceleration"}
            New quantity of the outputs.

        Raises
        ------
        ModelError
            When the present quantity is not known, or zero frequency would be integrated.
        """
        require_known("quantity", [quantity], ORDERS)
        if self.quantity not in ORDERS:
            raise ModelError(
                f"the quantity of this Frf is {self.quantity!r}: state what was measured, "
                "frf.replace(quantity='acceleration'), before it is converted."
            )
        order = ORDERS[quantity] - ORDERS[self.quantity]
        if order < 0 and self.freq.size and self.freq[0] == 0:
            raise ModelError("zero frequency cannot be integrated: leave it out of the Frf.")
        factor = (2j * np.pi * self.freq) ** order
        variance = None if self.variance is None else self.variance * np.abs(factor) ** 2
        units = {name: unit for name, unit in self.units.items() if name not in self.outputs}
        for name in set(self.outputs) & set(self.units):
            units[name] = self.units[name].partition("/")[0] + PER_TIME[ORDERS[quantity]]
        return self.replace(
            data=self.data * factor, quantity=quantity, variance=variance, units=units
        )

    def unit(self, output: str, input: str) -> str | None:
        """Return the unit of a response, such as "rad/N", "1" of a ratio; None when not known.

        It follows from the units of the channels. If these are not given, it follows from the
        `quantity` of the outputs, with inputs in N.
        """
        self._place((output, input))
        known = self.channel_units
        above, below = known.get(output), known.get(input)
        if above is None or below is None:
            return None
        if above == below:
            return "1"
        return f"{above}/({below})" if set(below) & set(" /") else f"{above}/{below}"

    @property
    def channel_units(self) -> dict[str, str]:
        """Units of the channels: those given, or those of the quantity per force in N."""
        if self.quantity not in ORDERS:
            return dict(self.units)
        per = "m" + PER_TIME[ORDERS[self.quantity]]
        return dict.fromkeys(self.inputs, "N") | dict.fromkeys(self.outputs, per) | dict(self.units)

    def to_control(self, dt: float = 0.0) -> Any:
        """Return a `control.FrequencyResponseData` of the same names and sampling time dt [s]."""
        import control

        return control.FrequencyResponseData(
            self.data,
            2 * np.pi * self.freq,
            positive(dt, "dt", zero=True),
            inputs=list(self.inputs),
            outputs=list(self.outputs),
        )

    @classmethod
    def from_control(cls, frd: Any) -> Frf:
        """Return a `control.FrequencyResponseData` as Frf, with its names."""
        if not all(hasattr(frd, part) for part in ("frdata", "omega", "input_labels")):
            raise ModelError(
                f"need a python-control FrequencyResponseData, got {type(frd).__name__}. Make "
                "one, control.frd(data, omega), or an Frf(freq, data)."
            )
        freq = np.asarray(frd.omega, dtype=np.float64) / (2 * np.pi)
        order = np.argsort(freq, kind="stable")
        return cls(
            freq[order],
            np.asarray(frd.frdata)[:, :, order],
            inputs=frd.input_labels,
            outputs=frd.output_labels,
        )

    def _place(self, key: tuple[str, str]) -> tuple[int, int]:
        rows, columns = chosen_pair(self.outputs, self.inputs, key)
        if len(rows) != 1 or len(columns) != 1:
            raise LabelError(
                f"frf[output, input] is one response, got {len(rows)} outputs and {len(columns)} "
                "inputs. Use frf.select(outputs, inputs) for several."
            )
        output = rows_of(self.outputs, rows, "output", None)
        return int(output[0]), int(rows_of(self.inputs, columns, "input", None)[0])


def frequency_response(sys: System, freq: npt.ArrayLike | None = None) -> Frf:
    """Return the frequency response ``C (s I - A)^-1 B + D``.

    Here s = 2 pi i f; for a sampled system it is exp(2 pi i f dt). If A is
    block triangular with 1 x 1 and 2 x 2 diagonal blocks, each block is solved in closed form. If A
    is even block diagonal, the cost of a frequency is proportional to the number of states.
    Otherwise the response is
    computed from the poles and residues, or from the Schur form of A if its eigenvectors are
    ill-conditioned.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled system, stable or not.
    freq : (n_freq,) array [Hz], optional
        Frequencies, increasing; by default a grid refined at resonances and antiresonances
        (`default_freq`).

    Returns
    -------
    Frf
        Response whose `data` has the shape (n_out, n_in, n_freq).

    Raises
    ------
    ModelError
        When a frequency is negative, lies above half the sampling rate, or on an undamped pole.

    Examples
    --------
    >>> import numpy as np
    >>> from flexplant.lti import StateSpace
    >>> g = StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
    >>> gain = abs(frequency_response(g, np.array([1 / (2 * np.pi)]))["y1", "u1"][0])
    >>> print(f"{gain:.6f}")
    0.707107
    """
    g = as_statespace(sys)
    if freq is None:
        freq = default_freq(g)
    freq = sampled_freq(freq, g.dt)
    work = g.C.size * g.B.shape[1] * freq.size * 10.0
    work += 20.0 * len(g.A) ** 3 if g.blocks is None else 0.0
    long = work > _LONG
    advice = "Fewer lines or states take less."
    with Progress(0, "frequency response", advice=advice) if long else nullcontext():
        expect(work)
        return _of_system(g, freq)


def _of_system(g: StateSpace, freq: FloatArray) -> Frf:
    """Return the response of a system at frequencies that are known to suit it."""
    # the checks of Frf hold already; its copy and checks would take twice the time of the response
    data = responses(g, freq)
    for array in (freq, data):
        array.flags.writeable = False
    fields = {"freq": freq, "data": data, "inputs": tuple(g.inputs), "outputs": tuple(g.outputs)}
    known = ("quantity", "coherence", "variance", "correlation", "resolution", "window", "freedom")
    return rebuild(Frf, fields | dict.fromkeys(known) | {"overlap": 0.0, "units": g.units})
