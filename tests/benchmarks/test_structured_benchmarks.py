"""Fixed-order H-infinity beside published optima; loop shaping beside python-control and slycot.

Run with ``-m benchmark -s``. Norms are of the loop, by a sweep of dense matrices.
"""

import time
from pathlib import Path

import numpy as np
import pytest

from flexplant.lti import StateSpace
from flexplant.synthesis import FixedOrder, design_hinf, design_structured
from oracles_synthesis import brute_norm, closed_loop, split, stability

DATA = Path(__file__).parents[3] / "shared" / "data" / "compleib-open.npz"
#: static output feedback: Apkarian, Noll, Nonsmooth H-infinity synthesis, 2006; HIFOO, 2006
PUBLISHED = {"HE1": 0.1538, "AC8": 2.005, "REA2": 1.149, "AC4": 0.9355, "CM1": 0.8165}


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
