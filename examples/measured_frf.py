"""From a noisy measurement to an updated model, with the accuracy of its parameters.

Run it: ``python examples/measured_frf.py``. The virtual machine floats under a slow servo and is
excited by multisines. Poles are identified from its frequency responses (FRFs). From the poles the
errors of the drawing are found, and the result is checked by responses that were not used before.
The machine differs from the drawing in three things: 0.5 kg at z8 that no drawing shows, Young's
modulus 70 instead of 69 GPa, and 1 % modal damping instead of 0.7 %. It has the drawing's mesh, so
that each parameter has a true value to compare with; ``wafer_stage.py`` shows an update for a
machine that is computed with another theory. Pictures go to ``examples/out``.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # matrices are small: more threads only wait

from pathlib import Path
from typing import Any

import numpy as np
import scipy.io as sio

import flexplant as fx
from flexplant.updating import Localisation

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
L = 0.6
RATE = 10e3  # Hz
BAND = (150.0, 1400.0)  # Hz, where modes are identified
ABOVE = (1400.0, 2000.0)  # Hz, lines that are not used in any fit
RUNS = 8
SENSOR = 1e-9  # m rms per sample
CORNERS = [(x, y, 0.0) for y in (0.0, L) for x in (0.0, L)]
INSET = [(x, y, 0.0) for y in (L / 4, 3 * L / 4) for x in (L / 4, 3 * L / 4)]
UNUSED = "y5"  # a sensor that is not used in any fit
ACTUATORS = {f"u{i}": point for i, point in enumerate(INSET, 1)}
SENSORS = {f"y{i}": point for i, point in enumerate([*CORNERS, (3 * L / 4, L, 0.0)], 1)}
FITTED = [name for name in SENSORS if name != UNUSED]
PORTS = fx.Ports(
    w=[fx.Disturbance(f"{name}:amp", at=p, asd=1e-3) for name, p in ACTUATORS.items()],
    u=[fx.Actuator(name, at=p) for name, p in ACTUATORS.items()],
    z=[fx.Poi("die", at=(L / 2, L / 2, 0.0))],
    y=[fx.Sensor(name, at=p, asd=SENSOR / np.sqrt(RATE / 2)) for name, p in SENSORS.items()],
)
TRUTH = {"mass": 0.5, "stiffness": 70 / 69 - 1, "damping": 0.01 / 0.007 * np.sqrt(70 / 69) - 1}


# %% The drawing, reduced to 49 DOFs: 24 modes and the compliance at 25 candidate places
SHAPE = {"size": (L, L), "thickness": 0.0272, "elements": (8, 8)}
plate = fx.kirchhoff_plate(**SHAPE, density=2702, youngs_modulus=69e9, poisson_ratio=0.35)
z8 = plate.dofs.nearest((L / 2, L / 4, 0.0), "z")
grid = np.linspace(0.0, L, 5)
places = [plate.dofs.nearest((x, y, 0.0), "z") for y in grid for x in grid]
modes = fx.solve_modes(plate, count=24, damping=fx.ModalDamping(0.007), compliance_at=places)
drawing = fx.reduce(modes, fx.DesiredDofs(fx.select_dofs(modes, 49, required=places).labels))
masses = {place: fx.AddedMass(place, name=place) for place in places}
stiffness = fx.MatrixParameter("stiffness", dK=drawing.K)  # relative changes of all of K and D
damping = fx.MatrixParameter("damping", dD=drawing.D)


# %% The measurement: six runs, whose spread is the variance
def measured(machine: Any) -> fx.Frf:
    """Return the mean FRFs of some noisy runs."""
    return fx.identification.average_frfs(
        machine.measure_frf(PORTS, period=0.5, periods=1, discard=2, amplitude=5.0, rng=seed)
        for seed in range(RUNS)
    )


def poles(frf: fx.Frf) -> tuple[fx.identification.IdentifiedModes, fx.MeasuredModes]:
    """Return the identified modes of the sensors that are used, and those that the drawing has."""
    found = fx.identify_modes(frf.select(outputs=FITTED), band=BAND, hold=RATE)
    at = {name: SENSORS[name] for name in FITTED}
    return found, fx.numbered(found, drawing, at=at, partial=True, least_mac=0.8)


# %% Where is the mass? Stiffness and damping are wrong everywhere: estimated again for each place
def response(frf: fx.Frf, lines: Any, outputs: list[str]) -> fx.FrfResidual:
    """Return the residual of lines of the sampled machine and of a model with the same hold."""
    used, where = frf.select(outputs=outputs), {name: SENSORS[name] for name in outputs}
    return fx.FrfResidual(used, lines=lines, places=where | ACTUATORS, hold=RATE)


def located(frf: fx.Frf, eigenvalues: fx.Eigenvalues) -> tuple[Localisation, Localisation]:
    """Return where the mass may be: by the poles, then by FRFs at the places left."""
    everywhere = {"nuisance": [stiffness, damping], "most": 1}
    by_poles = fx.updating.localise(
        drawing, [*masses.values()], [eigenvalues], screen=8, **everywhere
    )
    low = np.flatnonzero((frf.freq > BAND[0]) & (frf.freq < 700.0))[::4]
    left = [masses[place] for place in by_poles.alike]
    return by_poles, fx.updating.localise(drawing, left, [response(frf, low, FITTED)], **everywhere)


# %% The model's prediction of responses that were not used
def predicted(model: Any, freq: np.ndarray) -> fx.Frf:
    """Return a model's FRFs, behind the machine's zero-order hold."""
    return fx.frequency_response(fx.assemble_plant(model, PORTS).discretized(RATE).Gyu, freq)


def merit(frf: fx.Frf, model: Any) -> dict[str, tuple[float, float]]:
    """Return relative errors, and errors per standard deviation of the noise (both rms)."""
    error, seen = predicted(model, frf.freq).data - frf.data, {}
    for lines, (low, high) in (("identified band", BAND), ("unused lines above", ABOVE)):
        inside = (frf.freq > low) & (frf.freq < high)
        for name in ("fitted sensors", "unused sensor"):
            rows = [(output == UNUSED) == (name == "unused sensor") for output in frf.outputs]
            size, power, noise = (
                part[rows][..., inside]
                for part in (np.abs(error) ** 2, np.abs(frf.data) ** 2, frf.variance)
            )
            both = np.sqrt([size.sum() / power.sum(), np.mean(size / noise)])
            seen[f"{name}, {lines}"] = float(both[0]), float(both[1])
    return seen


# %% The run
def main() -> dict[str, Any]:
    """Return everything that the table and the pictures show."""
    machine = fx.testbeds.wafer_stage(elements=(8, 8), rate=RATE)
    frf = measured(machine)
    identified, numbered = poles(frf)
    eigenvalues = fx.Eigenvalues(numbered)
    by_poles, by_frfs = located(frf, eigenvalues)
    place = by_frfs.ranking[0]  # masses have the names of their places
    fit = fx.update(drawing, [masses[place], stiffness, damping], [eigenvalues])
    judged = {"drawing": merit(frf, drawing), "updated": merit(frf, fit.model)}
    result = {"frf": frf, "identified": identified, "numbered": numbered, "fit": fit}
    result |= {"by poles": by_poles, "by FRFs": by_frfs, "place": place, "merit": judged}
    result["real structures"] = real_structures()
    return {**result, "true poles": machine.poles(numbered.modes).poles}


# %% Real structures, if their data are present in the folder FLEXPLANT_DATA=<folder>
DATA = Path(os.environ.get("FLEXPLANT_DATA", "data")) / "fe"
BRIDGE = DATA / "updating" / "SteelPedBrdg_sim_form1_LM.mat"
SHAKEN = DATA / "uff" / "uff55_translation_rotation.uff"
BRIDGE_FROM = "github.com/ywang-structures/Structural-Model-Updating"  # GPL-3, not bundled
SHAKEN_FROM = "github.com/ladisk/pyuff, folder data"  # MIT


def bridge(noise: float = 0.0) -> str:
    """Find 15 stiffnesses of a pedestrian bridge (274 DOFs) from three modes; the truth is known.

    `noise` of each largest shape entry, and half as much of omega^2.
    """
    stored = sio.loadmat(BRIDGE, squeeze_me=True, struct_as_record=False)
    given, test, rng = stored["structModel"], stored["expModes"], np.random.default_rng(1)
    n = given.M0.shape[0]
    dofs = fx.DofSet(np.arange(1, n + 1), ["z"] * n, np.zeros((n, 3)))
    K = given.K0.toarray()
    matrices = given.M0.toarray(), np.zeros((n, n)), (K + K.T) / 2
    model = fx.ReducedModel(*matrices, np.eye(n), dofs, dofs, np.zeros((n, 0)), "none")
    squares = test.lambdaExp * (1 + 0.5 * noise * rng.normal(size=3))
    shapes = test.psiExp + noise * rng.normal(size=test.psiExp.shape)
    noisy = {"covariance": 2 * (0.25 * noise) ** 2 * squares} if noise else {}
    poles = fx.MeasuredModes(1j * np.sqrt(squares), modes=[1, 2, 3], **noisy)
    at = [f"{i}:z" for i in test.measDOFs]
    data = [fx.Eigenvalues(poles), fx.ModeShapes(poles, shapes, at, std=noise or None)]
    names = [f"a{i}" for i in range(1, len(given.K_j) + 1)]
    parts = zip(names, given.K_j, strict=True)
    unknowns = [fx.MatrixParameter(a, dK=(k + k.T) / 2, bounds=(-1, 1)) for a, k in parts]
    fit = fx.update(model, unknowns, data)
    truth = 0.01 * np.array([5, 5, -5, -10, 10, -15, 15, -5, -10, 10, -20, -30, 60, -30, 60])
    error = fit.values - truth
    said = f"rms error {np.sqrt(np.mean(error**2)):.1e} of {np.sqrt(np.mean(np.square(truth))):.2f}"
    if noise:
        said += f", per its own std {np.sqrt(np.mean((error / fit.std) ** 2)):.2f}"
    return f"{len(fit.history)} steps, {said}"


def real_structures() -> list[str]:
    """Return a line for each real structure."""
    said = []
    if BRIDGE.exists():
        said += [f"bridge, exact data:    {bridge()}", f"bridge, 0.5 / 1 % noise: {bridge(0.01)}"]
    else:
        said.append(f"bridge: {BRIDGE} is not here; it is at {BRIDGE_FROM}")
    if SHAKEN.exists():
        seen = fx.io.read_modes_uff(SHAKEN)
        count = "" if seen.shapes is None else f", shape at {len(seen.shapes)} DOFs"
        said.append(f"{SHAKEN.name}: a mode measured at {seen.freq[0]:.2f} Hz{count}")
    else:
        said.append(f"a mode: {SHAKEN} is not here; it is at {SHAKEN_FROM}")
    return said


# %% The table
def table(result: dict[str, Any]) -> str:
    """Return all numbers as text."""
    found, fit, frf = result["numbered"], result["fit"], result["frf"]
    inside = (frf.freq > BAND[0]) & (frf.freq < BAND[1])
    noise = 10 * np.log10(np.median((np.abs(frf.data) ** 2 / frf.variance)[..., inside]))
    text = [f"FRFs: {RUNS} runs, signal to noise {noise:.0f} dB (median)", ""]
    text.append(f"mode{'f [Hz]':>11s}{'+-':>8s}{'zeta [%]':>10s}{'+-':>8s}{'error/std':>16s}")
    gap, std, size = found.poles - result["true poles"], found.std, np.abs(found.poles)
    for i, mode in enumerate(found.modes):
        text.append(
            f"{mode:4d}{found.freq[i]:11.3f}{std[i].imag / (2 * np.pi):8.3f}"
            f"{100 * found.zeta[i]:10.4f}{100 * std[i].real / size[i]:8.4f}"
            f"{gap[i].real / std[i].real:+8.2f}{gap[i].imag / std[i].imag:+8.2f}"
        )
    for name, seen in (("poles", result["by poles"]), ("FRFs", result["by FRFs"])):
        alike = ", ".join(sorted(seen.alike))
        text.append(f"mass by {name}: {len(seen.candidates)} places tried, alike: {alike}")
    text.append(f"the mass is at {result['place']}; z8 is {z8}, by symmetry poles cannot tell")
    text += ["", f"{'':12s}{'update':>10s}{'+- (1 std)':>12s}{'truth':>10s}{'error/std':>11s}"]
    for (name, truth), value, std in zip(TRUTH.items(), fit.values, fit.std, strict=True):
        off = (value - truth) / std
        text.append(f"{name:12s}{value:10.5f}{std:12.5f}{truth:10.5f}{off:+11.2f}")
    text += ["", f"{'FRF error (per noise)':36s}{'drawing':>19s}{'updated':>19s}"]
    for name, before in result["merit"]["drawing"].items():
        both = (before, result["merit"]["updated"][name])
        text.append(f"{name:36s}" + "".join(f"{a:10.2%} ({b:6.2f})" for a, b in both))
    return "\n".join([*text, "", *result["real structures"]])


# %% The pictures
def pictures(result: dict[str, Any], folder: Path = OUT) -> list[Path]:
    """Draw the poles' choice, the identified and the unused response, and all of the update."""
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    frf, fit, drawn = result["frf"], result["fit"], []

    def keep(name: str) -> None:
        drawn.append(folder / f"measured_{name}.png")
        plt.savefig(drawn[-1], dpi=110)
        plt.close("all")

    used = frf.select(outputs=FITTED)
    fx.plot.stabilisation(result["identified"].diagram, frf=used)
    keep("stabilisation")
    fx.plot.identified(used, result["identified"], "y1", "u1")
    keep("identified")
    before, after = (predicted(model, frf.freq) for model in (drawing, fit.model))
    shown = {"measured": frf, "drawing": before, "updated": after}
    fx.plot.frf(shown, UNUSED, "u1", band=(100.0, ABOVE[1]))
    keep("unused_sensor")
    at = {name: SENSORS[name] for name in FITTED}
    data = [fx.Eigenvalues(result["numbered"]), fx.ModeShapes(result["numbered"], at=at)]
    lines = np.flatnonzero((frf.freq > 100.0) & (frf.freq < ABOVE[1]))
    fx.plot.update(fit, drawing, data, unused=response(frf, lines, [UNUSED]))
    keep("update")
    return drawn


# %% Run it
if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    outcome = main()
    print(table(outcome))
    print(f"\npictures in {OUT}: {', '.join(path.stem for path in pictures(outcome))}")
