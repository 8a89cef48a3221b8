"""Mistakes of exports, made on models that are right: check names the cause, not a symptom."""

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp

import flexplant as fx
from flexplant.errors import ModelError, SolverError
from plates import make_plate

MODELS = {
    "plate": make_plate(elements=(6, 6)),
    "large plate": make_plate(elements=(23, 23)),
    "solid": fx.solid_block(
        size=(0.1, 0.1, 0.05), elements=(4, 4, 2), density=2702, youngs_modulus=70e9,
        poisson_ratio=0.33,
    ),
}  # fmt: skip


LARGE = {"large plate": [pytest.mark.slow]}


@pytest.fixture(params=[pytest.param(m, id=n, marks=LARGE.get(n, ())) for n, m in MODELS.items()])
def model(request):
    return request.param


def line(report, subject):
    return next(found for found in report.lines if found[1] == subject)


def matrices(model, K=None, M=None, **changes):
    return fx.structure.FEMatrices(
        model.K if K is None else K,
        model.M if M is None else M,
        dofs=model.dofs.replace(interpolation=None, **changes),
    )


def with_noise(K, size):
    lower = sp.csc_array(sp.tril(K))
    lower.data = lower.data * (1 + size * np.random.default_rng(0).uniform(-1, 1, lower.nnz))
    return sp.csc_array(lower + sp.tril(lower, -1).T)


def test_models_that_are_right(model):
    report = fx.check(model)
    assert report.ok
    assert not report.of("note")


def test_a_node_without_stiffness_that_mass_couples(model):
    """Zero rows of a semi-definite matrix leave it so: nothing is negative."""
    rows = [i for i, label in enumerate(model.dofs.labels) if label.startswith("30:")]
    K = sp.lil_array(model.K)
    K[rows, :] = 0.0
    K[:, rows] = 0.0
    report = fx.check(matrices(model, K=sp.csc_array(K)))
    assert "definiteness of K" in report.of("ok")
    assert set(report.stiffless) == {model.dofs.labels[i] for i in rows}
    assert report.n_zero == 3 + report.n_rigid


def test_a_negative_spring_is_named_with_its_eigenvalue(model):
    i = model.dofs.indices(["30:z"])[0]
    K = sp.lil_array(model.K)
    K[i, i] -= 1.2 * K[i, i]
    report = fx.check(matrices(model, K=sp.csc_array(K)))
    said = line(report, "definiteness of K")[2]
    assert said.startswith("K has 1 negative eigenvalue, the lowest -")
    assert "moving 30:z, " in said
    if model.n_dof < 300:
        lowest = la.eigh(K.toarray(), model.M.toarray(), eigvals_only=True)[0]
        assert float(said.split()[7]) == pytest.approx(lowest, rel=5e-3)


@pytest.mark.parametrize(
    ("wrong", "cause", "step"),
    [
        ({"K": 1e-3}, "K is in N/mm", "multiply K by 1000"),
        ({"K": 1e3}, "K is 1000 times too large", "divide K by 1000"),
        ({"xyz": 1e3}, "the coordinates are in mm", "xyz / 1000"),
        ({"M": 1e-3}, "M is in t", "multiply M by 1000"),
    ],
)
def test_units_by_density_and_wave_speed(model, wrong, cause, step):
    right = {"K": model.K, "M": model.M, "xyz": model.dofs.xyz}
    changes = {name: factor * right[name] for name, factor in wrong.items()}
    report = fx.check(matrices(model, **changes))
    _, _, finding, following = line(report, "units")
    assert cause in finding
    assert step in following


def test_consistent_units_and_supports(model):
    mm = matrices(model, K=1e-3 * model.K, M=1e-3 * model.M, xyz=1e3 * model.dofs.xyz)
    if ":rx" not in "".join(model.dofs.labels):  # else rotations have other factors
        assert "converted(length='mm', mass='t')" in line(fx.check(mm), "units")[3]
    # soft springs change no local entry by much: the material is the same
    held = model.with_parts([fx.Spring(f"{n}:z", 1e3) for n in (1, 5, 21)])
    assert "units" not in fx.check(held).of("note")


@pytest.mark.parametrize("model", [MODELS["plate"], MODELS["solid"]], ids=["plate", "solid"])
@pytest.mark.parametrize("held", [False, True])
def test_k_and_m_swapped(model, held):
    if held:
        model = model.fixed(
            [name for name in model.dofs.labels if model.dofs.location(name)[0] == 0]
        )
    given = fx.structure.FEMatrices(model.M, model.K, dofs=model.dofs)
    report = fx.check(given)
    assert [*report.of("fail"), *report.of("note")] == ["order of K and M"]  # nothing beside it
    assert "FEModel(M, K)" in line(report, "order of K and M")[3]
    for massless in ("refuse", "condense"):
        with pytest.raises(
            ModelError, match=r"swapped\? .* The order is fx\.structure\.FEMatrices\(K, M\)"
        ):
            given.model(massless=massless)


@pytest.mark.parametrize("size", [1e-8, 1e-10])
def test_rounding_of_entries_is_measured_and_freed(model, size):
    K = with_noise(model.K, size)
    report = fx.check(matrices(model, K=K))
    assert report.ok
    assert report.n_rigid == fx.check(model).n_rigid
    assert f"K carries about {-np.log10(size):.0f} digits" in line(report, "digits")[2]
    assert "free=True" in line(report, "digits")[3]
    if model.n_dof < 300:
        freed = matrices(model, K=K).model(free=True)
        modes = fx.solve_modes(freed, count=8)
        assert modes.n_rigid == report.n_rigid
        np.testing.assert_allclose(modes.freq, fx.solve_modes(model, count=8).freq, rtol=1e-5)
    # a soft bed of springs acts in every row too, but along the motion: it is no rounding
    bed = model.K + sp.diags_array(1e-9 * np.where(model.dofs.kinds < 3, model.K.diagonal(), 0.0))
    assert not [found for found in fx.check(matrices(model, K=bed)).lines if found[1] == "digits"]


def test_what_rounding_holds_is_said_as_the_model_says_it():
    plate = MODELS["plate"]
    exact = matrices(plate).replace(digits=10)
    assert line(fx.check(exact), "digits")[2] == "10 digits are enough"
    rounded = exact.replace(K=with_noise(plate.K, 1e-10))
    found = line(fx.check(rounded), "digits")
    assert (found[0], found[2][:27]) == ("note", "3 of its rigid-body motions")
    with pytest.warns(fx.FlexplantWarning) as said:
        rounded.model()
    assert found[2] in str(said[0].message)


def test_modes_of_a_rounded_stiffness_say_so():
    plate = MODELS["plate"]
    with pytest.raises(SolverError, match="carry too few digits"):
        fx.solve_modes(fx.FEModel(plate.M, with_noise(plate.K, 1e-10), dofs=plate.dofs), count=7)


def test_a_motion_that_supports_leave_free_has_an_axis():
    plate, solid = MODELS["plate"], MODELS["solid"]
    a, b = plate.dofs.nearest((0.1, 0.0, 0)), plate.dofs.nearest((0.6, 0.5, 0))
    hinged = plate.with_parts([fx.Spring(a, 1e6), fx.Spring(b, 1e6)])
    found = line(fx.check(hinged), "rigid body")
    assert found[0] == "note"
    assert "free to turn about the axis through (0.35, 0.25, 0) m along (0.7071, 0.7071" in found[2]
    edge = solid.fixed(solid.dofs.where(nodes=[1, 5]))
    assert "through (0.05, 0, 0) m along (1, 0, 0)" in line(fx.check(edge), "rigid body")[2]
    # one ball joint: three rotations, each with an axis through it
    ball = line(fx.check(solid.fixed(solid.dofs.where(nodes=[1]))), "rigid body")[2]
    assert ball.count("free to turn about the axis") == 3
    assert line(fx.check(solid), "rigid body")[0] == "ok"
