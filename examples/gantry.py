"""A machine of which no body is free: an H-gantry on a frame with soft feet, from plant to move.

Two motors push a bridge against the frame, a third one pushes the carriage along the bridge, and
all of them shake the frame that their encoders stand on. The axes that are controlled are those
that the motors move: x and y of the tool relative to the frame, and the skew of the bridge.

Run it: ``python examples/gantry.py``. It prints what a servo and an H-infinity controller reach in
the direction y, and how large the error of the tool is in a move of 20 mm along y, without
feedforward and with it. Its picture shows both::

                |S| < 1 up to  max |S|  max |S| at u
    servo             18.2 Hz   4.8 dB        6.0 dB
    H-infinity         6.9 Hz   5.2 dB        5.5 dB

    largest error of the tool in the move of 20 mm
    without feedforward             357 um
    with the loop's feedforward    2.81 um
    with that of this move          2.4 um
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import flexplant as fx

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook

BANDWIDTH = 6.0  # Hz, of the H-infinity design
MOVE = {"velocity": 0.05, "acceleration": 0.5, "jerk": 10.0, "snap": 400.0}  # of 20 mm


# %% The plant and its axes
def axes_of(plant: fx.StandardPlant) -> fx.plant.DrivenAxes:
    """Return the axes and how forces reach them, decoupled on the real axis."""
    return fx.plant.driven_axes(plant, freq=BANDWIDTH)


# %% Loops
def servo_loop(plant: fx.StandardPlant, observer: Any) -> tuple[float, fx.ClosedLoop]:
    """Return the largest bandwidth of a servo, and its loop."""
    reach = fx.servo_bandwidth(plant, observer=observer)
    servo = fx.design_servo(plant, bandwidth=reach, observer=observer)
    return reach, fx.close_loop(plant, observer, servo)


def hinf_loop(plant: fx.StandardPlant) -> fx.ClosedLoop:
    """Return the H-infinity loop, which reads errors at the encoders."""
    errors = fx.reference_errors(plant)
    weights = fx.stage_weights(plant, BANDWIDTH)
    controller = fx.design_hinf(plant.through(errors).weighted(weights))
    return fx.close_loop(plant, errors, controller)


# %% A move along y: forces from its derivatives
def runs_of_a_move(loop: fx.ClosedLoop) -> dict[str, fx.Response]:
    """Return the move without feedforward, with that of the loop, and with that of this move."""
    plant = loop.plant
    move = fx.setpoint(20e-3, **MOVE, rate=1.0 / plant.dt)
    forward = {
        "without feedforward": (),
        "with the loop's feedforward": (fx.design_feedforward(loop, reference="tool_y:ref"),),
        "with that of this move": (fx.design_feedforward(loop, reference="tool_y:ref", move=move),),
    }
    found = {}
    for name, blocks in forward.items():
        fed = fx.close_loop(plant, *loop.blocks, *blocks)
        found[name] = fx.simulate(fed, reference={"tool_y:ref": move}, duration=1.2, noise=False)
    return found


# %% The run
def main() -> dict[str, Any]:
    """Return what is printed and drawn."""
    plant = fx.testbeds.gantry()
    observer = fx.design_kalman(plant)
    reach, servo = servo_loop(plant, observer)
    loops = {"servo": servo, "H-infinity": hinf_loop(plant)}
    return {"axes": axes_of(plant), "reach": reach, "loops": loops, "runs": runs_of_a_move(servo)}


def errors(result: dict[str, Any]) -> dict[str, float]:
    """Return the largest error of the tool along y [m] in each run of the move."""
    return {name: float(np.max(run.peak("tool_y:error"))) for name, run in result["runs"].items()}


def table(result: dict[str, Any]) -> str:
    """Return all numbers as text."""
    lines = [
        f"the axes: {result['axes']}",
        f"the loop gain of the servo crosses 1 at {result['reach']:.3g} Hz: max |S| at u is 6 dB",
        str(fx.compare_loops(result["loops"], reference="tool_y:ref")),
        "largest error of the tool in the move of 20 mm",
    ]
    lines += [f"  {name:28s}{1e6 * size:8.3g} um" for name, size in errors(result).items()]
    return "\n".join(lines)


def picture(result: dict[str, Any], folder: Path = OUT) -> Path:
    """Draw |S| of both loops, and the error in the move without feedforward and with it."""
    import matplotlib.pyplot as plt

    figure, axs = plt.subplots(3, 1, figsize=(9, 10), layout="constrained")
    freq = np.geomspace(0.2, 200.0, 600)
    curves = {
        name: (freq, np.abs(loop.frequency_response(freq)["tool_y:error", "tool_y:ref"]))
        for name, loop in result["loops"].items()
    }
    fx.plot.sensitivity(curves, ax=axs[0])
    axs[0].set_title("|S| from the reference of the tool along y to its error")
    first, *fed = result["runs"].items()
    for ax, runs in ((axs[1], [first]), (axs[2], fed)):
        for (name, run), color in zip(runs, ("#0072B2", "#D55E00"), strict=False):
            fx.plot.response(run, channels=["tool_y:error"], label=name, color=color, ax=ax)
        ax.legend()
    axs[1].set_title("error of the tool in the move of 20 mm")
    folder.mkdir(exist_ok=True)
    figure.savefig(folder / "gantry.png", dpi=90)
    plt.close("all")
    return folder / "gantry.png"


if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    outcome = main()
    print(table(outcome), picture(outcome), sep="\n\npicture: ")
