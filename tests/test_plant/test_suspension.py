"""Springs to ground: rigid-body modes become true oscillations near 1 Hz; residual compliance."""

import re

import numpy as np
import pytest

from flexplant import DofSet
from flexplant.errors import LabelError, ModelError
from flexplant.estimation import design_kalman
from flexplant.lti import frequency_response
from flexplant.modes import solve_modes
from flexplant.plant import (
    Actuator,
    BaseAcceleration,
    FastStates,
    Feedthrough,
    GroundSpring,
    Ports,
    Sensor,
    assemble_plant,
    suspend,
)
from flexplant.structure import FEModel, ModalDamping
from oracles_plant import machine, motion_row, receptance, z_row
from oracles_ports import chain
from plates import make_plate
from stages import AXES, CORNERS, INSET, RATE, Z8, L, full, ports, reduced, some_modes

STIFF, DAMP = 260.0, 20.0  # four of them under 26.5 kg: 1 Hz
FREQ = np.array([0.3, 0.8, 2.3, 40.0, 240.0, 470.0])


def springs(damping=DAMP):
    return [GroundSpring(p, STIFF, damping) for p in CORNERS]


def dense(damping=DAMP, zeta=0.01):
    M, D, K = machine(zeta)
    rows = np.array([z_row(x, y) for x, y, _ in CORNERS])
    return M, D + damping * rows.T @ rows, K + STIFF * rows.T @ rows


def responses(plant):
    sides = ["die:z", "die:rx", "die:ry", "y1"]
    return frequency_response(plant.system.select(sides, ["u1", "amp2"]), FREQ).data


def wanted(damping=DAMP):
    see = [motion_row(L / 2 + 0.01, L / 2 + 0.02, axis) for axis in AXES]
    see.append(z_row(*CORNERS[0][:2]))
    push = np.array([z_row(*INSET[0][:2]), z_row(*INSET[1][:2])])
    return receptance(*dense(damping), np.array(see), push, 2 * np.pi * FREQ)


DIE = (L / 2 + 0.01, L / 2 + 0.02, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(("model", "rtol"), [(full, 2e-6), (reduced, 2e-2), (some_modes, 2e-2)])
@pytest.mark.parametrize("damping", [0.0, DAMP])
def test_responses_of_the_suspended_plate(model, rtol, damping):
    held = suspend(model(), springs(damping))
    plant = assemble_plant(held, ports(die=DIE))
    assert plant.n_rigid == 0
    found, expected = responses(plant), wanted(damping)
    size = np.abs(expected).max(axis=(1, 2), keepdims=True)
    # reduced: what 24 modes leave out; at 1 Hz and below nothing
    np.testing.assert_allclose(found[..., :3] / size, expected[..., :3] / size, atol=1e-5)
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol * size.max() * 1e-4)


def test_suspension_frequencies_are_those_of_a_rigid_body():
    modes = suspend(some_modes(0.0), springs(0.0))
    mass = 0.6 * 0.6 * 0.0272 * 2702
    bounce = np.sqrt(4 * STIFF / mass)
    rock = np.sqrt(4 * STIFF * 0.3**2 / (mass * 0.6**2 / 12))
    np.testing.assert_allclose(np.sort(modes.omega[:3]), [bounce, rock, rock], rtol=5e-5)
    assert 0.9 < modes.freq[0] < 1.1
    assert modes.n_vectors == 1
    np.testing.assert_allclose(modes.vector_omega, some_modes(0.0).vector_omega, rtol=1e-6)


@pytest.mark.slow
def test_springs_that_leave_a_motion_free_leave_its_mode_at_zero():
    line = [GroundSpring((L / 2, y, 0.0), STIFF, DAMP) for y in (0.1, 0.5)]
    for model in (some_modes(), reduced(), full()):
        plant = assemble_plant(suspend(model, line), ports())
        assert plant.n_rigid == 1
        poles = plant.system.poles()
        assert np.count_nonzero(poles == 0) == 2
        assert plant.check()["excited"].holds


def test_a_suspended_plant_samples_and_filters():
    plant = assemble_plant(suspend(reduced(), springs()), ports()).discretized(RATE, delay=1)
    held = design_kalman(plant).rms("die")
    free = design_kalman(assemble_plant(reduced(), ports()).discretized(RATE, delay=1)).rms("die")
    # a 1 Hz suspension is nothing to a filter that works in milliseconds
    assert held == pytest.approx(free, rel=1e-2)


def test_moments_pairs_and_fe_models_without_damping():
    plate = make_plate()
    pair = {(0.1, 0.3, 0.0): 1.0, (0.5, 0.3, 0.0): -1.0}
    for spring in (GroundSpring(pair, 1e3), GroundSpring(Z8, 50.0, direction="ry")):
        held = suspend(plate, spring)
        assert held.rigid_body.shape[1] == 2
        assert held.D is None
        row = plate.dofs.row(spring.at, spring.direction)
        change = (held.K - plate.K).toarray()
        np.testing.assert_allclose(change, spring.stiffness * np.outer(row, row), atol=1e-6)
    damped = suspend(plate, GroundSpring(Z8, 1e3, 2.0))
    np.testing.assert_allclose(damped.D.diagonal().sum(), 2.0, rtol=1e-12)


def test_refusals():
    with pytest.raises(ModelError, match="stiffness of a ground spring is 0"):
        GroundSpring(Z8, 0.0)
    with pytest.raises(ModelError, match="damping of a ground spring"):
        GroundSpring(Z8, 1.0, -1.0)
    with pytest.raises(LabelError, match="direction"):
        GroundSpring(Z8, 1.0, direction="up")
    with pytest.raises(LabelError, match="off the plate"):
        suspend(make_plate(), GroundSpring((0.7, 0.0, 0.0), 1.0))
    with pytest.raises(ModelError, match="must be a list of at least one GroundSpring"):
        suspend(make_plate(), [])
    with pytest.raises(ModelError, match="FEModel, ReducedModel or Modes"):
        suspend("plate", springs())
    with pytest.raises(ModelError, match="springs are so weak"):
        suspend(make_plate(), GroundSpring(Z8, 1e-6))
    with pytest.raises(ModelError, match="overdamped"):
        suspend(some_modes(), springs(1e3))
    once = suspend(some_modes(), springs())
    with pytest.raises(ModelError, match="a mode would not oscillate"):
        suspend(once, springs(1e3))


def test_complex_modes_are_suspended_within_their_shapes():
    """All modes of a chain: exact. Twice on half the springs is once on the springs."""
    M, D, K = chain()
    dofs = DofSet(range(1, 6), ["x"] * 5, np.outer(np.arange(5.0), [1.0, 0.0, 0.0]))
    modes = solve_modes(FEModel(M, K, D, dofs=dofs), count=5)
    assert np.iscomplexobj(modes.phi)
    found = suspend(modes, [GroundSpring("1:x", 3e3, 5.0), GroundSpring("4:x", 2e2)])
    K2, D2 = K + np.diag([3e3, 0, 0, 2e2, 0]), D + np.diag([5.0, 0, 0, 0, 0])
    plant = assemble_plant(found, Ports(u=[Actuator("u", at="5:x")], y=[Sensor("y", at="2:x")]))
    shown = frequency_response(plant.Gyu, FREQ[:4])["y", "u"]
    wanted = [np.linalg.solve(s * s * M + s * D2 + K2, np.eye(5)[4])[1]
              for s in 2j * np.pi * FREQ[:4]]  # fmt: skip
    np.testing.assert_allclose(shown, wanted, rtol=1e-8)
    half = [GroundSpring(p, 0.5 * s.stiffness, 0.5 * s.damping)
            for p, s in zip(CORNERS, springs(), strict=True)]  # fmt: skip
    once, twice = suspend(some_modes(), springs()), suspend(suspend(some_modes(), half), half)
    np.testing.assert_allclose(twice.poles, once.poles, rtol=1e-7)
    gains = [np.abs(m.phi) for m in (once, twice)]
    np.testing.assert_allclose(gains[1], gains[0], rtol=1e-4, atol=1e-5 * gains[0].max())
    # what no spring stretches stays at 0: a plate hinged at two corners turns
    hinge = [GroundSpring(p, 50.0, 0.1) for p in CORNERS[:2]]
    alone = suspend(some_modes(), hinge)
    further = suspend(alone, [GroundSpring(CORNERS[0], 10.0)])
    assert alone.n_rigid == further.n_rigid == 1
    straight = suspend(some_modes(), [hinge[0].replace(stiffness=60.0), hinge[1]])
    np.testing.assert_allclose(further.poles, straight.poles, rtol=1e-6)


def test_undamped_modes_of_a_suspension_are_counted():
    soft = [GroundSpring(p, 40.0) for p in CORNERS]
    plant = assemble_plant(suspend(some_modes(), soft), ports())
    text = plant.check()["detectable"].finding
    assert re.match(r"3 undamped modes at 0\.\d+ to \d\.\d+ Hz, by 4 channels", text)


# residual compliance ------------------------------------------------------------------------


def test_feedthrough_is_the_static_gain_of_the_fast_states():
    channels = ports(y=[Sensor("y1", at=Z8, asd=1e-12)], references=[])
    fast = assemble_plant(some_modes(), channels, residual=FastStates())
    slow = assemble_plant(some_modes(), channels, residual=Feedthrough())
    assert slow.system.n_states == fast.system.n_states - 2
    np.testing.assert_array_equal(fast.system.A, assemble_plant(some_modes(), channels).system.A)
    modes = some_modes()
    z8 = modes.dofs.row(Z8) @ modes.vectors
    inset = modes.dofs.row(INSET[0]) @ modes.vectors
    wanted = z8 @ np.diag(modes.vector_omega**-2) @ inset
    np.testing.assert_allclose(slow.Gyu.D[0, 0], wanted, rtol=1e-12)
    for freq in (0.5, 100.0, 1000.0):
        s = 2j * np.pi * freq
        a, b = (p.Gyu.evaluated(s)[0] for p in (fast, slow))
        p = s / modes.vector_omega[0]
        fast_part = slow.D22[0] / (1 + 2 * modes.vector_zeta[0] * p + p**2)
        np.testing.assert_allclose(a, b + fast_part - slow.D22[0], rtol=1e-12)


@pytest.mark.slow
def test_static_modes_keep_the_compliance_of_all():
    """Above 2 kHz the modes of the full plate become static: at 30 Hz nothing is missed."""
    model = suspend(full(), springs())
    every = assemble_plant(model, ports())
    fewer = assemble_plant(model, ports(), residual=Feedthrough(above=2000.0))
    cut = assemble_plant(some_modes(count=20, attached=False), ports())
    assert fewer.system.n_states < 50
    s = 2j * np.pi * 30.0
    a, b, c = (p.Gyu.evaluated(s)[0] for p in (every, fewer, cut))
    np.testing.assert_allclose(b, a, rtol=1e-4)
    assert np.abs(c - a).max() > 1e-3 * np.abs(a).max()


def test_velocities_and_accelerations_have_no_static_part():
    y = [Sensor(q, at=Z8, quantity=q) for q in ("velocity", "acceleration")]
    plant = assemble_plant(some_modes(), ports(y=y, references=[]), residual=Feedthrough())
    bare = assemble_plant(some_modes(attached=False), ports(y=y, references=[]))
    np.testing.assert_allclose(plant.Gyu.D, bare.Gyu.D, rtol=1e-9)
    assert not plant.Gyu.D[0].any()


def test_a_feedthrough_needs_a_delay_and_something_to_replace():
    plant = assemble_plant(some_modes(), ports(), residual=Feedthrough())
    assert np.any(plant.discretized(RATE).D22)
    assert not np.any(plant.discretized(RATE, delay=1).D22)
    with pytest.raises(ModelError, match="no attachment vectors"):
        assemble_plant(full(), ports(), residual=Feedthrough())
    with pytest.raises(ModelError, match="no modes above"):
        assemble_plant(some_modes(attached=False), ports(), residual=Feedthrough(above=1e5))
    with pytest.raises(ModelError, match="above must be positive"):
        Feedthrough(above=0.0)
    lone = FEModel([[1.0]], [[4.0]], dofs=make_plate().dofs.select(["1:z"]))
    single = solve_modes(lone, damping=ModalDamping(0.01))
    with pytest.raises(ModelError, match="nothing but modes above"):
        assemble_plant(single, ports(w=[], u=[], z=[], references=[], y=[Sensor("y", at="1:z")]),
                       residual=Feedthrough(above=0.01))  # fmt: skip


@pytest.mark.slow
def test_base_acceleration_of_suspended_modes_and_reduced_models():
    """Complex modes tell their mass too; what the floor does is -M r, in all three kinds."""
    w = [BaseAcceleration("floor", "z"), BaseAcceleration("tilt", "rx", about=(0.0, 0.1, 0.0))]
    M, D, K = dense()
    y = make_plate().dofs.xyz[:, 1]
    kind = np.array(make_plate().dofs.directions)
    lift = (kind == "z").astype(float)
    tilt = np.where(kind == "z", y - 0.1, 0.0) + (kind == "rx")
    see = motion_row(*DIE[:2], "z")
    s = 2j * np.pi * FREQ[:4]
    expected = np.array(
        [[-see @ np.linalg.solve(p * p * M + p * D + K, M @ r) for p in s] for r in (lift, tilt)]
    )
    for model, rtol in ((full(), 1e-5), (reduced(), 1e-4), (some_modes(), 1e-4)):
        plant = assemble_plant(suspend(model, springs()), ports(w=w, die=DIE))
        found = frequency_response(plant.Gzw, FREQ[:4])
        for i, name in enumerate(("floor", "tilt")):
            np.testing.assert_allclose(found["die:z", name], expected[i], rtol=rtol)
    held = solve_modes(stuck(), count=10, damping=ModalDamping(0.01))
    with pytest.raises(ModelError, match=r"do not make the rigid-body motion 'z'.*FEModel"):
        assemble_plant(held, ports(w=w, y=[], references=[]))
    assert assemble_plant(stuck(), ports(w=w, y=[], references=[])).n_rigid == 0


def stuck():
    """The plate on stiff springs that were there before its modes were solved."""
    return suspend(make_plate(), [GroundSpring(p, 1e8) for p in CORNERS])
