"""The way of every design: a method of one's own is one class, and wrong claims are refused."""

from dataclasses import dataclass

import numpy as np
import pytest

import oracles_synthesis as oracle
from flexplant.errors import AssumptionError, CertificateError, ModelError, SolverError
from flexplant.lti import StateSpace, lft
from flexplant.synthesis import Controller
from flexplant.synthesis.controller import SolvedController, certified_norm
from flexplant.synthesis.pipeline import Design, designed, posed, solved


@dataclass(frozen=True)
class Gain(Design):
    """Feedback of a loop gain below one, and a claim relative to the norm of the scaled loop."""

    gain: float
    claim: float = 1.0
    name = "gain"

    def solve(self, problem):
        p, through = problem, np.zeros_like(problem.D22)
        D = np.full(through.T.shape, self.gain / oracle.brute_norm(p.A, p.B2, p.C2, through, 0.0))
        K = StateSpace([], [], [], D, inputs=problem.y, outputs=problem.u)
        A, B, C, D22 = (getattr(lft(problem.system, K), m) for m in "ABCD")
        norm = self.claim * oracle.brute_norm(A, B, C, D22, 0.0)
        return SolvedController(K.A, K.B, K.C, K.D, norm, 0.0)

    def certify(self, solution):
        loop = lft(solution.plant.system, solution.K)
        certificate = certified_norm(loop, solution.found.gamma)
        return Controller(solution.K, "a gain", gamma=certificate["norm"], certificate=certificate)


def plant(seed, dt=0.0):
    """A stable plant of random states; in other units of u, y and time."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(4, 4))
    A -= (np.linalg.eigvals(A).real.max() + 20.0) * np.eye(4)
    A = 1e3 * A if not dt else 0.9 * A / np.abs(np.linalg.eigvals(A)).max()
    names = {"inputs": ["d", "f"], "outputs": ["e", "s"]}
    system = StateSpace(A, rng.normal(size=(4, 2)), rng.normal(size=(2, 4)), np.zeros((2, 2)), dt,
                        **names)  # fmt: skip
    return posed(system, ["f"], ["s"], "a test")


@pytest.mark.parametrize("dt", [0.0, 1e-3])
@pytest.mark.parametrize("seed", range(4))
def test_what_is_solved_in_scaled_coordinates_holds_on_the_plant(seed, dt):
    """The norm of the scaled loop by one author is that of the restored one by another."""
    P = plant(seed, dt)
    found = designed(Gain(0.3), P, None)
    K, g = found.system, P.system
    loop = oracle.closed_loop(oracle.split(g.A, g.B, g.C, g.D, 1, 1), K.A, K.B, K.C, K.D)
    assert oracle.brute_norm(*loop, dt) == pytest.approx(found.gamma, rel=2e-3)
    assert (K.name, K.inputs, K.outputs, K.dt) == ("gain", ("s",), ("f",), dt)


def test_a_claim_below_the_norm_is_refused():
    with pytest.raises(CertificateError, match="was claimed"):
        designed(Gain(0.3, claim=0.9), plant(0), None)


def test_a_mode_that_no_controller_holds_is_named_before_the_method_runs():
    A, B = np.diag([1.0, -1.0]), np.array([[1.0, 0.0], [1.0, 1.0]])
    system = StateSpace(A, B, np.ones((2, 2)), np.zeros((2, 2)), inputs=["d", "f"],
                        outputs=["e", "s"])  # fmt: skip
    with pytest.raises(AssumptionError, match=r"u \(f\) does not reach a mode"):
        solved(Gain(0.0), posed(system, ["f"], ["s"], "a test"))


def test_badly_scaled_states_are_the_cause():
    """Coordinates of a condition of 1e7: whatever fails, they are named."""
    rng = np.random.default_rng(1)
    left, right = (np.linalg.qr(rng.normal(size=(4, 4)))[0] for _ in range(2))
    T = left @ np.diag(np.geomspace(1.0, 1e7, 4)) @ right
    g = plant(1).system
    turned = g.replace(A=T @ g.A @ np.linalg.inv(T), B=T @ g.B, C=g.C @ np.linalg.inv(T))

    class Failing(Gain):
        def solve(self, problem):
            raise SolverError("this method fails.")

    with pytest.raises(SolverError, match=r"badly conditioned: A is .*this method fails"):
        solved(Failing(0.0), posed(turned, ["f"], ["s"], "a test"))
    with pytest.raises(SolverError, match=r"^this method fails"):
        solved(Failing(0.0), plant(1))


def test_plants_that_name_their_channels_take_no_others():
    with pytest.raises(ModelError, match="names its u and y"):
        posed(plant(0), ["f"], ["s"], "a test")
