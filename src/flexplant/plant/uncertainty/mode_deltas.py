"""Deltas of modes whose uncertainty is stated, or judged from a fit and its measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from ...checks import ComplexArray, FloatArray, real_array
from ...errors import ModelError, require_known, unknown_label
from ...updating import ModalUncertainty
from ..realisation import ModalRealisation
from .uncertain_plant import Delta

#: relative standard deviations below this open no channel
KNOWN = 1e-12
#: largest relative uncertainty of a damping: an interval reaches farther above than below, where
#: it ends at zero
_DAMPING = 0.99
#: relative distance of poles of one model
SAME_MODEL = 1e-6


def correlated_deltas(
    realisation: ModalRealisation,
    source: ModalUncertainty,
    modes: Sequence[int] | None,
    deviations: float,
) -> tuple[tuple[Delta, ...], FloatArray]:
    """Return Deltas of modes as uncertain as they are, correlated, half-widths two deviations."""
    elastic = range(realisation.n_rigid + 1, realisation.n_modes + 1)
    chosen = [number for number in source.modes if number in elastic] if modes is None else modes
    for number in chosen:
        if number not in source.modes:
            raise unknown_label("elastic mode", number, map(str, source.modes))
    at = np.array([source.modes.index(number) for number in chosen], dtype=np.int64)
    check_poles(realisation, tuple(chosen), source.poles[at], SAME_MODEL, "fit")
    both = np.stack([at, at + len(source.modes)], axis=1).ravel()
    scale = 0.5 * deviations * source.share[both]
    scale[::2] *= 2.0  # stiffness is omega^2
    scale[1::2] = np.minimum(scale[1::2], _DAMPING)
    kinds: tuple[Literal["freq", "damping"], ...] = ("freq", "damping")
    names = [(number, kind) for number in chosen for kind in kinds]
    deltas = tuple(
        Delta(f"mode{number}:{kind}", number, kind, float(size))
        for (number, kind), size in zip(names, scale, strict=True)
    )
    size = np.sqrt(np.diag(source.covariance)[both])
    own = source.covariance[np.ix_(both, both)] / np.outer(size, size)
    return deltas, own / deviations**2


def stated(
    realisation: ModalRealisation, frequency: Any, damping: Any, modes: Sequence[int] | None
) -> tuple[Delta, ...]:
    """Return Deltas of stated relative uncertainties of frequency and damping, mode by mode."""
    elastic = range(realisation.n_rigid + 1, realisation.n_modes + 1)
    # negative stiffness, as of magnets, is no frequency; its modes are uncertain by name only
    swing = [n for n in elastic if np.linalg.det(realisation.pairs[n - 1]) > 0]
    chosen = tuple(swing if modes is None else modes)
    for number in chosen:
        if number not in elastic:
            raise unknown_label("elastic mode of the plant", number, map(str, elastic))
    sizes = {
        kind: _by_mode(given, f"{name} of a mode", chosen)
        for kind, name, given in (("freq", "frequency", frequency), ("damping", "damping", damping))
    }
    # stiffness is omega^2
    scales = {"freq": 2.0 * sizes["freq"], "damping": sizes["damping"]}
    kinds: tuple[Literal["freq", "damping"], ...] = ("freq", "damping")
    deltas = [
        Delta(f"mode{number}:{kind}", number, kind, float(scales[kind][i]))
        for i, number in enumerate(chosen)
        for kind in kinds
        if scales[kind][i] > KNOWN
    ]
    if not deltas:
        raise ModelError("frequency= and damping= are zero: there is nothing uncertain.")
    return tuple(deltas)


def _by_mode(given: Any, name: str, modes: Sequence[int]) -> FloatArray:
    """Return a number for each mode: of one for all, an array, or {mode: number}."""
    if given is None:
        return np.zeros(len(modes))
    if isinstance(given, Mapping):
        require_known("uncertain mode", map(str, given), map(str, modes))
        given = [given.get(number, 0.0) for number in modes]
    values = real_array(given, name)
    values = real_array(values if values.ndim else np.full(len(modes), values), name, (len(modes),))
    if np.any(values < 0):
        raise ModelError(
            f"the {name} is uncertain by a share of it, 0 or more, got {values.min()}."
        )
    return values


def check_poles(
    realisation: ModalRealisation,
    modes: Sequence[int],
    poles: ComplexArray,
    limit: float,
    name: str,
) -> None:
    """Refuse a plant without the modes that are uncertain."""
    count = realisation.n_modes
    for number, pole in zip(modes, poles, strict=True):
        if not realisation.n_rigid < number <= count:
            known = range(realisation.n_rigid + 1, count + 1)
            raise unknown_label("elastic mode of the plant", number, map(str, known))
        own = np.linalg.eigvals(realisation.pairs[number - 1])
        off = np.min(np.abs(own - pole)) / abs(pole)
        if off > limit:
            raise ModelError(
                f"mode {number} has the pole {pole:.6g} in the {name} and {own[0]:.6g} in the "
                "plant: they are "
                "not of the same model. Assemble the plant from fit.model."
            )
