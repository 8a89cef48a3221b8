"""One's own M-Delta structure: a labelled system and the blocks that close it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ...errors import ModelError, counted
from ...lti.conversions import bilinear
from ...lti.statespace import StateSpace, System, as_statespace
from ...plant import StandardPlant
from ...plant.partitioned import Partition
from ...plant.uncertainty.delta import Uncertainty
from ...plant.uncertainty.delta_blocks import Block, channels_of, filled_blocks
from ...plant.uncertainty.uncertain_plants import UncertainPlant, uncertain_plant
from ...store import Value


@dataclass(frozen=True, eq=False)
class BlockStructure(Uncertainty):
    """The uncertainty of a system M with blocks Delta: the result of `uncertain_system`.

    Parameters
    ----------
    system : StateSpace
        System M of the equation ``[z_Delta; z; y] = M [w_Delta; w; u]``.
    structure : sequence of RepeatedScalar and FullBlock
        Blocks of ``w_Delta = Delta z_Delta``, in the order of the channels.
    """

    system: StateSpace
    structure: tuple[Block, ...]

    def delta_blocks(self, plant: Partition) -> tuple[Block, ...]:
        """Return the blocks of `structure`."""
        return self.structure

    def with_blocks(self, plant: Partition, system: StateSpace) -> StateSpace:
        """Return M with the channels of Delta first, then the channels of the given system.

        If M is sampled and the given system is continuous, M is first mapped to continuous time by
        the bilinear transformation.
        """
        M = self.system
        if plant.dt != M.dt or system.n_states != M.n_states:
            raise ModelError(
                f"the blocks are those of {M!r}, the plant is {plant!r}. Sample or reduce M, and "
                "call synthesis.uncertain_system again."
            )
        if M.dt and not system.dt:
            M = bilinear(M, 1.0 / M.dt)
        k, p = (sum(getattr(block, side) for block in self.structure) for side in "wz")
        ends = [channels_of(block) for block in self.structure]
        into, out = ([name for one in ends for name in one[side]] for side in (0, 1))
        named = M.replace(inputs=[*into, *M.inputs[k:]], outputs=[*out, *M.outputs[p:]], units={})
        return named.select([*out, *system.outputs], [*into, *system.inputs])


def uncertain_system(
    M: System, blocks: Sequence[Block], *, u: Any = (), y: Any = ()
) -> UncertainPlant[StandardPlant]:
    """Return a system with Deltas between its first outputs and its first inputs.

    ::

        z_Delta <---|     |<--- w_Delta = Delta z_Delta,   Delta = diag(blocks)
              z <---|  M  |<--- w
              y <---|     |<--- u

    A Delta is an unknown number or matrix of size at most 1. The result can be passed to
    `robust_stability`, `worst_case_gain`, `robust_performance` and `design_mu`. Its method
    ``.lft(values)`` inserts values of some Deltas, and ``.machines.drawn(count)`` draws systems at
    random. If u and y are not given, M is a loop that is already closed. No controller is then
    needed: ``robust_stability(uncertain)``.

    Parameters
    ----------
    M : StateSpace or control.StateSpace
        System with named channels, continuous or sampled. It includes the weights of the Deltas.
    blocks : sequence of RepeatedScalar and FullBlock
        Blocks in the order of the channels. Blocks without a name are called `delta1`, `delta2` and
        so on.
    u, y : sequences of str
        Inputs that the controller drives and outputs that it reads.

    Returns
    -------
    UncertainPlant
        Uncertain plant. Its nominal plant is M with Delta = 0.

    Raises
    ------
    ModelError, ShapeError
        When `blocks` is not a list of blocks, or the sizes of the blocks do not match the channels
        of M.
    LabelError
        When u or y contain names that are not channels of M, or that are channels of Deltas.

    References
    ----------
    [ZhouDoyleGlover1996]_, section 10.1.

    Examples
    --------
    A spring of stiffness 1 +- 0.5 holds a mass; the Delta of the stiffness is its relative error.

    >>> import flexplant as fx
    >>> M = fx.StateSpace([[0, 1], [-1, 0]], [[0, 0, 0], [-1, 1, 1]], [[0.5, 0], [1, 0], [1, 0]],
    ...     0, inputs=["dk", "f", "u"], outputs=["k", "x", "position"])
    >>> spring = fx.synthesis.uncertain_system(
    ...     M, [fx.synthesis.RepeatedScalar(name="stiffness")], u=["u"], y=["position"])
    >>> damper = fx.lti.tf([-1.0, 0.0], [0.1, 1.0]).replace(inputs=["position"], outputs=["u"])
    >>> fx.synthesis.robust_stability(spring, damper).is_robust
    True
    """
    g = as_statespace(M)
    found = blocks if isinstance(blocks, Sequence) else ()
    listed = [b for b in found if isinstance(b, Value)]
    if len(listed) == len(found):
        listed = [b if b.name else b.replace(name=f"delta{i}") for i, b in enumerate(listed, 1)]
    k, p = sum(b.w for b in listed), sum(b.z for b in listed)
    if k > len(g.inputs) or p > len(g.outputs):
        raise ModelError(
            f"the blocks have {counted(k, 'output')} and {counted(p, 'input')}, M has "
            f"{counted(len(g.inputs), 'input')} and {counted(len(g.outputs), 'output')}. The first "
            "channels of M are those of Deltas, then follow w and u, z and y."
        )
    structure = filled_blocks(listed or blocks, k, p)
    rest = g.select(g.outputs[p:], g.inputs[k:])
    plant = StandardPlant.from_statespace(rest, u=u, y=y)
    ordered = g.select(
        [*g.outputs[:p], *plant.system.outputs], [*g.inputs[:k], *plant.system.inputs]
    )
    return uncertain_plant(plant, [BlockStructure(ordered, structure)])
