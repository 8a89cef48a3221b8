"""The paper's plate, from finite elements to a closed loop on a virtual machine.

Run it: ``python examples/wafer_stage.py``. It prints one table and writes the counterparts of the
paper's figures 3 to 11, and the closed-loop error, to ``examples/out``.

The paper says 0.1 % modal damping, but its printed eigenvalues have 1 %; both are shown.
"""

# %% Names and numbers
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
SEEDS = 5
SETTLE, MEASURE = 1.0, 2.0  # s
BANDWIDTH = 50.0  # Hz
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


def poi_errors(machine: Any, force: float, designs: dict[str, Any]) -> dict[str, Any]:
    """Return predicted and measured POI errors [m] while a slow servo holds the machine."""
    static = designs["static"]
    holding = fx.design_servo(static.plant, bandwidth=10.0)
    run = machine.run(
        ports(force),
        static,
        holding,
        *listening(designs),
        duration=SETTLE + MEASURE,
        rng=20260,
        runs=SEEDS,
    )
    late = run.time >= SETTLE
    hats = {"static": "die:hat", "nominal": "nominal:hat", "updated": "updated:hat"}
    return {
        key: (designs[key].rms("die:z"), *interval((run["die:z"] - run[hat])[:, late].std(axis=1)))
        for key, hat in hats.items()
    }


def study(damping: float, forces: tuple[float, ...]) -> dict[str, Any]:
    """Return machine, models, update and POI errors at one damping."""
    machine = fx.testbeds.wafer_stage(damping=damping, rate=RATE, delay=DELAY)
    measured = machine.poles([6, 7])
    nominal = reduced(damping, compliance=True)
    fit = updated(nominal, measured)
    errors = {
        force: poi_errors(machine, force, estimators(force, nominal, fit.model)) for force in forces
    }
    return {
        "machine": machine,
        "measured": measured,
        "nominal": nominal,
        "modal": updated(reduced(damping, compliance=False), measured),
        "fit": fit,
        "errors": errors,
    }


# %% The servo on (c)'s estimate, through a set-point
def servo_run(case: dict[str, Any], force: float = 1e-3) -> dict[str, Any]:
    """Return the loop on the model and on the machine, and a run through a set-point."""
    plant = fx.assemble_plant(case["fit"].model, ports(force)).discretized(RATE, delay=DELAY)
    observer = fx.design_kalman(plant)
    bowl = case["fit"].model.modes().freq[5]
    servo = fx.design_servo(plant, bandwidth=BANDWIDTH, notches=[bowl])
    move = fx.setpoint(100e-6, velocity=5e-3, acceleration=0.5, jerk=100.0, rest=0.05)
    run = case["machine"].run(ports(force), observer, servo, reference=move, duration=0.5, rng=7)
    return {
        "plant": plant,
        "on_model": fx.close_loop(plant, observer, servo),
        "on_machine": case["machine"].loop(ports(force), observer, servo),
        "exposure": run.time >= 0.3,
        "run": run,
    }


# %% Numbers of the reduction
def frf_error(count: int, compliance_at: list[str]) -> float:
    """Return max |H_red - H_full| at a corner up to mode 20, over its static compliance, 1 %."""
    damping = fx.ModalDamping(0.01)
    full = fx.solve_modes(plate, damping=damping)
    rows = [full.dofs.index(plate.dofs.nearest(CORNERS[0], "z"))]
    modes = fx.solve_modes(plate, count=count, damping=damping, compliance_at=compliance_at)
    omega = 2 * np.pi * np.linspace(0.0, full.freq[19], 4000)[:, None]

    def receptance(frequencies: Any, zeta: Any, shapes: Any) -> Any:
        elastic = frequencies > 0
        shape = np.asarray(shapes)[rows[0], elastic] ** 2
        w, z = frequencies[elastic], zeta[elastic]
        return (shape / (w**2 - omega**2 + 2j * z * w * omega)).sum(axis=1)

    exact = receptance(full.omega, full.zeta, full.phi)
    kept = receptance(modes.basis_omega, modes.basis_zeta, modes.basis)
    return float(np.abs(kept - exact).max() / np.abs(exact[0]))


# %% The run
def main() -> dict[str, Any]:
    """Return everything that the table and the pictures show."""
    cases = {damping: study(damping, FORCES) for damping in (0.01, 0.001)}
    loops = {damping: servo_run(case) for damping, case in cases.items()}
    corner = plate.dofs.nearest(CORNERS[0], "z")
    return {
        "cases": cases,
        "loops": loops,
        "frf_error": (frf_error(24, []), frf_error(24, [corner])),
        "frf": cases[0.01]["machine"].measure_frf(ports(), period=0.5, rng=3),
    }


def table(result: dict[str, Any]) -> str:
    """Return the numbers as text, the paper's beside ours where it has one."""
    case = result["cases"][0.01]
    nominal, fit = case["nominal"], case["fit"]
    before, after = nominal.modes(), fit.model.modes()
    lines = [f"{'':54s}{'flexplant':>14s}{'paper':>14s}"]

    def row(text: str, ours: str, paper: str = "") -> None:
        lines.append(f"{text:54s}{ours:>14s}{paper:>14s}")

    row("plate: degrees of freedom", str(plate.n_dof), "243")
    row("reduced: degrees of freedom (24 modes + 1 vector)", str(len(nominal.dofs)), "24")
    for number, paper in ((4, ""), (5, ""), (6, "461"), (7, ""), (8, "")):
        row(f"mode {number} before the update [Hz]", f"{before.freq[number - 1]:.3f}", paper)
    row("corner FRF error to mode 20, of static: modes only", f"{result['frf_error'][0]:.2%}")
    row("  with an attachment vector at the corner", f"{result['frf_error'][1]:.2%}")
    for pole, name, paper in zip(
        case["measured"].poles, ("12", "14"), ("-28.5 + 2870i", "-39.3 + 3970i"), strict=True
    ):
        row(f"measured lambda_{name} [rad/s]", f"{pole.real:.2f} + {pole.imag:.1f}i", paper)
    for text, found in (("modes only", case["modal"]), ("with compliance at z8", fit)):
        row(f"added mass, {text} [kg]", f"{found.values[0]:.6f}", "0.5")
        row("  added damping [N s/m]", f"{found.values[1]:.4f}", "0")
        row("  iterations", str(len(found.history)), "8")
    row("mode 6 after the update [Hz]", f"{after.freq[5]:.3f}", "455")
    lines += ["", "POI error with 0.1 nm sensors [nm rms]: predicted, then on the machine"]
    names = ("(a) static", "(b) not updated", "(c) updated")
    lines.append(
        f"{'damping':>8s}{'N/sqrt(Hz)':>12s}"
        + "".join(f"{name:>26s}" for name in names)
        + f"{'a/b':>7s}{'b/c':>6s}"
    )
    for damping, found in result["cases"].items():
        for force, errors in found["errors"].items():
            cells = "".join(
                f"{1e9 * predicted:9.3f} {1e9 * rms:8.3f} +-{1e9 * half:5.2f}"
                for predicted, rms, half in errors.values()
            )
            static, before_it, after_it = (rms for _, rms, _ in errors.values())
            lines.append(
                f"{damping:8.1%}{force:12.0e}{cells}"
                f"{static / before_it:7.2f}{before_it / after_it:6.2f}"
            )
    lines.append(f"+- is half the 95 % confidence interval over {SEEDS} seeds of {MEASURE:g} s.")
    lines += [
        "",
        f"servo, {BANDWIDTH:g} Hz, notch at mode 6, on (c)'s estimate, {DELAY} sample late:",
    ]
    lines.append(f"{'damping':>8s}{'':14s}{'spectral radius':>16s}{'max |S| [dB]':>14s}")
    for damping, loop in result["loops"].items():
        for where in ("on_model", "on_machine"):
            closed = loop[where]
            peak = -20 * np.log10(closed.modulus_margin)
            lines.append(
                f"{damping:8.1%}{where.replace('_', ' '):>14s}"
                f"{closed.spectral_radius:16.6f}{peak:14.2f}"
            )
        run, late = loop["run"], loop["exposure"]
        average = np.abs(run.moving_average("die:error")[late]).max()
        spread = run.moving_std("die:error")[late].max()
        lines.append(
            f"{'':8s}after a move of 100 um: moving average {1e9 * average:.2f} nm, "
            f"moving standard deviation {1e9 * spread:.2f} nm"
        )
    return "\n".join(lines)


# %% The pictures
def pictures(result: dict[str, Any], folder: Path = OUT) -> list[Path]:
    """Draw the counterparts of the paper's figures 3 to 11 and the closed-loop error."""
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    case = result["cases"][0.01]
    nominal, fit = case["nominal"], case["fit"]
    freq = np.geomspace(100.0, 4000.0, 4000)
    undelayed = {
        name: fx.frequency_response(fx.assemble_plant(model, ports()).Gyu, freq)
        for name, model in (("reduced", nominal), ("updated", fit.model))
    }
    bare = fx.solve_modes(plate, damping=fx.ModalDamping(0.01))
    full = fx.frequency_response(fx.assemble_plant(bare, ports()).Gyu, freq)
    measured = result["frf"]
    colors = {"full FE model": "tab:green", "reduced": "tab:blue", "updated": "tab:red"}
    colors["measured"] = "black"
    drawn = []

    def keep(name: str) -> None:
        path = folder / f"{name}.png"
        plt.savefig(path, dpi=110)
        plt.close("all")
        drawn.append(path)

    fx.plot.layout(plate.dofs, ports=ports(), desired=grid25, marked={"z8": z8})
    keep("figure_03_plate")
    fx.plot.frf({"full FE model": full, "reduced": undelayed["reduced"]}, "y1", "u1", colors=colors)
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
    both = {"measured": measured, **undelayed}
    ax = fx.plot.frf(both, "y1", "u1", colors=colors)
    ax.set_xlim(100.0, 4000.0)
    keep("figure_10_updated")
    ax = fx.plot.frf(both, "y1", "u1", colors=colors)
    ax.set(xlim=(430.0, 680.0), xscale="linear")
    keep("figure_11_zoom")
    _, axs = plt.subplots(2, 1, figsize=(8.0, 6.0), layout="constrained", sharex=True)
    run = result["loops"][0.01]["run"]
    fx.plot.response(run, ["die:z", "die:hat"], ax=axs[0])
    fx.plot.response(run, ["die:error"], ax=axs[1])
    keep("closed_loop_error")
    return drawn


if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    outcome = main()
    print(table(outcome))
    print(f"\npictures: {', '.join(path.name for path in pictures(outcome))} in {OUT}")
