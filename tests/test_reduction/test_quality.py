"""The quality report: against dense responses and eigenvalues, by any route."""

import numpy as np
import pytest
import scipy.linalg as la

import oracles_reduction as oracle
import oracles_structure
from flexplant.errors import ModelError
from flexplant.modes import solve_modes
from flexplant.modes.matching import pair_modes
from flexplant.reduction import CraigBampton, Guyan, ModalBalanced, ModalTruncation, reduce
from flexplant.structure import Damper, ModalDamping, Rayleigh
from plates import make_plate

LOW = ModalDamping(0.01)
KEPT = ["1:z", "5:z", "21:z", "25:z", "13:z", "7:z", "19:z"]
BAND = (100.0, 700.0)


@pytest.fixture(scope="module")
def plate():
    return make_plate(elements=(4, 4))


def test_every_number_against_dense_matrices(plate):
    M, K = oracles_structure.plate_matrices(4, 4)
    kept = [f"{node}:z" for node in range(1, 26, 2)]
    model = reduce(plate, Guyan(kept, damping=LOW))
    freq = np.array([120.0, 246.0, 500.0])
    found = model.quality(plate, band=BAND, inputs="1:z", outputs=["13:z", "25:z"], freq=freq)
    true, phi = la.eigh(K, M)
    true = np.sqrt(true[3:]) / (2 * np.pi)
    count = 3 + int(np.sum(true < BAND[1]))
    assert found.modes.tolist() == list(range(1, count + 1))
    np.testing.assert_allclose(found.full_freq[3:], true[: count - 3], rtol=1e-9)
    T = oracle.guyan(K, plate.dofs.indices(kept))
    less, mix = la.eigh(T.T @ K @ T, T.T @ M @ T)
    partner = np.sqrt(less[3:]) / (2 * np.pi)
    np.testing.assert_allclose(found.freq_error[3:6], partner[:3] / true[:3] - 1, rtol=1e-5)
    for i in (3, 4, 5):  # simple modes: M-orthonormal shapes
        wanted = float(phi[:, i] @ M @ (T @ mix[:, i])) ** 2
        assert found.mac[i] == pytest.approx(wanted, rel=1e-6)
    rows = np.eye(75)
    b, C = rows[:, plate.dofs.indices(["1:z"])], rows[plate.dofs.indices(["13:z", "25:z"])]
    gap, size = np.zeros((3, 2)), np.zeros((3, 2))
    for i, f in enumerate(freq):
        s, none = 2j * np.pi * f, np.zeros((1, 1))
        H = oracle.response(M, none, K * (1 + 0.02j), b, C, s)[:, 0]
        less_M, less_K = T.T @ M @ T, T.T @ K @ T * (1 + 0.02j)
        h = oracle.response(less_M, none, less_K, T.T @ b, C @ T, s)[:, 0]
        gap[i], size[i] = np.abs(H - h), np.abs(H)
    np.testing.assert_allclose(found.frf_error[:, 0], gap.max(axis=0) / size.max(axis=0), rtol=1e-4)
    assert found.true_error == pytest.approx(np.linalg.norm(gap, axis=1).max(), rel=1e-4)
    assert found.orthogonality < 1e-9
    assert "static shapes, loss factor 0.02 in both; direct solutions at 6 freq" in found.route
    assert found.full_error < 1e-5
    assert len(found.table().splitlines()) == count + 1
    assert repr(found).startswith(f"<ReductionQuality: {count} modes, worst frequency ")


def test_repeated_modes_are_compared_as_a_subspace(plate):
    model = reduce(plate, CraigBampton(KEPT[:4], 20))
    found = model.quality(plate, band=(600.0, 680.0))
    f = found.full_freq
    pair = np.flatnonzero(np.diff(f) < 1e-6 * f[1:])
    assert pair[pair >= 3].size  # the square plate has one there
    assert found.mac.min() > 0.999


@pytest.mark.parametrize("missing", [7, 8])
def test_a_missing_mode_of_a_repeated_pair_is_not_paired_with_a_stranger(plate, missing):
    """Modes 7 and 8 are one pair at 639 Hz, the next mode is at 1156 Hz: 81 % off."""
    modes = solve_modes(plate, count=14)
    kept = [n for n in range(1, 10) if n != missing]
    model = reduce(modes, ModalTruncation(modes=kept))
    found = model.quality(modes, band=BAND)  # the same basis of the pair: which one is known
    assert found.modes[np.isnan(found.freq)].tolist() == [missing]
    assert found.mac[missing - 1] < 1e-12
    assert np.nanmax(np.abs(found.freq_error)) < 1e-9
    assert np.delete(found.mac, missing - 1).min() == pytest.approx(1.0, abs=1e-9)
    # solved anew the pair has another basis: one is missing, which is not known, and it is said
    again = model.quality(plate, band=BAND)
    assert np.count_nonzero(np.isnan(again.freq)) == 1
    assert sorted(again.mac[6:8]) == pytest.approx([0.0, 1.0], abs=1e-9)
    assert np.nanmax(np.abs(again.freq_error)) < 1e-9
    assert again.alike == ((7, 8),)
    assert "cannot be distinguished: modes 7, 8" in repr(again)
    assert [line.endswith("alike: 8") for line in again.table().splitlines()].index(True) == 7


def shapes(n, m, seed=3):
    return la.qr(np.random.default_rng(seed).normal(size=(n, m)), mode="economic")[0]


def pairs_of(freq, other_freq, phi, psi, n_rigid=0):
    return pair_modes(freq, other_freq, phi.T @ phi, phi.T @ psi, psi.T @ psi, n_rigid=n_rigid)


def test_pairs_follow_shapes_and_alike_shapes_follow_frequency():
    phi = shapes(40, 5)
    f = np.array([100.0, 130.0, 170.0, 220.0, 300.0])
    found = pairs_of(f, np.array([101.0, 160.0, 165.0, 230.0, 290.0]), phi, phi[:, [0, 2, 1, 4, 3]])
    assert found.partner.tolist() == [0, 2, 1, 4, 3]  # two crossings
    assert found.group.tolist() == [0, 1, 2, 3, 4]
    # four sensors see modes 2 and 5 alike, and the noise of the shapes prefers the wrong one
    few = shapes(4, 4)[:, [0, 1, 2, 3, 1]]
    noisy = few + 0.01 * np.random.default_rng(1).normal(size=few.shape)
    noisy[:, [1, 4]] = few[:, [4, 1]] + 0.01 * noisy[:, [4, 1]]
    found = pairs_of(f, 1.007 * f, few, noisy)
    assert found.partner.tolist() == [0, 1, 2, 3, 4]
    assert found.group.tolist() == [0, 1, 2, 3, 1]


@pytest.mark.parametrize("angle", [0.0, 0.2, np.pi / 4, 1.4])
def test_pairs_of_a_cluster_hold_for_every_basis(angle):
    turn = np.eye(4)
    turn[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    basis = shapes(20, 5)
    phi, foreign = basis[:, :4], basis[:, 4]
    f, g = np.array([100.0, 200.0, 200.001, 300.0]), np.array([100.0, 201.0, 201.0, 300.0])
    found = pairs_of(f, g, phi, phi @ turn)
    assert found.partner.tolist() == [0, 1, 2, 3]
    assert found.mac == pytest.approx(1.0, abs=1e-12)
    assert found.group.tolist() == [0, 1, 1, 3]
    fewer = pairs_of(f, g[[0, 1, 3]], phi, (phi @ turn)[:, [0, 1, 3]])
    assert sorted(fewer.partner.tolist()) == [-1, 0, 1, 2]
    assert sorted(fewer.mac) == pytest.approx([0, 1, 1, 1], abs=1e-12)
    partly = (phi @ turn)[:, [0, 1, 3]]
    partly[:, 1] = 0.8 * partly[:, 1] + 0.6 * foreign
    found = pairs_of(f, g[[0, 1, 3]], phi, partly)
    assert sorted(found.mac) == pytest.approx([0, 0.64, 1, 1], abs=1e-12)
    # alike at one sensor: the cluster has no two dimensions there
    one = pairs_of(f[1:3], g[1:3], np.array([[1.0, 2.0]]), np.array([[1.0, 3.0]]))
    assert one.mac.tolist() == pytest.approx([1.0, 0.0], abs=1e-12)


@pytest.mark.slow
def test_the_report_can_fail(plate):
    model = reduce(plate, ModalTruncation(9, damping=LOW, inputs=KEPT))
    good = model.quality(plate, band=BAND)
    assert good.holds
    assert good.inputs == tuple(KEPT)
    assert np.abs(good.freq_error).max() < 1e-9
    wrong = model.replace(K=model.K * 1.02).quality(plate, band=BAND)
    assert np.abs(wrong.freq_error[3:]).min() > 0.009
    assert wrong.true_error > 10 * good.true_error
    shifted = model.replace(M=model.M * 2.0, K=model.K * 2.0).quality(plate, band=BAND)
    assert shifted.true_error > 5 * good.true_error
    # half the response everywhere: half the largest gain at a resonance, far beyond the bound
    for broken in (wrong, shifted):
        assert not broken.holds
        assert "BROKEN" in repr(broken)
    assert "BROKEN" not in repr(good)
    assert shifted.frf_error.max() == pytest.approx(0.5, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("method", [ModalTruncation(24, inputs=KEPT), ModalBalanced(24, KEPT)])
def test_a_bound_of_some_modes_says_so(plate, method):
    """Of 24 modes solved none is left out: the bound of what is, 0, says nothing of the others."""
    modes = solve_modes(plate, count=24, damping=LOW)
    model = reduce(modes, method)
    assert (model.bound.value, model.bound.covers) == (0.0, 24)
    assert "of the 24 modes solved alone" in repr(model.bound)
    found = model.quality(plate, band=BAND)
    assert found.true_error > 1e-12
    assert not found.bounded
    assert found.holds
    assert "of the 24 modes solved: others add to the error" in repr(found)
    assert "BROKEN" not in repr(found)
    among = model.quality(modes, band=BAND)
    assert among.bounded
    assert reduce(solve_modes(plate, damping=LOW), method).bound.covers is None
    # beside these modes it is a bound, which a wrong model breaks
    fewer = reduce(modes, method.replace(count=9))
    assert fewer.quality(modes, band=BAND).holds
    wrong = fewer.replace(M=fewer.M * 2.0, K=fewer.K * 2.0).quality(modes, band=BAND)
    assert "BROKEN" in repr(wrong)


def test_modes_without_a_partner_are_said(plate):
    model = reduce(plate, ModalBalanced(8, "13:z", damping=LOW))  # torsion is not seen there
    found = model.quality(plate, band=BAND)
    assert np.isnan(found.freq[3])
    assert "without a partner" in repr(found)


def test_against_modes_and_own_damping(plate):
    damped = plate.replace(D=2e-5 * plate.K)
    full = solve_modes(damped, count=40)
    model = reduce(damped, CraigBampton(KEPT, 12))
    by_modes = model.quality(full, band=BAND, inputs=KEPT[:2])
    direct = model.quality(damped, band=BAND, inputs=KEPT[:2])
    np.testing.assert_allclose(by_modes.freq_error, direct.freq_error, atol=1e-8)
    np.testing.assert_allclose(by_modes.frf_error, direct.frf_error, rtol=0.2)
    assert "sum over" in by_modes.route
    assert "its D" in direct.route


@pytest.mark.slow
def test_a_large_model_is_solved_by_fronts():
    plate = make_plate(elements=(26, 26))
    kept = [plate.dofs.nearest((x, y, 0)) for x in (0, 0.3, 0.6) for y in (0, 0.3, 0.6)]
    model = reduce(plate, CraigBampton(kept, 25, damping=LOW))
    found = model.quality(plate, band=BAND, inputs=kept[:2])
    assert "direct solutions at 3 frequencies" in found.route
    assert found.full_error < 1e-4
    assert found.mac.min() > 0.9999
    assert found.frf_error.max() < 0.05
    assert np.all(found.freq_error >= -1e-9)


@pytest.mark.slow
def test_the_worst_error_is_found_at_light_damping(plate):
    """At resonances and antiresonances of either model and between them: beside a fine grid."""
    M, K = oracles_structure.plate_matrices(4, 4)
    kept = [f"{node}:z" for node in range(1, 26, 2)]
    at = plate.dofs.indices
    T = oracle.guyan(K, at(kept))
    b, C = np.eye(75)[:, at(["1:z"])], np.eye(75)[at(["1:z", "13:z"])]
    full = np.sqrt(la.eigh(K, M, eigvals_only=True)[3:]) / (2 * np.pi)
    less = np.sqrt(la.eigh(T.T @ K @ T, T.T @ M @ T, eigvals_only=True)[3:]) / (2 * np.pi)
    band = (100.0, 500.0)
    own = np.concatenate([full[full < band[1]], less[less < band[1]]])
    near = (
        own[:, None] * (1 + np.concatenate([-1e-4 * np.arange(9), 1e-4 * np.arange(9)]))
    ).ravel()
    freq = np.unique(np.concatenate([np.linspace(*band, 400), near]))
    none = np.zeros((1, 1))
    H, h = (
        np.array([
            oracle.response(m, none, k * (1 + 2e-4j), inputs, outputs, 2j * np.pi * f)
            for f in freq
        ])
        for m, k, inputs, outputs in ((M, K, b, C), (T.T @ M @ T, T.T @ K @ T, T.T @ b, C @ T))
    )  # fmt: skip
    wanted = np.abs(H - h).max(axis=0) / np.abs(H).max(axis=0)
    model = reduce(plate, Guyan(kept, damping=ModalDamping(1e-4)))
    found = model.quality(plate, band=band, inputs="1:z", outputs=["1:z", "13:z"])
    assert np.all(found.frf_error > 0.99 * wanted)
    assert found.frf_error.max() > 0.9
    # resonances 0.5 % apart and 1e-4 wide: neither model has those of the other
    assert found.resonance_error.max() > 0.9
    # of 1:z to itself: between two resonances, and shifted by much more than its width
    assert 0.9 < found.antiresonance_error[0, 0] <= 2.0
    assert "at antiresonance" in repr(found)


@pytest.mark.slow
def test_a_damper_to_ground_is_judged(plate):
    damped = plate.with_damping(Rayleigh(0.0, 4e-6)).with_parts([Damper("1:z", 20.0)])
    model = reduce(damped, CraigBampton(KEPT, 30))
    found = model.quality(damped, band=BAND, inputs=KEPT[:2])
    assert found.frf_error.max() < 5e-3
    assert found.full_error < 1e-4
    # without it: the width of the resonances is wrong
    bare = model.replace(D=np.zeros_like(model.D))
    assert bare.quality(damped, band=BAND, inputs=KEPT[:2]).frf_error.max() > 0.5
    # a loss factor from a D that leaves no modes at 0
    assert "loss factor 0.0" in model.quality(plate, band=BAND, inputs=KEPT[:2]).route


def test_refusals(plate):
    model = reduce(plate, Guyan(KEPT))
    with pytest.raises(ModelError, match="made of"):
        model.quality(make_plate(elements=(3, 3)), band=BAND)
    with pytest.raises(ModelError, match="made of"):
        model.quality("plate", band=BAND)
    with pytest.raises(ModelError, match="lower end first"):
        model.quality(plate, band=(5.0, 1.0))
    with pytest.raises(ModelError, match="whole number"):
        model.quality(plate, band=BAND, count="a")
