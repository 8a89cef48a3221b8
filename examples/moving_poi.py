"""A point of interest that moves during exposure: why its estimate needs the path.

Run it: ``python examples/moving_poi.py``. A plate is scanned under a lens: the point of interest
(POI) runs over the plate at 0.3 m/s, from the middle towards an edge, while amplifier noise shakes
the plate and a servo holds it. The model is a mesh with measured poles; the machine is computed
with another theory. The motion of the POI is estimated from the same record in three ways. The
first takes the motion of the middle of the plate. The second transfers this motion to the POI as if
the plate were rigid. The third uses the path, so that every mode contributes with its shape at the
place of the POI at each sample.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # matrices are small: more threads only wait

from pathlib import Path
from typing import Any

import numpy as np

import flexplant as fx

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
L, RATE, DELAY = 0.6, 8e3, 1.3  # m, Hz, samples
SENSOR = 1e-12  # m/sqrt(Hz)
CORNERS = [(x, y, 0.0) for y in (0.0, L) for x in (0.0, L)]
INSET = [(x, y, 0.0) for y in (L / 4, 3 * L / 4) for x in (L / 4, 3 * L / 4)]
#: m: the scan starts in the middle, exposes this length and leaves room to stop
SCAN = fx.simulation.scan(
    0.2, velocity=0.3, acceleration=10.0, jerk=2000.0, settle=0.01, rest=0.05, rate=RATE
)
DURATION = 0.8  # s

# %% The machine, and the model: twelve modes of a mesh with another theory
machine = fx.testbeds.wafer_stage(damping=0.005, added_mass=0.0, rate=RATE, delay=DELAY)
plate = fx.kirchhoff_plate(
    size=(L, L),
    thickness=0.0272,
    elements=(16, 16),
    density=2702,
    youngs_modulus=70e9,
    poisson_ratio=0.35,
)
drawn = fx.solve_modes(plate, count=60, damping=fx.ModalDamping(0.005))
whole = drawn.calibrated(machine.poles(range(4, 13)))  # frequency and damping as measured
PORTS = fx.Ports(
    w=[fx.Disturbance(f"amp{i}", at=p, asd=1e-3) for i, p in enumerate(INSET, 1)],
    u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(INSET, 1)],
    z=[fx.Poi("die", at=(L / 2, L / 2, 0.0), axes=("z", "rx", "ry"))],
    y=[fx.Sensor(f"y{i}", at=p, asd=SENSOR) for i, p in enumerate(CORNERS, 1)],
    references=[fx.Reference("die")],
)
design = fx.assemble_plant(whole.select(range(12)), PORTS, evaluation=whole)
design = design.discretized(RATE, delay=DELAY)


# %% Where the POI is at each sample
def path(time: np.ndarray) -> np.ndarray:
    """Return the places (N, 3) [m] of the POI; shapes are found once for each distinct place."""
    x = np.round(L / 2 + SCAN.at(time).position, 3)
    return np.column_stack([x, np.full(time.size, L / 2), np.zeros(time.size)])


# %% One run, three estimates
def main() -> dict[str, Any]:
    """Return the run, the estimates of the motion in z at the POI, and their errors."""
    observer = fx.design_kalman(design)
    servo = fx.design_servo(design, bandwidth=30.0, observer=observer)
    run = machine.run(PORTS, observer, servo, duration=DURATION, moving={"die": path}, rng=11)
    places = path(run.time)
    fixed, along = observer.estimate(run), observer.estimate(run, path=places)
    arm = places[:, 0] - L / 2
    readings = {
        "as the middle": fixed["die:hat"],
        "as a rigid body": fixed["die:hat"] - fixed["die:ry:hat"] * arm,  # ry = -dz/dx
        "along the path": along["die:hat"],
    }
    begin, end = SCAN.exposures[0]
    exposed = (run.time >= begin) & (run.time < end)
    gaps = {name: (hat - run["die:z"])[exposed] for name, hat in readings.items()}
    return {
        "run": run,
        "places": places,
        "exposed": exposed,
        "readings": readings,
        "rms": {name: float(np.sqrt(np.mean(gap**2))) for name, gap in gaps.items()},
        "stated": float(np.sqrt(np.mean(along.deviation("die:hat")[exposed] ** 2))),
        "motion": float(np.sqrt(np.mean(run["die:z"][exposed] ** 2))),
    }


# %% The table
def table(result: dict[str, Any]) -> str:
    """Return all numbers as text."""
    way = result["places"][result["exposed"]][:, 0]
    moved = f"the POI moves by {1e9 * result['motion']:.1f} nm rms in z"
    lines = [
        f"exposed from x = {1e3 * way[0]:.0f} to {1e3 * way[-1]:.0f} mm; {moved}",
        f"{'its motion is read':24s}{'error [nm rms]':>16s}",
    ]
    lines += [f"{name:24s}{1e9 * rms:16.3f}" for name, rms in result["rms"].items()]
    lines.append(f"{'stated along the path':24s}{1e9 * result['stated']:16.3f}")
    return "\n".join(lines)


# %% The picture
def picture(result: dict[str, Any], folder: Path = OUT) -> Path:
    """Draw the errors of the three readings over the place of the POI."""
    import matplotlib.pyplot as plt

    figure, axs = plt.subplots(2, 1, figsize=(9, 6), sharex=True, layout="constrained")
    figure.suptitle("What an estimate must know of the place of a POI that moves")
    at, truth = result["exposed"], result["run"]["die:z"]
    way = 1e3 * (L / 2 + SCAN.at(result["run"].time).position[at])
    shown = (
        {"as the middle": fx.plot.STYLES["nominal"]["color"]},
        {"as a rigid body": fx.plot.CYCLE[1]["color"], "along the path": fx.plot.CYCLE[0]["color"]},
    )
    for ax, colors in zip(axs, shown, strict=True):
        for name, color in colors.items():
            error = 1e9 * (result["readings"][name] - truth)[at]
            label = f"{name}: {1e9 * result['rms'][name]:.2f} nm rms"
            ax.plot(way, error, color=color, lw=0.8, label=label)
        ax.set_ylabel("error of the estimate [nm]")
        ax.legend(frameon=False, loc="upper left")
        ax.grid(alpha=0.3)
    axs[-1].set_xlabel("place x of the POI [mm]")
    folder.mkdir(exist_ok=True)
    figure.savefig(folder / "moving_poi.png", dpi=110)
    plt.close(figure)
    return folder / "moving_poi.png"


# %% Run it
if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    outcome = main()
    print(table(outcome), picture(outcome), sep="\n\npicture: ")
