"""One engine: every method is a value with a search; steps end at rounding, not beyond it."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import minimize

import oracles_updating as oracle
from flexplant.identification import MeasuredModes
from flexplant.modes import solve_modes
from flexplant.reduction import DesiredDofs, reduce, select_dofs
from flexplant.structure import ModalDamping
from flexplant.updating import (
    AddedDamping,
    AddedMass,
    Eigenvalues,
    GaussNewton,
    TrustRegion,
    UpdateMethod,
    update,
)
from flexplant.updating.search import SearchEnd
from flexplant.updating.search.least_squares import Trail


@pytest.mark.slow
def test_scattered_poles_converge_with_every_gauss_newton(plate):
    """Poles scattered by 1e-6: full steps at rounding level are neither refused nor repeated."""
    rom, target = plate.reduced(0.01, True), oracle.truth(0.01)
    parameters = [AddedMass(plate.z8), AddedDamping(plate.z8)]
    rng = np.random.default_rng(0)
    for _ in range(6):
        noise = 1e-6 * np.abs(target) * (rng.normal(size=2) + 1j * rng.normal(size=2))
        data = [Eigenvalues(MeasuredModes(target + noise, modes=[6, 7]))]
        paper = update(rom, parameters, data)
        cut = update(rom, parameters, data, method=GaussNewton(truncate=1e-12))
        for fit in (paper, cut):
            assert fit.converged
            assert len(fit.history) <= 5
        assert abs(paper.values[0] - cut.values[0]) < 1e-9  # kg
        assert paper.values[1] == pytest.approx(cut.values[1], abs=1e-5)  # N s/m


@pytest.mark.parametrize("method", [GaussNewton(), GaussNewton(truncate=1e-9)])
def test_the_stopping_test_is_relative(make, method):
    """Weights in any unit: the same number of steps to the same answer."""
    model = make([1, 2, 1.5], [(0, None, 90), (0, 1, 110), (1, 2, 70)], beta=2e-3)
    M = np.array(model.M)
    M[1, 1] += 0.3
    target = oracle.poles(M, model.D, model.K) * [1.001, 1.0, 0.999]
    fits = []
    for unit in (1e-6, 1.0, 1e6):
        data = Eigenvalues(MeasuredModes(target, modes=[1, 2, 3]), weights=np.full(3, unit))
        fits.append(update(model, [AddedMass("2:z")], [data], method=method))
    assert all(fit.converged for fit in fits)
    assert {fit.reason for fit in fits} == {"step below the tolerance"}
    assert len({len(fit.history) for fit in fits}) == 1
    assert np.ptp([fit.values[0] for fit in fits]) < 1e-10


@dataclass(frozen=True, eq=False)
class Simplex(UpdateMethod):
    """Nelder and Mead's method on the sum of squares: a method made outside of the library."""

    def search(self, objective, start, *, most=None, tolerance=1e-10):
        """Return where the simplex ends."""
        trail = Trail()
        objective.begin(start)
        trail.add(objective, start, 0.0)

        def cost(p):
            return float(np.sum(objective.values(objective.at(p)) ** 2)) / 2

        found = minimize(cost, start, method="Nelder-Mead", tol=1e-9, options={"maxiter": 400})
        objective.at(found.x, refer=True)
        trail.add(objective, found.x, 1.0)
        return SearchEnd(found.x, found.fun, trail, found.success, found.message)


@pytest.mark.slow
def test_a_new_method_is_a_value_with_a_search(make):
    model = make([1, 2], [(0, None, 90), (0, 1, 110)], beta=2e-3)
    M = np.array(model.M)
    M[1, 1] += 0.3
    data = [Eigenvalues(MeasuredModes(oracle.poles(M, model.D, model.K), modes=[1, 2]))]
    own = update(model, [AddedMass("2:z")], data, method=Simplex())
    best = update(model, [AddedMass("2:z")], data, method=TrustRegion())
    assert own.values[0] == pytest.approx(best.values[0], abs=1e-6)


@pytest.mark.long
def test_poles_that_are_paired_wrongly_are_fitted_from_elsewhere(plate):
    """Three masses and poles alone: five of these machines end in a wrong minimum from zero.

    Where a search from one start ends hangs on rounding: one of them may be missed.
    """
    modes = solve_modes(plate.model, count=25, damping=ModalDamping(0.01))
    rom = reduce(modes, DesiredDofs(select_dofs(modes, 25)))
    places, tried, right = list(rom.dofs.labels), 0, 0
    for seed in (1, 2, 3, 5, 6, 7):
        rng = np.random.default_rng(seed)
        at, masses = rng.choice(25, 3, replace=False), rng.uniform(0.2, 1.5, 3)
        M = np.array(rom.M)
        M[at, at] += masses
        poles = oracle.poles(M, rom.D, rom.K)
        data = Eigenvalues(MeasuredModes(poles[poles.imag > 300][:8], modes=range(4, 12)))
        fit = update(rom, [AddedMass(places[i]) for i in at], [data])
        right += np.allclose(fit.values, masses, rtol=1e-6)
        tried += fit.starts is not None
    assert tried >= 4 and right >= 5
