"""Poles of plants, and G(j omega) against (-w^2 M + i w D + K)^-1 (oracles_plant, dense)."""

import numpy as np
import pytest

from flexplant import DofSet
from flexplant.errors import ModelError
from flexplant.lti import frequency_response
from flexplant.modes import solve_modes
from flexplant.plant import assemble_plant
from flexplant.plant.realisation import natural, realise
from flexplant.structure import FEModel, ModalDamping
from oracles_plant import machine, motion_row, receptance
from oracles_structure import poles as dense_poles
from stages import CORNERS, INSET, OFF_NODE, fitted, full, ports, reduced, some_modes

FREQ = np.array([3.0, 40.0, 200.0, 245.7, 300.0, 463.0, 640.0, 1500.0, 3700.0])
POLES = np.array([-28.569 + 2883.567j, -39.451 + 3983.308j])
MEASURED = {0.01: POLES, 0.001: np.array([-2.857 + 2883.707j, -3.945 + 3983.501j])}


def gain(model, freq=FREQ):
    """[die:z rx ry, y1...y4] per force at the insets, off-node POI."""
    plant = assemble_plant(model, ports(die=OFF_NODE))
    g = plant.system.select([*plant.z[:3], *plant.y[:4]], plant.u)
    return frequency_response(g, freq).data


def oracle(zeta=0.01, freq=FREQ, **changes):
    M, D, K = machine(zeta, **changes)
    see = [motion_row(*OFF_NODE[:2], axis) for axis in ("z", "rx", "ry")]
    see += [motion_row(x, y, "z") for x, y, _ in CORNERS]
    push = np.array([motion_row(x, y, "z") for x, y, _ in INSET])
    return receptance(M, D, K, np.array(see), push, 2 * np.pi * freq)


def test_frequencies_and_dampings_of_blocks_are_those_of_the_modes():
    zeta = [0.0, 0.0, 0.0, 0.01, 0.002]
    modes = solve_modes(full(), count=5, damping=ModalDamping(zeta))
    omega, found = natural(realise(modes).pairs)
    np.testing.assert_allclose(omega[3:], 2 * np.pi * modes.freq[3:], rtol=1e-9)
    np.testing.assert_allclose(found[3:], zeta[3:], rtol=1e-6)


def close(found, wanted, tolerance):
    size = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    return bool(np.all(np.abs(found - wanted) <= tolerance * (np.abs(wanted) + 1e-3 * size)))


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{}, {"mass": 0.5, "damper": 200.0}])
def test_a_full_model_is_the_dense_receptance(changes):
    # oracle: dense solves; with mass or damper the damping is not proportional (complex modes)
    for zeta in (0.001, 0.01):
        assert close(gain(full(zeta, **changes)), oracle(zeta, **changes), 1e-6)
    if changes:
        assert not close(gain(full(0.01, **changes)), oracle(0.01), 1e-3)


@pytest.mark.slow
def test_one_per_cent_of_thickness_is_seen():
    assert not close(gain(full(thickness=0.0272 * 1.01)), oracle(), 1e-2)
    assert close(gain(full()), oracle(), 1e-6)


def test_modes_of_everything_are_the_full_model():
    modes = solve_modes(full(), damping=ModalDamping(0.01))
    assert modes.omega.size == 243
    assert close(gain(modes), oracle(), 1e-6)


def test_truncated_modes_with_an_attachment_vector_are_near_it():
    # 24 modes leave out compliance; up to 1500 Hz that is at most a few per cent of the largest
    low = FREQ[:-1]
    assert close(gain(some_modes(), low), oracle(freq=low), 0.4)
    model = some_modes()
    assert realise(model).pairs.shape[0] == 25
    assert assemble_plant(model, ports()).system.states[-2:] == ("residual1:q", "residual1:v")


def reduced_oracle(model, freq=FREQ):
    """The reduced matrices themselves by dense solves, T bringing forces in and motions out."""
    T = model.T
    see = [motion_row(*OFF_NODE[:2], axis) for axis in ("z", "rx", "ry")]
    see += [motion_row(x, y, "z") for x, y, _ in CORNERS]
    push = np.array([motion_row(x, y, "z") for x, y, _ in INSET])
    return receptance(model.M, model.D, model.K, np.array(see) @ T, push @ T, 2 * np.pi * freq)


@pytest.mark.slow
@pytest.mark.parametrize("zeta", [0.01, 0.001])
def test_a_reduced_model_before_and_after_the_update(zeta):
    # oracle: dense solves of M*, D*, K*; after the update the damping is not proportional
    before = reduced(zeta)
    after = fitted(before, MEASURED[zeta])
    for model in (before, after.model):
        elastic = FREQ[2:]  # below, K* alone has its rigid-body modes at 1e-4 rad/s and not at 0
        assert close(gain(model, elastic), reduced_oracle(model, elastic), 1e-5)
    assert np.iscomplexobj(after.model.modes().phi)
    assert after.values[0] == pytest.approx(0.5, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["modes", "reduced", "updated"])
@pytest.mark.parametrize("zeta", [0.01, 0.001])
def test_poles(which, zeta):
    """Elastic to 1e-11 of the modes' own or of the dense ones, six rigid-body ones exactly 0."""
    modes = some_modes(zeta)
    omega, damped = modes.basis_omega[3:], modes.basis_zeta[3:]
    wanted = omega * (-damped + 1j * np.sqrt(1 - damped**2))
    model, tolerance = modes, 1e-11
    if which != "modes":
        model = reduced(zeta)
    if which == "updated":
        model = fitted(model, MEASURED[zeta]).model
        # oracle: M*, D*, K* projected on the modal basis of the start, dense eigenvalues
        basis = np.linalg.lstsq(model.T, np.asarray(modes.basis), rcond=None)[0]
        parts = [basis.T @ X @ basis for X in (model.M, model.D, model.K)]
        parts[2][:3], parts[2][:, :3] = 0.0, 0.0
        parts[1][:3], parts[1][:, :3] = 0.0, 0.0
        wanted, tolerance = dense_poles(*parts), 1e-11
    plant = assemble_plant(model, ports())
    found = plant.system.poles()
    assert np.count_nonzero(found == 0) == 6
    assert np.array_equal(found[:6], np.zeros(6))
    upper = np.sort_complex(found[found.imag > 0])
    assert upper.size == 22
    upper, wanted = (np.array(sorted(p, key=abs)) for p in (upper, wanted))
    np.testing.assert_allclose(np.abs(upper), np.abs(wanted), rtol=tolerance)
    np.testing.assert_allclose(upper.real, wanted.real, rtol=1e-6 if which == "updated" else 1e-8)


@pytest.mark.slow
def test_poles_after_the_update_are_the_measured_ones():
    # oracles: the update's own eigenvalues of another pencil (1e-11); the poles as measured, which
    # are rounded to 1e-3 rad/s
    fit = fitted(reduced(), POLES)
    found = assemble_plant(fit.model, ports()).system.poles()
    found = np.array(sorted(found[found.imag > 0], key=abs))[2:4]
    assert np.abs(found / fit.history.eigenvalues[-1] - 1).max() < 1e-11
    assert np.abs(found / POLES - 1).max() < 1e-6
    thick = fitted(reduced(thickness=0.0272 * 1.01), POLES)
    assert abs(thick.values[0] - fit.values[0]) > 0.05


@pytest.mark.slow
def test_two_poles_of_the_machine():
    # notes.md: with 0.5 kg at (L/2, L/4) and 1 % damping
    found = assemble_plant(full(mass=0.5), ports()).system.poles()
    upper = np.array(sorted(found[found.imag > 0], key=abs))
    np.testing.assert_allclose(upper[2:4], POLES, rtol=1e-6)
    assert np.count_nonzero(found == 0) == 6
    upper = assemble_plant(full(mass=0.5, thickness=0.0272 * 1.01), ports()).system.poles()
    upper = np.array(sorted(upper[upper.imag > 0], key=abs))
    assert np.abs(upper[2:4] / POLES - 1).min() > 1e-3


def test_state_names_and_blocks():
    g = assemble_plant(some_modes(), ports()).system
    assert g.states[:4] == ("mode1:q", "mode1:v", "mode2:q", "mode2:v")
    assert tuple(g.blocks) == (2,) * 25
    assert np.count_nonzero(g.A[:6, :6]) == 3  # three double integrators and nothing else


def test_a_realisation_passes_through():
    shared = realise(some_modes())
    assert realise(shared) is shared
    again = assemble_plant(shared, ports())
    assert np.array_equal(again.system.A, assemble_plant(some_modes(), ports()).system.A)


def test_an_undamped_model():
    dofs = DofSet([1, 2], ["z", "z"], [[0, 0, 0], [1, 0, 0]])
    two = FEModel(np.diag([2.0, 1.0]), np.array([[50.0, -50.0], [-50.0, 50.0]]), dofs=dofs)
    poles = realise(two).pairs
    np.testing.assert_allclose(np.linalg.eigvals(poles[1]).imag, [75**0.5, -(75**0.5)])


def test_other_models_and_large_ones_are_refused():
    with pytest.raises(ModelError, match=r"FEModel, Modes or ReducedModel, got str.*from_state"):
        realise("plate")
    n = 2600
    dofs = DofSet(np.arange(n), ["z"] * n, np.column_stack([np.arange(n), np.zeros((n, 2))]))
    import scipy.sparse as sp

    big = FEModel(sp.eye_array(n, format="csc"), sp.eye_array(n, format="csc"), dofs=dofs)
    with pytest.raises(ModelError, match=r"dense eigenproblem.*solve_modes"):
        realise(big)
