"""The assumption report beyond the rigid body: elastic modes, weights, invariant zeros."""

from time import perf_counter

import numpy as np
import pytest

from flexplant import DofSet
from flexplant.errors import AssumptionError, LabelError
from flexplant.estimation import design_kalman
from flexplant.lti import StateSpace, low_pass_filter
from flexplant.lti.zeros import axis_zeros
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Sensor, StandardPlant, assemble_plant
from flexplant.structure import FEModel, ModalDamping, kirchhoff_plate
from flexplant.synthesis import design_hinf
from stages import CORNERS, RATE, L, ports, reduced, some_modes

MIDDLE = [(0.1, L / 2, 0.0), (0.3, L / 2, 0.0), (0.5, L / 2, 0.0)]
KEYS = ["excited", "detectable", "performance", "stabilisable", "D12", "D21", "P12", "P21"]


def chain(masses=(1.0, 1.0, 1.0), *, ground=4.0, damping=0.0):
    """Masses in a row on springs, the first to the ground when asked."""
    n = len(masses)
    K = np.diag([ground, *[0.0] * (n - 1)])
    for i in range(n - 1):
        K[i : i + 2, i : i + 2] += 100.0 * np.array([[1, -1], [-1, 1]])
    xyz = np.column_stack([np.arange(n), np.zeros((n, 2))])
    dofs = DofSet(range(1, n + 1), ["z"] * n, xyz)
    return FEModel(np.diag(masses), K, damping * K if damping else None, dofs=dofs)


def line(u="1:z", y="1:z", z="3:z", w="1:z", **more):
    return Ports(
        w=[Disturbance("push", at=w, asd=1.0)],
        u=[Actuator("u", at=u)],
        z=[Poi("tip", at=z)],
        y=[Sensor("y", at=y, asd=1e-3, **more)],
    )


def frequencies(model):
    return np.sqrt(np.linalg.eigvals(np.linalg.solve(model.M, model.K)).real)


def test_undamped_modes_of_a_held_structure_count_too():
    """Mode 2 of a free symmetric chain has a node in its middle: nothing there touches it."""
    free = chain(ground=0.0)
    swing = np.sort(frequencies(free))[1] / (2 * np.pi)
    bad = {"excited": "w", "detectable": "y", "performance": "z", "stabilisable": "u"}
    verbs = {
        "w": "does not excite",
        "y": "does not see",
        "z": "does not see",
        "u": "does not reach",
    }
    for key, side in bad.items():
        found = assemble_plant(free, line(**{side: "2:z"})).check()
        assert not found[key].holds, key
        assert f"{side} {verbs[side]} mode 2 ({swing:.4g} Hz), which does not decay" in (
            found[key].finding
        )
        assert "model.with_damping(...)" in found[key].remedy
        for other in set(bad) - {key}:
            assert found[other].holds, (key, other)
    everywhere = assemble_plant(free, line()).check()
    assert all(everywhere[key].holds for key in bad)
    named = f"the rigid-body mode and 2 undamped modes at {swing:.4g} to "
    assert named in everywhere["excited"].finding
    # a little damping makes it information: the mode decays by itself
    damped = assemble_plant(chain(ground=0.0, damping=1e-5), line(y="2:z")).check()
    assert damped["detectable"].holds
    assert damped.modes[0].shares["y"] < 1e-12


def test_a_kalman_filter_needs_what_the_report_says():
    plant = assemble_plant(chain(ground=0.0), line(y="2:z")).discretized(100.0, delay=1)
    with pytest.raises(
        AssumptionError, match=r"y does not see mode 2.*Add or move a displ"
    ) as info:
        design_kalman(plant)
    said = str(info.value).splitlines()
    assert said[1] == "The plant's assumptions:"
    assert [text.split(":")[0].split()[-1] for text in said[2:]] == KEYS[:6]
    assert [text.split()[0] for text in said[2:]] == ["yes", "NO", "yes", "yes", "yes", "yes"]
    seen = assemble_plant(chain(ground=0.0), line()).discretized(100.0, delay=1)
    assert design_kalman(seen).certificate["spectral radius"] < 1


def test_hinf_fails_with_the_report():
    u = [Actuator(f"u{i}", at=p) for i, p in enumerate(MIDDLE)]
    plant = assemble_plant(some_modes(), ports(u=u))
    with pytest.raises(AssumptionError, match=r"H-infinity.*rotation rx") as info:
        design_hinf(plant.weighted(z={"die:z": 1e6}))
    assert "  NO  stabilisable: as said." in str(info.value)
    assert str(info.value).count("u does not reach the rigid-body rotation rx") == 1
    assert "  yes detectable" in str(info.value)


def test_every_elastic_mode_is_reported_with_its_best_channel():
    modes = some_modes()
    plant = assemble_plant(modes, ports())
    report = plant.check().modes
    assert [mode.mode for mode in report] == list(range(4, 25))
    np.testing.assert_allclose([mode.freq for mode in report], modes.freq[3:], rtol=1e-9)
    np.testing.assert_allclose([mode.zeta for mode in report], 0.01, rtol=1e-9)
    shapes = {
        "u": np.abs([modes.at(p.at)[3:] for p in ports().u]),
        "y": np.abs([modes.at(p.at)[3:] for p in ports().y]),
        "z": np.abs([modes.at(ports().z[0].at, axis)[3:] for axis in ("z", "rx", "ry")]),
    }
    for side, rows in shapes.items():
        # beside the strongest mode of each channel
        share = rows / np.array([row.max() for row in rows])[:, None]
        found = np.array([mode.shares[side] for mode in report])
        np.testing.assert_allclose(found, share.max(axis=0), rtol=1e-6, atol=1e-9)
    names = {"u": [p.name for p in ports().u], "y": [p.name for p in ports().y]}
    clear = 0
    for side in names:
        share = shapes[side] / shapes[side].max(axis=1, keepdims=True)
        for k, mode in enumerate(report):
            first, second = np.sort(share[:, k])[[-1, -2]]
            if first > 1.01 * second:
                clear += 1
                assert mode.channels[side] == names[side][int(np.argmax(share[:, k]))]
    sampled = plant.discretized(RATE, delay=1).check().modes
    assert [mode.shares["u"] for mode in sampled] == [mode.shares["u"] for mode in report]


@pytest.mark.parametrize("quantity", ["displacement", "velocity", "acceleration"])
def test_what_a_sensor_measures_does_not_change_how_well_it_sees(quantity):
    y = [Sensor("y1", at=(0.11, 0.0, 0.0), quantity=quantity), Sensor("y2", at=CORNERS[1])]
    report = assemble_plant(some_modes(), ports(y=y[:1])).check().modes
    row = np.abs(some_modes().at(y[0].at)[3:])
    found = [mode.shares["y"] for mode in report]
    np.testing.assert_allclose(found, row / row.max(), rtol=1e-6, atol=1e-9)


def test_dynamics_of_ports_count_at_the_mode():
    """An actuator and a sensor that roll off reach and see a mode by their gain at its pole."""
    modes = some_modes()
    u, y = (
        ports().u[0].replace(dynamics=low_pass_filter(300.0)),
        ports().y[0].replace(dynamics=lag(500.0)),
    )
    plant = assemble_plant(modes, ports(u=[u], y=[y]))
    poles = modes.poles[3:]
    H = {"u": low_pass_filter(300.0), "y": lag(500.0)}
    for side, port in (("u", u), ("y", y)):
        gain = [abs(H[side].evaluated(pole)[0, 0]) for pole in poles]
        share = np.abs(modes.at(port.at)[3:]) * gain
        found = [mode.shares[side] for mode in plant.check().modes]
        np.testing.assert_allclose(found, share / share.max(), rtol=1e-6, atol=1e-9)
    assert not plant.check()["detectable"].holds  # one sensor, three rigid-body modes
    assert "rotation rx" in plant.check()["detectable"].finding
    both = ports(u=[p.replace(dynamics=low_pass_filter(300.0)) for p in ports().u],
                 y=[p.replace(dynamics=lag(500.0)) for p in ports().y])  # fmt: skip
    full = assemble_plant(modes, both).check()
    assert all(full[key].holds for key in KEYS[:4])
    line_of_three = [Actuator(f"u{i}", at=p, dynamics=lag(400.0)) for i, p in enumerate(MIDDLE)]
    text = assemble_plant(modes, ports(u=line_of_three)).check()["stabilisable"].finding
    assert text.startswith("u does not reach the rigid-body rotation rx (channels")


def lag(hz):
    corner = 2 * np.pi * hz
    return StateSpace([[-corner]], [[corner]], [[1.0]], [[0.0]])


def test_weak_modes_are_noted_in_words():
    model = chain((1.0, 1.0, 1.0), ground=0.0, damping=1e-4)
    report = assemble_plant(model, line(y="2:z")).check()
    (swing,) = report.modes[0].weak
    hz = np.sort(frequencies(model))[1] / (2 * np.pi)
    assert swing.startswith(f"y sees mode 2 ({hz:.4g} Hz, damping ")
    assert swing.endswith("nowhere: it has a node at every channel.")
    assert f"  note {swing}" in repr(report)
    lopsided = chain((1.0, 1.0, 1.005), ground=0.0, damping=1e-4)
    (text,) = assemble_plant(lopsided, line(y="2:z")).check().modes[0].weak
    assert "% of its strongest mode (best: y)." in text
    assert assemble_plant(chain(damping=1e-4), line()).check().modes[0].weak == ()
    assert StandardPlant.from_statespace(pd_plant(), u=["u"], y=["y"]).check().modes == ()


def test_weights_must_decay():
    plant = assemble_plant(some_modes(), ports())
    integrator = StateSpace([[0.0]], [[1.0]], [[1.0]], [[0.0]])
    found = plant.weighted(z={"die:error": integrator}).check()
    assert not found["detectable"].holds
    assert "y does not see the weight of die:error, which does not decay" in (
        found["detectable"].finding
    )
    assert found["stabilisable"].holds
    found = plant.weighted(w={"amp2": integrator}).check()
    assert not found["stabilisable"].holds
    assert "the weight of amp2" in found["stabilisable"].finding
    lag = StateSpace([[-1e-3]], [[1.0]], [[1.0]], [[0.0]])
    assert plant.weighted(z={"die:error": lag}, w={"amp2": lag}).check()["detectable"].holds
    sampled = plant.discretized(RATE, delay=1)
    held = StateSpace([[1.0]], [[1.0]], [[1.0]], [[0.0]], 1 / RATE)
    assert not sampled.weighted(z={"die:z": held}).check()["detectable"].holds
    assert sampled.weighted(z={"die:z": held.replace(A=[[0.999]])}).check()["detectable"].holds


def pd_plant(A=((0.0, 1.0), (-4.0, 0.0)), z=(1.0, 0.0), w=(0.0, 1.0), dt=0.0, *, noise=1.0):
    """An oscillator with z, effort and a noisy y."""
    return StateSpace(
        A,
        np.array([[w[0], 0.0, 0.0], [w[1], 0.0, 1.0]]),
        [z, [0.0, 0.0], [1.0, 0.5]],
        [[0, 0, 0], [0, 0, 1.0], [0, noise, 0]],
        dt,
        inputs=["w", "noise", "u"],
        outputs=["z", "effort", "y"],
    )


def test_an_undamped_mode_that_z_does_not_see_is_a_zero_on_the_axis():
    """With its effort in z, u -> z has zeros where A has poles that z misses: at 2 rad/s."""
    good = StandardPlant.from_statespace(pd_plant(), u=["u"], y=["y"]).check()
    assert good.ok
    blind = StandardPlant.from_statespace(pd_plant(z=(0.0, 0.0)), u=["u"], y=["y"]).check()
    assert blind["D12"].holds
    assert not blind["P12"].holds
    assert f"at {2 / (2 * np.pi):.4g} Hz" in blind["P12"].finding
    assert "z that sees it" in blind["P12"].remedy
    quiet = StandardPlant.from_statespace(pd_plant(w=(0.0, 0.0)), u=["u"], y=["y"]).check()
    assert quiet["D21"].holds
    assert quiet["P12"].holds
    assert not quiet["P21"].holds
    assert "w -> y has an invariant zero" in quiet["P21"].finding
    damped = ((0.0, 1.0), (-4.0, -1e-3))
    for changes in ({"z": (0.0, 0.0)}, {"w": (0.0, 0.0)}):
        g = pd_plant(A=damped, **changes)
        assert StandardPlant.from_statespace(g, u=["u"], y=["y"]).check().ok
    with pytest.raises(AssumptionError, match=r"anything is not possible.*0\.3183 Hz"):
        blind.require(("P12",), "anything")
    blind.require(("D12", "P21"), "anything")


def test_a_zero_belongs_to_a_mode_or_to_the_rigid_body():
    free = chain(ground=0.0)
    found = assemble_plant(free, line(z="2:z")).check()
    hz = np.sort(frequencies(free))[1] / (2 * np.pi)
    assert f"at {hz:.4g} Hz (mode 2)" in found["P12"].finding
    found = assemble_plant(free, line(w="2:z")).check()
    assert f"at {hz:.4g} Hz (mode 2)" in found["P21"].finding
    plate = assemble_plant(some_modes(), ports(z=[Poi("die", at=(L / 2, L / 2, 0.0))]))
    for plant in (plate, plate.discretized(RATE, delay=1)):
        text = plant.check()["P12"].finding
        assert "at zero frequency (a rigid-body motion" in text
        assert plant.check()["P21"].holds


@pytest.mark.parametrize("dt", [0.0, 0.01])
@pytest.mark.parametrize(("p", "m"), [(2, 2), (3, 2), (4, 1)])
@pytest.mark.parametrize("on", [True, False])
def test_zeros_that_were_built_in(dt, p, m, on):
    """A state that feedback of the input hides: zeros at s0 of a random system, any feedthrough.

    A v = s0 v - B f and C v = -D f for some complex v and f (A, C at random elsewhere): then
    [A - s0, B; C, D] has the null vector [v; f] at s0.
    """
    rng = np.random.default_rng(100 * p + m)
    n = 7
    s0 = np.exp(0.3j) if dt else 40j
    if not on:
        s0 = s0 * 0.99 if dt else s0 - 0.4
    D = rng.standard_normal((p, m))
    v = rng.standard_normal(n) + 1j * rng.standard_normal(n)
    f = rng.standard_normal(m) + 1j * rng.standard_normal(m)
    real = np.column_stack([v.real, v.imag])
    pin = np.linalg.pinv(real)
    want = s0 * v
    B = 30.0 * rng.standard_normal((n, m))
    drive = np.column_stack([(want - B @ f).real, (want - B @ f).imag])
    miss = np.eye(n) - real @ pin
    A = drive @ pin + (5.0 * rng.standard_normal((n, n))) @ miss
    C = -D @ np.column_stack([f.real, f.imag]) @ pin + rng.standard_normal((p, n)) @ miss
    g = StateSpace(A, B, C, D, dt)
    assert np.abs((A - s0 * np.eye(n)) @ v + B @ f).max() < 1e-10 * np.abs(A).max()
    assert np.abs(C @ v + D @ f).max() < 1e-10
    found = axis_zeros(g)
    if on:
        assert np.min(np.abs(found - s0)) < 1e-6 * abs(s0)
    else:
        assert not found.size or np.min(np.abs(found - s0)) > 1e-3 * abs(s0)


def test_a_double_zero_at_the_origin_in_any_coordinates():
    """A free mass that z does not see, its states mixed with those of an oscillator."""
    A = np.zeros((4, 4))
    A[0, 1] = 1.0
    A[2:, 2:] = [[0.0, 30.0], [-30.0, -1.0]]
    B, C = np.array([[0.0], [1.0], [0.0], [1.0]]), np.array([[0, 0, 1.0, 0], [0, 0, 0, 0]])
    Q = np.linalg.qr(np.random.default_rng(6).standard_normal((4, 4)))[0]
    for seen in (0.0, 1e-2):
        C[0, 0] = seen
        g = StateSpace(Q @ A @ Q.T, Q @ B, C @ Q.T, [[0.0], [1.0]])
        found = axis_zeros(g)
        assert found.size == (1 if seen == 0.0 else 0)
        assert np.all(np.abs(found) < 1e-4)


def test_units_do_not_move_zeros():
    for scale in (1e-9, 1.0, 1e9):
        g = pd_plant(z=(0.0, 0.0)).select(["z", "effort"], ["u"])
        scaled = g.replace(B=g.B * scale, D=g.D * scale * 1e3, C=g.C * 1e3)
        np.testing.assert_allclose(axis_zeros(scaled), [2j], rtol=1e-9)


def test_too_few_channels():
    g = pd_plant().select(["z", "y"], ["w", "noise", "u"])
    two = StateSpace(
        g.A, np.column_stack([g.B, g.B[:, -1]]), g.C, np.zeros((2, 4)),
        inputs=["w", "noise", "u", "u2"], outputs=["z", "y"],
    )  # fmt: skip
    found = StandardPlant.from_statespace(two, u=["u", "u2"], y=["y"]).check()
    assert "P12 has 2 inputs u and 1 outputs z" in found["P12"].finding
    assert not found["P12"].holds


def test_asking_for_an_unknown_assumption():
    with pytest.raises(LabelError, match=r"no assumption 'D13'.*'D12'"):
        StandardPlant.from_statespace(pd_plant(), u=["u"], y=["y"]).check()["D13"]


def test_a_check_costs_milliseconds():
    """What every design asks: 3 ms for 50 states here; the bound leaves room for slow machines."""
    plant = assemble_plant(reduced(), ports()).discretized(RATE, delay=1)
    best = np.inf
    for _ in range(5):
        start = perf_counter()
        plant.check().require(("excited", "detectable", "stabilisable", "performance"), "it")
        best = min(best, perf_counter() - start)
    assert best < 0.03


@pytest.mark.parametrize("quantity", ["displacement", "acceleration"])
@pytest.mark.parametrize("where", ["sensor", "actuator", "both"])
def test_a_filter_of_large_rows_hides_no_rigid_body(quantity, where):
    """A filter that reads accelerations has rows of A far above those of the modes.

    The plate is free, its four corners push and measure: everything is reached and seen.
    """
    lag = low_pass_filter(2000.0, order=2)
    own = ports()
    at_y = lag if where != "actuator" else None
    at_u = lag if where != "sensor" else None
    sensor = Sensor("extra", at=(0.3, 0.1, 0.0), quantity=quantity, asd=1e-5, dynamics=at_y)
    moved = own.replace(
        y=[*own.y, sensor], u=[actuator.replace(dynamics=at_u) for actuator in own.u]
    )
    model = kirchhoff_plate(
        size=(L, L), thickness=0.0272, elements=(4, 4), density=2702.0,
        youngs_modulus=70e9, poisson_ratio=0.35,
    ).with_damping(ModalDamping(0.001))  # fmt: skip
    plant = assemble_plant(model, moved)
    for key in ("detectable", "performance", "stabilisable"):
        item = plant.check()[key]
        assert item.holds, item
        assert item.finding.startswith("all 3 rigid-body modes, by")
    # and a sensor that sees nothing of them is still found out
    blind = moved.replace(y=[sensor], references=())
    assert not assemble_plant(model, blind).check()["detectable"].holds
