"""A solid on springs that were there before its modes were solved: its rigid body, by geometry."""

from functools import cache

import numpy as np
import pytest
import scipy.linalg as la

from flexplant.errors import AssumptionError
from flexplant.lti import frequency_response
from flexplant.modes import solve_modes
from flexplant.plant import (
    Actuator,
    BaseAcceleration,
    Disturbance,
    GroundSpring,
    Poi,
    Ports,
    Reference,
    Sensor,
    assemble_plant,
    gravity_axes,
    reference_errors,
    stage_weights,
    suspend,
)
from flexplant.structure import solid_block

SIZE, DENSITY = np.array([0.4, 0.3, 0.05]), 2700.0
MASS = DENSITY * SIZE.prod()
CENTRE = SIZE / 2
AXES = ("x", "y", "z", "rx", "ry", "rz")
PUSHED = [
    ((0, 0, 0), "z"), ((0.4, 0, 0), "z"), ((0, 0.3, 0), "z"),
    ((0, 0.15, 0), "x"), ((0.1, 0, 0.05), "y"), ((0.3, 0, 0.05), "y"),
]  # fmt: skip
SEEN = [
    ((0, 0, 0.05), "z"), ((0.4, 0, 0.05), "z"), ((0, 0.3, 0.05), "z"),
    ((0, 0.15, 0.05), "x"), ((0.1, 0.3, 0), "y"), ((0.3, 0.3, 0), "y"),
]  # fmt: skip


@cache
def held(freq, directions="xyz"):
    """On springs at the corners that make the bounce this frequency [Hz]."""
    block = solid_block(
        size=tuple(SIZE),
        elements=(8, 6, 2),
        density=DENSITY,
        youngs_modulus=70e9,
        poisson_ratio=0.33,
    )
    stiffness = MASS * (2 * np.pi * freq) ** 2 / 8
    corners = [(x, y, z) for x in (0, 0.4) for y in (0, 0.3) for z in (0, 0.05)]
    return suspend(
        block, [GroundSpring(c, stiffness, direction=d) for c in corners for d in directions]
    )


@cache
def plant_of(freq, count=20, directions="xyz", **changes):
    fields = {
        "w": [Disturbance("d", at=(0.2, 0.15, 0.05), asd=1e-3)],
        "u": [Actuator(f"u{i}", at=at, direction=d) for i, (at, d) in enumerate(PUSHED, 1)],
        "z": [Poi("die", at=(0.2, 0.15, 0.05), axes=("z", "x", "y", "rx", "ry", "rz"))],
        "y": [Sensor(f"y{i}", at=at, direction=d) for i, (at, d) in enumerate(SEEN, 1)],
        "references": [Reference("die")],
    }
    modes = solve_modes(held(freq, directions), count=count)
    return assemble_plant(modes, Ports(**(fields | changes)))


def rows(places, about=CENTRE):
    """Motion (p, 6) along the directions at some points per motion of the centre of gravity."""
    found = []
    for at, direction in places:
        along = np.eye(3)["xyz".index(direction)]
        found.append([*along, *np.cross(np.array(at) - about, along)])
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize(("freq", "exact"), [(1.0, 1e-6), (3.0, 1e-5), (10.0, 1e-4)])
def test_the_rigid_body_is_that_of_the_box(freq, exact):
    plant = plant_of(freq)
    found = gravity_axes(plant)
    assert tuple(found.axes) == AXES
    np.testing.assert_allclose(found.centre, CENTRE, rtol=0, atol=exact * 0.4)
    a, b, c = SIZE**2
    inertia = MASS / 12 * np.array([b + c, a + c, a + b])
    np.testing.assert_allclose(np.diag(found.mass), [MASS] * 3 + inertia.tolist(), rtol=exact)
    for product in (found.T_y @ rows(SEEN), rows(PUSHED).T @ found.T_u):
        np.testing.assert_allclose(product, np.eye(6), rtol=0, atol=exact)
    # errors of sensors when the POI is to move along z: those along z follow it, no others
    follows = reference_errors(plant).D[:, -1]
    np.testing.assert_allclose(follows, [1, 1, 1, 0, 0, 0], rtol=0, atol=10 * exact)  # it bends
    assert stage_weights(plant, 100.0).z["die:error"] is not None


@pytest.mark.slow
@pytest.mark.parametrize("freq", [1.0, 10.0])
def test_a_shaken_floor_moves_it_as_the_full_model_does(freq):
    shaken = plant_of(freq, w=(BaseAcceleration("floor", direction="z", asd=1e-6),))
    model = held(freq)
    M, K = model.M.toarray(), model.K.toarray()
    up = np.array([d == "z" for d in model.dofs.directions], dtype=float)
    at = model.dofs.row((0.2, 0.15, 0.05), "z")
    frequencies = np.array([0.3, 0.9, 2.0, 30.0]) * freq
    wanted = [at @ la.solve(K - (2 * np.pi * f) ** 2 * M, -M @ up) for f in frequencies]
    got = frequency_response(shaken.system.select(["die:z"], ["floor"]), frequencies).data[0, 0]
    np.testing.assert_allclose(got, wanted, rtol=1e-4)


def test_axes_that_stiff_springs_bend_are_not_dropped_in_silence():
    stiff = plant_of(900.0, count=12, directions="xy")
    with pytest.raises(AssumptionError, match=r"miss .* % of x.*suspend\(modes, springs\)"):
        gravity_axes(stiff)
    # what rests under its forces bends against these springs, and follows all the same
    assert np.abs(reference_errors(stiff).D[:3, -1] - 1.0).max() < 0.5
    # those that are asked for by name are there
    assert tuple(gravity_axes(stiff, axes=["z"]).axes) == ("z",)
