"""The plant with the modes that a reduction left out: the check of designs on the reduced one."""

from __future__ import annotations

import numpy as np

from ..checks import FloatArray
from ..errors import LabelError, ModelError, some_names, warn
from ..lti.statespace import StateSpace
from ..reduction import ReducedModel
from ..tolerances import SAME
from .building import sampled_like, with_modes_of
from .partition import is_plant
from .realisation import Structure
from .rigid.rigid_motion import rigid_gain, rigid_modes
from .standard import StandardPlant, standard_plant

#: relative difference of rigid-body accelerations that is none of an updated mass
_ANOTHER_BODY = 0.1


def larger_plant(
    plant: StandardPlant, larger: StandardPlant | StateSpace | Structure | None = None
) -> StandardPlant | None:
    """Return the plant with the modes left out, sampled and delayed like the given one.

    Parameters
    ----------
    plant : StandardPlant
        Of a weighted plant, or one seen `through` a block, the plain plant underneath counts.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        The larger model: a structure gets the plant's ports, a plant must have its channels. Of a
        reduced model the modes that it left out count as well. None:
        the modes that the plant's reduced model still has.

    Returns
    -------
    StandardPlant or None
        With the channels w, u, z and y of the plain plant. None without `larger`, where no modes
        left out are known.

    Raises
    ------
    ModelError
        When the plant has no ports to assemble a structure with, or the larger plant has another
        sampling time or delay.
    LabelError
        When the larger plant has other channels.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0] * 4, stiffnesses=[4e5] * 3)
    >>> modes = fx.solve_modes(model, count=4, damping=fx.ModalDamping(0.01))
    >>> ports = fx.testbeds.three_masses().assembled.ports
    >>> plant = fx.assemble_plant(modes.select([0, 1]), ports).discretized(2e3, delay=1)
    >>> fx.plant.larger_plant(plant, modes).system.n_states - plant.system.n_states
    4
    """
    plain = standard_plant(plant).unweighted
    if larger is None:
        model = plain.model
        if not isinstance(model, ReducedModel) or model.truncated is None:
            return None
        larger = model
    found = (
        _matched(plain, standard_plant(larger))
        if is_plant(larger)
        else with_modes_of(plain, larger)
    )
    if plain.is_assembled and found.is_assembled:
        _warn_of_another_body(plain, found)
    return found


def _warn_of_another_body(own: StandardPlant, larger: StandardPlant) -> None:
    """Warn where forces accelerate the rigid body of a larger model otherwise than the plant's."""
    one, two = _rigid_gains(own), _rigid_gains(larger)
    size = float(np.linalg.norm(one))
    if not size or not np.any(two):
        return  # held, or on springs: no mode shows the mass alone
    off = float(np.linalg.norm(two - one)) / size
    if off > _ANOTHER_BODY:
        warn(
            f"the larger model moves as another rigid body: its acceleration per force differs by "
            f"{off:.0%} from the plant's. What is said of modes left out is then that of another "
            "machine. Pass the model that the plant was made of, with more modes."
        )


def _rigid_gains(plant: StandardPlant) -> FloatArray:
    """Return the acceleration (p, m) of what is seen, per force, by the modes at 0 Hz."""
    ports = plant.assembled.ports
    seen = [poi.channel(axis) for poi in ports.z for axis in poi.axes] + [s.name for s in ports.y]
    return rigid_gain(plant, rigid_modes(plant.assembled.realisation, None), seen, plant.u)


def _matched(plant: StandardPlant, larger: StandardPlant) -> StandardPlant:
    """Return the larger plant, sampled like the given one, after a check of its channels."""
    larger = larger.unweighted
    for side in "wuzy":
        own, other = getattr(plant, side), getattr(larger, side)
        if own != other:
            raise LabelError(
                f"the larger plant has other channels in {side}: {some_names(other)}, the plant "
                f"has {some_names(own)}. Assemble both with the same ports."
            )
    if plant.dt and not larger.dt:
        return sampled_like(plant, larger)
    same = bool(np.isclose(larger.dt, plant.dt, rtol=SAME, atol=0.0))
    if not same or larger.delay != plant.delay:
        raise ModelError(
            f"the larger plant has dt {larger.dt:g} s and delay {larger.delay:g}, the plant "
            f"{plant.dt:g} s and {plant.delay:g}: their responses could not be compared. Pass it "
            "continuous, or sampled like the plant."
        )
    return larger
