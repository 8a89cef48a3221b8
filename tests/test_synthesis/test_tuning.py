"""The tuner beside brute force over the same laws, beyond resonances, on noise and coarse lines."""

from functools import cache

import numpy as np
import pytest

import flexplant as fx
from driven_kinds import KINDS
from flexplant import Frf
from flexplant.synthesis import tune_loops
from flexplant.synthesis.laws.joint_plants import JointPlant
from judge import judged
from oracles_tuning import best_bandwidth

RATE, MASS = 1e4, 2.0
#: elastic modes [Hz] and their residues beside that of the rigid body
PLANTS = {
    "free": {},
    "collocated, below crossover": {300.0: 1.0},
    "turned by half, below crossover": {80.0: -0.1, 700.0: 0.6},
    "turned by half, above crossover": {600.0: -0.4},
    "two above": {1500.0: 0.5, 2300.0: -0.7},
}


def response(freq, modes, late=1.0):
    """A mass with modes of 0.1 %, held and delayed by some samples: continuous closed forms."""
    s = 2j * np.pi * freq
    G = 1 / s**2
    for f, residue in modes.items():
        w = 2 * np.pi * f
        G = G + residue / (s**2 + 2e-3 * w * s + w**2)
    return G / MASS * np.exp(-s * (late + 0.5) / RATE) * np.sinc(freq / RATE)


def dense(modes, points=300):
    """Frequencies through the resonances."""
    around = 1 + 1e-3 * np.sinh(np.linspace(-5, 5, 61))
    own = [f * around for f in modes]
    return np.unique(np.concatenate([np.geomspace(0.5, 4990.0, points), *own]))


def on_truth(law, modes):
    """The largest |S| on the plant itself, and where the loop of the mass alone crosses 1."""
    freq = dense(modes, 20_000)
    C = law.response(freq)
    F = 1 + C * response(freq, modes)
    assert abs(np.angle(F[1:] / F[:-1]).sum() - 1.5 * np.pi) < 0.6  # stable
    line = np.abs(C) / (MASS * (2 * np.pi * freq) ** 2)
    return 1 / np.abs(F).min(), freq[np.flatnonzero(line > 1.0)[-1]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "notches"),
    [
        *((name, 1) for name in PLANTS),
        ("free", 0),
        pytest.param("turned by half, below crossover", 2, marks=pytest.mark.long),
    ],
)
def test_as_fast_as_brute_force(name, notches):
    """On the same lines no search over the same laws finds one that is 2 % faster."""
    modes = PLANTS[name]
    freq = dense(modes)
    G = response(freq, modes)
    best = best_bandwidth(freq, G, RATE, MASS, list(modes), notches)
    found = tune_loops(Frf(freq, G[None, None]), rate=RATE, hold=False, notches=notches)
    peak, bandwidth = on_truth(found.laws["y1"], modes)
    assert peak < 2.02
    assert bandwidth > 0.98 * best
    if name == "collocated, below crossover" or notches == 2:
        assert bandwidth > min(modes)


@cache
def exact_bandwidth():
    """Of the law for the lines without noise."""
    modes, freq = PLANTS["two above"], np.arange(2.0, 4990.0, 2.0)
    frf = Frf(freq, response(freq, modes)[None, None])
    found = tune_loops(frf, rate=RATE, hold=False, notches=1)
    return on_truth(found.laws["y1"], modes)[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "known", [pytest.param("variance", marks=pytest.mark.long), "coherence", "nothing"]
)
def test_noise_is_not_fitted(known):
    """3 % noise on lines of 2 Hz: the plant itself keeps 6 dB, at the cost of a third at most."""
    modes, rng = PLANTS["two above"], np.random.default_rng(5)
    freq = np.arange(2.0, 4990.0, 2.0)
    G = response(freq, modes)
    noisy = G * (1 + 0.03 * rng.standard_normal((2, freq.size)).T @ [0.5**0.5, 0.5**0.5 * 1j])
    share = np.full((1, 1, freq.size), 0.03**2)
    kinds = {
        "variance": {"variance": share * np.abs(G) ** 2},
        "coherence": {"coherence": 1 / (1 + 10 * share), "freedom": 9.0},
        "nothing": {},
    }[known]
    found = tune_loops(Frf(freq, noisy[None, None], **kinds), rate=RATE, hold=False, notches=1)
    peak, bandwidth = on_truth(found.laws["y1"], modes)
    assert peak < 2.02
    assert bandwidth > 0.66 * exact_bandwidth()


@pytest.mark.slow
def test_a_mode_that_lines_do_not_resolve_stays_below():
    """A mode 0.16 Hz wide on lines of 1 Hz with 1 % noise: no law relies on its phase."""
    modes, rng = PLANTS["turned by half, below crossover"], np.random.default_rng(5)
    freq = np.arange(2.0, 2500.0, 1.0) + 0.3
    noise = 1 + 0.01 * rng.standard_normal((2, freq.size)).T @ [0.5**0.5, 0.5**0.5 * 1j]
    frf = Frf(freq, (response(freq, modes) * noise)[None, None])
    found = tune_loops(frf, rate=RATE, hold=False, notches=1)
    peak, bandwidth = on_truth(found.laws["y1"], modes)
    assert peak < 2.05
    assert bandwidth < 80.0


@pytest.mark.slow
def test_a_plant_that_moves_against_its_force_is_named():
    freq = np.geomspace(1.0, 4990.0, 400)
    found = tune_loops(Frf(freq, -response(freq, {})[None, None]), rate=RATE, hold=False, notches=0)
    assert found.laws["y1"].gain < 0.0
    assert "moves against its force" in repr(found)


@cache
def block():
    """24 kg of aluminium: six rigid-body axes, modes from 1189 Hz on."""
    size = 0.42, 0.36, 0.059
    body = fx.solid_block(
        size=size, elements=(6, 5, 2), density=2700, youngs_modulus=70e9, poisson_ratio=0.33
    )
    X, Y, Z = size
    corners = [(x, y, 0.0) for y in (0.06, Y - 0.06) for x in (0.06, X - 0.06)]
    u = [(p, "z") for p in corners]
    u += [((0.0, y, 0.03), "x") for y in (0.08, Y - 0.08)]
    u += [((x, 0.0, 0.03), "y") for x in (0.08, X - 0.08)]
    y = [((0.02, 0.02, Z), "z"), ((X - 0.02, 0.02, Z), "z"), ((X / 2, Y - 0.02, Z), "z")]
    y += [((X, 0.05, 0.04), "x"), ((X, Y - 0.05, 0.04), "x"), ((X / 2 - 0.03, Y, 0.04), "y")]
    y += [((X - 0.05, Y - 0.02, Z), "z"), ((0.05, Y, 0.04), "y")]
    ports = fx.Ports(
        u=[fx.Actuator(f"u{i}", at=p, direction=d) for i, (p, d) in enumerate(u)],
        z=[fx.Poi("body", at=(X / 2, Y / 2, Z), axes=("x", "y", "z", "rx", "ry", "rz"))],
        y=[fx.Sensor(f"y{i}", at=p, direction=d) for i, (p, d) in enumerate(y)],
    )
    modes = fx.solve_modes(body, count=40, damping=fx.ModalDamping(0.005))
    small = modes.select(list(range(12)))
    return fx.assemble_plant(small, ports).discretized(RATE, delay=1), modes


def peak_at_u(plant, design):
    """The largest singular value of S at u, each force in its own size, dense over resonances."""
    G = plant.system.select(plant.y, plant.u)
    K = design.system.select(plant.u, plant.y)
    own = [f * (1 + 1e-3 * np.sinh(np.linspace(-5, 5, 81))) for f in plant.model.freq[6:]]
    freq = np.unique(np.concatenate([np.geomspace(1.0, 4990.0, 2000), *own]))
    near = fx.frequency_response(G, freq[freq < 4990.0])
    P = np.moveaxis(near.data, -1, 0)
    C = np.moveaxis(fx.frequency_response(K, near.freq).data, -1, 0)
    size = np.linalg.norm(fx.decouple(plant).T_u, axis=1)
    loop = (C @ P) / size[:, None] * size
    return 1 / np.linalg.svd(np.eye(len(size)) - loop, compute_uv=False)[:, -1].min()


@pytest.mark.long
def test_six_axes_hold_the_peak_together():
    """Each axis alone reaches 400 Hz and more, and the modes couple them: 40 dB at u together."""
    plant, modes = block()
    found = tune_loops(plant.replace(evaluation=modes), peak=1.7, notches=0)
    assert fx.close_loop(plant.replace(evaluation=modes), found).is_stable
    assert min(one.modulus_margin for one in found.report.loops) >= 1 / 1.7
    assert peak_at_u(plant, found) < 1.7 * 1.001
    assert min(one.crossovers[0] for one in found.report.loops) > 60.0


def coupled(share):
    """Two masses, each an axis of its own, with one mode at 600 Hz that both move and see."""
    freq = dense({600.0: 1.0}, 150)
    s, w = 2j * np.pi * freq, 2 * np.pi * 600.0
    late = np.exp(-1.5 * s / RATE) * np.sinc(freq / RATE)
    mode = np.array([[0.1, share], [share, 0.1]])[:, :, None] / (s**2 + 2e-3 * w * s + w**2)
    return Frf(freq, (np.eye(2)[:, :, None] / s**2 + mode) / MASS * late)


@pytest.mark.long
def test_what_ended_the_search_is_said():
    """Where no laws hold the peak together, the best come back with what stands in the way."""
    found = tune_loops(coupled(0.05), rate=RATE, hold=False, notches=0)
    assert 1 / found.report.modulus_margin <= 2.0
    with pytest.warns(
        fx.FlexplantWarning, match=r"below .* was not reached: \|S\| at [uy] is .* Hz"
    ):
        found = tune_loops(coupled(0.05), rate=RATE, hold=False, notches=0, peak=1.1)


def test_slopes_of_the_joint_distances():
    """By differences of the laws, at u, at y and in each axis, with more actuators than axes."""
    rng, n, k = np.random.default_rng(4), 5, 2
    G = rng.standard_normal((2, 4, n)) + 1j * rng.standard_normal((2, 4, n))
    before, after = rng.standard_normal((4, k)), rng.standard_normal((k, 2))
    frf = Frf(np.arange(1.0, n + 1), G)
    one = JointPlant(frf, before, after, ("a", "b"), 0).coupling(frf.freq)
    C, D = (rng.standard_normal((n, k)) + 1j * rng.standard_normal((n, k)) for _ in range(2))
    assert one.of.places == ("at u", "at y", "of a", "of b")
    L = np.moveaxis(G, -1, 0) @ before @ (C[:, :, None] * after)
    shown = np.linalg.norm(np.linalg.pinv(after), axis=1)  # each output in its own unit
    own = L / shown[:, None] * shown
    least = np.linalg.svd(np.eye(2) + own, compute_uv=False)[:, -1]
    assert one.distances(C)[1] == pytest.approx(least)
    change = (one.distances(C + 1e-6 * D) - one.distances(C - 1e-6 * D)) / 2e-6
    for place, slope in enumerate(change):
        assert np.sum(one.slopes(C, place) * D, axis=1).real == pytest.approx(slope, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_free_axes_and_axes_on_springs_together(seed):
    """Two bodies, one of them on a spring of a few hertz: each axis is what it is at rest."""
    rng = np.random.default_rng(seed)
    masses = rng.uniform(1.0, 20.0, 2)
    K = np.diag([0.0, masses[1] * (2 * np.pi * rng.uniform(3.0, 8.0)) ** 2])
    model = fx.FEModel(
        np.diag(masses),
        K,
        dofs=fx.DofSet([1, 2], ["x", "y"], np.zeros((2, 3))),
        joint_motions=[[1.0], [0.0]],
    )
    own = fx.Ports(
        u=[fx.Actuator(f"f{i}", at=at) for i, at in enumerate(("1:x", "2:y"))],
        z=[fx.Poi(f"p{i}", at=at, axes=(at[-1],)) for i, at in enumerate(("1:x", "2:y"))],
        y=[fx.Sensor(f"s{i}", at=at) for i, at in enumerate(("1:x", "2:y"))],
    )
    modes = fx.solve_modes(model, count=2, damping=fx.ModalDamping(0.01))
    plant = fx.assemble_plant(modes, own).discretized(2e3, delay=1)
    found = tune_loops(plant, notches=0)
    loop = fx.close_loop(plant, found)
    assert np.abs(np.linalg.eigvals(loop.system.A)).max() < 1.0
    assert loop.modulus_margin >= 0.4999
    assert min(one.crossovers[0] for one in found.report.loops) > 40.0


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "seed"), [("dual stroke", 2001), ("screw", 2002), ("table", 2003)]
)
def test_modes_that_move_with_the_laws(kind, seed):
    """Closed-loop resonances that the machine does not have alone: the peak is held at u and y.

    A search on the machine's own resonances ended unstable, and returned 0.33, 0.25 and 0.32.
    """
    plant = KINDS[kind](np.random.default_rng([seed, list(KINDS).index(kind)]))
    found = tune_loops(plant, progress=False)
    assert not any("was not reached" in note for note in found.notes)
    assert judged(plant, found).margin >= 0.499
