"""What is checked after every synthesis: stability, and the norm by two routes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..certificates import stability, stability_name
from ..errors import CertificateError
from ..lti.norms import peak_gain
from ..lti.responses import Responder, responder
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..values import ComplexArray, FloatArray

#: the two norms agree to this part, and the claim holds to it
AGREEMENT = 1e-3


def certified_norm(
    loop: StateSpace, claim: float, respond: Responder | None = None
) -> dict[str, float]:
    """Return what was verified of a closed loop: its norm by two routes, and its stability."""
    least = stability(loop.poles(), loop.dt)
    if not least < (1.0 if loop.dt else 0.0):
        raise CertificateError(
            f"the closed loop is not stable ({stability_name(loop.dt)} {least:.6g}): the "
            "controller is refused. "
            "Is the sign of the feedback u = K y right, and is it the plant that it was made for?"
        )
    norm, _ = peak_gain(loop)
    swept = swept_norm(loop, respond)
    if not abs(norm - swept) <= AGREEMENT * norm:
        raise CertificateError(
            f"two routes to the norm disagree: {norm:.6g} with proof, {swept:.6g} by a sweep. "
            "The loop is too badly conditioned to trust; loosen the weights."
        )
    if norm > claim * (1.0 + AGREEMENT):
        raise CertificateError(
            f"the closed loop has the norm {norm:.6g}, but {claim:.6g} was claimed: "
            "the controller is refused."
        )
    return {"norm": norm, "swept norm": swept, stability_name(loop.dt): least, "claim": claim}


def reached_norms(P: StandardPlant, loop: StateSpace, respond: Responder) -> dict[str, float]:
    """Return the largest gain of a loop from each group of w to each group of z, by a sweep.

    The groups follow from the names that `assemble_plant` gives: of w `references` (die:ref),
    `noises` (y1:noise) and `disturbances`, of z `efforts` (u1:effort) and `motions`. Empty for a
    plant that was not assembled from a structure.
    """
    if not P.is_assembled:
        return {}
    gain = respond(_sweep(loop))
    w = {"references": ":ref", "noises": ":noise"}
    sides = [_grouped(P.z, {"efforts": ":effort"}, "motions"), _grouped(P.w, w, "disturbances")]
    return {
        f"{to} from {source}": _peak(gain[rows][:, columns])[0]
        for to, rows in sides[0].items()
        for source, columns in sides[1].items()
    }


def _grouped(names: Sequence[str], endings: Mapping[str, str], rest: str) -> dict[str, list[int]]:
    """Return the places of names by group, from their endings; empty groups left out."""
    groups: dict[str, list[int]] = {rest: [], **{group: [] for group in endings}}
    for i, name in enumerate(names):
        own = next((group for group, end in endings.items() if name.endswith(end)), rest)
        groups[own].append(i)
    return {group: places for group, places in groups.items() if places}


def swept_norm(loop: StateSpace, respond: Responder | None = None) -> float:
    """Return the largest gain over a grid that is refined at resonances and at its own peak."""
    if not loop.D.size:
        return 0.0
    if not loop.n_states:
        return float(np.linalg.norm(loop.D, 2))
    find, freq = respond or responder(loop), _sweep(loop)
    best = float(np.linalg.norm(loop.D, 2)) if not loop.dt else 0.0
    for _ in range(3):
        largest, peak = _peak(find(freq))
        best = max(best, largest)
        bracket = freq[max(peak - 1, 0)], freq[min(peak + 1, freq.size - 1)]
        freq = np.linspace(*bracket, 40)
    return best


def _sweep(loop: StateSpace) -> FloatArray:
    """Return frequencies [Hz] from 0 up, dense around the resonances of a loop with states."""
    poles = loop.poles()
    if loop.dt:
        poles = np.asarray(np.log(np.where(np.abs(poles) > 0, poles, 1e-300)) / loop.dt)
    nyquist = 0.5 / loop.dt if loop.dt else np.inf
    speeds = np.abs(poles.imag[np.abs(poles.imag) > 0]) / (2 * np.pi)
    sizes = np.abs(poles) / (2 * np.pi)
    low, high = (
        (0.01 * float(sizes[sizes > 0].min()), min(100.0 * float(sizes.max()), nyquist))
        if np.any(sizes > 0)
        else (1e-3, min(1e3, nyquist))
    )
    width = np.abs(poles.real[np.abs(poles.imag) > 0]) / (2 * np.pi)
    offsets = np.concatenate([[0.0], np.geomspace(0.05, 20.0, 24)])
    near = (speeds[:, None] + width[:, None] * np.concatenate([-offsets, offsets])).ravel()
    freq = np.concatenate([[0.0], np.geomspace(min(low, 0.5 * high), high, 600), near])
    return np.asarray(np.unique(freq[(freq >= 0) & (freq <= nyquist)]))


def _peak(H: ComplexArray) -> tuple[float, int]:
    """Return the largest singular value of responses (p, m, n_freq), and at which frequency.

    It lies between the Frobenius norm over the root of the rank and the Frobenius norm: where the
    latter is too small there is nothing to compute.
    """
    size = np.sqrt(np.sum(H.real**2 + H.imag**2, axis=(0, 1)))
    near = np.flatnonzero(size >= size.max() * (1.0 - 1e-12) / np.sqrt(min(H.shape[:2])))
    gains = np.linalg.norm(np.moveaxis(H[:, :, near], 2, 0), 2, axis=(1, 2))
    largest = int(np.argmax(gains))
    return float(gains[largest]), int(near[largest])
