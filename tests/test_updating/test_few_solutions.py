"""A search of data that do not fit costs few eigenvalue problems, and ends where all of it ends."""

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx
from flexplant.errors import FlexplantError
from flexplant.updating import searching
from flexplant.updating.family import Family, Point

pytestmark = pytest.mark.filterwarnings("ignore::flexplant.errors.FlexplantWarning")


@pytest.fixture
def solved(monkeypatch):
    """A list that grows by one with every eigenvalue problem."""
    calls, solve = [], Family._solved
    monkeypatch.setattr(Family, "_solved", lambda self, p: (calls.append(1), solve(self, p))[1])
    return calls


def scattered(rom, count, seed, share):
    """Poles of the model with a random relative error that no parameter explains."""
    rng = np.random.default_rng(seed)
    values = la.eigvals(
        np.block(
            [
                [np.zeros_like(rom.M), np.eye(len(rom.M))],
                [-np.linalg.solve(rom.M, rom.K), -np.linalg.solve(rom.M, rom.D)],
            ]
        )
    )
    poles = values[values.imag > 100]
    poles = poles[np.argsort(np.abs(poles))][:count] * (1 + share * rng.standard_normal(count))
    std = 1e-4 * np.abs(poles)
    return fx.MeasuredModes(poles, modes=range(4, 4 + count), covariance=std**2)


def parameters(plate, rom, count):
    places = [plate.z8, *plate.grid[3:5]]
    found = [
        fx.AddedMass(places[0]),
        fx.MatrixParameter("E", dK=rom.K),
        fx.AddedDamping(places[0]),
        fx.AddedMass(places[1]),
    ]
    return found[:count]


@pytest.mark.slow
@pytest.mark.parametrize(("count", "modes", "seed", "most"), [
    pytest.param(4, 14, 0, 1200, marks=pytest.mark.long), (4, 10, 1, 800), (2, 8, 2, 600)
])  # fmt: skip
def test_data_that_do_not_fit_are_few_eigenvalue_problems(plate, solved, count, modes, seed, most):
    """1534 and 1401 of the first two when every start was searched to its end.

    How many starts meet in one minimum hangs on rounding: the first takes 480 to 1080, the second
    430 to 700.
    """
    rom = plate.reduced(0.01, True)
    data = scattered(rom, modes, seed, 0.003)
    fit = fx.update(rom, parameters(plate, rom, count), [fx.Eigenvalues(data)])
    assert fit.p_value < 1e-4
    assert len(solved) < most


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(0, 12, 2))
def test_the_answer_is_that_of_all_starts_searched_to_their_end(monkeypatch, seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(5, 10))
    m, k = rng.uniform(1, 2, n), rng.uniform(0.5e6, 2e6, n)
    lower = np.eye(n) - np.eye(n, k=-1)
    K = lower.T @ np.diag(k) @ lower
    dofs = fx.DofSet(range(1, n + 1), ["x"] * n, np.column_stack([np.arange(n), np.zeros((n, 2))]))
    model = fx.FEModel(np.diag(m), K, 2e-5 * K, dofs=dofs)
    a, b, c = rng.permutation(n)[:3].tolist()
    other = K + 0.5 * k[c] * np.outer(lower[c], lower[c])
    heavy = np.diag(m + np.eye(n)[a] * rng.uniform(0.2, 1.0))
    omega = np.sqrt(la.eigh(other, heavy, eigvals_only=True))[: n - 1]
    poles = -1e-5 * omega**2 + 1j * omega
    measured = fx.MeasuredModes(poles, modes=range(1, n), covariance=(1e-4 * omega) ** 2)
    given = [
        fx.AddedMass(f"{a + 1}:x"),
        fx.MatrixParameter("k", dK=np.outer(lower[b], lower[b]) * k[b]),
    ]

    def answer():
        try:
            return fx.update(model, given, [fx.Eigenvalues(measured)])
        except FlexplantError as error:
            return str(error)

    quick = answer()
    monkeypatch.setattr(searching, "GLANCE", 200)
    monkeypatch.setattr(searching, "WORTH", np.inf)
    monkeypatch.setattr(searching, "AGREED", 1000)
    whole = answer()
    if isinstance(quick, str):
        assert quick == whole
    elif whole.converged:
        assert quick.converged
        np.testing.assert_allclose(quick.values, whole.values, rtol=1e-5, atol=1e-6)


def test_a_point_to_which_modes_were_followed_is_not_solved_again(plate, solved):
    rom = plate.reduced(0.01, True)
    data = scattered(rom, 8, 0, 1e-3)
    objective = fx.updating.search.Objective(rom, parameters(plate, rom, 2), [fx.Eigenvalues(data)])
    path = [np.array([0.01 * i, 1e-3 * i]) for i in range(6)]
    point = objective.follow(path)
    solutions = len(solved)
    again = objective.follow(path[-1:], point)
    assert isinstance(point, Point) and again is point
    assert len(solved) == solutions


def test_starts_of_a_parameter_that_moves_few_modes_are_of_its_own_size(monkeypatch):
    """Two springs of a machine of 14 modes: starts of 1e25, since other modes move by rounding."""
    apart = 8
    rng = np.random.default_rng(5)
    masses, springs = rng.uniform(1.0, 2.0, 14), rng.uniform(1e6, 2e6, 14)
    springs[apart] = 1e-6  # the last six masses are a machine of their own, but for rounding
    K = np.diag(springs + np.append(springs[1:], 0.0))
    K -= np.diag(springs[1:], 1) + np.diag(springs[1:], -1)
    K[apart, apart] += 1e6
    model = fx.FEModel(np.diag(masses), K)
    rom = fx.reduce(
        fx.solve_modes(model, damping=fx.ModalDamping(0.01)), fx.DesiredDofs(model.dofs)
    )
    parts = [np.zeros_like(K), np.zeros_like(K)]
    parts[0][:apart, :apart], parts[1][-2:, -2:] = K[:apart, :apart], K[-2:, -2:]
    unknown = [fx.MatrixParameter(name, dK=dK) for name, dK in zip("ab", parts, strict=True)]
    poles = rom.modes().poles * (1 + 0.02 * rng.normal(size=14))
    data = fx.MeasuredModes(poles, modes=range(1, 15), covariance=(1e-4 * np.abs(poles)) ** 2)
    drawn, scattered = [], searching._scattered
    monkeypatch.setattr(
        searching, "_scattered", lambda *given: drawn.extend(found := scattered(*given)) or found
    )
    fx.update(rom, unknown, [fx.Eigenvalues(data)])
    assert drawn and np.max(np.abs(drawn)) < 2.0
