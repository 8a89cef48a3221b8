"""Speeds up to which a moving loop is stable: shown at random, wrong functions refused."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.simulation import speed_certificate as module


def moving_loop(bandwidth=25.0, scheduled=False):
    plate = fx.kirchhoff_plate(
        size=(0.6, 0.6), thickness=0.0272, elements=(8, 8), density=2702, youngs_modulus=70e9,
        poisson_ratio=0.35,
    )  # fmt: skip
    corners = [(x, y, 0.0) for y in (0.1, 0.5) for x in (0.2, 0.4)]
    ports = fx.Ports(
        u=[fx.Actuator(f"u{i}", at=p, asd=1e-3) for i, p in enumerate(corners)],
        z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z", "rx", "ry"), moves={"x": (-1, 0, 0)})],
        y=[
            fx.Sensor(f"y{i}", at=p, asd=1e-12, moves={"x": (-1, 0, 0)})
            for i, p in enumerate(corners)
        ],
        references=[fx.Reference("die")],
        positions=[fx.plant.Position("x", range=(-0.05, 0.05))],
    )
    modes = fx.solve_modes(plate, count=5, damping=fx.ModalDamping(0.002))
    plant = fx.assemble_plant(modes, ports).discretized(4e3, delay=1)

    def design(there):
        return fx.design_kalman(there), fx.design_servo(there, bandwidth=bandwidth, notches=[])

    if scheduled:
        return fx.loop.schedule_loops(plant, design, places=[-0.05, -0.02, 0.02, 0.05])
    return fx.close_loop(plant, *design(plant))


@pytest.fixture(scope="module")
def loop():
    return moving_loop()


@pytest.fixture(scope="module")
def proof(loop):
    return fx.simulation.certify_speed(loop, nodes=9)


@pytest.mark.slow
def test_the_function_falls_at_random_positions_and_speeds(loop, proof):
    # the matrices of one sample of the moving machine, and eigenvalues: no Bernstein, no scaling
    motion = module._Motion.of(loop, None)
    rng = np.random.default_rng(1)
    low, high = proof.nodes[[0, -1]]
    worst = 0.0
    for _ in range(150):
        p, v = rng.uniform(low, high), rng.choice([-1.0, 1.0, rng.uniform(-1, 1)]) * proof.speed
        after = p + v * motion.h
        if not low <= after <= high:
            continue
        A, _ = motion.closed(p, v)
        P, following = (
            np.array([[np.interp(x, proof.nodes, proof.P[:, i, j]) for j in range(len(A))]
                      for i in range(len(A))])
            for x in (p, after)
        )  # fmt: skip
        R = np.linalg.cholesky(P).T
        growth = np.linalg.norm(np.linalg.cholesky(following).T @ A @ np.linalg.inv(R), 2)
        worst = max(worst, growth)
    assert 0.99 < worst < 1.0


def test_more_than_a_stage_needs_is_proven(proof):
    # the stage scans with 0.8 m/s
    assert proof.speed > 0.8
    assert proof.attempts[-1] == (proof.speed, None)


@pytest.mark.slow
def test_a_wrong_function_proves_nothing(loop):
    motion = module._Motion.of(loop, None)
    nodes = np.linspace(-0.05, 0.05, 9)
    right = module._NodeFunctions(motion, nodes).P
    assert module._unproven(motion, nodes, right, 0.05) is None
    larger = [*right[:2], 10.0 * right[2], *right[3:]]
    flat = [np.eye(len(right[0]))] * 9
    # at 0.05 m/s a node ten times larger changes V by 0.9 % a sample, more than it falls
    for wrong in (larger, flat, [-P for P in right]):
        assert module._unproven(motion, nodes, wrong, 0.05) is not None


@pytest.mark.slow
def test_a_schedule_is_proven_with_its_places_as_nodes():
    schedule = moving_loop(scheduled=True)
    proof = fx.simulation.certify_speed(schedule, 0.1, nodes=17)
    assert proof.speed == 0.1
    assert set(schedule.places) <= set(proof.nodes.tolist())


@pytest.mark.slow
def test_a_speed_out_of_reach_is_refused_with_what_the_nodes_allow(loop):
    with pytest.raises(fx.errors.AssumptionError, match="nodes alone would allow"):
        fx.simulation.certify_speed(loop, 500.0, nodes=9)


def test_a_machine_that_does_not_move_has_no_speed(loop):
    still = fx.testbeds.three_masses()
    observer = fx.design_kalman(still)
    standing = fx.close_loop(still, observer, fx.design_servo(still, bandwidth=20.0))
    with pytest.raises(fx.errors.ModelError, match="whose ports move"):
        fx.simulation.certify_speed(standing)
    with pytest.raises(fx.errors.LabelError, match="'y'"):
        fx.simulation.certify_speed(loop, position="y")


def test_a_loop_that_is_unstable_at_a_place_is_refused_there(loop):
    # the same controller with eight times the force
    strong = loop.controller.replace(C=8.0 * loop.controller.C)
    with pytest.warns(fx.FlexplantWarning, match="unstable"):
        unstable = fx.close_loop(loop.plant, strong)
    assert not unstable.is_stable
    with pytest.raises(fx.errors.AssumptionError, match="not stable where the machine stands at x"):
        fx.simulation.certify_speed(unstable, nodes=3)
