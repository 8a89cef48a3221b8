"""Where to put sensors and actuators: choices with a bound on the best possible one.

Run it: ``python examples/placement.py``. The stage of ``wafer_stage.py`` carries 0.5 kg that no
drawing shows; its model is updated from a measurement, with the uncertainty of the result. Four
sensors are placed so that the error at the die, which no sensor sees, is smallest. They are chosen
from a grid of 48 places outside the die. A lower bound shows the error that no choice can fall
below. The chosen sensors are then compared on the machine with sensors at the corners.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # the matrices are small: threads would only wait

from pathlib import Path
from typing import Any

import numpy as np

import flexplant as fx
from flexplant.placement import (
    BranchAndBound,
    ClosedLoopH2,
    DeviceLoss,
    Exchange,
    Excluded,
    MinimumDistance,
    ModeInformation,
    OverMachines,
    RowSelection,
    Screened,
    device_worth,
    pareto_curve,
)
from wafer_stage import L, models, plant_of, ports

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
ENCODER = 5e-12  # m/sqrt(Hz)
GRID = [(x, y, 0.0) for x in np.linspace(0.0, L, 7) for y in np.linspace(0.0, L, 7)]
SENSORS = [fx.Sensor(f"s{i}", at=place, asd=ENCODER) for i, place in enumerate(GRID)]
PLACES = [(x, y, 0.0) for x in np.linspace(0.1, L - 0.1, 3) for y in np.linspace(0.1, L - 0.1, 3)]
ACTUATORS = [fx.Actuator(f"a{i}", at=place) for i, place in enumerate(PLACES)]
#: sensors are not possible on the die and near its edge
DIE = fx.placement.Disc((L / 2, L / 2), radius=0.05)
#: nor here, where a cable runs
CABLE = fx.placement.Rectangle((-0.01, 0.15), (0.25, 0.45))
#: z at the die, and its rotations at the edge of a field, 13 mm away
AXES = {"z": 1.0, "rx": 0.013, "ry": 0.013}


# %% The machine: measured, and the uncertainty of its modes
def plants(case: dict[str, Any], rng: int = 1) -> tuple[fx.StandardPlant, list[fx.StandardPlant]]:
    """Return the sampled plant of the measured model, and three other possible machines."""
    small = plant_of(case, "measured").replace(evaluation=None)  # scored on its own modes
    return small, small.uncertain(frequency=case["off"]).machines.drawn(3, rng=rng)


def on_machine(case: dict[str, Any], plant: fx.StandardPlant) -> tuple[float, float]:
    """Return the die's error [m rms] over `AXES` by a plant's sensors: predicted, and measured."""
    full = case["full"]["measured"]
    judged = plant.replace(evaluation=full)
    design, static = {"estimate": fx.design_kalman(judged)}, fx.design_static(judged)
    servo = fx.design_servo(plant, bandwidth=10.0, observer=static)
    blocks = static, servo, *fx.simulation.reading_along(design)
    run = case["machine"].run(plant.assembled.ports, *blocks, duration=3.0, rng=1, runs=2)
    both = [
        weight
        * np.array(
            fx.simulation.compare_estimators(design, run, f"die:{axis}", start=1.0)["estimate"]
        )
        for axis, weight in AXES.items()
    ]
    predicted, measured, *_ = np.linalg.norm(both, axis=0)
    return float(predicted), float(measured)


# %% Sensors
def sensors(plant: fx.StandardPlant, machines: list[fx.StandardPlant]) -> dict[str, fx.Placement]:
    """Return four sensors by several criteria and constraints."""
    # modes that the reduced model has truncated are not included here: the bound would not hold
    goal = fx.PoiVariance("die", AXES, own_modes=True)
    off = Excluded(DIE)
    search = Exchange(starts=1)

    def best(criterion: Any, count: int = 4, method: Any = search, **options: Any) -> fx.Placement:
        given = (off, *options.pop("constraints", ()))
        return fx.place_sensors(
            plant, SENSORS, count, criterion, constraints=given, method=method, rng=0, **options
        )

    spread = fx.place_sensors(
        plant, SENSORS, 25, ModeInformation(), constraints=[off], method=RowSelection()
    )
    return {
        "the die's error": best(goal, method=Exchange(starts=5)),  # one ends 0.6 % higher
        "variance within 12 %, proven": best(goal, method=BranchAndBound(gap=0.12, starts=1)),
        "0.25 m apart": best(goal, constraints=[MinimumDistance(0.25)]),
        "none at the cable": best(goal, constraints=[Excluded(CABLE)]),
        "worst machine of three": best(OverMachines(goal, machines)),
        "one may fail": best(DeviceLoss(goal), method=Screened(goal, starts=1)),
        "25 for the shapes": spread,
    }


# %% Actuators, both together, and the benefit of more devices
def both(plant: fx.StandardPlant) -> dict[str, Any]:
    """Return actuators and sensors for the closed loop, the curve over counts, and their worth."""
    cost = ClosedLoopH2("die", AXES, effort=1e-9)
    few = [sensor for sensor in SENSORS[::3] if not DIE.holds(np.array([sensor.at[:2]]))[0]]
    search = Exchange(starts=1)
    pair = fx.placement.place_both(plant, few, ACTUATORS, (4, 4), cost, method=search, rng=0)
    goal = fx.PoiVariance("die", AXES, own_modes=True)
    curve = pareto_curve(
        plant, few, range(3, 7), goal, constraints=[Excluded(DIE)], method=search, rng=0
    )
    return {"pair": pair, "curve": curve, "worth": device_worth(plant, pair, cost)}


def main() -> dict[str, Any]:
    """Return everything that was found."""
    case = models(0.01)
    plant, machines = plants(case)
    result = {"plant": plant, "machines": machines, "sensors": sensors(plant, machines)}
    corners = plant.assembled.ports.replace(y=[y.replace(asd=ENCODER) for y in ports().y])
    result["machine"] = {
        "at the corners": on_machine(case, plant.with_ports(corners)),
        "the die's error": on_machine(case, result["sensors"]["the die's error"].on(plant)),
    }
    grid = [place for place in GRID if not DIE.holds(np.array([place[:2]]))[0]]
    corners = plant.assembled.ports.y[:3]
    three = plant.with_ports(plant.assembled.ports.replace(y=corners))
    goal = fx.PoiVariance("die", AXES, own_modes=True)
    found = fx.placement.sensor_map(three, grid, goal, asd=ENCODER, constraints=[Excluded(DIE)])
    return result | both(plant) | {"map": found, "three": three}


# %% The table
def table(result: dict[str, Any]) -> str:
    """Return choices with their values and bounds as text."""
    plant = result["plant"]
    goal = fx.PoiVariance("die", AXES, own_modes=True)
    lines = [f"{'sensors':24s}{'at the die':>12s}{'their goal':>12s}{'at best':>12s}   chosen"]
    for name, found in result["sensors"].items():
        error = f"{1e12 * np.sqrt(goal(found.on(plant))):.1f} pm"
        value, low = (
            f"{1e12 * np.sqrt(number):.1f} pm" if found.unit else "-"
            for number in (found.value, max(found.bound, 0.0))
        )
        lines.append(f"{name:24s}{error:>12s}{value:>12s}{low:>12s}   {' '.join(found.chosen):.24}")
    lines += ["", "error at the die, truncated modes included: predicted, and on the machine"]
    for name, both in result["machine"].items():
        lines.append(f"{name:24s}" + "".join(f"{1e12 * error:9.1f} pm" for error in both))
    pair = result["pair"]
    lines += ["", f"the closed loop: {pair!r}", f"{result['worth']!r}", "", f"{result['curve']!r}"]
    return "\n".join(lines)


# %% The pictures
def pictures(result: dict[str, Any], folder: Path = OUT) -> list[Path]:
    """Draw the score over the plate, the curve with its bound, and devices on a mode shape."""
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    drawn = []

    def keep(name: str) -> None:
        drawn.append(folder / f"{name}.png")
        plt.savefig(drawn[-1], dpi=110)
        plt.close("all")

    fx.plot.sensor_map(result["map"], ports=result["three"].assembled.ports)
    keep("placement_map")
    fx.plot.pareto_curve(result["curve"])
    keep("placement_curve")
    fx.plot.placed(result["pair"].on(result["plant"]), mode=6, zones=[DIE])
    keep("placement_mode")
    return drawn


# %% Run it
if __name__ == "__main__":
    everything = main()
    print(table(everything))
    for path in pictures(everything):
        print(path)
