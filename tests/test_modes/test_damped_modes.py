"""Complex modes of large sparse models: beside a dense solution, with dampers and by regions."""

import warnings

import numpy as np
import pytest

import flexplant as fx
import oracles_joining as oracle
from flexplant.errors import FlexplantWarning, ModelError, SolverError
from flexplant.modes import complex_modes, normal_form, solve, sparse_modes

PLATE = {"thickness": 0.0272, "density": 2702, "youngs_modulus": 70e9, "poisson_ratio": 0.35}


def machine(region):
    """Two plates of 297 and 75 DOFs on three springs, with dampers or one of them damped more."""
    lower = fx.kirchhoff_plate(size=(0.8, 0.6), elements=(8, 10), **PLATE)
    upper = fx.kirchhoff_plate(size=(0.6, 0.5), elements=(4, 4), **PLATE)
    rates = (0.0, 0.0, 0.0) if region else (200.0, 50.0, 300.0)
    if region:
        upper = upper.with_damping(fx.structure.Rayleigh(0.0, 2e-6))
        lower = lower.with_damping(fx.structure.Rayleigh(0.0, 2e-7))
    feet = [(0.1, 0.1), (0.5, 0.1), (0.3, 0.4)]
    joints = [
        fx.joining.Joint(
            ("up", (x, y, 0.1)), ("low", (x, y, 0.0)), axes=["z"], stiffness=2e6, rate=c
        )
        for (x, y), c in zip(feet, rates, strict=True)
    ]
    placed = {"up": fx.joining.Pose((0.0, 0.0, 0.1))}
    return fx.joined({"low": lower, "up": upper}, joints, placed=placed)


@pytest.mark.slow
@pytest.mark.parametrize("region", [False, True])
def test_complex_modes_of_a_large_model(region, monkeypatch):
    model = machine(region)
    for module in (solve, sparse_modes):  # a dense solution is the reference
        monkeypatch.setattr(module, "DENSE_LIMIT", 100)
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


def halves(rate):
    """A plate of two halves, held at one end, on springs and dampers between all nodes."""
    half = fx.kirchhoff_plate(size=(0.3, 0.6), elements=(3, 4), **PLATE)
    edge = half.dofs.where(box=[(0, 0, 0), (0, 1, 0)]).labels
    models, placed = {"a": half.fixed(edge), "b": half}, {"b": fx.joining.Pose((0.3, 0.0, 0.0))}
    rates, springs = rate * np.array([1, 0.01, 0.01]), [1e7, 1e5, 1e5]
    joints = [
        fx.joining.Joint(joint.first, joint.second, axes=joint.axes, stiffness=springs, rate=rates)
        for joint in fx.joining.coincident_joints(models, placed=placed)
    ]
    return fx.joined(models, joints, placed=placed)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "slow"), [(300.0, False), (3e4, True), (3e6, True)])
def test_overdamped_motions_are_set_apart(rate, slow, monkeypatch):
    """Far above the wanted modes, in silence; with a warning where their poles are among them."""
    model = halves(rate)
    poles = oracle.slow_poles(*(part.toarray() for part in (model.M, model.D, model.K)))
    swing = poles[poles.imag > 1e-6 * np.abs(poles)][:8]
    still = poles[np.abs(poles.imag) <= 1e-6 * np.abs(poles)].real
    assert still.size > 10
    among = np.count_nonzero(np.abs(still) < np.abs(swing[-1]))
    at_dampers = model.dofs.where(box=[(0.29, -1, -1), (0.31, 1, 1)]).labels
    rom = fx.reduce(model, fx.reduction.CraigBampton(at_dampers, 30))
    for is_large in (False, True):
        for module in (solve, complex_modes):
            monkeypatch.setattr(module, "is_large", lambda model, large=is_large: large)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            modes = fx.solve_modes(model, count=8)
        np.testing.assert_allclose(modes.poles, swing, rtol=1e-8)
        np.testing.assert_allclose(modes.zeta, -swing.real / np.abs(swing), rtol=1e-6)
        texts = [str(one.message) for one in said]
        assert texts == list(modes.notes)
        assert bool(texts) == bool(among) == slow
        if among:
            assert f"{among} real poles of overdamped motions ({still[0]:.4g}, " in texts[0]
        if rate == 3e4:  # up to a frequency, whatever oscillates there
            inside = np.count_nonzero(np.abs(still) < 2 * np.pi * 70.0)
            with pytest.warns(FlexplantWarning, match=f"^{inside} real poles"):
                assert fx.solve_modes(model, below=70.0).n_modes == 1
    with pytest.warns(FlexplantWarning, match="real poles of overdamped motions"):
        np.testing.assert_allclose(rom.modes().freq[:4], modes.freq[:4], rtol=1e-3)


def test_what_is_not_found_is_refused(monkeypatch):
    for module in (solve, sparse_modes):
        monkeypatch.setattr(module, "DENSE_LIMIT", 100)
    model = machine(False)
    with pytest.raises(ModelError, match="take no attachment vectors"):
        fx.solve_modes(model, count=8, compliance_at="low/1:z")
    monkeypatch.setattr(complex_modes, "MOST_STEPS", 2)
    with pytest.raises(SolverError, match="complex modes leave a relative residual"):
        fx.solve_modes(model, count=8)
