"""Controllers over a range of positions, judged where they were not designed."""

import pytest
from test_structured import judged, law, machine

from flexplant.errors import ModelError
from flexplant.lti import StateSpace
from flexplant.plant import StandardPlant
from flexplant.synthesis import TunedLaws, design_structured
from flexplant.synthesis.hinf.moved_design import PlantRange


def moving(places=(0.0, 0.5, 1.0)):
    """The mass whose mode the sensor sees by 0.4 at one end and by -0.2 at the other."""
    return {x: machine(sight=0.4 - 0.6 * x) for x in places}


@pytest.mark.long
def test_one_law_for_all_positions_is_judged_between_them():
    """Norms by dense matrices on machines made at each position, those between included."""
    found = design_structured(moving(), TunedLaws(law()), starts=1)
    norms = {x: judged(plant, found) for x, plant in moving().items()}
    said = found.certificate
    for x, norm in norms.items():
        assert said[f"norm at {x:g}"] == pytest.approx(norm, rel=2e-3)
    assert found.gamma == pytest.approx(max(norms.values()), rel=2e-3)
    assert said["worst position"] == max(norms, key=norms.get)
    middle = {x: judged(plant, found) for x, plant in moving((0.25, 0.75)).items()}
    assert said["norm between positions"] == pytest.approx(max(middle.values()), rel=2e-3)
    assert said["worst position between"] == max(middle, key=middle.get)


def test_plants_of_several_machines_are_no_range():
    with pytest.raises(ModelError, match="other channels or another rate"):
        two = {0.0: machine(), 1.0: machine(rate=400.0)}
        design_structured(two, TunedLaws(law()))
    with pytest.raises(ModelError, match="mapping with 1 or more"):
        design_structured({}, TunedLaws(law()))
    with pytest.raises(ModelError, match="a position"):
        design_structured({"left": machine()}, TunedLaws(law()))


def test_between_two_places_matrices_are_linear():
    one = StateSpace([[-1.0]], [[1.0]], [[2.0]], [[0.0]])
    two = StateSpace([[-3.0]], [[5.0]], [[4.0]], [[8.0]])
    plants = [StandardPlant.from_statespace(g, u=g.inputs, y=g.outputs) for g in (one, two)]
    found = PlantRange.of({4.0: plants[1], 0.0: plants[0]}).between[2.0].system
    assert [getattr(found, m).item() for m in "ABCD"] == [-2.0, 3.0, 3.0, 4.0]
