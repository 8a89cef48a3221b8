"""Dense references for uncertain modes, written from the equations."""

import numpy as np
import scipy.linalg as la


def modal_gain(omega, zeta, see, push, freq, *, derivative=0):
    """Sum over modes of see push' s^derivative / (omega^2 + 2 zeta omega s + s^2).

    see (n_out, k), push (n_in, k) are modal shapes; returns (n_out, n_in, n_freq).
    """
    s = 2j * np.pi * np.asarray(freq)
    gain = np.zeros((see.shape[0], push.shape[0], s.size), dtype=complex)
    for k in range(omega.size):
        mode = s**derivative / (omega[k] ** 2 + 2 * zeta[k] * omega[k] * s + s**2)
        gain += np.multiply.outer(np.outer(see[:, k], push[:, k]), mode)
    return gain


def poles_near(M, D, K, wanted):
    """Eigenvalues of lambda^2 M + lambda D + K closest to the wanted ones."""
    n = M.shape[0]
    scale = np.abs(wanted).max()  # time in this unit, for the eigenvalue solver's sake
    A = np.block(
        [[np.zeros((n, n)), np.eye(n)], [-la.solve(M, K) / scale**2, -la.solve(M, D) / scale]]
    )
    values = la.eigvals(A) * scale
    return np.array([values[np.argmin(np.abs(values - pole))] for pole in wanted])


def pole_jacobian(M, D, K, changes, wanted, steps):
    """d [Re lambda; Im lambda] / d p by fourth-order differences; changes are (dM, dD, dK)."""
    columns = []
    for (dM, dD, dK), h in zip(changes, steps, strict=True):
        f = {
            m: poles_near(M + m * h * dM, D + m * h * dD, K + m * h * dK, wanted)
            for m in (-2, -1, 1, 2)
        }
        slope = (8 * (f[1] - f[-1]) - (f[2] - f[-2])) / (12 * h)
        columns.append(np.concatenate([slope.real, slope.imag]))
    return np.array(columns).T


def relative_jacobian(poles):
    """d [log |lambda|^2; log -2 Re lambda] / d [Re lambda; Im lambda], by finite differences."""
    m = poles.size

    def logs(x):
        return np.concatenate([np.log(x[:m] ** 2 + x[m:] ** 2), np.log(-2 * x[:m])])

    x = np.concatenate([poles.real, poles.imag])
    h = 1e-5 * np.abs(x)
    columns = []
    for i in range(2 * m):
        step = np.zeros(2 * m)
        step[i] = h[i]
        columns.append((logs(x + step) - logs(x - step)) / (2 * h[i]))
    return np.array(columns).T
