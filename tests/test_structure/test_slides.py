"""Slides: found by name, taken as joint motions, and with few digits; oracle: null vectors."""

import numpy as np
import pytest
import scipy.sparse as sp

import flexplant as fx
from flexplant.errors import LabelError, ModelError
from flexplant.structure import slides, sliding


def machine(seed, motions=None):
    """A base on springs and two carriages on guides, at one place: no geometry frees them."""
    rng = np.random.default_rng(seed)
    labels = [(1, "x"), (1, "y"), (2, "x"), (2, "y"), (3, "x"), (3, "y"), (4, "x")]
    nodes, directions = zip(*labels, strict=True)
    n = len(labels)
    rows = np.zeros((6, n))
    rows[0, 0] = rows[1, 1] = 1.0  # feet
    rows[2, [3, 1]] = 1.0, -1.0  # carriage 2 slides along x, carriage 3 along y
    rows[3, [4, 0]] = 1.0, -1.0
    rows[4, [6, 2]] = 1.0, -1.0  # a tool on carriage 2
    rows[5, [2, 5, 0]] = 1.0, 2.0, -1.0  # a belt ties one to the other
    K = rows.T @ np.diag(10.0 ** rng.uniform(5, 8, 6)) @ rows
    dofs = fx.DofSet(nodes, directions, np.zeros((n, 3)))
    M = np.diag(rng.uniform(1.0, 50.0, n))
    free = np.linalg.svd(rows)[2][6:].T
    given = None if motions is None else motions(free)
    return fx.FEModel(M, K, dofs=dofs, joint_motions=given), free


@pytest.mark.parametrize("seed", range(8))
def test_a_slide_is_offered_by_name_and_taken(seed):
    model, free = machine(seed)
    with pytest.raises(ModelError, match=r"they are slides: pass structure\.sliding\(model\)"):
        fx.solve_modes(model, count=3)
    (advice,) = (row[3] for row in fx.check(model).lines if row[1] == "mechanisms")
    assert "joint_motions" in advice and "fx.joined" in advice
    found = slides(model)
    assert len(found) == 1
    ((name, motion),) = found.items()
    assert motion[model.dofs.index(name)] == pytest.approx(1.0)
    assert abs(free[:, 0] @ motion) == pytest.approx(np.linalg.norm(motion), rel=1e-9)
    modes = fx.solve_modes(sliding(model, [name]), count=7)
    assert modes.n_rigid == 1 and modes.freq[0] == 0.0
    wanted = np.sqrt(np.maximum(np.linalg.eigvals(np.linalg.solve(model.M, model.K)).real, 0.0))
    np.testing.assert_allclose(modes.omega[1:], np.sort(wanted)[1:], rtol=1e-6)
    with pytest.raises(LabelError, match="no slide 'rail'"):
        sliding(model, ["rail"])


@pytest.mark.parametrize("digits", [6, 8, 10, 12])
def test_a_slide_with_few_digits_is_one(digits):
    rng = np.random.default_rng(digits)

    def rounded(free):
        return free * (1.0 + 10.0**-digits * rng.uniform(-0.5, 0.5, free.shape))

    model, _ = machine(1, rounded)
    assert model.rigid_body.shape[1] == 1
    assert fx.solve_modes(model, count=4).n_rigid == 1


def test_a_spring_that_holds_a_slide_is_not_rounding():
    model, free = machine(2, lambda free: free)
    soft = model.K + 10.0 * np.outer(np.eye(7)[2], np.eye(7)[2])  # 10 N/m on 1e8 N/m
    held = fx.FEModel(model.M, soft, dofs=model.dofs, joint_motions=free)
    assert held.rigid_body.shape[1] == 0
    assert 0.0 < fx.solve_modes(held, count=2).freq[0] < 1.0


@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_motion_is_refused(seed):
    """A vector that stretches the machine is named where the slide is missed."""
    rng = np.random.default_rng(seed)
    model, _ = machine(seed, lambda free: free + 0.1 * rng.standard_normal(free.shape))
    with pytest.raises(ModelError, match="1 of the motions of the geometry and of joint_motions"):
        fx.solve_modes(model, count=3)


@pytest.mark.parametrize("seed", range(4))
def test_a_motion_that_a_held_machine_resists_is_noted(seed):
    """No slide is missed there, so that nothing else would say that the vector has no effect."""
    rng = np.random.default_rng(seed)
    model, free = machine(seed)
    K = model.K + 1e6 * np.outer(np.eye(7)[2], np.eye(7)[2])  # a spring on the slide
    vectors = np.column_stack([rng.standard_normal(7), free[:, 0]])
    held = fx.FEModel(model.M, K, dofs=model.dofs, joint_motions=vectors)
    (line,) = (row for row in fx.check(held).lines if row[1] == "joint motions")
    assert line[0] == "note" and "mend the entries" in line[3]
    for i, v in enumerate(vectors.T, 1):
        hertz = np.sqrt(v @ K @ v / (v @ model.M @ v)) / (2 * np.pi)
        assert f"{i} (as if rigid at {hertz:.4g} Hz)" in line[2]
    slide = fx.FEModel(model.M, model.K, dofs=model.dofs, joint_motions=free)
    assert not any(row[1] == "joint motions" for row in fx.check(slide).lines)


def large(spring, n=800):
    """Two lines of nodes in the plane: one on springs, the other guided by it along x."""
    line = sp.diags_array(
        [np.r_[1.0, np.full(n - 2, 2.0), 1.0], -np.ones(n - 1), -np.ones(n - 1)], offsets=[0, 1, -1]
    )
    eye = sp.eye_array(n)
    at_end = sp.csc_array(([spring], ([0], [0])), shape=(n, n))
    K = sp.block_array(
        [
            [1e8 * line + 1e5 * eye, None, None, None],
            [None, 5e7 * line + 1.1e6 * eye, None, -1e6 * eye],
            [None, None, 1e8 * line + at_end, None],
            [None, -1e6 * eye, None, 5e7 * line + 1e6 * eye],
        ]
    ).tocsc()
    ids = np.arange(1, n + 1)
    xyz = np.zeros((4 * n, 3))
    xyz[:, 0] = np.tile(np.linspace(0.0, 1.0, n), 4)
    nodes = np.concatenate([ids, ids, ids + n, ids + n])
    dofs = fx.DofSet(nodes, ["x"] * n + ["y"] * n + ["x"] * n + ["y"] * n, xyz)
    slide = np.zeros((4 * n, 1))
    slide[2 * n : 3 * n] = 1.0
    return K, dofs, slide


@pytest.mark.slow
@pytest.mark.parametrize("digits", [7, 10, 12])
def test_a_slide_of_few_digits_in_a_large_model(digits):
    """By inverse iteration, where K is too large for its null vectors."""
    rng = np.random.default_rng(digits)
    for spring, free in ((0.0, 1), (1e3, 0)):
        K, dofs, slide = large(spring)
        given = slide * (1.0 + 10.0**-digits * rng.standard_normal(slide.shape))
        M = 0.1 * sp.eye_array(K.shape[0], format="csc")
        model = fx.FEModel(M, K, dofs=dofs, joint_motions=given)
        modes = fx.solve_modes(model, count=2)
        assert (modes.n_rigid, bool(modes.freq[0] == 0.0)) == (free, bool(free))
