"""Fixed order beside published optima; loop shaping and H2 beside python-control with slycot.

Run with ``-n 0 -m benchmark -s``. Norms are of the loop, by a sweep of dense matrices.
"""

import pickle
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg as la

from flexplant.lti import StateSpace
from flexplant.synthesis import FixedOrder, design_h2, design_hinf, design_ncf, design_structured
from oracles_synthesis import brute_norm, cart_pole, closed_loop, coprime_problem, split, stability
from oracles_synthesis import chain as oracle_chain

DATA = Path(__file__).parents[3] / "shared" / "data" / "compleib-open.npz"
#: static output feedback: Apkarian, Noll, Nonsmooth H-infinity synthesis, 2006; HIFOO, 2006
PUBLISHED = {
    "HE1": 0.1538, "AC8": 2.005, "REA2": 1.149, "AC4": 0.9355, "CM1": 0.8165, "AC2": 0.1115,
    "AC15": 15.2074, "DIS1": 4.1716, "DIS2": 1.0548, "HE2": 4.2492, "HE5": 8.8952, "NN2": 2.2216,
    "NN4": 1.3627, "NN8": 2.8871, "TG1": 12.8462, "AGS": 8.1732, "BDT1": 0.2664, "CSE1": 0.0201,
}  # fmt: skip


def compleib(name):
    with np.load(DATA) as data:
        g = {k: data[f"{name}/{k}"] for k in ("A", "B1", "B2", "C1", "C2", "D11", "D12", "D21")}
    nu, ny = g["B2"].shape[1], g["C2"].shape[0]
    P = StateSpace(
        g["A"],
        np.hstack([g["B1"], g["B2"]]),
        np.vstack([g["C1"], g["C2"]]),
        np.block([[g["D11"], g["D12"]], [g["D21"], np.zeros((ny, nu))]]),
    )
    return P, P.inputs[-nu:], P.outputs[-ny:]


def true_norm(P, K, nu, ny):
    loop = closed_loop(split(P.A, P.B, P.C, P.D, nu, ny), K.A, K.B, K.C, K.D)
    return brute_norm(*loop, P.dt) if stability(loop[0], P.dt) < 0 else np.inf


@pytest.mark.benchmark
@pytest.mark.skipif(not DATA.exists(), reason="COMPleib is not here")
def test_static_output_feedback_beside_published_values(capsys):
    """Within 0.5 % of what was published; the full order beside it shows what structure costs."""
    rows = []
    for name, best in PUBLISHED.items():
        P, u, y = compleib(name)
        start = time.process_time()
        found = design_structured(P, FixedOrder(0), u=u, y=y)
        seconds = time.process_time() - start
        norm = true_norm(P, found.system, len(u), len(y))
        full = design_hinf(P, u=u, y=y).gamma
        assert found.gamma <= 1.005 * best
        assert norm == pytest.approx(found.gamma, rel=2e-3)
        left = found.certificate["decrease left"]
        rows.append(
            f"{name:6s} {best:10.4g} {found.gamma:10.5g} {norm:10.5g} {left:9.1e} {seconds:6.2f} "
            f"{full:10.4g}"
        )
    with capsys.disabled():
        print("\nstatic    published       ours  true norm  decrease   [s]  full order")
        print("\n".join(rows))


PEER = """
import pickle, sys, time
import control
name, A, B, C, D, nu, ny = pickle.load(sys.stdin.buffer)
start = time.perf_counter()
K = getattr(control, name)(control.ss(A, B, C, D), ny, nu)
K = K[0] if isinstance(K, tuple) else K
out = (K.A, K.B, K.C, K.D, time.perf_counter() - start)
sys.stdout.buffer.write(pickle.dumps(out))
"""


def peer(name, P, nu, ny):
    """(controller or None, seconds, what happened) of python-control with slycot."""
    given = pickle.dumps((name, P.A, P.B, P.C, P.D, nu, ny))
    command = [sys.executable, "-W", "ignore", "-c", PEER]
    try:
        done = subprocess.run(command, input=given, capture_output=True, timeout=20, check=False)
    except subprocess.TimeoutExpired:
        return None, np.nan, "no answer in 20 s"
    if done.returncode:
        return None, np.nan, done.stderr.decode().strip().splitlines()[-1][:60]
    *K, seconds = pickle.loads(done.stdout)
    return StateSpace(*K), seconds, ""


def h2(P, K, nu, ny):
    A, B, C, _ = closed_loop(split(P.A, P.B, P.C, P.D, nu, ny), K.A, K.B, K.C, K.D)
    if stability(A, 0.0) >= 0:
        return np.inf
    return np.sqrt(np.trace(C @ la.solve_continuous_lyapunov(A, -B @ B.T) @ C.T))


def light():
    """2 kg with modes at 300 and 900 Hz of 0.1 %, shaped for 50 Hz: SI units."""
    parts = [np.array([[0.0, 1], [0, 0]])]
    for freq in (300.0, 900.0):
        w = 2 * np.pi * freq
        parts.append(np.array([[0.0, 1], [-(w**2), -2e-3 * w]]))
    return StateSpace(
        la.block_diag(*parts),
        np.array([[0, 0.5, 0, 0.5, 0, 0.5]]).T,
        [[1, 0, -0.3, 0, 0.2, 0]],
        [[0]],
    )


@pytest.mark.benchmark
def test_loop_shaping_beside_hinfsyn(capsys):
    """The same coprime-factor problem given to the peer's H-infinity synthesis."""
    chain, cart = coprime_problem(*oracle_chain()), coprime_problem(*cart_pole())
    cases = {"chain": (oracle_chain(), chain), "cart and pole": (cart_pole(), cart)}
    rows = []
    for name, ((A, B, C), (parts, best)) in cases.items():
        nu, ny = B.shape[1], C.shape[0]
        P = StateSpace(*parts)
        G = StateSpace(A, B, C, np.zeros((ny, nu)))
        start = time.perf_counter()
        ours = design_ncf(G, back_off=1e-2)
        seconds = time.perf_counter() - start
        norm = true_norm(P, ours.system, nu, ny)
        K, theirs, note = peer("hinfsyn", P, nu, ny)
        shown = note or f"{true_norm(P, K, nu, ny):10.4g} {theirs:6.2f}"
        assert norm <= 1.02 * best
        rows.append(f"{name:14s} {best:10.4g} {norm:10.4g} {seconds:6.2f}   {shown}")
    with capsys.disabled():
        print("\nloop shaping      least       ours    [s]   hinfsyn    [s]")
        print("\n".join(rows))


@pytest.mark.benchmark
@pytest.mark.skipif(not DATA.exists(), reason="COMPleib is not here")
def test_h2_beside_h2syn(capsys):
    """The H2 norm that each controller truly reaches, by SciPy's Lyapunov equation."""
    rows = []
    for name in ("AC2", "AC15", "HE1", "DIS1", "NN2", "AGS", "BDT1"):
        P, u, y = compleib(name)
        nu, ny = len(u), len(y)
        if np.any(P.D[:-ny, :-nu]):
            continue
        start = time.perf_counter()
        ours = design_h2(P, u=u, y=y)
        seconds = time.perf_counter() - start
        norm = h2(P, ours.system, nu, ny)
        assert norm == pytest.approx(ours.gamma, rel=1e-4)
        K, theirs, note = peer("h2syn", P, nu, ny)
        shown = note or f"{h2(P, K, nu, ny):10.5g} {theirs:6.2f}"
        rows.append(f"{name:6s} {norm:10.5g} {seconds:6.2f}   {shown}")
    with capsys.disabled():
        print("\nH2           ours    [s]     h2syn    [s]")
        print("\n".join(rows))
