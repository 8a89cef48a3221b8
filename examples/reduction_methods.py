"""Twelve ways to reduce one machine to the same order, side by side.

Run it: ``python examples/reduction_methods.py``. The plate of the paper has 0.5 % damping, four
actuators and sensors at its four corners. It is reduced to 24 coordinates by every method of
``flexplant.reduce``. For each method the table shows the computing time and three errors: those of
the frequencies below 1.5 kHz, of the responses from actuators to sensors over the band, and of the
elastic compliance at 0 Hz. The full responses are solved from the matrices, not from modes.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # matrices are small: more threads only wait

import time
from pathlib import Path
from typing import Any

import numpy as np

import flexplant as fx

L = 0.6
ORDER = 24
OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
DRAWN = ("Guyan", "CraigBampton", "DesiredDofs")
BAND = (100.0, 1500.0)  # Hz, where responses are compared
DAMPING = fx.ModalDamping(0.005)

# %% The full model, its actuators and sensors
plate = fx.kirchhoff_plate(
    size=(L, L),
    thickness=0.0272,
    elements=(8, 8),
    density=2702,
    youngs_modulus=70e9,
    poisson_ratio=0.35,
)
ACTUATORS = [
    plate.dofs.nearest((x, y, 0.0)) for y in (L / 4, 3 * L / 4) for x in (L / 4, 3 * L / 4)
]
SENSORS = [plate.dofs.nearest((x, y, 0.0)) for y in (0.0, L) for x in (0.0, L)]
PORTS = [*ACTUATORS, *SENSORS]


# %% The methods, all at order 24
def methods() -> dict[str, tuple[Any, fx.ReducedModel, float]]:
    """Return {name: (method, reduced model, CPU seconds)}; with all preparations."""
    modes = fx.solve_modes(plate, count=ORDER)  # for the choice of DOFs, not counted
    chosen = fx.select_dofs(modes, ORDER, required=PORTS)

    def paper() -> fx.ReducedModel:
        own = fx.solve_modes(plate, count=ORDER, damping=DAMPING)
        return fx.reduce(own, fx.DesiredDofs(chosen))

    free = ORDER - len(PORTS)
    ways: dict[str, Any] = {
        "DesiredDofs": paper,
        "Serep": fx.reduction.Serep(chosen, damping=DAMPING),
        "Guyan": fx.reduction.Guyan(chosen, damping=DAMPING),
        "Irs": fx.reduction.Irs(chosen, damping=DAMPING),
        "Irs, 50 iterations": fx.reduction.Irs(chosen, iterations=50, damping=DAMPING),
        "ModalTruncation": fx.reduction.ModalTruncation(
            ORDER, inputs=ACTUATORS, outputs=SENSORS, damping=DAMPING
        ),
        "ModalTruncation, static": fx.reduction.ModalTruncation(
            free, static_at=PORTS, inputs=ACTUATORS, outputs=SENSORS, damping=DAMPING
        ),
        "ModalBalanced": fx.ModalBalanced(
            ORDER, ACTUATORS, outputs=SENSORS, among=80, damping=DAMPING
        ),
        "CraigBampton": fx.reduction.CraigBampton(PORTS, free, damping=DAMPING),
        "Rubin": fx.reduction.Rubin(PORTS, free, damping=DAMPING),
        "MacNeal": fx.reduction.MacNeal(PORTS, free, damping=DAMPING),
        "Krylov": fx.reduction.Krylov(
            [*ACTUATORS[:3], *SENSORS], [0.0, 500.0, 1100.0], damping=DAMPING
        ),
    }
    done = {}
    for name, way in ways.items():
        start = time.process_time()
        model = way() if callable(way) else fx.reduce(plate, way)
        done[name] = (way, model, time.process_time() - start)
    return done


# %% Which modes matter to which channels
def ranking() -> Any:
    """Return the modal Hankel values from actuators to sensors."""
    modes = fx.solve_modes(plate, count=80, damping=DAMPING)
    return fx.reduction.rank_modes(modes, inputs=ACTUATORS, outputs=SENSORS)


# %% The run
def main() -> dict[str, Any]:
    """Return {name: (order, quality, CPU seconds)}, the models, and the ranking of the modes."""
    judged, models = {}, {}
    for name, (_, model, seconds) in methods().items():
        models[name] = model
        quality = model.quality(plate, band=BAND, inputs=ACTUATORS, outputs=SENSORS)
        judged[name] = (model.n_dof, quality, seconds)
    return {"judged": judged, "models": models, "ranking": ranking()}


# %% The table
def table(result: dict[str, Any]) -> str:
    """Return all numbers as text; errors in per cent."""
    head = f"{'method':25s}{'order':>6s}{'freq [%]':>11s}{'lost':>5s}{'FRF/peak':>10s}"
    text = [head + f"{'at res.':>9s}{'static':>10s}{'bound/error':>12s}{'CPU [ms]':>10s}"]
    for name, (order, quality, seconds) in result["judged"].items():
        lost = np.isnan(quality.freq)
        worst = 100 * np.abs(quality.freq_error[~lost]).max()
        errors = (quality.frf_error, quality.resonance_error, quality.static_error)
        frf, resonance, static = (100 * float(error.max()) for error in errors)
        bound = f"{quality.band_bound / quality.true_error:.3g}" if quality.bound else "-"
        text.append(
            f"{name:25s}{order:6d}{worst:11.2g}{lost.sum():5d}{frf:10.2g}{resonance:9.2g}"
            f"{static:10.2g}{bound:>12s}{1e3 * seconds:10.1f}"
        )
    return "\n".join(
        [*text, "", "which modes matter to which channels", result["ranking"].table(8)]
    )


# %% The picture
def picture(result: dict[str, Any], folder: Path = OUT) -> Path:
    """Draw a response by three of the methods, and the errors of all."""
    import matplotlib.pyplot as plt

    figure, axs = plt.subplots(1, 2, figsize=(16.0, 5.5), layout="constrained")
    ports = fx.Ports(u=[fx.Actuator("u1", at=ACTUATORS[0])], y=[fx.Sensor("y1", at=SENSORS[0])])
    freq = np.geomspace(*BAND, 2000)
    full = fx.solve_modes(plate, damping=DAMPING)
    models = {"full model": full} | {name: result["models"][name] for name in DRAWN}
    responses = {
        name: fx.frequency_response(fx.assemble_plant(model, ports).Gyu, freq)
        for name, model in models.items()
    }
    fx.plot.frf(responses, "y1", "u1", reference="full model", ax=axs[0])
    axs[0].set_title(f"from actuator to corner, order {ORDER}")
    rows = list(result["judged"])[::-1]
    for k, (label, marker) in enumerate(
        (("frequencies", "o"), ("responses", "s"), ("static", "D"))
    ):
        found = [_errors(result["judged"][name][1])[k] for name in rows]
        look = fx.plot.CYCLE[k]["color"]
        axs[1].semilogx(found, range(len(rows)), marker, color=look, label=label, markersize=7)
    axs[1].set_yticks(range(len(rows)), rows)
    axs[1].set(xlabel="largest error [%]", title=f"{BAND[0]:g} to {BAND[1]:g} Hz and at rest")
    axs[1].grid(alpha=0.25)
    axs[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    folder.mkdir(exist_ok=True)
    figure.savefig(folder / "reduction_methods.png", dpi=90)
    plt.close(figure)
    return folder / "reduction_methods.png"


def _errors(quality: Any) -> tuple[float, float, float]:
    """Return the largest errors [%] of frequencies, responses and static compliance."""
    worst = np.nanmax(np.abs(quality.freq_error))
    errors = (worst, quality.frf_error.max(), quality.static_error.max())
    frf, response, static = (max(100.0 * float(error), 1e-12) for error in errors)
    return frf, response, static


if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    outcome = main()
    print(table(outcome), f"picture: {picture(outcome)}", sep="\n\n")
