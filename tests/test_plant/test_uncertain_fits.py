"""Plants of a fit, calibrated or not: what is measured of a mode is what it is uncertain by."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import ModelError

COUNT = 6
PLACES = [f"{i}:x" for i in range(1, COUNT + 1)]
PORTS = fx.testbeds.three_masses().assembled.ports


def chains(rng, damped):
    """A drawing and the machine that was built: other masses, springs and damping."""
    masses, springs = rng.uniform(5.0, 50.0, COUNT), rng.uniform(1e5, 1e7, COUNT - 1)
    drawing = fx.chain(masses=masses, stiffnesses=springs)
    built = fx.chain(
        masses=masses + np.eye(COUNT)[1] * rng.uniform(0.2, 2.0),
        stiffnesses=springs * rng.uniform(0.99, 1.01, COUNT - 1),
    )
    if damped:
        drawing = drawing.with_damping(fx.ModalDamping(0.02))
    return drawing, fx.solve_modes(built, count=COUNT, damping=fx.ModalDamping(0.03))


def fitted(seed, damped=True, damper=False, noise=1e-3, full=False):
    """A fit of a drawing to three measured poles, and these."""
    rng = np.random.default_rng([seed, 55])
    drawing, machine = chains(rng, damped)
    modes = fx.solve_modes(drawing, count=COUNT)
    model = drawing if full else fx.reduce(modes, fx.DesiredDofs(PLACES))
    numbers = [2, 3, 4]
    poles = machine.poles[[n - 1 for n in numbers]]
    std = noise * np.abs(poles.real if damped else poles)
    data = fx.MeasuredModes(poles, modes=numbers, covariance=np.diag(np.tile(std**2, 2)))
    unknown = [fx.AddedMass("2:x"), *([fx.AddedDamping("4:x")] if damper else [])]
    return fx.update(model, unknown, [fx.Eigenvalues(data)]), data


def upper(system):
    """The poles above the real axis, by rising size."""
    poles = np.linalg.eigvals(system.A)
    poles = poles[poles.imag > 1.0]
    return poles[np.argsort(np.abs(poles))]


def shares(data):
    """Two deviations of the measured frequencies and dampings, at least 0.1 % and 2 %."""
    poles, m = data.poles, len(data)
    d = 1e-6
    found = np.zeros((2, m))
    for i, pole in enumerate(poles):
        J = np.zeros((2, 2))
        for k, step in enumerate((d, 1j * d)):
            moved = pole + step * abs(pole)
            J[0, k] = (np.log(abs(moved)) - np.log(abs(pole))) / (d * abs(pole))
            J[1, k] = (np.log(-moved.real / abs(moved)) - np.log(-pole.real / abs(pole))) / (
                d * abs(pole)
            )
        own = data.covariance[np.ix_([i, m + i], [i, m + i])]
        found[:, i] = np.sqrt(np.diag(J @ own @ J.T))
    return np.maximum(np.expm1(2.0 * found), [[1e-3], [0.02]])


@pytest.mark.filterwarnings("ignore::flexplant.errors.FlexplantWarning")
@pytest.mark.parametrize("damped", [True, False])
@pytest.mark.parametrize("kind", ["plain", "damper", "modes"])
@pytest.mark.parametrize("seed", range(3))
def test_a_calibrated_plant_is_as_uncertain_as_its_poles_were_measured(seed, kind, damped):
    """Reduced models and modes of a full one, with coupled damping or none at all."""
    full = kind == "modes"
    fit, data = fitted(seed, damped and not full, damper=kind == "damper", full=full)
    known = fit
    if full:  # a drawing without damping, and modes with some
        ratio = fx.ModalDamping(0.02) if damped else None
        known = fx.solve_modes(fit.model, count=COUNT, damping=ratio)
    plant = fx.assemble_plant(known.calibrated(data), PORTS)
    uncertain = plant.uncertain(fit)
    assert len(uncertain.machines.drawn(5, rng=1)) == 5
    if uncertain.of_matrices:  # a damper to the ground couples the modes: its parameters are
        assert [d.name for d in uncertain.deltas] == list(fit.parameters)
        return
    wanted = shares(data)
    found = {delta.name: delta.scale for delta in uncertain.deltas}
    for i, pole in enumerate(data.poles):
        number = 1 + int(np.argmin(np.abs(upper(plant.system) - pole))) + 1  # one rigid-body mode
        # what the model says of a mode makes it a little better known than it was measured
        off, thin = 0.5 * found[f"mode{number}:freq"], found[f"mode{number}:damping"]
        assert 0.8 * wanted[0, i] <= off <= 1.001 * wanted[0, i]
        assert 0.8 * wanted[1, i] <= thin <= 1.001 * wanted[1, i]
        machine = uncertain.lft({f"mode{number}:freq": 1.0})
        moved = upper(machine.system)[number - 2]
        assert abs(moved) / abs(pole) == pytest.approx(np.sqrt(1.0 + 2.0 * off), rel=1e-6)


@pytest.mark.filterwarnings("ignore::flexplant.errors.FlexplantWarning")
def test_modes_that_change_places_by_what_was_measured():
    """The measured pole of mode 5 lies below that of mode 4: numbers are those of the plant."""
    fit = fitted(0)[0]
    own = fit.model.modes()
    poles = own.poles[[3, 4]]
    crossed = fx.MeasuredModes(poles[::-1] * 1.001, modes=[4, 5], covariance=[1e-2, 4e-2])
    plant = fx.assemble_plant(fit.calibrated(crossed), PORTS)
    uncertain = plant.uncertain(fx.plant.Fit(fit, modes=[4, 5]))
    expected = shares(crossed)[0][::-1]  # of the lower pole first
    found = [d.scale for d in uncertain.deltas if d.name in ("mode4:freq", "mode5:freq")]
    np.testing.assert_allclose(found, 2.0 * expected, rtol=1e-3)


@pytest.mark.filterwarnings("ignore::flexplant.errors.FlexplantWarning")
def test_a_model_that_is_updated_after_it_was_calibrated_is_not_calibrated():
    fit, data = fitted(1)
    again = fx.update(fit.calibrated(data), fit.unknowns, [
        fx.Eigenvalues(data.replace(poles=1.02 * data.poles))
    ])  # fmt: skip
    plant = fx.assemble_plant(again.model, PORTS)
    assert plant.model.calibration is not None
    plant.uncertain(again)
    with pytest.raises(ModelError, match="not of the same model"):
        plant.uncertain(fit)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::flexplant.errors.FlexplantWarning")
@pytest.mark.parametrize(("seed", "damped", "open_modes"), [(12, True, (5,)), (2, False, (4, 5))])
def test_what_was_measured_determines_shares_or_says_that_it_does_not(seed, damped, open_modes):
    """Two poles and two parameters, of which one hardly moves them: 1.8e10 % were said."""
    rng = np.random.default_rng(seed)
    masses, springs = rng.uniform(5.0, 50.0, 5), rng.uniform(1e5, 1e7, 4)
    drawing = fx.chain(masses=masses, stiffnesses=springs)
    built = fx.chain(
        masses=masses * rng.uniform(0.9, 1.1, 5), stiffnesses=springs * rng.uniform(0.8, 1.2, 4)
    )
    ratio = fx.ModalDamping(0.02) if damped else None
    modes = fx.solve_modes(drawing, count=5, damping=ratio)
    model = fx.reduce(modes, fx.DesiredDofs(PLACES[:5]))
    poles = fx.solve_modes(built, count=5, damping=fx.ModalDamping(0.03)).poles
    data = fx.MeasuredModes(poles[[1, 2]], modes=[2, 3])
    unknown = [fx.AddedMass("2:x"), fx.MatrixParameter("k", dK=model.K)]
    fit = fx.update(model, unknown, [fx.Eigenvalues(data)])
    known = fit.uncertainty()
    assert known.undetermined == open_modes
    assert "not determined by the measurement: modes " in repr(known)
    assert known.share.max() < 1e3
    plant = fx.assemble_plant(fit.calibrated(data), PORTS)
    with pytest.raises(ModelError, match=f"mode {open_modes[0]}"):
        plant.uncertain(fit)
    assert {d.mode for d in plant.uncertain(fx.plant.Fit(fit, modes=[2, 3])).deltas} == {2, 3}
