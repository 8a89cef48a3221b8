"""Draws of whole machines: against matrices that are changed by hand, and their own statistics."""

import re
import warnings

import numpy as np
import pytest
import scipy.linalg as la
import scipy.stats

import flexplant as fx
from flexplant.errors import AssumptionError, ModelError
from flexplant.estimation.filter_models import _difference, _driven_modes
from flexplant.plant.machine_draws import MachineFamily, small_exponential
from flexplant.plant.machine_plants import interval_of, interval_text
from flexplant.plant.realisation import realise
from flexplant.simulation import exposure_errors
from flexplant.updating.machines import Draw

STEEL = {"density": 7850.0, "youngs_modulus": 210e9, "area": 1e-3, "inertia": 8e-8}
HEAVIER = 0.3


def beam(cells=12):
    return fx.beam(length=1.0, elements=cells, **STEEL)


def measured_of(model, count, rng, scatter=2e-3, covariance=True):
    """Poles of the true machine: a mass more, scattered frequencies and dampings."""
    true = model.with_parts(fx.PointMass("7:z", HEAVIER))
    omega = fx.solve_modes(true, count=2 + count).omega[2:]
    omega = omega * np.exp(scatter * rng.normal(size=count))
    zeta = 0.01 * np.exp(0.2 * rng.normal(size=count))
    poles = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
    std = (1e-6 * np.abs(poles)) ** 2 if covariance else None
    return fx.MeasuredModes(poles, modes=range(3, 3 + count), covariance=std)


def ports():
    return fx.Ports(
        w=[fx.Disturbance(f"amp{i}", at=(x, 0, 0), asd=1e-3) for i, x in ((1, 0.25), (2, 0.75))],
        u=[fx.Actuator(f"u{i}", at=(x, 0, 0)) for i, x in ((1, 0.25), (2, 0.75))],
        z=[fx.Poi("die", at=(0.5, 0, 0), axes=("z", "ry"))],
        y=[fx.Sensor(f"y{i}", at=(x, 0, 0), asd=1e-11) for i, x in ((1, 0.0), (2, 1.0))],
        references=[fx.Reference("die", axes=("z", "ry"))],
    )


class Case:
    def __init__(self, count=7, seed=1, **options):
        rng = np.random.default_rng(seed)
        self.full = beam()
        damping = fx.ModalDamping(0.01)
        modes = fx.solve_modes(self.full, count=12, damping=damping)
        rom = fx.reduce(modes, fx.DesiredDofs(fx.select_dofs(modes, 12, required=["7:z"]).labels))
        self.measured = measured_of(self.full, count, rng, **options)
        unknown = [fx.AddedMass("7:z"), fx.MatrixParameter("E", dK=rom.K)]
        with warnings.catch_warnings(action="ignore"):  # scatter is more than noise
            self.fit = fx.update(rom, unknown, [fx.Eigenvalues(self.measured)])
        mass, stiffer = self.fit.values
        changed = beam().replace(K=self.full.K * (1 + stiffer))
        self.changed = changed.with_parts(fx.PointMass("7:z", mass))
        self.whole = fx.solve_modes(self.changed, count=26, damping=damping)
        self.machines = self.fit.machines(self.measured)

    def plant(self):
        whole = self.whole.calibrated(self.measured)
        model = self.fit.calibrated(self.measured)
        return fx.assemble_plant(model, ports(), evaluation=whole).discretized(5e3, delay=1)


@pytest.fixture(scope="module")
def case():
    return Case()


@pytest.fixture(scope="module")
def plant(case):
    return case.plant()


def drawn(family, *, s=0.0, dp=(0.0, 0.0), b=0.0, r=0.5, seed=1):
    poles = 2j * np.pi * family.machines.trend.model_freq  # where they are
    draw = Draw(s, np.array(dp), b, r, (0.0, 0.0), poles, np.random.default_rng(seed))
    return family._modes(draw)


def own(realisation):
    """Omega (b,) and shapes over the evaluation model's modes (b, b) of a drawn machine."""
    omega = np.sqrt(np.maximum(np.linalg.det(realisation.pairs), 0.0))
    omega[: realisation.n_rigid] = 0.0
    return omega, realisation.inputs[:, 1::2]


def unmeasured(case):
    return slice(2 + len(case.measured), None)


def test_parameters_move_modes_as_changed_matrices_do(case):
    """All modes of the full model are in the evaluation model: the changes are exact."""
    family = MachineFamily(realise(case.whole), case.machines)
    omega, V = own(drawn(family, dp=(0.07, 0.0)))
    M = case.changed.M.toarray()
    row = case.full.dofs.row("7:z")
    exact, _ = la.eigh(case.changed.K.toarray(), M + 0.07 * np.outer(row, row))
    np.testing.assert_allclose(omega[unmeasured(case)] ** 2, exact[unmeasured(case)], rtol=1e-6)
    # shapes have unit mass on the changed machine
    shapes = family.over @ V
    gram = shapes.T @ (M + 0.07 * np.outer(row, row)) @ shapes
    assert np.abs(gram - np.eye(len(gram))).max() < 1e-6


def test_a_stiffness_of_the_reduced_model_is_carried_to_all_modes(case):
    family = MachineFamily(realise(case.whole), case.machines)
    omega, _ = own(drawn(family, dp=(0.0, 0.02)))
    at = unmeasured(case)
    scale = np.sqrt(1.0 + 0.02 / (1.0 + case.fit["E"]))
    np.testing.assert_allclose(omega[at] / family.omega[at], scale, rtol=2e-3)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("slope", [-0.02, 0.01])
def test_a_trend_moves_frequencies_and_its_share_of_mass_shapes(case, share, slope):
    family = MachineFamily(realise(case.whole), case.machines)
    omega, V = own(drawn(family, b=slope, r=share))
    g = family.omega / (2 * np.pi * case.measured.freq.max())
    t = 0.5 * np.sign(slope) * np.log(1 + 2 * abs(slope) * g)
    at = unmeasured(case)
    np.testing.assert_allclose(np.log(omega[at] / family.omega[at]), t[at], rtol=1e-6)
    size = np.abs(np.diag(V))
    np.testing.assert_allclose(size[at], np.exp(share * t[at]), rtol=1e-6)


def test_scatter_moves_frequencies_and_shapes_together(case):
    family = MachineFamily(realise(case.whole), case.machines)
    s, at = 2e-3, unmeasured(case)
    found = [own(drawn(family, s=s, seed=i)) for i in range(60)]
    moved = np.array([np.log(omega[at] / family.omega[at]) for omega, _ in found])
    assert moved.std() == pytest.approx(s, rel=0.15)
    # first order: E_ij omega_i omega_j / (omega_j^2 - omega_i^2), of deviation sqrt(2) s
    i, j = 12, 13
    turned = np.array([V[i, j] * np.sign(V[j, j]) for _, V in found])
    w = family.omega
    expected = np.sqrt(2) * s * w[i] * w[j] / (w[j] ** 2 - w[i] ** 2)
    assert turned.std() == pytest.approx(expected, rel=0.35)
    # nobody weighed the machine: the rigid-body gain has twice the deviation of a frequency
    gain = np.array([np.log(V[0, 0] ** 2 + V[1, 0] ** 2) for _, V in found])
    assert gain.std() == pytest.approx(2 * s, rel=0.35)


def test_elastic_shapes_move_the_rigid_body_where_nobody_weighed_it(case):
    """Momentum of a hidden mass: the rigid part of a shape has the deviation of the scatter."""
    family = MachineFamily(realise(case.whole), case.machines)
    found = np.array([own(drawn(family, s=2e-3, seed=i))[1] for i in range(60)])
    at = unmeasured(case)
    part = found[:, :2, at] * np.sign(np.diagonal(found, axis1=1, axis2=2))[:, None, at]
    assert part.std() == pytest.approx(np.sqrt(2) * 2e-3, rel=0.15)


@pytest.mark.parametrize("first", [1, 0])
@pytest.mark.parametrize("seed", range(3))
def test_a_body_on_isolators_stays_as_stiff_as_its_scattered_springs(seed, first):
    """In the mode of the isolator the body bends as before, whether it was measured or not."""
    rng, springs, s = np.random.default_rng(seed), np.full(5, 4e6), 0.01
    held = fx.chain(masses=rng.uniform(0.5, 2.0, 6), stiffnesses=springs, ground=[2e2] + [0.0] * 5)
    modes = fx.solve_modes(held, damping=fx.ModalDamping(0.01))
    poles = modes.poles[first:] * np.exp(s * rng.standard_normal(6 - first))
    measured = fx.MeasuredModes(poles, modes=range(1 + first, 7))
    with warnings.catch_warnings(action="ignore"):  # scatter is more than noise
        fit = fx.update(held, [fx.AddedMass("3:x")], [fx.Eigenvalues(measured)])
    family = MachineFamily(realise(modes), fit.machines(measured))

    def stretch(shape):
        return np.linalg.norm(np.diff(shape)) / np.linalg.norm(shape)

    model = stretch(modes.phi[:, 0])
    found, true = [], []
    for draw in range(10):
        V = own(drawn(family, s=s, dp=(0.0,), seed=draw))[1]
        found.append(stretch(family.over @ V[:, 0]) / model)
        k = springs * np.exp(2 * s * rng.standard_normal(5))
        rows = np.diff(np.eye(6), axis=0)
        K = rows.T @ (k[:, None] * rows) + np.diag([2e2] + [0.0] * 5)
        true.append(stretch(la.eigh(K, held.M.toarray())[1][:, 0]) / model)
    assert max(np.abs(np.array(true) - 1)) < 0.1
    assert max(np.abs(np.array(found) - 1)) < 0.1


@pytest.mark.parametrize("angle", [-1.2, 0.3, 0.9])
def test_close_pairs_turn_to_their_measured_shapes(case, angle):
    """What was measured is a pair turned by an angle, each shape with any factor."""
    points = np.array([[x, 0.0, 0.0] for x in (0.0, 0.2, 0.55, 0.7)])
    rows = np.array([case.whole.at(tuple(p)) for p in points.tolist()])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shapes = np.zeros((4, len(case.measured)), dtype=complex)
    shapes[:, 2:] = 1.0
    shapes[:, :2] = rows[:, 2:4] @ turn * [2.0, -0.3j]
    named = {f"s{i}": tuple(point) for i, point in enumerate(points.tolist())}
    measured = case.measured.replace(shapes=shapes, dofs=list(named))
    known = measured.replace(xyz=points, directions=("z",) * 4)
    family = MachineFamily(realise(case.whole), case.fit.machines(known))
    assert family.pairs == []  # a beam has none
    family.pairs = [(0, 1)]
    V = family._turned(np.eye(family.omega.size), family.measured)
    np.testing.assert_allclose(np.abs(V[2:4, 2:4]), np.abs(turn), atol=5e-3)
    np.testing.assert_allclose(V.T @ V, np.eye(len(V)), atol=1e-12)
    # the points come with the numbers
    with warnings.catch_warnings(action="ignore"):
        found = fx.numbered(measured.replace(modes=None), case.whole, at=named, least_mac=0.0)
    np.testing.assert_array_equal(found.xyz, points)
    assert MachineFamily(realise(case.whole), case.machines).pairs == []


@pytest.mark.parametrize("size", [1e-3, 0.03])
def test_the_small_exponential_is_that_of_scipy(size):
    E = size * np.random.default_rng(2).normal(size=(30, 30))
    E = E + E.T
    np.testing.assert_allclose(small_exponential(E), la.expm(E), rtol=1e-12, atol=1e-13)


def test_measured_poles_are_put_back():
    case = Case(covariance=False)
    for modes in machines_of(case, 5):
        poles = np.linalg.eigvals(modes.pairs[2 : 2 + len(case.measured)]).reshape(-1)
        poles = np.sort_complex(poles[poles.imag > 0])
        np.testing.assert_allclose(
            np.sort(np.abs(poles)), np.sort(np.abs(case.measured.poles)), rtol=1e-9
        )


def machines_of(case, count):
    """Drawn modes of a case."""
    family = MachineFamily(realise(case.whole), case.machines)
    return [family.machine(rng) for rng in np.random.default_rng(3).spawn(count)]


def test_dampings_scatter_as_the_measured_ones(case):
    """Student's predictive distribution of the logarithms of the measured dampings."""
    logs = np.log(-case.measured.poles.real / np.abs(case.measured.poles))
    m, at = logs.size, unmeasured(case)
    drawn_logs = []
    for modes in machines_of(case, 150):
        omega = np.sqrt(np.linalg.det(modes.pairs[at]))
        drawn_logs.append(np.log(-0.5 * np.trace(modes.pairs[at], axis1=1, axis2=2) / omega)[3])
    ratio = (np.array(drawn_logs) - logs.mean()) / (logs.std(ddof=1) * np.sqrt(1 + 1 / m))
    assert scipy.stats.kstest(ratio, scipy.stats.t(m - 1).cdf).pvalue > 0.01


@pytest.mark.slow
def test_a_plant_of_a_calibrated_model_has_machines_without_asking(case, plant):
    assert len(plant.machines.plants) == 40
    assert plant.machines.plants is plant.machines.plants
    first = plant.machines.plants[0]
    assert (first.u, first.y, first.dt, first.delay) == (plant.u, plant.y, plant.dt, plant.delay)
    # another plant of the same evaluation model has the same machines
    moved = plant.at(poi=(0.4, 0, 0))
    again = moved.machines.plants[0]
    assert again.assembled.realisation is first.assembled.realisation
    other = fx.assemble_plant(case.fit.model, ports(), evaluation=case.whole)
    assert other.machines is None
    stated = other.uncertain(case.fit.machines(case.measured, count=5)).nominal
    assert len(stated.machines.plants) == 5


def test_machines_are_plants_of_their_matrices(case, plant):
    """A drawn plant responds as one that is assembled from its modes by hand."""
    found = plant.machines.plants[3]
    modes = found.assembled.realisation
    omega, V = own(modes)
    zeta = -0.5 * np.trace(modes.pairs, axis1=1, axis2=2)[2:] / omega[2:]
    by_hand = case.whole.replace(
        omega=omega,
        zeta=np.append([0.0, 0.0], zeta),
        phi=case.whole.phi @ V,
        certificate=fx.loop.Certificate(),
    )
    plain = fx.assemble_plant(by_hand, ports()).discretized(5e3, delay=1)
    freq = np.array([3.0, 57.0, 411.0, 1300.0])
    ours, theirs = (fx.frequency_response(one.Gyu, freq).data for one in (found, plain))
    np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-7 * np.abs(theirs).max())


def test_intervals_are_predictive_of_a_log_normal_figure():
    rng = np.random.default_rng(6)
    held = []
    for _ in range(1500):
        values = np.exp(0.1 + 0.2 * rng.normal(size=12))
        low, high = interval_of(values, 0.9)
        held.append(low < np.exp(0.1 + 0.2 * rng.normal()) < high)
    assert np.mean(held) == pytest.approx(0.9, abs=0.03)
    with pytest.raises(AssumptionError, match=r"positive and finite, .* on 2 of 3 machines"):
        interval_of(np.array([1.0, 0.0, np.inf]), 0.9)


@pytest.mark.slow
def test_an_observer_says_where_its_error_lies(plant):
    observer = fx.design_kalman(plant)
    low, high, sentence = observer.interval("die:z", 0.95)
    assert low < observer.rms("die:z") < high
    assert "on 95 % of such machines" in sentence
    assert interval_text(58.66e-9, 58.99e-9, "m") == "58.6 to 59 nm"
    narrow = observer.interval("die", 0.5)
    assert low < narrow.low < narrow.high < high
    each = [observer.rms("die", on=machine) for machine in plant.machines.plants]
    assert np.mean([(low <= one <= high) for one in each]) > 0.9
    assert "on 95 % of such machines" in repr(observer)


@pytest.mark.slow
def test_densities_scatter_as_stated_or_are_said_to_be_as_given(case, plant):
    """Without scatter of the structure the error is that of the densities alone: log-normal."""
    observer = fx.design_kalman(plant)
    assert observer.interval("die").sentence.endswith("such machines, densities as given")
    sure = plant.uncertain(frequency=1e-9).plant.replace(evaluation=None)
    own = sure.assembled.ports

    def loud(ports, off):
        return [port.replace(asd_deviation=off) for port in ports]

    ports = own.replace(w=loud(own.w, 0.2), y=loud(own.y, 0.1))
    unsure = sure.with_ports(ports).uncertain(frequency=1e-9)
    machines = unsure.machines.drawn(200, rng=2)
    spread = {
        name: np.std(np.log([one.asd[name] / plant.asd[name] for one in machines]))
        for name in plant.asd
    }
    assert spread["amp1"] == pytest.approx(0.2, rel=0.2)
    assert spread["y1:noise"] == pytest.approx(0.1, rel=0.2)
    found = fx.design_kalman(unsure.nominal)
    assert found.interval("die").sentence.endswith("of such machines")
    each = [found.rms("die", on=one) for one in unsure.machines.plants]
    assert np.std(np.log(each)) > 0.05  # the noise that a filter meets is that of its machine
    low, high, _ = found.interval("die")
    assert low < np.median(each) < high


@pytest.mark.slow
def test_a_loop_says_where_its_figures_lie(plant):
    observer = fx.design_static(plant)
    servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    margin = loop.interval("modulus_margin")  # a space or an underscore
    assert 0 < margin.low < margin.high < 1
    each = [loop.around(one).modulus_margin for one in plant.machines.plants]
    assert margin.low < np.median(each) < margin.high
    radius = loop.interval("spectral radius")
    assert radius.low < loop.spectral_radius < radius.high < 1
    width = loop.interval("bandwidth")
    axes = ("die:ref", "die:ry:ref")
    reached = [
        fx.compare_loops({"servo": loop}, reference=axis).rows["servo"].bandwidth for axis in axes
    ]
    assert width.low < min(reached) < width.high
    rms = loop.interval("die:z")
    assert rms.low < loop.completed.rms("die:z") < rms.high
    assert "modulus margin" in repr(loop).split("such machines")[1]
    with pytest.raises(ModelError, match="figure"):
        loop.interval("margins")


def test_what_machines_do_beyond_a_model_is_the_covariance_of_the_difference(plant):
    """Two models side by side under the same noise: a Lyapunov equation of both."""
    one, other = plant.machines.plants[2], plant.machines.plants[5]
    parts = []
    for each in (one, other):
        g, r = each.continuous.system, 2 * each.n_rigid
        B = g.B[r:, [g.inputs.index(f"amp{i}") for i in (1, 2)]] * 1e-3 / np.sqrt(2)
        rows = [g.outputs.index(name) for name in ("die:z", "die:ry", "y1", "y2")]
        parts.append((g.A[r:, r:], B, g.C[rows, r:]))
    (A, B, C), (F, G, H) = parts
    X = la.solve_continuous_lyapunov(la.block_diag(A, F), -np.vstack([B, G]) @ np.vstack([B, G]).T)
    wanted = np.hstack([C, -H]) @ X @ np.hstack([C, -H]).T
    found = _difference(_driven_modes(one), _driven_modes(other))
    size = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    assert np.abs((found - wanted) / size).max() < 1e-6


@pytest.mark.slow
def test_a_filter_that_weighs_modes_by_their_uncertainty_has_lower_upper_ends(plant):
    plain = fx.design_kalman(plant)
    weighed = fx.design_kalman(plant, machines=plant.machines)
    ends = [[one.interval(name).high for name in ("die:z", "die:ry")] for one in (plain, weighed)]
    assert np.log(ends[1]).mean() <= np.log(ends[0]).mean()
    assert weighed.rms("die") >= 0.99 * plain.rms("die")  # the model alone is known best by plain


@pytest.mark.slow
def test_places_are_compared_machine_by_machine(plant):
    """Is a place of a sensor better? The ratio of errors varies less than the errors do."""
    own = plant.assembled.ports
    near = plant.with_ports(own.replace(y=[own.y[0], own.y[1].replace(at=(0.2, 0.0, 0.0))]))
    far, close = fx.design_kalman(plant), fx.design_kalman(near)
    low, high, sentence = far.compared(close, "die")
    pairs = zip(plant.machines.plants, near.machines.plants, strict=True)
    ratios = [far.rms("die", on=a) / close.rms("die", on=b) for a, b in pairs]
    assert low < np.median(ratios) < high
    assert f"smaller on {np.count_nonzero(np.less(ratios, 1.0))} of 40" in sentence
    width = np.std(np.log(ratios))
    assert np.log(high / low) == pytest.approx(2 * 2.02 * width, rel=0.1)
    alone = fx.design_kalman(plant.replace(evaluation=None))
    assert "evaluation=" in alone.compared(close, "die").sentence


@pytest.mark.slow
def test_budgets_and_comparisons_have_intervals(plant):
    observer = fx.design_static(plant)
    servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    assert loop.interval("die:z").sentence in repr(loop.budget("die:z"))
    text = repr(fx.compare_loops({"servo": loop}, reference="die:ref"))
    assert "servo on 95 % of such machines:" in text and "modulus margin" in text


@pytest.mark.slow
def test_placements_compare_places_machine_by_machine(plant):
    """The sentence of scores and of a placement is that of two filters on the same machines."""
    near = plant.assembled.ports.y[1].replace(name="near", at=(0.2, 0.0, 0.0))
    scores = fx.score_sensors(plant, [["y1", "near"], ["y1", "y2"]], candidates=[near])
    best, next_one = (fx.design_kalman(scores.on(plant, rank=i)) for i in (0, 1))
    low, high, _ = best.compared(next_one, "die")
    said = re.search(r"([\d.]+) to ([\d.]+) on 95 % of such machines", repr(scores))
    # rounded outwards to three digits
    assert [float(end) for end in said.groups()] == pytest.approx([low, high], rel=0.01)
    assert float(said[1]) <= low < high <= float(said[2])
    found = fx.place_sensors(plant, [plant.assembled.ports.y[0], near], 2)
    own = fx.design_kalman(plant)
    low, high, _ = fx.design_kalman(found.on(plant)).compared(own, "die")
    assert f"over the own sensors {low:.3g} to {high:.3g} on 95 %" in repr(found)
    alone = fx.score_sensors(plant.replace(evaluation=None), [["y1", "y2"], ["y1", "near"]],
                             candidates=[near])  # fmt: skip
    assert not alone.interval


@pytest.mark.slow
def test_any_figure_of_a_loop_has_an_interval(plant):
    """The MA of the error after a move, against runs on the machines one by one."""
    observer = fx.design_static(plant)
    servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    move = fx.setpoint(1e-4, velocity=0.01, acceleration=1.0, jerk=200.0)

    def ma(one):
        run = fx.simulate(one, reference={"die:ref": move}, duration=0.06, noise=False)
        return run.exposure("die:error", start=0.04)[0]

    low, high, sentence = loop.interval(ma, unit="m")
    each = [ma(loop.around(loop.plant.around(one))) for one in plant.machines.plants]
    assert (low, high) == pytest.approx(interval_of(np.array(each)))
    assert sentence.endswith("m on 95 % of such machines")


@pytest.mark.slow
def test_a_specification_says_what_is_met_on_machines(plant):
    """Each value of a verdict against loops that are closed around the machines one by one."""
    observer = fx.design_static(plant)
    servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    move = fx.setpoint(1e-4, velocity=0.01, acceleration=1.0, jerk=200.0)

    def run(one):
        return fx.simulate(one, reference={"die:ref": move}, duration=0.06, noise=False)

    limits = fx.Specification(
        ma=1e-4, settling=1e-3, noise=1e-6, bandwidth=1.0, modulus_margin=0.1,
        channel="die:error", start=0.04,
    )  # fmt: skip
    found = limits.check(loop, run)
    loops = [loop.around(loop.plant.around(one)) for one in plant.machines.plants]
    each = {
        "MA": [exposure_errors(run(one), start=0.041)["die:error"].ma for one in loops],
        "noise": [one.rms("die:error") for one in loops],
        "modulus margin": [one.modulus_margin for one in loops],
        "bandwidth": [fx.loop.bandwidth(one) for one in loops],
    }
    for name, values in each.items():
        at = found.names.index(name)
        wanted = interval_of(np.array(values))
        assert (found.low[at], found.high[at]) == pytest.approx(wanted, rel=1e-6)
        assert "on 95 % of such machines" in found.sentences[at]
    assert found.passed and np.all(found.met_on_machines[np.array(found.names) != "settling"])
    # a limit that the design model keeps and a part of the machines does not
    middle = float(np.sqrt(found.high[found.names.index("MA")] * found["MA"]))
    tight = limits.replace(ma=middle).check(loop, run)
    assert tight.met[tight.names.index("MA")] and not tight.met_on_machines[tight.names.index("MA")]
    (row,) = (line for line in repr(tight).splitlines() if line.startswith("MA"))
    assert " to " in row and row.endswith("NO")
    # one run cannot be repeated elsewhere, and without machines the table is as short as ever
    single = limits.check(loop, run(loop))
    assert np.isnan(single.low[single.names.index("MA")]) and "lambda one:" in repr(single)
    alone = fx.close_loop(plant.replace(evaluation=None), observer, servo)
    assert "such machines" not in repr(limits.check(alone, run))


@pytest.mark.long
def test_a_stage_is_judged_on_the_machines_of_its_fit(plant, monkeypatch):
    """Without stated frequencies they decide; with them the certificate has their margin too."""
    promised = "least modulus margin of 20 machines "
    for given, name in ((plant, "drawn"), (plant.uncertain(frequency=0.02), "of the fit")):
        found = fx.design_stage(given, bandwidth=20.0)
        loop = fx.close_loop(plant, found)
        each = [loop.around(one).modulus_margin for one in plant.machines.plants[:20]]
        assert found.certificate[promised + name] == pytest.approx(min(each))
        assert min(each) >= 0.35
    assert found.certificate[promised + "drawn"] != pytest.approx(min(each))

    def beyond(*_):
        raise ModelError("a mass is negative.")

    monkeypatch.setattr(fx.plant.PlantMachines, "_of_fit", beyond)
    again = fx.design_stage(plant.uncertain(frequency=0.02), bandwidth=20.0)
    with pytest.warns(fx.FlexplantWarning, match=r"no margin on machines of the fit: .* negative"):
        assert promised + "of the fit" not in again.certificate


@pytest.mark.slow
def test_the_response_of_the_fit_judges_loops(case):
    """A plant of a model that was fitted to a response says the same as plant.measured(frf)."""
    system = case.plant().continuous.Gyu.select(["y1", "y2"], ["u1", "u2"])
    frf = fx.frequency_response(system, np.linspace(1.0, 1500.0, 1500))
    places = {"y1": (0, 0, 0), "y2": (1, 0, 0), "u1": (0.25, 0, 0), "u2": (0.75, 0, 0)}
    fitted = fx.FrfResidual(frf, places=places, lines=range(25, 150))
    rom = case.fit.model
    with warnings.catch_warnings(action="ignore"):
        fit = fx.update(rom, [fx.MatrixParameter("E", dK=rom.K)], [fitted])
    model = fit.calibrated(case.measured)
    own = fx.assemble_plant(model, ports()).discretized(5e3, delay=1)
    observer = fx.design_static(own)
    servo = fx.design_servo(own, bandwidth=20.0, observer=observer)
    found = fx.close_loop(own, observer, servo).on_measurement
    wanted = fx.close_loop(own.measured(frf), observer, servo).on_measurement
    assert found.margin == wanted.margin > 0.1
    assert found.summary in repr(fx.close_loop(own, observer, servo))
    held = fx.assemble_plant(model.replace(machines=None), ports()).discretized(5e3, delay=1)
    assert fx.close_loop(held, observer, servo).on_measurement is None


@pytest.mark.slow
def test_the_report_says_where_figures_lie(plant, tmp_path):
    observer = fx.design_static(plant)
    loop = fx.close_loop(plant, observer, fx.design_servo(plant, bandwidth=20.0, observer=observer))
    text = fx.plot.report(tmp_path / "design.html", loop).read_text()
    for figure in ("modulus margin", "bandwidth"):
        assert loop.interval(figure).sentence in text


def test_a_sentence_stands_where_something_is_missing():
    few = Case(count=3)
    plant = few.plant()
    observer = fx.design_kalman(plant)
    low, high, sentence = observer.interval("die:z")
    assert (low, high) == (None, None)
    assert "measure 4 modes or more" in sentence
    assert "measure 4 modes or more" in repr(observer)
    alone = fx.design_kalman(plant.replace(evaluation=None))
    assert alone.interval("die:z").low is None
    assert "evaluation=" in alone.interval("die:z").sentence


def test_damping_that_couples_modes_leaves_a_sentence_in_place_of_an_interval(case):
    """Dampers beyond modal damping: nothing that is printed raises."""
    between = {"7:z": 1.0, "5:z": -0.5, "9:z": -0.5}  # no rigid-body motion
    damped = case.changed.with_damping(fx.structure.Rayleigh(0.0, 1e-6))
    damped = damped.with_parts(fx.Damper(between, 300.0))
    evaluation = fx.solve_modes(damped, count=26)
    model = case.fit.calibrated(case.measured)
    coupled = fx.assemble_plant(model, ports(), evaluation=evaluation).discretized(5e3, delay=1)
    observer = fx.design_kalman(coupled)
    assert "damping couples those of the evaluation model" in repr(observer)
    assert observer.interval("die:z").low is None
    with pytest.raises(ModelError, match="damping couples"):
        coupled.machines.drawn(2)
