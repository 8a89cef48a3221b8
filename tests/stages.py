"""The paper's plate with its channels, for the tests of plants, servos and machines."""

from functools import cache

import numpy as np

from flexplant.identification import MeasuredModes
from flexplant.modes import solve_modes
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Reference, Sensor, assemble_plant
from flexplant.reduction import DesiredDofs, reduce
from flexplant.structure import FEModel, ModalDamping
from flexplant.updating import AddedDamping, AddedMass, Eigenvalues, update
from plates import make_plate

L, RATE = 0.6, 1e4
CORNERS = [(x, y, 0.0) for y in (0.0, L) for x in (0.0, L)]
INSET = [(x, y, 0.0) for y in (L / 4, 3 * L / 4) for x in (L / 4, 3 * L / 4)]
OFF_NODE = (0.31, 0.26, 0.0)
Z8 = (L / 2, L / 4, 0.0)
NOISE = 1e-10 / np.sqrt(RATE / 2)  # 0.1 nm rms a sample
AXES = ("z", "rx", "ry")


def ports(asd=1e-3, sensor_asd=NOISE, die=(L / 2, L / 2, 0.0), **changes):
    """The channels of the example."""
    fields = {
        "w": [Disturbance(f"amp{i}", at=p, asd=asd) for i, p in enumerate(INSET, 1)],
        "u": [Actuator(f"u{i}", at=p) for i, p in enumerate(INSET, 1)],
        "z": [Poi("die", at=die, axes=AXES)],
        "y": [Sensor(f"y{i}", at=p, asd=sensor_asd) for i, p in enumerate(CORNERS, 1)],
        "references": [Reference("die")],
    }
    return Ports(**(fields | changes))


@cache
def full(zeta=0.01, mass=0.0, thickness=0.0272, damper=0.0):
    """All 243 DOFs; mass at z8 and damper on bending there are added after the modal damping."""
    bare = make_plate(thickness=thickness).with_damping(ModalDamping(zeta))
    row = bare.dofs.row(Z8, "z")
    sides = [bare.dofs.row((x, L / 4, 0.0), "z") for x in (L / 4, 3 * L / 4)]
    bend = row - 0.5 * sum(sides)
    M, D = bare.M + mass * np.outer(row, row), bare.D + damper * np.outer(bend, bend)
    return FEModel(M, bare.K, D, dofs=bare.dofs)


@cache
def some_modes(zeta=0.01, count=24, attached=True, thickness=0.0272):
    """24 modes and the compliance at z8."""
    plate = make_plate(thickness=thickness)
    at = [plate.dofs.nearest(Z8, "z")] if attached else []
    return solve_modes(plate, count=count, damping=ModalDamping(zeta), compliance_at=at)


@cache
def reduced(zeta=0.01, thickness=0.0272):
    """25 z-DOFs with the compliance at z8."""
    modes = some_modes(zeta, thickness=thickness)
    spots = [(x, y, 0.0) for y in np.linspace(0, L, 5) for x in np.linspace(0, L, 5)]
    return reduce(modes, DesiredDofs([modes.dofs.nearest(p, "z") for p in spots]))


def fitted(model, poles):
    """An update of mass and damping at z8 from two poles."""
    at = model.full_dofs.nearest(Z8, "z")
    measured = MeasuredModes(poles=poles, modes=[6, 7])
    return update(model, [AddedMass(at), AddedDamping(at)], [Eigenvalues(measured)])


def calibrated(model, machine, modes=range(4, 16)):
    """The mass at z8 from two poles; then the frequencies and dampings are the machine's own."""
    low, poles = machine.poles([6, 7]), machine.poles(list(modes))
    at = model.full_dofs.nearest(Z8, "z")
    return update(model, [AddedMass(at)], [Eigenvalues(low)]).calibrated(poles)


def sampled(model, channels=None, *, delay=1):
    """The plant at the machine's rate."""
    return assemble_plant(model, channels or ports()).discretized(RATE, delay=delay)


def block(system):
    """A block as the dict that the oracles take."""
    return {name: getattr(system, name) for name in ("A", "B", "C", "D", "inputs", "outputs")}
