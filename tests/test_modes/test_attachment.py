"""Residual attachment vectors: inertia relief, orthogonality, what they do to the FRF."""

import numpy as np
import pytest
import scipy.sparse as sp

import oracles_structure as oracle
from flexplant.errors import LabelError, ModelError
from flexplant.modes import solve_modes, static_response
from flexplant.modes.solve import attachment_vectors
from flexplant.structure import FEModel, ModalDamping, Rayleigh
from plates import make_plate

CORNER = "1:z"
Z8 = "23:z"


@pytest.fixture(scope="module")
def plate():
    return make_plate()


def elastic_receptance(modes, row, freq):
    """From the basis of modes and vectors, rigid-body modes left out."""
    r = modes.n_rigid
    c2 = (row @ modes.basis)[r:] ** 2
    w0, zeta = modes.basis_omega[r:], modes.basis_zeta[r:]
    w = 2 * np.pi * freq[:, None]
    return np.sum(c2 / (w0**2 - w**2 + 2j * zeta * w0 * w), axis=1)


def corner_error(plate, at, oracle_thickness=0.0272):
    """|H_red - H_full| up to mode 20, of the static elastic compliance; oracle: all modes."""
    modes = solve_modes(plate, count=24, damping=ModalDamping(0.01), compliance_at=at)
    freq = np.unique(np.r_[np.linspace(0, modes.freq[19], 2000), modes.freq[3:20]])
    row = plate.dofs.row(CORNER)
    M, K = oracle.plate_matrices(8, 8, thickness=oracle_thickness)
    full, static = oracle.elastic_receptance(M, K, row, freq, 0.01)
    return np.abs(elastic_receptance(modes, row, freq) - full).max() / static


def test_corner_frf_with_modes_only(plate):
    error = corner_error(plate, ())
    assert 0.06 < error <= 0.07  # 0.0655: the truncated modes' compliance is missing


def test_corner_frf_with_a_vector(plate):
    assert corner_error(plate, CORNER) <= 0.005  # 0.0040


def test_corner_frf_feels_one_percent_of_thickness():
    assert corner_error(make_plate(thickness=0.0272 * 1.01), CORNER) > 0.05


def test_static_compliance_is_complete_with_the_vector(plate):
    modes = solve_modes(plate, count=24, compliance_at=[CORNER, Z8])
    M, K = oracle.plate_matrices(8, 8)
    for label in (CORNER, Z8):
        row = plate.dofs.row(label)
        u = oracle.static_free(M, K, plate.rigid_body, row)
        shapes = modes.basis[:, 3:]
        found = shapes @ ((row @ shapes) / modes.basis_omega[3:] ** 2)
        np.testing.assert_allclose(found, u, atol=1e-9 * np.abs(u).max())


def test_static_response_balances_the_load(plate):
    load = plate.dofs.row((0.11, 0.22, 0), "z")
    u = static_response(plate, load[:, None])[:, 0]
    R = plate.rigid_body
    force = plate.K @ u - (load - plate.M @ (R @ (R.T @ load)))
    assert np.abs(force).max() < 1e-9
    assert np.abs(R.T @ (plate.M @ u)).max() < 1e-12 * np.abs(u).max()
    expected = oracle.static_free(*oracle.plate_matrices(8, 8), R, load)
    np.testing.assert_allclose(u, expected, atol=1e-9 * np.abs(u).max())


def test_basis_is_orthonormal_and_diagonal(plate):
    at = [CORNER, Z8, (0.31, 0.42, 0.0), {"9:z": 1.0, "81:z": -1.0}, "40:rx"]
    modes = solve_modes(plate, count=24, compliance_at=at)
    assert modes.n_vectors == 5
    assert modes.vector_dofs == (CORNER, Z8, "(0.31, 0.42, 0)", "1 9:z + -1 81:z", "40:rx")
    basis = modes.basis
    np.testing.assert_allclose(basis.T @ (plate.M @ basis), np.eye(29), atol=1e-11)
    stiffness = basis.T @ (plate.K @ basis)
    size = np.r_[np.ones(3), modes.basis_omega[3:]]
    np.testing.assert_allclose(
        (stiffness - np.diag(modes.basis_omega**2)) / np.outer(size, size), 0, atol=1e-5
    )
    np.testing.assert_allclose(
        (stiffness[3:, 3:] / np.outer(size[3:], size[3:])), np.eye(26), atol=1e-9
    )
    assert np.all(np.diff(modes.vector_omega) > 0)
    assert modes.vector_omega[0] > modes.omega[-1]


def test_one_place_in_every_form_is_the_same_vector(plate):
    found = [
        solve_modes(plate, count=10, compliance_at=at)
        for at in (
            Z8,
            [Z8],
            (0.3, 0.15, 0.0),
            [(0.3, 0.15, 0.0)],
            {Z8: 1.0},
            np.array([0.3, 0.15, 0]),
        )
    ]
    for modes in found[1:]:
        np.testing.assert_allclose(modes.vector_omega, found[0].vector_omega, rtol=1e-9)


@pytest.mark.slow
def test_damping_of_vectors(plate):
    def vector_zeta(**options):
        modes = solve_modes(plate, count=24, compliance_at=[Z8], **options)
        return modes.vector_zeta, modes.vector_omega

    assert vector_zeta()[0] == 0
    assert vector_zeta(damping=ModalDamping(0.01))[0] == 0.01
    assert vector_zeta(damping=ModalDamping(0.01), compliance_damping=0.05)[0] == 0.05
    assert vector_zeta(compliance_damping=0.05)[0] == 0.05
    zeta, omega = vector_zeta(compliance_damping=Rayleigh(0.0, 1e-6))
    np.testing.assert_allclose(zeta, 0.5e-6 * omega)
    each = ModalDamping(np.full(24, 0.01))
    with pytest.raises(ModelError, match="compliance_damping="):
        vector_zeta(damping=each)
    assert vector_zeta(damping=each, compliance_damping=0.02)[0] == 0.02
    with pytest.raises(ModelError, match="damping ratios"):
        vector_zeta(compliance_damping=-1)


def test_damping_of_vectors_by_projection(plate):
    damped = plate.with_damping(ModalDamping(0.01))
    modes = solve_modes(damped, count=24, compliance_at=[Z8])
    v = modes.vectors[:, 0]
    np.testing.assert_allclose(
        modes.vector_zeta, v @ damped.D @ v / (2 * modes.vector_omega), rtol=1e-12
    )
    # the truncated modes have 1 %, and the vector is a mix of them
    assert 0.008 < modes.vector_zeta[0] < 0.01


@pytest.mark.slow
def test_held_structures_and_the_sparse_route():
    large = make_plate(elements=(24, 24))
    modes = solve_modes(large, count=24, compliance_at=CORNER)
    basis = modes.basis
    np.testing.assert_allclose(basis.T @ (large.M @ basis), np.eye(25), atol=1e-10)
    row = large.dofs.row(CORNER)
    u = static_response(large, row[:, None])[:, 0]
    dense = FEModel(large.M.toarray(), large.K.toarray(), dofs=large.dofs)
    expected = static_response(dense, row[:, None])[:, 0]
    np.testing.assert_allclose(u, expected, atol=1e-7 * np.abs(u).max())
    small = make_plate()
    ground = sp.csc_array(([1e7] * 3, ([0, 24, 240], [0, 24, 240])), shape=(243, 243))
    held = FEModel(small.M, small.K + ground, dofs=small.dofs)
    u = static_response(held, small.dofs.row(Z8)[:, None])[:, 0]
    np.testing.assert_allclose(held.K @ u, small.dofs.row(Z8), atol=1e-9)


def test_refusals(plate):
    with pytest.raises(ModelError, match="twice"):
        solve_modes(plate, count=24, compliance_at=[Z8, Z8])
    with pytest.raises(ModelError, match="already hold all"):
        solve_modes(plate, compliance_at=[Z8])
    with pytest.raises(LabelError, match="no DOF '1:x'"):
        solve_modes(plate, count=24, compliance_at=[Z8, "1:x"])
    with pytest.raises(LabelError, match="off the plate"):
        solve_modes(plate, count=24, compliance_at=[(0.3, 0.7, 0)])
    modes = solve_modes(plate, count=24)
    with pytest.raises(ModelError, match="already hold all"):
        attachment_vectors(plate, modes.phi, [{Z8: 0.0}])
