"""What an update or a measurement leaves open: Deltas with the covariance of the estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ...arrays import ComplexArray, FloatArray, members, positive, several
from ...errors import LabelError, ModelError, require_known, short
from ...identification import MeasuredModes
from ...modes.matching import NEAR, assigned
from ...sparse.symmetric import dense
from ...tolerances import CLOSE, DEVIATIONS, ROUNDING, SAME, TYPED
from ...updating import Machines, ModalUncertainty, UpdateResult, eigenvalue_sensitivities
from ...updating.parameters import Parameter
from ..partitioned import Partition
from ..realisation import ModalRealisation
from .delta import Known, Uncertainty
from .mode_delta import DampingDelta, FrequencyDelta, ModeDelta, require_elastic
from .parameter_amounts import ParameterDelta


@dataclass(frozen=True, eq=False)
class Fit(Uncertainty):
    """Remaining uncertainty of frequencies and dampings after a fit or a measurement of modes.

    An `UpdateResult`, `ModalUncertainty` or `MeasuredModes` that is passed directly to
    ``plant.uncertain`` is understood as ``Fit(source)``. If C is the covariance of the parameters,
    and J contains the sensitivities of the eigenvalues to the parameters, the covariance of the
    modes is ``J C J'``. The stiffness and the damping of each mode become the Deltas `mode6:freq`,
    `mode6:damping`. If damping couples the modes (a large damper to ground, an overdamped pair),
    the parameters of the fit themselves are the Deltas, and they act on all modes and mode shapes.
    The machines ``plant.machines``, which are drawn at random, differ in the parameters. Machines
    of a calibrated plant (one that has the measured poles) differ in their modes instead.

    Parameters
    ----------
    source : UpdateResult, ModalUncertainty or MeasuredModes
        One of three sources. The first is a fit; the plant must have been assembled from the
        `model` of this fit, or from the model with measured poles, `fit.calibrated(measured)`. For
        such a calibrated plant, and for a fit with a discrepancy (an estimated error of the model
        itself), the `uncertainty` of the fit is used in its place. A mode may then differ by two
        standard deviations. The second is the uncertainty of a calibrated model,
        ``fit.uncertainty(measured)``. The third is a set of measured poles with mode numbers and a
        covariance.
    modes : sequence of int, optional
        Numbers of the modes, counted from 1 with the rigid-body modes included. By default all
        elastic modes, or all measured ones.
    parameters : sequence of Parameter, optional
        Parameters given to `update`, in the same order; by default those that the fit stores.
    deviations : float
        Number of standard deviations at which a delta is 1.

    Raises
    ------
    LabelError
        When parameters are not those of the fit, or a mode is unknown.
    ModelError
        When the covariance is missing, the fit is of another model than the plant, or the
        uncertainty covers negative stiffness or damping.

    Examples
    --------
    >>> import flexplant as fx
    >>> measured = fx.MeasuredModes(poles=[-6.3 + 632.4j], modes=[2], covariance=[1.0])
    >>> fx.testbeds.three_masses().uncertain(fx.plant.Fit(measured, deviations=3.0))
    <UncertainPlant: 2 real Deltas at 3 std
      mode2:freq +- 0.335 %
      mode2:damping +- 33.7 %>
    """

    source: UpdateResult | ModalUncertainty | MeasuredModes | Machines
    modes: Sequence[int] | None = field(default=None, kw_only=True)
    parameters: Sequence[Parameter] | None = field(default=None, kw_only=True)
    deviations: float = field(default=DEVIATIONS, kw_only=True)

    def __post_init__(self) -> None:
        given: Any = self.source
        if not isinstance(given, UpdateResult | ModalUncertainty | MeasuredModes | Machines):
            raise ModelError(
                "uncertainty comes from an UpdateResult, ModalUncertainty or MeasuredModes, got "
                f"{short(given)}: pass one, fit.uncertainty(measured), or state it: "
                "plant.Frequencies(0.005), plant.Dampings(0.3)."
            )
        if several(self.modes) and not len(tuple(self.modes or ())):
            raise ModelError("modes is empty: nothing would be uncertain. Name some, or none.")
        about = self.parameters
        if about is not None:
            about = members(about, Parameter, "parameters", "Pass those of the fit.", least=0)
        self._set(deviations=positive(self.deviations, "deviations"), parameters=about)

    def known(self, plant: Partition) -> Known:
        """Return the Deltas of the modes; if damping couples the modes, those of the parameters."""
        source = self.source
        if isinstance(source, Machines):
            source = source.fit
        if isinstance(source, UpdateResult):
            calibration = _calibration_of(plant)
            if plant.form.startswith("dense"):
                return self._of_parameters(plant, source, calibration)
            if calibration is None and not (source.discrepancy and source.fitted_poles):
                return self._of_fit(plant.assembled.realisation.uncoupled, source)
            source = source.uncertainty(calibration)
        realisation = plant.assembled.realisation.uncoupled
        if isinstance(source, ModalUncertainty):
            return self._of_shares(realisation, source)
        return self._of_poles(realisation, _measured_poles(source, self.modes), "measurement")

    def _of_shares(self, realisation: ModalRealisation, source: ModalUncertainty) -> Known:
        """Return Deltas of modes as uncertain as they are, correlated; two deviations are 1."""
        numbers = _renumbered(realisation, source)
        known = [number for number in numbers if number]
        chosen = tuple(sorted(known) if self.modes is None else self.modes)
        require_known("elastic mode", chosen, known)
        at = np.array([numbers.index(number) for number in chosen], dtype=np.int64)
        _check_poles(realisation, chosen, source.poles[at], TYPED, "fit")
        both = np.stack([at, at + len(numbers)], axis=1).ravel()
        scale = self.deviations / DEVIATIONS * source.share[both]
        scale[::2] *= 2.0  # stiffness is omega^2
        # an interval of a damping reaches farther above than below, where it ends at zero
        scale[1::2] = np.minimum(scale[1::2], 1.0 - CLOSE)
        every = _of_modes(chosen, scale)
        keep = np.flatnonzero([delta.acts(realisation) for delta in every])
        covariance = source.covariance[np.ix_(both[keep], both[keep])]
        size = self.deviations * np.sqrt(np.diag(covariance))
        return Known(tuple(every[i] for i in keep), covariance / np.outer(size, size))

    def _of_fit(self, realisation: ModalRealisation, fit: UpdateResult) -> Known:
        """Return Deltas of the poles of a fit's model, ``J C J'``; machines by its parameters."""
        about, covariance = self._about(fit)
        chosen = list(realisation.elastic) if self.modes is None else self.modes
        found = eigenvalue_sensitivities(fit.model, about, modes=chosen)
        J = np.vstack([found.S.real, found.S.imag])
        poles = _Poles(found.modes, found.poles, J @ covariance @ J.T)
        known = self._of_poles(realisation, poles, "fit")
        drawn = tuple(ParameterDelta(q.name, 1.0, parameter=q, model=fit.model) for q in about)
        return known._replace(drawn=drawn, drawn_covariance=covariance)

    def _of_poles(self, realisation: ModalRealisation, poles: _Poles, name: str) -> Known:
        """Return Deltas of poles that are known, with their covariance."""
        limit = TYPED if name == "fit" else NEAR
        _check_poles(realisation, poles.modes, poles.values, limit, name)
        G = _log_derivatives(poles.values)
        covariance = G @ poles.covariance @ G.T
        rising = np.argsort(poles.modes, kind="stable")
        order = np.stack([rising, rising + rising.size], axis=1).ravel()  # mode by mode
        scale = self.deviations * np.sqrt(np.diag(covariance))[order]
        every = _of_modes([poles.modes[i] for i in rising], scale)
        keep = np.flatnonzero(scale > ROUNDING)
        if not keep.size:
            raise ModelError(
                f"modes {list(poles.modes)} have no variance: there is nothing uncertain."
            )
        own = covariance[np.ix_(order[keep], order[keep])] / np.outer(scale[keep], scale[keep])
        return Known(tuple(every[i] for i in keep), own)

    def _of_parameters(self, plant: Partition, fit: UpdateResult, calibration: Any) -> Known:
        """Return Deltas of the fit's parameters, on a plant whose damping couples the modes."""
        about, covariance = self._about(fit)
        if self.modes is not None:
            raise ModelError(
                f"the modes of this plant are coupled by damping ({plant.form}): its Deltas are "
                "the parameters of the fit, which act on all modes. Leave modes out."
            )
        _check_model(plant, fit.model if calibration is None else fit.calibrated(calibration))
        std = np.sqrt(np.diag(covariance))
        deltas = tuple(
            ParameterDelta(q.name, float(size), parameter=q)
            for q, size in zip(about, self.deviations * std, strict=True)
        )
        return Known(deltas, covariance / np.outer(std, std) / self.deviations**2)

    def _about(self, fit: UpdateResult) -> tuple[tuple[Parameter, ...], FloatArray]:
        """Return the fit's parameters, counted from their estimates, and their covariance."""
        given = tuple(fit.unknowns if self.parameters is None else self.parameters)
        names = tuple(parameter.name for parameter in given)
        if names != tuple(fit.parameters):
            raise LabelError(
                f"the fit is of {list(fit.parameters)}, got the parameters {list(names)}: pass "
                "those given to update, in the same order: plant.Fit(fit, parameters=[...])."
            )
        if fit.covariance is None:
            raise ModelError(
                "the fit has no covariance: as many numbers were measured as were fitted. Measure "
                "another mode, or give MeasuredModes(covariance=...)."
            )
        about = tuple(q.about(v) for q, v in zip(given, fit.values.tolist(), strict=True))
        return about, fit.covariance


class _Poles(NamedTuple):
    """Mode numbers, poles, and the covariance of [Re lambda; Im lambda]."""

    modes: tuple[int, ...]
    values: ComplexArray
    covariance: FloatArray


def _of_modes(numbers: Sequence[int], scales: FloatArray) -> list[ModeDelta]:
    """Return Deltas of stiffness and damping by relative scales (2 m,), mode by mode."""
    named = [(kind, number) for number in numbers for kind in (FrequencyDelta, DampingDelta)]
    return [kind.of(n, float(x)) for (kind, n), x in zip(named, scales, strict=True)]


def _measured_poles(measured: MeasuredModes, modes: Sequence[int] | None) -> _Poles:
    """Return the poles of modes as measured."""
    if measured.covariance is None or measured.modes is None:
        raise ModelError(
            "the measured modes need mode numbers and a covariance: "
            "MeasuredModes(poles, modes=[...], covariance=...)."
        )
    chosen = tuple(measured.modes if modes is None else modes)
    require_known("measured mode", chosen, measured.modes)
    at = [measured.modes.index(number) for number in chosen]
    both = [*at, *(i + len(measured) for i in at)]
    return _Poles(chosen, measured.poles[at], measured.covariance[np.ix_(both, both)])


def _log_derivatives(poles: ComplexArray) -> FloatArray:
    """Return the derivatives of [log omega^2; log 2 zeta omega] to [Re lambda; Im lambda]."""
    size = np.abs(poles) ** 2
    damped = np.where(poles.real != 0, poles.real, np.inf)
    return np.block([
        [np.diag(2 * poles.real / size), np.diag(2 * poles.imag / size)],
        [np.diag(1 / damped), np.zeros((poles.size, poles.size))],
    ])  # fmt: skip


def _renumbered(realisation: ModalRealisation, source: ModalUncertainty) -> list[int]:
    """Return the number in the plant of each mode of a source, 0 where the plant lacks it."""
    # calibration puts modes in another order where measured frequencies cross
    elastic = list(realisation.elastic)
    own = np.linalg.eigvals(realisation.pairs[[number - 1 for number in elastic]])
    size = np.abs(source.poles)
    gap = np.abs(size[:, None, None] - np.abs(own)).min(axis=2) / size[:, None]
    same = np.equal.outer(source.modes, elastic)
    found = assigned(gap + np.where(same, 0.0, TYPED))
    return [elastic[i] if i >= 0 else 0 for i in found.tolist()]


def _calibration_of(plant: Partition) -> Any:
    """Return the measured poles that the plant was calibrated with, None without any."""
    found = getattr(plant.model, "calibration", None)
    if found is None:
        return None
    own = np.linalg.eigvals(plant.assembled.realisation.A)
    poles = found.poles[np.abs(found.poles) <= (1.0 + TYPED) * np.abs(own).max()]
    gap = np.abs(poles[:, None] - own).min(axis=1)
    # a model that was updated after it was calibrated has other poles
    return found if np.all(gap <= TYPED * np.abs(poles)) else None


def _check_poles(
    realisation: ModalRealisation,
    modes: Sequence[int],
    poles: ComplexArray,
    limit: float,
    name: str,
) -> None:
    """Refuse a plant without the modes that are uncertain."""
    require_elastic(realisation, modes)
    for number, pole in zip(modes, poles, strict=True):
        own = np.linalg.eigvals(realisation.pairs[number - 1])
        # by frequency: the plant may have damping where the model that was fitted has none
        if np.min(np.abs(np.abs(own) - abs(pole))) > limit * abs(pole):
            raise ModelError(
                f"mode {number} has the pole {pole:.6g} in the {name} and {own[0]:.6g} in the "
                "plant: they are not of the same model. Assemble the plant from fit.model, or "
                "from fit.calibrated(measured)."
            )


def _check_model(plant: Partition, other: Any) -> None:
    """Refuse a fit of another model than the plant's."""
    for name in "MDK":
        own, others = getattr(plant.model, name, None), getattr(other, name)
        if own is None or own.shape != others.shape or not np.allclose(
            dense(own), dense(others), rtol=SAME, atol=0.0
        ):  # fmt: skip
            raise ModelError(
                f"the plant has another {name} than the fit's model. Assemble it from fit.model."
            )
