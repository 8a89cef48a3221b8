"""Several changes at once are found, none is named where none was made, and misfit is said."""

import numpy as np
import pytest

import oracles_updating as oracle
from flexplant.errors import FlexplantWarning
from flexplant.identification import MeasuredModes
from flexplant.modes import solve_modes
from flexplant.reduction import DesiredDofs, reduce
from flexplant.structure import ModalDamping, PointMass
from flexplant.updating import AddedMass, Eigenvalues, localise
from flexplant.updating.family import Point, repeated_groups
from flexplant.updating.search import Objective


@pytest.fixture(scope="module")
def uneven(plate):
    """The paper's plate with two actuators, so that no place has a mirror image."""
    nearest = plate.model.dofs.nearest
    actuators = [
        PointMass(nearest((0.075, 0.225, 0.0), "z"), 1.0),
        PointMass(nearest((0.525, 0.15, 0.0), "z"), 0.6),
    ]
    loaded = plate.model.with_parts(actuators)
    modes = solve_modes(loaded, count=25, damping=ModalDamping(0.001))
    return reduce(modes, DesiredDofs(plate.grid))


def measured(model, hidden, seed, count=12, noise=1e-4):
    M = np.array(model.M)
    for label, mass in hidden.items():
        at = model.dofs.index(label)
        M[at, at] += mass
    poles = oracle.poles(M, model.D, model.K)
    poles = poles[poles.imag > 500][:count]
    rng = np.random.default_rng(seed)
    std = noise * np.abs(poles)
    error = (rng.normal(size=count) + 1j * rng.normal(size=count)) * std / np.sqrt(2)
    modes = MeasuredModes(poles + error, modes=range(4, 4 + count), covariance=std**2)
    return [Eigenvalues(modes)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(n, marks=pytest.mark.long) for n in (2, 3))])
def test_two_masses_are_found_together(plate, uneven, seed):
    """The best single places are often none of the two; what they leave shows the others."""
    rng = np.random.default_rng(100 + seed)
    hidden = {str(label): rng.uniform(0.1, 0.4) for label in rng.choice(plate.grid, 2, False)}
    masses = [AddedMass(label, name=label) for label in plate.grid]
    found = localise(uneven, masses, measured(uneven, hidden, seed), most=2)
    assert set(found.chosen) == set(hidden)
    for name, value in zip(found.chosen, found.chosen_values, strict=True):
        assert value == pytest.approx(hidden[name], rel=0.05)
    assert found.p_value > 1e-3
    assert found.dof == 22
    assert "RESIDUAL EXCEEDS NOISE" not in repr(found)


@pytest.mark.slow
def test_nothing_changed_names_nothing(plate, uneven):
    """Of 25 places each can fit noise a little: the criterion counts how many were tried."""
    masses = [AddedMass(label, name=label) for label in plate.grid]
    found = [localise(uneven, masses, measured(uneven, {}, seed), most=1) for seed in range(8)]
    # chi-square of one above 9.6, in 25 places that are not independent: 5 % at most
    named = sum(bool(one.chosen) for one in found)
    assert named <= 1
    # by the criterion without the number of choices more would have been named
    assert sum(one.bic.min() - 2 * np.log(25) < one.nothing_bic for one in found) > named


@pytest.mark.slow
def test_misfit_that_no_candidate_explains_is_said(plate, uneven):
    grid = plate.grid
    data = measured(uneven, {grid[7]: 0.3, grid[18]: 0.4}, seed=0)
    few = [AddedMass(label, name=label) for label in (grid[0], grid[4], grid[20])]
    with pytest.warns(FlexplantWarning, match=r"more than noise: chi-square.*It fits worst mode"):
        found = localise(uneven, few, data, most=2)
    assert found.p_value < 1e-4
    assert "RESIDUAL EXCEEDS NOISE" in repr(found)


@pytest.mark.slow
def test_long_work_shows_a_bar(uneven, capsys):
    data = measured(uneven, {uneven.dofs.labels[3]: 0.3}, 0)
    localise(
        uneven, [AddedMass(label) for label in uneven.dofs.labels], data, most=1, progress=True
    )
    assert "candidates: 100%" in capsys.readouterr().err
    localise(uneven, [AddedMass(uneven.dofs.labels[3])], data, most=1)
    assert capsys.readouterr().err == ""


def test_the_order_in_which_rounding_leaves_repeated_modes_decides_nothing(plate):
    """On other kernels equal modes change places: slopes and places found are the same."""
    model = plate.reduced(0.001, attached=True)
    data = measured(model, {str(plate.z8): 0.5}, seed=3)
    objective = Objective(model, [AddedMass(plate.z8)], data, prior=False)
    point = objective.begin(np.zeros(1))
    groups = repeated_groups(point.eigen.poles)
    assert [point.labels[group].tolist() for group in groups][:2] == [[7, 8], [9, 10]]
    slopes = objective.slopes(point)
    labels = point.labels.copy()
    for group in groups:
        labels[group] = labels[group[::-1]]
    again = objective.place(Point(objective.family, point.p, point.eigen, labels))
    np.testing.assert_allclose(
        objective.slopes(again), slopes, rtol=0, atol=1e-6 * np.abs(slopes).max()
    )
