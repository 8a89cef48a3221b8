"""From a record to the motion at the die: whether the filter is consistent, and how to correct it.

Run it: ``python examples/recorded_data.py``, or with your own CSV file, whose columns are ``time``
and the sensors and commands by name. Without a file the script records two seconds of a virtual
stage whose amplifiers are three times noisier than their data sheet says, and loses 0.1 s of one
sensor. A filter made with the data sheet states errors that are too small. The record shows this,
and gives the noise densities with which the stated errors are correct.

Machine and model have the same mesh here on purpose, because only then should the estimated
densities equal those used for the record. The machine of `fx.testbeds.wafer_stage` also has modes
above half the rate, which are aliased into the record, even if the model has all poles below half
the rate. The verdict names them, and the estimated densities of the sensors are nearly four times
too large, because they include these modes.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # matrices are small: more threads only wait

import csv
import sys
from pathlib import Path
from typing import Any

import numpy as np

import flexplant as fx
from flexplant.estimation import consistency, estimate_noise

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
L, RATE, DELAY = 0.6, 4e3, 1  # m, Hz, samples
SHEET, REAL = 1e-3, 3e-3  # N/sqrt(Hz) of an amplifier: of its data sheet, and in truth
ENCODER = 3e-11  # m/sqrt(Hz)
DAMPING = fx.ModalDamping(0.01)
CORNERS = [(x, y, 0.0) for y in (0.0, L) for x in (0.0, L)]
INSET = [(x, y, 0.0) for y in (L / 4, 3 * L / 4) for x in (L / 4, 3 * L / 4)]
DARK = (1.0, 1.1)  # s, when y2 measures nothing
SETTLED = 0.5  # s, from when errors are judged

# %% The model of the stage: a plate, twelve modes of it
plate = fx.kirchhoff_plate(
    size=(L, L),
    thickness=0.0272,
    elements=(8, 8),
    density=2702,
    youngs_modulus=70e9,
    poisson_ratio=0.35,
)
modes = fx.solve_modes(plate, count=12, damping=DAMPING)


def plant(amplifier: float) -> fx.StandardPlant:
    """Return the sampled plant with amplifiers of one density [N/sqrt(Hz)]."""
    ports = fx.Ports(
        w=[fx.Disturbance(f"amp{i}", at=p, asd=amplifier) for i, p in enumerate(INSET, 1)],
        u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(INSET, 1)],
        z=[fx.Poi("die", at=(L / 2, L / 2, 0.0), axes=("z", "rx", "ry"))],
        y=[fx.Sensor(f"y{i}", at=p, asd=ENCODER) for i, p in enumerate(CORNERS, 1)],
        references=[fx.Reference("die")],
    )
    return fx.assemble_plant(modes, ports).discretized(RATE, delay=DELAY)


# %% A record: a stage held by a slow servo; one sensor fails for a while
def recorded(path: Path) -> fx.Response:
    """Write the signals of a controller to a CSV file; return the run with all signals."""
    machine = plant(REAL)
    eyes = fx.design_static(machine)
    servo = fx.design_servo(machine, bandwidth=10.0, observer=eyes)
    run = fx.simulate(fx.close_loop(machine, eyes, servo), duration=2.0, rng=3)
    seen = [f"y{i}" for i in range(1, 5)] + [f"u{i}" for i in range(1, 5)]
    columns = {"time": run.time} | {name: run[name].copy() for name in seen}
    columns["y2"][(run.time >= DARK[0]) & (run.time < DARK[1])] = np.nan
    path.parent.mkdir(exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
    return run


def read(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a CSV file by name; pandas.read_csv(path) works as well."""
    with path.open(encoding="utf-8") as file:
        names = file.readline().strip().split(",")
    return dict(zip(names, np.loadtxt(path, delimiter=",", skiprows=1).T, strict=True))


# %% The filter of the data sheet, the densities of the record, the filter made with these
def main(path: Path | None = None) -> dict[str, Any]:
    """Return both filters, their estimates and their tests on the record."""
    run = recorded(OUT / "record.csv") if path is None else None
    records = read(path or OUT / "record.csv")
    sheet = fx.design_kalman(plant(SHEET))
    levels = estimate_noise(sheet.plant, records)
    observers = {"data sheet": sheet, "record": fx.design_kalman(levels.plant)}
    estimates = {name: one.estimate(records) for name, one in observers.items()}
    smooth = observers["record"].estimate(records, fx.estimation.Smoother())
    result = {"records": records, "run": run, "levels": levels, "observers": observers}
    result |= {"estimates": estimates | {"record, smoother": smooth}}
    result["verdicts"] = {n: consistency(observers[n], estimates[n]) for n in observers}
    return result


def errors(result: dict[str, Any]) -> dict[str, tuple[float, float, float]]:
    """Return the rms of each estimate's error where nothing is missing, the stated one, NEES."""
    run, found = result["run"], {}
    time = run.time
    whole = (time > SETTLED) & ((time < DARK[0]) | (time > DARK[1] + 0.1))
    for name, one in result["estimates"].items():
        gap, stated = one["die:hat"] - run["die:z"], one.deviation("die:hat")
        nees = np.mean((gap[whole] / stated[whole]) ** 2)
        rms = (float(np.sqrt(np.mean(part[whole] ** 2))) for part in (gap, stated))
        found[name] = (*rms, float(nees))
    return found


# %% The table
def table(result: dict[str, Any]) -> str:
    """Return all numbers as text."""
    lines = [f"filter of the {n}: {said.text}" for n, said in result["verdicts"].items()]
    levels = result["levels"]
    lines += ["", f"{'channel':10s}{'data sheet':>14s}{'record':>14s}{'+-':>8s}"]
    sheet = result["observers"]["data sheet"].plant.asd
    for name in levels.channels:
        lines.append(
            f"{name:10s}{sheet[name]:14.3g}{levels.asd[name]:14.3g}{levels.relative[name]:8.1%}"
        )
    if result["run"] is not None:  # only a virtual machine shows the true motion
        lines += ["", f"{'estimate at the die':22s}{'error [nm]':>12s}{'stated [nm]':>12s}"]
        for name, (rms, stated, _) in errors(result).items():
            lines.append(f"{name:22s}{1e9 * rms:12.2f}{1e9 * stated:12.2f}")
    return "\n".join(lines)


# %% The picture
def picture(result: dict[str, Any], folder: Path = OUT) -> Path:
    """Draw the estimate with its deviation while a sensor fails."""
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(figsize=(9, 4), layout="constrained")
    one, run = result["estimates"]["record"], result["run"]
    near = (one.time > DARK[0] - 0.05) & (one.time < DARK[1] + 0.05)
    deviation = 1e9 * one.deviation("die:hat")[near]
    # for your own machine the truth is not known: the estimate itself is drawn
    middle = 1e9 * (one["die:hat"] - (0.0 if run is None else run["die:z"]))[near]
    center = middle if run is None else np.zeros_like(middle)
    ax.axvspan(*DARK, color="0.92", label="y2 sees nothing")
    blue = fx.plot.STYLES["model"]["color"]
    ax.fill_between(
        one.time[near],
        center - 2 * deviation,
        center + 2 * deviation,
        color=blue,
        alpha=0.3,
        lw=0,
        label="2 standard deviations, as the filter states them",
    )
    what = "motion of the die" if run is None else "error of the estimate at the die"
    ax.plot(one.time[near], middle, color=blue, lw=0.8, label=what)
    ax.set(xlabel="time [s]", ylabel=f"{what} [nm]")
    ax.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    folder.mkdir(exist_ok=True)
    figure.savefig(folder / "recorded_data.png", dpi=110)
    plt.close(figure)
    return folder / "recorded_data.png"


# %% Run it
if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    files = [Path(word) for word in sys.argv[1:] if word.endswith(".csv")]
    outcome = main(*files[:1])
    print(table(outcome), picture(outcome), sep="\n\npicture: ")
