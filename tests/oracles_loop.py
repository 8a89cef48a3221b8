"""Oracles of loop and simulation: dense, slow, from the equations. Never imports the package."""

import math
from fractions import Fraction

import numpy as np
import scipy.linalg as la
from scipy.optimize import linprog


def run_sample_by_sample(plant, blocks, w, push=None, sensed=None, drive=None):
    """Return {name: signal} of measure, update, control, hold, one sample after the other.

    `plant` is a dict with A, B, C, D, w, u, z, y; `blocks` dicts with A, B, C, D, inputs, outputs,
    in an order in which what a block passes on directly is known; `w` {name: samples}. `sensed` is
    a function of y, `drive` one of the commands and what was applied before.
    """
    n_time = len(next(iter(w.values())))
    nw, nz = len(plant["w"]), len(plant["z"])
    B1, B2 = plant["B"][:, :nw], plant["B"][:, nw:]
    C1, C2 = plant["C"][:nz], plant["C"][nz:]
    D11, D12 = plant["D"][:nz, :nw], plant["D"][:nz, nw:]
    D21 = plant["D"][nz:, :nw]
    x = np.zeros(plant["A"].shape[0])
    states = [np.zeros(block["A"].shape[0]) for block in blocks]
    record, before = {}, np.zeros(B2.shape[1])
    for k in range(n_time):
        now = np.array([w[name][k] if name in w else 0.0 for name in plant["w"]])
        y = C2 @ x + D21 @ now
        known = dict(zip(plant["y"], y if sensed is None else sensed(y), strict=True))
        applied = dict.fromkeys(plant["u"], 0.0)
        for block, state in zip(blocks, states, strict=True):
            value = block["C"] @ state
            for j, name in enumerate(block["inputs"]):
                if np.any(block["D"][:, j]):
                    value = value + block["D"][:, j] * known[name]
            for name, number in zip(block["outputs"], value, strict=True):
                if name in applied:
                    applied[name] += number
                else:
                    known[name] = number
        u = np.array([applied[name] for name in plant["u"]])
        if drive is not None:
            before = u = drive(u, before)
            applied = dict(zip(plant["u"], u, strict=True))
        z = C1 @ x + D11 @ now + D12 @ u
        for i, block in enumerate(blocks):
            e = np.array([{**known, **applied}[name] for name in block["inputs"]])
            states[i] = block["A"] @ states[i] + block["B"] @ e
        x = plant["A"] @ x + B1 @ now + B2 @ u + (0.0 if push is None else push[k])
        for name, number in {**known, **applied, **dict(zip(plant["z"], z, strict=True))}.items():
            record.setdefault(name, []).append(number)
    return {name: np.array(signal) for name, signal in record.items()}


def gain(A, B, C, D, s):
    """Return C (s I - A)^-1 B + D by a dense solve."""
    return C @ np.linalg.solve(s * np.eye(len(A)) - A, B.astype(complex)) + D


def stationary(A, noise, C, samples):
    """Return variances of C x and the standard errors of their mean squares over `samples`.

    x+ = A x + v, cov v = noise. For Gaussian e, var(mean e^2) = 2/N sum_tau R(tau)^2.
    """
    X = la.solve_discrete_lyapunov(A, noise)
    variance = np.diag(C @ X @ C.T)
    total, moved = np.zeros(len(C)), X
    for lag in range(20000):
        R = np.einsum("ij,jk,ik->i", C, moved, C)
        total += (1.0 if lag == 0 else 2.0) * R**2
        if np.all(np.abs(R) < 1e-6 * variance) and lag > 50:
            break
        moved = A @ moved
    return variance, np.sqrt(2.0 * total / samples)


def moving_moments(signal, count):
    """Return mean and deviation over `count` samples around each, in exact arithmetic."""
    exact = [Fraction(float(value)) for value in signal]
    means, deviations = [], []
    for k in range(len(exact)):
        part = exact[max(k - count // 2, 0) : k - count // 2 + count]
        mean = sum(part) / len(part)
        means.append(float(mean))
        deviations.append(math.sqrt(sum((value - mean) ** 2 for value in part) / len(part)))
    return np.array(means), np.array(deviations)


def farthest(duration, bounds, intervals=120):
    """Return the longest distance from rest to rest in a time with bounded derivatives.

    A linear program. `bounds` are those of velocity, acceleration, jerk (and snap); the highest
    derivative is constant over each interval, so this is at most a little less than the optimum.
    """
    order, h = len(bounds), duration / intervals
    # state: position and its derivatives below the highest; exact integration over one interval
    step = np.array(
        [
            [h ** (j - i) / math.factorial(j - i) if j >= i else 0.0 for j in range(order)]
            for i in range(order)
        ]
    )
    drive = np.array([h ** (order - i) / math.factorial(order - i) for i in range(order)])
    rows = [np.zeros((order, intervals))]
    for k in range(intervals):
        following = step @ rows[-1]
        following[:, k] += drive
        rows.append(following)
    limits, sizes = [], []
    for i, bound in enumerate(bounds[:-1], start=1):
        for row in rows[1:]:
            limits += [row[i] / bound, -row[i] / bound]
            sizes += [1.0, 1.0]
    scale = np.abs(rows[-1][1:]).max(axis=1, keepdims=True)
    answer = linprog(
        -rows[-1][0] * bounds[-1] / np.abs(rows[-1][0]).max(),
        A_ub=np.array(limits) * bounds[-1],
        b_ub=sizes,
        A_eq=rows[-1][1:] / scale,
        b_eq=np.zeros(order - 1),
        bounds=(-1.0, 1.0),
        method="highs",
    )
    assert answer.status == 0, answer.message
    return float(rows[-1][0] @ answer.x * bounds[-1])


def folded_spectrum(physical, loop, freq, asd, sensor_asd, aliases):
    """Return the one-sided PSD of a sampled closed loop's error from continuous spectra alone.

    `physical` holds A, B (force, then actuators), C (point, then sensors) of a continuous plant;
    `loop` the sampled responses as functions of z: K (nu, ny), P (1 + ny, nu). White force noise
    makes the continuous cross-spectrum of point and sensors without control, whose copies at all
    multiples of the rate add up when it is sampled; the loop then acts on the samples.
    """
    rate = loop["rate"]
    shown = len(physical["C"])
    out = np.zeros(freq.size)
    for i, f in enumerate(freq):
        H = [
            gain(
                physical["A"], physical["B"][:, :1], physical["C"], 0.0, 2j * np.pi * (f + k * rate)
            )
            for k in range(-aliases, aliases + 1)
        ]
        # the intensity asd^2 / 2 on both sides of zero, times two for a one-sided density
        S = sum(h @ h.conj().T for h in H) * asd**2
        S = S + np.diag([0.0] + [sensor_asd**2] * (shown - 1))
        z = np.exp(2j * np.pi * f / rate)
        K, P = loop["K"](z), loop["P"](z)
        back = np.linalg.solve(np.eye(K.shape[0]) - K @ P[1:], K)
        row = np.concatenate([[1.0], (P[:1] @ back)[0]])
        out[i] = (row @ S @ row.conj()).real
    return out


def lifted_inverse(A, B, C, D, target, damping):
    """Return u (n, r) that minimises ``|target - P u|^2 + sum damping u^2`` over n samples.

    Dense least squares on the matrix of Markov parameters; target (n, q), damping (r,).
    """
    n, q = target.shape
    r = B.shape[1]
    markov, x = [D], B
    for _ in range(n - 1):
        markov.append(C @ x)
        x = A @ x
    P = np.zeros((n * q, n * r))
    for k in range(n):
        for i in range(k, n):
            P[i * q : (i + 1) * q, k * r : (k + 1) * r] = markov[i - k]
    # in units in which the damping is one
    unit = np.tile(1.0 / np.sqrt(damping), n)
    tall = np.vstack([P * unit, np.eye(n * r)])
    right = np.concatenate([target.ravel(), np.zeros(n * r)])
    return (unit * np.linalg.lstsq(tall, right, rcond=None)[0]).reshape(n, r)
