"""A stage that scans under heads on its frame: the effect of the position, scheduled controllers.

Run it: ``python examples/scanning_stage.py``. The plate moves 200 mm in x below a lens and four
encoder heads that stay with the frame, so that the measured and exposed points on the plate depend
on x. One observer and one servo that are designed at the centre are compared with a scheduled
controller: designs at eleven positions, between which the gains are interpolated linearly. Both run
on a machine that is computed with another theory than the model.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # matrices are small: more threads only wait

from functools import cache
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import flexplant as fx

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
L, RATE, DELAY, BANDWIDTH = 0.6, 10e3, 1.3, 30.0  # m, Hz, samples, Hz
HEADS = [(x, y, 0.0) for y in (0.05, L - 0.05) for x in (0.15, L - 0.15)]
INSET = [(x, y, 0.0) for y in (L / 4, 3 * L / 4) for x in (L / 4, 3 * L / 4)]
X = fx.plant.Position("x", range=(-0.1, 0.1))
BELOW = {"x": (-1.0, 0.0, 0.0)}  # the point below a head moves opposite to the stage
MODES = [4, 5, 6, 7, 8]  # measured
NOTCHES = [360.0]  # Hz: the same at all positions
#: m: from -0.1 to 0.1 at 0.8 m/s
SCAN = fx.setpoint(0.2, velocity=0.8, acceleration=15.0, jerk=3e3, rate=RATE)
DURATION, RUNS = 0.35, 4  # s

# %% The model: a drawing, updated and calibrated by the poles of the machine
machine = fx.testbeds.wafer_stage(damping=0.01)
plate = fx.kirchhoff_plate(
    size=(L, L),
    thickness=0.0272,
    elements=(8, 8),
    density=2702,
    youngs_modulus=70e9,
    poisson_ratio=0.35,
)
PORTS = fx.Ports(
    u=[fx.Actuator(f"u{i}", at=p, asd=1e-3) for i, p in enumerate(INSET, 1)],
    z=[fx.Poi("die", at=(L / 2, L / 2, 0.0), axes=("z", "rx", "ry"), moves=BELOW)],
    y=[fx.Sensor(f"y{i}", at=p, asd=1.4e-12, moves=BELOW) for i, p in enumerate(HEADS, 1)],
    references=[fx.Reference("die")],
    positions=[X],
)


def model() -> fx.StandardPlant:
    """Return the plant of the updated drawing."""
    place = plate.dofs.nearest((L / 2, L / 4, 0.0), "z")
    modes = fx.solve_modes(plate, count=24, damping=fx.ModalDamping(0.01), compliance_at=[place])
    rom = fx.reduce(modes, fx.DesiredDofs(fx.select_dofs(modes, 25, required=[place]).labels))
    measured = machine.poles(MODES)
    unknown = [fx.AddedMass(place), fx.MatrixParameter("stiffness", dK=rom.K)]
    fit = fx.update(rom, unknown, [fx.Eigenvalues(measured)])
    return fx.assemble_plant(fit.calibrated(measured), PORTS).discretized(RATE, delay=DELAY)


# %% Designs: at the centre, and at eleven positions
def design(plant: fx.StandardPlant) -> tuple[Any, Any]:
    """Return the observer and the servo of a position."""
    return fx.design_kalman(plant), fx.design_servo(plant, bandwidth=BANDWIDTH, notches=NOTCHES)


def main() -> dict[str, Any]:
    """Compare both along the range, and along a scan of the machine."""
    plant = model()
    print(plant)
    centre = fx.close_loop(plant, *design(plant))
    schedule = fx.loop.schedule_loops(plant, design, places=np.linspace(*X.range, 11))
    print(schedule)

    # %% Effect of the position: on the model, then on the machine
    truth = machine.loop(PORTS, *centre.blocks).plant
    places = np.linspace(*X.range, 5)

    @cache
    def loops(there: fx.StandardPlant) -> dict[str, fx.ClosedLoop]:
        law = schedule.at(there.assembled.ports.values["x"]).blocks
        laws = {"fixed": centre.blocks, "following": law}
        return {name: fx.close_loop(there, *blocks) for name, blocks in laws.items()}

    judges = {
        f"{name}, {what}": lambda there, name=name, figure=figure: figure(loops(there)[name])
        for name in ("fixed", "following")
        for what, figure in (("margin", fx.modulus_margin), ("bandwidth", fx.loop.bandwidth))
    }
    maps = {
        "model": plant.map(judges, points=21),
        "machine": truth.map(judges, points={"x": places}),
    }
    for name, found in maps.items():
        print(name, found)

    # %% The scan: predicted, and on the machine
    start = {"x": lambda t: X.range[0] + SCAN.at(t).position}
    filters = fx.simulation.filters_along(plant, moving=start, duration=DURATION)
    print(filters)
    laws = {"fixed": centre, "following": schedule}
    predicted = {
        name: fx.simulation.rms_along(law, moving=start, duration=DURATION)
        for name, law in laws.items()
    }
    runs = {
        "fixed": machine.run(
            PORTS, *centre.blocks, duration=DURATION, moving=start, rng=1, runs=RUNS
        ),
        "following": machine.run(
            PORTS, schedule, duration=DURATION, moving=start, rng=1, runs=RUNS
        ),
    }
    rows = {}
    for name, run in runs.items():
        estimate = (run["die:z"] - run["die:hat"])[:, 500:]
        ma, msd = run.exposure("die:error", window=5e-3, start=0.05)
        rows[name] = {
            "predicted": float(np.sqrt(np.mean(predicted[name]["die:error"][500:] ** 2))),
            "error": float(np.sqrt(np.mean(run["die:error"][:, 500:] ** 2))),
            "estimate": float(np.sqrt(np.mean(estimate**2))),
            "ma": float(np.max(ma)),
            "msd": float(np.max(msd)),
            "margin": float(np.min(maps["machine"].figures[f"{name}, margin"])),
            "bandwidth": float(np.min(maps["machine"].figures[f"{name}, bandwidth"])),
        }
        print(
            f"{name:10s} on the machine: margin {rows[name]['margin']:.2f}, bandwidth "
            f"{rows[name]['bandwidth']:.1f} Hz at least; rms error at the die "
            f"{1e9 * rows[name]['predicted']:.1f} nm predicted, {1e9 * rows[name]['error']:.1f} on "
            f"the machine; of the estimate {1e9 * rows[name]['estimate']:.2f} nm; "
            f"MA {1e9 * rows[name]['ma']:.1f}, MSD {1e9 * rows[name]['msd']:.1f} nm"
        )
    draw(maps, runs)
    return {"rows": rows, "maps": maps, "filters": filters, "predicted": predicted, "runs": runs}


# %% The picture
def draw(maps: Any, runs: Any) -> None:
    """Draw margin and bandwidth over the range; MA, MSD and the estimate's error along the scan."""
    figure, panels = plt.subplots(2, 2, layout="constrained", figsize=(12.0, 7.5))
    (margin, bandwidth), (exposed, estimated) = panels
    for name, colour in (("fixed", "#D55E00"), ("following", "#0072B2")):
        for kind, style in (("model", "-"), ("machine", "o")):
            x = 1e3 * maps[kind].grid["x"]
            for panel, what in ((margin, "margin"), (bandwidth, "bandwidth")):
                y = maps[kind].figures[f"{name}, {what}"]
                panel.plot(x, y, style, color=colour, label=f"{name}, {kind}")
        run = runs[name]
        ma = np.abs(run.moving_average("die:error")).max(axis=0)
        msd = run.moving_std("die:error").max(axis=0)
        for size, style, what in ((ma, "-", "MA"), (msd, "--", "MSD")):
            exposed.plot(1e3 * run.time, 1e9 * size, style, color=colour, label=f"{what}, {name}")
        square = np.mean((run["die:z"] - run["die:hat"]) ** 2, axis=0)
        smooth = np.sqrt(np.convolve(square, np.full(50, 1 / 50), "same"))
        estimated.plot(1e3 * run.time, 1e9 * smooth, color=colour, label=name)
    scan = f"through a scan from {1e3 * X.range[0]:g} to {1e3 * X.range[1]:g} mm"
    margin.set(xlabel="position x [mm]", ylabel="modulus margin", ylim=(0.0, 0.7))
    bandwidth.set(xlabel="position x [mm]", ylabel="bandwidth [Hz]", ylim=(0.0, 25.0))
    exposed.set(xlabel="time [ms]", ylabel="error at the die [nm]", ylim=(0.0, 120.0))
    exposed.set_title(f"largest of {RUNS} runs on the machine, 5 ms windows, {scan}", fontsize=9)
    estimated.set(
        xlabel="time [ms]", ylabel="rms error of the die's estimate [nm]", ylim=(0.0, None)
    )
    estimated.set_title(f"machine, over 5 ms, {scan}", fontsize=9)
    for panel in panels.flat:
        panel.grid(True, alpha=0.25)
        panel.legend(fontsize=8)
    OUT.mkdir(exist_ok=True)
    figure.savefig(OUT / "scanning_stage.png", dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    main()
