"""Assembly: CPU time by part at a million DOFs, and beside scikit-fem on the same meshes.

Run with ``-n 0 -m benchmark -s`` and ``OMP_NUM_THREADS=1``. Times are process CPU time, the
shortest of a few runs. The peers assemble mass and stiffness of the same structure, a vectorised
quadrature over all elements; ratio: peer / ours, per DOF where their elements have other DOFs than
ours.
"""

import time

import numpy as np
import pytest
import scipy.sparse.linalg as spla

from flexplant import DofSet
from flexplant.structure import FEModel, Spring, kirchhoff_plate, solid_block
from flexplant.structure.element_matrices import plate_mass, plate_stiffness
from flexplant.structure.grids import Grid
from plates import PLATE, make_plate

pytestmark = pytest.mark.benchmark
ALU = {"density": 2700.0, "youngs_modulus": 70e9, "poisson_ratio": 0.33}


def cpu(run, repeats=1):
    """Return the shortest CPU time [s] of a call, and its answer."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        found = run()
        times.append(time.process_time() - start)
    return min(times), found


def line(what, seconds):
    print(f"{what:<58s} {seconds:8.2f} s")


def beside(what, ours, peer, peer_name, difference):
    print(
        f"{what:<44s} {ours:8.3f} s   {peer_name:<34s} {peer:8.3f} s   ratio {peer / ours:6.1f}"
        f"   differ {difference:.1e}"
    )


def test_a_million_dofs_by_part():
    """Issue: 1e6 DOFs in 10 s or less."""
    n = 577
    whole, plate = cpu(lambda: make_plate(elements=(n, n)))
    line(f"kirchhoff_plate, {plate.n_dof} DOFs, {plate.K.nnz} entries each", whole)
    grid = Grid((1.0, 1.0), (n, n), 3, np.ones((n, n), dtype=bool))
    a = 0.6 / n
    line("  neighbours and pattern, for M and K", cpu(lambda: (grid._there, grid._pattern))[0])
    line("  entries of M", cpu(lambda: grid.matrix([(plate_mass(a, a), 1.0)]))[0])
    line("  entries of K", cpu(lambda: grid.matrix([(plate_stiffness(a, a)[0], 1.0)]))[0])
    xyz, nodes, directions = plate.dofs.xyz, plate.dofs.nodes, plate.dofs.directions
    line("  DofSet and its checks", cpu(lambda: DofSet(nodes, directions, xyz))[0])
    some = np.random.default_rng(0).uniform(0.8, 1.2, (n, n))
    fields = PLATE | {"elements": (n, n), "thickness": 0.02 * some, "poisson_ratio": 0.3 * some}
    varied, _ = cpu(lambda: kirchhoff_plate(**fields))
    line("the same with a thickness and ratio per element", varied)
    line("rigid-body motions", cpu(lambda: plate.rigid_body)[0])
    line("with_parts, 100 springs", cpu(lambda: plate.with_parts(
        [Spring(f"{k}:z", 1.0) for k in range(1, 101)]))[0])  # fmt: skip
    edge = plate.dofs.where(box=[(0, 0, 0), (0, 0.6, 0)])
    line("fixed, one edge", cpu(lambda: plate.fixed(edge))[0])
    assert plate.n_dof > 1e6
    assert whole < 10
    assert varied < 10


def test_a_large_solid():
    seconds, block = cpu(lambda: solid_block(size=(0.4,) * 3, elements=(46,) * 3, **ALU))
    line(f"solid_block, {block.n_dof} DOFs, {block.K.nnz} entries each", seconds)
    assert block.n_dof > 3e5
    assert seconds < 6


def test_the_door_at_a_hundred_thousand():
    """What an imported model pays: symmetry, finiteness, definiteness."""
    plate = make_plate(elements=(180, 180))
    seconds, _ = cpu(lambda: FEModel(plate.M, plate.K, dofs=plate.dofs))
    line(f"FEModel(M, K), {plate.n_dof} DOFs, with its checks", seconds)


def test_files_at_a_million(tmp_path):
    dofs = make_plate(elements=(577, 577)).dofs
    line(f"DofSet of {len(dofs)} saved", cpu(lambda: dofs.save(tmp_path / "dofs.npz"))[0])
    from flexplant import load

    seconds, _ = cpu(lambda: load(tmp_path / "dofs.npz"))
    line("  and loaded", seconds)
    assert seconds < 5


def lowest(M, K, count, shift):
    found = spla.eigsh(K, count, M, shift, return_eigenvectors=False)
    return np.sqrt(np.sort(np.abs(found))) / (2 * np.pi)


def skfem_block(skfem, n, size, element, order):
    from skfem.helpers import ddot, dot, eye, sym_grad, trace

    lines = (np.linspace(0, length, k + 1) for length, k in zip(size, n, strict=True))
    lame, shear = 70e9 * 0.33 / 1.33 / 0.34, 70e9 / 2 / 1.33

    @skfem.BilinearForm
    def stiffness(u, v, _):
        e, f = sym_grad(u), sym_grad(v)
        return ddot(2 * shear * e + lame * eye(trace(e), 3), f)

    @skfem.BilinearForm
    def mass(u, v, _):
        return 2700.0 * dot(u, v)

    mesh = skfem.MeshHex.init_tensor(*lines)

    def run():
        basis = skfem.Basis(mesh, skfem.ElementVector(element), intorder=order)
        return mass.assemble(basis), stiffness.assemble(basis)

    return run


def test_block_beside_scikit_fem():
    skfem = pytest.importorskip("skfem")
    n = (24, 18, 12)
    ours, block = cpu(lambda: solid_block(size=(0.4, 0.3, 0.2), elements=n, **ALU), 3)
    peer, (M, _) = cpu(skfem_block(skfem, n, (0.4, 0.3, 0.2), skfem.ElementHex1(), 3), 2)
    assert M.shape[0] == block.n_dof
    # the mass is the same matrix, rows in another order
    differ = abs(np.sort(M.diagonal()) / np.sort(block.M.diagonal()) - 1).max()
    beside(f"block, {block.n_dof} DOFs", ours, peer, "scikit-fem ElementHex1", differ)
    assert differ < 1e-9


def test_bending_beside_scikit_fem():
    """A thin block: what bricks are worth in bending, at equal meshes."""
    skfem = pytest.importorskip("skfem")
    n, size = (12, 9, 1), (0.4, 0.3, 0.02)
    block = solid_block(size=size, elements=n, **ALU)
    fine = skfem_block(skfem, n, size, skfem.ElementHex2(), 4)()
    coarse = skfem_block(skfem, n, size, skfem.ElementHex1(), 3)()
    found = [lowest(M, K, 9, -1e4)[7] for M, K in ((block.M, block.K), coarse, fine)]
    print(
        f"thin block, first bending mode: ours {found[0]:.1f} Hz ({block.n_dof} DOFs), trilinear "
        f"{found[1]:.1f} Hz, quadratic {found[2]:.1f} Hz ({fine[0].shape[0]} DOFs)"
    )
    assert abs(found[0] / found[2] - 1) < 0.02
    assert found[1] / found[2] > 1.3


def test_plate_beside_scikit_fem():
    skfem = pytest.importorskip("skfem")
    from skfem.helpers import dd, ddot, eye, trace

    n, nu = 60, 0.35
    bending = 70e9 * 0.0272**3 / 12 / (1 - nu**2)

    @skfem.BilinearForm
    def stiffness(u, v, _):
        return bending * ddot((1 - nu) * dd(u) + nu * eye(trace(dd(u)), 2), dd(v))

    @skfem.BilinearForm
    def mass(u, v, _):
        return 2702 * 0.0272 * u * v

    ours, plate = cpu(lambda: make_plate(elements=(n, n)), 3)
    wanted = lowest(plate.M, plate.K, 5, -1e4)[3]
    line_up = np.linspace(0, 0.6, n + 1)
    meshes = {
        "ElementQuadBFS": (skfem.MeshQuad.init_tensor(line_up, line_up), skfem.ElementQuadBFS(), 6),
        "ElementTriMorley": (
            skfem.MeshTri.init_tensor(line_up, line_up),
            skfem.ElementTriMorley(),
            4,
        ),
    }
    for name, (mesh, element, order) in meshes.items():

        def run(mesh=mesh, element=element, order=order):
            basis = skfem.Basis(mesh, element, intorder=order)
            return mass.assemble(basis), stiffness.assemble(basis)

        peer, (M, K) = cpu(run)
        differ = abs(lowest(M, K, 5, -1e4)[3] / wanted - 1)
        scaled = peer * plate.n_dof / M.shape[0]
        beside(
            f"plate, {plate.n_dof} DOFs", ours, scaled, f"{name} ({M.shape[0]}), per DOF", differ
        )
        assert differ < 1e-2
