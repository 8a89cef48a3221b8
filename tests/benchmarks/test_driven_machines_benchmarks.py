"""The plain call of each verb on eight kinds of driven machines that are drawn at random.

``python -m pytest tests/benchmarks/test_driven_machines_benchmarks.py -n 0 -m benchmark -s`` prints
a table of kinds and verbs for each seed, in some ten minutes of CPU; ``-k [3]`` another draw.
The machines are those of `driven_kinds`, whose topologies and data `fx.testbeds` does not have. The
judge uses the matrices alone: a loop is stable with a modulus margin of 0.4 at u (all together or
one loop at a time), |S| of its references is at most 1.3 at a quarter of the bandwidth and 0.3 at a
twentieth; a feedforward has |P F - 1| of at most 0.1 up to a quarter of the bandwidth and makes the
peak error of a move five times smaller.
"""

import warnings

import numpy as np
import pytest

import flexplant as fx
from driven_kinds import KINDS
from flexplant.errors import FlexplantError, FlexplantWarning
from judge import inverse_error, judged

pytestmark = pytest.mark.benchmark

#: references of a kind on which the error of a move is judged: moves of all axes are alike
MOVED = 2


class Calls:
    """The plain calls on one plant; what one of them makes, a later one takes."""

    def __init__(self, plant):
        self.plant = plant
        self.references = [name for name in plant.w if name.endswith(":ref")]
        self.sensors = [one.name for one in plant.assembled.ports.y]
        self.reach, self.observer, self.servo = None, None, None

    def asked(self, bandwidth):
        return bandwidth if self.references else None

    def check(self):
        self.plant.check().require(("stabilisable", "detectable"), "a controller")
        return True

    def design_kalman(self):
        self.observer = fx.design_kalman(self.plant)
        return np.abs(np.linalg.eigvals(self.observer.system.A)).max() < 1.0

    def servo_bandwidth(self):
        self.reach = fx.servo_bandwidth(self.plant, observer=self.observer)
        self.servo = self._servo(self.reach)
        return judged(self.plant, self.observer, self.servo).serves(self.asked(self.reach))

    def design_servo(self):
        less = 0.6 * self.reach
        found = judged(self.plant, self.observer, self._servo(less))
        return found.serves(self.asked(less))

    def _servo(self, bandwidth):
        return fx.design_servo(self.plant, bandwidth=bandwidth, observer=self.observer)

    def design_hinf(self):
        asked = 0.5 * self.reach
        weights = fx.stage_weights(self.plant, asked)
        if not self.references:
            return judged(self.plant, fx.design_hinf(self.plant.weighted(weights))).serves()
        errors = fx.reference_errors(self.plant)
        law = fx.design_hinf(self.plant.through(errors).weighted(weights))
        return judged(self.plant, errors, law).serves(asked)

    def tune_loops(self):
        return judged(self.plant, fx.tune_loops(self.plant, progress=False)).serves()

    def design_stage(self):
        return judged(self.plant, fx.design_stage(self.plant, progress=False)).serves()

    def design_feedforward(self):
        plant, freq = self.plant, np.geomspace(0.01, 0.25, 60) * self.reach
        inverses = [fx.design_feedforward(plant, reference=name) for name in self.references]
        if not all(inverse_error(plant, one, freq) <= 0.1 for one in inverses):
            return False
        loop = fx.close_loop(plant, self.observer, self.servo)
        far, fast = 1e-3, self.reach
        move = fx.setpoint(
            far,
            velocity=0.5 * far * fast,
            acceleration=far * fast**2,
            jerk=5 * far * fast**3,
            snap=40 * far * fast**4,
            rate=1.0 / plant.dt,
        )
        for name in self.references[:MOVED]:
            forward = fx.design_feedforward(loop, reference=name)
            fed = fx.close_loop(plant, self.observer, self.servo, forward)
            without, left = (
                fx.simulate(
                    one, reference={name: move}, duration=move.duration + 4.0 / fast, noise=False
                ).peak(name.replace(":ref", ":error"))
                for one in (loop, fed)
            )
            if left > 0.2 * without:
                return False
        return True

    def place_sensors(self):
        found = fx.place_sensors(self.plant, self.sensors, len(self.sensors))
        return set(found.chosen) == set(self.sensors)

    def simulate(self):
        loop = fx.close_loop(self.plant, self.observer, self.servo)
        goal = dict.fromkeys(self.references[:1], 1e-4)
        run = fx.simulate(loop, reference=goal, duration=40.0 / self.reach, noise=False)
        channel = self.references[0].replace(":ref", ":error") if goal else self.plant.z[0]
        return np.abs(run[channel][-20:]).max() < 2e-5


VERBS = (
    "check",
    "design_kalman",
    "servo_bandwidth",
    "design_servo",
    "design_hinf",
    "tune_loops",
    "design_stage",
    "design_feedforward",
    "place_sensors",
    "simulate",
)


def served(plant):
    """Return of each verb whether its plain call serves, None where it does not apply, or why."""
    calls, found = Calls(plant), {}
    for verb in VERBS:
        if verb == "design_feedforward" and not calls.references:
            found[verb] = None
            continue
        try:
            found[verb] = bool(getattr(calls, verb)())
        except (FlexplantError, TypeError) as error:  # TypeError: an earlier call gave nothing
            found[verb] = f"{type(error).__name__}: {str(error)[:150]}"
    return found


@pytest.mark.parametrize("seed", [1001, 1002])
def test_plain_calls_on_machines_drawn(seed):
    table = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        for number, (kind, drawn) in enumerate(KINDS.items()):
            table[kind] = served(drawn(np.random.default_rng([seed, number])))
            marks = (
                "-" if one is None else "x" if one is True else "NO" for one in table[kind].values()
            )
            print(f"\n{kind:12s}" + " ".join(f"{mark:>4s}" for mark in marks), end="")
            for verb, one in table[kind].items():
                if isinstance(one, str):
                    print(f"\n    {verb}: {one}", end="")
    results = [one for row in table.values() for one in row.values() if one is not None]
    print(f"\n{results.count(True)} of {len(results)}")
    assert len(results) == 79
    assert results.count(True) >= 76
