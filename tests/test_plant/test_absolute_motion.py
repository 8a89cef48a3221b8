"""Inertial sensors and absolute POIs over a moving floor, against dense absolute coordinates."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import ModelError
from flexplant.lti import high_pass_filter, low_pass_filter
from flexplant.plant import BaseAcceleration, GroundSpring, Poi, Ports, Sensor, suspend
from flexplant.structure import FEModel
from flexplant.structure.unit_systems import units
from oracles_ports import chain, on_a_heavy_base, transmitted
from plates import make_plate

M, D, K = chain()
SPRING = np.diag([3e3, 0.0, 0.0, 0.0, 0.0])
DAMPER = np.diag([5.0, 0.0, 0.0, 0.0, 0.0])
FREQ = np.array([0.3, 3.0, 90.0, 260.0, 480.0])
S = 2j * np.pi * FREQ
#: corners of a geophone and of the floor's spectrum [Hz]
GEOPHONE, FLOOR = 1.0, 0.2


def corner(freq, s, order=2):
    """Butterworth high-pass written apart."""
    p = s / (2 * np.pi * freq)
    return p / (p + 1) if order == 1 else p**2 / (p**2 + np.sqrt(2) * p + 1)


def free():
    dofs = fx.DofSet(range(1, 6), ["x"] * 5, np.outer(np.arange(5.0), [1.0, 0.0, 0.0]))
    return FEModel(M, K, D, dofs=dofs)


def floor(**changes):
    return BaseAcceleration("floor", "x", **changes)


def plant(sensors, w, pois=(), model=None):
    ports = Ports(w=w, u=[fx.Actuator("u", at="1:x")], z=pois, y=sensors)
    model = suspend(free(), GroundSpring("1:x", 3e3, 5.0)) if model is None else model
    return fx.assemble_plant(model, ports)


def test_an_accelerometer_on_a_free_body_does_not_move_with_the_floor():
    sensors = [
        Sensor("inertial", at="3:x", quantity="acceleration"),
        Sensor("beside", at="3:x", quantity="acceleration", absolute=False),
    ]
    found = plant(sensors, [floor(asd=1e-5)], model=free())
    shown = fx.frequency_response(found.Gyw, FREQ)
    np.testing.assert_allclose(shown["inertial", "floor"], 0.0, atol=1e-12)
    np.testing.assert_allclose(shown["beside", "floor"], -1.0, rtol=1e-9)
    # exactly nothing at once: a white floor may be sampled behind springs
    assert found.Gyw.D[0, 0] == 0.0


def test_inertial_sensors_and_pois_of_a_suspended_structure():
    """Every kind of integral: by the sensor's zeros, the floor's, or one of each."""
    geophone, shape = high_pass_filter(GEOPHONE, order=2), high_pass_filter(FLOOR, order=2)
    sensors = [
        Sensor("acc", at="3:x", quantity="acceleration"),
        Sensor("geo", at="3:x", quantity="velocity", absolute=True, dynamics=geophone),
        Sensor("bare", at="3:x", quantity="velocity", absolute=True),
        Sensor("place", at="3:x", absolute=True, dynamics=high_pass_filter(GEOPHONE)),
        Sensor("gap", at={"3:x": 1.0, "1:x": -1.0}, absolute=True, dynamics=low_pass_filter(400.0)),
        Sensor("relative", at="3:x"),
    ]
    pois = [Poi("die", at="5:x", axes=("x",), absolute=True), Poi("own", at="5:x", axes=("x",))]
    found = plant(sensors, [floor(shape=shape)], pois)
    shown = fx.frequency_response(found.system, FREQ)
    moved = np.array([transmitted(M, D + DAMPER, K + SPRING, np.ones(5), s) for s in S])
    ground = corner(FLOOR, S) / S**2
    expected = {
        "acc": S**2 * moved[:, 2],
        "geo": S * corner(GEOPHONE, S) * moved[:, 2],
        "bare": S * moved[:, 2],
        "place": corner(GEOPHONE, S, order=1) * moved[:, 2],
        "gap": (moved[:, 2] - moved[:, 0]) / (S / (2 * np.pi * 400.0) + 1),
        "relative": moved[:, 2] - 1,
        "die:x": moved[:, 4],
        "own:x": moved[:, 4] - 1,
    }
    for name, wanted in expected.items():
        np.testing.assert_allclose(shown[name, "floor"], wanted * ground, rtol=2e-8, err_msg=name)
    # the zeros cost no state: ten of modes, two of the floor, two, one and one of the sensors
    assert found.system.n_states == 10 + 2 + 4
    # a white floor needs as many zeros in the sensor
    white = plant([sensors[0], sensors[1]], [floor(asd=1e-5)])
    shown = fx.frequency_response(white.Gyw, FREQ)
    np.testing.assert_allclose(shown["geo", "floor"], expected["geo"] / S**2, rtol=2e-8)
    assert white.system.n_states == 10 + 2
    # actuators are seen as before
    pushed = fx.frequency_response(found.Gyu, FREQ)["acc", "u"]
    own = [s * s * np.linalg.solve(s * s * M + s * (D + DAMPER) + K + SPRING, np.eye(5)[0])[2]
           for s in S]  # fmt: skip
    np.testing.assert_allclose(pushed, own, rtol=1e-8)


@pytest.mark.parametrize("last", ["high-pass", "low-pass"])
@pytest.mark.parametrize("roll", [1, 2])
def test_a_floor_of_several_filters(last, roll):
    """A high-pass in series with low-passes has its zeros at 0 Hz in either order, in any unit."""
    parts = [high_pass_filter(FLOOR, order=2), low_pass_filter(40.0, order=roll)]
    shape = fx.lti.series(*(parts if last == "low-pass" else parts[::-1]))
    units = np.geomspace(1e-3, 1e3, shape.n_states)
    scaled = fx.StateSpace(units[:, None] * shape.A / units, units[:, None] * shape.B,
                           shape.C / units, shape.D)  # fmt: skip
    pois = [Poi("die", at="5:x", axes=("x",), absolute=True)]
    for one in (shape, scaled):
        found = plant([Sensor("y", at="1:x")], [floor(shape=one)], pois)
        shown = fx.frequency_response(found.Gzw, FREQ)["die:x", "floor"]
        moved = [transmitted(M, D + DAMPER, K + SPRING, np.ones(5), s)[4] for s in S]
        p = S / (2 * np.pi * 40.0)
        low = 1.0 / (p + 1) if roll == 1 else 1.0 / (p**2 + np.sqrt(2) * p + 1)
        np.testing.assert_allclose(shown, moved * corner(FLOOR, S) * low / S**2, rtol=1e-6)
    # one zero is too few for a displacement
    few = fx.lti.series(high_pass_filter(FLOOR), low_pass_filter(40.0, order=roll))
    with pytest.raises(ModelError, match="has 1"):
        plant([Sensor("y", at="1:x")], [floor(shape=few)], pois)


def test_modes_of_a_suspended_structure_let_a_white_floor_pass():
    """Springs that bend the shapes a little leave nothing of the floor at once."""
    size = {"size": (0.4, 0.3, 0.05), "elements": (4, 3, 1)}
    block = fx.solid_block(**size, density=2700, youngs_modulus=70e9, poisson_ratio=0.33)
    places = [(x, y, 0.0) for x in (0.0, 0.4) for y in (0.0, 0.3)]
    springs = [GroundSpring(at, 2e4, direction=d) for at in places for d in "xyz"]
    modes = fx.solve_modes(suspend(block, springs), count=14, damping=fx.ModalDamping(0.005))
    ports = Ports(
        w=[BaseAcceleration("floor", "z", asd=1e-5)],
        z=[Poi("die", at=(0.2, 0.2, 0.05))],
        y=[Sensor("a", at=(0.3, 0.1, 0.05), quantity="acceleration")],
    )
    found = fx.assemble_plant(modes, ports)
    assert found.Gyw.D[0, 0] == 0.0
    # far below the suspension it moves with the floor
    low = fx.frequency_response(found.Gyw, np.array([0.01]))["a", "floor"]
    np.testing.assert_allclose(low, 1.0, rtol=1e-4)


def test_what_would_grow_without_bound_is_refused():
    geo = Sensor("geo", at="3:x", quantity="velocity", absolute=True)
    with pytest.raises(ModelError, match=r"'geo' is an absolute velocity.*'floor' has none"):
        plant([geo], [floor()])
    with pytest.raises(ModelError, match=r"need 1 zero .*high_pass_filter\(0.1, order=1\)"):
        plant([geo.replace(dynamics=low_pass_filter(100.0))], [floor(shape=low_pass_filter(100.0))])
    pois = [Poi("die", at="5:x", axes=("x",), absolute=True)]
    with pytest.raises(ModelError, match=r"'die:x' is an absolute displacement.*has 1"):
        plant([geo], [floor(shape=high_pass_filter(0.1))], pois)
    with pytest.raises(ModelError, match="absolute of 'y' is True"):
        Sensor("y", at="3:x", absolute="yes")


def test_a_tilting_floor_under_a_plate_of_modes():
    """Rotation about a point, places between nodes, modes and FE model alike, POI moved."""
    plate = make_plate(elements=(4, 4)).with_damping(fx.ModalDamping(0.01))
    corners = [(x, y, 0.0) for x in (0.0, 0.6) for y in (0.0, 0.6)]
    springs = [GroundSpring(at, 900.0, 0.5) for at in corners]
    about = (0.1, 0.2, 0.0)
    w = [BaseAcceleration("tilt", "rx", about=about, shape=high_pass_filter(FLOOR, order=2))]
    place = (0.33, 0.47, 0.0)
    ports = Ports(
        w=w,
        u=[fx.Actuator("u", at=(0.1, 0.1, 0.0))],
        z=[Poi("die", at=(0.2, 0.2, 0.0), axes=("z", "rx"), absolute=True)],
        y=[Sensor("acc", at=place, quantity="acceleration"),
           Sensor("turn", at=place, direction="rx", quantity="velocity", absolute=True)],
    )  # fmt: skip
    whole = suspend(plate, springs)
    dense = [np.asarray(m.toarray()) if hasattr(m, "toarray") else m
             for m in (whole.M, whole.D, whole.K)]  # fmt: skip
    kind, y = np.array(plate.dofs.directions), plate.dofs.xyz[:, 1]
    r = np.where(kind == "z", y - about[1], 0.0) + (kind == "rx")
    s = 2j * np.pi * np.array([0.5, 4.0, 30.0])
    moved = np.array([transmitted(*dense, r, p) * corner(FLOOR, p) / p**2 for p in s])
    rows = {"acc": s**2 * (moved @ plate.dofs.row(place, "z")),
            "turn": s * (moved @ plate.dofs.row(place, "rx")),
            "die:z": moved @ plate.dofs.row(place, "z")}  # fmt: skip
    free_modes = fx.solve_modes(plate, count=24, damping=fx.ModalDamping(0.01))
    for model, rtol in ((whole, 1e-7), (suspend(free_modes, springs), 2e-4)):
        found = fx.assemble_plant(model, ports).at({"die": place})
        shown = fx.frequency_response(found.system, s.imag / (2 * np.pi))
        for name, wanted in rows.items():
            np.testing.assert_allclose(shown[name, "tilt"], wanted, rtol=rtol, err_msg=name)
        along = fx.assemble_plant(model, ports).along("die", [place])
        np.testing.assert_allclose(along.C[0], found.system.C[found.system.output_index(
            ["die:z", "die:rx"])], atol=1e-12)  # fmt: skip


def test_skyhook_damping_on_a_geophone():
    """The textbook's transmissibility: a damper to the sky, which no relative sensor can make."""
    m, k, d = 8.0, 3e3, 5.0
    dofs = fx.DofSet([1], ["x"], [[0.0, 0.0, 0.0]])
    body = suspend(FEModel([[m]], [[0.0]], [[0.0]], dofs=dofs), GroundSpring("1:x", k, d))
    ports = Ports(
        w=[BaseAcceleration("floor", "x", asd=1e-5)],
        u=[fx.Actuator("u", at="1:x", direction="x")],
        z=[Poi("die", at="1:x", axes=("x",))],
        y=[Sensor("geo", at="1:x", quantity="velocity", absolute=True, asd=1e-9,
                  dynamics=high_pass_filter(0.01, order=2)),
           Sensor("acc", at="1:x", quantity="acceleration")],
    )  # fmt: skip
    found = fx.assemble_plant(body, ports)
    sky = 200.0
    loop = fx.lti.lft(found.system, fx.StateSpace([], [], [], [[-sky]], inputs=["geo"],
                                                  outputs=["u"]))  # fmt: skip
    freq = np.array([1.0, 3.0, 20.0])
    s = 2j * np.pi * freq
    wanted = (d * s + k) / (m * s**2 + (d + sky * corner(0.01, s)) * s + k)
    shown = fx.frequency_response(loop, freq)["acc", "floor"]
    np.testing.assert_allclose(shown, wanted, rtol=1e-9)
    # and it is a plant to design on: sampled, observed, its error as the certificate says
    observer = fx.design_kalman(found.with_ports(ports.replace(y=ports.y[:1])).discretized(1e3))
    assert 0 < observer.rms("die:x") < 1e-4


def test_held_models_feel_the_mass_that_couples_them_to_their_supports():
    """A clamped plate against one on a heavy base; without the coupling it is 3 per cent off."""
    plate = make_plate(elements=(2, 2)).with_damping(fx.structure.Rayleigh(0.0, 1e-6))
    edge = plate.dofs.where(box=[(0, 0, 0), (0, 0.6, 0)])
    held = plate.fixed(edge)
    again = plate.fixed(list(edge)[:4]).fixed(list(edge)[4:])
    tilt = BaseAcceleration("tilt", "ry", about=(0.1, 0.2, 0.0))
    at = (0.1, 0.3, 0.0)  # between held and free nodes
    ports = Ports(
        w=[BaseAcceleration("floor", "z"), tilt],
        z=[Poi("die", at=(0.6, 0.3, 0.0))],
        y=[Sensor("acc", at=at, quantity="acceleration")],
    )
    full = [m.toarray() if hasattr(m, "toarray") else m for m in (plate.M, plate.D, plate.K)]
    kind, x = np.array(plate.dofs.directions), plate.dofs.xyz[:, 0]
    rigid = {"floor": (kind == "z") * 1.0,
             "tilt": np.where(kind == "z", -(x - 0.1), 0.0) + (kind == "ry")}  # fmt: skip
    freq = np.array([20.0, 40.0, 100.0])
    base = plate.dofs.indices(edge)
    for model in (held, again):
        shown = fx.frequency_response(fx.assemble_plant(model, ports).system, freq)
        lost = fx.assemble_plant(model.replace(held_inertia=None), ports)
        lost = fx.frequency_response(lost.system, freq)
        for name, r in rigid.items():
            moved = np.array([on_a_heavy_base(*full, base, r, 2j * np.pi * f) for f in freq])
            wanted = moved @ plate.dofs.row((0.6, 0.3, 0.0), "z")
            np.testing.assert_allclose(shown["die:z", name], wanted, rtol=1e-5)
            assert name == "tilt" or abs(lost["die:z", name][0] / wanted[0] - 1) > 0.03
            total = (2j * np.pi * freq[:, None]) ** 2 * moved + r
            np.testing.assert_allclose(
                shown["acc", name], total @ plate.dofs.row(at, "z"), rtol=1e-5
            )
    # in any units
    dofs = plate.dofs.replace(interpolation=None)
    plain = FEModel(plate.M, plate.K, plate.D, dofs=dofs).fixed(edge)
    unit = units("mm", "t")
    small = FEModel(plate.M, plate.K, dofs=dofs)
    scale = np.where(dofs.kinds < 3, 1e-3, 1.0)
    milli = FEModel(
        small.M.toarray() * np.outer(scale, scale) / (unit.mass * unit.length**2),
        small.K.toarray() * np.outer(scale, scale) / (unit.mass * unit.length**2),
        dofs=dofs.replace(xyz=dofs.xyz * 1e3),
    )
    back = milli.fixed(edge).converted(length="mm", mass="t")
    np.testing.assert_allclose(back.held_inertia, plain.held_inertia, atol=1e-12)


def test_an_accelerometer_on_a_held_structure_shows_the_inertia_of_what_holds_it():
    """A light beam carries 2 kg: 3e-4 of the floor's motion is felt at once, and at 1 kHz alone."""
    beam = fx.beam(
        length=0.2, elements=1, area=1e-5, inertia=8.3e-14, density=7850, youngs_modulus=210e9
    ).with_parts(fx.PointMass("2:z", 2.0))
    held = Ports(
        w=[BaseAcceleration("floor", "z")],
        u=[fx.Actuator("u", at="2:z")],
        y=[Sensor("acc", at="2:z", quantity="acceleration")],
    )
    found = fx.assemble_plant(beam.fixed(["1:z", "1:ry"]), held)
    freq = np.array([10.0, 50.0, 100.0, 1000.0])
    labels = list(beam.dofs.labels)
    i = [labels.index("2:z"), labels.index("2:ry")]
    rigid = np.array([name.endswith(":z") * 1.0 for name in labels])
    M, K = beam.M.toarray(), beam.K.toarray()
    w2 = (2 * np.pi * freq) ** 2
    moved = [np.linalg.solve((K - s * M)[np.ix_(i, i)], -(M @ rigid)[i])[0] for s in w2]
    shown = fx.frequency_response(found.Gyw, freq)["acc", "floor"]
    np.testing.assert_allclose(shown, 1.0 - w2 * moved, rtol=1e-9)


def test_lumped_masses_do_not_feel_each_other_at_once():
    """Rounding of 9e-17 in D stopped a filter and a loop without delay."""
    model = fx.chain(masses=[2.0, 1.0, 0.5, 1.0], stiffnesses=[1e6, 4e5, 9e5], dampings=[20, 5, 60])
    far = Sensor("a3", at="3:x", quantity="acceleration", asd=1e-5)
    own = Ports(
        w=[fx.Disturbance("b", at="1:x", asd=5e-4)],
        u=[fx.Actuator("u1", at="1:x")],
        z=[Poi("die", at="2:x", axes=("x",))],
        y=[Sensor("y1", at="1:x", asd=1e-9), far],
    )
    plant = fx.assemble_plant(model, own)
    assert not plant.Gyu.D.any() and not plant.Gyw.D[:, :1].any()
    assert fx.design_kalman(plant.discretized(3e3, delay=1.0)).rms("die:x") > 0
