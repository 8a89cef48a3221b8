"""Blocks of samples against the same samples one by one."""

import numpy as np
import pytest
import scipy.linalg

from flexplant.loop import ClosedLoop, close_loop
from flexplant.lti import StateSpace
from flexplant.lti.response_solvers import Recursion
from flexplant.lti.sampling import sample_and_hold
from flexplant.plant import StandardPlant
from flexplant.plant.building import white_noise
from flexplant.simulation.runs import Drawn, InBlocks, SampleBySample, make_runner
from machines import observer, servo, stage
from stages import sampled, some_modes


def shown(runner, loop, given, start=None, seed=3):
    """Return the channels (n, steps) of a run by one of the ways."""
    total = loop.plant.system.n_states + loop.controller.n_states
    shown = len(loop.plant.z) + len(loop.plant.y) + len(loop.controller.outputs)
    runner.begin(np.zeros(total) if start is None else start, [np.random.default_rng(seed)])
    data = np.zeros((1, shown, given.shape[0]))
    for first in range(0, given.shape[0], runner.stretch):
        part = slice(first, first + runner.stretch)
        assert runner.fill(given[part], data[:, :, part])
    return data[0]


def free_mass():
    """A mass that nothing holds, two poles at 1, beside a mode; the law only reads."""
    c, s = 0.999 * np.cos(0.3), 0.999 * np.sin(0.3)
    A = np.array([[1.0, 0.1, 0, 0], [0, 1.0, 0, 0], [0, 0, c, s], [0, 0, -s, c]])
    B = np.array([[0.005, 0.1, 0, 1.0]] * 2).T
    C = np.array([[1.0, 0, 1e-3, 0]] * 2)
    names = {"inputs": ["w", "u"], "outputs": ["z", "y"], "blocks": [2, 2]}
    plant = StandardPlant.from_statespace(
        StateSpace(A, B, C, np.zeros((2, 2)), 0.1, **names), u=["u"], y=["y"]
    )
    return close_loop(plant, StateSpace([], [], [], [[0.0]], inputs=["y"], outputs=["u"]))


def shaken(seen):
    """White noise on one of three states, which y shows two samples later, or not at all."""
    A, G = [[0.9, 0.1, 0.0], [0.3 * seen, 0.5, 0.0], [0.0, 0.2, 0.7]], [[1.0], [0.0], [0.0]]
    C = [[0.0, 1.0, 1.0] if seen else [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    names = {"inputs": ["w", "u"], "outputs": ["z", "y"]}
    plant = StandardPlant.from_statespace(
        StateSpace(A, [[0.0, 0.0], [0.0, 0.0], [0.0, 1.0]], C, np.zeros((2, 2)), 0.1, **names),
        u=["u"], y=["y"], asd={"w": 1e-6}, noise_factor=1e-6 * np.array(G),
    )  # fmt: skip
    law = StateSpace([[0.5]], [[1.0]], [[-0.1]], [[-0.05]], 0.1, inputs=["y"], outputs=["u"])
    return close_loop(plant, law)


LOOPS = {
    "stage": lambda: close_loop(stage(), observer(), servo()),
    "free mass": free_mass,
    "noise that is measured a sample late": lambda: shaken(True),
    "noise that is not measured": lambda: shaken(False),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "silent"),
    [
        *((kind, ()) for kind in LOOPS),
        ("stage", ("amp", "y2:noise")),
        ("stage", ("amp", "y1:noise", "y2:noise")),
    ],
)
def test_blocks_are_the_samples_one_by_one(kind, silent):
    """With noise, a start that is not rest and more than one piece of blocks."""
    loop = LOOPS[kind]()
    rng = np.random.default_rng(0)
    given = rng.standard_normal((10_003, len(loop.plant.w))) * 1e-6
    given[:, [name in silent for name in loop.plant.w]] = 0.0
    start = 1e-6 * rng.standard_normal(loop.monitored.n_states)
    noise = white_noise(loop.plant)
    fast, plain = (
        make_runner(loop, noise, np.abs(given).max(axis=0), grows=grows) for grows in (False, True)
    )
    assert (type(fast), type(plain)) == (InBlocks, SampleBySample)
    expected = shown(plain, loop, given, start)
    wrong = np.abs(shown(fast, loop, given, start) - expected).max(axis=1)
    assert np.all(wrong <= 1e-10 * np.abs(expected).max(axis=1))


def test_blocks_that_lose_digits_are_not_taken(monkeypatch):
    """One entry of the matrices of a block is 1e-8 of itself off."""
    loop = close_loop(stage(), observer(), servo())
    given, exact = np.ones((500, len(loop.plant.w))), Recursion.in_blocks
    wanted = shown(
        make_runner(loop, white_noise(loop.plant), np.abs(given).max(axis=0)), loop, given
    )

    def off(self, size):
        blocks = exact(self, size)
        blocks.see[np.unravel_index(np.argmax(np.abs(blocks.see)), blocks.see.shape)] *= 1 + 1e-8
        return blocks

    monkeypatch.setattr(Recursion, "in_blocks", off)
    runner = make_runner(loop, white_noise(loop.plant), np.abs(given).max(axis=0))
    assert isinstance(runner, SampleBySample)
    scale = np.abs(wanted).max(axis=1, keepdims=True)
    np.testing.assert_allclose(shown(runner, loop, given) / scale, wanted / scale, atol=1e-10)


@pytest.mark.slow
def test_thousands_of_modes_go_mode_by_mode():
    """2000 states of which two are driven: the ring-down is that of the modes in closed form."""
    modes, dt = 1000, 1e-4
    angle, decay = np.linspace(0.01, 3.0, modes), 0.999
    A = np.zeros((2 * modes, 2 * modes))
    k = 2 * np.arange(modes)
    A[k, k] = A[k + 1, k + 1] = decay * np.cos(angle)
    A[k, k + 1], A[k + 1, k] = decay * np.sin(angle), -decay * np.sin(angle)
    C = np.zeros((2, 2 * modes))
    C[:, k] = 1.0
    B = np.zeros((2 * modes, 2))
    B[1] = 1.0
    g = StateSpace(
        A, B, C, np.zeros((2, 2)), dt, inputs=["w", "u"], outputs=["z", "y"], blocks=[2] * modes
    )
    plant = StandardPlant.from_statespace(g, u=["u"], y=["y"])
    law = StateSpace([], [], [], [[0.0]], dt, inputs=["y"], outputs=["u"])
    loop = ClosedLoop(plant, (law,), law)
    given = np.zeros((300, 1))
    runner = make_runner(loop, white_noise(plant), np.abs(given).max(axis=0))
    assert isinstance(runner, SampleBySample)
    start = np.zeros(2 * modes)
    start[k] = 1.0
    steps = np.arange(300)
    expected = (decay**steps)[:, None] * np.cos(np.outer(steps, angle))
    z = shown(runner, loop, given, start)[0]
    np.testing.assert_allclose(z, expected.sum(axis=1), rtol=0, atol=1e-10 * modes)


def test_few_columns_are_drawn_of_many_modes():
    """To 1e-8 of the variance of each state; rounding of the factor chooses no other columns."""
    plant = sampled(some_modes(count=60))
    noise = white_noise(plant)
    factor, few = noise.factor, Drawn(noise, plant).factor
    assert few.shape[1] < 0.6 * factor.shape[1]
    size = np.linalg.norm(factor, axis=1)
    assert np.all(np.abs(few @ few.T - factor @ factor.T) <= 1e-8 * np.outer(size, size))
    change = 1e-13 * np.random.default_rng(0).standard_normal(factor.shape)
    other = Drawn(noise._replace(factor=factor * (1.0 + change)), plant).factor
    np.testing.assert_allclose(other, few, rtol=1e-12, atol=0)


def test_a_quiet_force_that_only_the_output_shows_is_drawn():
    """The floor moves two equal masses alike, and the sensor measures their difference."""
    A = scipy.linalg.block_diag(*[[[0.0, 1.0], [-4e3, -5.0]]] * 2)
    B = np.array([[0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]]).T
    C = [[-1.0, 0.0, 1.0, 0.0]] * 2
    g = StateSpace(A, B, C, np.zeros((2, 3)), inputs=["floor", "fan", "u"], outputs=["z", "y"])
    asd = {"floor": 1e-2, "fan": 1e-7}
    held, factor = sample_and_hold(g, 2e3, {}, asd=np.array([*asd.values(), 0.0]))
    plant = StandardPlant.from_statespace(held, u=["u"], y=["y"], asd=asd, noise_factor=factor)
    few = Drawn(white_noise(plant), plant).factor
    moved, expected = (
        held.C @ scipy.linalg.solve_discrete_lyapunov(held.A, one @ one.T) @ held.C.T
        for one in (few, factor)
    )
    np.testing.assert_allclose(moved, expected, rtol=1e-6)


def test_the_rms_of_a_loop_is_that_of_all_columns():
    """Of each channel, by SciPy."""
    loop = close_loop(stage(), observer(), servo())
    g, noise = loop.monitored, white_noise(loop.plant)
    few = Drawn(noise, loop.plant).factor
    squares = []
    for one in (noise.factor, few):
        enter = np.zeros((g.n_states, one.shape[1]))
        enter[: len(one)] = one
        states = scipy.linalg.solve_discrete_lyapunov(g.A, enter @ enter.T)
        squares.append(np.sum(g.C @ states * g.C, axis=1))
    np.testing.assert_allclose(squares[1], squares[0], rtol=1e-7, atol=1e-12 * squares[0].min())
