"""Modes that no input moves or no output sees need no measurement and refuse nothing.

The structure is a chain along x, next to a chain along y that nothing joins to it. Its plants have
ports along x alone; the chain along x without the other one is the oracle.
"""

from functools import cache

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx
from flexplant.plant.visibility import untouched_modes

N = 8
#: mass that the drawing lacks [kg], softer spring, scatter of springs, seed
TRUE = 0.05, 0.04, 2e-3, 3


def chains(mass, softer=0.0, scatter=0.0, seed=0):
    """M and K of the chain along x, held at its first mass, which has another last mass."""
    rng = np.random.default_rng(seed)
    steps = np.eye(N) - np.eye(N, k=-1)
    k = 4e6 * (1.0 + 0.2 * np.cos(np.arange(N))) * np.exp(scatter * rng.standard_normal(N))
    k[3] *= 1.0 - softer
    m = np.linspace(2.0, 1.0, N)
    m[-1] += mass
    return np.diag(m), steps.T @ (k[:, None] * steps)


def freqs(M, K):
    return np.sqrt(la.eigh(K, M, eigvals_only=True)) / (2 * np.pi)


def other_chain():
    """M and K of the chain along y, whose third frequency is just below the third along x."""
    M, K = chains(0.0, seed=1)
    M[0, 0] *= 1.7
    return M, K * (0.9985 * freqs(*chains(*TRUE))[2] / freqs(M, K)[2]) ** 2


@cache
def drawn(both):
    M, K = chains(0.0)
    directions = ["x"] * N
    if both:
        other = other_chain()
        M, K = la.block_diag(M, other[0]), la.block_diag(K, other[1])
        directions += ["y"] * N
    nodes = [*range(1, N + 1)] * (1 + both)
    return fx.FEModel(M, K, dofs=fx.DofSet(nodes, directions, [[n, 0.0, 0.0] for n in nodes]))


def fitted(both, outlier=0.0):
    """The calibrated plant; `outlier`: relative error of the first pole measured along y."""
    model = drawn(both)
    modes = fx.solve_modes(model, count=model.n_dof, damping=fx.ModalDamping(0.005))
    own = freqs(*chains(*TRUE))[:7]
    along_x = freqs(*chains(0.0))
    numbers = [int(np.argmin(np.abs(modes.freq - f))) + 1 for f in along_x[:7]]
    if both and outlier:
        y = freqs(*other_chain())[:2] * [1.0 + outlier, 1.0]
        own = np.append(own, y)
        numbers += [int(np.argmin(np.abs(modes.freq - f))) + 1 for f in y / [1.0 + outlier, 1.0]]
    measured = fx.MeasuredModes.from_freq(
        own, 0.005, modes=numbers, freq_std=1e-5 * own, zeta_std=1e-5
    )
    spring = fx.AddedStiffness({"3:x": -1.0, "4:x": 1.0}, name="spring")
    labels = modes.dofs.labels
    fit = fx.update(
        fx.reduce(modes, fx.DesiredDofs(labels)),
        [fx.AddedMass(f"{N}:x", name="mass"), spring],
        [fx.Eigenvalues(measured.replace(covariance=None))],
    )
    whole = fx.solve_modes(fit.applied_to(model), count=model.n_dof, damping=fx.ModalDamping(0.005))
    return fit.calibrated(measured), whole.calibrated(measured)


def plant(both, outlier=0.0, seen="x", delay=1.0):
    model, whole = fitted(both, outlier)
    at = {"5:x": 1.0} if seen == "x" else {"5:x": 1.0, "5:y": 1.0}
    ports = fx.Ports(
        w=[fx.Disturbance("push", at="8:x", asd=1e-2), fx.Disturbance("side", at="2:y", asd=1e-2)]
        if both
        else [fx.Disturbance("push", at="8:x", asd=1e-2)],
        u=[fx.Actuator("motor", at="1:x")],
        z=[fx.Poi("tool", at=at, axes=("x",))],
        y=[fx.Sensor("encoder", at="8:x", asd=1e-9)],
    )
    return fx.assemble_plant(model, ports, evaluation=whole).discretized(5e3, delay=delay)


@pytest.mark.slow
def test_untouched_modes_are_those_of_the_other_chain():
    found = untouched_modes(plant(both=True))
    frequencies = np.sort(np.append(freqs(*chains(*TRUE)), freqs(*other_chain())))
    assert len(found) == N
    for number in found:
        assert np.min(np.abs(frequencies[number - 1] / freqs(*other_chain()) - 1)) < 0.02
    assert untouched_modes(plant(both=False)) == ()
    assert untouched_modes(plant(both=True, seen="both")) == ()


@pytest.mark.long
@pytest.mark.parametrize("outlier", [0.0, 0.05])
def test_an_interval_does_not_need_the_modes_that_nothing_touches(outlier):
    observer, alone = (fx.design_kalman(plant(both, outlier * both)) for both in (True, False))
    found, expected = observer.interval("tool:x"), alone.interval("tool:x")
    assert "which the channels do not touch" in found.sentence
    np.testing.assert_allclose(observer.rms("tool:x"), alone.rms("tool:x"), rtol=1e-3)
    # in other machines the close modes mix, so that the interval is wider
    assert found.low < 1.001 * expected.low
    assert found.high > 0.999 * expected.high
    assert found.high / found.low < 1.1


@pytest.mark.slow
def test_a_mode_that_matters_must_be_measured():
    said = fx.design_kalman(plant(both=True, seen="both")).interval("tool:x").sentence
    assert said.startswith("no interval: mode ")
    assert "was not measured" in said


def test_calibrations_one_after_the_other_are_those_of_both():
    """Intervals were those of the last one: 530 to 956 nm about an error of 157 nm."""
    model = drawn(both=False)
    modes = fx.solve_modes(model, count=N, damping=fx.ModalDamping(0.005))
    own = freqs(*chains(*TRUE))[:7]
    low, high = (
        fx.MeasuredModes.from_freq(
            own[some], 0.006, modes=np.arange(1, 8)[some], freq_std=1e-5 * own[some], zeta_std=1e-5
        )
        for some in (slice(3), slice(3, 7))
    )
    fit = fx.update(
        fx.reduce(modes, fx.DesiredDofs(modes.dofs.labels)),
        [fx.AddedMass(f"{N}:x")],
        [fx.Eigenvalues(low.merged(high).replace(covariance=None))],
    )
    each, together = fit.calibrated(low).calibrated(high), fit.calibrated(low.merged(high))
    np.testing.assert_allclose(each.modes().poles, together.modes().poles, rtol=1e-9)
    assert each.machines.measured.modes == together.machines.measured.modes == (*range(1, 8),)
    whole = modes.calibrated(low).calibrated(high)
    np.testing.assert_allclose(whole.freq[:7], own, rtol=1e-12)
    assert whole.calibration.modes == (*range(1, 8),)
    again = each.calibrated(low.replace(poles=1.001 * low.poles))
    np.testing.assert_allclose(
        again.modes().freq[:7], np.append(1.001 * own[:3], own[3:]), rtol=1e-6
    )
