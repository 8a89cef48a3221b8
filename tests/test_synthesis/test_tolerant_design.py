"""Controllers that tolerate errors of modes, on machines whose modes are off."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import CertificateError, InfeasibleError, ModelError
from flexplant.modes import solve_modes
from flexplant.structure import FEModel, ModalDamping
from flexplant.synthesis.hinf import hinf_design, hinf_riccati, stage_design
from flexplant.synthesis.hinf.hinf_riccati import UncheckedRiccati
from flexplant.synthesis.preparation import prepared
from flexplant.synthesis.robustness.guarantees import _quick
from judge import judged
from plates import make_plate
from stages import RATE, ports, sampled, some_modes

#: modes 14 and 15 are a pair
ZETA, COUNT, SHARE = 1e-3, 15, 0.005
CHANNELS = ports(asd=1e-2)


@cache
def plant():
    return sampled(some_modes(ZETA, COUNT, attached=False), CHANNELS)


@cache
def weighted(bandwidth=100.0):
    weights = fx.stage_weights(plant(), bandwidth, effort=10.0, disturbance=20.0)
    return plant().through(fx.reference_errors(plant())).weighted(z=weights.z, w=weights.w)


@cache
def design(tolerant=True):
    uncertain = plant().uncertain(frequency=SHARE) if tolerant else None
    return fx.design_hinf(weighted(), uncertain=uncertain)


@cache
def machine(seed):
    """A machine of the same kind whose frequencies are all off, by hand: phi from another E."""
    model = make_plate()
    found = solve_modes(model, count=COUNT, damping=ModalDamping(ZETA))
    rng = np.random.default_rng(seed)
    off = 1.0 + SHARE * rng.choice([-1.0, 1.0], size=COUNT) * (seed > 0)
    off[:3] = 1.0
    phi = model.M @ found.phi
    # K + sum (s^2 - 1) omega^2 M phi phi' M moves one frequency each and keeps its shape
    more = phi @ np.diag((off**2 - 1.0) * found.omega**2) @ phi.T
    moved = FEModel(model.M, model.K + more, dofs=model.dofs).with_damping(ModalDamping(ZETA))
    other = solve_modes(moved, count=COUNT)
    return sampled(other, CHANNELS)


def loop_on(machine_plant, controller):
    return fx.close_loop(machine_plant, fx.reference_errors(machine_plant), controller)


def radius(machine_plant, controller):
    return np.abs(loop_on(machine_plant, controller).poles()).max()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the closed loop is unstable")
def test_what_the_plain_design_does_not_tolerate_the_tolerant_one_does():
    machines = [machine(seed) for seed in range(1, 9)]
    assert radius(machine(0), design(False)) < 1.0
    assert sum(radius(one, design(False)) > 1.0 for one in machines) >= 4
    margins = [loop_on(one, design()).modulus_margin for one in machines]
    assert min(margins) > 0.3


@pytest.mark.slow
def test_the_certificate_is_below_one_and_each_mode_holds_alone():
    share = design().certificate["all frequencies at once"]
    assert share < 1.0
    tolerances = loop_on(plant(), design()).mode_tolerances()
    assert np.abs(tolerances.stable).min() > SHARE


@pytest.mark.slow
def test_what_was_tried_is_in_the_result():
    assert list(design().tried) == ["before the scales were evened out", "after"]
    assert any("a channel for each of 12 modes" in note for note in design().notes)


def test_uncertainty_of_another_plant_is_refused():
    other = fx.testbeds.three_masses()
    with pytest.raises(ModelError, match=r"weighted"):
        fx.design_hinf(weighted(), uncertain=other.uncertain(frequency=0.01))
    with pytest.raises(ModelError, match="Deltas of frequencies"):
        fx.design_hinf(weighted(), uncertain=plant().uncertain(damping=0.3))
    with pytest.raises(ModelError, match="uncertain"):
        fx.design_hinf(weighted(), uncertain=0.005)


@pytest.mark.long
def test_a_stage_is_as_fast_as_its_uncertainty_allows():
    small = sampled(some_modes(ZETA, 8, attached=False), CHANNELS)
    sure = fx.design_stage(small.uncertain(frequency=0.001))
    unsure = fx.design_stage(small.uncertain(frequency=0.02))
    for found, share in ((sure, 0.001), (unsure, 0.02)):
        loop = fx.close_loop(small, found)
        assert loop.modulus_margin >= 0.4
        assert (loop.mode_tolerances(margin=0.35).least > share).all()
        assert len(found.tried) >= 3
    fast, slow = (one.certificate["bandwidth of the weights [Hz]"] for one in (sure, unsure))
    assert fast > 1.2 * slow


@pytest.mark.slow
def test_a_bandwidth_that_cannot_be_kept_is_refused_with_what_was_tried():
    said = r"frequency off \(by up to 3 %\) .* crossing 1 at 400 Hz: "
    with pytest.raises(InfeasibleError, match=said):
        small = sampled(some_modes(ZETA, 8, attached=False), CHANNELS)
        fx.design_stage(small.uncertain(frequency=0.03), bandwidth=400.0)
    with pytest.raises(ModelError, match="margin must be below 1"):
        fx.design_stage(plant(), margin=1.2)


PROMISED = "least modulus margin of 20 machines drawn"


@pytest.mark.long
def test_what_fails_on_machines_drawn_is_not_promised(monkeypatch):
    """Machines whose frequencies are off by 10 %: each alone may be off by 0.1 %, no loop holds."""
    small = sampled(some_modes(ZETA, 8, attached=False), CHANNELS)
    uncertain = small.uncertain(frequency=0.001)
    held = fx.design_stage(uncertain, bandwidth=60.0)
    assert held.certificate[PROMISED] >= 0.35
    assert PROMISED in repr(held)
    far = small.uncertain(frequency=0.1).machines.drawn(20, rng=1)
    task = "flexplant.synthesis.hinf.stage_design._StageTask.machines"
    monkeypatch.setattr(task, getattr(far, "plants", far))
    with pytest.raises(InfeasibleError, match=r"on \d+ (of \d+ )?machines drawn"):
        fx.design_stage(uncertain, bandwidth=60.0)


@pytest.mark.parametrize(
    ("sizes", "margin", "those"),
    [
        ([0.5] * 100, 0.5, "20 machines"),
        ([0.5] * 7 + [0.3] + [0.5] * 92, 0.5, "39 of 40 machines"),
        ([0.3] + [0.5] * 19 + [0.2] + [0.4] * 79, 0.4, "58 of 60 machines"),
        ([0.5] * 10 + [0.3] * 4 + [0.29] + [0.5] * 85, 0.3, "11 of 15 machines"),
        ([0.5] * 10 + [0.0] + [0.5] * 89, 0.0, "11 machines"),
        (([0.3] + [0.5] * 19) * 4 + [0.5] * 20, 0.5, "96 of 100 machines"),
    ],
)
def test_a_machine_that_fails_has_more_drawn(monkeypatch, sizes, margin, those):
    """One in twenty may keep less than 0.35, and none may be unstable."""

    def looped(known, machine):
        return SimpleNamespace(broken=SimpleNamespace(margin=lambda scaled: machine))

    monkeypatch.setattr(stage_design, "loop_beside", looped)
    loop = SimpleNamespace(broken=SimpleNamespace(mixed=tuple))
    found = stage_design._margins(loop, sizes, 0.35)
    assert (found.margin, found.those) == (margin, those)


def test_what_decides_on_no_design_is_computed_where_it_is_read(monkeypatch):
    def fails(*_):
        raise CertificateError("of no use")

    monkeypatch.setattr(hinf_design, "tolerated", fails)
    found = fx.design_stage(fx.testbeds.three_masses(), bandwidth=10.0)
    assert 0.5 < found.lower < found.gamma < 0.7
    with pytest.raises(CertificateError, match="of no use"):
        _ = found.certificate["norm"]
    monkeypatch.undo()
    assert found.certificate["norm"] == found.gamma


@pytest.mark.slow
def test_a_design_whose_search_ends_at_its_bound_is_not_solved_again(monkeypatch):
    """The solution at hand, with the norm of its loop, is what `Riccati` gives."""
    uncertain = plant().uncertain(frequency=SHARE)
    quick = fx.design_stage(uncertain, bandwidth=60.0)
    monkeypatch.setattr(UncheckedRiccati, "proven", lambda *_: None)
    again = fx.design_stage(uncertain, bandwidth=60.0)
    assert quick.gamma == pytest.approx(again.gamma, rel=1e-5)
    freq = np.geomspace(1.0, 2e3, 100)
    one, other = (fx.frequency_response(K.system, freq).data for K in (quick, again))
    np.testing.assert_allclose(one, other, atol=1e-3 * np.abs(other).max())


def test_a_promise_that_is_not_kept_is_not_proven(monkeypatch):
    """Neither a gamma that hangs on the search, nor one below the norm of its loop."""
    P = prepared(weighted().system, weighted().u, weighted().y)
    one = UncheckedRiccati()
    found = one.solve(P)._replace(at_bound=True)
    monkeypatch.setattr(hinf_riccati, "resonance_gain", lambda *_: 0.0)
    kept = one.proven(P, found)
    assert 0.99 * found.gamma < kept.gamma <= found.gamma
    assert one.proven(P, found._replace(at_bound=False)) is None
    monkeypatch.setattr(hinf_riccati, "_loop_norm", lambda *_: 1.01 * found.gamma)
    assert one.proven(P, found) is None
    monkeypatch.setattr(hinf_riccati, "resonance_gain", lambda *_: 1.01 * found.gamma)
    assert one.proven(P, found) is None


@pytest.mark.long
def test_what_is_promised_holds_where_shapes_are_mixed_by_hand():
    """A mass of 20 g anywhere, of 26.5 kg: shapes of all modes differ, frequencies do too."""
    uncertain = plant().uncertain(frequency=SHARE)
    found = fx.design_stage(uncertain, bandwidth=60.0)
    promised = found.certificate[PROMISED]
    model, rng = make_plate(), np.random.default_rng(4)
    for _ in range(3):
        M = model.M.toarray()
        row = model.dofs.row((*(0.6 * rng.random(2)), 0.0), "z")
        heavier = FEModel(M + 0.02 * np.outer(row, row), model.K, dofs=model.dofs)
        modes = solve_modes(heavier, count=COUNT, damping=ModalDamping(ZETA))
        loop = fx.close_loop(sampled(modes, CHANNELS), found)
        assert loop.is_stable
        assert loop.modulus_margin > promised - 0.03


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the loop depends on")
def test_an_uncertain_plant_is_designed_for_by_default():
    """Weights and blocks keep what is uncertain: the same controller as with uncertain=."""
    uncertain = plant().uncertain(frequency=SHARE)
    P = uncertain.nominal
    weights = fx.stage_weights(plant(), 100.0, uncertainty=SHARE)
    again = fx.stage_weights(P, 100.0)
    assert repr(weights) == repr(again)
    assert "disturbance 20, effort 10" in repr(weights)
    assert (
        weights.uncertain.frequencies == uncertain.frequencies == dict.fromkeys(range(4, 16), SHARE)
    )
    problem = P.through(fx.reference_errors(P)).weighted(z=again.z, w=again.w)
    found = fx.design_hinf(problem)
    assert found.gamma == pytest.approx(design().gamma, rel=1e-9)
    assert found.certificate["all frequencies at once"] < 1.0


@pytest.mark.slow
def test_modes_below_a_frequency_are_damped():
    """The channel of a complex delta is small only where the loop damps the mode."""
    plain = loop_on(plant(), design())
    damped = loop_on(
        plant(),
        fx.design_hinf(
            weighted(), uncertain=plant().uncertain(frequency=SHARE), damped_below=350.0
        ),
    )

    def slowest(loop):
        poles = np.log(loop.poles()) * RATE
        near = (poles.imag > 2 * np.pi * 200.0) & (poles.imag < 2 * np.pi * 300.0)
        return (-poles.real / np.abs(poles))[near].min()

    assert slowest(damped) > 2.0 * slowest(plain)


@pytest.mark.slow
def test_the_quick_bound_shows_all_frequencies_at_once():
    """12 modes of 0.1 % damping: what it allows, machines made by hand tolerate, and no more."""
    errors = fx.reference_errors(plant())
    found = fx.synthesis.robust_stability(
        plant().uncertain(frequency=SHARE), errors, design(), quick=True, machines=8
    )
    assert found.is_robust
    assert found.certificate["largest spectral radius of 8 machines"] < 1.0
    assert found.certificate["modes, each by one channel"] == 12
    assert max(radius(machine(seed), design()) for seed in range(1, 5)) < 1.0


@pytest.mark.slow
def test_the_quick_bound_of_one_mode_is_its_tolerance():
    """The exact change at which a pole crosses: less is shown to be stable, more is not."""
    loop = loop_on(plant(), design())
    found = loop.mode_tolerances()
    worst = int(np.argmin(np.abs(found.stable).min(axis=1)))
    mode, edge = int(found.modes[worst]), np.abs(found.stable[worst]).min()
    shown = [
        _quick(
            plant().uncertain(frequency={mode: part * edge}),
            loop.blocks,
            0.5,
            2,
            np.random.default_rng(0),
        )
        for part in (0.85, 1.1)
    ]
    assert shown[0].is_robust
    assert 0.8 < shown[0].upper <= 1.0
    assert shown[1] is None


@pytest.mark.slow
def test_modes_above_half_the_rate_have_no_channel():
    """Folded back, their all-pass would be unstable, and the problem without a solution."""
    slow = plant().continuous.discretized(3e3, delay=1)
    weights = fx.stage_weights(slow, 30.0)
    problem = slow.through(fx.reference_errors(slow)).weighted(z=weights.z, w=weights.w)
    found = fx.design_hinf(problem, uncertain=slow.uncertain(frequency=1e-3))
    below = np.count_nonzero(swinging(slow) < 1500.0)
    assert 0 < below < 12
    assert any(f"a channel for each of {below} modes" in note for note in found.notes)


def swinging(P):
    """The frequencies [Hz] of the elastic modes, from the eigenvalues of A."""
    poles = np.linalg.eigvals(P.continuous.system.A)
    return np.abs(poles[poles.imag > 1.0]) / (2.0 * np.pi)


def cable_carrier():
    """A linear axis whose cable carrier, a chain of links, swings from 0.2 Hz on."""
    rng = np.random.default_rng([4, 1])

    def drawn(size):
        return size * np.exp(rng.uniform(-0.2, 0.2))

    masses = np.array([drawn(12.0), drawn(1.5), *(drawn(0.35) for _ in range(5))])
    K, C = np.zeros((7, 7)), np.zeros((7, 7))
    tool = masses[1] * (2.0 * np.pi * drawn(140.0)) ** 2
    links = [(i, i - 1 if i > 2 else 0, drawn(150.0), drawn(0.5)) for i in range(2, 7)]
    for i, j, k, c in [(1, 0, tool, 20.0), *links, (6, 6, drawn(150.0), drawn(0.5))]:
        row = np.zeros(7)
        row[j] = -1.0
        row[i] = 1.0
        K += k * np.outer(row, row)
        C += c * np.outer(row, row)
    dofs = fx.DofSet(np.arange(1, 8), ["x"] * 7, np.zeros((7, 3)))
    channels = fx.Ports(
        w=[fx.Disturbance("cable", at="3:x", asd=0.02)],
        u=[fx.Actuator("motor", at="1:x", asd=1e-2)],
        z=[fx.Poi("tool", at="2:x", axes=("x",))],
        y=[fx.Sensor("encoder", at="1:x", asd=1e-9)],
        references=[fx.Reference("tool")],
    )
    modes = solve_modes(FEModel(np.diag(masses), K, C, dofs=dofs))
    return fx.assemble_plant(modes, channels).discretized(4e3, delay=1.4)


@pytest.mark.long
def test_slow_modes_that_limit_nothing_end_no_search():
    """The stage follows as far as the servo does, not to 17 times the slowest mode."""
    plant = cable_carrier()
    servo = fx.servo_bandwidth(plant, observer=fx.design_kalman(plant))
    found = judged(plant, fx.design_stage(plant, progress=False))
    assert found.serves(0.7 * servo)
    assert np.interp(0.7 * servo, found.freq, found.S[0]) < 1.0


def isolated(more=()):
    """A carriage with a tool, on a base on isolators (1.5 Hz); `more`: masses along y on springs.

    The springs of `more` are in Hz: masses of 3 kg, which neither motor nor encoder touches.
    """
    base, carriage, tool = 400.0, 20.0, 2.0
    masses = np.array([base, carriage, tool, *[3.0] * len(more)])
    n = masses.size
    stiffness = {(0,): base * (3.0 * np.pi) ** 2, (1, 2): tool * (240.0 * np.pi) ** 2}
    stiffness |= {(3 + i,): 3.0 * (2.0 * np.pi * hertz) ** 2 for i, hertz in enumerate(more)}
    K = np.zeros((n, n))
    for ends, k in stiffness.items():
        row = np.zeros(n)
        row[list(ends)] = [1.0, -1.0][: len(ends)]
        K += k * np.outer(row, row)
    nodes = np.arange(1, n + 1)
    dofs = fx.DofSet(nodes, ["x"] * 3 + ["y"] * len(more), [[n, 0.0, 0.0] for n in nodes])
    model = fx.structure.sliding(FEModel(np.diag(masses), K, dofs=dofs))
    modes = solve_modes(model, count=n, damping=ModalDamping(0.01))
    relative = {"2:x": 1.0, "1:x": -1.0}
    channels = fx.Ports(
        w=[fx.Disturbance("cable", at="2:x", asd=1e-2)],
        u=[fx.Actuator("motor", at=relative)],
        z=[fx.Poi("tool", at={"3:x": 1.0, "1:x": -1.0}, axes=("x",))],
        y=[fx.Sensor("encoder", at=relative, asd=1e-10)],
        references=[fx.Reference("tool")],
    )
    return fx.assemble_plant(modes, channels, evaluation=modes).discretized(4e3, delay=1.0)


@pytest.mark.long
def test_modes_that_nothing_touches_are_left_out_of_a_design():
    alone = fx.design_stage(isolated(), bandwidth=15.0)
    found = fx.design_stage(isolated(more=(1.1, 20.0, 119.0, 121.0)), bandwidth=15.0)
    assert any(note.startswith("without modes 2, ") for note in found.notes)
    assert not any(note.startswith("without") for note in alone.notes)
    freq = np.geomspace(1.0, 1e3, 200)
    one, other = (fx.frequency_response(c.system, freq) for c in (alone, found))
    np.testing.assert_allclose(
        np.abs(other["motor", "encoder"]), np.abs(one["motor", "encoder"]), rtol=0.02
    )
