"""A stage that scans under heads on its frame: what the position does, and controllers that follow.

Run it: ``python examples/scanning_stage.py``. The plate moves 200 mm in x below a lens and four
encoder heads that stay with the frame, so that each point of it that is measured or exposed
depends on x. One observer and one servo designed at the centre stand beside designs at eleven
positions, linear between them. Both run on a machine of another formulation than the model's.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # matrices are small: more threads only wait

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
BELOW = {"x": (-1.0, 0.0, 0.0)}  # what is below a head moves against the stage
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
    return (
        fx.design_kalman(plant),
        fx.design_servo(plant, bandwidth=BANDWIDTH, notches=NOTCHES),
    )


def main() -> dict[str, Any]:
    """Compare both along the range, and along a scan of the machine."""
    plant = model()
    print(plant)
    centre = fx.close_loop(plant, *design(plant))
    schedule = fx.loop.schedule_loops(plant, design, places=np.linspace(*X.range, 11))
    print(schedule)
    print(fx.simulation.certify_speed(schedule, 0.8))

    # %% What the position does: of the model, then of the machine
    truth = machine.loop(PORTS, *centre.blocks).plant
    places = np.linspace(*X.range, 5)

    def fixed(there: fx.StandardPlant) -> float:
        return fx.modulus_margin(fx.close_loop(there, *centre.blocks))

    def following(there: fx.StandardPlant) -> float:
        law = schedule.at(there.assembled.ports.values["x"]).blocks
        return fx.modulus_margin(fx.close_loop(there, *law))

    judges = {"fixed": fixed, "following": following}
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
            "margin": float(np.min(maps["machine"].figures[name])),
        }
        print(
            f"{name:10s} least margin on the machine {rows[name]['margin']:.2f}; error at the die "
            f"{1e9 * rows[name]['predicted']:.1f} nm predicted, {1e9 * rows[name]['error']:.1f} on "
            f"the machine; of the estimate {1e9 * rows[name]['estimate']:.2f} nm; "
            f"MA {1e9 * rows[name]['ma']:.1f}, MSD {1e9 * rows[name]['msd']:.1f} nm"
        )
    draw(maps, predicted, runs)
    return {"rows": rows, "maps": maps, "filters": filters, "predicted": predicted, "runs": runs}


# %% The picture
def draw(maps: Any, predicted: Any, runs: Any) -> None:
    """Draw margins over the range, and errors along the scan."""
    figure, panels = plt.subplots(3, 1, layout="constrained", figsize=(7.5, 8.0))
    colours = {"fixed": "#D55E00", "following": "#0072B2"}
    for name, colour in colours.items():
        for kind, style in (("model", "-"), ("machine", "o")):
            x = 1e3 * maps[kind].grid["x"]
            panels[0].plot(
                x, maps[kind].figures[name], style, color=colour, label=f"{name}, {kind}"
            )
        run = runs[name]
        rms = 1e9 * np.sqrt(np.mean(run["die:error"] ** 2, axis=0))
        smooth = np.convolve(rms**2, np.full(200, 1 / 200), "same") ** 0.5
        panels[1].plot(1e3 * run.time, smooth, ".", ms=1, color=colour, label=f"{name}, machine")
        panels[1].plot(
            1e3 * run.time, 1e9 * predicted[name]["die:error"], color=colour,
            label=f"{name}, predicted",
        )  # fmt: skip
        estimate = 1e9 * np.sqrt(np.mean((run["die:z"] - run["die:hat"]) ** 2, axis=0))
        panels[2].semilogy(1e3 * run.time, estimate, color=colour, label=name)
    panels[0].set(xlabel="position x [mm]", ylabel="modulus margin")
    panels[1].set(xlabel="time [ms]", ylabel="rms error at the die [nm]")
    panels[2].set(xlabel="time [ms]", ylabel="rms error of its estimate [nm]")
    for panel in panels:
        panel.grid(True, alpha=0.25)
        panel.legend(fontsize=8)
    OUT.mkdir(exist_ok=True)
    figure.savefig(OUT / "scanning_stage.png", dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    main()
