"""A new kind of anything is a few lines outside of the package, used through the public verb."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import CertificateError, ModelError
from flexplant.io import files

MODEL = fx.chain(masses=[1.0, 2.0, 1.0], stiffnesses=[4e5, 3e5], ground=[1e4, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class StretchGauge(fx.plant.SensorPort):
    """How far two places move apart [m]."""

    name: str
    at: str
    other: str
    asd: float = 0.0

    def row(self, realisation):
        return realisation.row(self.at, "x") - realisation.row(self.other, "x")


@dataclass(frozen=True, eq=False)
class Strain(StretchGauge):
    """The same over a length: it states its own unit."""

    length: float = 0.1
    unit: str = "m/m"

    def row(self, realisation):
        return super().row(realisation) / self.length


def plant(*sensors, noises=()):
    ports = fx.Ports(
        w=[fx.Disturbance("f", at="1:x", asd=1e-3), *noises],
        u=[fx.Actuator("u", at="1:x")],
        z=[fx.Poi("die", at="3:x", axes=("x",))],
        y=sensors or [fx.Sensor("y", at="3:x", direction="x", asd=1e-9)],
    )
    modes = fx.solve_modes(MODEL, count=3, damping=fx.ModalDamping(0.01))
    return fx.assemble_plant(modes, ports)


def test_a_sensor_keeps_its_unit(tmp_path):
    leaking = fx.StateSpace([[-0.1]], [[1.0]], [[1.0]], [[0.0]])
    walks = [
        fx.plant.OutputDisturbance("rate", "gap", asd=1e-9, shape=leaking, unit="m/s"),
        fx.plant.OutputDisturbance("hum", "gap"),
    ]
    made = plant(
        StretchGauge("gap", "2:x", "1:x", asd=1e-9), Strain("strain", "2:x", "1:x", asd=1e-8),
        noises=walks,
    )  # fmt: skip
    made = made.discretized(5e3, delay=1)
    made.save(tmp_path / "plant.npz")
    for one in (made, fx.load(tmp_path / "plant.npz")):
        assert (one.units["gap"], one.units["strain"]) == ("m", "m/m")
        assert one.units["strain:noise"] == "m/m"
        assert (one.units["rate"], one.units["hum"]) == ("m/s", "m")
    gains = fx.frequency_response(made.Gyu, [20.0]).data[:, 0, 0]
    assert gains[1] == pytest.approx(10.0 * gains[0], rel=1e-9)
    assert fx.design_kalman(made).rms("die") > 0


@dataclass(frozen=True, eq=False)
class Averages(fx.reduction.ReductionMethod):
    """Coordinates are the static responses to unit forces at some DOFs, and nothing else."""

    at: Any = ()

    def reduced(self, structure):
        rows = [structure.dofs.index(label) for label in self.at]
        loads = np.eye(structure.n_dof)[:, rows]
        T = fx.modes.static_response(structure, loads)
        T = T @ np.linalg.inv(T[rows])
        kept = structure.dofs.select(self.at)
        return fx.reduction.projected_model(structure, T, dofs=kept, method="averages")


def test_a_reduction_by_the_helpers_that_the_own_ones_use():
    small = fx.reduce(MODEL, Averages(at=("1:x", "3:x")))
    guyan = fx.reduce(MODEL, fx.reduction.Guyan(["1:x", "3:x"]))
    np.testing.assert_allclose(small.K, guyan.K, rtol=1e-9, atol=1e-3)
    np.testing.assert_allclose(small.M, guyan.M, rtol=1e-9, atol=1e-12)


@dataclass(frozen=True, eq=False)
class Weight(fx.updating.Residual):
    """The mass of the machine, on scales [kg]."""

    mass: float

    def bound(self, family):
        return _Weighed(self.mass, family)


class _Weighed(fx.updating.Bound):
    def __init__(self, mass, family):
        self.mass, self.V = mass, family.V
        self.ones = np.linalg.lstsq(self.V, np.ones(len(self.V)), rcond=None)[0]

    def values(self, point):
        return np.array([(self.mass - self.ones @ point.matrices[0] @ self.ones) / self.mass])

    def slopes(self, point):
        return np.array([[-self.ones @ dM @ self.ones / self.mass for dM in point.family.dM]])


def test_a_residual():
    found = fx.update(MODEL, [fx.AddedMass("2:x")], [Weight(4.5)])
    assert found.values == pytest.approx([0.5], rel=1e-6)


def test_a_criterion_is_any_function_of_a_plant():
    def largest_error(plant):
        return fx.design_kalman(plant).rms("die")

    places = [fx.Sensor(f"y{i}", at=f"{i}:x", direction="x", asd=1e-9) for i in (1, 2, 3)]
    made = plant(*places).discretized(5e3, delay=1)
    best = fx.place_sensors(made, ["y1", "y2", "y3"], 1, criterion=largest_error)
    assert best.value == pytest.approx(min(largest_error(plant(one).discretized(5e3, delay=1))
                                           for one in places), rel=1e-6)  # fmt: skip


def test_a_reader_is_registered_once(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "FORMATS", files.FORMATS[:])
    monkeypatch.setattr("flexplant.io.models.FORMATS", files.FORMATS)
    form = fx.io.Format((".rows",), lambda path: fx.structure.FEMatrices(np.loadtxt(path)))
    fx.io.add_format(form)
    (tmp_path / "K.rows").write_text("2 -1\n-1 2\n")
    assert fx.read_matrices(tmp_path / "K.rows").K.toarray().tolist() == [[2, -1], [-1, 2]]
    with pytest.raises(ModelError, match=r"\.rows have a reader"):
        fx.io.add_format(form)


@dataclass(frozen=True, eq=False)
class SlowestPole(fx.synthesis.MeasuredObjective):
    """The largest time constant of the loop [s]."""

    def measured(self, closed):
        poles = closed.poles()
        rate = np.log(np.abs(poles)) / closed.dt if closed.dt else poles.real
        return 1.0 / -float(rate.max())


@pytest.mark.slow
@pytest.mark.parametrize("speed", [1.0, 1e3])
@pytest.mark.parametrize("rate", [0.0, 50.0])
def test_an_objective_counts_in_seconds_at_any_speed(speed, rate):
    """Velocity feedback of an oscillator: critical damping, at twice the damping ratio of one."""
    omega = speed
    A = np.array([[0.0, omega], [-omega, -0.2 * omega]])
    g = fx.StateSpace(A, [[0.0], [omega]], [[0.0, 1.0]], 0, inputs=["u"], outputs=["y"])
    g = fx.lti.discretized(g, rate * speed) if rate else g
    B, D = np.hstack([g.B, g.B]), np.zeros((2, 2))
    whole = fx.StateSpace(g.A, B, np.vstack([g.C, g.C]), D, g.dt, inputs=["w", "u"],
                          outputs=["z", "y"])  # fmt: skip
    law = fx.synthesis.FixedOrder(0)
    found = fx.synthesis.design_structured(
        whole, law, objective=SlowestPole(), u=["u"], y=["y"], starts=2, evaluations=4000
    )
    gains = np.linspace(0.05, 4.0, 4000)
    closed = [g.A - k * g.B @ g.C for k in gains]
    poles = np.array([np.linalg.eigvals(one) for one in closed])
    rates = np.log(np.abs(poles)) / g.dt if rate else poles.real
    best = np.min(np.where(rates.max(1) < 0, -1.0 / rates.max(1), np.inf))
    # at the best gain two poles meet: the number is not smooth there
    assert found.gamma == pytest.approx(best, rel=0.05)
    assert found.certificate["norm"] == found.gamma


@dataclass(frozen=True, eq=False, repr=False)
class Told(fx.synthesis.MeasuredObjective):
    """What a list says in turn, then its last entry."""

    said: Any = ()

    def measured(self, closed):
        return self.said.pop(0) if len(self.said) > 1 else self.said[0]


@pytest.mark.parametrize(
    ("said", "error", "match"),
    [
        ([np.nan], ModelError, "one positive number of a stable loop, got nan"),
        ([-1.0], ModelError, "one positive number of a stable loop, got -1.0"),
        ([None], ModelError, "one positive number of a stable loop, got None"),
        ([np.inf], fx.errors.InfeasibleError, "infinite for the stable loops"),
        (1.0 + 0.01 * np.arange(999), CertificateError, "one loop two numbers.*earlier calls"),
        ([1.0], None, ""),
    ],
)
def test_an_objective_that_fails_is_told_why(said, error, match):
    made = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=fx.lti.low_pass_filter(0.1),
                                      KS=0.1)  # fmt: skip
    given = {"objective": Told(said=list(said)), "starts": 1, "evaluations": 20}
    if error is None:  # nothing depends on the controller
        found = fx.synthesis.design_structured(made, fx.synthesis.FixedOrder(0), **given)
        assert found.gamma == 1.0
        return
    with pytest.raises(error, match=match):
        fx.synthesis.design_structured(made, fx.synthesis.FixedOrder(0), **given)


def test_a_judge_in_the_wrong_unit_of_time_is_told_so():
    class Wrong:
        below = None
        chosen, judges = SlowestPole().chosen, fx.synthesis.H2().judges

        @staticmethod
        def measured(closed):
            return 1.0

    made = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=fx.lti.low_pass_filter(0.1),
                                      KS=0.1)  # fmt: skip
    with pytest.raises(CertificateError, match=r"scaled time .*MeasuredObjective"):
        fx.synthesis.design_structured(made, fx.synthesis.FixedOrder(1, direct=False),
                                       objective=Wrong(), starts=1, evaluations=200)  # fmt: skip


class DeadZone:
    """An actuator that ignores small commands."""

    def begin(self, dt, generators):
        return lambda values: np.sign(values) * np.maximum(np.abs(values) - 0.1, 0.0)


def test_a_nonlinear_element():
    made = plant().discretized(5e3, delay=1)
    loop = fx.close_loop(made, fx.StateSpace([], [], [], [[-50.0]], made.dt, inputs=["y"],
                                             outputs=["u"]))  # fmt: skip
    quiet = fx.simulate(loop, duration=0.02, rng=1, elements={"u": DeadZone()})
    open_loop = fx.close_loop(made, fx.StateSpace([], [], [], [[0.0]], made.dt, inputs=["y"],
                                                  outputs=["u"]))  # fmt: skip
    free = fx.simulate(open_loop, duration=0.02, rng=1)
    np.testing.assert_allclose(quiet["die:x"], free["die:x"], rtol=1e-9, atol=1e-18)


@dataclass(frozen=True, eq=False)
class Slip(fx.plant.Delta):
    """How far along the machine a sensor sits, from its own mass towards the second one."""

    power: int = 1

    def changed(self, machine, amount):
        a = amount**self.power
        port = machine.ports.sensor("y").replace(at={"3:x": 1.0 - a, "2:x": a})
        return machine.with_port(port)


@dataclass(frozen=True, eq=False)
class Slips(fx.plant.Uncertainty):
    power: int = 1

    def deltas(self, plant):
        return [Slip("y:place", 0.2, power=self.power)]


def test_an_uncertain_place_opens_as_a_delta_and_is_drawn_as_machines():
    made = plant().discretized(5e3, delay=1)
    known = made.uncertain(Slips(), fx.plant.Frequencies(0.01))
    modes = fx.solve_modes(MODEL, count=3, damping=fx.ModalDamping(0.01))
    omega = 2.0 * np.pi * 90.0
    near, far = (
        np.sum(modes.phi[i] * modes.phi[0] / (modes.omega**2 - omega**2
                                              + 2j * modes.zeta * modes.omega * omega))
        for i in (1, 2)
    )  # fmt: skip
    opened = fx.frequency_response(known.opened.closed({"y:place": 0.5}), [90.0])["y", "u"][0]
    assert opened == pytest.approx(0.1 * near + 0.9 * far, rel=1e-9)
    places = [one.ports.sensor("y").at["2:x"] for one in known.machines.drawn(3, rng=0)]
    assert len(set(places)) == 3
    assert np.abs(places).max() < 0.6
    with pytest.raises(ModelError, match=r"'y:place'.*'y' is not affine.*Slip its `opened`"):
        made.uncertain(Slips(2), fx.plant.Frequencies(0.01))
