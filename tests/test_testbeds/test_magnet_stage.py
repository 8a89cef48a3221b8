"""A stage on magnets of another formulation than any drawing: a solid body in polynomials."""

from functools import cache

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx
from flexplant.errors import LabelError, ModelError
from flexplant.plant import suspend
from flexplant.testbeds.virtual_blocks import BLOCK, PULL, ritz_block

RATE = 10e3
AXES = ("x", "y", "z", "rx", "ry", "rz")
LX, LY, LZ = BLOCK["size"]
PUSHERS = {
    "z1": ((0.05, 0.05, 0.0), "z"),
    "z2": ((0.35, 0.05, 0.0), "z"),
    "z3": ((0.2, 0.25, 0.0), "z"),
    "x1": ((0.0, 0.075, 0.025), "x"),
    "x2": ((0.0, 0.225, 0.025), "x"),
    "y1": ((0.2, 0.0, 0.025), "y"),
}
SENSORS = {
    "ez1": ((0.0, 0.0, LZ), "z"),
    "ez2": ((LX, 0.0, LZ), "z"),
    "ez3": ((0.0, LY, LZ), "z"),
    "ez4": ((LX, LY, LZ), "z"),
    "ex1": ((LX, 0.05, 0.025), "x"),
    "ex2": ((LX, 0.25, 0.025), "x"),
    "ey1": ((0.2, LY, 0.025), "y"),
}


def ports():
    return fx.Ports(
        w=[fx.Disturbance(f"amp:{n}", at, direction=d, asd=1e-3) for n, (at, d) in PUSHERS.items()],
        u=[fx.Actuator(name, at, direction=along) for name, (at, along) in PUSHERS.items()],
        z=[fx.Poi("die", at=(0.23, 0.17, LZ), axes=AXES)],
        y=[fx.Sensor(n, at, direction=along, asd=1e-11) for n, (at, along) in SENSORS.items()],
    )


@cache
def machine():
    return fx.testbeds.magnet_stage()


def test_a_slender_block_is_a_beam():
    """A free beam's bending, 22.3733 / (2 pi L^2) sqrt(E I / rho A), and its stretching."""
    length, side = 1.0, 0.01
    bar = ritz_block(
        size=(length, side, side), density=7800.0, youngs_modulus=2.1e11, poisson_ratio=0.3,
        orders=(10, 2, 2),
    )  # fmt: skip
    freq = fx.solve_modes(bar, count=40).freq
    speed = np.sqrt(2.1e11 / 7800.0)
    for wave in (22.3733, 61.6728):
        bending = wave / (2.0 * np.pi * length**2) * side / np.sqrt(12.0) * speed
        assert np.abs(freq / bending - 1.0).min() < 2e-3
    assert np.abs(freq / (0.5 * speed / length) - 1.0).min() < 2e-3
    assert (freq[:6] == 0.0).all()


@pytest.mark.slow
def test_meshes_of_the_drawing_come_nearer_and_stay_above():
    bare = fx.solve_modes(ritz_block(**BLOCK), count=18).freq[6:]
    coarse, fine = (
        fx.solve_modes(fx.solid_block(elements=n, **BLOCK), count=18).freq[6:]
        for n in ((8, 6, 2), (16, 12, 4))
    )
    assert (fine > bare).all()
    assert np.median((coarse - bare) / (fine - bare)) == pytest.approx(4.0, rel=0.2)
    less = fx.solve_modes(ritz_block(**BLOCK, orders=(8, 7, 3)), count=14).freq[6:]
    assert (less > bare[:8]).all() and np.abs(less / bare[:8] - 1.0).max() < 1e-3


def test_motions_between_the_nodes():
    """A rotation about an axis moves every point as a rigid body does."""
    block = ritz_block(**BLOCK, orders=(3, 3, 2))
    point, turn = np.array([0.11, 0.07, 0.02]), np.array([0.3, -0.5, 0.7])
    q = np.cross(turn, block.dofs.xyz[::3]).reshape(-1)
    moved = [block.dofs.row(point, axis) @ q for axis in AXES]
    np.testing.assert_allclose(moved, [*np.cross(turn, point), *turn], atol=1e-12)
    with pytest.raises(LabelError, match="outside the block"):
        block.dofs.row((0.5, 0.0, 0.0), "z")
    with pytest.raises(LabelError, match="no direction 's'"):
        block.dofs.row(point, "s")


@pytest.mark.slow
def test_what_the_magnets_make_grow():
    """A rigid body on springs of negative stiffness, by hand; theirs are up to 10 % off."""
    box, mass = np.array(BLOCK["size"]), np.prod(BLOCK["size"]) * BLOCK["density"]
    corners = np.array([(x, y) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]) * box[:2]
    M = np.diag([mass, mass, mass, *(mass / 12.0 * (box @ box - box**2))])
    K = np.zeros((6, 6))
    for x, y in corners:
        arm = np.array([[0.0, 0.0, -y], [0.0, 0.0, x], [y, -x, 0.0]])
        seen = np.hstack([np.eye(3), arm])
        K += seen.T @ np.diag([PULL[axis] for axis in "xyz"]) @ seen
    drawn = np.sort(np.sqrt(la.eigvalsh(-K, M)))
    heavy = fx.testbeds.magnet_stage(added_mass=0.0)
    poles = fx.assemble_plant(heavy.truth, ports()).system.poles()
    grow = np.sort(poles.real[poles.real > 1e-3])
    np.testing.assert_allclose(grow, drawn, rtol=0.06)
    assert np.abs(grow / drawn - 1.0).max() > 0.005


@pytest.mark.slow
def test_machines_differ_and_refuse():
    one, other = (fx.testbeds.magnet_stage(individual=i).poles([7, 8, 9]) for i in (1, 2))
    off = np.abs(one.freq / other.freq - 1.0)
    assert 1e-4 < off.max() < 0.05
    zeta = machine().poles(range(7, 15)).zeta
    assert 0.1 < np.log(zeta / 0.005).std() < 0.6
    with pytest.raises(LabelError, match="elastic mode"):
        machine().poles([6])
    for bad in ({"size": (0.4, 0.3)}, {"size": (0.4, 0.3, 0.0)}, {"individual": -1}):
        with pytest.raises(fx.FlexplantError, match=r"size|individual"):
            fx.testbeds.magnet_stage(**bad)
    with pytest.raises(ModelError, match="size must "):
        fx.testbeds.magnet_stage(size=(0.4, -0.3, 0.05))


@cache
def drawn():
    """The drawing's bricks with what was measured of the machine, on the drawn magnets."""
    drawing = machine().drawing
    frf = machine().measure_frf(ports(), period=0.2, periods=3, discard=1, rng=3)
    found = fx.identify_modes(frf, band=(1000.0, 1800.0), hold=RATE, refine=False)
    damping = fx.ModalDamping(0.005)
    fine = fx.solve_modes(
        fx.solid_block(elements=(16, 12, 4), **drawing), count=60, damping=damping
    )
    poles = fx.numbered(found, fine, at=ports(), partial=True, least_mac=0.8)
    return poles, suspend(fine.calibrated(poles), machine().magnets)


@pytest.mark.long
def test_identified_poles_are_those_of_the_machine():
    """Among aliased ones: a mode above half the rate swings at the rate less its frequency."""
    poles, _ = drawn()
    assert poles.modes == (7, 8)
    truth = machine().poles(poles.modes).poles
    std = np.sqrt(np.diag(poles.covariance)).reshape(2, -1)
    off = poles.poles - truth
    assert np.abs(off / truth).max() < 1e-3
    assert (np.abs([off.real, off.imag]) < 4.0 * std).all()


@pytest.mark.long
def test_what_a_loop_promises_is_kept_on_the_machine():
    """Margin within 5 %, errors of the die in six axes within 5 %: bricks against polynomials."""
    _, full = drawn()
    one = fx.testbeds.magnet_stage(individual=2)
    plant = fx.assemble_plant(full.select(range(26)), ports(), evaluation=full)
    plant = plant.discretized(RATE, delay=one.delay)
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=70.0, observer=observer)
    promised = fx.close_loop(plant, observer, servo)
    kept = one.loop(ports(), observer, servo)
    assert kept.is_stable
    assert kept.modulus_margin > 0.95 * promised.modulus_margin
    off = [kept.rms(f"die:{axis}") / promised.rms(f"die:{axis}") - 1.0 for axis in AXES]
    assert np.abs(off).max() < 0.05


@pytest.mark.long
def test_a_tolerant_controller_holds_on_a_machine_of_another_formulation():
    """Six axes on magnets: what a body on negative stiffness has is no uncertain frequency."""
    _, full = drawn()
    one = fx.testbeds.magnet_stage(individual=2)
    own = ports().replace(references=[fx.Reference("die")])
    plant = fx.assemble_plant(full.select(range(14)), own, evaluation=full)
    plant = plant.discretized(RATE, delay=one.delay)
    off = plant.uncertain(frequency=0.005)
    assert list(off.frequencies) == list(range(7, 15))
    controller = fx.design_stage(off, bandwidth=60.0)
    promised = fx.close_loop(plant, controller).completed
    machine_loop = one.loop(own, controller)
    assert promised.modulus_margin > 0.4
    assert machine_loop.is_stable
    assert machine_loop.modulus_margin > 0.95 * promised.modulus_margin
