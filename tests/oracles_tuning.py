"""The law of highest bandwidth by brute force: differential evolution over closed forms."""

import numpy as np
from scipy.optimize import differential_evolution

#: ranges of the zero's, the pole's and the low-pass' factor, of a notch's depth and width
RANGES, NOTCH = ((1.2, 10.0), (1.5, 60.0), (1.5, 60.0)), ((0.01, 1.0), (0.02, 1.0))


def response(x, s, rate):
    """The law (n_s, n_x) at s = 2 rate (z - 1) / (z + 1), its numbers by x (n_number, n_x)."""

    def centred(hertz):
        return 2 * rate * np.tan(np.pi * hertz / rate)

    w, s = 2 * np.pi * x[0], s.reshape(-1, 1) if s.ndim == 1 else s
    p = s / centred(x[0] * x[3])
    C = (1 + 0.1 * w / s) * (1 + s * x[1] / w) / (1 + s / (w * x[2])) / (p * p + 2**0.5 * p + 1)
    for f, depth, width in x[4:].reshape(-1, 3, x.shape[1]):
        p = s / centred(f)
        C = C * (p * p + 2 * depth * width * p + 1) / (p * p + 2 * width * p + 1)
    return C


def best_bandwidth(freq, G, rate, inertia, modes, notches, *, peak=2.0, seed=1, rounds=100):
    """The highest bandwidth [Hz] that keeps |S| below a peak, of `notches` notches.

    A notch lies above the bandwidth or within 30 % of a mode; no corner above 0.45 of the rate.
    """
    top, s = 0.45 * rate, 2j * rate * np.tan(np.pi * freq / rate)
    own = [(8.0, top / 1.5), *RANGES, *([(freq[0], top), *NOTCH] * notches)]

    def cost(x):
        x = np.exp(np.reshape(x, (len(own), -1)))
        x[2:4] = np.minimum(x[2:4], top / x[0])
        at = response(x, 2j * rate * np.tan(np.pi * x[:1] / rate), rate)
        L = response(x, s, rate) * G[:, None] * inertia * (2 * np.pi * x[0]) ** 2 / np.abs(at)
        F = 1 + L  # a stable loop of three integrators turns by 3/2 pi
        turned = np.angle(F[1:] / F[:-1]).sum(axis=0)
        lack = np.minimum(np.abs(F).min(axis=0) - 1 / peak, 0.0)
        low = x[4::3] < x[0]
        far = np.abs(np.log(x[4::3, None] / np.reshape(modes, (1, -1, 1))))
        bad = low & (far.min(axis=1, initial=np.inf) > np.log(1.3))
        return (
            -np.log(x[0]) - 20 * lack + 5 * (np.abs(turned - 1.5 * np.pi) > 0.6) + bad.sum(axis=0)
        )

    found = differential_evolution(
        cost, np.log(own), maxiter=rounds, popsize=12, vectorized=True, updating="deferred",
        rng=seed, polish=False, tol=1e-6, init="sobol", mutation=(0.4, 0.9), recombination=0.8,
    )  # fmt: skip
    return float(np.exp(-found.fun))
