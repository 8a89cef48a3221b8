"""Modes followed by shape, clusters by subspace and order."""

import numpy as np

from flexplant.modes.matching import pair


def turned(degrees):
    a = np.deg2rad(degrees)
    return np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])


def test_distant_modes_that_swap_are_followed():
    X = np.eye(4)
    poles = 1j * np.array([10.0, 11.0, 20.0, 30.0])
    assert pair(poles, X, X[:, [1, 0, 3, 2]]).tolist() == [1, 0, 3, 2]


def test_foreign_shapes_of_a_cluster_may_cross():
    X = np.eye(3)
    poles = 1j * np.array([10.0, 10.1, 20.0])
    assert pair(poles, X, X[:, [1, 0, 2]]).tolist() == [1, 0, 2]


def test_coupled_shapes_of_a_cluster_keep_their_order():
    poles = 1j * np.array([10.0, 10.1, 20.0])
    X = np.eye(3)
    for degrees in (20, 44, 46, 70, 88, 120):
        new = X.copy()
        new[:2, :2] = turned(degrees)
        assert pair(poles, X, new).tolist() == [0, 1, 2]
    # without the cluster the larger MAC would decide
    apart = 1j * np.array([10.0, 11.0, 20.0])
    new[:2, :2] = turned(70)
    assert pair(apart, X, new).tolist() == [1, 0, 2]


def test_a_cluster_is_found_again_where_another_mode_has_moved_into_it():
    # 2 and 3 are a cluster and mix; 4 comes down below both
    poles = 1j * np.array([5.0, 10.0, 10.1, 20.0])
    X = np.eye(4)
    new = np.eye(4)[:, [0, 3, 1, 2]]
    new[1:3, 2:4] = turned(60)
    assert pair(poles, X, new).tolist() == [0, 2, 3, 1]


def test_a_cluster_and_a_foreign_mode_inside_it():
    # 1 and 3 mix, 2 has a symmetry of its own and moves through
    poles = 1j * np.array([10.0, 10.05, 10.1])
    X = np.eye(3)
    new = np.zeros((3, 3))
    new[np.ix_([0, 2], [0, 1])] = turned(60)
    new[1, 2] = 1.0
    assert pair(poles, X, new).tolist() == [0, 2, 1]


def test_modes_that_vanish_have_no_successor():
    poles = 1j * np.array([10.0, 11.0, 20.0])
    X = np.eye(3)
    assert pair(poles, X, X[:, [0, 2]]).tolist() == [0, -1, 1]
    assert pair(poles[:2], X[:, :2], X[:, [2, 1, 0]]).tolist() == [2, 1]


def test_a_cluster_is_found_by_its_subspace_not_by_single_shapes():
    # the first new shape is nearer to one old shape than any other is, but not to both together
    poles = 1j * np.array([10.0, 10.1])
    leak = np.sqrt(1 - 2 * 0.3)
    new = np.array(
        [
            [np.sqrt(0.35), np.sqrt(0.3), np.sqrt(0.3)],
            [0.0, np.sqrt(0.3), -np.sqrt(0.3)],
            [np.sqrt(0.65), 0.0, 0.0],
            [0.0, leak, leak],
        ]
    )
    assert pair(poles, np.eye(4)[:, :2], new).tolist() == [1, 2]
