"""Gauss-Newton on the paper's plate and on machines with swapping and repeated modes."""

import numpy as np
import pytest
import scipy.sparse as sp

import oracles_updating as oracle
from flexplant import load
from flexplant.errors import FlexplantWarning, LabelError, ModelError, ShapeError, SolverError
from flexplant.identification import MeasuredModes
from flexplant.updating import (
    AddedDamping,
    AddedMass,
    AddedStiffness,
    Eigenvalues,
    GaussNewton,
    TrustRegion,
    update,
)


def fitted(plate, model, target, **options):
    return update(
        model,
        [AddedMass(plate.z8), AddedDamping(plate.z8)],
        [Eigenvalues(MeasuredModes(target, modes=[6, 7]))],
        **options,
    )


def changed_poles(model, changes):
    """Poles of a small model with (matrix, DOF from 0, value) added."""
    parts = [np.array(a) for a in (model.M, model.D, model.K)]
    for matrix, i, value in changes:
        parts[matrix][i, i] += value
    return oracle.poles(*parts)


# ---- the paper's plate


@pytest.mark.slow
@pytest.mark.parametrize(("zeta", "damping"), [(0.01, -0.2087), (0.001, -0.02087)])
def test_modal_reduction_ends_at_the_papers_bias(plate, zeta, damping):
    target = oracle.truth(zeta)
    fit = fitted(plate, plate.reduced(zeta, False), target)
    assert fit.converged
    assert len(fit.history) <= 5
    assert fit.reason == "step below the tolerance"
    assert fit.values[0] == pytest.approx(0.5035, abs=5e-5)
    assert fit.values[1] == pytest.approx(damping, rel=2e-3)
    np.testing.assert_allclose(fit.values[0], oracle.modal_fit(zeta, target, False)[0], rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(("zeta", "damping"), [(0.01, 3e-3), (0.001, 3e-4)])
def test_one_attachment_vector_finds_the_mass(plate, zeta, damping):
    target = oracle.truth(zeta)
    fit = fitted(plate, plate.reduced(zeta, True), target)
    assert fit.converged
    assert len(fit.history) <= 5
    assert abs(fit.values[0] - 0.5) < 1e-6
    assert abs(fit.values[1]) < damping
    expected = oracle.modal_fit(zeta, target, True)
    np.testing.assert_allclose(fit.values, expected, rtol=1e-7, atol=1e-7)


@pytest.mark.slow
def test_one_percent_of_thickness_breaks_the_pins(plate, thicker_plate):
    target = oracle.truth(0.01)
    for attached in (False, True):
        fit = fitted(thicker_plate, thicker_plate.reduced(0.01, attached), target)
        assert abs(fit.values[0] - (0.5 if attached else 0.5035)) > 0.05
    # and a thicker truth is not this plate with 0.5 kg either
    fit = fitted(plate, plate.reduced(0.01, True), oracle.truth(0.01, 0.0272 * 1.01))
    assert abs(fit.values[0] - 0.5) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("attached", [False, True])
def test_any_rotation_of_the_repeated_pair_gives_the_same(plate, attached):
    target = oracle.truth(0.01)
    modes = plate.modes(0.01, attached)
    rng = np.random.default_rng(7)
    found = []
    for i in range(30):
        a = rng.uniform(0, 2 * np.pi)
        Q = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) * [1, (-1) ** i]
        phi = np.array(modes.phi)
        phi[:, 6:8] = phi[:, 6:8] @ Q
        rom = plate.reduced(0.01, attached, modes.replace(phi=phi))
        fit = fitted(plate, rom, target, starts=1)
        assert len(fit.history) <= 5
        found.append(fit.values)
    assert np.ptp(np.array(found), axis=0).max() < 1e-8


@pytest.mark.slow
def test_updated_model_has_the_measured_poles(plate):
    target = oracle.truth(0.01)
    fit = fitted(plate, plate.reduced(0.01, True), target)
    poles = fit.model.modes().poles
    np.testing.assert_allclose(poles[[5, 6]], target, rtol=1e-8)
    np.testing.assert_allclose(poles[[5, 6]], fit.history.eigenvalues[-1], rtol=1e-11)
    assert np.all(poles[:3] == 0)
    assert fit.model.rigid_body.shape == (25, 3)
    R = fit.model.rigid_body
    np.testing.assert_allclose(R.T @ fit.model.M @ R, np.eye(3), atol=1e-12)
    # unmeasured modes of the truth are met too
    M, K = oracle.plate()
    D = oracle.modal_damping(M, K, 0.01)
    at = oracle.z_dof(0.3, 0.15)
    M[at, at] += 0.5
    np.testing.assert_allclose(poles[3:13], oracle.poles(M, D, K)[:10], rtol=1e-4)


@pytest.mark.slow
def test_modes_are_expanded_to_the_full_structure(plate):
    fit = fitted(plate, plate.reduced(0.01, True), oracle.truth(0.01))
    modes = fit.modes()
    assert modes.dofs is fit.model.full_dofs
    assert modes.phi.shape == (243, 25)
    # mode 6 of the full truth, from the equations
    M, K = oracle.plate()
    D = oracle.modal_damping(M, K, 0.01)
    at = oracle.z_dof(0.3, 0.15)
    M[at, at] += 0.5
    lam = oracle.truth(0.01)[0]
    values, vectors = np.linalg.eig(np.linalg.solve(M, lam * lam * M + lam * D + K))
    shape = vectors[:, np.argmin(np.abs(values))]
    other = modes.phi[:, 5]
    weight = np.abs(shape.conj() @ M @ other) ** 2
    weight /= (shape.conj() @ M @ shape).real * (other.conj() @ M @ other).real
    assert weight > 1 - 1e-6


@pytest.mark.long
def test_update_takes_the_full_model_too(plate):
    fe = plate.model
    target = oracle.truth(0.0)
    fit = update(fe, [AddedMass(plate.z8)], [Eigenvalues(MeasuredModes(target, modes=[6, 7]))])
    assert type(fit.model) is type(fe)
    assert fit.values[0] == pytest.approx(0.5, abs=1e-8)
    assert fit.model.mass == pytest.approx(fe.mass + 0.5, abs=1e-8)
    assert fit.model.D is None
    assert sp.issparse(fit.model.M)
    assert fit.modes().phi.shape[0] == 243


# ---- pairing on the way


def test_distant_modes_that_swap(make):
    model = make(
        [1, 1, 1],
        [(0, None, 100), (1, None, 121), (2, None, 400), (0, 2, 1), (1, 2, 1), (0, 1, 0.05)],
        beta=1e-4,
    )
    mass = (11 / 9) ** 2 - 1
    poles = changed_poles(model, [(0, 1, mass)])
    # what was mode 2 is the lower one now
    measured = MeasuredModes(poles[[1, 0]], modes=[1, 2])
    fit = update(model, [AddedMass("2:z")], [Eigenvalues(measured)])
    assert fit.values[0] == pytest.approx(mass, rel=1e-8)
    assert fit.reason == "residual below the tolerance"
    assert fit.history.eigenvalues[0].imag[0] < fit.history.eigenvalues[0].imag[1]
    assert fit.history.eigenvalues[-1].imag[0] > fit.history.eigenvalues[-1].imag[1]


@pytest.mark.parametrize("mass", [0.03, 0.3])
def test_uncoupled_modes_of_a_cluster_that_swap(make, mass):
    model = make([1, 1], [(0, None, 100), (1, None, 102)], beta=1e-4)
    poles = changed_poles(model, [(0, 1, mass)])
    measured = MeasuredModes(poles[[1, 0]], modes=[1, 2])
    fit = update(model, [AddedMass("2:z")], [Eigenvalues(measured)])
    assert fit.values[0] == pytest.approx(mass, rel=1e-8)


@pytest.mark.parametrize("gap", [0.0, 1e-10, 1e-7, 1e-5, 1e-3, 1e-2])
@pytest.mark.parametrize("coupling", [1e-4, 1e-1])
def test_close_modes_that_turn_keep_their_order(make, gap, coupling):
    links = [(0, None, 100), (1, None, 100 * (1 + gap)), (0, 1, coupling)]
    model = make([1, 1], links, beta=1e-4)
    poles = changed_poles(model, [(0, 1, 0.2)])
    measured = MeasuredModes(poles, modes=[1, 2])
    fit = update(model, [AddedMass("2:z")], [Eigenvalues(measured)])
    assert fit.values[0] == pytest.approx(0.2, rel=1e-8)


RING = [*[(i, None, 30.0) for i in range(3)], (0, 1, 100.0), (1, 2, 100.0), (0, 2, 100.0)]


@pytest.mark.parametrize("node", [0, 1, 2])
@pytest.mark.parametrize(("mass", "modes"), [(0.2, [2]), (-0.2, [3]), (0.2, [2, 3]), (1.5, [2, 3])])
def test_repeated_pair_of_a_ring(make, node, mass, modes):
    model = make([1, 1, 1], RING, beta=1e-4)
    poles = changed_poles(model, [(0, node, mass), (1, node, 0.3)])
    place = f"{node + 1}:z"
    measured = MeasuredModes(poles[np.array(modes) - 1], modes=modes)
    fit = update(model, [AddedMass(place), AddedDamping(place)], [Eigenvalues(measured)])
    np.testing.assert_allclose(fit.values, [mass, 0.3], rtol=1e-7)


@pytest.mark.parametrize("masses", [(0.2, 0.1), (0.2, -0.1), (0.1, 0.3)])
def test_two_masses_that_split_a_pair_along_different_vectors(make, masses):
    model = make([1, 1, 1], RING, beta=1e-4)
    poles = changed_poles(model, [(0, 0, masses[0]), (0, 1, masses[1])])
    measured = MeasuredModes(poles, modes=[1, 2, 3])
    fit = update(model, [AddedMass("1:z"), AddedMass("2:z")], [Eigenvalues(measured)])
    # the two nodes are the same to the eigenvalues
    np.testing.assert_allclose(sorted(fit.values), sorted(masses), rtol=1e-7)


@pytest.mark.parametrize("node", range(4))
def test_triple_mode(make, node):
    links = [(i, j, 100.0) for i in range(4) for j in range(i)]
    model = make([1] * 4, [*links, *[(i, None, 50.0) for i in range(4)]], beta=1e-4)
    poles = changed_poles(model, [(0, node, 0.3)])
    measured = MeasuredModes(poles[[1]], modes=[2])
    fit = update(model, [AddedMass(f"{node + 1}:z")], [Eigenvalues(measured)])
    assert fit.values[0] == pytest.approx(0.3, rel=1e-8)


# ---- rigid-body modes


@pytest.mark.slow
def test_a_mass_moves_the_centre_of_gravity_and_keeps_rigid_body_modes(plate):
    rom = plate.reduced(0.01, True)
    fit = fitted(plate, rom, oracle.truth(0.01))
    R, K = fit.model.rigid_body, fit.model.K
    assert np.abs(K @ R).max() < 1e-7 * np.abs(K).max() * np.abs(R).max()
    full = rom.T @ R
    # translation: all z equal, mass of the plate and the actuator together
    z = [i for i, d in enumerate(rom.full_dofs.directions) if d == "z"]
    np.testing.assert_allclose(full[z, 0] ** -2.0, plate.model.mass + 0.5, rtol=1e-6)


def test_a_spring_to_the_ground_takes_rigid_body_modes_away(make, as_reduced):
    free = as_reduced(make([1, 2, 1, 3], [(0, 1, 90), (1, 2, 110), (2, 3, 70)], beta=1e-3))
    assert free.rigid_body.shape == (4, 1)
    poles = changed_poles(free, [(2, 0, 15.0)])
    # started at a spring, mode 1 is the suspension
    measured = MeasuredModes(poles[[0, 1]], modes=[1, 2])
    spring = AddedStiffness("1:z")
    fit = update(free, [spring], [Eigenvalues(measured)], start=[1.0])
    assert fit.values[0] == pytest.approx(15.0, rel=1e-8)
    assert fit.model.rigid_body.shape == (4, 0)
    np.testing.assert_allclose(fit.model.modes().poles, poles, rtol=1e-9)
    # started without, it is a rigid-body mode
    with pytest.raises(LabelError, match=r"rigid-body mode of the start model.*start="):
        update(free, [spring], [Eigenvalues(measured)])
    # elastic modes alone can do without a start; mode 2 is the first elastic one then
    elastic = MeasuredModes(poles[[1, 2]], modes=[2, 3])
    fit = update(free, [spring], [Eigenvalues(elastic)])
    assert fit.values[0] == pytest.approx(15.0, rel=1e-8)
    assert fit.model.rigid_body.shape == (4, 0)


def test_a_spring_between_two_dofs_keeps_them(make, as_reduced):
    free = as_reduced(make([1, 2, 1, 3], [(0, 1, 90), (1, 2, 110), (2, 3, 70)], beta=1e-3))
    stiffer = make([1, 2, 1, 3], [(0, 1, 120), (1, 2, 110), (2, 3, 70)])
    poles = oracle.poles(free.M, free.D, np.array(stiffer.K))
    spring = AddedStiffness({"1:z": 1, "2:z": -1})
    measured = MeasuredModes(poles, modes=[2, 3, 4])
    fit = update(free, [spring], [Eigenvalues(measured)])
    assert fit.values[0] == pytest.approx(30.0, rel=1e-8)
    assert fit.model.rigid_body.shape == (4, 1)


def test_a_damper_to_the_ground_is_found_though_it_drags_the_rigid_body(make, as_reduced):
    free = as_reduced(make([1, 2, 1, 3], [(0, 1, 90), (1, 2, 110), (2, 3, 70)], beta=1e-3))
    poles = changed_poles(free, [(1, 3, 2.0)])
    measured = MeasuredModes(poles, modes=[2, 3, 4])
    fit = update(free, [AddedDamping("4:z")], [Eigenvalues(measured)])
    assert fit.values[0] == pytest.approx(2.0, rel=1e-8)
    with pytest.raises(ModelError, match="dampers to ground"):
        fit.modes()


# ---- the iteration


def test_first_step_is_equation_13_with_W(make):
    model = make([1, 2, 1.5], [(0, None, 90), (0, 1, 110), (1, 2, 70)], beta=2e-3)
    target = changed_poles(model, [(0, 1, 0.3)]) * [1.01, 1.0, 0.99]
    W = np.array([2.0, 0.5, 7.0])
    measured = MeasuredModes(target, modes=[1, 2, 3])
    places = ["1:z", "2:z"]
    with pytest.warns(FlexplantWarning, match="did not converge in 1 step:"):
        fit = update(
            model,
            [AddedMass(place) for place in places],
            [Eigenvalues(measured, weights=W)],
            max_iterations=1,
        )
    assert not fit.converged
    assert "NOT CONVERGED" in repr(fit)
    S = np.empty((3, 2), dtype=complex)
    for b in range(2):
        dM = np.zeros((3, 3))
        dM[b, b] = 1.0
        for a in range(3):
            parts = [dM, 0 * dM, 0 * dM]
            S[a, b] = oracle.complex_step(model.M, model.D, model.K, parts, a)[1]
    gap = target - oracle.poles(model.M, model.D, model.K)
    step = np.linalg.solve((S.conj().T @ np.diag(W) @ S).real, (S.conj().T @ np.diag(W) @ gap).real)
    assert fit.history.fraction.tolist() == [0.0, 1.0]
    np.testing.assert_allclose(fit.values, step, rtol=1e-9)
    np.testing.assert_allclose(fit.history.error[0], (gap.conj() @ (W * gap)).real, rtol=1e-10)


def test_weights_pull_towards_their_pole(make):
    model = make([1, 2], [(0, None, 90), (0, 1, 110)], beta=2e-3)
    # two poles that no mass explains together
    low = changed_poles(model, [(0, 1, 0.2)])[0]
    high = changed_poles(model, [(0, 1, 0.6)])[1]
    measured = MeasuredModes([low, high], modes=[1, 2])
    found = [
        update(model, [AddedMass("2:z")], [Eigenvalues(measured, weights=W)]).values[0]
        for W in ([1.0, 1e-8], [1.0, 1.0], [1e-8, 1.0])
    ]
    assert found[0] == pytest.approx(0.2, abs=1e-4)
    assert found[2] == pytest.approx(0.6, abs=1e-4)
    assert 0.21 < found[1] < 0.59


@pytest.mark.slow
def test_history_holds_every_iterate(plate):
    target = oracle.truth(0.01)
    rom = plate.reduced(0.01, True)
    fit = fitted(plate, rom, target)
    history = fit.history
    assert history.parameters.shape == (len(history) + 1, 2)
    assert history.eigenvalues.shape == (len(history) + 1, 2)
    assert history.parameters[0].tolist() == [0, 0]
    assert np.array_equal(history.parameters[-1], fit.values)
    at = rom.dofs.index(plate.z8)
    for p, poles, error in zip(history.parameters, history.eigenvalues, history.error, strict=True):
        M, D = rom.M.copy(), rom.D.copy()
        M[at, at] += p[0]
        D[at, at] += p[1]
        expected = oracle.poles(M, D, rom.K)[[2, 3]]
        np.testing.assert_allclose(poles, expected, rtol=1e-9)
        np.testing.assert_allclose(error, np.sum(np.abs(target - poles) ** 2), rtol=1e-12)
    # the last step only confirms: it changes the error by rounding
    assert np.all(np.diff(history.error[:-1]) < 0)
    assert history.error[-1] == pytest.approx(history.error[-2], rel=1e-3)


def test_steps_are_halved_while_a_mass_would_become_negative(make):
    model = make([1, 1, 1], RING, beta=1e-4)
    poles = changed_poles(model, [(0, 1, -0.9)])
    measured = MeasuredModes(poles[[0, 2]], modes=[1, 3])
    fit = update(model, [AddedMass("2:z")], [Eigenvalues(measured)], method=GaussNewton())
    assert fit.values[0] == pytest.approx(-0.9, rel=1e-8)
    assert fit.history.fraction[1:].min() < 1
    assert fit.history.parameters.min() > -1


def test_steps_are_halved_while_the_error_would_grow(make):
    model = make([1, 1], [(0, None, 100), (1, None, 900)], beta=1e-4)
    # 10 rad/s to 14: the tangent overshoots to 22
    poles = changed_poles(model, [(0, 0, 1 / 1.96 - 1)])
    fit = update(model, [AddedMass("1:z")], [Eigenvalues(MeasuredModes(poles[:1], modes=[1]))])
    assert fit.values[0] == pytest.approx(1 / 1.96 - 1, rel=1e-8)
    assert fit.history.fraction[1] == 0.5
    assert np.all(np.diff(fit.history.error[:-1]) < 0)


def test_a_fit_that_no_physical_step_improves_raises(make, as_reduced):
    free = as_reduced(make([1, 2, 1], [(0, 1, 90), (1, 2, 110)], beta=1e-3))
    # softer than the free structure: a spring to the ground would have to be negative
    measured = MeasuredModes(0.9 * oracle.poles(free.M, free.D, free.K), modes=[2, 3])
    with pytest.raises(SolverError, match="stiffness at 1:z = -"):
        update(free, [AddedStiffness("1:z")], [Eigenvalues(measured)])


@pytest.mark.slow
def test_start_at_the_answer_takes_no_step(plate):
    fit = fitted(plate, plate.reduced(0.01, True), oracle.truth(0.01))
    again = fitted(plate, plate.reduced(0.01, True), fit.history.eigenvalues[-1], start=fit.values)
    assert len(again.history) == 0
    assert again.converged
    assert np.array_equal(again.values, fit.values)


@pytest.mark.slow
def test_unobservable_parameters_are_named(plate, make):
    rom = plate.reduced(0.01, True)
    torsion = MeasuredModes([-15 + 1530j], modes=[4])
    with pytest.raises(ModelError, match=rf"^mass at {plate.z8} cannot be found from modes 4"):
        update(rom, [AddedMass(plate.z8)], [Eigenvalues(torsion)])
    # also when the eigenvalue is right already
    exact = MeasuredModes(oracle.poles(rom.M, rom.D, rom.K)[:1], modes=[4])
    with pytest.raises(ModelError, match="cannot be found"):
        update(rom, [AddedMass(plate.z8)], [Eigenvalues(exact)])
    # undamped: mass and spring move one imaginary part only
    held = make([1, 2], [(0, None, 90), (0, 1, 110)])
    one = MeasuredModes([5j], modes=[1])
    with pytest.raises(ModelError, match="mass at 2:z, stiffness at 2:z cannot be distinguished"):
        update(held, [AddedMass("2:z"), AddedStiffness("2:z")], [Eigenvalues(one)])
    three = [AddedMass("1:z"), AddedMass("2:z"), AddedDamping("2:z")]
    with pytest.raises(ModelError, match="2 real equations, 3 unknowns"):
        update(held, three, [Eigenvalues(one)])


# ---- doubt


@pytest.mark.long
def test_covariance_is_that_of_repeated_measurements(make):
    model = make([1, 2, 1.5], [(0, None, 90), (0, 1, 110), (1, 2, 70)], beta=2e-3)
    truth = changed_poles(model, [(0, 1, 0.3), (1, 1, 0.1)])
    rng = np.random.default_rng(3)
    A = rng.normal(size=(6, 6)) * 1e-4
    C = A @ A.T + 1e-9 * np.eye(6)
    root = np.linalg.cholesky(C)
    parameters = [AddedMass("2:z"), AddedDamping("2:z")]
    values, count = [], 150
    for _ in range(count):
        noise = root @ rng.normal(size=6)
        measured = MeasuredModes(truth + noise[:3] + 1j * noise[3:], modes=[1, 2, 3], covariance=C)
        fit = update(model, parameters, [Eigenvalues(measured)], starts=1)
        values.append(fit.values)
    spread = np.cov(np.array(values).T)
    # five standard errors of sample (co)variances
    for i in range(2):
        for j in range(2):
            P = fit.covariance
            error = np.sqrt((P[i, i] * P[j, j] + P[i, j] ** 2) / count)
            assert abs(spread[i, j] - P[i, j]) < 5 * error
    std = np.sqrt(np.diag(fit.covariance))
    np.testing.assert_allclose(fit.std, std)
    np.testing.assert_allclose(fit.correlation, fit.covariance / np.outer(std, std))


@pytest.mark.slow
def test_without_measured_covariance_it_comes_from_the_residual(make):
    model = make([1, 2, 1.5], [(0, None, 90), (0, 1, 110), (1, 2, 70)], beta=2e-3)
    target = changed_poles(model, [(0, 1, 0.3)]) * [1.001, 1.0, 0.999]
    measured = MeasuredModes(target, modes=[1, 2, 3])
    parameters = [AddedMass("2:z"), AddedDamping("2:z")]
    fits = [
        update(model, parameters, [Eigenvalues(measured, weights=w * np.ones(3))])
        for w in (1.0, 9.0)
    ]
    # only ratios of weights count
    np.testing.assert_allclose(fits[0].covariance, fits[1].covariance, rtol=1e-6)
    J = np.empty((6, 2))
    M, D = np.array(model.M), np.array(model.D)
    M[1, 1] += fits[0].values[0]
    D[1, 1] += fits[0].values[1]
    unit = np.zeros((3, 3))
    unit[1, 1] = 1.0
    for b, parts in enumerate([[unit, 0 * unit, 0 * unit], [0 * unit, unit, 0 * unit]]):
        slopes = [oracle.complex_step(M, D, model.K, parts, a)[1] for a in range(3)]
        J[:, b] = np.concatenate([np.real(slopes), np.imag(slopes)])
    expected = np.linalg.inv(J.T @ J) * fits[0].history.error[-1] / 4
    np.testing.assert_allclose(fits[0].covariance, expected, rtol=1e-6)
    # nothing is left over to judge by
    exact = MeasuredModes(target[:1], modes=[1])
    alone = update(model, parameters, [Eigenvalues(exact)])
    assert alone.covariance is None
    assert alone.std is None
    assert alone.correlation.shape == (2, 2)


# ---- the answer as a value, and bad input


@pytest.mark.slow
def test_result_reads_and_is_stored(plate, tmp_path):
    fit = fitted(plate, plate.reduced(0.01, True), oracle.truth(0.01))
    assert fit.parameters == (f"mass at {plate.z8}", f"damping at {plate.z8}")
    assert fit[f"mass at {plate.z8}"] == fit.values[0]
    with pytest.raises(LabelError, match="no parameter 'mass'"):
        fit["mass"]
    text = repr(fit)
    assert text.startswith(f"<UpdateResult: converged in {len(fit.history)} steps")
    assert f"mass at {plate.z8} = 0.5000002 +- " in text
    assert repr(fit.history).startswith("<History: 4 steps (0 shortened), error 2.15e+03 -> ")
    fit.save(tmp_path / "fit.npz")
    again = load(tmp_path / "fit.npz")
    assert np.array_equal(again.values, fit.values)
    assert np.array_equal(again.model.M, fit.model.M)
    assert np.array_equal(again.history.error, fit.history.error)
    assert not fit.values.flags.writeable
    assert again.modes().phi.shape == (243, 25)


def test_bad_input_is_refused(plate):
    rom = plate.reduced(0.01, False)
    mass = [AddedMass(plate.z8)]
    data = [Eigenvalues(MeasuredModes([-28 + 2880j], modes=[6]))]
    with pytest.raises(ModelError, match="M, D, K"):
        update(np.eye(3), mass, data)
    with pytest.raises(ModelError, match="parameters is empty"):
        update(rom, [], data)
    with pytest.raises(ModelError, match=r"must be of type Parameter.*AddedMass"):
        update(rom, [plate.z8], data)
    with pytest.raises(LabelError, match="more than once"):
        update(rom, mass * 2, data)
    with pytest.raises(LabelError, match="999:z"):
        update(rom, [AddedMass("999:z")], data)
    with pytest.raises(ModelError, match="residuals is empty"):
        update(rom, mass, [])
    with pytest.raises(ModelError, match="a residual must be of type Residual, got MeasuredModes"):
        update(rom, mass, [data[0].measured])
    with pytest.raises(LabelError, match="rigid-body mode"):
        update(rom, mass, [Eigenvalues(MeasuredModes([-1 + 10j], modes=[2]))])
    with pytest.raises(LabelError, match="no mode 25"):
        update(rom, mass, [Eigenvalues(MeasuredModes([-1 + 10j], modes=[25]))])
    with pytest.raises(ShapeError, match="start needs one value"):
        update(rom, mass, data, start=[1.0, 2.0])
    with pytest.raises(ModelError, match="start"):
        update(rom, mass, data, start=[np.nan])
    with pytest.raises(ModelError, match="M is not positive definite"):
        update(rom, mass, data, start=[-30.0])
    for count in (0, 1.5, True):
        with pytest.raises(ModelError, match="max_iterations"):
            update(rom, mass, data, max_iterations=count)
    with pytest.raises(ModelError, match="tolerance"):
        update(rom, mass, data, tolerance=0.0)


def test_a_full_model_refuses_an_answer_that_is_not_physical(make):
    held = make([1, 2], [(0, None, 90), (0, 1, 110)], beta=1e-3)
    measured = MeasuredModes(changed_poles(held, [(1, 1, -0.05)]), modes=[1, 2])
    ended = r"ended at damping at 2:z = -0.05 \+-.* D is not .* keep damping at 2:z .* bounds="
    with pytest.raises(ModelError, match=ended):
        update(held, [AddedDamping("2:z")], [Eigenvalues(measured)])


@pytest.mark.slow
def test_a_search_ends_where_no_step_is_possible(make):
    """A free machine takes no negative spring to ground: K would be indefinite at any step."""
    free, part = make([1, 2, 1], [(0, 1, 90), (1, 2, 110)], beta=1e-3), AddedStiffness("2:z")
    poles = changed_poles(free, [])
    poles = 0.99 * poles[poles.imag > 1.0]
    std = 1e-4 * np.abs(poles)
    data = [Eigenvalues(MeasuredModes(poles, modes=[2, 3], covariance=std**2))]
    with pytest.warns(FlexplantWarning) as seen:
        fit = update(free, [part], data, method=TrustRegion())
    assert any("no step in the direction of descent is possible" in str(w.message) for w in seen)
    assert not fit.converged
    assert fit.values == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_a_fit_that_does_not_converge_says_so(plate):
    with pytest.warns(FlexplantWarning, match="did not converge in 2 steps: max_iterations"):
        fit = fitted(plate, plate.reduced(0.01, True), oracle.truth(0.01), max_iterations=2)
    assert not fit.converged
    assert len(fit.history) == 2
    assert repr(fit).startswith("<UpdateResult: NOT CONVERGED in 2 steps (max_iterations reached)")
