"""Shapes straight from an identification: their noise correlated, their scale and phase any."""

import numpy as np
import pytest

from flexplant import load
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.identification import MeasuredModes
from flexplant.updating import AddedMass, AddedStiffness, ModeShapes, ShapeCorrelation, update
from flexplant.updating.search import Objective

LINKS = [(0, None, 90), (0, 1, 110), (1, 2, 70), (2, 3, 130), (3, None, 60)]
PLACES = ["1:z", "2:z", "3:z", "4:z"]
PARAMETERS = [AddedMass("2:z"), AddedStiffness("3:z")]


@pytest.fixture
def chain(make):
    return make([1, 2, 1.5, 1.2], LINKS, D=np.diag([0.5, 0.0, 0.9, 0.2]))


def shapes_of(model, p=(0.0, 0.0)):
    """Complex poles and vectors by the companion matrix."""
    M, K = model.M + np.diag([0, p[0], 0, 0]), model.K + np.diag([0, 0, p[1], 0])
    A = np.block([[np.zeros((4, 4)), np.eye(4)], [-np.linalg.solve(M, np.hstack([K, model.D]))]])
    poles, vectors = np.linalg.eig(A)
    keep = np.flatnonzero(poles.imag > 0)
    keep = keep[np.argsort(np.abs(poles[keep]))]
    return poles[keep], vectors[:4, keep]


def values(model, residual, p=(0.0, 0.0)):
    objective = Objective(model, PARAMETERS, [residual])
    return objective.values(objective.begin(np.array(p)))


def hermitian(rng, n=4):
    A = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
    return A @ A.conj().T + 0.1 * np.eye(n)


def test_shapes_and_places_come_with_the_measured_modes(chain):
    poles, shapes = shapes_of(chain, (0.1, 4.0))
    own = MeasuredModes(poles, modes=[1, 2, 3, 4], shapes=shapes, dofs=PLACES)
    given = ModeShapes(own, shapes, PLACES)
    np.testing.assert_array_equal(values(chain, ModeShapes(own)), values(chain, given))
    channels = MeasuredModes(poles, modes=[1, 2, 3, 4], shapes=shapes, dofs=["a", "b", "c", "d"])
    at = dict(zip("abcd", PLACES, strict=True))
    for kind in (ModeShapes, ShapeCorrelation):
        named, plain = kind(channels, at=at), kind(own)
        np.testing.assert_array_equal(values(chain, named), values(chain, plain))
    assert repr(ModeShapes(own)) == "<ModeShapes: modes 1, 2, 3, 4 at 4 places, noise not known>"
    fit = update(chain, PARAMETERS, [ModeShapes(own).select([1, 3])])
    np.testing.assert_allclose(fit.values, [0.1, 4.0], rtol=1e-6)
    with pytest.raises(ShapeError, match="holds no shapes"):
        ModeShapes(MeasuredModes(poles, modes=[1, 2, 3, 4]))
    with pytest.raises(ShapeError, match="at="):
        ModeShapes(own, shapes)
    with pytest.raises(LabelError, match="not channels"):
        ModeShapes(own, at={"x": "1:z"})


def test_the_covariance_of_an_identification_is_taken(chain, monkeypatch, tmp_path):
    poles, shapes = shapes_of(chain)
    rng = np.random.default_rng(0)
    known = 1e-4 * np.array([hermitian(rng) for _ in range(4)])
    own = MeasuredModes(poles, modes=[1, 2, 3, 4], shapes=shapes, dofs=PLACES)
    monkeypatch.setattr(
        MeasuredModes, "shape_covariance", property(lambda self: known), raising=False
    )
    taken = ModeShapes(own)
    given = ModeShapes(own, shapes, PLACES, covariance=known)
    assert "noise known" in repr(taken)
    np.testing.assert_array_equal(values(chain, taken, (0.1, 0)), values(chain, given, (0.1, 0)))
    assert ModeShapes(own, std=0.1).covariance is None
    one = taken.select([3])
    np.testing.assert_array_equal(one.covariance, known[2:3])
    taken.save(tmp_path / "shapes.npz")
    back = load(tmp_path / "shapes.npz")
    np.testing.assert_array_equal(values(chain, back, (0.1, 0)), values(chain, taken, (0.1, 0)))


def test_scale_and_phase_do_not_matter_with_a_covariance(chain):
    poles, shapes = shapes_of(chain)
    rng = np.random.default_rng(1)
    known = 1e-4 * np.array([hermitian(rng) for _ in range(4)])
    factor = np.array([2.0, -1j, 0.3 + 0.4j, 5.0])
    measured = MeasuredModes(poles, modes=[1, 2, 3, 4])
    size = []
    for c in (np.ones(4), factor):
        covariance = np.abs(c[:, None, None]) ** 2 * known
        residual = ModeShapes(measured, shapes * c, PLACES, covariance=covariance)
        size.append(np.sum(values(chain, residual, (0.2, 3.0)) ** 2))
    assert size[1] == pytest.approx(size[0], rel=1e-9)
    assert size[0] > 1


@pytest.mark.slow
def test_noise_of_the_stated_covariance_counts_its_degrees_of_freedom(chain):
    """Shapes normalised to one at their largest entry, whose covariance is singular there."""
    poles, shapes = shapes_of(chain)
    rng = np.random.default_rng(2)
    sums = []
    for _ in range(120):
        noisy, covariances = [], []
        for shape in shapes.T:
            known = 1e-6 * hermitian(rng) * np.abs(shape).max() ** 2
            n = rng.normal(size=4) + 1j * rng.normal(size=4)
            psi = shape + np.linalg.cholesky(known) @ n / np.sqrt(2)
            top = np.argmax(np.abs(psi))
            noisy.append(psi / psi[top])
            J = np.eye(4, dtype=complex) / psi[top]
            J[:, top] -= psi / psi[top] ** 2
            covariances.append(J @ known @ J.conj().T)
        residual = ModeShapes(
            MeasuredModes(poles, modes=[1, 2, 3, 4]),
            np.array(noisy).T,
            PLACES,
            covariance=np.array(covariances),
        )
        sums.append(np.sum(values(chain, residual) ** 2))
    # four shapes of four complex entries, one complex scale each taken out
    free = 4 * 2 * 3
    assert abs(np.mean(sums) / free - 1) < 3 * np.sqrt(2 / free / 120)


def test_gradient_with_a_covariance(chain):
    poles, shapes = shapes_of(chain)
    rng = np.random.default_rng(3)
    known = np.array([hermitian(rng) for _ in range(4)])
    bent = shapes + 0.1 * rng.normal(size=shapes.shape)
    measured = MeasuredModes(poles, modes=[1, 2, 3, 4])
    for kind in (ModeShapes, ShapeCorrelation):
        residual = kind(measured, bent, PLACES, covariance=known, assign=False)
        objective = Objective(chain, PARAMETERS, [residual])
        base, steps = np.array([0.1, 2.0]), np.array([2e-3, 5e-2])
        J = objective.slopes(objective.begin(base))

        def at(b, k, objective=objective, base=base, steps=steps):
            return objective.values(objective.at(base + k * steps[b] * np.eye(2)[b]))

        for b in range(2):
            moved = sum(c * (at(b, k) - at(b, -k)) for c, k in [(45, 1), (-9, 2), (1, 3)])
            moved /= 60 * steps[b]
            assert np.abs(J[:, b] - moved).max() < 1e-7 * np.abs(moved).max()


def test_bad_covariances_are_refused(chain):
    poles, shapes = shapes_of(chain)
    measured = MeasuredModes(poles, modes=[1, 2, 3, 4])
    good = np.array([np.eye(4)] * 4)
    with pytest.raises(ShapeError, match="covariance"):
        ModeShapes(measured, shapes, PLACES, covariance=np.eye(4))
    with pytest.raises(ModelError, match="one of them"):
        ModeShapes(measured, shapes, PLACES, covariance=good, std=1.0)
    with pytest.raises(ModelError, match="Hermitian"):
        ModeShapes(measured, shapes, PLACES, covariance=good + np.triu(np.ones((4, 4)), 1))
    with pytest.raises(ModelError, match="semi-definite"):
        ModeShapes(measured, shapes, PLACES, covariance=-good)
    with pytest.raises(ModelError, match="zero"):
        values(chain, ModeShapes(measured, shapes, PLACES, covariance=0 * good))


def test_modes_that_look_alike_at_few_places_are_told_by_frequency(make):
    """At its two ends all odd modes of a chain look the same: far ones must not be taken."""
    links = [(i, i + 1, 100.0) for i in range(7)]
    model = make([1.0] * 8, links)
    # of the symmetric chain elastic modes are odd, even, odd, ...
    omega = 2 * np.sqrt(100.0) * np.sin(np.arange(1, 4) * np.pi / 16)
    ends = [[1.0, 1.0, 1.0], [-1.0, 1.0, -1.0]]
    measured = MeasuredModes(1j * omega, modes=[2, 3, 4])
    residual = ModeShapes(measured, ends, ["1:z", "8:z"])
    objective = Objective(model, [AddedMass("4:z")], [residual])
    for start in (0.0, 0.2):
        point = objective.begin(np.array([start]))
        found = point.eigen.poles[point.columns([2, 3, 4])].imag
        assert np.abs(found / omega - 1).max() < 0.05
