"""Dynamics that a model does not have, bounded over frequency by a weight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg as la

from ...arrays import FloatArray, name_list
from ...errors import ModelError, require_known, short
from ...lti.conversions import bilinear, tustin
from ...lti.riccati import filter_care
from ...lti.statespace import StateSpace, single_channel
from ..building import at_rate
from ..partitioned import Partition
from .delta import Uncertainty
from .delta_blocks import Block, FullBlock, channels_of

#: forms that a caller may name; the others follow from the channels
Form = Literal["inverse", "coprime"]


#: A, B, C and D
_Matrices: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


class _Ends(NamedTuple):
    """What the channels of a block move, (n + p, w), and what they read of x, u and w_Delta."""

    left: FloatArray
    right: FloatArray
    feed: FloatArray


@dataclass(frozen=True, eq=False)
class UnmodelledDynamics(Uncertainty):
    """Dynamics that a plant lacks: a stable Delta of gain at most 1, times a weight W(s).

    ::

        at inputs       y = G (I + Delta W) u
        at outputs      y = (I + W Delta) G u
        at both         y = (G + W Delta) u
        "inverse"       u or y is (I - W Delta)^-1 of what it was
        "coprime"       y = (M + W Delta_M)^-1 (N + W Delta_N) u,  G = M^-1 N normalised

    In the last form M and N are the normalised coprime factors of G. The Delta is one full matrix
    of dynamics over all channels that are named, so that it may couple them. For dynamics that are
    independent of each other, pass several values:
    ``plant.uncertain(UnmodelledDynamics(W, at="u1"), UnmodelledDynamics(W, at="u2"))``.

    Parameters
    ----------
    weight : number or system of one input and one output
        Weight W, a stable system, continuous or sampled at the plant's rate. Its gain at each
        frequency is the largest relative error there. In the additive form it is the largest
        absolute error [unit of y over that of u].
    at : str or sequence of str
        Actuators, sensors, or both.
    form : {"inverse", "coprime"}, optional
        Form of the uncertainty. By default it is multiplicative if `at` names only actuators or
        only sensors, and additive if it names both. "inverse" needs channels of one side. "coprime"
        takes all u and y and no `at`; the units must give signals of similar size (see
        `ncf_margin`).
    name : str, optional
        Name of the Delta; by default it follows from the channels, such as `u1:dynamics`.

    Raises
    ------
    LabelError, ModelError
        When a channel is not an actuator or sensor, the weight is unstable or of another sampling
        time, or the form does not fit the channels.

    References
    ----------
    [Skogestad2005]_, sections 8.2 and 8.6; [McFarlaneGlover1992]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> weight = fx.lti.tf([1.0, 20.0], [0.5, 100.0])  # 20 % at rest, 200 % above 200 rad/s
    >>> plant = fx.testbeds.three_masses()
    >>> plant.uncertain(fx.plant.UnmodelledDynamics(weight, at="u1"), frequency=0.005)
    <UncertainPlant: 2 real Deltas at 2 std
      mode2:freq +- 0.5 %
      mode3:freq +- 0.5 %
      u1:dynamics, a block of 1 x 1>
    """

    weight: Any
    at: Any = ()
    form: Form | None = None
    name: str = ""

    def __post_init__(self) -> None:
        weight = single_channel(self.weight, "the weight")
        if not weight.is_stable:
            raise ModelError(
                f"the weight {weight!r} is unstable: it bounds an error at each frequency. Take a "
                "stable one; a weight with an integrator bounds nothing at 0 Hz."
            )
        if self.form not in (None, "inverse", "coprime"):
            raise ModelError(
                f"form must be 'inverse', 'coprime' or left out, got {short(self.form)}: "
                "multiplicative and additive follow from the channels that `at` names."
            )
        self._set(weight=weight, at=tuple(name_list(self.at, "at")))
        if bool(self.at) == (self.form == "coprime"):
            raise ModelError(
                "name the actuators or sensors, at='u1' or at=['u1', 'y1']; form='coprime' is of "
                "all u and y, and takes no `at`."
            )

    def delta_blocks(self, plant: Partition) -> list[Block]:
        """Return the Delta as one block, a full matrix of dynamics."""
        u, y = self._sides(plant)
        if self.form == "coprime":
            return [FullBlock(len(y), len(u) + len(y), name=self.name or "coprime")]
        name = self.name or "+".join(self.at) + ":dynamics"
        return [FullBlock(len(y or u), len(u or y), name=name)]

    def with_blocks(self, plant: Partition, system: StateSpace) -> StateSpace:
        """Return a system of the plant whose first channels are those of the Delta."""
        if system.dt:  # by its bilinear image, in which a block has the same gain
            image = self.with_blocks(plant, bilinear(system, 1.0 / system.dt))
            return tustin(image, 1.0 / system.dt)
        (block,) = self.delta_blocks(plant)
        u, y = self._sides(plant)
        ends = _of_factors(system, u, y) if self.form == "coprime" else _of_channels(system, u, y)
        if self.form == "inverse":
            ends.feed[:] = np.eye(block.w)
        into, out = channels_of(block)
        n = system.n_states
        opened = StateSpace(
            system.A,
            np.hstack([ends.left[:n], system.B]),
            np.vstack([ends.right[:, :n], system.C]),
            np.block([[ends.feed, ends.right[:, n:]], [ends.left[n:], system.D]]),
            inputs=[*into, *system.inputs], outputs=[*out, *system.outputs],
            states=system.states, name=system.name,
        )  # fmt: skip
        weight = at_rate(self.weight, block.name, plant.dt) if self.weight.dt else self.weight
        if weight.dt and weight.n_states:
            weight = bilinear(weight, 1.0 / weight.dt)
        at_commands = not y and self.form is None
        count = block.z if at_commands else block.w
        return _weighted(opened, count, weight.replace(dt=0.0), block.name, at_commands)

    def _sides(self, plant: Partition) -> tuple[list[str], list[str]]:
        """Return the actuators and the sensors that it is of."""
        sensors = [name for name in plant.y if name not in plant.w]
        if self.form == "coprime":
            return list(plant.u), sensors
        require_known("actuator or sensor", self.at, (*plant.u, *sensors))
        u, y = ([n for n in self.at if n in side] for side in (plant.u, sensors))
        if self.form == "inverse" and u and y:
            raise ModelError(
                f"the inverse form is of one side, got {short(self.at)}. Name actuators or sensors."
            )
        return u, y


def _of_channels(g: StateSpace, u: list[str], y: list[str]) -> _Ends:
    """Return the ends of a Delta from actuators, or else sensors, to sensors, or else actuators."""
    n, (p, m) = g.n_states, g.D.shape
    left, right = np.zeros((n + p, len(y or u))), np.zeros((len(u or y), n + m))
    if y:
        left[[n + g.outputs.index(name) for name in y], range(len(y))] = 1.0
    else:
        columns = g.input_index(u)
        left[:] = np.vstack([g.B[:, columns], g.D[:, columns]])
        efforts = [
            n + g.outputs.index(f"{one}:effort") for one in u if f"{one}:effort" in g.outputs
        ]
        left[efforts] = 0.0  # the command itself
    if u:
        right[range(len(u)), [n + g.inputs.index(name) for name in u]] = 1.0
    else:
        rows = g.output_index(y)
        right[:] = np.hstack([g.C[rows], g.D[rows]])
        noises = [n + g.inputs.index(f"{one}:noise") for one in y if f"{one}:noise" in g.inputs]
        right[:, noises] = 0.0  # noise arises behind the dynamics
    return _Ends(left, right, np.zeros((len(right), left.shape[1])))


def _of_factors(g: StateSpace, u: list[str], y: list[str]) -> _Ends:
    """Return the ends of a Delta of the normalised left coprime factors of u -> y."""
    part = g.select(y, u)
    Q, R, S = part.B @ part.B.T, np.eye(len(y)) + part.D @ part.D.T, part.B @ part.D.T
    H = filter_care(part.A, part.C, Q=Q, R=R, S=S).gain
    # M^-1 = I + C (sI - A)^-1 H takes Delta to y, N^-1 of normalised factors has R^1/2 as unit
    root = la.sqrtm(R).real
    n, (p, m) = g.n_states, g.D.shape
    rows = g.output_index(y)
    left = np.zeros((n + p, len(y)))
    left[:n], left[[n + int(row) for row in rows]] = H @ root, root
    right, feed = np.zeros((len(u) + len(y), n + m)), np.zeros((len(u) + len(y), len(y)))
    right[range(len(u)), n + g.input_index(u)] = 1.0
    right[len(u) :], feed[len(u) :] = np.hstack([g.C[rows], g.D[rows]]), root
    noises = [n + g.inputs.index(f"{one}:noise") for one in y if f"{one}:noise" in g.inputs]
    right[len(u) :, noises] = 0.0
    return _Ends(left, right, feed)


def _weighted(
    g: StateSpace, count: int, weight: StateSpace, name: str, outputs: bool
) -> StateSpace:
    """Return a system with a weight on each of its first inputs, or outputs, its states last."""
    parts, own = (g.A, g.B, g.C, g.D), (weight.A, weight.B, weight.C, weight.D)
    if outputs:
        parts = _transposed(_with_inputs_weighted(_transposed(parts), count, _transposed(own)))
    else:
        parts = _with_inputs_weighted(parts, count, own)
    more = [f"{name}:weight:{i}" for i in range(1, weight.n_states * count + 1)]
    return StateSpace(
        *parts, inputs=g.inputs, outputs=g.outputs, states=[*g.states, *more], name=g.name
    )


def _with_inputs_weighted(g: _Matrices, count: int, weight: _Matrices) -> _Matrices:
    A, B, C, D = (np.kron(np.eye(count), part) for part in weight)
    first, rest, direct = g[1][:, :count], g[1][:, count:], g[3][:, :count]
    n = len(A)
    return (
        np.block([[g[0], first @ C], [np.zeros((n, len(g[0]))), A]]),
        np.block([[first @ D, rest], [B, np.zeros((n, rest.shape[1]))]]),
        np.hstack([g[2], direct @ C]),
        np.hstack([direct @ D, g[3][:, count:]]),
    )


def _transposed(g: _Matrices) -> _Matrices:
    return g[0].T, g[2].T, g[1].T, g[3].T
