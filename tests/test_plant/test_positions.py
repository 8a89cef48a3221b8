"""Ports that move with the machine: rows at a position, by hand and by interpolation."""

import re

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import LabelError, ModelError
from flexplant.plant import PlaceTable, Position
from plates import make_plate

L = 0.6
CORNERS = [(0.15, 0.05), (0.45, 0.05), (0.15, 0.55), (0.45, 0.55)]
INSET = [(x, y) for y in (0.15, 0.45) for x in (0.15, 0.45)]
MOVES = {"x": (-1.0, 0.0, 0.0), "y": (0.0, -1.0, 0.0)}
POSITIONS = [Position("x", range=(-0.1, 0.1)), Position("y", range=(0.01, 0.05))]


def ports(x=None, y=None, **more):
    """A stage below heads and coils on its frame; at a position by hand where that is given."""
    here = x is not None
    moves = {} if here else {"moves": MOVES}
    place = lambda p: (p[0] - (x or 0.0), p[1] - (y or 0.0), 0.0)  # noqa: E731
    return fx.Ports(
        w=[fx.Disturbance("amp", at=place((0.3, 0.2)), asd=1e-3, **moves)],
        u=[fx.Actuator(f"u{i}", at=place(p), latency=1e-5, **moves) for i, p in enumerate(INSET)],
        z=[fx.Poi("die", at=place((0.3, 0.3)), axes=("z", "rx", "ry"), **moves)],
        y=[
            *(fx.Sensor(f"y{i}", at=place(p), asd=1e-12, **moves) for i, p in enumerate(CORNERS)),
            fx.Sensor(
                "acc", at={place((0.2, 0.3)): 0.5, place((0.4, 0.3)): -0.5},
                quantity="acceleration", dynamics=fx.lti.low_pass_filter(3e3), asd=1e-6, **moves,
            ),
            fx.Sensor("fixed", at=(0.1, 0.1, 0.0), asd=1e-12),
        ],
        references=[fx.Reference("die")],
        **({} if here else {"positions": POSITIONS} | more),
    )  # fmt: skip


@pytest.fixture(scope="module")
def modes():
    return fx.solve_modes(make_plate(), count=16, damping=fx.ModalDamping(0.01))


def same(found, wanted):
    for part in "ABCD":
        ours, theirs = getattr(found.system, part), getattr(wanted.system, part)
        np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-12 * np.abs(theirs).max())
    assert found.w == wanted.w
    assert found.asd == wanted.asd


@pytest.mark.slow
def test_a_position_is_the_plant_with_its_ports_there(modes):
    plant = fx.assemble_plant(modes, ports())
    same(plant, fx.assemble_plant(modes, ports(0.0, 0.03)))  # x starts at 0, y in its middle
    assert "at x = 0 (-0.1 to 0.1), y = 0.03 (0.01 to 0.05)" in repr(plant)
    there = plant.at(x=0.031)
    by_hand = fx.assemble_plant(modes, ports(0.031, 0.03))
    same(there, by_hand)
    same(there.at(x=-0.07, y=0.02), fx.assemble_plant(modes, ports(-0.07, 0.02)))
    sampled = plant.discretized(1e4, delay=1.3)
    by_hand = by_hand.discretized(1e4, delay=1.3)
    same(sampled.at(x=0.031), by_hand)
    # the order of sampling and moving does not matter
    same(there.discretized(1e4, delay=1.3), by_hand)
    np.testing.assert_allclose(
        sampled.at(x=0.031).process_noise, by_hand.process_noise, atol=1e-12 * 1e-6
    )


def test_a_family_costs_rows_and_no_modes(modes):
    plant = fx.assemble_plant(modes, ports()).discretized(1e4, delay=1)
    for x in np.linspace(-0.1, 0.1, 5):
        there = plant.at(x=x)
        assert there.assembled.realisation is plant.assembled.realisation
        np.testing.assert_array_equal(there.modal_blocks, plant.modal_blocks)


@pytest.mark.slow
def test_weights_blocks_reduction_and_files_go_along(modes, tmp_path):
    plant = fx.assemble_plant(modes, ports()).discretized(1e4, delay=1.3)
    weights = fx.stage_weights(plant, 40.0)
    moving, there = plant.weighted(weights), plant.at(x=0.05)
    same(moving.at(x=0.05), there.weighted(weights))
    filtered = fx.lti.append(
        *[fx.lti.low_pass_filter(2e3).replace(inputs=[n], outputs=[n]) for n in ("y0",)]
    )
    filtered = fx.lti.tustin(filtered, 1e4)
    both = plant.through(filtered).weighted(z={"die:error": 2.0}, w={"amp": None})
    wanted = there.through(filtered).weighted(z={"die:error": 2.0}, w={"amp": None})
    same(both.at(x=0.05), wanted)
    moving.save(tmp_path / "moving.npz")
    same(fx.load(tmp_path / "moving.npz").at(x=0.05), there.weighted(weights))
    small = fx.reduce(modes, fx.DesiredDofs(fx.select_dofs(modes, 16).labels))
    reduced = fx.assemble_plant(small, ports())
    same(reduced.at(x=0.05), fx.assemble_plant(small, ports(0.05, 0.03)))


def test_a_table_that_was_measured(modes):
    """Straight in x, bent in y as a rail is: linear between the measured places."""
    places = [[0.4, 0.3, 0.0], [0.3, 0.302, 0.0], [0.2, 0.3, 0.0]]
    table = PlaceTable({"x": [-0.1, 0.0, 0.1]}, places)

    def plant(at, **more):
        given = fx.Ports(
            u=[fx.Actuator("u", at=(0.15, 0.15, 0.0))], y=[fx.Sensor("y", at=at, **more)],
            positions=POSITIONS[:1],
        )  # fmt: skip
        return fx.assemble_plant(modes, given)

    moving = plant((0.3, 0.3, 0.0), moves=table)
    same(moving, plant((0.3, 0.302, 0.0)))
    same(moving.at(x=0.05), plant((0.25, 0.301, 0.0)))
    same(moving.at(x=-0.1), plant((0.4, 0.3, 0.0)))


def test_a_port_that_moves_can_be_put_elsewhere(modes):
    plant = fx.assemble_plant(modes, ports()).at(x=0.05)
    moved = plant.at({"y0": (0.12, 0.04, 0.0)})
    np.testing.assert_allclose(moved.assembled.ports.sensor("y0").at, (0.12, 0.04, 0.0))
    back = moved.at(x=0.0).assembled.ports.sensor("y0").at
    np.testing.assert_allclose(back, (0.17, 0.04, 0.0), atol=1e-12)
    back = moved.at(x=0.0).assembled.ports.sensor("y1").at
    np.testing.assert_allclose(back, (0.45, 0.02, 0.0), atol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_a_position_at_the_end_of_its_range_is_inside_but_for_rounding(seed):
    rng = np.random.default_rng(seed)
    low, high = np.sort(10.0 ** rng.uniform(-4, 2) * rng.uniform(-1, 1, 2)).tolist()
    end, sign = ((low, -1), (high, 1))[seed % 2]
    x = fx.plant.Position("x", range=(low, high))
    for excess in 10.0 ** rng.uniform(-16, -6.1, 5):
        assert low <= x.within(end + sign * excess * (high - low)) <= high
    for excess in 10.0 ** rng.uniform(-5.9, 1, 5):
        given = end + sign * excess * (high - low)
        with pytest.raises(ModelError, match="outside its range") as refusal:
            x.within(given)
        numbers = re.findall(r"-?[\d.]+(?:e-?\d+)?", str(refusal.value).split(":")[0])
        assert [float(one) for one in numbers] == [given, low, high]


def test_refusals(modes):
    plant = fx.assemble_plant(modes, ports())
    for given, error, words in (
        ({"x": 0.11}, ModelError, "outside its range from -0.1 to 0.1"),
        ({"x": np.nan}, ModelError, "NaN"),
        ({"z": 0.0}, LabelError, "no position 'z'"),
    ):
        with pytest.raises(error, match=words):
            plant.at(**given)
    with pytest.raises(LabelError, match=r"moves with 'x', which is not among the positions"):
        fx.Ports(y=[fx.Sensor("y", at=(0, 0, 0), moves={"x": (1, 0, 0)})])
    with pytest.raises(LabelError, match="is at a node: '1:z'"):
        fx.Sensor("y", at="1:z", moves={"x": (1, 0, 0)})
    with pytest.raises(ModelError, match="a direction for each position"):
        fx.Actuator("u", at=(0, 0, 0), moves=(1, 0, 0))
    with pytest.raises(ModelError, match="give the least"):
        Position("x", range=(0.1, -0.1))
    with pytest.raises(LabelError, match="a word that can be a keyword"):
        Position("x y", range=(0, 1))
    with pytest.raises(LabelError, match="is off the plate"):
        fx.assemble_plant(modes, ports(positions=[Position("x", range=(-1, 1)), POSITIONS[1]])).at(
            x=L
        )
    short = PlaceTable({"x": [0.0, 0.05]}, np.zeros((2, 3)))
    with pytest.raises(ModelError, match="does not span position 'x'"):
        fx.Ports(y=[fx.Sensor("y", at=(0, 0, 0), moves=short)], positions=POSITIONS[:1])
    with pytest.raises(ModelError, match="must increase"):
        PlaceTable({"x": [0.0, 0.0]}, np.zeros((2, 3)))
    with pytest.raises(LabelError, match="a table stands where the table says"):
        table = PlaceTable({"x": [-0.1, 0.1]}, [[0.4, 0.3, 0], [0.2, 0.3, 0]])
        given = fx.Ports(
            u=[fx.Actuator("u", at=(0.1, 0.1, 0.0))],
            y=[fx.Sensor("y", at=(0.3, 0.3, 0), moves=table)], positions=POSITIONS[:1],
        )  # fmt: skip
        fx.assemble_plant(modes, given).at({"y": (0.1, 0.1, 0.0)})


@pytest.mark.slow
def test_a_map_of_the_range(modes):
    """Decoupling by lever arms, modes by their shapes, figures as given."""
    given = ports().replace(
        w=[],
        values={},
        positions=[Position("x", range=(-0.1, 0.1)), Position("y", range=(-0.02, 0.02))],
        y=[fx.Sensor(f"y{i}", at=(*p, 0.0), moves=MOVES) for i, p in enumerate(CORNERS)],
        u=[fx.Actuator(f"u{i}", at=(*p, 0.0)) for i, p in enumerate(INSET)],
        z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z", "rx", "ry"))],
    )
    plant = fx.assemble_plant(modes, given)
    found = plant.map({"first": lambda p: p.system.C[-3, 0]}, points={"x": 5, "y": [0.0, 0.02]})
    assert found.figures["first"].shape == (5, 2)
    assert found.figures["first"][1, 1] == plant.at(x=-0.05, y=0.02).system.C[-3, 0]
    # heads shifted by s see z - s tilt: off by s in units of their levers, nearly: the plate bends
    levers = 0.5 * np.ptp(np.array(CORNERS), axis=0)[:2]
    for i, x in enumerate(np.linspace(-0.1, 0.1, 5)):
        arm = np.hypot(x / levers[0], np.array([0.0, 0.02]) / levers[1])
        np.testing.assert_allclose(found.decoupling[i, :, 0], arm, rtol=0.02, atol=0.01)
    np.testing.assert_allclose(found.decoupling[..., 1], 0.0, atol=1e-9)
    shapes = abs(make_plate().dofs.rows(np.array([(*p, 0.0) for p in CORNERS]), "z") @ modes.phi)
    omega = modes.omega[3:]
    best = (shapes[:, 3:] / shapes[:, 3:].max(axis=1, keepdims=True)).max(axis=0)
    np.testing.assert_allclose(found.seen[2, 0], best, rtol=1e-6)
    assert omega.size == len(found.modes)
    assert "decoupling off by up to" in repr(found)
    one = plant.map({"first": lambda p: p.system.C[-3, 0]}, points={"x": 5, "y": [0.0, 0.01]})
    assert [ax.get_xlabel() for ax in fx.plot.position_map(one)] == ["position x [mm]"] * 3
    line = fx.plant.PositionMap(
        {"x": one.grid["x"]}, one.decoupling[:, 0], one.seen[:, 0], one.reached[:, 0],
        one.modes, {"first": one.figures["first"][:, 0]},
    )  # fmt: skip
    panels = fx.plot.position_map(line)
    np.testing.assert_allclose(panels[0].lines[0].get_ydata(), 100 * one.decoupling[:, 0, 0])
    assert panels[-1].get_xlabel() == "position x [mm]"
    with pytest.raises(LabelError, match="has no positions"):
        fx.testbeds.three_masses().map()
    with pytest.raises(ModelError, match=r"'figure' at x = -0\.1"):
        plant.map(lambda p: "poor", points=3)
