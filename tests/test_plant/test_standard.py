"""StandardPlant: its parts, the same machine with other ports, and what comes from elsewhere."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexplant import load
from flexplant.errors import FlexplantError, LabelError, ModelError
from flexplant.lti import StateSpace, frequency_response, high_pass_filter, low_pass_filter
from flexplant.plant import (
    Actuator,
    BaseAcceleration,
    GeneralizedPlant,
    Poi,
    Reference,
    Sensor,
    StandardPlant,
    assemble_plant,
    building,
)
from stages import OFF_NODE, RATE, Z8, L, ports, reduced, sampled, some_modes


@pytest.fixture(scope="module")
def plant():
    return assemble_plant(some_modes(), ports())


def elsewhere(dt=0.0):
    return StateSpace(
        [[-1.0, 2.0], [0.0, -3.0]],
        [[1.0, 0.0], [0.5, 2.0]],
        [[1.0, 0.0], [0.0, 1.0]],
        [[0.0, 1.0], [0.5, 0.0]],
        dt,
        inputs=["force", "wind"],
        outputs=["seen", "die"],
    )


def test_blocks_make_up_the_system(plant):
    for p in (plant, plant.discretized(RATE, delay=1)):
        g = p.system
        np.testing.assert_array_equal(np.hstack([p.B1, p.B2]), g.B)
        np.testing.assert_array_equal(np.vstack([p.C1, p.C2]), g.C)
        np.testing.assert_array_equal(np.block([[p.D11, p.D12], [p.D21, p.D22]]), g.D)
        for part, rows, columns in (
            (p.Gzw, p.z, p.w),
            (p.Gzu, p.z, p.u),
            (p.Gyw, p.y, p.w),
            (p.Gyu, p.y, p.u),
        ):
            assert (part.outputs, part.inputs) == (rows, columns)
            assert part.dt == p.dt


def test_arrays_are_read_only_and_values_frozen(plant):
    with pytest.raises(ValueError, match="read-only"):
        plant.system.A[0, 0] = 1.0
    with pytest.raises(AttributeError):
        plant.delay = 3.0
    with pytest.raises(TypeError):
        plant.asd["amp1"] = 3.0


def test_repr_is_short_and_has_no_array(plant):
    lines = repr(plant.discretized(RATE, delay=1)).splitlines()
    assert lines[0] == "<StandardPlant: 54 states, dt 0.0001 s, delay 1>"
    assert lines[2] == "  u (4) u1  u2  u3  u4"
    assert lines[1].endswith("...")  # nine of w
    assert len(lines) == 5
    assert "continuous" in repr(plant)


def test_sampling_remembers_where_it_came_from(plant):
    late = plant.discretized(RATE, delay=1.5)
    assert late.continuous is plant
    assert late.delay == 1.5
    assert late.dt == pytest.approx(1e-4, rel=1e-15)
    assert (late.w, late.u, late.z, late.y) == (plant.w, plant.u, plant.z, plant.y)
    assert late.asd == plant.asd


def test_poles_of_a_sampled_plant_are_exponentials(plant):
    # oracle: e^(lambda h); rigid-body ones exactly 1
    poles = plant.discretized(RATE).system.poles()
    assert np.array_equal(poles[:6], np.ones(6))
    modes = some_modes()
    zeta, omega = modes.basis_zeta[3:], modes.basis_omega[3:]
    wanted = np.exp(omega * (-zeta + 1j * np.sqrt(1 - zeta**2)) / RATE)
    upper = [max(pair, key=lambda p: p.imag) for pair in poles[6:].reshape(-1, 2)]
    np.testing.assert_allclose(upper, np.where(wanted.imag > 0, wanted, wanted.conj()), rtol=1e-11)


def test_to_control_and_back(plant):
    for p in (plant, plant.discretized(RATE, delay=1)):
        twin = p.to_control()
        assert list(twin.input_labels) == list(p.system.inputs)
        assert list(twin.output_labels) == list(p.system.outputs)
        assert twin.dt == p.dt
        again = StandardPlant.from_statespace(twin, w=p.w, u=p.u, z=p.z, y=p.y)
        for name in "ABCD":
            np.testing.assert_array_equal(getattr(again.system, name), getattr(p.system, name))
        assert again.system.dt == p.system.dt
        assert (again.w, again.z) == (p.w, p.z)


def test_moving_the_poi_changes_rows_of_c_alone(plant):
    for base in (plant, plant.discretized(RATE, delay=1.5)):
        moved = base.at(poi=OFF_NODE)
        fresh = assemble_plant(some_modes(), ports(die=OFF_NODE))
        fresh = fresh.discretized(RATE, delay=1.5) if base.dt else fresh
        for name in "ABCD":
            np.testing.assert_array_equal(getattr(moved.system, name), getattr(fresh.system, name))
        assert np.array_equal(moved.system.A, base.system.A)
        changed = np.any(moved.system.C != base.system.C, axis=1)
        assert [n for n, c in zip(base.system.outputs, changed, strict=True) if c] == [
            *base.z[:4]
        ]  # die:z, rx, ry and the error
        if base.dt:
            np.testing.assert_array_equal(moved.process_noise, base.process_noise)
        assert moved.assembled.ports.poi("die").at == OFF_NODE
        assert base.assembled.ports.poi("die").at == (L / 2, L / 2, 0.0)


def test_moving_one_of_several():
    two = [Poi("die", at=OFF_NODE), Poi("edge", at=Z8)]
    plant = assemble_plant(some_modes(), ports(z=two, references=[Reference("edge")]))
    moved = plant.at({"edge": (0.0, 0.0, 0.0)})
    C = moved.system.C - plant.system.C
    assert not C[0].any()
    assert C[1].any()
    np.testing.assert_array_equal(C[2], -C[1])
    with pytest.raises(LabelError, match=r"2 POIs \(die, edge\): say which, at\(\{name: point\}\)"):
        plant.at(Z8)
    with pytest.raises(LabelError, match="no POI 'dye'"):
        plant.at({"dye": Z8})


def test_moving_off_the_plate_is_refused(plant):
    with pytest.raises(LabelError, match=r"(off|outside|not on) the"):
        plant.at((0.61, 0.3, 0.0))
    with pytest.raises(ModelError, match="NaN"):
        plant.at((np.nan, 0.3, 0.0))
    with pytest.raises(ModelError, match="not assembled from a structure"):
        StandardPlant.from_statespace(elsewhere(), u=["force"], y=["seen"]).at(Z8)


def test_other_ports_on_the_same_modes():
    base = sampled(reduced(), delay=1)
    other = ports(y=[Sensor("s", at=OFF_NODE, asd=1e-12)], asd=2e-3)
    fresh = sampled(reduced(), other, delay=1)
    again = base.with_ports(other)
    for name in "ABCD":
        np.testing.assert_array_equal(getattr(again.system, name), getattr(fresh.system, name))
    np.testing.assert_array_equal(again.process_noise, fresh.process_noise)
    assert again.assembled.realisation is base.assembled.realisation
    assert again.y == ("s", "die:ref")
    with pytest.raises(ModelError, match="assemble_plant"):
        StandardPlant.from_statespace(elsewhere(), u=["force"], y=["seen"]).with_ports(other)


def test_channels_by_their_aliases(plant):
    for alias in ("die", "die:z", "die:hat"):
        assert plant.channel(alias) == "die:z"
    assert plant.channel("die:rx:hat") == "die:rx"
    assert plant.channel("die:error") == "die:error"
    assert plant.channel("u1", side="u") == "u1"
    with pytest.raises(LabelError, match="no channel of z 'dye'"):
        plant.channel("dye")


def test_saves_and_loads(tmp_path, plant):
    late = plant.discretized(RATE, delay=1)
    late.save(tmp_path / "p.npz")
    again = load(tmp_path / "p.npz")
    np.testing.assert_array_equal(again.system.A, late.system.A)
    np.testing.assert_array_equal(again.process_noise, late.process_noise)
    assert again.w == late.w
    np.testing.assert_array_equal(again.at(poi=OFF_NODE).system.C, late.at(poi=OFF_NODE).system.C)


def test_from_elsewhere():
    plant = StandardPlant.from_statespace(elsewhere(), u=["force"], y=["seen"], asd={"wind": 2.0})
    assert (plant.w, plant.u, plant.z, plant.y) == (("wind",), ("force",), ("die",), ("seen",))
    assert plant.B1[1, 0] == 2.0
    assert plant.D21[0, 0] == 1.0
    assert plant.D12[0, 0] == 0.5
    assert plant.n_rigid == 0
    assert plant.model is None
    freq = np.array([0.1, 3.0])
    found = frequency_response(plant.Gzw, freq)["die", "wind"]
    np.testing.assert_allclose(found, 2 / (2j * np.pi * freq + 3), rtol=1e-12)
    fast = plant.discretized(10.0, delay=1)
    assert fast.system.n_states == 3
    assert fast.continuous is plant
    np.testing.assert_allclose(fast.B1[1, 0], 2 * (1 - np.exp(-0.3)) / 3, rtol=1e-12)
    with pytest.raises(ModelError, match=r"process noise.*assemble_plant\(model, ports\)"):
        _ = fast.process_noise


def test_from_elsewhere_refuses():
    g = elsewhere()
    with pytest.raises(LabelError, match=r"no .*'push'"):
        StandardPlant.from_statespace(g, u=["push"], y=["seen"])
    with pytest.raises(LabelError, match=r"no .*'look'"):
        StandardPlant.from_statespace(g, u=["force"], y=["look"])
    with pytest.raises(LabelError, match=r"inputs hold .* more than once"):
        StandardPlant.from_statespace(g, u=["force"], y=["seen"], w=["wind", "force"])
    with pytest.raises(LabelError, match=r"outputs hold .* more than once"):
        StandardPlant.from_statespace(g, u=["force"], y=["seen"], z=["die", "seen"])
    with pytest.raises(LabelError, match="no w channel with an asd 'storm'"):
        StandardPlant.from_statespace(g, u=["force"], y=["seen"], asd={"storm": 1.0})
    with pytest.raises(ModelError, match="StateSpace"):
        StandardPlant.from_statespace("g", u=["force"], y=["seen"])
    with pytest.raises(LabelError, match="are not"):
        StandardPlant(g, ("wind",), ("force",), ("die",), ("seen",), {})
    right = g.select(["die", "seen"], ["wind", "force"])
    with pytest.raises(LabelError, match="are not"):
        StandardPlant(right, ("wind",), ("force",), ("seen",), ("die",), {})
    for bad in (-1.0, np.nan):
        with pytest.raises(ModelError, match="asd of 'wind'"):
            StandardPlant.from_statespace(g, u=["force"], y=["seen"], asd={"wind": bad})


def test_sampling_refuses(plant):
    for rate in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ModelError, match="rate"):
            plant.discretized(rate)
    for delay in (-1.0, np.nan):
        with pytest.raises(ModelError, match="delay"):
            plant.discretized(RATE, delay=delay)
    with pytest.raises(ModelError, match=r"sampled already.*plant.continuous"):
        plant.discretized(RATE).discretized(RATE)
    with pytest.raises(ModelError, match=r"noise of each sample.*discretized\(rate"):
        _ = plant.sensor_noise
    with pytest.raises(ModelError, match=r"discretized\(rate\)"):
        _ = plant.process_noise


@pytest.mark.slow
@given(st.integers(0, 3) | st.floats(0.01, 3.0), st.floats(600.0, 2e4))
def test_a_static_force_accelerates_the_rigid_body_alike_at_any_rate(delay, rate):
    # oracle: F = m a of the whole plate; integer delays and fractions leave the sum of forces
    plant = assemble_plant(some_modes(), ports()).discretized(rate, delay=delay)
    g = plant.Gzu
    rigid = slice(0, 6)
    B, A = g.B[rigid], g.A[rigid, rigid]
    assert np.array_equal(np.diag(A), np.ones(6))
    lines = g.A[rigid, 50:]
    gains = B.sum(axis=1) + lines.sum(axis=1)
    mass = 0.6 * 0.6 * 0.0272 * 2702
    # acceleration 4 / m from four units of force: the change of velocity over one sample
    speed = (g.C[0, rigid] @ (A - np.eye(6)) @ gains) * rate
    np.testing.assert_allclose(speed * rate, 4 / mass, rtol=1e-8)


def test_other_kinds_are_refused_at_the_door(plant):
    g = plant.system
    one = StandardPlant.from_statespace(g.select(["die:z", "y1"], ["amp1", "u1"]), u="u1", y="y1")
    assert one.w == ("amp1",)  # "u1" is one name and not the letters u and 1
    doors = [
        (lambda: StandardPlant.from_statespace(g, u=3, y=["y1"]), "u are chosen by name, got 3"),
        (lambda: plant.discretized(None), "rate must"),
        (lambda: plant.discretized("fast"), "rate must"),
        (lambda: plant.discretized(1e4, delay=None), "delay must"),
        (lambda: plant.discretized(1e4, delay=True), "delay must be one number"),
        (lambda: plant.weighted(z="die:z"), "weights of z must be of type Mapping, got str"),
        (lambda: plant.with_ports(["u1"]), r"ports must be of type Ports, got list.*Ports\(w="),
        (lambda: plant.at(None), "at needs a place"),
        (lambda: plant.along("dye", [(0.1, 0.1, 0.0)]), "no POI 'dye'"),
        (lambda: plant.along("die", None), "points must"),
        (lambda: plant.uncertain("fit"), "UpdateResult or MeasuredModes, got str"),
    ]
    for call, words in doors:
        with pytest.raises(FlexplantError, match=words):
            call()


class TestWhereItCameFrom:
    """`assembled` for a plant of a structure, weighted or not; a clear error for others."""

    def test_assembled(self):
        plant = assemble_plant(some_modes(), ports())
        fast = plant.discretized(1e4, delay=1.5)
        assert fast.assembled.continuous is plant
        assert fast.continuous is plant
        assert plant.continuous is plant
        assert fast.delay == fast.assembled.delay == 1.5
        assert plant.machine is plant
        assert plant.model is not None
        factor = fast.assembled.noise_factor
        np.testing.assert_array_equal(fast.process_noise, factor @ factor.T)

    def test_weighted(self):
        plant = assemble_plant(some_modes(), ports()).discretized(1e4, delay=1.5)
        heavy = plant.weighted(z={"die:z": 2.0}).weighted(w={plant.w[0]: 3.0})
        assert isinstance(heavy, GeneralizedPlant)
        assert heavy.unweighted is heavy.machine is plant
        assert heavy.assembled is plant.assembled
        assert heavy.delay == 1.5
        with pytest.raises(ModelError, match="process noise"):
            _ = heavy.process_noise

    def test_elsewhere(self):
        plant = assemble_plant(some_modes(), ports())
        bare = StandardPlant.from_statespace(plant.system)
        for foreign in (bare, bare.discretized(1e4, delay=1), bare.weighted(z={"die:z": 2.0})):
            assert foreign.model is None
            assert not foreign.modal_blocks.size
            with pytest.raises(ModelError, match=r"not assembled.*Make it by assemble_plant"):
                _ = foreign.assembled
        assert bare.discretized(1e4, delay=1).delay == 1
        assert bare.discretized(1e4).continuous is bare

    def test_noise_known_elsewhere(self):
        """A plant that was exported and read again, with its noise: the same Kalman filter."""
        plant = assemble_plant(some_modes(), ports()).discretized(1e4, delay=1)
        again = StandardPlant.from_statespace(
            plant.system, asd=plant.asd, noise_factor=plant.noise_factor
        )
        np.testing.assert_allclose(again.process_noise, plant.process_noise, rtol=1e-12, atol=0.0)

    def test_check_is_made_once(self):
        plant = assemble_plant(some_modes(), ports())
        assert plant.check() is plant.check()
        assert plant.check().assumptions is plant.check().assumptions


DYNAMIC = low_pass_filter(2e3, order=2)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [None, 0.0, 1.0, 1.5])
@pytest.mark.parametrize("late", [0.0, 130e-6])
@pytest.mark.parametrize("part", [DYNAMIC, None], ids=["filters", "bare"])
def test_some_of_a_plants_ports_are_rows_and_columns_of_it(monkeypatch, part, late, delay):
    """What is left out takes its filters and delay lines along; nothing is assembled again."""
    usual = ports()
    floor = BaseAcceleration("floor", "z", asd=1e-5, shape=high_pass_filter(1.0, order=2))
    y = [
        Sensor("y1", at=Z8, asd=1e-11, dynamics=part, latency=late),
        Sensor("y2", at=(0.1, 0.1, 0.0), asd=1e-11, absolute=True),
        Sensor("y3", at=(0.2, 0.1, 0.0), asd=1e-11, dynamics=part),
        Sensor("y4", at=(0.3, 0.2, 0.0), quantity="velocity", asd=1e-9, latency=late),
    ]
    u = [
        Actuator("u1", at=Z8, dynamics=part),
        Actuator("u2", at=(0.1, 0.3, 0.0), latency=late),
        Actuator("u3", at=(0.3, 0.3, 0.0), dynamics=part, latency=late),
    ]
    every = usual.replace(w=[*usual.w, floor], y=y, u=u)

    def made(own):
        plain = assemble_plant(some_modes(), own)
        return plain if delay is None else plain.discretized(RATE, delay=delay)

    choices = [every.replace(y=a, u=b) for a, b in ((y[:1], u), (y[1:], u[1:]), (y[::2], u[:1]))]
    fresh = [made(choice) for choice in choices]
    whole = made(every)
    monkeypatch.setattr(building, "continuous_plant", None)
    for choice, expected in zip(choices, fresh, strict=True):
        found = whole.with_ports(choice)
        assert [getattr(found, s) for s in "wuzy"] == [getattr(expected, s) for s in "wuzy"]
        assert found.system.states == expected.system.states
        assert found.system.blocks == expected.system.blocks
        assert found.asd == expected.asd
        assert found.delay == expected.delay
        for name in "ABCD":
            one, other = getattr(found.system, name), getattr(expected.system, name)
            assert np.allclose(one, other, rtol=1e-9, atol=1e-12 * np.abs(other).max())
        if delay is not None:
            noise, other = found.process_noise, expected.process_noise
            size = np.sqrt(np.diagonal(other))
            assert np.all(np.abs(noise - other) <= 1e-9 * np.outer(size, size))
            assert found.continuous.system.states == expected.continuous.system.states


def test_other_ports_are_assembled(plant):
    """Another order, another place, or noise of an actuator that the states hold mixed."""
    own = ports()
    moved = [own.y[0].replace(at=(0.2, 0.2, 0.0)), *own.y[1:]]
    noisy = [own.u[0].replace(asd=1e-3), *own.u[1:]]
    whole = plant.with_ports(own.replace(u=noisy))
    for one, other in (
        (plant, own.replace(y=own.y[::-1])),
        (plant, own.replace(y=moved)),
        (whole, own.replace(u=own.u[1:])),
    ):
        found = one.discretized(RATE, delay=1).with_ports(other)
        expected = assemble_plant(some_modes(), other).discretized(RATE, delay=1)
        assert np.array_equal(found.system.C, expected.system.C)
        assert np.allclose(found.process_noise, expected.process_noise, rtol=1e-9, atol=0)


@pytest.mark.parametrize("held", [False, True])
def test_other_densities_are_those_of_ports(held):
    """The noise of each sample follows asd: a louder, a silent and a held disturbance, and none."""
    own = ports()
    own = own.replace(w=[own.w[0].replace(held=held), *own.w[1:]])
    plant = assemble_plant(some_modes(), own).discretized(RATE, delay=1.3)
    levels = (3e-3, 2e-4, 1e-3, 0.0)
    loud = [port.replace(asd=level) for port, level in zip(own.w, levels, strict=True)]
    wanted = plant.with_ports(own.replace(w=loud))
    names = [port.name for port in own.w]
    found = plant.replace(asd={**plant.asd, **dict(zip(names, levels, strict=True))})
    size = np.sqrt(np.diagonal(wanted.process_noise))
    np.testing.assert_allclose(found.process_noise, wanted.process_noise, rtol=0.0,
                               atol=1e-9 * np.max(np.outer(size, size)))  # fmt: skip
    # so does what is made of it: fewer ports, another place, other modes, the sampled plant itself
    some, there = own.replace(w=loud, y=own.y[:1]), (0.1, 0.1, 0.0)
    pairs = [
        (found.with_ports(own.replace(y=own.y[:1])), plant.with_ports(some)),
        (found.at({own.z[0].name: there}), wanted.at({own.z[0].name: there})),
        (found.uncertain(frequency=0.01).machines.drawn(1, rng=0)[0],
         wanted.uncertain(frequency=0.01).machines.drawn(1, rng=0)[0]),
        (found.continuous.replace(asd=found.asd).discretized(RATE, delay=1.3), wanted),
    ]  # fmt: skip
    for one, other in pairs:
        assert dict(one.asd) == {**other.asd, **{n: one.asd[n] for n in one.asd if not one.asd[n]}}
        np.testing.assert_allclose(one.process_noise, other.process_noise, rtol=0.0,
                                   atol=1e-9 * np.max(np.outer(size, size)))  # fmt: skip
    quieter = found.replace(asd={"y1:noise": 1e-9})
    assert not quieter.process_noise.any()
    assert quieter.noise_factor.shape[0] == plant.system.n_states
    assert plant.replace(asd=plant.asd).noise_factor is plant.noise_factor
