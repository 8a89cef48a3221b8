"""Truncated modes of the filter: noise by the closed form, an honest rms, other machines."""

from functools import cache

import numpy as np
import pytest

from flexplant.errors import AssumptionError, FlexplantWarning, LabelError, ModelError
from flexplant.estimation import design_kalman, design_static
from flexplant.estimation.error import error_variances
from flexplant.estimation.filter_models import left_out
from flexplant.lti import low_pass_filter
from flexplant.modes import solve_modes
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Sensor, assemble_plant
from flexplant.reduction import DesiredDofs, ModalTruncation, reduce
from flexplant.structure import FEModel, ModalDamping, chain, kirchhoff_plate
from flexplant.testbeds import three_masses
from oracles_estimation import error_by_frequency, truncated_covariance
from plates import make_plate
from stages import CORNERS, INSET, fitted, ports, sampled
from stages import reduced as stage_model

#: meshes are small here: what they do not resolve is the subject of test_mesh

LEVELS = (1e-4, 1e-3, 1e-2)
DAMPINGS = (0.01, 0.001)
AXES = ("die:z", "die:rx", "die:ry")
#: the paper's plate, a thin wide one with its mass at a corner, a thick short one of steel
PLATES = {
    "paper": {"size": (0.6, 0.6), "thickness": 0.0272, "density": 2702, "youngs_modulus": 70e9},
    "thin": {"size": (0.6, 0.9), "thickness": 0.018, "density": 2702, "youngs_modulus": 70e9},
    "steel": {"size": (0.8, 0.6), "thickness": 0.03, "density": 7800, "youngs_modulus": 205e9},
}
ELEMENTS, OTHER = (8, 8), (10, 10)


def channels(kind, level):
    """The example's ports on a plate of another size; the die beside the centre."""
    scale = np.array([*PLATES[kind]["size"], 1.0]) / np.array([0.6, 0.6, 1.0])
    base = ports(asd=level, die=(0.31, 0.26, 0.0))
    moved = {
        side: [p.replace(at=tuple(scale * np.array(p.at))) for p in getattr(base, side)]
        for side in ("w", "u", "y", "z")
    }
    return base.replace(**moved)


@cache
def machine(kind, zeta, elements):
    """A plate with all its DOFs and the hidden mass at half its width, a quarter of its length."""
    size = PLATES[kind]["size"]
    bare = kirchhoff_plate(elements=elements, poisson_ratio=0.35, **PLATES[kind])
    damped = bare.with_damping(ModalDamping(zeta))
    row = damped.dofs.row((size[0] / 2, size[1] / 4, 0.0), "z")
    return FEModel(damped.M + 0.5 * np.outer(row, row), damped.K, damped.D, dofs=damped.dofs)


@cache
def all_modes(kind, zeta, elements=ELEMENTS):
    return solve_modes(machine(kind, zeta, elements))


def on_machine(kind, zeta, level):
    return sampled(all_modes(kind, zeta, OTHER), channels(kind, level))


def filter_of(kind, zeta, level, count=24):
    modes = all_modes(kind, zeta)
    return design_kalman(
        sampled(modes.select(range(count)), channels(kind, level)).replace(evaluation=modes)
    )


@pytest.mark.slow
def test_covariances_are_those_of_the_closed_form():
    modes = solve_modes(make_plate(), damping=ModalDamping(0.01))
    plant = sampled(modes.select(range(24)))
    found = left_out(plant, plant.replace(evaluation=modes).evaluation_plant)
    assert found.modes.tolist() == list(range(25, modes.n_modes + 1))
    dofs = modes.dofs
    see = np.array([dofs.row((0.3, 0.3, 0.0), axis) for axis in ("z", "rx", "ry")])
    see = np.vstack([see, *(dofs.row(p, "z")[None] for p in CORNERS)])
    push = np.array([dofs.row(p, "z") for p in INSET])
    out = slice(24, None)
    expected = truncated_covariance(
        modes.omega[out], modes.zeta[out], see @ modes.phi[:, out], push @ modes.phi[:, out], 1e-3
    )
    scale = np.sqrt(np.outer(*[np.diag(expected)] * 2))
    whole = np.block([[found.pois, found.cross], [found.cross.T, found.sensors]])
    np.testing.assert_allclose(whole / scale, expected / scale, atol=1e-9)


def test_a_filter_far_above_all_modes_changes_no_covariance():
    modes = solve_modes(chain(masses=[1.0] * 4, stiffnesses=[4e5] * 3), damping=ModalDamping(0.01))
    found = []
    for shape in (None, low_pass_filter(1e6)):
        w = [Disturbance("amp", at="1:x", asd=1.0, shape=shape)]
        channels = three_masses().assembled.ports.replace(w=w)
        plant = assemble_plant(modes.select([0, 1, 2]), channels).discretized(2e3, delay=1)
        found.append(
            float(left_out(plant, plant.replace(evaluation=modes).evaluation_plant).pois[0, 0])
        )
    assert found[1] == pytest.approx(found[0], rel=1e-6, abs=0)


@pytest.mark.long
def test_the_prediction_is_the_error_on_the_evaluation_plant_by_frequency():
    """Oracle: the integral of the error's density over all frequencies."""
    modes = all_modes("paper", 0.001).select(range(40))
    plant = sampled(modes.select(range(24)))
    estimator = design_kalman(plant.replace(evaluation=modes))
    expected = error_by_frequency(*dictionaries(sampled(modes), estimator.system))
    np.testing.assert_allclose(estimator.variances, expected, rtol=5e-3)
    assert estimator.certificate["truncated modes"] == 16
    assert estimator.certificate["difference"] < 1e-9


def dictionaries(plant, observer):
    g = plant.system
    rows, seen = g.output_index(AXES), g.output_index(["y1", "y2", "y3", "y4"])
    truth = {"A": g.A, "C1": g.C[rows], "C2": g.C[seen], "factor": plant.noise_factor}
    truth["R"] = plant.sensor_noise[:4, :4]
    return truth, {"A": observer.A, "B": observer.B[:, :4], "C": observer.C, "D": observer.D[:, :4]}


def test_a_plant_that_moves_as_a_rigid_body_only():
    """No elastic mode is in the plant: all those of the evaluation model are noise."""
    model = chain(masses=[1.0, 2.0, 1.5], stiffnesses=[4e6, 5e6])
    modes = solve_modes(model, count=3, damping=ModalDamping(0.01))
    channels = Ports(
        w=[Disturbance("d", at="1:x", asd=1e-3)],
        u=[Actuator("u", at="1:x")],
        z=[Poi("die", at="3:x", axes=("x",))],
        y=[Sensor("y", at="2:x", asd=1e-11)],
    )
    whole = assemble_plant(modes, channels).discretized(5e3, delay=1)
    body = assemble_plant(modes.select([0]), channels, evaluation=modes)
    estimator = design_kalman(body.discretized(5e3, delay=1))
    assert estimator.certificate["truncated modes"] == 2
    g, filter_ = whole.system, estimator.system
    rows, seen = g.output_index(["die:x"]), g.output_index(["y"])
    truth = {"A": g.A, "C1": g.C[rows], "C2": g.C[seen], "factor": whole.noise_factor}
    truth["R"] = whole.sensor_noise
    own = {"A": filter_.A, "B": filter_.B[:, :1], "C": filter_.C, "D": filter_.D[:, :1]}
    expected = error_by_frequency(truth, own)
    np.testing.assert_allclose(estimator.variances, expected, rtol=5e-3)


@pytest.mark.slow
def test_a_filter_that_knows_nothing_of_them_claims_too_little():
    """On the updated model with an attachment vector, 0.1 % damping: claims and errors."""
    modes = all_modes("paper", 0.001)
    fit = fitted(stage_model(0.001), modes.poles[[5, 6]])
    for level, claim, truth, cured in ((1e-3, 0.305e-9, 1.56e-9, 0.87e-9),
                                       (1e-2, 2.38e-9, 21.5e-9, 8.69e-9)):  # fmt: skip
        plant, whole = sampled(fit.model, ports(level)), sampled(modes, ports(level))
        blind, knowing = design_kalman(plant), design_kalman(plant.replace(evaluation=modes))
        assert blind.rms("die") == pytest.approx(claim, rel=0.02, abs=0)
        assert blind.rms("die", on=whole) == pytest.approx(truth, rel=0.02, abs=0)
        assert "truncation is not in these numbers" in repr(blind)
        assert blind.certificate.get("truncated modes") is None
        assert knowing.rms("die") == pytest.approx(cured, rel=0.02, abs=0)
        assert knowing.rms("die", on=whole) == pytest.approx(knowing.rms("die"), rel=1e-9, abs=0)
        assert "with 219 truncated modes" in repr(knowing)


@pytest.mark.long
def test_modes_left_out_as_noise_forgive_what_is_not_known_of_them():
    """Above mode 24 frequencies off by 1 % and damping by 40 %: against a filter on 160 modes."""
    true = machine("paper", 0.001, ELEMENTS)
    bare = FEModel(true.M, true.K, dofs=true.dofs)
    modes, channel = solve_modes(bare, damping=ModalDamping(0.001)).select(range(160)), ports(1e-3)
    few, many = (
        design_kalman(sampled(modes.select(range(count)), channel).replace(evaluation=modes))
        for count in (40, 160)
    )
    assert 1e9 * few.rms("die") == pytest.approx(0.774, rel=0.01)
    assert 1e9 * many.rms("die") == pytest.approx(0.685, rel=0.01)  # what more modes promise
    found = []
    for seed in range(3):
        off = np.random.default_rng(seed).standard_normal((2, modes.n_modes - 24))
        omega, zeta = modes.omega.copy(), modes.zeta.copy()
        omega[24:] *= 1 + 0.01 * off[0]
        zeta[24:] *= np.exp(0.4 * off[1] - 0.08)
        other = sampled(modes.replace(omega=omega, zeta=zeta), channel)
        found.append([1e9 * filter_.rms("die", on=other) for filter_ in (few, many)])
    robust, fragile = np.sqrt(np.mean(np.square(found), axis=0))
    assert robust == pytest.approx(0.87, rel=0.03)
    assert fragile > 1.08 * robust
    assert fragile > 1.3 * 1e9 * many.rms("die")


@pytest.mark.slow
def test_modes_that_the_reduced_model_knows_are_the_default():
    real = solve_modes(make_plate(elements=(4, 4)), count=40, damping=ModalDamping(0.01))
    grid = [real.dofs.nearest((x, y, 0), "z") for x in (0, 0.3, 0.6) for y in (0, 0.3, 0.6)]
    for method in (DesiredDofs(grid), ModalTruncation(9), ModalTruncation(9, static_at=["1:z"])):
        plant = sampled(reduce(real, method))
        found = design_kalman(plant)
        assert found.certificate["truncated modes"] == 31
        assert found.rms("die") == pytest.approx(
            design_kalman(plant.replace(evaluation=real)).rms("die"), rel=1e-6, abs=0
        )
        # a reduced model given as the evaluation model counts what it left out itself
        given = design_kalman(
            sampled(real.select(range(9))).replace(evaluation=reduce(real, method))
        )
        assert given.certificate["truncated modes"] == 31
        # without them truncation is not in the error
        alone = design_kalman(plant.replace(evaluation=None))
        assert alone.certificate.get("truncated modes") is None
        assert "not judged on a larger model: truncation is not in" in repr(alone)
        assert alone.left_out is None
        assert alone.rms("die") < found.rms("die")
        assert design_static(plant).rms("die") == pytest.approx(
            design_static(sampled(real)).rms("die"), rel=1e-9, abs=0
        )
        bare = design_static(plant.replace(evaluation=None)).rms("die")
        assert bare != pytest.approx(design_static(plant).rms("die"), rel=1e-3, abs=0)


def steady_error(truth, observer):
    """|z - hat| after a smooth step of u to an acceleration of 0.5 m/s^2, without noise."""
    g, seen = truth.system, [*AXES[:1], "y1", "y2", "y3", "y4"]
    rows, columns = g.output_index(seen), g.input_index(truth.u)
    C, D = g.C[rows], g.D[np.ix_(rows, columns)]
    read = [observer.inputs.index(name) for name in (*seen[1:], *truth.u)]
    By, Dy, B = observer.B[:, read], observer.D[0, read], g.B[:, columns]
    x, own = np.zeros(g.n_states), np.zeros(observer.n_states)
    force = 0.5 * 0.6 * 0.6 * 0.0272 * 2702 / 4
    for k in range(1500):
        u = np.full(4, force * np.sin(np.pi * min(k / 1000, 0.5)) ** 2)
        motion = C @ x + D @ u
        y = np.concatenate([motion[1:], u])
        error = motion[0] - observer.C[0] @ own - Dy @ y
        own, x = observer.A @ own + By @ y, g.A @ x + B @ u
    return abs(error)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.5, 1.0])
@pytest.mark.parametrize("attached", [False, True])
def test_a_steady_force_bends_the_modes_left_out_and_the_filter_knows(attached, delay):
    """Nanometres, with an attachment vector in the model (whose compliance counts once) or not."""
    modes = solve_modes(make_plate(), damping=ModalDamping(0.01)).select(range(120))
    small = stage_model(0.01) if attached else modes.select(range(24))
    die = ports(die=(0.05, 0.05, 0.0))
    plant, whole = (sampled(model, die, delay=delay) for model in (small, modes))
    blind, knowing = design_kalman(plant), design_kalman(plant.replace(evaluation=modes))
    assert steady_error(whole, blind.system) > 1.5e-9
    assert steady_error(whole, knowing.system) < 0.01e-9


def shaped(kind):
    """Channels with filters, delays and a velocity sensor."""
    base = ports(die=(0.1, 0.2, 0.0))
    if kind == "disturbance":
        return base.replace(w=[d.replace(shape=low_pass_filter(800.0)) for d in base.w])
    if kind == "filter":
        return base.replace(y=[s.replace(dynamics=low_pass_filter(2500.0)) for s in base.y])
    if kind == "delay":
        return base.replace(y=[s.replace(latency=3.3e-5) for s in base.y])
    if kind == "actuator":
        return base.replace(u=[a.replace(dynamics=low_pass_filter(900.0)) for a in base.u])
    speed = Sensor("v", at=(0.3, 0.3, 0.0), quantity="velocity", asd=1e-7)
    return base.replace(y=[*base.y, speed])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["disturbance", "filter", "delay", "actuator", "velocity"])
def test_filters_delays_and_shapes_act_on_the_modes_left_out(kind):
    """From many times the best possible error to less than twice: dynamics are accounted for."""
    modes = solve_modes(make_plate(elements=(4, 4)), count=30, damping=ModalDamping(0.003))
    plant, whole = (sampled(m, shaped(kind)) for m in (modes.select(range(14)), modes))
    blind, knowing = design_kalman(plant), design_kalman(plant.replace(evaluation=modes))
    best = design_kalman(whole).rms("die")
    assert knowing.rms("die") < 2.0 * best
    assert blind.rms("die", on=whole) > 1.5 * knowing.rms("die")
    assert knowing.rms("die", on=whole) == pytest.approx(knowing.rms("die"), rel=1e-9, abs=0)


@pytest.mark.slow
def test_damping_that_couples_the_modes_of_the_evaluation_plant():
    """The dense form: internal damper, one pair of modes overdamped."""
    bare = make_plate(elements=(4, 4)).with_damping(ModalDamping(0.01))
    rows = [bare.dofs.row((x, 0.15, 0.0), "z") for x in (0.15, 0.3, 0.45)]
    bend = rows[1] - 0.5 * (rows[0] + rows[2])
    model = FEModel(bare.M, bare.K, bare.D + 3e4 * np.outer(bend, bend), dofs=bare.dofs)
    with pytest.warns(FlexplantWarning, match="dense"):
        whole = sampled(model)
    plant = sampled(reduce(model, ModalTruncation(16)))
    knowing = design_kalman(plant.replace(evaluation=whole))
    blind = design_kalman(plant)
    assert knowing.rms("die") < blind.rms("die", on=whole)
    assert knowing.certificate["difference"] < 1e-6


def test_mode_by_mode_and_all_at_once_give_the_same_variances(monkeypatch):
    modes = solve_modes(make_plate(elements=(4, 4)), count=30, damping=ModalDamping(0.003))
    whole = sampled(modes)
    observer = design_kalman(sampled(modes.select(range(12))).replace(evaluation=modes)).system
    fast = error_variances(whole, observer).values
    monkeypatch.setattr("flexplant.estimation.error._plant_modes", lambda *_: None)
    np.testing.assert_allclose(fast, error_variances(whole, observer).values, rtol=1e-8)


def test_a_gain_with_one_sign_flipped_has_another_error():
    modes = solve_modes(make_plate(elements=(4, 4)), count=30, damping=ModalDamping(0.01))
    whole = sampled(modes)
    found = design_kalman(sampled(modes.select(range(12))).replace(evaluation=modes))
    D = np.array(found.system.D)
    D[0, 0] *= -1
    with pytest.raises(AssumptionError, match="grows without limit"):
        error_variances(whole, found.system.replace(D=D))
    # without a rigid-body part it is an error, and a larger one
    D = np.array(found.system.D)
    D[0, :4] *= 1 + 0.2 * np.array([1, -1, -1, 1])
    C = found.system.C[0] - (D - found.system.D)[0, :4] @ found.plant.C2[:4]
    worse = found.system.replace(D=D, C=np.vstack([C, found.system.C[1:]]))
    assert error_variances(whole, worse).values[0] > 1.001 * found.variances[0]


def test_refusals():
    modes = solve_modes(make_plate(elements=(4, 4)), count=30, damping=ModalDamping(0.01))
    plant = sampled(modes.select(range(12)))
    with pytest.raises(ModelError, match="9 elastic modes"):
        design_kalman(sampled(modes.select(range(20))).replace(evaluation=modes.select(range(12))))
    undamped = modes.replace(zeta=np.where(np.arange(30) < 12, modes.zeta, 0.0))
    with pytest.raises(ModelError, match="no damping"):
        design_kalman(plant.replace(evaluation=undamped))
    found = design_kalman(plant.replace(evaluation=modes))
    with pytest.raises(LabelError, match="channel of y"):
        found.rms("die", on=sampled(modes, ports(y=ports().y[:3])))
    with pytest.raises(ModelError, match="sampling time"):
        found.rms("die", on=assemble_plant(modes, ports()))
    with pytest.raises(AssumptionError, match="grows without limit"):
        moved = [sensor.replace(at=(0.3, 0.3, 0.0)) for sensor in ports().y[:1]]
        error_variances(sampled(modes, ports(y=[*moved, *ports().y[1:]])), found.system)


#: every plate, damping and level twice, no two of them together twice
CASES = [(kind, DAMPINGS[(i + j) % 2], LEVELS[(i + 2 * j) % 3])
         for i, kind in enumerate(PLATES) for j in range(2)]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "zeta", "level"),
    [pytest.param(*case, marks=[pytest.mark.long] * (i % 2)) for i, case in enumerate(CASES)],
)
def test_predicted_within_five_percent_on_machines_of_another_mesh(kind, zeta, level):
    estimator, truth = filter_of(kind, zeta, level), on_machine(kind, zeta, level)
    error = estimator.rms("die", on=truth)
    assert estimator.rms("die") == pytest.approx(error, rel=0.05, abs=0)
    assert error < 1.02 * design_kalman(estimator.plant).rms("die", on=truth)


def test_densities_changed_afterwards_are_those_of_modes_left_out_too():
    """`plant.replace(asd=)` and ports of that density: one error of the filter, judged or not."""
    modes = solve_modes(chain(masses=[1.0] * 4, stiffnesses=[4e5] * 3), count=4,
                        damping=ModalDamping(0.01))  # fmt: skip
    own = three_masses().assembled.ports
    loud = own.replace(w=[port.replace(asd=30.0 * port.asd) for port in own.w])

    def made(given, used):
        return assemble_plant(given, used).discretized(2e3, delay=1)

    few, asd = modes.select([0, 1, 2]), made(modes, loud).asd
    wanted = design_kalman(made(few, loud).replace(evaluation=made(modes, loud))).rms("die:x")
    plant, whole = (made(given, own).replace(asd=asd) for given in (few, modes))
    for judge in (whole, modes):
        assert design_kalman(plant.replace(evaluation=judge)).rms("die:x") == pytest.approx(
            wanted, rel=1e-9
        )
    assert design_kalman(made(few, own).replace(evaluation=modes)).rms("die:x") < 0.5 * wanted
