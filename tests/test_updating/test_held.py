"""Responses of a sampled machine behind a zero-order hold, against stepped matrix exponentials."""

import numpy as np
import pytest
import scipy.linalg as la

import oracles_updating as oracle
from flexplant.errors import ModelError
from flexplant.lti import Frf
from flexplant.updating import (
    AddedDamping,
    AddedMass,
    AddedStiffness,
    Antiresonances,
    FrfResidual,
    correlate,
    update,
)
from flexplant.updating.search import Objective

RATE = 20.0  # Hz; the modes of the chains lie between 0.5 and 3.4 Hz
FREQ = np.array([0.3, 0.9, 1.7, 2.4, 6.0, 9.9])
HELD = [(0, None, 90), (0, 1, 110), (1, 2, 70)]
FREE = HELD[1:]
RING = [*[(i, None, 30.0) for i in range(3)], (0, 1, 100.0), (1, 2, 100.0), (0, 2, 100.0)]
INPUTS, OUTPUTS = ["1:z", "2:z"], ["1:z", "3:z"]
PARAMETERS = [AddedMass("2:z"), AddedDamping("3:z"), AddedStiffness("1:z", to="3:z")]


def cases(make):
    grounded = np.zeros((3, 3))
    grounded[2, 2] = 0.8
    return {
        "held": make([1, 2, 1.5], HELD, D=np.diag([0.5, 0.0, 0.2])),
        "free": make([1, 2, 1.5], FREE, beta=2e-3),
        "dragged": make([1, 2, 1.5], FREE, D=grounded),
        "repeated": make([1, 1, 1], RING, beta=1e-3),
        "overdamped": make([1, 2, 1.5], HELD, D=np.diag([60.0, 0.0, 0.0])),
        "aliased": make([1e-3, 2, 1.5], HELD, beta=1e-4),
    }


def changed(model, p):
    M, D, K = (np.array(part, dtype=np.result_type(p)) for part in (model.M, model.D, model.K))
    M[1, 1] += p[0]
    D[2, 2] += p[1]
    K += p[2] * np.outer([1.0, 0, -1], [1.0, 0, -1])
    return M, D, K


def exact(model, p, **options):
    """Real and imaginary parts of the sampled response to the inputs at the outputs."""
    B, C = np.eye(3)[:, :2], np.eye(3)[[0, 2]]
    return oracle.sampled_response(*changed(model, p), B, C, FREQ, rate=RATE, **options)


def as_frf(parts, **options):
    return Frf(FREQ, parts[0] + 1j * parts[1], inputs=INPUTS, outputs=OUTPUTS, **options)


@pytest.mark.parametrize("velocity", [False, True])
@pytest.mark.parametrize("delay", [0.0, 2.0, 1.3])
@pytest.mark.parametrize("kind", ["held", "free", "dragged", "repeated", "overdamped", "aliased"])
def test_response_and_gradient_are_exact(make, kind, delay, velocity):
    model = cases(make)[kind]
    base = np.array([0.3, 0.4, 5.0])
    options = {"delay": delay, "velocity": velocity}
    parts = exact(model, base, **options)
    frf = as_frf(parts, quantity="velocity" if velocity else None)
    sigma = 1e-3 * np.abs(frf.data).max()
    residual = FrfResidual(frf, variance=2 * sigma**2, hold=RATE, delay=delay, lines=range(6))
    objective = Objective(model, PARAMETERS, [residual])
    point = objective.begin(base)
    assert np.abs(objective.values(point)).max() * 1e-3 < 1e-11
    J = objective.slopes(point)
    for b in range(3):
        p = base.astype(complex)
        p[b] += 1e-30j
        slope = np.imag(exact(model, p, **options)) / 1e-30
        expected = -np.moveaxis(slope, 3, 1).ravel() / sigma
        assert np.abs(J[:, b] - expected).max() < 1e-10 * np.abs(expected).max()


def test_logarithm_and_central_differences(make):
    model = cases(make)["free"]
    frf = as_frf(exact(model, np.array([0.3, 0.4, 5.0]), delay=1.0))
    residual = FrfResidual(frf, magnitude=True, hold=RATE, delay=1)
    objective = Objective(model, PARAMETERS, [residual])
    base, steps = np.array([0.2, 0.3, 4.0]), np.array([2e-3, 3e-2, 4e-2])
    J = objective.slopes(objective.begin(base))

    def values(b, k):
        return objective.values(objective.at(base + k * steps[b] * np.eye(3)[b]))

    for b in range(3):
        moved = sum(c * (values(b, k) - values(b, -k)) for c, k in [(45, 1), (-9, 2), (1, 3)]) / (
            60 * steps[b]
        )
        assert np.abs(J[:, b] - moved).max() < 1e-7 * np.abs(moved).max()


def test_a_slow_line_is_the_continuous_response_behind_half_a_sample(make):
    # far below the rate a hold is a delay of half a sample
    model = cases(make)["held"]
    frf = Frf([0.05], np.ones((1, 1, 1)), inputs=["1:z"], outputs=["3:z"])
    both = []
    for hold in (None, 200.0):
        objective = Objective(model, [], [FrfResidual(frf, variance=1.0, hold=hold, lines=[0])])
        both.append(objective.bounds[0].responses(objective.begin(np.zeros(0)))[0, 0, 0])
    turn = np.exp(-2j * np.pi * 0.05 / 400)
    assert abs(both[1] / both[0] / turn - 1) < 1e-6


@pytest.mark.slow
def test_an_update_finds_what_the_sampled_machine_has(make):
    model = cases(make)["free"]
    truth = np.array([0.05, 0.1, 3.0])
    frf = as_frf(exact(model, truth, delay=1.5))
    residual = FrfResidual(frf, variance=1e-12, hold=RATE, delay=1.5, lines=range(6))
    fit = update(model, PARAMETERS, [residual])
    np.testing.assert_allclose(fit.values, truth, rtol=1e-7)
    assert correlate(fit.model, [residual]).frac.min() > 1 - 1e-12
    # a residual of continuous signals is not zero at the truth
    plain = Objective(model, PARAMETERS, [FrfResidual(frf, variance=1e-12, lines=range(4))])
    ours = Objective(model, PARAMETERS, [residual])
    error = [np.abs(o.values(o.begin(truth))).max() for o in (plain, ours)]
    assert error[0] > 1e3 * error[1]


def test_what_a_hold_refuses(make):
    frf = as_frf(exact(cases(make)["held"], np.zeros(3)))
    with pytest.raises(ModelError, match="samples of a hold"):
        FrfResidual(frf, delay=1.0)
    with pytest.raises(ModelError, match="only known up to 4 Hz"):
        FrfResidual(frf, hold=8.0)
    with pytest.raises(ModelError, match="jump"):
        FrfResidual(frf.replace(quantity="acceleration"), hold=RATE)
    with pytest.raises(ModelError, match="positive"):
        FrfResidual(frf, hold=-1.0)
    with pytest.raises(ModelError, match="positive"):
        FrfResidual(frf, hold=RATE, delay=-1.0)
    assert repr(FrfResidual(frf, hold=RATE, delay=1.5)).endswith("held at 20 Hz, delay 1.5>")


def sampled_zeros(model, p, places=(0, 2)):
    """Zeros of 1:z to 3:z near the frequency axis, from determinants of the stepped system."""
    M, D, K = changed(model, p)
    inverse = np.linalg.inv(M)
    S = np.zeros((7, 7))
    S[:3, 3:6] = np.eye(3)
    S[3:6, :3], S[3:6, 3:6] = -inverse @ K, -inverse @ D
    S[3:6, 6] = inverse[:, places[0]]
    W = la.expm(S / RATE)
    A, g, c = W[:6, :6], W[:6, 6], np.eye(6)[places[1]]
    # numerator of c (z - A)^-1 g: poles with feedback g c less poles
    numerator = np.poly(A - np.outer(g, c) * 1.0) - np.poly(A)
    z = np.roots(numerator[1:])
    s = np.log(z.astype(complex)) * RATE
    return s[(s.imag > 1e-6) & (s.imag < 3.1 * RATE)]


@pytest.mark.parametrize("kind", ["held", "dragged", "free"])
def test_antiresonances_of_the_sampled_machine(make, kind):
    model = cases(make)[kind]
    base = np.array([0.2, 0.1, 2.0])
    zeros = sampled_zeros(model, base, (0, 0))
    assert zeros.size
    residual = Antiresonances(zeros, "1:z", "1:z", std=1.0, hold=RATE)
    objective = Objective(model, PARAMETERS, [residual])
    point = objective.begin(base)
    assert np.abs(objective.values(point)).max() < 1e-7 * np.abs(zeros).max()
    J = objective.slopes(point)
    steps = np.array([2e-3, 2e-2, 2e-2])
    for b in range(3):

        def at(k, b=b):
            return objective.values(objective.at(base + k * steps[b] * np.eye(3)[b]))

        moved = sum(c * (at(k) - at(-k)) for c, k in [(45, 1), (-9, 2), (1, 3)]) / (60 * steps[b])
        assert np.abs(J[:, b] - moved).max() < 1e-7 * np.abs(J * steps).max() / steps[b]
    # not those of continuous signals
    plain = Objective(model, PARAMETERS, [residual.replace(hold=None)])
    assert np.abs(plain.values(plain.begin(base))).max() > 1e-5
    with pytest.raises(ModelError, match="half the rate"):
        Antiresonances([1j * 70.0], "1:z", "1:z", hold=RATE)
