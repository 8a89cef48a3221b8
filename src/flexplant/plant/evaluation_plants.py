"""The plant that answers are judged on: the evaluation model with the channels of the plant."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import FloatArray
from ..errors import LabelError, ModelError, some_names, warn
from ..tolerances import SAME
from .building import P, continuous_plant, loud_like, sampled_like
from .evaluation_model import EvaluationModel
from .partitioned import Partition
from .remade import rebuilt
from .rigid_body import rigid_gain, rigid_modes

#: relative difference of rigid-body accelerations above which two models are different bodies; an
#: updated mass stays below it
_ANOTHER_BODY = 0.1


def evaluation_plant(plant: P) -> P | None:
    """Return the evaluation model of a plain plant with its channels, sampled and delayed alike."""
    model = plant.evaluation
    if model is None:
        return None
    if not model.is_structure:
        found = _matched(plant, own_plant(type(plant), model))
    else:
        before: Any = plant.continuous
        found = before.evaluation_plant if before is not plant else _with_ports(plant, model)
        found = sampled_like(plant, loud_like(plant, found))
        if before is not plant:
            return found  # compared when it was assembled
    _warn_of_another_body(plant, found)
    return found


def check_channels(plant: Partition, other: Partition) -> None:
    """Raise LabelError unless an evaluation model that is a plant has the plant's channels."""
    for side in "wuzy":
        own, others = getattr(plant, side), getattr(other, side)
        if own != others:
            raise LabelError(
                f"the evaluation model has other channels in {side}: {some_names(others)}, the "
                f"plant has {some_names(own)}. Assemble both with the same ports."
            )


def _with_ports(plant: P, model: EvaluationModel) -> P:
    """Return the continuous plant of a structure with the ports of the given one."""
    return continuous_plant(type(plant), model.realisation, plant.assembled.ports, None)


def own_plant(kind: type[P], model: EvaluationModel) -> P:
    """Return the plant that is an evaluation model, with the ports that it got since."""
    found = kind.of(model.source)
    return found if model.ports is None else rebuilt(found, ports=model.ports)


def _matched(plant: P, other: P) -> P:
    """Return an evaluation plant, sampled like the given one, after a check of its channels."""
    check_channels(plant, other)
    other = other.replace(evaluation=None)
    if plant.dt and not other.dt:
        return sampled_like(plant, other)
    same = bool(np.isclose(other.dt, plant.dt, rtol=SAME, atol=0.0))
    if not same or other.delay != plant.delay:
        raise ModelError(
            f"the evaluation model has dt {other.dt:g} s and delay {other.delay:g}, the plant "
            f"{plant.dt:g} s and {plant.delay:g}: their responses could not be compared. Pass it "
            "continuous, or sampled like the plant."
        )
    return other


def _warn_of_another_body(own: Partition, other: Partition) -> None:
    """Warn where forces accelerate the rigid body of an evaluation model differently."""
    if not (own.n_rigid and other.n_rigid):
        return  # held, on springs, or of foreign matrices: no mode shows the mass alone
    one, two = _rigid_gains(own), _rigid_gains(other)
    size = float(np.linalg.norm(one))
    if not size or not np.any(two):
        return  # no force moves the body
    off = float(np.linalg.norm(two - one)) / size
    if off > _ANOTHER_BODY:
        warn(
            "the evaluation model moves as another rigid body: its acceleration per force differs "
            f"by {off:.0%} from the plant's, so that answers would be judged on another machine. "
            "Pass the model that the plant was made of, with more modes."
        )


def _rigid_gains(plant: Partition) -> FloatArray:
    """Return the acceleration (p, m) of what is seen, per force, by the modes at 0 Hz."""
    motions = rigid_modes(plant.assembled.realisation, None)
    return rigid_gain(plant, motions, plant.assembled.ports.motions, plant.u)
