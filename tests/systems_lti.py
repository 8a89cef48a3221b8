"""Systems that several tests of the lti room share."""

import numpy as np

from flexplant.lti import StateSpace


def machine(n_rigid=3, n_elastic=21, *, zeta=1e-3, m=4, p=5, seed=0):
    """Modes in plain (q, dq/dt) states and SI units."""
    rng = np.random.default_rng(seed)
    omega = np.concatenate([np.zeros(n_rigid), 2 * np.pi * np.linspace(245.0, 3700.0, n_elastic)])
    n = 2 * omega.size
    A, B, C = np.zeros((n, n)), np.zeros((n, m)), np.zeros((p, n))
    k = np.arange(omega.size)
    A[2 * k, 2 * k + 1], A[2 * k + 1, 2 * k] = 1.0, -(omega**2)
    A[2 * k + 1, 2 * k + 1] = -2 * zeta * omega
    B[1::2], C[:, ::2] = rng.standard_normal((k.size, m)) / 5, rng.standard_normal((p, k.size)) / 5
    return StateSpace(A, B, C, np.zeros((p, m)), blocks=[2] * k.size)


def system(seed=0, n=4, m=3, p=2, dt=0.0, prefix=""):
    rng = np.random.default_rng(seed)
    return StateSpace(
        rng.standard_normal((n, n)) - 3 * np.eye(n) * (not dt),
        rng.standard_normal((n, m)),
        rng.standard_normal((p, n)),
        rng.standard_normal((p, m)),
        dt,
        inputs=[f"{prefix}in{i}" for i in range(m)],
        outputs=[f"{prefix}out{i}" for i in range(p)],
        states=[f"{prefix}state{i}" for i in range(n)],
        name=f"{prefix}sys",
    )


def same(a, b):
    for part in "ABCD":
        np.testing.assert_array_equal(getattr(a, part), getattr(b, part))
    assert (a.inputs, a.outputs, a.states, a.dt, a.name) == (
        b.inputs,
        b.outputs,
        b.states,
        b.dt,
        b.name,
    )
