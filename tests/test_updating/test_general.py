"""Updates with bounds, priors, mixed residuals and other methods; what they say of themselves."""

import numpy as np
import pytest

import flexplant as fx
import oracles_updating as oracle
from flexplant import load
from flexplant.errors import FlexplantWarning, LabelError, ModelError, ShapeError
from flexplant.identification import MeasuredModes
from flexplant.lti import Frf
from flexplant.updating import (
    AddedDamping,
    AddedMass,
    AddedStiffness,
    Antiresonances,
    Eigenvalues,
    FrfResidual,
    GaussNewton,
    MatrixParameter,
    ModeDamping,
    ModeShapes,
    StaticCompliance,
    TrustRegion,
    correlate,
    fdac,
    frac,
    identifiability,
    localise,
    mac,
    split,
    update,
    validate,
)
from flexplant.updating.search.least_squares import _data_loss

LINKS = [(0, None, 90), (0, 1, 110), (1, 2, 70), (2, 3, 130), (3, None, 60)]
MASSES = [1, 2, 1.5, 1.2]


@pytest.fixture
def chain(make):
    return make(MASSES, LINKS, beta=2e-3)


def changed(model, mass=(), stiffness=()):
    M, D, K = (np.array(part) for part in (model.M, model.D, model.K))
    for i, value in mass:
        M[i, i] += value
    for i, value in stiffness:
        K[i, i] += value
    return M, D, K


def measured(parts, noise=None, seed=0, modes=(1, 2, 3, 4)):
    poles = oracle.poles(*parts)[np.array(modes) - 1]
    if noise is None:
        return MeasuredModes(poles, modes=modes)
    rng = np.random.default_rng(seed)
    error = rng.normal(size=poles.size) + 1j * rng.normal(size=poles.size)
    std = noise * np.abs(poles)
    noisy = poles + error * std / np.sqrt(2)
    return MeasuredModes(noisy, modes=modes, covariance=std**2)


def responses(parts, freq, places):
    M, D, K = parts
    s = 2j * np.pi * freq
    H = np.array([np.linalg.inv(z * z * M + z * D + K) for z in s])
    names = [f"{i + 1}:z" for i in places]
    return Frf(freq, np.moveaxis(H[:, places][:, :, [0]], 0, 2), inputs=["1:z"], outputs=names)


MASS = [AddedMass("2:z"), AddedMass("3:z")]


# ---- every kind of residual finds the change


@pytest.mark.slow
def test_every_residual_finds_the_change_and_all_together(chain):
    parts = changed(chain, mass=[(1, 0.3)], stiffness=[(3, 8.0)])
    M, D, K = parts
    _, V = np.linalg.eigh(np.linalg.solve(np.sqrt(M), np.linalg.solve(np.sqrt(M), K).T))
    shapes = np.linalg.solve(np.sqrt(M), V)
    poles = measured(parts)
    held = np.ix_([1, 2, 3], [1, 2, 3])
    zeros = oracle.poles(M[held], D[held], K[held])
    given = {
        "poles": [Eigenvalues(poles)],
        "frf": [FrfResidual(responses(parts, np.linspace(0.4, 3.2, 15), [0, 2]))],
        "zeros": [Antiresonances(zeros, "1:z", "1:z")],
    }
    given["all"] = [
        *(r for listed in given.values() for r in listed),
        StaticCompliance(np.linalg.inv(K)[0, 2], "1:z", "3:z"),
    ]
    parameters = [AddedMass("2:z"), AddedStiffness("4:z")]
    for residuals in given.values():
        fit = update(chain, parameters, residuals, method=TrustRegion())
        assert fit.converged
        np.testing.assert_allclose(fit.values, [0.3, 8.0], rtol=1e-6)
    assert np.all(np.isfinite(shapes))


def test_shapes_alone_find_a_spring(chain):
    undamped = chain.replace(D=None)
    M, _, K = changed(undamped.replace(D=0 * np.eye(4)), stiffness=[(1, 15.0)])
    omega2, phi = oracle.la.eigh(K, M)
    poles = MeasuredModes(1j * np.sqrt(omega2), modes=[1, 2, 3, 4])
    at = [f"{i}:z" for i in range(1, 5)]
    residual = ModeShapes(poles, phi * [1, -2, 3e3, 1e-3], at)
    fit = update(undamped, [AddedStiffness("2:z")], [residual])
    assert fit.values[0] == pytest.approx(15.0, rel=1e-7)


@pytest.mark.slow
def test_trust_region_and_gauss_newton_agree_with_the_paper(plate):
    target = oracle.truth(0.01)
    rom = plate.reduced(0.01, True)
    parameters = [AddedMass(plate.z8), AddedDamping(plate.z8)]
    residuals = [Eigenvalues(MeasuredModes(target, modes=[6, 7]))]
    paper = update(rom, parameters, residuals)
    assert len(paper.history) <= 5
    for method in (TrustRegion(), GaussNewton(truncate=1e-12)):
        fit = update(rom, parameters, residuals, method=method)
        np.testing.assert_allclose(fit.values, paper.values, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(fit.history.eigenvalues[-1], target, rtol=1e-8)


# ---- parameters


def test_stiffness_between_dofs_and_matrix_and_mode_parameters(chain):
    K = np.array(chain.K)
    spring = np.zeros((4, 4))
    spring[np.ix_([1, 2], [1, 2])] = [[1, -1], [-1, 1]]
    _, phi = oracle.la.eigh(K, chain.M)
    omega = np.sqrt(oracle.la.eigh(K, chain.M)[0])
    force = chain.M @ phi[:, 1]
    D = chain.D + 2 * 0.01 * omega[1] * np.outer(force, force)
    parts = (np.array(chain.M), D, K + 12.0 * spring + 0.1 * K)
    parameters = [AddedStiffness("2:z", to="3:z"), MatrixParameter("all", dK=K), ModeDamping(2)]
    fit = update(chain, parameters, [Eigenvalues(measured(parts))])
    np.testing.assert_allclose(fit.values, [12.0, 0.1, 0.01], rtol=1e-6)
    assert parameters[0].name == "stiffness at 2:z to 3:z"


def test_a_full_matrix_is_projected_through_T(plate):
    rom = plate.reduced(0.01, True)
    full = MatrixParameter("all", dK=plate.model.K).matrices(rom)[2]
    np.testing.assert_allclose(full, rom.T.T @ (plate.model.K @ rom.T), rtol=1e-12)
    with pytest.raises(ShapeError, match="7 DOFs"):
        MatrixParameter("odd", dK=np.eye(7)).matrices(rom)


def test_a_size_by_differences_of_the_full_model(plate, thicker_plate):
    from plates import PLATE, make_plate

    thickness = PLATE["thickness"]
    density = MatrixParameter.from_difference(
        "density", lambda v: make_plate(density=v), value=PLATE["density"]
    )
    rom = plate.reduced(0.01, False)
    dM, dD, dK = density.matrices(rom)
    np.testing.assert_allclose(dM, rom.M / PLATE["density"], rtol=1e-7, atol=1e-9 * rom.M.max())
    assert dD is None
    assert dK is None
    size = MatrixParameter.from_difference(
        "thickness", lambda v: make_plate(thickness=v), value=thickness, unit="m"
    )
    np.testing.assert_allclose(
        size.matrices(rom)[2], 3 * rom.T.T @ plate.model.K @ rom.T / thickness, rtol=1e-5, atol=1e-3
    )
    with pytest.raises(ShapeError, match="DOFs"):
        MatrixParameter.from_difference(
            "n", lambda v: make_plate(elements=(4, 4) if v > 1 else (2, 2)), value=1.0
        )


# ---- bounds, priors, starts


@pytest.mark.slow
def test_bounds_hold_and_are_flagged(chain):
    parts = changed(chain, mass=[(1, 0.3), (2, 0.2)])
    residuals = [Eigenvalues(measured(parts, 1e-4))]
    free = update(chain, MASS, residuals, prior=False)
    assert free.at_bound == ()
    tight = [AddedMass("2:z", bounds=(0.0, 0.2)), AddedMass("3:z", bounds=(0.0, None))]
    with pytest.warns(FlexplantWarning, match="leaves more than noise"):
        fit = update(chain, tight, residuals, prior=False)
    assert fit.at_bound == ("mass at 2:z",)
    assert fit.values[0] == pytest.approx(0.2, abs=1e-6)
    assert "at a bound: mass at 2:z" in repr(fit)
    inside = [AddedMass("2:z", bounds=(0.0, 2.0)), AddedMass("3:z", bounds=(0.0, 2.0))]
    np.testing.assert_allclose(
        update(chain, inside, residuals, prior=False).values, free.values, rtol=1e-6
    )


@pytest.mark.slow
def test_a_prior_is_one_more_measurement(chain):
    parts = changed(chain, mass=[(1, 0.3), (2, 0.2)])
    residuals = [Eigenvalues(measured(parts, 0.02))]
    plain = update(chain, MASS, residuals, method=TrustRegion())
    known = [AddedMass("2:z", prior=(0.25, 1e-5)), AddedMass("3:z", prior=(0.0, 1e3))]
    fit = update(chain, known, residuals)
    assert fit.values[0] == pytest.approx(0.25, abs=1e-4)
    assert fit.std[0] == pytest.approx(1e-5, rel=1e-3)
    assert abs(plain.values[0] - 0.25) > 1e-3
    off = update(chain, known, residuals, prior=False)
    assert np.abs((off.values - plain.values) / plain.std).max() < 1e-5
    # without noise nothing weighs the prior against the data
    with pytest.warns(FlexplantWarning, match="are not used"):
        exact = update(chain, known, [Eigenvalues(measured(parts))])
    np.testing.assert_allclose(exact.values, [0.3, 0.2], rtol=1e-7)
    # bounds alone: the model itself, a third of the farther bound
    bounded = [AddedMass("2:z", bounds=(-0.03, 0.06)), AddedMass("3:z", prior=(0.2, 1e-4))]
    stated = [AddedMass("2:z", prior=(0.0, 0.02), bounds=(-0.03, 0.06)), bounded[1]]
    weak = [Eigenvalues(measured(changed(chain, mass=[(1, 0.02), (2, 0.2)]), 0.02))]
    np.testing.assert_allclose(
        update(chain, bounded, weak).values, update(chain, stated, weak).values, rtol=1e-9
    )


def test_posterior_covariance_is_that_of_the_linear_problem(chain):
    parts = changed(chain, mass=[(1, 0.3), (2, 0.2)])
    known = [AddedMass("2:z", prior=(0.25, 0.05)), AddedMass("3:z", prior=(0.1, 0.1))]
    poles = measured(parts, 0.02)
    fit = update(chain, known, [Eigenvalues(poles)])
    M = np.array(chain.M) + np.diag([0, *fit.values, 0])
    J = np.empty((8, 2))
    for b in range(2):
        unit = np.zeros((4, 4))
        unit[b + 1, b + 1] = 1.0
        slope = [
            oracle.complex_step(M, chain.D, chain.K, [unit, 0 * unit, 0 * unit], a)[1]
            for a in range(4)
        ]
        J[:, b] = np.concatenate([np.real(slope), np.imag(slope)])
    information = J.T @ np.linalg.inv(poles.covariance) @ J + np.diag([0.05**-2, 0.1**-2])
    np.testing.assert_allclose(fit.covariance, np.linalg.inv(information), rtol=1e-6)
    low, high = fit.interval(0.95)[0]
    assert (high - low) / 2 == pytest.approx(1.959964 * fit.std[0], rel=1e-6)


@pytest.mark.long
def test_draws_have_the_covariance_of_the_fit(chain):
    parts = changed(chain, mass=[(1, 0.3), (2, 0.2)])
    residuals = [Eigenvalues(measured(parts, 0.005))]
    fit = update(chain, MASS, residuals, method=TrustRegion())
    draws = fit.sample(4000, rng=1)
    np.testing.assert_allclose(np.cov(draws.T), fit.covariance, rtol=0.15, atol=3e-6)


def test_several_starts_keep_the_best(chain):
    parts = changed(chain, mass=[(1, 0.3), (2, 0.2)])
    inside = [AddedMass("2:z", bounds=(-1.5, 3.0)), AddedMass("3:z", bounds=(-1.2, 3.0))]
    residuals = [Eigenvalues(measured(parts))]
    fit = update(chain, inside, residuals, starts=4, rng=3)
    np.testing.assert_allclose(fit.values, [0.3, 0.2], rtol=1e-6)
    assert fit.starts.begin.shape == (4, 2)
    assert fit.starts.cost.min() < 1e-10
    again = update(chain, inside, residuals, starts=[[0.1, 0.1], [0.5, 0.0]])
    np.testing.assert_allclose(again.values, [0.3, 0.2], rtol=1e-6)
    with pytest.raises(ModelError, match="cannot be drawn"):
        update(chain, MASS, residuals, starts=3)
    with pytest.raises(ShapeError, match="starts"):
        update(chain, inside, residuals, starts=[[0.1]])
    with pytest.raises(ModelError, match="outside its bounds"):
        update(chain, inside, residuals, start=[9.0, 0.0])


# ---- other methods


@pytest.mark.slow
def test_a_robust_loss_shrugs_off_an_outlier(chain):
    parts = changed(chain, mass=[(1, 0.3), (2, 0.2)])
    poles = measured(parts, 1e-3)
    wrong = np.array(poles.poles)
    wrong[2] *= 1.05
    residuals = [Eigenvalues(MeasuredModes(wrong, modes=[1, 2, 3, 4], covariance=poles.covariance))]
    with pytest.warns(FlexplantWarning, match="fits worst mode 3 "):
        plain = update(chain, MASS, residuals, method=TrustRegion())
    truth = np.array([0.3, 0.2])
    for loss, share in [("cauchy", 0.2), ("soft_l1", 0.3), ("huber", 0.3)]:
        robust = update(chain, MASS, residuals, method=TrustRegion(loss=loss))
        assert np.abs(robust.values - truth).max() < share * np.abs(plain.values - truth).max()


@pytest.mark.parametrize("name", ["huber", "soft_l1", "cauchy"])
def test_losses_have_the_derivatives_they_state(name):
    rho = _data_loss(name, 4)
    z = np.array([0.3, 0.9, 1.7, 40.0, 9.0])
    near, far = rho(z + 1e-5), rho(z - 1e-5)
    np.testing.assert_allclose((near[:2] - far[:2]) / 2e-5, rho(z)[1:], rtol=1e-6, atol=1e-9)
    # priors are no outliers; small residuals count as squares
    assert rho(z)[:, 4].tolist() == [9.0, 1.0, 0.0]
    np.testing.assert_allclose(rho(np.full(5, 1e-6))[:2], [[1e-6] * 5, [1.0] * 5], rtol=1e-5)


def test_truncation_bounds_what_cannot_be_told(chain):
    parts = changed(chain, mass=[(1, 0.3)])
    # a mass everywhere from one pole: the sum of all effects is known, nothing else
    everywhere = [AddedMass(f"{i}:z") for i in range(1, 5)]
    residuals = [Eigenvalues(measured(parts, 1e-4, modes=(1, 2)))]
    short = update(chain, everywhere, residuals, method=GaussNewton(truncate=1e-3))
    assert np.linalg.norm(short.values) < 1.0
    assert short.covariance is None
    assert short.history.error[-1] < 1e-2 * short.history.error[0]


# ---- before and after


@pytest.mark.slow
def test_identifiability_names_what_is_missing(chain, plate):
    poles = measured(changed(chain, mass=[(1, 0.3)]), 1e-3, modes=(1,))
    everywhere = [AddedMass(f"{i}:z") for i in range(1, 5)]
    answer = identifiability(chain, everywhere, [Eigenvalues(poles)])
    assert answer.rank == 1 or answer.rank == 2
    assert answer.mixed
    assert "not distinguished" in repr(answer)
    full = measured(changed(chain, mass=[(1, 0.3)]), 1e-3)
    good = identifiability(chain, MASS, [Eigenvalues(full)])
    assert good.rank == 2
    assert not good.mixed
    assert not good.unseen
    fit = update(chain, MASS, [Eigenvalues(full)], method=TrustRegion(), start=[1e-9, 0])
    assert np.all(good.std / fit.std > 0.3)
    assert np.all(good.std / fit.std < 3)
    # the torsion mode does not see a mass on its nodal line; others do
    rom = plate.reduced(0.01, True)
    torsion = Eigenvalues(MeasuredModes([-15 + 1530j], modes=[4]))
    blind = identifiability(rom, [AddedMass(plate.z8), AddedMass(plate.grid[0])], [torsion])
    assert blind.unseen == (f"mass at {plate.z8}",)
    assert 4 not in blind.missing[f"mass at {plate.z8}"]
    assert np.isinf(blind.std[0])
    # mirror images: every mode moves with both alike, so none is advised
    image = plate.model.dofs.nearest((0.3, 0.45, 0.0), "z")
    pair = Eigenvalues(MeasuredModes(oracle.truth(0.01), modes=[6, 7]))
    both = [AddedMass(plate.z8), AddedMass(image)]
    alike = identifiability(plate.reduced(0.01, False), both, [pair])
    assert alike.mixed == ((both[0].name, both[1].name),)
    assert alike.missing == {both[0].name: (), both[1].name: ()}
    assert f"no eigenvalue separates {both[0].name}:" in repr(alike)
    # places without symmetry: the modes advised do tell them apart
    two = [AddedMass(plate.grid[0]), AddedMass(plate.grid[6]), AddedMass(plate.grid[7])]
    first = identifiability(rom, two, [pair.select([6])])
    assert first.mixed
    more = first.missing[two[0].name]
    assert more
    told = MeasuredModes([-1 + 100j] * len(more), modes=more)
    assert identifiability(rom, two, [pair.select([6]), Eigenvalues(told)]).rank > first.rank


def test_a_single_parameter_that_no_residual_sees():
    """The middle of three masses is at rest in mode 2: nothing to compare its column with."""
    free = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    drawing = fx.reduce(fx.solve_modes(free, count=3), fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    poles = [Eigenvalues(MeasuredModes([630j], modes=[2]))]
    found = identifiability(drawing, [AddedMass("2:x")], poles)
    assert (found.rank, found.unseen) == (0, ("mass at 2:x",))
    assert np.isinf(found.std[0])
    assert found.missing == {"mass at 2:x": (3,)}
    assert "0 of 1 combination," in repr(found)
    assert identifiability(drawing, [AddedMass("1:x")], poles).rank == 1


@pytest.mark.slow
def test_localisation_finds_z8_up_to_the_plates_symmetry(plate):
    M, K = oracle.plate()
    D = oracle.modal_damping(M, K, 0.01)
    at = oracle.z_dof(0.3, 0.15)
    M[at, at] += 0.5
    rom = plate.reduced(0.01, True)
    candidates = [AddedMass(label) for label in plate.grid]
    hidden = f"mass at {plate.z8}"
    poles = oracle.poles(M, D, K)[:6]
    rng = np.random.default_rng(2)
    std = 2e-5 * np.abs(poles)
    noise = (rng.normal(size=6) + 1j * rng.normal(size=6)) * std / np.sqrt(2)
    data = MeasuredModes(poles + noise, modes=range(4, 10), covariance=std**2)
    found = localise(rom, candidates, [Eigenvalues(data)], most=2)
    assert found.chosen == (hidden,)
    assert found.chosen_values[0] == pytest.approx(0.5, rel=1e-3)
    # its three mirror images come next, all others far behind
    nearest = plate.model.dofs.nearest
    images = {
        f"mass at {nearest((x, y, 0), 'z')}" for x, y in [(0.15, 0.3), (0.45, 0.3), (0.3, 0.45)]
    }
    assert set(found.ranking[:4]) == {hidden} | images
    assert found[hidden] > 1 - 1e-4
    assert found[found.ranking[4]] < 0.99
    # told apart by little: said with names
    assert found.alike == (hidden,)
    assert set(found.rivals) == images
    assert "differs by less than 1% of the data from: mass at" in repr(found)
    assert all(name in repr(found) for name in images)
    rows = found.table.splitlines()
    assert rows[1].startswith(hidden)
    assert rows[1].endswith("chosen")
    assert [row.split()[-1] for row in rows[2:5]] == ["rival"] * 3
    assert rows[-1] == "and 13 more"
    assert "1.0000" in rows[1]
    # as much noise as hides the truncated compliance: poles cannot tell mirror images
    std = 1e-3 * np.abs(poles)
    loud = MeasuredModes(poles + 50 * noise, modes=range(4, 10), covariance=std**2)
    found = localise(rom, candidates, [Eigenvalues(loud)], most=1)
    assert set(found.alike) == {hidden} | images
    assert "AMBIGUOUS, 4 alike: " in repr(found)
    assert all(name in repr(found) for name in [hidden, *images])
    assert sum(row.endswith("alike") for row in found.table.splitlines()) == 4


@pytest.mark.long
def test_localisation_beside_a_wrong_stiffness(plate):
    """Hidden 0.5 kg and 2 % of stiffness: alone z8 is not found, with the nuisance it is."""
    rom = plate.reduced(0.01, True)
    M, K = oracle.plate()
    D = oracle.modal_damping(M, K, 0.01)
    at = oracle.z_dof(0.3, 0.15)
    M[at, at] += 0.5
    poles = oracle.poles(M, D, 1.02 * K)[:6]
    rng = np.random.default_rng(3)
    std = 2e-5 * np.abs(poles)
    noise = (rng.normal(size=6) + 1j * rng.normal(size=6)) * std / np.sqrt(2)
    data = [Eigenvalues(MeasuredModes(poles + noise, modes=range(4, 10), covariance=std**2))]
    masses = [AddedMass(label, name=label) for label in plate.grid]
    stiffer = MatrixParameter("stiffness", dK=rom.K)
    found = localise(rom, masses, data, nuisance=[stiffer], most=1)
    assert found.chosen == (plate.z8,)
    assert found.chosen_values[0] == pytest.approx(0.5, rel=2e-3)
    assert found.nuisance == ("stiffness",)
    assert found.nuisance_values[0] == pytest.approx(0.02, rel=2e-3)
    assert "with stiffness = 0.0" in repr(found)
    with pytest.warns(FlexplantWarning, match=r"leaves more than noise.*nuisance="):
        alone = localise(rom, masses, data, most=1)
    assert alone.chosen != (plate.z8,) or abs(alone.chosen_values[0] - 0.5) > 0.1
    with pytest.raises(ModelError, match="both a candidate and a nuisance"):
        localise(rom, masses, data, nuisance=masses[:1])
    with pytest.raises(ModelError, match="data do not determine"):
        localise(rom, masses[:3], [data[0].select([4])], nuisance=masses[3:6])


@pytest.mark.slow
def test_localisation_says_when_nothing_changed(chain):
    data = Eigenvalues(measured(changed(chain), 1e-3, seed=4))
    found = localise(chain, [AddedMass(f"{i}:z") for i in range(1, 5)], [data])
    assert found.chosen == ()
    assert "no change" in repr(found)
    two = changed(chain, mass=[(0, 0.2)], stiffness=[(3, 9.0)])
    pool = [
        *(AddedMass(f"{i}:z") for i in range(1, 5)),
        *(AddedStiffness(f"{i}:z") for i in (2, 4)),
    ]
    found = localise(chain, pool, [Eigenvalues(measured(two, 1e-4))])
    assert set(found.chosen) == {"mass at 1:z", "stiffness at 4:z"}
    with pytest.raises(ModelError, match="most"):
        localise(chain, MASS, [data], most=0)
    with pytest.raises(LabelError, match="candidate"):
        found["mass at 9:z"]


@pytest.mark.slow
def test_validation_on_unused_data(chain):
    parts = changed(chain, mass=[(1, 0.03), (2, 0.02)])
    frf = responses(parts, np.linspace(0.4, 3.2, 30), [0, 2])
    first, rest = split(FrfResidual(frf), share=0.5, rng=1)
    assert sorted([*first.lines, *rest.lines]) == list(range(30))
    good = validate(chain, MASS, [first], [rest])
    assert good.helped
    assert good.unused[1] < 1e-6 < good.unused[0]
    assert good.after.frac.min() > 1 - 1e-9 > good.before.frac.max()
    assert "unused data" in repr(good)
    # a parameter that is not to blame fits its own mode and spoils the others
    poles = Eigenvalues(measured(parts))
    bad = validate(chain, [AddedStiffness("1:z")], [poles.select([1])], [poles.select([2, 3, 4])])
    assert bad.fitted[1] < 1e-2 * bad.fitted[0]
    assert not bad.unused[1] < 0.3 * bad.unused[0]
    with pytest.raises(ModelError, match="empty"):
        split(poles, share=0.01)
    with pytest.raises(ModelError, match="apart"):
        split(StaticCompliance(1.0, "1:z", "2:z"))


def test_validation_from_a_start(chain):
    """Before is at the start, not at zero; the way from there leaves K positive definite."""

    def compliance(k, i):
        return np.linalg.inv(chain.K + np.diag([0.0, k, 0.0, 0.0]))[i, i]

    lowest = -1.0 / compliance(0.0, 1)  # K is singular there
    start, truth, std = 0.6 * lowest, 0.3 * lowest, 1e-6
    one, other = (
        StaticCompliance(compliance(truth, i), *2 * [f"{i + 1}:z"], std=std) for i in (1, 2)
    )
    found = validate(chain, [AddedStiffness("2:z")], [one], [other], start=[start])
    for side, i in ((found.fitted, 1), (found.unused, 2)):
        expected = abs(compliance(truth, i) - compliance(start, i)) / std
        assert side[0] == pytest.approx(expected, rel=1e-9, abs=0)
        assert side[1] < 1e-6 * expected


def test_correlation_before_and_after(chain):
    parts = changed(chain, mass=[(1, 0.3), (2, 0.2)])
    poles = measured(parts)
    before = correlate(chain, [Eigenvalues(poles)])
    expected = np.abs(oracle.poles(chain.M, chain.D, chain.K)) / np.abs(poles.poles) - 1
    np.testing.assert_allclose(before.freq_error, expected, rtol=1e-6)
    fit = update(chain, MASS, [Eigenvalues(poles)])
    after = correlate(fit.model, [Eigenvalues(poles)])
    assert np.abs(after.freq_error).max() < 1e-9
    assert "frequencies within" in repr(after)


def test_four_corner_sensors_do_not_pair_distant_modes(plate):
    """0.7 % of stiffness: every mode is found at 0.35 %, though the corners see many alike."""
    rom = plate.reduced(0.01, False)
    omega2, phi = oracle.la.eigh(1.007 * oracle.plate()[1], oracle.plate()[0])
    corners = [plate.model.dofs.nearest((x, y, 0.0), "z") for x in (0.0, 0.6) for y in (0.0, 0.6)]
    rows = [plate.model.dofs.index(label) for label in corners]
    omega = np.sqrt(omega2[3:13])
    poles = MeasuredModes((1j - 0.01) * omega, modes=range(4, 14))
    seen = correlate(rom, [ModeShapes(poles, phi[rows, 3:13], corners)])
    assert np.abs(seen.freq_error).max() < 0.01
    # by the oracle's own shapes: which of them the corners see alike; a repeated pair as a span
    spans = np.split(np.arange(10), np.flatnonzero(np.diff(omega) > 1e-3 * omega[:-1]) + 1)
    assert max(map(len, spans)) == 2
    alike = np.eye(10, dtype=bool)
    moved = [np.abs(phi[rows][:, span + 3]).max() > 1e-3 for span in spans]  # no node at all four
    bases = [oracle.la.orth(phi[rows][:, span + 3], rcond=1e-3) for span in spans]
    for i, one in enumerate(spans):
        for j, other in enumerate(spans[i + 1 :], i + 1):
            if not (moved[i] and moved[j]):
                continue
            angle = oracle.la.subspace_angles(bases[i], bases[j]).min()
            alike[np.ix_(one, other)] = alike[np.ix_(other, one)] = np.cos(angle) ** 2 > 0.9
        if np.linalg.cond(phi[rows][:, one + 3]) > 10.0:
            alike[np.ix_(one, one)] = True
    joined = np.linalg.matrix_power(alike.astype(int), 10) > 0  # what is alike in turn
    for group in seen.alike:
        assert joined[np.ix_(np.array(group) - 4, np.array(group) - 4)].all()
    together = sum(len(group) * (len(group) - 1) for group in seen.alike)
    assert together == np.count_nonzero(joined) - 10
    assert together > 0
    assert f"cannot distinguish the shapes of modes {seen.alike[0][0]}, " in repr(seen)
    everywhere = [plate.model.dofs.index(label) for label in plate.grid]
    seen = correlate(rom, [ModeShapes(poles, phi[everywhere, 3:13], plate.grid)])
    assert seen.alike == ()
    assert "cannot distinguish" not in repr(seen)


@pytest.mark.slow
def test_a_fit_and_its_correlation_pair_alike(plate):
    """Shapes at four corners: the modes that the fit compares are those that are shown."""
    rom = plate.reduced(0.01, False)
    omega2, phi = oracle.la.eigh(1.05 * oracle.plate()[1], oracle.plate()[0])
    corners = [plate.model.dofs.nearest((x, y, 0.0), "z") for x in (0.0, 0.6) for y in (0.0, 0.6)]
    rows = [plate.model.dofs.index(label) for label in corners]
    poles = MeasuredModes((1j - 0.01) * np.sqrt(omega2[3:9]), modes=range(4, 10))
    shapes = ModeShapes(poles, phi[rows, 3:9], corners)
    unknown = [MatrixParameter("E", dK=plate.model.K)]
    fit = update(rom, unknown, [Eigenvalues(poles), shapes], start=[0.0], starts=1)
    assert fit.values[0] == pytest.approx(0.05, rel=5e-3)
    before = correlate(rom, [Eigenvalues(poles), shapes])
    pairs = np.abs(fit.history.eigenvalues[0]) / np.abs(poles.poles) - 1
    # two modes are equal: the rounding of their split hangs on their basis, 2e-12 on one kernel
    np.testing.assert_allclose(pairs, before.freq_error, rtol=0, atol=1e-11)


def test_criteria_by_hand():
    X = np.array([[1.0, 1.0], [0.0, 1.0]])
    np.testing.assert_allclose(mac(X, 3j * X), [[1, 0.5], [0.5, 1]])
    H = np.array([[1.0, 1j, -1.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(frac(H, [[2.0, 2j, -2.0], [1.0, 1.0, 0.0]]), [1.0, 0.5])
    np.testing.assert_allclose(fdac(H[:1], H[:1]), [[1, 0, -1], [0, 1, 0], [-1, 0, 1]], atol=1e-15)
    with pytest.raises(ModelError, match="zero shape"):
        mac(X, 0 * X)
    with pytest.raises(ShapeError, match="choose the same channels"):
        frac(H, H[:, :2])
    with pytest.raises(ModelError, match="zero"):
        fdac(0 * H, H)


def test_results_are_stored(chain, tmp_path):
    parts = changed(chain, mass=[(1, 0.3)])
    inside = [AddedMass("2:z", bounds=(0.0, 1.0))]
    fit = update(chain, inside, [Eigenvalues(measured(parts, 1e-3))], starts=2)
    for value in (
        fit,
        inside[0],
        Eigenvalues(measured(parts)),
        localise(chain, MASS, [Eigenvalues(measured(parts, 1e-3))]),
    ):
        value.save(tmp_path / "value.npz")
        assert repr(load(tmp_path / "value.npz")) == repr(value)


def test_bad_input_is_refused(chain):
    residuals = [Eigenvalues(measured(changed(chain)))]
    with pytest.raises(ModelError, match="method"):
        update(chain, MASS, residuals, method="lm")
    with pytest.raises(ModelError, match="takes no bounds"):
        update(chain, [AddedMass("2:z", bounds=(0, 1))], residuals, method=GaussNewton())
    with pytest.raises(ModelError, match="bounds"):
        AddedMass("2:z", bounds=(1, 0))
    with pytest.raises(ModelError, match="prior"):
        AddedMass("2:z", prior=(0.0, 0.0))
    with pytest.raises(LabelError, match="to='' is not a place"):
        AddedMass("2:z", to="")
    with pytest.raises(ModelError, match="has no effect"):
        update(chain, [AddedMass("2:z", to="2:z")], residuals)
    with pytest.raises(ModelError, match="changes nothing"):
        MatrixParameter("x", dM=np.zeros((4, 4)))
    with pytest.raises(ModelError, match="symmetric"):
        MatrixParameter("x", dM=np.triu(np.ones((4, 4))))
    with pytest.raises(LabelError, match="name"):
        MatrixParameter("", dM=np.eye(4))
    with pytest.raises(ModelError, match="mode"):
        ModeDamping(0)
    with pytest.raises(LabelError, match="no elastic mode 9"):
        update(chain, [ModeDamping(9)], residuals)
    with pytest.raises(ModelError, match="loss"):
        TrustRegion(loss="l3")
    with pytest.raises(ModelError, match="truncate"):
        GaussNewton(truncate=1.0)
    fit = update(chain, MASS, residuals)
    with pytest.raises(ModelError, match="level"):
        fit.interval(1.0)
    with pytest.raises(ModelError, match="count"):
        fit.sample(0)
    with pytest.raises(ModelError, match="a residual must be of type Residual"):
        identifiability(chain, MASS, [3])
    with pytest.warns(FlexplantWarning, match="did not converge"):
        update(
            chain,
            MASS,
            [Eigenvalues(measured(changed(chain, mass=[(1, 0.3)])))],
            method=TrustRegion(),
            max_iterations=1,
        )
