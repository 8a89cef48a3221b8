"""solve_modes: the pins of the paper's plate, both eigenvalue routes, damping, refusals."""

import numpy as np
import pytest
import scipy.sparse as sp

import oracles_structure as oracle
from flexplant import DofSet
from flexplant.errors import LabelError, ModelError, ShapeError, SolverError
from flexplant.modes import solve, solve_modes
from flexplant.modes import sparse_modes as counted
from flexplant.modes.solve import rigid_residual
from flexplant.structure import FEModel, ModalDamping, Rayleigh, Spring
from plates import make_plate

# Hz, rad/s; oracle: oracles_structure (Gauss quadrature, scipy.linalg.eigh, first-order poles)
ELASTIC = [245.754, 359.312, 463.131, 640.083, 640.083]
POLES = {
    0.01: [-28.569 + 2883.567j, -39.451 + 3983.308j],
    0.001: [-2.857 + 2883.707j, -3.945 + 3983.501j],
}
PRINTED = [-28.5 + 2870j, -39.3 + 3970j]  # the paper's, with 1 % damping


@pytest.fixture(scope="module")
def plate():
    return make_plate()


def truth(plate, zeta, mass=0.5):
    """The plate with a mass at z8 and the damping matrix of the bare plate."""
    e = plate.dofs.row((0.3, 0.15, 0.0))
    D = plate.with_damping(ModalDamping(zeta)).D
    return FEModel(plate.M + mass * np.outer(e, e), plate.K, D, dofs=plate.dofs)


def assert_modes_of(model, modes, tolerance=1e-12):
    """M-orthonormal and solving the eigenvalue problem, by plain dense algebra."""
    gram = modes.phi.T @ (model.M @ modes.phi)
    assert np.abs(gram - np.eye(modes.n_modes)).max() < tolerance
    stiffness = modes.phi.T @ (model.K @ modes.phi)
    top = modes.omega[-1] ** 2
    assert np.abs(stiffness - np.diag(modes.omega**2)).max() < 1e-8 * top


def test_the_paper_s_plate(plate):
    modes = solve_modes(plate, count=24)
    np.testing.assert_allclose(modes.freq[3:8], ELASTIC, rtol=1e-5)
    np.testing.assert_allclose(modes.freq[22:], 3767.7, rtol=2e-5)
    assert np.array_equal(modes.omega[:3], np.zeros(3))
    assert np.array_equal(modes.poles[:3], np.zeros(3))
    assert np.array_equal(modes.zeta, np.zeros(24))
    assert modes.n_rigid == 3
    assert_modes_of(plate, modes)


@pytest.mark.slow
def test_the_pins_feel_one_percent_of_thickness():
    thick = make_plate(thickness=0.0272 * 1.01)
    assert np.all(np.abs(solve_modes(thick, count=8).freq[3:] / ELASTIC - 1) > 5e-3)
    found = solve_modes(truth(thick, 0.01), count=8).poles[5:7]
    assert np.all(np.abs(found - POLES[0.01]) > 10)


def test_frequencies_are_the_oracle_s(plate):
    omega, _ = oracle.undamped(*oracle.plate_matrices(8, 8))
    np.testing.assert_allclose(solve_modes(plate).omega[3:], omega[3:], rtol=1e-9)


@pytest.mark.slow
def test_rectangular_refined_plates():
    freq = solve_modes(make_plate(elements=(16, 16)), count=7).freq[3:]
    np.testing.assert_allclose(freq, [245.50, 358.98, 462.33, 640.01], atol=0.006)


@pytest.mark.slow
@pytest.mark.parametrize("zeta", [0.01, 0.001])
def test_poles_with_half_a_kilogram(plate, zeta):
    model = truth(plate, zeta)
    modes = solve_modes(model, count=24)
    np.testing.assert_allclose(modes.poles[5:7].real, np.real(POLES[zeta]), atol=6e-4)
    np.testing.assert_allclose(modes.poles[5:7].imag, np.imag(POLES[zeta]), atol=6e-4)
    if zeta == 0.01:  # the paper prints these, of a slightly different element
        np.testing.assert_allclose(modes.poles[5:7], PRINTED, rtol=6e-3)
    assert np.array_equal(modes.poles[:3], np.zeros(3))
    assert np.iscomplexobj(modes.phi)
    # torsion (mode 4) has a node at z8
    np.testing.assert_allclose(modes.freq[3], ELASTIC[0], rtol=1e-5)


@pytest.mark.slow
def test_poles_are_the_oracle_s(plate):
    M, K = oracle.plate_matrices(8, 8)
    D = oracle.modal_damping_matrix(M, K, 0.01)
    row = 3 * (2 * 9 + 4)  # node 23: x = 4, y = 2 of 8
    M[row, row] += 0.5
    expected = oracle.poles(M, D, K)[:10]
    np.testing.assert_allclose(
        solve_modes(truth(plate, 0.01), count=13).poles[3:], expected, rtol=1e-7
    )


@pytest.mark.slow
def test_complex_modes_fulfil_the_quadratic_problem(plate):
    model = truth(plate, 0.01)
    modes = solve_modes(model, count=24)
    lam, phi = modes.poles, modes.phi
    M, D, K = model.M, model.D, model.K.toarray()
    residual = M @ phi * lam**2 + D @ phi * lam + K @ phi
    size = np.sqrt(np.diag(M))[:, None]
    assert np.linalg.norm(residual[:, 3:] / size, axis=0).max() < 1e-4 * np.abs(lam[3]) ** 2 * 1e-4
    gram = np.array(
        [
            [phi[:, i] @ ((lam[i] + lam[j]) * M + D) @ phi[:, j] for j in range(3, 24)]
            for i in range(3, 24)
        ]
    )
    np.testing.assert_allclose(gram, np.diag(2j * lam[3:].imag), atol=1e-6 * np.abs(lam[-1]))


@pytest.mark.slow
@pytest.mark.parametrize("elements", [(12, 12), (14, 9)])
def test_sparse_and_dense_routes_agree(elements, monkeypatch):
    model = make_plate(elements=elements)
    for module in (solve, counted):
        monkeypatch.setattr(module, "DENSE_LIMIT", 100)
    monkeypatch.setattr(solve, "_DENSE_MANY", 100)
    sparse = solve_modes(model, count=24)
    assert sparse.certificate["counted"] == sparse.certificate["found"] >= 24
    assert_modes_of(model, sparse)
    few = solve_modes(model, below=2000.0)
    assert few.n_modes == np.count_nonzero(sparse.freq <= 2000)
    again = solve_modes(model, count=24)
    assert np.array_equal(again.phi, sparse.phi)
    for module in (solve, counted):
        monkeypatch.setattr(module, "DENSE_LIMIT", 3000)
    dense = solve_modes(model, count=24)
    np.testing.assert_allclose(sparse.omega[3:], dense.omega[3:], rtol=1e-8)
    assert np.array_equal(sparse.omega[:3], np.zeros(3))


@pytest.mark.slow
def test_sparse_route_finds_every_partner():
    # square: modes 7/8, 9/10, 13/14, ... are exact pairs, of which Lanczos may drop one
    model = make_plate(elements=(24, 24))
    for count in (7, 8, 10, 60):
        modes = solve_modes(model, count=count)
        assert modes.n_modes == count
    np.testing.assert_allclose(modes.omega[6], modes.omega[7], rtol=1e-9)
    np.testing.assert_allclose(modes.omega[8], modes.omega[9], rtol=1e-9)


@pytest.mark.slow
def test_a_lost_partner_is_found_again(monkeypatch):
    model = make_plate(elements=(24, 24))
    expected = solve_modes(model, count=24)
    search, calls = counted._search, []

    def forgetful(*args):
        calls.append(args[3])
        squares, found = search(*args)
        lost = [4] if len(calls) == 1 else []
        return np.delete(squares, lost), np.delete(found, lost, axis=1)

    monkeypatch.setattr(counted, "_search", forgetful)
    modes = solve_modes(model, count=24)
    assert len(calls) == 2
    np.testing.assert_allclose(modes.omega, expected.omega, rtol=1e-9)
    assert_modes_of(model, modes)


@pytest.mark.slow
def test_a_count_that_does_not_agree_raises(monkeypatch):
    model = make_plate(elements=(24, 24))
    monkeypatch.setattr(counted, "MOST_STEPS", 3)
    below = counted.modes_below
    monkeypatch.setattr(counted, "modes_below", lambda *args: below(*args) - 1)
    with pytest.raises(SolverError, match="count finds"):
        solve_modes(model, count=24)
    monkeypatch.setattr(counted, "modes_below", lambda *args: below(*args) + 1)
    with pytest.raises(SolverError, match="count finds"):
        solve_modes(model, count=24)


def test_wrong_shapes_are_noticed(plate, monkeypatch):
    elastic = solve.elastic_modes

    def sloppy(*args, **more):
        omega, phi = elastic(*args, **more)
        return omega, phi * (1 + 1e-9)

    def wrong(*args, **more):
        omega, phi = elastic(*args, **more)
        return omega * (1 + 1e-5), phi

    monkeypatch.setattr(solve, "elastic_modes", sloppy)
    with pytest.raises(SolverError, match="M-orthonormal"):
        solve_modes(plate, count=24)
    monkeypatch.setattr(solve, "elastic_modes", wrong)
    with pytest.raises(SolverError, match="residual"):
        solve_modes(plate, count=24)


@pytest.mark.slow
def test_held_plate_has_no_rigid_body_modes():
    for elements in ((8, 8), (24, 24)):
        model = make_plate(elements=elements)
        rows = model.dofs.indices(
            [model.dofs.nearest(p) for p in [(0, 0, 0), (0.6, 0, 0), (0, 0.6, 0)]]
        )
        ground = sp.csc_array((np.full(3, 1e7), (rows, rows)), shape=(model.n_dof,) * 2)
        held = FEModel(model.M, model.K + ground, dofs=model.dofs)
        modes = solve_modes(held, count=10)
        assert modes.n_rigid == 0
        assert modes.omega[0] > 100
        assert_modes_of(held, modes)


def test_damping_laws(plate):
    modes = solve_modes(plate, count=10, damping=ModalDamping(0.01))
    np.testing.assert_array_equal(modes.zeta, [0, 0, 0] + [0.01] * 7)
    each = np.linspace(0.01, 0.1, 10)
    np.testing.assert_array_equal(
        solve_modes(plate, count=10, damping=ModalDamping(each)).zeta[3:], each[3:]
    )
    law = Rayleigh(alpha=1.0, beta=1e-6)
    modes = solve_modes(plate, count=10, damping=law)
    np.testing.assert_allclose(
        modes.zeta[3:], 0.5 / modes.omega[3:] + 0.5e-6 * modes.omega[3:], rtol=1e-14
    )
    with pytest.raises(ShapeError, match="24 damping ratios for 10 modes"):
        solve_modes(plate, count=10, damping=ModalDamping(np.full(24, 0.01)))


def test_a_proportional_matrix_gives_ratios(plate):
    for law in (ModalDamping(0.01), Rayleigh(alpha=2.0, beta=1e-6), Rayleigh(0.0, 1e-6)):
        modes = solve_modes(plate.with_damping(law), count=24)
        assert not np.iscomplexobj(modes.phi)
        np.testing.assert_allclose(modes.zeta, law.zeta(modes.omega), rtol=1e-7)
        assert np.array_equal(modes.zeta[:3], np.zeros(3))
    # damping= stands in place of D
    modes = solve_modes(plate.with_damping(law), count=24, damping=ModalDamping(0.03))
    assert np.all(modes.zeta[3:] == 0.03)


def test_signs_repeat(plate):
    modes = solve_modes(plate, count=6)
    size = np.abs(modes.phi)
    first = np.argmax(size >= (1 - 1e-6) * size.max(axis=0), axis=0)
    assert np.all(modes.phi[first, range(6)][3:] > 0)


@pytest.mark.parametrize("count", [0, 2, 244, 4.5, True, -1, "a", [], np.nan])
def test_bad_counts(plate, count):
    with pytest.raises(ModelError, match="count must be"):
        solve_modes(plate, count=count)


def test_refusals(plate):
    large = make_plate(elements=(24, 24))
    with pytest.raises(ModelError, match="count= or below="):
        solve_modes(large)
    with pytest.raises(ModelError, match="FEModel"):
        solve_modes(np.eye(3), count=2)
    with pytest.raises(ModelError, match=r"ModalDamping\(0.01\)"):
        solve_modes(plate, count=5, damping=0.01)
    with pytest.raises(ModelError, match="below must be positive"):
        solve_modes(plate, below=-1)
    with pytest.raises(LabelError, match="no DOF '99:z'"):
        solve_modes(plate, count=5, compliance_at="99:z")
    with pytest.raises(ModelError, match="no attachment"):
        solve_modes(truth(plate, 0.01), count=24, compliance_at="1:z")


def test_a_damper_to_ground_on_a_free_plate_is_refused(plate):
    D = np.zeros((243, 243))
    D[0, 0] = 50.0
    with pytest.raises(ModelError, match="rigid-body"):
        solve_modes(FEModel(plate.M, plate.K, D, dofs=plate.dofs), count=10)


def test_mechanisms_are_refused():
    # a hinge in the middle: two bars, three motions without energy, two of them rigid-body ones
    dofs = DofSet([1, 2, 3, 4, 5], ["z"] * 5, [[x, 0, 0] for x in range(5)])
    bend = np.array([[1.0, -2, 1, 0, 0], [0, 0, 1, -2, 1]])
    model = FEModel(np.eye(5), 1e6 * bend.T @ bend, dofs=dofs)
    assert model.rigid_body.shape[1] == 2
    with pytest.raises(ModelError, match="no stiffness"):
        solve_modes(model)


def test_unstable_large_models_are_refused():
    model = make_plate(elements=(24, 24))
    n = model.n_dof
    row = model.dofs.index("1:z")
    pull = sp.csc_array(([-1e7], ([row], [row])), shape=(n, n))
    with pytest.raises(ModelError, match="negative"):
        solve_modes(FEModel(model.M, model.K + pull, dofs=model.dofs), count=10)


def test_the_certificate_holds_the_rigid_body_residual(plate):
    modes = solve_modes(plate, count=6)
    K, R = abs(plate.K).toarray(), plate.rigid_body
    left = np.linalg.norm(plate.K @ R, axis=0) / np.linalg.norm(K @ np.abs(R), axis=0)
    np.testing.assert_allclose(modes.certificate["rigid_residual"], left.max(), rtol=1e-6)
    assert left.max() < 1e-12
    # a spring to ground that is too weak to be noticed as one leaves its trace
    spring = sp.csc_array(([1e-5], ([0], [0])), shape=plate.K.shape)
    held = FEModel(plate.M, plate.K, dofs=plate.dofs)
    object.__setattr__(held, "K", sp.csc_array(plate.K + spring))
    assert rigid_residual(held) > 1.5 * left.max()


@pytest.mark.slow
def test_below_a_frequency_is_sparse_from_some_hundred_dofs_on(monkeypatch):
    model = make_plate(elements=(26, 26))
    monkeypatch.setattr(solve, "elastic_modes", None)
    modes = solve_modes(model, below=2000.0)
    assert modes.certificate["counted"] == modes.n_modes
    assert modes.freq[-1] < 2000.0 < solve_modes(model, count=modes.n_modes + 1).freq[-1]


def test_too_many_modes_of_a_large_model_are_refused(monkeypatch):
    model = make_plate(elements=(24, 24))
    monkeypatch.setattr(counted, "LARGEST_FULL", 40)
    with pytest.raises(ModelError, match="more than 40 are not solved for at once"):
        solve_modes(model, below=12000.0)


@pytest.mark.slow
def test_thirty_thousand_dofs():
    model = make_plate(elements=(100, 100))
    modes = solve_modes(model, count=24, compliance_at="1:z")
    assert_modes_of(model, modes)
    np.testing.assert_allclose(modes.freq[3], 245.39, rtol=1e-4)


@pytest.mark.parametrize("at", [3, object(), [None], np.nan])
def test_what_is_no_place_is_refused(plate, at):
    with pytest.raises(ModelError, match="place must be a DOF label"):
        solve_modes(plate, count=8, compliance_at=at)


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [20.0, 1000.0])
def test_a_fine_mesh_on_soft_springs_has_suspension_modes(stiffness):
    """The sum of the plate's stiffnesses is 1e11 times the springs': nothing is called rounding."""
    plate = make_plate(elements=(60, 60))
    corners = [(0.0, 0.0, 0.0), (0.6, 0.0, 0.0), (0.0, 0.6, 0.0), (0.6, 0.6, 0.0)]
    model = plate.with_parts([Spring(at, stiffness) for at in corners])
    heave = np.sqrt(4 * stiffness / plate.mass) / (2 * np.pi)
    # about x: four springs at 0.3 m, the inertia m (0.6 m)^2 / 12
    pitch = heave * np.sqrt(3.0)
    freq = solve_modes(model, count=6).freq
    assert model.rigid_body.shape[1] == 0
    np.testing.assert_allclose(freq[:3], [heave, pitch, pitch], rtol=2e-3)
