"""How well a reduced model stands for the full one, by a route of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from scipy.optimize import linear_sum_assignment

from ..errors import ModelError
from ..labels import Place
from ..structure import FEModel
from ..structure.factor import dense
from ..values import (
    ComplexArray,
    FloatArray,
    IntArray,
    Matrix,
    Value,
    name_list,
    positive,
    real_array,
    whole,
)
from .attachment import labels_of, places, static_response
from .bounds import ErrorBound
from .modes import Modes
from .projection import lu_of, undamped
from .reduced import ReducedModel
from .solve import solve_modes

#: up to this many DOFs responses are solved densely, at many frequencies
_SMALL = 600
#: check frequencies beside the resonances, of small and of large models
_GRID = (60, 6)
#: resonances looked at, of small and of large models
_RESONANCES = (200, 6)
#: modes closer than this, relatively, are compared as one subspace
_CLUSTER = 1e-3
#: MAC from which a reduced mode is a full one's partner
_PARTNER = 0.5


@dataclass(frozen=True, eq=False, repr=False)
class ReductionQuality(Value):
    """What a reduced model gets right, judged against the full one.

    Parameters
    ----------
    modes : (m,) array of int
        Numbers of the full model's modes that are compared.
    full_freq, freq : (m,) arrays [Hz]
        Their frequencies, and those of the reduced modes paired with them; NaN when the best one
        has a MAC below 0.5.
    freq_error : (m,) array
        Relative; 0 for rigid-body modes, NaN without a partner.
    mac : (m,) array
        Of each full mode with the reduced one (with the span of those of a cluster): mass-weighted
        for an FEModel.
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
        """Return mode by mode: both frequencies, error and MAC."""
        lines = [f"mode{'full [Hz]':>12s}{'reduced [Hz]':>14s}{'error [%]':>12s}{'MAC':>9s}"]
        lines += [
            f"{n:4d}{f:12.4f}{g:14.4f}{100 * e:12.3g}{m:9.5f}"
            for n, f, g, e, m in zip(
                self.modes, self.full_freq, self.freq, self.freq_error, self.mac, strict=True
            )
        ]
        return "\n".join(lines)


def quality_of(
    reduced: ReducedModel,
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
            f"a reduced model is judged against the FEModel or Modes it was made of, got {what}."
        )
    low, high = _band(band)
    pushed, watched = _channels(reduced, inputs, outputs)
    modes = _full_modes(reduced, full, count, high)
    compared = _compared(full, modes, reduced, count, high)
    elastic = modes.freq[modes.n_rigid :]
    resonances = elastic[(elastic >= low) & (elastic <= high)]
    B, C = _rows(full, pushed).T, _rows(full, watched)
    Br, Cr = reduced.T.T @ B, C @ reduced.T
    small = len(full.dofs) <= _SMALL or isinstance(full, Modes)
    grid = _grid(low, high, resonances, small) if freq is None else real_array(freq, "freq")
    grid = np.unique(np.concatenate([np.atleast_1d(grid), []]))
    if not grid.size or grid[0] < 0:
        raise ModelError("freq needs at least one frequency [Hz], none below 0.")
    factor = _loss(reduced, loss)
    whole_response, route = _full_response(full, modes, grid, B, C, factor)
    structural = isinstance(full, FEModel) and full.D is None
    found = _reduced_response(reduced, grid, Br, Cr, factor if structural else None)
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
        static_error=_static_error(full, modes, reduced, B, C, Br, Cr),
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


def _channels(reduced: ReducedModel, inputs: Any, outputs: Any) -> tuple[list[Place], list[Place]]:
    pushed: list[Any] = places(inputs)
    watched: list[Any] = places(outputs)
    if not pushed and reduced.bound is not None:
        known = (reduced.bound.inputs, reduced.bound.outputs)
        if all(label in reduced.full_dofs for names in known for label in names):
            return list(known[0]), watched or list(known[1])
    return pushed, watched or pushed


def _rows(full: FEModel | Modes, at: list[Place]) -> FloatArray:
    return np.array([full.dofs.row(place) for place in at]).reshape(-1, len(full.dofs))


def _loss(reduced: ReducedModel, loss: float | None) -> float:
    if loss is not None:
        return positive(loss, "loss", zero=True)
    if not np.any(reduced.D):
        return 0.01
    modes = reduced.modes()
    return 2.0 * float(np.mean(modes.zeta[modes.n_rigid :]))


def _full_modes(
    reduced: ReducedModel, full: FEModel | Modes, count: int | None, high: float
) -> Modes:
    if isinstance(full, Modes):
        return full
    bare, asked = undamped(full), 0
    if count is not None:
        asked = whole(count, "count", maximum=full.n_dof)
    # the reduced model has about as many in the band: a count is cheaper than "all below"
    asked = max(asked, int(np.sum(_undamped_modes(reduced).freq <= high)) + 8)
    while True:
        found = solve_modes(bare, count=min(asked, full.n_dof))
        if found.n_modes == full.n_dof or found.freq[-1] > high:
            return found
        asked *= 2


def _compared(
    full: FEModel | Modes, modes: Modes, reduced: ReducedModel, count: int | None, high: float
) -> dict[str, Any]:
    """Return the pairing of full and reduced modes by MAC, and how alike they are."""
    wanted = whole(count, "count") if count is not None else int(np.sum(modes.freq <= high))
    phi: Any = np.asarray(modes.phi)[:, :wanted]
    f = modes.freq[:wanted]
    r = modes.n_rigid
    found = _undamped_modes(reduced)
    own = found.freq
    shapes = np.real(found.phi)
    if isinstance(full, FEModel):
        loaded = np.asarray(full.M @ shapes)
        weighted, size = loaded, np.sum(shapes * loaded, axis=0)
        full_size = np.sum(np.conj(phi) * np.asarray(full.M @ phi), axis=0).real
        orthogonality = float(np.abs(shapes.T @ loaded - np.eye(own.size)).max())
    else:
        straight = np.array([":r" not in label for label in full.dofs.labels])
        weighted = shapes * (straight if straight.any() else True)[:, None]  # type: ignore[index]
        size = np.sum(shapes * weighted, axis=0)
        full_size = np.sum(np.abs(phi[straight] if straight.any() else phi) ** 2, axis=0)
        orthogonality = float("nan")
    alike = np.abs(phi.conj().T @ weighted) ** 2 / np.outer(full_size, size)
    k = min(f.size, own.size)
    partner = np.full(f.size, -1)
    partner[: min(r, k)] = np.arange(min(r, k))
    rows, columns = linear_sum_assignment(-alike[r:, r:]) if k > r else ([], [])
    partner[np.asarray(rows, dtype=np.int64) + r] = np.asarray(columns, dtype=np.int64) + r
    partner = _in_order(partner, f)
    mac = np.where(partner >= 0, 0.0, np.nan)
    for members in _clusters(f, r):
        mine = partner[members]
        mine = mine[mine >= 0]
        for i in members:
            mac[i] = _inside(alike[i], mine, shapes, weighted, phi[:, i], size, full_size[i])
    mac = np.where(np.isnan(mac), 0.0, mac)
    paired = np.where((partner >= 0) & (mac >= _PARTNER), own[partner], np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.where(f > 0, paired / f - 1.0, 0.0)
    return {
        "modes": np.arange(1, f.size + 1),
        "full_freq": f,
        "freq": paired,
        "freq_error": error,
        "mac": mac,
        "orthogonality": orthogonality,
    }


def _undamped_modes(reduced: ReducedModel) -> Modes:
    bare = reduced.replace(D=np.zeros_like(reduced.D))
    found = bare.modes()
    if not reduced.is_physical:
        return found
    return found.replace(phi=reduced.T @ found.phi, dofs=reduced.full_dofs)


def _clusters(f: FloatArray, r: int) -> list[IntArray]:
    """Return the modes that are compared together: rigid-body modes, then close ones."""
    cuts = [0] if not f.size else [0, *(i for i in range(1, f.size) if _apart(f, i, r))]
    return [np.arange(a, b) for a, b in zip(cuts, [*cuts[1:], f.size], strict=True) if b > a]


def _apart(f: FloatArray, i: int, r: int) -> bool:
    return i == r or (i > r and f[i] - f[i - 1] > _CLUSTER * f[i])


def _in_order(partner: IntArray, f: FloatArray) -> IntArray:
    """Return partners with those of a cluster in rising order."""
    for members in _clusters(f, 0):
        mine = partner[members]
        if np.all(mine >= 0):
            partner[members] = np.sort(mine)
    return partner


def _inside(
    alike: FloatArray,
    mine: IntArray,
    shapes: FloatArray,
    weighted: FloatArray,
    phi: Any,
    size: FloatArray,
    full_size: float,
) -> float:
    """Return how much of a full mode lies in the span of its reduced partners."""
    if not mine.size:
        return 0.0
    if mine.size == 1:
        return float(alike[mine[0]])
    gram = shapes[:, mine].T @ weighted[:, mine]
    part = weighted[:, mine].T @ phi
    share = la.solve(gram, part, assume_a="sym")
    return float(np.real(np.conj(part) @ share)) / full_size


def _grid(low: float, high: float, resonances: FloatArray, small: bool) -> FloatArray:
    which = 0 if small else 1
    start = low if low > 0 else high / 1000
    grid = np.geomspace(start, high, _GRID[which])
    few = resonances
    if few.size > _RESONANCES[which]:
        few = few[np.linspace(0, few.size - 1, _RESONANCES[which]).astype(int)]
    return np.concatenate([grid, few])


def _full_response(
    full: FEModel | Modes, modes: Modes, freq: FloatArray, B: FloatArray, C: FloatArray, loss: float
) -> tuple[ComplexArray, str]:
    """Return responses (f, p, q) of the full structure, and how they were found."""
    found = np.zeros((freq.size, C.shape[0], B.shape[1]), dtype=np.complex128)
    if not B.shape[1]:
        return found, "no response: no inputs were named"
    if isinstance(full, Modes):
        return _modal_response(full, freq, B, C), "the sum over the given modes"
    M, K, D = full.M, full.K, full.D
    many = len(full.dofs) > _SMALL and sp.issparse(K) and sp.issparse(M)
    for i, f in enumerate(freq):
        omega = 2 * np.pi * float(f)
        stiffness: Any = K * (1 + 1j * loss) if D is None else K + 1j * omega * _as_like(D, K)
        found[i] = C @ _solved(stiffness - omega**2 * M, B, many)
    kind = "sparse" if many else "dense"
    how = "its D" if D is not None else f"loss factor {loss:.3g} in both"
    return found, f"{kind} solutions at {freq.size} frequencies, {how}"


def _as_like(D: Matrix, K: Matrix) -> Any:
    return D if sp.issparse(K) == sp.issparse(D) else (dense(D) if not sp.issparse(K) else D)


def _solved(matrix: Any, B: FloatArray, many: bool) -> ComplexArray:
    is_sparse = sp.issparse(matrix)
    if many and is_sparse:
        lu = lu_of(matrix)
        loads = B.astype(np.complex128)
        solved = lu.solve(loads)
        return np.asarray(solved + lu.solve(loads - matrix @ solved))
    full = matrix.toarray() if is_sparse else np.asarray(matrix)
    size = 1.0 / np.sqrt(np.abs(np.diag(full)))
    scaled = full * size[:, None] * size
    return np.asarray(la.solve(scaled, B * size[:, None]) * size[:, None], dtype=np.complex128)


def _modal_response(modes: Modes, freq: FloatArray, B: FloatArray, C: FloatArray) -> ComplexArray:
    s = 2j * np.pi * freq[:, None]
    if np.iscomplexobj(modes.phi):
        r = modes.n_rigid
        poles = np.asarray(modes.poles)
        phi = np.asarray(modes.phi)
        swing = np.where(poles.imag > 0, poles.imag, 1.0)
        one = np.where(np.arange(poles.size) < r, 1 / s**2, 1 / (2j * swing * (s - poles)))
        two = np.where(np.arange(poles.size) < r, 0.0, 1 / (-2j * swing * (s - poles.conj())))
        total = np.einsum("pk,fk,kq->fpq", C @ phi, one, phi.T @ B)
        total = total + np.einsum("pk,fk,kq->fpq", C @ phi.conj(), two, phi.conj().T @ B)
        return np.asarray(total, dtype=np.complex128)
    omega, zeta = modes.basis_omega, modes.basis_zeta
    gain = 1.0 / (omega**2 + 2 * zeta * omega * s + s**2)
    basis = np.real(modes.basis)
    return np.asarray(np.einsum("pk,fk,kq->fpq", C @ basis, gain, basis.T @ B))


def _reduced_response(
    reduced: ReducedModel, freq: FloatArray, B: FloatArray, C: FloatArray, loss: float | None
) -> ComplexArray:
    omega = 2 * np.pi * freq[:, None, None]
    if not B.shape[1]:
        return np.zeros((freq.size, C.shape[0], 0), dtype=np.complex128)
    stiffness: Any = reduced.K * (1 + 1j * loss) if loss is not None else reduced.K
    damping = 0.0 if loss is not None else 1j * omega * reduced.D
    size = 1.0 / np.sqrt(np.abs(np.diag(reduced.K)) + np.abs(np.diag(reduced.M)))
    matrix = (stiffness + damping - omega**2 * reduced.M) * size[:, None] * size
    return np.asarray((C * size) @ np.linalg.solve(matrix, (B * size[:, None])[None]))


def _static_error(
    full: FEModel | Modes,
    modes: Modes,
    reduced: ReducedModel,
    B: FloatArray,
    C: FloatArray,
    Br: FloatArray,
    Cr: FloatArray,
) -> FloatArray:
    """Return errors (p, q) of the elastic compliance, of the size of its channels."""
    p, q = C.shape[0], B.shape[1]
    if not q:
        return np.zeros((p, q))
    loads, watched = np.hstack([B, C.T]), np.hstack([Br, Cr.T])
    if isinstance(full, FEModel):
        whole_set = loads.T @ static_response(full.M, full.K, full.rigid_body, loads)
    else:
        if np.iscomplexobj(full.phi):
            return np.full((p, q), np.nan)
        r = modes.n_rigid
        motion = (loads.T @ np.real(full.basis))[:, r:] / full.basis_omega[r:]
        whole_set = motion @ motion.T
    found = watched.T @ static_response(reduced.M, reduced.K, reduced.rigid_body, watched)
    size = np.sqrt(np.abs(np.diag(whole_set)))
    return np.asarray(np.abs(found - whole_set)[q:, :q] / np.outer(size[q:], size[:q]))
