"""H-infinity synthesis beside slycot's: claim, true norm of the loop, time.

Run with ``-m benchmark -s``. The peer runs in a process of its own with a time limit: it was seen
to claim less than a tenth of what its loop has, and to take minutes.
"""

import os
import pickle
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from flexplant.lti import StateSpace
from flexplant.lti.discretisation import bilinear
from flexplant.plant import reference_errors, stage_weights
from flexplant.synthesis import design_hinf
from oracles_synthesis import brute_norm, closed_loop, split, stability
from stages import reduced, sampled

DATA = Path(__file__).parents[3] / "shared" / "data" / "compleib-open.npz"
LIMIT = 30.0  # s for the peer
FULL_RANK = ("AC4", "AC8", "DIS5", "EB1", "EB2", "HE5", "JE3")

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


@pytest.mark.benchmark
@pytest.mark.skipif(not DATA.exists(), reason="COMPleib is not here")
def test_synthesis_beside_slycot(capsys):
    rows = []
    for name in (*FULL_RANK, "stage"):
        if name == "stage":
            P = stage()
            system, u, y = P.system, P.u, P.y
            g = bilinear(system, 1 / system.dt)
            parts = (g.A, g.B, g.C, g.D, len(u), len(y))
            start = time.perf_counter()
            found = design_hinf(P)
        else:
            parts = compleib(name)
            system = StateSpace(*parts[:4])
            u, y = system.inputs[-parts[4] :], system.outputs[-parts[5] :]
            start = time.perf_counter()
            found = design_hinf(system, u=u, y=y)
        seconds = time.perf_counter() - start
        K = found.system
        loop = closed_loop(
            split(system.A, system.B, system.C, system.D, len(u), len(y)), K.A, K.B, K.C, K.D
        )
        norm = judged(loop, system.dt)
        claim, peers, peer_seconds, note = peer(parts)
        shown = note or f"{claim:12.5g} {judged(peers):12.5g} {peer_seconds:7.2f}"
        rows.append(f"{name:6} {found.gamma:12.5g} {norm:12.5g} {seconds:7.2f}   {shown}")
        assert norm == pytest.approx(found.gamma, rel=1e-3)
    with capsys.disabled():
        print("\n            ours: claim         norm    time   slycot: claim       norm    time")
        print("\n".join(rows))
