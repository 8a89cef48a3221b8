"""Numbers of measured poles, on a plate whose modes 7 and 8 are a repeated pair."""

from functools import cache

import numpy as np
import pytest

from flexplant.errors import LabelError, ModelError
from flexplant.identification import MeasuredModes, identify_modes, numbered
from flexplant.lti import Frf
from flexplant.modes import solve_modes
from flexplant.structure import FEModel, ModalDamping
from oracles_identification import modal_frf
from plates import make_plate

SPOTS = [(0.0, 0.0), (0.6, 0.0), (0.0, 0.6), (0.6, 0.6), (0.3, 0.0), (0.0, 0.3)]


@cache
def modes():
    return solve_modes(make_plate(), count=14, damping=ModalDamping(0.01))


def answer(numbers, shift=1.0, mix=0.3):
    """Poles of some modes, 3 % away by default, modes 7 and 8 turned within their span."""
    labels = [modes().dofs.nearest((*p, 0.0), "z") for p in SPOTS]
    phi = np.array([modes().at(label) for label in labels])
    turned = phi.copy()
    turned[:, 6] = np.cos(mix) * phi[:, 6] + np.sin(mix) * phi[:, 7]
    turned[:, 7] = np.cos(mix) * phi[:, 7] - np.sin(mix) * phi[:, 6]
    places = np.array(numbers) - 1
    return MeasuredModes(
        modes().poles[places] * shift, shapes=(1 + 2j) * turned[:, places], dofs=labels
    )


@pytest.mark.parametrize("shift", [0.97, 1.0, 1.03])
def test_numbers_are_those_of_the_model(shift):
    found = numbered(answer([9, 4, 7, 8, 6], shift), modes())
    assert found.modes[:2] == (9, 4)
    assert sorted(found.modes[2:4]) == [7, 8]
    assert found.modes[4] == 6


def test_shapes_decide_where_frequencies_would_mislead():
    """Mode 4 measured at mode 5's frequency and the other way round."""
    right = answer([4, 5])
    crossed = right.replace(poles=right.poles[::-1])
    assert numbered(crossed, modes(), tolerance=0.5).modes == (4, 5)
    bare = MeasuredModes(crossed.poles)
    assert numbered(bare, modes(), tolerance=0.5).modes == (5, 4)


@pytest.mark.parametrize("mix", [0.0, 0.3, np.pi / 4, 1.2, np.pi / 2, 2.0])
@pytest.mark.parametrize("numbers", [(7, 8), (8, 7)])
def test_a_repeated_pair_that_split_is_numbered_by_frequency(mix, numbers):
    """A mass splits a pair: any shapes of the span, the lower pole is the lower number."""
    found = answer([*numbers, 4], mix=mix)
    poles = found.poles * np.array([0.975, 0.96, 1.0])
    assert numbered(found.replace(poles=poles), modes()).modes == (8, 7, 4)


@pytest.mark.parametrize("split", [-1e-9, 0.0, 1e-9])
@pytest.mark.parametrize("seen", [[9], [10], [9, 10]])
def test_one_pole_of_a_repeated_pair_has_the_lowest_number(seen, split):
    """Modes 9 and 10 are the second pair; rounding splits it either way."""
    omega = modes().omega.copy()
    omega[8], omega[9] = omega[8] * (1 - abs(split)), omega[8] * (1 + split)
    for shift in (0.97, 1.0, 1.03):
        found = numbered(answer([*seen, 4], shift), modes().replace(omega=np.sort(omega)))
        assert sorted(found.modes) == [4, 9, 10][: len(seen) + 1]


def test_poles_without_partner_are_refused_or_left_out():
    good = answer([4, 6])
    stranger = MeasuredModes(
        [*good.poles, -30 + 3300j],
        shapes=np.column_stack([good.shapes, np.arange(6.0) - 2.2]),
        dofs=good.dofs,
        covariance=[1.0, 2.0, 3.0],
    )
    with pytest.raises(ModelError, match="525"):
        numbered(stranger, modes())
    found = numbered(stranger, modes(), partial=True)
    assert found.modes == (4, 6)
    assert np.allclose(np.diag(found.covariance), [0.5, 1.0, 0.5, 1.0])
    with pytest.raises(ModelError, match="no separate mode"):
        numbered(stranger.select([2]), modes(), partial=True)


def test_places_may_be_given_by_point():
    found = answer([4, 6, 9])
    named = found.replace(dofs=[f"y{i}" for i in range(1, 7)])
    at = {f"y{i}": (*p, 0.0) for i, p in enumerate(SPOTS, 1)}
    assert numbered(named, modes(), at=at).modes == (4, 6, 9)
    with pytest.raises(LabelError, match=r"the model has no DOF 'y1'.*at=\{'y1': place or sensor"):
        numbered(named, modes())


@pytest.mark.parametrize(
    ("measured", "model", "options", "error", "cause"),
    [
        ("poles", modes, {}, ModelError, "measured must be"),
        (answer, lambda: 3, {}, ModelError, "model must be"),
        (answer, modes, {"tolerance": 0.0}, ModelError, "tolerance"),
        (answer, modes, {"least_mac": 1.0}, ModelError, "least_mac"),
        (answer, modes, {"at": ["1:z"]}, LabelError, "at"),
        (answer, lambda: solve_modes(make_plate(), count=3), {}, ModelError, "elastic"),
    ],
)
def test_bad_arguments_are_refused(measured, model, options, error, cause):
    value = measured([4, 6]) if callable(measured) else measured
    with pytest.raises(error, match=cause):
        numbered(value, model(), **options)


@pytest.mark.parametrize("seed", range(3))
def test_a_folded_pole_does_not_take_the_number_of_a_mode_that_no_sensor_sees(seed):
    """Of two separate machines the sensors see one: shapes of the other are rounding there."""
    rng = np.random.default_rng(seed)
    masses, springs = rng.uniform(1.0, 2.0, 6), rng.uniform(1e6, 2e6, 6)
    K = np.diag(springs + np.append(springs[1:], 0.0))
    K -= np.diag(springs[1:], 1) + np.diag(springs[1:], -1)
    K[3, 2] = K[2, 3] = 0.0
    turn = np.eye(6) + 1e-13 * rng.normal(size=(6, 6))  # as rounding of a solver couples them
    model = FEModel(np.diag(masses), turn.T @ K @ turn / 2 + (turn.T @ K @ turn).T / 2)
    known = solve_modes(model, damping=ModalDamping(0.005))
    places, ends = ["1:x", "2:x"], ["1:x"]
    phi, by = (np.array([known.at(one) for one in names]) for names in (places, ends))
    mine = np.flatnonzero(np.abs(phi[0]) > 1e-6)
    hidden = np.setdiff1d(np.arange(6), mine)
    freq = np.arange(1.0, 600.0, 0.5)
    folded = known.omega[hidden[0]] * 1.01 * (-0.036 + 1j)
    poles = np.append(known.poles[mine], folded)
    shapes = np.column_stack([phi[:, mine], phi[:, hidden[0]] / np.abs(phi[0, hidden[0]]) * 0.1])
    by = np.append(by[:, mine], [[0.1]], axis=1)
    H = modal_frf(freq, poles, shapes, by)
    frf = Frf(freq, H, variance=np.full(H.shape, 1e-24))
    found = identify_modes(frf, dofs={"y1": "1:x", "y2": "2:x", "u1": "1:x"})
    assert np.min(np.abs(found.freq / (np.abs(folded) / 2 / np.pi) - 1)) < 1e-3
    assert numbered(found, known, partial=True).modes == tuple(mine + 1)
    with pytest.raises(ModelError, match="like size"):
        numbered(found, known)
