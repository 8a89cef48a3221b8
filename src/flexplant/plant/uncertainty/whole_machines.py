"""Machines drawn with the modes that the plant left out: frequencies, damping and shapes off."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...checks import FloatArray
from ..building import rebuilt
from ..realisation import ModalRealisation
from ..standard import StandardPlant
from .uncertain_plant import Delta, UncertainPlant, changed_modes, modal_realisation

#: kinds of Deltas that say the same of the modes of a larger plant
_OF_MODES = ("freq", "damping")


def draws_with_left_out(
    uncertain: UncertainPlant[StandardPlant],
    whole: StandardPlant,
    rng: np.random.Generator,
    count: int,
    *,
    shapes: float = 0.0,
) -> Iterator[StandardPlant] | None:
    """Return machines of a larger plant, drawn one by one; None where no Delta is of its modes.

    The plant's own modes are off as its Deltas say, normally with 1 at some deviations. Nothing is
    measured of the modes left out: each frequency is off like that of the plant's least known.
    """
    kinds = {delta.kind for delta in uncertain.deltas}
    if uncertain.fit is not None or not kinds <= set(_OF_MODES) or not whole.has_own_modes:
        return None
    deltas = list(uncertain.deltas)
    covariance = uncertain.covariance
    realisation = modal_realisation(whole)
    own = uncertain.plant.assembled.realisation.n_modes
    ranges = uncertain.frequencies
    least = max(ranges.values(), default=0.0)
    left = [
        Delta(f"mode{mode}:freq", mode, "freq", 2.0 * least)
        for mode in range(own + 1, realisation.n_modes + 1)
        if least
    ]
    deviation = np.sqrt(np.diag(covariance))
    root = np.linalg.cholesky(
        covariance / np.outer(deviation, deviation) + 1e-9 * np.eye(deviation.size)
    )

    def one(own_rng: np.random.Generator) -> StandardPlant:
        amounts = np.concatenate([
            deviation * (root @ own_rng.standard_normal(deviation.size)),
            own_rng.standard_normal(len(left)) / uncertain.deviations,
        ])  # fmt: skip
        every = [*deltas, *left]
        changes = [(d, float(max(d.scale * x, -0.9))) for d, x in zip(every, amounts, strict=True)]
        modes = changed_modes(whole, changes)
        return rebuilt(whole, realisation=_mixed(modes, own_rng, shapes) if shapes else modes)

    return (one(each) for each in rng.spawn(count))


def _mixed(
    realisation: ModalRealisation, rng: np.random.Generator, size: float
) -> ModalRealisation:
    r"""Return a realisation whose elastic shapes hold a little of all others.

    What a model lacks of mass and stiffness moves shapes, to first order, by

    .. math:: \delta\phi_i = \sum_j \frac{\omega_i \max(\omega_i, \omega_j)}
        {\omega_i^2 - \omega_j^2} E_{ij} \phi_j

    with E_ij as large as the relative errors of omega^2 that it causes.
    """
    n, r = realisation.pairs.shape[0], realisation.n_rigid
    real = ~np.any(realisation.inputs[:, ::2], axis=0)
    omega = np.sqrt(np.maximum(np.linalg.det(realisation.pairs), 0.0))
    omega[:r] = 0.0
    E = np.triu(size * rng.standard_normal((n, n)), 1)
    E = E + E.T
    gap = omega[:, None] ** 2 - omega**2
    gap[gap == 0] = np.inf  # of rigid-body motions, and each mode of itself
    part = E * omega[:, None] * np.maximum(omega[:, None], omega) / gap
    part /= np.sqrt(1.0 + part**2)  # near each other modes turn, and mix no further
    part[:r] = 0.0
    part[:, ~real], part[~real] = 0.0, 0.0
    inputs, outputs = np.array(realisation.inputs), np.array(realisation.outputs)
    s: FloatArray = realisation.pairs[:, 0, 1]
    phi = inputs[:, 1::2].copy()
    changed = phi + phi @ part.T
    inputs[:, 1::2] = changed
    outputs[:, ::2] += (changed - phi) / s
    return realisation.replace(inputs=inputs, outputs=outputs)
