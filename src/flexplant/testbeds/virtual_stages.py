"""The virtual machines: a wafer stage, a stage on magnets in six axes, three masses in a row."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..arrays import FloatArray, positive, positive_array, whole
from ..modes import solve_modes
from ..plant import (
    Actuator,
    Disturbance,
    GroundSpring,
    Poi,
    Ports,
    Reference,
    Sensor,
    StandardPlant,
    assemble_plant,
    suspend,
)
from ..reduction import ModalTruncation, reduce
from ..structure import FEModel, ModalDamping, PointMass, chain, kirchhoff_plate
from .ritz import plate_modes, ritz_block, ritz_plate
from .virtual_machine import DRAWING, WaferStage

#: of a machine: relative scatter of stiffness over the plate and of damping over its modes [-],
#: delay [samples], step of its sensors [m], and a second mass [kg], at most
STIFFNESS, SPREAD, LATENCY, STEP, SECOND = 0.003, 0.3, 1.3, 5e-11, 0.1
#: dampings that a machine draws, of which its modes take the first: its second mass comes after
#: them, and is the same for plates of any order
DAMPINGS = 253


def wafer_stage(
    *,
    elements: tuple[int, int] | None = None,
    size: Sequence[float] = (0.6, 0.6),
    thickness: float = 0.0272,
    damping: float = 0.01,
    added_mass: float = 0.5,
    rate: float = 10e3,
    delay: float | None = None,
    individual: int = 1,
) -> WaferStage:
    """Return a virtual machine: a free plate with the mass of an actuator that no drawing shows.

    The machine is the free plate of Table 1 of [paper]_, an aluminium plate of 0.6 m by 0.6 m by
    27.2 mm, with rotary inertia. It is modelled by polynomial shape functions (Ritz method) of such
    a high order that its frequencies are converged. They therefore differ from those of any mesh of
    the drawing. The mass of the actuator is added at (L/2, L/4), where L is the side of the plate
    (point z_8 of the paper), and another of up to 0.1 kg at a random place. The stiffness is
    scattered over the plate by 0.3 % and the damping over its modes by 30 %. The sensors have steps
    of 0.05 nm, and the delay is not a whole number of samples.

    Parameters
    ----------
    elements : (int, int), optional
        Number of elements along x and y. If it is given, a mesh of the drawn plate takes the place
        of the polynomials. The machine then has the same formulation as the models, without
        scatter, second mass and sensor steps, and its delay is 1 sample by default. (8, 8) is the
        mesh of the paper, with 243 DOFs.
    size : (float, float) [m]
        Sides of the plate along x and y; by default the paper's.
    thickness : float [m]
        Thickness of the plate; by default the paper's.
    damping : float
        Mean modal damping ratio of the elastic modes of the plate without added masses.
    added_mass : float [kg]
        Mass of the actuator that no drawing shows.
    rate : float [Hz]
        Sampling rate of its controller.
    delay : float [samples], optional
        Delay from a measurement to the reaction of the actuators, including fractions; 1.3
        by default.
    individual : int
        Number of the machine, from which its scatter and its second mass are drawn.

    Returns
    -------
    WaferStage
        Machine that gives poles, FRFs and closed-loop runs; its matrices are for tests only.

    Raises
    ------
    ModelError
        When a value is out of range.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.testbeds.wafer_stage().poles([6]).freq.round(1)
    array([455.1])
    >>> fx.testbeds.wafer_stage(size=(0.5, 0.35), thickness=0.03).poles([6]).freq.round(1)
    array([1260.7])
    >>> fx.testbeds.wafer_stage(elements=(4, 4)).poles([4]).freq.round(1)
    array([246.5])
    """
    mass = positive(added_mass, "added_mass", zero=True)
    fast = positive(rate, "rate")
    drawing = _plate_drawing(size, thickness)
    x, y = drawing["size"]
    mass_at: dict[tuple[float, ...], float] = {(x / 2, y / 4, 0.0): mass}
    if elements is None:
        late = positive(LATENCY if delay is None else delay, "delay", zero=True)
        seed = whole(individual, "individual", minimum=0)
        return WaferStage(_individual(drawing, damping, mass_at, seed), fast, late, STEP, drawing)
    late = positive(1.0 if delay is None else delay, "delay", zero=True)
    bare = kirchhoff_plate(elements=elements, name="wafer stage", **drawing)
    truth = _with_masses(bare.with_damping(ModalDamping(damping)), mass_at)
    return WaferStage(truth, fast, late, drawing=drawing)


def _plate_drawing(size: Any, thickness: Any) -> Mapping[str, Any]:
    """Return the drawing of a plate of this size."""
    sides = tuple(positive_array(size, "size", (2,)).tolist())
    return {**DRAWING, "size": sides, "thickness": positive(thickness, "thickness")}


def waves(random: np.random.Generator, sides: Sequence[float]) -> Callable[..., FloatArray]:
    """Return a factor of stiffness over x and y (...): cosines of random heights."""
    height = random.normal(size=(3, 3))

    def factor(x: FloatArray, y: FloatArray) -> FloatArray:
        over_x, over_y = (
            np.cos(np.pi * np.arange(3) * at[..., None] / side)
            for at, side in zip((x, y), sides[:2], strict=True)
        )
        seen = np.einsum("...i,ji,...j->...", over_x, height, over_y)
        return np.asarray(1.0 + STIFFNESS * seen / np.sqrt(9.0 / 4.0))

    return factor


def _individual(
    drawing: Mapping[str, Any], damping: float, known: Mapping[Any, float], seed: int
) -> FEModel:
    """Return one machine: its stiffness, damping and masses."""
    random = np.random.default_rng([seed, 8])
    sides = drawing["size"]
    bare = ritz_plate(stiffer=waves(random, sides), **drawing)
    omega, phi = plate_modes(bare)
    own = random.normal(size=DAMPINGS)[: omega.size]
    zeta = positive(damping, "damping", zero=True) * np.exp(SPREAD * own)
    shapes = bare.M @ phi
    D = shapes * (2.0 * zeta * omega) @ shapes.T
    spot = (sides[0] * random.random(), sides[1] * random.random(), 0.0)
    masses = {**known, spot: SECOND * random.random()}
    return _with_masses(bare.replace(D=0.5 * (D + D.T), name="wafer stage"), masses)


def _with_masses(bare: FEModel, masses: Mapping[tuple[float, ...], float]) -> FEModel:
    """Return a damped plate with point masses [kg] added after its damping."""
    M = bare.M
    for at, mass in masses.items():
        row = bare.dofs.row(np.array(at), "z")
        M = M + mass * np.outer(row, row)
    return FEModel(M, bare.K, bare.D, dofs=bare.dofs, name="wafer stage")


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

    The machine is an elastic block. It is modelled by polynomial shape functions (Ritz method) of
    such a high order that its frequencies are converged. They therefore differ from those of any
    mesh of bricks. Magnets at its corners attract, so that its stiffness is ``K - sum_s |k_s| r_s'
    r_s`` (k_s is the stiffness of magnet s, and the row r_s gives the motion there). The six
    rigid-body motions grow until a loop holds them. The stiffnesses of the magnets differ from the
    drawn ones by up to 10 %. A mass is added on the bottom at (3/4, 1/4) of its sides, and another
    of up to 0.1 kg at a random place. The stiffness is scattered over the block by 0.3 % and the
    damping over its modes by 30 %. The sensors have steps of 0.05 nm, and the delay is not a whole
    number of samples.

    Parameters
    ----------
    size : (float, float, float) [m]
        Sides of the block along x, y and z, where it is thin.
    damping, added_mass, rate, delay, individual
        As for `wafer_stage`; `individual` determines the magnets too.

    Returns
    -------
    WaferStage
        Machine whose `drawing` holds the arguments of `solid_block` and whose `magnets` are the
        drawn GroundSprings. Modes 1 to 6 are the rigid-body motions; `poles` are those of mode 7
        and above.

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
    sides = tuple(positive_array(size, "size", (3,)).tolist())
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


def three_masses(*, rate: float | None = 2e3, delay: int = 1) -> StandardPlant:
    r"""Return the plant of three masses in a row: one to push, one to hold still, two to see.

    ::

        u1 --> [1 kg]--/\/\/--[1 kg]--/\/\/--[1 kg]     free along x
                 y1            die              y2

    The actuator u1, with amplifier noise `amp`, pushes the first mass. The sensors y1 and y2
    measure the masses at both ends. The point of interest `die`, with a reference, is the middle
    mass, which no sensor measures. Springs of 4e5 N/m give modes at 0, 100.7 and 174.3 Hz with 1 %
    damping. The plant serves for first trials and for the examples in docstrings.

    Parameters
    ----------
    rate : float [Hz], optional
        Sampling rate; None gives the continuous plant.
    delay : int [samples]
        Delay from measurement to actuation.

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
