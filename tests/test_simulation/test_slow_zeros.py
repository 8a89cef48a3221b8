"""Feedforward of machines whose frame resonates within the band: the inverse of its zeros."""

import warnings

import numpy as np
import pytest

import flexplant as fx
from driven_kinds import KINDS, between, hertz
from flexplant.errors import FlexplantWarning, ModelError
from judge import inverse_error


def on_a_frame(seed, rate, softer=0.0, damped=1.0):
    """A mass driven against a frame on isolators, and the numbers of the closed form.

    The isolator's frequency is lower by a fraction, and its damping is multiplied.
    """
    rng = np.random.default_rng(seed)
    m, M = rng.uniform(1, 5), rng.uniform(20, 80)
    k = M * hertz(rng.uniform(1, 6) * (1.0 - softer))
    zeta = damped * rng.uniform(0.005, 0.05)
    model = fx.FEModel(
        np.diag([m, M]), np.diag([0.0, k]), dofs=fx.DofSet([1, 2], ["x", "x"]),
        joint_motions=[[1.0], [0.0]],
    )  # fmt: skip
    modes = fx.solve_modes(model, count=2, damping=fx.ModalDamping(zeta))
    at = between("1:x", "2:x")
    ports = fx.Ports(
        w=[fx.Disturbance("floor", at="2:x", asd=0.1)],
        u=[fx.Actuator("motor", at=at, asd=0.01)],
        z=[fx.Poi("stage", at=at, axes=("x",))],
        y=[fx.Sensor("scale", at=at, asd=1e-9)],
        references=[fx.Reference("stage")],
    )
    plant = fx.assemble_plant(modes, ports)
    return plant.discretized(rate, delay=1.3), (m, M, k, zeta)


@pytest.mark.parametrize("seed", range(5))
def test_the_inverse_of_a_mass_on_a_frame(seed):
    """``1 / P = m s^2 (M s^2 + d s + k) / ((m + M) s^2 + d s + k)``, but for the fast sampling."""
    plant, (m, M, k, zeta) = on_a_frame(seed, rate=20e3)
    d = 2 * zeta * np.sqrt(k * M)
    pole = max(np.roots([m + M, d, k]), key=np.imag)
    found = fx.design_feedforward(plant)
    np.testing.assert_allclose(found.zeros.poles, [pole], rtol=1e-4)
    residue = m * pole**2 * (M * pole**2 + d * pole + k) / ((m + M) * (pole - pole.conj()))
    late = np.exp(1.8 * pole * plant.dt)  # the inverse acts before hold and delay
    np.testing.assert_allclose(found.zeros.residues, [[residue * late]], rtol=1e-4)
    assert inverse_error(plant, found, np.geomspace(0.01, 100.0, 60)) < 1e-3
    assert found.gains[0, 0, 2] == pytest.approx(m, rel=1e-6)  # as at rest: the frame stands


@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize("dt", [0.0, 1e-3])
def test_the_filters_are_the_rest_of_an_expansion(order, dt):
    """``c / (s - p)`` with its conjugate less its terms at rest; sampled: at the pole alone."""
    p, c = -2.0 + 30.0j, np.array([[3.0 - 1.0j], [0.5j]])
    zeros = fx.plant.SlowZeros([p], c, dt)
    A, B, C, D = zeros.filters(order)
    s = np.array([0.3j, 20.0j, 29.0j, 31.0j, 50.0j]) if not dt else p + 1e-5 * np.array([1, 1j])
    at = np.exp(s * dt) if dt else s
    found = np.array([(C @ np.linalg.solve(z * np.eye(2) - A, B) + D)[:, 0] for z in at])
    rest = sum((s / q)[:, None] ** (order + 1) * (r[:, 0] / (s - q)[:, None])
               for q, r in ((p, c), (p.conjugate(), c.conj())))  # fmt: skip
    wanted = rest / s[:, None] ** order
    np.testing.assert_allclose(found, wanted, rtol=1e-9 if not dt else 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["gantry", "dual stroke", "screw", "hexapod", "joint"])
@pytest.mark.parametrize("seed", [6001, 6002])
def test_moves_within_the_resonances_of_the_frame(kind, seed):
    """|P F - 1| up to a quarter of a usual bandwidth, by the matrices."""
    plant = KINDS[kind](np.random.default_rng([seed, list(KINDS).index(kind)]))
    freq = np.geomspace(1e-4, 2.5e-3, 60) / plant.dt
    for name in [one for one in plant.w if one.endswith(":ref")]:
        assert inverse_error(plant, fx.design_feedforward(plant, reference=name), freq) < 0.01


def test_a_loop_has_the_filters_too():
    """The frame rings after a move, and the POI stands: peak errors of loops with both."""
    plant, _ = on_a_frame(3, rate=2e3)
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    found = fx.design_feedforward(loop)
    assert "and the inverse of zeros at" in repr(found)
    move = fx.setpoint(0.01, velocity=0.1, acceleration=2.0, jerk=100.0, snap=1e4, rate=2e3)
    static = found.replace(zeros=None)

    def peak(*blocks):
        fed = fx.close_loop(plant, observer, servo, *blocks)
        run = fx.simulate(fed, reference={"stage:ref": move}, duration=1.0, noise=False)
        return run.peak("stage:error")

    assert peak(found) < 0.02 * peak(static) < 0.02 * peak()


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "part"), [(0, 0.3), (1, 3.0), (2, 0.3), (3, 3.0)])
def test_filters_leave_less_on_machines_that_differ(seed, part):
    """The bandwidth is below or above the zero; the machine's isolators are not the model's."""
    plant, (_, M, k, _) = on_a_frame(seed, rate=2e3)
    zero = np.sqrt(k / M) / (2.0 * np.pi)
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=part * zero, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)  # gains alone leave much, as is known
        both = [fx.design_feedforward(loop, slow_zeros=on) for on in (True, False)]
    move = fx.setpoint(0.01, velocity=0.1, acceleration=2.0, jerk=100.0, snap=1e4, rate=2e3)
    for softer, damped in [(0.0, 1.0), (0.005, 1.0), (0.01, 2.0), (-0.01, 0.5), (0.03, 1.0)]:
        machine, _ = on_a_frame(seed, 2e3, softer, damped)
        filters, gains = (
            fx.simulate(
                fx.close_loop(machine, observer, servo, forward),
                reference={"stage:ref": move}, duration=1.5, noise=False,
            ).peak("stage:error")
            for forward in both
        )  # fmt: skip
        assert filters < gains, (softer, damped)
        if not softer:  # an exact model
            assert filters < 0.1 * gains


@pytest.mark.slow
def test_a_loop_far_slower_than_the_zeros_fits_their_residues():
    """The pedestal's zero is at four times the bandwidth of a joint: the fit reaches beyond it."""
    plant = KINDS["joint"](np.random.default_rng(41))
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=4.9, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    move = fx.setpoint(
        1e-3, velocity=2.5e-3, acceleration=0.024, jerk=0.59, snap=23.0, rate=1.0 / plant.dt
    )

    def peak(on):
        fed = fx.close_loop(plant, observer, servo, fx.design_feedforward(loop, slow_zeros=on))
        run = fx.simulate(fed, reference={"tool:ref": move}, duration=0.9, noise=False)
        return run.peak("tool:error")

    # a fit that ended at the bandwidth left 1.6 times as much with filters as without
    assert peak(True) < 0.7 * peak(False)


def test_forces_of_samples():
    """Forces by the difference equation of the filters, one sample after another."""
    plant, _ = on_a_frame(1, rate=1e3)
    found = fx.design_feedforward(plant)
    move = fx.setpoint(0.01, velocity=0.1, acceleration=2.0, jerk=100.0, snap=1e4, rate=1e3)
    time = np.arange(300) * plant.dt
    block, x, wanted = found.system, np.zeros(found.system.n_states), []
    signals = move.at(time)
    v = np.array([getattr(signals, name.split(":")[-1]) for name in block.inputs])
    for now in v.T:
        wanted.append(block.C @ x + block.D @ now)
        x = block.A @ x + block.B @ now
    forces = found.forces(move, time)["motor:feedforward"]
    np.testing.assert_allclose(forces, np.ravel(wanted), atol=1e-9 * np.abs(wanted).max())
    with pytest.raises(ModelError, match="past"):
        found.forces(move, time[::2])


def test_an_unstable_inverse_is_named():
    """The POI beyond the centre of percussion moves back first: a real unstable pole."""
    m, J, lever = 2.0, 0.5, 1.0
    k = J * hertz(30.0)
    model = fx.FEModel(
        np.diag([m, J]), np.diag([0.0, k]), dofs=fx.DofSet([1, 1], ["z", "rx"]),
        joint_motions=[[1.0], [0.0]],
    )  # fmt: skip
    modes = fx.solve_modes(model, count=2, damping=fx.ModalDamping(0.01))
    ports = fx.Ports(
        u=[fx.Actuator("motor", at={"1:z": 1.0, "1:rx": -lever})],
        z=[fx.Poi("tip", at={"1:z": 1.0, "1:rx": lever}, axes=("z",))],
        y=[fx.Sensor("scale", at="1:z", asd=1e-9)],
        references=[fx.Reference("tip")],
    )
    plant = fx.assemble_plant(modes, ports).discretized(6e3)
    poles = np.roots([J - m * lever**2, 2 * 0.01 * np.sqrt(k * J), k])
    zero = poles.max() / (2 * np.pi)
    with pytest.warns(FlexplantWarning, match=f"unstable poles at {zero:.3g}"):
        fx.design_feedforward(plant)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert fx.design_feedforward(on_a_frame(2, rate=2e3)[0]).zeros is not None
