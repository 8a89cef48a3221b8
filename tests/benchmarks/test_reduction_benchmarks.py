"""Reductions: process time and agreement beside scipy and pyMOR.

Run with ``-n 0 -m benchmark -s`` and ``OMP_NUM_THREADS=1``. Each line: ours, the peer, their ratio
(above one: ours is faster) and the largest relative difference of the answers.
"""

import time

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spla

import oracles_reduction as oracle
from flexplant.modes import solve_modes
from flexplant.reduction import (
    CraigBampton,
    EffectiveIndependence,
    Greedy,
    Guyan,
    Irs,
    Krylov,
    PivotedQr,
    Serep,
    rank_modes,
    reduce,
    select_dofs,
)
from flexplant.structure import ModalDamping
from plates import make_plate

pytestmark = pytest.mark.benchmark


def spent(run, repeats=1):
    """Return the shortest process time [s] and the last answer."""
    best, answer = np.inf, None
    for _ in range(repeats):
        start = time.process_time()
        answer = run()
        best = min(best, time.process_time() - start)
    return best, answer


def line(what, ours, peer_name, peer, difference):
    print(
        f"{what:<44s} {1e3 * ours:10.1f} ms   {peer_name:<28s} {1e3 * peer:10.1f} ms"
        f"   ratio {peer / ours:7.1f}   differ {difference:.1e}"
    )


@pytest.fixture(scope="module")
def large():
    """30 000 DOFs, and 25 z-DOFs of it."""
    plate = make_plate(elements=(99, 99))
    steps = np.linspace(0.0, 0.6, 5)
    return plate, [plate.dofs.nearest((x, y, 0.0)) for y in steps for x in steps]


def scipy_guyan(plate, rows):
    """Static condensation with SuperLU, as one writes it."""
    others = np.setdiff1d(np.arange(plate.n_dof), rows)
    K = sp.csc_array(plate.K)
    coupling = K[others][:, rows].toarray()
    T = np.zeros((plate.n_dof, rows.size))
    T[rows] = np.eye(rows.size)
    T[others] = -spla.splu(sp.csc_matrix(K[others][:, others])).solve(coupling)
    return T


def test_guyan_30000(large):
    plate, kept = large
    rows = plate.dofs.indices(kept)
    ours, model = spent(lambda: reduce(plate, Guyan(kept)), 2)
    peer, T = spent(lambda: scipy_guyan(plate, rows))
    line("Guyan, 30 000 DOFs to 25", ours, "scipy splu", peer, np.abs(model.T - T).max())
    assert ours < 5.0
    assert np.abs(model.T - T).max() < 1e-6


def test_craig_bampton_30000(large):
    plate, kept = large
    boundary, rows = kept[::4], plate.dofs.indices(kept[::4])
    others = np.setdiff1d(np.arange(plate.n_dof), rows)
    K, M = sp.csc_array(plate.K)[others][:, others], sp.csc_array(plate.M)[others][:, others]
    ours, model = spent(lambda: reduce(plate, CraigBampton(boundary, 20)))

    def peer():
        static = scipy_guyan(plate, rows)
        phi = spla.eigsh(K, 20, M, sigma=0.0)[1]
        inner = np.zeros((plate.n_dof, 20))
        inner[others] = phi
        T = np.hstack([static, inner])
        return la.eigh(T.T @ (plate.K @ T), T.T @ (plate.M @ T), eigvals_only=True)

    other, squares = spent(peer)
    freq = np.sqrt(squares[3:]) / (2 * np.pi)
    error = np.abs(model.modes().freq[3:] / freq - 1).max()
    line("Craig-Bampton, 7 + 20 coordinates", ours, "scipy splu, eigsh", other, error)
    assert error < 1e-5


def test_irs_and_serep(large):
    plate, _ = large
    modes = solve_modes(plate, count=12)
    kept = list(select_dofs(modes, 12))
    slow, serep = spent(lambda: reduce(plate, Serep(kept)))
    fast, irs = spent(lambda: reduce(plate, Irs(kept, iterations=60)))
    error = np.abs(irs.modes().freq[3:] / serep.modes().freq[3:] - 1).max()
    line("IRS iterated, 12 DOFs", fast, "ours, SEREP (modes)", slow, error)
    assert error < 1e-4


def test_krylov_beside_pymor():
    """Interpolation of both channels at two frequencies by pyMOR's second-order interpolation."""
    logger = pytest.importorskip("pymor.core.logger")
    iosys = pytest.importorskip("pymor.models.iosys")
    interpolation = pytest.importorskip("pymor.reductors.interpolation")
    logger.set_log_levels({"pymor": "ERROR"})
    plate = make_plate(elements=(16, 16))
    damped = plate.replace(D=2e-6 * plate.K)
    rows = plate.dofs.indices(["1:z", "145:z"])
    B = np.eye(plate.n_dof)[:, rows]
    freq = np.array([300.0, 900.0])
    ours, rom = spent(lambda: reduce(damped, Krylov(["1:z", "145:z"], freq)), 2)
    full = iosys.SecondOrderModel.from_matrices(
        *(sp.csc_matrix(part) for part in (damped.M, damped.D, damped.K)), B, B.T
    )
    sigma = np.concatenate([2j * np.pi * freq, -2j * np.pi * freq])

    def peer():
        reductor = interpolation.SOBHIReductor(full)
        b = np.ones((4, 2))
        return reductor.reduce(sigma, b, b)

    other, theirs = spent(peer)
    worst = [0.0, 0.0]
    for f in freq:
        s = 2j * np.pi * f
        parts = damped.M.toarray(), damped.D.toarray(), damped.K.toarray()
        wanted = oracle.response(*parts, B, B.T, s)
        mine = oracle.response(rom.M, rom.D, rom.K, rom.T.T @ B, B.T @ rom.T, s)
        size = np.abs(wanted).max()
        worst[0] = max(worst[0], np.abs(mine - wanted).max() / size)
        # theirs is tangential: along (1, 1) only
        along = theirs.transfer_function.eval_tf(s).sum() - wanted.sum()
        worst[1] = max(worst[1], abs(along) / np.abs(wanted.sum()))
    line(
        f"Krylov, {plate.n_dof} DOFs to {rom.n_dof}",
        ours,
        f"pyMOR SOBHI to {theirs.order}",
        other,
        worst[1],
    )
    print(f"{'':44s} interpolation error ours {worst[0]:.1e}, pyMOR {worst[1]:.1e}")
    assert worst[0] < 1e-8


def test_modal_hankel_beside_pymor():
    """Exact Hankel values of 60 modes: ours, and pyMOR's from its Lyapunov solver."""
    logger = pytest.importorskip("pymor.core.logger")
    iosys = pytest.importorskip("pymor.models.iosys")
    logger.set_log_levels({"pymor": "ERROR"})
    modes = solve_modes(make_plate(), count=63, damping=ModalDamping(0.005))
    ours, ranking = spent(lambda: rank_modes(modes, inputs=["21:z", "25:z"], outputs="1:z"), 3)
    omega, zeta, m = modes.omega[3:], modes.zeta[3:], 60
    phi = np.real(modes.phi)[modes.dofs.indices(["21:z", "25:z", "1:z"])][:, 3:]
    A = np.block(
        [[np.zeros((m, m)), np.diag(omega)], [-np.diag(omega), -np.diag(2 * zeta * omega)]]
    )
    B = np.vstack([np.zeros((m, 2)), phi[:2].T])
    C = np.hstack([phi[2:] / omega, np.zeros((1, m))])

    def peer():
        return iosys.LTIModel.from_matrices(A, B, C).hsv()

    other, values = spent(peer)
    error = np.abs(ranking.exact[:20] / values[:20] - 1).max()
    line("Hankel values, 60 modes", ours, "pyMOR hsv", other, error)
    assert error < 1e-5


@pytest.mark.parametrize("criterion", [PivotedQr(), EffectiveIndependence(), Greedy()])
def test_selection(criterion):
    """30 of 10 000 candidates for 30 modes; effective independence beside its definition."""
    rows = la.qr(np.random.default_rng(0).standard_normal((10_000, 30)), mode="economic")[0]
    none = np.zeros((0, 30))
    ours, found = spent(lambda: criterion.chosen(none, rows, 30))
    condition = np.linalg.cond(rows[found])
    print(f"{criterion!r:<44s} {1e3 * ours:10.1f} ms   condition {condition:.2f}")
    assert ours < 4.0
    if isinstance(criterion, EffectiveIndependence):
        few = rows[:600] + 0.0
        mine, one = spent(lambda: criterion.chosen(none, few, 30))
        other, two = spent(lambda: oracle.effective_independence(few, 30))
        line(
            "effective independence, 600 candidates",
            mine,
            "definition, numpy",
            other,
            float(one != two),
        )
        assert one == two
