"""A reduced model beside the full one: modes, responses and static compliance compared."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import ModelError
from ..labels import Place
from ..lti.grid import climbed
from ..modes.attachment_vectors import labels_of, places
from ..modes.modes import Modes
from ..modes.shifted import held_factor
from ..modes.solve import modes_reaching
from ..structure import FEModel
from ..values import ComplexArray, FloatArray, positive, real_array, whole
from .check_responses import (
    FullResponses,
    Reduced,
    check_frequencies,
    reduced_response,
    static_error,
)
from .mode_pairs import paired
from .quality import ReductionQuality

#: refinements of the frequencies at which the error is largest
_ROUNDS = 3


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
    own = _undamped_modes(reduced)
    modes = _full_modes(full, count, high)
    B, C = _rows(full, pushed).T, _rows(full, watched)
    Br, Cr = reduced.T.T @ B, C @ reduced.T
    undamped = full.D is None if isinstance(full, FEModel) else not np.any(full.basis_zeta)
    factor = _loss(reduced, own, loss) if undamped else None
    # one factor for the static shapes and the check, while it is held here
    held = held_factor(full) if isinstance(full, FEModel) else None
    responses = FullResponses(full, modes, B, C, factor)

    def less(at: FloatArray) -> ComplexArray:
        return reduced_response(reduced, at, Br, Cr, factor)

    both = [(responses.at, modes), (less, own)]
    elastic = [(find, one.freq[one.n_rigid :]) for find, one in both]
    grid, peaks, deep = check_frequencies(low, high, elastic)
    grid = np.unique(np.atleast_1d(grid if freq is None else real_array(freq, "freq")))
    if not grid.size or grid[0] < 0:
        raise ModelError("freq needs at least one frequency [Hz], none below 0.")
    responses.checked(grid)
    del held
    if freq is None and B.shape[1] and C.shape[0]:
        size = np.abs(responses.at(grid)).max(axis=0)
        size[size == 0] = 1.0
        # between resonances of both the error may be larger than at either
        grid, _ = climbed(
            lambda at: (np.abs(responses.at(at) - less(at)) / size).max(axis=(1, 2)), grid, _ROUNDS
        )
    whole_response, found = responses.at(grid), less(grid)
    gap, size = np.abs(found - whole_response), np.abs(whole_response)
    larger = np.maximum(size, np.abs(found))
    with np.errstate(invalid="ignore", divide="ignore"):
        frf = gap.max(axis=0) / size.max(axis=0)
        # of the largest response there: a mode on a node line makes no resonance of that pair
        at_peaks = gap / larger.max(axis=(1, 2), keepdims=True, initial=0.0)
        at_dips = gap / larger
    bound = reduced.bound
    if bound is not None and (bound.inputs, bound.outputs) != (
        labels_of(pushed, full.dofs),
        labels_of(watched, full.dofs),
    ):
        bound = None
    return ReductionQuality(
        **_compared(full, modes, own, count, high),
        check_freq=grid,
        frf_error=frf,
        resonance_error=_largest(at_peaks, np.isin(grid, peaks)),
        antiresonance_error=_largest(at_dips, np.isin(grid, deep)),
        static_error=static_error(responses.static(), reduced, Br, Cr),
        true_error=float(np.linalg.norm(found - whole_response, 2, axis=(1, 2)).max(initial=0.0))
        if gap.size
        else 0.0,
        condition=reduced.condition,
        inputs=labels_of(pushed, full.dofs),
        outputs=labels_of(watched, full.dofs),
        full_error=np.nan if responses.check is None else responses.check.worst,
        route=str(responses),
        bound=bound,
        bounded=bound is not None
        and (bound.covers is None or (isinstance(full, Modes) and full.n_modes <= bound.covers)),
    )


def _largest(error: FloatArray, chosen: Any) -> FloatArray:
    """Return the largest of errors (f, p, q) over the chosen frequencies, NaN where none is."""
    if not chosen.any():
        return np.full(error.shape[1:], np.nan)
    return np.asarray(error[chosen].max(axis=0))


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


def _loss(reduced: Reduced, own: Modes, loss: float | None) -> float:
    if loss is not None:
        return positive(loss, "loss", zero=True)
    if not np.any(reduced.D):
        return 0.01
    # 2 zeta = phi^T D phi / omega, mode by mode: dampers to ground leave no modes at 0
    shapes = np.linalg.lstsq(reduced.T, np.real(own.phi), rcond=None)[0]
    rates = np.einsum("ik,ij,jk->k", shapes, reduced.D, shapes)[own.n_rigid :]
    return float(np.mean(rates / own.omega[own.n_rigid :]))


def _full_modes(full: FEModel | Modes, count: int | None, high: float) -> Modes:
    if isinstance(full, Modes):
        return full
    number = 0 if count is None else whole(count, "count", maximum=full.n_dof)
    return modes_reaching(full, high, least=number)


def _compared(
    full: FEModel | Modes, modes: Modes, found: Modes, count: int | None, high: float
) -> dict[str, Any]:
    """Return the pairs of full and reduced modes, and how alike they are."""
    wanted = whole(count, "count") if count is not None else int(np.sum(modes.freq <= high))
    phi: Any = np.asarray(modes.phi)[:, :wanted]
    f = modes.freq[:wanted]
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
