"""The Modes value."""

import pickle

import numpy as np
import pytest

from flexplant import DofSet, load
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.modes import Modes, solve_modes
from flexplant.modes.matching import mac_matrix
from flexplant.structure import ModalDamping
from plates import make_plate

DOFS = DofSet([1, 2], ["x", "x"], [[0, 0, 0], [1, 0, 0]])


@pytest.fixture(scope="module")
def plate():
    return make_plate()


def test_poles_and_frequencies():
    modes = Modes([0, 100.0], [0, 0.1], np.eye(2), DOFS, n_rigid=1)
    np.testing.assert_allclose(modes.poles, [0, -10 + 100j * np.sqrt(0.99)], rtol=1e-15)
    assert modes.poles[0] == 0
    np.testing.assert_allclose(modes.freq, [0, 100 / (2 * np.pi)])
    # poles fulfil s^2 + 2 zeta omega s + omega^2 = 0
    s = modes.poles[1]
    assert abs(s**2 + 20 * s + 1e4) < 1e-9


def test_places(plate):
    modes = solve_modes(plate, count=6)
    np.testing.assert_array_equal(modes.at("23:z"), modes.phi[plate.dofs.index("23:z")])
    np.testing.assert_allclose(modes.at((0.3, 0.15, 0)), modes.at("23:z"), atol=1e-12)
    np.testing.assert_allclose(modes.at((0.3, 0.15, 0), "rx"), modes.at("23:rx"), atol=1e-12)
    np.testing.assert_allclose(
        modes.at({"1:z": 0.5, "2:z": -0.5}), 0.5 * (modes.at("1:z") - modes.at("2:z"))
    )
    with pytest.raises(LabelError, match="off the plate"):
        modes.at((1, 1, 0))
    with pytest.raises(LabelError, match="no DOF '82:z'"):
        modes.at("82:z")


def test_repr_is_one_line(plate):
    modes = solve_modes(plate, count=24, compliance_at=["1:z", (0.1, 0.2, 0)])
    assert repr(modes) == (
        "<Modes: 24 of 243 DOFs (3 rigid-body, 21 elastic at 245.8 to 3768 Hz), "
        "vectors at 1:z, (0.1, 0.2, 0)>"
    )
    assert repr(Modes([2 * np.pi], [0], [[1j], [0]], DOFS)) == (
        "<Modes: 1 complex of 2 DOFs (1 elastic at 1 Hz)>"
    )


def test_travels(plate, tmp_path):
    modes = solve_modes(plate, count=10, damping=ModalDamping(0.01), compliance_at="1:z")
    modes.save(tmp_path / "modes.npz")
    for other in (pickle.loads(pickle.dumps(modes)), load(tmp_path / "modes.npz")):
        for name in ("omega", "zeta", "phi", "vectors", "vector_omega", "vector_zeta"):
            assert np.array_equal(getattr(other, name), getattr(modes, name))
            with pytest.raises(ValueError, match="read-only"):
                getattr(other, name)[...] = 0
        assert other.vector_dofs == ("1:z",)
        assert other.n_rigid == 3


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"omega": [1.0, 2.0, 3.0]}, ShapeError),
        ({"zeta": [0.1]}, ShapeError),
        ({"phi": np.eye(3)}, ShapeError),
        ({"phi": np.full((2, 2), np.nan)}, ModelError),
        ({"phi": np.array([[1, 1j * np.nan], [0, 1]])}, ModelError),
        ({"n_rigid": 1}, ModelError),
        ({"n_rigid": 3}, ModelError),
        ({"omega": [0.0, 1.0]}, ModelError),
        ({"vectors": np.ones((2, 1))}, ShapeError),
        ({"vector_dofs": ["1:x"]}, ShapeError),
        (
            {
                "phi": 1j * np.eye(2),
                "vectors": np.ones((2, 1)),
                "vector_omega": [1.0],
                "vector_zeta": [0.0],
                "vector_dofs": ["1:x"],
            },
            ModelError,
        ),
    ],
)
def test_bad_input(changes, error):
    given = {"omega": [1.0, 2.0], "zeta": [0, 0], "phi": np.eye(2), "dofs": DOFS} | changes
    with pytest.raises(error):
        Modes(**given)


@pytest.mark.slow
def test_large_models_tell_what_was_counted():
    modes = solve_modes(make_plate(elements=(24, 24)), count=24)
    shown = modes.certificate
    assert shown["counted"] == shown["found"] >= 24
    assert shown["shift"] > modes.freq[-1]
    assert shown["orthonormality"] < 1e-12
    assert modes.residual.shape == (24,)
    assert np.all(modes.residual[:3] == 0)
    assert 0 < modes.residual.max() < 1e-7
    assert "counted below" in repr(modes)
    assert "none missing" in repr(modes)
    small = solve_modes(make_plate(), count=24)
    assert "counted" not in small.certificate
    assert small.residual.max() < 1e-8
    with pytest.raises(ShapeError, match="residual must have shape"):
        modes.replace(residual=[1.0, 2.0])


def test_residual_is_that_of_the_equation():
    model = make_plate()
    modes = solve_modes(model, count=8)
    force = model.K @ modes.phi
    left = np.linalg.norm(force - model.M @ modes.phi * modes.omega**2, axis=0)
    np.testing.assert_allclose(
        modes.residual[3:], (left / np.linalg.norm(force, axis=0))[3:], rtol=1e-3
    )


def test_mac_is_one_for_a_scaled_shape_and_zero_for_an_orthogonal_one():
    X = np.array([[1.0, 0.0], [1j, 0.0], [0.0, 2.0]])
    np.testing.assert_allclose(mac_matrix(X, X * (3 - 4j)), np.eye(2), atol=1e-15)
