"""A body of any shape, meshed by scikit-fem, as a model.

Run it: ``python examples/from_skfem.py`` (needs ``pip install scikit-fem``). An aluminium block of
200 x 200 x 20 mm has a round hole of 80 mm. The mesh has four patches between the hole and the
sides of the block, and quadratic bricks; scikit-fem assembles M and K. flexplant takes M, K and the
place and the direction of each DOF. ``skfem.Mesh.load("part.msh")`` reads a mesh of Gmsh.
"""

# %% Names and numbers
from typing import Any

import numpy as np
import skfem
from skfem.helpers import ddot, dot, eye, sym_grad, trace

import flexplant as fx

SIDE, RADIUS, DEPTH = 0.2, 0.04, 0.02  # m
DENSITY, YOUNG, POISSON = 2700.0, 70e9, 0.33
DAMPING = 0.002


# %% Geometry and mesh
def plate_with_hole(across: int = 3, around: int = 6) -> skfem.MeshHex:
    """Return a mesh of the block: elements from the hole to a side, and along a quarter of it."""
    patch = skfem.MeshHex.init_tensor(
        np.linspace(0, 1, across + 1), np.linspace(-1, 1, around + 1), np.linspace(0, DEPTH, 3)
    )
    out, along, z = patch.p
    side = 0.5 * SIDE * np.array([np.ones_like(along), along])
    hole = RADIUS * np.array([np.cos(np.pi / 4 * along), np.sin(np.pi / 4 * along)])
    x, y = (1 - out) * hole + out * side
    quarters = [(x, y), (-y, x), (-x, -y), (y, -x)]
    meshes = [skfem.MeshHex(np.array([*xy, z]), patch.t) for xy in quarters]
    return meshes[0] + meshes[1] + meshes[2] + meshes[3]


# %% Matrices, and what their rows stand for
def model_of(mesh: skfem.MeshHex) -> fx.FEModel:
    """Return the model of an isotropic solid."""
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex2()), intorder=4)
    lame, shear = YOUNG * POISSON / (1 + POISSON) / (1 - 2 * POISSON), YOUNG / 2 / (1 + POISSON)

    @skfem.BilinearForm
    def stiffness(u: Any, v: Any, _: Any) -> Any:
        strain = sym_grad(u)
        return ddot(2 * shear * strain + eye(lame * trace(strain), 3), sym_grad(v))

    @skfem.BilinearForm
    def mass(u: Any, v: Any, _: Any) -> Any:
        return DENSITY * dot(u, v)

    # three DOFs of each vertex, edge, face and cell, in the order x, y, z
    kinds = (basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs)
    rows = np.hstack(kinds).T.ravel()
    nodes = np.repeat(np.arange(1, rows.size // 3 + 1), 3)
    dofs = fx.DofSet(nodes, ["x", "y", "z"] * (rows.size // 3), basis.doflocs[:, rows].T)
    M, K = (form.assemble(basis)[rows][:, rows] for form in (mass, stiffness))
    return fx.FEModel(M, K, dofs=dofs)


# %% From here it is a model like any other
def main() -> dict[str, Any]:
    """Check and solve the body, and reduce it; a point on the rim of the hole is kept."""
    model = model_of(plate_with_hole())
    print(fx.check(model))
    modes = fx.solve_modes(model, count=16, damping=fx.ModalDamping(DAMPING))
    print(modes)
    rim = model.dofs.nearest((RADIUS, 0.0, DEPTH), "x")
    keep = fx.select_dofs(modes, 16, required=[rim]).labels
    reduced = fx.reduce(modes, fx.DesiredDofs(keep))
    print(reduced)
    return {"model": model, "modes": modes, "reduced": reduced}


if __name__ == "__main__":
    main()
