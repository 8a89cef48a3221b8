"""A model that lacks what the machine has: every such fit warns, names, widens and points on."""

import numpy as np
import pytest

import noisy_plate
import oracles_updating as oracle
from flexplant.errors import FlexplantWarning
from flexplant.lti import Frf
from flexplant.modes import solve_modes
from flexplant.reduction import DesiredDofs, reduce, select_dofs
from flexplant.structure import ModalDamping, kirchhoff_plate
from flexplant.updating import (
    AddedDamping,
    AddedMass,
    FrfResidual,
    MatrixParameter,
    localise,
    update,
)
from plates import PLATE, make_plate


def responses(M, D, K, freq, rows, force, rng, noise=0.01):
    """Responses (n_out, 1, f) with complex noise of a part of the rms, and its variance."""
    load = np.eye(len(M))[:, force]
    H = np.array([np.linalg.solve(K - w**2 * M + 1j * w * D, load)[rows] for w in 2 * np.pi * freq])
    H = np.moveaxis(H[:, :, None], 0, 2)
    variance = noise**2 * np.mean(np.abs(H) ** 2, axis=2, keepdims=True) * np.ones(H.shape)
    error = rng.normal(size=H.shape) + 1j * rng.normal(size=H.shape)
    return H + error * np.sqrt(variance / 2), variance


def formal(fit):
    """The standard deviations without the widening."""
    return fit.std / np.sqrt(fit.chi2 / fit.dof)


@pytest.mark.slow
def test_a_region_left_out():
    """All of E is 3 % higher, a strip another 12 %: E alone is wrong, which is said."""
    strip = np.zeros(PLATE["elements"], dtype=bool)
    strip[2:4] = True
    modulus = 70e9 * 1.03 * np.where(strip, 1.12, 1.0)
    drawing, machine = make_plate(), make_plate(youngs_modulus=modulus)
    nearest = drawing.dofs.nearest
    corners = [nearest((x, y, 0.0), "z") for x in (0.0, 0.6) for y in (0.0, 0.6)]
    modes = solve_modes(drawing, count=30, damping=ModalDamping(0.01))
    rom = reduce(modes, DesiredDofs(select_dofs(modes, 30, required=corners).labels))
    M, K = (part.toarray() for part in (machine.M, machine.K))
    index = drawing.dofs.index
    rows = [index(label) for label in corners[1:]]
    freq = np.linspace(150, 400, 20)
    D = oracle.modal_damping(M, K, 0.01)
    H, variance = responses(M, D, K, freq, rows, index(corners[0]), np.random.default_rng(3))
    frf = Frf(freq, H, inputs=corners[:1], outputs=corners[1:], variance=variance)
    stiffer = MatrixParameter("E", dK=drawing.K)
    with pytest.warns(FlexplantWarning, match="leaves more than noise") as said:
        fit = update(rom, [stiffer], [FrfResidual(frf)])
    assert fit.dof == 119
    assert fit.chi2 / fit.dof > 5
    assert fit.p_value < 1e-12
    # the value is wrong, and its deviation without the widening would deny it
    gap = fit.values[0] - 0.03
    assert gap > 20 * formal(fit)[0]
    assert fit.std[0] == pytest.approx(formal(fit)[0] * np.sqrt(fit.chi2 / fit.dof), rel=1e-9)
    text = str(said[0].message)
    assert "standard deviations" in text and "localise(" in text and " Hz (" in text


@pytest.mark.slow
def test_a_mass_looked_for_in_the_wrong_place():
    """Half a kilogram at one place, looked for at another: 0.17 kg there, which does not fit."""
    campaign = noisy_plate.Campaign()
    frf = Frf(
        noisy_plate.FREQ,
        campaign.H,
        inputs=campaign.inputs,
        outputs=campaign.outputs,
        variance=campaign.variance,
    )
    data, wrong, right = [FrfResidual(frf)], campaign.outputs[1], campaign.at
    with pytest.warns(FlexplantWarning, match=r"leaves more than noise.* / .* Hz \(.*localise"):
        fit = update(campaign.rom, [AddedMass(wrong)], data)
    assert fit.chi2 > 100 * fit.dof
    assert abs(fit.values[0] - 0.5) > 3 * fit.std[0] / np.sqrt(fit.chi2 / fit.dof)
    # as the warning says
    pool = [AddedMass(wrong, name="wrong"), AddedMass(right, name="right")]
    found = localise(campaign.rom, pool, data, most=1)
    assert found.chosen == ("right",)
    assert found.chosen_values[0] == pytest.approx(0.5, rel=1e-3)


@pytest.mark.long
def test_a_full_model_from_its_default_start():
    """Responses of all DOFs, 1.5 kg and 8 % away from them: found from zeros, up to noise."""
    shape = {"size": (0.6, 0.45), "thickness": 0.02, "elements": (4, 4), "density": 2702}
    model = kirchhoff_plate(**shape, youngs_modulus=70e9, poisson_ratio=0.35)
    M, K = (part.toarray() for part in (model.M, model.K))
    D = oracle.modal_damping(M, K, 0.01)
    nearest, index = model.dofs.nearest, model.dofs.index
    at = nearest((0.3, 0.1125, 0.0), "z")
    corners = [nearest((x, y, 0.0), "z") for x in (0.0, 0.6) for y in (0.0, 0.45)]
    heavier = M.copy()
    heavier[index(at), index(at)] += 1.5
    rows = [index(label) for label in corners[1:]]
    freq, rng = np.linspace(60, 500, 40), np.random.default_rng(5)
    H, variance = responses(heavier, D, 1.08 * K, freq, rows, index(corners[0]), rng)
    frf = Frf(freq, H, inputs=corners[:1], outputs=corners[1:], variance=variance)
    unknown = [AddedMass(at), MatrixParameter("E", dK=model.K)]
    fit = update(model.replace(D=D), unknown, [FrfResidual(frf)])
    assert H.size * 2 == 240
    assert fit.p_value > 1e-3
    assert np.abs((fit.values - [1.5, 0.08]) / fit.std).max() < 4


@pytest.mark.long
def test_other_starts_are_tried_where_the_first_explains_nothing(plate):
    """2 kg and 12 % at 0.2 % damping end at -0.45 kg from zero; a start farther on finds them."""
    zeta, mass, stiffer = 0.002, 2.0, 0.12
    M, K = oracle.plate()
    D = oracle.modal_damping(M, K, zeta)
    at = oracle.z_dof(0.3, 0.15)
    M[at, at] += mass
    corners = [(0.0, 0.0), (0.6, 0.6), (0.3, 0.3), (0.0, 0.6)]
    rows = [oracle.z_dof(*xy) for xy in corners]
    freq, rng = np.linspace(100, 1400, 150), np.random.default_rng(5)
    H, variance = responses(M, D, (1 + stiffer) * K, freq, rows[1:], rows[0], rng)
    names = [plate.model.dofs.nearest((*xy, 0.0), "z") for xy in corners]
    frf = Frf(freq, H, inputs=names[:1], outputs=names[1:], variance=variance)
    unknown = [AddedMass(plate.z8), AddedDamping(plate.z8), MatrixParameter("E", dK=plate.model.K)]
    fit = update(plate.reduced(zeta, True), unknown, [FrfResidual(frf)])
    assert fit.p_value > 1e-3
    np.testing.assert_allclose(fit.values[[0, 2]], [mass, stiffer], rtol=0.01)
    assert len(fit.starts.cost) > 1
    assert fit.starts.cost.min() < 1e-2 * fit.starts.cost[0]
    np.testing.assert_allclose(fit.starts.begin[0], 0.0, atol=0.0)
    np.testing.assert_array_equal(fit.history.parameters[-1], fit.values)
