"""Gradients of every residual against central differences and, for the vectors, a complex step."""

import numpy as np
import pytest

import oracles_updating as oracle
from flexplant import DofSet
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.identification import MeasuredModes
from flexplant.lti import Frf
from flexplant.reduction import ReducedModel
from flexplant.updating import (
    AddedDamping,
    AddedMass,
    AddedStiffness,
    Antiresonances,
    Eigenvalues,
    FrfResidual,
    ModeDamping,
    ModeShapes,
    ShapeCorrelation,
    StaticCompliance,
)
from flexplant.updating.family import Family, first_point
from flexplant.updating.search import Objective

BASE = np.array([0.3, 5.0, 1e5, 0.002])
STEPS = np.array([3e-3, 0.3, 3e3, 3e-4])


def unknowns(plate):
    return [
        AddedMass((0.13, 0.21, 0.0)),
        AddedDamping((0.33, 0.21, 0.0)),
        AddedStiffness(plate.grid[3], to=plate.grid[7]),
        ModeDamping(6),
    ]


def residuals(plate):
    rng = np.random.default_rng(0)
    at = [plate.grid[i] for i in (0, 3, 8, 11, 17)]
    poles = [-28 + 2880j, -39 + 3970j, -40 + 4000j, -15 + 1530j]
    measured = MeasuredModes(poles, modes=[6, 7, 8, 4])
    A = rng.normal(size=(8, 8))
    known = MeasuredModes(poles, modes=[6, 7, 8, 4], covariance=A @ A.T + np.eye(8))
    shapes = rng.normal(size=(5, 4))
    data = 1e-7 * (rng.normal(size=(2, 1, 15)) + 1j * rng.normal(size=(2, 1, 15)))
    frf = Frf(np.linspace(50, 700, 15), data, inputs=[plate.grid[0]], outputs=at[:2])
    return {
        "poles": Eigenvalues(known),
        "means": Eigenvalues(known, clusters=0.02),
        "shapes": ModeShapes(measured, shapes, at, assign=False),
        "complex shapes": ModeShapes(measured, shapes + 1j * shapes[::-1], at, assign=False),
        "mac": ShapeCorrelation(measured, shapes, at, assign=False),
        "frf": FrfResidual(frf, variance=1e-18),
        "log": FrfResidual(frf, magnitude=True),
        "acceleration": FrfResidual(frf.replace(quantity="acceleration")),
        "zeros": Antiresonances([-10 + 1700j, -10 + 2500j], at[1], plate.grid[0]),
        "compliance": StaticCompliance(1e-6, at[1], plate.grid[0]),
    }


KINDS = [
    "poles", "means", "shapes", "complex shapes", "mac", "frf", "log", "acceleration", "zeros",
    "compliance",
]  # fmt: skip


@pytest.fixture(scope="module", params=KINDS)
def slopes(request, plate):
    """Slopes of a residual, and central differences of sixth order of its values."""
    objective = Objective(
        plate.reduced(0.01, True), unknowns(plate), [residuals(plate)[request.param]]
    )
    J = objective.slopes(objective.begin(BASE))

    def values(b, k):
        p = BASE.copy()
        p[b] += k * STEPS[b]
        return objective.values(objective.at(p))

    parts = [(45, 1), (-9, 2), (1, 3)]
    columns = [
        sum(c * (values(b, k) - values(b, -k)) for c, k in parts) / (60 * STEPS[b])
        for b in range(4)
    ]
    return J, np.column_stack(columns)


def deviation(J, moved):
    """Largest deviation in each column, in units of its largest entry."""
    # compliance: the numbers of the mass are rounding, as is damping
    size = np.abs(moved * STEPS).max() / STEPS
    return np.abs(J - moved).max(axis=0) / np.maximum(np.abs(moved).max(axis=0), 1e-2 * size)


def test_gradients_are_central_differences(slopes):
    assert np.all(deviation(*slopes) < 1e-7)


def test_a_rows_sign_would_be_noticed(slopes):
    """Every row moves with some parameter, so that the test above sees its sign."""
    J, moved = slopes
    for row in range(J.shape[0]):
        wrong = J.copy()
        wrong[row] *= -1.0
        assert deviation(wrong, moved).max() > 1e-5, f"row {row}"


@pytest.mark.parametrize("kind", ["M", "D", "K"])
def test_vectors_against_a_complex_step(make, kind):
    model = make([1, 2, 1.5], [(0, None, 90), (0, 1, 110), (1, 2, 70)], D=np.diag([0.5, 0.0, 0.2]))
    parameter = {"M": AddedMass, "D": AddedDamping, "K": AddedStiffness}[kind]("2:z")
    family = Family(model, [parameter])
    point = first_point(family, np.zeros(1))
    parts = [np.zeros((3, 3)) for _ in range(3)]
    parts["MDK".index(kind)][1, 1] = 1.0
    for mode in range(3):
        dX, dL = point.subspace([mode + 1])
        slope, shape = oracle.complex_step_vector(model.M, model.D, model.K, parts, mode)
        assert abs(dL[0, 0, 0] - slope) < 1e-9 * abs(point.eigen.poles[mode])
        x, dx = family.V @ point.eigen.X[:, mode], family.V @ dX[0, :, 0]
        c = np.argmax(np.abs(x))
        # of the vector scaled to x_c = 1
        found = dx / x[c] - x * dx[c] / x[c] ** 2
        np.testing.assert_allclose(found, shape, atol=1e-9 * np.abs(shape).max())


def test_a_repeated_pair_moves_as_a_subspace(make):
    ring = [*[(i, None, 30.0) for i in range(3)], (0, 1, 100.0), (1, 2, 100.0), (0, 2, 100.0)]
    model = make([1, 1, 1], ring, beta=1e-4)
    family = Family(model, [AddedMass("2:z")])
    point = first_point(family, np.zeros(1))
    _, dL = point.subspace([2, 3])
    step = 1e-3

    def mean(p):
        return oracle.poles(model.M + p * np.diag([0.0, 1, 0]), model.D, model.K)[1:].mean()

    near = mean(step) - mean(-step)
    far = mean(2 * step) - mean(-2 * step)
    expected = (8 * near - far) / (12 * step)
    assert abs(np.trace(dL[0]) / 2 - expected) < 1e-7 * abs(expected)


def test_dofs_without_mass_are_condensed():
    # node 2 has no mass: the same as two springs in series
    K = np.array([[30.0, -20, 0], [-20, 50, -30], [0, -30, 30]])
    dofs = line_dofs()
    zero = np.zeros((3, 3))
    model = ReducedModel(np.diag([1.0, 0, 2]), zero, K, np.eye(3), dofs, dofs, np.zeros((3, 0)))
    family = Family(model, [AddedStiffness("2:z")])
    eigen = family.at(np.array([7.0]))
    K[1, 1] += 7
    follow = -np.linalg.solve(K[1:2, 1:2], K[1:2, [0, 2]])
    Kc = K[np.ix_([0, 2], [0, 2])] + K[np.ix_([0, 2], [1])] @ follow
    expected = oracle.poles(np.diag([1.0, 2.0]), np.zeros((2, 2)), Kc * 100)
    np.testing.assert_allclose(10 * eigen.poles, expected, rtol=1e-12)
    np.testing.assert_allclose(eigen.X[1], (follow @ eigen.X[[0, 2]])[0], rtol=1e-12)


def line_dofs():
    return DofSet([1, 2, 3], ["z"] * 3, [[float(i), 0.0, 0.0] for i in range(3)])


# ---- what the residuals say, against formulas of another route


def test_scale_and_phase_of_a_shape_do_not_matter(plate):
    rom = plate.reduced(0.01, True)
    at = plate.grid[:9]
    shape = rom.modes().phi[:9, [5]]
    measured = MeasuredModes(rom.modes().poles[[5]], modes=[6])
    for factor in (1.0, -3e4, 2 - 5j):
        residual = ModeShapes(measured, factor * shape, at, std=abs(factor) * 0.01)
        objective = Objective(rom, [AddedMass(plate.z8)], [residual])
        assert np.abs(objective.values(objective.begin(np.zeros(1)))).max() < 1e-8
    # |r|^2 = (1 - MAC) |psi|^2 / std^2
    other = shape + 0.1 * rom.modes().phi[:9, [3]]
    product = float(shape[:, 0] @ other[:, 0])
    mac = product**2 / float((shape**2).sum() * (other**2).sum())
    objective = Objective(rom, [AddedMass(plate.z8)], [ModeShapes(measured, other, at, std=0.01)])
    r = objective.values(objective.begin(np.zeros(1)))
    assert r @ r == pytest.approx((1 - mac) * float((other**2).sum()) / 1e-4, rel=1e-9)


def test_noise_of_the_stated_size_has_residuals_of_one(plate):
    rom = plate.reduced(0.01, True)
    rng = np.random.default_rng(3)
    at, modes = plate.grid[:20], rom.modes()
    measured = MeasuredModes(modes.poles[[3, 4, 5]], modes=[4, 5, 6])
    exact = modes.phi[:20, [3, 4, 5]]
    noise = rng.normal(size=exact.shape) + 1j * rng.normal(size=exact.shape)
    real = ModeShapes(measured, exact + 0.01 * noise.real, at, std=0.01)
    # E|n|^2 = std^2 of a complex entry
    turned = ModeShapes(measured, 1j * exact + 0.01 * noise, at, std=0.01 * np.sqrt(2))
    freq = np.linspace(100, 700, 200)
    s = 2j * np.pi * freq
    load = np.eye(25)[0]
    H = np.array([np.linalg.solve(z * z * rom.M + z * rom.D + rom.K, load)[3] for z in s])
    error = 1e-10 * (rng.normal(size=200) + 1j * rng.normal(size=200))
    frf = Frf(freq, (H + error)[None, None], inputs=[plate.grid[0]], outputs=[plate.grid[3]])
    keep = np.abs(H) > 1e-9
    linear = FrfResidual(frf, variance=2e-20, lines=keep)
    logarithm = FrfResidual(frf, variance=2e-20, lines=keep, magnitude=True)
    for residual in (real, turned, linear, logarithm):
        objective = Objective(rom, [AddedMass(plate.z8)], [residual])
        r = objective.values(objective.begin(np.zeros(1)))
        # 2.5 standard errors of a mean square; a scale per shape is fitted away
        assert abs(np.mean(r**2) - 1) < 2.5 * np.sqrt(2 / r.size) + 0.05


def test_responses_zeros_and_compliance_of_a_chain(make):
    model = make([1, 2, 1.5], [(0, None, 90), (0, 1, 110), (1, 2, 70)], D=np.diag([0.5, 0.0, 0.2]))
    freq = np.array([0.5, 1.0, 2.0])
    s = 2j * np.pi * freq
    H = np.array([np.linalg.inv(z * z * model.M + z * model.D + model.K)[0, 2] for z in s])
    frf = Frf(freq, (s * H)[None, None], inputs=["3:z"], outputs=["1:z"], quantity="velocity")
    # zeros of the drive point 1: poles of what is left when it is held
    held = np.ix_([1, 2], [1, 2])
    zeros = oracle.poles(model.M[held], model.D[held], model.K[held])
    compliance = np.linalg.inv(model.K)[0, 2]
    for residual in (
        FrfResidual(frf, variance=1e-20),
        Antiresonances(zeros, "1:z", "1:z", std=1e-6),
        StaticCompliance(compliance, "1:z", "3:z", std=1e-9),
    ):
        objective = Objective(model, [AddedMass("2:z")], [residual])
        assert np.abs(objective.values(objective.begin(np.zeros(1)))).max() < 1e-3
        away = objective.values(objective.begin(np.array([0.01])))
        static = isinstance(residual, StaticCompliance)
        assert (np.abs(away).max() < 1e-3) == static


def test_static_compliance_of_a_free_body_is_its_elastic_part(make):
    free = make([1, 2], [(0, 1, 50.0)])
    # both ends about the centre of gravity: unit force on 1 stretches by f m2/(m k) ...
    reduced = 2 / 3
    residual = StaticCompliance(reduced**2 / 50, "1:z", "1:z", std=1e-12)
    objective = Objective(free, [AddedMass("2:z")], [residual])
    assert abs(objective.values(objective.begin(np.zeros(1)))[0]) < 1e-3


def test_lines_in_the_noise_are_left_out():
    data = np.array([1.0, 1e-3, 0.5, 1e-4, 2.0]) + 0j
    frf = Frf([0.0, 1, 2, 3, 4], data[None, None], inputs=["1:z"], outputs=["1:z"])
    assert FrfResidual(frf, variance=1e-4).lines.tolist() == [2, 4]
    assert FrfResidual(frf).lines.tolist() == [1, 2, 3, 4]
    assert FrfResidual(frf, lines=[4, 1]).lines.tolist() == [1, 4]
    assert FrfResidual(frf).select([2]).lines.tolist() == [2]
    with pytest.raises(ModelError, match="no frequency line"):
        FrfResidual(frf, variance=1e4)


def test_bad_input_is_refused(plate):
    measured = MeasuredModes([-1 + 20j, -2 + 60j], modes=[1, 2])
    good = [[1.0, 1.0], [1.4, -0.7]]
    at = ["1:z", "2:z"]
    for kind in (ModeShapes, ShapeCorrelation):
        with pytest.raises(ModelError, match="MeasuredModes"):
            kind([1j], good, at)
        with pytest.raises(LabelError, match="mode numbers"):
            kind(MeasuredModes([-1 + 20j, -2 + 60j]), good, at)
        with pytest.raises(ShapeError, match="shapes must have shape"):
            kind(measured, [[1.0, 1.0]], at)
        with pytest.raises(ShapeError, match="two places"):
            kind(measured, [[1.0, 1.0]], ["1:z"])
        with pytest.raises(ModelError, match="mode 2 is zero"):
            kind(measured, [[1.0, 0.0], [1.0, 0.0]], at)
        with pytest.raises(ModelError, match="std"):
            kind(measured, good, at, std=0.0)
        with pytest.raises(LabelError, match=r"\[7\]"):
            kind(measured, good, at).select([7])
    frf = Frf([1.0, 2.0], [[[1.0, 0.5j]]], inputs=["1:z"], outputs=["2:z"])
    with pytest.raises(ModelError, match="Frf"):
        FrfResidual([1.0])
    with pytest.raises(ModelError, match="variance"):
        FrfResidual(frf, variance=0.0)
    with pytest.raises(ShapeError, match="variance"):
        FrfResidual(frf, variance=np.ones(3))
    with pytest.raises(ModelError, match="lines"):
        FrfResidual(frf, lines=[2])
    with pytest.raises(LabelError, match="not channels"):
        FrfResidual(frf, places={"y9": "1:z"})
    with pytest.raises(ModelError, match="imaginary"):
        Antiresonances([-1.0], "1:z", "2:z")
    with pytest.raises(ModelError, match="std"):
        Antiresonances([-1 + 3j], "1:z", "2:z", std=-1.0)
    with pytest.raises(ModelError, match="zero"):
        StaticCompliance(0.0, "1:z", "2:z")
    with pytest.raises(LabelError, match="999:z"):
        Objective(
            plate.reduced(0.01, False),
            [AddedMass(plate.z8)],
            [StaticCompliance(1.0, "999:z", plate.z8)],
        )
