"""Plants whose damping no modes express: overdamped, coalescing, dragged to ground.

Oracles: (-w^2 M + i w D + K)^-1, and expm of the first-order form of M, D, K (oracles_plant,
oracles_damping); neither imports flexplant.
"""

import re
import warnings
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import flexplant as fx
import oracles_damping as oracle
from flexplant import DofSet
from flexplant.errors import FlexplantWarning, ModelError
from flexplant.lti import frequency_response, low_pass_filter
from flexplant.modes import normal_form, solve_modes
from flexplant.modes.normal_forms import modal, real_form
from flexplant.plant import (
    Actuator,
    Disturbance,
    Feedthrough,
    GroundSpring,
    Poi,
    Ports,
    Sensor,
    StandardPlant,
    assemble_plant,
    gravity_axes,
    suspend,
)
from flexplant.plant.realisation import ILL_CONDITIONED, realise
from flexplant.structure import FEModel
from oracles_plant import delayed_run, first_order, machine, receptance, z_row
from oracles_ports import noise_of_late_outputs
from stages import Z8, full, ports, reduced

FREQ = np.array([0.5, 20.0, 150.0, 268.0, 402.0, 800.0])
RATE = 5e3
#: what an SI machine looks like: kg, N/m, 0.1 % damping
MASSES, SPRINGS = (1.0, 2.0, 1.5, 1.0), (5e6, 7e6, 4e6)
SEEN = ("p:z", "y", "v", "a")


@cache
def chain(case):
    """M, D, K of four masses; D is 0.1 % modal and what the case adds."""
    held = 0.0 if case.startswith("free") else 6e6
    M, K = oracle.chain(MASSES, SPRINGS, held)
    D = oracle.light_damping(M, K, 1e-3)
    added = {
        "free dragged": np.diag([300.0, 0.0, 0.0, 0.0]),
        "free stuck": np.diag([0.0, 3e4, 0.0, 0.0]),
        "free overdamped": oracle.between(4, 1, 2, 1e5),
        "held overdamped": oracle.between(4, 1, 2, 1e5),
        "held grounded": np.diag([0.0, 0.0, 5e4, 0.0]),
        "held light": np.diag([0.0, 0.0, 5.0, 0.0]),
    }
    if case == "held proportional":
        return M, oracle.modal(M, K, [2.0, 1.0, 0.7, 1e-3]), K
    if case == "held critical":
        return M, D + critical() * np.diag([0.0, 0.0, 1.0, 0.0]), K
    return M, D + added[case], K


@cache
def critical():
    """The damper to ground at which a pair of poles meets on the real axis, to rounding."""
    M, K = oracle.chain(MASSES, SPRINGS, 6e6)
    D = oracle.light_damping(M, K, 1e-3)
    return oracle.meets(M, D, np.diag([0.0, 0.0, 1.0, 0.0]), K, 1e2, 1e5)


DENSE = [
    "free dragged",
    "free stuck",
    "free overdamped",
    "held overdamped",
    "held grounded",
    "held critical",
]
CASES = [*DENSE, "held proportional", "held light"]


def model_of(M, D, K):
    n = M.shape[0]
    places = np.column_stack([0.1 * np.arange(n), np.zeros((n, 2))])
    return FEModel(M, K, D, dofs=DofSet(np.arange(1, n + 1), ["z"] * n, places))


def channels(**changes):
    """Force noise and a force; displacements, a velocity and an acceleration."""
    fields = {
        "w": [Disturbance("d", at="2:z", asd=1e-2)],
        "u": [Actuator("u", at="1:z")],
        "z": [Poi("p", at="4:z")],
        "y": [
            Sensor("y", at="3:z", asd=1e-11),
            Sensor("v", at="2:z", quantity="velocity"),
            Sensor("a", at="2:z", quantity="acceleration"),
        ],
    }
    return Ports(**(fields | changes))


def quietly(model, given=None, **options):
    """Assemble; the warning is looked at by tests of its own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        return assemble_plant(model, given or channels(), **options)


@cache
def plant_of(case):
    return quietly(model_of(*chain(case)))


def wanted(case, freq=FREQ):
    """[p, y, v, a] per force at the first mass, by dense solves."""
    eye, s = np.eye(4), 2j * np.pi * freq
    q = receptance(*chain(case), eye, eye[:1], 2 * np.pi * freq)[:, 0]
    return np.array([q[3], q[2], s * q[1], s**2 * q[1]])


def agree(found, expected, tolerance):
    size = np.abs(expected).max(axis=-1, keepdims=True)
    return bool(np.all(np.abs(found - expected) <= tolerance * (np.abs(expected) + 1e-3 * size)))


@pytest.mark.parametrize("case", CASES)
def test_responses_are_those_of_the_matrices(case):
    g = plant_of(case).system.select(SEEN, ["u"])
    data = frequency_response(g, FREQ).data[:, 0]
    assert agree(data, wanted(case), 1e-9)
    assert not agree(data, wanted("held light" if case != "held light" else "held grounded"), 1e-2)


@pytest.mark.slow
@given(st.integers(0, 10**6), st.floats(-2.0, 4.0), st.booleans())
def test_any_damping_gives_the_plant_of_its_matrices(seed, size, free):
    rng = np.random.default_rng(seed)
    M, K = oracle.chain(rng.uniform(0.5, 2, 4), rng.uniform(2e6, 9e6, 3), 0.0 if free else 5e6)
    root = rng.standard_normal((4, 2)) * rng.uniform(0, 1, (4, 1))
    D = oracle.light_damping(M, K, 1e-3) + 10.0**size * root @ root.T
    plant = quietly(model_of(M, D, K))
    found = frequency_response(plant.system.select(["y"], ["u"]), FREQ[1:]).data
    exact = receptance(M, D, K, np.eye(4)[2:3], np.eye(4)[:1], 2 * np.pi * FREQ[1:])
    # below its limit the drag of rigid-body motion is left out: at most 1e-4 of the first mode's
    # frequency, beside that of the force
    tolerance = 1e-8 if not free or plant.form != "modal blocks" else 0.1
    np.testing.assert_allclose(found, exact, rtol=tolerance)


@pytest.mark.parametrize("delay", [0.0, 1.0, 1.5])
@pytest.mark.parametrize("case", ["free dragged", "held overdamped", "held critical"])
def test_sampled_with_an_exact_hold_and_delay(case, delay):
    # oracle: small steps of the first-order form, the input held and late
    M, D, K = chain(case)
    eye = np.eye(4)
    A, B, C = first_order(M, D, K, eye[[3, 2]], eye[:1])
    u = np.random.default_rng(0).standard_normal((60, 1))
    expected = delayed_run(A, B, C, u, 1 / RATE, delay)
    g = plant_of(case).discretized(RATE, delay=delay).system.select(["p:z", "y"], ["u"])
    x, seen = np.zeros(g.n_states), []
    for now in u:
        seen.append(g.C @ x)
        x = g.A @ x + g.B @ now
    found = np.array(seen)
    assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()
    assert plant_of(case).discretized(RATE, delay=delay).form.startswith("dense")


@pytest.mark.parametrize("case", [*DENSE, "held proportional"])
def test_noise_of_a_sample_is_exact_and_a_covariance(case):
    # oracle: the integral in 200 pieces, expm of M, D, K
    expected = oracle.sample_covariance(*chain(case), np.eye(4)[1], 1e-2, 1 / RATE)
    plant = plant_of(case).discretized(RATE)
    realisation = plant.assembled.realisation
    see = np.vstack([realisation.motion(np.eye(4), 0), realisation.motion(np.eye(4), 1)])
    G = see @ plant.noise_factor[plant.modal_states]
    found = G @ G.T
    size = np.sqrt(np.diag(expected))
    assert np.abs((found - expected) / np.outer(size, size)).max() < 1e-8
    values = np.linalg.eigvalsh(plant.process_noise)
    assert values[0] >= -1e-15 * values[-1]


def test_the_same_noise_with_a_filter_and_a_late_sensor():
    # an anti-alias filter and a delay go through the dense exponential of the whole
    slow = low_pass_filter(400.0, order=2)
    given = channels(y=[Sensor("y", at="3:z", dynamics=slow, latency=1.7 / RATE, asd=1e-11)])
    plant = quietly(model_of(*chain("held overdamped")), given).discretized(RATE, delay=0.4)
    M, D, K = chain("held overdamped")
    eye = np.eye(4)
    A, B, C = first_order(M, D, K, eye[[2]], eye[[0, 1]])
    A, B, C = oracle.behind(A, B, C, slow.A, slow.B, slow.C)
    u = np.random.default_rng(1).standard_normal((80, 1))
    expected = oracle.late_run(A, B[:, :1], C, u, 1 / RATE, 0.4, 1.7)
    g = plant.system.select(["y"], ["u"])
    x, seen = np.zeros(g.n_states), []
    for now in u:
        seen.append(g.C @ x)
        x = g.A @ x + g.B @ now
    assert np.abs(np.array(seen) - expected).max() < 1e-9 * np.abs(expected).max()
    # stationary variance of the late sensor is that of the sensor: noise is split right
    P = oracle.stationary(plant.system.A, plant.process_noise)
    row = plant.system.C[list(plant.system.outputs).index("y")]
    exact = C @ oracle.white_response(A, B[:, 1:], 1e-2) @ C.T
    assert row @ P @ row == pytest.approx(exact[0, 0], rel=1e-7, abs=0)
    # one sample's share: the motion at its end, and 0.7 of a sample earlier, as the sensor sees it
    now = quietly(model_of(M, D, K), given.replace(y=[given.y[0].replace(latency=0.0)]))
    now = now.discretized(RATE, delay=0.4).system
    see = np.zeros((2, plant.system.n_states))
    own = [plant.system.states.index(state) for state in now.states]
    see[0, own] = now.C[now.outputs.index("y")]
    see[1, plant.system.states.index("y:late1")] = 1.0
    root = B[:, 1:] * 1e-2 / np.sqrt(2.0)
    coarse, fine = (
        noise_of_late_outputs(A, root, C, 1 / RATE, [0.7 / RATE], n) for n in (1000, 2000)
    )
    shared = fine + (fine - coarse) / 3.0  # the oracle is second order
    found = see @ plant.process_noise @ see.T
    np.testing.assert_allclose(found, shared, rtol=1e-8)


@pytest.mark.slow
def test_norms_are_those_of_the_matrices():
    M, D, K = chain("held grounded")
    A, B, C = first_order(M, D, K, np.eye(4)[[3]], np.eye(4)[[0]])
    g = plant_of("held grounded").system.select(["p:z"], ["u"])
    exact = np.sqrt((C @ oracle.gramian(A, B) @ C.T)[0, 0])
    assert fx.h2_norm(g) == pytest.approx(exact, rel=1e-8)
    sweep = np.linspace(1.0, 800.0, 40001)
    peak = np.abs(receptance(M, D, K, np.eye(4)[[3]], np.eye(4)[[0]], 2 * np.pi * sweep)).max()
    assert fx.hinf_norm(g) == pytest.approx(peak, rel=1e-3)
    assert fx.hinf_norm(g) >= peak * (1 - 1e-12)


def test_poles_at_zero_are_exactly_there():
    # a dragged mass has one pole at zero (it stays where it is) and one that is its speed's decay
    M, D, K = chain("free dragged")
    dense = np.linalg.eigvals(first_order(M, D, K, np.eye(4), np.eye(4))[0])
    for plant in (plant_of("free dragged"), plant_of("free dragged").discretized(RATE, delay=1.5)):
        poles = plant.system.poles()
        assert np.count_nonzero(poles == (1.0 if plant.dt else 0.0)) == 1
        assert plant.n_rigid == 1
    slowest = np.sort(np.abs(dense))[1]
    found = np.sort(np.abs(plant_of("free dragged").system.poles()))[1]
    assert found == pytest.approx(slowest, rel=1e-9)
    free = plant_of("free overdamped").discretized(RATE)
    assert np.count_nonzero(free.system.poles() == 1.0) == 2
    assert tuple(free.system.blocks) == (2, 6)


@pytest.mark.parametrize(
    ("case", "says"),
    [
        ("free dragged", r"^dense: dampers to ground drag rigid-body motion at up to 54.\d 1/s"),
        ("held overdamped", r"^dense: an overdamped pair near mode [34] \(.*Hz undamped\)"),
        ("held critical", r"^dense: .*near mode 1 \(112\.4 Hz undamped\)$"),
        ("held proportional", r"^modal blocks$"),
        ("held light", r"^modal blocks$"),
    ],
)
def test_the_form_is_said(case, says):
    plant = plant_of(case)
    assert re.search(says, plant.form)
    dense = plant.form.startswith("dense")
    assert (plant.form in repr(plant)) == dense
    assert ("note the plant is dense" in repr(plant.check())) == dense
    given = model_of(*chain(case))
    if dense:
        with pytest.warns(FlexplantWarning, match=r"not in modal blocks but dense.*plant\.form"):
            shared = assemble_plant(given, channels()).assembled.realisation
    else:
        # a warning would be an error here
        shared = assemble_plant(given, channels()).assembled.realisation
    # what was said once is not said again by plants of the same modes
    assert assemble_plant(shared, channels()).form == plant.form
    assert plant.at({"p": "1:z"}).form == plant.form


def test_a_proportional_pair_stays_a_block_however_damped():
    plant = plant_of("held proportional")
    assert tuple(plant.system.blocks) == (2, 2, 2, 2)
    poles = plant.system.poles()  # those of the critical pair are apart by the root of rounding
    assert np.count_nonzero(np.abs(poles.imag) > 1e-6 * np.abs(poles)) == 4
    assert plant.assembled.realisation.coupling is None
    found = [mode.zeta for mode in plant.check().modes]
    np.testing.assert_allclose(found, [2.0, 1.0, 0.7, 1e-3], rtol=1e-8)
    assert all(0 < mode.shares["u"] <= 1 for mode in plant.check().modes)


def test_shares_do_not_depend_on_the_damping():
    light, heavy = (plant_of(case).check().modes for case in ("held light", "held overdamped"))
    for a, b in zip(light, heavy, strict=True):
        assert b.freq == pytest.approx(a.freq, rel=1e-4)
        for side in "wu":
            assert b.shares[side] == pytest.approx(a.shares[side], rel=1e-2)


def switching():
    """The damper at which the form changes, by bisection on what realised() says."""
    M, D, K = chain("held light")
    low, high = 10.0, critical()
    for _ in range(60):
        middle = 0.5 * (low + high)
        blocks = realise(model_of(M, D + np.diag([0, 0, middle, 0]), K)).form == "modal blocks"
        low, high = (middle, high) if blocks else (low, middle)
    return low, high


@pytest.mark.slow
def test_the_two_forms_agree_where_one_gives_way_to_the_other():
    M, D, K = chain("held light")
    answers = []
    for damper, form in zip(switching(), ("modal", "dense"), strict=True):
        there = D + np.diag([0, 0, damper, 0])
        plant = quietly(model_of(M, there, K))
        assert plant.form.startswith(form)
        found = frequency_response(plant.system.select(["p:z", "y"], ["u"]), FREQ).data
        exact = receptance(M, there, K, np.eye(4)[[3, 2]], np.eye(4)[:1], 2 * np.pi * FREQ)
        np.testing.assert_allclose(found, exact, rtol=1e-9)
        answers.append(found)
    np.testing.assert_allclose(answers[0], answers[1], rtol=1e-9)


def test_the_condition_of_complex_modes():
    # oracle: 1 / |w' v| of unit left and right eigenvectors of the same first-order form
    M, D, K = chain("held critical")
    D = D - np.diag([0, 0, critical(), 0])
    for damper in (50.0, 0.9 * critical(), critical() * (1 - 1e-8)):
        real = real_form(M, D + np.diag([0, 0, damper, 0]), K, np.zeros((4, 0)))
        found = real.condition(modal(real))
        assert found == pytest.approx(oracle.condition(real.omega, real.C), rel=1e-3)
    assert found > 100
    light = real_form(M, oracle.light_damping(M, K, 1e-3), K, np.zeros((4, 0)))
    assert light.condition(modal(light)) == pytest.approx(1.0, rel=1e-5)
    assert ILL_CONDITIONED == 30.0


def test_modes_point_to_the_plant():
    held, free = (model_of(*chain(case)) for case in ("held overdamped", "free dragged"))
    with pytest.warns(FlexplantWarning, match=r"overdamped.*assemble_plant\(model, ports\)"):
        assert solve_modes(held).n_modes == held.n_dof - 1
    with pytest.raises(ModelError, match=r"dampers to ground.*assemble_plant\(model, ports\)"):
        solve_modes(free)
    for model in (held, free):
        with pytest.raises(ModelError, match=r"dense form"):
            normal_form(model.M, model.D, model.K, model.rigid_body)


def test_a_single_dragged_mass():
    plant = quietly(
        model_of(np.eye(1) * 2.0, np.eye(1) * 6.0, np.zeros((1, 1))),
        channels(w=[], z=[Poi("p", at="1:z")], y=[Sensor("y", at="1:z")]),
    )
    np.testing.assert_allclose(np.sort(plant.system.poles().real), [-3.0, 0.0])
    gain = frequency_response(plant.system.select(["y"], ["u"]), np.array([0.3])).data[0, 0, 0]
    s = 0.6j * np.pi
    assert gain == pytest.approx(1 / (2 * s * s + 6 * s), rel=1e-12)


def test_other_operations_of_a_dense_plant(tmp_path):
    plant = plant_of("held overdamped")
    plant.save(tmp_path / "p.npz")
    again = fx.load(tmp_path / "p.npz")
    assert again.form == plant.form
    assert np.array_equal(again.system.A, plant.system.A)
    assert np.array_equal(
        again.discretized(RATE).noise_factor, plant.discretized(RATE).noise_factor
    )
    fit = fx.MeasuredModes([-1 + 1000j], modes=[1], covariance=np.eye(2))
    with pytest.raises(
        ModelError, match=r"coupled by damping \(dense: an overdamped.*plant.uncertain\(fit\)"
    ):
        plant.uncertain(fit)
    foreign = StandardPlant.from_statespace(plant.system, u=plant.u, y=plant.y)
    assert foreign.form == "as given"
    # the slowest modes alone, the others as their flexibility: exact at zero frequency
    static = quietly(model_of(*chain("held overdamped")), residual=Feedthrough(above=500.0))
    assert static.system.n_states < plant.system.n_states
    low = np.array([1e-3])
    few, all_ = (
        frequency_response(p.system.select(["p:z"], ["u"]), low).data[0, 0, 0]
        for p in (static, plant)
    )
    assert few == pytest.approx(all_, rel=1e-6)


def test_weak_springs_under_a_dragged_structure():
    # a suspension mode whose damper is above critical: real poles of the suspension
    M, D, K = chain("free dragged")
    soft = suspend(model_of(M, D, K), GroundSpring("1:z", 400.0))
    plant = quietly(soft)
    assert plant.n_rigid == 0
    assert plant.form.startswith("dense: an overdamped pair near mode 1")
    K = K + np.diag([400.0, 0, 0, 0])
    g = frequency_response(plant.system.select(["p:z"], ["u"]), FREQ).data
    exact = receptance(M, D, K, np.eye(4)[[3]], np.eye(4)[:1], 2 * np.pi * FREQ)
    np.testing.assert_allclose(g, exact, rtol=1e-8)
    dense = np.sort(np.linalg.eigvals(first_order(M, D, K, np.eye(4), np.eye(4))[0]).real)
    assert plant.system.is_stable
    np.testing.assert_allclose(np.sort(plant.system.poles().real)[-2:], dense[-2:], rtol=1e-7)


@cache
def stuck_plate(damper=2e3):
    """The reduced plate with an (updated) damper to ground that drags its rigid body."""
    model = reduced(0.001)
    row = model.row(model.full_dofs.nearest(Z8, "z"))
    return model.replace(D=model.D + damper * np.outer(row, row))


def test_a_plate_that_is_dragged_is_still_a_stage():
    plant = quietly(stuck_plate(), ports())
    assert plant.n_rigid == 3
    assert plant.form.startswith("dense: dampers to ground drag")
    # one combination of the three motions is dragged: two stay double integrators
    assert np.count_nonzero(plant.system.poles() == 0) == 5
    assert plant.system.blocks[:2] == (2, 2)
    found = gravity_axes(plant)
    np.testing.assert_allclose(found.mass, gravity_axes(quietly(reduced(0.001), ports())).mass)
    moved = plant.at((0.2, 0.4, 0.0))
    model = stuck_plate()
    freq = np.array([40.0, 246.0, 700.0])
    see = model.row((0.2, 0.4, 0.0))[None]
    push = np.array([model.row(port.at) for port in plant.assembled.ports.u])
    gain = frequency_response(moved.system.select(["die:z"], plant.u), freq).data
    exact = receptance(model.M, model.D, model.K, see, push, 2 * np.pi * freq)
    np.testing.assert_allclose(gain, exact, rtol=1e-6)
    rows = plant.along("die", [(0.2, 0.4, 0.0)])
    np.testing.assert_allclose(rows.C[0, 0], moved.system.C[0], atol=1e-15)


def test_observer_servo_and_run_on_a_dragged_plate():
    plant = quietly(stuck_plate(), ports()).discretized(1e4, delay=1)
    assert plant.check()["stabilisable"].holds
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=50.0)
    loop = fx.close_loop(plant, observer, servo)
    assert loop.spectral_radius < 1
    run = fx.simulate(loop, duration=0.2, rng=3)
    # the filter's prediction of its own error: one sided bands of a run of 2000 samples
    error = run["die:z"] - run["die:hat"]
    predicted = observer.rms("die:z")
    assert 0.8 < np.std(error[500:]) / predicted < 1.25
    # a filter for the plate without the damper is worse on this one than it says
    assert fx.design_kalman(quietly(reduced(0.001), ports()).discretized(1e4, delay=1)) is not None


@pytest.mark.slow
def test_hinf_and_neglected_modes_of_a_dragged_plate():
    plant = quietly(stuck_plate(), ports()).discretized(1e4, delay=1)
    errors = fx.reference_errors(plant)
    weights = fx.stage_weights(plant, 60.0)
    found = fx.design_hinf(plant.through(errors).weighted(z=weights.z, w=weights.w))
    loop = fx.close_loop(plant, errors, found)
    assert loop.spectral_radius < 1
    assert found.gamma < 3


@pytest.mark.slow
def test_a_free_plate_of_all_dofs_on_a_strong_damper():
    # 486 states in metres and newtons; oracle: dense solves
    bare = full(0.001)
    row = bare.dofs.row(Z8, "z")
    model = FEModel(bare.M, bare.K, bare.D + 5e4 * np.outer(row, row), dofs=bare.dofs)
    plant = quietly(model, ports())
    assert plant.form.startswith("dense: dampers to ground")
    freq = np.array([5.0, 245.7, 1500.0])
    M, D, K = machine(0.001)
    damped = D + 5e4 * np.outer(z_row(*Z8[:2]), z_row(*Z8[:2]))
    push = np.array([z_row(x, y) for x, y, _ in [port.at for port in plant.assembled.ports.u]])
    see = np.array([z_row(x, y) for x, y, _ in [port.at for port in plant.assembled.ports.y]])
    gain = frequency_response(plant.system.select(plant.y[:4], plant.u), freq).data
    np.testing.assert_allclose(
        gain, receptance(M, damped, K, see, push, 2 * np.pi * freq), rtol=1e-5
    )
    sampled = plant.discretized(1e4, delay=1)
    values = np.linalg.eigvalsh(sampled.process_noise)
    assert values[0] >= -1e-15 * values[-1]
    assert np.abs(sampled.system.poles()).max() <= 1 + 1e-9
