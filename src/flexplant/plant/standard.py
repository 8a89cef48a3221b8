"""The standard plant: one StateSpace and the names of w, u, z, y in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..errors import LabelError, ModelError, unknown_label
from ..labels import Place
from ..lti.statespace import StateSpace, System, as_statespace
from ..values import FloatArray, IntArray, Value, name_list, positive, short
from .channel_sides import TYPE_THIS, sides
from .partition import Partition
from .ports import Ports
from .realisation import ModalRealisation

if TYPE_CHECKING:
    from .check import AssumptionReport
    from .moving import Along
    from .uncertainty.uncertain_plant import UncertainPlant


@dataclass(frozen=True, eq=False, repr=False)
class StandardPlant(Partition, Value):
    """A plant with disturbances w, inputs u, performance z and measurements y.

    ::

                +-----------+
          z <---|           |<--- w      inputs  [w; u], outputs [z; y], in this order
                |     P     |
          y <---|           |<--- u      u = K y: the sign of the feedback is in K
                +-----------+

    Made by `assemble_plant` from a structure, or by `StandardPlant.from_statespace`.

    Parameters
    ----------
    system : StateSpace
        ``[w; u] -> [z; y]``.
    w, u, z, y : sequences of str
        Names of its channels.
    asd : mapping {str: float}
        One-sided amplitude spectral density of the w channels that are white noise.
    ports : Ports, optional
        Where the channels are.
    realisation : ModalRealisation, optional
        The structure's modes.
    physical : StateSpace, optional
        Forces to motions, before noise, references and efforts are wired to it.
    continuous : StandardPlant, optional
        The plant before sampling.
    delay : float [samples]
        Of the inputs u.
    noise_factor : (n, r) array, optional
        G with G G' the covariance of x that disturbances add in one sample.
    unweighted : StandardPlant, optional
        The plant before `weighted` and `through`.
    reading : StateSpace, optional
        The block of `through`: from `unweighted.y` to y.

    Raises
    ------
    LabelError
        When the names are not those of the system's channels, in this order.
    ModelError
        When a density is negative or not finite.
    """

    system: StateSpace
    w: tuple[str, ...]
    u: tuple[str, ...]
    z: tuple[str, ...]
    y: tuple[str, ...]
    asd: Mapping[str, float]
    ports: Ports | None = None
    realisation: ModalRealisation | None = None
    physical: StateSpace | None = None
    continuous: StandardPlant | None = None
    delay: float = 0.0
    noise_factor: FloatArray | None = None
    unweighted: StandardPlant | None = None
    reading: StateSpace | None = None

    def __post_init__(self) -> None:
        for side in "wuzy":
            self._set(**{side: tuple(getattr(self, side))})
        if (*self.w, *self.u) != tuple(self.system.inputs):
            raise LabelError(f"inputs {self.system.inputs} are not [w; u] = {self.w + self.u}.")
        if (*self.z, *self.y) != tuple(self.system.outputs):
            raise LabelError(f"outputs {self.system.outputs} are not [z; y] = {self.z + self.y}.")
        for name in self.asd:
            if name not in self.w:
                raise unknown_label("w channel with an asd", name, self.w)
        asd = {name: positive(a, f"asd of {name!r}", zero=True) for name, a in self.asd.items()}
        self._set(asd=asd, noise_factor=self.noise_factor)

    def __repr__(self) -> str:
        kind = f"dt {self.dt:g} s, delay {self.delay:g}" if self.dt else "continuous"
        named = f" {self.system.name!r}" if self.system.name else ""
        lines = [f"<StandardPlant{named}: {self.system.n_states} states, {kind}>"]
        for side in "wuzy":
            names = getattr(self, side)
            shown = "  ".join(names[:8]) + ("  ..." if len(names) > 8 else "")
            lines.append(f"  {side} ({len(names)}) {shown}")
        if self.ports is not None and self.ports.delays and not self.dt:
            late = ", ".join(f"{name} {delay:g} s" for name, delay in self.ports.delays.items())
            lines.append(f"  delays that act once it is sampled: {late}")
        if self.form.startswith("dense"):
            lines.append(f"  {self.form}")
        return "\n".join(lines)

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
    ) -> StandardPlant:
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
            One-sided amplitude spectral densities of white w channels.

        Returns
        -------
        StandardPlant
            With inputs [w; u] and outputs [z; y].

        Raises
        ------
        LabelError
            When a name is unknown or on two sides, or none is given and the channels do not tell.
        """
        g = as_statespace(sys)
        if u is None and y is None and w is None and z is None:
            w, u, z, y = sides(g)
        if u is None or y is None:
            raise LabelError(
                f"name both u and y, got u = {u} and y = {y}. Type {TYPE_THIS}, or leave all four "
                "out when the channels are named like those of an assembled plant."
            )
        u, y = name_list(u, "u"), name_list(y, "y")
        w = [n for n in g.inputs if n not in u] if w is None else list(name_list(w, "w"))
        z = [n for n in g.outputs if n not in y] if z is None else list(name_list(z, "z"))
        ordered = g.select([*z, *y], [*w, *u])
        return cls(ordered, tuple(w), tuple(u), tuple(z), tuple(y), dict(asd or {}))

    @property
    def n_rigid(self) -> int:
        """Number of rigid-body modes."""
        return self.realisation.n_rigid if self.realisation is not None else 0

    @property
    def form(self) -> str:
        """`modal blocks`, `dense: ` and why modes are coupled, or `as given` without a structure.

        Weights and filters of the ports add blocks of their own.
        """
        return self.realisation.form if self.realisation is not None else "as given"

    @property
    def model(self) -> Any:
        """The structural model that the plant was assembled from, or None."""
        return self.realisation.model if self.realisation is not None else None

    @property
    def modal_states(self) -> IntArray:
        """Where the states of the structure's modes are; sensors' filters stand before them.

        Raises
        ------
        ModelError
            When the plant was not assembled from a structure.
        """
        if self.realisation is None or self.realisation.names[0] not in self.system.states:
            raise ModelError("this plant has no modes: it was not assembled from a structure.")
        first = self.system.states.index(self.realisation.names[0])
        return np.arange(first, first + len(self.realisation.names), dtype=np.int64)

    @cached_property
    def structural(self) -> StateSpace:
        """The structure alone, [w; u] -> [z; y], continuous; filters as their static gains."""
        from .assembly import structural

        return structural(self)

    @property
    def process_noise(self) -> FloatArray:
        """Covariance (n, n) that white disturbances add to x in one sample."""
        if self.noise_factor is None:
            raise ModelError(
                "process noise per sample is known only for a plant that was assembled from a "
                "structure and sampled: use assemble_plant(model, ports).discretized(rate)."
            )
        return self.noise_factor @ self.noise_factor.T

    def channel(self, name: str, side: str = "z") -> str:
        """Return the channel of `side` that a name means: `die` or `die:hat` mean `die:z`.

        Raises
        ------
        LabelError
            When it means none.
        """
        names: tuple[str, ...] = getattr(self, side)
        if name in names:
            return name
        for poi in self.ports.z if self.ports is not None else ():
            for axis in poi.axes:
                aliases = (poi.derived(axis, "hat"), poi.derived(axis, "error"))
                if name in aliases or (name == poi.name and axis == poi.axes[0]):
                    return poi.channel(axis)
        raise unknown_label(f"channel of {side}", name, names)

    def discretized(self, rate: float, *, delay: float = 0.0) -> StandardPlant:
        """Return the plant sampled at a rate: exact zero-order hold, mode by mode.

        Parameters
        ----------
        rate : float [Hz]
            Sampling rate.
        delay : float [samples]
            From a measurement to the moment the actuators answer it; any fraction. A delay of at
            least one sample leaves the controller the whole interval to compute.

        Returns
        -------
        StandardPlant
            Efforts are the commands (not delayed); sensor noises and references act as sample
            values; `process_noise` and `sensor_noise` hold the exact covariances.

        Raises
        ------
        ModelError
            When the plant is sampled already, is weighted, or rate or delay is not positive; when
            they are plausible in another unit only: the lowest elastic mode lies above five times
            the rate, a delay is below 0.01 samples, or that of a port above 1000 samples.

        Warns
        -----
        FlexplantWarning
            When all elastic modes lie above half the rate.
        """
        from .assembly import sampled

        return sampled(self, rate, delay)

    def weighted(
        self,
        *,
        z: Mapping[str, Any] | None = None,
        w: Mapping[str, Any] | None = None,
    ) -> StandardPlant:
        """Return the plant with weights on z and w absorbed into its states; names stay.

        Parameters
        ----------
        z, w : mapping {name: weight}
            A weight is a number or a system with one input and one output, of this plant's dt.
            None leaves the channel out; a channel that is not named is kept as it is.

        Returns
        -------
        StandardPlant
            `W_z P W_w`; its `unweighted` is this plant.

        Raises
        ------
        LabelError
            When a name is unknown.
        ModelError
            When a weight is not one by one, or of another sampling time.
        """
        from .weighting import weighted

        return weighted(self, z, w)

    def through(self, block: System) -> StandardPlant:
        """Return the plant whose measurements are the outputs of a block that reads y.

        What the controller then reads may be errors, decoupled motions or filtered sensors; close
        the loop with the same block before the controller.

        Parameters
        ----------
        block : StateSpace
            Its inputs are channels of y; its outputs become y.

        Returns
        -------
        StandardPlant
            With the same w, u and z.

        Raises
        ------
        LabelError
            When an input of the block is not in y.
        ModelError
            When its sampling time differs.
        """
        from .weighting import measured_through

        return measured_through(self, block)

    def with_ports(self, ports: Ports) -> StandardPlant:
        """Return the plant of the same structure, sampled alike, with other ports.

        The modes are not solved again: this is what placement calls.

        Raises
        ------
        ModelError
            When the plant was not assembled from a structure.
        """
        from .assembly import reassembled

        return reassembled(self, ports)

    def at(self, poi: Place | Mapping[str, Place]) -> StandardPlant:
        """Return the plant with the POI moved: only its rows of C (and D12, if any) change.

        Parameters
        ----------
        poi : (3,) array [m] or mapping {name: place}
            The new point; a mapping when there are several POIs, or to move other ports too:
            actuators (columns of B), disturbances, sensors.

        Raises
        ------
        LabelError
            When a name is unknown, or the plant has several POIs and none is named.
        """
        from .moving import moved

        return self.with_ports(moved(self.ports, poi))

    def along(self, name: str, points: npt.ArrayLike) -> Along:
        """Return the rows of a POI (or the columns of a force) at many points at once.

        All that depends on where a POI is are its rows of C, and of D where the plant has a
        feedthrough: for positions that change with time.

        Parameters
        ----------
        name : str
            A POI; or an actuator or disturbance of a continuous plant.
        points : (p, 3) array [m]
            The places.

        Returns
        -------
        Along

        Raises
        ------
        LabelError
            When the name is unknown or a point is off the structure.
        ModelError
            When the plant was not assembled from a structure, or more than B depends on the place.
        """
        from .moving import along

        return along(self, name, points)

    def uncertain(
        self,
        source: Any,
        parameters: Any = None,
        *,
        modes: Sequence[int] | None = None,
        deviations: float = 2.0,
        neglected: Any = None,
    ) -> UncertainPlant:
        """Return the plant with the doubt of a fit opened as real Deltas on its modes.

        The covariance of the parameters goes to the modes by the eigenvalue sensitivities,
        ``J C J'``; each chosen mode's stiffness omega^2 and damping 2 zeta omega becomes a channel
        `mode6:freq`, `mode6:damping` with ``|delta| <= 1`` at some standard deviations.

        Parameters
        ----------
        source : UpdateResult or MeasuredModes
            A fit whose `model` this plant was assembled from, or measured poles with mode numbers
            and a covariance.
        parameters : sequence of Parameter, optional
            Those that were given to `update`, in its order; those the fit keeps when not given.
        modes : sequence of int, optional
            Numbers from 1, rigid-body modes included; all elastic (or all measured) ones when not
            given.
        deviations : float
            Standard deviations at which a delta is 1.
        neglected : StandardPlant, FEModel, Modes or ReducedModel, optional
            A larger model with the same u and y: the difference from u to y is bounded by an
            additive weight (not that from w or to z; see `NeglectedModes`).

        Returns
        -------
        UncertainPlant
            `.system`, `.deltas`, `.lft(values)`, `.sample(rng, n)`.

        Raises
        ------
        LabelError
            When parameters are not those of the fit, or a mode is unknown.
        ModelError
            When there is no covariance, the fit is of another model, or the doubt covers negative
            stiffness or damping.
        """
        from .uncertainty.uncertain_plant import uncertain

        return uncertain(
            self,
            source,
            parameters,
            modes=modes,
            deviations=deviations,
            neglected=neglected,
        )

    def to_control(self) -> Any:
        """Return the whole system as a `control.StateSpace` with the same names."""
        return self.system.to_control()

    def check(self) -> AssumptionReport:
        """Return which standard assumptions hold, in physical words, rigid-body modes first."""
        from .check import report

        return report(self)


def standard_plant(given: StandardPlant | System) -> StandardPlant:
    """Return a StandardPlant; of a system with labels when these tell w, u, z and y.

    The one door of all functions that take a plant.

    Raises
    ------
    LabelError
        When the labels do not tell.
    ModelError
        When it is neither.
    """
    if isinstance(given, StandardPlant):
        return given
    if isinstance(given, StateSpace) or hasattr(given, "input_labels"):
        return StandardPlant.from_statespace(given)
    raise ModelError(
        f"need a StandardPlant, got {short(given)}. Make it by assemble_plant(model, ports), or by "
        f"{TYPE_THIS}."
    )
