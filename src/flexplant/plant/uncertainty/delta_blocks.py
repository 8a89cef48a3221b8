"""The blocks of an uncertainty: their kinds, their channels and random values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from ...arrays import flag, whole
from ...errors import ModelError, ShapeError, short
from ...lti.blocks_of_states import block_matrix
from ...lti.conversions import tustin
from ...lti.statespace import StateSpace, as_statespace
from ...store import Value, checked

#: random Deltas turn their phase between these multiples of the slowest and the fastest pole
_PHASES = (0.1, 10.0)


@dataclass(frozen=True, eq=False)
class RepeatedScalar(Value):
    """An uncertain block ``w = delta z``. The same number delta multiplies all its channels.

    Parameters
    ----------
    size : int
        Number of channels of z, which is also that of w.
    real : bool
        Whether delta is a real number (a parameter). Otherwise it is a complex number.
    name : str
        Name of the uncertainty in results and messages.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.RepeatedScalar(2).w
    2
    """

    size: int = field(default=1, metadata=checked(whole))
    real: bool = field(default=True, metadata=checked(flag))
    name: str = ""

    @property
    def w(self) -> int:
        """Number of channels of w."""
        return self.size

    @property
    def z(self) -> int:
        """Number of channels of z."""
        return self.size


@dataclass(frozen=True, eq=False)
class FullBlock(Value):
    """An uncertain block ``w = Delta z`` for unknown dynamics. Delta is any complex matrix.

    Parameters
    ----------
    w, z : int
        Number w of the outputs of Delta, which drive the plant, and number z of its inputs.
    name : str
        Name of the uncertainty in results and messages.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.FullBlock(2, 3)
    FullBlock(w=2, z=3, name='')
    """

    w: int = field(default=1, metadata=checked(whole))
    z: int = field(default=1, metadata=checked(whole))
    name: str = ""


Block: TypeAlias = RepeatedScalar | FullBlock


def filled_blocks(blocks: Any, w: int, z: int) -> tuple[Block, ...]:
    """Return blocks that fill w outputs and z inputs of an uncertainty."""
    if not isinstance(blocks, Sequence) or not blocks or any(
        not isinstance(block, RepeatedScalar | FullBlock) for block in blocks
    ):  # fmt: skip
        raise ModelError(
            "blocks must be a list of synthesis.RepeatedScalar(...) and "
            "synthesis.FullBlock(...), got "
            f"{short(blocks)}. Pass one for each uncertainty, in the order of the channels."
        )
    found = sum(block.w for block in blocks), sum(block.z for block in blocks)
    if found != (w, z):
        raise ShapeError(
            f"the blocks have {found[0]} outputs and {found[1]} inputs in all, M has {w} inputs "
            f"and {z} outputs: w = Delta z goes into M. List the blocks in the order of channels."
        )
    return tuple(blocks)


def channels_of(block: Block) -> tuple[list[str], list[str]]:
    """Return the names of the inputs `name:w` and outputs `name:z` by which a block acts."""
    sides = []
    for side in "wz":
        count = getattr(block, side)
        numbers = [""] if count == 1 else [f":{i}" for i in range(1, count + 1)]
        sides.append([f"{block.name}{number}:{side}" for number in numbers])
    return sides[0], sides[1]


def delta_system(block: Block, given: Any, dt: float) -> StateSpace:
    """Return a number, matrix or system as the Delta of a block, between its channels."""
    if isinstance(block, RepeatedScalar) and np.ndim(given) == 0 and not hasattr(given, "A"):
        given = np.eye(block.size) * given
    found = as_statespace(np.atleast_2d(given) if isinstance(given, int | float) else given)
    if isinstance(block, RepeatedScalar) and found.D.shape == (1, 1):
        found = _repeated(found, block.size)
    if found.D.shape != (block.w, block.z):
        raise ShapeError(
            f"the Delta of {block.name!r} has {block.w} outputs and {block.z} inputs, got "
            f"{found!r}. Pass a number, a matrix or a system of this size."
        )
    if not found.n_states:
        found = found.replace(dt=dt)
    elif dt and not found.dt:
        found = tustin(found, 1.0 / dt)
    ends, starts = channels_of(block)
    states = [f"{block.name}|{i}" for i in range(1, found.n_states + 1)]
    return found.replace(inputs=starts, outputs=ends, states=states, units={}, blocks=None)


def _repeated(g: StateSpace, count: int) -> StateSpace:
    """Return a block diagonal system of copies."""
    A, B, C, D = (block_matrix([part] * count) for part in (g.A, g.B, g.C, g.D))
    return StateSpace(A, B, C, D, g.dt)


def drawn_delta(block: Block, rng: np.random.Generator, poles: Any, size: float) -> StateSpace:
    """Return a random stable Delta of a norm: a matrix of rank one times an all-pass filter."""
    if isinstance(block, RepeatedScalar) and block.real:
        return as_statespace(np.eye(block.size) * size * rng.choice([-1.0, 1.0]))
    speeds = np.abs(poles[np.abs(poles) > 0])
    low, high = (speeds.min(), speeds.max()) if speeds.size else (1.0, 1.0)
    p = float(np.exp(rng.uniform(np.log(_PHASES[0] * low), np.log(_PHASES[1] * high))))
    sign = float(rng.choice([-1.0, 1.0]))
    # sign size (s - p) / (s + p)
    B, C = np.array([[np.sqrt(2 * p * size)]]), np.array([[-sign * np.sqrt(2 * p * size)]])
    one = StateSpace([[-p]], B, C, [[sign * size]])
    if isinstance(block, RepeatedScalar):
        return _repeated(one, block.size)
    out, into = (rng.standard_normal(count) for count in (block.w, block.z))
    out, into = out[:, None] / np.linalg.norm(out), into[None] / np.linalg.norm(into)
    return StateSpace(one.A, one.B @ into, out @ one.C, out @ one.D @ into)
