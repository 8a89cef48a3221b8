"""One H-infinity controller for a range of positions, beside those designed for one."""

import numpy as np
import pytest
from test_structured import judged, machine

import flexplant as fx
from flexplant.errors import ModelError


def moving(places=(0.0, 0.5, 1.0)):
    """The mass whose mode the sensor sees by 0.4 at one end and by -0.2 at the other."""
    return {x: machine(sight=0.4 - 0.6 * x) for x in places}


@pytest.mark.long
def test_one_controller_for_all_positions_beats_those_of_one():
    """Norms by dense matrices on machines made at each position, those between included."""
    found = fx.design_hinf(moving())
    norms = {x: judged(plant, found) for x, plant in moving().items()}
    said = found.certificate
    for x, norm in norms.items():
        assert said[f"norm at {x:g}"] == pytest.approx(norm, rel=2e-3)
    assert found.gamma == pytest.approx(max(norms.values()), rel=2e-3)
    assert said["worst position"] == max(norms, key=norms.get)
    middle = {x: judged(plant, found) for x, plant in moving((0.25, 0.75)).items()}
    assert said["norm between positions"] == pytest.approx(max(middle.values()), rel=2e-3)
    each = [fx.design_hinf(one) for one in moving().values()]
    assert found.lower <= min(alone.gamma for alone in each) * 1.001
    for alone in each:
        assert found.gamma < 0.99 * max(judged(plant, alone) for plant in moving().values())


@pytest.mark.slow
def test_a_scanning_plate_is_held_where_designs_for_a_place_are_unstable():
    plate = fx.kirchhoff_plate(
        size=(0.6, 0.6), thickness=0.0272, elements=(4, 4), density=2702, youngs_modulus=70e9,
        poisson_ratio=0.35,
    )  # fmt: skip
    corners = [(x, y, 0.0) for y in (0.1, 0.5) for x in (0.2, 0.4)]
    below = {"x": (-1, 0, 0)}
    ports = fx.Ports(
        u=[fx.Actuator(f"u{i}", at=p, asd=1e-3) for i, p in enumerate(corners)],
        z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z", "rx", "ry"), moves=below)],
        y=[fx.Sensor(f"y{i}", at=p, asd=1e-12, moves=below) for i, p in enumerate(corners)],
        references=[fx.Reference("die")],
        positions=[fx.plant.Position("x", range=(-0.1, 0.1))],
    )
    modes = fx.solve_modes(plate, count=5, damping=fx.ModalDamping(0.01))
    plant = fx.assemble_plant(modes, ports).discretized(4e3, delay=1)
    stands = {x: plant.at(x=x) for x in (-0.1, 0.0, 0.1)}
    one = fx.design_hinf(stands, bandwidth=30.0)
    centre = fx.design_hinf(plant, bandwidth=30.0)

    def radius(x, K):  # of plant and controller put together by hand
        g, k = plant.at(x=x).system, K.system
        B, C = g.B[:, g.input_index(k.outputs)], g.C[g.output_index(k.inputs)]
        assert not np.any(g.D[np.ix_(g.output_index(k.inputs), g.input_index(k.outputs))])
        A = np.block([[g.A + B @ k.D @ C, B @ k.C], [k.B @ C, k.A]])
        return np.abs(np.linalg.eigvals(A)).max()

    for x in np.linspace(-0.1, 0.1, 9):
        assert radius(x, one) < 1.0
    assert max(radius(x, centre) for x in (-0.1, 0.1)) > 1.0


def test_options_for_one_plant_are_refused():
    with pytest.raises(ModelError, match="leave out uncertain="):
        fx.design_hinf(moving(), uncertain=fx.testbeds.three_masses().uncertain(frequency=0.01))
