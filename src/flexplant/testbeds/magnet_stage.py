"""A virtual stage of six axes that floats on magnets: a solid body, unstable without control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..checks import positive, real_array, whole
from ..errors import ModelError
from ..modes import solve_modes
from ..plant import GroundSpring, suspend
from ..reduction import ModalTruncation, reduce
from ..structure import ModalDamping, PointMass
from .ritz_block import ritz_block
from .wafer_stage import LATENCY, SECOND, SPREAD, STEP, WaferStage, waves

#: an aluminium block
BLOCK: Mapping[str, Any] = {
    "size": (0.4, 0.3, 0.05),
    "density": 2700.0,
    "youngs_modulus": 70e9,
    "poisson_ratio": 0.33,
}
#: N/m of the magnets at each corner as drawn, and by what share those of a machine differ
PULL, OFF = {"x": -2e3, "y": -2e3, "z": -6e3}, 0.1
#: modes of the truth: up to four times the highest frequency that 10 kHz shows
MODES = 120


def magnet_stage(
    *,
    size: Sequence[float] = BLOCK["size"],
    damping: float = 0.005,
    added_mass: float = 0.3,
    rate: float = 10e3,
    delay: float | None = None,
    individual: int = 1,
) -> WaferStage:
    """Return a virtual machine that floats on magnets, with a mass that no drawing shows.

    A block of linear elasticity in polynomials, solved to convergence: no mesh of bricks has its
    frequencies. Magnets at its corners attract, ``K - sum_s |k_s| r_s' r_s``, so that six motions
    of the rigid body grow until a loop holds them; theirs are up to 10 % off the drawn ones. A
    mass is added on the bottom at (3/4, 1/4) of its sides, and another of up to 0.1 kg
    somewhere; stiffness is scattered over the block by 0.3 %, damping over its modes by 30 %,
    sensors have steps of 0.05 nm, and the delay is no whole number of samples.

    Parameters
    ----------
    size : (float, float, float) [m]
        Sides of the block along x, y and z, where it is thin.
    damping : float
        Modal damping ratio of the elastic modes, their mean.
    added_mass : float [kg]
        The hidden mass.
    rate : float [Hz]
        Sampling rate of its controller.
    delay : float [samples], optional
        From measurement to actuation; 1.3 when not given.
    individual : int
        Which machine: its scatter, its magnets and its second mass.

    Returns
    -------
    WaferStage
        Its `drawing` holds what `solid_block` takes, its `magnets` the drawn GroundSprings. Modes
        1 to 6 are the motions of the rigid body; poles are of those from 7 on.

    Raises
    ------
    ModelError
        When a value is out of range.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.testbeds.magnet_stage().poles([7, 8]).freq.round(0)
    array([1229., 1543.])
    """
    mass = positive(added_mass, "added_mass", zero=True)
    late = positive(LATENCY if delay is None else delay, "delay", zero=True)
    sides = tuple(real_array(size, "size", (3,)).tolist())
    if not all(side > 0.0 for side in sides):
        raise ModelError(f"size is three lengths (x, y, z) in m, got {sides}. Try {BLOCK['size']}.")
    drawing = {**BLOCK, "size": sides}
    random = np.random.default_rng([whole(individual, "individual", minimum=0), 32])
    block = ritz_block(stiffer=waves(random, sides), **drawing)
    places = (0.75 * sides[0], 0.25 * sides[1], 0.0), (*(sides[:2] * random.random(2)), 0.0)
    loads = [
        PointMass(at, size)
        for at, size in zip(places, (mass, SECOND * random.random()), strict=True)
        if size
    ]
    zeta = positive(damping, "damping", zero=True) * np.exp(SPREAD * random.normal(size=MODES))
    modes = solve_modes(block.with_parts(loads), count=MODES, damping=ModalDamping(zeta))
    drawn = tuple(
        GroundSpring((x, y, 0.5 * sides[2]), pull, direction=along)
        for x in (0.0, sides[0])
        for y in (0.0, sides[1])
        for along, pull in PULL.items()
    )
    own = [
        spring.replace(stiffness=spring.stiffness * (1.0 + OFF * random.uniform(-1.0, 1.0)))
        for spring in drawn
    ]
    truth = suspend(reduce(modes, ModalTruncation(MODES)), own)
    return WaferStage(truth, positive(rate, "rate"), late, STEP, drawing, drawn)
