"""Each certificate is handed a wrong answer and refuses it: one of its two routes is made wrong.

By 0.1 % where two routes give the same number; where one bounds the other (the gain of a filter
0.1 % off is still below its level), or a tolerance of 1 % is stated, by what lies beyond it.
"""

from functools import cache
from importlib import import_module

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import CertificateError, ModelError
from flexplant.plant import Neglected
from flexplant.synthesis import FixedOrder, PoleRegion
from mutants import LINES, SOURCE


@cache
def masses():
    """Sampled: three masses on springs with w, u, z and y."""
    return fx.testbeds.three_masses()


@cache
def problem():
    """Continuous: a first-order plant with weights on S and K S."""
    return fx.plant.mixed_sensitivity(
        fx.lti.tf([1.0], [1.0, 1.0]), S=fx.lti.low_pass_filter(0.1), KS=0.1
    )


@cache
def two_masses(count=2):
    """Continuous: two masses, and a third that few modes leave out."""
    model = fx.chain(masses=[1.0, 1.0, 0.1], stiffnesses=[4e5, 4e5])
    modes = fx.solve_modes(model, count=count, damping=fx.ModalDamping(0.02))
    ports = fx.Ports(
        w=[fx.Disturbance("d", at="2:x")],
        u=[fx.Actuator("u1", at="1:x")],
        z=[fx.Poi("tip", at="2:x", axes=("x",))],
        y=[fx.Sensor("y1", at="1:x", asd=1e-9)],
    )
    return fx.assemble_plant(modes, ports)


def off_by(share):
    """The two masses, the frequency of their mode uncertain."""
    return two_masses().uncertain(frequency=share)


def lead(rate=None):
    """A controller of the two masses, sampled or not."""
    law = -1e3 * fx.lti.tf([0.05, 1.0], [0.002, 1.0]).replace(inputs=["y1"], outputs=["u1"])
    return law if rate is None else fx.lti.tustin(law, rate)


def estimate():
    return fx.design_kalman(masses())


@cache
def servo():
    observer = fx.design_kalman(masses())
    return fx.close_loop(masses(), observer, fx.design_servo(masses(), bandwidth=5.0))


def reducer(**options):
    return fx.synthesis.reduce_controller(masses(), fx.design_h2(masses()), **options)


def frfs():
    freq = np.array([10.0, 20.0])
    return {
        name: fx.Frf(freq, -1 / (m * (2 * np.pi * freq) ** 2)[None, None], ["1:x"], ["1:x"])
        for name, m in (("stage", 2.0), ("frame", 3.0))
    }


def chains():
    return {name: fx.chain(masses=[1.0, 2.0], stiffnesses=[5e5]) for name in ("stage", "frame")}


JOINT = fx.joining.Joint("stage/1:x", "frame/1:x")


def larger(by, place=None):
    """The right answer too large by a factor; of several numbers, the one at a place."""

    def wrong(function):
        def called(*args, **options):
            found = function(*args, **options)
            if place is None or found is None:
                return None if found is None else by * found
            parts = list(found)
            parts[place] = by * parts[place]
            return type(found)(*parts) if hasattr(found, "_fields") else tuple(parts)

        return called

    return wrong


def given(by, place):
    """An argument too large by a factor."""

    def wrong(function):
        def called(*args):
            return function(*(by * x if i == place else x for i, x in enumerate(args)))

        return called

    return wrong


def twice(function):
    """Motions of which each is there twice."""

    def called(*args):
        return np.hstack([function(*args)] * 2)

    return called


def half_open(function):
    """Coupled responses with a part of those that nothing couples."""

    def called(B, lines, load, found, *others):
        return function(B, lines, load, found + 0.01 * lines, *others)

    return called


def opposite(function):
    """A controller of the wrong sign."""

    def called(*args):
        found = function(*args)
        return found._replace(C=-found.C, D=-found.D)

    return called


class Unstable:
    """The report of a loop that is not stable."""

    is_stable = False

    def __init__(self, report):
        self.report = report

    def __getattr__(self, name):
        return getattr(self.report, name)


#: what is made wrong, how, what is called then, and what is said
WRONG = {
    "error of an observer, its dual": (
        "estimation.error._two_ways", larger(1.02, 1),
        lambda: estimate().rms("die", on=masses()), "its dual differ",
    ),
    "coupled responses": (
        "joining.frf_coupling._check_gap", half_open, lambda: fx.joined(frfs(), JOINT),
        "leave a gap",
    ),
    "rigid-body motions of joined parts": (
        "joining.join.rigid_body_basis", twice, lambda: fx.joined(chains(), JOINT),
        "stretch no joint",
    ),
    "budget by the other Gramian": (
        "loop.budget.controllability_factor", larger(1.001), lambda: servo().budget("die:error"),
        "observability Gramian",
    ),
    "budget by its spectrum": (
        "loop.budget.integrated", larger(1.001, 1), lambda: servo().budget("die:error"),
        "integral of the spectrum",
    ),
    "H2 norm by the other Gramian": (
        "lti.norms.observability_factor", larger(1.001),
        lambda: fx.h2_norm(fx.StateSpace([[-2.0]], [[1.0]], [[1.0]], [[0.0]])),
        "by the observability",
    ),
    "cost of a layout": (
        "placement.closed_loop_h2.TYPED", lambda allowed: -allowed,
        lambda: import_module("flexplant.placement.closed_loop_h2").confirmed(1.0, 1.0),
        "loop costs",
    ),
    "affine channels of a sampled plant": (
        "plant.uncertainty.sampled_channels._distance", lambda _: lambda *_: 1.0,
        lambda: fx.synthesis.robust_stability(
            two_masses().discretized(2e3).uncertain(frequency=0.01, damping=0.1), lead(2e3)
        ), "lie 100 % off",
    ),
    "bound of neglected modes": (
        "plant.uncertainty.neglected_dynamics._MARGIN", lambda margin: 0.5 * margin,
        lambda: two_masses().uncertain(Neglected(two_masses(3)), frequency=0.01),
        "times the weights",
    ),
    "reduced controller": (
        "synthesis.aftercare.order.loss_text", lambda _: lambda *_: "too much",
        lambda: reducer(loss=0.1), "no controller of fewer states",
    ),
    "blocks for C, of several places": (
        "synthesis.aftercare.forms._difference", lambda _: lambda *_: 1e-3,
        lambda: import_module("flexplant.synthesis.aftercare.forms").scheduled_form(
            [lead(2e3).replace(blocks=None)], driven=1
        ), "differs from the controller of a place",
    ),
    "H2 claim": (
        "synthesis.h2._solve_regular", larger(1.001, 4),
        lambda: fx.design_h2(masses()), "by the synthesis",
    ),
    "H2 stability": (
        "synthesis.h2._solve_regular", opposite, lambda: fx.design_h2(masses()),
        "is not stable.*stays undamped",
    ),
    "inverse of a plant": (
        "simulation.plant_inverse.responder",
        lambda function: lambda g: larger(1.001)(function(g)),
        lambda: fx.simulation.inverse_forces(
            servo(), fx.setpoint(1e-4, velocity=5e-3, acceleration=0.5, jerk=100.0, rest=0.05),
            duration=0.2, bandwidth=60.0,
        ), "forces do not minimise",
    ),
    "normalised coprime factors": (
        "synthesis.hinf.ncf.hankel_norm", larger(1.001),
        lambda: fx.design_ncf(fx.lti.tf([1.0], [1.0, 1.0, 0.0])), "by the Hankel norm",
    ),
    "largest gain": (
        "synthesis.robustness.guarantees._machine_gain", larger(100.0, 0),
        lambda: fx.synthesis.worst_case_gain(off_by(0.01), lead(), w=["d"], z=["tip:x"]),
        "was proven as largest",
    ),
    "mu of one channel a mode": (
        "synthesis.robustness.dk.swept_norm", larger(100.0),
        lambda: fx.synthesis.design_mu(
            off_by(0.01), w=["d", "y1:noise"], z=["tip:x", "u1:effort"], iterations=1
        ), "times the gain",
    ),
    "robust stability by machines": (
        "synthesis.robustness.guarantees.stability", lambda _: lambda *_: 1.5,
        lambda: fx.synthesis.robust_stability(off_by(0.01), lead(), machines=8), "is unstable",
    ),
    "structured claim": (
        "synthesis.structured.structured_design._end_norm", larger(1.001),
        lambda: fx.synthesis.design_structured(problem(), FixedOrder(0), starts=1),
        "by the search",
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_answer_is_refused(what, monkeypatch):
    target, wrong, call, said = WRONG[what]
    module, name = target.rsplit(".", 1)
    place = import_module(f"flexplant.{module}")
    monkeypatch.setattr(place, name, wrong(getattr(place, name)))
    with pytest.raises(CertificateError, match=said):
        call()


def test_a_loop_is_held_to_each_objective():
    """`design_lmi` computes what it reached from the loop: a norm and a region not kept."""
    design = import_module("flexplant.synthesis.lmi.objective_design")
    plant, found = problem(), fx.design_hinf(problem())
    norm = fx.synthesis.Hinf(below=0.9 * found.gamma)
    with pytest.raises(CertificateError, match="in the closed loop"):
        design._verified_values(plant, found.system, norm, ())
    region = PoleRegion(decay=1e6)
    with pytest.raises(CertificateError, match="outside its region"):
        design._verified_values(plant, found.system, fx.synthesis.Hinf(), (region,))
    with pytest.raises(CertificateError, match="not stable"):
        wrong = found.system.replace(C=-1e3 * found.system.C, D=-1e3 * found.system.D)
        design._verified_values(plant, wrong, fx.synthesis.Hinf(), ())


def test_a_simpler_controller_may_lose_what_is_allowed_and_no_more():
    order = import_module("flexplant.synthesis.aftercare.order")
    before = order.LoopFacts(True, 0.9, 1.0, True, 0.5, 2.0)
    order.required(before, before._replace(margin=0.451, gamma=2.19), 0.1, "")
    for worse in ({"margin": 0.449}, {"gamma": 2.21}, {"is_stable": False}):
        with pytest.raises(CertificateError, match="refused"):
            order.required(before, before._replace(**worse), 0.1, "")


def test_a_structured_loop_that_is_not_stable_has_no_h2_norm():
    structured = import_module("flexplant.synthesis.structured.structured_design")
    loop = fx.StateSpace([[0.1]], [[1.0]], [[1.0]], [[0.0]])
    with pytest.raises(CertificateError, match="is not stable"):
        structured._verified_loop(two_masses(), loop, (fx.synthesis.H2(),), 1.0)


@pytest.mark.slow
def test_the_proven_tolerance_ends_where_the_stiffness_of_the_mode_does():
    """By hand: the lead damps the mode as long as there is one, 10 units of 5 % either way."""
    deltas = off_by(0.05)
    found = fx.synthesis.robust_stability(deltas, lead(), resolution=0.05)
    size = 1.0 / found.upper
    for sign in (-0.98, 0.98):
        machine = deltas.lft({"mode2:freq": sign * size})
        assert fx.close_loop(machine, lead()).obstacle is None
    with pytest.raises(ModelError, match="negative stiffness"):
        deltas.lft({"mode2:freq": -1.02 * size})


def test_an_unstable_loop_at_one_of_the_positions_has_no_norm():
    moved = import_module("flexplant.synthesis.hinf.moved_design")
    plant = masses()
    idle = fx.StateSpace([], [], [], np.zeros((len(plant.u), len(plant.y))), plant.dt,
                         inputs=plant.y, outputs=plant.u)  # fmt: skip
    with pytest.raises(CertificateError, match="not stable"):
        moved._position_norm(plant, idle)


def test_the_lines_that_mutants_change_are_there():
    """Each once: a line that moves takes its mutant with it (``python tests/mutants.py``)."""
    found = {line[:2]: (SOURCE / line[0]).read_text("utf-8").count(line[1]) for line in LINES}
    assert not {line: count for line, count in found.items() if count != 1}
