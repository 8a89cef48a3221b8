"""What an update finds goes into a plant, also where a damper drags the free structure."""

import numpy as np
import pytest

import oracles_updating as oracle
from flexplant.errors import FlexplantWarning
from flexplant.identification import MeasuredModes
from flexplant.lti import frequency_response
from flexplant.plant import assemble_plant
from flexplant.updating import AddedDamping, AddedMass, Eigenvalues, update
from stages import CORNERS, INSET, Z8, ports, reduced


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
