"""A fleet of wafer stages: one robust controller for all against one for each machine.

Run it: ``python examples/fleet.py`` for ten machines (50 s of two cores), as for the results below,
or with another number: ``python examples/fleet.py 50``. The machines have another plate theory than
the drawing: each is a plate computed with polynomials and rotary inertia. It has an unknown mass at
z8 and another mass elsewhere, scattered stiffness and damping, and sensors with finite resolution.
For each machine the poles of twelve modes are measured (with errors of 1e-5), and the model is
updated and calibrated. Each is controlled twice. The first controller is the same for all machines,
and as fast as a sample of them allows. The second is designed for one machine and tolerates the
remaining uncertainty of its modes. The paper claims that the second can be faster. The study can be
stopped at any time: finished machines are stored in a file.

The claim is true for these ten machines. All are stable with both controllers, with a modulus
margin of at least 0.4. With their own controllers the margin is at least 0.43, and it is at most
0.1 % below the predicted margin::

                       bandwidth [Hz]            error rms [nm]                   MA [nm]
                   median    95 %   worst    median    95 %   worst    median    95 %   worst
    one for all      32.8    32.3    32.2      11.2    14.1    14.3      28.6    35.7    39.2
    one for each     67.8    67.5    67.4      4.08    4.79    4.86      8.05    9.77    9.88

Every machine gave a result; the worst bandwidth is the lowest. The specification is a moving
average (MA) of the error of at most 12 nm after a move. All machines exceed it with the common
controller, and none exceeds it with its own controller.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # a process for each core

import sys
import warnings
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

import flexplant as fx

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
L, RATE, DELAY, DAMPING = 0.6, 10e3, 1.3, 0.002
CORNERS = [(x, y, 0.0) for y in (0.0, L) for x in (0.0, L)]
INSET = [(x, y, 0.0) for y in (L / 4, 3 * L / 4) for x in (L / 4, 3 * L / 4)]
MEASURED, ERROR = range(4, 16), 1e-5  # modes whose poles are identified, and their relative error
OWN, TRIED = (70.0, 50.0), (15.0, 20.0, 25.0, 30.0, 40.0, 60.0)  # Hz
MARGIN, MA = 0.4, 12e-9  # modulus margin, m: the specification
TRAINING = 8  # machines on which the common controller is chosen

PORTS = fx.Ports(
    w=[fx.Disturbance(f"amp{i}", at=p, asd=1e-3) for i, p in enumerate(INSET, 1)],
    u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(INSET, 1)],
    z=[fx.Poi("die", at=(L / 2, L / 2, 0.0), axes=("z", "rx", "ry"))],
    y=[fx.Sensor(f"y{i}", at=p, asd=0.1e-9 / np.sqrt(RATE / 2)) for i, p in enumerate(CORNERS, 1)],
    references=[fx.Reference("die")],
)

# %% The drawing, reduced to 25 DOFs: 24 modes and the compliance at the mass of an actuator
ALUMINIUM = {"density": 2702, "youngs_modulus": 70e9, "poisson_ratio": 0.35}
plate = fx.kirchhoff_plate(size=(L, L), thickness=0.0272, elements=(8, 8), **ALUMINIUM)
LAW = fx.ModalDamping(DAMPING)
Z8 = plate.dofs.nearest((L / 2, L / 4, 0.0), "z")
GRID = [
    plate.dofs.nearest((x, y, 0.0), "z") for x in np.linspace(0, L, 5) for y in np.linspace(0, L, 5)
]


@cache
def reduced(mass: float = 0.0) -> fx.ReducedModel:
    """Return the plate with a mass [kg] at z8 in 25 z-DOFs."""
    loaded = plate.with_parts(fx.PointMass(Z8, mass)) if mass else plate
    modes = fx.solve_modes(loaded, count=24, damping=LAW, compliance_at=[Z8])
    return fx.reduce(modes, fx.DesiredDofs(GRID))


@cache
def mesh_error() -> Any:
    """Return how far the drawing's mesh is from a finer one, mode by mode."""
    fine = fx.kirchhoff_plate(size=(L, L), thickness=0.0272, elements=(16, 16), **ALUMINIUM)
    coarse, fine = (fx.solve_modes(one, count=24, damping=LAW) for one in (plate, fine))
    return coarse.mesh_error(fine)


def fleet(count: int, seed: int = 20261) -> list[fx.testbeds.WaferStage]:
    """Return machines; a longer list begins with the machines of a shorter one."""
    masses = np.random.default_rng(seed).uniform(0.0, 1.0, count)
    return [
        fx.testbeds.wafer_stage(
            damping=DAMPING, rate=RATE, delay=DELAY, added_mass=mass, individual=seed + i
        )
        for i, mass in enumerate(masses)
    ]


# %% The pipeline of each machine: measure, update, design, verify on the machine
STIFFNESS = fx.MatrixParameter("stiffness", dK=plate.K, bounds=(-0.1, 0.1))
UNKNOWN = [fx.AddedMass(Z8, bounds=(0.0, 2.0)), STIFFNESS]
DURATION, STEADY = 0.6, 0.3  # s, of a run and where its move is over
SPECIFICATION = fx.Specification(ma=MA, modulus_margin=MARGIN, start=STEADY)
MOVE = fx.setpoint(100e-6, velocity=5e-3, acceleration=0.5, jerk=100.0, rest=0.05)


def pipeline(machine: Any, rng: np.random.Generator, blocks: Any = None) -> dict[str, Any]:
    """Return the row of a machine, with its own controller or with the given blocks."""
    with warnings.catch_warnings(action="ignore"):  # the row reports the result
        of_run, of_measurement = rng.spawn(2)
        measured = machine.poles(MEASURED, deviation=ERROR, rng=of_measurement)
        fit = fx.update(reduced(), UNKNOWN, [fx.Eigenvalues(measured)], starts=3)
        whole = fx.solve_modes(fit.applied_to(plate), count=80, damping=LAW).calibrated(measured)
        plant = fx.assemble_plant(fit.calibrated(measured), PORTS, evaluation=whole)
        plant = plant.discretized(RATE, delay=DELAY)
        if blocks is None:
            own = fastest(plant.uncertain(fit.uncertainty(measured, mesh=mesh_error())))
            blocks, left_out = (own,), own.left_out
        else:
            left_out = fx.close_loop(plant, *blocks).left_out
        loop = machine.loop(PORTS, *blocks)
        run = fx.simulate(loop, duration=DURATION, reference=MOVE, rng=of_run)
        verdict = SPECIFICATION.check(loop, run)
    return {
        **{one.name: value for one, value in zip(UNKNOWN, fit.values.tolist(), strict=True)},
        "margin expected": left_out.modulus_margin,
        "modulus margin": loop.modulus_margin,
        "stable": loop.is_stable,
        "bandwidth": fx.loop.bandwidth(loop),
        "error rms": float(np.max(run.rms("die:error", start=STEADY))),
        "MA": verdict["MA"],
        "passed": verdict.passed,
    }


def fastest(plant: Any) -> Any:
    """Return the controller for the higher of the two bandwidths that is feasible."""
    with suppress(fx.errors.InfeasibleError):
        return fx.design_stage(plant, bandwidth=OWN[0], margin=MARGIN)
    return fx.design_stage(plant, bandwidth=OWN[1], margin=MARGIN)


# %% One controller for all: the fastest that keeps the margin on a sample of the machines
def for_all(machines: list[fx.testbeds.WaferStage]) -> tuple[float, Any]:
    """Return bandwidth and blocks of the fastest design on the mean machine that holds on all."""
    model = reduced(0.5)  # the mean machine
    plant = fx.assemble_plant(model, PORTS).discretized(RATE, delay=DELAY)
    errors, best = fx.reference_errors(plant), (0.0, None)
    for asked in TRIED:
        weights = fx.stage_weights(plant, asked)
        weighted = plant.through(errors).weighted(z=weights.z, w=weights.w)
        blocks = errors, fx.design_hinf(weighted)
        with warnings.catch_warnings(action="ignore"):  # instability is a possible result here
            loops = [one.loop(PORTS, *blocks) for one in machines]
            if not all(loop.is_stable and loop.modulus_margin >= MARGIN for loop in loops):
                break
        best = asked, blocks
    return best


# %% The study and its results
def main(count: int = 10, folder: Path = OUT, workers: int | None = None) -> dict[str, Any]:
    """Return both tables; each continues where it was stopped."""
    folder.mkdir(exist_ok=True)
    machines, tables = fleet(count), {}
    asked, blocks = for_all(fleet(TRAINING, seed=7))
    with ProcessPoolExecutor(workers) as pool:
        for name, controller in (("one for all", blocks), ("one for each", None)):
            tables[name] = fx.study(
                machines,
                partial(pipeline, blocks=controller),
                executor=pool,
                rng=1,
                checkpoint=folder / f"fleet_{count}_{name.replace(' ', '_')}.jsonl",
            )
    return {"asked": asked, "tables": tables}


def failures(one: fx.simulation.StudyTable) -> str:
    """Return how many machines failed, and why: no result, unstable, not to specification."""
    ran = one["failed"] == ""
    counts = {reason: int(np.sum(one["failed"] == reason)) for reason in sorted({*one["failed"]})}
    counts.pop("", None)
    counts["unstable"] = int(np.sum(ran & ~one["stable"]))
    counts[f"modulus margin below {MARGIN:g}"] = int(np.sum(one["modulus margin"] < MARGIN))
    counts[f"MA above {1e9 * MA:g} nm"] = int(np.sum(one["MA"] > MA))
    return ", ".join(f"{reason}: {count}" for reason, count in counts.items())


def table(result: dict[str, Any]) -> str:
    """Return the distributions as text; the worst bandwidth is the lowest one."""
    tried, own = (", ".join(f"{one:g}" for one in some) for some in (TRIED, OWN))
    heads = ("bandwidth [Hz]", "error rms [nm]", "MA [nm]")
    lines = [
        f"One controller for all is designed for {result['asked']:g} Hz, the fastest of {tried} Hz",
        f"that leaves {TRAINING} other machines a modulus margin of {MARGIN:g}. One for each is",
        f"designed for the first of {own} Hz that has it on its own model.",
        f"{'':14s}{'machines':>10s}" + "".join(f"{h:>26s}" for h in heads),
        f"{'':24s}" + f"{'median':>10s}{'95 %':>8s}{'worst':>8s}" * 3,
    ]
    for name, one in result["tables"].items():
        row = f"{name:14s}{one['stable'].size:10d}"
        for column, scale in (("bandwidth", -1.0), ("error rms", 1e9), ("MA", 1e9)):
            values = scale * one[column][one["stable"]]
            row += "  " + "".join(f"{abs(q):8.3g}" for q in np.quantile(values, (0.5, 0.95, 1.0)))
        lines.append(row)
    lines += [f"{name}, failed: {failures(one)}" for name, one in result["tables"].items()]
    each = result["tables"]["one for each"]
    said, there = each["margin expected"], each["modulus margin"]
    lines.append(
        f"one for each: least modulus margin {said.min():.3f} predicted, {there.min():.3f} on the "
        f"machines, at most {max(0.0, 100 * np.max(1 - there / said)):.1f} % below the prediction"
    )
    lines.append("error rms: of die:error from 0.3 to 0.6 s; MA: largest mean of it over 5 ms")
    return "\n".join(lines)


def picture(result: dict[str, Any], folder: Path = OUT) -> Path:
    """Draw the distributions of bandwidth and error, both ways."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import PercentFormatter

    figure, axs = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    figure.suptitle("Machines that differ: one controller for all, and one for each")
    for ax, (column, scale, label) in zip(
        axs,
        (
            ("bandwidth", 1.0, "bandwidth [Hz]"),
            ("MA", 1e9, "MA of the error after a move [nm]"),
            ("modulus margin", 1.0, "modulus margin [1]"),
        ),
        strict=True,
    ):
        for (name, one), role in zip(result["tables"].items(), ("nominal", "model"), strict=True):
            values = scale * one[column][one["stable"]]
            ax.ecdf(values, label=name, **fx.plot.STYLES[role])
        ax.set(xlabel=label, ylabel="machines below", ylim=(0.0, 1.02))
        ax.yaxis.set_major_formatter(PercentFormatter(1.0))
        ax.grid(alpha=0.3)
    axs[1].set_xscale("log")
    axs[1].set_xticks([5, 10, 20, 50], ["5", "10", "20", "50"])
    axs[1].minorticks_off()
    axs[0].legend(loc="center")
    figure.savefig(folder / "fleet.png", dpi=90)
    plt.close(figure)
    return folder / "fleet.png"


# %% Run it
if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    counts = [int(word) for word in sys.argv[1:] if word.isdigit()]
    outcome = main(*counts[:1])
    print(table(outcome), picture(outcome), sep="\n\npicture: ")
