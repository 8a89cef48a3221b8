"""Robust performance: mu of a loop with the block from its weighted z back to w."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...errors import ModelError
from ...parallel import Progress, one_thread
from ...plant.uncertainty.uncertain_plants import UncertainPlant
from .mu_bounds import INTERVALS, Cover, MuBounds, mu
from .uncertain_loops import UncertainLoop, uncertain_loop


def performance_bound(loop: UncertainLoop) -> tuple[float, float]:
    """Return mu of robust performance from above, real Deltas real, and where it is [Hz]."""
    blocks = [*loop.blocks, loop.performance]
    found = Cover(loop.system, blocks, heights=loop.heights).run()
    return float(np.sqrt(found.level)), float(loop.freq(found.omega))


@one_thread()
def robust_performance(
    uncertain: UncertainPlant[Any],
    *blocks: Any,
    w: Any,
    z: Any,
    rng: Any = 0,
    progress: bool | None = None,
) -> MuBounds:
    """Return mu of robust performance, which measures stability and weighted gain together.

    A machine is the plant with one choice of values within the uncertainty. If mu is below 1, every
    machine is stable and has a weighted gain below 1 from w to z. If it is 2, machines with half
    the uncertainty are stable and have a weighted gain of at most 2. `design_mu` minimises this
    number.

    Parameters
    ----------
    uncertain, *blocks : as for `robust_stability`
    w, z : sequence of str, or mapping {name: weight}
        Channels of performance and their weights.
    rng : int, SeedSequence, Generator or None
        Random generator of the search for the lower bound, or its seed.
    progress : as for `robust_stability`, optional

    Returns
    -------
    MuBounds
        Bounds of mu. `lower` is 0 for a plant with neglected modes, for which no lower bound is
        computed.

    Raises
    ------
    AssumptionError
        When the nominal loop is not stable.
    ModelError, LabelError, SolverError
        As for `worst_case_gain`.

    References
    ----------
    [ZhouDoyleGlover1996]_, section 11.3; [Skogestad2005]_, section 8.10.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses(rate=None)
    >>> lead = -1e3 * fx.lti.tf([0.05, 1.0], [0.002, 1.0]).replace(inputs=["y1"], outputs=["u1"])
    >>> actuator = fx.plant.UnmodelledDynamics(0.1, at="u1")
    >>> found = fx.synthesis.robust_performance(
    ...     plant.uncertain(actuator), lead, w=["amp"], z={"die:x": 100.0})
    >>> found.lower <= found.upper
    True
    """
    if not w or not z:
        raise ModelError("name the channels of performance: w={'d': 1.0}, z={'tip:x': weight}.")
    loop = uncertain_loop(uncertain, blocks, w=w, z=z)
    with Progress(None, INTERVALS, progress=progress):
        if loop.neglected is not None:
            upper, freq = performance_bound(loop)
            shape = sum(b.w for b in loop.blocks), sum(b.z for b in loop.blocks)
            return MuBounds(upper, 0.0, freq, np.zeros(shape, dtype=np.complex128))
        found = mu(loop.system, [*loop.blocks, loop.performance], rng=rng)
    return found.replace(
        freq=float(loop.freq(2 * np.pi * found.freq)),
        frequencies=loop.freq(2 * np.pi * found.frequencies),
    )
