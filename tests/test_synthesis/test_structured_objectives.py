"""Objectives of structured synthesis: optima in closed form, gradients, several, a fleet."""

import numpy as np
import pytest
import scipy.linalg as la
from scipy.optimize import brentq
from test_structured import law, machine, named

from flexplant.errors import AssumptionError, CertificateError, ModelError
from flexplant.lti import StateSpace, discretized, lft
from flexplant.plant import StandardPlant
from flexplant.synthesis import H2, FixedOrder, Hinf, PeakGain, TunedLaws, design_h2
from flexplant.synthesis import design_structured as design
from flexplant.synthesis.preparation import prepared
from flexplant.synthesis.structured.judges import H2Judge, PeakJudge, problem_on


def first_order(effort, dt=0.0):
    """x' = w + u (sampled: x[k + 1] = x + dt (w + u)), z = [x, effort u], y = x."""
    A, B = (np.eye(1), dt * np.ones((1, 2))) if dt else (np.zeros((1, 1)), np.ones((1, 2)))
    C = np.array([[1.0], [0.0], [1.0]])
    D = np.array([[0.0, 0], [0, effort], [0, 0]])
    return named(A, B, C, D, 1, 1, dt)


def resonant(dt=0.0):
    """A mass on a spring with process and sensor noise, motion and effort weighed."""
    A, b, c = np.array([[0.0, 1], [-4.0, -0.1]]), np.array([[0.0], [1]]), np.array([[1.0, 0]])
    if dt:
        g = discretized(StateSpace(A, b, c, [[0.0]]), 1 / dt)
        A, b, c = g.A, g.B, g.C
    B, C = np.hstack([b, 0 * b, b]), np.vstack([c, 0 * c, c])
    D = np.array([[0.0, 0, 0], [0, 0, 0.3], [0, 0.2, 0]])
    return named(A, B, C, D, 1, 1, dt)


def h2_of(plant, K):
    """By the Lyapunov equation of scipy, of matrices put together by hand."""
    g, m, p = plant.system, len(plant.w), len(plant.z)
    B1, B2, C1, C2 = g.B[:, :m], g.B[:, m:], g.C[:p], g.C[p:]
    D11, D12, D21 = g.D[:p, :m], g.D[:p, m:], g.D[p:, :m]
    A = np.block([[g.A + B2 @ K.D @ C2, B2 @ K.C], [K.B @ C2, K.A]])
    B = np.vstack([B1 + B2 @ K.D @ D21, K.B @ D21])
    C = np.hstack([C1 + D12 @ K.D @ C2, D12 @ K.C])
    D = D11 + D12 @ K.D @ D21
    if plant.dt:
        P = la.solve_discrete_lyapunov(A, B @ B.T)
        return np.sqrt(np.trace(C @ P @ C.T + D @ D.T))
    assert np.abs(D).max() < 1e-12
    return np.sqrt(np.trace(C @ la.solve_continuous_lyapunov(A, -B @ B.T) @ C.T))


@pytest.mark.parametrize("effort", [1.0, 0.5])
def test_the_h2_gain_in_closed_form(effort):
    """(1 + r^2 k^2) / (2 k) is least at k = 1 / r: H2^2 = r."""
    found = design(first_order(effort), FixedOrder(0), objective=H2(), starts=1)
    assert found.gamma == pytest.approx(np.sqrt(effort), rel=1e-6)
    assert found.system.D[0, 0] == pytest.approx(-1.0 / effort, rel=1e-3)


@pytest.mark.slow
def test_the_peak_gain_in_closed_form():
    """x: 1 / k, u: 1 for any k; sampled x: the same sum, as 0 < 1 - k dt."""
    for dt in (0.0, 0.01):
        given = first_order(0.25, dt)
        found = design(given, FixedOrder(0), objective=[
            PeakGain(z=["z0"], below=0.5), H2(below=1.0)], starts=1)  # fmt: skip
        k = -found.system.D[0, 0]
        peak = found.certificate["PeakGain(z=['z0'], below=0.5)"]
        assert peak == pytest.approx(1.0 / k, rel=1e-4)
        h2 = found.certificate["H2(below=1)"]
        assert h2 == pytest.approx(h2_of(given, found.system), rel=1e-8)
        # both count alike where they meet: 2 / k = H2
        assert found.gamma == pytest.approx(max(2.0 * peak, h2), rel=1e-9)
        assert 2.0 * peak == pytest.approx(h2, rel=2e-3)  # where gamma is flat


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_the_full_order_reaches_the_optimum_of_h2(dt):
    """LQG has two states and no feedthrough; the sampled optimum is that of the two Riccatis."""
    plant = resonant(dt)
    best = design_h2(plant).gamma
    found = design(plant, FixedOrder(2, direct=bool(dt)), objective=H2(), starts=1)
    assert found.gamma == pytest.approx(h2_of(plant, found.system), rel=1e-7)
    assert best * (1 - 1e-6) <= found.gamma <= 1.001 * best
    one = design(plant, FixedOrder(1, direct=bool(dt)), objective=H2(), starts=2)
    assert found.gamma <= one.gamma * (1 + 1e-9)
    if not dt:
        assert not np.any(found.system.D)
        assert not np.any(one.system.D)
        with pytest.raises(AssumptionError, match="direct=False"):
            design(plant, FixedOrder(1), objective=H2())


@pytest.mark.slow
@pytest.mark.parametrize("kind", [H2Judge, PeakJudge])
@pytest.mark.parametrize("sampled", [False, True])
def test_gradients_by_differences(kind, sampled):
    """By entries of a stabilising controller; the number is that of `measured`."""
    plant = resonant(0.1 if sampled else 0.0)
    spec = H2() if kind is H2Judge else PeakGain(w=["w0"], z=["z0"])
    w, z = spec.chosen(plant)
    judge = kind(problem_on(plant, w, z), 2)
    rest = (0.9 if sampled else -1.0) * np.eye(2)  # a slow controller, as slow loops are smooth
    start = StateSpace(rest, np.zeros((2, 1)), np.zeros((1, 2)), [[0.0]], plant.dt)
    structure = FixedOrder(2, direct=sampled, start=start)
    family = structure.family(plant, prepared(plant.system, plant.u, plant.y))
    rng = np.random.default_rng(1)
    theta = family.first + 0.1 * rng.standard_normal(family.first.size)
    K = family.matrices(theta)
    value, place = judge.value(K)
    from flexplant.synthesis.structured.structures import as_system

    closed = lft(plant.system, as_system(K, (plant.y, plant.u), plant.dt))
    assert spec.measured(closed.select(z, w)) == pytest.approx(value, rel=1e-4)
    pieces = judge.pieces(K, family.jacobian(theta), place, sweep=True)
    assert pieces.value[0] == pytest.approx(np.log(value), rel=1e-12)
    H = pieces.hessian(0)
    for _ in range(3):
        step = rng.standard_normal(theta.size)
        step *= 1e-4 / np.linalg.norm(step)

        def at(k, step=step):
            return np.log(judge.value(family.matrices(theta + k * step))[0])

        # a sample that changes its sign within the step bends the sum: a short one
        slope = pieces.gradient[0] @ step
        assert at(0.01) - at(-0.01) == pytest.approx(0.02 * slope, rel=1e-4, abs=1e-13)
        if kind is H2Judge:
            bend = step @ H @ step
            assert at(-1) - 2 * at(0) + at(1) == pytest.approx(bend, rel=1e-2, abs=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_derivatives_of_a_peak_by_poles_of_unlike_speeds(seed):
    """Modes of 1 to 1e4 rad/s: integrals between zeros that brentq finds, differences of them."""
    rng = np.random.default_rng(seed)
    speed, damping = 10.0 ** rng.uniform(0, 4, 3), rng.uniform(0.1, 0.9, 3)
    upper = speed * (-damping + 1j * np.sqrt(1 - damping**2))
    poles, residues = (
        np.concatenate([one, one.conj()])
        for one in (upper, rng.normal(size=3) + 1j * rng.normal(size=3))
    )
    end = 30.0 / np.min(-poles.real)
    t = np.union1d(np.linspace(0, end, 20_001), np.geomspace(1e-8, end, 20_001))

    def integral(poles):
        def h(t):
            return float(np.real(np.exp(poles * t) @ residues))

        values = np.real(np.exp(np.outer(t, poles)) @ residues)
        at = np.flatnonzero(values[1:] * values[:-1] < 0)
        edges = [0.0, *(brentq(h, t[i], t[i + 1], xtol=1e-18) for i in at), end]
        return np.abs(np.diff(np.real(np.exp(np.outer(edges, poles)) / poles @ residues))).sum()

    _, S, slope = PeakJudge._continuous(poles, residues, 0.0, 0.0)
    total = integral(poles)
    assert np.real(residues @ S) == pytest.approx(total, rel=1e-9)
    for k in range(3):
        step = np.zeros(6, dtype=complex)
        step[k] = 1e-6 * poles[k]
        step[k + 3] = step[k].conj()
        found = (integral(poles + step) - integral(poles - step)) / 2e-6
        assert abs(2 * np.real(residues[k] * slope[k] * poles[k]) - found) < 1e-7 * total


@pytest.mark.long
def test_one_fixed_order_for_a_fleet():
    """A mode from 26 to 36 Hz: two states hold machines that the design has not seen."""
    fleet = [machine(freq) for freq in (26.0, 30.0, 36.0)]
    start = design(fleet, TunedLaws(law(30.0), free=("p", "freq")), starts=1, evaluations=150)
    found = design(fleet, FixedOrder(2), starts=1, evaluations=600)
    assert found.system.n_states == 2
    for freq in (27.0, 28.5, 33.0, 35.0):
        other = machine(freq)
        loop = lft(other.system, found.system)
        assert loop.is_stable
        assert Hinf().measured(loop) < 1.15 * found.gamma
    assert start.system.n_states > 2


def test_an_objective_of_ones_own_is_a_value_with_four_names():
    """The H2 norm from one channel, doubled: half the work of a new objective is its gradient."""
    calls = []

    class Doubled(H2):
        def judges(self, plant, order):
            calls.append(order)
            inner = super().judges(plant, order)[0]
            found = inner.found
            inner.found = lambda loop: tuple(2.0 * part for part in found(loop))
            return [inner]

        def measured(self, closed):
            return 2.0 * super().measured(closed)

    found = design(first_order(0.5), FixedOrder(0), objective=Doubled(), starts=1)
    assert found.gamma == pytest.approx(2.0 * np.sqrt(0.5), rel=1e-6)
    assert calls


def test_a_claim_that_is_wrong_is_refused_and_so_are_wrong_objectives(monkeypatch):
    plant = first_order(0.5)
    right = H2Judge.found
    monkeypatch.setattr(
        H2Judge, "found", lambda self, loop: tuple(1.01 * part for part in right(self, loop))
    )
    with pytest.raises(CertificateError, match="by the search"):
        design(plant, FixedOrder(0), objective=H2(), starts=1)
    for wrong in (H2, "h2", 3.0):
        with pytest.raises(ModelError, match="objective must be"):
            design(plant, FixedOrder(0), objective=wrong)
    with pytest.raises(ModelError, match="no bound"):
        design(plant, FixedOrder(0), objective=[H2(), Hinf(below=1.0)])
    with pytest.raises(ModelError, match="empty"):
        design(plant, FixedOrder(0), objective=[])
    with pytest.raises(ModelError, match="is its D"):
        FixedOrder(0, direct=False)
    assert isinstance(plant, StandardPlant)
