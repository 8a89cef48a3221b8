"""Modal Gramians against Lyapunov's equation, and a case in which measures differ."""

import numpy as np
import pytest
import scipy.linalg as la

from flexplant import DofSet
from flexplant.errors import ModelError
from flexplant.modes import solve_modes
from flexplant.placement import ModalControllability, ModalObservability, OffPoi, place_sensors
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Sensor, assemble_plant
from flexplant.structure import FEModel, ModalDamping

#: two modes of one frequency and one above; a sensor sees parts of the three masses
SEES = {"a": (1.0, 1.0, 0.02), "b": (1.0, 0.99, 0.02), "c": (0.6, 0.02, 0.1), "d": (0.02, 0.6, 0.1)}


@pytest.fixture(scope="module")
def masses():
    xyz = [(0.1 * i, 0.0, 0.0) for i in range(3)]
    model = FEModel(np.eye(3), np.diag([1e6, 1e6, 4e6]), dofs=DofSet(range(3), ["z"] * 3, xyz))
    modes = solve_modes(model, count=3, damping=ModalDamping(0.001))
    at = {n: {f"{i}:z": w for i, w in enumerate(row)} for n, row in SEES.items()}
    sensors = [Sensor(name, at=place, asd=1e-9) for name, place in at.items()]
    actuators = [Actuator(f"{name}u", at=place) for name, place in at.items()]
    ports = Ports(
        w=[Disturbance("f", at="2:z", asd=1e-3)],
        u=actuators[2:],
        z=[Poi("die", at="1:z")],
        y=sensors[2:],
    )
    return assemble_plant(modes, ports).discretized(4e3), sensors


@pytest.mark.parametrize("side", ["y", "u"])
def test_the_closed_form_solves_lyapunov(masses, side):
    plant, _ = masses
    real = plant.assembled.realisation
    rows = np.array([SEES["c"], SEES["d"]])
    if side == "y":
        A, B, kind = real.A.T, (rows @ real.outputs).T / 1e-9, ModalObservability
    else:
        A, B, kind = real.A, (rows @ real.inputs).T, ModalControllability
    expected = la.solve_continuous_lyapunov(A, -B @ B.T)
    found = kind().matrix(plant)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    sizes = la.eigvalsh(expected)
    for measure, value in (("trace", sizes.sum()), ("least", sizes[0])):
        assert kind(measure)(plant) == pytest.approx(-value, rel=1e-6, abs=0.0)
    assert kind("log det")(plant) == pytest.approx(-np.log(sizes).sum(), rel=1e-6, abs=0.0)


def test_measures_decide_differently(masses):
    """Trace takes two that see the twin modes alike; the others, and the exact form, do not."""
    plant, sensors = masses
    chosen = {
        measure: place_sensors(
            plant, sensors, 2, ModalObservability(measure), constraints=[OffPoi(-1)]
        ).chosen
        for measure in ("trace", "log det", "least")
    }
    assert chosen["trace"] == ("a", "b")
    assert chosen["least"] == ("c", "d")
    assert chosen["log det"] != chosen["trace"]
    # by the diagonal alone, in the modes' own shapes, a and b together would be best as well
    shapes = np.array([SEES["a"], SEES["b"], SEES["c"], SEES["d"]])
    alike, apart = (np.sum(np.log((shapes[s] ** 2).sum(axis=0)[:2])) for s in ([0, 1], [2, 3]))
    assert alike > apart
    with pytest.raises(ModelError, match="measure"):
        ModalObservability("sum")
