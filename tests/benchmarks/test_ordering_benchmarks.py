"""Nested dissection without coordinates beside METIS: entries of the factor and CPU seconds.

Run with ``-n 0 -m benchmark -s``. Entries of METIS's order are counted by symbolic elimination of
the graph of nodes, ours are those that the fronts store: leaves of up to 64 DOFs as dense squares.
Of the small matrix, which `solve_modes` takes as a dense one, the order is compared: entries of the
lower triangle, leaves of up to 32 DOFs.
"""

import time

import numpy as np
import pytest
import scipy.io
import scipy.sparse as sp

import flexplant as fx
from flexplant.sparse.ordering import dissect
from shared_data import data_file

pytestmark = pytest.mark.benchmark


def block(cells):
    return fx.solid_block(
        size=(1, 1, 1),
        elements=(cells, cells, cells),
        density=1,
        youngs_modulus=1,
        poisson_ratio=0.3,
    )


def shell():
    """A plate rolled up to a spiral: what is near in space is far through the graph."""
    flat = fx.kirchhoff_plate(
        size=(3, 1),
        thickness=0.01,
        elements=(240, 120),
        density=1,
        youngs_modulus=1,
        poisson_ratio=0.3,
    )
    x, y, _ = flat.dofs.xyz.T
    radius, turn = 0.1 + 0.02 * x, x / 0.12
    return flat.K, flat.dofs.node_index, np.c_[radius * np.cos(turn), radius * np.sin(turn), y]


def of(model):
    return model.K, model.dofs.node_index, model.dofs.xyz


def harwell_boeing():
    path = data_file("fe/hb/bcsstk11.mtx")
    if not path.exists():
        pytest.skip("needs the data of shared/data")
    K = sp.csc_array(scipy.io.mmread(path))
    return K, np.arange(K.shape[0]), None


def eliminated(graph, order, width):
    """Entries of the factor of a graph of nodes with `width` DOFs each, diagonal blocks whole."""
    n = order.size
    later = sp.csr_array(graph[order][:, order])
    width = width[order]
    touched, passed, entries = [None] * n, [[] for _ in range(n)], 0
    for k in range(n):
        own = later.indices[later.indptr[k] : later.indptr[k + 1]]
        rows = np.unique(np.concatenate([own, *(touched[c] for c in passed[k])]))
        touched[k] = rows = rows[rows > k]
        entries += int(width[k]) * int(width[k] + width[rows].sum())
        if rows.size:
            passed[rows[0]].append(k)
    return entries


def by_metis(K, nodes):
    pymetis = pytest.importorskip("pymetis")
    member = np.unique(nodes, return_inverse=True)[1]
    pattern = sp.csc_array((np.ones(K.nnz), K.indices, K.indptr), shape=K.shape)
    group = sp.csr_array((np.ones(member.size), (member, np.arange(member.size))))
    graph = sp.csr_array(group @ pattern @ group.T)
    graph.setdiag(0)
    graph.eliminate_zeros()
    begin = time.process_time()
    adjacency = pymetis.CSRAdjacency(adj_starts=graph.indptr, adjacent=graph.indices)
    order, _ = pymetis.nested_dissection(adjacency=adjacency)
    spent = time.process_time() - begin
    return eliminated(graph, np.asarray(order), np.bincount(member)), spent


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("solid, 98 304 DOFs", lambda: of(block(31))),
        ("rolled shell, 87 483 DOFs", shell),
        ("bcsstk11, 1473 DOFs", harwell_boeing),
    ],
    ids=["solid", "shell", "bcsstk11"],
)
def test_beside_metis(name, given):
    K, nodes, xyz = given()
    metis, spent = by_metis(K, nodes)
    print(f"\n{name}: METIS {metis / 1e6:.2f} M entries, {spent:.2f} s")
    for label, arguments in (
        ("coordinates", (nodes, xyz)),
        ("nodes", (nodes,)),
        ("matrix alone", ()),
    ):
        begin = time.process_time()
        small = K.shape[0] < 5000
        order = dissect(K, *arguments, **({"leaf": 32} if small else {}))
        spent = time.process_time() - begin
        found = order.n_factor
        if small:
            found -= sum((f.last - f.first) * (f.last - f.first - 1) // 2 for f in order.fronts)
        print(f"  ours, {label:<12s} {found / 1e6:.2f} M, {found / metis:.2f} of it, {spent:.2f} s")
        assert found < 1.5 * metis
