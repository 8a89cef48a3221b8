"""Responses of a full model between its ports, beside a direct sparse solution at each frequency.

Run with ``-n 0 -m benchmark -s`` and ``OMP_NUM_THREADS=1``. Ours is all of `frequency_response`:
the modes, the static shapes and the direct solutions that check them. The peer is SciPy's SuperLU
of ``K (1 + i eta) - omega^2 M``; it solves some of the lines, whose time is counted for all.
"""

import time

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla

import flexplant as fx
from plates import make_plate

pytestmark = pytest.mark.benchmark
BETA, LINES, SOLVED = 1e-6, 200, 4  # s, lines, lines of the peer


def race():
    """Return how many DOFs, the CPU time [s] of ours and of the peer, and how far they differ."""
    plate = make_plate(elements=(99, 99))
    at = ["1:z", "5050:z"]
    ports = fx.Ports(
        u=[fx.Actuator("u", at[0])], y=[fx.Sensor(f"y{i}", place) for i, place in enumerate(at)]
    )
    freq = np.geomspace(30.0, 1500.0, LINES)
    begin = time.process_time()
    found = fx.frequency_response(plate, ports, freq, damping=fx.structure.Rayleigh(0.0, BETA))
    ours = time.process_time() - begin
    out = np.array([plate.row(place) for place in at])
    some = np.linspace(0, LINES - 1, SOLVED).astype(int)
    begin = time.process_time()
    wanted = []
    for f in freq[some]:
        omega = 2 * np.pi * f
        dynamic = sp.csc_matrix(plate.K * (1 + 1j * omega * BETA) - omega**2 * plate.M)
        wanted.append(out @ spla.splu(dynamic).solve(out[0].astype(complex)))
    peer = (time.process_time() - begin) * LINES / SOLVED
    gap = np.abs(found.data[:, 0, some].T - wanted).max(axis=0) / np.abs(found.data[:, 0]).max(
        axis=1
    )
    return plate.n_dof, ours, peer, float(gap.max())


def test_two_hundred_lines():
    n, ours, peer, gap = race()
    print(
        f"\n{LINES} lines of {n} DOFs: {ours:.1f} s, SuperLU {peer:.1f} s ({SOLVED} lines solved), "
        f"ratio {peer / ours:.1f}, differ {gap:.1e} of the peak"
    )
    assert gap < 1e-4
    assert ours < peer
