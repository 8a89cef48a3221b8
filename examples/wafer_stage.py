"""The paper's plate, from finite elements to a closed loop on a virtual machine.

Run it: ``python examples/wafer_stage.py``. It prints the numbers, the paper's beside ours, and
writes pictures to ``examples/out``: the counterparts of the paper's figures 3 to 11, the closed
loops, and where a further sensor would help.

The paper says 0.1 % modal damping, but its printed eigenvalues have 1 %; both are shown.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # two processes share the work: one thread each

import json
from concurrent.futures import ProcessPoolExecutor
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import flexplant as fx

OUT = Path(__file__).parent / "out"
L = 0.6
RATE, DELAY = 10e3, 1  # Hz, samples
SENSOR = 0.1e-9  # m rms per sample
FORCES = (1e-4, 1e-3, 1e-2)  # N/sqrt(Hz): two decades of disturbance
DAMPINGS = (0.01, 0.001)
SEEDS = 5
SETTLE, MEASURE = 1.0, 2.0  # s
BANDWIDTH = 50.0  # Hz, where the servo's open loop crosses 1
HINF_BANDWIDTH = 30.0  # Hz, below which H-infinity is to keep |S| < 1
CORNERS = [(x, y, 0.0) for y in (0.0, L) for x in (0.0, L)]
INSET = [(x, y, 0.0) for y in (L / 4, 3 * L / 4) for x in (L / 4, 3 * L / 4)]


def ports(force: float = 1e-3) -> fx.Ports:
    """Return the channels of the stage, with amplifier noise of one density [N/sqrt(Hz)]."""
    return fx.Ports(
        w=[fx.Disturbance(f"amp{i}", at=p, asd=force) for i, p in enumerate(INSET, 1)],
        u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(INSET, 1)],
        z=[fx.Poi("die", at=(L / 2, L / 2, 0.0), axes=("z", "rx", "ry"))],
        y=[
            fx.Sensor(f"y{i}", at=p, asd=SENSOR / np.sqrt(RATE / 2))
            for i, p in enumerate(CORNERS, 1)
        ],
        references=[fx.Reference("die")],
    )


# %% The plate and its reduction (paper, 4.1 and 4.2)
plate = fx.kirchhoff_plate(
    size=(L, L),
    thickness=0.0272,
    elements=(8, 8),
    density=2702,
    youngs_modulus=70e9,
    poisson_ratio=0.35,
)
z8 = plate.dofs.nearest((L / 2, L / 4, 0.0), "z")
centre = plate.dofs.nearest((L / 2, L / 2, 0.0), "z")
grid25 = [
    plate.dofs.nearest((x, y, 0.0), "z") for y in np.linspace(0, L, 5) for x in np.linspace(0, L, 5)
]
grid24 = [label for label in grid25 if label != centre]


def reduced(damping: float, *, compliance: bool) -> fx.ReducedModel:
    """Return the plate in 24 z-DOFs, or in 25 with the compliance at z8."""
    modes = fx.solve_modes(
        plate,
        count=24,
        damping=fx.ModalDamping(damping),
        compliance_at=[z8] if compliance else [],
    )
    return fx.reduce(modes, fx.DesiredDofs(grid25 if compliance else grid24))


# %% The update (paper, 4.3): the machine carries 0.5 kg that no drawing shows
def updated(model: fx.ReducedModel, measured: fx.MeasuredModes) -> fx.UpdateResult:
    """Return the model updated from measured poles."""
    unknown = [fx.AddedMass(z8), fx.AddedDamping(z8)]
    return fx.update(model, unknown, [fx.Eigenvalues(measured)])


# %% What the update buys: POI error of three estimators on the machine
def estimators(
    force: float, nominal: fx.ReducedModel, fit: fx.ReducedModel
) -> dict[str, fx.KalmanEstimator | fx.StaticEstimator]:
    """Return (a) the static geometric relation, (b) and (c) Kalman filters on two models."""
    before, after = (
        fx.assemble_plant(model, ports(force)).discretized(RATE, delay=DELAY)
        for model in (nominal, fit)
    )
    return {
        "static": fx.design_static(before),
        "nominal": fx.design_kalman(before),
        "updated": fx.design_kalman(after),
    }


def listening(designs: dict[str, Any]) -> list[fx.StateSpace]:
    """Return the Kalman filters with outputs of their own: they listen, the static one steers."""
    return [
        designs[key].system.renamed(
            outputs={hat: hat.replace("die", key) for hat in designs[key].system.outputs}
        )
        for key in ("nominal", "updated")
    ]


def interval(rms: np.ndarray) -> tuple[float, float]:
    """Return the root mean square over seeds and the half width of its 95 % interval."""
    power = rms**2
    half = stats.t.ppf(0.975, power.size - 1) * power.std(ddof=1) / np.sqrt(power.size)
    mean = float(np.sqrt(power.mean()))
    return mean, float(half / (2.0 * mean))


def poi_errors(
    machine: Any, force: float, designs: dict[str, Any], seed: np.random.SeedSequence
) -> dict[str, Any]:
    """Return predicted and measured POI errors [m rms] while a slow servo holds the machine.

    The measured error is about zero, as the predicted one: nothing that stands still is left out.
    """
    static = designs["static"]
    holding = fx.design_servo(static.plant, bandwidth=10.0)
    run = machine.run(
        ports(force),
        static,
        holding,
        *listening(designs),
        duration=SETTLE + MEASURE,
        rng=seed,
        runs=SEEDS,
    )
    late = run.time >= SETTLE
    hats = {"static": "die:hat", "nominal": "nominal:hat", "updated": "updated:hat"}

    def rms(hat: str) -> np.ndarray:
        return np.sqrt(np.mean((run["die:z"] - run[hat])[:, late] ** 2, axis=1))

    return {key: (designs[key].rms("die:z"), *interval(rms(hat))) for key, hat in hats.items()}


def study(damping: float, forces: tuple[float, ...] = FORCES) -> dict[str, Any]:
    """Return machine, models, update and POI errors at one damping."""
    machine = fx.testbeds.wafer_stage(damping=damping, rate=RATE, delay=DELAY)
    measured = machine.poles([6, 7])
    nominal = reduced(damping, compliance=True)
    fit = updated(nominal, measured)
    # a seed of its own for each row of the table: the same noise twice would prove nothing
    seeds = np.random.SeedSequence([20260, round(1e6 * damping)]).spawn(len(forces))
    errors = {
        force: poi_errors(machine, force, estimators(force, nominal, fit.model), seed)
        for force, seed in zip(forces, seeds, strict=True)
    }
    return {
        "machine": machine,
        "measured": measured,
        "nominal": nominal,
        "modal": updated(reduced(damping, compliance=False), measured),
        "fit": fit,
        "plant": fx.assemble_plant(fit.model, ports()).discretized(RATE, delay=DELAY),
        "errors": errors,
    }


# %% Closed loops: the servo on (c)'s estimate, and a four-block H-infinity design beside it
def servo_blocks(case: dict[str, Any]) -> tuple[Any, ...]:
    """Return the observer and the servo on its estimate, with a notch at the updated mode 6."""
    bowl = case["fit"].model.modes().freq[5]
    servo = fx.design_servo(case["plant"], bandwidth=BANDWIDTH, notches=[bowl])
    return fx.design_kalman(case["plant"]), servo


def hinf_blocks(case: dict[str, Any]) -> tuple[Any, ...]:
    """Return the errors that the H-infinity controller reads, and the controller."""
    comparison = fx.reference_errors(case["plant"])
    weights = fx.stage_weights(case["plant"], HINF_BANDWIDTH)
    weighted = case["plant"].through(comparison).weighted(z=weights.z, w=weights.w)
    hinf = fx.design_hinf(weighted)
    require_worth(doing_nothing(weighted), hinf.gamma)
    return comparison, hinf


def doing_nothing(weighted: fx.StandardPlant) -> float:
    """Return the zero controller's score on the reference alone, a bound from below by a sweep.

    With the disturbances it would have no norm at all, since the rigid body integrates them: any
    design would look good beside it.
    """
    freq = np.geomspace(0.01, 0.499 * RATE, 2000)
    alone = fx.frequency_response(weighted.system.select(weighted.z, ["die:ref"]), freq)
    return float(np.linalg.norm(alone.data[:, 0], axis=0).max())


def require_worth(nothing: float, gamma: float) -> None:
    """Raise when doing nothing scores within twice the design's gamma."""
    if nothing < 2.0 * gamma:
        raise RuntimeError(f"doing nothing scores {nothing:.3g}, the design {gamma:.3g}")


def sensitivity(loop: fx.ClosedLoop) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies [Hz] and |S|, from die:ref to die:error."""
    freq = np.unique(np.concatenate([np.geomspace(0.5, 0.499 * RATE, 800), np.arange(20, 800)]))
    return freq, np.abs(loop.frequency_response(freq)["die:error", "die:ref"])


def reached(curve: tuple[np.ndarray, np.ndarray]) -> float:
    """Return the frequency [Hz] up to which |S| < 1."""
    freq, size = curve
    return float(freq[np.argmax(size >= 1.0)])


def closed_loop(case: dict[str, Any], blocks: tuple[Any, ...]) -> dict[str, Any]:
    """Return the loop on the model and on the machine, and its run through a set-point there."""
    move = fx.setpoint(100e-6, velocity=5e-3, acceleration=0.5, jerk=100.0, rest=0.05)
    on_machine = case["machine"].loop(ports(), *blocks)
    on_model = fx.close_loop(case["plant"], *blocks)
    run = fx.simulate(on_machine, reference=move, duration=0.5, rng=7)
    exposure = run.time >= 0.3
    return {
        "blocks": blocks,
        "on model": on_model,
        "on machine": on_machine,
        "S": {"on model": sensitivity(on_model), "on machine": sensitivity(on_machine)},
        "run": run,
        "MA": float(np.abs(run.moving_average("die:error")[exposure]).max()),
        "MSD": float(run.moving_std("die:error")[exposure].max()),
    }


def loops(case: dict[str, Any]) -> dict[str, Any]:
    """Return both closed loops; fail when H-infinity loses |S| < 1 below what was asked."""
    found = {
        "servo": closed_loop(case, servo_blocks(case)),
        "H-infinity": closed_loop(case, hinf_blocks(case)),
    }
    require_bandwidth(found["H-infinity"]["S"])
    return found


def require_bandwidth(curves: dict[str, Any]) -> None:
    """Raise when |S| < 1 is lost below the asked bandwidth, on the model or the machine."""
    for where, curve in curves.items():
        if reached(curve) < HINF_BANDWIDTH:
            raise RuntimeError(f"|S| < 1 is lost below {HINF_BANDWIDTH:g} Hz {where}")


# %% Placement: which four sensors, and where a fifth one would help the POI most
def placement(case: dict[str, Any]) -> dict[str, Any]:
    """Return the scores of all four-sensor layouts, the search's answer, and the map."""
    places = {
        "corner": CORNERS,
        "edge": [(L / 2, 0.0, 0.0), (0.0, L / 2, 0.0), (L, L / 2, 0.0), (L / 2, L, 0.0)],
        "inner": INSET,
    }
    asd = SENSOR / np.sqrt(RATE / 2)
    candidates = [
        fx.Sensor(f"{kind}{i}", at=point, asd=asd)
        for kind, points in places.items()
        for i, point in enumerate(points, 1)
    ]
    names = [sensor.name for sensor in candidates]
    every = fx.score_sensors(
        case["plant"],
        list(combinations(names, 4)),
        criterion=fx.PoiVariance("die"),
        candidates=candidates,
    )
    best = fx.place_sensors(
        case["plant"],
        candidates,
        count=4,
        criterion=fx.PoiVariance("die"),
        method=fx.Exchange(starts=20),
        rng=1,
    )
    if not np.isclose(best.value, every.values[0], rtol=1e-9, atol=0.0):
        raise RuntimeError(f"the search found {best.chosen}, the best is {every.best}")
    lines = np.linspace(0.0, L, 13)
    points = [(x, y, 0.0) for y in lines for x in lines]
    fifth = fx.sensor_map(case["plant"], points, criterion=fx.PoiVariance("die"), asd=asd)
    return {"every": every, "best": best, "fifth": fifth}


# %% Numbers of the reduction
def frf_error(compliance_at: list[str]) -> float:
    """Return max |H_red - H_full| at a corner up to mode 20, over its static compliance, 1 %.

    The reduced model is the one of physical DOFs, (M*, D*, K*); elastic motion alone is compared,
    as the rigid-body motion is infinite at rest and the same in both.
    """
    damping = fx.ModalDamping(0.01)
    corner = plate.dofs.nearest(CORNERS[0], "z")
    full = fx.solve_modes(plate, damping=damping)
    modes = fx.solve_modes(plate, count=24, damping=damping, compliance_at=compliance_at)
    desired = fx.DesiredDofs(grid25 if compliance_at else grid24)
    model = fx.reduce(modes, desired)
    own = model.modes()
    s = 2j * np.pi * np.linspace(0.0, full.freq[19], 4000)[:, None]

    def receptance(omega: Any, zeta: Any, row: Any) -> Any:
        elastic = omega > 0
        w, z = omega[elastic], zeta[elastic]
        return (row[elastic] ** 2 / (s**2 + 2 * z * w * s + w**2)).sum(axis=1)

    exact = receptance(full.omega, full.zeta, full.at(corner))
    kept = receptance(own.omega, own.zeta, model.row(corner) @ own.phi)
    return float(np.abs(kept - exact).max() / np.abs(exact[0]))


# %% The run
def at_damping(damping: float) -> dict[str, Any]:
    """Return all that is computed at one damping."""
    case = study(damping)
    return {**case, "loops": loops(case)}


def main() -> dict[str, Any]:
    """Return everything that the tables and the pictures show; two processes share the work."""
    corner = plate.dofs.nearest(CORNERS[0], "z")
    with ProcessPoolExecutor(2) as executor:
        cases = dict(zip(DAMPINGS, executor.map(at_damping, DAMPINGS), strict=True))
        machine = cases[0.01]["machine"]
        frf = executor.submit(machine.measure_frf, ports(), period=0.5, rng=3)
        placed = executor.submit(placement, cases[0.01])
        return {
            "cases": cases,
            "frf_error": (frf_error([]), frf_error([corner])),
            "frf": frf.result(),
            "placement": placed.result(),
        }


# %% The tables
def model_table(result: dict[str, Any]) -> list[str]:
    """Return reduction and update as text, the paper's numbers beside ours."""
    case = result["cases"][0.01]
    nominal, fit = case["nominal"], case["fit"]
    before, after = nominal.modes(), fit.model.modes()
    lines = [f"{'1 % damping':54s}{'flexplant':>18s}{'paper':>16s}"]

    def row(text: str, ours: str, paper: str = "") -> None:
        lines.append(f"{text:54s}{ours:>18s}{paper:>16s}")

    row("plate: degrees of freedom", str(plate.n_dof), "243")
    row("reduced: degrees of freedom (24 modes + 1 vector)", str(len(nominal.dofs)), "24")
    for number in (4, 5, 6, 7, 8):
        paper = "461" if number == 6 else ""
        row(f"mode {number} before the update [Hz]", f"{before.freq[number - 1]:.3f}", paper)
    row("corner FRF error to mode 20, of static: modes only", f"{result['frf_error'][0]:.2%}")
    row("  with an attachment vector at the corner", f"{result['frf_error'][1]:.2%}")
    printed = {"lambda_12": "-28.5 - 2870i", "lambda_14": "-39.3 - 3970i"}
    for pole, (name, paper) in zip(case["measured"].poles, printed.items(), strict=True):
        row(f"measured {name} [rad/s]", f"{pole.real:.2f} - {pole.imag:.1f}i", paper)
    for text, found in (("modes only", case["modal"]), ("with compliance at z8", fit)):
        row(f"added mass, {text} [kg]", f"{found.values[0]:.6f}", "0.5")
        row("  added damping [N s/m]", f"{found.values[1]:.4f}", "0")
        row("  iterations", str(len(found.history)), "8")
    row("mode 6 after the update [Hz]", f"{after.freq[5]:.3f}", "455")
    return lines


def estimation_table(result: dict[str, Any]) -> list[str]:
    """Return what the update buys: predicted and measured POI errors."""
    lines = ["POI error with 0.1 nm sensors [nm rms]: predicted, then on the machine"]
    names = ("(a) static", "(b) not updated", "(c) updated")
    head = "".join(f"{name:>26s}" for name in names)
    lines.append(f"{'damping':>8s}{'N/sqrt(Hz)':>12s}{head}{'a/b':>7s}{'b/c':>6s}")
    for damping, case in result["cases"].items():
        for force, errors in case["errors"].items():
            cells = "".join(
                f"{1e9 * predicted:9.3f} {1e9 * rms:8.3f} +-{1e9 * half:5.2f}"
                for predicted, rms, half in errors.values()
            )
            a, b, c = (rms for _, rms, _ in errors.values())
            lines.append(f"{damping:8.1%}{force:12.0e}{cells}{a / b:7.2f}{b / c:6.2f}")
    lines.append(f"+- is half the 95 % confidence interval over {SEEDS} seeds of {MEASURE:g} s.")
    return lines


def loop_table(result: dict[str, Any]) -> list[str]:
    """Return both closed loops, on the model and on the machine."""
    lines = ["closed loops, one sample late; MA and MSD over 5 ms, settled after a 100 um move"]
    lines.append(
        f"{'damping':>8s}{'controller':>12s}{'gamma':>8s}{'':>12s}{'spectral radius':>17s}"
        f"{'|S|<1 to':>11s}{'max |S|':>10s}{'at u':>9s}{'MA':>10s}{'MSD':>10s}"
    )
    for damping, case in result["cases"].items():
        for name, loop in case["loops"].items():
            gamma = loop["blocks"][-1].gamma
            first = f"{damping:8.1%}{name:>12s}{'' if gamma is None else f'{gamma:.3f}':>8s}"
            for where in ("on model", "on machine"):
                closed, curve = loop[where], loop["S"][where]
                line = (
                    f"{first if where == 'on model' else '':28s}{where:>12s}"
                    f"{closed.spectral_radius:17.6f}{reached(curve):8.1f} Hz"
                    f"{20 * np.log10(curve[1].max()):7.2f} dB"
                    f"{-20 * np.log10(closed.modulus_margin):6.2f} dB"
                )
                if where == "on machine":
                    line += f"{1e9 * loop['MA']:7.2f} nm{1e9 * loop['MSD']:7.2f} nm"
                lines.append(line)
    for damping, case in result["cases"].items():
        freq, size = case["loops"]["H-infinity"]["S"]["on machine"]
        lines.append(
            f"{damping:8.1%}  |S| of H-infinity is largest at {freq[np.argmax(size)]:.0f} Hz "
            f"on the machine: {20 * np.log10(size.max()):.2f} dB"
        )
    return lines


def placement_table(result: dict[str, Any]) -> list[str]:
    """Return the best four-sensor layouts."""
    found = result["placement"]
    every = found["every"]
    lines = [f"the best of {len(every)} four-sensor layouts, by the predicted POI error"]
    for rank in range(5):
        error = 1e9 * np.sqrt(every.values[rank])
        lines.append(f"{rank + 1:4d}  {error:8.4f} nm  {', '.join(every.layouts[rank])}")
    corners = every.layouts.index(tuple(f"corner{i}" for i in range(1, 5)))
    lines.append(f"{corners + 1:4d}  {1e9 * np.sqrt(every.values[corners]):8.4f} nm  the corners")
    best, fifth = found["best"], found["fifth"]
    lines.append(
        f"exchange finds the same with {best.evaluations} evaluations; no four are better than "
        f"{1e9 * np.sqrt(best.bound):.4f} nm"
    )
    x, y, _ = fifth.best
    lines.append(
        f"a fifth sensor helps most at ({x:.2f}, {y:.2f}) m: {1e9 * np.sqrt(fifth.without):.4f} -> "
        f"{1e9 * np.sqrt(fifth.values.min()):.4f} nm"
    )
    return lines


def table(result: dict[str, Any]) -> str:
    """Return all numbers as text."""
    parts = (model_table, estimation_table, loop_table, placement_table)
    return "\n\n".join("\n".join(part(result)) for part in parts)


# %% The pictures
def pictures(result: dict[str, Any], folder: Path = OUT) -> list[Path]:
    """Draw the counterparts of the paper's figures 3 to 11, the closed loops and the map."""
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    case = result["cases"][0.01]
    nominal, fit = case["nominal"], case["fit"]
    bare = fx.solve_modes(plate, damping=fx.ModalDamping(0.01))
    freq = np.geomspace(100.0, 4000.0, 4000)
    frfs = {
        name: fx.frequency_response(fx.assemble_plant(model, ports()).Gyu, freq)
        for name, model in (("full FE model", bare), ("reduced", nominal), ("updated", fit.model))
    }
    frfs["measured"] = result["frf"]
    colors = dict(zip(frfs, ("tab:green", "tab:blue", "tab:red", "black"), strict=True))
    drawn = []

    def frf(*names: str) -> Any:
        shown = {name: frfs[name] for name in names}
        return fx.plot.frf(shown, "y1", "u1", colors=colors)

    def keep(name: str, **metadata: str) -> None:
        drawn.append(folder / f"{name}.png")
        plt.savefig(drawn[-1], dpi=110, metadata=metadata)
        plt.close("all")

    fx.plot.layout(plate.dofs, ports=ports(), desired=grid25, marked={"z8": z8})
    keep("figure_03_plate")
    frf("full FE model", "reduced")
    keep("figure_04_reduction")
    fx.plot.mode_shape(bare, 4, color="tab:green")
    keep("figure_05_torsion_full")
    fx.plot.mode_shape(nominal.modes(), 4)
    keep("figure_06_torsion_reduced")
    fx.plot.eigenvalues(fit, case["measured"].poles)
    keep("figure_07_eigenvalues")
    fx.plot.residual(fit)
    keep("figure_08_residual")
    _, axs = plt.subplots(2, 1, figsize=(6.0, 6.0), layout="constrained")
    truth = dict(zip(fit.parameters, (0.5, 0.0), strict=True))
    fx.plot.parameters(fit, truth=truth, axs=list(axs))
    keep("figure_09_parameters")
    frf("measured", "reduced", "updated").set(xlim=(100.0, 4000.0))
    keep("figure_10_updated")
    zoom = {"xlim": (430.0, 680.0), "ylim": (-165.0, -130.0), "xscale": "linear"}
    frf("measured", "reduced", "updated").set(**zoom)
    keep("figure_11_zoom")
    draw_loops(case["loops"])
    # the README shows a copy of this one, beside this file: the numbers in it tell when it is old
    keep("closed_loop", Comment=json.dumps(shown_numbers(case["loops"])))
    fx.plot.sensor_map(result["placement"]["fifth"], ports=ports())
    keep("fifth_sensor")
    return drawn


def draw_loops(both: dict[str, Any]) -> None:
    """Draw the move, its error, and |S| of both designs: the README's picture."""
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(11.0, 5.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    for (name, loop), color in zip(both.items(), ("tab:blue", "tab:red"), strict=True):
        fx.plot.response(loop["run"], ["die:error"], label=name, color=color, ax=left)
    left.set_title("error at the POI, on the virtual machine, through a 100 um move")
    shades = {"servo": ("tab:blue", "navy"), "H-infinity": ("tab:red", "darkred")}
    curves, colors = {}, {}
    for name, loop in both.items():
        for where, color in zip(("on model", "on machine"), shades[name], strict=True):
            curves[f"{name}, {where}"] = loop["S"][where]
            colors[f"{name}, {where}"] = color
    dashed = [label for label in curves if label.endswith("machine")]
    fx.plot.sensitivity(curves, colors=colors, dashed=dashed, ax=right)
    right.set_title("sensitivity, die:ref to die:error")


def shown_numbers(both: dict[str, Any]) -> dict[str, list[float]]:
    """Return points of the curves in the README's picture: errors [nm] and |S| [dB]."""
    shown = {}
    for name, loop in both.items():
        run = loop["run"]
        every = run.time.size // 25
        shown[f"{name}, die:error [nm]"] = [round(1e9 * x, 2) for x in run["die:error"][::every]]
        for where, (freq, size) in loop["S"].items():
            at = np.interp(np.geomspace(1.0, 4000.0, 25), freq, 20 * np.log10(size))
            shown[f"{name}, {where}, |S| [dB]"] = [round(float(x), 3) for x in at]
    return shown


if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    outcome = main()
    print(table(outcome))
    print(f"\npictures in {OUT}: {', '.join(path.stem for path in pictures(outcome))}")
