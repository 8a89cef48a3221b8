"""Loops shaped by hand in a browser, on measured FRFs of a machine, up to C code.

Run it: ``python examples/workbench.py``. It measures the virtual stage and opens the workbench on
its frequency responses, with a model for the error at the die and the truncated modes. Then it
waits until Ctrl-C. ``--no-browser`` only prints the results that the page would show for the same
design. For your own measurement, without a line of Python:
``python -m flexplant.workbench measured.uff --rate 10000``.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # matrices are small: more threads only wait

import sys
from pathlib import Path
from typing import Any

import flexplant as fx
from flexplant.synthesis import LoopDesign, LowPass, Notch, Pid, ShapedAxis

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
L, RATE, DELAY = 0.6, 10e3, 1.3  # m, Hz, samples
CORNERS = [(x, y, 0.0) for y in (0.0, L) for x in (0.0, L)]
INSET = [(x, y, 0.0) for y in (L / 4, 3 * L / 4) for x in (L / 4, 3 * L / 4)]
PORTS = fx.Ports(
    w=[fx.Disturbance(f"amp{i}", at=p, asd=1e-3) for i, p in enumerate(INSET, 1)],
    u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(INSET, 1)],
    z=[fx.Poi("die", at=(L / 2, L / 2, 0.0), axes=("z", "rx", "ry"))],
    y=[fx.Sensor(f"y{i}", at=p, asd=1.4e-12) for i, p in enumerate(CORNERS, 1)],
    references=[fx.Reference("die")],
)


# %% Available: responses of the machine, and the drawing
def measured() -> fx.Frf:
    """Return the responses from each actuator to each sensor, with their variance."""
    machine = fx.testbeds.wafer_stage(rate=RATE)
    return machine.measure_frf(PORTS, period=0.4, periods=4, discard=1, amplitude=5.0, rng=3)


def drawn() -> fx.StandardPlant:
    """Return the plant of the drawing with 12 modes, judged on 60."""
    plate = fx.kirchhoff_plate(
        size=(L, L), thickness=0.0272, elements=(12, 12), density=2702,
        youngs_modulus=70e9, poisson_ratio=0.35,
    )  # fmt: skip
    modes = fx.solve_modes(plate, count=60, damping=fx.ModalDamping(0.01))
    plant = fx.assemble_plant(modes.select(range(12)), PORTS, evaluation=modes)
    return plant.discretized(RATE, delay=DELAY)


# %% A law for each axis of the rigid body: what sliders set, in a script
def law(crossover: float, gain: float, *notches: float) -> ShapedAxis:
    """Return PID around a crossover, a low-pass, and notches at some frequencies [Hz]."""
    pid = Pid.corners(
        1.0, integrator=crossover / 8, zero=crossover / 3, pole=3.5 * crossover
    )  # fmt: skip
    filters = [Notch(freq, depth=0.15, width=0.3) for freq in notches]
    return ShapedAxis([pid, LowPass(12 * crossover), *filters], gain)


def shaped(frf: fx.Frf, plant: fx.StandardPlant) -> LoopDesign:
    """Return laws of 60 Hz for the rigid body of the drawing, on the measured responses."""
    axes = {
        "die:z": law(60.0, 4.9e4, 455.0),
        "die:rx": law(60.0, 4.9e4, 636.0, 1130.0),
        "die:ry": law(60.0, 4.9e4, 630.0, 1130.0),
    }
    rigid = fx.decouple(plant)
    return LoopDesign.on(
        frf, axes, before=rigid.accelerations, after=rigid.to_motions, rate=RATE, hold=False,
        references={"die:z": "die:ref"},
    )  # fmt: skip


# %% The run
def main(*, browser: bool = False) -> dict[str, Any]:
    """Return the design, as it was when the page was left, and its loops on both plants."""
    frf, plant = measured(), drawn()
    bench = fx.workbench.open_page(
        frf, design=shaped(frf, plant), model=plant, open_browser=browser
    )
    design = bench.design
    closed = fx.close_loop(plant, design.controller())
    OUT.mkdir(exist_ok=True)
    design.save(OUT / "loops.npz")
    fx.export.write_c(design.controller(), OUT / "loops.c")
    return {"frf": frf, "bench": bench, "design": design, "loops": design.loops(frf)} | {
        "plant": plant, "closed": closed,
    }  # fmt: skip


def table(result: dict[str, Any]) -> str:
    """Return what the page shows, as text."""
    closed = result["closed"]
    lines = [repr(result["design"]), repr(result["loops"].report)]
    lines.append(f"on the drawing: {closed.decay}; truncated modes: {closed.left_out.summary}")
    lines.append(f"predicted error at the die: {1e9 * closed.rms('die:error'):.2f} nm rms")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(main(browser="--no-browser" not in sys.argv)))
