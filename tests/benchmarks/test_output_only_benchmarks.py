"""Modes of a mast from its own motion: twelve, in near pairs; ``-n 0 -m benchmark -s``."""

import time

import numpy as np
import pytest
import scipy.linalg as la
import scipy.signal as ss

from flexplant.identification import identify_output_only
from oracles_identification import pole

pytestmark = pytest.mark.benchmark
#: heights of sensors among 24, each with two axes; time [periods of the first mode]
HEIGHTS, PERIODS, RATE = [5, 11, 17, 23], 1200, 2.5


def plane(stiffness, count=24, length=30.0, mass=60.0):
    """Six frequencies [Hz] and shapes of a cantilever that tapers to 0.4, Euler and Bernoulli."""
    h = length / count
    K = np.zeros((2 * count + 2, 2 * count + 2))
    M = np.zeros_like(K)
    for e in range(count):
        wide, own = 1 - 0.6 * (e + 0.5) / count, slice(2 * e, 2 * e + 4)
        bend = [[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h],
                [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h * h, -6 * h, 4 * h * h]]  # fmt: skip
        move = [[156, 22 * h, 54, -13 * h], [22 * h, 4 * h * h, 13 * h, -3 * h * h],
                [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h * h, -22 * h, 4 * h * h]]  # fmt: skip
        K[own, own] += stiffness * wide**3 / h**3 * np.array(bend)
        M[own, own] += mass * wide * h / 420 * np.array(move)
    squares, shapes = la.eigh(K[2:, 2:], M[2:, 2:])
    return np.sqrt(squares[:6]) / (2 * np.pi), shapes[::2, :6]


def shaken(rng):
    """Accelerations (8, n) under white forces at twelve heights, axes 20 degrees off the planes."""
    (f, X), (g, Y) = plane(6e6), plane(6.18e6)
    freq, zeta = np.append(f, g), np.tile(np.linspace(0.008, 0.012, 6), 2)
    turn = np.deg2rad(20.0)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    phi = np.kron(R, np.eye(4)) @ la.block_diag(X[HEIGHTS], Y[HEIGHTS])
    rate = RATE * freq.max()
    count = int(PERIODS / freq.min() * rate)
    forces = la.block_diag(X[1::2], Y[1::2]).T @ rng.normal(size=(24, count + 2000))
    y = np.zeros((8, count))
    for k, p in enumerate(pole(freq, zeta)):
        b, a, _ = ss.cont2discrete(([1.0, 0, 0], [1.0, -2 * p.real, abs(p) ** 2]), 1 / rate)
        y += phi[:, [k]] * ss.lfilter(b[0], a, forces[k])[2000:]
    return freq, zeta, rate, y + 0.02 * y.std() * rng.normal(size=y.shape)


def test_twelve_modes_of_a_mast():
    """Near pairs 1.5 % apart, chosen by nobody, with deviations.

    pyOMA2 1.4.3 (SSI, 50 block rows), told the twelve frequencies and an order of 40, meets all
    in 4 s without deviations; left to choose the order it finds none of them at once.
    """
    freq, zeta, rate, y = shaken(np.random.default_rng(0))
    start = time.process_time()
    found = identify_output_only(y, rate=rate, band=(0.6 * freq.min(), 1.1 * freq.max()))
    spent = time.process_time() - start
    away = np.abs(found.freq[:, None] / freq - 1)
    met, near = np.unique(away.argmin(axis=1)[away.min(axis=1) < 0.01]), away.argmin(axis=1)
    wrong = int(np.sum(away.min(axis=1) >= 0.01))
    off = np.abs(found.zeta / zeta[near] - 1)
    print(
        f"\n{met.size} of 12 modes within 1 %, {wrong} false, frequencies off by up to "
        f"{away.min(axis=1).max():.1e}, damping by {off.max():.0%}, {spent:.0f} s"
    )
    assert met.size == 12
    assert wrong == 0
    assert off.max() < 0.3
