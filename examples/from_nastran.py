"""A model of Nastran: from punched matrices in millimetres and tonnes to a plant in SI.

Run it: ``python examples/from_nastran.py``, or with files of your own:
``python examples/from_nastran.py stage.pch stage.bdf``. Nastran punches the matrices of a model as
DMIG cards with ``PARAM,EXTOUT,DMIGPCH`` (or ``EXTSEOUT(DMIGPCH)``); the nodes are in the bulk data.
Without files the script writes those of a free aluminium block as Nastran would, with ten digits
per number. Ten digits are not enough for rigid-body modes at 0 Hz. The table shows the error and
its correction.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # matrices are small: more threads only wait

import sys
import textwrap
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

import flexplant as fx

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
UNITS = ("mm", "t", "s")  # of the files; forces are then in N
SIZE = (0.4, 0.3, 0.05)  # m
COMPONENTS = {"x": 1, "y": 2, "z": 3, "rx": 4, "ry": 5, "rz": 6}


# %% The files, as Nastran writes them
def card(name: str, matrix: Any, dofs: fx.DofSet) -> list[str]:
    """Return the DMIG cards of a symmetric matrix: its lower triangle, in large fields."""
    lines = [f"{'DMIG':8s}{name:8s}{0:8d}{6:8d}{2:8d}{0:8d}{'':16s}{len(dofs):8d}"]
    lower = sp.csc_array(sp.tril(matrix))
    for column in range(len(dofs)):
        begin, end = lower.indptr[column : column + 2]
        if begin == end:
            continue
        node, component = dofs.nodes[column], COMPONENTS[dofs.directions[column]]
        lines.append(f"{'DMIG*':8s}{name:16s}{node:16d}{component:16d}")
        for row, value in zip(lower.indices[begin:end], lower.data[begin:end], strict=True):
            number = f"{value:.9E}".replace("E", "D")
            row_component = COMPONENTS[dofs.directions[row]]
            lines.append(f"{'*':8s}{dofs.nodes[row]:16d}{row_component:16d}{number:>16s}")
    return lines


def written(folder: Path) -> tuple[Path, Path]:
    """Write punch file and bulk data of a block in mm and t; return their paths."""
    block = fx.solid_block(
        size=SIZE, elements=(6, 5, 1), density=2700, youngs_modulus=70e9, poisson_ratio=0.33
    )
    folder.mkdir(exist_ok=True)
    punch, bulk = folder / "stage.pch", folder / "stage.bdf"
    # N/mm, and t = N s^2/mm
    lines = card("KAAX", block.K / 1e3, block.dofs) + card("MAAX", block.M / 1e3, block.dofs)
    punch.write_text("\n".join(lines) + "\n", encoding="ascii")
    nodes, first = np.unique(block.dofs.nodes, return_index=True)
    places = 1e3 * block.dofs.xyz[first]
    grid = [
        f"GRID,{node},,{x:.6f},{y:.6f},{z:.6f}"
        for node, (x, y, z) in zip(nodes.tolist(), places.tolist(), strict=True)
    ]
    bulk.write_text("\n".join(["BEGIN BULK", *grid, "ENDDATA"]) + "\n", encoding="ascii")
    return punch, bulk


# %% Read, look, solve, reduce
def main(punch: Path | None = None, bulk: Path | None = None) -> dict[str, Any]:
    """Return what was read, the report on it, modes, the reduced model and its quality."""
    if punch is None or bulk is None:
        punch, bulk = written(OUT)
    matrices = fx.read_matrices(punch, nodes=bulk)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        as_printed = fx.read_model(punch, nodes=bulk, units=UNITS)
    free = fx.read_model(punch, nodes=bulk, units=UNITS, free=True)
    modes = fx.solve_modes(free, count=20, damping=fx.ModalDamping(0.005))
    keep = fx.select_dofs(modes, 20)
    rom = fx.reduce(modes, fx.DesiredDofs(keep.labels))
    ends = {"inputs": keep.labels[:1], "outputs": keep.labels[-1:]}
    return {
        "report": fx.check(matrices),  # in the units of the file, which it guesses
        "warnings": [str(one.message).partition(": ")[2] for one in said],
        "printed": fx.solve_modes(as_printed, count=10),
        "modes": modes,
        "rom": rom,
        "quality": rom.quality(free, band=(500.0, 3000.0), **ends),
    }


# %% A plant by Nastran's node numbers
def plant(rom: fx.ReducedModel) -> fx.StandardPlant:
    """Return the sampled plant from a force at one end of the block to the motion at the other."""
    ports = fx.Ports(
        w=[fx.Disturbance("force", at=rom.dofs.labels[0], asd=1e-3)],
        u=[fx.Actuator("u1", at=rom.dofs.labels[0])],
        z=[fx.Poi("tip", at=rom.dofs.labels[-1])],
        y=[fx.Sensor("y1", at=rom.dofs.labels[-1], asd=1e-12)],
    )
    return fx.assemble_plant(rom, ports).discretized(10e3, delay=1)


# %% The table
def table(result: dict[str, Any]) -> str:
    """Return all numbers as text."""
    modes = result["modes"]
    held = ", ".join(f"{f:.2f}" for f in result["printed"].freq[: modes.n_rigid])
    freed = f"freed: {modes.n_rigid} rigid-body modes at 0, then {modes.freq[modes.n_rigid]:.2f} Hz"
    parts = [
        f"{result['report']}",
        "\n".join(line for one in result["warnings"] for line in textwrap.wrap(one, 100)),
        f"as printed: modes at {held} Hz\n{freed}",
        f"{result['rom']}\n{result['quality']}",
        f"{plant(result['rom'])}",
    ]
    return "\n\n".join(part for part in parts if part)


# %% Run it
if __name__ == "__main__":
    files = [Path(word) for word in sys.argv[1:] if word.lower().endswith((".pch", ".bdf"))]
    print(table(main(*files[:2])))
