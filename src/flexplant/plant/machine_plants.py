"""The machines that a plant may be, and intervals of figures over them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, Context
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ..arrays import MOST_DRAWS, FloatArray, Rng, between, generator, whole
from ..errors import AssumptionError, FlexplantWarning, ModelError, in_unit, named_modes, with_unit
from ..lti.statespace import as_statespace
from ..store import Value
from ..tolerances import INTERVAL
from ..updating import FrfResidual
from ..updating.machines import COUNT, Machines
from .building import another_machine, noiseless, sampled
from .forces import Actuator
from .machine_draws import DrawnModes, MachineFamily, obstacle
from .origins import MeasuredResponse
from .partitioned import Partition
from .port import ForcePort, SensorPort
from .ports import Poi, Ports
from .realisation import ModalRealisation, plant_modes
from .visibility import untouched_modes

Port: TypeAlias = ForcePort | SensorPort | Poi


class FigureInterval(NamedTuple):
    """Interval that contains a figure for a fraction of the machines that a plant may be.

    Parameters
    ----------
    low, high : float or None
        Ends of the interval; None if the data for an interval are missing.
    sentence : str
        The interval in words, or the data that are missing for it.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.FigureInterval(None, None, "measure more modes").low is None
    True
    """

    low: float | None
    high: float | None
    sentence: str


def fitted_machines(plant: Any) -> Machines | None:
    """Return the machines of a plant's fit, stated or that of its model; None without any.

    Where modes that the plant's channels do not touch prevent intervals, these are left out.
    """
    if plant.evaluation is None:
        return None
    stated = () if plant.uncertainty is None else plant.uncertainty.kinds
    sources = (getattr(kind, "source", None) for kind in stated)
    for found in (*sources, getattr(plant.model, "machines", None)):
        if isinstance(found, Machines):
            return found.without(_untouched(plant, found)) if found.missing else found
    return None


def _untouched(plant: Any, machines: Machines) -> tuple[int, ...]:
    """Return the untouched modes of a plant, by their numbers in the model that was fitted."""
    freq = np.array(machines.fit.model.modes().freq)
    places = np.array(machines.measured.modes) - 1
    if freq.size != plant.assembled.realisation.n_modes or places.max() >= freq.size:
        return ()
    # calibration puts modes in another order where measured frequencies cross
    freq[places] = machines.measured.freq
    order = np.argsort(freq, kind="stable")
    return tuple(sorted(int(order[number - 1]) + 1 for number in untouched_modes(plant)))


def fitted_response(plant: Any) -> MeasuredResponse | None:
    """Return the response to which the plant's model was fitted, where it is of its sensors."""
    machines = getattr(plant.model, "machines", None)
    if not isinstance(machines, Machines):
        return None
    found = [r for r in machines.fit.residuals if isinstance(r, FrfResidual) and r.hold is None]
    if len(found) != 1:
        return None
    frf = found[0].measured
    quantities = {port.name: port.quantity for port in plant.ports.y}
    measured = frf.quantity or "displacement"
    if any(quantities.get(name, measured) != measured for name in frf.outputs):
        return None
    return MeasuredResponse(frf)


@dataclass(frozen=True, eq=False, repr=False)
class MachineParts(Value):
    """Parts of a machine from which its plant is made: modes, ports, delay.

    The Deltas (normalised uncertain numbers) of a plant change these parts.

    Parameters
    ----------
    plant : StandardPlant
        The nominal plant.
    realisation : ModalRealisation
        Modes of the structure; their blocks of A are replaced by `pairs`.
    pairs : (b, 2, 2) array [rad/s]
        Diagonal blocks of A, one for each mode.
    ports : Ports
        Ports of the machine; `with_port` and `with_gain` change one of them.
    model : FEModel or ReducedModel, optional
        A model with other matrices, whose modes are then solved again in place of `realisation`.
    late : float [samples]
        Change of the delay of the actuators, relative to the nominal plant.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> machine = fx.plant.MachineParts.of(plant).with_gain("u1", 1.1)
    >>> machine.assembled().Gyu.D.shape == plant.Gyu.D.shape
    True
    """

    plant: Partition
    realisation: ModalRealisation
    pairs: FloatArray
    ports: Ports
    model: Any = None
    late: float = 0.0

    @classmethod
    def of(cls, plant: Partition) -> MachineParts:
        """Return the parts of a plant, which are those of the nominal machine."""
        own = plant.assembled
        return cls(plant, own.realisation, own.realisation.pairs, own.ports)

    def with_port(self, port: Port) -> MachineParts:
        """Return the machine with another port in place of the one with the same name."""
        side = [port if one.name == port.name else one for one in getattr(self.ports, port.home)]
        return self.replace(ports=self.ports.replace(**{port.home: side}))

    def with_gain(self, name: str, gain: float) -> MachineParts:
        """Return the machine with the gain of an actuator or sensor multiplied by a number."""
        every: tuple[Actuator | SensorPort, ...] = (*self.ports.u, *self.ports.y)
        port = next(one for one in every if one.name == name)
        part = as_statespace([[1.0]]) if port.dynamics is None else port.dynamics
        # states as before: a command is scaled before the filter, a reading behind it
        driven = {"B": gain * part.B} if isinstance(port, ForcePort) else {"C": gain * part.C}
        return self.with_port(port.replace(dynamics=part.replace(D=gain * part.D, **driven)))

    def changed(self, changes: Sequence[tuple[Any, float]]) -> MachineParts:
        """Return the machine that is off by amounts of Deltas, those of lower stages first."""
        machine = self
        for delta, amount in sorted(changes, key=lambda one: one[0].stage):
            machine = delta.changed(machine, amount)
        return machine

    def assembled(self) -> Any:
        """Return the plant of the machine, with the sampling of the nominal plant."""
        plant, realisation = self.plant, self._modes
        if not self.late:
            return another_machine(plant, realisation, self.ports)
        fresh = another_machine(plant.continuous, realisation, self.ports)
        return sampled(fresh, 1.0 / plant.dt, plant.delay + self.late)

    def fed_back(self) -> Any:
        """Return the same for a loop that reads sensors alone: no motions of POIs, no noise."""
        ports = self.ports.replace(z=(), references=())
        return noiseless(self.plant, self._modes, ports, self.late)

    @property
    def _modes(self) -> ModalRealisation:
        if self.model is not None:
            with warnings.catch_warnings():  # the nominal plant has said in which form it is
                warnings.simplefilter("ignore", FlexplantWarning)
                return plant_modes(self.model)
        if np.array_equal(self.pairs, self.realisation.pairs):
            return self.realisation
        return self.realisation.replace(pairs=self.pairs)


class PlantMachines:
    """Possible machines of a plant; they have its channels and its sampling.

    A machine is a plant that is drawn at random within the known uncertainty. If the plant knows
    the remaining uncertainty of a fit (``fit.machines(measured)``, see
    `flexplant.updating.Machines`) and has an evaluation model, the modes of these machines come
    from the fit, so that they agree with its measurement. Otherwise they come from the uncertainty
    that the user states: frequencies, with the changes of the mode shapes that belong to them, and
    dampings. Gains, delays and other stated Deltas are drawn as well. Machines have the modes of
    the evaluation model, unless the stated uncertainty contains parameters or mode shapes of the
    plant's own model.

    Parameters
    ----------
    plant : StandardPlant
        The plant.
    fit : Machines, optional
        Result of ``fit.machines(measured)``, from which machines are drawn.

    Examples
    --------
    >>> import flexplant as fx
    >>> known = fx.testbeds.three_masses().uncertain(frequency=0.01, damping=0.3)
    >>> len(known.machines.drawn(5, rng=1))
    5
    """

    def __init__(self, plant: Any, fit: Machines | None = None) -> None:
        self.plant, self.fit = plant, fit

    @property
    def missing(self) -> str:
        """Data that are missing for an interval, in words; empty when none are missing."""
        if self.fit is None:
            return ""
        return self.fit.missing or obstacle(self._base.assembled.realisation)

    @property
    def left_out(self) -> str:
        """Remark for an interval that is of some modes only; otherwise empty."""
        left = () if self.fit is None else self.fit.left_out
        return f" (without {named_modes(left)}, which the channels do not touch)" if left else ""

    @cached_property
    def plants(self) -> list[Any]:
        """The machines from which intervals are computed, drawn once."""
        if self.fit is None:
            return self.drawn()
        return self.drawn(self.fit.count, rng=self.fit.seed)

    def drawn(self, count: int = COUNT, *, rng: Rng = 0) -> list[Any]:
        """Return machines that are drawn at random; machine i is the same for every count.

        Parameters
        ----------
        count : int
            Number of machines.
        rng : int, SeedSequence, Generator or None
            Random generator of the machines, or its seed.

        Raises
        ------
        ModelError
            When a drawn machine is not physical, because the uncertainty is larger than the
            structure allows.
        """
        return list(self.each(count, rng=rng))

    def each(self, count: int, *, rng: Rng, fed_back: bool = False) -> Iterator[Any]:
        """Yield the machines of `drawn` one after the other, or only what loops feed back."""
        uncertain = self.plant.uncertainty
        blocks = uncertain is not None and bool(uncertain.delta_blocks)  # these may be of any port
        seeds = generator(rng).spawn(whole(count, "count", maximum=MOST_DRAWS))
        for i, own in enumerate(seeds, 1):
            try:
                machine = self._machine(own, fed_back and not blocks)
                if blocks:
                    machine = uncertain.with_drawn_blocks(machine, own)
            except ModelError as error:
                raise ModelError(
                    f"machine {i} of those drawn is not physical: {error} The uncertainty reaches "
                    "beyond what the structure allows; measure more modes, or scale the covariance."
                ) from None
            yield machine

    def _machine(self, rng: np.random.Generator, fed_back: bool) -> Any:
        """Return one machine: its modes drawn together, then all else that is stated."""
        uncertain, (apart,) = self.plant.uncertainty, rng.spawn(1)
        drawn = [] if uncertain is None else uncertain.values(apart)
        if self.fit is None and any(not delta.stage for delta, _ in drawn):  # of matrices
            changes = [(delta.of_matrices(self.plant), delta.amount(x)) for delta, x in drawn]
            return MachineParts.of(self.plant).changed(changes).assembled()
        if self.fit is None and not drawn:
            return self._base
        of_modes = [one for one in drawn if one[0].of_modes]
        others = [(one, one.amount(x)) for one, x in drawn if one.stage and not one.of_modes]
        machine = MachineParts.of(self._base)
        for port in _noisy(machine.ports):
            if off := self._unsure.get(port.name):  # log-normal
                louder = float(np.exp(off * apart.standard_normal()))
                machine = machine.with_port(port.replace(asd=louder * port.asd))
        machine = machine.changed(others)
        modes: ModalRealisation | None = None
        if self.fit is not None:
            modes = self._of_fit(rng)
        elif of_modes:
            modes = uncertain.drawn_modes(machine.realisation, rng, of_modes)
        if modes is not None:
            machine = machine.replace(realisation=modes, pairs=modes.pairs)
        return machine.fed_back() if fed_back else machine.assembled()

    @cached_property
    def _base(self) -> Any:
        """The plant whose modes are drawn: the larger one where nothing is of the own model."""
        uncertain, own = self.plant.uncertainty, self.plant
        if uncertain is not None and any(delta.of_own_model for delta in uncertain.deltas):
            return own
        found = own.evaluation_plant if uncertain is None else uncertain.larger
        return found if found is not None and found.has_own_modes else own

    @property
    def _unsure(self) -> dict[str, float]:
        """Deviations of the densities of ports, where these are stated."""
        every = _noisy(self.plant.ports)
        return {port.name: port.asd_deviation for port in every if port.asd_deviation > 0.0}

    @property
    def densities(self) -> str:
        """Remark that noise densities do not vary among the machines; empty if they do."""
        return "" if self._unsure else ", densities as given"

    def _of_fit(self, rng: np.random.Generator) -> DrawnModes:
        """Return the modes of one machine of the fit, shared by plants of one evaluation model."""
        realisation = self._base.assembled.realisation
        fit: Any = self.fit
        seed: Any = rng.bit_generator.seed_seq
        family = realisation.once(fit, lambda: MachineFamily(realisation, fit))
        key = (fit, str(seed.entropy), seed.spawn_key)
        found: DrawnModes = realisation.once(key, lambda: family.machine(rng))
        return found


def _noisy(ports: Ports) -> tuple[Any, ...]:
    """Return the ports that have noise of a density."""
    return (*ports.w, *ports.u, *ports.y)


def interval_of(values: FloatArray, level: float = INTERVAL) -> tuple[float, float]:
    """Return the prediction interval of a log-normal figure of one more machine, from n drawn.

    For the logarithm the interval is ``mean +- t s sqrt(1 + 1 / n)``, Student's t with n - 1
    degrees of freedom.
    """
    from scipy.special import stdtrit

    share = between(level, "level", 0.0, 1.0, "Choose 0.95, say.")
    if without := int(np.count_nonzero(~((values > 0.0) & np.isfinite(values)))):
        raise AssumptionError(
            f"a figure of a log-normal distribution is positive and finite, and it is not on "
            f"{without} of {len(values)} machines"
        )
    logs, n = np.log(values), len(values)
    half = stdtrit(n - 1, 0.5 * (1 + share)) * np.std(logs, ddof=1) * np.sqrt(1 + 1 / n)
    centre = float(np.mean(logs))
    return float(np.exp(centre - half)), float(np.exp(centre + half))


def interval(
    machines: PlantMachines | None,
    figures: Callable[[], FloatArray],
    level: float,
    unit: str,
    given: str = "",
    own: float | None = None,
) -> FigureInterval:
    """Return the interval of a figure over machines, or what is missing for one.

    `given` is what the interval takes as it was given, in words; `own` is the figure of the design
    model, which the sentence states where it lies outside.
    """
    if machines is None:
        return FigureInterval(
            None,
            None,
            "no interval: nothing is known of other machines. Make the plant of "
            "fit.calibrated(measured) with evaluation=, or pass plant.uncertain(machines)",
        )
    if machines.missing:
        return FigureInterval(None, None, f"no interval: {machines.missing}")
    try:
        low, high = interval_of(figures(), level)
    except AssumptionError as error:  # a machine on which the figure has no value
        return FigureInterval(None, None, f"no interval: {error}")
    outside = own is not None and not low <= own <= high
    but = f" ({with_unit(own or 0.0, unit or None)} on the design model)" if outside else ""
    but += machines.left_out
    return FigureInterval(
        low,
        high,
        f"{interval_text(low, high, unit)} on {100 * level:.3g} % of such machines{given}{but}",
    )


def interval_text(low: float, high: float, unit: str) -> str:
    """Return two numbers in one unit, rounded outwards to the three digits of other figures."""
    factor, name = in_unit(high, unit or None)
    ends = [
        Context(prec=3, rounding=mode).create_decimal(f"{end / factor:.9g}")
        for end, mode in ((low, ROUND_FLOOR), (high, ROUND_CEILING))
    ]
    return f"{float(ends[0]):.3g} to {float(ends[1]):.3g} {name}".rstrip()
