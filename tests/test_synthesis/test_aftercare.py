"""Controllers after their design: reduced, sampled, limited, as sections and in C."""

from functools import cache

import numpy as np
import pytest
from scipy.signal import freqz_sos, sosfilt

import flexplant as fx
from flexplant.errors import AssumptionError, CertificateError, ModelError
from flexplant.lti import StateSpace, discretized, frequency_response, lft, minimal, tustin
from flexplant.synthesis import (
    anti_windup_form,
    design_ncf,
    discretise_controller,
    reduce_controller,
    second_order_sections,
)

RATE = 500.0


@cache
def plant(sampled=True, count=4):
    """Four masses in a row, 0.1 % damping; the last is the point of interest."""
    model = fx.chain(masses=[1.0] * 4, stiffnesses=[2000.0] * 3, ground=20.0)
    modes = fx.solve_modes(model, count=count, damping=fx.ModalDamping(0.001))
    ports = fx.Ports(
        w=[fx.Disturbance("d", at="2:x", asd=1e-3)],
        u=[fx.Actuator("f", at="1:x")],
        z=[fx.Poi("tip", at="4:x", axes=("x",))],
        y=[fx.Sensor("s", at="1:x", asd=1e-6)],
    )
    found = fx.assemble_plant(modes, ports)
    return found.discretized(RATE, delay=0.5) if sampled else found


@cache
def designed(sampled=True):
    """H-infinity with a slow weight on the tip and a roll-off on the force: 11 states or so."""
    given = plant(sampled)
    slow = fx.lti.low_pass_filter(0.2) * 300.0
    slow = tustin(slow, RATE) if sampled else slow
    weighted = given.weighted(z={"tip:x": slow, "f:effort": 0.02}, w={"s:noise": 1e-2})
    return weighted, fx.design_hinf(weighted)


@pytest.mark.slow
@pytest.mark.parametrize("sampled", [False, True])
def test_a_reduced_controller_keeps_the_loop(sampled):
    """Fewer states, and margin and gamma of the loop closed by hand within the loss."""
    weighted, full = designed(sampled)
    found = reduce_controller(weighted, full, loss=0.1)
    assert found.system.n_states < full.system.n_states
    gamma = fx.hinf_norm(lft(weighted.system, found.system))
    assert gamma <= 1.1 * full.gamma
    assert found.gamma == pytest.approx(gamma, rel=1e-6, abs=0)
    loop = fx.close_loop(weighted.unweighted, found)
    assert loop.is_stable
    assert loop.modulus_margin >= 0.9 * found.certificate["modulus margin before"]
    # below one, the weighted error alone proves that the loop stays stable
    assert found.certificate["weighted error"] < 1.0


def test_what_degrades_the_loop_is_refused():
    weighted, full = designed()
    with pytest.raises(CertificateError, match="Choose a higher order"):
        reduce_controller(weighted, full, order=1)
    with pytest.raises(ModelError, match="order"):
        reduce_controller(weighted, full, order=full.system.n_states)
    with pytest.raises(CertificateError, match=r"not stabilise .*, at [0-9.e+-]+ Hz\)"):
        reduce_controller(weighted, -full.system)


def test_an_integrator_is_kept():
    """Two fast lags next to an integrator: they go, it stays where it is, at zero."""
    given = plant(False).machine
    pi = StateSpace(np.diag([0.0, -300.0, -301.0]), [[1.0], [1.0], [1.0]],
                    [[-0.5, -3e3, 2.9e3]], [[-10.0]], inputs=["s"], outputs=["f"])  # fmt: skip
    found = reduce_controller(given, pi, loss=0.05)
    assert found.system.n_states < 3
    assert np.abs(found.system.poles()).min() == 0.0


def test_discretised_for_the_sampled_plant():
    continuous = plant(False)
    K = StateSpace([[-400.0]], [[400.0]], [[15 * 400.0 / 40 - 15.0]], [[-15 * 400.0 / 40]],
                   inputs=["s"], outputs=["f"])  # fmt: skip
    given = continuous.discretized(2000.0, delay=1)
    found = discretise_controller(given, K)
    assert fx.close_loop(given, found).is_stable
    assert found.certificate["modulus margin"] < found.certificate["modulus margin continuous"]
    assert "largest real part continuous" in found.certificate
    with pytest.raises(CertificateError, match="design on the sampled plant"):
        discretise_controller(continuous.discretized(60.0, delay=1), K)
    with pytest.raises(ModelError, match="sampled already"):
        discretise_controller(given, found.system)
    with pytest.raises(ModelError, match="sampled plant"):
        discretise_controller(continuous, K)


def pi_controller():
    """Proportional, integral and lead: marginal by itself."""
    z, p = 2 * np.pi * 2.0, 2 * np.pi * 40.0
    lead = StateSpace([[-p]], [[p]], [[z - p]], [[p]])
    parts = StateSpace([[0.0]], [[1.0]], [[0.3]], [[1.0]])
    K = (lead * parts) * (-20.0 / z)
    return tustin(K.replace(inputs=["s"], outputs=["f"]), RATE)


@pytest.mark.parametrize("recovery", [None, 0.05])
def test_the_anti_windup_form(recovery):
    """The same loop while nothing limits; a saturated run ends sooner, states bounded."""
    K = pi_controller()
    form = anti_windup_form(K, recovery=recovery)
    assert form.inputs == ("s", "f")
    plain, ours = (fx.close_loop(plant(), one) for one in (K, form))
    np.testing.assert_allclose(ours.spectral_radius, plain.spectral_radius, rtol=1e-9)
    # driven by its own command it is the controller, sample by sample
    rng = np.random.default_rng(2)
    y = rng.standard_normal(200)
    x, xf = np.zeros(K.n_states), np.zeros(K.n_states)
    for value in y:
        u = K.C @ x + K.D[:, 0] * value
        np.testing.assert_allclose(form.C @ xf + form.D[:, 0] * value, u, rtol=1e-9)
        x = K.A @ x + K.B[:, 0] * value
        xf = form.A @ xf + form.B @ np.array([value, u[0]])
    # an actuator stuck at zero: the plain integrator grows on and on, the form settles
    plain_u, form_u = [], []
    for _ in range(5000):
        x = K.A @ x + K.B[:, 0]
        xf = form.A @ xf + form.B @ np.array([1.0, 0.0])
        plain_u.append((K.C @ x)[0])
        form_u.append((form.C @ xf)[0])
    assert abs(plain_u[-1] - plain_u[2500]) > 10.0
    assert abs(form_u[-1] - form_u[2500]) < 0.1 * abs(plain_u[-1] - plain_u[2500])
    # outputs do not depend on the applied command at once: simulate accepts it with limits
    assert not np.any(form.D[:, 1])


def test_hanus_has_the_zeros_of_the_controller_as_poles():
    K = pi_controller()
    form = anti_windup_form(K)
    np.testing.assert_allclose(
        np.sort(np.linalg.eigvals(form.A).real), np.sort(K.zeros().real), rtol=1e-9
    )
    slow = StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01, inputs=["s"], outputs=["f"])
    with pytest.raises(AssumptionError, match="recovery"):
        anti_windup_form(slow)
    for recovery, pole in ((0.005, np.exp(-2.0)), (0.1, 0.5)):  # that of 0.5 is faster than 0.1 s
        assert anti_windup_form(slow, recovery=recovery).A[0, 0] == pytest.approx(pole, rel=1e-9)
    unstable_zero = slow.replace(D=[[-0.1]])
    # two zeros at exactly -1, as Tustin's rule makes them, whatever rounding makes of them
    low_pass = tustin(StateSpace([[-9.0, -20.0], [1, 0]], [[1.0], [0]], [[0, 20.0]], [[0.0]]), 0.01)
    for one in (unstable_zero, low_pass.replace(inputs=["s"], outputs=["f"])):
        with pytest.raises(AssumptionError, match="not all stable"):
            anti_windup_form(one)


def test_sections_filter_like_the_controller():
    _, full = designed()
    K = full.system
    sections = second_order_sections(full)
    assert set(sections) == {("f", "s")}
    rng = np.random.default_rng(3)
    y = rng.standard_normal(400)
    x, wanted = np.zeros(K.n_states), np.empty(y.size)
    for k, value in enumerate(y):
        wanted[k] = (K.C @ x + K.D[:, 0] * value)[0]
        x = K.A @ x + K.B[:, 0] * value
    got = sosfilt(sections["f", "s"], y)
    np.testing.assert_allclose(got, wanted, atol=1e-6 * np.abs(wanted).max())
    with pytest.raises(ModelError, match="discretise_controller"):
        second_order_sections(designed(False)[1])


def slow_beside_fast(freq, rate=0.0, delay=0.0):
    """Two modes of equal mass: a suspension of 5 % and one of 1 % at 3 kHz."""
    omega, zeta = 2 * np.pi * np.array([freq, 3e3]), np.array([0.05, 0.01])
    A = np.kron(np.diag(omega), [[0.0, 1.0], [-1.0, 0.0]])
    A[[1, 3], [1, 3]] = -2 * zeta * omega
    B = np.array([[0.0, 1 / omega[0], 0.0, 1 / omega[1]]]).T
    g = StateSpace(A, B, [[1.0, 0.0, 1.0, 0.0]], [[0.0]], inputs=["f"], outputs=["s"])
    return discretized(g, rate, delay=delay) if rate else g


@pytest.mark.parametrize("freq", [3.0, 0.3, 0.03])
@pytest.mark.parametrize("delay", [0.0, 1.0, 2.5])
def test_sections_of_fewer_zeros_than_poles_are_not_early(freq, delay):
    """One sample early is little beside a slow peak, and the wrong sign at half the rate."""
    K = slow_beside_fast(freq, 2e4, delay)
    sections = second_order_sections(K)["s", "f"]
    x, wanted = K.B[:, 0], [K.D[0, 0]]
    for _ in range(300):
        wanted.append((K.C @ x)[0])
        x = K.A @ x
    got = sosfilt(sections, np.eye(1, 301)[0])
    np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-6 * np.abs(wanted).max())


def test_sections_name_the_rate_where_their_coefficients_are_too_coarse():
    with pytest.raises(CertificateError, match=r"a pole at 0.003 Hz .* 20000 Hz .* Lower the rate"):
        second_order_sections(slow_beside_fast(0.003, 2e4))


@pytest.mark.parametrize("rate", [0.0, 2e4], ids=["continuous", "sampled"])
@pytest.mark.parametrize("gain", [1e3, 1e8])
def test_a_slow_suspension_beside_a_fast_mode_stays_in_the_controller(rate, gain):
    """Neither mode is small at its own frequency, though their peaks are 1e10 apart."""
    plant = slow_beside_fast(0.03, rate)
    assert minimal(plant).n_states == 4
    found = design_ncf(plant, before=np.array([[gain]]))
    assert found.gamma < 1.11 * found.lower
    K = minimal(found.system)
    assert K.n_states == 4
    both = [0.03, 3e3]
    responses = [frequency_response(sys, both).data[0, 0] for sys in (K, found.system)]
    np.testing.assert_allclose(*responses, rtol=1e-6)
    if rate:
        sections = second_order_sections(found)["f", "s"]
        _, response = freqz_sos(sections, both, fs=rate)
        np.testing.assert_allclose(response, responses[1], rtol=1e-4)
