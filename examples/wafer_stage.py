"""A wafer stage with half a kilogram that no drawing shows: what a model of this machine buys.

Run it: ``python examples/wafer_stage.py``. A plate is reduced, updated from two measured poles, and
what is designed on it runs on a virtual machine of full order: (1) estimates of the die's motion,
(2) a controller that is unstable there when designed on the drawing and holds when designed on the
updated model, (3) a further sensor. It stops when one of its claims is no longer true.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # two processes share the work: one thread each

import json
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

import flexplant as fx

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
L, RATE, DELAY = 0.6, 10e3, 1  # m, Hz, samples
NOISE = 0.1e-9 / np.sqrt(RATE / 2)  # m/sqrt(Hz): sensors of 0.1 nm rms per sample
FORCES = (1e-4, 1e-3, 1e-2)  # N/sqrt(Hz): amplifier noise, two decades
DAMPINGS, BANDWIDTH = (0.01, 0.001), 80.0  # Hz, asked of H-infinity
CORNERS = [(x, y, 0.0) for y in (0.0, L) for x in (0.0, L)]
INSET = [(x, y, 0.0) for y in (L / 4, 3 * L / 4) for x in (L / 4, 3 * L / 4)]
COLORS = ("0.55", "#E69F00", "#0072B2")  # of the loops; then of the estimates
SHADES = ("#E69F00", "0.55", "#56B4E9", "#0072B2")


def ports(force: float = 1e-3) -> fx.Ports:
    """Return the channels of the stage, with amplifier noise of one density [N/sqrt(Hz)]."""
    return fx.Ports(
        w=[fx.Disturbance(f"amp{i}", at=p, asd=force) for i, p in enumerate(INSET, 1)],
        u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(INSET, 1)],
        z=[fx.Poi("die", at=(L / 2, L / 2, 0.0), axes=("z", "rx", "ry"))],
        y=[fx.Sensor(f"y{i}", at=p, asd=NOISE) for i, p in enumerate(CORNERS, 1)],
        references=[fx.Reference("die")],
    )


# %% The drawing: the paper's plate, reduced to 25 DOFs (24 modes and the compliance at z8)
ALUMINIUM = {"density": 2702, "youngs_modulus": 70e9, "poisson_ratio": 0.35}
plate = fx.kirchhoff_plate(size=(L, L), thickness=0.0272, elements=(8, 8), **ALUMINIUM)
z8 = plate.dofs.nearest((L / 2, L / 4, 0.0), "z")
spots = [(x, y, 0.0) for y in np.linspace(0.0, L, 5) for x in np.linspace(0.0, L, 5)]
grid = [plate.dofs.nearest(point, "z") for point in spots]


def reduced(damping: float, *, compliance: bool = True) -> fx.ReducedModel:
    """Return the plate in 25 z-DOFs; in 24 (not the centre) without the compliance at z8."""
    at = [z8] if compliance else []
    modes = fx.solve_modes(plate, count=24, damping=fx.ModalDamping(damping), compliance_at=at)
    return fx.reduce(modes, fx.DesiredDofs(grid if compliance else [*grid[:12], *grid[13:]]))


# %% The update: two measured poles give the mass that the machine carries at z8
def updated(model: fx.ReducedModel, measured: fx.MeasuredModes) -> fx.UpdateResult:
    """Return the model updated from measured poles: mass and damping at z8."""
    return fx.update(model, [fx.AddedMass(z8), fx.AddedDamping(z8)], [fx.Eigenvalues(measured)])


def study(damping: float) -> dict[str, Any]:
    """Return machine, models, errors of the estimates and closed loops at one damping."""
    machine = fx.testbeds.wafer_stage(damping=damping, rate=RATE, delay=DELAY)
    nominal, bare = reduced(damping), plate.with_damping(fx.ModalDamping(damping))
    fit = updated(nominal, machine.poles([6, 7]))
    case: dict[str, Any] = {"machine": machine, "fit": fit}
    case["models"] = {"drawing": nominal, "updated": fit.model}  # what designs run on
    whole = {"drawing": bare, "updated": fit.applied_to(bare)}  # with the modes left out
    case["full"] = {name: fx.solve_modes(model) for name, model in whole.items()}
    seeds = np.random.SeedSequence([20260, round(1e6 * damping)]).spawn(len(FORCES))
    case["errors"] = {f: estimation(case, f, s) for f, s in zip(FORCES, seeds, strict=True)}
    case["loops"] = control(case)
    table = fx.compare_loops({name: loop["machine"] for name, loop in case["loops"].items()})
    return case | {"table": table}


def plant_of(case: dict[str, Any], kind: str, force: float = 1e-3) -> fx.StandardPlant:
    """Return the sampled plant of a model."""
    return fx.assemble_plant(case["models"][kind], ports(force)).discretized(RATE, delay=DELAY)


# %% Estimation: four ways from the sensors to the die, each with more of the machine in it
def estimation(case: dict[str, Any], force: float, seed: Any) -> Any:
    """Return predicted errors and those of 5 runs of 2 s; a slow servo holds the machine."""
    nominal, fit = (plant_of(case, kind, force) for kind in case["models"])
    static = fx.design_static(fit, larger=case["full"]["updated"])
    with warnings.catch_warnings(action="ignore"):  # a coarse mesh for rx and ry: z is compared
        designs = {
            "geometry alone": static,
            "drawing": fx.design_kalman(nominal, larger=case["full"]["drawing"]),
            "updated, 24 modes": fx.design_kalman(fit),
            "updated, all modes": fx.design_kalman(fit, larger=case["full"]["updated"]),
        }
    servo = fx.design_servo(fit, bandwidth=10.0, observer=static)
    blocks = static, servo, *fx.reading_along(designs)
    run = case["machine"].run(ports(force), *blocks, duration=3.0, rng=seed, runs=5)
    return fx.compare_estimators(designs, run, "die:z", start=1.0)


# %% Control: H-infinity on the drawing and on the updated model, and the best servo that holds
def hinf(plant: fx.StandardPlant, full: fx.Modes) -> tuple[Any, ...]:
    """Return the errors that the H-infinity controller reads, and the controller."""
    errors, weights = fx.reference_errors(plant), fx.stage_weights(plant, BANDWIDTH)
    weighted = plant.through(errors).weighted(z=weights.z, w=weights.w)
    return errors, fx.design_hinf(weighted, larger=full)


def servo(plant: fx.StandardPlant, full: fx.Modes) -> tuple[Any, ...]:
    """Return the servo of the largest bandwidth that keeps |S| at u below 6 dB, by geometry."""
    static = fx.design_static(plant, larger=full)  # a Kalman filter in the loop allows less
    reach = fx.servo_bandwidth(plant, observer=static, larger=full)
    return static, fx.design_servo(plant, bandwidth=reach, observer=static, larger=full)


def control(case: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return three loops on the machine, and each through a move of 100 um in 40 ms."""
    move = fx.setpoint(100e-6, velocity=5e-3, acceleration=0.5, jerk=100.0, rest=0.05)
    found = {}
    for name, design, kind in (
        ("H-infinity, drawing", hinf, "drawing"),
        ("best servo, updated", servo, "updated"),
        ("H-infinity, updated", hinf, "updated"),
    ):
        blocks = design(plant_of(case, kind), case["full"][kind])
        with warnings.catch_warnings(action="ignore"):  # one is unstable there: see the claims
            loop = case["machine"].loop(ports(), *blocks)
            run = fx.simulate(loop, reference=move, duration=1.5, rng=7)
        model = fx.close_loop(plant_of(case, kind), *blocks)
        exposure = run.exposure("die:error", window=5e-3, start=0.3)
        found[name] = {"model": model, "machine": loop, "run": run, "exposure": exposure}
    return found


# %% Placement: where a fifth sensor would help the die most, the die itself left out
def placement(case: dict[str, Any]) -> fx.placement.SensorMap:
    """Return the predicted error of the die over places of a sensor beside those at the corners."""
    points = [(x, y, 0.0) for y in np.linspace(0, L, 9) for x in np.linspace(0, L, 9)]
    fine = fx.kirchhoff_plate(size=(L, L), thickness=0.0272, elements=(16, 16), **ALUMINIUM)
    mass = fx.PointMass(fine.dofs.nearest((L / 2, L / 4, 0.0), "z"), case["fit"].values[0])
    many = fx.solve_modes(fine.with_parts(mass), count=80, damping=fx.ModalDamping(0.01))
    plant, goal = plant_of(case, "updated"), fx.PoiVariance("die", larger=many)
    return fx.sensor_map(plant, points, goal, asd=NOISE, constraints=[fx.placement.OffPoi(0.12)])


# %% What it shows: each claim is printed with its figures, and stops the example when untrue
def claims(cases: dict[float, dict[str, Any]]) -> dict[str, bool]:
    """Return what this example shows, and whether it is true."""
    light, usual = cases[0.001], cases[0.01]
    rows = [e["updated, all modes"] for case in cases.values() for e in case["errors"].values()]
    off = max(abs(row[0] / row[1] - 1.0) for row in rows)
    alone, cured = (1e9 * light["errors"][1e-3][f"updated, {n} modes"] for n in ("24", "all"))
    drawing, _, held = light["table"].rows.values()
    peak = -20.0 * np.log10(max(held.margin, 1e-9))  # dB
    _, best, ours = (1e9 * loop["exposure"][0] for loop in light["loops"].values())
    old, _, new = (1e9 * loop["exposure"][0] for loop in usual["loops"].values())
    return {
        f"predicted errors are those of the machine within {off:.1%}: modes left out of the model "
        "count as noise": off < 0.05,
        f"without them {alone[0]:.2f} nm are predicted where the machine has {alone[1]:.2f} nm; "
        f"with them it has {cured[1]:.2f} nm": alone[1] > max(3.0 * alone[0], 1.5 * cured[1]),
        f"H-infinity for {BANDWIDTH:g} Hz designed on the drawing is unstable": not drawing.stable,
        f"designed on the updated model it holds: |S| < 1 up to {held.bandwidth:.0f} Hz, at most "
        f"{peak:.1f} dB at the actuators": held.bandwidth > BANDWIDTH and peak < 8.0,
        f"its mean error over an exposure is {ours:.1f} nm at most after a move, the best servo's "
        f"{best:.1f} nm": ours < 0.6 * best,
        f"at 1 % damping the drawing serves this machine as well: {old:.1f} against {new:.1f} "
        "nm": abs(old / new - 1.0) < 0.1,
    }


# %% The run, and its tables
def main() -> dict[str, Any]:
    """Return all that the tables and the picture show; two processes share the work."""
    with ProcessPoolExecutor(2) as both:
        cases = dict(zip(DAMPINGS, both.map(study, DAMPINGS), strict=True))
    found = claims(cases)
    if untrue := [text for text, holds in found.items() if not holds]:
        raise RuntimeError(f"no longer true: {'; '.join(untrue)}")
    return {"cases": cases, "claims": list(found), "placement": placement(cases[0.01])}


def table(result: dict[str, Any]) -> str:
    """Return all numbers as text."""
    cases, fifth = result["cases"], result["placement"]
    parts = ["What this example shows, on the machine at 0.1 % damping:"]
    parts += [f"- {text}" for text in result["claims"]]
    fit = cases[0.01]["fit"]
    parts.append(f"\nThe update from the poles of modes 6 and 7 (true: 0.5 kg, no damper):\n{fit}")
    for damping, case in cases.items():
        for force, errors in case["errors"].items():
            parts.append(f"\n{damping:.1%} damping, amplifiers {force:g} N/sqrt(Hz):\n{errors}")
    for damping, case in cases.items():
        parts.append(f"\nClosed loops on the machine, {damping:.1%} damping:\n{case['table']}")
        for name, loop in case["loops"].items():
            if loop["machine"].is_stable:
                ma, msd = (1e9 * size for size in loop["exposure"])
                parts.append(f"{name}: MA {ma:.1f} nm, MSD {msd:.1f} nm")
    parts.append("MA, MSD: largest mean and deviation of die:error over 5 ms, after the move.\n")
    (x, y, _), (old, new) = fifth.best, 1e9 * np.sqrt([fifth.without, fifth.values.min()])
    parts.append(f"A fifth sensor helps most at ({x:g}, {y:g}) m: {old:.3f} -> {new:.3f} nm")
    return "\n".join(parts)


# %% The picture: the machine black, the drawing grey, the updated model blue, the servo orange
def picture(result: dict[str, Any], folder: Path = OUT) -> Path:
    """Draw the story in six panels: the README's picture."""
    import matplotlib.pyplot as plt

    case, colors, shown = result["cases"][0.001], {}, {}  # at 0.1 % damping
    figure, axs = plt.subplots(2, 3, figsize=(17, 9), layout="constrained")
    figure.suptitle("A virtual machine with 0.5 kg that no drawing shows, 0.1 % damping")
    shades = dict(zip(case["errors"][1e-3].names, SHADES, strict=True))
    forces, rows = [f"{f:g} N/√Hz" for f in FORCES], list(case["errors"].values())
    fx.plot.predictions(rows, colors=shades, cases=forces, ax=axs[0, 0])
    for (name, loop), color in zip(case["loops"].items(), COLORS, strict=True):
        run, held = loop["run"], loop["machine"].is_stable
        style = {"label": name + ("" if held else ": unstable"), "color": color}
        if loop is not case["loops"]["best servo, updated"]:  # its force is like the blue one
            fx.plot.response(run, ["u1"], ax=axs[1, 0], **style)
        if held:
            fx.plot.response(run, ["die:error"], span=(0.0, 0.25), ax=axs[0, 1], **style)
            fx.plot.response(run, ["die:error"], span=(0.1, 0.35), ax=axs[0, 2], **style)
            shown |= {f"{name}, {kind}": loop[kind] for kind in ("model", "machine")}
            colors |= {f"{name}, model": color, f"{name}, machine": "black"}
    fx.plot.sensitivity(shown, colors=colors, dashed=list(shown)[1::2], ax=axs[1, 1])
    fx.plot.sensor_map(result["placement"], ports=ports(), ax=axs[1, 2])
    axs[0, 1].set_title("error at the die through a move of 100 µm, machine")
    axs[0, 2].set(ylim=(-100.0, 100.0), title="error at the die after the move, machine")
    axs[1, 0].set(ylim=(-2.0, 2.0), title="force of actuator u1, machine")
    axs[1, 1].set(xlim=(5.0, 5e3), ylim=(-50.0, 12.0), title="sensitivity, die:ref to die:error")
    axs[1, 1].legend(frameon=False, loc="lower right")
    folder.mkdir(exist_ok=True)
    claimed = {"Comment": json.dumps(result["claims"])}  # says when the README's copy is old
    figure.savefig(folder / "wafer_stage.png", dpi=90, metadata=claimed)
    plt.close("all")
    return folder / "wafer_stage.png"


# %% Run it
if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    print(table(outcome := main()), picture(outcome), sep="\n\npicture: ")
