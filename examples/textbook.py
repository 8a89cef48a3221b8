"""Mixed sensitivity of four textbook plants: S, T and K S below bounds given by weights.

Run it: ``python examples/textbook.py``. The plants are a slow lag, an integrator, a rigid body with
a lightly damped mode, and a lag with a zero in the right half plane. Each weight says how small one
quantity has to be: ``|S| < 1 / |W_S|`` for errors, ``|K S| < 1 / |W_KS|`` for the effort and
``|T| < 1 / |W_T|`` for errors of the model. `design_hinf` finds the controller with the smallest
norm gamma of all weighted quantities together. If gamma is below 1, all bounds are met. If it is
above 1, they are missed by at most the factor gamma.

The table compares gamma with a lower bound that holds for every controller, and says whether all
bounds are met. For a zero z in the right half plane a bound is known by hand: S(z) = 1 for every
controller, so that gamma is at least ``|W_S(z)|``. A bandwidth close to such a zero is impossible,
as the last plant shows.
"""

# %% Plants and weights
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import flexplant as fx
from flexplant.lti import tf
from flexplant.plant import mixed_sensitivity

OUT = Path(globals().get("__file__", ".")).parent / "out"  # "." in a notebook
ZERO = 10.0  # rad/s


class Case(NamedTuple):
    """A plant, and the weights of S, K S and T."""

    G: fx.StateSpace
    weights: dict[str, Any]


def rigid_body_with_mode(omega: float = 20.0, zeta: float = 0.005) -> fx.StateSpace:
    """Return ``1 / s^2 - 0.5 / (s^2 + 2 zeta omega s + omega^2)``: a mode out of phase."""
    mode = [1.0, 2.0 * zeta * omega, omega**2]
    return tf(np.polysub(mode, [0.5, 0.0, 0.0]), np.polymul([1.0, 0.0, 0.0], mode))


CASES = {
    "slow lag": Case(tf([1.0], [1.0, 1e-4]), {"S": tf([0.5, 2.0], [1.0, 2e-4]), "KS": 0.05}),
    "integrator": Case(tf([1.0], [1.0, 0.0]), {"S": tf([0.5, 2.0], [1.0, 2e-4]), "KS": 0.1}),
    "double integrator, mode": Case(
        rigid_body_with_mode(), {"S": tf([0.5, 1.0], [1.0, 1e-4]), "KS": 0.02, "T": 0.4}
    ),
    "zero at 10 rad/s": Case(
        tf([-1.0, ZERO], [1.0, 11.0, 10.0]), {"S": tf([0.5, 4.0], [1.0, 4e-4]), "KS": 0.1}
    ),
}


# %% Design
def main() -> dict[str, tuple[Any, fx.Controller]]:
    """Return the plant with its weights and the controller of each case."""
    found = {}
    for name, case in CASES.items():
        plant = mixed_sensitivity(case.G, **case.weights)
        found[name] = plant, fx.design_hinf(plant)
    return found


def least_by_hand(case: Case, zero: float = ZERO) -> float:
    """Return ``|W_S(z)|``, the lower bound on gamma for a plant with that zero."""
    return float(abs(case.weights["S"].evaluated(zero)[0, 0]))


def table(found: dict[str, tuple[Any, fx.Controller]]) -> str:
    """Return gamma, its lower bound and the modulus margin of each loop, and whether it is good."""
    rows = ["plant                      gamma   lower bound   modulus margin   all bounds"]
    for name, (plant, K) in found.items():
        margin = fx.modulus_margin((plant, K))
        verdict = "met" if K.gamma < 1.0 else f"missed by at most {100 * (K.gamma - 1):.0f} %"
        rows.append(f"{name:25} {K.gamma:7.4f} {K.lower:13.4f} {margin:16.3f}   {verdict}")
    least = least_by_hand(CASES["zero at 10 rad/s"])
    rows.append(f"\nThe zero at 10 rad/s alone asks for a gamma of {least:.4f}, |W_S| at the zero.")
    return "\n".join(rows)


# %% The picture
def picture(found: dict[str, tuple[Any, fx.Controller]], folder: Path = OUT) -> Path:
    """Draw S, T and K S of each loop, and the bounds that its weights set."""
    import matplotlib.pyplot as plt

    shape = {"figsize": (4.2 * len(found), 8.0), "layout": "constrained", "sharex": "col"}
    figure, axs = plt.subplots(3, len(found), **shape)
    freq = np.geomspace(1e-5, 1e3, 1200)
    for column, (name, (plant, K)) in enumerate(found.items()):
        fx.plot.sensitivities(
            {f"gamma {K.gamma:.3f}": (plant, K)},
            weights=CASES[name].weights,
            freq=freq,
            ax=axs[:, column],
        )
        axs[0, column].set_title(name)
        axs[1, column].set_ylim(-90.0, 15.0)  # dB: below that T says nothing
    folder.mkdir(exist_ok=True)
    figure.savefig(folder / "textbook.png", dpi=90)
    plt.close("all")
    return folder / "textbook.png"


# %% Run it
if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    outcome = main()
    print(table(outcome), picture(outcome), sep="\n\npicture: ")
