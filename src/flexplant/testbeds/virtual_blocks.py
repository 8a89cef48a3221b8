"""The stage on magnets: a free block in polynomials of high order, with hidden differences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.polynomial import legendre

from ..arrays import FloatArray, positive, positive_array, whole
from ..labels import node_dofs
from ..modes import solve_modes
from ..plant import GroundSpring, suspend
from ..reduction import ModalTruncation, reduce
from ..structure import FEModel, ModalDamping, PointMass
from .virtual_machine import (
    LATENCY,
    SECOND,
    SPREAD,
    STEP,
    PolynomialShape,
    WaferStage,
    lobatto,
    waves,
)

#: an aluminium block
BLOCK: Mapping[str, Any] = {
    "size": (0.4, 0.3, 0.05),
    "density": 2700.0,
    "youngs_modulus": 70e9,
    "poisson_ratio": 0.33,
}
#: N/m of the magnets at each corner as drawn, and by what share those of a machine differ
PULL, OFF = {"x": -2e3, "y": -2e3, "z": -6e3}, 0.1
#: modes of the truth: up to four times the highest frequency that 10 kHz shows
MODES = 120


def magnet_stage(
    *,
    size: Sequence[float] = BLOCK["size"],
    damping: float = 0.005,
    added_mass: float = 0.3,
    rate: float = 10e3,
    delay: float | None = None,
    individual: int = 1,
) -> WaferStage:
    """Return a virtual machine that floats on magnets, with a mass that no drawing shows.

    The machine is an elastic block. It is modelled by polynomial shape functions (Ritz method) of
    such a high order that its frequencies are converged. They therefore differ from those of any
    mesh of bricks. Magnets at its corners attract, so that its stiffness is ``K - sum_s |k_s| r_s'
    r_s`` (k_s is the stiffness of magnet s, and the row r_s gives the motion there). The six
    rigid-body motions grow until a loop holds them. The stiffnesses of the magnets differ from the
    drawn ones by up to 10 %. A mass is added on the bottom at (3/4, 1/4) of its sides, and another
    of up to 0.1 kg at a random place. The stiffness is scattered over the block by 0.3 % and the
    damping over its modes by 30 %. The sensors have steps of 0.05 nm, and the delay is not a whole
    number of samples.

    Parameters
    ----------
    size : (float, float, float) [m]
        Sides of the block along x, y and z, where it is thin.
    damping, added_mass, rate, delay, individual
        As for `wafer_stage`; `individual` determines the magnets too.

    Returns
    -------
    WaferStage
        Machine whose `drawing` holds the arguments of `solid_block` and whose `magnets` are the
        drawn GroundSprings. Modes 1 to 6 are the rigid-body motions; `poles` are those of mode 7
        and above.

    Raises
    ------
    ModelError
        When a value is out of range.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.testbeds.magnet_stage().poles([7, 8]).freq.round(0)
    array([1229., 1543.])
    """
    mass = positive(added_mass, "added_mass", zero=True)
    late = positive(LATENCY if delay is None else delay, "delay", zero=True)
    sides = tuple(positive_array(size, "size", (3,)).tolist())
    drawing = {**BLOCK, "size": sides}
    random = np.random.default_rng([whole(individual, "individual", minimum=0), 32])
    block = ritz_block(stiffer=waves(random, sides), **drawing)
    places = (0.75 * sides[0], 0.25 * sides[1], 0.0), (*(sides[:2] * random.random(2)), 0.0)
    loads = [
        PointMass(at, size)
        for at, size in zip(places, (mass, SECOND * random.random()), strict=True)
        if size
    ]
    zeta = positive(damping, "damping", zero=True) * np.exp(SPREAD * random.normal(size=MODES))
    modes = solve_modes(block.with_parts(loads), count=MODES, damping=ModalDamping(zeta))
    drawn = tuple(
        GroundSpring((x, y, 0.5 * sides[2]), pull, direction=along)
        for x in (0.0, sides[0])
        for y in (0.0, sides[1])
        for along, pull in PULL.items()
    )
    own = [
        spring.replace(stiffness=spring.stiffness * (1.0 + OFF * random.uniform(-1.0, 1.0)))
        for spring in drawn
    ]
    truth = suspend(reduce(modes, ModalTruncation(MODES)), own)
    return WaferStage(truth, positive(rate, "rate"), late, STEP, drawing, drawn)


#: orders along x, y and z of a block that is thin in z: a wave of bending has few half waves in a
#: thickness, and twelve elastic frequencies change by less than 1e-4 with one order more of each
ORDERS = (9, 8, 3)


def ritz_block(
    *,
    size: Sequence[float],
    density: float,
    youngs_modulus: float,
    poisson_ratio: float,
    orders: tuple[int, int, int] = ORDERS,
    stiffer: Callable[[FloatArray, FloatArray], FloatArray] | None = None,
) -> FEModel:
    """Return a free block of linear elasticity by the method of Ritz, dense."""
    # of the energies `rho u_t . u_t / 2` and `lambda (tr e)^2 / 2 + mu e : e` of the strains
    # `e = (grad u + grad u') / 2` integrals are exact; free faces meet their conditions in the
    # limit. `stiffer` is a function of (x, y): a factor of E there
    lengths = tuple(float(length) for length in size)
    shape = PolynomialShape(lengths, tuple(orders))
    gauss = [legendre.leggauss(order + 2) for order in orders]
    weight = np.einsum("r,q,p->rqp", *(w for _, w in reversed(gauss))).reshape(-1)
    weight = weight * np.prod(lengths) / 8.0
    grid = [0.5 * length * (1.0 + at) for (at, _), length in zip(gauss, lengths, strict=True)]
    z, y, x = (one.reshape(-1) for one in np.meshgrid(*reversed(grid), indexing="ij"))
    share = np.ones(z.size) if stiffer is None else np.asarray(stiffer(x, y))
    places = np.column_stack([x, y, z])
    N, *slopes = (shape.polynomials(places, axis) for axis in (None, 0, 1, 2))
    first = youngs_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
    shear = youngs_modulus / (2.0 * (1.0 + poisson_ratio))
    each = [[one.T @ ((weight * share)[:, None] * other) for other in slopes] for one in slopes]
    n = N.shape[1]
    K, M = np.zeros((n, 3, n, 3)), np.zeros((n, 3, n, 3))
    mass = N.T @ ((density * weight)[:, None] * N)
    for i in range(3):
        M[:, i, :, i] = mass
        K[:, i, :, i] += shear * sum(each[k][k] for k in range(3))
        for j in range(3):
            K[:, i, :, j] += first * each[i][j] + shear * each[j][i]
    nodes = [0.5 * a * (1.0 + lobatto(order)) for order, a in zip(orders, lengths, strict=True)]
    z, y, x = (one.reshape(-1) for one in np.meshgrid(*reversed(nodes), indexing="ij"))
    dofs = node_dofs(np.arange(1, n + 1), ("x", "y", "z"), np.column_stack([x, y, z]), shape)
    M, K = (0.5 * (one + one.T) for one in (M.reshape(3 * n, -1), K.reshape(3 * n, -1)))
    return FEModel(M, K, dofs=dofs, name="block by Ritz")
