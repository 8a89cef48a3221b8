"""design_hinf on the stage: updated model, virtual machine, other time, other doors."""

import re
from functools import cache

import control
import numpy as np
import pytest

from flexplant import load
from flexplant.errors import AssumptionError, CertificateError, LabelError, ModelError, SolverError
from flexplant.loop import close_loop
from flexplant.lti import StateSpace, hinf_norm, lft
from flexplant.plant import Sensor, StandardPlant, assemble_plant, reference_errors, stage_weights
from flexplant.synthesis import Riccati, design_hinf
from flexplant.synthesis.controller import certified_norm
from flexplant.testbeds import wafer_stage
from oracles_synthesis import brute_norm, closed_loop, gains, split, stability
from stages import CORNERS, NOISE, RATE, calibrated, ports, reduced, sampled

BANDWIDTH = 30.0


@cache
def machine():
    """Of another formulation than the model's mesh."""
    return wafer_stage(damping=0.01, rate=RATE, delay=1)


@cache
def updated():
    return calibrated(reduced(), machine())


def weighted(plant, bandwidth=BANDWIDTH):
    """What the example designs on: errors at the sensors, four blocks of weights."""
    comparison = reference_errors(plant)
    weights = stage_weights(plant, bandwidth)
    return comparison, plant.through(comparison).weighted(z=weights.z, w=weights.w)


@cache
def stage(delay=1):
    plant = sampled(updated(), delay=delay) if delay is not None else assembled()
    comparison, problem = weighted(plant)
    return plant, comparison, problem, design_hinf(problem)


@cache
def assembled():
    return assemble_plant(updated(), ports())


def dense_loop(P, K):
    return closed_loop(split(P.A, P.B, P.C, P.D, len(K.outputs), len(K.inputs)), K.A, K.B, K.C, K.D)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [1, None], ids=["sampled", "continuous"])
def test_the_stage_keeps_its_claim(delay):
    """Dense interconnection, eigenvalues, a brute sweep: gamma is the norm, 5 % above `lower`."""
    _, _, problem, found = stage(delay)
    loop = dense_loop(problem.system, found.system)
    assert stability(loop[0], problem.dt) < 0
    assert brute_norm(*loop, problem.dt, count=150) == pytest.approx(found.gamma, rel=1e-3)
    assert found.certificate["claim"] == pytest.approx(found.gamma, rel=1e-3)
    assert found.certificate["swept norm"] == pytest.approx(found.gamma, rel=1e-3)
    assert 0.85 < found.gamma < 1.1
    assert found.gamma / 1.06 < found.lower < found.gamma
    assert found.system.dt == problem.dt
    assert (found.system.inputs, found.system.outputs) == (problem.y, problem.u)


@pytest.mark.slow
def test_doing_nothing_is_twice_as_bad():
    """Without control the rigid body integrates: no norm at all."""
    _, _, problem, found = stage()
    assert hinf_norm(problem.Gzw) > 2 * found.gamma
    assert stability(problem.system.A, problem.dt) > -1e-9


@pytest.mark.slow
@pytest.mark.parametrize("on", ["model", "machine"])
def test_the_asked_bandwidth_is_reached_on_model_and_machine(on):
    """|S| < 1 from die:ref to die:error up to 30 Hz, and stable, with the true dynamics too."""
    plant, comparison, _, found = stage()
    if on == "model":
        loop = close_loop(plant, comparison, found)
    else:
        loop = machine().loop(ports(), comparison, found)
    assert loop.is_stable and loop.spectral_radius < 1
    assert loop.modulus_margin > 0.3
    system = loop.system
    assert stability(system.A, system.dt) < 0
    row, column = system.outputs.index("die:error"), system.inputs.index("die:ref")
    freq = np.geomspace(0.5, BANDWIDTH, 60)
    one = (system.A, system.B[:, [column]], system.C[[row]], system.D[np.ix_([row], [column])])
    S = gains(*one, np.exp(2j * np.pi * freq * system.dt))
    assert S.max() < 1.0
    assert S[0] < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("channel", range(4))
@pytest.mark.parametrize("side", ["u", "y"])
def test_one_flipped_sign_is_refused(side, channel):
    _, _, problem, found = stage()
    signs = np.ones(4)
    signs[channel] = -1.0
    K = found.system
    if side == "u":
        K = K.replace(C=signs[:, None] * K.C, D=signs[:, None] * K.D)
    else:
        K = K.replace(B=K.B * signs, D=K.D * signs)
    with pytest.raises(CertificateError, match="not stable"):
        certified_norm(lft(problem.system, K), found.gamma)


@pytest.mark.slow
def test_delay_costs():
    """The same weights with five samples of delay cannot be met as well."""
    slow = stage(5)[3]
    assert slow.lower > stage()[3].lower
    assert slow.system.n_states == stage()[3].system.n_states + 16


@pytest.mark.slow
def test_python_control_systems_serve_and_give_the_same():
    _, _, problem, found = stage()
    other = design_hinf(problem.to_control(), u=problem.u, y=problem.y)
    assert other.gamma == pytest.approx(found.gamma, rel=1e-6)
    z = np.exp(2j * np.pi * np.array([1.0, 30.0, 300.0]) / RATE)
    for point in z:
        np.testing.assert_allclose(
            other.system.evaluated(point),
            found.system.evaluated(point),
            rtol=1e-5,
            atol=1e-7 * np.abs(found.system.evaluated(point)).max(),
        )


@pytest.mark.slow
def test_nanometres_and_milliseconds_make_no_difference():
    """z and y in nm, u in kN, time in ms: gamma and the feedback are the same physics."""
    _, _, problem, found = stage()
    P = problem.system
    inputs = np.r_[np.ones(len(problem.w)), np.full(len(problem.u), 1e3)]
    outputs = np.r_[np.ones(len(problem.z)), np.full(len(problem.y), 1e9)]
    other = P.replace(
        B=P.B * inputs,
        C=P.C * outputs[:, None],
        D=P.D * outputs[:, None] * inputs,
        dt=1e3 * P.dt,
        blocks=None,
    )
    K = design_hinf(other, u=problem.u, y=problem.y)
    assert K.gamma == pytest.approx(found.gamma, rel=1e-6)
    for freq in (0.5, 30.0, 400.0):
        point = np.exp(2j * np.pi * freq * P.dt)
        first, second = found.system.evaluated(point), K.system.evaluated(point) * 1e12
        assert np.linalg.norm(first - second) < 1e-5 * np.linalg.norm(first)


@pytest.mark.slow
def test_accelerometers_feed_through():
    """D22 is not zero: the loop of the restored controller is the one that was designed."""
    y = [Sensor(f"y{i}", at=p, asd=NOISE) for i, p in enumerate(CORNERS, 1)]
    y.append(Sensor("a1", at=CORNERS[0], quantity="acceleration", asd=1e-4))
    plant = assemble_plant(updated(), ports(y=y, references=[]))
    assert np.any(plant.D22)
    weights = stage_weights(plant, BANDWIDTH)
    problem = plant.weighted(z=weights.z, w=dict(weights.w) | {"a1:noise": 1.0})
    found = design_hinf(problem)
    loop = dense_loop(problem.system, found.system)
    assert stability(loop[0], 0.0) < 0
    assert brute_norm(*loop, 0.0, count=150) == pytest.approx(found.gamma, rel=1e-3)


@pytest.mark.slow
def test_the_controller_is_saved_whole(tmp_path):
    found = stage()[3]
    found.save(tmp_path / "k.npz")
    back = load(tmp_path / "k.npz")
    assert (back.gamma, back.lower) == (found.gamma, found.lower)
    assert dict(back.certificate) == dict(found.certificate)
    np.testing.assert_array_equal(back.system.A, found.system.A)
    lines = repr(found).splitlines()
    assert lines[0].startswith("<Controller H-infinity by Riccati: 61 states, gamma 0.")
    assert "reached, of 1 that the weights require: motions from disturbances" in lines[1]
    assert "swept norm" in lines[2]
    assert lines[3] == "  stays stable if one modal frequency (not its shape) shifts by 1 %"
    assert "not judged on a larger model" in lines[4]
    assert dict(back.reached) == dict(found.reached)


EFFORTS, NOISES = [f"u{i}:effort" for i in range(1, 5)], [f"y{i}:noise" for i in range(1, 5)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "side", "names", "note"),
    [
        # sampled: two combinations move or bend the plate less than is felt at half the rate
        (RATE, "z", EFFORTS, r"D12 has rank [02] of 4: .*u1.* z "),
        (0.0, "w", NOISES, r"D21 has rank 1 of 4: .*y1:error.* noise"),
        (RATE, "z", ["die:rx", "die:ry"], "z does not feel all that u moves at 0 Hz"),
        (0.0, "z", ["die:rx", "die:ry"], "z does not feel all that u moves at 0 Hz"),
        (RATE, "w", [f"amp{i}" for i in range(1, 5)], "w does not excite all that y sees at 0 Hz"),
    ],
)
def test_what_the_weights_leave_out_is_served_with_a_note(rate, side, names, note):
    plant = sampled(updated()) if rate else assembled()
    weights = stage_weights(plant, BANDWIDTH)
    sides = {"z": dict(weights.z), "w": dict(weights.w)}
    sides[side] |= dict.fromkeys(names)
    found = design_hinf(plant.through(reference_errors(plant)).weighted(**sides))
    assert re.search(note, found.notes[0])
    assert f"{found.certificate['added noise']:.0e}" in found.notes[0]


@pytest.mark.slow
def test_rigid_motions_that_no_sensor_sees_are_named():
    blind = ports(y=[Sensor("y1", at=CORNERS[0], asd=NOISE)], references=[])
    with pytest.raises(AssumptionError, match=r"y does not see the rigid-body .*rotation"):
        design_hinf(sampled(updated(), blind))


@pytest.mark.slow
def test_a_plant_without_weights_is_solved_in_any_units():
    """Metres beside newtons: the Riccati equations are in units of their own."""
    plant = sampled(updated())
    found = design_hinf(plant)
    g, K = plant.system, found.system
    parts = split(g.A, g.B, g.C, g.D, len(plant.u), len(plant.y))
    loop = closed_loop(parts, K.A, K.B, K.C, K.D)
    assert stability(loop[0], plant.dt) < 0
    assert brute_norm(*loop, plant.dt) == pytest.approx(found.gamma, rel=1e-3)
    assert found.lower <= found.gamma <= 1.052 * found.lower  # the back-off and the tolerance


@pytest.mark.slow
def test_a_loop_that_hangs_on_rounding_is_refused():
    """Sixteen lags in a row, each of gain 1000: 1e48 from the first state to the last.

    One rounding of each entry of the plant moves the loop's norm by 0.2 to 1.5 %, on five kernels.
    """
    n = 16
    A = np.diag(np.full(n - 1, 1e3), 1) - np.eye(n)
    B, C = np.eye(n)[:, [0, -1]] @ np.ones((2, 2)), np.ones((2, n))
    P = StateSpace(A, B, C, [[0.0, 1], [1, 0]], inputs=["w", "u"], outputs=["z", "y"])
    with pytest.raises(SolverError, match=r"one rounding of each entry .* changes it by \d\.\d+ %"):
        design_hinf(P, u="u", y="y", progress=False)


@pytest.mark.slow
def test_a_long_chain_of_lags_with_large_gains():
    """Eight lags in a row, each of gain 1000: 1e24 from the first state to the last.

    At the speed of its loop, some 1000 rad/s, all of its states have the same size.
    """
    n = 8
    A = np.diag(np.full(n - 1, 1e3), 1) - np.eye(n)
    B, C = np.eye(n)[:, [0, -1]] @ np.ones((2, 2)), np.ones((2, n))
    P = StateSpace(A, B, C, [[0.0, 1], [1, 0]], inputs=["w", "u"], outputs=["z", "y"])
    found = design_hinf(P, u="u", y="y")
    K = found.system
    loop = closed_loop(split(A, B, C, P.D, 1, 1), K.A, K.B, K.C, K.D)
    assert stability(loop[0], 0.0) < 0
    assert brute_norm(*loop, 0.0) == pytest.approx(found.gamma, rel=2e-3)
    assert found.gamma <= 1.15 * found.lower


def small():
    return StateSpace(
        [[-1.0]],
        [[1, 0, 1]],
        [[1], [0], [1]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
        inputs=["w1", "w2", "u"],
        outputs=["z1", "z2", "y"],
    )


def test_wrong_arguments_are_refused():
    P = small()
    with pytest.raises(LabelError, match=r"do not show which are w, u, z and y.*Type Standard"):
        design_hinf(P)
    with pytest.raises(LabelError, match="name both u and y"):
        design_hinf(P, u=["u"])
    with pytest.raises(ModelError, match=r"need a StandardPlant, got 3\.0"):
        design_hinf(3.0)
    with pytest.raises(ModelError, match="got str"):
        design_hinf("plant", u=["u"], y=["y"])
    with pytest.raises(LabelError, match="'v'"):
        design_hinf(P, u=["v"], y=["y"])
    for method in ("riccati", Riccati):
        with pytest.raises(ModelError, match="method must be"):
            design_hinf(P, method, u=["u"], y=["y"])
    for below in (-1.0, np.nan, "350"):
        with pytest.raises(ModelError, match="damped_below"):
            design_hinf(P, u=["u"], y=["y"], damped_below=below)
    plant = StandardPlant.from_statespace(P, u=["u"], y=["y"])
    with pytest.raises(ModelError, match="leave them out"):
        design_hinf(plant, u=["u"], y=["y"])
    with pytest.raises(AssumptionError, match="channels w, z, u and y"):
        design_hinf(P, u=["u"], y=["z1", "z2", "y"])
    with pytest.raises(ModelError, match="z = -1"):
        design_hinf(P.replace(dt=0.1), u=["u"], y=["y"])
    unstated = control.ss([[-1.0]], [[1, 1]], [[1], [1]], np.eye(2), True)
    with pytest.raises(ModelError, match="sampling time"):
        design_hinf(unstated, u=["u[1]"], y=["y[1]"])


def test_a_single_name_serves_as_channel():
    assert design_hinf(small(), u="u", y="y").gamma == design_hinf(small(), u=["u"], y=["y"]).gamma


def test_a_method_that_lies_is_caught():
    """Claims and signs of any method are judged by the loop."""

    class Liar:
        def __init__(self, factor, sign):
            self.factor, self.sign = factor, sign

        def solve(self, problem):
            found = Riccati().solve(problem)
            C, D = self.sign * found.C, self.sign * found.D
            return found._replace(C=C, D=D, gamma=self.factor * found.gamma)

    P = small()
    P = P.replace(A=[[1.0]])
    with pytest.raises(CertificateError, match="was claimed"):
        design_hinf(P, Liar(0.9, 1.0), u="u", y="y")
    with pytest.raises(CertificateError, match="not stable"):
        design_hinf(P, Liar(1.0, -1.0), u="u", y="y")
