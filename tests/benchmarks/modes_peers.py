"""One measurement in a process of its own: 24 modes of a mesh by one method, as one JSON line.

python modes_peers.py plate 181 METHOD: ours, ours_on_cholmod, default, superlu, cholmod or pardiso.
"""

import json
import resource
import sys
import time
from pathlib import Path

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spla

sys.path.insert(0, str(Path(__file__).parents[1]))
import flexplant as fx
import meshes

COUNT = 24


def peak():
    """Peak memory of this process [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def ours(mesh, times, **options):
    """CPU of the checked modes; making the model (its checks) is timed by itself."""
    from flexplant.modes import solve_modes
    from flexplant.modes import sparse_modes as counted
    from flexplant.structure import FEModel

    begin = time.process_time()
    model = FEModel(mesh[0], mesh[1], dofs=meshes.dofs_of(mesh))
    times["model"] = time.process_time() - begin
    begin = time.process_time()
    assert model.rigid_body.shape[1] in (3, 6)
    times["rigid"] = time.process_time() - begin
    below = counted.modes_below

    def timed(*args):
        start = time.process_time()
        try:
            return below(*args)
        finally:
            times["count"] = times.get("count", 0.0) + time.process_time() - start

    counted.modes_below = timed
    begin = time.process_time()
    modes = solve_modes(model, count=COUNT, **options)
    times["modes"] = time.process_time() - begin
    r = modes.n_rigid
    return modes.omega[r:] ** 2, modes.phi[:, r:]


def peer(mesh, times, factor):
    """eigsh at its defaults (tol=0, one vector at a time) on a factor of K - sigma M."""
    M, K = mesh[0], mesh[1]
    begin = time.process_time()
    sigma = -1e-9 * float(np.max(K.diagonal() / M.diagonal()))
    solve = factor(sp.csc_matrix(K - sigma * M))
    inverse = spla.LinearOperator(K.shape, matvec=solve, dtype=float)
    squares, phi = spla.eigsh(K, COUNT, M, sigma, OPinv=inverse)
    times["modes"] = time.process_time() - begin
    elastic = squares > 1e-6 * squares[-1]
    return squares[elastic], phi[:, elastic]


def default(A):
    """SciPy's default."""
    return spla.splu(A).solve


def superlu(A):
    """SuperLU in symmetric mode."""
    return spla.splu(
        A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    ).solve


def cholmod(A):
    """CHOLMOD, by the wheel of sksparse-minimal, which needs no compiler."""
    from sksparse_minimal import SparseCholesky

    A = sp.csc_matrix(A)
    A.sort_indices()
    A.indptr, A.indices = A.indptr.astype(np.int32), A.indices.astype(np.int32)
    return SparseCholesky(A).solve_A


def pardiso(A):
    """MKL PARDISO, by pypardiso: METIS, no refinement, no check that the matrix is the same."""
    from pypardiso import PyPardisoSolver

    upper, solver = sp.csr_matrix(sp.triu(A)), PyPardisoSolver(mtype=2)  # positive definite
    solver.set_iparm(1, 1)
    solver.set_iparm(2, 2)
    solver.factorize(upper)
    solver.set_phase(33)
    return lambda b: solver._call_pardiso(upper, b)


FACTORS = {"ours_on_cholmod": fx.sparse.Cholmod()}


def main(kind, n, method):
    """Measure and print."""
    mesh = meshes.plate(n) if kind == "plate" else meshes.solid(n, n, n)
    times = {}
    if method == "ours":
        squares, phi = ours(mesh, times)
    elif method in FACTORS:
        squares, phi = ours(mesh, times, factor=FACTORS[method])
    else:
        squares, phi = peer(mesh, times, globals()[method])
    memory = peak()
    M, K = mesh[0], mesh[1]
    force, mass = K @ phi, M @ phi
    left = la.norm(force - mass * squares, axis=0) / la.norm(force, axis=0)
    gram = np.abs(phi.T @ mass - np.eye(squares.size)).max()
    print(
        json.dumps(
            times
            | {
                "n": M.shape[0],
                "GB": memory,
                "residual": left.max(),
                "orthonormality": gram,
                "freq": (np.sqrt(squares) / (2 * np.pi)).tolist(),
            }
        )
    )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3])
