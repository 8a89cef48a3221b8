"""The LTI type: labelled, immutable, and with the block structure of A from modes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from ..arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    complex_array,
    divisor,
    known_units,
    mapping,
    positive,
    real_array,
    signal_names,
)
from ..errors import FlexplantError, ModelError, ShapeError, counted, short
from ..store import Value
from .blocks_of_states import (
    Channels,
    block_eigenvalues,
    checked_blocks,
    chosen_pair,
    in_parallel,
    in_series,
    rows_of,
    short_list,
)
from .foreign_systems import foreign_fields
from .zeros import invariant_zeros

if TYPE_CHECKING:
    import control
    from scipy import signal


#: types that functions of systems accept: StateSpace, or systems of python-control or SciPy
System: TypeAlias = "StateSpace | control.StateSpace | control.TransferFunction | signal.lti"


@dataclass(frozen=True, eq=False, repr=False)
class StateSpace(Value):
    """A linear time-invariant system with named channels.

    ``dx/dt = A x + B u, y = C x + D u`` (dt = 0), or ``x[k+1] = A x[k] + B u[k]`` with
    sampling time dt > 0.

    Parameters
    ----------
    A, B, C, D : (n, n), (n, m), (p, n), (p, m) arrays
        Real and finite matrices. D may be the number 0. A system with n = 0 is a static gain.
    dt : float [s]
        Sampling time; 0 for continuous time.
    inputs, outputs, states : sequences of str, optional
        Unique names; `u1`..., `y1`..., `x1`... when not given.
    name : str, optional
        Name of the system, for display.
    blocks : sequence of int, optional
        Sizes of the diagonal blocks of A, for an A that is block upper triangular. The modes of a
        structure give 2 x 2 blocks. If A is block diagonal, the cost of poles, frequency responses
        and discretisation grows only linearly with the number of states.
    units : mapping {channel: unit}, optional
        SI units of the inputs and outputs that have a known one, such as "m", "rad" or "N m".

    Raises
    ------
    ShapeError, ModelError, LabelError
        When sizes do not match, entries are not finite, names occur twice or `blocks` do not
        describe A.

    Examples
    --------
    >>> g = StateSpace([[0, 1], [-4, -0.1]], [[0], [1]], [[1, 0]], [[0]], inputs=["f"])
    >>> g
    <StateSpace: 2 states, continuous, f -> y1>
    >>> bool(g.is_stable)
    True
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    dt: float = 0.0
    inputs: Sequence[str] = ()
    outputs: Sequence[str] = ()
    states: Sequence[str] = ()
    name: str | None = None
    blocks: Sequence[int] | None = None
    units: Mapping[str, str] = field(default_factory=dict)

    #: arrays leave `2.0 * g` with a numpy number to this class
    __array_ufunc__ = None

    if TYPE_CHECKING:  # arrays come in as anything array-like, and are held as float64

        def __init__(
            self,
            A: npt.ArrayLike,
            B: npt.ArrayLike,
            C: npt.ArrayLike,
            D: npt.ArrayLike,
            dt: float = 0.0,
            inputs: Sequence[str] = (),
            outputs: Sequence[str] = (),
            states: Sequence[str] = (),
            name: str | None = None,
            blocks: Sequence[int] | None = None,
            units: Mapping[str, str] = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        D = direct_gain(self.D, self.B, self.C)
        p, m = D.shape
        A = real_array(self.A, "A", copy=False)
        A = A if A.size else np.zeros((0, 0))
        if A.ndim != 2 or A.shape[0] != A.shape[1]:
            A = real_array(real_array(A, "A", (None, None)), "A", (len(A), len(A)))
        n = A.shape[0]
        B = real_array(self.B, "B", (n, m), copy=False) if n else np.zeros((0, m))
        C = real_array(self.C, "C", (p, n), copy=False) if n else np.zeros((p, 0))
        inputs = signal_names(self.inputs, m, "u", "inputs")
        outputs = signal_names(self.outputs, p, "y", "outputs")
        self._set(
            A=A,
            B=B,
            C=C,
            D=D,
            dt=positive(self.dt, "dt", zero=True),
            inputs=inputs,
            outputs=outputs,
            units=known_units(self.units, (*inputs, *outputs)),
            states=signal_names(self.states, n, "x", "states"),
            blocks=None if self.blocks is None else checked_blocks(A, self.blocks),
        )

    def __repr__(self) -> str:
        kind = "continuous" if not self.dt else f"dt {self.dt:g} s"
        named = f" {self.name!r}" if self.name else ""
        sides = f"{short_list(self.inputs)} -> {short_list(self.outputs)}"
        return f"<StateSpace{named}: {counted(self.n_states, 'state')}, {kind}, {sides}>"

    @property
    def n_states(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @cached_property
    def _poles(self) -> ComplexArray:
        if self.blocks is None:
            return np.asarray(la.eigvals(self.A), dtype=np.complex128)
        return block_eigenvalues(self.A, self.blocks)

    def poles(self) -> ComplexArray:
        """Return the eigenvalues of A, block by block where its blocks are known [rad/s or 1]."""
        return self._poles.copy()

    @property
    def is_stable(self) -> bool:
        """Whether all poles lie strictly inside the stability region."""
        if not self.n_states:
            return True
        poles = self._poles
        return bool(np.max(np.abs(poles)) < 1 if self.dt else np.max(poles.real) < 0)

    def input_index(self, names: Iterable[str]) -> IntArray:
        """Return the columns of the named inputs."""
        return rows_of(self.inputs, names, "input", self.name)

    def output_index(self, names: Iterable[str]) -> IntArray:
        """Return the rows of the named outputs."""
        return rows_of(self.outputs, names, "output", self.name)

    def select(
        self, outputs: Iterable[str] | None = None, inputs: Iterable[str] | None = None
    ) -> StateSpace:
        """Return the system between some channels, in the order given; all states are kept."""
        rows = self.output_index(self.outputs if outputs is None else outputs)
        cols = self.input_index(self.inputs if inputs is None else inputs)
        if [*rows] == [*range(len(self.outputs))] and [*cols] == [*range(len(self.inputs))]:
            return self
        chosen = self.replace(
            B=self.B[:, cols],
            C=self.C[rows],
            D=self.D[np.ix_(rows, cols)],
            inputs=[self.inputs[i] for i in cols],
            outputs=[self.outputs[i] for i in rows],
        )
        if "_poles" in self.__dict__:  # the poles do not change
            chosen.__dict__["_poles"] = self._poles
        return chosen

    def __getitem__(self, key: tuple[Channels, Channels]) -> StateSpace:
        """Return the channel `sys["output", "input"]` or `sys[0, 1]`; lists and slices: several."""
        return self.select(*chosen_pair(self.outputs, self.inputs, key))

    def _direct(self, value: Any) -> FloatArray:
        """Return a number or a matrix that is added to D; of several channels it is a matrix."""
        found = real_array(value, "what is added to a system")
        if found.shape != self.D.shape and (found.ndim or self.D.shape != (1, 1)):
            raise ModelError(
                f"what is added to a system of shape {self.D.shape} is a system or a matrix of "
                f"that shape, got {short(value)}. For I + L add np.eye({self.D.shape[0]})."
            )
        return found

    def __neg__(self) -> StateSpace:
        """Return the system with its outputs negated."""
        return self.replace(C=-self.C, D=-self.D)

    def __add__(self, other: Any) -> StateSpace:
        """Return `parallel(self, other)`: same channels, outputs added; a number adds to D."""
        if isinstance(other, Mapping):  # an Frf, which combines line by line
            return NotImplemented
        if isinstance(other, int | float | np.number | np.ndarray):
            return self.replace(D=self.D + self._direct(other))
        return StateSpace(**in_parallel(self, as_statespace(other)))

    __radd__ = __add__

    def __rsub__(self, other: Any) -> StateSpace:
        """Return `-self + other`: ``1 - S``."""
        found: StateSpace = -self + other
        return found

    def __sub__(self, other: Any) -> StateSpace:
        """Return self + (-other): same channels, outputs subtracted."""
        if isinstance(other, Mapping):
            return NotImplemented
        numeric = isinstance(other, int | float | np.number | np.ndarray)
        return self + (-other if numeric else -as_statespace(other))

    def __mul__(self, other: Any) -> StateSpace:
        """Return `series(other, self)`, as transfer functions multiply; a number scales outputs."""
        if isinstance(other, int | float | np.number):
            factor = float(real_array(other, "the factor", ()))
            return self.replace(C=factor * self.C, D=factor * self.D)
        if isinstance(other, Mapping):
            return NotImplemented
        return StateSpace(**in_series(as_statespace(other), self))

    def __rmul__(self, other: float) -> StateSpace:
        """Return the system with its outputs times a number."""
        return self * other if isinstance(other, int | float | np.number) else NotImplemented

    def __rtruediv__(self, other: float) -> StateSpace:
        """Return a number times the inverse of the system: ``1 / (1 + L)``.

        From ``y = C x + D u``: ``u = D^-1 (y - C x)``.
        """
        D = self.D
        if D.shape[0] != D.shape[1] or np.linalg.matrix_rank(D) < D.shape[0]:
            raise ModelError(
                "the inverse of this system differentiates: its D is not invertible, as for all "
                "plants. For 1 / (1 + L) write the brackets; for S and T see lti.feedback."
            )
        inverse = np.linalg.inv(D)
        B, C = self.B @ inverse, -inverse @ self.C
        found = self.replace(
            A=self.A - B @ self.C,
            B=B,
            C=C,
            D=inverse,
            inputs=self.outputs,
            outputs=self.inputs,
            blocks=None,  # D couples them
        )
        return found * other

    def __truediv__(self, other: float) -> StateSpace:
        """Return the system with its outputs divided by a number."""
        number = float(real_array(other, "the divisor", ()))
        if not number:
            raise ModelError("a system is divided by a number other than 0: pass one.")
        return self * (1.0 / number)

    def renamed(
        self, inputs: dict[str, str] | None = None, outputs: dict[str, str] | None = None
    ) -> StateSpace:
        """Return the system with some channels renamed, as {old: new}."""
        hint = "Pass {old: new}."
        sides = ((inputs, "inputs"), (outputs, "outputs"))
        new_in, new_out = ({} if n is None else mapping(n, side, hint) for n, side in sides)
        self.input_index(new_in)
        self.output_index(new_out)
        new = {**new_in, **new_out}
        return self.replace(
            inputs=[new_in.get(name, name) for name in self.inputs],
            outputs=[new_out.get(name, name) for name in self.outputs],
            units={**self.units, **{new.get(n, n): unit for n, unit in self.units.items()}},
        )

    def transformed(self, T: npt.ArrayLike, *, states: Sequence[str] = ()) -> StateSpace:
        """Return the same system in other states, ``x = T x_new`` (a similarity).

        ``A_new = T^-1 A T, B_new = T^-1 B, C_new = C T``. Channels and D stay; blocks are not kept.

        Parameters
        ----------
        T : (n, n) array
            Matrix that is not singular. It is tested after its columns are scaled to equal length,
            because the units of the states do not matter.
        states : sequence of str, optional
            Names of the new states; `x1`... when not given.

        Raises
        ------
        ShapeError, ModelError, LabelError
            When T has another shape or is singular to working precision, or names do not fit.
        """
        n = self.n_states
        matrix = real_array(T, "T", (n, n))
        size = np.linalg.norm(matrix, axis=0)
        condition = float(np.linalg.cond(matrix / divisor(size))) if n else 1.0
        if not condition < 1e14:
            raise ModelError(
                f"T is singular (condition {condition:.1e}): its columns must be n independent "
                "directions of the state, else information is lost. Reduce the system instead."
            )
        new = np.linalg.solve(matrix, np.hstack([self.A @ matrix, self.B]))
        return self.replace(
            A=new[:, :n], B=new[:, n:], C=self.C @ matrix, states=tuple(states), blocks=None
        )

    def __call__(self, s: complex) -> complex | ComplexArray:
        """Return the gain at one complex frequency s (z when sampled).

        A number for one input and one output, else (p, m), as systems of python-control answer.
        """
        gain = self.evaluated(s)
        return complex(gain[0, 0]) if gain.shape == (1, 1) else gain

    def dcgain(self) -> float | FloatArray:
        """Return the static gain ``C (-A)^-1 B + D`` (at z = 1 when sampled).

        The result is a number for one input and one output, otherwise an array (p, m).

        Raises
        ------
        ModelError
            When a pole lies at zero frequency, such as that of a free mass or an integrator.
        """
        gain = self.evaluated(1.0 if self.dt else 0.0).real
        return float(gain[0, 0]) if gain.shape == (1, 1) else gain

    def zeros(self) -> ComplexArray:
        """Return the finite invariant zeros [rad/s, or z], where inputs have no effect on outputs.

        At such a frequency there is an input that, with suitable states, leaves all outputs at
        zero. The zeros include the poles of uncontrollable and unobservable states.
        """
        return invariant_zeros(self)

    def evaluated(self, s: complex) -> ComplexArray:
        """Return the gain ``C (s I - A)^-1 B + D`` (p, m) at one complex s (z when sampled)."""
        point = complex(complex_array(s, "s", ()))
        shifted = point * np.eye(self.n_states) - self.A
        try:
            gain = self.C @ np.linalg.solve(shifted, self.B) + self.D
        except np.linalg.LinAlgError as error:
            raise ModelError(
                f"the gain at {s:g} is infinite: a pole lies there, at zero frequency that of a "
                "free mass or an integrator. Evaluate at another frequency."
            ) from error
        return np.asarray(gain, dtype=np.complex128)

    def to_control(self) -> control.StateSpace:
        """Return the system as a `control.StateSpace` with the same names."""
        import control

        return control.StateSpace(
            self.A,
            self.B,
            self.C,
            self.D,
            self.dt,
            inputs=list(self.inputs),
            outputs=list(self.outputs),
            states=list(self.states),
            name=self.name,
            remove_useless_states=False,
        )

    @classmethod
    def from_control(cls, sys: Any) -> StateSpace:
        """Return a system of python-control or SciPy as a StateSpace with the same names.

        A transfer function becomes sections in series. In a matrix of transfer functions each
        channel has separate states; `minimal` removes those that channels have in common.
        """
        return cls(**foreign_fields(sys))


def as_statespace(sys: System | FloatArray) -> StateSpace:
    """Return `sys` as a StateSpace.

    Parameters
    ----------
    sys : StateSpace, system of python-control or SciPy, value with a `.system`, or (p, m) array
        An array is a static gain.

    Raises
    ------
    ModelError
        When it is neither a system nor a (p, m) array. Also when it is a StandardPlant, because it
        must be clear which of its parts is meant (from w or u to z or y).
    ShapeError
        When an array is empty.

    Examples
    --------
    >>> import flexplant as fx
    >>> from scipy.signal import StateSpace as ScipySystem
    >>> fx.lti.as_statespace(ScipySystem([[-1.0]], [[1.0]], [[1.0]], [[0.0]])).poles().real
    array([-1.])
    """
    if isinstance(sys, StateSpace):
        return sys
    if isinstance(sys, np.ndarray | list | tuple | float | int):
        gain = np.atleast_2d(real_array(sys, "a static gain"))
        if not gain.size and np.ndim(sys) < 2:
            raise ShapeError(
                f"a static gain has rows and columns (p, m), got {short(sys)}: nothing. Pass a "
                "matrix, [[1.0]], or a system."
            )
        return StateSpace(
            np.zeros((0, 0)), np.zeros((0, gain.shape[1])), np.zeros((gain.shape[0], 0)), gain
        )
    inner = getattr(sys, "system", None)  # a controller, an observer, a closed loop w -> z
    if isinstance(inner, StateSpace):
        if all(hasattr(sys, side) for side in "wuzy"):
            raise ModelError(
                "this is a StandardPlant, whose [w; u] -> [z; y] are four systems: choose "
                "plant.Gzw (or Gzu, Gyw, Gyu), or plant.system for all of it."
            )
        return inner
    return StateSpace.from_control(sys)


def single_channel(given: Any, name: str, error: type[FlexplantError] = ModelError) -> StateSpace:
    """Return a system of one input and one output."""
    g = as_statespace(given)
    if g.D.shape != (1, 1):
        raise error(
            f"{name} must have one input and one output, got {g!r}. Select a channel of it: "
            "sys['output', 'input']."
        )
    return g


def direct_gain(D: Any, B: Any, C: Any) -> FloatArray:
    """Return D (p, m) of a system with inputs B and outputs C; the number 0 stands for zeros."""
    if not isinstance(D, int | float):
        return real_array(D, "D", (None, None), copy=False)
    (m,) = real_array(B, "B", (None, None)).shape[1:]
    p = len(real_array(C, "C", (None, None)))
    if real_array(D, "D", ()) != 0:
        raise ShapeError(
            f"D is the gain from {m} inputs to {p} outputs, an array of shape ({p}, {m}); got the "
            f"number {D:g}. Pass that array, or 0 where no input acts on an output directly."
        )
    return np.zeros((p, m))
