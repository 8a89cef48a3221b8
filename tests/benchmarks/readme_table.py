"""The README's table: CPU seconds of ours and of a peer for one task each, in one run.

``OMP_NUM_THREADS=1 python tests/benchmarks/readme_table.py`` prints it, in some three minutes. Both
run in turn, the least CPU time of each counts; the answers are compared before the times are.
"""

# ruff: noqa: E402 - the number of threads is set before NumPy is loaded

import os
import sys
import tempfile
import time
import warnings
from importlib.util import find_spec
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"
sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]

import control
import numpy as np
import scipy.linalg as la
import slycot
import test_identification_benchmarks as identification
import test_modes_benchmarks as large
import test_op4_benchmarks as op4
import test_response_benchmarks as responses
import test_simulation_benchmarks as simulation
import test_synthesis_benchmarks as synthesis
from pyyeti.nastran import op4 as pyyeti
from scipy.signal import cont2discrete
from test_estimation_benchmarks import observer
from test_lti_benchmarks import slycot_hinf

import flexplant as fx
from flexplant.loop.blocks import applied_law
from flexplant.lti import filter_dare
from flexplant.synthesis.robustness.uncertainty_blocks import Scalings
from flexplant.synthesis.robustness.upper import upper_level
from plates import make_plate
from systems_lti import machine

RATE = 1e4
#: most runs of each side of a race: the first ones of a quick task load code and data
QUICK = 40


def race(ours, peer, repeats=3):
    """Return both answers and the least CPU time [s] of each, run in turn; quick ones often."""
    answers, times = [None, None], [[], []]
    while len(times[0]) < repeats or (len(times[0]) < QUICK and sum(map(sum, times)) < 1.0):
        for i, run in enumerate((ours, peer)):
            begin = time.process_time()
            answers[i] = run()
            times[i].append(time.process_time() - begin)
    return (*answers, min(times[0]), min(times[1]))


def near(found, wanted, relative):
    """Raise when two answers differ by more than a share of the largest entry."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    off = float(np.max(np.abs(found - wanted)) / np.max(np.abs(wanted)))
    if not off <= relative:
        raise ArithmeticError(f"the answers differ by {off:.1e} of the largest entry")


def modes_of_a_solid():
    ours, peer = (large.measured("solid", 20, method) for method in ("ours", "default"))
    near(ours["freq"][:10], peer["freq"][:10], 1e-6)
    return (
        f"24 modes of a solid, {ours['n']:_} DOFs".replace("_", " "),
        "scipy eigsh",
        ours["modes"],
        peer["modes"],
    )


def modes_of_a_plate(method="cholmod", package="sksparse_minimal"):
    """The peer needs a package that no extra installs: without it the row has no time."""
    ours, peer = large.measured("plate", 100, "ours"), {"modes": None}
    if find_spec(package):
        peer = large.measured("plate", 100, method)
        near(ours["freq"][:10], peer["freq"][:10], 1e-6)
    what = f"24 modes of a plate, {ours['n']:_} DOFs".replace("_", " ")
    return what, f"scipy eigsh on {method.upper()}", ours["modes"], peer["modes"]


def modes_beside_pardiso():
    return modes_of_a_plate("pardiso", "pypardiso")


def modes_of_a_small_plate():
    plate = make_plate()
    M, K = plate.M.toarray(), plate.K.toarray()
    ours, peer, *times = race(
        lambda: fx.solve_modes(plate).omega, lambda: np.sqrt(np.abs(la.eigh(K, M)[0]))
    )
    near(ours[3:], peer[3:], 1e-7)
    return f"all {plate.n_dof} modes of a plate, dense", "scipy eigh", *times


def responses_of_a_plate():
    n, ours, peer, gap = responses.race()
    near(1.0 + gap, 1.0, 1e-4)  # of the peaks
    what = f"{responses.LINES} lines of a plate's responses, {n:_} DOFs".replace("_", " ")
    return what, f"scipy splu ({responses.SOLVED} of them)", ours, peer


def frequency_response():
    g, freq = machine(3, 21, m=8, p=8), np.geomspace(1.0, 4900.0, 10_000)
    twin = g.to_control()
    ours, peer, *times = race(
        lambda: fx.frequency_response(g, freq).data,
        lambda: control.frequency_response(twin, 2 * np.pi * freq).frdata,
    )
    near(ours, peer, 1e-9)
    return "8 x 8 frequency responses, 10 000 lines", "python-control, slycot", *times


def hinf_norm():
    g = machine(0, 24, m=8, p=8, zeta=1e-3)
    ours, peer, *times = race(lambda: fx.hinf_norm(g.replace(name="x")), lambda: slycot_hinf(g))
    near(ours, peer, 1e-4)
    return "H-infinity norm, 48 states, 0.1 % damping", "slycot ab13dd", *times


def dense_hinf_norm():
    g = machine(0, 24, m=8, p=8, zeta=1e-3).replace(blocks=None)
    ours, peer, *times = race(lambda: fx.hinf_norm(g.replace(name="x")), lambda: slycot_hinf(g))
    near(ours, peer, 1e-4)
    return "the same, A dense", "slycot ab13dd", *times


def h2_norm():
    g = machine(0, 100, m=8, p=8)
    twin = g.to_control()
    ours, peer, *times = race(
        lambda: fx.h2_norm(g.replace(name="x")), lambda: control.system_norm(twin, 2)
    )
    near(ours, peer, 1e-6)
    return "H2 norm, 200 states", "python-control, slycot", *times


def hold():
    g = machine(0, 24, m=8, p=8)
    parts = g.A, g.B, g.C, g.D
    ours, peer, *times = race(
        lambda: fx.lti.discretized(g, RATE).A, lambda: cont2discrete(parts, 1 / RATE)[0], 5
    )
    near(ours, peer, 1e-9)
    return "zero-order hold, 48 states", "scipy cont2discrete", *times


def riccati():
    plant = observer().plant
    g, ny = plant.system, len(plant.y)
    C = g.C[g.output_index(plant.y)]
    Q = g.B @ g.B.T
    R = np.eye(ny) * np.max(np.abs(C)) ** 2 * 1e-6
    ours, peer, *times = race(
        lambda: filter_dare(g.A, C, Q=Q, R=R).P, lambda: la.solve_discrete_are(g.A.T, C.T, Q, R)
    )
    near(ours, peer, 1e-3)
    return "a discrete Riccati equation, 48 states", "scipy solve_discrete_are", *times


def filtered():
    kalman, count, part = observer(), 100_000, 5_000
    rng, names = np.random.default_rng(0), (*kalman.sensors, *kalman.plant.u)
    data = 1e-9 * rng.standard_normal((count, len(names)))
    records, start = dict(zip(names, data.T, strict=True)), np.zeros(kalman.system.n_states)
    twin, ny = kalman.to_filterpy(), len(kalman.sensors)

    def peer():
        for row in data[:part]:
            twin.update(row[:ny])
            twin.predict(row[ny:])

    _, _, ours, theirs = race(lambda: kalman.estimate(records, start=start), peer)
    return (
        "100 000 samples through a Kalman filter",
        f"filterpy ({part} of them)",
        ours,
        theirs * count / part,
    )


def simulated():
    loop = simulation.stage_loop()
    g, count = loop.monitored, 100_000
    given = np.zeros((len(loop.plant.w), count))
    given[loop.plant.w.index("die:ref")] = 1e-6
    times, twin = g.dt * np.arange(count), g.to_control()
    options = {"duration": count * g.dt, "reference": 1e-6, "noise": False}
    ours, peer, *spent = race(
        lambda: fx.simulate(loop, **options), lambda: control.forced_response(twin, times, given), 2
    )
    shown = ours.names.index("die:z")
    near(ours.data[shown], peer.outputs[shown], 1e-8)
    return f"100 000 samples of a loop, {g.n_states} states", "python-control", *spent


def noisy():
    """The same with the noises of amplifiers and sensors; rms values are compared."""
    loop, count = simulation.stage_loop(), 100_000
    ours, peer, *spent = race(
        lambda: fx.simulate(loop, duration=count * loop.monitored.dt, rng=1),
        simulation.noisy_peer(loop, count),
    )
    near(ours.rms("die:z"), np.std(peer.outputs[ours.names.index("die:z")]), 0.1)
    return "the same with its white noises", "python-control", *spent


def saturated():
    """The same with commands that saturate; the peer's equations as short as they can be."""
    loop = simulation.stage_loop()
    plant, count, part, limit = loop.plant, 100_000, 2_000, 0.02
    law = applied_law(loop, None)[0]  # its observer reads what is applied
    g, n, m = plant.system, plant.system.n_states, law.n_states
    rows, w, u = g.output_index(plant.y), g.input_index(plant.w), g.input_index(loop.driven)
    A, Bw, Bu, C, D = g.A, g.B[:, w], g.B[:, u], g.C[rows], g.D[np.ix_(rows, w)]
    ny, nu = len(plant.y), len(loop.driven)
    F, L = law.C[:nu], law.D[:nu, :ny]

    def following(t, x, w, _):
        y = C @ x[:n] + D @ w
        u = np.clip(F @ x[n:] + L @ y, -limit, limit)
        return np.concatenate([A @ x[:n] + Bw @ w + Bu @ u, law.A @ x[n:] + law.B @ [*y, *u]])

    def seen(t, x, w, _):
        return C @ x[:n] + D @ w

    sizes = {"inputs": len(plant.w), "outputs": len(plant.y), "states": n + m, "dt": g.dt}
    twin = control.NonlinearIOSystem(following, seen, **sizes)
    given = np.zeros((len(plant.w), part))
    given[plant.w.index("die:ref")] = 1e-6
    options = {"duration": count * g.dt, "reference": 1e-6, "noise": False}
    options["elements"] = {name: fx.simulation.Saturation(limit) for name in loop.driven}
    ours, peer, mine, theirs = race(
        lambda: fx.simulate(loop, **options),
        lambda: control.input_output_response(twin, g.dt * np.arange(part), given, np.zeros(n + m)),
        1,
    )
    assert abs(ours["u1"]).max() == limit
    near(ours["y1"][:part], peer.outputs[plant.y.index("y1")], 1e-8)
    return (
        "the loop with saturated commands",
        f"python-control ({part} of them)",
        mine,
        theirs * count / part,
    )


def designed_small():
    plant = fx.plant.mixed_sensitivity(
        fx.lti.tf([1.0], [1.0, 0.02, 1.0]), S=fx.lti.low_pass_filter(0.02), KS=0.1
    )
    g = plant.system
    twin, sizes = control.ss(g.A, g.B, g.C, g.D), (len(plant.y), len(plant.u))
    ours, peer, *times = race(
        lambda: fx.design_hinf(plant).gamma, lambda: control.hinfsyn(twin, *sizes)[2]
    )
    near(ours, peer, 0.1)
    what = f"H-infinity, {g.n_states} states: norm {ours:.3g}"
    return what, f"python-control, slycot: {peer:.3g}", *times


def designed():
    """Both norms are those of the loops, not the claims."""
    plant = synthesis.stage()
    g = synthesis.bilinear(plant.system, 1 / plant.system.dt)
    parts = (g.A, g.B, g.C, g.D, len(plant.u), len(plant.y))
    begin = time.process_time()
    ours = fx.design_hinf(plant)
    seconds = time.process_time() - begin
    claim, loop, taken, note = synthesis.peer(parts)
    norm = np.nan if loop is None else synthesis.judged(loop)
    peer = f"slycot: {note}" if note else f"slycot: claims {claim:.3g}, has {norm:.3g}"
    return (
        f"H-infinity, {g.n_states} states of a stage: norm {ours.gamma:.3g}",
        peer,
        seconds,
        taken,
    )


def mu_bounds():
    return "mu of 12 complex scalars, both bounds", *_beside_ab13md(
        lambda *given: fx.synthesis.mu(*given).upper
    )


def mu_from_above():
    """By the function behind `mu`, which always adds the lower bound."""
    found = _beside_ab13md(lambda M, blocks: upper_level(M, Scalings(blocks)).level ** 0.5)
    return "the upper bound alone", *found


def _beside_ab13md(upper):
    rng = np.random.default_rng(1)
    M = rng.standard_normal((12, 12)) + 1j * rng.standard_normal((12, 12))
    blocks = [fx.synthesis.RepeatedScalar(1, real=False)] * 12
    ours, peer, *times = race(
        lambda: upper(M, blocks),
        lambda: slycot.ab13md(M.copy(), np.ones(12, int), np.full(12, 2))[0],
    )
    near(ours, peer, 2e-2)
    return "slycot ab13md, the upper one", *times


def identified():
    H, deviation = identification.responses(1e-3)
    methods = (identification.of_flexplant, identification.of_vector_fitting)
    ours, peer, *times = race(*(lambda m=m: m(H, deviation) for m in methods), 1)
    worst = [identification.errors(poles)[0].max() for poles in (ours, peer)]
    return (
        f"poles of a close pair in noise: error {worst[0]:.0e}",
        f"scikit-rf: {worst[1]:.0e}",
        *times,
    )


def read():
    matrix = op4.stiffness_like(3000)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.op4"
        pyyeti.write(path, {"KAA": matrix}, binary=True, sparse="bigmat")
        ours, peer, *times = race(
            lambda: fx.io.read_op4_matrices(path)["KAA"], lambda: pyyeti.read(path)["kaa"]
        )
    near(ours.toarray(), peer.toarray() if hasattr(peer, "toarray") else peer, 0.0)
    return "a sparse OUTPUT4 file of Nastran", "pyYeti", *times


ROWS = (
    modes_of_a_solid,
    modes_of_a_plate,
    modes_beside_pardiso,
    modes_of_a_small_plate,
    responses_of_a_plate,
    frequency_response,
    hinf_norm,
    dense_hinf_norm,
    h2_norm,
    hold,
    riccati,
    filtered,
    simulated,
    noisy,
    saturated,
    designed_small,
    designed,
    mu_bounds,
    mu_from_above,
    identified,
    read,
)


def shown(seconds):
    """Return a time in s or ms with two digits, or a dash."""
    if seconds is None:
        return "-"
    size, unit = (seconds, "s") if seconds >= 0.1 else (1e3 * seconds, "ms")
    return f"{float(f'{size:.2g}'):g} {unit}"


def row(task):
    """Return one line of the table."""
    with warnings.catch_warnings(action="ignore"):
        what, peer, ours, theirs = task()
    ratio = "-" if theirs is None else f"{float(f'{theirs / ours:.2g}'):g}"
    return f"| {what} | {shown(ours)} | {peer} | {shown(theirs)} | {ratio} |"


if __name__ == "__main__":
    print("| task | flexplant | peer | its time | ratio |")
    print("|---|---|---|---|---|")
    for task in ROWS:
        print(row(task), flush=True)
