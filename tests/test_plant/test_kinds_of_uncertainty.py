"""Each kind of uncertainty against M, D and K changed by hand; combinations; a kind of one's own.

The oracle has its own matrices of the chain and solves ``(M s^2 + D s + K) q = f`` at a frequency.
"""

from dataclasses import dataclass
from functools import cache
from itertools import permutations

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import LabelError, ModelError
from flexplant.plant import (
    Dampings,
    Delay,
    Delta,
    Fit,
    Frequencies,
    Gains,
    MachineParts,
    Neglected,
    Parameters,
    Shapes,
    Uncertainty,
)

N = 4
POINTS = 2j * np.pi * np.array([3.0, 41.0, 97.0, 160.0])
QUANTITIES = ("displacement", "velocity", "acceleration")


class Chain:
    """A free chain with modal damping, and what is changed of it, in plain numpy."""

    def __init__(self, seed):
        rng = np.random.default_rng([seed, 563])
        self.masses, self.springs = rng.uniform(0.5, 2.0, N), rng.uniform(1e5, 6e5, N - 1)
        self.M = np.diag(self.masses)
        self.K = np.zeros((N, N))
        for i, k in enumerate(self.springs):
            self.K[i : i + 2, i : i + 2] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
        root = np.sqrt(self.masses)
        values, vectors = np.linalg.eigh(self.K / np.outer(root, root))
        self.omega, self.phi = np.sqrt(np.maximum(values, 0.0)), vectors / root[:, None]
        self.omega[0] = 0.0
        self.zeta = np.where(self.omega > 0, 0.01, 0.0)
        self.gain = {"u1": 1.0, "u2": 1.0, "y1": 1.0, "y2": 1.0}
        self.quantity = ("displacement", QUANTITIES[seed % 3])

    @property
    def D(self):
        push = self.M @ self.phi
        return push @ np.diag(2.0 * self.zeta * self.omega) @ push.T

    def plant(self, rate=0.0, reduced=False):
        model = fx.chain(masses=self.masses, stiffnesses=self.springs)
        modes = fx.solve_modes(model, count=N, damping=fx.ModalDamping(0.01))
        if reduced:
            modes = fx.reduce(modes, fx.DesiredDofs([f"{i}:x" for i in range(1, N + 1)]))
        ports = fx.Ports(
            w=[fx.Disturbance("floor", at="3:x", asd=1e-3)],
            u=[fx.Actuator("u1", at="1:x"), fx.Actuator("u2", at="2:x")],
            z=[fx.Poi("die", at="4:x", axes=("x",))],
            y=[
                fx.Sensor(f"y{i}", at=f"{i + 1}:x", quantity=q, asd=1e-9)
                for i, q in enumerate(self.quantity, 1)
            ],
        )
        plant = fx.assemble_plant(modes, ports)
        return plant.discretized(rate, delay=1.4) if rate else plant

    def response(self, M=None, D=None, K=None, phi=None):
        """Gyu (2, 2, f) of matrices, or of modal sums where shapes differ."""
        M, D, K = (own if given is None else given for own, given in zip(
            (self.M, self.D, self.K), (M, D, K), strict=True))  # fmt: skip
        found = []
        for s in POINTS:
            if phi is None:
                q = np.linalg.solve(M * s**2 + D * s + K, np.eye(N)[:, :2])
            else:
                tuned = s**2 + 2.0 * self.zeta * self.omega * s + self.omega**2
                q = (phi / tuned) @ phi.T[:, :2]
            order = [s ** QUANTITIES.index(one) for one in self.quantity]
            found.append(q[[1, 2]] * np.array(order)[:, None])
        scale = np.outer([self.gain["y1"], self.gain["y2"]], [self.gain["u1"], self.gain["u2"]])
        return np.moveaxis(np.array(found) * scale, 0, -1)

    def along_mode(self, mode):
        """(M phi)(M phi)'."""
        push = self.M @ self.phi[:, mode - 1]
        return np.outer(push, push)


def frequencies(own, x):
    return {"K": own.K + 2.0 * 0.02 * x * own.omega[1] ** 2 * own.along_mode(2)}


def dampings(own, x):
    return {"D": own.D + 0.3 * x * 2.0 * own.zeta[2] * own.omega[2] * own.along_mode(3)}


def gains(own, x):
    own.gain["u2"] = 1.0 + 0.05 * x
    return {}


def parameters(own, x):
    M = own.M.copy()
    M[2, 2] += 0.1 * x
    return {"M": M}


def shapes(own, x):
    phi = own.phi.copy()
    phi[:, 3] += 2.0 * x * direction()
    return {"phi": phi}


def fits(own, x):
    """Two standard deviations of a measured pole: relative, of omega^2 and 2 zeta omega."""
    return {"K": own.K + 4e-3 * x * own.omega[3] ** 2 * own.along_mode(4)}


def direction():
    return 0.02 * np.array([1.0, -2.0, 0.5, 1.5])


def measured(own):
    """A pole of mode 4 whose decay rate is known and whose frequency has a deviation of 0.1 %."""
    pole = own.omega[3] * (-0.01 + 1j * np.sqrt(1 - 1e-4))
    std = 1e-3 * abs(pole) ** 2 / pole.imag
    return fx.MeasuredModes([pole], modes=[4], covariance=np.diag([1e-14 * std**2, std**2]))


#: kind, the name of its Delta, the change by hand, and whether the plant has matrices
KINDS = {
    "frequencies": (lambda own: Frequencies({2: 0.02}), "mode2:freq", frequencies, False),
    "dampings": (lambda own: Dampings({3: 0.3}), "mode3:damping", dampings, False),
    "gains": (lambda own: Gains({"u2": 0.05}), "u2:gain", gains, False),
    "parameters": (
        lambda own: Parameters({fx.AddedMass("3:x"): 0.1}), "mass at 3:x", parameters, True,
    ),
    "shapes": (lambda own: Shapes(direction()[None, :, None], [4]), "mode4:shape1", shapes, False),
    "fit": (lambda own: Fit(measured(own)), "mode4:freq", fits, False),
}  # fmt: skip


def responses(system, u=("u1", "u2"), y=("y1", "y2")):
    """Gyu of a continuous system, by its matrices."""
    g = system.select(list(y), list(u))
    eye = np.eye(len(g.A))
    return np.stack([g.C @ np.linalg.solve(s * eye - g.A, g.B) + g.D for s in POINTS], axis=-1)


def by_channels(uncertain, values):
    """The plant of some Deltas by the definition w = delta z, by hand."""
    g, owner = uncertain.system, list(uncertain.channels.values())
    k, eye = len(owner), np.eye(g.n_states)
    delta = np.diag([values.get(name, 0.0) for name in owner])
    u, y = g.input_index(["u1", "u2"]), g.output_index(["y1", "y2"])
    found = []
    for s in POINTS:
        H = g.C @ np.linalg.solve(s * eye - g.A, g.B) + g.D
        inner = delta @ np.linalg.solve(np.eye(k) - H[:k, :k] @ delta, H[:k][:, u])
        found.append(H[np.ix_(y, u)] + H[y][:, :k] @ inner)
    return np.stack(found, axis=-1)


def assert_same(found, wanted, digits=1e-8):
    np.testing.assert_allclose(found, wanted, rtol=0, atol=digits * np.abs(wanted).max())


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_a_kind_is_the_plant_with_the_changed_property(name, seed):
    """Opened as a Delta and as a machine, at three values of it."""
    own = Chain(seed)
    kind, delta, change, matrices = KINDS[name]
    uncertain = own.plant(reduced=matrices).uncertain(kind(own))
    assert delta in {one.name for one in uncertain.deltas}
    nominal = own.response()
    for x in (1.0, -0.6, 0.0):
        wanted = own.response(**change(own, x))
        assert_same(by_channels(uncertain, {delta: x}), wanted)
        assert_same(responses(uncertain.lft({delta: x}).system), wanted)
        assert np.any(np.abs(wanted - nominal) > 1e-3 * np.abs(nominal)) == bool(x)


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_machines_that_are_drawn_have_the_property_at_some_value(name):
    """One number explains all responses of each machine, and its deviation is a half."""
    own = Chain(1)
    kind, _, change, matrices = KINDS[name]
    uncertain = own.plant(reduced=matrices).uncertain(kind(own))
    base, found = own.response(), []
    for machine in uncertain.machines.drawn(120, rng=3):
        made, x = responses(machine.system), 0.0
        for _ in range(12):  # Newton's steps to the number at which the plant by hand is the same
            now, near = (own.response(**change(own, at)) for at in (x, x + 1e-5))
            slope, miss = (near - now) / 1e-5 / base, (made - now) / base
            x += np.vdot(slope, miss).real / np.vdot(slope, slope).real
        assert np.abs(miss).max() < 1e-6
        found.append(np.log1p(0.3 * x) / 0.3 if name == "dampings" else x)
    assert np.std(found) == pytest.approx(0.5, rel=0.2)
    assert abs(np.mean(found)) < 0.15


@pytest.mark.slow
def test_a_delay_is_the_plant_that_was_sampled_with_it():
    own = Chain(0)
    uncertain = own.plant(2e3).uncertain(Delay(0.3))
    for x in (1.0, -0.5):
        wanted = own.plant().discretized(2e3, delay=1.4 + 0.3 * x)
        z = np.exp(POINTS / 2e3)
        gap = []
        for system in (uncertain.lft({"delay": x}).system, wanted.system):
            g = system.select(["y1", "y2"], ["u1", "u2"])
            gap.append([g.C @ np.linalg.solve(p * np.eye(len(g.A)) - g.A, g.B) + g.D for p in z])
        assert_same(np.array(gap[0]), np.array(gap[1]), 1e-10)
    late = np.array([machine.delay for machine in uncertain.machines.drawn(200, rng=1)])
    assert late.std() == pytest.approx(0.15, rel=0.15)


SOME = ("frequencies", "dampings", "gains", "fit")


@pytest.mark.parametrize("others", [("shapes",), ("parameters",), ()])
def test_kinds_combine_in_any_order(others):
    """All at once are the matrices with all changes; the order of the kinds does not matter."""
    names = (*SOME, *others)
    own = Chain(2)
    plant = own.plant(reduced="parameters" in others)
    values = dict(zip([KINDS[n][1] for n in names], (0.7, -0.9, 0.8, -0.5, 0.6), strict=False))
    changed: dict = {"M": own.M.copy(), "D": own.D.copy(), "K": own.K.copy()}
    for name in names:
        for matrix, made in KINDS[name][2](own, values[KINDS[name][1]]).items():
            if matrix != "phi":
                changed[matrix] = changed[matrix] + made - getattr(own, matrix)
    if "shapes" in names:  # by modal sums: the other changes keep the shapes
        phi = shapes(own, values["mode4:shape1"])["phi"]
        inner = {m: own.phi.T @ changed[m] @ own.phi for m in "DK"}
        own.omega = np.sqrt(np.maximum(np.diag(inner["K"]), 0.0))
        own.omega[0] = 0.0
        own.zeta[1:] = 0.5 * np.diag(inner["D"])[1:] / own.omega[1:]
        wanted = own.response(phi=phi)
        own = Chain(2)
    else:
        wanted = own.response(**changed)
    first = None
    for order in list(permutations(names))[::17]:
        uncertain = plant.uncertain(*(KINDS[name][0](own) for name in order))
        assert_same(by_channels(uncertain, values), wanted)
        assert_same(responses(uncertain.lft(values).system), wanted)
        listed = [delta.name for delta in uncertain.deltas]
        drawn = responses(uncertain.machines.drawn(1, rng=5)[0].system)
        first = first or (listed, drawn)
        assert listed == first[0]
        assert_same(drawn, first[1], 1e-12)


@cache
def whole():
    model = fx.chain(masses=[1.0] * 6, stiffnesses=[4e5] * 5)
    return fx.solve_modes(model, count=6, damping=fx.ModalDamping(0.01))


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.0, 2e3])
def test_neglected_modes_are_bounded_and_drawn(rate):
    """Machines have the modes that the plant lacks; what these do lies below the weights."""
    ports = fx.testbeds.three_masses().assembled.ports
    plant, big = (fx.assemble_plant(whole().select(range(k)), ports) for k in (3, 6))
    if rate:
        plant, big = (one.discretized(rate, delay=1) for one in (plant, big))
    uncertain = plant.uncertain(Neglected(whole()), frequency={2: 0.01})
    bound = uncertain.neglected if not rate else uncertain.neglected.sampled
    assert bound.tightest <= 1.0
    for machine in uncertain.machines.drawn(3, rng=2):
        assert machine.system.n_states == big.system.n_states
        poles, own = (np.linalg.eigvals(one.continuous.system.A) for one in (machine, big))
        poles, own = (np.sort(np.abs(p[p.imag > 1.0])) for p in (poles, own))
        moved = np.abs(poles / own - 1.0)
        assert 1e-6 < moved[0] < 0.02
        assert moved[1] < 1e-9
        # those that the plant leaves out are known as well as mode 2
        assert np.all((moved[2:] > 1e-6) & (moved[2:] < 0.02))
    assert plant.uncertain(uncertain.neglected, frequency={2: 0.01}).neglected.tightest <= 1.0
    with pytest.raises(ModelError, match="no evaluation model"):
        plant.uncertain(Neglected(), frequency=0.01)
    judged = plant.replace(evaluation=whole()).uncertain(Neglected(), frequency={2: 0.01})
    assert judged.neglected.tightest == uncertain.neglected.tightest
    np.testing.assert_array_equal(
        judged.machines.drawn(1, rng=2)[0].system.A, uncertain.machines.drawn(1, rng=2)[0].system.A
    )
    with pytest.raises(ModelError, match="neglected twice"):
        plant.uncertain(Neglected(whole()), Neglected(whole()), frequency=0.01)


@dataclass(frozen=True, eq=False)
class Stretch(Delta):
    """All frequencies together, as by the temperature of the whole machine."""

    def changed(self, machine: MachineParts, amount: float) -> MachineParts:
        pairs = np.array(machine.pairs)
        elastic = machine.realisation.n_rigid
        pairs[elastic:, 1, 0] *= 1.0 + amount
        return machine.replace(pairs=pairs)


@dataclass(frozen=True, eq=False)
class Temperature(Uncertainty):
    """A kind that only this test has."""

    share: float

    def deltas(self, plant):
        return [Stretch("temperature", self.share)]


@pytest.mark.parametrize("rate", [0.0, 4e3])
def test_a_kind_of_ones_own(rate):
    """It says what a machine is; channels, draws and mu follow, with all other kinds."""
    own = Chain(0)  # displacements: A is affine in it
    plant = own.plant(rate)
    uncertain = plant.uncertain(Temperature(0.04), Gains({"u2": 0.05}), Dampings({3: 0.3}))
    names = [delta.name for delta in uncertain.deltas]
    assert names == ["temperature", "mode3:damping", "u2:gain"]
    values = {"temperature": -0.8, "u2:gain": 1.0, "mode3:damping": 0.5}
    K, D = own.K * (1.0 - 0.8 * 0.04), dampings(own, 0.5)["D"]
    gains(own, 1.0)
    wanted = own.response(K=K, D=D)
    assert_same(by_channels(uncertain, values), wanted)
    assert_same(responses(uncertain.lft(values).continuous.system), wanted)
    assert len({machine.system.A[1, 0] for machine in uncertain.machines.drawn(5, rng=1)}) == 1
    assert "temperature +- 4 %" in repr(uncertain)


def test_what_is_not_known_is_refused_by_name():
    own = Chain(0)
    plant = own.plant()
    with pytest.raises(LabelError, match="elastic mode of the plant"):
        plant.uncertain(Shapes(direction()[None, :, None], [9]))
    with pytest.raises(ModelError, match="got int"):
        plant.uncertain(3)
    with pytest.raises(ModelError, match="mode2:freq is uncertain twice"):
        plant.uncertain(Frequencies({2: 0.01}), frequency=0.02)
    with pytest.raises(ModelError, match="of the shape of a mode"):
        own.plant(reduced=True).uncertain(
            Shapes(direction()[None, :, None], [4]), Parameters({fx.AddedMass("3:x"): 0.1})
        )


def steps(plant):
    """What may be done to a plant with uncertainty, by name."""
    weights = {"z": {"die:x": 2.0}, "w": {"amp": 3.0}}
    return {
        "discretized": lambda one: one.discretized(2e3, delay=1.2),
        "at": lambda one: one.at({"die": "2:x"}),
        "through": lambda one: one.through(fx.reference_errors(plant)),
        "weighted": lambda one: one.weighted(**weights),
        "uncertain": lambda one: one.uncertain(
            Gains({"u1": 0.02}), Neglected(), frequency={2: 0.01}
        ),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    "order",
    [
        *permutations(["discretized", "at", "uncertain"]),
        *list(permutations(["discretized", "at", "uncertain", "through", "weighted"]))[::9],
    ],
)
def test_uncertainty_survives_whatever_is_done_to_the_plant(order):
    """Steps in any order: the Deltas are those of the plant on which they were stated last."""
    ports = fx.testbeds.three_masses().assembled.ports
    plant = fx.assemble_plant(whole().select(range(3)), ports, evaluation=whole())
    last = plant.discretized(2e3, delay=1.2).at({"die": "2:x"})
    wanted = steps(plant)["uncertain"](last)
    made = plant
    for name in order:
        made = steps(plant)[name](made)
    known = made if isinstance(made, fx.plant.UncertainPlant) else made.uncertainty
    assert [delta.name for delta in known.deltas] == [delta.name for delta in wanted.deltas]
    np.testing.assert_allclose(known.system.B, wanted.system.B, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(known.system.C, wanted.system.C, rtol=1e-12, atol=1e-15)
    assert (known.plant.dt, known.plant.delay) == (1 / 2e3, 1.2)
    assert known.neglected.sampled.tightest == pytest.approx(wanted.neglected.sampled.tightest)
    values = {"mode2:freq": 0.8, "u1:gain": -1.0}
    np.testing.assert_allclose(
        known.lft(values).system.A, wanted.lft(values).system.A, rtol=1e-12, atol=1e-15
    )
    # what takes a plant takes it with the uncertainty
    assert fx.plant.standard_plant(known).uncertainty.frequencies == {2: pytest.approx(0.01)}
