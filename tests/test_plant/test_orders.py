"""What is made of a plant, in random orders: against ports assembled once and numpy."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import LabelError
from flexplant.lti import StateSpace, frequency_response
from flexplant.plant import Gains, GeneralizedPlant, StandardPlant
from plates import make_plate
from stages import ports

PLATE = make_plate(elements=(4, 4)).with_damping(fx.ModalDamping(0.01))
MODES = fx.solve_modes(PLATE, count=20)
FREQ = np.array([3.0, 47.0, 290.0, 1410.0])
RATE, DELAY = 10e3, 1.3
ELSEWHERE = (0.15, 0.3, 0.0)
MIXED = np.array([[1.0, 2.0], [0.5, -1.0]])
KEPT, SHOWN = ("u1", "u3"), ("die:z", "die:ry", "die:error")
SLOW = 40.0  # corner [rad/s] of a weight

STEPS = {
    "discretized": lambda plant: plant.discretized(RATE, delay=DELAY),
    "at": lambda plant: plant.at({"die": ELSEWHERE}),
    "select": lambda plant: plant.select(u=KEPT, z=SHOWN),
    "weighted": lambda plant: plant.weighted(
        z={"die:z": StateSpace([[-SLOW]], [[1.0]], [[SLOW]], [[0.0]])}, w={"amp1": 3.0}
    ),
    "through": lambda plant: plant.through(
        StateSpace([], [], [], MIXED, inputs=["y1", "y2"], outputs=["a", "b"])
    ),
    "uncertain": lambda plant: plant.uncertain(Gains({"u1": 0.02}), frequency=0.005),
}


def expected(modes, names):
    """Return gains {(output, input): (n,)} of the machine, weighed and mixed by numpy."""
    own = ports()
    if "at" in names:
        own = own.replace(z=[own.z[0].replace(at=ELSEWHERE), *own.z[1:]])
    plant = fx.assemble_plant(modes, own)
    s = 2j * np.pi * FREQ
    if "discretized" in names:
        plant = plant.discretized(RATE, delay=DELAY)
        s = 2 * RATE * (np.exp(s / RATE) - 1) / (np.exp(s / RATE) + 1)
    g = frequency_response(plant.system, FREQ).data
    rows = {n: g[i] for i, n in enumerate(plant.system.outputs)}
    if "through" in names:
        rows |= {n: MIXED[i, 0] * rows["y1"] + MIXED[i, 1] * rows["y2"] for i, n in enumerate("ab")}
    if "weighted" in names:
        rows["die:z"] = rows["die:z"] * SLOW / (s + SLOW)
    found = {(a, b): row[j] for a, row in rows.items() for j, b in enumerate(plant.system.inputs)}
    if "weighted" in names:
        found |= {(a, b): 3.0 * x for (a, b), x in found.items() if b == "amp1"}
    return found


def compared(plant, gains):
    data = frequency_response(plant.system, FREQ).data
    for i, a in enumerate(plant.system.outputs):
        for j, b in enumerate(plant.system.inputs):
            size = max(np.abs(x).max() for (to, _), x in gains.items() if to == a)
            np.testing.assert_allclose(data[i, j], gains[a, b], rtol=1e-7, atol=1e-9 * size)


@pytest.mark.parametrize("seed", range(24))
def test_any_order(seed):
    """The plant, its evaluation plant and what is not known are those of any other order."""
    rng = np.random.default_rng(seed)
    names = rng.permutation(sorted(STEPS))[: rng.integers(2, len(STEPS) + 1)]
    plant = fx.assemble_plant(MODES.select(range(9)), ports(), evaluation=MODES)
    for name in names:
        plant = STEPS[name](plant)
        if rng.random() < 0.5:  # an uncertain plant itself, or what designs take of it
            plant = getattr(plant, "nominal", plant)
    known = plant if hasattr(plant, "nominal") else getattr(plant, "uncertainty", None)
    plant = getattr(plant, "nominal", plant)
    assert isinstance(
        plant, GeneralizedPlant if {"weighted", "through"} & {*names} else StandardPlant
    )
    assert plant.y[:2] == (("a", "b") if "through" in names else ("y1", "y2"))
    assert plant.u == (KEPT if "select" in names else tuple(p.name for p in ports().u))
    assert {*SHOWN} <= {*plant.z} and ("die:rx" in plant.z) == ("select" not in names)
    compared(plant, expected(MODES.select(range(9)), names))
    compared(plant.evaluation_plant, expected(MODES, names))
    if "uncertain" in names:
        assert known.plant.u == plant.u and known.plant.dt == plant.dt
        low = known.lft({"mode4:freq": -1.0})
        ratio = np.sqrt(np.linalg.det(low.modal_blocks[3]) / np.linalg.det(plant.modal_blocks[3]))
        assert ratio == pytest.approx(0.995, abs=1e-4)
        assert "u1:gain" in {delta.name for delta in known.deltas}


def test_selected_channels():
    """A port takes what belongs to it along; foreign matrices answer as the machine does."""
    plant = fx.assemble_plant(MODES, ports(references=[fx.Reference("die", ("z", "rx"))]))
    chosen = {"w": ["amp2"], "u": ["u2", "u4"], "z": ["die:rx"], "y": ["y1", "y3"]}
    ours = plant.select(**chosen)
    assert ours.w == ("amp2", "y1:noise", "y3:noise", "die:ref")
    assert ours.z == ("die:rx", "die:error", "u2:effort", "u4:effort")
    assert (ours.u, ours.y) == (("u2", "u4"), ("y1", "y3", "die:ref"))
    bare = StandardPlant.from_statespace(plant.system, asd=plant.asd)
    foreign = bare.select(u=["u2", "u4"], y=["y1", "y3"])
    assert set(foreign.asd) == {*(f"amp{i}" for i in range(1, 5)), "y1:noise", "y3:noise"}
    one, two = (frequency_response(p.Gyu, FREQ).data[:2] for p in (ours, foreign))
    np.testing.assert_allclose(one, two, rtol=1e-9)
    with pytest.raises(LabelError, match="y9"):
        plant.select(y=["y9"])
    heavy = plant.weighted(z={"die:z": 2.0})
    read = heavy.select(w=["amp2"], z=["die:z"], y=["y3"])
    assert (read.w, read.z, read.y) == (("amp2",), ("die:z",), ("y3",))
    with pytest.raises(LabelError, match="die:w"):
        heavy.select(z=["die:w"])
