"""A stage that slides on a frame on isolators: joined from parts, reduced, taken apart again.

Run it: ``python examples/joined_machine.py``. Four air bearings hold a stage on a frame and let it
slide along x; four isolators hold the frame on the floor. The machine joined from the two models
has one motion at exactly 0 Hz, the slide. Its modes are complex, because bearings and isolators
damp the machine only at a few places. When the parts are first reduced and then joined, 420 DOFs
become 84, and frequencies up to 1.4 kHz agree to 1e-3. The responses of the separate parts also
give those of the machine. Conversely, when the frame is removed from the machine's responses, those
of the stage remain.
"""

# %% Names and numbers
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # matrices are small: more threads only wait

from typing import Any

import numpy as np

import flexplant as fx

ALUMINIUM = {"density": 2700.0, "youngs_modulus": 70e9, "poisson_ratio": 0.33}
BEARING = {"stiffness": 5e7, "rate": 300.0}  # N/m, N s/m
ISOLATOR = {"stiffness": 2e5, "rate": 400.0}
PLACED = {"stage": fx.joining.Pose(shift=(0.2, 0.1, 0.08))}  # on top of the frame
AXES = ("x", "y", "z")


# %% The parts, 0.1 % damping in each
def parts() -> dict[str, fx.FEModel]:
    """Return the models of stage and frame, each where it was drawn."""
    stage = fx.solid_block(size=(0.3, 0.3, 0.03), elements=(3, 3, 1), **ALUMINIUM)
    frame = fx.solid_block(size=(0.8, 0.5, 0.08), elements=(8, 5, 1), **ALUMINIUM)
    law = fx.ModalDamping(0.001)
    return {"stage": stage.with_damping(law), "frame": frame.with_damping(law)}


def nodes(model: fx.FEModel, points: list[tuple[float, float, float]]) -> list[str]:
    """Return the numbers of the nodes at some points of a part."""
    return [model.dofs.nearest(point).partition(":")[0] for point in points]


# %% How they are joined
def joints(models: dict[str, fx.FEModel]) -> tuple[list[fx.joining.Joint], dict[str, list[str]]]:
    """Return the joints, and the nodes of each part that they hold."""
    corners = [(x, y) for y in (0.0, 0.3) for x in (0.0, 0.3)]
    feet = nodes(models["stage"], [(x, y, 0.0) for x, y in corners])
    pads = nodes(models["frame"], [(x + 0.2, y + 0.1, 0.08) for x, y in corners])
    floor = nodes(models["frame"], [(x, y, 0.0) for y in (0.0, 0.5) for x in (0.1, 0.7)])
    bearings = [
        fx.joining.Joint(f"stage/{foot}", f"frame/{pad}", axes=("y", "z"), **BEARING)
        for foot, pad in zip(feet, pads, strict=True)
    ]
    isolators = [fx.joining.Joint(f"frame/{node}", axes=AXES, **ISOLATOR) for node in floor]
    return [*bearings, *isolators], {"stage": feet, "frame": [*pads, *floor]}


# %% The same machine from reduced parts
def reduced(models: dict[str, fx.FEModel], held: dict[str, list[str]]) -> dict[str, Any]:
    """Return the parts by Craig and Bampton, with the DOFs of their joints kept."""
    found = {}
    for name, count in (("stage", 24), ("frame", 24)):
        boundary = [f"{node}:{axis}" for node in held[name] for axis in AXES]
        found[name] = fx.reduce(models[name], fx.reduction.CraigBampton(boundary, count))
    return found


# %% Responses between drive and encoder
def ports(held: dict[str, list[str]]) -> fx.Ports:
    """Return a motor and an encoder between stage and frame, and a probe on the stage."""
    stage, frame = held["stage"], held["frame"]
    between = {f"stage/{stage[0]}:x": 1.0, f"frame/{frame[0]}:x": -1.0}
    return fx.Ports(
        u=[fx.Actuator("motor", at=between)],
        y=[fx.Sensor("encoder", at=between), fx.Sensor("probe", at=f"stage/{stage[3]}:z")],
    )


# %% The parts as they would be measured
def measured(model: fx.FEModel, labels: list[str], freq: np.ndarray) -> fx.Frf:
    """Return the exact responses of a part between some DOFs, channels named alike."""
    channels = fx.Ports(
        u=[fx.Actuator(f"{label} force", at=label) for label in labels],
        y=[fx.Sensor(label, at=label) for label in labels],
    )
    found = fx.frequency_response(fx.assemble_plant(model, channels).Gyu, freq)
    exact = np.zeros(found.data.shape)
    return fx.Frf(freq, found.data, labels, labels, "displacement", variance=exact)


# %% All of it
def main() -> dict[str, Any]:
    """Return the machine, the one from reduced parts, their modes and responses."""
    models = parts()
    listed, held = joints(models)
    machine = fx.joined(models, listed, placed=PLACED, name="stage on frame")
    small = fx.joined(reduced(models, held), listed, placed=PLACED)
    freq = np.geomspace(20.0, 600.0, 60)
    channels = ports(held)
    plants = [fx.assemble_plant(model, channels).Gyu for model in (machine, small)]
    answers = [fx.frequency_response(plant, freq) for plant in plants]

    # bearings alone, with the responses of the parts: those of the machine, and apart again
    bearings = listed[:4]
    labels = {name: [f"{n}:{a}" for n in held[name][:4] for a in ("y", "z")] for name in held}
    frfs = {name: measured(models[name], labels[name], freq) for name in models}
    coupled = fx.joined(frfs, bearings)
    free = fx.joined(models, bearings, placed=PLACED)
    every = [f"{name}/{label}" for name in models for label in labels[name]]
    whole = measured(free, every, freq)
    rest = fx.joining.uncoupled(whole, {"frame": frfs["frame"]}, bearings)
    return {
        "machine": machine,
        "small": small,
        "modes": (fx.solve_modes(machine, count=15), small.modes().select(range(15))),
        "answers": answers,
        "coupled": (coupled, whole),
        "apart": (rest, frfs["stage"]),
    }


def largest_error(found: fx.Frf, exact: fx.Frf) -> float:
    """Return the largest error of a response, of the largest entry at its frequency."""
    size = np.abs(exact.data).max(axis=(0, 1))
    return float((np.abs(found.data - exact.data).max(axis=(0, 1)) / size).max())


def report(result: dict[str, Any]) -> str:
    """Return what was found, in words."""
    full, small = result["modes"]
    lines = [
        repr(result["machine"]),
        repr(result["machine"].joining),
        repr(result["small"]),
        "mode   Hz          damping    from reduced parts",
    ]
    for i in range(full.n_modes):
        error = f"{small.freq[i] / full.freq[i] - 1:+.1e}" if full.freq[i] else "0, exactly"
        lines.append(f"{i + 1:4d}   {full.freq[i]:9.4f}   {100 * full.zeta[i]:6.3f} %   {error}")
    lines += [
        f"motor to encoder and probe, reduced: to {largest_error(*result['answers'][::-1]):.1e}",
        f"machine from the responses of its parts: to {largest_error(*result['coupled']):.1e}",
        f"stage from the machine without its frame: to {largest_error(*result['apart']):.1e}",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    print(report(main()))
