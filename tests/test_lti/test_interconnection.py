"""Every interconnection against `control.interconnect` and dense gains; names kept."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.lti import (
    StateSpace,
    append,
    as_statespace,
    connect,
    feedback,
    frequency_response,
    lft,
    parallel,
    series,
)
from oracles_lti import gain_at
from systems_lti import same, system

POINTS = (0.3j, 2.0 + 1.0j, 17.0j)


def gain(g, s):
    return gain_at(g.A, g.B, g.C, g.D, s)


def assert_equals_control(g, blocks, **interconnect):
    """Same names, same gains as the interconnection that control makes of the same blocks."""
    import control

    twin = control.interconnect(
        [b.replace(name=f"block{i}").to_control() for i, b in enumerate(blocks)], **interconnect
    )
    assert list(twin.input_labels) == list(g.inputs)
    assert list(twin.output_labels) == list(g.outputs)
    for s in POINTS:
        np.testing.assert_allclose(
            gain(g, s), gain_at(twin.A, twin.B, twin.C, twin.D, s), atol=1e-9
        )


@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.1]))
def test_series(seed, dt):
    first = system(seed, m=2, p=3, dt=dt, prefix="a")
    second = system(seed + 1, n=3, m=3, p=2, dt=dt, prefix="b")
    both = series(first, second)
    for s in POINTS:
        np.testing.assert_allclose(gain(both, s), gain(second, s) @ gain(first, s), rtol=1e-9)
    assert both.inputs == first.inputs
    assert both.outputs == second.outputs
    assert both.states == (*second.states, *first.states)
    assert both.dt == dt
    linked = [first.replace(outputs=["l0", "l1", "l2"]), second.replace(inputs=["l0", "l1", "l2"])]
    assert_equals_control(both, linked, inputs=list(first.inputs), outputs=list(second.outputs))


@given(st.integers(0, 10_000))
def test_parallel(seed):
    first, second = system(seed), system(seed + 1, n=2)
    both = parallel(first, second)
    for s in POINTS:
        np.testing.assert_allclose(gain(both, s), gain(second, s) + gain(first, s), rtol=1e-9)
    assert (both.inputs, both.outputs) == (first.inputs, first.outputs)
    assert both.states[0] == "1:state0"


@given(st.integers(0, 10_000))
def test_append(seed):
    first, second = system(seed, prefix="a"), system(seed + 1, n=0, m=1, p=2, prefix="b")
    both = append(first, second)
    for s in POINTS:
        found = gain(both, s)
        np.testing.assert_allclose(found[:2, :3], gain(first, s), rtol=1e-12)
        np.testing.assert_allclose(found[2:, 3:], second.D)
        assert not found[:2, 3:].any()
        assert not found[2:, :3].any()
    assert both.inputs == (*first.inputs, *second.inputs)
    assert both.outputs == (*first.outputs, *second.outputs)


@pytest.mark.slow
@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.1]))
def test_lft(seed, dt):
    rng = np.random.default_rng(seed)
    P = system(seed, n=5, m=4, p=5, dt=dt).replace(
        inputs=["w1", "w2", "u1", "u2"], outputs=["z1", "z2", "y1", "y2", "y3"]
    )
    K = system(seed + 1, n=3, m=3, p=2, dt=dt, prefix="k")
    K = K.replace(inputs=["y1", "y2", "y3"], outputs=["u1", "u2"], D=0.1 * K.D)
    loop = lft(P, K)
    assert (loop.inputs, loop.outputs) == (("w1", "w2"), ("z1", "z2"))
    for s in POINTS:
        G, k = gain(P, s), gain(K, s)
        closed = G[:2, :2] + G[:2, 2:] @ k @ np.linalg.inv(np.eye(3) - G[2:, 2:] @ k) @ G[2:, :2]
        np.testing.assert_allclose(gain(loop, s), closed, rtol=1e-7, atol=1e-8)
    # control cannot route an algebraic loop: compare with a plant without D22
    strict = P.replace(
        D=np.where(np.arange(5)[:, None] >= 2, np.where(np.arange(4) >= 2, 0, P.D), P.D)
    )
    assert_equals_control(lft(strict, K), [strict, K], inputs=["w1", "w2"], outputs=["z1", "z2"])
    order = rng.permutation(3)
    shuffled = K.select(["u2", "u1"], [K.inputs[i] for i in order])
    np.testing.assert_allclose(gain(lft(P, shuffled), 1j), gain(loop, 1j), rtol=1e-8)


def test_lft_leaves_unused_channels_open():
    P = system(2, n=3, m=3, p=3).replace(inputs=["w", "u", "v"], outputs=["z", "y", "r"])
    K = as_statespace([[0.2]]).replace(inputs=["y"], outputs=["u"])
    loop = lft(P, K)
    assert (loop.inputs, loop.outputs) == (("w", "v"), ("z", "r"))


@given(st.integers(0, 10_000), st.sampled_from([-1, 1]))
def test_feedback(seed, sign):
    G, H = system(seed, m=2, p=2), system(seed + 1, n=2, m=2, p=2, prefix="h")
    H = H.replace(D=0.1 * H.D)
    loop = feedback(G, H, sign=sign)
    unit = feedback(G.replace(D=0 * G.D))
    for s in POINTS:
        g, h = gain(G, s), gain(H, s)
        np.testing.assert_allclose(
            gain(loop, s), np.linalg.solve(np.eye(2) - sign * g @ h, g), rtol=1e-7, atol=1e-8
        )
        g = g - G.D
        np.testing.assert_allclose(gain(unit, s), np.linalg.solve(np.eye(2) + g, g), rtol=1e-7)
    assert (loop.inputs, loop.outputs) == (G.inputs, G.outputs)


@pytest.mark.slow
@given(st.integers(0, 10_000))
def test_connect(seed):
    plant = system(seed, m=3, p=2).replace(inputs=["d", "u1", "u2"], outputs=["y", "z"])
    plant = plant.replace(D=np.zeros((2, 3)))
    observer = system(seed + 1, n=2, m=2, p=1).replace(inputs=["y", "u1"], outputs=["hat"])
    servo = system(seed + 2, n=1, m=2, p=2).replace(inputs=["ref", "hat"], outputs=["u1", "u2"])
    # no feedthrough from u1 to hat: the chain hat -> u1 -> hat would be an algebraic loop
    observer = observer.replace(D=observer.D * [[1.0, 0.0]])
    blocks = [plant, observer, servo]
    outer = {"inputs": ["ref", "d"], "outputs": ["z", "u2", "hat"]}
    loop = connect(blocks, **outer)
    assert_equals_control(loop, blocks, **outer)
    assert loop.n_states == 7


def test_connect_adds_where_allowed():
    one = as_statespace([[2.0]]).replace(inputs=["a"], outputs=["sum"])
    two = as_statespace([[3.0]]).replace(inputs=["b"], outputs=["sum"])
    with pytest.raises(LabelError, match="'sum' is driven 2 times"):
        connect([one, two], ["a", "b"], ["sum"])
    both = connect([one, two], ["a", "b"], "sum", adding="sum")  # one name is no list of letters
    np.testing.assert_array_equal(both.D, [[2.0, 3.0]])


def test_connect_solves_algebraic_loops():
    half = as_statespace([[0.5, 0.5]]).replace(inputs=["r", "b"], outputs=["a"])
    back = as_statespace([[1.0]]).replace(inputs=["a"], outputs=["b"])
    loop = connect([half, back], ["r"], ["b"])
    np.testing.assert_allclose(loop.D, [[1.0]])


def test_blocks_survive_series_append_parallel_and_selection():
    pair = StateSpace([[0, 1], [-4, -0.1]], [[0], [1]], [[1, 0]], [[0]], blocks=[2])
    lag = StateSpace([[-1]], [[1]], [[1]], [[0]])
    assert tuple(series(pair, lag).blocks) == (1, 2)
    assert tuple(parallel(pair, lag).blocks) == (2, 1)
    assert tuple(append(pair, lag.replace(inputs=["f"], outputs=["x"])).blocks) == (2, 1)
    assert tuple(pair["y1", "u1"].blocks) == (2,)
    same(pair["y1", "u1"], pair)


def test_static_gains_fit_any_sampling_time():
    g = system(dt=0.1)
    assert series(as_statespace(np.eye(3)), g).dt == 0.1
    assert series(g, as_statespace(np.eye(2))).dt == 0.1
    with pytest.raises(ModelError, match="sampling times"):
        series(g, system(m=2))
    with pytest.raises(ModelError, match="sampling times"):
        append(g, system(prefix="b"))


def test_bad_input():
    g = system()
    with pytest.raises(ShapeError, match="as many outputs"):
        series(g, g)
    with pytest.raises(LabelError, match="same channels"):
        parallel(g, system(prefix="b"))
    with pytest.raises(LabelError, match="more than once"):
        append(g, g)
    with pytest.raises(ShapeError, match="feedback needs H"):
        feedback(g, g)
    square = g.select(["out0"], ["in0"])
    with pytest.raises(ModelError, match="sign"):
        feedback(square, sign=2)
    with pytest.raises(LabelError, match="no output 'in0'"):
        lft(g, square)
    minus = as_statespace([[-1.0]])
    with pytest.raises(ModelError, match="ill-posed"):
        feedback(as_statespace([[1.0]]), minus)
    with pytest.raises(LabelError, match="no signal to connect 'in1'"):
        connect([g], ["in0"], ["out0"])
    with pytest.raises(LabelError, match="driven 2 times"):
        connect([g, system(3, prefix="b").renamed(outputs={"bout0": "out0"})], [], ["out0"])
    with pytest.raises(ModelError, match="StateSpace"):
        series(g, "gain")


@pytest.mark.slow
@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.1]))
def test_every_operation_takes_a_control_system(seed, dt):
    g, h = system(seed, m=2, p=2, dt=dt), system(seed + 1, n=3, m=2, p=2, dt=dt, prefix="b")
    h = h.replace(D=0.1 * h.D)
    plain = [
        (series, (g, h)),
        (parallel, (g, h.replace(inputs=g.inputs, outputs=g.outputs))),
        (append, (g, h)),
        (feedback, (g, h)),
        (lft, (g, h.replace(inputs=g.outputs, outputs=g.inputs).select([g.inputs[0]]))),
    ]
    for operation, parts in plain:
        ours = operation(*parts)
        theirs = operation(*(part.to_control() for part in parts))
        same(theirs.replace(name=None), ours.replace(name=None))
    twins = [g.to_control(), h.replace(inputs=["out0", "r"], D=0 * h.D).to_control()]
    outer = {"inputs": ["in0", "in1", "r"], "outputs": ["bout1", "out1"]}
    assert connect(twins, **outer).outputs == ("bout1", "out1")


def test_blocks_survive_renaming_and_reordering():
    pair = StateSpace([[0, 1], [-4, -0.1]], np.eye(2), np.eye(2), np.zeros((2, 2)), blocks=[2])
    assert pair.renamed(inputs={"u1": "f"}).blocks == (2,)
    assert pair.select(["y2"], ["u2", "u1"]).blocks == (2,)
    chain = series(series(pair, pair), pair)
    assert chain.blocks == (2, 2, 2)
    freq = np.array([0.1, 0.3])
    found = frequency_response(chain, freq).data
    for k, f in enumerate(freq):
        single = gain(pair, 2j * np.pi * f)
        np.testing.assert_allclose(found[:, :, k], single @ single @ single, rtol=1e-10)


@pytest.mark.parametrize("gain", [1e10, 1e25, 1e80])
def test_a_loop_of_very_large_and_very_small_gains_is_well_posed(gain):
    """a = gain b, b = 0.1 / gain a + w: units so far apart stay within one balanced loop."""
    up = StateSpace([], [], [], [[gain]], inputs=["b"], outputs=["a"])
    down = StateSpace([], [], [], [[0.1 / gain, 1.0]], inputs=["a", "w"], outputs=["b"])
    ring = connect([up, down], ["w"], ["a", "b"])
    np.testing.assert_allclose(ring.D[:, 0], [gain / 0.9, 1 / 0.9], rtol=1e-14)
    alone = down.replace(D=[[1.0 / gain, 1.0]])
    with pytest.raises(ModelError, match="ill-posed"):
        connect([up, alone], ["w"], ["a"])


@pytest.mark.slow
@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.1]))
def test_operators_are_those_of_transfer_functions_with_names(seed, dt):
    rng = np.random.default_rng(seed)
    g, h = system(rng, 3, 2, 2, dt), system(rng, 2, 2, 2, dt)
    h = h.replace(inputs=g.inputs, outputs=g.outputs)
    for s in POINTS:
        G, H = gain(g, s), gain(h, s)
        for found, wanted in (
            (g + h, G + H),
            (g - h, G - H),
            (g - h.to_control(), G - H),
            (g * h, G @ H),
            (-g, -G),
            (np.float64(2.5) * g, 2.5 * G),
            (g * 3, 3 * G),
        ):
            assert (found.inputs, found.outputs) == (g.inputs, g.outputs)
            np.testing.assert_allclose(gain(found, s), wanted, rtol=1e-9, atol=1e-9)
    with pytest.raises(LabelError, match="same channels"):
        g + h.renamed(outputs={h.outputs[0]: "other"})
    with pytest.raises(ModelError, match="got str"):
        g * "h"
    with pytest.raises(TypeError):
        np.eye(2) * g
