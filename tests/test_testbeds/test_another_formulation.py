"""The virtual machine that no drawing resembles, and models calibrated with what is measured."""

from functools import cache

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx
from flexplant.errors import InfeasibleError, LabelError, ModelError, ShapeError
from flexplant.sparse.symmetric import dense
from flexplant.testbeds.virtual_machine import ritz_plate
from stages import RATE, ports

PLATE = {
    "size": (0.6, 0.4),
    "thickness": 0.0272,
    "density": 2702.0,
    "youngs_modulus": 70e9,
    "poisson_ratio": 0.3,
}
#: the paper's, of which the machines are made
DRAWN = PLATE | {"size": (0.6, 0.6), "poisson_ratio": 0.35}


@cache
def machine(individual=1):
    return fx.testbeds.wafer_stage(damping=0.001, individual=individual)


def swing(M, K, count):
    """Frequencies [Hz] of the elastic modes, densely."""
    return np.sqrt(la.eigh(K, M, eigvals_only=True)[3 : 3 + count]) / (2 * np.pi)


@pytest.mark.slow
def test_thin_it_is_kirchhoffs_plate():
    """Meshes of another formulation converge to it with the square of their size (Richardson)."""
    thin = PLATE | {"thickness": 1e-4}
    found = ritz_plate(**thin)
    exact = swing(found.M, found.K, 12)
    meshes = [
        fx.solve_modes(fx.kirchhoff_plate(elements=(3 * n, 2 * n), **thin), count=15).freq[3:]
        for n in (6, 12)
    ]
    limit = (4.0 * meshes[1] - meshes[0]) / 3.0
    np.testing.assert_allclose(exact, limit, rtol=5e-4)
    assert np.abs(meshes[1] / exact - 1.0).max() > 6e-4


@pytest.mark.slow
def test_rotary_inertia_is_that_of_its_slopes():
    """First order: (rho h^3 / 12) times the integral of the squared slopes over that of rho h w^2.

    The slopes are those of a meshed plate at its nodes.
    """
    thick, mesh = PLATE["thickness"], fx.kirchhoff_plate(elements=(36, 24), **PLATE)
    modes = fx.solve_modes(mesh, count=9)
    one = ritz_plate(**PLATE)
    with_it = swing(one.M, one.K, 6)
    none = ritz_plate(**(PLATE | {"thickness": thick / 1e3}))
    without = 1e3 * swing(none.M, none.K, 6)
    count = np.array([37, 25])
    weight = np.outer(*(np.r_[0.5, np.ones(n - 2), 0.5] for n in count[::-1])).reshape(-1)
    area = 0.6 * 0.4 / (36 * 24) * weight
    slopes = modes.phi.reshape(-1, 3, 9)[:, 1:, 3:]
    share = 2702.0 * thick**3 / 12.0 * np.einsum("n,nkm->m", area, slopes**2)
    np.testing.assert_allclose(1.0 - with_it / without, 0.5 * share, rtol=0.05)


def test_motions_between_nodes_are_those_of_one_polynomial():
    plate = ritz_plate(**PLATE)
    x, y = plate.dofs.xyz[:, 0], plate.dofs.xyz[:, 1]
    w = 1.0 + 2.0 * x - 3.0 * y + 5.0 * x**2 * y - y**3
    at = np.array([0.123, 0.321, 0.0])
    assert plate.dofs.row(at, "z") @ w == pytest.approx(
        1 + 2 * at[0] - 3 * at[1] + 5 * at[0] ** 2 * at[1] - at[1] ** 3
    )
    assert plate.dofs.row(at, "rx") @ w == pytest.approx(-3 + 5 * at[0] ** 2 - 3 * at[1] ** 2)
    assert plate.dofs.row(at, "ry") @ w == pytest.approx(-2 - 10 * at[0] * at[1])
    with pytest.raises(LabelError, match="off the plate"):
        plate.dofs.row((0.7, 0.1, 0.0), "z")
    with pytest.raises(LabelError, match=r"no motion .x. in a plate"):
        plate.dofs.row(at, "x")


@pytest.mark.slow
def test_no_mesh_of_the_drawing_has_its_frequencies():
    found = machine().poles(range(4, 20)).freq
    for n in (8, 16, 24):
        drawing = fx.kirchhoff_plate(elements=(n, n), **DRAWN)
        loaded = drawing.with_parts(fx.PointMass(drawing.dofs.nearest((0.3, 0.15, 0), "z"), 0.5))
        off = np.abs(fx.solve_modes(loaded, count=19).freq[3:] / found - 1.0)
        assert np.median(off) > 0.005


@pytest.mark.slow
def test_machines_differ_and_each_is_itself():
    first, again, other = machine(1), fx.testbeds.wafer_stage(damping=0.001), machine(2)
    np.testing.assert_allclose(first.poles([9]).poles, again.poles([9]).poles, rtol=1e-9)
    off = other.poles(range(4, 14)).freq / first.poles(range(4, 14)).freq - 1.0
    assert 1e-4 < np.abs(off).max() < 0.02
    zeta = machine().poles(range(4, 24)).zeta
    assert 0.15 < np.log(zeta / 0.001).std() < 0.45
    assert first.delay == 1.3


@pytest.mark.slow
def test_its_sensors_have_steps():
    static = fx.design_static(fx.assemble_plant(drawing(), ports()).discretized(RATE, delay=1.3))
    servo = fx.design_servo(
        fx.assemble_plant(drawing(), ports()).discretized(RATE, delay=1.3),
        bandwidth=8.0,
        observer=static,
    )
    run = machine().run(ports(), static, servo, duration=0.05, rng=1)
    counts = run["y1"] / 5e-11
    assert np.abs(counts - counts.round()).max() < 1e-6


@cache
def drawing():
    plate = fx.kirchhoff_plate(elements=(8, 8), **DRAWN)
    modes = fx.solve_modes(plate, count=24, damping=fx.ModalDamping(0.001))
    spots = [(x, y, 0.0) for y in np.linspace(0, 0.6, 5) for x in np.linspace(0, 0.6, 5)]
    del spots[12]
    return fx.reduce(modes, fx.DesiredDofs([modes.dofs.nearest(p, "z") for p in spots]))


def dense_poles(model):
    """Poles of M, D, K in the upper half plane, by frequency."""
    n = len(model.M)
    inverse = np.linalg.inv(model.M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ model.K, -inverse @ model.D]])
    poles = np.linalg.eigvals(A)
    poles = poles[poles.imag > 100.0]
    return poles[np.argsort(np.abs(poles))]


@pytest.mark.parametrize("damper", [0.0, 30.0])
def test_a_calibrated_model_has_the_measured_poles_and_its_own_shapes(damper):
    """With a damper that couples the modes too; what is not measured stays as it was."""
    model = drawing()
    row = np.eye(model.n_dof)[0] - np.eye(model.n_dof)[1]
    model = model.replace(D=model.D + damper * np.outer(row, row))
    measured = machine().poles([4, 6, 7, 9])
    found = model.calibrated(measured)
    poles = dense_poles(found)
    nearest = np.abs(poles[:, None] - measured.poles).min(axis=0)
    assert (nearest < 1e-8 * np.abs(measured.poles)).all()
    assert np.array_equal(found.M, model.M)
    before, after = (la.eigh(one.K, one.M)[0] for one in (model, found))
    np.testing.assert_allclose(after[[4, 7, 9, 10, 15]], before[[4, 7, 9, 10, 15]], rtol=1e-9)
    # rigid-body motions stay free of force
    assert np.abs(found.K @ model.rigid_body).max() < 1e-6 * np.abs(model.K).max()


def test_calibrated_modes_keep_their_shapes():
    modes = fx.solve_modes(ritz_plate(**PLATE), count=12, damping=fx.ModalDamping(0.01))
    measured = fx.MeasuredModes([-2 + 1000j, -3 + 1500j], modes=[4, 6])
    found = modes.calibrated(measured)
    assert found.poles[[3, 5]] == pytest.approx(measured.poles, rel=1e-12)
    assert np.array_equal(found.phi, modes.phi)
    assert np.array_equal(np.delete(found.omega, [3, 5]), np.delete(modes.omega, [3, 5]))


def test_what_cannot_be_calibrated_is_refused():
    poles = [-2 + 1000j]
    with pytest.raises(ModelError, match="without numbers"):
        drawing().calibrated(fx.MeasuredModes(poles))
    with pytest.raises(ModelError, match="got float"):
        drawing().calibrated(1.0)
    with pytest.raises(LabelError, match="elastic mode"):
        drawing().calibrated(fx.MeasuredModes(poles, modes=[2]))
    with pytest.raises(LabelError, match="elastic mode"):
        drawing().calibrated(fx.MeasuredModes(poles, modes=[40]))


def test_fits_are_calibrated_too():
    at = drawing().dofs.labels[0]
    fit = fx.update(drawing(), [fx.AddedMass(at)], [fx.Eigenvalues(machine().poles([4]))])
    measured = machine().poles([6, 7])
    found = fit.calibrated(measured)
    nearest = np.abs(dense_poles(found)[:, None] - measured.poles).min(axis=0)
    assert (nearest < 1e-8 * np.abs(measured.poles)).all()


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*modes that the plant truncates")
def test_what_is_promised_on_a_calibrated_model_is_kept_by_other_machines():
    """By its own poles; on this one (and another of eight) a shape at 244 Hz is not the model's.

    Tolerating errors of frequencies alone gave 0.34 on it for 0.47; modes near are damped now.
    """
    known = [4, 6, 7, 8, 9, 10, 11, 13]
    for individual in (3,):
        one = machine(individual)
        model = drawing()
        plate_mass = fx.AddedMass(model.dofs.labels[7])
        fit = fx.update(
            model,
            [plate_mass, fx.MatrixParameter("E", dK=model.K)],
            [fx.Eigenvalues(one.poles([4, 6, 7, 8]))],
        )
        own = fx.assemble_plant(fit.calibrated(one.poles(known)), ports())
        plant = own.discretized(RATE, delay=one.delay)
        off = {m: 0.001 if m in known else 0.015 for m in range(4, 25)}
        controller = fx.design_stage(plant.uncertain(frequency=off), bandwidth=50.0)
        promised = fx.close_loop(plant, controller).modulus_margin
        loop = one.loop(ports(), controller)
        assert loop.is_stable
        assert loop.modulus_margin > 0.9 * promised


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:the closed loop is unstable")
def test_the_search_judges_the_modes_left_out():
    """On a small thick plate with six elastic modes known these limit the bandwidth.

    A search that ignores them promises 100 Hz with a margin of 0.5: the machine is unstable.
    """
    size, material = (
        (0.5, 0.35),
        {k: v for k, v in DRAWN.items() if k != "size"} | {"thickness": 0.03},
    )
    one = fx.testbeds.wafer_stage(damping=0.001, individual=221, size=size, thickness=0.03)
    coarse = fx.kirchhoff_plate(size=size, elements=(8, 6), **material)
    at = coarse.dofs.nearest((0.25, 0.0875, 0.0), "z")
    low = fx.ModalDamping(0.001)
    modes = fx.solve_modes(coarse, count=9, damping=low, compliance_at=[at])
    rom = fx.reduce(modes, fx.DesiredDofs(fx.select_dofs(modes, 10, required=[at]).labels))
    poles = one.poles(range(4, 14), deviation=1e-5, rng=221)
    first = fx.MeasuredModes(poles.poles[:4], modes=poles.modes[:4])
    unknown = [fx.AddedMass(at), fx.MatrixParameter("E", dK=rom.K)]
    fit = fx.update(rom, unknown, [fx.Eigenvalues(first)])
    mass, stiffer = fit.values
    modulus = (1.0 + stiffer) * DRAWN["youngs_modulus"]
    fine = fx.kirchhoff_plate(
        size=size, elements=(32, 24), **material | {"youngs_modulus": modulus}
    )
    loaded = fine.with_parts(fx.PointMass(fine.dofs.nearest((0.25, 0.0875, 0.0), "z"), mass))
    whole = fx.solve_modes(loaded, count=120, damping=low).calibrated(poles)
    inset = [(x, y, 0.0) for y in (0.0875, 0.2625) for x in (0.125, 0.375)]
    own = fx.Ports(
        w=[fx.Disturbance(f"amp{i}", at=p, asd=1e-3) for i, p in enumerate(inset)],
        u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(inset)],
        z=[fx.Poi("die", at=(0.25, 0.175, 0.0), axes=("z", "rx", "ry"))],
        y=[
            fx.Sensor(f"y{i}", at=(x, y, 0.0), asd=1.4e-12)
            for i, (x, y) in enumerate([(0, 0), (0.5, 0), (0, 0.35), (0.5, 0.35)])
        ],
        references=[fx.Reference("die")],
    )
    known = fx.MeasuredModes(poles.poles[:6], modes=poles.modes[:6])
    plant = fx.assemble_plant(fit.calibrated(known), own).discretized(RATE, delay=one.delay)
    off = fit.uncertainty(known).frequency
    fast = fx.design_stage(plant.uncertain(frequency=off), bandwidth=100.0)
    assert fx.close_loop(plant, fast).modulus_margin > 0.45
    assert one.loop(own, fast).spectral_radius > 1.003
    judged = plant.replace(evaluation=whole)
    with pytest.raises(InfeasibleError, match="crossing 1 at 100 Hz: modulus margin"):
        fx.design_stage(judged.uncertain(frequency=off), bandwidth=100.0)
    controller = fx.design_stage(judged.uncertain(frequency=off), bandwidth=50.0)
    promised = fx.close_loop(judged, controller)
    assert min(promised.modulus_margin, promised.completed.modulus_margin) > 0.5
    loop = one.loop(own, controller)
    assert loop.is_stable
    assert loop.modulus_margin > 0.9 * promised.completed.modulus_margin
    reached = fx.compare_loops({"promised": promised, "machine": loop}).rows
    assert reached["promised"].bandwidth == pytest.approx(50.0, rel=0.03)
    assert reached["machine"].bandwidth == pytest.approx(50.0, rel=0.1)


@pytest.mark.long
def test_predicted_errors_are_those_of_unseen_machines():
    """Within 10 %: of 30 machines 97 % were (rms 4.6 %), the rest is damping nobody measured."""
    model, off = drawing(), []
    sides = ("die:z", "die:rx", "die:ry")
    for individual in (101,):
        one = machine(individual)
        measured = one.poles(range(4, 14), deviation=1e-5, rng=individual)
        fit = fx.update(
            model,
            [fx.AddedMass(model.dofs.labels[7]), fx.MatrixParameter("E", dK=model.K)],
            [fx.Eigenvalues(fx.MeasuredModes(measured.poles[:4], modes=measured.modes[:4]))],
        )
        mass, stiffer = fit.values
        modulus = (1.0 + stiffer) * DRAWN["youngs_modulus"]
        fine = fx.kirchhoff_plate(elements=(40, 40), **DRAWN | {"youngs_modulus": modulus})
        loaded = fine.with_parts(fx.PointMass(fine.dofs.nearest((0.3, 0.15, 0.0), "z"), mass))
        full = fx.solve_modes(loaded, count=160, damping=fx.ModalDamping(0.001))
        judge = full.calibrated(measured)
        plant = fx.assemble_plant(fit.calibrated(measured), ports(), evaluation=judge)
        design = fx.design_kalman(plant.discretized(RATE, delay=one.delay))
        truth = fx.assemble_plant(one.truth, ports()).discretized(RATE, delay=one.delay)
        off += [design.rms(side, on=truth) / design.rms(side) - 1.0 for side in sides]
    assert np.abs(off).max() < 0.1


@pytest.mark.slow
def test_frequencies_are_uncertain_by_what_was_not_explained():
    """Measured modes by their deviation, others by the misfit of those measured and by the mesh."""
    model = drawing()
    fit = fx.update(
        model, [fx.MatrixParameter("E", dK=model.K)], [fx.Eigenvalues(machine().poles([4, 6, 7]))]
    )
    poles = machine().poles([4, 6, 7, 9, 13])
    wide = poles.replace(covariance=np.diag((0.002 * np.abs(np.r_[poles.poles, poles.poles])) ** 2))
    found = fit.uncertainty(poles).frequency
    assert {found[m] for m in (4, 6, 7, 9, 13)} == {1e-3}
    assert 0.005 < found[5] < found[20] < 0.1
    assert fit.uncertainty(wide).frequency[6] == pytest.approx(0.004, rel=0.05)
    coarse, fine = (
        fx.solve_modes(fx.kirchhoff_plate(elements=(n, n), **DRAWN), count=24) for n in (8, 16)
    )
    mesh = coarse.mesh_error(fine)
    beside = fit.uncertainty(poles, mesh=mesh).frequency
    assert beside[20] == pytest.approx(max(found[20], 1.5 * abs(mesh.error[16])))
    assert beside[4] == 1e-3
    true = np.abs(machine().poles(range(4, 25)).freq / fit.model.modes().freq[3:24] - 1.0)
    inside = [true[m - 4] < share for m, share in beside.items() if share > 1e-3]
    assert np.mean(inside) > 0.9
    with pytest.raises(ModelError, match="mesh"):
        fit.uncertainty(poles, mesh=0.01)


@pytest.mark.slow
def test_a_second_size_is_its_own_machine():
    """A drawing of that size has its frequencies within 2 %, one of the paper's size none."""
    size, thickness = (0.5, 0.35), 0.03
    other = fx.testbeds.wafer_stage(size=size, thickness=thickness, damping=0.001)
    mesh = fx.kirchhoff_plate(elements=(16, 12), **(DRAWN | {"size": size, "thickness": thickness}))
    row, M = mesh.dofs.row((0.25, 0.0875, 0.0), "z"), mesh.M.toarray()
    drawn = swing(M + 0.5 * np.outer(row, row), mesh.K.toarray(), 6)
    found = other.poles(range(4, 10)).freq
    np.testing.assert_allclose(found, drawn, rtol=0.02)
    assert np.abs(found / drawn - 1.0).max() > 1e-3
    assert np.all(found > 1.2 * machine().poles(range(4, 10)).freq)
    with pytest.raises(ShapeError, match="size must "):
        fx.testbeds.wafer_stage(size=0.5)
    with pytest.raises(ModelError, match="thickness"):
        fx.testbeds.wafer_stage(thickness=0.0)


@pytest.mark.long
def test_a_second_size_is_measured_at_its_own_places():
    """The measured FRF is that of the hidden matrices; the paper's centre is off this plate."""
    other = fx.testbeds.wafer_stage(size=(0.5, 0.28), thickness=0.03)
    pushed = [(0.1, 0.07, 0.0), (0.4, 0.07, 0.0), (0.2, 0.24, 0.0)]
    seen = [(0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.28, 0.0)]
    own = fx.Ports(
        w=[],
        u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(pushed)],
        z=[],
        y=[fx.Sensor(f"y{i}", at=p) for i, p in enumerate(seen)],
    )
    frf = other.measure_frf(own, period=1.0, periods=2, amplitude=10.0, rng=1)
    M, D, K = (dense(part) for part in (other.truth.M, other.truth.D, other.truth.K))
    B, C = (
        np.array([other.truth.dofs.row(np.array(p), "z") for p in side]) for side in (pushed, seen)
    )
    for frequency in (50.0, 200.0, 300.0):
        k = int(np.argmin(np.abs(frf.freq - frequency)))
        s = 2j * np.pi * frf.freq[k]
        hold = (1.0 - np.exp(-s / other.rate)) / (s / other.rate)
        exact = hold * (C @ np.linalg.solve(s**2 * M + s * D + K, B.T))
        # what is left of the transient of a servo of 8 Hz: 1e-3; with periods of 0.2 s it is 0.1
        assert np.abs(frf.data[..., k] - exact).max() < 3e-3 * np.abs(exact).max()
