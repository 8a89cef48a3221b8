"""Lumped machines: bodies with a mass matrix, joined by springs; three masses in a row."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from ..arrays import FloatArray
from ..labels import DofSet
from ..modes import solve_modes
from ..plant import (
    Actuator,
    Disturbance,
    Poi,
    Ports,
    Reference,
    Sensor,
    StandardPlant,
    assemble_plant,
)
from ..structure import FEModel, ModalDamping, chain
from ..tolerances import SAME

#: a spring: the combination of DOFs that stretches it, and its stiffness [N/m or N m/rad]
Stretch = tuple[Mapping[str, float], float]


def lumped(
    bodies: Mapping[str | tuple[str, ...], float | FloatArray],
    springs: Iterable[Stretch],
    places: Mapping[int, Sequence[float]] | None = None,
    name: str = "",
) -> FEModel:
    """Return the model of bodies and springs; places are coordinates [m] of nodes."""
    groups = {(key,) if isinstance(key, str) else key: mass for key, mass in bodies.items()}
    labels = [label for group in groups for label in group]
    row = {label: i for i, label in enumerate(labels)}
    M, K = np.zeros((len(labels),) * 2), np.zeros((len(labels),) * 2)
    for group, mass in groups.items():
        rows = [row[label] for label in group]
        own: FloatArray = np.asarray(mass, dtype=np.float64)
        M[np.ix_(rows, rows)] = own if own.ndim == 2 else np.diag(np.broadcast_to(own, len(rows)))
    stretches = [np.zeros((0, len(labels)))]
    for along, stiffness in springs:
        r = np.zeros((1, len(labels)))
        r[0, [row[label] for label in along]] = list(along.values())
        K += stiffness * r.T @ r
        stretches.append(r / np.linalg.norm(r))
    nodes, directions = zip(*(label.split(":") for label in labels), strict=True)
    numbers = [int(node) for node in nodes]
    xyz = [(places or {}).get(node, (0.0, 0.0, 0.0)) for node in numbers]
    # slides: what stretches no spring moves freely
    free = la.null_space(np.vstack(stretches), rcond=SAME)
    dofs = DofSet(numbers, directions, xyz)
    return FEModel(M, K, dofs=dofs, joint_motions=free, name=name)


def two_points(mass: float, inertia: float, span: float) -> FloatArray:
    """Return the mass matrix of a rigid body by its displacements at two ends, a span apart."""
    away = inertia / span**2
    near = 0.25 * mass
    return np.array([[near + away, near - away], [near - away, near + away]])


def along_leg(
    node: int, attached: npt.ArrayLike, direction: npt.ArrayLike, weight: float = 1.0
) -> dict[str, float]:
    """Return the motion along a direction of a point attached to a body with six DOFs."""
    d = np.asarray(direction, dtype=np.float64)
    turned = np.cross(np.asarray(attached, dtype=np.float64), d)
    parts = zip(("x", "y", "z", "rx", "ry", "rz"), (*d, *turned), strict=True)
    return {f"{node}:{axis}": float(weight * part) for axis, part in parts if abs(part) > 1e-12}


def three_masses(*, rate: float | None = 2e3, delay: int = 1) -> StandardPlant:
    r"""Return the plant of three masses in a row: one to push, one to hold still, two to see.

    ::

        u1 --> [1 kg]--/\/\/--[1 kg]--/\/\/--[1 kg]     free along x
                 y1            die              y2

    The actuator u1, with amplifier noise `amp`, pushes the first mass. The sensors y1 and y2
    measure the masses at both ends. The point of interest `die`, with a reference, is the middle
    mass, which no sensor measures. Springs of 4e5 N/m give modes at 0, 100.7 and 174.3 Hz with 1 %
    damping. The plant serves for first trials and for the examples in docstrings.

    Parameters
    ----------
    rate : float [Hz], optional
        Sampling rate; None gives the continuous plant.
    delay : int [samples]
        Delay from measurement to actuation.

    Returns
    -------
    StandardPlant

    Raises
    ------
    ModelError
        When the rate is not positive, or the delay is negative.

    Examples
    --------
    >>> three_masses()
    <StandardPlant: 7 states, dt 0.0005 s, delay 1>
      w (4) amp  y1:noise  y2:noise  die:ref
      u (1) u1
      z (3) die:x  die:error  u1:effort
      y (3) y1  y2  die:ref
    """
    masses = chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    modes = solve_modes(masses, count=3, damping=ModalDamping(0.01))
    ports = Ports(
        w=[Disturbance("amp", at="1:x", asd=1e-3)],
        u=[Actuator("u1", at="1:x")],
        z=[Poi("die", at="2:x", axes=("x",))],
        y=[Sensor("y1", at="1:x", asd=1e-10), Sensor("y2", at="3:x", asd=1e-10)],
        references=[Reference("die")],
    )
    plant = assemble_plant(modes, ports)
    return plant if rate is None else plant.discretized(rate, delay=delay)
