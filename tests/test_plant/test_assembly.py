"""assemble_plant: names, places, quantities and wiring, against dense oracles."""

from functools import cache

import numpy as np
import pytest

from flexplant.errors import LabelError, ModelError
from flexplant.lti import frequency_response
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Reference, Sensor, assemble_plant
from flexplant.plant.realisation import realise
from oracles_plant import first_order, hold, machine, motion_row, receptance, z_row
from stages import AXES, INSET, OFF_NODE, Z8, L, full, ports, reduced, some_modes

FREQ = np.array([50.0, 240.0, 246.0, 470.0, 1200.0])
S = 2j * np.pi * FREQ


@cache
def heavy():
    """The full model with its mass, solved once."""
    return realise(full(mass=0.5))


def one(at, *, direction="z", model=None, freq=FREQ, quantity="displacement", push=INSET[0]):
    """The FRF from a force at the first inset to one sensor."""
    channels = Ports(
        u=[Actuator("u", at=push)], y=[Sensor("y", at=at, direction=direction, quantity=quantity)]
    )
    plant = assemble_plant(model or heavy(), channels)
    return frequency_response(plant.Gyu, freq)["y", "u"]


def oracle(row, push=None):
    M, D, K = machine(0.01, mass=0.5)
    push = z_row(*INSET[0][:2]) if push is None else push
    return receptance(M, D, K, row[None], push[None], S.imag)[0, 0]


def agree(found, wanted, tolerance=1e-6):
    np.testing.assert_allclose(found, wanted, rtol=tolerance, atol=tolerance * abs(wanted).max())


def test_names_and_order():
    plant = assemble_plant(some_modes(), ports())
    assert plant.w == (
        *(f"amp{i}" for i in range(1, 5)), *(f"y{i}:noise" for i in range(1, 5)), "die:ref"
    )  # fmt: skip
    assert plant.u == ("u1", "u2", "u3", "u4")
    efforts = [f"u{i}:effort" for i in (1, 2, 3, 4)]
    assert plant.z == ("die:z", "die:rx", "die:ry", "die:error", *efforts)
    assert plant.y == ("y1", "y2", "y3", "y4", "die:ref")
    assert plant.system.inputs == (*plant.w, *plant.u)
    assert plant.system.outputs == (*plant.z, *plant.y)
    assert plant.dt == 0
    assert plant.n_rigid == 3
    assert plant.model is some_modes()
    assert plant.asd["amp1"] == 1e-3
    assert "die:ref" not in plant.asd
    quiet = assemble_plant(some_modes(), ports(asd=0.0, sensor_asd=0.0, references=[]))
    assert quiet.w == ("amp1", "amp2", "amp3", "amp4")
    assert not quiet.asd
    assert quiet.y == ("y1", "y2", "y3", "y4")


@pytest.mark.slow
@pytest.mark.parametrize(("quantity", "order"), [("velocity", 1), ("acceleration", 2)])
@pytest.mark.parametrize("kind", ["real", "complex", "modes"])
def test_velocity_and_acceleration_are_s_times_displacement(quantity, order, kind):
    model = {"real": full(), "complex": full(mass=0.5), "modes": some_modes()}[kind]
    still = one(OFF_NODE, model=model)
    agree(one(OFF_NODE, model=model, quantity=quantity), S**order * still, 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("order", [0, 1, 2])
def test_quantities_against_the_dense_oracle(order):
    quantity = ("displacement", "velocity", "acceleration")[order]
    agree(one(OFF_NODE, quantity=quantity), S**order * oracle(z_row(0.31, 0.26)))


@pytest.mark.slow
def test_an_accelerometer_sees_the_force_at_once():
    # oracle: M^-1, rigid body and all modes together
    M, _, _ = machine(0.01, mass=0.5)
    channels = Ports(
        u=[Actuator("u", at=INSET[0])], y=[Sensor("a", at=OFF_NODE, quantity="acceleration")]
    )
    plant = assemble_plant(heavy(), channels)
    wanted = z_row(0.31, 0.26) @ np.linalg.solve(M, z_row(*INSET[0][:2]))
    np.testing.assert_allclose(plant.D22, [[wanted]], rtol=1e-6)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("point", [(0.31, 0.26), (0.025, 0.55), (0.59, 0.01)])
def test_a_poi_between_nodes(axis, point):
    # oracle: the element polynomial; slopes by finite differences of the interpolated z field
    poi = Poi("p", at=(*point, 0), axes=AXES)
    plant = assemble_plant(heavy(), Ports(u=[Actuator("u", at=INSET[0])], z=[poi]))
    found = frequency_response(plant.Gzu, FREQ)[f"p:{axis}", "u"]
    agree(found, oracle(motion_row(*point, axis)), 1e-5)


def test_forces_and_moments_between_nodes():
    # reciprocity: a moment at one point moves another as its force turns the first
    for axis in AXES:
        channels = Ports(
            u=[Actuator("u", at=OFF_NODE, direction=axis)], y=[Sensor("y", at=INSET[0])]
        )
        found = frequency_response(assemble_plant(heavy(), channels).Gyu, FREQ)
        agree(found["y", "u"], oracle(motion_row(0.31, 0.26, axis)), 1e-5)


def test_labels_and_mappings_are_places():
    dofs = full().dofs
    a, b = (dofs.nearest(p, "z") for p in (INSET[0], Z8))
    rows = np.array([z_row(*p[:2]) for p in (INSET[0], Z8)])
    agree(one(a), oracle(rows[0]))
    agree(one({a: 0.25, b: -2.0}), oracle(0.25 * rows[0] - 2.0 * rows[1]))
    agree(one(b, push={a: 1.0, b: -1.0}), oracle(rows[1], rows[0] - rows[1]))
    turned = a.replace(":z", ":ry")
    agree(one(turned), one(INSET[0], direction="ry"), 1e-9)


def test_a_poi_at_a_label_takes_its_axes_there():
    node = full().dofs.nearest(Z8, "z")
    u = [Actuator("u", at=INSET[0])]
    there, point = (
        assemble_plant(full(), Ports(u=u, z=[Poi("p", at=at, axes=AXES)])) for at in (node, Z8)
    )
    np.testing.assert_allclose(there.system.C, point.system.C, rtol=1e-9, atol=1e-12)
    mean = {full().dofs.nearest(p, "z"): 0.5 for p in INSET[:2]}
    plant = assemble_plant(full(), Ports(u=u, z=[Poi("p", at=mean)]))
    rows = [one(p, model=realise(full())) for p in INSET[:2]]
    agree(frequency_response(plant.Gzu, FREQ)["p:z", "u"], 0.5 * (rows[0] + rows[1]), 1e-9)


def test_references_errors_efforts_and_noises():
    plant = assemble_plant(reduced(), ports(die=OFF_NODE))
    g = plant.system

    def through(output, name):
        return g.D[g.output_index([output])[0], g.input_index([name])[0]]

    still = {"die:ref", "u1:effort"}
    for name in still:
        assert not g.C[g.output_index([name])].any()
    assert np.array_equal(g.C[g.output_index(["die:error"])], -g.C[g.output_index(["die:z"])])
    assert through("die:error", "die:ref") == through("die:ref", "die:ref") == 1.0
    assert through("die:z", "die:ref") == 0.0
    assert through("u1:effort", "u1") == 1.0
    assert through("u1:effort", "u2") == 0.0
    assert through("y2", "y2:noise") == 1.0
    assert np.count_nonzero(g.D) == 2 + 4 + 4
    for name in ("y1:noise", "die:ref"):
        assert not g.B[:, g.input_index([name])].any()


def test_the_error_follows_the_first_axis():
    turn = ports(z=[Poi("die", at=OFF_NODE, axes=("ry", "z"))])
    g = assemble_plant(some_modes(), turn).system
    assert np.array_equal(g.C[g.output_index(["die:error"])], -g.C[g.output_index(["die:ry"])])
    two = ports(
        z=[Poi("die", at=OFF_NODE), Poi("edge", at=Z8)], references=[Reference("edge")]
    )  # fmt: skip
    plant = assemble_plant(some_modes(), two)
    assert plant.z[:3] == ("die:z", "edge:z", "edge:error")
    assert plant.y[-1] == "edge:ref"


@pytest.mark.parametrize("delay", [0.0, 0.3, 1.0, 1.6, 2.0])
@pytest.mark.parametrize(
    "model", ["reduced", pytest.param("full with a mass", marks=pytest.mark.slow)]
)
def test_sampling_is_the_dense_matrix_exponential(delay, model):
    """Impulse responses of the sampled plant against scipy.linalg.expm of [0 I; -K/M -D/M].

    With a fraction of delay the force arrives in the interval: exponentials of both parts.
    """
    rate, h, steps = 2000.0, 1 / 2000.0, 40
    channels = Ports(u=[Actuator("u", at=INSET[0])], z=[Poi("p", at=OFF_NODE, axes=AXES)])
    see = np.array([motion_row(0.31, 0.26, axis) for axis in AXES])
    push = z_row(*INSET[0][:2])[None]
    if model == "reduced":
        rom = reduced()
        parts = (rom.M, rom.D, rom.K, see @ rom.T, push @ rom.T)
    else:
        rom = full(mass=0.5)
        parts = (*machine(0.01, mass=0.5), see, push)
    A, B, C = first_order(*parts)
    whole, fraction = int(delay), delay - int(delay)
    E, _ = hold(A, B, h)
    _, rest = hold(A, B, (1 - fraction) * h)
    part = hold(A, B, fraction * h)[1]
    x = np.zeros(A.shape[0])
    wanted = []
    for k in range(steps):
        wanted.append(C @ x)
        x = E @ x
        if k == whole:
            x = x + rest[:, 0]
        if fraction and k == whole + 1:
            x = x + hold(A, B, (1 - fraction) * h)[0] @ part[:, 0]
    g = assemble_plant(rom, channels).discretized(rate, delay=delay).Gzu
    state, found = g.B[:, 0], [g.D[:3, 0]]
    for _ in range(steps - 1):
        found.append(g.C[:3] @ state)
        state = g.A @ state
    size = np.abs(wanted).max(axis=0)
    assert np.abs((np.array(found) - wanted) / size).max() < 1e-7
    shifted = np.roll(wanted, 1, axis=0)
    assert np.abs((np.array(found) - shifted) / size).max() > 1e-2
    assert g.n_states == 2 * rom.M.shape[0] + whole + (fraction > 0)


def test_delay_acts_on_u_alone():
    plant = assemble_plant(some_modes(), ports()).discretized(1e4, delay=1.6)
    lines = [i for i, name in enumerate(plant.system.states) if ":delay" in name]
    assert len(lines) == 8
    assert not plant.B1[lines].any()
    assert not plant.process_noise[lines].any()
    effort = plant.system.output_index(["u1:effort"])
    assert not plant.system.C[effort].any()  # the command, not what arrives
    assert plant.D12[plant.z.index("u1:effort"), 0] == 1.0
    assert plant.delay == 1.6


@pytest.mark.slow
def test_rescaling_w_by_1e9():
    """A_d bit-equal, Q_d scaled to 1e-12; references and sensor noises stay sample values."""
    for model in (some_modes(0.001), full(mass=0.5)):
        one, other = (
            assemble_plant(model, ports(asd=asd)).discretized(1e4, delay=1) for asd in (1e-3, 1e6)
        )
        assert np.array_equal(one.system.A, other.system.A)
        assert np.array_equal(one.system.B, other.system.B)
        Q, Q9 = one.process_noise, other.process_noise
        size = np.sqrt(np.outer(Q.diagonal(), Q.diagonal()))
        assert np.all(np.abs(Q9 / 1e18 - Q) <= 1e-12 * size)
        assert Q.any()


def test_noise_per_sample_of_a_sensor():
    plant = assemble_plant(some_modes(), ports(sensor_asd=2e-12)).discretized(1e4)
    wanted = np.diag([4e-24 * 1e4 / 2] * 4 + [0.0])
    np.testing.assert_allclose(plant.sensor_noise, wanted, rtol=1e-12)


def test_refusals():
    with pytest.raises(ModelError, match="ports must be of type Ports, got list"):
        assemble_plant(some_modes(), [])
    with pytest.raises(ModelError, match="FEModel, Modes or ReducedModel, got dict"):
        assemble_plant({}, ports())
    with pytest.raises(ModelError, match=r"needs inputs .* and outputs .*Add ports"):
        assemble_plant(some_modes(), Ports(u=[Actuator("u", at=INSET[0])]))
    with pytest.raises(ModelError, match="Add ports"):
        assemble_plant(some_modes(), Ports(y=[Sensor("y", at=INSET[0])]))
    for at in ((0.7, 0.1, 0.0), (-1e-3, 0.1, 0.0), (0.1, 0.1, 0.02)):
        for model in (some_modes(), full(), reduced()):
            with pytest.raises(LabelError, match=r"(off|outside|not on) the"):
                assemble_plant(model, ports(z=[Poi("die", at=at)]))
    for wrong in ("82:z", "z8"):
        with pytest.raises(LabelError, match="no DOF"):
            assemble_plant(some_modes(), ports(u=[Actuator("u", at=wrong)]))
    with pytest.raises(LabelError, match="no DOF"):
        assemble_plant(some_modes(), ports(w=[Disturbance("d", at={"1:x": 1.0})]))
    with pytest.raises(LabelError, match="rz"):
        assemble_plant(some_modes(), ports(z=[Poi("die", at=(L / 2, L / 2, 0), axes=("rz",))]))
    with pytest.raises(LabelError, match="more than once"):
        assemble_plant(some_modes(), ports(y=[Sensor("die:z", at=Z8)]))
    with pytest.raises(
        LabelError, match=r"cannot be named 'y1:noise'.*plant and its observer make themselves"
    ):
        assemble_plant(some_modes(), ports(w=[Disturbance("y1:noise", at=Z8, asd=1.0)]))
