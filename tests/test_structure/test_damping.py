"""Damping laws."""

import pickle

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp

import flexplant as fx
from flexplant.errors import FlexplantWarning, ModelError, ShapeError
from flexplant.identification import MeasuredModes
from flexplant.modes import solve_modes
from flexplant.structure import FEMatrices, ModalDamping, Rayleigh, chain


def test_modal_damping():
    np.testing.assert_array_equal(ModalDamping(0.02).zeta([0, 1, 5]), [0, 0.02, 0.02])
    np.testing.assert_array_equal(ModalDamping([0.5, 0.1, 0.2]).zeta([0, 1, 5]), [0, 0.1, 0.2])
    assert repr(ModalDamping(0.01)) == "ModalDamping(ratio=0.01, rigid=0)"
    assert repr(ModalDamping([0.01, 0.03])) == "ModalDamping(ratio=[0.01, 0.03], rigid=0)"
    assert pickle.loads(pickle.dumps(ModalDamping(0.01))).ratio == 0.01


def test_rayleigh():
    np.testing.assert_allclose(
        Rayleigh(alpha=3.0, beta=0.01).zeta([0.0, 2.0, 10.0]), [0, 0.75 + 0.01, 0.15 + 0.05]
    )
    assert repr(Rayleigh(1, 0)) == "Rayleigh(alpha=1 1/s, beta=0 s)"


@pytest.mark.parametrize("ratio", [-0.01, 1.0, np.nan, [0.1, 2.0], "a", 1j])
def test_bad_ratios(ratio):
    with pytest.raises(ModelError, match="ratio"):
        ModalDamping(ratio)


def test_bad_shapes():
    with pytest.raises(ShapeError, match="one per mode"):
        ModalDamping([[0.1]])
    with pytest.raises(ShapeError, match="2 damping ratios for 3 modes"):
        ModalDamping([0.1, 0.1]).zeta([1, 2, 3])
    with pytest.raises(ShapeError, match="omega must have shape"):
        ModalDamping(0.1).zeta(3.0)
    with pytest.raises(ModelError, match="alpha must be zero or positive"):
        Rayleigh(-1, 0)
    with pytest.raises(ModelError, match="beta has a NaN"):
        Rayleigh(0, np.nan)


def test_ratios_beyond_the_list():
    law = ModalDamping([0.0, 0.02, 0.03], others=0.01)
    np.testing.assert_array_equal(law.zeta([0, 1, 2, 3, 4]), [0, 0.02, 0.03, 0.01, 0.01])
    np.testing.assert_array_equal(law.zeta([0, 1]), [0, 0.02])
    assert repr(law) == "ModalDamping(ratio=[0, 0.02, 0.03], others=0.01, rigid=0)"
    with pytest.raises(ModelError, match="others needs an array"):
        ModalDamping(0.01, others=0.02)
    with pytest.raises(ModelError, match="others"):
        ModalDamping([0.01], others=1.5)


def test_measured_poles():
    omega, zeta = np.array([900.0, 1500.0]), np.array([0.013, 0.004])
    poles = -zeta * omega + 1j * omega * np.sqrt(1 - zeta**2)
    law = ModalDamping.from_measured(poles, modes=[4, 6], others=0.01)
    expected = [0, 0, 0, 0.013, 0.01, 0.004, 0.01]
    np.testing.assert_allclose(law.zeta([0, 0, 0, 1, 2, 3, 4]), expected, rtol=1e-12)
    # either sign of the imaginary part; and whatever holds poles and mode numbers
    other = ModalDamping.from_measured(MeasuredModes(poles.conj(), modes=[4, 6]), others=0.01)
    np.testing.assert_allclose(other.ratio, law.ratio)


@pytest.mark.parametrize(
    ("poles", "modes", "says"),
    [
        ([-1 + 10j], None, "numbers of the measured modes"),
        ([-1 + 10j], [1, 2], "different mode numbers"),
        ([-1 + 10j, -1 + 11j], [2, 2], "different mode numbers"),
        ([1 + 10j], [1], "does not oscillate and decay"),
        ([-1.0], [1], "does not oscillate and decay"),
        ([-1 + 10j], [0], "mode number"),
        (["a"], [1], "hold numbers"),
        ([np.nan + 1j], [1], "NaN or infinite"),
    ],
)
def test_bad_measured_poles(poles, modes, says):
    with pytest.raises(ModelError, match=says):
        ModalDamping.from_measured(poles, modes=modes, others=0.01)


def test_rayleigh_through_ratios():
    law = Rayleigh.fitted([100, 700], [0.02, 0.01])
    np.testing.assert_allclose(law.zeta(2 * np.pi * np.array([100.0, 700.0])), [0.02, 0.01])
    # more than two: the normal equations, by hand
    hertz, zeta = np.array([50.0, 200.0, 400.0, 900.0]), np.array([0.02, 0.011, 0.012, 0.02])
    law = Rayleigh.fitted(hertz, zeta)
    w = 2 * np.pi * hertz
    A = np.column_stack([0.5 / w, 0.5 * w])
    np.testing.assert_allclose([law.alpha, law.beta], np.linalg.pinv(A) @ zeta, rtol=1e-9)
    # where least squares would feed energy in, that part is left out
    falling = Rayleigh.fitted([100.0, 200.0, 300.0], [0.05, 0.01, 0.002])
    assert falling.beta == 0
    assert falling.alpha > 0


@pytest.mark.parametrize(
    ("freq", "zeta", "error", "says"),
    [
        ([100, 1000], [0.01, 0.2], ModelError, "alpha would be negative.*factor of 10"),
        ([100, 1000], [0.2, 0.01], ModelError, "beta would be negative"),
        ([100, 100], [0.01, 0.01], ModelError, "two different"),
        ([100], [0.01], ModelError, "two different"),
        ([0, 100], [0.01, 0.01], ModelError, "two different"),
        ([10, 100], [0.01, -0.01], ModelError, "zeta must be in"),
        ([10, 100], [0.01], ShapeError, "zeta"),
    ],
)
def test_bad_fits(freq, zeta, error, says):
    with pytest.raises(error, match=says):
        Rayleigh.fitted(freq, zeta)


def test_rigid_body_modes_are_damped_only_when_asked():
    model = chain(masses=[1, 2, 3], stiffnesses=[5e3, 7e3])
    M, R = model.M.toarray(), model.rigid_body
    for quiet in (ModalDamping(0.02), Rayleigh(2.0, 1e-3)):
        D = model.with_damping(quiet).D
        assert np.abs(D @ R).max() < 1e-12 * np.abs(D).max()
    drag = model.with_damping(ModalDamping(0.02, rigid=3.0)).D
    np.testing.assert_allclose(drag @ R, 3.0 * M @ R, atol=1e-12)
    elastic = model.with_damping(ModalDamping(0.02)).D
    np.testing.assert_allclose(drag - elastic, 3.0 * M @ R @ R.T @ M, atol=1e-12)
    whole = model.with_damping(Rayleigh(2.0, 1e-3, rigid=True)).D
    np.testing.assert_allclose(whole.toarray(), 2 * M + 1e-3 * model.K.toarray(), rtol=1e-14)


def test_a_measured_matrix():
    model = chain(masses=[1, 2], stiffnesses=[5])
    D = np.array([[2.0, -1], [-1, 3]])
    np.testing.assert_array_equal(model.with_damping(D).D, D)
    with pytest.raises(ModelError, match="feed energy in"):
        model.with_damping(-D)
    with pytest.raises(ModelError, match="not symmetric"):
        model.with_damping(np.array([[2.0, -1], [0, 3]]))


def held_chain():
    return chain(masses=[1, 2, 1.5], stiffnesses=[5e4, 7e4], ground=[3e4, 0, 1e4])


def test_laws_in_solve_modes():
    model = held_chain()
    for law, zeta in (
        (ModalDamping(0.02), [0.02] * 3),
        (
            ModalDamping.from_measured([-3 + 200j], modes=[2], others=0.01),
            [0.01, 3 / 200.0225, 0.01],
        ),
    ):
        np.testing.assert_allclose(solve_modes(model, damping=law).zeta, zeta, rtol=1e-6)
        # the same through the matrix
        np.testing.assert_allclose(solve_modes(model.with_damping(law)).zeta, zeta, rtol=1e-6)


@pytest.mark.parametrize(
    ("law", "rate"), [(ModalDamping(0.01, rigid=0.5), 0.5), (Rayleigh(0.5, 1e-6, rigid=True), 0.5)]
)
def test_damped_rigid_body_motions_go_all_the_way_into_a_plant(law, rate):
    """Responses against the dense matrices, and the poles of the dragged body."""
    free = fx.kirchhoff_plate(
        size=(0.6, 0.6), thickness=0.0272, elements=(3, 3), density=2702, youngs_modulus=70e9,
        poisson_ratio=0.35,
    )  # fmt: skip
    model = free.with_damping(law)
    corners = ["1:z", "4:z", "13:z", "16:z"]
    ports = fx.Ports(
        w=[fx.Disturbance(f"d{i}", at=at, asd=1e-3) for i, at in enumerate(corners)],
        u=[fx.Actuator(f"u{i}", at=at) for i, at in enumerate(corners)],
        z=[fx.Poi("die", at="6:z")],
        y=[fx.Sensor(f"y{i}", at=at, asd=1e-11) for i, at in enumerate(corners)],
    )
    with pytest.warns(FlexplantWarning, match="not in modal blocks but dense"):
        plant = fx.assemble_plant(model, ports)
    freq = np.array([0.02, 1.0, 245.0, 1000.0])  # the dense oracle has 7 digits at the first
    found = fx.frequency_response(plant.system, freq)["die:z", "u1"]
    out, into = free.dofs.index("6:z"), free.dofs.index("4:z")
    M, D, K = (
        np.asarray(A.todense()) if sp.issparse(A) else A for A in (model.M, model.D, model.K)
    )
    for w, value in zip(2 * np.pi * freq, np.ravel(np.asarray(found)), strict=True):
        wanted = np.linalg.inv(K + 1j * w * D - w**2 * M)[out, into]
        assert abs(value - wanted) < 1e-6 * abs(wanted)
    slow = plant.system.poles()
    assert np.sort(slow[np.abs(slow) < 10].real) == pytest.approx([-rate] * 3 + [0] * 3, abs=1e-6)
    assert fx.design_kalman(plant.discretized(rate=10e3, delay=1)).rms("die:z") > 0


@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_a_complex_stiffness_is_read_as_half_its_loss_factor(kind):
    """Modes of ``K (1 + i eta)`` by the dense complex eigenproblem."""
    eta, model = 0.04, held_chain()
    K, M = model.K.toarray(), model.M.toarray()
    given = K * (1 + 1j * eta)
    read = FEMatrices(sp.csc_array(given) if kind == "sparse" else given, M, dofs=model.dofs)
    np.testing.assert_array_equal(read.K.toarray(), K)
    assert read.loss_factor == pytest.approx(eta)
    assert "damping=fx.ModalDamping(0.02)" in read.notes[-1]
    with pytest.warns(FlexplantWarning, match=r"loss factor of 0\.04 is read .* ratio of 0\.02"):
        again = read.converted("mm", "t", "s").model()
    modes = solve_modes(again, damping=ModalDamping(read.loss_factor / 2))
    squares = la.eigvals(1e3 * given, 1e3 * M)
    true = np.sort(squares.imag / squares.real)
    np.testing.assert_allclose(2 * modes.zeta, true, rtol=1e-9)
    assert FEMatrices(K, M, dofs=model.dofs).loss_factor == 0.0
