"""Springs of negative stiffness, as magnets make: unstable rigid-body pairs, from K to the loop."""

import re

import numpy as np
import pytest
import scipy.linalg as la

from flexplant import DofSet
from flexplant.errors import ModelError, SolverError
from flexplant.estimation import design_kalman
from flexplant.identification import MeasuredModes
from flexplant.loop import close_loop
from flexplant.lti import frequency_response
from flexplant.modes import solve_modes
from flexplant.plant import (
    Actuator,
    Disturbance,
    GroundSpring,
    Poi,
    Ports,
    Sensor,
    assemble_plant,
    gravity_axes,
    reference_errors,
    stage_weights,
    suspend,
)
from flexplant.reduction import DesiredDofs, Guyan, rank_modes, reduce
from flexplant.simulation import setpoint, simulate
from flexplant.structure import FEModel, ModalDamping, Rayleigh, Spring, chain
from flexplant.synthesis import design_hinf, design_servo
from flexplant.updating import AddedMass, Eigenvalues, update
from oracles_plant import (
    delayed_run,
    first_order,
    machine,
    motion_row,
    noise_by_doubling,
    receptance,
    z_row,
)
from plates import make_plate
from stages import AXES, CORNERS, INSET, RATE, L, full, ports, reduced, some_modes

MAGNET = -260.0  # N/m at each corner of 26.5 kg
DIE = (L / 2 + 0.01, L / 2 + 0.02, 0.0)


def magnets(damping=0.0, stiffness=MAGNET):
    return [GroundSpring(p, stiffness, damping) for p in CORNERS]


def dense(damping, stiffness=MAGNET, zeta=0.01):
    M, D, K = machine(zeta)
    rows = np.array([z_row(x, y) for x, y, _ in CORNERS])
    return M, D + damping * rows.T @ rows, K + stiffness * rows.T @ rows


def see():
    found = [motion_row(*DIE[:2], axis) for axis in AXES]
    return np.array([*found, z_row(*CORNERS[0][:2])])


def push():
    return np.array([z_row(*INSET[0][:2]), z_row(*INSET[1][:2])])


def channels(plant):
    return plant.system.select(["die:z", "die:rx", "die:ry", "y1"], ["u1", "amp2"])


@pytest.mark.slow
@pytest.mark.parametrize("model", [full, reduced, some_modes])
@pytest.mark.parametrize("damping", [0.0, 20.0])
def test_poles_and_responses_are_those_of_the_dense_model(model, damping):
    held = suspend(model(), magnets(damping))
    plant = assemble_plant(held, ports(die=DIE))
    M, D, K = dense(damping)
    A, _, _ = first_order(M, D, K, see(), push())
    grows = np.sort([p.real for p in la.eigvals(A) if p.real > 1e-3])
    found = plant.system.poles()
    np.testing.assert_allclose(np.sort(found[found.real > 1e-3].real), grows, rtol=3e-6)
    freq = np.array([0.2, 1.0, 3.0, 40.0, 240.0])
    wanted = receptance(M, D, K, see(), push(), 2 * np.pi * freq)
    size = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    got = frequency_response(channels(plant), freq).data
    np.testing.assert_allclose(got / size, wanted / size, rtol=0, atol=1e-5)
    assert plant.form == "modal blocks"


def test_modes_have_negative_frequencies_and_the_poles_of_the_pair():
    modes = solve_modes(suspend(make_plate(), magnets()), count=8)
    M, _, K = dense(0.0)
    squares = la.eigh(K, M, eigvals_only=True, subset_by_index=(0, 2))
    np.testing.assert_allclose(modes.omega[:3], -np.sqrt(-squares), rtol=1e-6)
    assert modes.n_unstable == 3
    assert modes.n_rigid == 0
    np.testing.assert_allclose(modes.poles[:3], np.sqrt(-squares), rtol=1e-6)
    assert "3 unstable growing at up to 10.86 1/s" in repr(modes)
    assert "3 unstable" in repr(suspend(make_plate(), magnets()))
    # of the modes that were solved free, and of the reduced model, to the softness of the springs
    for other in (suspend(some_modes(0.0), magnets()), suspend(reduced(0.0), magnets()).modes()):
        np.testing.assert_allclose(other.omega[:3], modes.omega[:3], rtol=3e-6)
    again = reduce(
        modes, DesiredDofs(["1:z", "9:z", "73:z", "81:z", "41:z", "5:z", "37:z", "45:z"])
    )
    np.testing.assert_allclose(again.modes().omega, modes.omega, rtol=1e-8)


def three_masses(damping):
    """Masses on stiff springs, the first on a magnet; and M, D, K with the magnet, by hand."""
    free = chain(masses=[1.0, 2.0, 1.5], stiffnesses=[4e5, 3e5]).with_damping(ModalDamping(0.01))
    M, D, K = free.M.toarray(), np.array(free.D), free.K.toarray()
    D[0, 0] += damping
    K[0, 0] -= 300.0
    return suspend(free, GroundSpring("1:x", -300.0, damping)), (M, D, K)


@pytest.mark.parametrize("damping", [0.0, 5.0])
@pytest.mark.parametrize("delay", [0.0, 1.3])
def test_sampled_exactly_noise_included(damping, delay):
    model, dense_model = three_masses(damping)
    ports_here = Ports(
        w=[Disturbance("floor", at="2:x", asd=2e-3)],
        u=[Actuator("u1", at="1:x")],
        z=[Poi("die", at="3:x", axes=("x",))],
        y=[Sensor("y1", at="2:x", asd=1e-9)],
    )
    rate = 300.0
    plant = assemble_plant(model, ports_here).discretized(rate, delay=delay)
    A, B, C = first_order(*dense_model, np.eye(3)[[2, 1]], np.eye(3)[[0, 1]])
    u = np.random.default_rng(1).standard_normal((40, 1))
    wanted = delayed_run(A, B[:, :1], C, u, 1 / rate, delay)
    g = plant.system.select(["die:x", "y1"], ["u1"])
    x, found = np.zeros(g.n_states), []
    for sample in u:
        found.append(g.C @ x + g.D @ sample)
        x = g.A @ x + g.B @ sample
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())
    # what white noise has moved after 20 samples
    P = np.zeros((g.n_states, g.n_states))
    for _ in range(20):
        P = g.A @ P @ g.A.T + plant.process_noise
    S = B[:, 1:] @ B[:, 1:].T * 0.5 * 2e-3**2
    expected = C @ noise_by_doubling(A, S, 20 / rate, 16) @ C.T
    np.testing.assert_allclose(g.C @ P @ g.C.T, expected, rtol=1e-7, atol=0)


def test_check_and_repr_name_the_pairs():
    plant = assemble_plant(suspend(reduced(), magnets()), ports())
    assert "unstable rigid-body pairs: mode 1 (+10.86 and -10.86 1/s)" in repr(plant)
    report = plant.check()
    assert report.ok
    assert report["detectable"].finding.startswith("3 unstable rigid-body pairs")
    assert "negative stiffness makes rigid-body motion unstable: mode 1" in repr(report)
    assert all(mode.mode > 3 for mode in report.modes)
    one = assemble_plant(suspend(reduced(), magnets()), ports(y=ports().y[:1]))
    said = one.check()["detectable"]
    assert not said.holds
    assert "y does not see the unstable rigid-body mode 1 (+10.86 and -10.86 1/s), which grows" in (
        said.finding
    )


@pytest.mark.long
def test_the_loop_is_closed_on_observer_servo_and_h_infinity():
    plant = assemble_plant(suspend(reduced(0.001), magnets()), ports()).discretized(RATE, delay=1)
    free = assemble_plant(reduced(0.001), ports()).discretized(RATE, delay=1)
    observer = design_kalman(plant)
    with pytest.raises(SolverError, match="unstable"):  # slower than the magnets, at 1.7 Hz
        design_servo(plant, bandwidth=1.5, observer=observer)
    servo = design_servo(plant, bandwidth=50.0, observer=observer)
    loop = close_loop(plant, observer, servo)
    assert servo.certificate["spectral radius"] < 1
    assert loop.spectral_radius < 1
    on_free = design_servo(free, bandwidth=50.0, observer=design_kalman(free))
    margins = [one.certificate["modulus margin"] for one in (servo, on_free)]
    assert margins[0] == pytest.approx(margins[1], rel=0.1)
    run = simulate(
        loop,
        reference=setpoint(1e-5, velocity=5e-3, acceleration=0.5, jerk=100.0),
        duration=0.4,
        rng=1,
    )
    assert np.abs(run["die:z"][-200:] - 1e-5).max() < 5e-8  # noise of amplifiers and sensors
    block, weights = reference_errors(plant), stage_weights(plant, 50.0)
    hinf = design_hinf(plant.through(block).weighted(z=weights.z, w=weights.w))
    assert hinf.gamma < 1.1
    assert close_loop(plant, block, hinf).spectral_radius < 1
    # by the geometry: the same as without magnets
    np.testing.assert_allclose(
        gravity_axes(plant).T_u, gravity_axes(free).T_u, rtol=1e-6, atol=1e-9
    )


def test_raw_matrices_are_judged_by_the_motion_that_is_unstable():
    masses, springs = [1.0, 2.0, 1.5], [4e5, 3e5]
    soft = chain(masses=masses, stiffnesses=springs)
    K = soft.K.toarray()
    K[0, 0] -= 10.0
    model = FEModel(soft.M, K, dofs=soft.dofs)
    assert "1 unstable" in repr(model)
    lowest = la.eigh(K, soft.M.toarray(), eigvals_only=True)[0]
    np.testing.assert_allclose(solve_modes(model).omega[0], -np.sqrt(-lowest), rtol=1e-8)
    # an element, or a spring to ground, with the wrong sign bends the structure
    wrong = soft.K.toarray()
    wrong[:2, :2] -= 2 * springs[0] * np.array([[1, -1], [-1, 1]])
    with pytest.raises(ModelError, match="K is not positive semi-definite"):
        FEModel(soft.M, wrong, dofs=soft.dofs)
    wrong = soft.K.toarray()
    wrong[0, 0] -= springs[0]
    with pytest.raises(ModelError, match="K is not positive semi-definite"):
        FEModel(soft.M, wrong, dofs=soft.dofs)
    strong = soft.with_parts(Spring("1:x", -4e5))
    with pytest.raises(ModelError, match="too strong"):
        solve_modes(strong)


@pytest.mark.slow
def test_a_single_mass_on_a_magnet():
    model = FEModel([[2.0]], [[-10.0]], dofs=DofSet([1], ["x"], np.zeros((1, 3))))
    assert model.n_unstable == 1
    assert solve_modes(model, count=1).omega == pytest.approx([-np.sqrt(5.0)], rel=1e-12, abs=0)


@pytest.mark.slow
def test_a_large_sparse_model_on_magnets():
    plate = make_plate(elements=(24, 24))
    held = suspend(plate, magnets())
    modes = solve_modes(held, count=8)
    mass = plate.mass
    np.testing.assert_allclose(modes.omega[2], -np.sqrt(-4 * MAGNET / mass), rtol=2e-3)
    free = solve_modes(plate, count=8)
    np.testing.assert_allclose(modes.omega[3:], free.omega[3:], rtol=1e-4)
    assert modes.certificate["counted"] == modes.certificate["found"]


@pytest.mark.slow
def test_what_is_for_free_or_held_structures_says_so():
    held = suspend(make_plate().with_damping(ModalDamping(0.01)), magnets())
    modes = solve_modes(held, count=8)
    fit = [AddedMass("1:z")], [Eigenvalues(MeasuredModes(poles=[-3 + 1500j], modes=[4]))]
    for call in (
        lambda: reduce(held, Guyan(["1:z", "9:z", "73:z", "81:z"])),
        lambda: rank_modes(modes, inputs=["1:z"]),
        lambda: update(suspend(reduced(), magnets()), *fit),
    ):
        with pytest.raises(ModelError, match=re.escape("then suspend the result")):
            call()
    with pytest.raises(ModelError, match="Solve the free structure"):
        solve_modes(held, count=8, compliance_at=["1:z"])
    with pytest.raises(ModelError, match="feeds energy in"):
        suspend(make_plate(), magnets()).with_damping(Rayleigh(0.0, 1e-6))
    with pytest.raises(ModelError, match="is 0: it holds nothing"):
        GroundSpring("1:z", 0.0)
