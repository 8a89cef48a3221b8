"""How far it goes: many items, many samples, many candidates, many states.

Run with ``-n 0 -m benchmark -s``. Asserted is that answers hold; seconds and bytes are printed.
"""

import shutil
import subprocess
import time

import numpy as np
import pytest
from test_placement_benchmarks import stage

import flexplant as fx
from flexplant.export import write_c
from flexplant.placement import BranchAndBound
from oracles_lti import periodic_answer
from stages import RATE, L, ports, some_modes

COMPILER = shutil.which("cc") or shutil.which("gcc")


def timed(name, work):
    begin = time.process_time()
    found = work()
    print(f"\n{name}: {time.process_time() - begin:.1f} s of CPU\n{found!r}")
    return found


def machine(seed):
    """Return a row of a machine: an observer, a servo, a loop, a run; and the process's memory."""
    plant = fx.testbeds.three_masses()
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=10.0 + seed % 100 / 10, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    run = fx.simulate(loop, duration=0.1, rng=seed)
    with open("/proc/self/statm") as file:
        pages = int(file.read().split()[1])
    return {"margin": loop.modulus_margin, "rms": run.rms("die:hat"), "MB": pages * 4096 / 1e6}


@pytest.mark.benchmark
def test_ten_thousand_machines_in_flat_memory():
    table = timed("10 000 machines", lambda: fx.study(range(10_000), machine))
    used = table["MB"]
    print(
        f"  resident: {used[100]:.1f} MB at 100, {used[1000]:.1f} at 1000, {used[-1]:.1f} at last"
    )
    assert not any(table["failed"])
    assert used[-1] - used[1000] < 20.0  # rows take 0.5 kB each


DAY = """
#include <stdio.h>
#include <string.h>
#include "law.h"
static const double table[{period}][{m}] = {{{rows}}};
int main(void)
{{
    static law_t self, before;
    {real} in[{m}], out[{p}];
    long k;
    int i;
    law_reset(&self);
    for (k = 0; k < {samples}L; ++k) {{
        if (k == {samples}L - {period}) before = self;
        for (i = 0; i < {m}; ++i) in[i] = ({real})table[k % {period}][i];
        law_step(&self, in, out);
    }}
    printf("%d\\n", memcmp(&self, &before, sizeof self));
    for (i = 0; i < {p}; ++i) printf("%.17g\\n", (double)out[i]);
    return 0;
}}
"""


@pytest.mark.benchmark
@pytest.mark.skipif(COMPILER is None, reason="no C compiler")
@pytest.mark.parametrize("single", [False, True])
def test_a_hundred_million_samples_in_c_do_not_drift(single, tmp_path):
    """Beside the periodic answer of linear algebra; the state is what it was a period before."""
    plant = fx.assemble_plant(some_modes(count=24, attached=False), ports())
    law = fx.design_kalman(plant.discretized(RATE, delay=1)).system
    period, samples = 1000, 10**8
    records = np.random.default_rng(0).standard_normal((period, len(law.inputs)))
    records *= [1e-6 if name.startswith("y") else 1.0 for name in law.inputs]
    write_c(law, tmp_path / "law.c", single=single)
    rows = ",".join("{" + ",".join(f"{v:.17g}" for v in row) + "}" for row in records)
    sizes = {"m": len(law.inputs), "p": len(law.outputs), "period": period, "samples": samples}
    text = DAY.format(rows=rows, real="float" if single else "double", **sizes)
    (tmp_path / "main.c").write_text(text)
    command = [COMPILER, "-O2", "-std=c99", "law.c", "main.c", "-o", "run"]
    subprocess.run(command, cwd=tmp_path, check=True)
    begin = time.perf_counter()
    said = subprocess.run(["./run"], cwd=tmp_path, check=True, capture_output=True, text=True)
    different, *out = map(float, said.stdout.split())
    exact = periodic_answer(law, records)
    error = np.max(np.abs(out - exact[-1]) / np.abs(exact).max(axis=0))
    spent = time.perf_counter() - begin
    print(f"\n{samples:.0e} samples of {law.n_states} states: {spent:.0f} s, error {error:.1g}")
    assert not different
    assert error < (1e-5 if single else 1e-11)


@pytest.mark.benchmark
def test_a_thousand_candidates_with_a_bound():
    plant, sensors, _ = stage(side=32)
    method = BranchAndBound(gap=0.1)
    goal = fx.PoiVariance("die")
    found = timed(
        f"four of {len(sensors)} sensors",
        lambda: fx.place_sensors(plant, sensors, 4, goal, method=method, rng=0),
    )
    assert found.bound <= found.value and found.gap <= 0.02


@pytest.mark.benchmark
def test_a_kalman_filter_of_a_thousand_states():
    """Dense, by doubling: time grows with the third power of the states, memory with the second."""
    plate = fx.kirchhoff_plate(
        size=(L, L), thickness=0.0272, elements=(16, 16), density=2702,
        youngs_modulus=70e9, poisson_ratio=0.35,
    )  # fmt: skip
    for count in (100, 248, 498):
        modes = fx.solve_modes(plate, count=count, damping=fx.ModalDamping(0.01))
        plant = fx.assemble_plant(modes, ports(references=[])).discretized(RATE, delay=1)
        observer = timed(f"{plant.system.n_states} states", lambda p=plant: fx.design_kalman(p))
    assert observer.system.n_states == 1000


@pytest.mark.benchmark
@pytest.mark.parametrize("elastic", [10, 40])
def test_six_axes_and_forty_modes_by_hinf(elastic):
    at = {
        f"{axis}{i}": ((x, y, z), axis)
        for axis, points in (
            ("z", [(0.0, 0.0, 0.05), (0.4, 0.0, 0.05), (0.0, 0.3, 0.05), (0.4, 0.3, 0.05)]),
            ("x", [(0.4, 0.05, 0.025), (0.4, 0.25, 0.025)]),
            ("y", [(0.1, 0.0, 0.025), (0.3, 0.0, 0.025)]),
        )
        for i, (x, y, z) in enumerate(points)
    }
    block = fx.solid_block(
        size=(0.4, 0.3, 0.05), elements=(8, 6, 2), density=2700,
        youngs_modulus=70e9, poisson_ratio=0.33,
    )  # fmt: skip
    modes = fx.solve_modes(block, count=6 + elastic, damping=fx.ModalDamping(0.005))
    own = fx.Ports(
        w=[fx.Disturbance(f"d{n}", p, direction=axis, asd=1e-4) for n, (p, axis) in at.items()],
        u=[fx.Actuator(f"u{n}", p, direction=axis) for n, (p, axis) in at.items()],
        z=[fx.Poi("die", at=(0.2, 0.15, 0.05), axes=("x", "y", "z", "rx", "ry", "rz"))],
        y=[fx.Sensor(f"y{n}", p, direction=axis, asd=1e-11) for n, (p, axis) in at.items()],
        references=[fx.Reference("die")],
    )
    plant = fx.assemble_plant(modes, own)
    weights = fx.stage_weights(plant, 30.0)
    weighted = plant.through(fx.reference_errors(plant)).weighted(z=weights.z, w=weights.w)
    found = timed(
        f"H-infinity of {weighted.system.n_states} states, {len(weighted.u)} actuators",
        lambda: fx.design_hinf(weighted, fx.Riccati()),
    )
    assert found.certificate["norm"] <= found.gamma * (1.0 + 1e-6) < 1.0
    assert found.gamma <= 1.02 * found.lower
