"""How well a reduced model stands for the full one, checked by another computation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import ModelError
from ..labels import Place
from ..modes.attachment_vectors import labels_of, places
from ..modes.modes import Modes
from ..modes.solve import solve_modes
from ..structure import FEModel, ModalDamping
from ..values import FloatArray, IntArray, Value, name_list, positive, real_array, whole
from .bounds import ErrorBound
from .check_responses import (
    SMALL,
    Reduced,
    check_frequencies,
    full_response,
    reduced_response,
    static_error,
)
from .mode_pairs import paired


@dataclass(frozen=True, eq=False, repr=False)
class ReductionQuality(Value):
    """The error of a reduced model beside the full one.

    Parameters
    ----------
    modes : (m,) array of int
        Numbers of the full model's modes that are compared.
    full_freq, freq : (m,) arrays [Hz]
        Their frequencies, and those of the reduced modes paired with them, one to one, by shape and
        frequency; NaN where none has a MAC of 0.5.
    freq_error : (m,) array
        Relative; 0 for rigid-body modes, NaN without a partner.
    mac : (m,) array
        Of each full mode with the reduced one: mass-weighted for an FEModel. Of repeated modes,
        whose shapes are any basis of a subspace, the squared cosines of the angles between the two
        subspaces.
    group : (m,) array of int
        Number of the first mode whose shape cannot be distinguished from that of each: of
        repeated modes that lack a partner it is not known which one is missing.
    check_freq : (f,) array [Hz]
        Where responses were compared.
    frf_error : (p, q) array
        Largest error over the band, of the largest response, output by input.
    resonance_error : (p, q) array
        Largest error at a resonance, of the largest response of any pair there; NaN without a
        resonance in the band.
    static_error : (p, q) array
        Of the elastic static compliance, relative to its size sqrt(G_ii G_jj).
    true_error : float [m/N]
        Largest singular value of the error at the check frequencies.
    orthogonality : float
        Departure of the expanded reduced modes from M-orthonormality; NaN against Modes.
    condition : float
        Of what the method inverted.
    inputs, outputs : sequence of str
        The channels.
    route : str
        How the full responses were found.
    bound : ErrorBound, optional
        The a-priori bound of the method, when it is of these channels.
    """

    modes: IntArray
    full_freq: FloatArray
    freq: FloatArray
    freq_error: FloatArray
    mac: FloatArray
    group: IntArray
    check_freq: FloatArray
    frf_error: FloatArray
    resonance_error: FloatArray
    static_error: FloatArray
    true_error: float
    orthogonality: float
    condition: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    route: str
    bound: ErrorBound | None = None

    def __post_init__(self) -> None:
        self._set(
            modes=np.asarray(self.modes, dtype=np.int64),
            group=np.asarray(self.group, dtype=np.int64),
            inputs=name_list(self.inputs, "inputs"),
            outputs=name_list(self.outputs, "outputs"),
            **{
                name: np.asarray(getattr(self, name), dtype=np.float64)
                for name in (
                    "full_freq", "freq", "freq_error", "mac", "check_freq",
                    "frf_error", "resonance_error", "static_error",
                )
            },
        )  # fmt: skip

    @property
    def alike(self) -> tuple[tuple[int, ...], ...]:
        """Numbers of the elastic modes whose shapes cannot be distinguished, group by group."""
        elastic = self.full_freq > 0
        firsts = np.unique(self.group[elastic])
        groups = [self.modes[elastic & (self.group == first)].tolist() for first in firsts]
        return tuple(tuple(members) for members in groups if len(members) > 1)

    @property
    def band_bound(self) -> float | None:
        """The a-priori bound [m/N] for frequencies up to the last one checked, if there is one."""
        if self.bound is None or not self.check_freq[-1]:
            return None if self.bound is None else self.bound.value
        return self.bound.below(float(self.check_freq[-1]))

    @property
    def holds(self) -> bool:
        """Whether the true error at the check frequencies is within the bound, if there is one."""
        limit = self.band_bound
        return limit is None or self.true_error <= limit * (1 + 1e-9)

    def __repr__(self) -> str:
        lost = int(np.count_nonzero(np.isnan(self.freq)))
        errors = self.freq_error[~np.isnan(self.freq_error)]
        lines = [
            f"<ReductionQuality: {self.modes.size} modes, worst frequency "
            f"{100 * np.abs(errors).max(initial=0.0):.3g} %, lowest MAC "
            f"{self.mac[~np.isnan(self.freq)].min(initial=1.0):.4f}"
            + (f", {lost} without a partner" if lost else "")
        ]
        if self.alike:
            listed = "; ".join(", ".join(map(str, members)) for members in self.alike[:4])
            more = ", ..." if len(self.alike) > 4 else ""
            lines.append(f"shapes that cannot be distinguished: modes {listed}{more}")
        if self.frf_error.size:
            i, j = np.unravel_index(int(np.argmax(self.frf_error)), self.frf_error.shape)
            lines.append(
                f"FRF over {self.check_freq[0]:.4g} to {self.check_freq[-1]:.4g} Hz: worst "
                f"{100 * self.frf_error[i, j]:.3g} % of the peak ({self.inputs[j]} -> "
                f"{self.outputs[i]}), static {100 * self.static_error.max():.3g} %"
            )
            if not np.all(np.isnan(self.resonance_error)):
                worst = 100 * np.nanmax(self.resonance_error)
                lines[-1] += f", at resonance {worst:.3g} %"
            if self.bound is not None:
                lines.append(
                    f"error {self.true_error:.3g} m/N, bound {self.band_bound:.3g} m/N up to "
                    f"{self.check_freq[-1]:.4g} Hz ({self.bound.value:.3g} at all)"
                    + ("" if self.holds else ": BROKEN")
                )
            lines.append(f"by {self.route}")
        return "\n  ".join(lines) + ">"

    def table(self) -> str:
        """Return mode by mode: both frequencies, error, MAC and of which shape it may also be."""
        other = {
            n: f"  alike: {', '.join(str(k) for k in members if k != n)}"
            for members in self.alike
            for n in members
        }
        lines = [f"mode{'full [Hz]':>12s}{'reduced [Hz]':>14s}{'error [%]':>12s}{'MAC':>9s}"]
        lines += [
            f"{n:4d}{f:12.4f}{g:14.4f}{100 * e:12.3g}{m:9.5f}{other.get(n, '')}"
            for n, f, g, e, m in zip(
                self.modes, self.full_freq, self.freq, self.freq_error, self.mac, strict=True
            )
        ]
        return "\n".join(lines)


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
    low, high = _band(band)
    pushed, watched = _channels(reduced, inputs, outputs)
    modes = _full_modes(reduced, full, count, high)
    compared = _compared(full, modes, reduced, count, high)
    elastic = modes.freq[modes.n_rigid :]
    resonances = elastic[(elastic >= low) & (elastic <= high)]
    B, C = _rows(full, pushed).T, _rows(full, watched)
    Br, Cr = reduced.T.T @ B, C @ reduced.T
    small = len(full.dofs) <= SMALL or isinstance(full, Modes)
    grid = (
        check_frequencies(low, high, resonances, small)
        if freq is None
        else real_array(freq, "freq")
    )
    grid = np.unique(np.concatenate([np.atleast_1d(grid), []]))
    if not grid.size or grid[0] < 0:
        raise ModelError("freq needs at least one frequency [Hz], none below 0.")
    factor = _loss(reduced, loss)
    whole_response, route = full_response(full, modes, grid, B, C, factor)
    structural = isinstance(full, FEModel) and full.D is None
    found = reduced_response(reduced, grid, Br, Cr, factor if structural else None)
    gap = np.abs(found - whole_response)
    size = np.abs(whole_response)
    at = np.isin(grid, resonances)
    with np.errstate(invalid="ignore", divide="ignore"):
        # of the largest response there: a mode on a node line makes no resonance of that pair
        largest = size[at].max(axis=(1, 2), keepdims=True, initial=0.0)
        resonance = (gap[at] / largest).max(axis=0) if at.any() else np.full(gap.shape[1:], np.nan)
        frf = gap.max(axis=0) / size.max(axis=0)
    bound = reduced.bound
    if bound is not None and (bound.inputs, bound.outputs) != (
        labels_of(pushed, full.dofs),
        labels_of(watched, full.dofs),
    ):
        bound = None
    return ReductionQuality(
        **compared,
        check_freq=grid,
        frf_error=frf,
        resonance_error=resonance,
        static_error=static_error(full, modes, reduced, B, C, Br, Cr),
        true_error=float(np.linalg.norm(found - whole_response, 2, axis=(1, 2)).max(initial=0.0))
        if gap.size
        else 0.0,
        condition=reduced.condition,
        inputs=labels_of(pushed, full.dofs),
        outputs=labels_of(watched, full.dofs),
        route=route,
        bound=bound,
    )


def _band(band: Any) -> tuple[float, float]:
    ends = real_array(band, "band", (2,))
    if not 0 <= ends[0] < ends[1]:
        raise ModelError(f"band must be two rising frequencies [Hz], got {ends.tolist()}.")
    return float(ends[0]), float(ends[1])


def _channels(reduced: Reduced, inputs: Any, outputs: Any) -> tuple[list[Place], list[Place]]:
    pushed: list[Any] = places(inputs)
    watched: list[Any] = places(outputs)
    if not pushed and reduced.bound is not None:
        known = (reduced.bound.inputs, reduced.bound.outputs)
        if all(label in reduced.full_dofs for names in known for label in names):
            return list(known[0]), watched or list(known[1])
    return pushed, watched or pushed


def _rows(full: FEModel | Modes, at: list[Place]) -> FloatArray:
    return np.array([full.dofs.row(place) for place in at]).reshape(-1, len(full.dofs))


def _loss(reduced: Reduced, loss: float | None) -> float:
    if loss is not None:
        return positive(loss, "loss", zero=True)
    if not np.any(reduced.D):
        return 0.01
    modes = reduced.modes()
    return 2.0 * float(np.mean(modes.zeta[modes.n_rigid :]))


def _full_modes(reduced: Reduced, full: FEModel | Modes, count: int | None, high: float) -> Modes:
    if isinstance(full, Modes):
        return full
    number = 0
    if count is not None:
        number = whole(count, "count", maximum=full.n_dof)
    # the reduced model has about as many in the band: a count is cheaper than "all below"
    number = max(number, int(np.sum(_undamped_modes(reduced).freq <= high)) + 8)
    while True:
        found = solve_modes(full, count=min(number, full.n_dof), damping=ModalDamping(0.0))
        if found.n_modes == full.n_dof or found.freq[-1] > high:
            return found
        number *= 2


def _compared(
    full: FEModel | Modes, modes: Modes, reduced: Reduced, count: int | None, high: float
) -> dict[str, Any]:
    """Return the pairs of full and reduced modes, and how alike they are."""
    wanted = whole(count, "count") if count is not None else int(np.sum(modes.freq <= high))
    phi: Any = np.asarray(modes.phi)[:, :wanted]
    f = modes.freq[:wanted]
    found = _undamped_modes(reduced)
    own = found.freq
    shapes = np.real(found.phi)
    if isinstance(full, FEModel):
        loaded = np.asarray(full.M @ shapes)
        weighted, full_gram = loaded, phi.conj().T @ np.asarray(full.M @ phi)
        orthogonality = float(np.abs(shapes.T @ loaded - np.eye(own.size)).max())
    else:
        straight = np.array([":r" not in label for label in full.dofs.labels])
        seen = straight if straight.any() else np.ones_like(straight)
        weighted, full_gram = shapes * seen[:, None], phi[seen].conj().T @ phi[seen]
        orthogonality = float("nan")
    gram = shapes.T @ weighted
    pairs = paired(f, own, full_gram, phi.conj().T @ weighted, gram, n_rigid=modes.n_rigid)
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


def _undamped_modes(reduced: Reduced) -> Modes:
    bare = reduced.replace(D=np.zeros_like(reduced.D))
    found = bare.modes()
    if not reduced.is_physical:
        return found
    return found.replace(phi=reduced.T @ found.phi, dofs=reduced.full_dofs)
