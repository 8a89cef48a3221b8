"""Oracles of synthesis: dense, slow, from the equations. Never imports the package."""

import numpy as np
import scipy.linalg as la


def split(A, B, C, D, nu, ny):
    """The nine matrices of [w; u] -> [z; y] by name."""
    nw, nz = B.shape[1] - nu, C.shape[0] - ny
    return {
        "A": A,
        "B1": B[:, :nw],
        "B2": B[:, nw:],
        "C1": C[:nz],
        "C2": C[nz:],
        "D11": D[:nz, :nw],
        "D12": D[:nz, nw:],
        "D21": D[nz:, :nw],
        "D22": D[nz:, nw:],
    }


def closed_loop(p, AK, BK, CK, DK):
    """A, B, C, D of w -> z with u = K y, from solving the interconnection for (u, y) at once."""
    nu, ny, n, k = p["B2"].shape[1], p["C2"].shape[0], p["A"].shape[0], AK.shape[0]
    nw = p["B1"].shape[1]
    # [I, -DK; -D22, I] [u; y] = [0, CK, 0; C2, 0, D21] [x; xk; w]
    left = np.block([[np.eye(nu), -DK], [-p["D22"], np.eye(ny)]])
    right = np.block(
        [[np.zeros((nu, n)), CK, np.zeros((nu, nw))], [p["C2"], np.zeros((ny, k)), p["D21"]]]
    )
    uy = np.linalg.solve(left, right)
    u, y = uy[:nu], uy[nu:]
    x = np.hstack([p["A"], np.zeros((n, k)), p["B1"]]) + p["B2"] @ u
    xk = np.hstack([np.zeros((k, n)), AK, np.zeros((k, nw))]) + BK @ y
    z = np.hstack([p["C1"], np.zeros((p["C1"].shape[0], k)), p["D11"]]) + p["D12"] @ u
    both = np.vstack([x, xk])
    return both[:, : n + k], both[:, n + k :], z[:, : n + k], z[:, n + k :]


def stability(A, dt):
    """Spectral radius minus one, or spectral abscissa: negative when stable."""
    if not A.size:
        return -1.0
    poles = np.linalg.eigvals(A)
    return np.max(np.abs(poles)) - 1 if dt else np.max(poles.real)


def gains(A, B, C, D, points):
    """Largest singular values at points s (or z)."""
    eye = np.eye(A.shape[0])
    return np.array([np.linalg.norm(C @ np.linalg.solve(s * eye - A, B) + D, 2) for s in points])


def brute_norm(A, B, C, D, dt, count=400):
    """Largest gain on a grid of all decades and of all poles, refined around its ten best."""
    if not A.size:
        return float(np.linalg.norm(D, 2))
    poles = np.linalg.eigvals(A)
    if dt:
        poles = np.log(poles[np.abs(poles) > 1e-12] + 0j) / dt
    top = np.pi / dt if dt else 1e3 * np.abs(poles).max()
    low = 1e-3 * np.abs(poles)[np.abs(poles) > 0].min()
    grid = [[0.0, top], np.geomspace(min(low, 0.1 * top), top, count), np.abs(poles)]
    grid += [np.abs(poles.imag) + h * np.abs(poles.real) for h in (-2, -1, -0.5, 0, 0.5, 1, 2)]
    omega = np.unique(np.clip(np.concatenate(grid), 0.0, top))

    def at(values):
        return gains(A, B, C, D, np.exp(1j * values * dt) if dt else 1j * values)

    size = at(omega)
    best = float(max(size.max(), 0.0 if dt else np.linalg.norm(D, 2)))
    for i in np.argsort(size)[::-1][:10]:
        a, b = omega[max(i - 1, 0)], omega[min(i + 1, omega.size - 1)]
        for _ in range(4):
            fine = np.linspace(a, b, 11)
            found = at(fine)
            j = int(np.argmax(found))
            a, b = fine[max(j - 1, 0)], fine[min(j + 1, 10)]
            best = max(best, float(found[j]))
    return best


def scalar_optimum(a):
    """Smallest gamma of x' = a x + w1 + u, z = (x, u), y = x + w2, for a > -1/2.

    X = Y solves 2 a X + 1 = X^2 (1 - 1/g^2); at the optimum X Y = g^2, so X = g:
    g^2 - 2 a g - 2 = 0.
    """
    return a + np.sqrt(a * a + 2.0)


def coprime_problem(A, B, C):
    """The standard plant of normalised coprime factor uncertainty, and its smallest gamma.

    z = (y, u), x' = A x + B u + Y C' w, y = C x + w; gamma = (1 + lambda_max(X Y))^(1/2): Glover,
    McFarlane, IEEE Trans. Automatic Control 34, 1989, a Nehari problem.
    """
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    X = la.solve_continuous_are(A, B, C.T @ C, np.eye(m))
    Y = la.solve_continuous_are(A.T, C.T, B @ B.T, np.eye(p))
    plant = (
        A,
        np.hstack([Y @ C.T, B]),
        np.vstack([C, np.zeros((m, n)), C]),
        np.block(
            [
                [np.eye(p), np.zeros((p, m))],
                [np.zeros((m, p)), np.eye(m)],
                [np.eye(p), np.zeros((p, m))],
            ]
        ),
    )
    return plant, float(np.sqrt(1 + np.max(np.linalg.eigvals(X @ Y).real)))


def rigid_sensor(point, die, axes):
    """What a sensor of z at a point sees per unit of each axis of the die, of a rigid body.

    rx = dz/dy, ry = -dz/dx.
    """
    dx, dy = point[0] - die[0], point[1] - die[1]
    return np.array([{"z": 1.0, "rx": dy, "ry": -dx}[axis] for axis in axes])


# --- plants with a known smallest gamma, made here: for where no collection of plants is at hand


def chain(masses=3, stiffness=4.0):
    """A, B, C of equal masses on a line, free at both ends, undamped: force and motion at one end.

    The non-collocated pair (force on the first, position of the last) when C is reversed.
    """
    L = 2.0 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1)
    L[0, 0] = L[-1, -1] = 1.0
    A = np.block([[np.zeros((masses, masses)), np.eye(masses)], [-stiffness * L, np.zeros_like(L)]])
    B = np.zeros((2 * masses, 1))
    B[masses] = 1.0
    C = np.zeros((1, 2 * masses))
    C[0, masses - 1] = 1.0
    return A, B, C


def cart_pole(growth=2.0):
    """A, B, C of an inverted pendulum on a cart: two integrators, a pole and its mirror."""
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1, 2], A[3, 2] = -1.0, growth**2
    B = np.array([[0.0], [1.0], [0.0], [-1.0]])
    C = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0]])
    return A, B, C


def random_plant(seed, n=6, m=2, p=2):
    """A, B, C of any poles."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.normal(size=(p, n))


def sensitivity_problem(zero, pole, lag, *, peak=2.0, corner=0.5, low=0.01):
    """The standard plant of ||W S||, and its infimum.

    y = w + G u, z = W y, W = (s / peak + corner) / (s + corner low) and
    ``G = (s - zero) / (s - pole)``, times ``1 / (s + 1)`` with lag. S is 1 at the zero and 0 at an
    unstable pole, so that by the maximum modulus theorem (Zames; Khargonekar, Tannenbaum)
    ``|W S| >= |W(zero)|``, times ``(zero + pole) / |zero - pole|`` when the pole is unstable.
    """
    # G: pole, then the lag; u -> g
    A = np.array([[pole]])
    B, C, D = np.array([[1.0]]), np.array([[pole - zero]]), np.array([[1.0]])
    if lag:
        A = np.array([[pole, 0.0], [pole - zero, -1.0]])
        B, C, D = np.array([[1.0], [1.0]]), np.array([[0.0, 1.0]]), np.array([[0.0]])
    n = A.shape[0]
    a, d = -corner * low, 1.0 / peak
    c = corner - corner * low / peak  # W = d + c / (s - a)
    states = np.block([[A, np.zeros((n, 1))], [C, np.array([[a]])]])
    inputs = np.block([[np.zeros((n, 1)), B], [np.ones((1, 1)), D]])
    outputs = np.block([[d * C, np.array([[c]])], [C, np.zeros((1, 1))]])
    through = np.block([[np.array([[d]]), d * D], [np.ones((1, 1)), D]])
    weight = (zero / peak + corner) / (zero + corner * low)
    least = weight * ((zero + pole) / abs(zero - pole) if pole > 0 else 1.0)
    return (states, inputs, outputs, through), least
