"""A six-axis stage that floats on magnets: from its mesh to the error at a moving point.

Run it: ``python examples/maglev.py``. Magnets that attract have negative stiffness. Without control
the stage falls to one side, and its distance from the centre doubles every 10 to 30 ms. Eight
actuators with noisy amplifiers hold it, and seven sensors measure its position relative to a floor
that vibrates. The point of interest (POI), where a wafer is exposed, moves over the top of the
stage. No sensor measures this point.

All numbers in the tables are computed without simulation: rms errors come from Lyapunov equations.
The last table compares the predictions for the loop with the result on a virtual machine that is
computed with another theory, and has a mass and magnets that the drawing does not have.
"""

# %% Names and numbers
from pathlib import Path
from typing import Any

import numpy as np

import flexplant as fx
from flexplant.lti import high_pass_filter
from flexplant.plant import BaseAcceleration, GroundSpring, gravity_axes, suspend

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
SIZE, ELEMENTS = (0.4, 0.3, 0.05), (8, 6, 2)  # m
LX, LY, LZ = SIZE
RATE, DELAY = 10e3, 1  # Hz, samples
BANDWIDTH = 100.0  # Hz
AXES = ("x", "y", "z", "rx", "ry", "rz")
CORNERS = [(x, y) for x in (0.0, LX) for y in (0.0, LY)]

#: N/m of the magnets at each corner
MAGNETS = [
    GroundSpring((x, y, LZ / 2), stiffness, direction=along)
    for x, y in CORNERS
    for along, stiffness in (("x", -2e3), ("y", -2e3), ("z", -6e3))
]

#: name: (place, direction) of eight actuators, one more in z and in x than axes
ACTUATORS = {
    "z1": ((0.05, 0.05, 0.0), "z"),
    "z2": ((0.35, 0.05, 0.0), "z"),
    "z3": ((0.05, 0.25, 0.0), "z"),
    "z4": ((0.35, 0.25, 0.0), "z"),
    "x1": ((0.0, 0.075, 0.025), "x"),
    "x2": ((0.0, 0.225, 0.025), "x"),
    "y1": ((0.1, 0.0, 0.025), "y"),
    "y2": ((0.3, 0.0, 0.025), "y"),
}
#: seven sensors in addition to that of the floor: encoders, one more in z than axes
SENSORS = {
    "ez1": ((0.0, 0.0, LZ), "z"),
    "ez2": ((LX, 0.0, LZ), "z"),
    "ez3": ((0.0, LY, LZ), "z"),
    "ez4": ((LX, LY, LZ), "z"),
    "ex1": ((LX, 0.05, 0.025), "x"),
    "ex2": ((LX, 0.25, 0.025), "x"),
    "ey1": ((0.2, LY, 0.025), "y"),
}
AMPLIFIER = 1e-4  # N/sqrt(Hz) at its input
ENCODER = 1e-11  # m/sqrt(Hz)
FLOOR = 2e-5  # m/s^2/sqrt(Hz) between 1 and 60 Hz
#: path of the POI, from the middle of the top to a corner
PATH = [(0.2 + 0.16 * s, 0.15 + 0.11 * s, LZ) for s in np.linspace(0.0, 1.0, 3)]


# %% The machine
def modes(count: int) -> fx.Modes:
    """Return the modes of the aluminium block on its magnets, 0.5 % damped."""
    block = fx.solid_block(
        size=SIZE, elements=ELEMENTS, density=2700, youngs_modulus=70e9, poisson_ratio=0.33
    )
    return suspend(fx.solve_modes(block, count=count, damping=fx.ModalDamping(0.005)), MAGNETS)


def ports() -> fx.Ports:
    """Return the channels: the floor, eight actuators, the POI, seven sensors."""
    spectrum = fx.lti.low_pass_filter(60.0) * high_pass_filter(1.0, order=2)
    return fx.Ports(
        w=[
            BaseAcceleration(f"floor:{axis}", axis, asd=FLOOR, shape=spectrum)
            for axis in ("x", "y", "z")
        ],
        u=[
            fx.Actuator(
                name, at, direction=along, dynamics=fx.lti.low_pass_filter(4e3), asd=AMPLIFIER
            )
            for name, (at, along) in ACTUATORS.items()
        ],
        z=[fx.Poi("die", at=PATH[0], axes=AXES)],
        y=[
            fx.Sensor(name, at, direction=along, asd=ENCODER)
            for name, (at, along) in SENSORS.items()
        ],
    )


# %% Observer, controller and error budget, with the POI at one place
def held(plant: fx.StandardPlant) -> dict[str, Any]:
    """Return the observer, the controller and the loop of a plant."""
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=BANDWIDTH, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    return {"observer": observer, "servo": servo, "loop": loop}


def main() -> dict[str, Any]:
    """Return what is printed, drawn and pinned by the tests."""
    many = modes(40)
    few = many.select(range(16))  # six on the magnets, ten elastic; the others are truncated
    plant = fx.assemble_plant(few, ports(), evaluation=many)
    sampled = plant.discretized(RATE, delay=DELAY)
    path = [held(sampled.at(point)) for point in PATH]
    middle, corner = path[0]["loop"], path[-1]["observer"].plant
    rigid = gravity_axes(plant)
    machine = fx.testbeds.magnet_stage(rate=RATE, delay=DELAY)
    return {
        "machine": machine.loop(ports(), path[0]["observer"], path[0]["servo"]),
        "modes": few,
        "plant": plant,
        "report": plant.check(),
        "decoupling": rigid,
        "path": path,
        "budgets": {axis: middle.budget(f"die:{axis}") for axis in ("x", "z")},
        # a filter that reads only the decoupled motions, at the corner
        "six": fx.design_kalman(corner.through(gravity_axes(corner).to_motions)),
    }


# %% Tables
def poles(found: dict[str, Any]) -> str:
    """Return the effect of the magnets on the six rigid-body motions."""
    grows = sorted(pole.real for pole in found["plant"].system.poles() if pole.real > 1e-6)
    rows = [f"{pole:8.2f}{1e3 * np.log(2.0) / pole:12.1f}" for pole in grows]
    return "\n".join(["growth [1/s], doubles in [ms]", *rows])


def along(found: dict[str, Any]) -> str:
    """Return the errors along the path of the POI: of the estimate, and of the closed loop."""
    head = f"{'POI at [m]':18s}" + "".join(
        f"{f'{axis} [{unit}]':>16s}" for axis in AXES for unit in [_unit(axis)]
    )
    lines = ["rms of the estimation error / of the motion in closed loop", head]
    for point, case in zip(PATH, found["path"], strict=True):
        cells = [
            f"{1e9 * case['observer'].rms(f'die:{axis}'):.3f} / "
            f"{1e9 * case['loop'].rms(f'die:{axis}'):.3f}"
            for axis in AXES
        ]
        place = f"({point[0]:.2f}, {point[1]:.4g})"
        lines.append(f"{place:18s}" + "".join(f"{cell:>16s}" for cell in cells))
    return "\n".join(lines)


def _unit(axis: str) -> str:
    return "nrad" if axis.startswith("r") else "nm"


def on_the_machine(found: dict[str, Any]) -> str:
    """Return the motion and the margin of the loop in the middle: predicted, and on the machine."""
    loops = {"promised": found["path"][0]["loop"], "on the machine": found["machine"]}
    lines = ["".join(f"{head:>16s}" for head in ["", *loops])]
    for axis in AXES:
        sizes = [1e9 * loop.rms(f"die:{axis}") for loop in loops.values()]
        label = f"{axis} [{_unit(axis)}]"
        lines.append("".join(f"{cell:>16s}" for cell in [label, *(f"{x:.3f}" for x in sizes)]))
    margins = [f"{loop.modulus_margin:.3f}" for loop in loops.values()]
    return "\n".join([*lines, "".join(f"{cell:>16s}" for cell in ["modulus margin", *margins])])


def table(found: dict[str, Any]) -> str:
    """Return all tables as text."""
    rigid, first = found["decoupling"], found["path"][0]
    mass = ", ".join(f"{m:.4g}" for m in np.diag(rigid.mass))
    parts = [
        f"The stage on its magnets:\n{found['modes']}\n{poles(found)}",
        f"The plant:\n{found['plant']}",
        f"What the channels reach and see:\n{found['report']}",
        f"Actuators to forces at the centre of gravity, sensors to its motions:\n{rigid}",
        f"Inertia along {', '.join(AXES)}: {mass} (kg, then kg m^2)",
        f"The observer in the middle:\n{first['observer']}",
        f"The controller in the middle:\n{first['servo']}",
        f"The loop in the middle:\n{first['loop']}",
        *(f"Where the error in {axis} comes from:\n{b}" for axis, b in found["budgets"].items()),
        f"Along the path:\n{along(found)}",
        f"The loop in the middle on a machine of another formulation:\n{on_the_machine(found)}",
    ]
    seven, six = (1e9 * f.rms("die:z") for f in (found["path"][-1]["observer"], found["six"]))
    parts.append(
        f"At the corner, an observer that reads six decoupled motions instead of seven sensors "
        f"errs by {six:.4f} nm in z instead of {seven:.4f} nm"
    )
    return "\n\n".join(parts)


# %% Pictures
def picture(found: dict[str, Any], folder: Path = OUT) -> Path:
    """Draw the budgets, the margins and the errors along the path."""
    import matplotlib.pyplot as plt

    figure, axs = plt.subplots(2, 2, figsize=(13, 9), layout="constrained")
    figure.suptitle("A stage on magnets of negative stiffness: errors at the point of interest")
    for axis, ax in zip(("z", "x"), axs[0], strict=True):
        fx.plot.budget(found["budgets"][axis], most=5, ax=ax)
        ax.set(xlim=(0.5, 5e3))
    for kind, ax in zip((("x", "y", "z"), ("rx", "ry", "rz")), axs[1], strict=True):
        way = [1e3 * np.linalg.norm(np.subtract(point, PATH[0])) for point in PATH]
        for i, axis in enumerate(kind):
            for what, style in (("loop", "-"), ("observer", "--")):
                rms = [1e9 * case[what].rms(f"die:{axis}") for case in found["path"]]
                label = axis if what == "loop" else f"{axis}, of its estimate"
                color = fx.plot.CYCLE[i]["color"]
                ax.plot(way, rms, style, color=color, marker="o^s"[i], markersize=4, label=label)
        ax.set(xlabel="distance of the POI from the middle [mm]", ylim=(0.0, None))
        ax.set(ylabel=f"rms error [{_unit(kind[0])}]", title=f"{', '.join(kind)} along the path")
        ax.legend(frameon=False, ncols=3)
        ax.grid(alpha=0.3)
    folder.mkdir(exist_ok=True)
    figure.savefig(folder / "maglev.png", dpi=90)
    plt.close(figure)
    return folder / "maglev.png"


# %% Run it
if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    outcome = main()
    print(table(outcome), picture(outcome), sep="\n\npicture: ")
