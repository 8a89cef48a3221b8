"""Filters, delays, shaped and base disturbances of ports, against dense systems."""

import numpy as np
import pytest
import scipy.linalg as la

from flexplant import DofSet, load
from flexplant.errors import AssumptionError, LabelError, ModelError, ShapeError
from flexplant.estimation import design_kalman
from flexplant.lti import StateSpace, discretized, frequency_response, low_pass_filter, pade, tf
from flexplant.lti.equations import state_scale
from flexplant.lti.sampling import Flow, held_exactly, sample_and_hold
from flexplant.plant import (
    Actuator,
    BaseAcceleration,
    Disturbance,
    GroundSpring,
    OutputDisturbance,
    Poi,
    Ports,
    Reference,
    Sensor,
    assemble_plant,
    stage_weights,
    suspend,
)
from flexplant.structure import FEModel
from oracles_ports import (
    chain,
    companion,
    gain,
    late_run,
    machine_with_filters,
    noise_of_late_outputs,
)
from stages import NOISE, L, ports, some_modes

M, D, K = chain()
E = np.eye(5)
FREQ = np.array([3.0, 90.0, 260.0, 480.0, 900.0])
S = 2j * np.pi * FREQ
#: filters as polynomials: one pole, two poles, and a resonance
AMP = ([9000.0], [1.0, 9000.0])
SENSE = ([4e7], [1.0, 8000.0, 4e7])
SHAPE = ([50.0, 1e5], [1.0, 300.0, 2.5e5])


def model(**changes):
    dofs = DofSet(range(1, 6), ["x"] * 5, np.outer(np.arange(5.0), [1.0, 0.0, 0.0]))
    return FEModel(**({"M": M, "K": K, "D": D, "dofs": dofs} | changes))


def filtered(polynomials):
    A, B, C, direct = companion(*polynomials)
    return StateSpace(A, B, C, direct)


def channels(**changes):
    fields = {
        "w": [
            Disturbance("hum", at="2:x", direction="x", asd=0.3, shape=filtered(SHAPE)),
            Disturbance("rub", at={"4:x": 1.0, "3:x": -1.0}, asd=0.1),
        ],
        "u": [
            Actuator("u1", at="1:x", dynamics=filtered(AMP)),
            Actuator("u2", at="3:x", direction="x"),
        ],
        "z": [Poi("die", at="4:x", axes=("x",))],
        "y": [
            Sensor("y1", at="2:x", asd=1e-9, dynamics=filtered(SENSE)),
            Sensor("y2", at="5:x", asd=1e-9),
        ],
        "references": [Reference("die")],
    }
    return Ports(**(fields | changes))


def dense():
    """The same machine: inputs hum, rub, u1, u2; outputs die, y1, y2."""
    push = np.array([E[1], E[3] - E[2], E[0], E[2]])
    see = np.array([E[3], E[1], E[4]])
    before = [companion(*SHAPE), None, companion(*AMP), None]
    return machine_with_filters(M, D, K, push, see, before, [None, companion(*SENSE), None])


INPUTS, OUTPUTS = ["hum", "rub", "u1", "u2"], ["die:x", "y1", "y2"]


def test_filters_multiply_the_response():
    plant = assemble_plant(model(), channels())
    assert plant.system.n_states == 10 + 2 + 1 + 2
    found = frequency_response(plant.system.select(OUTPUTS, INPUTS), FREQ).data
    for i, s in enumerate(S):
        push = np.array([E[1], E[3] - E[2], E[0], E[2]]).T * [
            gain(*SHAPE, s), 1.0, gain(*AMP, s), 1.0,
        ]  # fmt: skip
        motion = np.linalg.solve(s * s * M + s * D + K, push)
        wanted = np.array([motion[3], motion[1] * gain(*SENSE, s), motion[4]])
        np.testing.assert_allclose(found[..., i], wanted, rtol=1e-9)
    # effort is the command, error the reference less the POI
    assert plant.Gzu.D[plant.z.index("u1:effort"), 0] == 1.0
    np.testing.assert_array_equal(plant.Gzw.C[1], -plant.Gzw.C[0])


def test_velocity_and_acceleration_pass_their_filters_too():
    y = [
        Sensor("v", at="2:x", quantity="velocity", dynamics=filtered(SENSE)),
        Sensor("a", at="2:x", quantity="acceleration", dynamics=filtered(SENSE)),
        Sensor("bare", at="2:x", quantity="acceleration"),
    ]
    plant = assemble_plant(model(), channels(y=y, u=[Actuator("u", at="2:x")]))
    found = frequency_response(plant.Gyu, FREQ).data[:3, 0]
    bare = np.array([np.linalg.solve(s * s * M + s * D + K, E[1])[1] for s in S])
    filters = gain(*SENSE, S)
    np.testing.assert_allclose(found, [bare * S * filters, bare * S**2 * filters, bare * S**2],
                               rtol=1e-9)  # fmt: skip
    assert plant.D22[1, 0] == 0.0
    np.testing.assert_allclose(plant.D22[2, 0], 1.0, rtol=1e-12)  # 1 kg at node 2


def test_the_matrix_is_block_triangular_with_exact_rigid_poles():
    plant = assemble_plant(model(), channels())
    g = plant.system
    assert g.states[:2] == ("y1|x1", "y1|x2")
    assert g.states[-1] == "u1|x1"
    assert g.blocks == (2, 2, 2, 2, 2, 2, 2, 1)
    assert [g.states[i] for i in plant.modal_states] == list(plant.assembled.realisation.names)
    rigid = plant.modal_states[:2]
    assert not g.poles()[rigid].any()
    sampled = plant.discretized(5e3, delay=0.4)
    np.testing.assert_array_equal(sampled.system.poles()[sampled.modal_states[:2]], 1.0)
    wanted = np.sort_complex(np.exp(np.linalg.eigvals(dense()[0]) / 5e3))
    lines = np.concatenate([sampled.system.poles()[:-2]])
    np.testing.assert_allclose(np.sort_complex(lines), wanted, atol=2e-7)  # 1 is defective


@pytest.mark.parametrize(("delay", "own"), [(0.0, 0), (1.0, 0), (0.3, 0), (1.0, 7), (2.5, 13)])
def test_sampled_runs_follow_the_dense_machine(delay, own):
    """Delays in tenths of a sample: of all u, and one more of u2, y1 and y2."""
    h, fine = 2e-4, 10
    late_y = (3 if own else 0, 12 if own else 0)
    base = channels()
    ports = base.replace(
        u=[base.u[0], base.u[1].replace(latency=own * h / fine)],
        y=[base.y[0].replace(latency=late_y[0] * h / fine),
           base.y[1].replace(latency=late_y[1] * h / fine)],
    )  # fmt: skip
    plant = assemble_plant(model(), ports).discretized(1 / h, delay=delay)
    rng = np.random.default_rng(5)
    u = rng.standard_normal((40, 4))
    g, x, found = plant.system.select(OUTPUTS, INPUTS), 0.0, []
    x = np.zeros(g.n_states)
    for k in range(40):
        found.append(g.C @ x + g.D @ u[k])
        x = g.A @ x + g.B @ u[k]
    shift = round(delay * fine)
    late_in = (0, 0, shift, shift + own)
    wanted = late_run(*dense(), u, h, late_in, (0, *late_y), fine)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())


def test_an_acceleration_keeps_its_direct_part_through_delays():
    h, fine = 2e-4, 10
    y = [Sensor("a", at="1:x", quantity="acceleration", latency=0.4 * h)]
    for late in (0.0, 0.3 * h, 0.8 * h):
        ports = Ports(u=[Actuator("u", at="1:x", latency=late)], y=y)
        plant = assemble_plant(model(), ports).discretized(1 / h)
        g = plant.system.select(["a"])
        A, B, C = machine_with_filters(M, D, K, E[:1], E[:1], [None], [None])
        row, direct = C @ A @ A, C @ A @ B
        u = np.random.default_rng(2).standard_normal((30, 1))
        x, found = np.zeros(g.n_states), []
        for k in range(30):
            found.append(g.C @ x + g.D @ u[k])
            x = g.A @ x + g.B @ u[k]
        lag, shift = 4, round(late / h * fine)
        motion = late_run(A, B, row, u, h, [shift], [lag], fine)
        # the sample of u that acts at k h - 0.4 h
        acting = [(k * fine - lag - shift) // fine for k in range(30)]
        push = np.array([[u[i, 0] if i >= 0 else 0.0] for i in acting])
        wanted = motion + push * direct[0, 0]
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())


def test_one_delay_for_all_is_that_of_the_dense_system():
    plant = assemble_plant(model(), channels(u=[Actuator("u1", at="1:x")], w=[], y=[]))
    g = plant.assembled.physical
    for delay in (0.0, 1.0, 0.25, 2.75):
        wanted = held_exactly(g.replace(blocks=None), 5e3, delay=delay, delayed=["u1"])
        found, noise = sample_and_hold(g, 5e3, {"u1": delay / 5e3})
        assert found.states == wanted.states
        for name in "ABCD":
            np.testing.assert_allclose(
                getattr(found, name), getattr(wanted, name), rtol=1e-11, atol=1e-18
            )
        assert noise.shape == (found.n_states, 0)


def test_the_flow_is_the_dense_exponential():
    g = assemble_plant(model(), channels()).assembled.physical
    for scale in (1.0, 1e7):  # units of the inputs' filters: N or 0.1 uN
        A = g.A.copy()
        A[:, 12:] *= scale
        A[12:, 12:] /= scale
        flow = Flow(A, g.blocks, state_scale(A, g.B, g.C))
        for t in (1e-5, 2e-4, 3e-3):
            wanted = la.expm(A * t)
            size = np.abs(wanted).max()
            np.testing.assert_allclose(flow.at(t), wanted, rtol=1e-9, atol=1e-14 * size)
            np.testing.assert_allclose(flow.on(np.eye(len(A)), t), flow.at(t))


def test_the_flow_of_modes_alone_acts_on_vectors_without_its_matrix():
    """Modes of two states, of one and undamped ones, in units that differ by five decades."""
    rng = np.random.default_rng(2)
    sizes = [2, 1, 2, 2, 1, 2]
    blocks = [-rng.uniform(1.0, 50.0, (1, 1)) if n == 1 else
              np.array([[0.0, 1.0], [-rng.uniform(1e2, 1e6), -rng.uniform(0.0, 5.0)]])
              for n in sizes]  # fmt: skip
    A, vectors = la.block_diag(*blocks), rng.normal(size=(sum(sizes), 3))
    flow = Flow(A, sizes, 10.0 ** rng.integers(-2, 3, len(A)))
    for t in (1e-5, 3e-3):
        wanted = la.expm(A * t) @ vectors
        np.testing.assert_allclose(flow.on(vectors, t), wanted, rtol=1e-9, atol=1e-11)


def test_a_filter_of_several_sections_keeps_its_blocks():
    """The exponential of its block triangular matrix has rounding below the blocks."""
    triple = tf([8.0], [1.0, 6.0, 12.0, 8.0])
    own = channels(w=[Disturbance("force", at="2:x", asd=1e-3, shape=triple)])
    plant = assemble_plant(model(), own)
    sampled, wanted = plant.discretized(5e3), discretized(plant.system, 5e3)
    assert {1, 2} <= set(sampled.system.blocks)
    where = [sampled.system.states.index(name) for name in plant.system.states]
    A = sampled.system.A[np.ix_(where, where)]
    np.testing.assert_allclose(A, wanted.A, rtol=1e-9, atol=1e-12 * np.abs(A).max())


def test_process_noise_holds_the_filters_and_late_samples():
    h = 2e-4
    late = np.array([0.0, 0.3, 0.85]) * h
    ports = channels()
    pairs = zip(ports.y, late[1:], strict=True)
    ports = ports.replace(y=[sensor.replace(latency=t) for sensor, t in pairs])
    plant = assemble_plant(model(), ports).discretized(1 / h)
    A, B, C = dense()
    root = B[:, :2] * (np.array([0.3, 0.1]) / np.sqrt(2))
    # the quadrature of the oracle is second order: three digits more by Richardson
    coarse, fine = (noise_of_late_outputs(A, root, C, h, late, n) for n in (1000, 2000))
    wanted = fine + (fine - coarse) / 3.0
    rows = plant.system.C[[plant.system.outputs.index(name) for name in OUTPUTS]]
    late_rows = rows.copy()
    now = assemble_plant(model(), channels()).discretized(1 / h)
    instant = now.system.C[[now.system.outputs.index(name) for name in OUTPUTS]]
    # the undelayed motions are still states of the delayed plant
    own = [plant.system.states.index(state) for state in now.system.states]
    rows = np.zeros_like(late_rows)
    rows[:, own] = instant
    both = np.vstack([rows, late_rows])
    found = both @ plant.process_noise @ both.T
    size = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(found / np.outer(size, size), wanted / np.outer(size, size),
                               atol=1e-8)  # fmt: skip


def test_stationary_variance_is_that_of_continuous_time():
    """P = A P A' + Q at any rate is the continuous Gramian: only an exact Q does that."""
    held = suspend(model(), [GroundSpring("1:x", 2e3, 20.0), GroundSpring("5:x", 2e3, 20.0)])
    plant = assemble_plant(held, channels())
    stiff = K + np.diag([2e3, 0, 0, 0, 2e3])
    damped = D + np.diag([20.0, 0, 0, 0, 20.0])
    push = np.array([E[1], E[3] - E[2]])
    see = np.array([E[3], E[1], E[4]])
    A, B, C = machine_with_filters(
        M, damped, stiff, push, see, [companion(*SHAPE), None], [None, companion(*SENSE), None]
    )
    W = la.solve_continuous_lyapunov(A, -B @ np.diag([0.3**2 / 2, 0.1**2 / 2]) @ B.T)
    for rate in (2e3, 2e4):
        sampled = plant.discretized(rate)
        g = sampled.system
        P = la.solve_discrete_lyapunov(g.A, sampled.process_noise)
        rows = g.C[[g.outputs.index(name) for name in OUTPUTS]]
        np.testing.assert_allclose(rows @ P @ rows.T, C @ W @ C.T, rtol=1e-7)


def test_the_kalman_filter_estimates_with_filters_and_delays():
    """More delay, more error; the stationary covariance bounds the open-loop one from below."""
    base = channels(
        w=[Disturbance("hum", at="2:x", asd=0.3, shape=filtered(SHAPE)),
           Disturbance("rub", at="4:x", asd=0.1)],
    )  # fmt: skip
    errors = []
    for late in (0.0, 1e-4, 3e-4):
        ports = base.replace(y=[s.replace(latency=late) for s in base.y])
        plant = assemble_plant(model(), ports).discretized(5e3, delay=1)
        errors.append(design_kalman(plant).rms("die"))
    assert errors[0] < errors[1] < errors[2]
    assert errors[2] < 20 * errors[0]


def test_base_acceleration_is_inertia_of_all_masses():
    held = suspend(model(), [GroundSpring("1:x", 3e3, 5.0)])
    grounded_K = K + np.diag([3e3, 0, 0, 0, 0])
    grounded_D = D + np.diag([5.0, 0, 0, 0, 0])
    ports = channels(w=[BaseAcceleration("floor", "x", asd=1e-4)])
    for structure, stiffness, damping in ((held, grounded_K, grounded_D), (model(), K, D)):
        plant = assemble_plant(structure, ports)
        found = frequency_response(plant.Gzw, FREQ)["die:x", "floor"]
        wanted = [
            -np.linalg.solve(s * s * M + s * damping + stiffness, M @ np.ones(5))[3] for s in S
        ]
        np.testing.assert_allclose(found, wanted, rtol=1e-8)
    # a free body only falls behind: -a / s^2
    np.testing.assert_allclose(found, -1 / S**2, rtol=1e-8)


def test_output_disturbances_pass_the_sensor_only():
    ports = channels(w=[OutputDisturbance("drift", "y1", asd=1e-9)])
    plant = assemble_plant(model(), ports)
    found = frequency_response(plant.Gyw, FREQ)
    np.testing.assert_allclose(found["y1", "drift"], gain(*SENSE, S), rtol=1e-10)
    assert not found["y2", "drift"].any()
    # sampled, its noise is that of the filter alone
    sampled = plant.discretized(5e3)
    A, B, C, _ = companion(*SENSE)
    W = la.solve_continuous_lyapunov(A, -0.5e-18 * B @ B.T)
    row = sampled.system.C[sampled.system.output_index(["y1"])][0, :2]
    own, noise = sampled.system.A[:2, :2], sampled.process_noise[:2, :2]
    P = la.solve_discrete_lyapunov(own, noise)
    np.testing.assert_allclose(row @ P @ row, (C @ W @ C.T)[0, 0], rtol=1e-8)
    shaped = channels(w=[OutputDisturbance("drift", "y2", asd=1e-9, shape=filtered(AMP))])
    found = frequency_response(assemble_plant(model(), shaped).Gyw, FREQ)
    np.testing.assert_allclose(found["y2", "drift"], gain(*AMP, S), rtol=1e-10)


def test_static_gains_are_filters_without_states():
    double = StateSpace([], [], [], [[2.0]])
    ports = channels(w=[], u=[Actuator("u", at="1:x", dynamics=double)],
                     y=[Sensor("y", at="2:x", dynamics=double)])  # fmt: skip
    plain = channels(w=[], u=[Actuator("u", at="1:x")], y=[Sensor("y", at="2:x")])
    found, bare = (assemble_plant(model(), p) for p in (ports, plain))
    assert found.system.n_states == 10
    np.testing.assert_allclose(found.Gyu["y", "u"].evaluated(300j),
                               4 * bare.Gyu["y", "u"].evaluated(300j), rtol=1e-12)  # fmt: skip


def test_filters_do_not_hide_rigid_body_modes():
    base = channels()
    twice = StateSpace(*companion([18000.0], [1.0, 9000.0]))
    thrice = StateSpace(*companion([1.2e8], [1.0, 8000.0, 4e7]))
    ports = base.replace(
        u=[base.u[0].replace(dynamics=twice), base.u[1]],
        y=[base.y[0].replace(dynamics=thrice), base.y[1]],
    )
    plant = assemble_plant(model(), ports).discretized(5e3, delay=1)
    assert plant.check()["stabilisable"].holds
    assert plant.check()["detectable"].holds


def plate_with_filters(**changes):
    """The paper's plate, a filter on each sensor (states before the modes) and each actuator."""
    base = ports(**changes)
    return base.replace(
        y=[s.replace(dynamics=low_pass_filter(3e3, order=2), latency=3e-5) for s in base.y],
        u=[a.replace(dynamics=low_pass_filter(4e3)) for a in base.u],
    )


def test_check_names_rigid_motions_behind_filters():
    """The same words with filters and without, for places with no symmetry."""
    one = [Disturbance("mid", at=(0.2, 0.1, 0.0), asd=1e-3)]
    two = [Sensor("a", at=(L / 2, 0.1, 0.0), asd=NOISE), Sensor("b", at=(0.2, 0.5, 0.0), asd=NOISE)]
    reports = [
        assemble_plant(some_modes(), channels_of(w=one, y=two)).check()
        for channels_of in (ports, plate_with_filters)
    ]
    for key in ("excited", "detectable"):
        assert not reports[0][key].holds
        assert reports[1][key].finding == reports[0][key].finding
    assert "the rigid-body rotation rx + rotation ry (" in reports[0]["detectable"].finding


def test_visibility_of_modes_behind_filters():
    """What filters of sensors add stands before the modes: w and z see them as without filters."""
    modes, channels = some_modes(), plate_with_filters()
    found = assemble_plant(modes, channels).check().modes
    assert len(found) == modes.phi.shape[1] - 3 == 21
    # modal displacement where noise pushes, of the free plate's shapes
    gains = np.abs([modes.at(noise.at) for noise in channels.w])[:, 3:]
    expected = (gains / gains.max(axis=1, keepdims=True)).max(axis=0)
    np.testing.assert_allclose([mode.shares["w"] for mode in found], expected, atol=1e-9)
    plain = assemble_plant(modes, ports()).check().modes
    seen = [[mode.shares["z"] for mode in report] for report in (found, plain)]
    np.testing.assert_allclose(*seen, atol=1e-9)


def test_weights_of_a_stage_with_every_kind_of_disturbance():
    w = [*ports().w, BaseAcceleration("floor", "z"), BaseAcceleration("tilt", "rx"),
         OutputDisturbance("drift", "y1")]  # fmt: skip
    plant = assemble_plant(some_modes(), ports(w=w))
    weights = stage_weights(plant, 50.0, disturbance=0.4, noise=0.01)
    crossing = 2 * np.pi * 1.6 * 50.0
    # the same motion of the body as 0.4 f0: 0.4 w_c^2 times a length of one
    assert weights.w["floor"] == pytest.approx(0.4 * crossing**2, rel=1e-9)
    # a unit of the axes as the sensor shows it on the real axis, where the plate bends a little
    assert weights.w["drift"] == pytest.approx(0.01, rel=0.05)
    arm = np.hypot(L / 2, 0.0)  # corners, rms along y
    assert weights.w["tilt"] == pytest.approx(weights.w["floor"] / arm, rel=0.05)
    shown = plant.weighted(z=weights.z, w=weights.w)
    assert shown.w == plant.w
    changed = weights.replace(w={**weights.w, "floor": None})
    assert "floor" not in plant.weighted(z=changed.z, w=changed.w).w


def test_a_continuous_plant_names_the_delays_it_leaves_out():
    ports = channels(u=[Actuator("u1", at="1:x", latency=2e-4)])
    plant = assemble_plant(model(), ports)
    assert "latencies that act once it is sampled: u1 0.0002 s" in repr(plant)
    assert "delays" not in repr(plant.discretized(5e3))
    close = assemble_plant(model(), ports.with_pade(4))
    assert "delays" not in repr(close)
    freq = FREQ[:4]
    exact = frequency_response(plant.Gyu, freq)["y1", "u1"] * np.exp(-2j * np.pi * freq * 2e-4)
    np.testing.assert_allclose(frequency_response(close.Gyu, freq)["y1", "u1"], exact, rtol=1e-7)
    both = channels(y=[Sensor("y1", at="2:x", dynamics=filtered(SENSE), latency=1e-4)])
    late = assemble_plant(model(), both.with_pade(3))
    found = frequency_response(late.Gyw, freq)["y1", "rub"]
    bare = frequency_response(assemble_plant(model(), both).Gyw, freq)["y1", "rub"]
    np.testing.assert_allclose(found, bare * np.exp(-2j * np.pi * freq * 1e-4), rtol=1e-7)


@pytest.mark.parametrize("order", [1, 2, 3, 6])
def test_pade_is_all_pass_and_right_at_low_frequency(order):
    g = pade(1e-3, order=order)
    assert g.n_states == order
    assert g.is_stable
    for freq in (10.0, 300.0, 5e3):
        assert abs(g.evaluated(2j * np.pi * freq)[0, 0]) == pytest.approx(1.0, rel=1e-9)
    s = 2j * np.pi * 20.0
    assert abs(g.evaluated(s)[0, 0] - np.exp(-s * 1e-3)) < 2 * 0.126 ** (2 * order + 1)


def test_saves_and_loads(tmp_path):
    plant = assemble_plant(model(), channels()).discretized(5e3, delay=0.5)
    plant.save(tmp_path / "p.npz")
    again = load(tmp_path / "p.npz")
    np.testing.assert_array_equal(again.at("2:x").system.C, plant.at("2:x").system.C)
    np.testing.assert_array_equal(again.process_noise, plant.process_noise)


def test_refusals():
    unstable = StateSpace([[0.0]], [[1.0]], [[1.0]], [[0.0]])
    two = StateSpace([[-1.0]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]])
    sampled = StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 1e-3)
    for bad, words in ((unstable, "not stable"), (two, "one input and one output"),
                       (sampled, "sampled")):  # fmt: skip
        with pytest.raises(ModelError, match=words):
            Actuator("u", at="1:x", dynamics=bad)
        with pytest.raises(ModelError, match=words):
            Disturbance("w", at="1:x", shape=bad)
        with pytest.raises(ModelError, match=words):
            Sensor("y", at="1:x", dynamics=bad)
    for kind in (Actuator, Sensor):
        with pytest.raises(ModelError, match="latency of 'p' must be zero or positive"):
            kind("p", at="1:x", latency=-1e-3)
    for kind in (Actuator, Sensor, Poi, Disturbance):
        with pytest.raises(ShapeError, match=r"a point of 'p' must have shape \(3,\)"):
            kind("p", at={(0.1, 0.2): 1.0})
    with pytest.raises(LabelError, match="no sensor 'y9'"):
        channels(w=[OutputDisturbance("d", "y9")])
    with pytest.raises(LabelError, match="direction"):
        BaseAcceleration("b", "up")
    with pytest.raises(ModelError, match="does not move this model"):
        assemble_plant(model(), channels(w=[BaseAcceleration("b", "z")]))
    with pytest.raises(ModelError, match="order must be"):
        channels(u=[Actuator("u", at="1:x", latency=1e-3)]).with_pade(0)
    with pytest.raises(ModelError, match="residual must be of type ResidualForm"):
        assemble_plant(model(), channels(), residual="fast")
    late = [Sensor("a", at="4:x", quantity="acceleration", latency=1e-5, asd=1e-3)]
    with pytest.raises(AssumptionError, match=r"'rub' reaches 'a' without delay.*roll off"):
        assemble_plant(model(), channels(y=late)).discretized(5e3)
