"""Mode shapes on plates, solids and beams: the surface, the motion, and the motion over time."""

from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import ModelError
from flexplant.plot.shapes import surface_of
from stages import L, fitted, reduced, some_modes

ALUMINIUM = {"density": 2700.0, "youngs_modulus": 70e9, "poisson_ratio": 0.33}
POLES = np.array([-28.569 + 2883.567j, -39.451 + 3983.308j])


def area(skin):
    a, b, c = (skin.xyz[skin.triangles[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def length(skin):
    return np.linalg.norm(np.diff(skin.xyz[skin.edges], axis=1)[:, 0], axis=1).sum()


def test_the_surface_of_a_solid():
    """Its area and edges are those of the body, found from its nodes alone."""
    skin = surface_of(block_modes().dofs)
    assert skin.is_solid
    assert area(skin) == pytest.approx(0.38, rel=1e-9)
    assert length(skin) == pytest.approx(3.2, rel=1e-9)
    corner = fx.solid_block(
        size=(0.4, 0.4, 0.2), elements=(6, 6, 3), holes=lambda x, y, z: x > 0.2 and y > 0.2,
        **ALUMINIUM,
    )  # fmt: skip
    assert area(surface_of(corner.dofs)) == pytest.approx(
        0.56, rel=0.01
    )  # half an element is filled


def test_the_surface_of_a_plate_with_a_hole_and_the_line_of_a_beam():
    plate = fx.kirchhoff_plate(size=(0.6, 0.4), thickness=0.01, elements=(12, 8), **ALUMINIUM)
    x, y, _ = plate.dofs.xyz.T
    kept = np.flatnonzero((np.abs(x - 0.45) > 0.076) | (np.abs(y - 0.2) > 0.076))
    skin = surface_of(plate.dofs.select([plate.dofs.labels[i] for i in kept]))
    assert not skin.is_solid
    assert area(skin) == pytest.approx(0.24 - 0.04, rel=0.06)  # of four corners half elements
    beam = fx.beam(
        length=1.0, elements=5, density=2700, youngs_modulus=70e9, area=1e-4, inertia=1e-9
    )
    line = surface_of(beam.dofs)
    assert not len(line.triangles)
    assert length(line) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["full", "reduced", "complex"])
def test_torsion_of_a_plate(kind):
    modes = {
        "full": some_modes,
        "reduced": lambda: reduced().modes(),
        "complex": lambda: fitted(reduced(), POLES).model.modes(),
    }[kind]()
    ax = fx.plot.mode_shape(modes, 4, scale=0.1)
    edge = np.concatenate(ax.collections[1]._segments3d)
    x, y, z = 1e-3 * edge.T
    torsion = (x - L / 2) * (y - L / 2)
    assert np.abs(z).max() == pytest.approx(0.1 * L, rel=1e-6)
    assert abs(np.corrcoef(z, torsion)[0, 1]) > 0.98
    known = f"{modes.freq[3]:.1f} Hz, damping {100 * modes.zeta[3]:.2g} %"
    assert ax.get_title() == f"mode 4, {known}"
    assert [ax.get_xlabel(), ax.get_zlabel()] == ["x [mm]", "z [mm]"]
    assert ax.figure.axes[1].get_ylabel() == "displacement, largest 1 [-]"
    for bad in (0, modes.omega.size + 1):
        with pytest.raises(ModelError, match=f"mode {bad} does not exist: modes are numbered 1 to"):
            fx.plot.mode_shape(modes, bad)


def block_modes():
    block = fx.solid_block(size=(0.4, 0.3, 0.1), elements=(4, 3, 1), **ALUMINIUM)
    return fx.solve_modes(block, count=8)


def test_the_ports_of_a_solid_where_they_are():
    modes = block_modes()
    ports = fx.Ports(
        u=[fx.Actuator("push", at=(0.05, 0.05, 0.0), direction="z")],
        y=[fx.Sensor("side", at=modes.dofs.nearest((0.4, 0.3, 0.1), "x"))],
        z=[fx.Poi("die", at=(0.2, 0.1, 0.1))],
    )
    ax = fx.plot.layout(modes.dofs, ports=ports)
    marked = {line.get_label(): np.ravel(line.get_data_3d()) for line in ax.get_lines()}
    np.testing.assert_allclose(marked["actuators"], [50.0, 50.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(marked["sensors"], [400.0, 300.0, 100.0])
    np.testing.assert_allclose(marked["POI"], [200.0, 100.0, 100.0])
    assert {"push", "side", "die"} <= {text.get_text().strip() for text in ax.texts}
    with pytest.raises(ModelError, match="three dimensions"):
        fx.plot.layout(modes.dofs, ax=plt.subplots()[1])


def portal_frame(count=6, seed=0):
    """Four legs and four beams of a machine frame: an FEModel, and its joined node numbers."""
    corners = [(0, 0), (1.2, 0), (1.2, 0.8), (0, 0.8)]
    legs = [((*c, 0.0), (*c, 0.7)) for c in corners]
    beams = [
        ((*a, 0.7), (*b, 0.7)) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)
    ]
    numbers, pairs = {}, set()
    rng = np.random.default_rng(seed)
    free = iter(rng.permutation(np.arange(1, 1000)).tolist())
    for a, b in legs + beams:
        on = [tuple(np.round(p, 9)) for p in np.linspace(a, b, count)]
        ids = [numbers.setdefault(p, next(free)) if p not in numbers else numbers[p] for p in on]
        pairs |= {tuple(sorted(pair)) for pair in pairwise(ids)}
    ids = np.array(list(numbers.values()))
    n, place = ids.size, {node: i for i, node in enumerate(ids.tolist())}
    K = np.zeros((3 * n, 3 * n))
    for a, b in pairs:
        rows = np.array([3 * place[a], 3 * place[b]])
        stiff = rng.uniform(1e6, 2e6, 3)
        for axis in range(3):
            at = np.ix_(rows + axis, rows + axis)
            K[at] += stiff[axis] * np.array([[1.0, -1.0], [-1.0, 1.0]])
    dofs = fx.DofSet(np.repeat(ids, 3), list("xyz") * n, np.repeat(list(numbers), 3, axis=0))
    return fx.FEModel(np.eye(3 * n), K, dofs=dofs), {tuple(map(int, pair)) for pair in pairs}


def drawn_pairs(modes, joined=None):
    skin = surface_of(modes.dofs, joined)
    assert not len(skin.triangles)
    nodes = np.unique(modes.dofs.nodes)
    return {tuple(sorted(map(int, nodes[edge]))) for edge in skin.edges}


def test_a_frame_is_drawn_as_its_members():
    """Lines between near nodes, between those that K joins, or between those of the elements."""
    model, pairs = portal_frame()
    modes = fx.solve_modes(model, count=12)
    assert drawn_pairs(modes) == pairs
    assert drawn_pairs(modes, model) == pairs
    assert drawn_pairs(modes, np.array(sorted(pairs))[:, ::-1]) == pairs
    coarse, few = portal_frame(count=2)  # nodes at the corners alone form a box
    assert drawn_pairs(fx.solve_modes(coarse, count=8), coarse) == few
    ax = fx.plot.mode_shape(modes, 8, joined=model)
    _, moved = ax.collections[:2]
    assert len(ax.collections) == 2
    assert len(np.unique(moved.get_colors(), axis=0)) > 3, "coloured by the displacement"
    assert fx.plot.layout(model.dofs).name == "3d"
    for wrong in (np.array([[1, 2000]]), np.array([1, 2, 3])):
        with pytest.raises(ModelError, match="node numbers at both ends"):
            fx.plot.mode_shape(modes, 8, joined=wrong)
