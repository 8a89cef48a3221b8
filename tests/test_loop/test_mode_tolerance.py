"""How far each mode may be off: eigenvalues of loops assembled by hand are the judge."""

import warnings
from functools import cache

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx
from flexplant.errors import AssumptionError, FlexplantWarning, ModelError
from flexplant.loop.modal_tolerances import mode_tolerances
from flexplant.plant.uncertainty.delta import with_changes
from flexplant.plant.uncertainty.mode_delta import FrequencyDelta
from stages import RATE, ports, sampled, some_modes

ZETA, COUNT = 1e-3, 15


@cache
def plant():
    return sampled(some_modes(ZETA, COUNT, attached=False), ports(asd=1e-2))


@cache
def loop(bandwidth=90.0):
    """A loop of high gain at modes of 0.1 % damping, designed as if their frequencies were sure."""
    P, errors = plant(), fx.reference_errors(plant())
    weights = fx.stage_weights(P, bandwidth)
    controller = fx.design_hinf(P.through(errors).weighted(z=weights.z, w=weights.w))
    return fx.close_loop(P, fx.lti.series(errors, controller.system).replace(name="all"))


@cache
def tolerances():
    return loop().mode_tolerances()


def changed(mode, freq=0.0, damping=0.0):
    """A of the closed loop with one mode changed, and what S at u is made of: all by hand.

    The two states of a mode are its position and speed; u is held and one sample late.
    """
    g = plant().continuous.system
    A = g.A.copy()
    own = [g.states.index(f"mode{mode}:{part}") for part in "qv"]
    A[own[1], own[0]] *= (1.0 + freq) ** 2  # its stiffness: the damping force stays
    A[own[1], own[1]] *= 1.0 + damping
    return closed_by_hand(A)


def closed_by_hand(A):
    """A of the closed loop with the plant's A given, and what S at u is made of."""
    g = plant().continuous.system
    B = g.B[:, g.input_index(plant().u)]
    C = g.C[g.output_index(plant().y)]
    n, m = B.shape
    both = la.expm(np.block([[A, B], [np.zeros((m, n + m))]]) / RATE)
    late = np.block([[both[:n]], [np.zeros((m, n + m))]])
    F, G = late, np.vstack([np.zeros((n, m)), np.eye(m)])
    H = np.hstack([C, np.zeros((len(C), m))])
    (block,) = loop().blocks
    K = {name: getattr(block.select(plant().u, plant().y), name) for name in "ABCD"}
    closed = np.block([[F + G @ K["D"] @ H, G @ K["C"]], [K["B"] @ H, K["A"]]])
    return closed, (F, G, H), K


def radius(mode, **change):
    return np.abs(np.linalg.eigvals(changed(mode, **change)[0])).max()


def closed_radius(A):
    return np.abs(np.linalg.eigvals(closed_by_hand(A)[0])).max()


def margin(mode, change, around):
    """The modulus margin at u within 5 % of a frequency [Hz], the lowest place halved in."""
    _, (F, G, H), K = changed(mode, freq=change)

    def size(f):
        z = np.exp(2j * np.pi * f / RATE)
        P = H @ np.linalg.solve(z * np.eye(len(F)) - F, G)
        C = K["C"] @ np.linalg.solve(z * np.eye(len(K["A"])) - K["A"], K["B"]) + K["D"]
        return la.svdvals(np.eye(G.shape[1]) - C @ P)[-1]

    freq = np.linspace(0.95, 1.05, 1001) * around
    for _ in range(2):
        sizes = [size(f) for f in freq]
        k = int(np.argmin(sizes))
        freq = np.linspace(freq[max(k - 1, 0)], freq[min(k + 1, freq.size - 1)], 31)
    return min(sizes)


@pytest.mark.slow
def test_the_loop_by_hand_is_the_loop():
    assert radius(4) == pytest.approx(np.abs(loop().poles()).max(), abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["freq", "damping"])
def test_a_pole_crosses_the_boundary_at_each_tolerance_and_not_before(kind):
    found = tolerances()
    ends = found.stable if kind == "freq" else found.damping
    where = np.argwhere(np.isfinite(ends))
    assert len(where) >= (4 if kind == "freq" else 0)
    for row, side in where:
        mode, change = int(found.modes[row]), ends[row, side]
        assert np.sign(change) == (-1, 1)[side]
        assert radius(mode, **{kind: 0.99 * change}) < 1.0 < radius(mode, **{kind: 1.01 * change})


def test_a_mode_without_a_tolerance_may_be_anywhere_in_the_range():
    found = tolerances()
    free = [i for i in range(found.modes.size) if not np.isfinite(found.stable[i]).any()]
    assert free
    for row in free[:3]:
        for change in np.linspace(-1.0, 1.0, 21) * found.limit[row]:
            assert radius(int(found.modes[row]), freq=change) < 1.0


@pytest.mark.slow
def test_the_margin_falls_to_what_was_stated():
    found = tolerances()
    for row in np.argsort(found.least)[:3]:
        ends = found.within[row]
        assert np.isfinite(ends).all()
        for change in ends:
            least = margin(int(found.modes[row]), change, found.freq[row] * (1.0 + change))
            assert least == pytest.approx(0.35, rel=0.01)


@pytest.mark.slow
def test_a_loop_below_the_margin_without_a_change_is_judged_on_stability():
    one = loop()
    below = mode_tolerances(one.plant, one.broken, margin=0.9)
    assert one.modulus_margin < 0.9 and not np.any(below.within)
    np.testing.assert_array_equal(below.least, np.abs(tolerances().stable).min(axis=1))
    assert below.summary.startswith("the modulus margin is below 0.9, mode ")
    assert "+0 %" not in below.summary and "instability" in below.summary


@pytest.mark.slow
def test_what_is_known_of_a_mode_stands_beside_its_tolerance():
    found = tolerances()
    worst = int(np.argmin(found.least))
    mode = int(found.modes[worst])
    with pytest.warns(FlexplantWarning, match=f"mode {mode} .* tolerates .* known to 1 %"):
        beside = loop().mode_tolerances(known=plant().uncertain(frequency={mode: 0.01}))
    assert beside.critical == (mode,)
    assert "known to" in repr(beside) and "!" in repr(beside)
    assert "known to" not in repr(found)  # a column of nothing is left out
    np.testing.assert_array_equal(beside.stable, found.stable)
    assert loop().mode_tolerances(known=1e-7).critical == ()
    assert str(mode) in found.summary and "leads to" in found.summary


@pytest.mark.slow
def test_a_loop_that_tolerates_all_says_so():
    observer = fx.design_kalman(plant())
    servo = fx.design_servo(plant(), bandwidth=5.0, observer=observer)
    found = fx.close_loop(plant(), observer, servo).mode_tolerances(known=0.01)
    assert found.critical == ()
    assert "stays stable" in found.summary


def test_modes_that_are_named_are_examined_up_to_limits_of_their_own():
    every, one = tolerances(), loop()
    worst = every.modes[np.argsort(every.least)[:3]]
    limits = {int(mode): 0.05 if mode == worst[0] else 1e-3 for mode in worst}
    found = mode_tolerances(one.plant, one.broken, margin=every.margin, limit=limits)
    row = np.searchsorted(every.modes, found.modes)
    np.testing.assert_array_equal(found.modes, np.sort(worst))
    for got, wanted in ((found.stable, every.stable[row]), (found.within, every.within[row])):
        limit = np.tile(found.limit[:, None], (1, 2))
        near = np.abs(wanted) < limit
        np.testing.assert_allclose(got[near], wanted[near], rtol=1e-2)
        assert np.all(
            np.abs(got[~near]) > 0.99 * np.broadcast_to(found.limit[:, None], got.shape)[~near]
        )
    none = mode_tolerances(one.plant, one.broken, margin=every.margin, limit={99: 0.01})
    assert not none.modes.size


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["stable", "within"])
def test_a_tolerance_just_inside_of_the_limit_is_found(kind):
    """A limit that is 0.5 % above a tolerance finds what wide limits found."""
    every, one, slack = tolerances(), loop(), 1.005
    wanted = getattr(every, kind)
    where = np.argwhere(np.isfinite(wanted) & (slack * np.abs(wanted) < every.limit[:, None]))
    assert len(where) >= 5
    for row, side in where:
        end = wanted[row, side]
        limit = {int(every.modes[row]): slack * abs(end)}
        found = mode_tolerances(one.plant, one.broken, margin=every.margin, limit=limit)
        assert getattr(found, kind)[0, side] == pytest.approx(end, rel=0.02)


def test_what_cannot_be_judged_is_refused():
    with pytest.raises(ModelError, match="below 1"):
        loop().mode_tolerances(margin=1.0)
    with pytest.raises(ModelError, match="known has the shape"):
        loop().mode_tolerances(known=[0.1, 0.2])
    (block,) = loop().blocks
    with pytest.warns(FlexplantWarning, match="unstable"):
        wild = fx.close_loop(plant(), block.replace(B=-block.B, D=-block.D))
    with pytest.raises(AssumptionError, match="modes have no tolerance"):
        wild.mode_tolerances()


@cache
def uncertain(share=0.001):
    return plant().uncertain(frequency=share)


def around(given):
    with pytest.warns(FlexplantWarning, match="is known to") as said:
        found = fx.close_loop(given, *loop().blocks)
    return found, str(said[0].message)


@pytest.mark.slow
def test_a_loop_on_an_uncertain_plant_says_what_its_modes_hold_to():
    found, said = around(uncertain())
    fragile = tolerances()
    worst = int(np.argmin(fragile.least))
    assert found.tolerances.least[worst] == pytest.approx(fragile.least[worst], rel=1e-3)
    mode, holds = fragile.modes[worst], 100 * fragile.least[worst]
    assert f"mode {mode} ({fragile.freq[worst]:.4g} Hz) tolerates {holds:.2g} %" in said
    certificate = found.tolerances.certificate
    assert certificate[f"mode {mode} holds to"] == pytest.approx(fragile.least[worst], rel=1e-3)
    assert certificate[f"mode {mode} known to"] == 0.001
    assert f"mode {mode} ({fragile.freq[worst]:.4g} Hz) shifted by " in repr(found)
    assert "(known to 0.1 %)" in repr(found)
    sure = loop().tolerances  # nothing was stated of that plant
    assert sure.known is None
    assert sure.least[worst] == pytest.approx(fragile.least[worst], rel=1e-3)
    assert f"mode {mode} ({fragile.freq[worst]:.4g} Hz) shifted by " in repr(loop())


def radius_around(machine):
    """Spectral radius of the loop's controller around another machine, from their matrices."""
    g, (block,) = machine.system, loop().blocks
    B, C = g.B[:, g.input_index(machine.u)], g.C[g.output_index(machine.y)]
    K = {name: getattr(block.select(machine.u, machine.y), name) for name in "ABCD"}
    closed = np.block([[g.A + B @ K["D"] @ C, B @ K["C"]], [K["B"] @ C, K["A"]]])
    return np.abs(np.linalg.eigvals(closed)).max()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the loop depends on")
def test_a_loop_says_on_how_many_machines_it_is_unstable():
    one = fx.close_loop(uncertain(0.002), *loop().blocks)
    count = sum(radius_around(machine) >= 1.0 for machine in one.plant.machines.plants)
    assert 0 < count < 40
    low, high, sentence = one.interval("modulus margin")
    assert (low, high) == (None, None)
    assert sentence == f"unstable on {count} of 40 such machines"
    assert sentence in repr(one)


@pytest.mark.slow
def test_designs_say_what_their_modes_hold_to():
    own = sampled(some_modes(ZETA, 6, attached=False), ports(asd=1e-2))
    P = own.uncertain(frequency=1e-4)
    observer = fx.design_static(P)
    servo = fx.design_servo(P, bandwidth=40.0, observer=observer)
    tuned = fx.design_loops(P, fx.Pid((2 * np.pi * 20.0) ** 2) * fx.Lead(20.0))
    for found, blocks in ((servo, (observer, servo)), (tuned, (tuned,))):
        alone = fx.close_loop(own, *blocks).mode_tolerances()
        assert found.tolerances.least.min() == pytest.approx(alone.least.min(), rel=1e-2)
        assert found.tolerances.summary in repr(found)


@cache
def of_both_kinds():
    """A loop around masses on springs, position and speed of one measured, 1.3 samples late."""
    model = fx.chain(masses=[1.0, 0.5, 0.3, 0.2], stiffnesses=[4e5, 3e5, 2e5])
    modes = fx.solve_modes(model, count=4, damping=fx.ModalDamping(0.004))
    first, last = modes.dofs.labels[0], modes.dofs.labels[-1]
    own = fx.Ports(
        w=[fx.Disturbance("w", at=first, asd=1e-2)],
        u=[fx.Actuator("u", at=first)],
        z=[fx.Poi("tip", at=last, axes=("x",))],
        y=[
            fx.Sensor("q", at=first, asd=1e-9),
            fx.Sensor("v", at=last, quantity="velocity", asd=1e-6),
        ],
    )
    sampled_plant = fx.assemble_plant(modes, own).discretized(4e3, delay=1.3)
    design = fx.design_h2(sampled_plant.weighted(z={"u:effort": 1e-6}))
    return fx.close_loop(sampled_plant, design)


@pytest.mark.slow
def test_positions_and_speeds_measured_together_a_fraction_of_a_sample_late():
    """Each machine is assembled and sampled anew: stable before, unstable behind a tolerance."""
    closed = of_both_kinds()
    found, seen = closed.mode_tolerances(), 0
    for row, mode in enumerate(found.modes.tolist()):
        for end in found.stable[row][np.isfinite(found.stable[row])]:
            seen += 1
            for part, holds in ((0.99, True), (1.01, False)):
                moved = [(FrequencyDelta.of(mode, 1.0), (1.0 + part * end) ** 2 - 1.0)]
                assert closed.around(with_changes(closed.plant, moved)).is_stable == holds
        for end in found.within[row][np.isfinite(found.within[row])]:
            seen += 1
            moved = [(FrequencyDelta.of(mode, 1.0), (1.0 + end) ** 2 - 1.0)]
            there = closed.around(with_changes(closed.plant, moved))
            assert not there.is_stable or there.modulus_margin == pytest.approx(0.35, rel=0.02)
    assert seen >= 3


LATE = {
    "a filter": [{"dynamics": fx.lti.low_pass_filter(2400.0)}],
    "a latency": [{"latency": 1e-6}],
    "more than a sample": [{"latency": 3.4e-4}],
    "one of two": [{}, {"latency": 3e-5}],
}


@pytest.mark.slow
@pytest.mark.parametrize("sensors", LATE.values(), ids=LATE)
def test_sensors_behind_filters_and_latencies(sensors):
    """Machines that are unstable 1 % off, where 5 % was said to be safe for every mode."""
    model = fx.chain(
        masses=[2.0, 1.0, 0.5, 1.0], stiffnesses=[1e6, 4e5, 9e5], dampings=[3.0, 0.5, 6.0]
    )
    own = fx.Ports(
        w=[fx.Disturbance("amp", at="2:x", asd=1e-3)],
        u=[fx.Actuator("u1", at="1:x")],
        z=[fx.Poi("die", at="4:x", axes=("x",))],
        y=[fx.Sensor(f"y{i}", at=f"{i}:x", asd=1e-10, **late) for i, late in enumerate(sensors, 1)],
        references=[fx.Reference("die")],
    )
    plant = fx.assemble_plant(model, own).discretized(5e3, delay=1.3)
    closed = fx.close_loop(plant, fx.design_stage(plant, bandwidth=15.0))

    def off(mode, change):
        return closed.around(
            with_changes(plant, [(FrequencyDelta.of(mode, 1.0), (1 + change) ** 2 - 1)])
        )

    found = closed.mode_tolerances()
    assert len(sensors) > 1 or np.isfinite(found.stable[0, 0])  # judged below
    for row, mode in enumerate(found.modes.tolist()):
        for side, sign in enumerate((-1.0, 1.0)):
            end, within = found.stable[row, side], found.within[row, side]
            if np.isfinite(end):
                assert off(mode, 0.98 * end).is_stable and not off(mode, 1.02 * end).is_stable
            if np.isfinite(within) and within:
                before, behind = (off(mode, part * within) for part in (0.98, 1.02))
                assert not behind.is_stable or behind.modulus_margin < 0.35 < before.modulus_margin
            for share in (0.5, 0.95):  # and nothing happens before
                before = off(mode, sign * share * min(abs(within), found.limit[row]))
                assert before.is_stable and before.modulus_margin > 0.35 * 0.98


def two_masses(off=0.0):
    """Two masses on a spring that is stiffer, so that the mode's frequency is off by a share."""
    model = fx.chain(masses=[1.0, 0.3], stiffnesses=[4e5 * (1.0 + off) ** 2])
    modes = fx.solve_modes(model, count=2, damping=fx.ModalDamping(0.002 / (1.0 + off)))
    own = fx.Ports(
        w=[fx.Disturbance("w", at="1:x", asd=1e-2)],
        u=[fx.Actuator("u", at="1:x")],
        z=[fx.Poi("tip", at="2:x", axes=("x",))],
        y=[fx.Sensor("q", at="2:x", asd=1e-9)],
    )
    return fx.assemble_plant(modes, own).discretized(4e3, delay=1)


@pytest.mark.slow
def test_laws_that_are_tuned_say_what_the_mode_below_their_notch_holds_to():
    """The notch turns the phase of a gain above 1: machines with another spring are the judge."""
    with pytest.warns(FlexplantWarning, match=r"mode 2 \(209.5 Hz\) tolerates .* known to 2 %"):
        found = fx.tune_loops(two_masses().uncertain(frequency=0.02), notches=1)
    (stable,), (within,) = found.tolerances.stable, found.tolerances.within
    assert 0.0 < within[1] < stable[1] < 0.05
    for part, holds in ((0.99, True), (1.01, False)):
        with warnings.catch_warnings(action="ignore"):
            assert fx.close_loop(two_masses(part * stable[1]), found).is_stable == holds
    margin_there = fx.close_loop(two_masses(within[1]), found).modulus_margin
    assert margin_there == pytest.approx(0.35, rel=0.01)
    assert found.tolerances.critical == (2,)
    assert found.tolerances.summary in repr(found)
