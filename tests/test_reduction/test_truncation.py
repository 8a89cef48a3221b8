"""Modal truncation by frequency and by Hankel values: bounds that hold, tables, static shapes."""

import numpy as np
import pytest

import oracles_reduction as oracle
from flexplant.errors import LabelError, ModelError
from flexplant.modes import solve_modes
from flexplant.reduction import ModalBalanced, ModalTruncation, rank_modes, reduce
from flexplant.structure import ModalDamping
from plates import make_plate

LOW = ModalDamping(0.01)
INTO, OUT = ["7:z", "9:z"], ["1:z", "13:z", "25:z"]


@pytest.fixture(scope="module")
def plate():
    return make_plate(elements=(4, 4))


@pytest.fixture(scope="module")
def modes(plate):
    return solve_modes(plate, damping=LOW)


def true_error(modes, model, below=np.inf):
    """The largest singular value of the error over a dense grid, resonances included."""
    rows = [modes.dofs.indices(names) for names in (INTO, OUT)]
    phi, omega, zeta = np.real(modes.phi), modes.omega, modes.zeta
    B, C = phi[rows[0]], phi[rows[1]]
    Br, Cr = model.T[rows[0]], model.T[rows[1]]
    worst = 0.0
    grid = np.union1d(np.geomspace(30.0, 2e5, 1500), omega[3:] * np.sqrt(1 - 2 * zeta[3:] ** 2))
    for w in grid[grid <= 2 * np.pi * below]:
        full = (C / (omega**2 - w**2 + 2j * zeta * omega * w)) @ B.T
        less = Cr @ np.linalg.solve(model.K + 1j * w * model.D - w**2 * model.M, Br.T)
        worst = max(worst, np.linalg.norm(full - less, 2))
    return worst


@pytest.mark.slow
@pytest.mark.parametrize("count", [5, 12, 30])
@pytest.mark.parametrize("from_model", [False, True])
def test_the_bound_of_truncation_holds(plate, modes, count, from_model):
    method = ModalTruncation(count, inputs=INTO, outputs=OUT, damping=LOW if from_model else None)
    model = reduce(plate if from_model else modes, method)
    error = true_error(modes, model)
    assert error <= model.bound.value * (1 + 1e-6)
    assert model.bound.value < (60 if from_model else 30) * error  # and says something
    assert model.coordinates[:4] == ("mode 1", "mode 2", "mode 3", "mode 4")


@pytest.mark.slow
def test_the_bound_is_reached_by_one_neglected_mode(modes):
    ranking = rank_modes(modes, inputs=INTO, outputs=OUT)
    method = ModalBalanced(modes.n_modes - 1, INTO, outputs=OUT)
    model = reduce(modes, method)
    left_out = set(range(1, 76)) - {int(name[5:]) for name in model.coordinates}
    assert left_out == {int(ranking.order[-1])}
    one = ModalTruncation(modes=[i for i in range(1, 76) if i != 4], inputs=INTO, outputs=OUT)
    model = reduce(modes, one)
    assert true_error(modes, model) == pytest.approx(model.bound.value, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("count", [8, 16])
def test_balanced_truncation_beats_the_lowest_modes(modes, count):
    low = reduce(modes, ModalTruncation(count, inputs=INTO, outputs=OUT))
    best = reduce(modes, ModalBalanced(count, INTO, outputs=OUT))
    errors = [true_error(modes, model) for model in (low, best)]
    assert errors[1] < errors[0]
    assert errors[1] <= best.bound.value * (1 + 1e-6) < low.bound.value


@pytest.mark.slow
def test_static_correction_is_exact_at_0_hz(plate, modes):
    for given, method in (
        (plate, ModalTruncation(9, static_at=[*INTO, *OUT], damping=LOW)),
        (modes, ModalTruncation(9, static_at=[*INTO, *OUT])),
        (modes, ModalBalanced(9, INTO, outputs=OUT, static_at=[*INTO, *OUT])),
    ):
        model = reduce(given, method)
        assert model.n_dof == 14
        assert model.coordinates[-1] == "static 5"
        found = model.quality(plate, band=(50.0, 300.0), inputs=INTO, outputs=OUT)
        assert found.static_error.max() < 1e-8
    without = reduce(modes, ModalTruncation(9))
    found = without.quality(plate, band=(50.0, 300.0), inputs=INTO, outputs=OUT)
    assert found.static_error.max() > 0.01
    # both ways give the same vectors where the modes are all of the structure's
    one, two = (reduce(g, ModalTruncation(9, static_at=INTO)) for g in (plate, modes))
    assert oracle.same_span(one.T, two.T) < 1e-6


def test_static_correction_bound_holds(plate, modes):
    model = reduce(modes, ModalTruncation(9, static_at=OUT, inputs=INTO, outputs=OUT))
    assert true_error(modes, model) <= model.bound.value


def test_hankel_values_against_lyapunov(modes):
    few = solve_modes(make_plate(elements=(4, 4)), count=9, damping=ModalDamping(1e-3))
    ranking = rank_modes(few, inputs="1:z", outputs=["13:z", "2:z"])
    rows = few.dofs.indices(["1:z", "13:z", "2:z"])
    p = np.real(few.phi)[rows][:, 3:]
    wanted = oracle.modal_hankel(few.omega[3:], few.zeta[3:], p[:1].T, p[1:])
    np.testing.assert_allclose(ranking.exact[:8], wanted[:8], rtol=1e-6)
    # two values for each mode, near the closed form when damping is low and modes are apart
    alone = np.sort(ranking.total)[::-1]
    np.testing.assert_allclose(ranking.exact[0:4:2], alone[:2], rtol=0.02)
    np.testing.assert_allclose(ranking.exact[1:4:2], alone[:2], rtol=0.02)
    np.testing.assert_allclose(np.linalg.norm(ranking.values, axis=(1, 2)), ranking.total)
    np.testing.assert_allclose(ranking.peak, 2 * ranking.total, rtol=1e-5)
    text = ranking.table(3)
    assert len(text.splitlines()) == 4
    assert f"{ranking.order[0]:4d}" in text
    assert "1:z -> " in text
    assert repr(ranking).startswith("<ModeRanking: 6 elastic modes, 1 input to 2 outputs")


def test_a_mode_that_a_channel_does_not_see_comes_last(modes):
    """Torsion has its node lines through the centre."""
    ranking = rank_modes(modes, inputs="13:z")
    assert modes.freq[3] == pytest.approx(246, abs=3)
    assert ranking.total[0] < 1e-9 * ranking.total.max()


def test_refusals(plate, modes):
    with pytest.raises(ModelError, match=r"count= .* or modes="):
        ModalTruncation()
    with pytest.raises(ModelError, match="not both"):
        ModalTruncation(5, modes=[1, 2, 3])
    with pytest.raises(ModelError, match="left out"):
        reduce(modes, ModalTruncation(2))
    with pytest.raises(ModelError, match="mode 99 is required"):
        reduce(modes, ModalTruncation(99))
    with pytest.raises(ModelError, match="have their damping"):
        reduce(modes, ModalTruncation(9, damping=LOW))
    with pytest.raises(ModelError, match="independent static shapes"):
        reduce(modes, ModalTruncation(9, static_at=["1:z", "1:z"]))
    with pytest.raises(LabelError, match="no DOF 'q'"):
        reduce(modes, ModalTruncation(9, inputs="q"))
    with pytest.raises(ModelError, match="needs inputs"):
        ModalBalanced(9, [])
    with pytest.raises(ModelError, match="from 3"):
        reduce(modes, ModalBalanced(2, INTO))
    with pytest.raises(ModelError, match="need an FEModel"):
        reduce(modes, ModalBalanced(9, INTO, among=20))
    with pytest.raises(ModelError, match="undamped"):
        reduce(plate, ModalBalanced(9, INTO))
    with pytest.raises(ModelError, match="real Modes"):
        rank_modes(plate, inputs=INTO)
    undamped = reduce(solve_modes(plate), ModalTruncation(9, inputs=INTO))
    assert undamped.bound is None  # no finite one


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.05, 0.5, 0.95, 1.001, 1.5])
@pytest.mark.parametrize("count", [5, 9])
@pytest.mark.parametrize("made", ["modes", "static", "balanced", "model"])
def test_the_bound_below_a_frequency_holds_and_is_tight(plate, modes, made, count, share):
    """Of bands that end below, at and above the first neglected mode."""
    channels = {"inputs": INTO, "outputs": OUT}
    model = {
        "modes": lambda: reduce(modes, ModalTruncation(count, **channels)),
        "static": lambda: reduce(modes, ModalTruncation(count, static_at=OUT, **channels)),
        "balanced": lambda: reduce(modes, ModalBalanced(count, **channels)),
        "model": lambda: reduce(plate, ModalTruncation(count, damping=LOW, **channels)),
    }[made]()
    end = share * modes.freq[count]
    error, bound = true_error(modes, model, end), model.bound.below(end)
    assert error <= bound * (1 + 1e-9)
    assert bound <= model.bound.value
    if share == 0.05 and made in ("modes", "balanced"):
        assert bound < 1.2 * error
    if share == 0.5 and made != "balanced":
        assert bound < 0.1 * model.bound.value
    assert model.bound.below(1e9) == pytest.approx(model.bound.value, rel=1e-9)


def test_the_bound_of_chosen_modes_of_a_model_has_no_band(plate):
    """What lies between the chosen modes was not looked at."""
    method = ModalTruncation(modes=[1, 2, 3, 6], inputs=INTO, outputs=OUT, damping=LOW)
    bound = reduce(plate, method).bound
    assert bound.terms is None
    assert bound.below(10.0) == bound.value
    with pytest.raises(ModelError, match="freq"):
        bound.below(-1.0)


def test_the_largest_departure_from_the_static_response_is_that_of_a_dense_grid():
    """Below, at and above the resonance, up to critical damping."""
    from flexplant.reduction.ranking import _largest_change

    w = np.linspace(0.0, 3.0, 60001)
    for zeta in (0.001, 0.1, 0.4, 0.9):
        for top in (0.5, 1.0, 3.0):
            own = w[w <= top]
            change = np.abs(1.0 / (1.0 - own**2 + 2j * zeta * own) - 1.0).max()
            found = _largest_change(np.ones(1), np.array([zeta]), top)
            np.testing.assert_allclose(found, change, rtol=1e-4)
