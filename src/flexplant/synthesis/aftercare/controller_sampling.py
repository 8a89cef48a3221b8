"""discretise_controller: a continuous controller for a sampled, delayed plant, checked there."""

from __future__ import annotations

from typing import Any

from ...checks import instance, positive
from ...errors import ModelError
from ...lti.discretisation import tustin
from ...lti.statespace import as_statespace
from ...plant import StandardPlant
from ..controller import Controller, with_left_out
from .order import loop_facts, required, stable_before


def discretise_controller(
    plant: StandardPlant,
    controller: Any,
    *,
    prewarp: float | None = None,
    loss: float = 0.5,
    larger: Any = None,
) -> Controller:
    """Return a continuous controller at the rate of a sampled plant, and how its loop stands there.

    Bilinear (Tustin), the response kept at one frequency where `prewarp` is given. The loop on
    the sampled and delayed plant is compared with the continuous loop it was designed for: what a
    delay costs is in the margin. To design for the sampled plant from the start costs less.

    Parameters
    ----------
    plant : StandardPlant
        Sampled: ``plant.discretized(rate, delay=)`` of a plant that is not weighted.
    controller : StateSpace or Controller
        Continuous, from y to u.
    prewarp : float [Hz], optional
        A frequency that keeps its response: a notch, the crossover.
    loss : float
        Relative loss of the modulus margin that is allowed.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        As for `larger_plant`.

    Returns
    -------
    Controller
        The certificate holds spectral radius and margin, and the continuous ones.

    Raises
    ------
    CertificateError
        When the sampled loop is unstable or loses more margin, or the continuous one is unstable.
    ModelError
        When the plant is not sampled or weighted, or the controller is sampled already.

    Warns
    -----
    FlexplantWarning
        When the modes left out make the loop unstable, or bring |S| at u above 8 dB; it names them.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> law = fx.lti.tf([-1e4, -2e6], [1.0, 1e3]).replace(inputs=["y1"], outputs=["u1"])
    >>> fx.synthesis.discretise_controller(plant, law).system.dt
    0.0005
    """
    given = instance(plant, StandardPlant, "plant", "Make it by assemble_plant(...).discretized().")
    K = as_statespace(controller)
    if not given.dt or given.is_weighted or given.continuous.dt:
        raise ModelError(
            "a controller is discretised for a sampled plant without weights whose continuous one "
            "is known: pass plant.unweighted.discretized(rate, delay=1)."
        )
    if K.dt:
        raise ModelError(
            f"the controller is sampled already (dt {K.dt:g} s). Pass a continuous one."
        )
    before = stable_before(given.continuous, K)
    found = tustin(K, 1.0 / given.dt, prewarp=prewarp)
    after = loop_facts(given, found)
    required(
        before, after, positive(loss, "loss", zero=True),
        "Raise the rate, shorten the delay, lower the bandwidth, or design on the sampled plant.",
    )  # fmt: skip
    continuous = {f"{name} continuous": v for name, v in before.certificate.items()}
    answer = Controller(
        found,
        f"discretised at {1.0 / given.dt:g} Hz by the bilinear map"
        + ("" if prewarp is None else f", exact at {prewarp:g} Hz"),
        certificate=after.certificate | continuous,
    )
    return with_left_out(answer, given, larger)
