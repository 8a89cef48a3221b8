"""Covariance of the poles of a plant's modes, from a fit or from a measurement."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...errors import LabelError, ModelError, unknown_label
from ...identification import MeasuredModes
from ...updating import UpdateResult, eigenvalue_sensitivities
from ...updating.parameters.added import Parameter
from ...values import ComplexArray, FloatArray
from ..realisation import ModalRealisation
from .delta import Delta


def fitted_poles(
    realisation: ModalRealisation,
    fit: UpdateResult,
    parameters: Sequence[Parameter] | None,
    modes: Sequence[int] | None,
) -> tuple[tuple[int, ...], ComplexArray, FloatArray]:
    """Return mode numbers, poles and J C J', the covariance of [Re lambda; Im lambda]."""
    names = tuple(parameter.name for parameter in parameters or ())
    if names != tuple(fit.parameters):
        raise LabelError(
            f"the fit is of {list(fit.parameters)}, got the parameters {list(names)}: pass those "
            "given to update, in the same order: plant.uncertain(fit, parameters)."
        )
    if fit.covariance is None:
        raise ModelError(
            "the fit has no covariance: as many numbers were measured as were fitted. Measure "
            "another mode, or give MeasuredModes(covariance=...)."
        )
    elastic = range(realisation.n_rigid + 1, realisation.n_modes + 1)
    chosen = list(elastic if modes is None else modes)
    found = eigenvalue_sensitivities(fit.model, list(parameters or ()), modes=chosen)
    J = np.vstack([found.S.real, found.S.imag])
    return found.modes, found.poles, J @ fit.covariance @ J.T


def measured_poles(
    measured: MeasuredModes, modes: Sequence[int] | None
) -> tuple[tuple[int, ...], ComplexArray, FloatArray]:
    """Return mode numbers, poles and the covariance of [Re lambda; Im lambda], as measured."""
    if measured.covariance is None or measured.modes is None:
        raise ModelError(
            "the measured modes need mode numbers and a covariance: "
            "MeasuredModes(poles, modes=[...], covariance=...)."
        )
    chosen = list(measured.modes if modes is None else modes)
    for number in chosen:
        if number not in measured.modes:
            raise unknown_label("measured mode", number, map(str, measured.modes))
    at = [measured.modes.index(number) for number in chosen]
    both = [*at, *(i + len(measured) for i in at)]
    return tuple(chosen), measured.poles[at], measured.covariance[np.ix_(both, both)]


def relative(poles: ComplexArray) -> FloatArray:
    """Return the derivatives of [log omega^2; log 2 zeta omega] to [Re lambda; Im lambda]."""
    size = np.abs(poles) ** 2
    damped = np.where(poles.real != 0, poles.real, np.inf)
    zero = np.zeros((poles.size, poles.size))
    return np.block(
        [
            [np.diag(2 * poles.real / size), np.diag(2 * poles.imag / size)],
            [np.diag(1 / damped), zero],
        ]
    )


def check_poles(
    realisation: ModalRealisation, modes: Sequence[int], poles: ComplexArray, strict: bool
) -> None:
    """Refuse a plant that has not the modes that the doubt is about."""
    count = realisation.n_modes
    for number, pole in zip(modes, poles, strict=True):
        if not realisation.n_rigid < number <= count:
            known = range(realisation.n_rigid + 1, count + 1)
            raise unknown_label("elastic mode of the plant", number, map(str, known))
        own = np.linalg.eigvals(realisation.pairs[number - 1])
        off = np.min(np.abs(own - pole)) / abs(pole)
        if off > (1e-6 if strict else 0.1):
            raise ModelError(
                f"mode {number} has the pole {pole:.6g} in the "
                f"{'fit' if strict else 'measurement'} and {own[0]:.6g} in the plant: they are "
                "not of the same model. Assemble the plant from fit.model."
            )


def check_range(deltas: Sequence[Delta], deviations: float) -> None:
    """Refuse Deltas that reach negative stiffness or damping."""
    for delta in deltas:
        if delta.scale >= 1:
            what = "stiffness" if delta.kind == "freq" else "damping"
            raise ModelError(
                f"the {what} of mode {delta.mode} is doubted by {100 * delta.scale:.3g} % at "
                f"{deviations:g} standard deviations, so it may be negative: no controller is "
                "robust to that. Measure it better, leave the mode out, or lower deviations."
            )
