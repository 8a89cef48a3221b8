"""select_dofs: pivoted QR over candidates."""

import re

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given
from hypothesis import strategies as st

import oracles_reduction as oracle
from flexplant import DofSet
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.modes import solve_modes
from flexplant.reduction import (
    DesiredDofs,
    EffectiveIndependence,
    Greedy,
    PivotedQr,
    reduce,
    select_dofs,
)
from flexplant.structure import Damper, FEModel, ModalDamping
from plates import make_plate


@pytest.fixture(scope="module")
def modes():
    return solve_modes(make_plate(), count=24, compliance_at="23:z")


def condition(modes, labels):
    return np.linalg.cond(modes.basis[modes.dofs.indices(labels)])


def test_better_than_the_paper_s_grid(modes):
    chosen = select_dofs(modes, 25, required=["23:z", "1:z"])
    assert chosen.labels[:2] == ("23:z", "1:z")
    assert len(set(chosen)) == len(chosen) == 25
    assert all(label.endswith(":z") for label in chosen)
    assert chosen.condition == pytest.approx(condition(modes, chosen.labels), rel=1e-12)
    assert chosen.condition < 11.6  # the 5 x 5 grid
    assert repr(chosen).startswith("<DofSelection: 25 DOFs (23:z, 1:z, ")


def test_greedy_like_the_definition(modes):
    # oracle: take the row least explained by those taken before, one by one
    pool = [label for label in modes.dofs.labels if label.endswith(":z")]
    rows = modes.basis[modes.dofs.indices(pool)]
    taken, span = [], np.zeros((0, 25))
    for _ in range(6):
        rest = rows - rows @ span.T @ span
        best = int(np.argmax(np.linalg.norm(rest, axis=1)))
        taken.append(rows[best])
        span = np.vstack([span, rest[best] / np.linalg.norm(rest[best])])
    chosen = select_dofs(modes, 6)
    # symmetric corners tie: compare what is spanned in size
    ours = modes.basis[modes.dofs.indices(chosen.labels)]
    found = np.prod(np.linalg.svd(ours, compute_uv=False))
    assert found == pytest.approx(
        np.prod(np.linalg.svd(np.array(taken), compute_uv=False)), rel=0.05
    )


@given(st.integers(0, 10**6))
def test_beats_random_sets(modes, seed):
    rng = np.random.default_rng(seed)
    pool = [label for label in modes.dofs.labels if label.endswith(":z")]
    drawn = rng.choice(pool, size=25, replace=False).tolist()
    assert select_dofs(modes, 25).condition < condition(modes, drawn)


def test_candidates_are_kept_to(modes):
    pool = [f"{node}:{d}" for node in range(1, 41) for d in ("z", "rx")]
    chosen = select_dofs(modes, 25, candidates=pool, required="81:ry")
    assert chosen.labels[0] == "81:ry"
    assert set(chosen.labels[1:]) <= set(pool)
    only = select_dofs(modes, 2, candidates=[], required=["1:z", "9:z"])
    assert only.labels == ("1:z", "9:z")


def test_refusals(modes):
    with pytest.raises(ShapeError, match=r"from 1 .* to 25"):
        select_dofs(modes, 26)
    with pytest.raises(ShapeError, match="from 1"):
        select_dofs(modes, 0)
    with pytest.raises(ShapeError, match="from 3"):
        select_dofs(modes, 2, required=["1:z", "2:z", "3:z"])
    with pytest.raises(ShapeError, match="candidates"):
        select_dofs(modes, 5, candidates=["1:z", "2:z"])
    with pytest.raises(LabelError, match="no DOF '1:x'"):
        select_dofs(modes, 5, candidates=["1:x"])
    with pytest.raises(LabelError, match="no DOF 'q'"):
        select_dofs(modes, 5, required=["q"])
    with pytest.raises(LabelError, match="twice"):
        select_dofs(modes, 5, required=["1:z", "1:z"])
    few = solve_modes(make_plate(), count=4)
    line = [few.dofs.nearest((0.3, 0.075 * i, 0)) for i in range(9)]
    with pytest.raises(ModelError, match="node lines"):
        select_dofs(few, 4, candidates=line)
    with pytest.raises(ModelError, match="whole number"):
        select_dofs(few, "a")
    with pytest.raises(ModelError, match=r"PivotedQr\(\) or reduction\.Greedy"):
        select_dofs(few, 3, criterion="qr")
    with pytest.raises(ModelError, match="got str"):
        select_dofs("modes", 3)
    with pytest.raises(ModelError, match="condition above 2"):
        select_dofs(modes, 25, limit=2.0)


def random_rows(seed, p=40, k=6):
    return np.random.default_rng(seed).standard_normal((p, k))


@given(st.integers(0, 10**6), st.integers(6, 12))
def test_effective_independence_is_the_deletion_one_by_one(seed, count):
    rows = random_rows(seed)
    found = EffectiveIndependence().chosen(np.zeros((0, 6)), rows, count)
    assert found == oracle.effective_independence(rows, count)


def test_effective_independence_over_many_deletions():
    """More than are done between two new information matrices, and with units far apart."""
    rows = random_rows(3, p=200) * np.array([1e-2, 1.0, 10.0, 1.0, 1.0, 1e2])
    found = EffectiveIndependence().chosen(np.zeros((0, 6)), rows, 6)
    assert found == oracle.effective_independence(rows, 6)


@given(st.integers(0, 10**6))
def test_greedy_takes_the_best_next(seed):
    rows = random_rows(seed, p=20)
    assert Greedy().chosen(np.zeros((0, 6)), rows, 6) == oracle.greedy(rows, 6)


@pytest.mark.parametrize("criterion", [PivotedQr(), EffectiveIndependence(), Greedy()])
def test_criteria_keep_what_is_required(modes, criterion):
    chosen = select_dofs(modes, 25, required=["23:z", "1:z"], criterion=criterion)
    assert chosen.labels[:2] == ("23:z", "1:z")
    assert len(set(chosen)) == 25
    assert chosen.condition == pytest.approx(condition(modes, chosen.labels), rel=1e-10)
    assert chosen.condition < 12
    assert chosen.criterion is criterion
    assert chosen.values.shape == (25,)
    rows = modes.basis[modes.dofs.indices(chosen.labels)]
    if isinstance(criterion, Greedy):
        assert chosen.values[-1] == pytest.approx(np.linalg.svd(rows, compute_uv=False)[-1])
    elif isinstance(criterion, EffectiveIndependence):
        np.testing.assert_allclose(chosen.values, 1.0, rtol=1e-9)
    else:
        assert np.prod(chosen.values) == pytest.approx(abs(np.linalg.det(rows)), rel=1e-9)
    fewer = select_dofs(modes, 7, required="23:z", criterion=criterion)
    assert len(fewer) == 7
    assert fewer.labels[0] == "23:z"


def test_what_cannot_be_inverted_is_refused_with_dofs_that_can(modes):
    """The labels in the message, put in place of those it names, are taken."""
    few = solve_modes(make_plate(), count=6)
    wrong = [few.dofs.nearest((0.3, 0.075 * i, 0)) for i in range(6)]
    with pytest.raises(ModelError) as raised:
        reduce(few, DesiredDofs(wrong))
    text = str(raised.value)
    take, leave, stated = re.search(
        r"Take (.*?) in place of (.*?): condition ([\d.]+)\. ", text
    ).groups()
    better = [label for label in wrong if label not in leave.split(", ")] + take.split(", ")
    model = reduce(few, DesiredDofs(better))
    assert model.condition == pytest.approx(float(stated), rel=0.01)
    assert model.condition < 1e3


@pytest.mark.parametrize("criterion", [PivotedQr(), EffectiveIndependence(), Greedy()])
def test_complex_modes_are_distinguished_as_they_are(criterion):
    """The phase of a shape says nothing; what damping turns apart counts."""
    real = solve_modes(make_plate(elements=(4, 4)), count=10)
    turned = real.replace(phi=real.phi * np.exp(1j * np.arange(10.0)))
    labels = select_dofs(real, 8, required=["1:z"], criterion=criterion).labels
    found = select_dofs(turned, 8, required=["1:z"], criterion=criterion)
    assert found.labels == labels
    bend = Damper({"6:z": 1.0, "7:z": -2.0, "8:z": 1.0}, 3000.0)
    with_damper = make_plate(elements=(4, 4)).with_damping(ModalDamping(0.01)).with_parts(bend)
    modes = solve_modes(with_damper, count=10)
    assert np.iscomplexobj(modes.phi)
    chosen = select_dofs(modes, 10, criterion=criterion)
    rows = modes.phi[modes.dofs.indices(chosen.labels)]
    assert chosen.condition == pytest.approx(np.linalg.cond(rows), rel=1e-6)
    assert chosen.condition < 30


def test_a_mode_that_only_turns_is_kept_by_a_rotation():
    dofs = DofSet([1, 1, 2], ["x", "ry", "x"], [[0, 0, 0], [0, 0, 0], [1, 0, 0]])
    modes = solve_modes(FEModel(np.eye(3), np.diag([1e4, 2e3, 3e4]), dofs=dofs), count=2)
    with pytest.raises(ModelError, match=r"such as modes\.dofs\.labels"):
        select_dofs(modes, 2, candidates=["1:x", "2:x"])
    assert set(select_dofs(modes, 2).labels) == {"1:x", "1:ry"}
    with pytest.raises(ModelError, match=r"Take 1:ry in place of 2:x: condition 1\."):
        reduce(modes, DesiredDofs(["1:x", "2:x"]))


def bodies(seed):
    """Two or three rigid bodies with six DOFs each, on six springs at random corners each."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 4))
    n = 6 * count
    K = np.zeros((n, n))
    for body in range(count):
        for _ in range(8):
            arm, along = rng.normal(size=3), rng.normal(size=3)
            row = np.zeros(n)
            row[6 * body : 6 * body + 6] = np.append(along, np.cross(arm, along))
            if body:
                row[6 * body - 6 : 6 * body] = -row[6 * body : 6 * body + 6]
            K += 10 ** rng.uniform(4, 7) * np.outer(row, row)
    M = np.diag(np.tile([5.0, 5.0, 5.0, 0.1, 0.2, 0.3], count))
    nodes = np.repeat(np.arange(1, count + 1), 6)
    places = np.repeat(rng.normal(size=(count, 3)), 6, axis=0)
    dofs = DofSet(nodes, ["x", "y", "z", "rx", "ry", "rz"] * count, places)
    return FEModel(M, K, dofs=dofs)


@pytest.mark.parametrize("seed", range(4))
def test_rotations_are_chosen_where_displacements_do_not_distinguish_the_modes(seed):
    model = bodies(seed)
    modes = solve_modes(model, count=model.n_dof - 2)
    chosen = select_dofs(modes, modes.n_modes)
    assert any(":r" in label for label in chosen.labels)
    kept = la.eigh(model.K, model.M, eigvals_only=True)[: modes.n_modes]
    small = reduce(modes, DesiredDofs(chosen.labels))
    np.testing.assert_allclose(la.eigh(small.K, small.M, eigvals_only=True), kept, rtol=1e-6)
    few = solve_modes(model, count=3)
    straight = [label for label in model.dofs.labels if ":r" not in label]
    assert set(select_dofs(few, 3).labels) <= set(straight)
