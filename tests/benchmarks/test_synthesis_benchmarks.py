"""H-infinity synthesis beside slycot's and cvxpy's: claim, true norm of the loop, time.

Run with ``-n 0 -m benchmark -s``. The peer runs in a process of its own with a time limit: it was
seen to claim less than a tenth of what its loop has, and to take minutes.
"""

import csv
import os
import pickle
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from flexplant.estimation import design_kalman
from flexplant.lti import StateSpace
from flexplant.lti.conversions import bilinear
from flexplant.plant import reference_errors, stage_weights
from flexplant.synthesis import Lmi, design_hinf, design_servo
from oracles_synthesis import brute_norm, closed_loop, split, stability
from stages import reduced, sampled
from test_synthesis.test_relaxed import flexible

DATA = Path(__file__).parents[3] / "shared" / "data" / "compleib-open.npz"
LIMIT = 10.0  # s for the peer

PEER = """
import pickle, sys, time
import control, numpy as np
A, B, C, D, nu, ny = pickle.load(sys.stdin.buffer)
start = time.perf_counter()
K, _, gamma, _ = control.hinfsyn(control.ss(A, B, C, D), ny, nu)
out = (K.A, K.B, K.C, K.D, float(gamma), time.perf_counter() - start)
sys.stdout.buffer.write(pickle.dumps(out))
"""


def compleib(name):
    with np.load(DATA) as data:
        g = {k: data[f"{name}/{k}"] for k in ("A", "B1", "B2", "C1", "C2", "D11", "D12", "D21")}
    nu, ny = g["B2"].shape[1], g["C2"].shape[0]
    return (
        g["A"],
        np.hstack([g["B1"], g["B2"]]),
        np.vstack([g["C1"], g["C2"]]),
        np.block([[g["D11"], g["D12"]], [g["D21"], np.zeros((ny, nu))]]),
        nu,
        ny,
    )


def stage():
    plant = sampled(reduced())
    weights = stage_weights(plant, 30.0)
    return plant.through(reference_errors(plant)).weighted(z=weights.z, w=weights.w)


def peer(parts):
    """(claim, loop or None, time or None, what happened) of slycot's hinfsyn."""
    try:
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", PEER],
            input=pickle.dumps(parts),
            capture_output=True,
            timeout=LIMIT,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            check=False,
        )
    except subprocess.TimeoutExpired:
        return None, None, None, f"no answer in {LIMIT:g} s"
    if done.returncode:
        return None, None, None, done.stderr.decode().strip().splitlines()[-1][:60]
    *K, claim, seconds = pickle.loads(done.stdout)
    A, B, C, D, nu, ny = parts
    return claim, closed_loop(split(A, B, C, D, nu, ny), *K), seconds, ""


def judged(loop, dt=0.0):
    return brute_norm(*loop, dt, count=150) if stability(loop[0], dt) < 0 else np.inf


def solved(system, u, y, method=None):
    """(claim, lower, true norm, seconds) of ours."""
    start = time.perf_counter()
    found = design_hinf(system, method, u=u, y=y)
    seconds = time.perf_counter() - start
    g = system if u is not None else system.system
    names = (u, y) if u is not None else (system.u, system.y)
    parts = split(g.A, g.B, g.C, g.D, *map(len, names))
    K = found.system
    norm = judged(closed_loop(parts, K.A, K.B, K.C, K.D), g.dt)
    assert norm == pytest.approx(found.gamma, rel=1e-3)
    return found.gamma, found.lower, norm, seconds


@pytest.mark.benchmark
@pytest.mark.skipif(not DATA.exists(), reason="COMPleib is not here")
def test_synthesis_beside_slycot(capsys):
    """By default, singular problems included; slycot's claim beside its norm."""
    with DATA.with_suffix(".csv").open() as file:
        best = {row["name"]: float(row["gamma"]) for row in csv.DictReader(file)}
    rows = []
    for name in (*best, "stage"):
        if name == "stage":
            P = stage()
            g = bilinear(P.system, 1 / P.system.dt)
            parts = (g.A, g.B, g.C, g.D, len(P.u), len(P.y))
            ours = solved(P, None, None)
        else:
            parts = compleib(name)
            P = StateSpace(*parts[:4])
            u, y = P.inputs[-parts[4] :], P.outputs[-parts[5] :]
            ours = solved(P, u, y)
        claim, peers, peer_seconds, note = peer(parts)
        known = f"{best[name]:10.4g}" if name in best else " " * 10
        shown = note or f"{claim:10.4g} {judged(peers):10.4g} {peer_seconds:6.2f}"
        rows.append(f"{name:6} {known} {ours[1]:10.4g} {ours[2]:10.4g} {ours[3]:6.2f}   {shown}")
    with capsys.disabled():
        print("\n             best      lower    default   time   slycot: claim       norm   time")
        print("\n".join(rows))


@pytest.mark.benchmark
def test_the_riccati_equations_beside_the_lmis(capsys):
    """Modes of 0.1 % damping: gamma, its lower bound, time; cvxpy with Clarabel up to 20 states."""
    rows = []
    for states in (12, 20, 36, 48):
        P, u, y = flexible(states // 2)
        value, lower, _, seconds = solved(P, u, y)
        row = f"{states:3} {value:11.6g} {lower:11.6g} {seconds:7.2f}"
        if states <= Lmi().max_states:
            value, lower, _, seconds = solved(P, u, y, Lmi())
            assert seconds < 10.0
            row += f"   {value:11.6g} {lower:11.6g} {seconds:7.2f}"
        rows.append(row)
    with capsys.disabled():
        print("\n  n     Riccati       lower    time   cvxpy, Clarabel   lower    time")
        print("\n".join(rows))


def cpu(call, repeats=10):
    """Return what a call gave, and its least CPU time [ms]."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        result = call()
        times.append(1e3 * (time.process_time() - start))
    return result, min(times)


@pytest.mark.benchmark
def test_a_servo(capsys):
    """The plate of 24 modes; python-control finds poles and |S| of the same loop on one grid."""
    control, model = pytest.importorskip("control"), reduced()
    plant, others = sampled(model), (sampled(model) for _ in range(10))
    observer, bandwidths = design_kalman(plant), iter(np.linspace(48.0, 52.0, 10))
    servo, again = cpu(lambda: design_servo(plant, bandwidth=50.0))
    rows = [
        ("first design on a plant", cpu(lambda: design_servo(next(others), bandwidth=50.0))[1]),
        ("the same again", again),
        ("other bandwidths", cpu(lambda: design_servo(plant, bandwidth=next(bandwidths)))[1]),
        (
            "with its observer",
            cpu(lambda: design_servo(plant, bandwidth=50.0, observer=observer))[1],
        ),
    ]
    hats = list(servo.system.inputs[1:])
    poi = plant.system.select([name for name in plant.z if "error" not in name][:3], plant.u)
    P, K = poi.to_control(), servo.system.select(inputs=hats).to_control()
    omega = 2 * np.pi * np.geomspace(1.0, 4990.0, 1000)

    def theirs():
        z = np.exp(1j * omega * plant.dt)
        L = np.moveaxis(K(z), 2, 0) @ np.moveaxis(P(z), 2, 0)
        S = np.linalg.inv(np.eye(4) - L)
        return control.feedback(P, K, sign=1).poles(), np.linalg.norm(S, 2, axis=(1, 2)).max()

    (poles, top), seconds = cpu(theirs, 2)
    assert np.abs(poles).max() == pytest.approx(servo.certificate["spectral radius"], rel=1e-6)
    assert 1 / top == pytest.approx(servo.certificate["modulus margin"], rel=1e-2)
    rows.append(("python-control: the certificate alone", seconds))
    with capsys.disabled():
        print("\nservo of the plate, ms of CPU, ratio to the same again")
        print("\n".join(f"  {name:38s} {ms:8.2f} {ms / again:7.1f}" for name, ms in rows))
