"""A thickness: K goes with its cube, M with itself; gradients are exact."""

import numpy as np
import pytest

import oracles_updating as oracle
from flexplant.errors import ModelError, ShapeError
from flexplant.identification import MeasuredModes
from flexplant.modes import solve_modes
from flexplant.plant import Actuator, Fit, Poi, Ports, Sensor, assemble_plant
from flexplant.structure import ModalDamping, chain
from flexplant.updating import (
    Eigenvalues,
    FrfResidual,
    MatrixParameter,
    PolynomialParameter,
    update,
)
from flexplant.updating.search import Objective
from plates import PLATE, make_plate

H = PLATE["thickness"]


def build(h):
    return make_plate(thickness=h)


@pytest.fixture(scope="module")
def thickness():
    return PolynomialParameter.from_build("thickness", build, value=H, unit="m")


def test_matrices_are_those_of_the_plate(thickness):
    """K_3 h^3 and M_1 h of the bending plate, from the integrals of an oracle."""
    M, K = oracle.plate(thickness=1.1 * H)
    dM, dD, dK = thickness.change(make_plate(), 0.1 * H)
    base = make_plate()
    np.testing.assert_allclose((base.K + dK).toarray(), K, atol=1e-9 * np.abs(K).max())
    np.testing.assert_allclose((base.M + dM).toarray(), M, atol=1e-9 * np.abs(M).max())
    assert dD is None
    assert (len(thickness.dM), len(thickness.dK)) == (1, 3)
    # counted from another thickness
    moved = thickness.about(0.1 * H)
    for i in (0, 2):
        whole = thickness.change(base, 0.15 * H)[i] - thickness.change(base, 0.1 * H)[i]
        gap = abs(whole - moved.change(base, 0.05 * H)[i]).max()
        assert gap < 1e-9 * abs(whole).max()


@pytest.mark.slow
def test_three_per_cent_are_found(thickness, plate):
    """11 standard deviations off with the derivative alone."""
    rom = plate.reduced(0.01, False)
    poles = oracle.truth(0.01, thickness=1.03 * H, mass=0.0)
    std = 1e-4 * np.abs(poles)
    data = [Eigenvalues(MeasuredModes(poles, modes=[6, 7], covariance=std**2))]
    full = plate.model.with_damping(ModalDamping(0.01))
    damping = MatrixParameter("damping", dD=full.D)
    fit = update(rom, [thickness, damping], data)
    assert fit.values[0] == pytest.approx(0.03 * H, rel=1e-6)
    line = MatrixParameter.from_difference("thickness", build, value=H, unit="m")
    flat = update(rom, [line, damping], data)
    assert abs(flat.values[0] - 0.03 * H) > 8 * fit.std[0]
    # the model that is made of it is the thick plate
    assert fit.applied_to(full).M.sum() == pytest.approx(1.03 * plate.model.M.sum())
    # and its uncertainty is that of the modes at the estimate: 2 df/f = 2 dh/h
    ends = {"at": plate.grid[0]}
    ports = Ports(u=[Actuator("u", **ends)], z=[Poi("die", at=plate.grid[12], axes=("z",))],
                  y=[Sensor("y", **ends)])  # fmt: skip
    deltas = assemble_plant(fit.model, ports).uncertain(Fit(fit, modes=[6], deviations=1.0)).deltas
    wanted = 2 * fit.std[0] / (1.03 * H)
    assert deltas[0].scale == pytest.approx(wanted, rel=1e-3)


@pytest.mark.slow
def test_gradients_of_all_residuals(thickness, plate):
    """Against central differences, far from p = 0, with an affine parameter beside it."""
    from flexplant.lti import Frf
    from flexplant.updating import AddedMass, Antiresonances, ModeShapes, StaticCompliance

    rom, (a, b) = plate.reduced(0.01, True), (plate.grid[0], plate.z8)
    freq = np.array([300.0, 420.0])
    frf = Frf(freq, np.full((1, 1, 2), 1e-6 + 1e-7j), inputs=[a], outputs=[b])
    poles = MeasuredModes(oracle.truth(0.01), modes=[6, 7])
    rng = np.random.default_rng(0)
    residuals = [
        Eigenvalues(poles),
        ModeShapes(poles, rng.normal(size=(4, 2)), plate.grid[:4]),
        FrfResidual(frf),
        FrfResidual(frf, hold=5e3, delay=0.5),
        Antiresonances([-10 + 3000j], a, b),
        StaticCompliance(1e-6, a, a),
    ]
    objective = Objective(rom, [AddedMass(plate.z8), thickness], residuals)
    p = np.array([0.2, 0.1 * H])
    J = objective.slopes(objective.begin(p))
    for column, step in enumerate((1e-4, 1e-5 * H)):
        h = np.eye(2)[column] * step
        up, down = (objective.values(objective.at(p + s * h)) for s in (1, -1))
        slope = (up - down) / (2 * step)
        np.testing.assert_allclose(J[:, column], slope, atol=3e-5 * np.abs(slope).max())


def stretched(length):
    """A rod's spring goes with 1/length, its mass with the length."""
    masses = [1.0, 2.0 * length, 1.5]
    return chain(masses=masses, stiffnesses=[4e5 / length, 3e5], ground=[1e5, 0.0, 0.0])


@pytest.mark.slow
def test_matrices_that_are_no_polynomials_are_followed():
    """15 % longer: found to 1e-7, with gradients of the model built anew; bounds where compared."""
    length = PolynomialParameter.from_build("length", stretched, value=1.0, unit="m")
    assert "good to" in repr(length)
    assert 1e-9 < length.missed < 1e-6
    assert (len(length.dM), length.bounds) == (1, (-0.2, 0.2))
    model, longer = stretched(1.0), stretched(1.15)
    poles = solve_modes(longer, count=3).poles
    data = [Eigenvalues(MeasuredModes(poles, modes=[1, 2, 3]))]
    fit = update(model, [length], data)
    assert fit.values[0] == pytest.approx(0.15, rel=1e-6)
    objective = Objective(model, [length], data)
    slope = objective.slopes(objective.begin(np.array([0.1])))
    up, down = (solve_modes(stretched(1.1 + h), count=3).omega for h in (1e-5, -1e-5))
    np.testing.assert_allclose(slope[3:, 0], -(up - down) / 2e-5, rtol=1e-5)
    with pytest.raises(ModelError, match=r"K of length is not a polynomial of degree 12"):
        PolynomialParameter.from_build("length", stretched, value=1.0, width=0.99)


def test_what_is_no_polynomial_is_refused():
    with pytest.raises(ModelError, match=r"K of t is not a polynomial of degree 2.*Raise degree="):
        PolynomialParameter.from_build("t", build, value=H, degree=2)
    with pytest.raises(ModelError, match="changes nothing"):
        PolynomialParameter("t", dK=[None])
    with pytest.raises(ShapeError, match="list of matrices"):
        PolynomialParameter("t", dK=np.eye(3))
    with pytest.raises(ShapeError, match="changes the DOFs"):
        PolynomialParameter.from_build(
            "n", lambda n: make_plate(elements=(2, 2) if n > 1 else (3, 3)), value=1.0
        )
