"""Random machines told otherwise: the same answers, in other units, orders, frames and parts.

Trusses of random masses and springs, made here by NumPy. What else of this kind is shown where it
is made: two halves of a plate are one (test_joined), threads and processes to the bit
(test_parallel, test_search), units of one equation (test_riccati, test_lyapunov).
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx

FREQ = np.array([3.0, 40.0, 111.0, 400.0])
AXES = ("x", "y", "z")
RATE = 2e3
NODES, FORCES = 5, 6


class Told(NamedTuple):
    """A machine and what is asked of it, in a frame, an order, and units of SI's."""

    M: np.ndarray
    K: np.ndarray
    nodes: np.ndarray
    directions: tuple
    xyz: np.ndarray
    #: a direction (3,) for each of six forces, seven sensors
    along: np.ndarray
    length: float = 1.0
    mass: float = 1.0
    time: float = 1.0
    turn: np.ndarray = np.eye(3)
    channels: tuple = tuple(range(13))

    @property
    def force(self):
        return self.mass * self.length / self.time**2

    @property
    def model(self):
        dofs = fx.DofSet(self.nodes, self.directions, self.xyz)
        return fx.FEModel(self.M, self.K, dofs=dofs)

    def at(self, i):
        """The motion of a node along a direction, as a sum of DOFs."""
        return {f"{i % NODES + 1}:{a}": float(v) for a, v in zip(AXES, self.along[i], strict=True)}

    @property
    def sensors(self):
        asd = 1e-9 * self.length * np.sqrt(self.time)
        named = [i for i in self.channels if i >= FORCES]
        return [fx.Sensor(f"y{i}", at=self.at(i), asd=asd) for i in named]

    @property
    def ports(self):
        asd = 1e-2 * self.force * np.sqrt(self.time)
        forces = [i for i in self.channels if i < FORCES]
        return fx.Ports(
            w=[fx.Disturbance(f"d{i}", at=self.at(i), asd=asd) for i in forces],
            u=[fx.Actuator(f"u{i}", at=self.at(i)) for i in forces],
            z=[fx.Poi("tip", at="4:x", axes=AXES)],
            y=self.sensors,
        )

    @property
    def plant(self):
        modes = fx.solve_modes(self.model, damping=fx.ModalDamping(0.02))
        return fx.assemble_plant(modes, self.ports)

    @property
    def sampled(self):
        return self.plant.discretized(RATE / self.time, delay=1)

    def weighted(self, plant):
        z = dict.fromkeys(plant.z, 1e6 / self.length)
        z |= {name: 1.0 / self.force for name in plant.z if name.endswith(":effort")}
        w = dict.fromkeys(plant.w, 1.0 * self.force)
        w |= {name: 1e-6 * self.length for name in plant.w if name.endswith(":noise")}
        return plant.weighted(z=z, w=w)


def truss(seed, held=False):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-0.3, 0.3, (NODES, 3))
    K = np.zeros((3 * NODES, 3 * NODES))
    for i in range(NODES):
        for j in range(i):
            e = np.zeros(3 * NODES)
            unit = (xyz[i] - xyz[j]) / np.linalg.norm(xyz[i] - xyz[j])
            e[3 * i : 3 * i + 3], e[3 * j : 3 * j + 3] = unit, -unit
            K += rng.uniform(0.5, 2.0) * 1e6 * np.outer(e, e)
    if held:
        K += np.diag(rng.uniform(1e4, 1e5, 3 * NODES))
    M = np.diag(np.repeat(rng.uniform(0.5, 2.0, NODES), 3))
    nodes = np.repeat(np.arange(1, NODES + 1), 3)
    along = rng.standard_normal((13, 3))
    return Told(M, K, nodes, AXES * NODES, np.repeat(xyz, 3, axis=0), along)


def in_units(one, length, mass, time=1.0):
    """A force per length is mass / time^2; coordinates are lengths, directions only numbers."""
    units = {"length": length, "mass": mass, "time": time}
    return one._replace(M=mass * one.M, K=mass / time**2 * one.K, xyz=length * one.xyz, **units)


def in_another_order(one):
    order = np.random.default_rng(5).permutation(3 * NODES)
    swapped = np.ix_(order, order)
    directions = tuple(np.array(one.directions)[order])
    return one._replace(
        M=one.M[swapped], K=one.K[swapped], nodes=one.nodes[order], directions=directions,
        xyz=one.xyz[order], channels=tuple(np.random.default_rng(6).permutation(13).tolist()),
    )  # fmt: skip


def turned(one):
    """Of coordinates, directions and matrices: q' = R q at each node."""
    R = la.expm(np.cross(np.eye(3), [0.3, -0.8, 0.5]))
    all_nodes = np.kron(np.eye(NODES), R)
    return one._replace(
        M=all_nodes @ one.M @ all_nodes.T, K=all_nodes @ one.K @ all_nodes.T,
        xyz=one.xyz @ R.T, along=one.along @ R.T, turn=R,
    )  # fmt: skip


OTHERWISE = {
    "mm, t, s": lambda one: in_units(one, 1e3, 1e-3),
    "mm, kg, ms": lambda one: in_units(one, 1e3, 1.0, 1e3),
    "um, g, ms": lambda one: in_units(one, 1e6, 1e3, 1e3),
    "another order": in_another_order,
    "a turned frame": turned,
}


@pytest.fixture(params=OTHERWISE, name="tell")
def of_each(request):
    return OTHERWISE[request.param]


@pytest.mark.parametrize("seed", range(2))
def test_poles_and_responses(tell, seed):
    one = truss(seed)
    two = tell(one)
    first, second = one.plant, two.plant
    poles = [np.sort(np.abs(p.system.poles())) for p in (first, second)]
    assert first.n_rigid == second.n_rigid == 6
    np.testing.assert_allclose(two.time * poles[1], poles[0], rtol=1e-9, atol=1e-6)
    inputs = [f"u{i}" for i in range(FORCES)]
    outputs = [*(f"tip:{axis}" for axis in AXES), *(f"y{i}" for i in range(FORCES, 13))]
    G1, G2 = (
        np.moveaxis(
            fx.frequency_response(p.system.select(outputs, inputs), FREQ / told.time).data, 2, 0
        )
        for p, told in ((first, one), (second, two))
    )
    G2 = two.force / two.length * G2
    G2[:, :3] = two.turn.T @ G2[:, :3]
    np.testing.assert_allclose(G2, G1, atol=1e-9 * np.abs(G1).max())


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_error_of_the_observer_and_scores(tell, seed):
    one = truss(seed)
    two = tell(one)
    found = []
    for told in (one, two):
        plant = told.sampled
        kalman = fx.design_kalman(plant)
        rms = np.array([kalman.rms(f"tip:{axis}") for axis in AXES])
        layouts = [[f"y{j}" for j in range(FORCES, 13) if j != i] for i in range(FORCES, 13)]
        scores = fx.score_sensors(plant, layouts, fx.PoiVariance("tip", axes=AXES))
        found.append((rms / told.length, dict(zip(scores.layouts, scores.values, strict=True))))
    (rms1, by1), (rms2, by2) = found
    assert np.linalg.norm(rms2) == pytest.approx(np.linalg.norm(rms1), rel=1e-7, abs=0)
    if np.array_equal(two.turn, np.eye(3)):
        np.testing.assert_allclose(rms2, rms1, rtol=1e-7)
    assert by1.keys() == by2.keys()
    for layout, value in by1.items():
        assert by2[layout] / two.length**2 == pytest.approx(value, rel=1e-6, abs=0)


def best_norms(told, sampled):
    """Return the H2 norm, the H-infinity norm and the gain of what its best controllers leave."""
    plant = told.weighted(told.sampled if sampled else told.plant)
    h2 = fx.design_h2(plant).gamma * (1.0 if sampled else np.sqrt(told.time))
    return h2, fx.design_hinf(plant).gamma, fx.peak_gain(plant.Gzw)[0]


@cache
def norms_as_told_first(sampled):
    return best_norms(truss(7, held=True), sampled)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sampled"), [(name, bool(i % 2)) for i, name in enumerate(OTHERWISE)]
)
def test_norms_of_the_best_controllers(name, sampled):
    told = OTHERWISE[name](truss(7, held=True))
    found = [norms_as_told_first(sampled), best_norms(told, sampled)]
    np.testing.assert_allclose(found[1][0], found[0][0], rtol=1e-6)
    np.testing.assert_allclose(found[1][1], found[0][1], rtol=2e-3)
    np.testing.assert_allclose(found[1][2], found[0][2], rtol=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_a_part_that_nothing_couples_changes_nothing(seed):
    """A free mass far away with its own sensors and force: six more motions, three of them seen."""
    one = truss(seed)
    own = one.ports
    dofs = fx.DofSet(
        [*one.nodes, 9, 9, 9],
        [*one.directions, *AXES],
        np.vstack([one.xyz, [[50.0, 9.0, 2.0]] * 3]),
    )
    M, K = la.block_diag(one.M, 3.0 * np.eye(3)), la.block_diag(one.K, np.zeros((3, 3)))
    model = fx.FEModel(M, K, dofs=dofs)
    far = [f"9:{axis}" for axis in AXES]
    ports = own.replace(
        w=[*own.w, *(fx.Disturbance(f"far{i}", at=at, asd=1e-2) for i, at in enumerate(far))],
        y=[*own.y, *(fx.Sensor(f"seen{i}", at=at, asd=1e-9) for i, at in enumerate(far))],
    )
    modes = fx.solve_modes(model, damping=fx.ModalDamping(0.02))
    plant = fx.assemble_plant(modes, ports)
    inputs, outputs = [u.name for u in own.u], [y.name for y in own.y]
    G1, G2 = (
        fx.frequency_response(p.system.select(outputs, inputs), FREQ).data
        for p in (one.plant, plant)
    )
    np.testing.assert_allclose(G2, G1, atol=1e-9 * np.abs(G1).max())
    alone, beside = (
        fx.design_kalman(one.sampled),
        fx.design_kalman(plant.discretized(RATE, delay=1)),
    )
    for axis in AXES:
        assert beside.rms(f"tip:{axis}") == pytest.approx(alone.rms(f"tip:{axis}"), rel=1e-7, abs=0)


@pytest.mark.parametrize("seed", range(2))
def test_two_parts_that_are_joined_are_the_whole(seed):
    """The mass of one node and the springs that meet there as a part of its own."""
    one = truss(seed)
    rng = np.random.default_rng(seed)
    share = rng.uniform(0.1, 0.9, NODES)
    part = np.diag(np.repeat(share, 3))
    M1, K1 = part @ one.M, np.zeros_like(one.K)
    for j in range(4):  # springs of node 5 belong to the other part
        i = 3 * 4
        block = one.K[i : i + 3, 3 * j : 3 * j + 3]
        for a, b, sign in ((4, j, 1), (j, 4, 1), (4, 4, -1), (j, j, -1)):
            K1[3 * a : 3 * a + 3, 3 * b : 3 * b + 3] += sign * block
    whole = one.model
    parts = {
        "a": fx.FEModel(M1, K1, dofs=whole.dofs),
        "b": fx.FEModel(one.M - M1, one.K - K1, dofs=whole.dofs),
    }
    joints = [fx.joining.Joint(f"a/{label}", f"b/{label}") for label in whole.dofs.labels]
    found = fx.solve_modes(fx.joined(parts, joints))
    assert found.n_rigid == 6
    np.testing.assert_allclose(found.omega, fx.solve_modes(whole).omega, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_two_samples_at_twice_the_rate_are_one(seed):
    plant = truss(seed).plant
    slow, fast = (plant.discretized(rate).system for rate in (RATE, 2 * RATE))
    W1, W2 = (plant.discretized(rate).process_noise for rate in (RATE, 2 * RATE))
    A, B = fast.A, fast.B[:, fast.input_index(plant.u)]
    size = np.sqrt(np.diag(W1))
    np.testing.assert_allclose(A @ A, slow.A, atol=1e-11 * np.abs(slow.A).max())
    wanted = slow.B[:, slow.input_index(plant.u)]
    np.testing.assert_allclose(A @ B + B, wanted, atol=1e-10 * np.abs(wanted).max())
    np.testing.assert_allclose(
        (A @ W2 @ A.T + W2) / np.outer(size, size), W1 / np.outer(size, size), atol=1e-8
    )
