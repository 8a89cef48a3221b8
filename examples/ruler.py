"""From a real measurement to a plant and a controller: a ruler, hit by hand at ten places.

Run it: ``python examples/ruler.py``. No finite-element model is used: the responses give the modes,
the modes give the plant, and the measured responses show the effect of the controller on the ruler
itself. The ruler hangs free, the accelerometer is at its end, and ten places along it were hit. The
record contains a disturbance of 50 Hz from the mains. The force is not calibrated: motions are in
the unit of the record. The picture goes to ``examples/out``. Data: pydvma (Butlin, Woodhouse;
BSD-3), see ``data/ruler.LICENSE``.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # matrices are small: more threads only wait

from pathlib import Path
from typing import Any

import numpy as np

import flexplant as fx

HERE = Path(globals().get("__file__", ".")).parent  # "." in a notebook
OUT = HERE / "out"
PLACES = range(1, 11)
END, FAR = "10:z", "1:z"  # end with the accelerometer, and the other end
RATE, DELAY = 5e3, 1  # Hz, samples
LOWER = 4.0  # by how much the highest peak at the far end is to be lowered
NOISE = 0.01  # of the sensor, relative to the highest peak of its signal
ROOTS = 4.73004, 7.85320, 10.99561, 14.13717  # cos x cosh x = 1: a free beam, f as x^2
EFFORT = 1.0  # weight of the coil's force, relative to the hand's


# %% The measurement
def measured() -> fx.Frf:
    """Return the responses at the accelerometer to hits; by reciprocity, those to hits there."""
    stored = np.load(HERE / "data" / "ruler.npz")
    data, names = stored["accelerance"].astype(complex)[:, None], [f"hit{i}" for i in PLACES]
    return fx.Frf(stored["freq"], data, ["end"], names, quantity="acceleration")


def identified(frf: fx.Frf) -> Any:
    """Return the modes, of shapes normalised by the response at the accelerometer itself."""
    return fx.identify_modes(frf, dofs={f"hit{i}": f"{i}:z" for i in PLACES} | {"end": END})


def bending(found: Any) -> Any:
    """Return the modes that move the end as the hit at the end does: bending.

    A residue at the driven place is real and positive, ``2 i omega psi l > 0``. Torsion has the
    opposite sign if the accelerometer is on one side and the hit on the other.
    """
    own = 2j * found.poles.imag * (found.shapes * found.participation)[-1]
    return found.select(np.flatnonzero(own.real > 0).tolist())


# %% The plant and the controller
def plant(found: Any) -> fx.StandardPlant:
    """Return the sampled plant of measured modes: hand and coil at one end, POI at the other."""
    places = fx.DofSet(PLACES, ["z"] * 10, [(i / 10, 0.0, 0.0) for i in PLACES])
    modes = fx.identification.structural_modes(found, places, rigid=False)
    ports = {"w": [fx.Disturbance("hand", at=END, asd=1.0)], "u": [fx.Actuator("coil", at=END)]}
    poi = fx.Poi("far", at=(0.1, 0.0, 0.0), axes=("z",))
    sensor = fx.Sensor("y", at=END, asd=1e-9)
    made = fx.assemble_plant(modes, fx.Ports(**ports, z=[poi], y=[sensor]))
    return made.discretized(RATE, delay=DELAY)


def controller(plant: fx.StandardPlant, freq: np.ndarray) -> fx.Controller:
    """Return the H-infinity controller that lowers the peak with the least effort."""
    peak, seen = (
        np.abs(fx.frequency_response(plant.system, freq)[name, "hand"]).max()
        for name in ("far:z", "y")
    )
    weights = {"far:z": LOWER / peak, "coil:effort": EFFORT}
    return fx.design_hinf(plant.weighted(z=weights, w={"y:noise": NOISE * seen}))


# %% Effect on the ruler itself: the measured responses in closed loop
def on_the_ruler(frf: fx.Frf, controller: fx.Controller) -> np.ndarray:
    """Return the response (10, n_freq) at all places, to a hand at the end, of the closed loop.

    With the measured accelerance H, and K including hold and delay: ``H / (1 - K H_end)``.
    """
    s, T = 2j * np.pi * frf.freq, 1 / RATE
    H = frf.converted("displacement").data[:, 0]
    hold = (1 - np.exp(-s * T)) / (s * T) * np.exp(-s * T * DELAY)
    K = fx.frequency_response(controller.system, frf.freq).data[0, 0]
    return np.asarray(H / (1 - K * hold * H[-1]))


# %% The run
def main() -> dict[str, Any]:
    """Return everything that the table and the picture show."""
    frf = measured()
    found = identified(frf)
    modes = bending(found)
    stage = plant(modes)
    law = controller(stage, frf.freq)
    loops = {"without": fx.close_loop(stage, 0.0 * law.system), "with": fx.close_loop(stage, law)}
    hit = {"hand": np.eye(1, int(RATE))[0] * RATE}  # of unit impulse
    runs = {
        name: fx.simulate(loop, disturbance=hit, duration=1.0, noise=False)
        for name, loop in loops.items()
    }
    lines = {
        "measured": frf.converted("displacement").data[0, 0],
        "synthesised": found.frf(frf.freq).data[0, 0],
        "plant, closed loop": loops["with"].frequency_response(frf.freq)["far:z", "hand"],
        "ruler, closed loop": on_the_ruler(frf, law)[0],
    }
    known = {"frf": frf, "found": found, "bending": modes, "plant": stage, "law": law}
    return known | {"loops": loops, "runs": runs, "lines": lines}


# %% The table
def table(result: dict[str, Any]) -> str:
    """Return all numbers as text: the modes, and the peaks near them at the far end."""
    found, modes, freq = result["found"], result["bending"], result["frf"].freq
    text = [f"left out: {f:.2f} Hz, {why}" for f, _, why in found.rejected]
    head = "".join(f"{name:>19s}" for name in result["lines"])
    text += ["", f"{'f [Hz]':>8s}{'+-':>7s}{'zeta [%]':>10s}{'f/f1':>8s}{'free beam':>11s}{head}"]
    for i, own in enumerate(modes.freq):
        near = np.abs(freq - own) < 5.0
        peaks = [np.abs(line[near]).max() for line in result["lines"].values()]
        text.append(
            f"{own:8.2f}{modes.std[i].imag / (2 * np.pi):7.2f}{100 * modes.zeta[i]:10.3f}"
            f"{own / modes.freq[0]:8.3f}{(ROOTS[i] / ROOTS[0]) ** 2:11.3f}"
            + "".join(f"{peak:19.2e}" for peak in peaks)
        )
    margin = result["loops"]["with"].modulus_margin
    rms = {name: float(run.rms("far:z")) for name, run in result["runs"].items()}
    text += ["", f"modulus margin {margin:.2f}; rms at the far end after a hit"]
    text[-1] += f" {rms['with'] / rms['without']:.2f} of that without control"
    return "\n".join(text)


# %% The picture
def picture(result: dict[str, Any], folder: Path = OUT) -> Path:
    """Draw measured and synthesised response, those in closed loop, and the motion after a hit."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4.6), layout="constrained")
    names = {"inputs": ["hand"], "outputs": ["far:z"]}
    lines = {
        name: fx.Frf(result["frf"].freq, line[None, None], **names)
        for name, line in result["lines"].items()
    }
    fx.plot.frf(lines, "far:z", "hand", ax=left)
    left.set_ylabel("far end / hand [dB, 0 dB: record's unit]")
    left.set_title("a ruler: measured, synthesised, and in closed loop")
    for name, run in result["runs"].items():
        own = run.replace(units={})  # of the record
        fx.plot.response(own, ["far:z"], label=f"{name} control", ax=right)
    right.set(ylabel="far end [record's unit]", title="after a hit at the end")
    folder.mkdir(exist_ok=True)
    figure.savefig(folder / "ruler.png", dpi=90)
    plt.close("all")
    return folder / "ruler.png"


# %% Run it
if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    outcome = main()
    print(table(outcome), picture(outcome), sep="\n\npicture: ")
