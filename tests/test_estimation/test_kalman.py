"""The Kalman filter of the POI on the paper's plate: prediction, closed form, a run, refusals.

Machine and model are one mesh: the filter of a given plant is exact algebra. Other machines are in
`test_unseen_machines_benchmarks`.
"""

import pickle
from functools import cache

import numpy as np
import pytest

from flexplant.errors import (
    AssumptionError,
    CertificateError,
    LabelError,
    ModelError,
    ShapeError,
    SolverError,
)
from flexplant.estimation import Filter, Smoother, design_kalman, kalman
from flexplant.lti import StateSpace
from flexplant.lti.equations import difference_of
from flexplant.lti.riccati import riccati_root
from flexplant.modes import solve_modes
from flexplant.placement import score_sensors
from flexplant.plant import (
    Actuator,
    Disturbance,
    Poi,
    Ports,
    Reference,
    Sensor,
    StandardPlant,
    assemble_plant,
)
from flexplant.structure import ModalDamping, Spring, chain, kirchhoff_plate
from flexplant.synthesis import design_servo
from machines import stage
from oracles_estimation import mean_square_and_its_error, observer_error, run

L = 0.6
CORNERS = [(0, 0, 0), (L, 0, 0), (0, L, 0), (L, L, 0)]
INSET = [(0.075, 0.075, 0), (0.525, 0.075, 0), (0.075, 0.525, 0), (0.525, 0.525, 0)]


def ports(asd=1e-3, sensor_asd=1e-12, **changes):
    fields = {
        "w": [Disturbance(f"amp{i}", at=p, asd=asd) for i, p in enumerate(INSET, 1)],
        "u": [Actuator(f"u{i}", at=p) for i, p in enumerate(INSET, 1)],
        "z": [Poi("die", at=(0.31, 0.26, 0.0), axes=("z", "rx", "ry"))],
        "y": [Sensor(f"y{i}", at=p, asd=sensor_asd) for i, p in enumerate(CORNERS, 1)],
        "references": [Reference("die")],
    }
    return Ports(**(fields | changes))


def one_state(a, q=1.0, r=2.0):
    """x+ = a x + xi, y = x + v, z = x, with variances q and r per sample."""
    dt = 1e-3
    g = StateSpace(
        [[a]], [[1.0, 0.0, 0.0]], [[1.0], [1.0]], [[0, 0, 0], [0, 1.0, 0]], dt,
        inputs=["force", "y1:noise", "u1"], outputs=["die:z", "y1"],
    )  # fmt: skip
    asd = {"y1:noise": np.sqrt(2 * r * dt)}
    return StandardPlant.from_statespace(
        g, u=["u1"], y=["y1"], asd=asd, noise_factor=[[np.sqrt(q)]]
    )


@cache
def modes(zeta=1e-3, count=24):
    plate = kirchhoff_plate(
        size=(L, L),
        thickness=0.0272,
        elements=(8, 8),
        density=2702,
        youngs_modulus=70e9,
        poisson_ratio=0.35,
    )
    return solve_modes(plate, count=count, damping=ModalDamping(zeta))


def plate_plant(zeta=1e-3, *, delay=1.0, count=24, **changes):
    return assemble_plant(modes(zeta, count), ports(**changes)).discretized(1e4, delay=delay)


def dictionaries(plant, estimator):
    g = plant.system
    y = [name for name in plant.y if name not in plant.w]
    z = [name for name in plant.z if not name.endswith((":error", ":effort"))]
    rows = [plant.y.index(name) for name in y]
    o = estimator.system
    truth = {
        "A": g.A,
        "C1": g.C[g.output_index(z)],
        "C2": g.C[g.output_index(y)],
        "Q": plant.process_noise,
        "R": plant.sensor_noise[np.ix_(rows, rows)],
        "factor": plant.noise_factor,
    }
    k = len(y)
    assert tuple(o.inputs) == (*y, *plant.u)
    return truth, {"A": o.A, "By": o.B[:, :k], "Bu": o.B[:, k:], "C": o.C, "Dy": o.D[:, :k]}


PLANTS = {
    "1 %": lambda: plate_plant(1e-2),
    "0.1 %": lambda: plate_plant(1e-3),
    "0.1 %, loud sensors": lambda: plate_plant(1e-3, sensor_asd=1e-9),
    "0.1 %, loud forces": lambda: plate_plant(1e-3, asd=0.1, sensor_asd=1e-12),
    "fractional delay": lambda: plate_plant(1e-3, delay=1.6),
    "velocity too": lambda: plate_plant(
        1e-3, y=[*ports().y, Sensor("v", at=(0.3, 0.3, 0), quantity="velocity", asd=1e-8)]
    ),
    "by hand": stage,
}


@pytest.mark.parametrize("kind", PLANTS)
def test_closed_form_error_is_the_prediction(kind):
    plant = PLANTS[kind]()
    estimator = design_kalman(plant)
    variance = observer_error(*dictionaries(plant, estimator))
    channels = [name for name in plant.z if not name.endswith((":error", ":effort"))]
    predicted = np.array([estimator.rms(name) for name in channels])
    np.testing.assert_allclose(np.sqrt(variance), predicted, rtol=1e-6)
    assert estimator.certificate["difference"] < 1e-9
    assert estimator.certificate["residual"] < 1e-11
    radius = np.abs(np.linalg.eigvals(estimator.system.A)).max()
    assert estimator.certificate["spectral radius"] == pytest.approx(radius, rel=1e-6)
    assert radius < 1


@pytest.mark.parametrize("column", [0, 2])
def test_any_other_gain_is_worse(column):
    plant = plate_plant(1e-2, count=8)
    estimator = design_kalman(plant)
    truth, observer = dictionaries(plant, estimator)
    best = observer_error(truth, observer)[0]
    rng = np.random.default_rng(column)
    for size in (1e-2, 1e-1):
        L_other = estimator.gain * (1 + size * rng.standard_normal(estimator.gain.shape))
        moved = truth["A"] @ L_other
        other = {
            "A": truth["A"] - moved @ truth["C2"],
            "By": moved,
            "C": truth["C1"] - truth["C1"] @ L_other @ truth["C2"],
            "Dy": truth["C1"] @ L_other,
        }
        assert observer_error(truth, other)[0] > best * (1 + 1e-9)


@pytest.mark.long
@pytest.mark.parametrize("zeta", [1e-2, 1e-3])
def test_a_run_agrees_within_three_standard_errors(zeta):
    plant = plate_plant(zeta)
    estimator = design_kalman(plant)
    truth, observer = dictionaries(plant, estimator)
    rng = np.random.default_rng(5)
    steps = 20_000
    u = 0.1 * rng.standard_normal((steps, 4))
    errors = run(truth, observer, plant.B2, u, steps, rng, count=32)[steps // 4 :]
    for i, channel in enumerate(("die:z", "die:rx", "die:ry")):
        square, deviation = mean_square_and_its_error(errors[:, i])
        assert deviation < 0.05 * square
        assert abs(square - estimator.rms(channel) ** 2) < 3 * deviation


def test_without_noise_the_estimate_is_exact_also_with_feedthrough_of_u():
    plant = stage(delay=0.0)
    D = plant.system.D.copy()
    rows = plant.system.output_index(["y1", "y2"])
    D[np.ix_(rows, plant.system.input_index(plant.u))] = [[3e-9, 1e-9], [0.0, 2e-9]]
    plant = plant.replace(system=plant.system.replace(D=D))
    truth, o = dictionaries(plant, design_kalman(plant))
    Du = design_kalman(plant).system.D[:, 2:]
    rng = np.random.default_rng(0)
    x, xo = np.zeros(plant.system.n_states), np.zeros(plant.system.n_states)
    for _ in range(200):
        u = rng.standard_normal(2)
        y = truth["C2"] @ x + plant.D22[:2] @ u
        hat = o["C"] @ xo + o["Dy"] @ y + Du @ u
        np.testing.assert_allclose(hat, truth["C1"] @ x, atol=1e-18)
        xo = o["A"] @ xo + o["By"] @ y + o["Bu"] @ u
        x = truth["A"] @ x + plant.B2 @ u
    assert np.abs(truth["C1"] @ x).max() > 1e-9
    with pytest.raises(ModelError, match="feedthrough"):
        design_kalman(plant).to_filterpy()


@pytest.mark.parametrize("shape", [(-1,), (-1, 1)])
@pytest.mark.parametrize("make", [stage, plate_plant])
def test_filterpy_in_its_stationary_state_gives_the_same_estimates(make, shape):
    plant = make()
    estimator = design_kalman(plant)
    twin = pickle.loads(pickle.dumps(estimator.to_filterpy()))
    truth, observer = dictionaries(plant, estimator)
    rng = np.random.default_rng(1)
    x = np.zeros(plant.system.n_states)
    theirs, ours = [], []
    for _ in range(50):
        y, u = rng.standard_normal(twin.dim_z) * 1e-9, rng.standard_normal(twin.dim_u)
        twin.update(y.reshape(shape))
        assert twin.x.shape == (x.size, 1)
        theirs.append(truth["C1"] @ twin.x[:, 0])
        ours.append(observer["C"] @ x + observer["Dy"] @ y)
        x = observer["A"] @ x + observer["By"] @ y + observer["Bu"] @ u
        np.testing.assert_array_equal(twin.get_prediction(u.reshape(shape))[0].shape, (x.size, 1))
        twin.predict(u.reshape(shape))
    size = np.abs(ours).max(axis=0)
    np.testing.assert_allclose(np.array(theirs) / size, np.array(ours) / size, rtol=0, atol=1e-12)


@pytest.mark.parametrize("shape", [(-1,), (-1, 1)])
@pytest.mark.parametrize("make", [lambda: stage(delay=0.0), stage, plate_plant])
def test_the_smoother_of_filterpy_is_ours_where_u_is_zero(make, shape):
    """Singular covariances of delay lines included; both begin at the stationary covariance."""
    plant = make()
    estimator = design_kalman(plant)
    twin = estimator.to_filterpy()
    rng = np.random.default_rng(2)
    names = (*estimator.sensors, *plant.u)
    y = rng.standard_normal((40, twin.dim_z)) * np.sqrt(np.diag(twin.R))
    records = dict(zip(names, np.hstack([y, np.zeros((40, twin.dim_u))]).T, strict=True))
    means, covariances, *_ = twin.batch_filter([one.reshape(shape) for one in y], update_first=True)
    smooth, spread, *_ = twin.rts_smoother(means, covariances)
    C1, at_rest = estimator.model.C1, np.zeros(twin.dim_x)
    for lag, found in ((Filter(), means), (Smoother(), smooth)):
        ours = estimator.estimate(records, lag, start=at_rest)
        theirs = C1 @ found[:, :, 0].T
        size = np.abs(theirs).max(axis=1, keepdims=True)
        np.testing.assert_allclose(ours.data / size, theirs / size, rtol=0, atol=1e-12)
    variance = np.einsum("zi,kij,zj->zk", C1, spread, C1)
    np.testing.assert_allclose(ours.deviations**2, variance, rtol=1e-6)


def test_observers_and_controllers_in_python_control():
    plant = plate_plant(1e-2, count=8)
    estimator = design_kalman(plant)
    servo = design_servo(plant, bandwidth=30.0, observer=estimator)
    for value in (estimator, servo):
        theirs, g = value.to_control(), value.system
        assert (theirs.input_labels, theirs.output_labels) == (list(g.inputs), list(g.outputs))
        assert theirs.dt == g.dt
        z = np.exp(2j * np.pi * 0.01)
        np.testing.assert_allclose(theirs(z), g.evaluated(z), rtol=1e-9)


def test_filterpy_runs_without_commands_and_refuses_too_many():
    twin = design_kalman(stage()).to_filterpy()
    still = twin.batch_filter([np.zeros(2)] * 3)[0]
    assert still.shape == (3, twin.dim_x, 1)
    assert not still.any()
    with pytest.raises(ShapeError, match="u must have 2 entries"):
        twin.predict(np.zeros(3))
    with pytest.raises(ShapeError, match="y must have 2 entries"):
        twin.update(np.zeros((2, 2)))


def test_delays_of_u_cost_nothing():
    plain, late = (design_kalman(plate_plant(delay=d)) for d in (0.0, 2.5))
    assert late.rms("die") == pytest.approx(plain.rms("die"), rel=1e-9, abs=0)
    lines = [i for i, name in enumerate(late.system.states) if "delay" in name]
    assert len(lines) == 12
    assert not late.gain[lines].any()
    assert not late.covariance[lines].any()


def test_units_of_forces_and_motions():
    one = design_kalman(plate_plant())
    other = design_kalman(plate_plant(asd=1e6, sensor_asd=1e-3))
    assert other.rms("die") == pytest.approx(1e9 * one.rms("die"), rel=1e-9, abs=0)
    scale = np.abs(one.gain).max()
    np.testing.assert_allclose(other.gain, one.gain, atol=1e-9 * scale)


def test_more_noise_is_worse_and_a_sensor_more_is_better():
    base = design_kalman(plate_plant()).rms("die")
    assert design_kalman(plate_plant(sensor_asd=2e-12)).rms("die") > base
    assert design_kalman(plate_plant(asd=2e-3)).rms("die") > base
    more = [*ports().y, Sensor("y5", at=(0.3, 0.15, 0), asd=1e-12)]
    assert design_kalman(plate_plant(y=more)).rms("die") < base


def test_names():
    estimator = design_kalman(plate_plant())
    assert estimator.system.outputs == ("die:hat", "die:rx:hat", "die:ry:hat")
    assert estimator.system.inputs == ("y1", "y2", "y3", "y4", "u1", "u2", "u3", "u4")
    assert estimator.sensors == ("y1", "y2", "y3", "y4")
    assert len({estimator.rms(n) for n in ("die", "die:z", "die:hat", "die:error")}) == 1
    assert len({estimator.rms(n) for n in ("die:rx", "die:rx:hat", "die:rx:error")}) == 1
    assert estimator.rms("die:rx") != estimator.rms("die")
    for name in ("u1:effort", "dye", "y1"):
        with pytest.raises(LabelError, match="no POI channel"):
            estimator.rms(name)
    text = repr(estimator)
    assert "4 sensors" in text
    assert len(text.splitlines()) == 2
    assert "truncation is not in these numbers" in text


def test_the_repr_says_how_many_axes_it_leaves_out():
    every = ("x", "y", "z", "rx", "ry", "rz")
    pois = [Poi("die", at=(0.31, 0.26, 0.0), axes=every[2:5]), Poi("edge", at=CORNERS[0], axes="z")]
    for chosen, ending in (
        (pois, "rad, edge:z"),
        ([*pois, pois[1].replace(name="b")], "(1 more) ("),
    ):
        plant = assemble_plant(modes(1e-2, 9), ports(z=chosen)).discretized(1e4, delay=1)
        assert ending in repr(design_kalman(plant))


def test_saves_and_loads(tmp_path):
    from flexplant import load

    estimator = design_kalman(stage())
    estimator.save(tmp_path / "k.npz")
    again = load(tmp_path / "k.npz")
    np.testing.assert_array_equal(again.gain, estimator.gain)
    assert again.rms("die") == estimator.rms("die")


def test_certificate_refuses_a_wrong_gain():
    plant = plate_plant(1e-2)
    estimator = design_kalman(plant)
    model, P = estimator.model, estimator.covariance

    def difference(gain, covariance):
        return kalman.checked_error(model, gain, model.A @ gain, covariance)[1]

    assert difference(estimator.gain, P) < 1e-9
    flipped = estimator.gain.copy()
    flipped[:, 1] *= -1
    with pytest.raises(CertificateError, match="not stable"):
        difference(flipped, P)
    with pytest.raises(CertificateError, match="differ"):
        difference(0.99 * estimator.gain, P)
    with pytest.raises(CertificateError, match="differ"):
        difference(estimator.gain, P * (1 + 1e-5))


@pytest.mark.slow
@pytest.mark.parametrize("make", [stage, plate_plant])
def test_any_little_noise_of_the_sensors(make):
    """Below 1e-6 of the motion in a sample its square is lost in P: square roots keep it."""
    limit = None
    for asd in (1e-14, 1e-17, 1e-30):
        plant = make(asd=1.0, sensor_asd=asd)
        found = design_kalman(plant)
        variance = observer_error(*dictionaries(plant, found))
        assert np.sqrt(variance[0]) == pytest.approx(found.rms("die"), rel=1e-6, abs=0)
        assert limit is None or found.rms("die") == pytest.approx(limit, rel=1e-4, abs=0)
        limit = found.rms("die")


def on_soft_springs(at, asd, sensor_asd, rate=5e3):
    """A plate at 0.2 Hz: 1 mN beside 1 nm leaves P with parts that are 1e-16 of others."""
    plate = kirchhoff_plate(
        size=(0.6, 0.6), thickness=0.01, elements=(6, 6), density=2700.0, youngs_modulus=70e9,
        poisson_ratio=0.3,
    )  # fmt: skip
    stiffness = plate.mass * (2 * np.pi * 0.2) ** 2 / 4
    soft = plate.with_parts([Spring(f"{corner}:z", stiffness) for corner in (1, 7, 43, 49)])
    ports = Ports(
        w=[Disturbance("d", at=at, asd=asd)],
        u=[Actuator("u1", at="25:z")],
        y=[Sensor(f"y{node}", at=f"{node}:z", asd=sensor_asd) for node in (1, 7, 43)],
        z=[Poi("die", at=(0.3, 0.3, 0.0))],
    )
    modes = solve_modes(soft, count=12, damping=ModalDamping(0.001))
    return assemble_plant(modes, ports).discretized(rate, delay=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("at", ["25:z", "4:z", "1:z", (0.2, 0.1, 0.0)])
def test_one_disturbance_on_a_softly_mounted_plate(at):
    """Refused before ("the Stein series does not end"), in half of such cases."""
    found = {}
    for asd, noise in ((1e-3, 1e-9), (1e-6, 1e-12)):
        plant = on_soft_springs(at, asd, noise)
        found[asd, noise] = design_kalman(plant)
        variance = observer_error(*dictionaries(plant, found[asd, noise]))
        rms = found[asd, noise].rms("die")
        assert np.sqrt(variance[0]) == pytest.approx(rms, rel=2e-5, abs=0)
    # in other units it is the same problem
    milli, micro = found[1e-3, 1e-9].rms("die"), found[1e-6, 1e-12].rms("die")
    assert milli == pytest.approx(1e3 * micro, rel=1e-6, abs=0)
    layout = score_sensors(on_soft_springs(at, 1e-6, 1e-12), [["y1", "y7", "y43"]])
    assert np.sqrt(layout.values[0]) == pytest.approx(
        found[1e-6, 1e-12].rms("die"), rel=1e-6, abs=0
    )


def test_a_quiet_accelerometer_beside_a_held_disturbance():
    """Its own noise is 1e-17 of R: it was lost, and the error was 0.0 m with a certificate."""
    chained = chain(masses=(0.1, 0.1), stiffnesses=[1400.0], ground=2e4)
    ports = Ports(
        w=[Disturbance("d", at="1:x", asd=0.08, held=True)],
        u=[Actuator("u", at="1:x")],
        y=[
            Sensor("p", at="1:x", asd=1e-13),
            Sensor("a", at="2:x", quantity="acceleration", asd=1e-5),
        ],
        z=[Poi("die", at="2:x", axes=("x",))],
    )
    modes = solve_modes(chained, count=2, damping=ModalDamping(0.01))
    found = design_kalman(assemble_plant(modes, ports).discretized(32e3, delay=1.0))
    # by a doubling in 70 digits
    assert found.rms("die") == pytest.approx(4.9763315609e-13, rel=1e-6, abs=0)


def test_covariances_that_lack_digits_give_no_deviations():
    observer = design_kalman(plate_plant(1e-2))
    other = observer.replace(covariance=1.001 * observer.covariance)
    silent = dict.fromkeys((*other.sensors, *other.model.commands), np.zeros(50))
    with pytest.raises(SolverError, match=r"run it by observer\.system"):
        other.estimate(silent)
    assert difference_of(np.array([-1e-24]), np.array([-2e-24])) == np.inf


def test_square_roots_give_the_filter_that_covariances_give():
    plant = plate_plant(1e-2)
    found = design_kalman(plant)
    root = riccati_root(found.model.A, found.model.C2, found.model.G, found.model.H)
    scale = np.abs(found.predictor_gain).max(axis=1, keepdims=True) + 1e-300
    np.testing.assert_allclose(root.K / scale, found.predictor_gain / scale, atol=1e-7)
    assert root.change < 1e-9 and root.steps < 20  # from sensors of 8000 times the noise
    # with correlated noise of process and sensors: the gain of least error
    A, C, G, H = np.array([[0.9]]), np.eye(1), np.array([[1.0, 0.0]]), np.array([[0.5, 0.1]])
    gains = np.linspace(-2.0, 2.0, 40_001)
    errors = np.sum((G - gains[:, None] * H) ** 2, axis=1) / (1 - (0.9 - gains) ** 2)
    best = np.argmin(np.where(np.abs(0.9 - gains) < 1, errors, np.inf))
    root = riccati_root(A, C, G, H)
    assert root.K[0, 0] == pytest.approx(gains[best], abs=1e-4)
    assert root.L[0, 0] ** 2 == pytest.approx(errors[best], rel=1e-6)


def test_what_was_tried_before_the_square_roots_is_listed(monkeypatch):
    plant = plate_plant(1e-2)
    found = design_kalman(plant)

    def fails(model):
        raise SolverError("few digits")

    monkeypatch.setattr(kalman, "_design_by_covariance", fails)
    again = design_kalman(plant)
    np.testing.assert_allclose(again.variances, found.variances, rtol=1e-6)
    assert found.tried == ("Riccati equation of the covariance",)
    assert again.tried == (
        "Riccati equation of the covariance: few digits",
        "Newton's steps in square roots",
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda r: r._replace(K=-r.K), "not stable"),
        (lambda r: r._replace(L=1.02 * r.L), "differ"),
        (lambda r: r._replace(K=0.9 * r.K), "differ|not stable"),
    ],
)
def test_a_wrong_square_root_is_refused(monkeypatch, wrong, words):
    plant = on_soft_springs("1:z", 1e-4, 1e-12)
    monkeypatch.setattr(kalman, "riccati_root", lambda *given: wrong(riccati_root(*given)))
    with pytest.raises(CertificateError, match=words):
        design_kalman(plant)


def test_one_disturbance_leaves_rigid_body_modes_unexcited():
    with pytest.raises(AssumptionError, match="does not excite the rigid-body"):
        design_kalman(plate_plant(w=ports().w[:1]))


def test_too_few_sensors_do_not_see_the_rigid_body():
    with pytest.raises(AssumptionError, match="does not see the rigid-body"):
        design_kalman(plate_plant(y=ports().y[:2]))
    line = [Sensor(f"y{i}", at=(0.1 * i, 0.3, 0), asd=1e-12) for i in range(1, 5)]
    with pytest.raises(AssumptionError, match="does not see the rigid-body"):
        design_kalman(plate_plant(y=line))


def test_bad_plants_are_refused():
    with pytest.raises(AssumptionError, match=r"discretized\(rate"):
        design_kalman(assemble_plant(modes(), ports()))
    silent = [*ports().y[:3], Sensor("y4", at=CORNERS[3])]
    with pytest.raises(AssumptionError, match="sensors y4 have no noise"):
        design_kalman(plate_plant(y=silent))
    hammer = Sensor("a", at=(0.3, 0.3, 0), quantity="acceleration", asd=1e-4)
    with pytest.raises(AssumptionError, match="reaches 'a' without delay"):
        design_kalman(plate_plant(y=[*ports().y, hammer]))
    with pytest.raises(AssumptionError, match="no POI"):
        design_kalman(plate_plant(z=[], references=[]))
    with pytest.raises(ModelError, match="weighted"):
        design_kalman(plate_plant().weighted(z={"die:z": 1e9}))
    with pytest.raises(ModelError, match="StandardPlant"):
        design_kalman(modes())
    bare = StandardPlant.from_statespace(
        StateSpace([[0.5]], np.ones((1, 2)), np.ones((2, 1)), np.zeros((2, 2)), 0.1,
                   inputs=["w", "u"], outputs=["z", "y"]),
        u=["u"], y=["y"],
    )  # fmt: skip
    with pytest.raises((ModelError, AssumptionError), match="noise"):
        design_kalman(bare)
