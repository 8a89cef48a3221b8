"""fixed_point: a controller in integers, its loop closed again and its limit cycles found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from ...checks import FloatArray, Rng, Value, generator, instance, positive, whole, with_unit
from ...errors import CertificateError, FlexplantError, ModelError
from ...loop import ClosedLoop
from ...lti.statespace import StateSpace
from ...parallel import one_thread
from ...tolerances import TINY
from .c_code import controller_law
from .forms import TwoStateForm, two_state_form
from .order import LoopFacts, loop_facts, loss_text, reduce_controller, stable_before

Integers: TypeAlias = npt.NDArray[np.int64]

#: word lengths that are tried, in turn; products of two words and their sums fit 63 bits
_FEWEST, _MOST, _PRODUCT = 4, 32, 58
#: samples of a run that looks for limit cycles, within these: its first half lasts until a start
#: has decayed to a part of a word's step; what is left of it where that takes longer is no cycle
_SHORTEST, _LONGEST, _REST = 2_000, 40_000, 20.0
#: starts of these runs, and the part of the word in which states start
_STARTS, _PART = 3, 0.25


#: a limit cycle of this part of what the run has is no rest
_NO_REST = 0.1


@dataclass(frozen=True, eq=False)
class LimitCycle(Value):
    """What a loop in integers goes on doing without any input.

    Parameters
    ----------
    channel : str
        A channel of y, or a command.
    freq : float [Hz]
        Of its largest line; 0 where it stands still beside zero.
    amplitude : float
        Largest distance from zero, in the channel's unit.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.LimitCycle("y1", freq=33.0, amplitude=2e-9)
    LimitCycle(channel='y1', freq=33.0, amplitude=2e-09)
    """

    channel: str
    freq: float
    amplitude: float


@dataclass(frozen=True, eq=False, repr=False)
class FixedPointController(Value):
    """A controller with coefficients and states in words of stated length.

    Made by `fixed_point`.

    Parameters
    ----------
    system : StateSpace
        The controller that the rounded coefficients make, from y to u.
    bits, state_bits : int
        Of a coefficient, and of a state, an input and an output, signs included.
    sections : int
        Blocks of two states.
    ranges : mapping {channel: float}
        What the words of inputs and outputs hold at most.
    certificate : mapping
        Stability and modulus margin with rounded coefficients and before.
    limit_cycles : sequence of LimitCycle
        The largest of each channel over some starts; empty where all come to rest at zero.
    tried : mapping {"6 sections, 8 bits": str}
        What else was tried, and what the loop lost with it.
    """

    system: StateSpace
    bits: int
    state_bits: int
    sections: int
    ranges: Mapping[str, float]
    certificate: Mapping[str, float]
    limit_cycles: tuple[LimitCycle, ...]
    tried: Mapping[str, str]

    def __repr__(self) -> str:
        margins = [self.certificate[name] for name in ("modulus margin", "modulus margin before")]
        head = f"<FixedPointController: {self.sections} sections, coefficients of {self.bits} bits"
        lines = [
            f"{head}, states of {self.state_bits}",
            f"  modulus margin {margins[0]:.3g}, before {margins[1]:.3g}",
        ]
        for one in self.limit_cycles[:4]:
            size = with_unit(one.amplitude, self.system.units.get(one.channel))
            lines.append(f"  limit cycle of {one.channel}: {size} at {one.freq:.3g} Hz")
        if not self.limit_cycles:
            lines.append("  no limit cycle found")
        return "\n".join(lines) + ">"


@one_thread()
def fixed_point(
    loop: ClosedLoop,
    run: Any,
    *,
    bits: int | None = None,
    state_bits: int = 32,
    sections: int | Sequence[int] | None = None,
    headroom: float = 4.0,
    loss: float = 0.1,
    rng: Rng = 0,
) -> FixedPointController:
    """Return a loop's controller in fixed-point arithmetic, judged in its loop.

    Blocks of two states as in `write_c`: each row of A - I, B, C and D is rounded to integers of
    `bits` with one power of two; states, inputs and outputs are integers of `state_bits`, scaled by
    a run. The loop is closed with the rounded coefficients, and run in integers without inputs from
    some states: what does not come to rest is named.

    Parameters
    ----------
    loop : ClosedLoop
        Around a sampled plant. Words are judged on its evaluation model where it has one.
    run : Response
        A run of the loop that is as large as it gets: it gives the sizes of all signals.
    bits : int, optional
        Word length of coefficients; the fewest that keep the loop when not given.
    state_bits : int
        Word length of states, inputs and outputs.
    sections : int or sequence of int, optional
        Blocks of two states to which the controller is reduced; of several numbers the one with
        the fewest bits in all (sections times bits). As many as it has when not given.
    headroom : float
        What words hold beyond the run's largest values, as a factor.
    loss : float
        Relative loss of the modulus margin that is allowed.
    rng : int, SeedSequence or Generator
        Draws the states from which limit cycles are sought.

    Returns
    -------
    FixedPointController

    Raises
    ------
    CertificateError
        When no number of sections and bits keeps the loop, with what each lost; or when it does not
        come to rest: a limit cycle of a tenth of what the run has.
    ModelError
        When the words are too long to be multiplied in 64 bits, or the run is of another loop.

    References
    ----------
    [AstromWittenmark1997]_, section 9.7.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo)
    >>> run = fx.simulate(loop, reference=1e-3, duration=0.5, rng=1)
    >>> found = fx.synthesis.fixed_point(loop, run, bits=12)
    >>> found.sections, fx.close_loop(plant, found.system).is_stable
    (6, True)
    """
    closed = instance(loop, ClosedLoop, "loop", "Pass close_loop(plant, *blocks).")
    K = controller_law(closed).select(outputs=closed.driven)
    wide = whole(state_bits, "state_bits", minimum=8)
    longest = min(_MOST, _PRODUCT - wide)
    given = None if bits is None else whole(bits, "bits", minimum=2)
    if longest < _FEWEST or (given or 0) > longest:
        raise ModelError(
            f"products of {given or _FEWEST} and {wide} bits, and their sums, do not fit 64: take "
            f"fewer; together at most {_PRODUCT}."
        )
    judge = closed.plant.evaluation_plant or closed.plant
    before = stable_before(judge, K)
    inputs = np.array([_run_channel(run, name) for name in K.inputs])
    room, allowed = positive(headroom, "headroom"), positive(loss, "loss", zero=True)
    counts = [None] if sections is None else np.atleast_1d(np.asarray(sections)).tolist()
    tried: dict[str, str] = {}
    best: tuple[int, int, _WordForm, StateSpace, LoopFacts] | None = None
    for count in counts:
        try:
            own = K
            if count is not None and 2 * whole(count, "sections") < K.n_states:
                own = reduce_controller(closed.plant, K, order=2 * count, loss=allowed).system
        except FlexplantError as error:
            tried[f"{count} sections"] = str(error)
            continue
        form = two_state_form(own)
        powers = _replayed_powers(form, inputs, room)
        number = -(-own.n_states // 2)
        for length in range(_FEWEST, longest + 1) if given is None else (given,):
            if best is not None and number * length >= best[0]:
                break
            words = _WordForm.of(form, powers, length, wide)
            system = words.system(own)
            facts = loop_facts(judge, system)
            lost = loss_text(before, facts, allowed)
            if not lost:
                best = number * length, length, words, system, facts
                break
            tried[f"{number} sections, {length} bits"] = lost
    if best is None:
        named = "; ".join(f"{name}: {lost}" for name, lost in list(tried.items())[-4:])
        raise CertificateError(
            f"no word length keeps the loop ({named}). Allow more bits, more sections or a larger "
            "loss."
        )
    _, length, words, system, facts = best
    cycles, left = _limit_cycles(closed, system, words, generator(rng))
    was = {f"{name} before": value for name, value in before.certificate.items()}
    held = np.exp2([*words.D.of, *words.D.to]).tolist()
    ranges = dict(zip((*system.inputs, *system.outputs), held, strict=True))
    large = [one for one in cycles if room * one.amplitude > _NO_REST * ranges[one.channel]]
    if large:
        named = ", ".join(f"{one.channel} {one.amplitude:.3g} (SI)" for one in large)
        raise CertificateError(
            f"with words of {wide} bits the loop does not come to rest: limit cycles of {named} "
            f"are more than {_NO_REST:g} of what the run has. Allow more state_bits, or a smaller "
            "headroom."
        )
    return FixedPointController(
        system,
        length,
        wide,
        -(-system.n_states // 2),
        ranges,
        facts.certificate | was | {"cycles sought above, of a word": left},
        cycles,
        tried,
    )


def _run_channel(run: Any, name: str) -> FloatArray:
    try:
        values = np.asarray(run[name], dtype=np.float64)
    except (TypeError, KeyError, FlexplantError) as error:
        raise ModelError(
            f"run has no channel {name!r}, which the controller reads: pass simulate(loop, ...)."
        ) from error
    return np.asarray(values.reshape(-1, values.shape[-1])[0])


def _replayed_powers(form: TwoStateForm, inputs: FloatArray, headroom: float) -> list[Integers]:
    """Return the powers of two of inputs, states and outputs above a run, replayed."""
    # a signal that is zero counts as 1
    A = form.change
    x, most = np.zeros(len(A)), np.zeros(len(A))
    largest = np.zeros(len(form.C))
    for value in inputs.T:
        largest = np.maximum(largest, np.abs(form.C @ x + form.D @ value))
        x = x + A @ x + form.B @ value
        most = np.maximum(most, np.abs(x))
    sizes = (headroom * one for one in (np.abs(inputs).max(axis=1, initial=0.0), most, largest))
    return [np.ceil(np.log2(np.where(one > 0, one, 1.0))).astype(np.int64) for one in sizes]


class _Rounded(NamedTuple):
    """A matrix of integers whose rows are shifted by bits, between powers of two of signals."""

    entries: Integers
    shift: Integers
    to: Integers
    of: Integers

    @classmethod
    def made(cls, matrix: FloatArray, to: Integers, of: Integers, bits: int) -> _Rounded:
        """Return a matrix, each row with as many digits as its largest entry leaves."""
        # y 2^-to = M 2^(of - to) (x 2^-of)
        relative = matrix * np.exp2((of - to[:, None]).astype(np.float64))
        largest = np.abs(relative).max(axis=1, initial=0.0)
        most = 2 ** (bits - 1) - 1
        shift = np.floor(np.log2(most / np.where(largest > 0, largest, most))).astype(np.int64)
        shift = np.minimum(shift, _PRODUCT)
        entries = np.rint(relative * np.exp2(shift[:, None].astype(float))).astype(np.int64)
        return cls(entries, shift, to, of)

    @property
    def value(self) -> FloatArray:
        """The matrix that the integers stand for."""
        power = self.to[:, None] - self.of - self.shift[:, None]
        return np.asarray(self.entries * np.exp2(power.astype(np.float64)))

    def times(self, x: Integers) -> Integers:
        """Return products with words (n, runs), rounded to nearest."""
        right = np.maximum(self.shift, 0)[:, None]
        half = np.where(right > 0, np.left_shift(1, np.maximum(right - 1, 0)), 0)
        left = np.maximum(-self.shift, 0)[:, None]
        return np.asarray(np.left_shift(np.right_shift(self.entries @ x + half, right), left))


class _WordForm(NamedTuple):
    """``x+ = x + A x + B in, out = C x + D in`` in integers of so many bits."""

    A: _Rounded
    B: _Rounded
    C: _Rounded
    D: _Rounded
    wide: int

    @classmethod
    def of(cls, form: TwoStateForm, powers: list[Integers], bits: int, wide: int) -> _WordForm:
        """Return the integers of a form, the powers of inputs, states and outputs known."""
        into, x, out = powers
        return cls(
            _Rounded.made(form.change, x, x, bits),
            _Rounded.made(form.B, x, into, bits),
            _Rounded.made(form.C, out, x, bits),
            _Rounded.made(form.D, out, into, bits),
            wide,
        )

    def system(self, like: StateSpace) -> StateSpace:
        """Return what the coefficients make, without states that only fill up."""
        A, B, C, D = (one.value for one in (self.A, self.B, self.C, self.D))
        used = np.any(B != 0, axis=1) | np.any(A != 0, axis=1) | np.any(C != 0, axis=0)
        full = (A + np.eye(len(A)))[np.ix_(used, used)]
        return like.replace(A=full, B=B[used], C=C[:, used], D=D, states=None, blocks=None)

    def outputs(self, x: Integers, into: Integers) -> Integers:
        """Return the outputs (p, runs) of a sample."""
        return self._held(self.C.times(x) + self.D.times(into))

    def following(self, x: Integers, into: Integers) -> Integers:
        """Return the states (n, runs) of the next sample."""
        return self._held(x + self.A.times(x) + self.B.times(into))

    def read(self, values: FloatArray) -> Integers:
        """Return inputs in words."""
        steps = values * np.exp2(self.wide - 1.0 - self.D.of)[:, None]
        return self._held(np.rint(np.clip(steps, -(2.0**62), 2.0**62)).astype(np.int64))

    def written(self, out: Integers) -> FloatArray:
        """Return outputs in their units."""
        return np.asarray(out * np.exp2(self.D.to - (self.wide - 1.0))[:, None])

    def _held(self, values: Integers) -> Integers:
        most = 2 ** (self.wide - 1) - 1
        return np.clip(values, -most, most)


def _limit_cycles(
    loop: ClosedLoop, K: StateSpace, words: _WordForm, rng: np.random.Generator
) -> tuple[tuple[LimitCycle, ...], float]:
    """Return what remains of the loop in integers left alone, and the part of a word seen."""
    plant = loop.plant
    g, driven = plant.system, list(K.outputs)
    B, C = g.B[:, g.input_index(driven)], g.C[g.output_index(list(K.inputs))]
    radius = loop.spectral_radius
    decays = np.log(_REST * 2.0**words.wide)
    samples = int(np.clip(2.0 * decays / max(-np.log(radius), TINY), _SHORTEST, _LONGEST))
    names = (*K.inputs, *driven)
    powers = [*words.D.of.tolist(), *words.D.to.tolist()]
    x = np.zeros((g.n_states, _STARTS))
    most = _PART * 2.0 ** (words.wide - 1)
    state = np.rint(most * rng.uniform(-1.0, 1.0, (len(words.A.to), _STARTS))).astype(np.int64)
    first = samples - samples // 2
    last = np.zeros((samples // 2, len(names), _STARTS))
    for k in range(samples):
        y = C @ x
        into = words.read(y)
        out = words.outputs(state, into)
        state = words.following(state, into)
        u = words.written(out)
        x = g.A @ x + B @ u
        if k >= first:
            last[k - first] = np.vstack([y, u])
    with np.errstate(under="ignore"):
        decayed = float(10.0 * radius**first)
    left = max(decayed, 2.0**-words.wide)  # half a step
    found = []
    for i, name in enumerate(names):
        run = last[:, i, np.argmax(np.abs(last[:, i]).max(axis=0))]
        amplitude = float(np.abs(run).max())
        if amplitude > left * 2.0 ** powers[i]:
            found.append(LimitCycle(name, _line(run, K.dt), amplitude))
    return tuple(found), left


def _line(values: FloatArray, dt: float) -> float:
    """Return the frequency [Hz] of the largest line; 0 of a standstill."""
    power = np.abs(np.fft.rfft(values))
    power[1:] *= 2.0
    return float(np.argmax(power) / (values.size * dt))
