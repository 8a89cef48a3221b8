"""close_loop: a plant and its controller blocks, connected by name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ..errors import ModelError, require_known, warn
from ..lti.statespace import System
from ..plant import StandardPlant, larger_plant, standard_plant
from ..values import name_list
from .blocks import as_block, check_inputs, drives, joined
from .closed import ClosedLoop
from .known import with_known


def close_loop(
    plant: StandardPlant | System, *blocks: Any, idle: Iterable[str] = (), larger: Any = None
) -> ClosedLoop:
    """Return the closed loop of a plant with controller blocks, connected by name.

    An input of a block is a measurement (plant.y: sensors, references such as `die:ref`), the
    applied command of an actuator (plant.u), or an output of another block. An output of a block
    that has an actuator's name drives it, and several such outputs add; every other output is
    monitored. A block may also read what is known in advance: the derivatives of a reference
    (`die:ref:velocity`, `die:ref:acceleration`, `die:ref:jerk`, `die:ref:snap`), which `simulate`
    takes from the SetPoint, and forces (`u1:feedforward`), which it is given as a reference.

    Parameters
    ----------
    plant : StandardPlant, StateSpace or control.StateSpace
        The plant; a system whose channels are named like those of an assembled plant (see
        `StandardPlant.from_statespace`) is one.
    *blocks : StateSpace, or values with a `system` such as KalmanEstimator and Controller
        The controller in any number of parts. Sampled at the plant's rate, or static gains.
    idle : iterable of str
        Actuators that stay without a drive on purpose.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        A model with the modes that the plant left out, as for `larger_plant`. The loop is then
        checked there too (`ClosedLoop.left_out`); unless given, with those that the plant's reduced
        model still has.

    Returns
    -------
    ClosedLoop
        Its repr says whether it is stable, with spectral radius and modulus margin.

    Warns
    -----
    FlexplantWarning
        When the closed loop is unstable, or is with the modes that the plant left out; it is
        returned all the same, for inspection. Marginal poles (a rigid-body mode that nothing
        holds) are named by its repr alone.

    Raises
    ------
    LabelError
        When the names of a system do not show which channels are w, u, z and y, an input is
        connected to nothing, an actuator is driven by nothing (and not idle), or
        a name other than an actuator's is driven twice.
    ModelError
        When there is no block, a block is no system, sampling times differ, or the algebraic loop
        is ill-posed, or `larger` does not go with the plant.

    Examples
    --------
    >>> import numpy as np
    >>> from flexplant.lti import StateSpace
    >>> from flexplant.plant import StandardPlant
    >>> mass = StateSpace([[0, 1], [0, 0]], [[0, 0], [1, 1]], [[1, 0], [1, 0], [0, 1]],
    ...     np.zeros((3, 2)), inputs=["f", "u"], outputs=["z", "y", "v"])
    >>> plant = StandardPlant.from_statespace(mass, u=["u"], y=["y", "v"])
    >>> pd = StateSpace([], [], [], [[-100.0, -20.0]], inputs=["y", "v"], outputs=["u"])
    >>> loop = close_loop(plant, pd)
    >>> loop.is_stable, round(loop.spectral_abscissa, 6)
    (True, -10.0)
    """
    plant = standard_plant(plant)
    systems = tuple(as_block(block, i, plant.dt) for i, block in enumerate(blocks, 1))
    if not systems:
        raise ModelError(
            "close_loop needs at least one block that drives an actuator: pass a StateSpace, "
            "a Controller, or an observer and a servo."
        )
    resting = name_list(idle, "idle actuators")
    require_known("actuator to leave idle", resting, plant.u)
    larger = _completed(plant, larger)
    plant = with_known(plant, systems)
    driven, watched = drives(plant, systems, resting)
    check_inputs(plant, systems)
    controller = joined(plant, systems, driven, watched)
    loop = ClosedLoop(
        plant, systems, controller, resting, None if larger is None else with_known(larger, systems)
    )
    found = loop.left_out
    if not loop.is_stable:
        if loop.obstacle and loop.obstacle.reason.startswith("unstable"):
            warn(
                f"the closed loop is {loop.obstacle.reason} ({loop.decay}): its signals grow, and "
                "it has no margin, bandwidth or norm. Check the sign (u = K y), lower the "
                "bandwidth, or notch the mode at that frequency."
            )
    elif found is not None and not found.is_stable:
        warn(
            f"the loop is stable on its plant, but with the modes left out it is {found.summary}. "
            "The machine has these modes: lower the bandwidth, keep them in the plant, or let the "
            "controller roll off (or notch) before them."
        )
    return loop


def _completed(plant: StandardPlant, larger: Any) -> StandardPlant | None:
    """Return the plant with the modes left out, None where they are not known."""
    if not plant.is_weighted:
        return larger_plant(plant, larger)
    if larger is not None:
        raise ModelError(
            "the plant is weighted, or seen through a block, and the larger one is not: close the "
            "loop on plant.unweighted (with that block first) to check it with the modes left out."
        )
    return None
