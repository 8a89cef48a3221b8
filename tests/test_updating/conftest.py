"""The paper's plate, its reductions, and small machines to update."""

import numpy as np
import pytest

from flexplant import DofSet
from flexplant.modes import solve_modes
from flexplant.reduction import DesiredDofs, ReducedModel, reduce
from flexplant.structure import FEModel, ModalDamping
from plates import PLATE, make_plate


class Plate:
    """The paper's plate with its grid of desired DOFs."""

    def __init__(self, thicker=1.0):
        self.model = make_plate(thickness=thicker * PLATE["thickness"])
        nearest = self.model.dofs.nearest
        self.z8 = nearest((0.3, 0.15, 0.0), "z")
        self.grid = [nearest((0.15 * i, 0.15 * j, 0.0), "z") for j in range(5) for i in range(5)]
        self.around = [label for i, label in enumerate(self.grid) if i != 12]

    def modes(self, zeta, attached):
        at = [self.z8] if attached else ()
        return solve_modes(self.model, count=24, damping=ModalDamping(zeta), compliance_at=at)

    def reduced(self, zeta, attached, modes=None):
        """24 modes in 24 DOFs, or with a vector at z8 in 25."""
        modes = self.modes(zeta, attached) if modes is None else modes
        return reduce(modes, DesiredDofs(self.grid if attached else self.around))


@pytest.fixture(scope="session")
def plate():
    return Plate()


@pytest.fixture(scope="session")
def thicker_plate():
    return Plate(thicker=1.01)


def line(count):
    """DOFs z of nodes 1, 2, ... on a line; a free chain has no motion of theirs in common but z."""
    return DofSet(
        np.arange(1, count + 1), ["z"] * count, [[float(i), 0.0, 0.0] for i in range(count)]
    )


def springs(count, links):
    """Stiffness of springs (i, j, k) between DOFs from 0; j None is the ground."""
    K = np.zeros((count, count))
    for i, j, k in links:
        row = np.zeros(count)
        row[i] = 1.0
        if j is not None:
            row[j] = -1.0
        K += k * np.outer(row, row)
    return K


@pytest.fixture(scope="session")
def make():
    """Return a function that makes a held or free mass-spring model."""

    def make(masses, links, D=None, beta=0.0):
        count = len(masses)
        K = springs(count, links)
        D = beta * K if D is None else np.asarray(D)
        return FEModel(np.diag(np.asarray(masses, dtype=float)), K, D, dofs=line(count))

    return make


@pytest.fixture(scope="session")
def as_reduced():
    """Return a function that wraps any FEModel as a ReducedModel of all its DOFs."""

    def wrap(model):
        n = model.n_dof
        return ReducedModel(
            model.M, model.D, model.K, np.eye(n), model.dofs, model.dofs, model.rigid_body, "all"
        )

    return wrap
