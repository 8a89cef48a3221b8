"""A light tool on a heavy slide: forces in one unit that no singular value may compare."""

from functools import cache

import numpy as np
import pytest

import flexplant as fx
from flexplant.plant.uncertainty.delta import with_changes
from flexplant.plant.uncertainty.mode_delta import FrequencyDelta
from judge import closed, gain, judged, through


@cache
def machine(seed):
    """A slide on a base with a tool on flexures, 6 to 150 times lighter, and a holder on it."""
    rng = np.random.default_rng([58, seed])
    slide, rate = rng.uniform(30.0, 90.0), rng.uniform(10e3, 25e3)
    tool = slide / np.exp(rng.uniform(np.log(6.0), np.log(150.0)))
    masses = {"1:x": 15.0 * slide, "2:x": slide, "3:x": tool, "4:x": 0.15 * tool}
    names = list(masses)
    K = np.zeros((4, 4))
    for row, m, freq in (
        ([1, 0, 0, 0], 15.0 * slide, rng.uniform(4.0, 9.0)),
        ([0, -1, 1, 0], tool, rng.uniform(5.0, 60.0)),
        ([0, 0, -1, 1], 0.15 * tool, rate / rng.uniform(9.0, 12.0)),
    ):
        K += m * (2.0 * np.pi * freq) ** 2 * np.outer(row, row)
    dofs = fx.DofSet([int(n[0]) for n in names], ["x"] * 4, np.zeros((4, 3)))
    model = fx.FEModel(np.diag(list(masses.values())), K, dofs=dofs)
    gap = {"3:x": 1.0, "2:x": -1.0}
    ports = fx.Ports(
        u=[fx.Actuator("slide", at={"2:x": 1.0, "1:x": -1.0}, asd=2e-2),
           fx.Actuator("coil", at=gap, asd=2e-4)],
        z=[fx.Poi("tip", at={"4:x": 1.0, "1:x": -1.0}, axes=("x",)),
           fx.Poi("stroke", at=gap, axes=("x",))],
        y=[fx.Sensor("scale", at={"2:x": 1.0, "1:x": -1.0}, asd=5e-10),
           fx.Sensor("cap", at=gap, asd=3e-11)],
        references=[fx.Reference("tip")],
    )  # fmt: skip
    damped = fx.solve_modes(model, damping=fx.ModalDamping(0.01))
    return fx.assemble_plant(damped, ports).discretized(rate, delay=rng.uniform(0.0, 1.5))


@cache
def designed(seed):
    plant = machine(seed)
    observer = fx.design_kalman(plant)
    reach = fx.servo_bandwidth(plant, observer=observer)
    return observer, fx.design_servo(plant, bandwidth=reach, observer=observer), reach


def scaled_margin(plant, *blocks):
    """1 / max_f min_d of the largest singular value, d tried on a grid, by matrices alone."""
    A, B, C, D, ext, names = closed(plant, [one.system for one in blocks])
    freq = through(np.linalg.eigvals(A), plant.dt)
    T = gain(A, B, C, D, np.exp(2j * np.pi * freq * plant.dt))
    push = [i for i, name in enumerate(ext) if name.startswith("push")]
    S = np.eye(2) + T[:, [names.index(name) for name in plant.u]][:, :, push]
    least = np.full(freq.size, np.inf)
    for d in np.geomspace(1e-4, 1e4, 161):
        scale = np.array([1.0, d])
        size = np.linalg.norm(scale[:, None] * S / scale, 2, axis=(1, 2))
        least = np.minimum(least, size)
    return 1.0 / least.max()


@pytest.mark.long
@pytest.mark.parametrize("seed", range(6))
def test_the_fastest_servo_serves(seed):
    plant, (observer, servo, reach) = machine(seed), designed(seed)
    found = judged(plant, observer, servo)
    assert found.serves(reach)
    # singular values of raw newtons refused these machines, or gave a few hertz
    assert reach > 15.0
    margin = scaled_margin(plant, observer, servo)
    assert margin > 0.49
    assert servo.certificate["modulus margin"] == pytest.approx(margin, rel=0.02)


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 4])
def test_modes_hold_the_margin_within_their_tolerance(seed):
    """The loop on the machine with one frequency changed, by the scaled margin."""
    plant, (observer, servo, _) = machine(seed), designed(seed)
    loop = fx.close_loop(plant, observer, servo)
    found = loop.mode_tolerances(margin=0.4)
    assert np.abs(found.within).min() > 1e-3
    for mode, ends in zip(found.modes.tolist(), found.within, strict=True):
        for end in np.clip(0.99 * ends, -0.03, 0.03):
            other = with_changes(plant, [(FrequencyDelta.of(mode, 1.0), (1.0 + end) ** 2 - 1.0)])
            assert scaled_margin(other, observer, servo) > 0.395


@pytest.mark.slow
def test_units_of_the_forces_change_no_margin():
    """The coil's force in units of 1 mN and of 1 kN."""
    plant, (observer, servo, _) = machine(0), designed(0)
    margins = []
    for unit in (1e-3, 1.0, 1e3):
        size = np.array([unit if name == "coil" else 1.0 for name in plant.u])
        g, K = plant.system, fx.close_loop(plant, observer, servo).controller
        P = g.select(plant.y[:2], plant.u)
        P = P.replace(B=P.B * size, D=P.D * size)
        law = K.select(outputs=plant.u, inputs=plant.y[:2])
        law = law.replace(C=law.C / size[:, None], D=law.D / size[:, None])
        margins.append(fx.loop.report_loops((P, law)).scaled_margin)
    loop = fx.close_loop(plant, observer, servo)
    assert margins == pytest.approx([loop.modulus_margin] * 3, rel=1e-6)
    assert "N)" in repr(fx.loop.report_loops(loop))
