"""Systems: time and agreement beside python-control, scipy and slycot.

Run with ``-m benchmark -s`` and ``OMP_NUM_THREADS=1``. Each line: ours, the peer, their ratio
(above one: ours is faster) and the largest relative difference of the answers.
"""

import time

import control
import numpy as np
import pytest
import scipy.linalg as la
import scipy.signal

from flexplant.lti import (
    balanced,
    discretized,
    frequency_response,
    h2_norm,
    hankel_values,
    hinf_norm,
    lft,
)
from systems_lti import machine

pytestmark = pytest.mark.benchmark
RATE = 1e4


def best(run, repeats=5):
    """Return the shortest time [s] of some runs, after one that warms up."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def fresh(g):
    """Return the system without what it has cached."""
    return g.replace(name="fresh")


def line(what, ours, peer, peer_name, difference):
    print(
        f"{what:<44s} {1e3 * ours:9.3f} ms   {peer_name:<28s} {1e3 * peer:9.3f} ms"
        f"   ratio {peer / ours:7.1f}   differ {difference:.1e}"
    )


def relative(found, wanted):
    return float(np.max(np.abs(found - wanted)) / np.max(np.abs(wanted)))


def per_frequency(found, wanted):
    return float(np.max(np.abs(found - wanted).max(axis=(0, 1)) / np.abs(wanted).max(axis=(0, 1))))


@pytest.mark.parametrize("kind", ["continuous", "sampled", "dense", "delayed"])
def test_frequency_response(kind, monkeypatch):
    """48 states, 8 x 8 channels, 10 000 frequencies."""
    g = machine(3, 21, m=8, p=8)
    if kind in ("sampled", "delayed"):
        g = discretized(g, RATE, delay=float(kind == "delayed"))
    g = g.replace(blocks=None) if kind == "dense" else g
    freq = np.geomspace(1.0, 4900.0, 10_000)
    twin = g.to_control()
    omega = 2 * np.pi * freq
    ours = best(lambda: frequency_response(g, freq))
    found = frequency_response(g, freq).data
    print()
    slycot_path = best(lambda: control.frequency_response(twin, omega), 2)
    wanted = control.frequency_response(twin, omega).frdata
    name = f"frequency response, {kind}, {g.n_states} states"
    line(name, ours, slycot_path, "control (slycot path)", per_frequency(found, wanted))

    def missing(*_):
        raise ImportError

    monkeypatch.setattr(control.StateSpace, "slycot_laub", missing)
    python_path = best(lambda: control.frequency_response(twin, omega), 1)
    wanted = control.frequency_response(twin, omega).frdata
    difference = per_frequency(found, wanted)
    line(name, ours, python_path, "control (python path)", difference)
    assert difference < 1e-10


def slycot_hinf(g):
    slycot = pytest.importorskip("slycot")
    n, p, m = g.n_states, *g.D.shape
    parts = (g.A.copy(), np.eye(n), g.B.copy(), g.C.copy(), g.D.copy())
    return slycot.ab13dd("D" if g.dt else "C", "I", "S", "D", n, m, p, *parts, 1e-9)[0]


@pytest.mark.parametrize("modes", [24, 100])
@pytest.mark.parametrize("zeta", [1e-2, 1e-3])
@pytest.mark.parametrize("sampled", [False, True])
def test_hinf_norm(modes, zeta, sampled):
    g = machine(0, modes, m=8, p=8, zeta=zeta)
    g = discretized(g, RATE) if sampled else g
    dense = g.replace(blocks=None)
    repeats = 5 if modes < 50 else 2
    found, wanted = hinf_norm(g), slycot_hinf(g)
    difference = abs(found / wanted - 1)
    print()
    peer = best(lambda: slycot_hinf(g), repeats)
    name = f"Hinf norm, {g.n_states} states, zeta {zeta:g}" + (", sampled" if sampled else "")
    line(name, best(lambda: hinf_norm(fresh(g)), repeats), peer, "slycot ab13dd", difference)
    ours = best(lambda: hinf_norm(fresh(dense)), repeats)
    line(f"{name}, dense", ours, peer, "slycot ab13dd", difference)
    assert difference < 1e-7


@pytest.mark.parametrize("modes", [24, 100])
def test_h2_norm(modes):
    g = machine(0, modes, m=8, p=8)
    print()

    def scipy_norm():
        P = la.solve_continuous_lyapunov(g.A, -g.B @ g.B.T)
        return np.sqrt(np.trace(g.C @ P @ g.C.T))

    found, repeats = h2_norm(g), 3
    ours = best(lambda: h2_norm(fresh(g)), repeats)
    name = f"H2 norm, {g.n_states} states"
    peer = best(scipy_norm, repeats)
    line(name, ours, peer, "scipy Lyapunov", abs(found / scipy_norm() - 1))
    twin = g.to_control()
    wanted = control.system_norm(twin, 2)
    peer = best(lambda: control.system_norm(twin, 2), repeats)
    line(name, ours, peer, "control.system_norm", abs(found / wanted - 1))


@pytest.mark.parametrize("modes", [24, 300])
def test_lft(modes):
    plant = machine(0, modes, m=4, p=4)
    plant = plant.replace(inputs=["w1", "w2", "u1", "u2"], outputs=["z1", "z2", "y1", "y2"])
    inner = machine(0, modes // 2, m=2, p=2, seed=1)
    inner = inner.replace(inputs=["y1", "y2"], outputs=["u1", "u2"], name="controller")
    a, b = plant.to_control(), inner.to_control()
    ours = best(lambda: lft(plant, inner))
    found = lft(plant, inner)
    name = f"lft, {plant.n_states} and {inner.n_states} states"
    print()
    peer = best(lambda: a.lft(b))
    line(name, ours, peer, "control lft (names lost)", relative(found.A, a.lft(b).A))
    outer = {"inputs": ["w1", "w2"], "outputs": ["z1", "z2"]}
    twin = control.interconnect([a, b], **outer)
    peer = best(lambda: control.interconnect([a, b], **outer), 2)
    line(name, ours, peer, "control.interconnect", relative(found.A, twin.A))


@pytest.mark.parametrize("modes", [24, 100])
def test_discretisation(modes):
    g = machine(0, modes, m=8, p=8)
    parts = g.A, g.B, g.C, g.D
    ours = best(lambda: discretized(g, RATE))
    found = discretized(g, RATE)
    name = f"zero-order hold, {g.n_states} states"
    print()
    peer = best(lambda: scipy.signal.cont2discrete(parts, 1 / RATE))
    line(name, ours, peer, "scipy cont2discrete", relative(
        found.A, scipy.signal.cont2discrete(parts, 1 / RATE)[0]
    ))  # fmt: skip
    twin = g.to_control()
    peer = best(lambda: control.sample_system(twin, 1 / RATE, "zoh"))
    line(name, ours, peer, "control.sample_system", relative(
        found.A, control.sample_system(twin, 1 / RATE, "zoh").A
    ))  # fmt: skip


@pytest.mark.parametrize("modes", [24, 100])
def test_hankel_and_balancing(modes):
    slycot = pytest.importorskip("slycot")
    g = machine(0, modes, m=8, p=8, zeta=1e-2)
    order = modes

    def peer():
        parts = g.A.copy(), g.B.copy(), g.C.copy()
        return slycot.ab09ad("C", "B", "S", g.n_states, 8, 8, *parts, nr=order)

    difference = relative(hankel_values(g), peer()[4])
    print()
    time_of_peer = best(peer, 2)
    ours = best(lambda: hankel_values(fresh(g)), 2)
    line(f"Hankel values, {g.n_states} states", ours, time_of_peer, "slycot ab09ad", difference)
    ours = best(lambda: balanced(fresh(g), order=order), 2)
    line(
        f"balanced with its error, {g.n_states} states",
        ours,
        time_of_peer,
        "slycot ab09ad (no error)",
        difference,
    )
