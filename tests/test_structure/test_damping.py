"""Damping laws."""

import pickle
import warnings

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp

import flexplant as fx
import oracles_grids as grids
import oracles_structure as oracle
from flexplant.errors import FlexplantWarning, ModelError, ShapeError
from flexplant.identification import MeasuredModes
from flexplant.modes import solve_modes
from flexplant.structure import Hysteretic, LossRegion, ModalDamping, Rayleigh, chain


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
    with pytest.raises(ModelError, match="others goes with"):
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
    for quiet in (ModalDamping(0.02), Rayleigh(2.0, 1e-3), Hysteretic(0.04)):
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


def test_hysteretic_is_half_the_loss_factor():
    law = Hysteretic(0.06)
    np.testing.assert_array_equal(law.zeta([0.0, 3.0, 9.0]), [0, 0.03, 0.03])
    assert repr(law) == "Hysteretic(loss_factor=0.06)"
    model = held_chain()
    M, K = model.M.toarray(), model.K.toarray()
    expected = oracle.modal_damping_matrix(M, K, 0.03, n_rigid=0)
    np.testing.assert_allclose(model.with_damping(law).D, expected, atol=1e-12 * expected.max())


def test_the_error_of_the_equivalence_is_that_of_dense_responses():
    """One mass: equality at every frequency. Three: a bound that is not idle."""
    eta, freq = 0.08, np.linspace(1.0, 90.0, 200)
    law = Hysteretic(eta)
    k, m = 4e4, 1.7
    natural = np.sqrt(k / m) / 2 / np.pi
    w = 2 * np.pi * freq
    true = 1 / (k * (1 + 1j * eta) - m * w**2)
    ours = 1 / (k - m * w**2 + 1j * w * eta * np.sqrt(k * m))
    np.testing.assert_allclose(
        law.error(freq, [natural])[:, 0], np.abs(ours / true - 1), rtol=1e-9, atol=1e-12
    )
    np.testing.assert_allclose(
        law.response_error(freq, [natural], [1 / m]), np.abs(ours - true), rtol=1e-9, atol=1e-15
    )
    assert law.error([0.0], [natural]) == pytest.approx(eta)
    assert law.error([natural], [natural]) == pytest.approx(0, abs=1e-12)

    model = held_chain()
    M, K = model.M.toarray(), model.K.toarray()
    out, force = np.eye(3)[0], np.eye(3)[2]
    true = grids.receptance(M, 0 * M, K * (1 + 1j * eta), out, force, freq)
    ours = grids.receptance(M, model.with_damping(law).D, K, out, force, freq)
    omega, phi = oracle.undamped(M, K, 0)
    bound = law.response_error(freq, omega / 2 / np.pi, phi[0] * phi[2])
    error = np.abs(ours - true)
    assert np.all(error <= bound * (1 + 1e-9))
    assert np.median(error / bound) > 0.5


def test_without_loss_there_is_no_error():
    np.testing.assert_array_equal(Hysteretic(0.0).error([0, 5.0, 7.0], [5.0]), 0)


def test_bad_loss_factors():
    for eta in (-0.1, 2.0, np.nan, "a"):
        with pytest.raises(ModelError, match="loss_factor"):
            Hysteretic(eta)
    with pytest.raises(ModelError, match="negative"):
        Hysteretic(0.1).error([-1.0], [1.0])
    with pytest.raises(ShapeError, match="gains"):
        Hysteretic(0.1).response_error([1.0], [1.0, 2.0], [1.0])


def test_loss_factors_by_region():
    """A plate of which a part and the feet have their own, by the dense complex eigenproblem."""

    def build(E):
        return fx.kirchhoff_plate(
            size=(0.6, 0.4), thickness=0.02, elements=(3, 2), density=2702, youngs_modulus=E,
            poisson_ratio=0.3,
        )  # fmt: skip

    E, mask = np.full((3, 2), 70e9), np.array([[True, True], [False, False], [False, False]])
    feet = [fx.Spring(at, 2e5) for at in ((0, 0, 0), (0.6, 0, 0), (0, 0.4, 0), (0.6, 0.4, 0))]
    model = build(E).with_parts(feet)
    left = LossRegion.of_elements(0.02, build, mask, youngs_modulus=E)
    law = Hysteretic(0.001, regions={"left": left, "feet": (0.3, feet)})
    assert repr(law).startswith("Hysteretic(loss_factor=0.001, regions={'left': LossRegion(")
    K, M = model.K.toarray(), model.M.toarray()
    soft = sum(2e5 * np.outer(*2 * [model.row(foot.at)]) for foot in feet)
    part = (build(E * (1 + mask)).K - build(E).K).toarray()
    H = 0.3 * soft + 0.02 * part + 0.001 * (K - soft - part)
    squares = la.eigvals(K + 1j * H, M)
    squares = squares[np.argsort(squares.real)][:9]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        modes = solve_modes(model, count=9, damping=law)
    np.testing.assert_allclose(2 * modes.zeta, squares.imag / squares.real, rtol=0.01)
    assert modes.zeta[0] > 10 * modes.zeta[-1]
    # the error that is known: strain energy beside the coupled modes, here all of them
    whole = solve_modes(model, damping=ModalDamping(0.0))
    errors = law.coupling_errors(whole.omega, whole.phi, model.dofs)[:9]
    own = 2 * law.ratios(whole.omega, whole.phi, K, model.dofs)[:9]
    true = squares.imag / squares.real
    np.testing.assert_allclose(errors, np.abs(own / true - 1), rtol=1e-6, atol=1e-9)
    assert 1e-4 < modes.certificate["loss_coupling"] < 0.01
    # the same ratios in time, by D, and in reduced models
    damped = solve_modes(model.with_damping(law), count=9)
    np.testing.assert_allclose(damped.zeta, modes.zeta, rtol=1e-6)
    for method in (
        fx.reduction.Rubin(["1:z"], 9, damping=law),
        fx.reduction.ModalTruncation(9, damping=law),
    ):
        np.testing.assert_allclose(fx.reduce(model, method).modes().zeta[:9], modes.zeta, rtol=1e-6)
    boxed = fx.reduce(model, fx.reduction.CraigBampton(["1:z", "12:z"], 25, damping=law))
    np.testing.assert_allclose(boxed.modes().zeta[:6], modes.zeta[:6], rtol=0.01)
    # modes of near frequencies are coupled most
    square = fx.chain(masses=[1.0, 1.0], stiffnesses=[1.0], ground=[1e5, 1e5])
    one = Hysteretic(0.001, regions={"one": (0.1, fx.Spring("1:x", 1e5))})
    with pytest.warns(FlexplantWarning, match=r"the loss factor of mode [12] at 50.3\d* Hz"):
        solve_modes(square, damping=one)
    with pytest.raises(ModelError, match=r"feet' and those before it hold 1.* they overlap"):
        solve_modes(model, damping=Hysteretic(0.0, regions={"a": (0.1, K), "feet": (0.1, feet)}))
    with pytest.raises(ModelError, match="by where it bends"):
        law.zeta([1.0])
    with pytest.raises(ShapeError, match="shape \\(2, 2\\), the structure has"):
        solve_modes(model, damping=Hysteretic(0.0, regions={"a": (0.1, np.eye(2))}))
    with pytest.raises(ModelError, match=r"must be \(loss factor, stiffness\)"):
        Hysteretic(0.0, regions={"feet": 0.3})
    with pytest.raises(ModelError, match="at least one Spring"):
        Hysteretic(0.0, regions={"feet": (0.3, [])})


def test_laws_in_solve_modes():
    model = held_chain()
    for law, zeta in (
        (Hysteretic(0.04), [0.02] * 3),
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
