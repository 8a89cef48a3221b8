"""Comparison of a reduced model with the full one: modes, responses and static compliance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from ..arrays import (
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    divisor,
    frequency_band,
    positive,
    real_array,
    whole,
)
from ..errors import ModelError, aligned, counted, short
from ..labels import Place
from ..lti.frequency_sweep import POINTS, ROUNDS, climbed_grid
from ..modes.dynamic_basis import (
    SILENT,
    DirectCheck,
    DynamicBasis,
    antiresonances,
    checked_response,
)
from ..modes.matching import pair_modes
from ..modes.modes import Modes
from ..modes.solve import labels_of, modes_reaching, places, static_response
from ..modes.sparse_modes import held_factor
from ..store import Value
from ..structure import FEModel
from ..tolerances import FOUR_DIGITS, SAME
from .ranking import ErrorBound

#: a `ReducedModel`, whose module imports this one
Reduced: TypeAlias = Any


def quality_of(
    reduced: Reduced,
    full: FEModel | Modes,
    band: tuple[float, float],
    inputs: Any,
    outputs: Any,
    count: int | None,
    freq: Any,
    loss: float | None,
) -> ReductionQuality:
    """Return the quality of a reduced model; `ReducedModel.quality` is the public way."""
    if not isinstance(full, FEModel | Modes) or tuple(full.dofs) != tuple(reduced.full_dofs):
        what = f"{full!r:.80}" if isinstance(full, FEModel | Modes) else type(full).__name__
        raise ModelError(
            f"a reduced model is compared with the FEModel or Modes it was made of, got {what}: "
            "pass that."
        )
    low, high = frequency_band(band)
    pushed, watched = _judged_places(reduced, inputs, outputs)
    own: Modes = reduced.replace(D=np.zeros_like(reduced.D)).modes()
    if reduced.is_physical:
        own = own.replace(phi=reduced.T @ own.phi, dofs=reduced.full_dofs)
    modes = _full_modes(full, count, high)
    B, C = _place_rows(full, pushed).T, _place_rows(full, watched)
    Br, Cr = reduced.T.T @ B, C @ reduced.T
    undamped = full.D is None if isinstance(full, FEModel) else not np.any(full.basis_zeta)
    factor = _loss(reduced, own, loss) if undamped else None
    # keep one factor for the static shapes and the check
    held = held_factor(full) if isinstance(full, FEModel) else None
    responses = FullResponses(full, modes, B, C, factor)

    def less(at: FloatArray) -> ComplexArray:
        return reduced_response(reduced, at, Br, Cr, factor)

    both = [(responses.at, modes), (less, own)]
    elastic = [(find, one.freq[one.n_rigid :]) for find, one in both]
    grid, peaks, deep = check_frequencies(low, high, elastic)
    grid = np.unique(np.atleast_1d(grid if freq is None else real_array(freq, "freq")))
    if not grid.size or grid[0] < 0:
        raise ModelError(
            "freq needs at least one frequency [Hz], and negative frequencies are refused."
        )
    responses.checked(grid)
    del held
    places_move = responses.drive_points(np.append(peaks, grid[[0, -1]]))
    sizes, _ = channel_sizes(np.abs(responses.at(grid)).max(axis=0), places_move.max(axis=0))
    if freq is None and B.shape[1] and C.shape[0]:
        # between two close resonances of the models the error may be larger than at either
        grid, _ = climbed_grid(
            lambda at: (np.abs(responses.at(at) - less(at)) / sizes).max(axis=(1, 2)), grid, ROUNDS
        )
    whole_response, found = responses.at(grid), less(grid)
    gap, size = np.abs(found - whole_response), np.abs(whole_response)
    larger, peak = np.maximum(size, np.abs(found)), size.max(axis=0)
    sizes, silent = channel_sizes(peak, places_move.max(axis=0))
    # relative to the largest response there: a mode with a node line at a place has no resonance in
    # that pair
    at_peaks = gap / divisor(larger.max(axis=(1, 2), keepdims=True, initial=0.0))
    at_peaks[:, silent] = np.nan
    at_dips = gap / np.where(silent, sizes, divisor(larger))
    channels = labels_of(pushed, full.dofs), labels_of(watched, full.dofs)
    bound = reduced.bound
    if bound is not None and (bound.inputs, bound.outputs) != channels:
        bound = None
    covered = bound is not None and (
        bound.covers is None or (isinstance(full, Modes) and full.n_modes <= bound.covers)
    )
    true = np.linalg.norm(found - whole_response, 2, axis=(1, 2)) if gap.size else np.zeros(0)
    return ReductionQuality(
        **_mode_comparison(full, modes, own, count, high),
        check_freq=grid,
        frf_error=gap.max(axis=0) / sizes,
        silent=silent,
        resonance_error=_largest_error(at_peaks, np.isin(grid, peaks)),
        antiresonance_error=_largest_error(at_dips, np.isin(grid, deep)),
        static_error=static_error(responses.static(), reduced, Br, Cr, places_move[-1]),
        true_error=float(true.max(initial=0.0)),
        condition=reduced.condition,
        inputs=channels[0],
        outputs=channels[1],
        full_error=np.nan if responses.check is None else responses.check.worst,
        route=str(responses),
        bound=bound,
        bounded=covered,
    )


def channel_sizes(peak: FloatArray, places_move: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the reference of errors of channels (p, q), and which channels are silent.

    `places_move` (q + p) has the responses of the inputs, then of the outputs, to forces on
    themselves. The error of a silent channel is relative to their geometric mean, since its own
    peak is rounding.
    """
    q = peak.shape[1]
    own = np.sqrt(np.outer(places_move[q:], places_move[:q]))
    silent = peak <= SILENT * own
    return divisor(np.where(silent, own, peak)), silent


def _largest_error(error: FloatArray, chosen: Any) -> FloatArray:
    """Return the largest of errors (f, p, q) over the chosen frequencies, NaN without any."""
    if not chosen.any():
        return np.full(error.shape[1:], np.nan)
    return np.asarray(error[chosen].max(axis=0))


def _judged_places(reduced: Reduced, inputs: Any, outputs: Any) -> tuple[list[Place], list[Place]]:
    pushed: Any = places(inputs)
    watched: Any = places(outputs)
    if not pushed and reduced.bound is not None:
        known = (reduced.bound.inputs, reduced.bound.outputs)
        if all(label in reduced.full_dofs for names in known for label in names):
            return list(known[0]), watched or list(known[1])
    return pushed, watched or pushed


def _place_rows(full: FEModel | Modes, at: list[Place]) -> FloatArray:
    rows = np.array([full.dofs.row(place) for place in at]).reshape(-1, len(full.dofs))
    if not rows.any(axis=1).all():
        empty = at[int(np.argmin(rows.any(axis=1)))]
        raise ModelError(f"the place {short(empty)} moves with no DOF: its weights are all zero.")
    return rows


def _loss(reduced: Reduced, own: Modes, loss: float | None) -> float:
    if loss is not None:
        return positive(loss, "loss", zero=True)
    if not np.any(reduced.D):
        return 0.01
    # 2 zeta = phi^T D phi / omega, mode by mode: with dampers to ground no modes at 0 exist
    shapes = np.linalg.lstsq(reduced.T, np.real(own.phi), rcond=None)[0]
    rates = np.einsum("ik,ij,jk->k", shapes, reduced.D, shapes)[own.n_rigid :]
    return float(np.mean(rates / own.omega[own.n_rigid :]))


def _full_modes(full: FEModel | Modes, count: int | None, high: float) -> Modes:
    if isinstance(full, Modes):
        return full
    least = 0 if count is None else whole(count, "count", maximum=full.n_dof)
    return modes_reaching(full, high, least=least)


def _mode_comparison(
    full: FEModel | Modes, modes: Modes, found: Modes, count: int | None, high: float
) -> dict[str, Any]:
    """Return the pairs of full and reduced modes, and their MAC."""
    wanted = whole(count, "count") if count is not None else int(np.sum(modes.freq <= high))
    phi: Any = np.asarray(modes.phi)[:, :wanted]
    f, own, shapes = modes.freq[:wanted], found.freq, np.real(found.phi)
    if isinstance(full, FEModel):
        loaded = np.asarray(full.M @ shapes)
        weighted, full_gram = loaded, phi.conj().T @ np.asarray(full.M @ phi)
        orthogonality = float(np.abs(shapes.T @ loaded - np.eye(own.size)).max())
    else:
        straight = np.array([":r" not in label for label in full.dofs.labels])
        seen = straight if straight.any() else np.ones_like(straight)
        weighted, full_gram = shapes * seen[:, None], phi[seen].conj().T @ phi[seen]
        orthogonality = np.nan
    gram = shapes.T @ weighted
    pairs = pair_modes(f, own, full_gram, phi.conj().T @ weighted, gram, n_rigid=modes.n_rigid)
    found_freq = np.where(pairs.partner >= 0, own[pairs.partner], np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.where(f > 0, found_freq / f - 1.0, 0.0)
    return {
        "modes": np.arange(1, f.size + 1),
        "full_freq": f,
        "freq": found_freq,
        "freq_error": error,
        "mac": pairs.mac,
        "group": pairs.group + 1,
        "orthogonality": orthogonality,
    }


#: number of direct solutions that check the responses of a small and of a large structure
_CHECKS, _SMALL = (6, 3), 2000


#: function that returns the responses (f, p, q) at frequencies [Hz]
Find: TypeAlias = Callable[[FloatArray], ComplexArray]


class FullResponses:
    """The responses of a full structure at any frequency."""

    def __init__(
        self, full: FEModel | Modes, modes: Modes, B: FloatArray, C: FloatArray, loss: float | None
    ) -> None:
        self.full, self.modes, self.B, self.C, self.loss = full, modes, B, C, loss
        self.basis: DynamicBasis | None = None
        if isinstance(full, FEModel):
            self.basis = DynamicBasis(full, modes, np.hstack([B, C.T]), loss=loss)
        self.check: DirectCheck | None = None

    def at(self, freq: FloatArray) -> ComplexArray:
        """Return the responses (f, p, q)."""
        if not self.B.shape[1]:
            return np.zeros((freq.size, self.C.shape[0], 0), dtype=np.complex128)
        return self._response(freq, self.C, self.B)

    def _response(self, freq: FloatArray, rows: FloatArray, loads: FloatArray) -> ComplexArray:
        if self.basis is not None:
            return self.basis.response(freq, rows, loads)
        return _modal_response(self.modes, freq, loads, rows, self.loss or 0.0)

    def checked(self, freq: FloatArray) -> None:
        """Compare the responses in a band with direct solutions, which improve the basis."""
        if self.basis is not None and self.B.shape[1]:
            checks = _CHECKS[len(self.full.dofs) > _SMALL]
            self.basis, _, self.check = checked_response(
                self.basis, freq, self.C, self.B, checks=checks, tolerance=FOUR_DIGITS
            )

    def drive_points(self, freq: FloatArray) -> FloatArray:
        """Return the size (f, q + p) of the response of each input and output to its own force."""
        loads = np.hstack([self.B, self.C.T])
        if self.basis is not None:
            return self.basis.drive_points(freq, loads.T)
        found = np.zeros((freq.size, loads.shape[1]))
        for k, load in enumerate(loads.T):
            found[:, k] = np.abs(self._response(freq, load[None], load[:, None]))[:, 0, 0]
        return found

    def static(self) -> FloatArray:
        """Return the elastic compliance (p + q, p + q) of [inputs, outputs]; NaN if not known."""
        loads = np.hstack([self.B, self.C.T])
        if self.basis is not None:
            return self.basis.compliance(loads.T, loads)
        modes = self.modes
        if np.iscomplexobj(modes.phi):
            return np.full((loads.shape[1],) * 2, np.nan)
        r = modes.n_rigid
        motion = (loads.T @ np.real(modes.basis))[:, r:] / modes.basis_omega[r:]
        return np.asarray(motion @ motion.T)

    def __str__(self) -> str:
        how = "its D" if self.loss is None else f"loss factor {self.loss:.3g} in both"
        if self.basis is None:
            return "the sum over the given modes" + (f", {how}" if self.loss is not None else "")
        check = f"; {self.check}" if self.check is not None else ""
        return f"{self.basis.n_modes} modes and {self.basis.n_shapes} static shapes, {how}{check}"


def check_frequencies(
    low: float, high: float, both: Sequence[tuple[Find, FloatArray]]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return frequencies [Hz] over a band, and those that are resonances and antiresonances."""
    start = low if low > 0 else high / 1000
    resonances = np.concatenate([own for _, own in both])
    resonances = resonances[(resonances >= low) & (resonances <= high)]
    deep = np.concatenate([antiresonances(find, own, low, high) for find, own in both])
    return np.concatenate([np.geomspace(start, high, POINTS), resonances, deep]), resonances, deep


def _modal_response(
    modes: Modes, freq: FloatArray, B: FloatArray, C: FloatArray, loss: float
) -> ComplexArray:
    s = 2j * np.pi * freq[:, None]
    if np.iscomplexobj(modes.phi):
        r, poles, phi = modes.n_rigid, np.asarray(modes.poles), np.asarray(modes.phi)
        swing = divisor(poles.imag)
        one = np.where(np.arange(poles.size) < r, 1 / s**2, 1 / (2j * swing * (s - poles)))
        two = np.where(np.arange(poles.size) < r, 0.0, 1 / (-2j * swing * (s - poles.conj())))
        basis, gain = np.hstack([phi, phi.conj()]), np.hstack([one, two])
    else:
        basis = np.real(modes.basis)
        gain = 1.0 / (modes.basis_squares * (1 + 1j * loss) + modes.basis_rates * s + s**2)
    return np.asarray(np.einsum("pk,fk,kq->fpq", C @ basis, gain, basis.T @ B))


def reduced_response(
    reduced: Reduced, freq: FloatArray, B: FloatArray, C: FloatArray, loss: float | None
) -> ComplexArray:
    """Return responses (f, p, q) of the reduced model: with a loss factor, or its own D."""
    omega = 2 * np.pi * freq[:, None, None]
    stiffness: Any = reduced.K * (1 + 1j * loss) if loss is not None else reduced.K
    damping = 0.0 if loss is not None else 1j * omega * reduced.D
    size = 1.0 / np.sqrt(np.abs(np.diag(reduced.K)) + np.abs(np.diag(reduced.M)))
    matrix = (stiffness + damping - omega**2 * reduced.M) * size[:, None] * size
    return np.asarray((C * size) @ np.linalg.solve(matrix, (B * size[:, None])[None]))


def static_error(
    whole: FloatArray, reduced: Reduced, Br: FloatArray, Cr: FloatArray, places_move: FloatArray
) -> FloatArray:
    """Return errors (p, q) of the elastic compliance `whole`, relative to its channels."""
    q = Br.shape[1]
    watched = np.hstack([Br, Cr.T])
    found = watched.T @ static_response(reduced, watched)
    size = np.sqrt(np.abs(np.diag(whole)))
    sizes, _ = channel_sizes(np.outer(size[q:], size[:q]), places_move)
    return np.asarray(np.abs(found - whole)[q:, :q] / sizes)


@dataclass(frozen=True, eq=False, repr=False)
class ReductionQuality(Value):
    """The error of a reduced model relative to the full one.

    Parameters
    ----------
    modes : (m,) array of int
        Numbers of the full model's modes that are compared.
    full_freq, freq : (m,) arrays [Hz]
        Frequencies of these modes in the full model, and in the reduced model. Modes are paired one
        to one, by shape and frequency. NaN: no reduced mode has a MAC of at least 0.5 with it.
    freq_error : (m,) array
        Relative error of each frequency. It is 0 for rigid-body modes and NaN without a partner.
    mac : (m,) array
        Modal assurance criterion (MAC) of each full mode and its reduced mode. It is 1 for equal
        shapes and 0 for orthogonal ones. For an FEModel, the mass matrix is the weight. The shapes
        of repeated modes are an arbitrary basis of a subspace. The values of repeated modes are
        therefore the squared cosines of the angles between the subspaces of the two models.
    group : (m,) array of int
        Number of the group of each mode, which is the number of the first mode in the group. Shapes
        of modes in a group cannot be distinguished. If one mode of a group has no partner in the
        reduced model, it is not known which one.
    check_freq : (f,) array [Hz]
        Frequencies at which the responses are compared.
    frf_error : (p, q) array
        Largest error of each channel over the band, relative to the largest response of the
        channel. Rows are outputs, and columns are inputs.
    silent : (p, q) array of bool
        True for channels whose response in the full model is only rounding, below 1e-9 of a
        reference. The reference is the geometric mean of two responses: the largest response at the
        input to a force at the same place, and the largest response at the output to a force at
        that place. The errors of such a channel are relative to the reference. These channels are
        left out when the worst one is printed.
    resonance_error : (p, q) array
        Largest error at a resonance of either model, relative to the largest response of any
        channel of both models at this frequency. NaN without a resonance in the band, and for
        silent channels.
    antiresonance_error : (p, q) array
        Largest error at an antiresonance of either model, relative to the larger response of the
        two models there. It is 1 where only one model has the antiresonance, and NaN without an
        antiresonance. For silent channels it is relative to the reference of `silent`.
    static_error : (p, q) array
        Error of the elastic static compliance G_ij from input j to output i, relative to
        ``sqrt(G_ii G_jj)``. If this root is only rounding, G_ii and G_jj are taken at the upper
        end of the band instead of 0 Hz.
    true_error : float [m/N]
        Largest singular value of the error of the response, over the check frequencies.
    orthogonality : float
        Deviation of the expanded reduced modes from M-orthonormality. NaN: the full structure was
        given by Modes.
    condition : float
        Condition number of the matrix that the method inverted.
    inputs, outputs : sequence of str
        Names of the inputs and outputs.
    route : str
        Method by which the full responses were computed.
    full_error : float
        Difference between these responses and direct solutions with the full matrices, relative to
        the peak. NaN: the full structure was given by Modes.
    bound : ErrorBound, optional
        Bound of the error, computed by the reduction method without responses. None if the method
        has no bound for these channels.
    bounded : bool
        Whether the bound covers all compared modes. If a reduction started from some modes of the
        structure, its bound does not include the other modes.

    Examples
    --------
    Three of four modes are kept. They are exact, and mode 4 has no partner:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5, 4e5])
    >>> small = fx.reduce(model, fx.reduction.ModalTruncation(3))
    >>> quality = small.quality(model, band=(10.0, 200.0), inputs=["1:x"], outputs=["1:x"])
    >>> quality.freq_error.round(9), quality.mac.round(6)
    (array([ 0.,  0.,  0., nan]), array([1., 1., 1., 0.]))
    """

    modes: IntArray
    full_freq: FloatArray
    freq: FloatArray
    freq_error: FloatArray
    mac: FloatArray
    group: IntArray
    check_freq: FloatArray
    frf_error: FloatArray
    silent: BoolArray
    resonance_error: FloatArray
    antiresonance_error: FloatArray
    static_error: FloatArray
    true_error: float
    orthogonality: float
    condition: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    route: str
    full_error: float = np.nan
    bound: ErrorBound | None = None
    bounded: bool = True

    @property
    def alike(self) -> tuple[tuple[int, ...], ...]:
        """Groups of mode numbers: elastic modes whose shapes cannot be distinguished."""
        elastic = self.full_freq > 0
        firsts = np.unique(self.group[elastic])
        groups = [self.modes[elastic & (self.group == first)].tolist() for first in firsts]
        return tuple(tuple(members) for members in groups if len(members) > 1)

    @property
    def band_bound(self) -> float | None:
        """The bound [m/N] for frequencies up to the highest checked one; None without a bound."""
        if self.bound is None:
            return None
        top = float(self.check_freq[-1])
        return self.bound.below(top) if top else self.bound.value

    @property
    def holds(self) -> bool:
        """Whether the true error at the check frequencies is within the bound.

        It is also True without a bound, and when the bound does not cover all modes that were
        compared (see `bounded`).
        """
        limit = self.band_bound if self.bounded else None
        return limit is None or self.true_error <= limit * (1 + SAME)

    def __repr__(self) -> str:
        lost = int(np.count_nonzero(np.isnan(self.freq)))
        errors = self.freq_error[~np.isnan(self.freq_error)]
        lines = [
            f"<ReductionQuality: {counted(self.modes.size, 'mode')}, worst frequency "
            f"{100 * np.abs(errors).max(initial=0.0):.3g} %, lowest MAC "
            f"{self.mac[~np.isnan(self.freq)].min(initial=1.0):.4f}"
            + (f", {lost} without a partner" if lost else "")
        ]
        if self.alike:
            listed = "; ".join(", ".join(map(str, members)) for members in self.alike[:4])
            more = ", ..." if len(self.alike) > 4 else ""
            lines.append(f"shapes that cannot be distinguished: modes {listed}{more}")
        if self.frf_error.size:
            heard = np.where(self.silent, -1.0, self.frf_error)
            i, j = np.unravel_index(int(np.argmax(heard)), heard.shape)
            worst, pair = max(heard[i, j], 0.0), f"{self.inputs[j]} -> {self.outputs[i]}"
            lines.append(
                f"FRF over {self.check_freq[0]:.4g} to {self.check_freq[-1]:.4g} Hz: worst "
                f"{100 * worst:.3g} % of the peak ({pair}), static "
                f"{100 * self.static_error.max():.3g} %"
            )
            if (unheard := self.frf_error[self.silent].max(initial=0.0)) > max(worst, SAME):
                lines[-1] += f", {100 * unheard:.3g} % where the full model is silent"
            for what in ("resonance", "antiresonance"):
                error = getattr(self, f"{what}_error")
                if not np.all(np.isnan(error)):
                    lines[-1] += f", at {what} {100 * np.nanmax(error):.3g} %"
            if self.bound is not None:
                lines.append(
                    f"error {self.true_error:.3g} m/N, bound {self.band_bound:.3g} m/N up to "
                    f"{self.check_freq[-1]:.4g} Hz ({self.bound.value:.3g} at all)"
                    + ("" if self.holds else ": BROKEN")
                )
                if not self.bounded:
                    solved = f"of the {self.bound.covers} modes solved"
                    lines[-1] += f", {solved}: others add to the error"
            lines.append(f"by {self.route}")
        return "\n  ".join(lines) + ">"

    def table(self) -> str:
        """Return a table of modes: both frequencies, error, MAC and modes with the same shape."""
        other = {
            n: f"alike: {', '.join(str(k) for k in members if k != n)}"
            for members in self.alike
            for n in members
        }
        columns = (self.modes, self.full_freq, self.freq, self.freq_error, self.mac)
        rows = [
            (str(n), f"{f:.4f}", f"{g:.4f}", f"{100 * e:.3g}", f"{m:.5f}", other.get(n, ""))
            for n, f, g, e, m in zip(*columns, strict=True)
        ]
        head = ("mode", "full [Hz]", "reduced [Hz]", "error [%]", "MAC", "")
        return "\n".join(aligned(head, rows))
