"""From the uncertainty of a measurement to guarantees for a loop on every possible machine.

Run it: ``python examples/robust_control.py``. The stage of ``wafer_stage.py`` is modelled by the 13
modes of the measured band, with their measured poles. Real Deltas describe the uncertainty of their
frequencies. A weight bounds the effect of the 147 higher modes, which are truncated. The script has
six steps. (1) For the sampled loop of a servo, with its delay, it bounds mu at all frequencies,
also between grid points. (2) It finds the worst gain from set-point to error, and the machine that
has this gain. (3) It simulates that machine. (4) It compares both with the virtual machine, which
is computed with another theory than all models here. (5) It shows mu of an H-infinity controller
that ignores the higher modes. (6) It reduces that controller with weights from its loop, and writes
it in C. The script stops when one of its claims is not true.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # matrices are small: more threads only wait

import warnings
from pathlib import Path
from typing import Any

import numpy as np

import flexplant as fx
from flexplant.export import write_c
from flexplant.synthesis import reduce_controller, robust_stability, worst_case_gain
from wafer_stage import RATE, models, ports

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
DAMPING, MODES = 0.001, 13  # ratio; the modes up to 1.5 kHz
UNMOVED = 5, 12  # modes with nodes at all actuators: their frequencies do not matter
BANDWIDTH, MORE = 60.0, 80.0  # Hz, of the servo and of H-infinity


# %% The model: measured modes and their uncertainty
def uncertain_plant(case: dict[str, Any]) -> tuple[fx.StandardPlant, Any, Any]:
    """Return the sampled plant of a few modes, and the plant without and with the modes above."""
    full = case["full"]["measured"]
    plant = fx.assemble_plant(full.select(range(MODES)), ports(), evaluation=full)
    plant = plant.discretized(RATE, delay=case["machine"].delay)
    moved = set(range(MODES + 1)) - {*UNMOVED}
    off = {mode: part for mode, part in case["off"].items() if mode in moved}
    alone = plant.uncertain(frequency=off)
    return plant, alone, plant.uncertain(fx.plant.Neglected(full), frequency=off)


# %% The guarantee: mu of the sampled loop, its worst machine, and the machine itself
def peak(loop: fx.ClosedLoop) -> float:
    """Return the largest gain from set-point to error."""
    return float(fx.peak_gain(loop.system["die:error", "die:ref"])[0])


def within(uncertain: Any, count: int) -> list[Any]:
    """Return plants with all Deltas anywhere in their intervals."""
    values = np.random.default_rng(5).uniform(-1.0, 1.0, (count, len(uncertain.deltas)))
    names = [delta.name for delta in uncertain.deltas]
    return [uncertain.lft(dict(zip(names, row, strict=True))) for row in values.tolist()]


def study() -> dict[str, Any]:
    """Return the loop, its guarantees, and the worst machine compared with others."""
    case = models(DAMPING)
    machine = case["machine"]
    plant, alone, uncertain = uncertain_plant(case)
    static = fx.design_static(plant)
    servo = fx.design_servo(plant, bandwidth=BANDWIDTH, observer=static)
    blocks = static, servo
    robust = robust_stability(uncertain, *blocks)
    worst = worst_case_gain(uncertain, *blocks, w=["die:ref"], z=["die:error"])
    errors, weights = fx.reference_errors(plant), fx.stage_weights(plant, MORE)
    weighted = plant.through(errors).weighted(z=weights.z, w=weights.w)
    hinf = fx.design_hinf(weighted)
    return {
        "uncertain": uncertain, "loop": fx.close_loop(plant, *blocks),
        "robust": robust, "worst": worst, "bad": fx.close_loop(worst.machine, *blocks),
        "gains": [peak(fx.close_loop(one, *blocks)) for one in within(uncertain, 10)],
        "machine": machine.loop(ports(), *blocks), "weighted": weighted, "hinf": hinf,
        "few": robust_stability(alone, errors, hinf),
        "sharp": robust_stability(uncertain, errors, hinf),
        "broken": machine.loop(ports(), errors, hinf),
    }  # fmt: skip


# %% Simulation: the nominal machine, and the worst one, through a move of 100 um
def moved(loop: fx.ClosedLoop) -> fx.Response:
    """Return a move in 40 ms and the time after it."""
    move = fx.setpoint(100e-6, velocity=5e-3, acceleration=0.5, jerk=100.0, rest=0.05)
    return fx.simulate(loop, reference=move, duration=0.5, rng=7)


def difference(runs: dict[str, fx.Response]) -> np.ndarray:
    """Return the error of the worst machine less that of the nominal one."""
    return np.asarray(runs["worst"]["die:error"] - runs["nominal"]["die:error"])


# %% After the design: H-infinity with fewer states, and in C
def aftercare(weighted: fx.StandardPlant, full: fx.Controller, folder: Path) -> dict[str, Any]:
    """Return the reduced controller, and the files that hold it."""
    small = reduce_controller(weighted, full)
    folder.mkdir(exist_ok=True)
    return {"small": small, "files": write_c(small, folder / "stage_hinf.c")}


def claims(found: dict[str, Any]) -> dict[str, bool]:
    """Return what this example shows, and whether it is true."""
    robust, worst, few, sharp = (found[name] for name in ("robust", "worst", "few", "sharp"))
    full, small = found["hinf"], found["care"]["small"]
    sizes, real = (full.system.n_states, small.system.n_states), peak(found["machine"])
    drawn = max(found["gains"])
    return {
        f"every machine with frequencies within their uncertainty, and with any higher modes below "
        f"their weight, is stable: mu <= {robust.upper:.3g}": (
            robust.is_robust and found["machine"].is_stable
        ),
        f"the gain from set-point to error is at most {worst.upper:.3f} on every one of them, and "
        f"a machine with {worst.lower:.3f} was found": worst.upper < 1.03 * worst.lower,
        f"without uncertainty it is {worst.nominal:.3f}, on 10 machines drawn at most {drawn:.3f}, "
        f"on the virtual machine {real:.3f}": max(drawn, real) <= worst.upper,
        f"the worst machine can be simulated: through a move its error differs from the nominal "
        f"one's by {np.abs(1e9 * difference(found['runs'])).max():.0f} nm at most": (
            found["bad"].is_stable
        ),
        f"H-infinity for {MORE:g} Hz has mu {few.upper:.2f} of the frequencies alone, with the "
        f"modes above {sharp.lower:.0f} or more: the virtual machine is unstable with it": (
            few.is_robust and sharp.lower > 1.0 and not found["broken"].is_stable
        ),
        f"its {sizes[0]} states can be {sizes[1]}, the loop closed again: gamma "
        f"{full.gamma:.3f} and {small.gamma:.3f}": sizes[1] < 0.8 * sizes[0],
    }


# %% The run, and its tables
def main(folder: Path = OUT) -> dict[str, Any]:
    """Return all that the tables and the picture show."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fx.FlexplantWarning)
        found = study()
        found["runs"] = {"nominal": moved(found["loop"]), "worst": moved(found["bad"])}
        found["care"] = aftercare(found["weighted"], found["hinf"], folder)
        found["claims"] = claims(found)
    if untrue := [text for text, holds in found["claims"].items() if not holds]:
        raise RuntimeError(f"no longer true: {'; '.join(untrue)}")
    return found


def table(found: dict[str, Any]) -> str:
    """Return all numbers as text."""
    parts = ["What this example shows:", *(f"- {text}" for text in found["claims"])]
    parts.append(f"\nWhat is not known:\n{found['uncertain']}")
    parts.append(f"\nThe loop:\n{found['loop']}\n\n{found['robust']}\n\n{found['worst']}")
    parts.append(f"\nH-infinity for {MORE:g} Hz:\n{found['sharp']}")
    parts.append(f"\nAfter the design:\n{found['care']['small']}")
    parts.append(f"in C: {', '.join(path.name for path in found['care']['files'])}")
    return "\n".join(parts)


# %% The picture
def picture(found: dict[str, Any], folder: Path = OUT) -> Path:
    """Draw mu, the gain to the error, and what the worst machine adds to the error of a move."""
    import matplotlib.pyplot as plt

    robust, worst = found["robust"], found["worst"]
    figure, axs = plt.subplots(1, 3, figsize=(16, 4.6), layout="constrained")
    for name, one, color in (
        (f"servo, {BANDWIDTH:g} Hz", robust, fx.plot.CYCLE[0]["color"]),
        (f"H-infinity, {MORE:g} Hz", found["sharp"], fx.plot.CYCLE[1]["color"]),
    ):
        axs[0].loglog(one.frequencies, one.bounds, ".", ms=4, color=color)
        axs[0].axhline(one.upper, color=color)
        said = f"{name}: at most {one.upper:.3g}"
        axs[0].annotate(said, (85.0, one.upper), (0, 4), color=color, textcoords="offset points")
    axs[0].axhline(1.0, **fx.plot.STYLES["bound"])
    axs[0].annotate("above 1 a machine may be unstable", (85.0, 1.0), (0, 4), color="0.3",
                    textcoords="offset points")  # fmt: skip
    axs[0].set(title="mu: lines bound all frequencies, dots are resonances",
               xlabel="frequency [Hz]", ylabel="structured singular value mu [-]",
               xlim=(80.0, 5e3), ylim=(1e-3, 300.0))  # fmt: skip
    near = worst.freq * (1.0 + np.linspace(-2e-3, 2e-3, 201))  # a resonance of 0.1 % damping
    freq = np.union1d(np.geomspace(5.0, 4e3, 1500), near)
    for name, loop, color in (
        ("nominal", found["loop"], fx.plot.CYCLE[0]["color"]),
        ("worst machine", found["bad"], fx.plot.CYCLE[1]["color"]),
        ("virtual machine", found["machine"], "black"),
    ):
        gain = np.abs(loop.frequency_response(freq)["die:error", "die:ref"])
        wide = {"lw": 4.0, "alpha": 0.4} if loop is found["loop"] else {"lw": 1.2}
        axs[1].loglog(freq, gain, color=color, label=name, **wide)
    axs[1].axhline(worst.upper, label="bound on every machine", **fx.plot.STYLES["bound"])
    axs[1].set(title="From set-point to error", xlabel="frequency [Hz]",
               ylabel="|error / set-point| [-]", ylim=(1e-2, 4.0))  # fmt: skip
    nominal = found["runs"]["nominal"]
    within = nominal.time <= 0.2
    off = 1e9 * difference(found["runs"])[within]
    axs[2].plot(1e3 * nominal.time[within], off, **fx.plot.STYLES["difference"])
    largest = 1e6 * np.max(np.abs(nominal["die:error"]))
    axs[2].set(title=f"Error of the worst machine minus nominal (up to {largest:.0f} µm)",
               xlabel="time [ms]", ylabel="difference of the errors [nm]")  # fmt: skip
    for ax in axs:
        ax.grid(alpha=0.3)
    for ax in axs[:2]:
        ax.xaxis.set_major_formatter("{x:g}")
    axs[1].legend(fontsize="small")
    folder.mkdir(exist_ok=True)
    figure.savefig(folder / "robust_control.png", dpi=90)
    plt.close("all")
    return folder / "robust_control.png"


# %% Run it
if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    outcome = main()
    print(table(outcome), picture(outcome), sep="\n\npicture: ")
