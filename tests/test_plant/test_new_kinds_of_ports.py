"""A new kind of sensor or force is one class: it works from assembly to simulation."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.linalg import block_diag

from flexplant import load
from flexplant.errors import ModelError
from flexplant.estimation import design_kalman
from flexplant.labels import Place
from flexplant.loop import close_loop
from flexplant.lti import StateSpace, h2_norm, low_pass_filter
from flexplant.placement import PoiVariance, score_sensors
from flexplant.plant import ForcePort, MeasuredRow, NarrowBand, Sensor, SensorPort, assemble_plant
from flexplant.reduction import ModalTruncation, reduce
from flexplant.simulation import simulate
from flexplant.synthesis import design_servo
from stages import CORNERS, INSET, NOISE, RATE, Z8, full, ports, reduced, sampled, some_modes

OMEGA = 1j * 2 * np.pi * np.array([3.0, 70.0, 451.0, 900.0])


@dataclass(frozen=True, eq=False)
class Stretch(SensorPort):
    """How far a place moves beside another one, over their distance [m]: a strain."""

    name: str
    at: Place
    beside: Place
    length: float = 1.0
    asd: float = 0.0
    dynamics: StateSpace | None = None
    latency: float = 0.0
    quantity: str = "displacement"

    def row(self, realisation):
        """Return the difference of two rows of displacements."""
        return (realisation.row(self.at, "z") - realisation.row(self.beside, "z")) / self.length


@dataclass(frozen=True, eq=False)
class Led(SensorPort):
    """A displacement with its rate: it overrides what is seen, not only the row."""

    name: str
    at: Place
    lead: float
    asd: float = 0.0

    def row(self, realisation):
        """Return what it shows at rest."""
        return realisation.row(self.at, "z")

    def see(self, realisation):
        """Return a row q and a row of T dq/dt."""
        row = self.row(realisation)
        return MeasuredRow(
            realisation.motion(row, 0) + self.lead * realisation.motion(row, 1),
            realisation.at_once(row),
        )


@dataclass(frozen=True, eq=False)
class Pair(ForcePort):
    """A force on one place and its reaction on another one."""

    name: str
    at: Place
    against: Place
    asd: float = 0.0

    def push(self, realisation):
        """Return the difference of two loads."""
        return realisation.row(self.at, "z") - realisation.row(self.against, "z")


@dataclass(frozen=True, eq=False)
class Fan(ForcePort):
    """A periodic force: harmonics of a speed [Hz] of given rms [N], each a narrow band of noise."""

    name: str
    at: Place
    speed: float
    rms: tuple[float, ...]
    asd: float = 1.0

    @property
    def filter(self):
        """The bands beside each other, driven by one white noise."""
        bands = [NarrowBand(rms, k * self.speed, 0.05) for k, rms in enumerate(self.rms, 1)]
        parts = [(band.shape, band.asd) for band in bands]
        A = block_diag(*(g.A for g, _ in parts))
        B = np.vstack([size * g.B for g, size in parts])
        states = [f"{self.name}|{i}" for i in range(len(A))]
        return StateSpace(A, B, np.hstack([g.C for g, _ in parts]), [[0.0]], states=states)

    def push(self, realisation):
        """Return the load of a unit force."""
        return realisation.row(self.at, "z")


def with_sensor(*more):
    """The channels of the example and more sensors."""
    base = ports()
    return base.replace(y=[*base.y, *more])


def response(plant, outputs, inputs):
    g = plant.system.select(outputs, inputs)
    return np.array([g.evaluated(s) for s in OMEGA])


STRETCH = Stretch("s", CORNERS[3], CORNERS[0], length=0.5, asd=NOISE)
U = ["u1", "u2", "u3", "u4", "amp1"]


@pytest.mark.slow
@pytest.mark.parametrize("model", [full, some_modes, reduced])
def test_assembled(model):
    """It shows the difference of two ordinary sensors, of all three models of a structure."""
    plant = assemble_plant(model(), with_sensor(STRETCH))
    apart = response(plant, ["y4"], U) - response(plant, ["y1"], U)
    found = response(plant, ["s"], U)
    np.testing.assert_allclose(found, 2.0 * apart, rtol=1e-9, atol=1e-12 * np.abs(apart).max())
    assert "s:noise" in plant.w
    assert plant.system.units["s"] == plant.system.units["y1"]  # twice the difference of two
    assert plant.check()["detectable"].holds
    assert plant.with_ports(ports()).y == ("y1", "y2", "y3", "y4", "die:ref")
    moved = plant.at({"s": CORNERS[0]})
    assert not np.any(moved.system.select(["s"]).C)


def test_velocity_and_acceleration():
    """A quantity is enough for the derivatives, and for what follows a force at once."""
    plain = assemble_plant(some_modes(), with_sensor(STRETCH))
    for quantity, power in (("velocity", 1), ("acceleration", 2)):
        rate = STRETCH.replace(quantity=quantity)
        plant = assemble_plant(some_modes(), with_sensor(rate))
        wanted = response(plain, ["s"], U) * OMEGA[:, None, None] ** power
        scale = 1e-10 * np.abs(wanted).max()
        np.testing.assert_allclose(response(plant, ["s"], U), wanted, rtol=1e-7, atol=scale)
        assert np.any(plant.system.select(["s"], U).D) == (quantity == "acceleration")


@pytest.mark.slow
def test_sampled_estimated_simulated_saved(tmp_path):
    """A filter, a latency, a Kalman filter and a run: those of the same sum of displacements."""
    filtered = {"asd": NOISE, "dynamics": low_pass_filter(2e3), "latency": 1.3 / RATE}
    own = Stretch("s", CORNERS[3], CORNERS[0], **filtered)
    same = Sensor("s", at={CORNERS[3]: 1.0, CORNERS[0]: -1.0}, **filtered)
    plants = [sampled(reduced(), with_sensor(sensor)) for sensor in (own, same)]
    for name in "ABCD":
        one, two = (getattr(plant.system, name) for plant in plants)
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-12 * np.abs(two).max())
    filters = [design_kalman(plant) for plant in plants]
    without = design_kalman(sampled(reduced())).rms("die")
    rms = [estimator.rms("die") for estimator in filters]
    assert rms[0] == pytest.approx(rms[1], rel=1e-7, abs=0.0)
    assert rms[0] < without
    runs = [
        simulate(close_loop(plant, estimator, idle=plant.u), duration=0.05, rng=3)
        for plant, estimator in zip(plants, filters, strict=True)
    ]
    size = np.abs(runs[1]["s"]).max()
    assert size > 0
    np.testing.assert_allclose(runs[0]["s"], runs[1]["s"], rtol=0, atol=1e-6 * size)
    plants[0].save(tmp_path / "plant")
    again = load(tmp_path / "plant")
    assert isinstance(again.assembled.ports.sensor("s"), Stretch)
    np.testing.assert_array_equal(again.with_ports(again.assembled.ports).system.C,
                                  plants[0].system.C)  # fmt: skip


def test_see_may_be_anything_linear():
    lead = 2e-4
    plant = assemble_plant(some_modes(), with_sensor(Led("l", CORNERS[1], lead)))
    wanted = (1.0 + lead * OMEGA)[:, None, None] * response(plant, ["y2"], U)
    scale = 1e-12 * np.abs(wanted).max()
    np.testing.assert_allclose(response(plant, ["l"], U), wanted, rtol=1e-9, atol=scale)


@pytest.mark.slow
def test_a_candidate():
    """It is scored among others, as its own plant would be."""
    few = reduce(some_modes(attached=False), ModalTruncation(12))
    plant = sampled(few, with_sensor(STRETCH))
    found = score_sensors(plant, [["y1", "y2", "y3", "s"]], criterion=PoiVariance("die"))
    own = plant.assembled.ports
    other = plant.with_ports(own.replace(y=[*own.y[:3], STRETCH]))
    direct = design_kalman(other).rms("die")
    assert found.values[0] == pytest.approx(direct**2, rel=1e-6, abs=0.0)


def test_a_force():
    """A force and its reaction, white: the sum of two disturbances, and no rigid-body motion."""
    base = ports()
    pair = Pair("pair", INSET[0], INSET[3], asd=1e-3)
    plant = assemble_plant(some_modes(), base.replace(w=[*base.w, pair]))
    out = ["die:z", *plant.y[:4]]
    apart = response(plant, out, ["amp1"]) - response(plant, out, ["amp4"])
    scale = 1e-12 * np.abs(apart).max()
    np.testing.assert_allclose(response(plant, out, ["pair"]), apart, rtol=1e-9, atol=scale)
    assert plant.asd["pair"] == 1e-3
    rms = [design_kalman(p.discretized(RATE, delay=1)).rms("die")
           for p in (plant, plant.with_ports(base))]  # fmt: skip
    assert rms[0] > rms[1]


def test_sides_are_kept():
    """A port of the wrong side is refused by the side that it says it belongs to."""
    with pytest.raises(ModelError, match=r"Ports\.y holds Sensors, got Pair. It belongs in w"):
        with_sensor(Pair("pair", Z8, CORNERS[0]))
    with pytest.raises(ModelError, match=r"Ports\.w holds disturbances, got Stretch.*in y"):
        ports(w=[STRETCH])


@pytest.mark.slow
def test_a_periodic_force():
    """Two harmonics of a fan: run, budget, spectrum and filter ask the port for its noise."""
    base, speed, rms = ports(), 45.0, (0.04, 0.02)
    fan = Fan("fan", INSET[0], speed, rms)
    few = reduce(some_modes(attached=False), ModalTruncation(12))
    plant = sampled(few, base.replace(w=[*base.w, fan]))
    assert h2_norm(fan.filter) / np.sqrt(2) == pytest.approx(np.hypot(*rms), rel=0.05)
    with_fan, without = (design_kalman(one) for one in (plant, plant.with_ports(base)))
    assert with_fan.rms("die") > 1.001 * without.rms("die")
    assert with_fan.system.n_states == without.system.n_states + 2 * len(rms)
    loop = close_loop(plant, with_fan, design_servo(plant, bandwidth=20.0, observer=with_fan))
    own = loop.budget("die:error")
    share = own.variances[own.names.index("fan")] / own.variances.sum()
    assert 0.1 < share < 1.0
    quiet = close_loop(plant.with_ports(base), *loop.blocks)
    lines = [speed, 1.4 * speed, 2.0 * speed]
    more, less = (one.psd("die:error", lines).psd for one in (loop, quiet))
    assert np.all((more / less > 2.0) == [True, False, True])
    run = simulate(loop, duration=4.0, rng=1)
    assert run.rms("die:error", start=0.5) == pytest.approx(loop.rms("die:error"), rel=0.2)
