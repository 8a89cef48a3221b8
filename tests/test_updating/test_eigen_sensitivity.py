"""Derivatives of complex eigenvalues against differences and complex steps of another route."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import oracles_updating as oracle
from flexplant import DofSet
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.structure import FEModel
from flexplant.updating import AddedDamping, AddedMass, AddedStiffness, eigenvalue_sensitivities

KINDS = [AddedMass, AddedDamping, AddedStiffness]


def parts_of(parameter, model):
    return [np.zeros(model.M.shape) if a is None else a for a in parameter.matrices(model)]


@pytest.mark.parametrize(("kind", "step"), [(AddedMass, 3e-3), (AddedDamping, 3.0)])
@pytest.mark.parametrize("times", [0, 50])
def test_plate_against_central_differences(plate, kind, step, times):
    # a point off all symmetry lines, so that every mode moves
    parameter = kind((0.13, 0.21, 0.0))
    rom = plate.reduced(0.01, True)
    found = eigenvalue_sensitivities(rom, [parameter], modes=[4, 5, 6], values=[times * step])
    for a, mode in enumerate(found.modes):
        expected = oracle.central_difference(
            rom.M, rom.D, rom.K, parts_of(parameter, rom), times * step, step, mode - 4
        )
        assert abs(found.S[a, 0] - expected) < 1e-7 * abs(expected)


@st.composite
def held_models(draw):
    """Chains held at both ends with general damping and one odd spring: no modes are repeated."""
    count = draw(st.integers(2, 6))
    number = st.floats(0.5, 2.0)
    M = np.diag([draw(number) for _ in range(count)])
    K, D = np.zeros((count, count)), np.zeros((count, count))
    for i in range(count + 1):
        row = np.zeros(count)
        row[min(i, count - 1)] += 1.0
        if 0 < i < count:
            row[i - 1] -= 1.0
        K += 100 * draw(number) * np.outer(row, row)
        D += 0.2 * draw(number) * np.outer(row, row)
    dofs = DofSet(np.arange(1, count + 1), ["z"] * count, np.arange(3 * count).reshape(-1, 3))
    return FEModel(M, K, D, dofs=dofs)


@pytest.mark.slow
@settings(max_examples=40, deadline=None, derandomize=True)
@given(model=held_models(), kind=st.sampled_from(KINDS), where=st.integers(0, 5))
def test_any_damping_against_complex_step_and_differences(model, kind, where):
    parameter = kind(f"{where % model.n_dof + 1}:z")
    found = eigenvalue_sensitivities(model, [parameter])
    parts = parts_of(parameter, model)
    largest = np.abs(found.S).max()
    step = 5e-4 * {AddedMass: 1.0, AddedDamping: 1.0, AddedStiffness: 100.0}[kind]
    for mode in range(model.n_dof):
        pole, slope = oracle.complex_step(model.M, model.D, model.K, parts, mode)
        assert abs(found.poles[mode] - pole) < 1e-11 * abs(pole)
        assert abs(found.S[mode, 0] - slope) < 1e-9 * largest
        difference = oracle.central_difference(model.M, model.D, model.K, parts, 0.0, step, mode)
        assert abs(found.S[mode, 0] - difference) < 1e-7 * largest


def test_units_do_not_matter(plate):
    rom = plate.reduced(0.01, True)
    # millimetres and tonnes: N, so T q in mm; a mass of 1 kg is 1e-3 t
    scaled = rom.replace(M=rom.M * 1e-3, D=rom.D * 1e-3, K=rom.K * 1e-3)
    mass = AddedMass(plate.z8)
    in_si = eigenvalue_sensitivities(rom, [mass], modes=[4, 6, 9])
    in_t = eigenvalue_sensitivities(scaled, [mass], modes=[4, 6, 9])
    np.testing.assert_allclose(in_t.poles, in_si.poles, rtol=1e-12)
    np.testing.assert_allclose(in_t.S[1:], 1e3 * in_si.S[1:], rtol=1e-10)


def test_a_mass_leaves_torsion_alone_on_its_nodal_line(plate):
    found = eigenvalue_sensitivities(plate.reduced(0.01, True), [AddedMass(plate.z8)], modes=[4, 6])
    assert abs(found.S[0, 0]) < 1e-9 * abs(found.S[1, 0])


def test_repeated_modes_turn_to_the_split_of_the_parameter(plate):
    rom = plate.reduced(0.001, True)
    mass = AddedMass(plate.z8)
    lower, upper = eigenvalue_sensitivities(rom, [mass], modes=[7, 8]).S[:, 0]
    parts = parts_of(mass, rom)
    # rank one: the lower moves by all of it, the upper not at all
    step = 1e-4
    moved = [oracle.poles(rom.M + p * parts[0], rom.D, rom.K)[3] for p in (0, step, 2 * step)]
    one_sided = (4 * moved[1] - moved[2] - 3 * moved[0]) / (2 * step)
    assert abs(lower - one_sided) < 1e-5 * abs(lower)
    assert abs(upper) < 1e-9 * abs(lower)


def test_parameters_that_split_repeated_modes_differently_have_no_common_derivative(make):
    ring = make([1, 1, 1], [*[(i, None, 30.0) for i in range(3)], (0, 1, 9), (1, 2, 9), (0, 2, 9)])
    with pytest.raises(ModelError, match=r"modes \[2, 3\] are repeated"):
        eigenvalue_sensitivities(ring, [AddedMass("1:z"), AddedMass("2:z")])
    alone = eigenvalue_sensitivities(ring, [AddedMass("1:z"), AddedMass("2:z")], modes=[1])
    # the breathing mode (1, 1, 1)/sqrt(3) at sqrt(30): -i omega/6 for each
    np.testing.assert_allclose(alone.S, [[-1j * np.sqrt(30) / 6] * 2], rtol=1e-12, atol=1e-12)


def test_answer_names_modes_and_parameters(plate):
    found = eigenvalue_sensitivities(plate.reduced(0.01, False), [AddedMass(plate.z8)])
    assert found.modes == tuple(range(4, 25))
    assert found.S.shape == (21, 1)
    assert repr(found) == f"<Sensitivities: 21 modes to mass at {plate.z8}>"


def test_bad_input_is_refused(plate, make):
    rom = plate.reduced(0.01, False)
    mass = AddedMass(plate.z8)
    with pytest.raises(ModelError, match=r"must be of type Parameter.*AddedMass"):
        eigenvalue_sensitivities(rom, ["mass"])
    with pytest.raises(ModelError, match="empty"):
        eigenvalue_sensitivities(rom, [])
    with pytest.raises(LabelError, match="more than once"):
        eigenvalue_sensitivities(rom, [mass, mass])
    with pytest.raises(LabelError, match="rigid-body mode"):
        eigenvalue_sensitivities(rom, [mass], modes=[3])
    with pytest.raises(LabelError, match="numbered from 1 to 24"):
        eigenvalue_sensitivities(rom, [mass], modes=[25])
    with pytest.raises(LabelError, match="numbered from 1 to 24"):
        eigenvalue_sensitivities(rom, [mass], modes=[0])
    with pytest.raises(ShapeError, match="values"):
        eigenvalue_sensitivities(rom, [mass], values=[1.0, 2.0])
    with pytest.raises(ModelError, match=r"= -30 kg: M is not positive definite"):
        eigenvalue_sensitivities(rom, [mass], values=[-30.0])
    held = make([1, 1], [(0, None, 9.0), (0, 1, 9.0)])
    with pytest.raises(ModelError, match=r"= -50 N/m"):
        eigenvalue_sensitivities(held, [AddedStiffness("2:z")], values=[-50.0])
    with pytest.raises(ModelError, match="M, D, K"):
        eigenvalue_sensitivities(np.eye(3), [mass])
