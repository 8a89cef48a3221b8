"""Truncated modes of a solid's filter: bending, twisting and stretching in all six directions."""

import numpy as np
import pytest

from flexplant.estimation import design_kalman
from flexplant.modes import solve_modes
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Sensor, assemble_plant
from flexplant.structure import ModalDamping, solid_block
from oracles_estimation import error_by_frequency

SIZE = (0.3, 0.2, 0.05)
TOP = [(x, y, SIZE[2]) for y in (0.0, SIZE[1]) for x in (0.0, SIZE[0])]
PLACES = [*(("z", p) for p in TOP), ("x", (0.0, 0.0, 0.0)), ("x", (0.0, SIZE[1], 0.0)),
          ("y", (SIZE[0], 0.0, 0.0))]  # fmt: skip


def sampled(modes):
    along = [(i, {"at": p, "direction": d}) for i, (d, p) in enumerate(PLACES, 1)]
    ports = Ports(
        w=[Disturbance(f"amp{i}", asd=1e-2, **place) for i, place in along],
        u=[Actuator(f"u{i}", **place) for i, place in along],
        z=[Poi("die", at=(SIZE[0] / 2, SIZE[1] / 2, SIZE[2]), axes=("z", "rx", "ry"))],
        y=[Sensor(f"y{i}", asd=1e-12, **place) for i, place in along],
    )
    return assemble_plant(modes, ports).discretized(40e3, delay=1)


@pytest.mark.slow
def test_the_prediction_on_a_solid_is_the_error_by_frequency():
    body = solid_block(
        size=SIZE, elements=(6, 4, 2), density=2700, youngs_modulus=70e9, poisson_ratio=0.33
    )
    modes = solve_modes(body.with_damping(ModalDamping(0.01)), count=24)
    plant, whole = sampled(modes.select(range(12))), sampled(modes)
    blind, found = design_kalman(plant), design_kalman(plant.replace(evaluation=modes))
    assert found.certificate["truncated modes"] == 12
    g, observer, n = whole.system, found.system, len(PLACES)
    seen = g.output_index(whole.y)
    truth = {"A": g.A, "C1": g.C[:3], "C2": g.C[seen], "factor": whole.noise_factor}
    truth["R"] = whole.sensor_noise
    own = {"A": observer.A, "B": observer.B[:, :n], "C": observer.C, "D": observer.D[:, :n]}
    np.testing.assert_allclose(found.variances, error_by_frequency(truth, own), rtol=5e-3)
    assert blind.rms("die", on=whole) > max(1.2 * found.rms("die"), 3.0 * blind.rms("die"))
