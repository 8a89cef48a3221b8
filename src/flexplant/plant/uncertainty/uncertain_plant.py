"""Uncertain plants: the doubt of a fit as real Deltas on frequency and damping of modes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.sparse as sp

from ...errors import LabelError, ModelError, unknown_label
from ...identification import MeasuredModes
from ...lti.statespace import StateSpace
from ...structure.rigid import orthonormalised
from ...updating import UpdateResult, eigenvalue_sensitivities
from ...updating.parameters.added import Parameter
from ...values import ComplexArray, FloatArray, Value, generator, positive, real_array, whole
from ..assembly import assemble_plant
from ..realisation import MODAL, ModalRealisation, Structure
from ..standard import StandardPlant
from .neglected import NeglectedModes, neglected_modes, opened

#: relative doubts below this open no channel
_KNOWN = 1e-12
#: relative change at which the plant's dependence on a Delta is read off
_PROBE = 0.25


@dataclass(frozen=True, eq=False)
class Delta(Value):
    """One real uncertainty, ``w = delta z`` with ``|delta| <= 1``.

    Parameters
    ----------
    name : str
        Of the channels: `mode6:freq` has the input `mode6:freq:w` and the output `mode6:freq:z`.
    mode : int
        Number of the mode, from 1, rigid-body modes included.
    kind : {"freq", "damping"}
        Stiffness ``omega^2 (1 + scale delta)`` or damping ``2 zeta omega (1 + scale delta)``.
    scale : float
        Relative change at delta = 1.
    """

    name: str
    mode: int
    kind: Literal["freq", "damping"]
    scale: float


@dataclass(frozen=True, eq=False, repr=False)
class UncertainPlant(Value):
    """A plant whose modes are known up to real Deltas, and its neglected modes up to a weight.

    ::

          z_Delta <---|     |<--- w_Delta = Delta z_Delta
                z <---|  P  |<--- w
                y <---|     |<--- u

    A mode of frequency omega and damping ratio zeta keeps its shape and obeys
    ``q'' + 2 zeta omega (1 + b d_b) q' + omega^2 (1 + a d_a) q = f``: each Delta is one channel.

    Made by `StandardPlant.uncertain`.

    Parameters
    ----------
    plant : StandardPlant
        The nominal plant, continuous or sampled.
    system : StateSpace
        Continuous: inputs [Delta channels `mode6:freq:w`; neglected modes `y1:neglected:w`; w; u],
        outputs [`mode6:freq:z`; `u1:neglected:z`; z; y].
    deltas : sequence of Delta
        In the order of their channels.
    covariance : (m, m) array
        Of the deltas as random numbers; their variances are ``1 / deviations^2``.
    deviations : float
        Standard deviations at which a delta is 1.
    neglected : NeglectedModes, optional
        Weight on the modes that the plant lacks.
    fit : UpdateResult, optional
        Where the doubt comes from; `sample` draws its parameters.
    parameters : sequence of Parameter
        Those of the fit.
    """

    plant: StandardPlant
    system: StateSpace
    deltas: tuple[Delta, ...]
    covariance: FloatArray
    deviations: float
    neglected: NeglectedModes | None = None
    fit: UpdateResult | None = None
    parameters: tuple[Parameter, ...] = ()

    def __post_init__(self) -> None:
        self._set(covariance=self.covariance)

    def __repr__(self) -> str:
        more = f", {self.neglected!r}" if self.neglected is not None else ""
        lines = [
            f"<UncertainPlant: {len(self.deltas)} real Deltas at {self.deviations:g} std{more}"
        ]
        for delta in self.deltas[:6]:
            half = 0.5 if delta.kind == "freq" else 1.0
            lines.append(f"  {delta.name} +- {100 * half * delta.scale:.3g} %")
        if len(self.deltas) > 6:
            lines.append(f"  ... and {len(self.deltas) - 6} more")
        return "\n".join(lines) + ">"

    def lft(self, values: Mapping[str, float] | None = None) -> StandardPlant:
        """Return the plant at some values of the Deltas, exactly; sampled like the nominal one.

        Parameters
        ----------
        values : mapping {name: float}, optional
            Such as {"mode6:freq": 0.5}; Deltas that are not named are 0. Beyond 1 is allowed.

        Returns
        -------
        StandardPlant
            Its realisation holds the changed modes.

        Raises
        ------
        LabelError
            When a Delta is unknown.
        ModelError
            When a mode would lose its stiffness or its damping would be negative.
        """
        if values is not None and not isinstance(values, Mapping):
            raise ModelError(
                f"values of Deltas are a mapping {{name: value}}, got {type(values).__name__}."
                " Such as {'" + self.deltas[0].name + "': 0.5}."
            )
        given = dict(values or {})
        known = {delta.name: delta for delta in self.deltas}
        changes = []
        for name, value in given.items():
            if name not in known:
                raise unknown_label("Delta", name, known)
            amount = float(real_array(value, f"the value of {name!r}", ()))
            changes.append((known[name], known[name].scale * amount))
        return _with_changes(self.plant, changes)

    def sample(self, rng: Any, n: int = 1) -> list[StandardPlant]:
        """Return machines that the doubt allows, ports and sampling those of the nominal plant.

        From a fit: its parameters are drawn from their covariance and each machine's matrices are
        rebuilt, so shapes and all modes differ too. From measured modes: stiffness and damping of
        the measured modes are drawn, correlated as measured.

        Parameters
        ----------
        rng : int, SeedSequence, Generator or None
            Seeds are spawned: machine i is the same whatever n is.
        n : int
            How many.

        Returns
        -------
        list of StandardPlant

        Raises
        ------
        ModelError
            When a machine drawn is not physical: the doubt is too large for a normal distribution.
        """
        machines = []
        for i, own in enumerate(generator(rng).spawn(whole(n, "n")), 1):
            try:
                machines.append(self._drawn(own))
            except ModelError as error:
                raise ModelError(
                    f"machine {i} of the sample is not physical: {error} The doubt reaches beyond "
                    "what the structure allows; measure more modes, or scale the covariance."
                ) from None
        return machines

    def _drawn(self, rng: np.random.Generator) -> StandardPlant:
        if self.fit is None or self.fit.covariance is None:
            drawn = _normal(rng, self.covariance)
            names = (delta.name for delta in self.deltas)
            return self.lft(dict(zip(names, drawn.tolist(), strict=True)))
        model = _moved(self.fit.model, self.parameters, _normal(rng, self.fit.covariance))
        if self.plant.ports is None:
            raise ModelError("the plant has no ports.")
        plant = assemble_plant(model, self.plant.ports)
        return _sampled_like(self.plant, plant)


def uncertain(
    plant: StandardPlant,
    source: UpdateResult | MeasuredModes,
    parameters: Sequence[Parameter] | None = None,
    *,
    modes: Sequence[int] | None = None,
    deviations: float = 2.0,
    neglected: StandardPlant | Structure | None = None,
) -> UncertainPlant:
    """Return a plant with the doubt of a fit opened; see `StandardPlant.uncertain`."""
    realisation = _structure(plant)
    many = positive(deviations, "deviations")
    if isinstance(source, UpdateResult):
        parameters = source.unknowns if parameters is None else parameters
        numbers, poles, doubt = _fitted(realisation, source, parameters, modes)
    elif isinstance(source, MeasuredModes):
        numbers, poles, doubt = _measured(source, modes)
    else:
        raise ModelError(
            f"uncertainty comes from an UpdateResult or MeasuredModes, got {type(source).__name__}."
        )
    _check_poles(realisation, numbers, poles, isinstance(source, UpdateResult))
    G = _relative(poles)
    doubt = G @ doubt @ G.T
    scale = many * np.sqrt(np.diag(doubt))
    kinds: tuple[Literal["freq", "damping"], ...] = ("freq", "damping")
    every = [
        Delta(f"mode{number}:{kind}", number, kind, float(size))
        for (kind, number), size in zip(
            ((kind, number) for kind in kinds for number in numbers), scale, strict=True
        )
    ]
    keep = sorted(np.flatnonzero(scale > _KNOWN), key=lambda i: (every[i].mode, i))
    if not keep:
        raise ModelError(f"modes {list(numbers)} have no doubt: there is no uncertainty to open.")
    deltas = tuple(every[i] for i in keep)
    _check_range(deltas, many)
    system = _opened(plant.continuous or plant, deltas)
    weight = None
    if neglected is not None:
        weight = neglected_modes(plant, neglected)
        system = opened(system, weight, len(deltas))
    return UncertainPlant(
        plant,
        system,
        deltas,
        doubt[np.ix_(keep, keep)] / np.outer(scale[keep], scale[keep]),
        many,
        weight,
        source if isinstance(source, UpdateResult) else None,
        tuple(parameters or ()),
    )


def _structure(plant: StandardPlant) -> ModalRealisation:
    if plant.realisation is None or plant.ports is None or plant.unweighted is not None:
        raise ModelError(
            "uncertain modes need a plant assembled from a structure and not weighted: use "
            "assemble_plant(model, ports), or plant.unweighted."
        )
    if plant.form != MODAL:
        raise ModelError(
            f"the modes of this plant are coupled by damping ({plant.form}): frequency and "
            "damping of one mode are not its own, so that no Delta belongs to it. Draw machines "
            "from the fit itself (its parameters and covariance), or lower the damping."
        )
    return plant.realisation


def _fitted(
    realisation: ModalRealisation,
    fit: UpdateResult,
    parameters: Sequence[Parameter] | None,
    modes: Sequence[int] | None,
) -> tuple[tuple[int, ...], ComplexArray, FloatArray]:
    """Return mode numbers, poles and J C J', the covariance of [Re lambda; Im lambda]."""
    names = tuple(parameter.name for parameter in parameters or ())
    if names != tuple(fit.parameters):
        raise LabelError(
            f"the fit is of {list(fit.parameters)}, got the parameters {list(names)}: pass those "
            "given to update, in the same order: plant.uncertain(fit, parameters)."
        )
    if fit.covariance is None:
        raise ModelError(
            "the fit has no covariance: as many numbers were measured as were fitted. Measure "
            "another mode, or give MeasuredModes(covariance=...)."
        )
    elastic = range(realisation.n_rigid + 1, _modes_of(realisation) + 1)
    chosen = list(elastic if modes is None else modes)
    found = eigenvalue_sensitivities(fit.model, list(parameters or ()), modes=chosen)
    J = np.vstack([found.S.real, found.S.imag])
    return found.modes, found.poles, J @ fit.covariance @ J.T


def _measured(
    measured: MeasuredModes, modes: Sequence[int] | None
) -> tuple[tuple[int, ...], ComplexArray, FloatArray]:
    if measured.covariance is None or measured.modes is None:
        raise ModelError(
            "the measured modes need mode numbers and a covariance: "
            "MeasuredModes(poles, modes=[...], covariance=...)."
        )
    chosen = list(measured.modes if modes is None else modes)
    for number in chosen:
        if number not in measured.modes:
            raise unknown_label("measured mode", number, map(str, measured.modes))
    at = [measured.modes.index(number) for number in chosen]
    both = [*at, *(i + len(measured) for i in at)]
    return tuple(chosen), measured.poles[at], measured.covariance[np.ix_(both, both)]


def _relative(poles: ComplexArray) -> FloatArray:
    """Return the derivatives of [log omega^2; log 2 zeta omega] to [Re lambda; Im lambda]."""
    size = np.abs(poles) ** 2
    damped = np.where(poles.real != 0, poles.real, np.inf)
    zero = np.zeros((poles.size, poles.size))
    return np.block(
        [
            [np.diag(2 * poles.real / size), np.diag(2 * poles.imag / size)],
            [np.diag(1 / damped), zero],
        ]
    )


def _modes_of(realisation: ModalRealisation) -> int:
    return sum(name.startswith("mode") for name in realisation.names) // 2


def _check_poles(
    realisation: ModalRealisation, modes: Sequence[int], poles: ComplexArray, strict: bool
) -> None:
    """Refuse a plant that has not the modes that the doubt is about."""
    count = _modes_of(realisation)
    for number, pole in zip(modes, poles, strict=True):
        if not realisation.n_rigid < number <= count:
            known = range(realisation.n_rigid + 1, count + 1)
            raise unknown_label("elastic mode of the plant", number, map(str, known))
        own = np.linalg.eigvals(realisation.pairs[number - 1])
        off = np.min(np.abs(own - pole)) / abs(pole)
        if off > (1e-6 if strict else 0.1):
            raise ModelError(
                f"mode {number} has the pole {pole:.6g} in the "
                f"{'fit' if strict else 'measurement'} and {own[0]:.6g} in the plant: they are "
                "not of the same model. Assemble the plant from fit.model."
            )


def _check_range(deltas: Sequence[Delta], deviations: float) -> None:
    for delta in deltas:
        if delta.scale >= 1:
            what = "stiffness" if delta.kind == "freq" else "damping"
            raise ModelError(
                f"the {what} of mode {delta.mode} is doubted by {100 * delta.scale:.3g} % at "
                f"{deviations:g} standard deviations, so it may be negative: no controller is "
                "robust to that. Measure it better, leave the mode out, or lower deviations."
            )


def _with_changes(plant: StandardPlant, changes: Sequence[tuple[Delta, float]]) -> StandardPlant:
    """Return the plant with modes' stiffness or damping changed by some relative amounts.

    Rows [1, 0] and [a00 / s, 1] of a block [[a00, s], [a10, a11]] are a mode's displacement and
    its rate over s; only the second row of the block changes, whatever its form.
    """
    realisation = _structure(plant)
    pairs = np.array(realisation.pairs)
    for delta, amount in changes:
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
    changed = plant.replace(realisation=realisation.replace(pairs=pairs))
    if plant.ports is None:
        raise ModelError("the plant has no ports.")
    return changed.with_ports(plant.ports)


def _opened(plant: StandardPlant, deltas: Sequence[Delta]) -> StateSpace:
    """Return the continuous plant with a channel for each Delta.

    All matrices are affine in the Deltas, [A B; C D] + sum delta_j L_j R_j: each L_j R_j is read
    off the plant assembled with that mode changed, so it holds for any port.
    """
    base, g = _matrix(plant.system), plant.system
    n, m = g.n_states, len(g.inputs)
    left, right = np.zeros((base.shape[0], len(deltas))), np.zeros((len(deltas), n + m))
    for j, delta in enumerate(deltas):
        change = (_matrix(_with_changes(plant, [(delta, _PROBE)]).system) - base) / _PROBE
        sizes = np.linalg.norm(change, axis=1)
        R = change[np.argmax(sizes)] / np.sqrt(sizes.max())
        left[:, j] = change @ R / (R @ R) * np.sqrt(delta.scale)
        right[j] = R * np.sqrt(delta.scale)
    _check_affine(plant, deltas, left, right)
    zero = np.zeros((len(deltas), len(deltas)))
    return StateSpace(
        g.A,
        np.hstack([left[:n], g.B]),
        np.vstack([right[:, :n], g.C]),
        np.block([[zero, right[:, n:]], [left[n:], g.D]]),
        inputs=[*(f"{delta.name}:w" for delta in deltas), *g.inputs],
        outputs=[*(f"{delta.name}:z" for delta in deltas), *g.outputs],
        states=g.states,
        name=g.name,
        blocks=g.blocks,
    )


def _check_affine(
    plant: StandardPlant, deltas: Sequence[Delta], left: FloatArray, right: FloatArray
) -> None:
    amounts = [_PROBE * (1.0 if j % 2 else -0.5) for j in range(len(deltas))]
    wanted = _matrix(_with_changes(plant, list(zip(deltas, amounts, strict=True))).system)
    weights = np.array(amounts) / np.array([delta.scale for delta in deltas])
    off = np.abs(wanted - _matrix(plant.system) - (left * weights) @ right)
    row = np.abs(wanted - _matrix(plant.system)).max(axis=1)
    bad = np.flatnonzero(off.max(axis=1) > 1e-6 * row + 1e-12 * np.abs(wanted).max(axis=1))
    if bad.size:
        i = int(bad[0]) - plant.system.n_states
        name = plant.system.outputs[i] if i >= 0 else plant.system.states[int(bad[0])]
        raise ModelError(
            f"{name!r} depends on products of Deltas: an acceleration of a mode whose damping is "
            "not proportional does. Measure displacement or velocity there, or assemble from "
            "modes with proportional damping."
        )


def _matrix(g: StateSpace) -> FloatArray:
    return np.block([[g.A, g.B], [g.C, g.D]])


def _normal(rng: np.random.Generator, covariance: FloatArray) -> FloatArray:
    """Draw from N(0, covariance), scaled inside: units differ and it may be singular."""
    std = np.sqrt(np.diag(covariance))
    unit = covariance / np.outer(std, std)
    values, vectors = np.linalg.eigh(0.5 * (unit + unit.T))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(std * (root @ rng.standard_normal(std.size)))


def _moved(model: Any, parameters: Sequence[Parameter], change: FloatArray) -> Any:
    """Return the fit's model with parameters changed by some amounts.

    Rigid-body modes are undamped by convention: dampers change the elastic motions only.
    """
    changed: dict[str, Any] = {name: getattr(model, name) for name in "MDK"}
    for parameter, amount in zip(parameters, change.tolist(), strict=True):
        for name, part in zip("MDK", parameter.matrices(model), strict=True):
            if part is None:
                continue
            if name == "D" and model.rigid_body.shape[1]:
                rigid = orthonormalised(model.M, model.rigid_body)
                elastic = np.eye(rigid.shape[0]) - rigid @ np.asarray(model.M @ rigid).T
                part = elastic.T @ part @ elastic
            old = changed[name]
            if sp.issparse(old):
                changed[name] = sp.csc_array(old + amount * sp.csc_array(part))
            else:
                changed[name] = amount * part if old is None else old + amount * part
    return model.replace(**changed)


def _sampled_like(nominal: StandardPlant, plant: StandardPlant) -> StandardPlant:
    return plant.discretized(1.0 / nominal.dt, delay=nominal.delay) if nominal.dt else plant
