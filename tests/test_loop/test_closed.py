"""close_loop against python-control's interconnect, dense formulas, and wrong connections."""

import re

import control as ct
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import flexplant as fx
import oracles_loop as oracle
from flexplant import load
from flexplant.errors import AssumptionError, FlexplantWarning, LabelError, ModelError
from flexplant.estimation import design_static
from flexplant.loop import ClosedLoop, bandwidth, close_loop
from flexplant.loop.broken import moved_poles
from flexplant.lti import StateSpace
from flexplant.plant import StandardPlant
from flexplant.synthesis import design_servo
from machines import RATE, block, matrices, observer, servo, stage
from stages import reduced, sampled

DT = 1.0 / RATE


@pytest.fixture(scope="module")
def loop():
    return close_loop(stage(), observer(), servo())


def by_interconnect(loop, outputs):
    """Return the loop by python-control; its names on both sides must differ from ours of w."""
    plant = loop.plant
    outer = [f"{name}|in" for name in plant.w]
    g = plant.system.to_control()
    g.input_labels = [*outer, *plant.u]
    parts = [g, *(b.to_control() for b in loop.blocks)]
    for i, part in enumerate(parts):
        part.name = f"part{i}"
    return ct.interconnect(parts, inputs=outer, outputs=list(outputs))


def test_closed_loop_is_that_of_interconnect(loop):
    outputs = [*loop.plant.z, *loop.plant.y, *loop.driven, *loop.watched]
    # interconnect adds doubled outputs of one name only through sums, so one block per name here
    reference = by_interconnect(loop, outputs)
    assert loop.monitored.inputs == loop.plant.w
    assert loop.monitored.outputs == tuple(outputs)
    for z in (np.exp(2j * np.pi * f * DT) for f in (0.7, 9.0, 61.0, 640.0)):
        ours = loop.monitored.evaluated(z)
        np.testing.assert_allclose(ours, reference(z), rtol=1e-9, atol=1e-12 * abs(ours).max())
    poles = np.sort(np.abs(np.linalg.eigvals(np.asarray(reference.A))))
    assert loop.spectral_radius == pytest.approx(poles[-1], rel=1e-12)
    assert loop.is_stable == (poles[-1] < 1)
    assert loop.spectral_abscissa == pytest.approx(np.log(poles[-1]) / DT, rel=1e-9)


def test_system_is_w_to_z_with_plant_states_first(loop):
    assert loop.system.inputs == loop.plant.w
    assert loop.system.outputs == loop.plant.z
    assert loop.system.states[: loop.plant.system.n_states] == tuple(loop.plant.system.states)
    np.testing.assert_array_equal(loop.system.A, loop.monitored.A)


def test_one_block_or_many_is_the_same_controller(loop):
    whole = close_loop(loop.plant, loop.controller)
    assert whole.watched == ("die:hat",)
    np.testing.assert_allclose(whole.system.A, loop.system.A, rtol=0, atol=1e-13)
    np.testing.assert_allclose(whole.system.D, loop.system.D, rtol=1e-13)


def test_outputs_to_one_actuator_add(loop):
    half = servo().replace(C=0.25 * servo().C, D=0.25 * servo().D, name="quarter")
    rest = servo().replace(C=0.75 * servo().C, D=0.75 * servo().D, name="rest")
    twice = close_loop(loop.plant, observer(), half, rest)
    z = np.exp(2j * np.pi * 11.0 * DT)
    np.testing.assert_allclose(twice.system.evaluated(z), loop.system.evaluated(z), rtol=1e-10)


def test_observer_is_given_the_applied_command(loop):
    """The observer's inputs u1, u2 hold the sum of what all blocks drive."""
    hat = loop.monitored.select(["die:hat", "y1", "y2", "u1", "u2"])
    z = np.exp(2j * np.pi * 30.0 * DT)
    row = observer().evaluated(z)
    from_loop = hat.evaluated(z)
    np.testing.assert_allclose(from_loop[:1], row @ from_loop[1:], rtol=1e-9)
    assert np.abs(row[:, 2:] @ from_loop[3:]).max() > 1e-4 * np.abs(from_loop[0]).max()


def test_idle_actuator_rests(loop):
    one = servo().select(["u1"])
    resting = close_loop(loop.plant, observer(), one, idle=["u2"])
    assert resting.driven == ("u1",)
    zero = servo().replace(C=servo().C * [[1.0], [0.0]], D=servo().D * [[1.0], [0.0]])
    both = close_loop(loop.plant, observer(), zero)
    z = np.exp(2j * np.pi * 5.0 * DT)
    np.testing.assert_allclose(
        resting.system.evaluated(z), both.system.evaluated(z), rtol=1e-9, atol=1e-14
    )


def test_unstable_loop_is_reported_not_refused():
    with pytest.warns(FlexplantWarning, match=r"is unstable: a pole at .* \(spectral radius 1\."):
        bad = close_loop(stage(), observer(), servo(sign=-1.0))
    assert re.search(
        rf"\n  unstable: a pole .*; spectral radius {bad.spectral_radius:.9g}\n", repr(bad)
    )
    with pytest.raises(AssumptionError, match="not stable"):
        bandwidth(bad)
    with pytest.raises(AssumptionError, match="not stable"):
        bandwidth((bad.plant, bad))
    assert not bad.is_stable
    assert bad.spectral_radius > 1
    assert bad.modulus_margin == 0.0


def test_same_blocks_on_another_machine(loop):
    truth = close_loop(stage(stiffer=0.6), *loop.blocks)
    assert truth.is_stable
    assert truth.controller.outputs == loop.controller.outputs
    assert truth.modulus_margin < loop.modulus_margin - 0.1


def test_stiff_servos_are_not_taken_for_algebraic_loops(loop):
    """A gain of 1e10 N/m is a unit, not an ill-posed loop."""
    stiff = servo(sign=1e6)
    with pytest.warns(FlexplantWarning, match="unstable"):
        joined = close_loop(loop.plant, observer(), stiff).controller
    np.testing.assert_allclose(
        joined.select(["u1", "u2"]).C / 1e6, loop.controller.select(["u1", "u2"]).C, rtol=1e-12
    )
    np.testing.assert_allclose(
        joined.select(["u1", "u2"]).D / 1e6, loop.controller.select(["u1", "u2"]).D, rtol=1e-12
    )


def test_a_block_may_pass_the_command_on_directly(loop):
    """A meter of the applied force is exact, whatever the size of that force."""
    meter = StateSpace([], [], [], [[3.0, 0.5]], inputs=["u1", "u2"], outputs=["meter"])
    stiff = servo(sign=1e6)
    with pytest.warns(FlexplantWarning, match="unstable"):
        g = close_loop(loop.plant, observer(), stiff, meter).controller
    z = np.exp(2j * np.pi * 30.0 * DT)
    gain = g.evaluated(z)
    assert g.outputs == ("u1", "u2", "die:hat", "meter")
    np.testing.assert_allclose(gain[3], 3.0 * gain[0] + 0.5 * gain[1], rtol=1e-12)


def test_references_are_not_fed_back(loop):
    assert loop.fed_back == ("y1", "y2")


def test_blocks_may_be_values_with_a_system(loop):
    class Estimator:
        system = observer()

    again = close_loop(loop.plant, Estimator(), servo().to_control())
    np.testing.assert_allclose(again.system.A, loop.system.A, rtol=0, atol=1e-13)


def test_static_gain_fits_any_rate():
    mass = StateSpace(
        [[0, 1], [0, 0]],
        [[0, 0], [1, 1]],
        [[1, 0], [1, 0], [0, 1]],
        np.zeros((3, 2)),
        inputs=["f", "u"],
        outputs=["z", "y", "v"],
    )
    plant = StandardPlant.from_statespace(mass, u=["u"], y=["y", "v"])
    loop = close_loop(
        plant, StateSpace([], [], [], [[-9.0, -0.6]], inputs=["y", "v"], outputs=["u"])
    )
    # s^2 + 0.6 s + 9: real part -0.3
    assert loop.spectral_abscissa == pytest.approx(-0.3, rel=1e-12)
    assert loop.is_stable
    with pytest.raises(ModelError, match="spectral_abscissa"):
        _ = loop.spectral_radius


@pytest.mark.slow
@given(st.lists(st.floats(0.1, 1.0), min_size=1, max_size=4), st.integers(0, 3))
def test_closed_form_of_a_chain_of_gains(gains, seed):
    """u = (prod gains) y through blocks in any order."""
    rng = np.random.default_rng(seed)
    names = ["y", *(f"v{i}" for i in range(1, len(gains))), "u"]
    parts = [
        StateSpace([], [], [], [[g]], inputs=[names[i]], outputs=[names[i + 1]])
        for i, g in enumerate(gains)
    ]
    plant = StandardPlant.from_statespace(
        StateSpace(
            [[0.0]], [[1.0, -0.5]], [[1.0], [1.0]], np.zeros((2, 2)), 1.0,
            inputs=["w", "u"], outputs=["z", "y"],
        ),
        u=["u"],
        y=["y"],
    )  # fmt: skip
    loop = close_loop(plant, *[parts[i] for i in rng.permutation(len(parts))])
    assert loop.spectral_radius == pytest.approx(0.5 * np.prod(gains), rel=1e-12)
    assert loop.watched == () if len(gains) == 1 else set(loop.watched) == set(names[1:-1])


def test_saved_and_loaded(loop, tmp_path):
    loop.save(tmp_path / "loop.npz")
    again = load(tmp_path / "loop.npz")
    assert isinstance(again, ClosedLoop)
    np.testing.assert_array_equal(again.monitored.A, loop.monitored.A)


def test_repr_is_short(loop):
    assert repr(loop).splitlines() == [
        "<ClosedLoop: plant 10 states, controller 2 states, dt 0.0005 s>",
        f"  stable: spectral radius {loop.spectral_radius:.9g}, modulus margin 0.586",
        "  driven: u1 u2",
        "  monitored: die:hat",
        "  not judged on a larger model",
        "  not judged on a measurement",
    ]


@pytest.mark.parametrize(
    ("blocks", "error", "message"),
    [
        (list, ModelError, "at least one block"),
        (lambda: [np.eye(2)], ModelError, "named channels"),
        (lambda: [stage()], ModelError, "block 1 is a StandardPlant"),
        (lambda: [servo()], LabelError, r"no signal 'die:hat'.*'die:ref'.*the observer too"),
        (
            lambda: [servo().renamed(inputs={"die:hat": "die:z"})],
            LabelError,
            "which is not measured",
        ),
        (lambda: [observer()], LabelError, "nothing drives actuator 'u1'"),
        (
            lambda: [observer(), servo(), observer()],
            LabelError,
            "'die:hat' is an output of 2 blocks",
        ),
        (
            lambda: [observer().renamed(outputs={"die:hat": "y1"}), servo()],
            LabelError,
            "'y1', which is already in the plant's y",
        ),
        (lambda: [observer(), servo(), servo()], ModelError, "blocks 2 and 3 are the same system"),
        (lambda: [observer(dt=1e-3), servo()], ModelError, "block 1 .* dt 0.001 s"),
        (lambda: [observer().replace(dt=0.0), servo()], ModelError, "0 is continuous"),
    ],
)
def test_wrong_connections_are_refused(blocks, error, message):
    with pytest.raises(error, match=message):
        close_loop(stage(), *blocks())


def test_a_loop_whose_actuators_all_rest():
    assert "driven: \n" in f"{close_loop(stage(), observer(), idle=['u1', 'u2'])}\n"


def test_idle_must_be_true():
    with pytest.raises(LabelError, match="cannot be idle"):
        close_loop(stage(), observer(), servo(), idle="u1")
    with pytest.raises(LabelError, match="actuator to leave idle 'u9'"):
        close_loop(stage(), observer(), servo(), idle=["u9"])


def test_a_system_whose_names_do_not_tell_cannot_be_closed():
    plain = stage().system.renamed(outputs={"u1:effort": "force1", "u2:effort": "force2"})
    with pytest.raises(LabelError, match="from_statespace"):
        close_loop(plain, observer(), servo())


def test_the_recursion_itself(loop):
    """The lft's impulse responses against the loop run by hand, sample by sample."""
    for name in loop.plant.w:
        impulse = np.zeros(60)
        impulse[0] = 1.0
        by_hand = oracle.run_sample_by_sample(
            matrices(loop.plant), [block(b) for b in loop.blocks], {name: impulse}
        )
        g = loop.monitored
        x, column = g.B[:, g.inputs.index(name)], g.inputs.index(name)
        rows = [g.D[:, column]]
        for _ in range(59):
            rows.append(g.C @ x)
            x = g.A @ x
        for i, output in enumerate(g.outputs):
            np.testing.assert_allclose(
                np.array(rows)[:, i],
                by_hand[output],
                rtol=1e-8,
                atol=1e-12 * np.abs(by_hand[output]).max(initial=1e-300),
            )


def test_frequency_response_by_structure_equals_the_closed_system(loop):
    # oracle: C (zI - A)^-1 B + D of the closed loop as one dense system
    freq = np.geomspace(1.0, 0.49 * RATE, 50)
    found = loop.frequency_response(freq)
    g = loop.system
    z = np.exp(2j * np.pi * freq * DT)
    dense = np.array(
        [g.C @ np.linalg.solve(x * np.eye(g.n_states) - g.A, g.B) + g.D for x in z]
    ).transpose(1, 2, 0)
    assert (tuple(found.inputs), tuple(found.outputs)) == (loop.plant.w, loop.plant.z)
    np.testing.assert_allclose(found.data, dense, rtol=1e-7, atol=1e-9 * np.abs(dense).max())


def test_a_plant_of_python_control_with_our_names_closes_the_same_loop():
    """Names tell w, u, z and y; a system whose names do not is refused with the line to type."""
    plant = sampled(reduced())
    twin = plant.to_control()
    again = StandardPlant.from_statespace(twin)
    assert (again.w, again.u, again.z, again.y) == (plant.w, plant.u, plant.z, plant.y)
    blocks = design_static(plant), design_servo(plant, bandwidth=30.0)
    ours, theirs = close_loop(plant, *blocks), close_loop(twin, *blocks)
    assert theirs.system.inputs == ours.system.inputs
    assert theirs.modulus_margin == pytest.approx(ours.modulus_margin, rel=1e-6)
    for system in (
        twin[:3, :],  # no efforts: what are actuators?
        plant.system.select(inputs=plant.w),
        plant.system.renamed(outputs={plant.y[0]: "y1:measured"}),
    ):
        with pytest.raises(LabelError, match=r"from_statespace\(sys, w="):
            close_loop(system, *blocks)
    with pytest.raises(LabelError, match="name both u and y"):
        StandardPlant.from_statespace(twin, u=plant.u)
    with pytest.raises(ModelError, match="need a StandardPlant, got 3"):
        close_loop(3, *blocks)


def test_a_command_without_feedback_keeps_the_whole_margin():
    plant = stage(delay=1.0)
    plant = plant.replace(system=plant.system.replace(A=0.9 * plant.system.A))
    ahead = StateSpace([], [], [], [[2.0], [2.0]], inputs=["die:ref"], outputs=["u1", "u2"])
    loop = close_loop(plant, ahead)
    assert loop.modulus_margin == pytest.approx(1.0, rel=1e-12)
    assert "modulus margin 1\n" in repr(loop)


def test_a_reference_that_nothing_follows_is_named():
    plant = fx.testbeds.three_masses()
    sensors = [name for name in plant.y if name not in plant.w]
    blind = plant.system.select([*plant.z, *sensors], [*plant.w, *plant.u])
    own = fx.StandardPlant.from_statespace(blind, u=plant.u, y=sensors)
    loop = fx.close_loop(plant, fx.design_h2(own.weighted(z={"u1:effort": 1e-6})))
    assert "\n  references that no block reads: die:ref" in repr(loop)
    followed = fx.close_loop(plant, fx.design_h2(plant.weighted(z={"u1:effort": 1e-6})))
    assert "no block reads" not in repr(followed)


@pytest.mark.filterwarnings("ignore:the closed loop is unstable")
@pytest.mark.parametrize("dt", [0.0, fx.testbeds.three_masses().dt])
def test_poles_on_machines_follow_from_those_of_the_loop(dt):
    """As the eigenvalues, also where a machine is unstable; none is followed to another plant."""
    plant = fx.testbeds.three_masses()
    plant = plant if dt else plant.continuous
    pole = np.exp(-500.0 * dt) if dt else -500.0
    lead = StateSpace([[pole]], [[1.0]], [[900.0]], [[-2.0]], dt, inputs=["y1"], outputs=["u1"])
    machines = plant.uncertain(frequency=0.05, damping=0.3).machines.drawn(3, rng=1)
    for gain in (1e2, 1e6):
        loop = close_loop(plant, lead.replace(C=gain * lead.C, D=gain * lead.D))
        for machine in machines:
            other = loop.around(machine)
            found, wanted = moved_poles(loop, other), other.poles()
            apart = np.abs(found[:, None] - wanted) / np.abs(wanted).max()
            assert max(apart.min(axis=0).max(), apart.min(axis=1).max()) < 1e-6
    later = plant.continuous.discretized(1e3, delay=3.0)
    assert moved_poles(loop, ClosedLoop(later, loop.blocks, loop.controller)) is None


@pytest.mark.filterwarnings("ignore:the closed loop is unstable")
@pytest.mark.parametrize(("law", "omega"), [
    ((-50.0, -20.0, 0.999), 120.0), ((-364.5, 1.98898, 0.999558729), 96.55),
    ((-50.0, -20.0, -3.0), 120.0),
])  # fmt: skip
def test_poles_on_machines_with_feedthrough_of_plant_and_law(law, omega):
    """An accelerometer and a law whose D cancel nearly: the eigenvalues, or no proof."""

    def machine(omega):
        A = np.array([[0.0, 1.0], [-(omega**2), -0.02 * omega]])
        B, C, D = [[0.0, 0.0], [1.0, 1.0]], np.vstack([[1.0, 0.0], A[1]]), [[0, 0], [1.0, 1.0]]
        g = StateSpace(A, B, C, D, inputs=["w", "u"], outputs=["z", "y"])
        return StandardPlant.from_statespace(g, u=["u"], y=["y"])

    a, c, d = law
    loop = close_loop(
        machine(100.0), StateSpace([[a]], [[1.0]], [[c]], [[d]], inputs=["y"], outputs=["u"])
    )
    other = loop.around(machine(omega))
    found, wanted = moved_poles(loop, other), other.poles()
    if found is not None:
        apart = np.abs(found[:, None] - wanted)
        assert np.all(apart.min(axis=0) <= 0.01 * np.abs(wanted.real))
    assert found is not None or d > 0
