"""select_dofs: pivoted QR over candidates."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.reduction import select_dofs, solve_modes
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
    imaginary = few.replace(phi=few.phi * 1j)
    with pytest.raises(ModelError, match="real modes"):
        select_dofs(imaginary, 4)
