"""Whether what an update leaves grows with frequency: against regressions and plates of theory."""

import numpy as np
import pytest
import scipy.stats

import flexplant as fx
from flexplant.errors import ModelError
from flexplant.updating import Trend
from oracles_mindlin import mindlin_frequencies


def trend_of(rng, m=9, q=2, s=2e-3, b=0.0, dp=None, shaped=True):
    """A trend of random sensitivities with a slope and scatter."""
    model = np.sort(rng.uniform(100.0, 2000.0, size=m))
    S = rng.normal(size=(m, q))
    dp = rng.normal(size=q) * 0.01 if dp is None else dp
    freq = model.copy()
    for _ in range(30):  # g is of the measured frequencies
        y = S @ dp + b * freq / freq.max()
        freq = model * np.exp(y)
    e = rng.normal(size=m)
    return Trend(tuple(range(4, 4 + m)), freq * np.exp(s * e), model, S, tuple(range(q)), shaped)


def regression(trend):
    """Estimates, covariance / s^2 and s of ordinary least squares."""
    X = np.column_stack([trend.S, trend.freq / trend.freq.max()])
    y = np.log(trend.freq / trend.model_freq)
    found = np.linalg.lstsq(X, y)[0]
    left = y - X @ found
    s = np.sqrt(left @ left / (y.size - X.shape[1]))
    return found, np.linalg.inv(X.T @ X), s


@pytest.mark.parametrize("seed", range(5))
def test_it_is_a_regression(seed):
    rng = np.random.default_rng(seed)
    trend = trend_of(rng, m=int(rng.integers(6, 14)), q=int(rng.integers(1, 4)), b=-0.01)
    found, C, s = regression(trend)
    assert trend.slope == pytest.approx(found[-1], rel=1e-8)
    assert trend.deviation == pytest.approx(s, rel=1e-8)
    deviation = s * np.sqrt(C[-1, -1])
    assert trend.slope_deviation == pytest.approx(deviation, rel=1e-8)
    p = 2 * scipy.stats.t.sf(abs(found[-1]) / deviation, trend.dof)
    assert trend.p_value == pytest.approx(p, rel=1e-6)
    assert trend.is_significant == (p < 0.003)


def test_chance_alone_rejects_as_seldom_as_it_says():
    rng = np.random.default_rng(1)
    p = np.array([trend_of(rng).p_value for _ in range(400)])
    assert scipy.stats.kstest(p, "uniform").pvalue > 0.01
    assert np.mean([trend_of(rng).outlier is not None for _ in range(400)]) < 0.015


def test_a_slope_is_found():
    rng = np.random.default_rng(2)
    found = [trend_of(rng, s=1e-3, b=-0.01) for _ in range(50)]
    assert np.mean([one.slope for one in found]) == pytest.approx(-0.01, abs=4e-4)
    assert np.mean([one.is_significant for one in found]) > 0.8
    assert "grows with frequency" in next(one for one in found if one.is_significant).missing


def test_the_posterior_is_student_s():
    trend = trend_of(np.random.default_rng(3), m=12, q=2)
    rng = np.random.default_rng(4)
    draws = [trend.posterior(rng) for _ in range(20_000)]
    found, C, s = regression(trend)
    slopes = np.array([b for *_, b in draws])
    ratio = (slopes - found[-1]) / (s * np.sqrt(C[-1, -1]))
    assert scipy.stats.kstest(ratio, scipy.stats.t(trend.dof).cdf).pvalue > 0.01
    own = np.array([dp[0] for _, dp, _ in draws])
    spread = np.sqrt(C[0, 0]) * s * np.sqrt(trend.dof / (trend.dof - 2))
    assert own.std() == pytest.approx(spread, rel=0.05)
    sizes = trend.dof * s**2 / np.array([one for one, *_ in draws]) ** 2
    assert scipy.stats.kstest(sizes, scipy.stats.chi2(trend.dof).cdf).pvalue > 0.01


def test_a_mode_with_a_wrong_number_is_named():
    trend = trend_of(np.random.default_rng(5), m=10)
    freq = trend.freq.copy()
    freq[6] *= 0.94
    found = trend.replace(freq=freq)
    mode, off = found.outlier
    assert mode == 10
    assert off == pytest.approx(-0.06, abs=0.02)
    assert "mode 10" in found.missing


def test_close_pairs_without_shapes_are_named():
    rng = np.random.default_rng(6)
    model = np.array([200.0, 415.0, 416.0, 700.0, 900.0, 1300.0])
    S = rng.normal(size=(6, 1))
    freq = model * np.exp(3e-3 * rng.normal(size=6))
    trend = Trend((4, 5, 6, 7, 8, 9), freq, model, S, (0,), False)
    assert trend.unshaped_pairs == ((5, 6),)
    assert "modes 5 and 6 may be swapped" in trend.missing
    assert trend.replace(shaped=True).unshaped_pairs == ()


def test_a_mode_within_its_noise_is_no_outlier():
    """Exact but for one frequency: by its own deviation, and then by twenty of them."""
    trend = trend_of(np.random.default_rng(8), m=9, q=1, s=1e-6, b=0.0)
    noise = np.full(9, 1e-6)
    noise[3] = 3e-4
    freq = trend.freq * np.exp(np.where(np.arange(9) == 3, 3e-4, 0.0))
    assert trend.replace(freq=freq).outlier[0] == trend.modes[3]
    assert trend.replace(freq=freq, noise=np.full(9, 1e-6)).outlier[0] == trend.modes[3]
    assert trend.replace(freq=freq, noise=noise).outlier is None
    further = freq * np.exp(np.where(noise > 1e-5, 20.0 * noise, 0.0))
    assert trend.replace(freq=further, noise=noise).outlier[0] == trend.modes[3]


def test_too_few_modes_say_how_many_are_needed():
    trend = trend_of(np.random.default_rng(7), m=3, q=2)
    assert trend.dof == 0
    assert "measure 4 modes or more" in trend.missing
    assert not trend.is_significant
    with pytest.raises(ModelError, match="posterior"):
        trend.posterior(np.random.default_rng(1))


SIZE, THICKNESS = (0.5, 0.42), 0.02
MATERIAL = {"density": 2700.0, "youngs_modulus": 70e9, "poisson_ratio": 0.33}


@pytest.mark.slow
@pytest.mark.parametrize(("make", "lacks"), [(fx.kirchhoff_plate, True), (fx.plate, False)])
def test_plates_are_told_to_lack_shear(make, lacks):
    """A thick plate in polynomials, measured, and a thin and a thick drawing of it."""
    rng = np.random.default_rng(8)
    freq = mindlin_frequencies(SIZE, THICKNESS, 2700.0, 71e9, 0.33, order=13, count=15)
    freq = freq * np.exp(2e-4 * rng.normal(size=freq.size))
    poles = 2 * np.pi * freq * (-0.01 + 1j)

    def modes(nx, ny):
        model = make(size=SIZE, thickness=THICKNESS, elements=(nx, ny), **MATERIAL)
        return fx.solve_modes(model, count=24)

    fine = modes(30, 25).extrapolated(modes(20, 17))
    rom = fx.reduce(fine, fx.DesiredDofs(fx.select_dofs(fine, 24).labels))
    measured = fx.MeasuredModes(poles, modes=range(4, 19))
    fit = fx.update(rom, [fx.MatrixParameter("E", dK=rom.K)], [fx.Eigenvalues(measured)])
    trend = fit.trend()
    assert trend.is_significant == lacks
    assert ("grows with frequency" in repr(fit)) == lacks
    if lacks:
        # theory: the shear and rotary inertia of the highest wave, less the mean that E takes
        assert trend.slope < -0.02
    else:
        assert abs(trend.slope) < 4e-3


def test_a_mode_that_was_not_measured_beside_one_that_was_is_named():
    """Two modes so near that scatter mixes them; of one that is far nothing is said."""
    rng = np.random.default_rng(3)
    model = np.array([100.0, 180.0, 260.0, 330.0, 470.0, 560.0])
    freq = model * np.exp(2e-3 * rng.normal(size=6))
    S = np.ones((6, 1))

    def trend(other):
        given = ((9,), np.array([other]))
        return fx.updating.Trend((4, 5, 6, 7, 8, 10), freq, model, S, (0,), True, *given)

    near = 260.0 * (1.0 + 5.0 * trend(400.0).deviation)
    assert trend(400.0).half_measured_pairs == ()
    assert trend(near).half_measured_pairs == ((6, 9),)
    assert "mode 9 was not measured" in trend(near).missing
