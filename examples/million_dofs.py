"""A million degrees of freedom (DOFs) on a laptop: from the mesh to a closed loop.

Run it: ``python examples/million_dofs.py 1000000`` (about a minute of one core and 7 GB of memory),
or with fewer DOFs. Without a number the model has 100 000 DOFs. A square plate is meshed. Its modes
are computed, each with a residual, and a count proves that none is missing. The model is reduced to
the DOFs of sensors and actuators, and a loop is closed on it. Frequencies are compared with those
published by Leissa for a free square plate.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # times are then those of one core

import sys
import time
from typing import Any

import numpy as np

import flexplant as fx

L, THICKNESS = 0.6, 0.01  # m
E, NU, RHO = 70e9, 0.3, 2700.0
COUNT, RATE = 24, 10e3  # modes, Hz
#: omega L^2 sqrt(rho h / D) of a free square plate (Leissa, J. Sound Vib. 31, 1973); by the method
#: of Ritz, so that they are upper bounds, up to 1 % high
LEISSA = np.array([13.489, 19.789, 24.432, 35.024, 35.024])
CORNERS = [(x, y, 0.0) for y in (0.0, L) for x in (0.0, L)]
INSET = [(x, y, 0.0) for y in (L / 4, 3 * L / 4) for x in (L / 4, 3 * L / 4)]
PORTS = fx.Ports(
    w=[fx.Disturbance(f"amp{i}", at=p, asd=1e-3) for i, p in enumerate(INSET, 1)],
    u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(INSET, 1)],
    z=[fx.Poi("die", at=(L / 2, L / 2, 0.0), axes=("z", "rx", "ry"))],
    y=[fx.Sensor(f"y{i}", at=p, asd=1e-12) for i, p in enumerate(CORNERS, 1)],
    references=[fx.Reference("die")],
)


# %% The mesh: three DOFs at each node
def meshed(dofs: int) -> fx.FEModel:
    """Return a plate with at least as many DOFs; an even mesh has nodes under all ports."""
    elements = 4 * int(np.ceil((np.sqrt(dofs / 3) - 1) / 4))
    return fx.kirchhoff_plate(
        size=(L, L),
        thickness=THICKNESS,
        elements=(elements, elements),
        density=RHO,
        youngs_modulus=E,
        poisson_ratio=NU,
    )


# %% From the mesh to the loop, each step with its time
def main(dofs: int = 100_000) -> dict[str, Any]:
    """Return the model, its modes, the reduced model, the loop, and CPU seconds of each."""
    seconds, begin = {}, time.process_time()

    def took(what: str) -> None:
        nonlocal begin
        seconds[what] = time.process_time() - begin
        begin = time.process_time()

    model = meshed(dofs)
    took("mesh")
    places = [model.dofs.nearest(point, "z") for point in INSET]
    modes = fx.solve_modes(model, count=COUNT, damping=fx.ModalDamping(0.005), compliance_at=places)
    took("modes")
    chosen = fx.select_dofs(modes, COUNT + len(places), required=places)
    rom = fx.reduce(modes, fx.DesiredDofs(chosen.labels))
    took("reduction")
    plant = fx.assemble_plant(rom, PORTS).discretized(RATE, delay=1)
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=25.0, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    took("loop")
    return {"model": model, "modes": modes, "rom": rom, "loop": loop, "seconds": seconds}


def leissa_error(modes: fx.Modes) -> np.ndarray:
    """Return how far the first elastic frequencies are from the printed ones, relative."""
    stiffness = E * THICKNESS**3 / (12 * (1 - NU**2))  # of the plate, D [N m]
    factor = L**2 * np.sqrt(RHO * THICKNESS / stiffness)
    elastic = modes.omega[modes.omega > 0][: LEISSA.size]
    return np.asarray(elastic * factor / LEISSA - 1)


# %% The table
def table(result: dict[str, Any]) -> str:
    """Return all numbers as text."""
    modes, rom, model = result["modes"], result["rom"], result["model"]
    kept = np.abs(rom.modes().freq[3:COUNT] / modes.freq[3:COUNT] - 1).max()
    low, high = min(leissa_error(modes)), max(leissa_error(modes))
    steps = ", ".join(f"{what} {took:.1f} s" for what, took in result["seconds"].items())
    return "\n".join(
        [
            f"{model.n_dof} DOFs, {model.K.nnz} entries of K; {steps} (CPU)",
            f"{modes}",
            f"relative to Leissa's upper bounds: {low:.2%} to {high:.2%}",
            f"reduced to {rom.M.shape[0]} DOFs; its frequencies differ by {kept:.0e} at most",
            f"{result['loop']}",
        ]
    )


# %% Run it
if __name__ == "__main__":
    sizes = [int(word) for word in sys.argv[1:] if word.isdigit()]
    print(table(main(*sizes[:1])))
