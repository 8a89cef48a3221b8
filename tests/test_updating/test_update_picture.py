"""The one picture of an update holds what the update and the correlation say."""

import numpy as np
import pytest

import flexplant as fx
import oracles_updating as oracle
from flexplant.errors import ModelError


@pytest.fixture
def case(make):
    links = [(0, None, 90), (0, 1, 110), (1, 2, 70), (2, 3, 130), (3, None, 60)]
    model = make([1, 2, 1.5, 1.2], links, beta=2e-3)
    M = np.array(model.M)
    M[1, 1] += 0.02
    poles = oracle.poles(M, model.D, model.K)
    shapes = (
        np.linalg.inv(np.linalg.cholesky(M)).T
        @ (
            np.linalg.eigh(
                np.linalg.inv(np.linalg.cholesky(M))
                @ model.K
                @ np.linalg.inv(np.linalg.cholesky(M)).T
            )[1]
        )
    )
    measured = fx.MeasuredModes(poles, modes=[1, 2, 3, 4], covariance=(1e-3 * np.abs(poles)) ** 2)
    freq = np.linspace(0.3, 3.0, 60)
    s = 2j * np.pi * freq
    H = np.array([np.linalg.inv(x * x * M + x * model.D + model.K)[1:2, :1] for x in s])
    frf = fx.Frf(freq, np.moveaxis(H, 0, 2), inputs=["1:z"], outputs=["2:z"])
    frf = frf.replace(variance=np.full(frf.data.shape, 1e-4))
    at = [f"{i}:z" for i in range(1, 5)]
    residuals = [
        fx.Eigenvalues(measured),
        fx.ModeShapes(measured, shapes, at, std=0.01),
        fx.FrfResidual(frf),
    ]
    unknown = [fx.AddedMass("2:z", prior=(0.0, 0.5)), fx.AddedStiffness("4:z")]
    return model, residuals, fx.update(model, unknown, residuals)


@pytest.mark.slow
def test_everything_is_in_it(case):
    model, residuals, fit = case
    axs = fx.plot.update(fit, model, residuals)
    assert set(axs) == {
        "frequencies",
        "damping",
        "mac before",
        "mac after",
        "parameters",
        "convergence",
        "response",
    }
    before, after = (fx.updating.correlate(m, residuals) for m in (model, fit.model))
    bars = [bar.get_height() for bar in axs["frequencies"].patches]
    np.testing.assert_allclose(bars, 100 * np.r_[before.freq_error, after.freq_error], atol=1e-12)
    np.testing.assert_allclose(axs["mac before"].images[0].get_array(), before.mac)
    np.testing.assert_allclose(axs["mac after"].images[0].get_array(), after.mac)
    np.testing.assert_allclose(axs["convergence"].lines[0].get_ydata(), fit.history.error)
    rows = axs["parameters"].child_axes
    titles = [row.get_title(loc="left") for row in rows]
    assert titles[0].startswith(f"mass at 2:z: {1e3 * fit.values[0]:.4g} \N{PLUS-MINUS SIGN} ")
    assert titles[0].endswith(" g")
    assert [len(row.patches) for row in rows] == [1, 0]  # the prior of one of the two
    mass = next(line for line in rows[0].lines if line.get_marker() == "o")
    assert float(mass.get_xdata()[0]) == pytest.approx(1e3 * fit.values[0], rel=1e-12)
    lines = {line.get_label(): line.get_ydata() for line in axs["response"].lines}
    assert set(lines) == {"measured", "before", "after"}
    np.testing.assert_allclose(lines["after"], lines["measured"], rtol=1e-3)
    assert np.abs(lines["before"] / lines["measured"] - 1).max() > 0.1


@pytest.mark.slow
def test_only_what_was_measured_is_in_it(case):
    model, residuals, _ = case
    fit = fx.update(model, [fx.AddedMass("2:z")], residuals[:1])
    axs = fx.plot.update(fit, model, residuals[:1])
    assert set(axs) == {"frequencies", "damping", "parameters", "convergence"}
    axs = fx.plot.update(fit, model, residuals[:1], unused=residuals[2].measured)
    assert "response" in axs
    with pytest.raises(ModelError, match="update returned"):
        fx.plot.update(model, model, residuals)
