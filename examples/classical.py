"""What control engineers look for first, on textbook plants: each in a few lines.

Run it: ``python examples/classical.py``. The first plant is the distillation column of Skogestad
and Postlethwaite with 20 % error of each input. With the inverse of the plant as controller, their
section 8.11.3 states mu 0.53 for robust stability and 5.8 for robust performance. The second
consists of the two masses and one uncertain spring of Wie and Bernstein. Then follow a PD law with
a delay of one second, which is judged without sampling it, PI and PID controllers of ordinary
plants, and an LQG controller with an integrator, with its margins and the figures of its step
response.
"""

# %% Plants
import numpy as np

import flexplant as fx
from flexplant.lti import Delayed, tf
from flexplant.plant import UnmodelledDynamics
from flexplant.synthesis import RepeatedScalar

GAIN = np.array([[87.8, -86.4], [108.2, -109.6]])
PLANTS = {
    "temperature, 0.01 Hz": (tf([1.0], [1 / (0.02 * np.pi), 1.0]), 10.0, 0.0),
    "process with dead time": (tf([2.0], [10.0, 1.0]), 2.0, 2.0),
    "position of a motor": (tf([1.0], [5e-5, 0.0105, 0.2, 0.0]), 500.0, 0.0),
}


# %% Robust stability and performance of the column
def column() -> fx.plant.UncertainPlant:
    """Return the column: u, disturbances d of the outputs, errors e, measurements y."""
    A, rows, one, no = -np.eye(2) / 75, GAIN / 75, np.eye(2), np.zeros((2, 2))
    D = np.block([[one, no], [one, no]])
    names = {"inputs": ["d1", "d2", "u1", "u2"], "outputs": ["e1", "e2", "y1", "y2"]}
    g = fx.StateSpace(A, np.hstack([no, one]), np.vstack([rows, rows]), D, **names)
    plant = fx.StandardPlant.from_statespace(g, u=["u1", "u2"], y=["y1", "y2"])
    error = tf([1.0, 0.2], [0.5, 1.0])  # 20 % at rest, 200 % far above
    return plant.uncertain(*(UnmodelledDynamics(error, at=name) for name in ("u1", "u2")))


def inverse_based() -> fx.StateSpace:
    """Return ``0.7 / s`` times the inverse of the column."""
    inverse = -0.7 * np.linalg.inv(GAIN)
    names = {"inputs": ["y1", "y2"], "outputs": ["u1", "u2"]}
    return fx.StateSpace(np.zeros((2, 2)), np.eye(2), inverse, 75 * inverse, **names)


def column_mu() -> tuple[float, float]:
    """Return mu of robust stability and of robust performance, both from above."""
    known, law, weight = column(), inverse_based(), tf([0.5, 0.05], [1.0, 1e-4])
    stable = fx.synthesis.robust_stability(known, law)
    performance = {"w": ["d1", "d2"], "z": {"e1": weight, "e2": weight}}
    return stable.upper, fx.synthesis.robust_performance(known, law, **performance).upper


# %% Two masses, and a spring of 1.25 +- 0.75
def two_masses() -> fx.plant.UncertainPlant:
    """Return the benchmark: the Delta of the spring, force on one mass, sensor on the other."""
    A = [[0, 0, 1, 0], [0, 0, 0, 1], [-1.25, 1.25, 0, 0], [1.25, -1.25, 0, 0]]
    B = [[0, 0], [0, 0], [-0.75, 1], [0.75, 0]]
    C = [[1, -1, 0, 0], [0, 1, 0, 0]]
    M = fx.StateSpace(A, B, C, 0, inputs=["dk", "u"], outputs=["stretch", "y"])
    return fx.synthesis.uncertain_system(M, [RepeatedScalar(name="k")], u=["u"], y=["y"])


def lqg_of(known: fx.plant.UncertainPlant) -> fx.StateSpace:
    """Return an LQG law of the nominal masses, with little trust in the model."""
    g = known.plant.Gyu
    W = np.diag([0.0, 0.0, 1.0, 1.0])
    return fx.synthesis.lqg(g, Q=g.C.T @ g.C, R=[[0.1]], W=W, V=[[1e-3]])


# %% A second of delay
def delayed_pd() -> fx.loop.DelayedLoop:
    """Return the loop of an integrator with 1 s of delay and a PD law, which is improper."""
    return fx.loop.DelayedLoop(Delayed(tf([1.0], [1.0, 0.0]), 1.0), -Delayed.tf([0.2, 0.6], [1.0]))


# %% Ordinary plants
def tuned() -> dict[str, fx.synthesis.PidTuning]:
    """Return the PI or PID controllers of plants, at a rate and with a dead time."""
    return {
        name: fx.synthesis.tune_pid(g, rate=rate, dead_time=late)
        for name, (g, rate, late) in PLANTS.items()
    }


# %% LQG with an integrator, in numbers
def motor() -> tuple[fx.synthesis.MarginTable, fx.lti.StepInfo]:
    """Return the margins of a motor's LQG loop, and what its step takes."""
    g = tf([1.0], [0.05, 1.0, 0.0]).replace(inputs=["volt"], outputs=["angle"])
    K = fx.synthesis.lqg(
        g, Q=np.diag([0.0, 1.0, 400.0]), R=[[0.01]], W=g.B @ g.B.T, V=[[1e-4]], integrate=["angle"]
    )
    loop = fx.lti.connect([g, K], inputs=["angle:ref"], outputs=["angle"])
    info = fx.lti.step_info(loop)
    return fx.synthesis.margins((g, K.select(inputs=["angle"]))), info


# %% Run it
if __name__ == "__main__":
    print("column: mu of stability {:.2f}, of performance {:.2f}".format(*column_mu()))
    masses = two_masses()
    print(fx.synthesis.robust_stability(masses, lqg_of(masses)))
    pd = delayed_pd()
    kept = [f"{name} {most:.3g} at {at:.3g} Hz" for name, (most, at) in pd.margins.items()]
    print(pd, "margins: " + ", ".join(kept), f"T below {pd.norm('T')[0]:.2f}", sep="\n  ")
    for name, found in tuned().items():
        print(f"{name}: {found}")
    print(*motor(), sep="\n")
