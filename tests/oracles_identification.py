"""Responses of known modes and loops, from their formulas; nothing here is fast."""

import numpy as np
import scipy.linalg as la
import scipy.signal as ss


def pole(freq, zeta):
    omega, zeta = 2 * np.pi * np.asarray(freq, dtype=float), np.asarray(zeta)
    return -zeta * omega + 1j * omega * np.sqrt(1 - zeta**2)


def modal_frf(freq, poles, out, drive, rigid=None, static=None):
    """(n_out, n_in, n_freq) of mass-normalised real modes: sum phi phi^T / ((s-l)(s-l*))."""
    s = 2j * np.pi * np.asarray(freq)
    H = np.zeros((out.shape[0], drive.shape[0], s.size), dtype=complex)
    for f in range(s.size):
        for k, p in enumerate(poles):
            second_order = s[f] ** 2 - 2 * p.real * s[f] + abs(p) ** 2
            H[:, :, f] += np.outer(out[:, k], drive[:, k]) / second_order
        if rigid is not None:
            H[:, :, f] += rigid / s[f] ** 2
        if static is not None:
            H[:, :, f] += static
    return H


def held_mode(freq, p, rate, late=0.0):
    """(n_freq,) of x'' - 2 Re(p) x' + |p|^2 x = u, u held, by the exponential of its matrix.

    `late`: u is late by this number of samples.
    """
    A = np.array([[0.0, 1.0], [-(abs(p) ** 2), 2 * p.real]])
    big = np.zeros((3, 3))
    big[:2, :2], big[1, 2] = A / rate, 1.0 / rate
    e, older, newer = (la.expm(big * t) for t in (1.0, late % 1.0, 1.0 - late % 1.0))
    z = np.exp(2j * np.pi * np.asarray(freq) / rate)
    return np.array(
        [
            np.linalg.solve(
                x * np.eye(2) - e[:2, :2], newer[:2, 2] + newer[:2, :2] @ older[:2, 2] / x
            )[0]
            / x ** (late // 1.0)
            for x in z
        ]
    )


def noisy(H, deviation, rng):
    """Add circular complex errors with E|e|^2 = deviation^2."""
    e = rng.normal(size=H.shape) + 1j * rng.normal(size=H.shape)
    return H + deviation * e / np.sqrt(2)


class Loop:
    """y = G u + v, u = r - k y with G = B(z)/A(z), one sample of delay at least."""

    def __init__(self, b, a, k):
        self.b, self.a, self.k = np.asarray(b), np.asarray(a), k

    def run(self, r, v):
        n = max(self.b.size, self.a.size)
        b, a = np.zeros(n), np.zeros(n)
        b[: self.b.size], a[: self.a.size] = self.b, self.a
        closed = a + self.k * b
        y = ss.lfilter(b, closed, r) + ss.lfilter(a, closed, v)
        return r - self.k * y, y

    def plant(self, freq, rate):
        return ss.freqz(self.b, self.a, 2 * np.pi * np.asarray(freq) / rate)[1]

    def biased(self, freq, rate, r_power, v_power):
        """What S_yu/S_uu tends to: (G Srr - k* Svv) / (Srr + |k|^2 Svv)."""
        G = self.plant(freq, rate)
        return (G * r_power - self.k * v_power) / (r_power + self.k**2 * v_power)


def mac(a, b):
    return abs(np.vdot(a, b)) ** 2 / (np.vdot(a, a) * np.vdot(b, b)).real
