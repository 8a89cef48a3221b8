"""What is promised of machines that nobody has seen: errors at the die, and loops that hold.

``python -m pytest tests/benchmarks/test_unseen_machines_benchmarks.py -n 0 -m benchmark -s`` prints
the tables, in some 30 minutes of CPU; ``-k errors`` the first ones, in four. Each machine is a
plate in polynomials with rotary inertia, 0.1 to 1 kg at a place that is known, up to 0.1 kg
somewhere, scattered stiffness and damping; drawing, mesh and measurement are those of
`test_robustness_benchmarks`. Errors on the machine are exact (a Lyapunov equation), without the
steps of its sensors. How many of a fleet hold at 0.2 %: ``python examples/fleet.py 50``.
"""

import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np
import pytest
from test_robustness_benchmarks import CASES, RATE, models, ports

import flexplant as fx
from flexplant.estimation.error import error_variances

pytestmark = pytest.mark.benchmark

SIZE, THICKNESS, ELEMENTS, FORCES = CASES["the paper's plate"]
AXES = ("die:z", "die:rx", "die:ry")
FIRST = 4001
WANTED = 60.0  # Hz, of the controllers that tolerate what is not known


def plants(zeta, seed):
    """One machine, its ports, the plant of its calibrated model, and what is not known."""
    mass = np.random.default_rng(seed).uniform(0.1, 1.0)
    machine = fx.testbeds.wafer_stage(damping=zeta, individual=seed, added_mass=mass, rate=RATE)
    own = ports(SIZE, FORCES)
    model, whole, off = models(machine, SIZE, THICKNESS, ELEMENTS, seed, zeta)
    plant = fx.assemble_plant(model, own, evaluation=whole)
    return machine, own, plant.discretized(RATE, delay=machine.delay), off


def estimated(zeta, seed):
    """Promised and true errors (2, 3) of the estimate at the die, u at rest."""
    with warnings.catch_warnings(action="ignore"):
        machine, own, plant, _ = plants(zeta, seed)
        kalman = fx.design_kalman(plant)
    true = fx.assemble_plant(machine.truth, own).discretized(RATE, delay=machine.delay)
    return np.sqrt([kalman.variances, error_variances(true, kalman.system).values])


def controlled(zeta, seed):
    """Modulus margins (2, 2) of two loops, promised and on the machine; 0 where unstable."""
    margins = []
    with warnings.catch_warnings(action="ignore"):
        machine, own, plant, off = plants(zeta, seed)
        static = fx.design_static(plant)
        servo = fx.design_servo(plant, bandwidth=40.0, observer=static)
        tolerant = fx.design_stage(plant.uncertain(frequency=off), bandwidth=WANTED)
        for blocks in ((static, servo), (tolerant,)):
            promised = fx.close_loop(plant, *blocks)
            both = promised if not promised.is_stable else promised.completed
            pair = both, machine.loop(own, *blocks)
            margins.append([one.modulus_margin if one.is_stable else 0.0 for one in pair])
    return np.array(margins)


def over_machines(judge, zeta, count):
    with ProcessPoolExecutor(2) as pool:
        return np.array(list(pool.map(partial(judge, zeta), range(FIRST, FIRST + count))))


@pytest.mark.parametrize("zeta", [0.001, 0.01])
def test_promised_errors_at_the_die(zeta):
    """Measured at 0.1 %: within 5 % on 67, 60, 60 % (z, rx, ry), within 10 % on 97, 87, 100 %."""
    errors = over_machines(estimated, zeta, 30)
    off = errors[:, 0] / errors[:, 1] - 1.0
    print(f"\n30 machines, {zeta:.1%} damping, promised / true error of the estimate - 1:")
    print("             mean  within 5 %  10 %   worst")
    for axis, part in zip(AXES, off.T, strict=True):
        size = np.abs(part)
        near, wide = np.mean(size < 0.05), np.mean(size < 0.1)
        print(f"  {axis:8s}{part.mean():+7.1%}{near:9.0%}{wide:9.0%}{size.max():8.1%}")
    assert np.all(np.abs(off.mean(axis=0)) < 0.06)
    assert np.mean(np.abs(off) < 0.1) > 0.85


@pytest.mark.parametrize("zeta", [0.001, 0.002])
def test_loops_that_are_called_stable(zeta):
    """Of each kind of loop, how many are called stable, and how many of these are.

    Measured, 35 minutes beside other work: all 200 loops are called stable and are. Least margins,
    promised and there: servo 0.531 and 0.536 at 0.1 %, 0.617 and 0.616 at 0.2 %; tolerant 0.439
    and 0.436, 0.441 and 0.438.
    """
    margins = over_machines(controlled, zeta, 50)
    print(f"\n50 machines, {zeta:.1%} damping: loops called stable, of these stable there,")
    print("least modulus margin promised, least there")
    for name, part in zip(("servo", "tolerant"), margins.swapaxes(0, 1), strict=True):
        part = part[part[:, 0] > 0.0]
        held = np.sum(part[:, 1] > 0.0)
        promised, found = part.min(axis=0)
        print(f"  {name:9s}{len(part):4d}{held:4d}   {promised:.3f}  {found:.3f}")
    called = margins[..., 0] > 0.0
    assert called.mean() > 0.9
    assert np.all(margins[..., 1][called] > 0.0)
