"""A plant of three masses: the smallest one with all that a stage has."""

from __future__ import annotations

from ..modes import solve_modes
from ..plant import (
    Actuator,
    Disturbance,
    Poi,
    Ports,
    Reference,
    Sensor,
    StandardPlant,
    assemble_plant,
)
from ..structure import ModalDamping, chain


def three_masses(*, rate: float | None = 2e3, delay: int = 1) -> StandardPlant:
    r"""Return the plant of three masses in a row: one to push, one to hold still, two to see.

    ::

        u1 --> [1 kg]--/\/\/--[1 kg]--/\/\/--[1 kg]     free along x
                 y1            die              y2

    The actuator u1, with amplifier noise `amp`, pushes the first mass; the sensors y1 and y2 see
    the ends; the point of interest `die`, with a reference, is the middle mass, which no sensor
    sees. Springs of 4e5 N/m give modes at 0, 100.7 and 174.3 Hz, 1 % damped. For first trials and
    for the examples in docstrings.

    Parameters
    ----------
    rate : float [Hz], optional
        Sampling rate; None gives the continuous plant.
    delay : int [samples]
        From measurement to actuation.

    Returns
    -------
    StandardPlant

    Raises
    ------
    ModelError
        When the rate is not positive, or the delay is negative.

    Examples
    --------
    >>> three_masses()
    <StandardPlant: 7 states, dt 0.0005 s, delay 1>
      w (4) amp  y1:noise  y2:noise  die:ref
      u (1) u1
      z (3) die:x  die:error  u1:effort
      y (3) y1  y2  die:ref
    """
    masses = chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    modes = solve_modes(masses, count=3, damping=ModalDamping(0.01))
    ports = Ports(
        w=[Disturbance("amp", at="1:x", asd=1e-3)],
        u=[Actuator("u1", at="1:x")],
        z=[Poi("die", at="2:x", axes=("x",))],
        y=[Sensor("y1", at="1:x", asd=1e-10), Sensor("y2", at="3:x", asd=1e-10)],
        references=[Reference("die")],
    )
    plant = assemble_plant(modes, ports)
    return plant if rate is None else plant.discretized(rate, delay=delay)
