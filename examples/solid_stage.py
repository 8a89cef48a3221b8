"""A solid stage with six degrees of freedom, imported from matrices of another program.

Run it: ``python examples/solid_stage.py``. A block of aluminium is meshed with eight-node bricks.
It is written as a finite-element program would do it, in Matrix Market files in mm and t with a
table of the DOFs. Then it is read back in SI units, so that flexplant knows the matrices and the
nodes, but not the elements. Mode shapes are interpolated between the nodes, so that sensors,
actuators and the point of interest may be anywhere in the block.

Six sensors and six actuators (each through its amplifier, with 40 us of cable) control x, y, z, rx,
ry and rz of a point that no sensor sees.
"""

# %% Names and numbers
import csv
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse as sp

import flexplant as fx

SIZE, ELEMENTS = (0.4, 0.3, 0.1), (4, 3, 1)  # m
DENSITY, YOUNG, POISSON = 2700.0, 70e9, 0.33
OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
RATE, DELAY = 10e3, 1  # Hz, samples
SENSOR = 1e-9 / np.sqrt(RATE / 2)  # 1 nm rms a sample
FORCE = 1e-3  # N/sqrt(Hz) at each actuator
BANDWIDTH = 60.0  # Hz
AXES = ("x", "y", "z", "rx", "ry", "rz")
LX, LY, LZ = SIZE
POI = (0.23, 0.17, LZ)  # on the top, between nodes
#: three pushers along z, two along x, one along y; sensors likewise, elsewhere
PUSHERS = {
    "z1": ((0.05, 0.05, 0.0), "z"),
    "z2": ((0.35, 0.05, 0.0), "z"),
    "z3": ((0.2, 0.25, 0.0), "z"),
    "x1": ((0.0, 0.06, 0.05), "x"),
    "x2": ((0.0, 0.24, 0.05), "x"),
    "y1": ((0.2, 0.0, 0.05), "y"),
}
SENSORS = {
    "sz1": ((0.02, 0.02, LZ), "z"),
    "sz2": ((0.38, 0.02, LZ), "z"),
    "sz3": ((0.2, 0.29, LZ), "z"),
    "sx1": ((LX, 0.03, 0.06), "x"),
    "sx2": ((LX, 0.27, 0.06), "x"),
    "sy1": ((0.17, LY, 0.06), "y"),
}


# %% What a finite-element program does
def brick(a: float, b: float, c: float) -> tuple[np.ndarray, np.ndarray]:
    """Return consistent mass and stiffness (24, 24) of an eight-node brick a x b x c."""
    corners = np.array(list(product((-1, 1), repeat=3)))
    lame = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    shear = YOUNG / (2 * (1 + POISSON))
    law = np.diag([2 * shear] * 3 + [shear] * 3)
    law[:3, :3] += lame
    M, K = np.zeros((24, 24)), np.zeros((24, 24))
    for point in np.array(list(product((-1, 1), repeat=3))) / np.sqrt(3.0):
        parts = (1 + corners * point) / 2
        shape = parts.prod(axis=1)
        slope = np.empty((8, 3))
        for k, length in enumerate((a, b, c)):
            slope[:, k] = corners[:, k] / length * np.delete(parts, k, axis=1).prod(axis=1)
        strain = np.zeros((6, 24))
        for k in range(3):
            strain[k, k::3] = slope[:, k]
        for row, (i, j) in enumerate(((0, 1), (1, 2), (2, 0)), 3):
            strain[row, i::3], strain[row, j::3] = slope[:, j], slope[:, i]
        moved = np.kron(shape, np.eye(3))
        M += DENSITY * a * b * c / 8 * moved.T @ moved
        K += a * b * c / 8 * strain.T @ law @ strain
    return M, K


def mesh() -> tuple[sp.csc_array, sp.csc_array, np.ndarray]:
    """Return M, K and the nodes (n, 3) of the block."""
    counts = np.array(ELEMENTS) + 1
    lengths = np.array(SIZE) / ELEMENTS
    nodes = np.array(list(product(*(range(n) for n in counts)))) * lengths
    M, K = sp.lil_array((nodes.size, nodes.size)), sp.lil_array((nodes.size, nodes.size))
    mass, stiffness = brick(*lengths)
    steps = np.array(list(product((0, 1), repeat=3)))
    for first in product(*(range(n) for n in ELEMENTS)):
        at = np.ravel_multi_index(tuple((np.array(first) + steps).T), tuple(counts))
        dofs = (3 * at[:, None] + np.arange(3)).ravel()
        M[np.ix_(dofs, dofs)] += mass
        K[np.ix_(dofs, dofs)] += stiffness
    return sp.csc_array(M), sp.csc_array(K), nodes


def export(folder: Path) -> None:
    """Write what a finite-element program would, in mm and t: two matrices and a table."""
    M, K, nodes = mesh()
    scipy.io.mmwrite(folder / "M.mtx", M / 1e3, symmetry="symmetric")  # kg -> t
    scipy.io.mmwrite(folder / "K.mtx", K / 1e3, symmetry="symmetric")  # N/m -> N/mm
    with open(folder / "dofs.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["node", "direction", "x", "y", "z"])
        for number, xyz in enumerate(1e3 * nodes, 1):
            table.writerows([number, direction, *xyz.tolist()] for direction in "xyz")


# %% Import
def imported() -> fx.FEModel:
    """Return the block from files, in SI, its shapes interpolated between the nodes."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        export(folder)
        model = fx.read_model(
            folder / "K.mtx",
            mass=folder / "M.mtx",
            dofs=folder / "dofs.csv",
            units=("mm", "t", "s"),
            name="block",
        )
    return fx.interpolated(model)


def ports() -> fx.Ports:
    """Return six disturbances, six actuators, the POI with six axes, six sensors."""
    amplifier = fx.lti.low_pass_filter(4e3)
    return fx.Ports(
        w=[fx.Disturbance(f"w{n}", p, direction=d, asd=FORCE) for n, (p, d) in PUSHERS.items()],
        u=[
            fx.Actuator(n, p, direction=d, dynamics=amplifier, latency=40e-6)
            for n, (p, d) in PUSHERS.items()
        ],
        z=[fx.Poi("die", at=POI, axes=AXES)],
        y=[fx.Sensor(n, p, direction=d, asd=SENSOR) for n, (p, d) in SENSORS.items()],
        references=[fx.Reference("die")],
    )


# %% Six axes
def main() -> dict[str, Any]:
    """Return the numbers that the tests check."""
    model = imported()
    modes = fx.solve_modes(model, count=20, damping=fx.ModalDamping(0.005))
    plant = fx.assemble_plant(modes, ports())
    report = plant.check()
    axes = fx.plant.gravity_axes(plant)
    sampled = plant.discretized(RATE, delay=DELAY)
    observer = fx.design_kalman(sampled)
    servo = fx.design_servo(sampled, bandwidth=BANDWIDTH)
    loop = fx.close_loop(sampled, observer, servo)
    move = fx.setpoint(distance=1e-3, velocity=0.02, acceleration=0.5, jerk=50.0)
    run = fx.simulate(loop, reference=move, duration=0.5, rng=1)
    return {
        "model": model,
        "modes": modes,
        "plant": plant,
        "report": report,
        "decoupling": axes,
        "observer": observer,
        "loop": loop,
        "run": run,
    }


def printed(found: dict[str, Any]) -> None:
    """Print the numbers."""
    print(fx.check(found["model"]))
    print(found["model"], found["modes"], found["plant"], found["report"], sep="\n")
    axes = found["decoupling"]
    print(axes)
    print("inertia about the centre of gravity [kg, kg m^2]:", np.diag(axes.mass).round(5))
    print("estimation error of the POI:")
    for axis in AXES:
        rms = found["observer"].rms(f"die:{axis}")
        unit = "nrad" if axis.startswith("r") else "nm"
        print(f"  {axis:2s} {1e9 * rms:8.3f} {unit}")
    loop = found["loop"]
    print(f"spectral radius {loop.spectral_radius:.5f}, modulus margin {loop.modulus_margin:.3f}")
    print(f"error in the last 0.1 s: {1e9 * np.std(found['run']['die:error'][-1000:]):.2f} nm rms")


# %% The picture
def picture(found: dict[str, Any], folder: Path = OUT) -> Path:
    """Draw the stage with its ports, its first elastic mode, the move and the loop."""
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(14.0, 10.0), layout="constrained")
    solid = [figure.add_subplot(2, 2, k, projection="3d") for k in (1, 2)]
    flat = [figure.add_subplot(2, 2, k) for k in (3, 4)]
    fx.plot.layout(found["model"].dofs, ports=ports(), ax=solid[0])
    fx.plot.mode_shape(found["modes"], 7, ax=solid[1])
    fx.plot.exposures(found["run"], "die:error", start=0.3, ax=flat[0])
    fx.plot.sensitivity({"die:ref to die:error": found["loop"]}, ax=flat[1])
    flat[0].set_title("error after a move of 1 mm, moving windows of 5 ms")
    flat[1].set(title="sensitivity at the point of interest", xlim=(1.0, 5e3), ylim=(-80.0, 15.0))
    folder.mkdir(exist_ok=True)
    figure.savefig(folder / "solid_stage.png", dpi=90)
    plt.close(figure)
    return folder / "solid_stage.png"


if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    outcome = main()
    printed(outcome)
    print(f"picture: {picture(outcome)}")
