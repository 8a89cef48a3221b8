"""A small machine with everything in it, made by hand from its modes."""

import time

import numpy as np

from flexplant.lti import StateSpace
from flexplant.lti.sampling import sample_and_hold
from flexplant.plant import Foreign, StandardPlant

RATE = 2000.0
OMEGA = 2 * np.pi * np.array([0.0, 60.0, 150.0, 400.0])
# modal shapes at two actuators (the sensors beside them), the die and the disturbance
SHAPES = {
    "1": np.array([0.7, 0.6, 0.4, -0.5]),
    "2": np.array([0.7, -0.5, 0.6, 0.4]),
    "die": np.array([0.7, 0.05, -0.3, 0.2]),
    "amp": np.array([0.7, 0.4, -0.5, 0.3]),
}


def stage(*, delay=1.0, rate=RATE, asd=1e-2, sensor_asd=1e-9, stiffer=1.0, blocks=True, zeta=0.01):
    """Return a sampled stage: rigid body and three elastic modes, two actuators, two sensors."""
    omega, k = OMEGA * np.sqrt(stiffer), np.arange(OMEGA.size)
    scale = np.where(omega > 0, omega, omega[1])
    n = 2 * omega.size
    A, B, C = np.zeros((n, n)), np.zeros((n, 3)), np.zeros((3, n))
    A[2 * k, 2 * k + 1], A[2 * k + 1, 2 * k] = scale, -(omega**2) / scale
    A[2 * k + 1, 2 * k + 1] = -2 * zeta * omega
    for column, place in enumerate(("amp", "1", "2")):
        B[2 * k + 1, column] = SHAPES[place]
    for row, place in enumerate(("die", "1", "2")):
        C[row, 2 * k] = SHAPES[place] / scale
    physical = StateSpace(
        A,
        B,
        C,
        np.zeros((3, 3)),
        inputs=["amp", "u1", "u2"],
        outputs=["die:z", "y1", "y2"],
        blocks=[2] * omega.size if blocks else None,
    )
    late = dict.fromkeys(["u1", "u2"], delay / rate)
    sampled, factor = sample_and_hold(physical, rate, late, asd=np.array([asd, 0.0, 0.0]))
    w = ["amp", "y1:noise", "y2:noise", "die:ref"]
    z = ["die:z", "die:error", "u1:effort", "u2:effort"]
    wide = np.zeros((sampled.n_states, 6))
    wide[:, [0, 4, 5]] = sampled.B
    tall = np.zeros((7, sampled.n_states))
    tall[[0, 4, 5]], tall[1] = sampled.C, -sampled.C[0]
    D = np.zeros((7, 6))
    D[1, 3] = D[6, 3] = D[2, 4] = D[3, 5] = D[4, 1] = D[5, 2] = 1.0
    system = sampled.replace(
        B=wide, C=tall, D=D, inputs=[*w, "u1", "u2"], outputs=[*z, "y1", "y2", "die:ref"]
    )
    return StandardPlant(
        system,
        tuple(w),
        ("u1", "u2"),
        tuple(z),
        ("y1", "y2", "die:ref"),
        {"amp": asd, "y1:noise": sensor_asd, "y2:noise": sensor_asd},
        Foreign(factor),
    )


def observer(dt=1.0 / RATE):
    """Return a crude observer: the mean of the sensors, low-passed, led by the applied force."""
    pole = 0.3
    return StateSpace(
        [[pole]],
        [[0.35, 0.35, 1e-7, 1e-7]],
        [[1.0]],
        [[0.0, 0.0, 0.0, 0.0]],
        dt,
        inputs=["y1", "y2", "u1", "u2"],
        outputs=["die:hat"],
        name="observer",
    )


def servo(dt=1.0 / RATE, *, hz=8.0, sign=1.0):
    """Return a lead controller on `die:ref` - `die:hat`, half of the force to each actuator."""
    crossover = 2 * np.pi * hz
    mass = 1.0 / 0.7**2
    corner = np.exp(-6.0 * crossover * dt)
    proportional, derivative = mass * crossover**2 / 3.0, mass * crossover
    slope = derivative * 6.0 * crossover
    half = 0.5 * sign * np.ones((2, 1))
    return StateSpace(
        [[corner]],
        (1.0 - corner) * np.array([[1.0, -1.0]]),
        -slope * half,
        (proportional + slope) * half @ np.array([[1.0, -1.0]]),
        dt,
        inputs=["die:ref", "die:hat"],
        outputs=["u1", "u2"],
        name="servo",
    )


def matrices(plant):
    """Return a plant as the dict that the oracles take."""
    g = plant.system
    return {
        "A": g.A,
        "B": g.B,
        "C": g.C,
        "D": g.D,
        "w": plant.w,
        "u": plant.u,
        "z": plant.z,
        "y": plant.y,
    }


def block(g):
    """Return a block as the dict that the oracles take."""
    return {"A": g.A, "B": g.B, "C": g.C, "D": g.D, "inputs": g.inputs, "outputs": g.outputs}


def slow_machine(item):
    """Return a row of a study after a while."""
    time.sleep(0.1)
    return {"twice": 2.0 * item}
