"""Regions of a plate with a thickness, modulus and density of their own."""

import numpy as np
import pytest

from flexplant.errors import FlexplantWarning, LabelError, ModelError, ShapeError
from flexplant.identification import MeasuredModes
from flexplant.modes import solve_modes
from flexplant.reduction import DesiredDofs, reduce, select_dofs
from flexplant.structure import ModalDamping, kirchhoff_plate
from flexplant.updating import (
    Eigenvalues,
    MatrixParameter,
    eigenvalue_sensitivities,
    localise,
    update,
)

THICK = 0.02
LEFT = np.zeros((6, 4), dtype=bool)
LEFT[:2] = True  # not half: mirror images have the same slopes
REGIONS = {"left": LEFT, "right": ~LEFT}
REST = {"size": (0.6, 0.4), "elements": (6, 4), "poisson_ratio": 0.3}
FIELDS = {"thickness": THICK, "youngs_modulus": 70e9, "density": 2702.0}


def plate(**changes):
    return kirchhoff_plate(**REST, **(FIELDS | changes))


def builder(quantity):
    return lambda field: plate(**{quantity: field})


@pytest.fixture(scope="module")
def rom():
    model = plate()
    modes = solve_modes(model, count=20, damping=ModalDamping(0.01))
    return reduce(modes, DesiredDofs(select_dofs(modes, 20).labels))


def omegas(quantity, p):
    """Elastic frequencies of the full model with both regions changed."""
    field = FIELDS[quantity] * np.where(LEFT, 1 + p[0], 1 + p[1])
    return solve_modes(plate(**{quantity: field}), count=12).omega[3:]


@pytest.mark.parametrize("quantity", list(FIELDS))
def test_slopes_are_those_of_the_full_model(rom, quantity):
    parameters = MatrixParameter.regions(builder(quantity), REGIONS, value=FIELDS[quantity])
    modes = range(4, 9)
    S = eigenvalue_sensitivities(rom, parameters, modes=modes).S
    h = 1e-3
    for b in range(2):
        step = h * np.eye(2)[b]
        slope = (omegas(quantity, step) - omegas(quantity, -step))[:5] / (2 * h)
        # poles are -zeta omega + i omega sqrt(1 - zeta^2); D stays
        assert np.abs(S[:, b].imag - slope).max() < 2e-3 * np.abs(slope).max()
    # both regions together are the whole plate: thickness moves all frequencies alike
    whole = {"thickness": 1.0, "youngs_modulus": 0.5, "density": -0.5}[quantity]
    np.testing.assert_allclose(S.sum(axis=1).imag / rom.modes().omega[3:8], whole, rtol=2e-3)


@pytest.mark.slow
def test_two_thicknesses_are_found(rom):
    truth = np.array([0.04, -0.03])
    omega = omegas("thickness", truth)[:6]
    data = [
        Eigenvalues(MeasuredModes(omega * (-0.01 + 1j * np.sqrt(1 - 1e-4)), modes=range(4, 10)))
    ]
    thick = np.full(LEFT.shape, THICK)
    for _ in range(4):
        parameters = MatrixParameter.regions(builder("thickness"), REGIONS, value=thick)
        model = plate(thickness=thick)
        modes = solve_modes(model, count=20, damping=ModalDamping(0.01))
        fit = update(reduce(modes, DesiredDofs(rom.dofs)), parameters, data)
        thick = thick * np.where(LEFT, 1 + fit.values[0], 1 + fit.values[1])
    assert fit.parameters == ("left", "right")
    found = np.array([thick[0, 0], thick[-1, 0]]) / THICK - 1
    np.testing.assert_allclose(found, truth, atol=1e-7)


def test_an_array_of_values_and_overlaps():
    field = 70e9 * np.linspace(1, 2, 24).reshape(6, 4)
    both = MatrixParameter.regions(
        builder("youngs_modulus"), {"left": LEFT, "all": LEFT | True}, value=field, bounds=(-1, 1)
    )
    full = plate(youngs_modulus=field).K
    assert abs(both[1].dK - full).max() < 1e-9 * abs(full).max()
    left = full - plate(youngs_modulus=np.where(LEFT, 1e-9, 1.0) * field).K
    assert abs(both[0].dK - left).max() < 1e-8 * abs(full).max()
    assert both[0].bounds == (-1.0, 1.0)


def test_bad_regions_are_refused():
    build = builder("thickness")
    with pytest.raises(LabelError, match="mapping"):
        MatrixParameter.regions(build, [LEFT], value=THICK)
    with pytest.raises(ShapeError, match="True or False"):
        MatrixParameter.regions(build, {"a": [1, 2]}, value=THICK)
    with pytest.raises(ShapeError, match="choose some"):
        MatrixParameter.regions(build, {"a": LEFT & False}, value=THICK)
    with pytest.raises(ShapeError, match="shape"):
        MatrixParameter.regions(build, {"a": LEFT, "b": LEFT[:3]}, value=THICK)
    with pytest.raises(ShapeError, match="shape"):
        MatrixParameter.regions(build, {"a": LEFT}, value=np.ones(3))
    with pytest.raises(ModelError, match="zero"):
        MatrixParameter.regions(build, {"a": LEFT}, value=0.0)
    with pytest.raises(ModelError, match="function"):
        MatrixParameter.regions(None, {"a": LEFT}, value=THICK)
    with pytest.raises(LabelError, match="name"):
        MatrixParameter.regions(build, {3: LEFT}, value=THICK)


@pytest.mark.slow
def test_a_soft_region_is_localised(rom):
    """12 regions of 2 elements; one is 8 % softer: found up to the plate's mirror images."""
    masks = {}
    for i in range(6):
        for j in range(2):
            mask = np.zeros((6, 4), dtype=bool)
            mask[i, 2 * j : 2 * j + 2] = True
            masks[f"{i}{j}"] = mask
    build = builder("youngs_modulus")
    soft = solve_modes(plate(youngs_modulus=70e9 * np.where(masks["21"], 0.92, 1.0)), count=13)
    omega = soft.omega[3:]
    rng = np.random.default_rng(1)
    poles = omega * (-0.01 + 1j * np.sqrt(1 - 1e-4))
    std = 1e-5 * omega
    noise = (rng.normal(size=10) + 1j * rng.normal(size=10)) * std / np.sqrt(2)
    data = MeasuredModes(poles + noise, modes=range(4, 14), covariance=std**2)
    pool = MatrixParameter.regions(build, masks, value=70e9)
    # damping stays proportional to frequency in the data, which noise of 1e-5 shows
    with pytest.warns(FlexplantWarning, match="more than noise"):
        found = localise(rom, pool, [Eigenvalues(data)], most=1)
    images = {"20", "21", "30", "31"}
    assert set(found.alike) | set(found.rivals) >= images
    assert set(found.ranking[:4]) == images
    assert found.chosen_values[0] == pytest.approx(-0.08, abs=0.01)
