"""Complex modes of large sparse models: beside a dense solution, with dampers and by regions."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import ModelError, SolverError
from flexplant.modes import damped_modes, normal_form, solve

PLATE = {"thickness": 0.0272, "density": 2702, "youngs_modulus": 70e9, "poisson_ratio": 0.35}


def machine(region):
    """Two plates of 297 and 75 DOFs on three springs, with dampers or one of them damped more."""
    lower = fx.kirchhoff_plate(size=(0.8, 0.6), elements=(8, 10), **PLATE)
    upper = fx.kirchhoff_plate(size=(0.6, 0.5), elements=(4, 4), **PLATE)
    rates = (0.0, 0.0, 0.0) if region else (200.0, 50.0, 300.0)
    if region:
        upper = upper.with_damping(fx.Rayleigh(0.0, 2e-6))
        lower = lower.with_damping(fx.Rayleigh(0.0, 2e-7))
    feet = [(0.1, 0.1), (0.5, 0.1), (0.3, 0.4)]
    joints = [
        fx.Joint(("up", (x, y, 0.1)), ("low", (x, y, 0.0)), axes=["z"], stiffness=2e6, rate=c)
        for (x, y), c in zip(feet, rates, strict=True)
    ]
    placed = {"up": fx.Pose((0.0, 0.0, 0.1))}
    return fx.joined({"low": lower, "up": upper}, joints, placed=placed)


@pytest.mark.slow
@pytest.mark.parametrize("region", [False, True])
def test_complex_modes_of_a_large_model(region, monkeypatch):
    model = machine(region)
    monkeypatch.setattr(solve, "DENSE_LIMIT", 100)  # a dense solution is the reference
    found = fx.solve_modes(model, count=16)
    assert np.iscomplexobj(found.phi)
    assert np.all(found.freq[:3] == 0)
    assert found.residual.max() < 1e-8
    exact = normal_form(model.M, model.D, model.K, model.rigid_body)
    np.testing.assert_allclose(found.poles[3:], exact.poles[3:16], rtol=1e-9)
    lost = np.linalg.norm(found.phi[:, 3:] - exact.phi[:, 3:16], axis=0)
    assert np.all(lost < 1e-4 * np.linalg.norm(exact.phi[:, 3:16], axis=0))
    band = fx.solve_modes(model, below=float(found.freq[9]) * 1.0001)
    np.testing.assert_allclose(band.poles, found.poles[: band.n_modes], rtol=1e-8)
    assert band.n_modes == 10


def test_what_is_not_found_is_refused(monkeypatch):
    monkeypatch.setattr(solve, "DENSE_LIMIT", 100)
    model = machine(False)
    with pytest.raises(ModelError, match="take no attachment vectors"):
        fx.solve_modes(model, count=8, compliance_at="low/1:z")
    monkeypatch.setattr(damped_modes, "_STEPS", 2)
    with pytest.raises(SolverError, match="complex modes leave a relative residual"):
        fx.solve_modes(model, count=8)
