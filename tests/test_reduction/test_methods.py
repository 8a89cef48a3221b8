"""Ways to reduce from matrices: dense oracles, Rayleigh-Ritz bounds, exactness, relations."""

import re

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given, settings
from hypothesis import strategies as st

import oracles_reduction as oracle
import oracles_structure
from flexplant import DofSet
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.identification import MeasuredModes
from flexplant.lti import frequency_response
from flexplant.modes import solve_modes
from flexplant.plant import assemble_plant, gravity_axes
from flexplant.reduction import (
    CraigBampton,
    DesiredDofs,
    Guyan,
    Irs,
    Krylov,
    MacNeal,
    ModalBalanced,
    ModalTruncation,
    Rubin,
    Serep,
    reduce,
    select_dofs,
)
from flexplant.structure import Damper, FEModel, ModalDamping, Rayleigh
from flexplant.updating import AddedMass, Eigenvalues, identifiability, update
from plates import make_plate
from stages import ports

LOW = ModalDamping(0.01)
CORNERS = ["1:z", "5:z", "21:z", "25:z"]
PLACES = [*CORNERS, "13:z", "8:z", "17:z"]


@pytest.fixture(scope="module")
def plate():
    return make_plate(elements=(4, 4))


@pytest.fixture(scope="module")
def matrices():
    return oracles_structure.plate_matrices(4, 4)


def elastic(model):
    modes = model.modes()
    assert np.array_equal(modes.omega[: modes.n_rigid], np.zeros(modes.n_rigid))
    return modes.omega[modes.n_rigid :]


def chain(n=6, ends=(True, False)):
    """Masses 1 kg and springs 1 N/m in a row, its first end held."""
    K = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    for end, held in zip((0, n - 1), ends, strict=True):
        K[end, end] = 2.0 if held else 1.0
    xyz = np.zeros((n, 3))
    xyz[:, 0] = np.arange(n)
    return FEModel(np.eye(n), K, dofs=DofSet(np.arange(1, n + 1), ["x"] * n, xyz))


def test_guyan_by_hand():
    """Two masses between a wall and each other: K* = 1/2, M* = 1 + 1/4."""
    model = reduce(chain(2), Guyan(["2:x"]))
    np.testing.assert_allclose(model.T[:, 0], [0.5, 1.0], atol=1e-15)
    np.testing.assert_allclose([model.M[0, 0], model.K[0, 0]], [1.25, 0.5], atol=1e-15)


def test_frequencies_in_closed_form():
    """A held chain: 2 sin((2 i - 1) pi / (2 (2 n + 1))), kept by all its modes."""
    n = 6
    wanted = 2 * np.sin((2 * np.arange(1, n + 1) - 1) * np.pi / (2 * (2 * n + 1)))
    kept = ["2:x", "4:x", "6:x"]
    np.testing.assert_allclose(elastic(reduce(chain(n), Serep(kept))), wanted[:3], rtol=1e-12)
    np.testing.assert_allclose(elastic(reduce(chain(n), CraigBampton(kept, 3))), wanted, rtol=1e-12)
    rubin = reduce(chain(n), Rubin(["6:x"], 3))
    np.testing.assert_allclose(elastic(rubin)[:3], wanted[:3], rtol=1e-12)


def test_expansions_are_those_of_the_equations(plate, matrices):
    M, K = matrices
    kept = plate.dofs.indices(PLACES)
    for method, wanted in (
        (Guyan(PLACES), oracle.guyan(K, kept)),
        (Irs(PLACES), oracle.irs(M, K, kept, 1)),
        (Irs(PLACES, iterations=4), oracle.irs(M, K, kept, 4)),
    ):
        model = reduce(plate, method)
        np.testing.assert_allclose(model.T, wanted, atol=1e-6 * np.abs(wanted).max())
        np.testing.assert_allclose(model.M, wanted.T @ M @ wanted, rtol=1e-5, atol=1e-6)
    bampton = reduce(plate, CraigBampton(PLACES, 5))
    assert oracle.same_span(bampton.T, oracle.craig_bampton(M, K, kept, 5)) < 1e-6
    np.testing.assert_allclose(bampton.T[kept], np.eye(7, 12), atol=1e-12)
    rubin = reduce(plate, Rubin(PLACES, 9))
    basis, _ = oracle.free_interface(M, K, kept, 9, 3)
    assert oracle.same_span(rubin.T, basis) < 1e-6
    np.testing.assert_allclose(rubin.T[kept], np.eye(7, 16), atol=1e-12)
    np.testing.assert_allclose(rubin.M, rubin.T.T @ M @ rubin.T, atol=1e-9)
    np.testing.assert_allclose(rubin.K, rubin.T.T @ K @ rubin.T, atol=1e-9 * np.abs(rubin.K).max())


def ritz_methods(extra):
    return [
        Guyan([*PLACES, *["3:z", "11:z"][:extra]]),
        CraigBampton(CORNERS, 4 + extra),
        Rubin(CORNERS, 7 + extra),
        Krylov(CORNERS, [0.0, 300.0, 700.0][: extra + 1]),
        ModalTruncation(8 + extra),
    ]


@pytest.mark.parametrize("which", range(5))
def test_frequencies_bound_the_true_ones_from_above(plate, matrices, which):
    """Rayleigh-Ritz, and falling when the basis grows."""
    true = oracle.frequencies(*matrices)[3:]
    less, more = (elastic(reduce(plate, ritz_methods(extra)[which])) for extra in (0, 2))
    for found in (less, more):
        assert np.all(found > true[: found.size] * (1 - 1e-9))
    assert np.all(more[: less.size] < less * (1 + 1e-9))
    if which < 4:
        assert np.any(less > true[: less.size] * (1 + 1e-4))  # the test can fail


def test_n_modes_at_n_dofs_reproduce_the_poles(plate, matrices):
    true = oracle.frequencies(*matrices)[3:12]
    chosen = select_dofs(solve_modes(plate, count=12), 12)
    for model in (
        reduce(plate, Serep(chosen, damping=LOW)),
        reduce(solve_modes(plate, count=12, damping=LOW), DesiredDofs(chosen)),
    ):
        wanted = true * (-0.01 + 1j * np.sqrt(1 - 1e-4))
        assert np.abs(model.modes().poles[3:] / wanted - 1).max() < 1e-8


def test_serep_of_chosen_modes_keeps_any_damping(plate):
    modes = [1, 2, 3, 4, 6, 9]
    damped = plate.replace(D=3e-6 * plate.K)
    chosen = ["1:z", "5:z", "21:z", "25:z", "13:z", "11:z"]
    full = solve_modes(damped, count=9)
    found = reduce(damped, Serep(chosen, modes)).modes()
    np.testing.assert_allclose(found.poles[3:], full.poles[[3, 5, 8]], rtol=1e-8)


def test_irs_converges_to_serep(plate, matrices):
    kept = list(select_dofs(solve_modes(plate, count=6), 6))
    true = oracle.frequencies(*matrices)[3:6]
    errors = [
        np.abs(elastic(reduce(plate, Irs(kept, iterations=i))) / true - 1).max() for i in (1, 3, 9)
    ]
    assert errors[0] > 2 * errors[1] > 4 * errors[2]
    model = reduce(plate, Irs(kept, iterations=400))
    np.testing.assert_allclose(elastic(model), true, rtol=1e-8)
    serep = reduce(plate, Serep(kept))
    np.testing.assert_allclose(model.T, serep.T, atol=1e-4 * np.abs(serep.T).max())
    assert "400" not in model.method  # it stopped where nothing changed


def all_methods():
    modes = solve_modes(make_plate(elements=(4, 4)), count=7, damping=LOW)
    return [
        DesiredDofs(select_dofs(modes, 7)),
        ModalTruncation(8, damping=LOW),
        ModalTruncation(8, static_at=CORNERS, damping=LOW),
        ModalBalanced(8, CORNERS, damping=LOW),
        Guyan(PLACES, damping=LOW),
        Irs(PLACES, iterations=2, damping=LOW),
        Serep(select_dofs(modes, 7), damping=LOW),
        CraigBampton(CORNERS, 6, damping=LOW),
        Rubin(CORNERS, 8, damping=LOW),
        MacNeal(CORNERS, 8, damping=LOW),
        Krylov(CORNERS, [0.0, 400.0], damping=LOW),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("which", range(11))
def test_every_model_goes_on(plate, which):
    """Rigid-body motions exact, plant, decoupling, rows, an update, identifiability."""
    method = all_methods()[which]
    given_modes = isinstance(method, DesiredDofs)
    model = reduce(solve_modes(plate, count=7, damping=LOW) if given_modes else plate, method)
    R = model.rigid_body
    np.testing.assert_allclose(model.T @ R, plate.rigid_body, atol=1e-9)
    scale = np.abs(np.abs(model.K) @ np.abs(R)).max() + np.abs(model.K).max() * 1e-16
    assert np.abs(model.K @ R).max() < 1e-8 * scale + 1e-9 * np.abs(model.K).max()
    modes = model.modes()
    assert np.array_equal(modes.poles[:3], np.zeros(3))
    assert len(model.coordinates) == model.n_dof
    np.testing.assert_allclose(modes.zeta[3:8], 0.01, rtol=1e-6)
    plant = assemble_plant(model, ports())
    assert plant.n_rigid == 3
    assert {"z", "rx", "ry"} == set(gravity_axes(plant).axes)
    freq = np.array([20.0, 130.0])
    true = assemble_plant(plate.with_damping(LOW), ports())
    found, wanted = (frequency_response(p.system, freq).data for p in (plant, true))
    assert np.abs(found - wanted).max() < 0.05 * np.abs(wanted).max()
    measured = MeasuredModes(poles=1.01 * modes.poles[3:5], modes=[4, 5])
    if isinstance(method, MacNeal):
        return  # a free model without boundary mass: no update
    unknown = [AddedMass("1:z")]
    fit = update(model, unknown, [Eigenvalues(measured)])
    assert len(fit.modes().dofs) == plate.n_dof
    assert np.abs(fit.modes().poles[3] / modes.poles[3] - 1) > 1e-4
    assert identifiability(model, unknown, [Eigenvalues(measured)]).rank == 1


def test_macneal_leaves_out_the_residual_mass(plate, matrices):
    """Its response is the modes' plus the static rest at once: by modal sums of the oracle."""
    M, K = matrices
    model = reduce(plate, MacNeal(CORNERS, 8, damping=LOW))
    assert list(model.massless) == [0, 1, 2, 3]
    w, phi = la.eigh(K, M)
    w, phi = np.sqrt(w[3:]), phi[:, 3:]
    rows = plate.dofs.indices(CORNERS)
    freq = np.array([50.0, 400.0, 900.0])
    s = 2j * np.pi * freq
    p = phi[rows]
    wanted = np.empty((3, 4, 4), dtype=complex)
    rigid = plate.rigid_body[rows]
    for i, one in enumerate(s):
        low = (p[:, :5] / (one**2 + 0.02 * one * w[:5] + w[:5] ** 2)) @ p[:, :5].T
        wanted[i] = low + (p[:, 5:] / w[5:] ** 2) @ p[:, 5:].T + rigid @ rigid.T / one**2
    matrix = model.K + s[:, None, None] * model.D + s[:, None, None] ** 2 * model.M
    B = model.T.T @ np.eye(plate.n_dof)[:, rows]
    np.testing.assert_allclose(
        B.T @ np.linalg.solve(matrix, B[None]), wanted, rtol=1e-6, atol=1e-13
    )
    # the plant answers so too, with a feedthrough
    plant = assemble_plant(model, ports())
    see = model.row("1:z")
    inner = plant.assembled.realisation
    direct = inner.at_once(see) @ see
    assert see @ model.condensed()[2] @ see == pytest.approx(direct, rel=1e-9, abs=0)
    assert direct == pytest.approx(np.sum(p[0, 5:] ** 2 / w[5:] ** 2), rel=1e-6, abs=0)


@pytest.mark.parametrize("damped", [False, True])
def test_moments_are_matched(plate, matrices, damped):
    """Taylor coefficients at each frequency against the full model's, by their recursion."""
    M, K = matrices
    D = 2e-6 * K if damped else np.zeros_like(K)
    model = plate.replace(D=2e-6 * plate.K) if damped else plate
    inputs, moments, freq = ["1:z", "8:z"], 2, [300.0, 900.0]
    rom = reduce(model, Krylov(inputs, freq, moments=moments))
    np.testing.assert_allclose(rom.M, np.eye(rom.n_dof), atol=1e-10)
    B = np.eye(plate.n_dof)[:, plate.dofs.indices(inputs)]
    Br, Cr = rom.T.T @ B, B.T @ rom.T
    # an output elsewhere: as many as moments
    E = np.eye(plate.n_dof)[plate.dofs.indices(["7:z", "3:rx"])]
    for f in freq:
        s = 2j * np.pi * f
        for C, Cm, exact in ((B.T, Cr, 2 * moments), (E, E @ rom.T, moments)):
            wanted = oracle.taylor(M, D, K, B, C, s, 2 * moments + 2)
            found = oracle.taylor(rom.M, rom.D, rom.K, Br, Cm, s, 2 * moments + 2)
            errors = [
                np.abs(a - b).max() / np.abs(b).max() for a, b in zip(found, wanted, strict=True)
            ]
            assert max(errors[:exact]) < 1e-6
            if not damped:
                assert errors[exact] > 1e-3  # and no more than these


def test_static_moment_of_a_free_structure(plate):
    """At 0 Hz: the elastic compliance under inertia relief, exactly."""
    rom = reduce(plate, Krylov(CORNERS, 0.0))
    found = rom.quality(plate, band=(50.0, 300.0), inputs=CORNERS)
    assert found.static_error.max() < 1e-9
    assert rom.n_dof == 7


@pytest.mark.slow
@settings(max_examples=10)
@given(st.integers(0, 10**6), st.floats(1e-2, 1e3))
def test_order_of_dofs_and_units_do_not_matter(seed, unit):
    rng = np.random.default_rng(seed)
    n = 8
    model = chain(n)
    order = rng.permutation(n)
    dofs = DofSet(model.dofs.nodes[order], ["x"] * n, model.dofs.xyz[order])
    moved = FEModel(
        unit * model.M[np.ix_(order, order)], unit**3 * model.K[np.ix_(order, order)], dofs=dofs
    )
    for method in (
        Guyan(["3:x", "8:x"]),
        Irs(["3:x", "8:x"], iterations=2),
        CraigBampton(["8:x"], 3),
        Rubin(["8:x"], 3),
        Serep(["3:x", "8:x"]),
    ):
        one, two = elastic(reduce(model, method)), elastic(reduce(moved, method))
        np.testing.assert_allclose(two, unit * one, rtol=1e-8)


def test_damping_of_the_model_is_projected(plate):
    damped = plate.replace(D=2e-6 * plate.K)
    for method in (Guyan(PLACES), CraigBampton(CORNERS, 5), Rubin(CORNERS, 8), Krylov("1:z", 99.0)):
        model = reduce(damped, method)
        np.testing.assert_allclose(model.D, 2e-6 * model.K, atol=1e-8 * np.abs(model.D).max())
        if isinstance(method, Krylov):
            continue  # its basis knows D
        by_law = reduce(plate, type(method)(**{**method._fields(), "damping": Rayleigh(0, 2e-6)}))
        np.testing.assert_allclose(
            by_law.modes().poles, reduce(damped, method).modes().poles, rtol=1e-6, atol=1e-5
        )


def test_refusals(plate):
    modes = solve_modes(plate, count=9)
    with pytest.raises(ModelError, match="Guyan works on the matrices M and K"):
        reduce(modes, Guyan(CORNERS))
    with pytest.raises(ModelError, match=r"leave . rigid-body motions? free"):
        reduce(plate, Guyan(["1:z", "5:z"]))
    with pytest.raises(ModelError, match=r"leave . rigid-body motions? free"):
        reduce(plate, CraigBampton(["1:z", "3:z", "5:z"], 2))
    with pytest.raises(ShapeError, match="nothing is condensed"):
        reduce(plate, Guyan(plate.dofs))
    with pytest.raises(LabelError, match="no DOF '1:q'"):
        reduce(plate, Irs(["1:q"]))
    with pytest.raises(LabelError, match="twice"):
        Rubin(["1:z", "1:z"], 5)
    with pytest.raises(LabelError, match="boundary DOFs is empty"):
        CraigBampton([], 5)
    with pytest.raises(ModelError, match="not both"):
        CraigBampton(CORNERS, 5, below=100.0)
    with pytest.raises(ModelError, match="fixed-interface modes of an interior"):
        reduce(plate, CraigBampton(CORNERS, 80))
    with pytest.raises(ModelError, match="whole number"):
        CraigBampton(CORNERS, "a")
    with pytest.raises(ModelError, match="whole number"):
        Irs(CORNERS, iterations=0)
    with pytest.raises(ModelError, match="left out"):
        reduce(plate, Serep(["1:z", "5:z", "21:z"], [1, 2, 4]))
    with pytest.raises(ShapeError, match="square"):
        Serep(["1:z", "5:z"], [1, 2, 3])
    with pytest.raises(ModelError, match="may appear only once"):
        Serep(["1:z", "5:z"], [1, 1])
    with pytest.raises(ModelError, match="ModalDamping or Rayleigh"):
        Guyan(CORNERS, damping=0.01)
    with pytest.raises(ModelError, match="from 0 up"):
        Krylov("1:z", -1.0)
    with pytest.raises(ModelError, match="at least one input"):
        Krylov([], 1.0)
    with pytest.raises(ModelError, match="twice"):
        Krylov("1:z", [1.0, 1.0])
    with pytest.raises(ModelError, match="resonance"):
        reduce(chain(3, (True, True)), Krylov("1:x", np.sqrt(2.0) / (2 * np.pi)))


@pytest.mark.parametrize("kept", [["1:z"], ["1:z", "5:z"], ["1:z", "3:z", "5:z"]])
@pytest.mark.parametrize("method", [Guyan, CraigBampton])
def test_the_degrees_of_freedom_to_add_are_named(plate, kept, method):
    """What the refusal proposes is enough, and is displacements."""
    with pytest.raises(ModelError, match=r"Keep for example '.*Rubin") as caught:
        reduce(plate, method(kept))
    more = re.findall(r"'(\d+:\w+)'", str(caught.value))
    assert more
    assert all(label.endswith(":z") for label in more)
    assert reduce(plate, method([*kept, *more])).rigid_body.shape[1] == 3


GRID = ["1:z", "5:z", "21:z", "25:z", "13:z", "3:z"]
EVERY = {
    "DesiredDofs": DesiredDofs(GRID[:5], static_at="1:z", damping=ModalDamping(0.01)),
    "ModalTruncation": ModalTruncation(6),
    "ModalBalanced": ModalBalanced(6, "1:z", damping=ModalDamping(0.01)),
    "Guyan": Guyan(GRID),
    "Irs": Irs(GRID),
    "Serep": Serep([*GRID[:4], "3:z"]),
    "CraigBampton": CraigBampton(GRID[:4], 6),
    "Rubin": Rubin(GRID[:4], 6),
    "MacNeal": MacNeal(GRID[:4], 6),
    "Krylov": Krylov(GRID[:4], 100.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", EVERY.values(), ids=EVERY)
def test_every_method_is_called_alike_and_judged(plate, method):
    """A model with a damper to ground, from the matrices; from Modes where these are enough."""
    damped = plate.with_damping(Rayleigh(0.0, 2e-6)).with_parts([Damper("1:z", 20.0)])
    model = reduce(damped, method)
    assert np.any(model.D)
    assert np.abs(model.K @ model.rigid_body).max() < 1e-9 * np.abs(model.K).max()
    found = model.quality(damped, band=(100.0, 400.0), inputs="1:z")
    assert np.all(np.isfinite(found.frf_error))
    assert found.full_error < 1e-4
    assert found.static_error.max() < 0.5
    if isinstance(method, DesiredDofs):
        modes = solve_modes(plate, count=4, damping=ModalDamping(0.01), compliance_at="1:z")
        same = reduce(modes, DesiredDofs(GRID[:5]))
        np.testing.assert_allclose(same.K, model.K, rtol=0, atol=1e-9 * np.abs(model.K).max())
        np.testing.assert_allclose(same.D, model.D, rtol=0, atol=1e-9 * np.abs(model.D).max())
