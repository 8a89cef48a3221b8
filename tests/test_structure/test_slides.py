"""Slides: found by name, taken as joint motions, and with few digits; oracle: null vectors."""

import numpy as np
import pytest

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
