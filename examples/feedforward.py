"""Feedforward for a move of the wafer stage: how much each order reduces the error.

Run it: ``python examples/feedforward.py``. Two loops of `wafer_stage.py`, designed on the model
with measured poles, move a virtual machine by 100 um. The machine has another plate theory than the
model. Feedforward is designed for this move on the model of each loop: first order by order, then
as an inverse with preview. Finally a loop that is designed on the drawing, whose mass and stiffness
are wrong, learns its feedforward gains from repeated moves. The table shows errors at the die in
nm: the largest error during the move, and the mean error over 5 ms after it::

    feedforward      best servo         tolerant
                   largest   after   largest   after
    none              5850    3090      1170     148
    acceleration        87      26        33     8.3
    jerk               9.8     2.8       5.4     1.9
    snap               4.2     0.4       4.4     0.5
    inverse            2.9     0.2       3.3     0.2
"""

# %% Names and numbers
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import flexplant as fx
import wafer_stage as stage
from flexplant import simulation as sim

DAMPING, DURATION = 0.001, 0.5  # 1, s
MOVE = fx.setpoint(
    100e-6, velocity=5e-3, acceleration=0.5, jerk=100.0, snap=4e4, rest=0.05, rate=stage.RATE
)
TERMS = ("acceleration", "jerk", "snap")


# %% The moves
def moved(case: dict[str, Any], *blocks: Any, reference: Any = MOVE, **noise: Any) -> fx.Response:
    """Return the move on the machine; without noise unless there is a seed."""
    loop = case["machine"].loop(stage.ports(), *blocks)
    options = {"noise": False} | noise
    return fx.simulate(loop, reference=reference, duration=DURATION, **options)


# %% Term by term, and the inverse
def orders(case: dict[str, Any], design: Any, *known: Any) -> dict[str, fx.Response]:
    """Return the move with feedforward of each order, and with the inverse."""
    plant = stage.plant_of(case, "measured")
    blocks = design(plant, *known)
    model = fx.close_loop(plant, *blocks)
    runs = {"none": moved(case, *blocks)}
    for order, term in enumerate(TERMS, 2):
        runs[term] = moved(case, *blocks, fx.design_feedforward(model, order=order, move=MOVE))
    forces = sim.inverse_forces(model, MOVE, duration=DURATION, bandwidth=400.0)
    through = sim.known_forces(plant)
    runs["inverse"] = moved(case, *blocks, through, reference={"die:ref": MOVE, **forces})
    return runs


# %% Learning: the servo of the drawing
def learnt(case: dict[str, Any]) -> sim.LearnedFeedforward:
    """Return the gains after three moves of the machine, under its noise."""
    plant = stage.plant_of(case, "drawing")
    static = fx.design_static(plant)
    blocks = static, fx.design_servo(plant, bandwidth=50.0, observer=static)
    model = fx.close_loop(plant, *blocks)
    seeds = iter(range(100))

    def trial(feedforward: sim.Feedforward) -> fx.Response:
        return moved(case, *blocks, feedforward, noise=True, rng=next(seeds))

    start = fx.design_feedforward(model)
    return sim.learn_feedforward(start, trial, model, MOVE, duration=DURATION, trials=3)


# %% Results
def main() -> dict[str, Any]:
    """Return the runs of both loops, and what was learnt."""
    case = stage.models(DAMPING)
    runs = {
        "best servo": orders(case, stage.servo),
        "tolerant": orders(case, stage.tolerant, case["off"]),
    }
    return {"runs": runs, "learnt": learnt(case)}


def figures(run: fx.Response) -> tuple[float, float, float]:
    """Return the largest error, and MA and MSD after the move [nm]."""
    late = sim.exposure_errors(run, ["die:error"], start=MOVE.duration + 5e-3)["die:error"]
    return 1e9 * float(np.max(run.peak("die:error"))), 1e9 * late.ma, 1e9 * late.msd


def table(result: dict[str, Any]) -> str:
    """Return all numbers as text."""
    lines = []
    for name, runs in result["runs"].items():
        heads = "".join(
            f"{head:>16s}" for head in ("largest [nm]", "MA after [nm]", "MSD after [nm]")
        )
        lines.append(f"{name + ', feedforward':26s}{heads}")
        for label, run in runs.items():
            peak, ma, msd = figures(run)
            lines.append(f"  {label:24s}{peak:16.2f}{ma:16.2f}{msd:16.2f}")
    lines.append(f"\nservo of the drawing, gains learnt on the machine:\n{result['learnt']}")
    return "\n".join(lines)


def picture(result: dict[str, Any], folder: Path = stage.OUT) -> Path:
    """Draw the error of both loops in the move; below without the term that hides the others."""
    import matplotlib.pyplot as plt

    figure, axs = plt.subplots(2, 2, figsize=(13, 8), sharex=True, layout="constrained")
    colors = dict(
        zip([*TERMS, "inverse"], ("#0072B2", "#E69F00", "#009E73", "#D55E00"), strict=True)
    )
    show = partial(fx.plot.response, channels=["die:error"], span=(0.04, 0.2))
    for column, (name, runs) in zip(axs.T, result["runs"].items(), strict=True):
        for label, color in colors.items():
            for ax in column[: 1 if label == TERMS[0] else 2]:
                show(runs[label], label=label, color=color, ax=ax)
        peak = figures(runs["none"])[0]
        column[0].set(title=f"{name}: at most {1e-3 * peak:.1f} µm without feedforward", xlabel="")
        column[1].set_title(f"{name}: the same but for {TERMS[0]} feedforward")
    folder.mkdir(exist_ok=True)
    figure.savefig(folder / "feedforward.png", dpi=90)
    plt.close("all")
    return folder / "feedforward.png"


# %% Run it
if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    outcome = main()
    print(table(outcome), picture(outcome), sep="\n\npicture: ")
