"""The files of ``examples/gantry.py``: what a finite-element program and a laboratory deliver.

This script does not use flexplant. It assembles the matrices of an H-gantry, writes them in
millimetres and tonnes, and measures another gantry that differs from the drawing: see `TRUE`.
Run it: ``python examples/data/gantry_files.py FOLDER``.
"""

import sys
from pathlib import Path

import numpy as np
import pyuff
import scipy.io
import scipy.linalg
import scipy.sparse

#: nodes [m]: frame 1 and 2, carriage 5, tool 6, and nine nodes along the bridge
PLACES = {1: (0.0, 0.0, 0.0), 2: (1.0, 0.0, 0.0), 5: (0.625, 0.0, 0.2), 6: (0.625, 0.0, -0.1)}
PLACES |= {10 + i: (0.125 * i, 0.0, 0.2) for i in range(9)}
DOFS = ["1:x", "1:y", "2:y", "5:x", "5:y", "6:x", "6:y", "10:x"]
DOFS += [f"{10 + i}:{direction}" for i in range(9) for direction in ("y", "rz")]
DRAWN = {"tool": 5.0, "column": 1.0, "feet": 1.0}  # kg; stiffness relative to the drawing
TRUE = {"tool": 5.8, "column": 0.88, "feet": 1.04}  # a camera that no drawing shows; soft bolts
BENDING = 6.0e5  # N m^2 of the bridge, 60 kg of 1 m
STRUCK = ["1:y", "2:y", "5:x", "10:x", "10:y", "18:y"]  # by a hammer
FELT = [*STRUCK, "6:x", "6:y", "14:y"]  # accelerometers
FREQ = np.arange(4.0, 460.0, 0.5)  # Hz
NOISE = 2e-4  # m/s^2 per N rms, of each line


def matrices(*, tool: float, column: float, feet: float) -> tuple[np.ndarray, np.ndarray]:
    """Return mass and stiffness in SI."""
    row = {name: i for i, name in enumerate(DOFS)}
    M, K = np.zeros((2, len(DOFS), len(DOFS)))

    def spring(stiffness: float, along: dict[str, float]) -> None:
        r = np.zeros(len(DOFS))
        r[[row[name] for name in along]] = list(along.values())
        K[:] += stiffness * np.outer(r, r)

    ends = [row["1:y"], row["2:y"]]
    M[np.ix_(ends, ends)] = [[375.0, 75.0], [75.0, 375.0]]  # 900 kg, 150 kg m^2, 1 m apart
    for name, mass in {"1:x": 900.0, "5:x": 18.0, "5:y": 18.0, "10:x": 60.0}.items():
        M[row[name], row[name]] += mass
    M[row["6:x"], row["6:x"]] = M[row["6:y"], row["6:y"]] = tool
    h = 0.125  # m, of each element of the bridge
    bending = [[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h],
               [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h * h, -6 * h, 4 * h * h]]  # fmt: skip
    inertia = [[156, 22 * h, 54, -13 * h], [22 * h, 4 * h * h, 13 * h, -3 * h * h],
               [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h * h, -22 * h, 4 * h * h]]  # fmt: skip
    for i in range(10, 18):
        rows = [row[f"{i + k}:{d}"] for k in (0, 1) for d in ("y", "rz")]
        K[np.ix_(rows, rows)] += BENDING / h**3 * np.array(bending)
        M[np.ix_(rows, rows)] += 60.0 * h / 420.0 * np.array(inertia)
    spring(feet * 900.0 * (2 * np.pi * 11.0) ** 2, {"1:x": 1.0})
    spring(feet * 450.0 * (2 * np.pi * 13.0) ** 2, {"1:y": 1.0})
    spring(feet * 450.0 * (2 * np.pi * 13.0) ** 2, {"2:y": 1.0})
    spring(1.2e8, {"10:x": 1.0, "1:x": -1.0})  # guides of the bridge
    spring(6e7, {"5:y": 1.0, "15:y": -1.0})  # guide of the carriage
    spring(column * 5.0 * (2 * np.pi * 62.0) ** 2, {"6:x": 1.0, "5:x": -1.0})
    spring(column * 5.0 * (2 * np.pi * 80.0) ** 2, {"6:y": 1.0, "5:y": -1.0})
    return M, K


def machine() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return omega [rad/s], damping ratios and shapes of the gantry that is measured."""
    M, K = matrices(**TRUE)
    squares, phi = scipy.linalg.eigh(K, M)
    omega = np.sqrt(np.where(squares > 1.0, squares, 0.0))  # three motions are free slides
    soft = omega < 2 * np.pi * 30.0  # the feet are of rubber
    scatter = np.random.default_rng(5).uniform(0.7, 1.4, omega.size)
    return omega, np.where(soft, 0.04, 0.01) * scatter, phi


def accelerance(rng: np.random.Generator) -> np.ndarray:
    """Return what the laboratory measures: acceleration per force, with noise."""
    omega, zeta, phi = machine()
    rows, columns = (np.array([DOFS.index(name) for name in names]) for names in (FELT, STRUCK))
    s = 2j * np.pi * FREQ[:, None]
    modal = s**2 / (s**2 + 2 * zeta * omega * s + omega**2)
    H = np.einsum("im,fm,jm->ijf", phi[rows], modal, phi[columns])
    noise = rng.standard_normal((2, *H.shape)) * NOISE / np.sqrt(2)
    return H + noise[0] + 1j * noise[1]


def write(folder: Path) -> None:
    """Write stiffness.mtx, mass.mtx, nodes.csv (mm, t, N) and lab.uff (m/s^2 per N)."""
    folder.mkdir(parents=True, exist_ok=True)
    M, K = matrices(**DRAWN)
    # a displacement in mm, a rotation in rad: forces in N, moments in N mm
    size = np.array([1.0 if name.endswith("rz") else 1e-3 for name in DOFS])
    for name, matrix in (("mass", M), ("stiffness", K)):
        in_mm = 1e3 * size[:, None] * matrix * size
        scipy.io.mmwrite(folder / f"{name}.mtx", scipy.sparse.coo_array(in_mm))
    lines = ["node,direction,x,y,z"]
    for name in DOFS:
        node, direction = name.split(":")
        place = (1e3 * x for x in PLACES[int(node)])
        lines.append(",".join([node, direction, *(f"{x:g}" for x in place)]))
    (folder / "nodes.csv").write_text("\n".join(lines) + "\n", encoding="ascii")
    H = accelerance(np.random.default_rng(65))
    number = {"x": 1, "y": 2}
    records = []
    for i, felt in enumerate(FELT):
        for j, struck in enumerate(STRUCK):
            (a, d), (b, e) = felt.split(":"), struck.split(":")
            records.append(pyuff.prepare_58(
                func_type=4, binary=0, rsp_node=int(a), rsp_dir=number[d], ref_node=int(b),
                ref_dir=number[e], x=FREQ, data=H[i, j], abscissa_spec_data_type=18,
                ordinate_spec_data_type=12, ordinate_axis_units_lab="m/s^2",
                orddenom_spec_data_type=13, orddenom_axis_units_lab="N",
            ))  # fmt: skip
    pyuff.UFF(str(folder / "lab.uff")).write_sets(records, "overwrite")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
