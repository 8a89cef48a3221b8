"""Predicted errors and the mesh of the evaluation model, next to a plate of a finer mesh."""

import warnings

import numpy as np
import pytest

from flexplant.errors import FlexplantWarning
from flexplant.estimation import design_kalman
from flexplant.estimation.left_out_modes import nodes_per_wavelength
from flexplant.modes import solve_modes
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Sensor, assemble_plant
from flexplant.reduction import ModalTruncation, reduce
from flexplant.structure import FEModel, ModalDamping, beam, kirchhoff_plate, solid_block

WIDE, DEEP = 0.5, 0.3
CORNERS = [(x, y, 0.0) for y in (0.0, DEEP) for x in (0.0, WIDE)]
INSET = [(x, y, 0.0) for y in (DEEP / 4, 3 * DEEP / 4) for x in (WIDE / 4, 3 * WIDE / 4)]


def plate(elements):
    bare = kirchhoff_plate(
        size=(WIDE, DEEP), thickness=0.02, elements=(elements, elements), density=2702,
        youngs_modulus=70e9, poisson_ratio=0.35,
    )  # fmt: skip
    return bare.with_damping(ModalDamping(0.01))


def sampled(structure):
    ports = Ports(
        w=[Disturbance(f"amp{i}", at=p, asd=1e-3) for i, p in enumerate(INSET)],
        u=[Actuator(f"u{i}", at=p) for i, p in enumerate(INSET)],
        z=[Poi("die", at=(WIDE / 2, DEEP / 2, 0.0))],
        y=[Sensor(f"y{i}", at=p, asd=1e-12) for i, p in enumerate(CORNERS)],
    )
    return assemble_plant(structure, ports).discretized(10e3, delay=1.5)


def test_nodes_per_wavelength_of_a_beam():
    """Free modes far from the ends are waves: mode n of a long beam has n - 1.5 half waves."""
    model = beam(length=1.0, elements=80, density=2700, youngs_modulus=70e9, area=1e-4,
                 inertia=1e-9)  # fmt: skip
    modes = solve_modes(model, count=42)
    found = nodes_per_wavelength(model, modes.phi[:, :, None])
    number = np.arange(18, 42)
    assert found[number] == pytest.approx(80 * 2 / (number + 1 - 1.5), rel=0.05)
    # nodes side by side, where no matrix couples them
    lumped = FEModel(np.diag(model.M.diagonal()), model.K, dofs=model.dofs)
    for other in (lumped, modes):
        same = nodes_per_wavelength(other, modes.phi[:, :, None])
        np.testing.assert_allclose(same, found, rtol=1e-12)


def clamped_inside(plate):
    """The plate held in a rectangle, whose nodes it then lacks."""
    return plate.fixed(plate.dofs.where(box=[(0.16, 0.06, 0.0), (0.39, 0.19, 0.0)]))


MESHES = {
    "plate": lambda: plate(8),
    "block": lambda: solid_block(
        size=(0.3, 0.2, 0.05), elements=(6, 4, 2), density=2700, youngs_modulus=70e9,
        poisson_ratio=0.33,
    ),
    "hole": lambda: clamped_inside(kirchhoff_plate(
        size=(WIDE, DEEP), thickness=0.02, elements=(10, 8), density=2702, youngs_modulus=70e9,
        poisson_ratio=0.35,
    )),
}  # fmt: skip


@pytest.mark.parametrize("kind", MESHES)
def test_modes_have_the_mesh_of_their_model(kind):
    model = MESHES[kind]()
    modes = solve_modes(model, count=60)
    shapes = modes.phi[:, 6:, None]
    found = nodes_per_wavelength(modes, shapes) / nodes_per_wavelength(model, shapes)
    assert found.min() > 0.85 and found.max() < 1.2
    assert np.median(found) == pytest.approx(1.05, abs=0.06)


@pytest.mark.slow
def test_a_coarse_mesh_is_warned_of_in_every_form_of_the_evaluation_model():
    coarse = plate(8)
    modes = solve_modes(coarse, count=100)
    small, plant = sampled(reduce(modes, ModalTruncation(24))), sampled(modes.select(range(24)))
    shares = []
    for given in (plant.replace(evaluation=coarse), plant.replace(evaluation=modes), small):
        with pytest.warns(FlexplantWarning, match="evaluation= of a finer mesh"):
            shares.append(design_kalman(given).certificate["unresolved share"])
    assert shares == pytest.approx([shares[0]] * 3, abs=0.1)


@pytest.mark.long
def test_a_mesh_that_is_too_coarse_is_warned_of_and_one_that_is_fine_is_not():
    truth = sampled(solve_modes(plate(20), count=150))
    coarse, fine = plate(8), plate(12)
    with pytest.warns(FlexplantWarning, match="evaluation= of a finer mesh"):
        wrong = design_kalman(sampled(solve_modes(coarse, count=24)).replace(evaluation=coarse))
    assert wrong.rms("die") > 1.25 * wrong.rms("die", on=truth)
    assert wrong.certificate["unresolved share"] > 0.5 and "nodes of the mesh" in repr(wrong)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        right = design_kalman(sampled(solve_modes(fine, count=24)).replace(evaluation=fine))
    assert right.rms("die") == pytest.approx(right.rms("die", on=truth), rel=0.05, abs=0)
    assert right.certificate["unresolved share"] < 0.15 and "nodes" not in repr(right)
