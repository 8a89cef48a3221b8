"""Wrong values given to the control rooms are refused: by our errors with a next step.

A wrong kind (text where a plant is needed) may also meet Python's own TypeError or AttributeError.
"""

import re
from functools import cache

import pytest

import flexplant as fx
from flexplant.errors import FlexplantError
from flexplant.loop import close_loop
from flexplant.placement import (
    BranchAndBound,
    Budget,
    CountLimits,
    DeviceLoss,
    Exchange,
    Excluded,
    Exhaustive,
    JointGroups,
    MinimumDistance,
    OverMachines,
    RowSelection,
    Screened,
    device_worth,
    pareto_curve,
)
from flexplant.simulation import (
    error_map,
    exposure_errors,
    inverse_forces,
    learn_feedforward,
    settling_time,
)
from flexplant.synthesis import FixedOrder, design_structured
from flexplant.testbeds import wafer_stage
from stages import RATE, ports, sampled, some_modes

#: nothing that is a number, a list of names, a plant or a system
KINDS = {
    "text": "a",
    "none": None,
    "nan": float("nan"),
    "negative": -1.0,
    "fraction": 2.5,
    "bool": True,
    "object": object(),
    "dict": {"a": 1},
    "list": [None],
}


MOVE = fx.setpoint(1e-6, velocity=5e-3, acceleration=0.5, jerk=100.0, rate=RATE)


@cache
def plant():
    return sampled(some_modes())


@cache
def kalman():
    return fx.design_kalman(plant())


@cache
def loop():
    return close_loop(plant(), fx.design_static(plant()), held())


@cache
def run():
    return fx.simulate(loop(), duration=0.01)


@cache
def stage():
    return wafer_stage(elements=(4, 4))


def placed(**options):
    names = [sensor.name for sensor in plant().assembled.ports.y]
    return fx.place_sensors(plant(), options.pop("candidates", names), **({"count": 4} | options))


def servo(**options):
    return fx.design_servo(plant(), **({"bandwidth": 50.0} | options))


@cache
def held():
    return servo()


def simulated(**options):
    return fx.simulate(loop(), **({"duration": 0.01} | options))


def machine_frf(**options):
    return stage().measure_frf(ports(), **({"period": 0.01} | options))


#: (name, call of one argument, kinds that are allowed there)
NUMBERS = ("bool", "fraction", "negative")  # static gains
CALLS = [
    ("mu", lambda x: fx.synthesis.mu(x, [fx.synthesis.FullBlock()]), NUMBERS),
    ("mu blocks", lambda x: fx.synthesis.mu([[1.0]], x), ()),
    ("RepeatedScalar", lambda x: fx.synthesis.RepeatedScalar(x), ()),
    ("robust_stability", lambda x: fx.synthesis.robust_stability(x, held()), ()),
    ("design_mu", lambda x: fx.synthesis.design_mu(x, w=["amp1"], z=["die:z"]), ()),
    ("design_lmi minimize", lambda x: fx.synthesis.design_lmi(plant(), minimize=x), ()),
    ("H2 below", lambda x: fx.synthesis.H2(below=x), ("none", "fraction")),
    ("reduce_controller", lambda x: fx.synthesis.reduce_controller(x, held()), ()),
    ("anti_windup_form", lambda x: fx.synthesis.anti_windup_form(x), NUMBERS),
    ("write_c", lambda x: fx.export.write_c(held(), x), ()),
    ("design_kalman", lambda x: fx.design_kalman(x), ()),
    ("FirstOrder rms", lambda x: fx.plant.FirstOrder(x, 1.0), ("fraction",)),
    ("FirstOrder corner", lambda x: fx.plant.FirstOrder(1.0, x), ("fraction",)),
    ("NarrowBand freq", lambda x: fx.plant.NarrowBand(1.0, x), ("fraction",)),
    ("NarrowBand zeta", lambda x: fx.plant.NarrowBand(1.0, 1.0, x), ()),
    ("RandomWalk drift", lambda x: fx.plant.RandomWalk(x), ("fraction",)),
    ("RigidForce direction", lambda x: fx.plant.RigidForce("a", x), ()),
    ("consistency", lambda x: fx.estimation.consistency(x, x), ()),
    ("consistency estimate", lambda x: fx.estimation.consistency(kalman(), x), ()),
    ("estimate_noise", lambda x: fx.estimation.estimate_noise(x, {}), ()),
    ("estimate_noise records", lambda x: fx.estimation.estimate_noise(plant(), x), ()),
    ("replace evaluation", lambda x: plant().replace(evaluation=x), ("none",)),
    ("kalman rms on", lambda x: kalman().rms("die", on=x), ("none",)),
    (
        "assemble_plant evaluation",
        lambda x: fx.assemble_plant(plant().model, plant().assembled.ports, evaluation=x),
        ("none",),
    ),
    ("design_static", lambda x: fx.design_static(x), ()),
    ("design_servo", lambda x: fx.design_servo(x, bandwidth=50.0), ()),
    ("design_servo bandwidth", lambda x: servo(bandwidth=x), ("fraction",)),
    ("design_servo rolloff", lambda x: servo(rolloff=x), ("none", "fraction")),
    ("design_servo integrator", lambda x: servo(integrator=x), ("none", "fraction")),
    ("design_servo notches", lambda x: servo(notches=x), ("none",)),
    ("design_servo observer", lambda x: servo(observer=x), ("none",)),
    ("servo_bandwidth", lambda x: fx.servo_bandwidth(x), ()),
    ("servo_bandwidth peak", lambda x: fx.servo_bandwidth(plant(), peak=x), ("fraction",)),
    ("design_servo a notch", lambda x: servo(notches=[x]), ("fraction", "bool")),
    ("design_servo poi", lambda x: servo(poi=x), ("none",)),
    ("design_h2", lambda x: fx.design_h2(x), ()),
    ("design_h2 u", lambda x: fx.design_h2(plant().system, u=x, y=plant().y), ()),
    ("design_ncf", lambda x: fx.design_ncf(x), NUMBERS),
    ("design_ncf before", lambda x: fx.design_ncf(plant(), before=x), ("none",)),
    ("design_ncf bandwidth", lambda x: fx.design_ncf(plant(), bandwidth=x), ("none",)),
    ("design_loops", lambda x: fx.design_loops(x, fx.Pid(1.0)), ()),
    ("design_loops laws", lambda x: fx.design_loops(plant(), x), ()),
    ("design_loops before", lambda x: fx.design_loops(plant(), fx.Pid(1.0), before=x), ("none",)),
    ("tune_loops", lambda x: fx.tune_loops(x), ()),
    ("tune_loops peak", lambda x: fx.tune_loops(plant(), peak=x), ("fraction",)),
    ("Pid", lambda x: fx.Pid(x), ("negative", "fraction", "bool")),
    ("Pid pole", lambda x: fx.Pid(1.0, pole=x), ("none", "fraction")),
    ("Lead", lambda x: fx.Lead(x), ("fraction",)),
    ("Notch", lambda x: fx.Notch(x), ("fraction",)),
    ("LowPass order", lambda x: fx.LowPass(1.0, x), ()),
    ("Law factors", lambda x: fx.synthesis.Law(x), ("dict",)),
    ("law sampled", lambda x: fx.Pid(1.0).sampled(x), ("fraction",)),
    ("law response", lambda x: fx.Pid(1.0).law.response(x), ()),
    ("law times", lambda x: fx.Pid(1.0) * x, ("negative", "fraction", "bool")),
    ("in_axes", lambda x: fx.loop.in_axes(x), ()),
    ("report_loops", lambda x: fx.loop.report_loops(x), ()),
    ("report_loops rigid", lambda x: fx.loop.report_loops(loop(), rigid=x), ()),
    ("design_structured", lambda x: design_structured(x, FixedOrder(0)), ()),
    ("design_structured structure", lambda x: design_structured(plant(), x), ()),
    ("design_structured starts", lambda x: design_structured(plant(), FixedOrder(0), starts=x), ()),
    ("FixedOrder", lambda x: FixedOrder(x), ()),
    ("FixedOrder pattern", lambda x: FixedOrder(pattern=x), ("none",)),
    ("TunedLaws", lambda x: design_structured(plant(), fx.synthesis.TunedLaws(x)), ()),
    ("TunedLaws free", lambda x: fx.synthesis.TunedLaws(fx.Pid(1.0), free=x), ("dict",)),
    ("Parametrised", lambda x: fx.synthesis.Parametrised(x, [1.0]), ()),
    ("ncf_margin", lambda x: fx.synthesis.ncf_margin(plant(), x), ()),
    ("design_hinf", lambda x: fx.design_hinf(x), ()),
    ("design_hinf method", lambda x: fx.design_hinf(plant(), x), ("none",)),
    ("design_hinf u", lambda x: fx.design_hinf(plant().system, u=x, y=plant().y), ()),
    ("Lmi back_off", lambda x: fx.Lmi(back_off=x), ("none", "fraction")),
    ("Lmi max_states", lambda x: fx.Lmi(max_states=x), ()),
    ("Lmi tolerance", lambda x: fx.Lmi(tolerance=x), ("fraction",)),
    ("Riccati tolerance", lambda x: fx.Riccati(tolerance=x), ("fraction",)),
    ("close_loop", lambda x: fx.close_loop(x, loop().controller), ()),
    ("close_loop block", lambda x: fx.close_loop(plant(), x), ()),
    ("close_loop idle", lambda x: fx.close_loop(plant(), *loop().blocks, idle=x), ()),
    ("loop response", lambda x: loop().frequency_response(x), ()),
    ("sensitivity", lambda x: fx.loop.sensitivity(x), ()),
    ("loop psd", lambda x: loop().psd("die:error", x), ("none",)),
    ("loop rms", lambda x: loop().rms(x), ()),
    ("loop residue", lambda x: loop().budget("die:error", residue=x), ("none",)),
    ("response psd", lambda x: run().psd("die:error", segment=x), ("none",)),
    ("sensitivity freq", lambda x: fx.loop.sensitivity(loop(), freq=x), ("none",)),
    ("sensitivity at", lambda x: fx.loop.sensitivity(loop(), at=x), ()),
    ("modulus_margin", lambda x: fx.modulus_margin(x), ()),
    ("simulate", lambda x: fx.simulate(x, duration=0.01), ()),
    ("simulate duration", lambda x: simulated(duration=x), ("fraction",)),
    ("simulate rng", lambda x: simulated(rng=x), ("none",)),
    ("simulate runs", lambda x: simulated(runs=x), ("none",)),
    ("simulate noise", lambda x: simulated(noise=x), ("bool",)),
    ("simulate start", lambda x: simulated(start=x), ("none",)),
    ("simulate disturbance", lambda x: simulated(disturbance=x), ("none",)),
    ("simulate reference", lambda x: simulated(reference=x),
        ("none", "negative", "fraction", "bool")),
    ("setpoint", lambda x: fx.setpoint(x, velocity=1.0, acceleration=1.0, jerk=1.0),
        ("negative", "fraction", "bool")),
    ("scan", lambda x: fx.simulation.scan(x, velocity=1.0, acceleration=1.0),
     ("fraction", "negative", "bool")),
    ("setpoint rate", lambda x: fx.setpoint(1.0, velocity=1.0, acceleration=1.0, rate=x),
     ("none", "fraction")),
    ("exposure errors", lambda x: exposure_errors(x), ()),
    ("exposures", lambda x: exposure_errors(run(), exposures=x), ("none",)),
    ("settling", lambda x: settling_time(run(), "die:error", ma=x), ("fraction",)),
    ("error map", lambda x: error_map(loop(), x, duration=0.01), ()),
    ("feedforward", lambda x: fx.design_feedforward(x), ()),
    ("feedforward order", lambda x: fx.design_feedforward(plant(), order=x), ()),
    ("feedforward along", lambda x: fx.design_feedforward(plant(), along=x), ("none",)),
    ("feedforward reference", lambda x: fx.design_feedforward(plant(), reference=x), ("none",)),
    ("feedforward term", lambda x: fx.design_feedforward(plant()).up_to(x), ()),
    ("forces", lambda x: fx.design_feedforward(plant()).forces(MOVE, x), ()),
    ("inverse bandwidth", lambda x: inverse_forces(loop(), MOVE, duration=0.1, bandwidth=x),
     ("fraction",)),
    ("inverse", lambda x: inverse_forces(x, MOVE, duration=0.1, bandwidth=100.0), ()),
    ("learn", lambda x: learn_feedforward(x, lambda f: run(), loop(), MOVE, duration=0.1), ()),
    ("learn step", lambda x: learn_feedforward(fx.design_feedforward(plant()), lambda f: run(),
     loop(), MOVE, duration=0.01, step=x), ()),
    ("specification", lambda x: fx.Specification(ma=x), ("fraction", "none")),
    ("specification check", lambda x: fx.Specification(noise=1.0).check(x), ()),
    ("specification run", lambda x: fx.Specification(ma=1.0).check(loop(), x), ()),
    ("saturation", lambda x: fx.simulation.Saturation(x), ("fraction",)),
    ("saturation rate", lambda x: fx.simulation.Saturation(1.0, rate=x), ("none", "fraction")),
    ("quantiser", lambda x: fx.simulation.Quantiser(x), ("fraction",)),
    ("hysteresis", lambda x: fx.simulation.Hysteresis(x), ("fraction",)),
    ("dropout", lambda x: fx.simulation.Dropout(x), ("fraction",)),
    ("jitter", lambda x: fx.simulation.Jitter(x), ("fraction",)),
    ("friction", lambda x: fx.simulation.Friction(x, 1e6, "y1"), ("fraction",)),
    ("rate of a spectrum", lambda x: fx.simulation.spectral_noise(abs, rate=x, duration=9.0),
     ("fraction",)),
    ("simulate elements", lambda x: fx.simulate(loop(), duration=0.01, elements=x), ("none",)),
    ("simulate element", lambda x: fx.simulate(loop(), duration=0.01, elements={"u1": x}), ()),
    ("simulate moving", lambda x: fx.simulate(loop(), duration=0.01, moving=x), ("none",)),
    ("simulate path", lambda x: fx.simulate(loop(), duration=0.01, moving={"die": x}), ()),
    ("simulate finer", lambda x: fx.simulate(loop(), duration=0.01, finer=x), ()),
    ("simulate anti-windup", lambda x: fx.simulate(loop(), duration=0.01, anti_windup=x),
     ("none", "fraction")),
    ("setpoint velocity", lambda x: fx.setpoint(1.0, velocity=x, acceleration=1.0, jerk=1.0),
        ("fraction",)),
    ("setpoint snap", lambda x: fx.setpoint(1.0, velocity=1.0, acceleration=1.0, jerk=1.0, snap=x),
        ("none", "fraction")),
    ("rms", lambda x: run().rms(x), ()),
    ("rms start", lambda x: run().rms("die:z", start=x), ("negative",)),
    ("moving_average window", lambda x: run().moving_average("die:z", window=x), ()),
    ("place_sensors", lambda x: fx.place_sensors(x, ["y1"], 1), ()),
    ("place_sensors candidates", lambda x: placed(candidates=x), ()),
    ("place_both", lambda x: fx.placement.place_both(x, ["y1"], ["u1"], (1, 1)), ()),
    ("place_both counts", lambda x: fx.placement.place_both(plant(), ["y1"], ["u1"], x), ()),
    ("place_both sensors", lambda x: fx.placement.place_both(plant(), x, ["u1"], (1, 1)), ()),
    ("pareto_curve", lambda x: pareto_curve(x, ["y1"], [1]), ()),
    ("pareto_curve candidates", lambda x: pareto_curve(plant(), x, [4]), ()),
    ("pareto_curve amounts", lambda x: pareto_curve(plant(), ["y1", "y2", "y3", "y4"], x), ()),
    ("device_worth", lambda x: device_worth(plant(), x), ()),
    ("DeviceLoss", DeviceLoss, ()),
    ("AfterLoss of", lambda x: DeviceLoss(fx.PoiVariance(), of=x), ()),
    ("OverMachines", lambda x: OverMachines(fx.PoiVariance(), x), ()),
    ("PoiVariance lag", lambda x: fx.PoiVariance(lag=x), ("none",)),
    ("PoiVariance measure", lambda x: fx.PoiVariance(measure=x), ()),
    ("PoiVariance poi", lambda x: fx.PoiVariance(x)(plant()), ("none",)),
    ("RowSelection", RowSelection, ()),
    ("Screened", Screened, ()),
    ("CountLimits", lambda x: CountLimits(x, at_most=1), ("text", "dict")),
    ("place_sensors checkpoint", lambda x: placed(checkpoint=x), ("text", "none")),
    ("place_sensors count", lambda x: placed(count=x), ()),
    ("place_sensors required", lambda x: placed(required=x), ()),
    ("place_sensors constraints", lambda x: placed(constraints=x), ()),
    ("JointGroups", lambda x: JointGroups(x), ()),
    ("MinimumDistance", lambda x: MinimumDistance(x), ("fraction",)),
    ("Budget", lambda x: Budget(x), ("fraction",)),
    ("Excluded", lambda x: Excluded(x), ()),
    ("place_sensors method", lambda x: placed(method=x), ("none",)),
    ("place_sensors rng", lambda x: placed(rng=x, method=Exchange(starts=2)), ("none",)),
    ("place_sensors criterion", lambda x: placed(criterion=x), ("none",)),
    ("Exchange", lambda x: Exchange(starts=x), ()),
    ("BranchAndBound gap", lambda x: BranchAndBound(gap=x), ("fraction",)),
    ("BranchAndBound branches", lambda x: BranchAndBound(branches=x), ()),
    ("BranchAndBound starts", lambda x: BranchAndBound(starts=x), ()),
    ("Exhaustive", lambda x: Exhaustive(limit=x), ()),
    ("score_sensors", lambda x: fx.score_sensors(plant(), x), ()),
    ("score_sensors layout", lambda x: fx.score_sensors(plant(), [x]), ()),
    ("sensor_map points", lambda x: fx.placement.sensor_map(plant(), x, asd=1e-12), ()),
    (
        "sensor_map asd",
        lambda x: fx.placement.sensor_map(plant(), [(0.3, 0.3, 0.0)], asd=x),
        ("fraction",),
    ),
    ("hinf_norm", lambda x: fx.hinf_norm(x), ("negative", "fraction", "bool")),
    ("h2_norm", lambda x: fx.h2_norm(x), ("negative", "fraction", "bool")),
    ("frequency_response", lambda x: fx.frequency_response(x), ("negative", "fraction", "bool")),
    ("frequency_response freq", lambda x: fx.frequency_response(loop().controller, x), ("none",)),
    ("StateSpace A", lambda x: fx.StateSpace(x, [[1.0]], [[1.0]], [[0.0]]), ()),
    ("StateSpace dt", lambda x: fx.StateSpace([], [], [], [[1.0]], dt=x), ("fraction",)),
    ("StateSpace inputs", lambda x: fx.StateSpace([], [], [], [[1.0]], inputs=x),
        ("text", "none", "dict")),
    ("lft", lambda x: fx.lft(plant().system, x), ()),
    ("wafer_stage elements", lambda x: wafer_stage(elements=x), ("none",)),
    ("wafer_stage an element", lambda x: wafer_stage(elements=(x, 8)), ()),
    ("wafer_stage delay", lambda x: wafer_stage(elements=(2, 2), delay=x), ("fraction", "none")),
    ("wafer_stage rate", lambda x: wafer_stage(elements=(2, 2), rate=x), ("fraction",)),
    ("wafer_stage added_mass", lambda x: wafer_stage(elements=(2, 2), added_mass=x), ("fraction",)),
    ("poles", lambda x: stage().poles(x), ()),
    ("measure_frf periods", lambda x: machine_frf(periods=x), ()),
    ("measure_frf rng", lambda x: machine_frf(rng=x), ("none",)),
    ("plot.response", lambda x: fx.plot.response(x), ()),
    ("plot.response channels", lambda x: fx.plot.response(run(), x), ("none",)),
    ("plot.frf", lambda x: fx.plot.frf(x, "y1", "u1"), ()),
    ("plot.sensitivity", lambda x: fx.plot.sensitivity(x), ("dict",)),
    ("plot.sensitivities", lambda x: fx.plot.sensitivities(x), ()),
    ("plot.bode", lambda x: fx.plot.bode(x), ()),
    ("plot.sensor_map", lambda x: fx.plot.sensor_map(x), ()),
]  # fmt: skip

#: a sentence or clause that says what to do, or what there is to choose from
VERBS = "add call check choose convert give leave make move name pass put raise remove say take try"
NEXT_STEP = re.compile(
    rf"[.;:,?] (?:{VERBS.replace(' ', '|')}|type|use|known are|close matches)\b", re.IGNORECASE
)


def by_function(calls):
    """Return {function: its entries}: one case each, whose report lists every wrong answer."""
    grouped = {}
    for entry in calls:
        grouped.setdefault(entry[0].split()[0], []).append(entry)
    return grouped


def not_refused(entries, kinds=KINDS, step=NEXT_STEP):
    """Return a line for every wrong value that is taken, or refused without a next step."""
    lines = []
    for name, call, allowed in entries:
        for kind in kinds.keys() - allowed:
            try:
                call(kinds[kind])
                lines.append(f"{name} took {kind}")
            except FlexplantError as error:
                text = str(error)
                if len(text) >= 600 or not step.search(text):
                    lines.append(f"{name}, {kind}: what to do next? {text}")
            except (TypeError, AttributeError):
                pass
            except Exception as error:
                lines.append(f"{name}, {kind}: {type(error).__name__}: {error}")
    return sorted(lines)


GROUPS = by_function(CALLS)


@pytest.mark.slow
@pytest.mark.parametrize("function", GROUPS)
def test_wrong_kinds(function):
    wrong = not_refused(GROUPS[function])
    assert not wrong, "\n".join(wrong)


def test_what_is_not_refused_is_listed():
    def crooked(x):
        if isinstance(x, dict):
            raise FlexplantError("a dict")
        if isinstance(x, str):
            raise ValueError("a text")
        return 1.0 + x

    found = not_refused([("crooked", crooked, ("nan", "negative", "fraction"))])
    assert [line.split(":")[0] for line in found] == [
        "crooked took bool", "crooked, dict", "crooked, text",
    ]  # fmt: skip
    assert "what to do next? a dict" in found[1]
    assert "ValueError" in found[2]


def test_what_counts_as_a_next_step():
    for text in ("a plant is missing.", "got 'a': str", "need a plant, got 2. It has none.", "Use"):
        assert not NEXT_STEP.search(text)
    for text in ("got 'a'. Pass a float.", "no 'a'. Known are b, c.", "got 2: choose 3 or more."):
        assert NEXT_STEP.search(text)


@pytest.mark.slow
def test_the_rate_of_these_tests_is_the_stages():
    assert plant().dt == 1 / RATE
    with pytest.raises(FlexplantError, match=r"mode 70 is at .* not below half the rate, 1000 Hz"):
        wafer_stage(elements=(8, 8), rate=2000.0).poles([70])


def test_a_plant_where_a_system_is_needed_is_told_which_systems_it_has():
    for function in (fx.hinf_norm, fx.h2_norm, fx.frequency_response, fx.peak_gain):
        with pytest.raises(FlexplantError, match=r"plant\.Gzw .*plant\.system for all of it"):
            function(plant())
    assert fx.peak_gain(held()) == fx.peak_gain(held().system)


def test_a_system_where_a_plant_is_needed_is_told_what_it_lacks():
    """Its labels tell w, u, z and y; densities, ports and shapes are not in it."""
    names = [sensor.name for sensor in plant().assembled.ports.y]
    lacking = {
        fx.design_kalman: r"no noise density.*from_statespace\(sys, w=\[.*noise_factor",
        fx.design_static: r"assembled from a structure.*assemble_plant\(",
        lambda s: fx.design_servo(s, bandwidth=50.0): r"assembled from a structure.*assemble_plant",
        lambda s: fx.stage_weights(s, 30.0): r"assembled from a structure.*assemble_plant\(",
        lambda s: fx.place_sensors(s, names, 4): r"no noise density.*from_statespace\(sys",
        lambda s: fx.score_sensors(s, [names]): r"no noise density.*from_statespace\(sys",
        lambda s: fx.placement.sensor_map(
            s, [(0.3, 0.3, 0.0)], asd=1e-12
        ): r"from a structure.* Make it by",
    }
    for sys in (plant().system, plant().system.to_control()):
        for function, words in lacking.items():
            with pytest.raises(FlexplantError, match=words):
                function(sys)


@pytest.mark.slow
def test_a_system_whose_labels_tell_is_a_plant_where_no_more_is_needed():
    """The H-infinity controller of an assembled plant, weighted, and of its bare system."""
    small = sampled(some_modes(count=4, attached=False))
    weights = fx.stage_weights(small, 30.0)
    weighted = small.weighted(z=weights.z, w=weights.w)
    whole = fx.design_hinf(weighted)
    for sys in (weighted.system, weighted.system.to_control()):
        assert fx.design_hinf(sys).gamma == pytest.approx(whole.gamma, rel=1e-6)
