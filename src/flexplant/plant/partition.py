"""The data of a machine's plant: its channels, where it comes from, and how it is judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self, TypeGuard

import numpy as np

from ..checks import FloatArray, mapping, name_list, real_array, short
from ..errors import LabelError, ModelError
from ..lti.statespace import StateSpace, System, as_statespace
from .evaluation_model import EvaluationModel
from .origins import Foreign, Origin, PlantChannel
from .partitioned import PartitionedSystem
from .ports import Ports
from .realisation import MODAL
from .sides import TYPE_THIS, sides_of


def is_system(given: object) -> TypeGuard[System]:
    """Return whether it is a system with labels: ours, or one of python-control."""
    return isinstance(given, StateSpace) or hasattr(given, "input_labels")


def is_plant(given: object) -> TypeGuard[PartitionedSystem | System]:
    """Return whether it is a plant or a system with labels, not a structure."""
    return isinstance(given, PartitionedSystem) or is_system(given)


@dataclass(frozen=True, eq=False, repr=False)
class Partition(PartitionedSystem):
    """The data of a standard plant, in the fields of `StandardPlant`, and derived quantities."""

    origin: Origin = field(default_factory=Foreign)
    uncertainty: Any = None
    evaluation: EvaluationModel | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(evaluation=EvaluationModel.of(self.evaluation))
        if isinstance(self.origin, Foreign):  # its ports are the names that it has
            u: Any = [PlantChannel(name, "u") for name in self.u]
            y: Any = [PlantChannel(name, "y") for name in self.y if name not in self.w]
            self._set(origin=self.origin.replace(ports=Ports(u=u, y=y)))

    @property
    def machine(self) -> Self:
        """The machine: the plant itself."""
        return self

    def around(self, machine: Self) -> Self:
        """Return another machine: there are no weights and blocks to put around it."""
        return machine

    def _all_changes(self, changes: dict[str, Any]) -> dict[str, Any]:
        """Return changes of fields with the noise of each sample and the plant before sampling."""
        asd = changes.get("asd")
        of_sample = self.origin.continuous is not None and self.origin.noise_factor is not None
        if isinstance(asd, Mapping) and "origin" not in changes and of_sample:
            quiet = {f"{name}:noise" for name in self.y}
            new, old = (
                {n: a for n, a in d.items() if a and n not in quiet} for d in (asd, self.asd)
            )
            if new != old:
                factor = np.zeros((len(self.noise_factor), len(self.held)))
                if new:
                    loud = {n: a for n, a in new.items() if n in self.continuous.w}
                    before: Any = self.continuous.replace(asd=loud)
                    factor = before.discretized(1.0 / self.dt, delay=self.delay).noise_factor
                changes["origin"] = self.assembled.replace(noise_factor=factor)
        if "evaluation" in changes:  # the plant before sampling has the same one
            judged = EvaluationModel.of(changes["evaluation"])
            origin = changes.get("origin", self.origin)
            if origin.continuous is not None and origin.continuous.evaluation is not judged:
                origin = origin.replace(continuous=origin.continuous.replace(evaluation=judged))
            changes |= {"evaluation": judged, "origin": origin}
        return changes

    @classmethod
    def of(cls, given: Any) -> Self:
        """Return a plant; of a system with labels when these name w, u, z and y.

        Of an `UncertainPlant` its nominal plant, with what is uncertain in `uncertainty`.
        LabelError when the labels do not, ModelError when it is neither.
        """
        given = getattr(given, "nominal", given)
        if isinstance(given, cls):
            return given
        if is_system(given):
            return cls.from_statespace(given)
        if hasattr(given, "alteration"):
            raise ModelError(
                f"need the plant of a machine, but the plant is {given.alteration}: its "
                "channels are not those of the machine. Use plant.unweighted."
            )
        raise ModelError(
            f"need a StandardPlant, got {short(given)}. Make it by assemble_plant(model, ports), "
            f"or by {TYPE_THIS}."
        )

    @classmethod
    def from_statespace(
        cls,
        sys: System,
        *,
        u: Sequence[str] | None = None,
        y: Sequence[str] | None = None,
        w: Sequence[str] | None = None,
        z: Sequence[str] | None = None,
        asd: Mapping[str, float] | None = None,
        noise_factor: FloatArray | None = None,
        evaluation: Any = None,
    ) -> Self:
        """Return the standard plant of a system made elsewhere.

        Parameters
        ----------
        sys : StateSpace or control.StateSpace
            With named channels.
        u, y : sequences of str, optional
            Inputs that the controller drives, outputs that it reads. Both may be left out when
            the channels are named like those of an assembled plant (`u1:effort`, `y1:noise`,
            `die:z`, `die:ref`), as those of `plant.to_control()` are.
        w, z : sequences of str, optional
            Disturbances and performance; the remaining channels when not given.
        asd : mapping, optional
            One-sided amplitude spectral densities of white w channels; the noise of a sensor y1
            is the w channel `y1:noise`.
        noise_factor : (n, r) array, optional
            G with G G' the covariance of x that disturbances add in one sample.
        evaluation : StandardPlant, optional
            The plant that answers are judged on, with the same channels.

        Returns
        -------
        StandardPlant
            With inputs [w; u] and outputs [z; y].

        Raises
        ------
        LabelError
            When a name is unknown or on two sides, or none is given and the names do not show them.
        """
        g = as_statespace(sys)
        if u is None and y is None and w is None and z is None:
            w, u, z, y = sides_of(g)
        if u is None or y is None:
            raise LabelError(
                f"name both u and y, got u = {u} and y = {y}. Type {TYPE_THIS}, or leave all four "
                "out when the channels are named like those of an assembled plant."
            )
        u, y = name_list(u, "u"), name_list(y, "y")
        w = [n for n in g.inputs if n not in u] if w is None else list(name_list(w, "w"))
        z = [n for n in g.outputs if n not in y] if z is None else list(name_list(z, "z"))
        if noise_factor is not None:
            noise_factor = real_array(noise_factor, "noise_factor", (g.n_states, None))
        return cls(
            g.select([*z, *y], [*w, *u]),
            tuple(w), tuple(u), tuple(z), tuple(y),
            {} if asd is None else mapping(asd, "asd", "Pass {channel: density}."),
            Foreign(noise_factor), evaluation=evaluation,
        )  # fmt: skip

    @property
    def continuous(self) -> Self:
        """The plant before sampling; this plant where it is continuous, or nothing is known."""
        found: Self | None = self.origin.continuous
        return self if found is None else found

    @property
    def has_own_modes(self) -> bool:
        """Whether it has modes, each with its own frequency and damping."""
        return self.form == MODAL

    @property
    def noise_factor(self) -> FloatArray:
        """G (n, r), G G' the covariance that white disturbances add to x in one sample.

        ModelError when it is not known.
        """
        found = self.origin.noise_factor
        if found is None:
            raise ModelError(
                "labels carry no noise density, so that the process noise of each sample is not "
                "known. Use assemble_plant(model, ports).discretized(rate), or type "
                f"{TYPE_THIS[:-1]}, noise_factor=G), G G' the covariance that w adds to x in one "
                "sample."
            )
        return found

    @property
    def reading_gain(self) -> FloatArray:
        """The identity: y are the measurements of the machine."""
        return np.eye(len(self.y))
