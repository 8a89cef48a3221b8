"""assemble_plant: the one bridge from a structure and its ports to a standard plant."""

from __future__ import annotations

from .building import continuous_plant
from .ports import Ports
from .realisation import ModalRealisation, Structure
from .residual_form import ResidualForm, modes_of
from .standard import StandardPlant


def assemble_plant(
    model: Structure | ModalRealisation, ports: Ports, *, residual: ResidualForm | None = None
) -> StandardPlant:
    """Return the standard plant of a structure with its channels.

    ``M q'' + D q' + K q = f`` (the paper's (1), or (8) when reduced) in modal states, with forces
    at the disturbances and actuators and motions at the POIs and sensors. The filters of the ports
    (shapes, dynamics) add their states.

    Parameters
    ----------
    model : FEModel, Modes or ReducedModel
        The structure. A plant's `realisation` serves too: the modes are then not solved again.
    ports : Ports
        The channels.
    residual : FastStates or Feedthrough, optional
        What residual attachment vectors of Modes become: fast modes (when not given), or a
        compliance that answers at once.

    Returns
    -------
    StandardPlant
        Continuous. w: disturbances, sensor noises `y1:noise`, references; u: actuators;
        z: POI axes `die:z`, errors `die:error`, efforts `u1:effort`; y: sensors, references.
        Delays of ports act once it is sampled. `plant.form` says whether A is in modal blocks.

    Raises
    ------
    LabelError
        When a place is not on the structure.
    ModelError
        When the model or the ports have another type, or a side is empty.

    Warns
    -----
    FlexplantWarning
        When damping couples the modes so that blocks cannot hold it: an overdamped pair, two poles
        that (nearly) coalesce, or a damper to ground that drags rigid-body motion at more than
        1e-4 of the first elastic frequency (what drags less is left out: rigid-body modes are
        undamped by convention). The undamped modes are then kept with all of D between them, the
        dense form.

    References
    ----------
    [paper]_, equations (1)-(8) and Fig. 2.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0], stiffnesses=[100.0]), count=2)
    >>> ports = fx.Ports(
    ...     u=[fx.Actuator("u1", at="1:x")],
    ...     z=[fx.Poi("die", at="2:x", axes=("x",))],
    ...     y=[fx.Sensor("y1", at="1:x", asd=1e-10)],
    ... )
    >>> fx.assemble_plant(modes, ports)
    <StandardPlant: 4 states, continuous>
      w (1) y1:noise
      u (1) u1
      z (2) die:x  u1:effort
      y (1) y1
    """
    return continuous_plant(StandardPlant, modes_of(model, residual), ports)
