"""Large meshes of equal elements, assembled at once: plates and solid blocks for speed tests."""

import numpy as np
import scipy.sparse as sp

from flexplant import DofSet
from flexplant.structure import kirchhoff_plate
from plates import PLATE

CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)


def assembled(places, element, n):
    """Sum equal element matrices (m, m) at the DOFs `places` (elements, m)."""
    m = element.shape[0]
    places = places.astype(np.int32)
    rows, columns = np.repeat(places, m, axis=1).ravel(), np.tile(places, (1, m)).ravel()
    entries = np.tile(element.ravel(), places.shape[0])
    # a copy: what is summed keeps the memory of all terms
    return sp.csc_array(sp.coo_array((entries, (rows, columns)), shape=(n, n))).copy()


def plate(n, size=0.6):
    """M, K, node numbers, coordinates and directions of a free square plate, n x n elements."""
    h = size / n
    one = kirchhoff_plate(**(PLATE | {"size": (h, h), "elements": (1, 1)}))
    corner = np.rint(one.dofs.xyz[:, :2] / h).astype(int)
    kind = np.array([("z", "rx", "ry").index(d) for d in one.dofs.directions])
    x, y = (a.ravel()[:, None] for a in np.meshgrid(range(n), range(n), indexing="ij"))
    places = 3 * (x + corner[:, 0] + (y + corner[:, 1]) * (n + 1)) + kind
    total = 3 * (n + 1) ** 2
    row, column = np.divmod(np.arange((n + 1) ** 2), n + 1)
    xyz = np.column_stack([column * h, row * h, 0.0 * row])
    M, K = (assembled(places, a.toarray(), total) for a in (one.M, one.K))
    return M, K, *_table(xyz, ("z", "rx", "ry"))


def brick(h, youngs_modulus=70e9, poisson_ratio=0.33, density=2700.0):
    """Mass and stiffness (24, 24) of the trilinear brick, Gauss 2 x 2 x 2."""
    signs = 2.0 * CORNERS - 1
    lame = youngs_modulus * poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio))
    shear = youngs_modulus / (2 * (1 + poisson_ratio))
    law = np.diag([2 * shear] * 3 + [shear] * 3)
    law[:3, :3] += lame
    M, K, volume = np.zeros((24, 24)), np.zeros((24, 24)), np.prod(h) / 8
    for point in (2.0 * CORNERS - 1) / np.sqrt(3):
        f = 1 + signs * point
        shape = f.prod(axis=1) / 8
        others = np.column_stack([f[:, 1] * f[:, 2], f[:, 0] * f[:, 2], f[:, 0] * f[:, 1]])
        slope = signs * others / 8 * (2 / np.asarray(h))
        B = np.zeros((6, 24))
        for i, (x, y, z) in enumerate(slope):
            B[:, 3 * i : 3 * i + 3] = [
                [x, 0, 0], [0, y, 0], [0, 0, z], [y, x, 0], [0, z, y], [z, 0, x],
            ]  # fmt: skip
        K += B.T @ law @ B * volume
        M += density * volume * np.kron(np.outer(shape, shape), np.eye(3))
    return M, K


def solid(nx, ny, nz, size=(0.3, 0.3, 0.3)):
    """M, K, node numbers, coordinates and directions of a free block, nx x ny x nz bricks."""
    counts, h = np.array([nx, ny, nz]), np.array(size) / [nx, ny, nz]
    cells = np.stack(np.meshgrid(*map(range, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    corner = cells[:, None, :] + CORNERS
    nodes = (corner[..., 0] * (ny + 1) + corner[..., 1]) * (nz + 1) + corner[..., 2]
    places = (3 * nodes[..., None] + np.arange(3)).reshape(-1, 24)
    grid = np.stack(np.meshgrid(*map(range, counts + 1), indexing="ij"), axis=-1).reshape(-1, 3)
    M, K = (assembled(places, a, 3 * len(grid)) for a in brick(h))
    return M, K, *_table(grid * h, ("x", "y", "z"))


def _table(xyz, directions):
    count = len(xyz)
    return np.repeat(np.arange(count), 3), np.repeat(xyz, 3, axis=0), directions * count


def dofs_of(mesh):
    """The DofSet of a mesh."""
    return DofSet(mesh[2], mesh[4], mesh[3])
