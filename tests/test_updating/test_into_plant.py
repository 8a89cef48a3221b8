"""What an update finds goes into a plant, also where a damper drags the free structure."""

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp

import oracles_updating as oracle
from flexplant.errors import FlexplantWarning, LabelError, ModelError
from flexplant.identification import MeasuredModes
from flexplant.lti import frequency_response
from flexplant.modes import solve_modes
from flexplant.plant import assemble_plant
from flexplant.plant.realisation import realise
from flexplant.structure import FEModel, ModalDamping, kirchhoff_plate
from flexplant.updating import (
    AddedDamping,
    AddedMass,
    AddedStiffness,
    Eigenvalues,
    History,
    MatrixParameter,
    ModeDamping,
    UpdateResult,
    update,
)
from oracles_plant import machine
from stages import CORNERS, INSET, Z8, full, ports, reduced, some_modes


@pytest.mark.slow
def test_a_large_damper_to_the_ground_on_a_free_plate(plate):
    """60 N s/m at z8: the rigid-body motions are dragged and the plant has no modal form."""
    rom = reduced(0.01)
    at = rom.full_dofs.nearest(Z8, "z")
    row = rom.row(at)
    M = rom.M + 0.5 * np.outer(row, row)
    D = rom.D + 60.0 * np.outer(row, row)
    poles = oracle.poles(M, D, rom.K)
    poles = poles[poles.imag > 500][:6]
    data = [Eigenvalues(MeasuredModes(poles, modes=range(4, 10)))]
    fit = update(rom, [AddedMass(at), AddedDamping(at)], data)
    np.testing.assert_allclose(fit.values, [0.5, 60.0], rtol=1e-6)

    with pytest.warns(FlexplantWarning, match="dampers to ground drag rigid-body motion"):
        made = assemble_plant(fit.model, ports())
    assert made.form.startswith("dense")
    freq = np.array([0.5, 20.0, 300.0, 455.0, 632.0])
    found = frequency_response(made.Gyu, freq).data
    C = np.array([rom.row(p, "z") for p in CORNERS])
    B = np.array([rom.row(p, "z") for p in INSET]).T
    for n, w in enumerate(2 * np.pi * freq):
        exact = C @ np.linalg.solve(rom.K + 1j * w * D - w**2 * M, B.astype(complex))
        assert np.abs(found[:4, :, n] - exact).max() < 1e-5 * np.abs(exact).max()
    # dragged: slow real poles beside the rigid-body tilts that the damper at z8 does not hold
    real = made.system.poles()
    slow = real[np.abs(real) < 100.0]
    assert np.sum(slow.real < -1.0) >= 1
    sampled = made.discretized(10e3, delay=1)
    assert np.abs(sampled.system.poles()).max() < 1 + 1e-6


@pytest.mark.slow
def test_the_full_structure_takes_the_answer_too(plate):
    """The same damper and mass on the FEModel give the poles of the updated reduced model."""
    rom = plate.reduced(0.01, True)
    M, K = oracle.plate()
    D = oracle.modal_damping(M, K, 0.01)
    at = oracle.z_dof(0.3, 0.15)
    M[at, at] += 0.5
    D[at, at] += 60.0
    poles = oracle.poles(M, D, K)
    poles = poles[poles.imag > 500][:6]
    data = [Eigenvalues(MeasuredModes(poles, modes=range(4, 10)))]
    fit = update(rom, [AddedMass(plate.z8), AddedDamping(plate.z8)], data)
    np.testing.assert_allclose(fit.values, [0.5, 60.0], rtol=5e-3)


@pytest.mark.slow
def test_the_full_model_with_the_parameters_of_a_fit(plate):
    """M, D and K of the full FEModel are its own plus the estimated mass, damper and modulus."""
    rom = plate.reduced(0.01, True)
    model = plate.model.with_damping(ModalDamping(0.01))
    stiffer = MatrixParameter("E", dK=plate.model.K, prior=(0.0, 0.01))
    unknowns = [AddedMass(plate.z8), AddedDamping(plate.z8), stiffer, ModeDamping(6)]
    M, K = oracle.plate()
    D = oracle.modal_damping(M, K, 0.01)
    square, phi = la.eigh(K, M)
    omega = np.sqrt(np.abs(square))
    force = M @ phi[:, 5]
    at = oracle.z_dof(0.3, 0.15)
    D = D + 2 * 0.002 * omega[5] * np.outer(force, force)
    K = 1.01 * K
    M[at, at] += 0.3
    D[at, at] += 5.0
    exact = oracle.poles(M, D, K)
    exact = exact[exact.imag > 500][:8]
    noise = np.diag(np.tile(1e-8 * np.abs(exact) ** 2, 2))
    data = [Eigenvalues(MeasuredModes(exact, modes=range(4, 12), covariance=noise))]
    fit = update(rom, unknowns, data)
    whole = fit.applied_to(model)
    assert isinstance(whole, FEModel)
    assert whole.dofs is model.dofs
    mass, damper, modulus, ratio = fit.values
    rise = {"M": np.zeros_like(M), "K": modulus * model.K.toarray()}
    rise["M"][at, at] = mass
    rise["D"] = 2 * ratio * omega[5] * np.outer(force, force)
    rise["D"][at, at] += damper
    for name, change in rise.items():
        before, after = (
            np.asarray(sp.csc_array(getattr(m, name)).todense()) for m in (model, whole)
        )
        error = np.abs(after - before - change).max()
        assert error < 1e-9 * max(np.abs(change).max(), 1e-6 * np.abs(before).max())
    # the structure that was measured: within what the fit leaves
    found = oracle.poles(whole.M.toarray(), whole.D, whole.K.toarray())
    found = found[found.imag > 500][:8]
    assert np.abs(found / exact - 1).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("zeta", [0.01, 0.001])
def test_a_slightly_negative_drag_is_no_obstacle(zeta):
    """The damper of the paper's update ends at -0.2 zeta N s/m: below the convention for drags."""
    M, D, K = machine(zeta, mass=0.5)
    exact = oracle.poles(M, D, K)
    exact = exact[exact.imag > 500]
    measured = MeasuredModes(exact[2:4], modes=[6, 7])
    at = some_modes(zeta).dofs.nearest(Z8, "z")
    fit = update(reduced(zeta), [AddedMass(at), AddedDamping(at)], [Eigenvalues(measured)])
    assert fit.values[1] < 0
    whole = fit.applied_to(full(zeta))
    found = realise(whole)
    assert found.n_rigid == 3
    poles = np.linalg.eigvals(found.pairs[3:]).reshape(-1)
    poles = poles[poles.imag > 0]
    np.testing.assert_allclose(poles[np.argsort(poles.imag)][:12], exact[:12], rtol=1e-6)
    # what feeds energy in beyond that is refused as before
    with pytest.raises(ModelError, match="FEModel refuses: D is not positive"):
        fit.replace(values=np.array([0.5, -5.0])).applied_to(full(zeta))


@pytest.mark.slow
def test_a_large_model_stays_sparse_and_a_model_without_damping_is_remarked_on():
    """1587 DOFs: masses, springs and the damping of a mode; dampers beside no D of its own warn."""
    model = kirchhoff_plate(
        size=(0.6, 0.6), thickness=0.02, elements=(22, 22), density=2702,
        youngs_modulus=70e9, poisson_ratio=0.35,
    )  # fmt: skip
    at = model.dofs.nearest((0.3, 0.15, 0.0), "z")
    i = model.dofs.index(at)
    unknowns = (AddedMass(at), AddedStiffness(at))
    fit = _fit_of(unknowns, [0.5, 1e4])
    whole = fit.applied_to(model)
    assert sp.issparse(whole.M)
    assert sp.issparse(whole.K)
    assert whole.M[i, i] - model.M[i, i] == pytest.approx(0.5, rel=1e-12)
    assert whole.K[i, i] - model.K[i, i] == pytest.approx(1e4, rel=1e-6)
    assert whole.rigid_body.shape[1] == 2  # the spring holds the plate at one point
    with pytest.warns(FlexplantWarning, match="has no D"):
        damped = _fit_of([ModeDamping(6)], [0.01]).applied_to(model)
    modes = solve_modes(model, count=8)
    omega, phi = modes.omega, modes.phi
    np.testing.assert_allclose(
        np.diag(phi.T @ damped.D @ phi)[3:] / (2 * omega[3:]), [0, 0, 0.01, 0, 0], atol=1e-9
    )
    with pytest.raises(ModelError, match="FEModel refuses"):
        _fit_of([AddedMass(at)], [-5.0]).applied_to(model)
    with pytest.raises(LabelError, match="9999:z"):
        _fit_of([AddedMass("9999:z")], [1.0]).applied_to(model)
    with pytest.raises(ModelError, match="needs an FEModel"):
        fit.applied_to("plate")


def _fit_of(unknowns, values):
    """Return an UpdateResult with given values."""
    q = len(values)
    return UpdateResult(
        parameters=tuple(p.name for p in unknowns),
        units=tuple(p.unit for p in unknowns),
        values=np.array(values),
        covariance=None,
        correlation=np.eye(q),
        model=None,
        history=History(np.zeros((1, q)), np.zeros((1, 1), complex), np.zeros(1), np.zeros(1)),
        converged=True,
        reason="given",
        unknowns=tuple(unknowns),
    )
