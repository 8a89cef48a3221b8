"""From the covariance of an update to a guarantee: what a loop keeps on every machine of a fleet.

Run it: ``python examples/robust_control.py``. A plate with half a kilogram that no drawing shows is
updated from two measured poles, whose errors leave an uncertainty: real Deltas on the measured
modes, a weight on the modes that the model lacks. For the sampled, delayed loop of a servo it then
(1) bounds mu between all frequencies, (2) finds the worst gain from set-point to error, and the
machine that has it, (3) simulates that machine, (4) reduces an H-infinity controller as its loop
sees it and writes it in C. It stops when one of its claims is no longer true.
"""

# %% Names and numbers
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import flexplant as fx
from flexplant.synthesis import (
    reduce_controller,
    robust_stability,
    worst_case_gain,
    write_c,
)

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
L, RATE, DELAY = 0.6, 10e3, 1  # m, Hz, samples
BANDWIDTH, MORE = 60.0, 80.0  # Hz, of the servo and of H-infinity
DAMPING, ERROR = 0.001, 20.0  # ratio; rad/s, standard deviation of each measured pole
CORNERS = [(x, y, 0.0) for y in (0.0, L) for x in (0.0, L)]
INSET = [(x, y, 0.0) for y in (L / 4, 3 * L / 4) for x in (L / 4, 3 * L / 4)]


def ports() -> fx.Ports:
    """Return the channels of the stage: four actuators, four sensors, the die in the middle."""
    noise = 0.1e-9 / np.sqrt(RATE / 2)  # 0.1 nm rms a sample
    return fx.Ports(
        w=[fx.Disturbance(f"amp{i}", at=p, asd=1e-3) for i, p in enumerate(INSET, 1)],
        u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(INSET, 1)],
        z=[fx.Poi("die", at=(L / 2, L / 2, 0.0), axes=("z", "rx", "ry"))],
        y=[fx.Sensor(f"y{i}", at=p, asd=noise) for i, p in enumerate(CORNERS, 1)],
        references=[fx.Reference("die")],
    )


# %% The update, with the covariance of its answer
plate = fx.kirchhoff_plate(
    size=(L, L), thickness=0.0272, elements=(8, 8), density=2702, youngs_modulus=70e9,
    poisson_ratio=0.35,
).with_damping(fx.ModalDamping(DAMPING))  # fmt: skip
z8 = plate.dofs.nearest((L / 2, L / 4, 0.0), "z")


def updated() -> tuple[fx.UpdateResult, fx.FEMatrices | Any]:
    """Return the fit of the added mass to two measured poles, and the updated full structure."""
    modes = fx.solve_modes(plate, count=24, compliance_at=[z8])
    spots = [(x, y, 0.0) for y in np.linspace(0.0, L, 5) for x in np.linspace(0.0, L, 5)]
    rom = fx.reduce(modes, fx.DesiredDofs([plate.dofs.nearest(p, "z") for p in spots]))
    machine = fx.testbeds.wafer_stage(elements=(8, 8), damping=DAMPING)
    measured = machine.poles([6, 7]).replace(covariance=[ERROR**2, ERROR**2])
    fit = fx.update(rom, [fx.AddedMass(z8)], [fx.Eigenvalues(measured)])
    return fit, fit.applied_to(plate)


# %% The guarantee: mu of the sampled loop, and its worst machine
def study() -> dict[str, Any]:
    """Return the loop, what is proven of it, and the worst machine beside others."""
    fit, whole = updated()
    plant = fx.assemble_plant(fit.model, ports()).discretized(RATE, delay=DELAY)
    uncertain = plant.uncertain(fit, modes=[6, 7], deviations=3.0, neglected=whole)
    static = fx.design_static(plant, larger=whole)
    servo = fx.design_servo(plant, bandwidth=BANDWIDTH, observer=static, larger=whole)
    blocks = static, servo
    loop = fx.close_loop(plant, *blocks, larger=whole)
    robust = robust_stability(uncertain, *blocks, larger=whole)
    worst = worst_case_gain(uncertain, *blocks, w=["die:ref"], z=["die:error"])
    drawn = [fx.close_loop(one, *blocks) for one in uncertain.sample(5, 10)]
    gains = [fx.peak_gain(one.system["die:error", "die:ref"])[0] for one in drawn]
    bad = fx.close_loop(worst.machine, *blocks)
    errors, weights = fx.reference_errors(plant), fx.stage_weights(plant, MORE)
    weighted = plant.through(errors).weighted(z=weights.z, w=weights.w)
    hinf = fx.design_hinf(weighted, larger=whole)
    known = plant.uncertain(fit, modes=[6, 7], deviations=3.0)
    sharp = robust_stability(known, errors, hinf)
    return {
        "fit": fit, "uncertain": uncertain, "loop": loop, "robust": robust, "worst": worst,
        "gains": gains, "bad": bad, "whole": whole, "weighted": weighted, "hinf": hinf,
        "sharp": sharp, "errors": errors,
    }  # fmt: skip


# %% Simulation: the nominal machine, and the worst one, through a move of 100 um
def moved(loop: fx.ClosedLoop) -> fx.Response:
    """Return a move in 40 ms and what follows."""
    move = fx.setpoint(100e-6, velocity=5e-3, acceleration=0.5, jerk=100.0, rest=0.05)
    return fx.simulate(loop, reference=move, duration=0.5, rng=7)


# %% After-care: H-infinity with fewer states, and in C
def aftercare(weighted: fx.StandardPlant, full: fx.Controller, folder: Path) -> dict[str, Any]:
    """Return the reduced controller, and the files that hold it."""
    small = reduce_controller(weighted, full)
    folder.mkdir(exist_ok=True)
    return {"small": small, "files": write_c(small, folder / "stage_hinf.c")}


def claims(found: dict[str, Any]) -> dict[str, bool]:
    """Return what this example shows, and whether it is true."""
    robust, worst, sharp = found["robust"], found["worst"], found["sharp"]
    full, small = found["hinf"], found["care"]["small"]
    sizes = full.system.n_states, small.system.n_states
    broken = fx.close_loop(sharp.machine, found["errors"], full)
    return {
        f"every machine within 3 standard deviations, and with any modes beyond the model below "
        f"their weight, is stable: mu <= {robust.upper:.3g}": robust.is_robust,
        f"the gain from set-point to error is at most {worst.upper:.3f} on every one of them, and "
        f"a machine with {worst.lower:.3f} was found": worst.upper < 1.03 * worst.lower,
        f"without uncertainty it is {worst.nominal:.3f}, on 10 machines drawn from the fit at most "
        f"{max(found['gains']):.3f}": max(found["gains"]) <= worst.upper,
        f"the worst machine can be simulated: its error is "
        f"{1e9 * found['runs']['worst'].rms('die:error'):.1f} nm rms through a move, the nominal "
        f"one's {1e9 * found['runs']['nominal'].rms('die:error'):.1f} nm": found["bad"].is_stable,
        f"H-infinity for {MORE:g} Hz has mu between {sharp.lower:.2f} and {sharp.upper:.2f}: a "
        f"machine is unstable with it, and every one is stable once poles are measured to "
        f"{ERROR / sharp.upper:.1f} rad/s": sharp.lower > 1.0 and not broken.is_stable,
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
    parts.append(f"\nThe update, poles measured to {ERROR:g} rad/s:\n{found['fit']}")
    parts.append(f"\nIts uncertainty:\n{found['uncertain']}")
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
        dots = None if one is robust else "dots: at the frequencies of their scalings"
        axs[0].loglog(one.frequencies, one.bounds, ".", ms=3, color=color, label=dots)
        axs[0].axhline(one.upper, color=color, label=f"{name}: proven at all frequencies")
    axs[0].axhline(1.0, label="uncertainty of the fit", **fx.plot.STYLES["bound"])
    axs[0].set(title="robust stability", xlabel="frequency [Hz]", ylabel="upper bound of mu [1]",
               xlim=(80.0, 5e3), ylim=(1e-3, 30.0))  # fmt: skip
    freq = np.geomspace(5.0, 4e3, 1500)
    for name, loop, color in (
        ("nominal", found["loop"], fx.plot.CYCLE[0]["color"]),
        ("worst machine", found["bad"], fx.plot.CYCLE[1]["color"]),
    ):
        gain = np.abs(loop.frequency_response(freq)["die:error", "die:ref"])
        wide = {"lw": 4.0, "alpha": 0.4} if loop is found["loop"] else {"lw": 1.2}
        axs[1].loglog(freq, gain, color=color, label=name, **wide)
    axs[1].axhline(worst.upper, label="bound on every machine", **fx.plot.STYLES["bound"])
    axs[1].set(title="from set-point to error", xlabel="frequency [Hz]",
               ylabel="|error / set-point| [1]", ylim=(1e-2, 4.0))  # fmt: skip
    nominal, bad = found["runs"]["nominal"], found["runs"]["worst"]
    within = nominal.time <= 0.2
    difference = 1e9 * (bad["die:error"] - nominal["die:error"])[within]
    axs[2].plot(1e3 * nominal.time[within], difference, **fx.plot.STYLES["difference"])
    largest = 1e6 * np.max(np.abs(nominal["die:error"]))
    axs[2].set(title=f"worst machine less nominal, whose error is {largest:.0f} µm",
               xlabel="time [ms]", ylabel="difference of error [nm]")  # fmt: skip
    for ax in axs:
        ax.grid(alpha=0.3)
    for ax in axs[:2]:
        ax.legend(fontsize="small")
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
