"""Uncertain plants: the covariance of a fit as real Deltas on frequency and damping of modes."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal

import numpy as np
import scipy.sparse as sp

from ...checks import MOST_DRAWS, FloatArray, Value, generator, mapping, number, whole
from ...errors import FlexplantWarning, ModelError, counted, require_known
from ...lti.statespace import StateSpace, as_statespace
from ...sparse.symmetric import dense, orthonormalised
from ...updating import UpdateResult
from ...updating.parameters import Parameter
from ..building import P, rebuilt, sampled
from ..partition import Partition, require_plain
from ..port import ForcePort
from ..realisation import MODAL, ModalRealisation, plant_modes
from .neglected import NeglectedModes


@dataclass(frozen=True, eq=False)
class Delta(Value):
    """One real uncertainty, ``w = delta z`` with ``|delta| <= 1``.

    Parameters
    ----------
    name : str
        Of the channels: `mode6:freq` has the input `mode6:freq:w` and the output `mode6:freq:z`.
    mode : int
        Number of the mode, from 1, rigid-body modes included; 0 of a parameter.
    kind : {"freq", "damping", "shape", "parameter", "gain", "delay"}
        Stiffness ``omega^2 (1 + scale delta)``, damping ``2 zeta omega (1 + scale delta)`` or shape
        ``phi + scale delta along`` of a mode; a parameter, its value plus scale delta; the gain
        ``1 + scale delta`` of an actuator or sensor, or the delay of all actuators.
    scale : float
        Change at delta = 1: relative, of a parameter in its own unit, of the delay in samples.
    along : (n,) array, optional
        Of a shape: as long as the shape, over the DOFs of the plant's modes.

    Examples
    --------
    >>> import flexplant as fx
    >>> one = fx.testbeds.three_masses().uncertain(frequency=0.01).deltas[0]
    >>> one.name, one.scale  # of the stiffness
    ('mode2:freq', 0.02)
    """

    name: str
    mode: int
    kind: Literal["freq", "damping", "shape", "parameter", "gain", "delay"]
    scale: float
    along: FloatArray | None = None


def modal_realisation(plant: Partition) -> ModalRealisation:
    """Return the modes of a plant, each of which has its own frequency and damping."""
    require_plain(plant, "uncertain modes are those of a structure")
    realisation = plant.assembled.realisation
    if plant.form != MODAL:
        raise ModelError(
            f"the modes of this plant are coupled by damping ({plant.form}): frequency and "
            "damping of one mode are not its own, so that no Delta belongs to it. Deltas on the "
            "parameters of a fit do: plant.uncertain(fit)."
        )
    return realisation


def with_changes(plant: P, changes: Sequence[tuple[Delta, float]]) -> P:
    """Return the plant with modes' stiffness, damping or shape changed by some relative amounts."""
    # rows [1, 0] and [a00 / s, 1] of a block [[a00, s], [a10, a11]] are a mode's displacement and
    # its rate over s; only the second row of the block changes, whatever its form
    if all(delta.kind in ("gain", "delay") for delta, _ in changes):
        return _with_ports(plant, plant.assembled.realisation, changes)
    return _with_ports(plant, changed_modes(plant, changes), changes)


def changed_modes(plant: Partition, changes: Sequence[tuple[Delta, float]]) -> ModalRealisation:
    """Return the modes of a plant with stiffness, damping or shape changed."""
    realisation = modal_realisation(plant)
    for delta, amount in changes:
        if delta.kind == "shape":
            realisation = reshaped(realisation, delta, amount)
    return realisation.replace(pairs=changed_pairs(realisation, changes))


def changed_pairs(
    realisation: ModalRealisation, changes: Sequence[tuple[Delta, float]]
) -> FloatArray:
    """Return the blocks (b, 2, 2) of modes with stiffness or damping of some changed."""
    pairs = np.array(realisation.pairs)
    for delta, amount in changes:
        if delta.kind not in ("freq", "damping"):
            continue
        if not amount > -1:
            raise ModelError(
                f"{delta.name} = {amount / delta.scale:.4g} leaves mode {delta.mode} with negative "
                f"{'stiffness' if delta.kind == 'freq' else 'damping'}."
            )
        nominal = realisation.pairs[delta.mode - 1]
        s = nominal[0, 1]
        if delta.kind == "freq":
            row = np.array([np.linalg.det(nominal) / s, 0.0])
        else:
            row = -np.trace(nominal) * np.array([nominal[0, 0] / s, 1.0])
        pairs[delta.mode - 1, 1] -= amount * row
    return pairs


def _with_ports(
    plant: P, realisation: ModalRealisation, changes: Sequence[tuple[Delta, float]]
) -> P:
    """Return the plant of a realisation, gains of its ports and its delay changed."""
    gains = {d.name.removesuffix(":gain"): 1.0 + x for d, x in changes if d.kind == "gain"}
    late = sum(x for d, x in changes if d.kind == "delay")
    ports = None
    if gains:
        own = plant.assembled.ports
        sides = {
            side: [_times(port, gains.get(port.name, 1.0)) for port in getattr(own, side)]
            for side in "uy"
        }
        ports = own.replace(**sides)
    if not late:
        return rebuilt(plant, ports=ports, realisation=realisation)
    fresh = rebuilt(plant.continuous, ports=ports, realisation=realisation)
    return sampled(fresh, 1.0 / plant.dt, plant.delay + late)


def _times(port: Any, gain: float) -> Any:
    """Return an actuator or sensor with another gain."""
    if gain == 1.0:
        return port
    part = as_statespace([[1.0]]) if port.dynamics is None else port.dynamics
    # states as before: a command is scaled before the filter, a reading behind it
    driven = {"B": gain * part.B} if isinstance(port, ForcePort) else {"C": gain * part.C}
    return port.replace(dynamics=part.replace(D=gain * part.D, **driven))


def reshaped(
    realisation: ModalRealisation,
    delta: Delta,
    amount: float,
    *,
    inputs: bool = True,
    outputs: bool = True,
) -> ModalRealisation:
    """Return a realisation with ``phi + amount along`` where forces act, motions show, or both."""
    first = 2 * delta.mode - 2
    if np.any(realisation.inputs[:, first]) or np.any(realisation.outputs[:, first + 1]):
        raise ModelError(
            f"mode {delta.mode} has a complex shape: deviations of shapes are of real ones. Leave "
            "it out of modes=."
        )
    pushed, shown = np.array(realisation.inputs), np.array(realisation.outputs)
    moved = amount * np.asarray(delta.along)
    if inputs:
        pushed[:, first + 1] += moved
    if outputs:
        shown[:, first] += moved / realisation.pairs[delta.mode - 1, 0, 1]
    return realisation.replace(inputs=pushed, outputs=shown)


@dataclass(frozen=True, eq=False, repr=False)
class UncertainPlant(Value, Generic[P]):
    """A plant whose modes are known up to real Deltas, and its neglected modes up to a weight.

    ::

          z_Delta <---|     |<--- w_Delta = Delta z_Delta
                z <---|  P  |<--- w
                y <---|     |<--- u

    A mode of frequency omega and damping ratio zeta obeys
    ``q'' + 2 zeta omega (1 + b d_b) q' + omega^2 (1 + a d_a) q = f``: each Delta is one channel.
    Where deviations of shapes are given, it is driven and seen by ``phi + c d_c v``.

    Made by `StandardPlant.uncertain`.

    Parameters
    ----------
    plant : StandardPlant
        The nominal plant, continuous or sampled.
    system : StateSpace
        Continuous: inputs [Delta channels `mode6:freq:w`; neglected modes `die:z:neglected:w`,
        `y1:neglected:w`; w; u], outputs [`mode6:freq:z`; `amp1:neglected:z`, `u1:neglected:z`; z;
        y]. A Delta that acts at several places has further channels after the first ones of all:
        `mode6:freq:rate:w`, where accelerations need it.
    deltas : sequence of Delta
        In the order of their channels.
    covariance : (m, m) array
        Of the deltas as random numbers; their variances are ``1 / deviations^2``.
    deviations : float
        Standard deviations at which a delta is 1.
    neglected : NeglectedModes, optional
        Weights on the modes that the plant lacks.
    fit : UpdateResult, optional
        Where the uncertainty comes from; `sample` draws its parameters.
    parameters : sequence of Parameter
        Those of the fit, or those stated.

    Examples
    --------
    >>> import flexplant as fx
    >>> known = fx.testbeds.three_masses().uncertain(frequency=0.01, damping=0.3)
    >>> len(known.sample(1, 5))  # machines that it may be
    5
    """

    plant: P
    system: StateSpace
    deltas: tuple[Delta, ...]
    covariance: FloatArray
    deviations: float
    neglected: NeglectedModes | None = None
    fit: UpdateResult | None = None
    parameters: tuple[Parameter, ...] = ()

    @property
    def nominal(self) -> P:
        """The nominal plant with `uncertainty` this value, which weights and blocks keep.

        What designs and loops take when they are given an uncertain plant; an H-infinity design
        has ``uncertain.nominal.through(errors).weighted(z=..., w=...)``.
        """
        return self.plant.replace(uncertainty=self)

    @property
    def frequencies(self) -> dict[int, float]:
        """By what share the frequency of each mode may be off, {mode: share} at delta = 1."""
        # stiffness is off by twice the relative error of the frequency
        return {d.mode: 0.5 * d.scale for d in self.deltas if d.kind == "freq"}

    @property
    def of_matrices(self) -> bool:
        """Whether Deltas are changes of M, D and K: of parameters, and of modes beside these."""
        return any(delta.kind == "parameter" for delta in self.deltas)

    @property
    def channels(self) -> dict[str, str]:
        """The Delta of each of its channels: {`mode6:freq:rate`: `mode6:freq`, ...}, in order."""
        inner = len(self.system.inputs) - len(self.plant.system.inputs)
        return {
            channel: delta.name
            for channel in (name.removesuffix(":w") for name in self.system.inputs[:inner])
            for delta in self.deltas
            if f"{channel}:".startswith(f"{delta.name}:")
        }

    def __repr__(self) -> str:
        more = f", {self.neglected!r}" if self.neglected is not None else ""
        count = counted(len(self.deltas), "real Delta")
        lines = [f"<UncertainPlant: {count} at {self.deviations:g} std{more}"]
        for i, delta in enumerate(self.deltas[:6]):
            amount, unit = 100 * delta.scale, "%"
            if delta.kind == "freq":
                amount *= 0.5
            elif delta.kind in ("parameter", "delay"):
                amount = delta.scale
                unit = "samples" if delta.kind == "delay" else self.parameters[i].unit
            lines.append(f"  {delta.name} +- {amount:.3g} {unit}")
        if len(self.deltas) > 6:
            lines.append(f"  ... and {len(self.deltas) - 6} more")
        return "\n".join(lines) + ">"

    def lft(self, values: Mapping[str, float] | None = None) -> P:
        """Return the plant at some values of the Deltas, exactly; sampled like the nominal one.

        Parameters
        ----------
        values : mapping {name: float}, optional
            Such as {"mode6:freq": 0.5}; Deltas that are not named are 0. Beyond 1 is allowed.

        Raises
        ------
        LabelError, ModelError
            When a Delta is unknown; when a mode would lose its stiffness or its damping would be
            negative.
        """
        hint = "Such as {'" + self.deltas[0].name + "': 0.5}."
        given = {} if values is None else mapping(values, "values of Deltas", hint)
        known = {delta.name: delta for delta in self.deltas}
        require_known("Delta", given, known)
        changes = [
            (known[name], known[name].scale * number(value, f"the value of {name!r}"))
            for name, value in given.items()
        ]
        if not self.of_matrices:
            return with_changes(self.plant, changes)
        amounts = {delta.name: amount for delta, amount in changes}
        moved = np.array([amounts.get(parameter.name, 0.0) for parameter in self.parameters])
        return self._moved(moved, changes)

    def sample(self, rng: Any, n: int = 1) -> list[P]:
        """Return machines within the uncertainty, ports and sampling those of the nominal plant.

        From a fit: its parameters are drawn from their covariance and each machine's matrices are
        rebuilt, so shapes and all modes differ too. From measured modes: stiffness and damping of
        the measured modes are drawn, correlated as measured, and their shapes where deviations
        were given.

        Parameters
        ----------
        rng : int, SeedSequence, Generator or None
            Seeds are spawned: machine i is the same whatever n is.
        n : int

        Raises
        ------
        ModelError
            When a machine drawn is not physical: too uncertain for a normal distribution.
        """
        machines = []
        for i, own in enumerate(generator(rng).spawn(whole(n, "n", maximum=MOST_DRAWS)), 1):
            try:
                machines.append(self._drawn(own))
            except ModelError as error:
                raise ModelError(
                    f"machine {i} of the sample is not physical: {error} The uncertainty reaches "
                    "beyond what the structure allows; measure more modes, or scale the covariance."
                ) from None
        return machines

    def _drawn(self, rng: np.random.Generator) -> P:
        if self.fit is None or self.fit.covariance is None:
            drawn = _normal(rng, self.covariance)
            for i, delta in enumerate(self.deltas):
                if delta.kind == "damping":  # of logarithms, so that it stays positive
                    drawn[i] = np.expm1(delta.scale * drawn[i]) / delta.scale
            names = (delta.name for delta in self.deltas)
            return self.lft(dict(zip(names, drawn.tolist(), strict=True)))
        moved = _normal(rng, self.fit.covariance)
        beside = [delta for delta in self.deltas if delta.kind in ("gain", "delay")]
        amounts = (rng.standard_normal(len(beside)) / self.deviations).tolist()
        return self._moved(moved, [(d, d.scale * x) for d, x in zip(beside, amounts, strict=True)])

    def _moved(self, change: FloatArray, changes: Sequence[tuple[Delta, float]] = ()) -> P:
        """Return the plant of the model with its parameters, gains and delay changed."""
        realisation = self.plant.assembled.realisation
        own = self.plant.model if self.of_matrices or self.fit is None else self.fit.model
        model = _changed_model(realisation, own, self.parameters, change)
        with warnings.catch_warnings():  # the nominal plant has said in which form it is
            warnings.simplefilter("ignore", FlexplantWarning)
            return _with_ports(self.plant, plant_modes(model), changes)


def _normal(rng: np.random.Generator, covariance: FloatArray) -> FloatArray:
    """Draw from N(0, covariance), scaled inside: units differ and it may be singular."""
    std = np.sqrt(np.diag(covariance))
    unit = covariance / np.outer(std, std)
    values, vectors = np.linalg.eigh(0.5 * (unit + unit.T))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(std * (root @ rng.standard_normal(std.size)))


def elastic_part(model: Any, realisation: ModalRealisation, D: FloatArray) -> FloatArray:
    """Return what a damper does beside rigid-body motion, which is undamped by convention."""
    # all of it where the plant's own dampers slow rigid-body motion down
    r = realisation.n_rigid
    coupled = realisation.coupling is not None and np.any(realisation.coupling[:r])
    if not model.rigid_body.shape[1] or coupled or np.any(realisation.pairs[:r, 1, 1]):
        return D
    rigid = orthonormalised(model.M, model.rigid_body)
    elastic = np.eye(rigid.shape[0]) - rigid @ np.asarray(model.M @ rigid).T
    return np.asarray(elastic.T @ D @ elastic)


def _changed_model(
    realisation: ModalRealisation, model: Any, parameters: Sequence[Parameter], change: FloatArray
) -> Any:
    """Return the fit's model with parameters changed by some amounts."""
    changed: dict[str, Any] = {name: getattr(model, name) for name in "MDK"}
    for parameter, amount in zip(parameters, change.tolist(), strict=True):
        for name, part in zip("MDK", parameter.change(model, amount), strict=True):
            if part is None:
                continue
            moved: Any = elastic_part(model, realisation, dense(part)) if name == "D" else part
            old = changed[name]
            if sp.issparse(old):
                moved = sp.csc_array(moved)
            changed[name] = moved if old is None else old + moved
    return model.replace(**changed)
