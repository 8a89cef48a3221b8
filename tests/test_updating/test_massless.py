"""Updates of free models with coordinates that have no mass, as MacNeal's reduction leaves them."""

import numpy as np
import pytest

import oracles_updating as oracle
from flexplant.errors import ModelError
from flexplant.identification import MeasuredModes
from flexplant.lti import Frf
from flexplant.reduction import MacNeal, reduce
from flexplant.updating import (
    AddedDamping,
    AddedMass,
    AddedStiffness,
    Eigenvalues,
    FrfResidual,
    eigenvalue_sensitivities,
    update,
)
from flexplant.updating.search import Objective

LINKS = [(i, i + 1, 900.0 + 40 * i) for i in range(7)]


@pytest.fixture
def free(make):
    return make([1, 2, 1.5, 1.2, 1.0, 1.7, 0.8, 1.1], LINKS, beta=2e-4)


@pytest.fixture
def rom(free):
    return reduce(free, MacNeal(["2:z", "7:z"], 4))


def exact(rom, mass=0.0, spring=0.0, damper=0.0):
    """Poles of the condensed matrices, by hand; the mass is at 2:z, the others between both."""
    M, D, K = (np.array(part) for part in (rom.M, rom.D, rom.K))
    M[0, 0] += mass
    between = np.zeros(len(K))
    between[:2] = 1.0, -1.0
    K += spring * np.outer(between, between)
    heavy = np.arange(0 if mass else 2, len(K))
    heavy = heavy[heavy != 1]
    light = np.setdiff1d(np.arange(len(K)), heavy)
    follow = -np.linalg.solve(K[np.ix_(light, light)], K[np.ix_(light, heavy)])
    Kc = K[np.ix_(heavy, heavy)] + K[np.ix_(heavy, light)] @ follow
    poles = oracle.poles(M[np.ix_(heavy, heavy)], D[np.ix_(heavy, heavy)], Kc)
    return poles[poles.imag > 1e-2]


@pytest.mark.slow
def test_a_mass_and_a_spring_on_a_massless_boundary_are_found(rom):
    poles = exact(rom, mass=0.4, spring=25.0)[:3]
    data = Eigenvalues(MeasuredModes(poles, modes=[2, 3, 4]))
    fit = update(rom, [AddedMass("2:z"), AddedStiffness("2:z", to="7:z")], [data])
    np.testing.assert_allclose(fit.values, [0.4, 25.0], rtol=1e-6)
    # the one rigid-body motion is left, and weighs the mass
    assert fit.model.rigid_body.shape[1] == 1
    R = fit.model.rigid_body
    np.testing.assert_allclose(R.T @ fit.model.M @ R, [[1.0]], rtol=1e-12)
    np.testing.assert_allclose(fit.model.modes().poles[1:4], poles, rtol=1e-7)


def test_sensitivities_of_the_free_massless_model(rom):
    S = eigenvalue_sensitivities(
        rom, [AddedMass("2:z"), AddedStiffness("2:z", to="7:z")], modes=[2, 3, 4]
    ).S
    # a mass from zero adds a mode far above: the others move smoothly from one side
    h = 5e-5
    mass = (4 * exact(rom, mass=h)[:3] - exact(rom, mass=2 * h)[:3] - 3 * exact(rom)[:3]) / (2 * h)
    np.testing.assert_allclose(S[:, 0], mass, rtol=1e-5)
    spring = (exact(rom, spring=1e-2)[:3] - exact(rom, spring=-1e-2)[:3]) / 2e-2
    np.testing.assert_allclose(S[:, 1], spring, rtol=1e-6, atol=1e-9)


def test_a_spring_to_the_ground_holds_the_free_massless_model(rom):
    M, D, K = (np.array(part) for part in (rom.M, rom.D, rom.K))
    K[0, 0] += 30.0
    s = 2j * np.pi * np.array([1.0, 2.0, 4.0])
    H = np.array([np.linalg.inv(z * z * M + z * D + K)[1, 0] for z in s])
    frf = Frf(s.imag / 2 / np.pi, H[None, None], inputs=["2:z"], outputs=["7:z"])
    fit = update(rom, [AddedStiffness("2:z")], [FrfResidual(frf)], start=[10.0])
    assert fit.values[0] == pytest.approx(30.0, rel=1e-7)
    assert fit.model.rigid_body.shape[1] == 0


def test_what_has_no_mass_is_named(rom):
    data = Eigenvalues(MeasuredModes(exact(rom)[:2], modes=[2, 3]))
    with pytest.raises(ModelError, match=r"2:z has a damper but no mass"):
        update(rom, [AddedDamping("2:z")], [data], start=[1.0])
    frf = Frf([1.0], np.ones((1, 1, 1)), inputs=["2:z"], outputs=["7:z"])
    objective = Objective(rom, [], [FrfResidual(frf, hold=100.0)])
    with pytest.raises(ModelError, match="mass in every coordinate"):
        objective.values(objective.begin(np.zeros(0)))
