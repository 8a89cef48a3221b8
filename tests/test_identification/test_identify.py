"""Poles and shapes from responses of known modes; the truth is the oracle."""

import warnings

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from flexplant.errors import FlexplantWarning, LabelError, ModelError, ShapeError, SolverError
from flexplant.identification import (
    IdentifiedModes,
    MeasuredModes,
    PoleSelection,
    identify_modes,
    stabilisation_diagram,
)
from flexplant.identification.refine import Lines, _Projected, refined
from flexplant.identification.unexplained import completed, unexplained
from flexplant.lti import Frf
from flexplant.store import load
from oracles_identification import held_mode, mac, modal_frf, noisy, pole

FREQ = np.arange(20.0, 200.0, 0.1)
#: a pair that a peer merged, one 0.1 % apart, one repeated, at 0.1 % damping
CLOSE = pole([47.5, 48.2, 90.0, 90.09, 120.0, 120.0, 160.0], 1e-3)
RNG = np.random.default_rng(0)
PHI = RNG.normal(size=(5, 7))
ORDERS = range(2, 31)


def measured(poles=CLOSE, phi=PHI, n_in=3, level=1e-4, seed=1, freq=FREQ, rigid=True, known=True):
    """Noisy responses; noise is a share of their rms, below the rigid-body line."""
    mass = np.ones((phi.shape[0], n_in)) * 0.5 if rigid else None
    H = modal_frf(
        freq, poles, phi, phi[:n_in], rigid=mass, static=np.full(phi[:, :n_in].shape, 1e-7)
    )
    deviation = level * np.sqrt(np.mean(np.abs(H) ** 2))
    variance = np.full(H.shape, deviation**2) if known else None
    data = noisy(H, deviation, np.random.default_rng(seed))
    return Frf(freq, data, variance=variance, quantity="displacement")


def z_scores(found, truth):
    error = found.poles - truth
    return np.concatenate([error.real / found.std.real, error.imag / found.std.imag])


def test_close_and_repeated_modes_with_rigid_body_motion():
    frf = measured()
    found = identify_modes(frf, orders=ORDERS, dofs={"u1": "7:z", "y1": "7:z", "y2": "9:z"})
    assert isinstance(found, MeasuredModes)
    assert len(found) == 7
    order = np.array([0, 1, 2, 3, *(4 + np.argsort(np.abs(found.poles[4:6] - CLOSE[4]))), 6])
    z = z_scores(found.select(order.tolist()), CLOSE)
    assert np.abs(z).max() < 3.5
    assert 0.9 < found.misfit < 1.1
    assert found.dofs[:3] == ("7:z", "9:z", "y3")
    assert found.mass_normalised
    for k in (0, 1, 2, 3, 6):
        assert np.abs(np.abs(found.shapes[:, k]) / np.abs(PHI[:, k]) - 1).max() < 0.03
        assert mac(found.shapes[:, k], PHI[:, k]) > 0.999
    span = np.linalg.qr(PHI[:, 4:6])[0]
    for k in (4, 5):
        unit = found.shapes[:, k] / np.linalg.norm(found.shapes[:, k])
        assert np.linalg.norm(span.T @ unit) ** 2 > 0.999
    rest = np.abs(found.frf(FREQ).data - frf.data) / np.sqrt(frf.variance)
    assert np.sqrt(np.mean(rest**2)) < 1.05


def test_the_pair_that_was_merged_and_the_mode_that_became_zero():
    """One reference, poles at 47.5 and 48.2 Hz; sdypy-EMA merged them and gave a 0 Hz mode."""
    truth = pole([47.5, 48.2, 112.0], [0.004, 0.004, 0.01])
    frf = measured(truth, PHI[:, :3], n_in=1, level=1e-3, known=False)
    found = identify_modes(frf, orders=ORDERS)
    assert len(found) == 3
    assert np.all(found.freq > 40.0)
    assert np.abs(z_scores(found, truth)).max() < 3.5
    assert np.abs(found.freq / (np.abs(truth) / 2 / np.pi) - 1).max() < 1e-4


def test_a_missed_mode_is_warned_of_and_a_merged_one_added():
    """Started without the 90.09 Hz neighbour: by hand it is warned of; left alone it is there."""
    frf = measured(freq=np.arange(80.0, 100.0, 0.02), level=1e-2)
    start = PoleSelection(CLOSE[[2]], PHI[:3, [2]])
    with pytest.warns(FlexplantWarning, match=r"missed or merged .*"):
        alone = identify_modes(frf, start=start)
    score = np.abs(alone.poles - CLOSE[2]) / np.abs(alone.std)
    assert score[0] > 4  # as it was without a word
    lines = Lines(frf.freq, frf.data, np.sqrt(2.0 / frf.variance), 2, 3, None)
    fit = refined(lines, CLOSE[[2]], PHI[:3, [2]].astype(complex), steps=150)
    assert unexplained(lines, fit)[0].freq == pytest.approx(90.04, abs=0.1)
    fit, left = completed(lines, fit, steps=150)
    assert not left
    assert fit.poles.size == 2
    found = identify_modes(frf, orders=range(2, 21))
    assert len(found) == 2
    assert np.abs(z_scores(found, CLOSE[2:4])).max() < 3.5
    assert np.abs(np.sort_complex(fit.poles) - np.sort_complex(found.poles)).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False], ids=["variance", "no variance"])
def test_no_pole_is_lost_in_silence_and_the_doubt_is_honest(known):
    """100 sets of 40 dB, random shapes, pairs and a free machine: poles and z-scores."""
    truth = pole([47.5, 48.2, 90.0, 90.5, 120.0, 120.0], [4e-3, 4e-3, 2e-3, 2e-3, 3e-3, 3e-3])
    freq, scores, lost = np.arange(35.0, 140.0, 0.25), [], 0
    for seed in range(100 if known else 30):
        phi = np.random.default_rng(seed).normal(size=(4, 6))
        frf = measured(truth, phi, n_in=2, level=1e-2, seed=seed, freq=freq, known=known)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            found = identify_modes(frf, orders=range(2, 25))
        pairs = linear_sum_assignment(np.abs(found.poles[:, None] - truth))
        error, std = found.poles[pairs[0]] - truth[pairs[1]], found.std[pairs[0]]
        score = np.concatenate([error.real / std.real, error.imag / std.imag])
        if not said:
            scores.append(score)
        lost += len(found) < truth.size and not said
    rms = np.sqrt(np.mean(np.concatenate(scores) ** 2))
    print(f"z-score rms {rms:.3f}, largest {np.abs(np.concatenate(scores)).max():.1f}, lost {lost}")
    assert 0.8 < rms < 1.25
    # a pole too weak to be seen: then its neighbours are not off either
    assert np.abs(np.concatenate(scores)).max() < 4.5
    assert lost <= 0.06 * (100 if known else 30)


@pytest.mark.slow
def test_without_noise_to_machine_precision():
    frf = measured(level=0.0, known=False)
    found = identify_modes(frf, orders=ORDERS)
    assert len(found) == 7
    assert np.abs(found.poles[np.argsort(found.poles.imag)] / CLOSE - 1).max() < 1e-9


@pytest.mark.slow
def test_without_variance_doubt_comes_from_what_is_left():
    found = identify_modes(measured(known=False), orders=ORDERS)
    known = identify_modes(measured(), orders=ORDERS)
    assert len(found) == 7
    assert np.all(np.abs(found.std.real / known.std.real - 1)[[2, 3, 6]] < 0.5)
    assert np.abs(z_scores(found, known.poles)).max() < 4.0


def test_fewer_outputs_than_inputs():
    frf = measured(n_in=3).select(outputs=["y1", "y2"])
    found = identify_modes(frf, orders=ORDERS)
    assert len(found) == 7
    assert found.shapes.shape == (2, 7)
    assert found.participation.shape == (3, 7)
    for k in (0, 1, 2, 3, 6):
        assert mac(found.participation[:, k], PHI[:3, k]) > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("quantity", ["velocity", "acceleration"])
def test_the_quantity_and_the_unit_do_not_matter(quantity):
    frf = measured()
    base = identify_modes(frf, orders=ORDERS)
    other = frf.replace(data=frf.data * 1e-9, variance=frf.variance * 1e-18).converted(quantity)
    found = identify_modes(other, orders=ORDERS)
    assert np.abs(found.poles / base.poles - 1).max() < 1e-8
    assert np.allclose(found.std, base.std, rtol=1e-4)


@pytest.mark.slow
def test_poles_by_hand_give_the_same_fit(tmp_path):
    frf = measured()
    diagram = stabilisation_diagram(frf, orders=ORDERS)
    picked = diagram.select(freq=[47.5, 48.2, 90.0, 90.09, 120.0, 120.0, 160.0])
    assert len(picked) == 7
    by_hand = identify_modes(frf, start=picked)
    base = identify_modes(frf, orders=ORDERS)
    assert np.abs(by_hand.poles / base.poles - 1).max() < 1e-8
    for value in (diagram, picked, base):
        value.save(tmp_path / "v.npz")
        again = load(tmp_path / "v.npz")
        assert repr(again) == repr(value)
        assert np.array_equal(again.poles, value.poles)
    assert "array" not in repr(diagram) + repr(picked) + repr(base)


def test_flags_say_what_stays():
    diagram = stabilisation_diagram(measured(), orders=ORDERS)
    near = np.abs(diagram.freq - 160.0) < 0.05
    assert np.mean(diagram.flags[near & (diagram.orders > 10)] == 3) > 0.9
    assert np.all(diagram.flags[diagram.orders == 2] == 0)
    assert diagram.zeta.min() > 0
    with pytest.raises(SolverError, match="no pole stays"):
        stabilisation_diagram(
            measured(), orders=[2, 3, 4, 5], tolerances=(1e-9, 1e-9, 0.9)
        ).automatic()


def test_a_held_machine_needs_its_hold():
    rate, truth = 500.0, pole([60.0, 130.0], [0.01, 0.005])
    phi = PHI[:3, :2]
    H = sum(
        np.outer(phi[:, k], phi[:2, k])[:, :, None] * held_mode(FREQ, truth[k], rate)
        for k in (0, 1)
    )
    dofs = {"u1": "1:z", "y1": "1:z"}
    frf = Frf(FREQ, H)
    found = identify_modes(frf, orders=range(2, 16), lower=0, upper=0, hold=rate, dofs=dofs)
    assert np.abs(found.poles / truth - 1).max() < 1e-10
    assert np.abs(np.abs(found.shapes) / np.abs(phi) - 1).max() < 1e-8
    assert np.abs(found.frf(FREQ).data - H).max() < 1e-10 * np.abs(H).max()
    start = PoleSelection(truth, phi[:2])
    with pytest.warns(FlexplantWarning, match="missed or merged"):
        without = identify_modes(frf, start=start, lower=0, upper=3, dofs=dofs)
    assert np.abs(np.abs(without.shapes) / np.abs(phi) - 1).max() > 1e-2


def test_slopes_against_central_differences():
    frf = measured(CLOSE[[0, 2, 6]], PHI[:, :3], n_in=2, freq=np.arange(40.0, 170.0, 1.0))
    weight = np.sqrt(2.0 / frf.variance)
    lines = Lines(frf.freq, frf.data, weight, 2, 2, None)
    poles = CLOSE[[0, 2, 6]] * (1 + 1e-4)
    part = np.array([[1.0, 1.0, 0.3 - 0.1j], [0.4, -0.2j, 1.0]])
    pivots = np.array([0, 0, 1])

    def cost(x):
        moved = part.copy()
        free = [(1, 0), (1, 1), (0, 2)]
        for k, place in enumerate(free):
            moved[place] += x[6 + k] + 1j * x[9 + k]
        return _Projected(lines, poles + x[:3] + 1j * x[3:6], moved, pivots).cost

    g = _Projected(lines, poles, part, pivots).normal[1]
    step = np.array([1e-4] * 6 + [1e-5] * 6)
    for k in range(12):
        e = np.zeros(12)
        e[k] = step[k]
        slope = (cost(e) - cost(-e)) / (2 * step[k])
        assert slope == pytest.approx(-2 * g[k], rel=1e-5, abs=1e-6 * np.abs(g).max())


COARSE = np.arange(40.0, 60.0, 0.05)
TRIAL = pole([47.5, 48.2, 53.0], [0.004, 0.005, 0.003])


@pytest.mark.slow
@pytest.mark.parametrize("common", [0.0, 0.9])
def test_confidence_covers_the_truth(common):
    """300 trials: chi-square of all poles together, 95 % regions within a binomial interval.

    With errors that outputs share, the same regions without the correlation cover too little.
    """
    rng, trials = np.random.default_rng(7), 300
    H = modal_frf(COARSE, TRIAL, PHI[:, :3], PHI[:2, :3], static=np.full((5, 2), 1e-7))
    deviation = 1e-3 * np.sqrt(np.mean(np.abs(H) ** 2))
    mix = np.full((5, 5), common) + (1 - common) * np.eye(5)
    root = np.linalg.cholesky(mix)
    correlation = np.repeat(mix[:, :, None], COARSE.size, axis=2)
    variance = np.full(H.shape, deviation**2)
    start = PoleSelection(TRIAL * (1 + 1e-5), PHI[:2, :3])
    distance, blind, z = [], [], []
    for _ in range(trials):
        e = np.einsum("ab,bif->aif", root, noisy(np.zeros(H.shape), deviation, rng))
        frf = Frf(COARSE, H + e, variance=variance, correlation=correlation)
        for F, scores in ((frf, distance), (frf.replace(correlation=None), blind)):
            if F is not frf and not common:
                continue
            found = identify_modes(F, start=start, lower=0, upper=2)
            error = found.poles - TRIAL
            error = np.concatenate([error.real, error.imag])
            scores.append(error @ np.linalg.solve(found.covariance, error))
            if F is frf:
                z.append(error / np.sqrt(np.diag(found.covariance)))
    share = np.mean(np.array(distance) < chi2.ppf(0.95, 6))
    margin = 3 * np.sqrt(0.95 * 0.05 / trials)
    assert abs(share - 0.95) < margin
    assert np.std(z) == pytest.approx(1.0, abs=0.05)
    if common:
        assert np.mean(np.array(blind) < chi2.ppf(0.95, 6)) < 0.95 - 1.5 * margin


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({"band": (100.0, 50.0)}, ModelError, "band"),
        ({"band": (100.0, 100.5)}, ModelError, "at least 20"),
        ({"orders": [3]}, ModelError, "orders"),
        ({"orders": [0, 1, 2, 3]}, ModelError, "orders"),
        ({"orders": range(2, 2000)}, ModelError, "needs more lines"),
        ({"lower": -1}, ModelError, "lower"),
        ({"upper": 1.5}, ModelError, "upper"),
        ({"max_iterations": 0}, ModelError, "max_iterations"),
        ({"hold": 100.0}, ModelError, "hold"),
        ({"dofs": ["y1"]}, LabelError, "mapping"),
        ({"dofs": {"y9": "1:z"}}, LabelError, "y9"),
        ({"start": [1.0]}, ModelError, "PoleSelection"),
        ({"start": PoleSelection([-1 + 300j], [[1.0]])}, ShapeError, "references"),
    ],
)
def test_bad_arguments_are_refused(arguments, error, text):
    frf = measured(CLOSE[:2], PHI[:, :2], n_in=2, freq=np.arange(20.0, 200.0, 1.0))
    with pytest.raises(error, match=text):
        identify_modes(frf, **arguments)


def test_bad_frfs_are_refused():
    freq = np.arange(20.0, 100.0, 1.0)
    H = np.ones((1, 1, 80), dtype=complex)
    with pytest.raises(ModelError, match="from an Frf"):
        identify_modes(H)
    with pytest.raises(ModelError, match="variance is zero"):
        identify_modes(Frf(freq, H, variance=np.zeros(H.shape)))
    with pytest.raises(ModelError, match="zero at all lines"):
        identify_modes(Frf(freq, 0 * H))
    with pytest.raises(ModelError, match="tolerances"):
        stabilisation_diagram(Frf(freq, H), tolerances=(0.1, 0.1, 1.0))
    with pytest.raises(ModelError, match="max_zeta"):
        stabilisation_diagram(Frf(freq, H), max_zeta=1.0)


def test_bad_choices_are_refused():
    diagram = stabilisation_diagram(measured(), orders=ORDERS)
    with pytest.raises(ModelError, match="within 3 %"):
        diagram.select(freq=[75.0])
    with pytest.raises(ModelError, match="at least one"):
        diagram.select(freq=[])
    with pytest.raises(ModelError, match="presence"):
        diagram.automatic(presence=1.5)
    with pytest.raises(ShapeError, match="belong together"):
        PoleSelection([-1 + 10j], [[1.0, 2.0]])
    with pytest.raises(ModelError, match="positive imaginary"):
        PoleSelection([-1 - 10j], [[1.0]])


def test_identified_response_is_asked_at_positive_frequencies():
    found = identify_modes(measured(CLOSE[:2], PHI[:, :2], n_in=2), orders=ORDERS)
    assert isinstance(found, IdentifiedModes)
    with pytest.raises(ModelError, match="positive"):
        found.frf(np.array([0.0, 1.0]))
