"""A sampled system as blocks of two states that act side by side, as a computer runs it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg as la
from scipy.sparse import csgraph

from ...checks import ComplexArray, FloatArray, IntArray
from ...errors import CertificateError
from ...lti.equations import state_scale
from ...lti.frequency import frequency_response
from ...lti.frequency_sweep import resonance_grid
from ...lti.modal import modal_form
from ...lti.norms import eigenvalues_with_error
from ...lti.statespace import StateSpace
from ...tolerances import RANK, ROUNDING, divisor

#: blocks that are computed at a time: four doubles are one AVX register, four floats one of SSE
LANES = 4
#: largest condition of the states' transformation: what rounding is multiplied with
_CONDITION = 1e7
#: distances of poles [1], beside 1, within which they share a block, tried in turn; the last
#: leaves the system as it is, in orthogonal states
_NEAR = (1e-6, 1e-4, 1e-2, 0.1, np.inf)
#: what the blocks may differ from the system, relative to the largest gain: in double precision
#: (rounding times the condition), and in single, whose 24 bits a resonance of 1e-4 still stands
_DOUBLE, _SINGLE = 1e-8, 1e-2
#: how far rounding may have moved a pole, beside its distance from a frequency: the square, that
#: of a double pole, is below the accuracy sought
_MOVED = 3e-5
#: a channel this far below the others of its output and input is not compared by itself
_SMALL = 1e-8


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
    K: StateSpace,
    *,
    driven: Sequence[slice] = (),
    inputs: int | None = None,
    single: bool = False,
) -> TwoStateForm:
    """Return a sampled system in blocks of two states, its response compared with the system's.

    For each group of outputs that are `driven` a start is computed that gives their commands at
    the values of the first `inputs`.
    """
    most, error = (_SINGLE if single else _DOUBLE), np.inf
    for form, sizes in _block_forms(K):
        found = _arranged(form, sizes, driven, inputs)
        found = _single_precision(found) if single else found
        error = min(error, away := _difference(K, found))
        if away <= most:
            return found._replace(error=away)
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
    """Return systems that differ in A too, one for each place, as full matrices.

    Between places their entries are linear: no coordinates but the systems' own keep them so, up
    to a scale for each state.
    """
    sizes = [state_scale(K.A, K.B, K.C) for K in laws]
    d = np.exp(np.mean(np.log(sizes), axis=0))
    found, error = [], 0.0
    for K in laws:
        K = K.replace(A=K.A * d / d[:, None], B=K.B / d[:, None], C=K.C * d, blocks=None)
        own = _arranged(K, [K.n_states], [slice(driven)], None)
        own = _single_precision(own) if single else own
        error = max(error, _difference(K, own))
        found.append(own)
    if error > (most := _SINGLE if single else _DOUBLE):
        raise CertificateError(
            f"{'single' if single else 'double'} precision moves the response at a place by "
            f"{error:.1e} of its largest gain, more than {most:g}. Write it in double precision, "
            "or reduce the controllers."
        )
    rest, B, start = (np.array([getattr(one, part) for one in found])
                      for part in ("rest", "B", "start"))  # fmt: skip
    C, D = (np.vstack([getattr(one, part) for one in found]) for part in "CD")
    return TwoStateForm(found[0].pairs, rest, B, C, D, start[:, 0], error)


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
    values = real + 1j * imag  # in the order of T
    for near in _NEAR:
        owner = _cluster_numbers(values, near)
        sizes = np.bincount(owner).tolist()
        bases = [
            la.lapack.dtrsen(owner == k, T, Z, job="N")[1][:, :size] for k, size in enumerate(sizes)
        ]
        V = np.hstack(bases)
        if np.linalg.cond(V) > _CONDITION:
            continue
        kept = la.block_diag(*(np.ones((size, size)) for size in sizes)) > 0
        new = np.where(kept, np.linalg.solve(V, A @ V), 0.0)
        B, C = np.linalg.solve(V, K.B / d[:, None]), (K.C * d) @ V
        yield K.replace(A=new, B=B, C=C, blocks=None), sizes


def _cluster_numbers(values: ComplexArray, near: float) -> IntArray:
    """Return the group of each pole: those within a distance of each other, and conjugates."""
    folded = values.real + 1j * np.abs(values.imag)
    near_others = np.abs(folded[:, None] - folded) <= near
    return np.asarray(csgraph.connected_components(near_others, directed=False)[1], dtype=np.int64)


def _arranged(
    K: StateSpace, sizes: list[int], driven: Sequence[slice], inputs: int | None
) -> TwoStateForm:
    """Return a block-diagonal system with its blocks side by side."""
    starts = np.cumsum([0, *sizes])[:-1]
    ones = [int(s) for s, size in zip(starts, sizes, strict=True) if size == 1]
    twos = [(int(s), int(s) + 1) for s, size in zip(starts, sizes, strict=True) if size == 2]
    many = [
        int(s) + k for s, size in zip(starts, sizes, strict=True) if size > 2 for k in range(size)
    ]
    n = K.n_states  # stands for a state that does not exist
    pairs = [*twos, *zip(ones[0::2], [*ones[1::2], n][: len(ones[0::2])], strict=True)]
    pairs += [(n, n)] * (-len(pairs) % LANES)
    many += [n] * (-len(many) % LANES)
    order = np.array([i for i, _ in pairs] + [j for _, j in pairs] + many, dtype=int)
    exists = order < n
    place = np.where(exists, order, 0)
    both = exists[:, None] & exists
    change = K.A - np.eye(n) if n else np.zeros((1, 1))
    full = np.where(both, change[np.ix_(place, place)], 0.0)
    B = np.where(exists[:, None], K.B[place], 0.0) if n else np.zeros((0, len(K.inputs)))
    C = np.where(exists, K.C[:, place], 0.0) if n else np.zeros((len(K.outputs), 0))
    N = len(pairs)
    entries = [[np.diag(full[i : i + N, j : j + N]) for j in (0, N)] for i in (0, N)]
    held = K.replace(B=K.B[:, :inputs], D=K.D[:, :inputs], inputs=K.inputs[:inputs], units={})
    start = [np.where(exists[:, None], _at_rest(held, rows)[place], 0.0) for rows in driven if n]
    return TwoStateForm(np.array(entries), full[2 * N :, 2 * N :], B, C, K.D, np.array(start), 0.0)


def _single_precision(form: TwoStateForm) -> TwoStateForm:
    """Return a form with its numbers in single precision."""
    parts = form._asdict().items()
    single = {name: np.asarray(part, np.float32).astype(np.float64) for name, part in parts}
    return form._replace(**single)  # type: ignore[arg-type]


def _at_rest(K: StateSpace, driven: slice) -> FloatArray:
    """Return the states (n, m + driven) that give the wanted commands and move least.

    Of all x with ``C x = out - D in`` (in least squares, where states cannot give them) that with
    the smallest ``(A - I) x + B in``, of these the smallest x.
    """
    C, D = K.C[driven], K.D[driven]
    first = np.linalg.pinv(C, rcond=RANK) @ np.hstack([-D, np.eye(len(C))])
    free, move = la.null_space(C, rcond=RANK), K.A - np.eye(K.n_states)
    drift = np.hstack([K.B, np.zeros((K.n_states, len(C)))]) + move @ first
    more, *_ = np.linalg.lstsq(move @ free, -drift, rcond=ROUNDING)
    return np.asarray(first + free @ more)


def _difference(K: StateSpace, form: TwoStateForm) -> float:
    """Return how much the response of the blocks differs, relative to the channel's largest gain.

    A channel far below the others of its output and input counts as part of them: it is rounding.
    """
    if not K.n_states:
        return 0.0
    poles, _, moved = eigenvalues_with_error(K.A)
    grid = resonance_grid(poles, K.dt, points=60)
    # nearer to poles than this the response is one of rounding: of a double pole at z = 1 in a
    # full A, say, which comes out as two, 1e-8 apart
    away = np.abs(np.exp(2j * np.pi * grid * K.dt)[:, None] - poles)
    grid = grid[np.all(moved < _MOVED * away, axis=1)]
    wanted, got = frequency_response(K, grid).data, form.response(grid, K.dt)
    size = np.abs(wanted).max(axis=2, initial=0.0)
    least = _SMALL * np.sqrt(np.outer(size.max(axis=1), size.max(axis=0)))
    away = np.abs(got - wanted).max(axis=2, initial=0.0)
    return float(np.max(away / divisor(np.maximum(size, least)), initial=0.0))
