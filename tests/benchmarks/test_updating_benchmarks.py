"""The numbers of updating, beside a peer where there is one; run with ``-n 0 -m benchmark -s``."""

import time
import warnings

import numpy as np
import pytest
import scipy.optimize as so

import oracles_updating as oracle
from bridges import FILE, Bridge, ends, noisy_fits
from flexplant.errors import FlexplantWarning
from flexplant.identification import MeasuredModes
from flexplant.modes import solve_modes
from flexplant.modes.sparse_modes import stiffness_factor
from flexplant.reduction import DesiredDofs, reduce, select_dofs
from flexplant.structure import ModalDamping, PointMass, kirchhoff_plate
from flexplant.updating import AddedMass, Eigenvalues, ModeShapes, localise, update
from flexplant.updating.judgement import subsets
from flexplant.updating.search import Objective
from noisy_plate import Campaign, judged
from other_plate import TRUTH as OTHER_TRUTH
from other_plate import OtherPlate
from stages import fitted, reduced

pytestmark = pytest.mark.benchmark
ZETA = 0.01


def truth():
    M, K = oracle.plate()
    D = oracle.modal_damping(M, K, ZETA)
    at = oracle.z_dof(0.3, 0.15)
    M[at, at] += 0.5
    return M, D, K


def test_one_iteration_of_25_dofs_and_10_parameters():
    rom = reduced(ZETA)
    labels = list(rom.dofs)[:10]
    poles = oracle.poles(*truth())[:6]
    objective = Objective(
        rom,
        [AddedMass(at) for at in labels],
        [Eigenvalues(MeasuredModes(poles, modes=range(4, 10)))],
    )
    objective.begin(np.full(10, 0.01))

    def ours(p):
        point = objective.at(p, refer=True)
        return np.linalg.lstsq(objective.slopes(point), objective.values(point), rcond=None)[0]

    def model_poles(p):
        M = rom.M + np.diag(np.r_[p, np.zeros(len(rom.dofs) - 10)])
        solved = np.linalg.solve(M, np.hstack([-rom.K, -rom.D]))
        k = len(rom.dofs)
        values = np.linalg.eigvals(np.vstack([np.hstack([np.zeros((k, k)), np.eye(k)]), solved]))
        values = values[values.imag > 100]
        return values[np.argsort(np.abs(values))][:6]

    def peer(p):
        def residual(q):
            gap = poles - model_poles(q)
            return np.r_[gap.real, gap.imag]

        return so.least_squares(residual, p, max_nfev=1).x

    taken = {}
    for name, step in (("flexplant", ours), ("least_squares, eig, differences", peer)):
        runs = []
        for k in range(100 if step is ours else 10):
            begun = time.process_time()
            step(np.full(10, 0.011 + 1e-4 * k))
            runs.append(time.process_time() - begun)
        taken[name] = np.median(runs)
    one, other = taken.values()
    print(
        f"\niteration, 25 DOFs x 10: {1e3 * one:.2f} ms; {list(taken)[1]}: {1e3 * other:.2f} ms, "
        f"ratio {other / one:.1f}"
    )
    assert one < 2e-3


def test_the_papers_example():
    poles = np.array([-28.5 + 2870j, -39.3 + 3970j])
    begun = time.process_time()
    fit = fitted(reduced(ZETA), oracle.poles(*truth())[[2, 3]])
    print(
        f"\npaper: {len(fit.history)} steps (the paper: 8), mass {fit.values[0]:.4f} kg, damping "
        f"{fit.values[1]:.3f} N s/m, {1e3 * (time.process_time() - begun):.0f} ms; "
        f"printed poles give {fitted(reduced(ZETA), poles).values[0]:.3f} kg"
    )
    assert len(fit.history) <= 5
    assert fit.values[0] == pytest.approx(0.5, rel=5e-3)


def test_four_hundred_updates_from_noisy_responses():
    campaign, rng = Campaign(), np.random.default_rng(5)
    begun = time.process_time()
    fits = [campaign.fit(rng) for _ in range(400)]
    taken = time.process_time() - begun
    covered, error = judged(fits)
    print(
        f"\n400 updates at 40 dB: {taken:.1f} s, interval covers {100 * covered:.1f} %, median "
        f"error {100 * error:.2f} %"
    )
    assert taken < 20
    assert 0.92 <= covered <= 0.98
    assert error < 0.01


@pytest.mark.parametrize("elements", [(20, 16), (36, 30)])
def test_one_mass_on_all_dofs(elements):
    """1071 and 3441 DOFs: a few factors of K - s M in all, beside what one of them takes."""
    size = {"size": (0.6, 0.5), "thickness": 0.02, "elements": elements}
    full = kirchhoff_plate(**size, density=2702, youngs_modulus=70e9, poisson_ratio=0.35)
    at = full.dofs.nearest((0.31, 0.17, 0.0), "z")
    omega = solve_modes(full.with_parts([PointMass(at, 0.4)]), count=9).omega[3:]
    data = [Eigenvalues(MeasuredModes(omega * (1j - 1e-3), modes=range(4, 10)))]
    begun = time.process_time()
    fit = update(full, [AddedMass(at)], data)
    taken = time.process_time() - begun
    begun = time.process_time()
    stiffness_factor(full)
    one = time.process_time() - begun
    print(
        f"\none mass on {full.n_dof} DOFs: {taken:.2f} s ({len(fit.rounds)} rounds); one factor "
        f"of K - s M {1e3 * one:.0f} ms"
    )
    assert fit.values[0] == pytest.approx(0.4, rel=1e-6)


class Places:
    """0.4 kg hidden at one of 99 places of a plate; ten poles and their shapes at 25 sensors."""

    def __init__(self):
        size = {"size": (0.6, 0.5), "thickness": 0.02, "elements": (10, 8)}
        material = {"density": 2702, "youngs_modulus": 70e9, "poisson_ratio": 0.35}
        self.full = kirchhoff_plate(**size, **material).with_damping(ModalDamping(ZETA))
        self.labels = [label for label in self.full.dofs.labels if label.endswith("z")]
        self.hidden = self.full.dofs.nearest((0.31, 0.17, 0.0), "z")
        modes = solve_modes(self.full.with_parts([PointMass(self.hidden, 0.4)]), count=13)
        omega, rng, sensors = modes.omega[3:], np.random.default_rng(0), self.labels[::4]
        std = 1e-4 * omega
        noise = (rng.normal(size=10) + 1j * rng.normal(size=10)) / np.sqrt(2)
        poles = omega * (-ZETA + 1j * np.sqrt(1 - ZETA**2)) + std * noise
        phi = np.real(modes.phi[[self.full.dofs.index(label) for label in sensors], 3:])
        phi = phi / np.abs(phi).max(axis=0)
        measured = MeasuredModes(poles, modes=range(4, 14), covariance=std**2)
        phi = phi + 0.01 * rng.normal(size=phi.shape)
        self.data = [Eigenvalues(measured), ModeShapes(measured, phi, sensors, std=0.01)]

    @property
    def reduced(self):
        modes = solve_modes(self.full, count=52, damping=ModalDamping(ZETA))
        return reduce(modes, DesiredDofs(select_dofs(modes, 52)))


@pytest.mark.parametrize("kind", ["reduced", "full"])
def test_ninety_nine_places_with_shapes(kind, monkeypatch):
    """In few coordinates, and in all of them: the same place, value and criterion."""
    places = Places()
    model = getattr(places, kind)
    pool = [AddedMass(label, name=label) for label in places.labels]
    taken, found = [], []
    for few in (True, False):
        if not few:
            monkeypatch.setattr(subsets, "coordinates", lambda *arguments: None)
        begun = time.process_time()
        found.append(localise(model, pool, places.data, most=2))
        taken.append(time.process_time() - begun)
    known = np.isfinite(found[1].bic)
    apart = float(np.abs(found[0].bic[known] - found[1].bic[known]).max())
    print(
        f"\nlocalise, 99 candidates, {model.M.shape[0]} DOFs: {taken[0]:.2f} s in few "
        f"coordinates, {taken[1]:.2f} s in all; BIC of single places {apart:.1g} apart"
    )
    assert found[0].chosen == found[1].chosen == (places.hidden,)
    assert apart < 0.1
    assert found[0].chosen_bic == pytest.approx(found[1].chosen_bic, abs=1e-5)


@pytest.fixture(scope="module")
def bridge():
    if not FILE.exists():
        pytest.skip("the bridge's data are not here")
    return Bridge()


def test_the_bridge_from_a_hundred_starts(bridge):
    begun = time.process_time()
    found = ends(bridge, bridge.starts)
    taken = time.process_time() - begun
    print(
        f"\nbridge: truth to 1e-8 from {np.sum(found < 1e-8)} of {found.size} starts (median "
        f"error {np.median(found):.0e}) in {taken:.1f} s altogether; the authors: 49-154 s each"
    )
    assert np.sum(found < 1e-8) >= 90
    assert taken < 60


def test_the_bridge_with_noise(bridge):
    known = [noisy_fits(bridge, 40, seed=seed, bounds=(-1, 1)) for seed in (4, 5, 6)]
    error, score = np.sqrt(np.mean(np.square(known), axis=0))
    plain, _ = noisy_fits(bridge, 10)
    print(
        f"\nbridge, 0.5 / 1 % noise, 120 trials: rms error {error:.4f} "
        f"({', '.join(f'{e:.4f}' for e, _ in known)}), z-score rms {score:.2f}; without "
        f"prior {plain:.2f}"
    )
    assert error <= 0.11
    assert 0.8 <= score <= 1.25


def test_defect_correction_covers_the_truth():
    """200 machines of another kind, five unknowns: how often 95 % intervals hold them."""
    machine = OtherPlate()
    for kind in ("responses", "modes"):
        for rounds in (0, 2):
            held, begun = [], time.process_time()
            for seed in range(200):
                data = getattr(machine, kind)(np.random.default_rng(seed))
                more = {"full": machine.full, "rounds": rounds} if rounds else {}
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", FlexplantWarning)
                    low, high = update(machine.rom, machine.unknowns, data, **more).interval().T
                held.append((low <= OTHER_TRUTH) & (high >= OTHER_TRUTH))
            taken = (time.process_time() - begun) / 200
            share = np.mean(held, axis=0)
            print(f"\n{kind}, {rounds} rounds: held {share}, {taken:.2f} s each", end="")
            if rounds:
                assert np.all(np.abs(share - 0.95) <= 0.035)
