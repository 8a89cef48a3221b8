"""Forms of a controller: blocks of two states, second-order sections, conditioned on u."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import zip_longest
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la
from scipy.sparse import csgraph

from ...arrays import ComplexArray, FloatArray, divisor, positive
from ...errors import AssumptionError, CertificateError, ModelError
from ...loop.anti_windup import recovery_gain
from ...lti.equations import state_scale
from ...lti.frequency import frequency_response
from ...lti.frequency_sweep import resonance_grid
from ...lti.minimal_realisations import minimal
from ...lti.modal import eigenvalues_with_error, modal_form
from ...lti.statespace import StateSpace, as_statespace
from ...tolerances import (
    CLOSE,
    FOUR_DIGITS,
    PRECISION,
    RANK,
    RESIDUAL,
    ROOT,
    ROUNDING,
    SPLIT,
    TYPED,
)

#: blocks that are computed at a time: four doubles are one AVX register, four floats one of SSE
LANES = 4
#: relative distances of poles [1] within which they share a block, tried in turn
_NEAR = SPLIT, FOUR_DIGITS, CLOSE
#: what the blocks may differ from the system, relative to the largest gain: in double precision
#: (rounding times the condition), and in single, whose 24 bits a resonance of 1e-4 still stands
_DOUBLE, _SINGLE = ROOT, CLOSE


class TwoStateForm(NamedTuple):
    """``x+ = x + (A - I) x + B in, out = C x + D in``, A of blocks with two states and a rest.

    The difference ``A - I`` is stored: of a pole near z = 1 its digits are those of the pole's
    frequency. The first halves of the blocks come first, then the second halves, each filled up to
    whole lanes, then the states `rest` of larger blocks.
    """

    pairs: FloatArray  # (2, 2, N): entry i, j of each block of A - I
    rest: FloatArray  # (R, R): of A - I; (places, R, R) where A follows a place
    B: FloatArray  # (2 N + R, m); (places, R, m)
    C: FloatArray  # (p, 2 N + R); p of each place below each other
    D: FloatArray
    start: FloatArray  # (groups, 2 N + R, m + driven): steady states with given commands
    error: float  # of the response, relative to its largest gain

    @property
    def lanes(self) -> int:
        """Blocks, those that fill up included."""
        return int(self.pairs.shape[2])

    @property
    def change(self) -> FloatArray:
        """``A - I`` of all states."""
        (aa, ab), (ba, bb) = (tuple(np.diag(entry) for entry in row) for row in self.pairs)
        return np.asarray(la.block_diag(np.block([[aa, ab], [ba, bb]]), self.rest))

    def response(self, freq: FloatArray, dt: float) -> ComplexArray:
        """Return the response (p, m, n_freq), block by block."""
        N, change = self.lanes, np.expm1(2j * np.pi * freq * dt)  # z - 1
        (aa, ab), (ba, bb) = self.pairs[..., None]
        first, second, rest = np.split(self.B, [N, 2 * N])
        found = np.empty((*self.D.shape, freq.size), dtype=np.complex128)
        for k, move in enumerate(change):
            a, b = move - aa, move - bb
            det = a * b - ab * ba
            x = [(b * first + ab * second) / det, (ba * first + a * second) / det]
            x.append(np.linalg.solve(move * np.eye(len(rest)) - self.rest, rest))
            found[:, :, k] = self.C @ np.vstack(x) + self.D
        return found


def two_state_form(
    K: StateSpace, *, driven: Sequence[slice] = (), inputs: int | None = None, single: bool = False
) -> TwoStateForm:
    """Return a sampled system in blocks of two states, its response compared with the system's."""
    # for each group of outputs that are `driven` a start is computed that gives their commands at
    # the values of the first `inputs`
    most, error = (_SINGLE if single else _DOUBLE), np.inf
    for form, sizes in _block_forms(K):
        found = _compared(K, _arranged(form, sizes, driven, inputs), single, most)
        if found.error <= most:
            return found
        error = min(error, found.error)
    # slow poles of laws that act on one another do not stand the rounding of any change of states
    found = _as_given(K, state_scale(K.A, K.B, K.C), driven, inputs, single)
    if found.error <= most:
        return found
    error = min(error, found.error)
    cure = (
        "Write it in double precision, or lower the rate."
        if single
        else "Reduce the controller first (reduce_controller)."
    )
    raise CertificateError(
        f"the blocks of two states differ from the system by {error:.1e} of its largest gain: "
        f"rounding of {K.n_states} states is too much. {cure}"
    )


def scheduled_form(
    laws: Sequence[StateSpace], *, driven: int, single: bool = False
) -> TwoStateForm:
    """Return systems that differ in A too, one for each place, as full matrices."""
    # between places their entries are linear: no coordinates but the systems' own keep them so, up
    # to a scale for each state
    sizes = [state_scale(K.A, K.B, K.C) for K in laws]
    d = np.exp(np.mean(np.log(sizes), axis=0))
    most = _SINGLE if single else _DOUBLE
    found = [_as_given(K, d, [slice(driven)], None, single) for K in laws]
    error = max(one.error for one in found)
    if error > most:
        cure = (
            "Write it in double precision, or reduce the controllers."
            if single
            else "Its entries were not copied as they are."
        )
        raise CertificateError(
            f"what is written differs from the controller of a place by {error:.1e} of its largest "
            f"gain, more than {most:g}. {cure}"
        )
    rest, B, start = (np.array([getattr(one, part) for one in found])
                      for part in ("rest", "B", "start"))  # fmt: skip
    C, D = (np.vstack([getattr(one, part) for one in found]) for part in "CD")
    return TwoStateForm(found[0].pairs, rest, B, C, D, start[:, 0], error)


def _as_given(
    K: StateSpace, d: FloatArray, driven: Sequence[slice], inputs: int | None, single: bool
) -> TwoStateForm:
    """Return a system as full matrices in its own states, each in units of a scale (n,)."""
    d = np.asarray(np.exp2(np.round(np.log2(d))), dtype=np.float64)  # so that no digit changes
    K = K.replace(A=K.A * d / d[:, None], B=K.B / d[:, None], C=K.C * d, blocks=None)
    own = _arranged(K, [K.n_states], driven, inputs, paired=0)
    own = _in_single(own) if single else own
    away = partial(_entries_response, K, own)
    return own._replace(error=_difference(K, away, _SINGLE if single else _DOUBLE))


def _block_forms(K: StateSpace) -> Iterator[tuple[StateSpace, list[int]]]:
    """Yield the system with A block diagonal and the sizes of its blocks, the smallest first."""
    try:
        modal = modal_form(K)
    except np.linalg.LinAlgError:  # LAPACK cannot reorder poles that are equal to rounding
        modal = None
    if modal is not None and not modal.reason:
        yield modal.system, list(modal.system.blocks or [1] * K.n_states)
    if not K.n_states:
        return
    d = state_scale(K.A, K.B, K.C)
    A = K.A * d / d[:, None]
    T, Z = la.schur(A)
    real, imag = la.lapack.dtrsen(np.zeros(len(T)), T, Z, job="N")[2:4]
    folded = real + 1j * np.abs(imag)  # in the order of T; conjugates stay together
    for near in _NEAR:
        close = np.abs(folded[:, None] - folded) <= near
        owner = csgraph.connected_components(close, directed=False)[1]
        sizes = np.bincount(owner).tolist()
        bases = [
            la.lapack.dtrsen(owner == k, T, Z, job="N")[1][:, :size] for k, size in enumerate(sizes)
        ]
        V = np.hstack(bases)
        if np.linalg.cond(V) > _DOUBLE / PRECISION:  # which multiplies rounding errors
            continue
        kept = la.block_diag(*(np.ones((size, size)) for size in sizes)) > 0
        new = np.where(kept, np.linalg.solve(V, A @ V), 0.0)
        B, C = np.linalg.solve(V, K.B / d[:, None]), (K.C * d) @ V
        yield K.replace(A=new, B=B, C=C, blocks=None), sizes


def _arranged(
    K: StateSpace, sizes: list[int], driven: Sequence[slice], inputs: int | None, paired: int = 2
) -> TwoStateForm:
    """Return a block-diagonal system with its blocks side by side, those of few states paired."""
    ends, n = np.cumsum(sizes, dtype=int).tolist(), K.n_states
    blocks = [range(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    many = [k for block in blocks if len(block) > paired for k in block]
    blocks = [block for block in blocks if len(block) <= paired]
    ones = [k for block in blocks if len(block) == 1 for k in block]
    pairs = [(block[0], block[1]) for block in blocks if len(block) == 2]
    pairs += zip_longest(ones[::2], ones[1::2], fillvalue=n)  # n: a state that does not exist
    pairs += [(n, n)] * (-len(pairs) % LANES)
    many += [n] * (-len(many) % LANES)
    order = np.array([i for i, _ in pairs] + [j for _, j in pairs] + many, dtype=int)

    def rows(matrix: FloatArray) -> FloatArray:
        return np.asarray(np.pad(matrix, ((0, 1), (0, 0)))[order])

    N, full = len(pairs), rows(rows(K.A - np.eye(n)).T).T
    entries = [[np.diag(full[i : i + N, j : j + N]) for j in (0, N)] for i in (0, N)]
    held = K.replace(B=K.B[:, :inputs], D=K.D[:, :inputs], inputs=K.inputs[:inputs], units={})
    start = [rows(_at_rest(held, group)) for group in driven if n]
    rest, C = full[2 * N :, 2 * N :], rows(K.C.T).T
    return TwoStateForm(np.array(entries), rest, rows(K.B), C, K.D, np.array(start), 0.0)


def _compared(K: StateSpace, form: TwoStateForm, single: bool, most: float) -> TwoStateForm:
    """Return a form, in single precision if asked, with what its response differs by."""
    form = _in_single(form) if single else form

    def away(freq: FloatArray) -> ComplexArray:
        return form.response(freq, K.dt) - frequency_response(K, freq).data

    return form._replace(error=_difference(K, away, most))


def _in_single(form: TwoStateForm) -> TwoStateForm:
    """Return a form with its numbers rounded to single precision."""
    parts = form._asdict().items()
    less = {name: np.asarray(part, np.float32).astype(np.float64) for name, part in parts}
    return form._replace(**less)  # type: ignore[arg-type]


def _entries_response(K: StateSpace, form: TwoStateForm, freq: FloatArray) -> ComplexArray:
    """Return the response of a form in the states of K less that of K, from their entries.

    ``dG = dD + dC x + C (zI - A)^-1 (dB + dA x)`` with ``x = (zI - A')^-1 B'``, where d is what the
    form A', B', C', D' differs by. A difference of two responses would be their own rounding, in
    proportion to the condition of A.
    """
    states = [(0, form.change.shape[0] - K.n_states)]  # those that fill up whole lanes
    A = np.pad(K.A - np.eye(K.n_states), states * 2)
    B, C = np.pad(K.B, [*states, (0, 0)]), np.pad(K.C, [(0, 0), *states])
    dA, dB, dC, dD = form.change - A, form.B - B, form.C - C, form.D - K.D
    found = np.empty((*K.D.shape, freq.size), dtype=np.complex128)
    for k, move in enumerate(np.expm1(2j * np.pi * freq * K.dt)):  # z - 1
        z = move * np.eye(len(A))
        x = np.linalg.solve(z - form.change, form.B)
        found[:, :, k] = dD + dC @ x + C @ np.linalg.solve(z - A, dB + dA @ x)
    return found


def _at_rest(K: StateSpace, driven: slice) -> FloatArray:
    """Return the states (n, m + driven) that give the wanted commands and move least."""
    # of all x with `C x = out - D in` (in least squares, where states cannot give them) that with
    # the smallest `(A - I) x + B in`, of these the smallest x
    C, D = K.C[driven], K.D[driven]
    first = np.linalg.pinv(C, rcond=RANK) @ np.hstack([-D, np.eye(len(C))])
    free, move = la.null_space(C, rcond=RANK), K.A - np.eye(K.n_states)
    drift = np.hstack([K.B, np.zeros((K.n_states, len(C)))]) + move @ first
    more, *_ = np.linalg.lstsq(move @ free, -drift, rcond=ROUNDING)
    return np.asarray(first + free @ more)


def _difference(K: StateSpace, away: Callable[[FloatArray], ComplexArray], most: float) -> float:
    """Return how large a difference from the response is, relative to the channel's largest gain.

    A channel far below the others of its output and input counts as part of them: it is rounding.
    What is below the rounding of those others is at most the allowed difference `most`.
    """
    if not K.n_states:
        return 0.0
    poles, _, moved = eigenvalues_with_error(K.A)
    grid = resonance_grid(poles, K.dt, points=60)
    # nearer to poles than this the response is one of rounding: of a double pole at z = 1 in a
    # full A, say, which comes out as two, 1e-8 apart. The square of the relative error, for a
    # double pole, is below the required accuracy
    apart = np.abs(np.exp(2j * np.pi * grid * K.dt)[:, None] - poles)
    grid = grid[np.all(moved < np.sqrt(RESIDUAL) * apart, axis=1)]
    size = np.abs(frequency_response(K, grid).data).max(axis=2, initial=0.0)
    small = max(_DOUBLE, ROUNDING / most)
    least = small * np.sqrt(np.outer(size.max(axis=1), size.max(axis=0)))
    gap = np.abs(away(grid)).max(axis=2, initial=0.0)
    return float(np.max(gap / divisor(np.maximum(size, least)), initial=0.0))


def second_order_sections(controller: Any) -> Mapping[tuple[str, str], FloatArray]:
    """Return each channel of a sampled controller as second-order sections.

    ::

        K_ij(z) = prod_k (b0 + b1 z^-1 + b2 z^-2) / (1 + a1 z^-1 + a2 z^-2)

    A section is a filter of second order, and the sections of a channel are connected in series.
    States that do not act in a channel are removed before its poles and zeros are computed. The
    response of the product is then compared with that of the channel on a frequency grid that
    includes its resonances.

    Parameters
    ----------
    controller : StateSpace or Controller
        Sampled controller.

    Returns
    -------
    mapping {(output, input): (k, 6) array}
        Rows [b0, b1, b2, 1, a1, a2], in the format of `scipy.signal.sosfilt`. The first row
        contains the gain of the channel.

    Raises
    ------
    CertificateError
        When the sections differ from the channel by more than 1e-6 of its largest gain. This
        happens, for example, if a pole is very slow compared with the sampling rate: rounding of
        the coefficients then moves it.
    ModelError
        When the controller is continuous.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> list(fx.synthesis.second_order_sections(servo))
    [('u1', 'die:ref'), ('u1', 'die:hat')]
    """
    K = as_statespace(controller)
    if not K.dt and K.n_states:
        raise ModelError(
            "sections are of a sampled controller: synthesis.discretise_controller(plant, "
            "controller) first."
        )
    return {(output, name): _sections(K[output, name]) for output in K.outputs for name in K.inputs}


def _sections(g: StateSpace) -> FloatArray:
    """Return the sections of one channel."""
    from scipy.signal import zpk2sos

    small = minimal(g) if g.n_states else g
    poles: Any = small.poles()
    zeros: Any = small.zeros()
    grid = resonance_grid(poles, g.dt or 1.0, points=100)
    wanted = frequency_response(g.replace(dt=g.dt or 1.0), grid).data[0, 0]
    size = float(np.abs(wanted).max(initial=0.0))
    if not size:
        return np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    back = np.expm1(-2j * np.pi * grid * (g.dt or 1.0))  # 1/z - 1
    shape = _root_product(poles, zeros, back)
    at = int(np.argmax(np.abs(wanted)))
    gain = float((wanted[at] / shape[at]).real)
    # with a zero at z = 0 for each missing zero: early by their number in samples
    sections = np.asarray(zpk2sos(zeros, poles, gain, pairing="nearest"), dtype=np.float64)
    late = len(poles) - len(zeros)
    for row in sections:
        while late and not row[2]:
            row[:3], late = [0.0, *row[:2]], late - 1
    off = float(np.abs(_sections_response(sections, back) - wanted).max()) / size
    if not off <= TYPED:
        exact = float(np.abs(gain * shape - wanted).max()) / size
        raise CertificateError(
            f"the sections of {g.outputs[0]!r} from {g.inputs[0]!r} differ from it by {off:.1e} of "
            f"its largest gain: {_cause(exact, poles, g.dt)}, or export its states (write_c)."
        )
    return sections


def _root_product(poles: ComplexArray, zeros: ComplexArray, back: ComplexArray) -> ComplexArray:
    """Return ``prod (z - zeros) / prod (z - poles)`` at 1/z - 1 = back."""
    z = 1.0 / (1.0 + back)
    rise = -back * z  # z - 1
    above, below = (np.prod(rise + (1.0 - roots[:, None]), axis=0) for roots in (zeros, poles))
    return np.asarray(above / below)


def _sections_response(sections: FloatArray, back: ComplexArray) -> ComplexArray:
    """Return the response of sections: in powers of 1/z - 1, small where coefficients cancel."""
    c = sections.reshape(-1, 2, 3, 1)
    c0, c1, c2 = c[:, :, 0], c[:, :, 1], c[:, :, 2]
    each = (c0 + c1 + c2) + (c1 + 2.0 * c2) * back + c2 * back**2
    return np.asarray(np.prod(each[:, 0] / each[:, 1], axis=0))


def _cause(exact: float, poles: ComplexArray, dt: float) -> str:
    """Return why sections differ, and what helps: the product of their factors differs less."""
    if exact > TYPED:
        return (
            "with this number of states, rounding makes poles and zeros meaningless. Reduce the "
            "controller first "
            "(reduce_controller)"
        )
    slow = float(np.abs(poles - 1.0).min()) / (2.0 * np.pi * dt)
    return (
        f"a pole at {slow:.3g} Hz is so near z = 1 at a rate of {1.0 / dt:g} Hz that coefficients "
        "in double precision cannot hold it: 1 + a1 + a2 is (w dt)^2. Lower the rate"
    )


def anti_windup_form(controller: Any, *, recovery: float | None = None) -> StateSpace:
    """Return an anti-windup form of a controller, with the applied commands as additional inputs.

    ::

        x' = (A - L C) x + (B - L D) y + L u_applied,    u = C x + D y

    Here u is the command of the controller and u_applied is the command that the actuators really
    apply. As long as both are equal, this system equals the controller. When an actuator saturates,
    the term with L corrects the states, so that they agree with the applied command. The poles of
    ``A - L C`` determine how fast this correction acts.

    By default, ``L = B D^-1`` (the form of Hanus). The poles of A - L C are then the zeros of the
    controller. If `recovery` is given, L moves only the poles of the controller that decay more
    slowly than this time constant, such as integrators. These poles get this time constant and keep
    their frequency. The other poles do not change. For a PI controller this is the well-known
    back-calculation, with `recovery` as its tracking time.

    Parameters
    ----------
    controller : StateSpace or Controller
        Controller from y to u, continuous or sampled.
    recovery : float [s], optional
        Time constant of the slowest poles of A - L C. By default the form of Hanus is used.

    Returns
    -------
    StateSpace
        System whose inputs are those of the controller and then the applied commands. Its outputs
        are the commands u. `close_loop` takes it as a block and connects the applied commands.

    Raises
    ------
    AssumptionError
        When no `recovery` is given and Hanus' form cannot be used. D may be singular, so that its
        inverse does not exist. Or the zeros of the controller, which are the poles of this form,
        are not stable. Give a recovery time in both cases.
    ModelError
        When slow states do not act on the commands, so that commands cannot correct them.

    References
    ----------
    [Hanus1987]_; [AstromWittenmark1997]_, section 9.4.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> fx.synthesis.anti_windup_form(servo, recovery=0.05).inputs
    ('die:ref', 'die:hat', 'u1')
    """
    K = as_statespace(controller)
    L = back_gain(K, recovery)
    n_u = len(K.outputs)
    return K.replace(
        A=K.A - L @ K.C,
        B=np.hstack([K.B - L @ K.D, L]),
        D=np.hstack([K.D, np.zeros((n_u, n_u))]),
        inputs=[*K.inputs, *K.outputs],
        blocks=None,
    )


def back_gain(K: StateSpace, recovery: float | None) -> FloatArray:
    """Return L (n, nu): the states move by ``L (applied - commanded)``, with stable A - L C."""
    if recovery is None:
        return _hanus(K)
    return recovery_gain(K.A, K.C, positive(recovery, "recovery"), K.dt)


def _hanus(K: StateSpace) -> FloatArray:
    """Return ``B D^-1``, of a wide D its least solution."""
    size = np.linalg.svd(K.D, compute_uv=False)
    rank = int(np.count_nonzero(size > ROOT * size.max(initial=0.0)))
    if rank < len(K.outputs) or not size.max(initial=0.0) > 0:
        raise AssumptionError(
            f"Hanus' form divides by D, which has rank {rank} for {len(K.outputs)} actuators: a "
            "controller that rolls off has none. Give a recovery time: the observer form."
        )
    L = np.asarray(K.B @ np.linalg.pinv(K.D))
    poles = np.linalg.eigvals(K.A - L @ K.C) if K.n_states else np.zeros(0)
    size = np.abs(poles)
    growth = np.max(size - 1.0 if K.dt else poles.real, initial=-np.inf)
    # Tustin's rule puts zeros at exactly -1, several at once, which rounding moves by its root
    if not growth < -(1e-7 if K.dt else 1e-9 * np.max(size, initial=0.0)):
        raise AssumptionError(
            "the zeros of the controller, which Hanus' form has as poles, are not all stable, or "
            "not clearly: its states would run off while an actuator saturates. Give a recovery "
            "time."
        )
    return L
