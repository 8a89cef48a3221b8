"""The standard plant: one StateSpace, the names of w, u, z, y in it, and its methods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy.typing as npt

from ..arrays import flag, instance, positive
from ..errors import LabelError, ModelError, require_known
from ..labels import Place
from ..lti.frequency import Frf
from ..lti.statespace import System
from .building import PASS_PORTS, continuous_plant, evaluation_plant, sampled
from .generalized import GeneralizedPlant, Weighable
from .machine_plants import PlantMachines, fitted_machines
from .moving import PortPath, along, moved_ports, seen_elsewhere
from .origins import MeasuredResponse
from .partitioned import EvaluationModel, Partition
from .ports import Ports
from .realisation import ModalRealisation, ResidualForm, Structure, plant_modes
from .remade import check_channels, matched, own_plant, rebuilt, selected
from .uncertainty.mode_delta import Dampings, Frequencies
from .uncertainty.uncertain_plants import UncertainPlant, uncertain_plant


@dataclass(frozen=True, eq=False, repr=False)
class StandardPlant(Weighable, Partition):
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
        Names of the channels of each group.
    asd : mapping {str: float}
        One-sided amplitude spectral density of the w channels that are white noise.
    origin : Assembled or Foreign
        Origin of the plant: `plant.assembled` holds ports, modes, noise and delay of a plant that
        was assembled from a structure.
    uncertainty : UncertainPlant, optional
        Uncertainty of the plant. It exists in ``plant.uncertain(...).nominal``, and it is kept when
        weights are added.
    evaluation : EvaluationModel, optional
        Larger model of the same machine, on which results are checked; see `assemble_plant`.
        ``plant.replace(evaluation=model)`` changes it, ``plant.replace(evaluation=None)`` removes
        it.
    measurement : MeasuredResponse, optional
        Measured response on which loops are judged; ``plant.measured(frf)`` adds it.

    Raises
    ------
    LabelError
        When the names are not those of the system's channels, in this order, or u and y have a name
        in common.
    ModelError
        When a density is negative or not finite.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> plant
    <StandardPlant: 7 states, dt 0.0005 s, delay 1>
      w (4) amp  y1:noise  y2:noise  die:ref
      u (1) u1
      z (3) die:x  die:error  u1:effort
      y (3) y1  y2  die:ref
    >>> plant.Gyu.outputs
    ('y1', 'y2', 'die:ref')
    """

    def discretized(self, rate: float, *, delay: float = 0.0) -> StandardPlant:
        """Return the plant sampled at a rate: exact zero-order hold, mode by mode.

        Parameters
        ----------
        rate : float [Hz]
            Sampling rate.
        delay : float [samples]
            Delay from a measurement to the reaction of the actuators, including fractions. With a
            delay of at least one sample, the controller has a whole sampling interval for its
            computation.

        Returns
        -------
        StandardPlant
            The sampled plant. Its efforts are the commands without delay. Sensor noises and
            references act as sample values. `process_noise` and `sensor_noise` are the exact
            covariances.

        Raises
        ------
        ModelError
            When the plant is sampled already, the rate is not positive, or a delay is negative or
            longer than 1000 samples.

        Warns
        -----
        FlexplantWarning
            When all elastic modes lie above half the rate, or a delay is shorter than 0.01
            samples: the unit is probably another one.
        """
        return self._known(sampled(self, rate, delay))

    def with_ports(self, ports: Ports) -> StandardPlant:
        """Return the plant of the same structure and sampling with other ports.

        The modes are not solved again, so that this is fast; the placement functions use it.
        ModelError when the plant was not assembled from a structure.
        """
        return self._known(rebuilt(self, ports))

    def select(
        self,
        *,
        w: Sequence[str] | None = None,
        u: Sequence[str] | None = None,
        z: Sequence[str] | None = None,
        y: Sequence[str] | None = None,
    ) -> StandardPlant:
        """Return the plant with some of its channels, in the order of the plant.

        A channel that belongs to another one is kept or removed with it and needs no name: the
        noise of a sensor, the effort of an actuator, the reference and the error of an axis of a
        POI.

        Parameters
        ----------
        w, u, z, y : sequence of str, optional
            Disturbances, actuators, axes of POIs and sensors to keep; all by default.

        Raises
        ------
        LabelError
            When a name is not a channel of that side.

        Examples
        --------
        >>> import flexplant as fx
        >>> fx.testbeds.three_masses().select(y=["y2"]).y
        ('y2', 'die:ref')
        """
        return self._known(selected(self, {"w": w, "u": u, "z": z, "y": y}))

    def at(
        self, poi: Place | Mapping[str, Place] | None = None, **positions: float
    ) -> StandardPlant:
        """Return the plant with ports at other places: only rows of C, columns of B, and D change.

        ``plant.at(x=0.03)`` is the plant at the position x = 0.03 m: all ports that move with x are
        placed there. The modes and A are the same, so that plants for many positions need only new
        rows and columns.

        Parameters
        ----------
        poi : (3,) array [m] or mapping {name: place}, optional
            New point of the POI. Give a mapping if there are several POIs, or to move actuators
            (columns of B), disturbances or sensors too.
        **positions : float [m or rad]
            Values of the positions by name; positions not named stay.

        Raises
        ------
        LabelError, ModelError
            When a name is unknown, or the plant has several POIs and none is named; when a
            position is out of its range.
        """
        if poi is None and not positions:
            raise LabelError(
                "at needs a place: a point of the POI, {name: point}, or a position by name "
                f"({', '.join(self.assembled.ports.values) or 'this plant has none'})."
            )
        ports = self.assembled.ports
        if positions:
            ports = ports.at(positions)
        there = ports if poi is None else moved_ports(ports, poi)
        found = seen_elsewhere(self, there) or self.with_ports(there)
        judged = self.evaluation
        if judged is not None and not judged.is_structure:
            there_too = own_plant(StandardPlant, judged).at(poi, **positions)
            found = found.replace(evaluation=there_too)
        return self._known(found)

    def _known(self, found: StandardPlant) -> StandardPlant:
        """Return a plant of the same modes with the uncertainty of this one."""
        if self.measurement is not None:
            found = found.replace(measurement=self.measurement)
        return found if self.uncertainty is None else self.uncertainty.on(found).nominal

    def measured(self, frf: Frf, *, hold: bool = True, delay: float = 0.0) -> StandardPlant:
        """Return the plant with the measured response of its machine, on which loops are judged.

        A plant made from ``fit.calibrated(measured)`` has such a response already, if the model was
        fitted to a response (`FrfResidual` without a hold) whose channels have the names of the
        plant's actuators and sensors.

        Parameters
        ----------
        frf : Frf
            Response from actuators to sensors of this plant, which are found by name. It may
            contain only some of them.
        hold : bool
            False for a response that was measured from sample to sample, so that it contains the
            zero-order hold.
        delay : float [samples]
            Delay that the response contains, for example that of the controller which measured it.
            Loops are judged with the delay of the plant in its place.

        Raises
        ------
        LabelError
            When a channel of the response is not an actuator or sensor of the plant.
        ModelError
            When the delay is negative or not finite, or the plant with a delay is not sampled.
        """
        instance(frf, Frf, "frf", "Pass the measured one, estimate_frf(...) say.")
        require_known("actuator", frf.inputs, self.u)
        require_known("sensor", frf.outputs, self.y)
        late = positive(delay, "delay", zero=True)
        if late and not self.dt:
            raise ModelError("delay counts samples: sample it first, plant.discretized(rate).")
        return self.replace(measurement=MeasuredResponse(frf, flag(hold, "hold"), late))

    def along(self, name: str, points: npt.ArrayLike) -> PortPath:
        """Return the rows of C and D of a POI (or columns of B and D of a force) at many points.

        Use it for positions that change with time. Only rows of C depend on the place of a POI, and
        rows of D if the plant has a feedthrough.

        Parameters
        ----------
        name : str
            Name of a POI, or of an actuator or disturbance of a continuous plant.
        points : (p, 3) array [m]
            Points of the structure at which the port is placed.

        Raises
        ------
        LabelError, ModelError
            When the name is unknown or a point is off the structure; when the plant was not
            assembled from a structure, or more than B depends on the place.
        """
        return along(self, name, points)

    def uncertain(
        self, *kinds: Any, frequency: Any = None, damping: Any = None
    ) -> UncertainPlant[StandardPlant]:
        """Return the plant with its uncertainty, of one or several kinds.

        An example is ``plant.uncertain(Frequencies(0.005), Gains(0.02), fit, Neglected())``. Each
        kind gives Deltas with ``|delta| <= 1``, and random values for the machines that `machines`
        draws. The order of the kinds does not matter.

        Parameters
        ----------
        *kinds : Uncertainty, UpdateResult, ModalUncertainty or MeasuredModes
            Kinds of uncertainty: `Frequencies`, `Dampings` and `Shapes` of modes, `Parameters` of
            the model, `Gains`, `Delay`, `Neglected` modes, `UnmodelledDynamics`, or the remaining
            uncertainty of a `Fit`. In place of a `Fit` you may give a fit, its uncertainty or
            measured modes directly. Your own kind derives from `Uncertainty`.
        frequency, damping : float, (m,) array or {mode: float}, optional
            The same as `Frequencies(frequency)` and `Dampings(damping)`.

        Returns
        -------
        UncertainPlant
            Plant with `.system`, `.deltas`, `.lft(values)` and `.machines`. Functions that take a
            plant accept it too. Designs and loops then report the allowed error of each mode.

        Raises
        ------
        LabelError
            When a mode, a port or a parameter is unknown.
        ModelError
            When nothing is uncertain, or something twice; when a kind is of another model or
            covers negative stiffness or damping; when no channels express a Delta.

        Examples
        --------
        >>> import flexplant as fx
        >>> from flexplant.plant import Delay, Gains
        >>> fx.testbeds.three_masses().uncertain(Gains({"u1": 0.02}), Delay(0.2), frequency=0.005)
        <UncertainPlant: 4 real Deltas at 2 std
          mode2:freq +- 0.5 %
          mode3:freq +- 0.5 %
          u1:gain +- 2 %
          delay +- 0.2 samples>
        """
        stated = [] if frequency is None else [Frequencies(frequency)]
        more = [] if damping is None else [Dampings(damping)]
        plain = self if self.uncertainty is None else self.replace(uncertainty=None)
        return uncertain_plant(plain, [*kinds, *stated, *more])

    @cached_property
    def machines(self) -> PlantMachines | None:
        """Machines that this plant may be, drawn at random; None if no uncertainty is known.

        A plant made from ``fit.calibrated(measured)``, or from
        ``plant.uncertain(fit.machines(measured))`` with an evaluation model, has machines that
        agree with the measurement of the fit. Otherwise they are drawn from the uncertainty that
        ``plant.uncertain(...)`` states.
        """
        fit = fitted_machines(self)
        if fit is None and self.uncertainty is None:
            return None
        return PlantMachines(self, fit)

    @cached_property
    def evaluation_plant(self) -> StandardPlant | None:
        """The evaluation model with this plant's channels, sampled and delayed like it.

        It is assembled once and kept. It is None if there is no evaluation model.

        LabelError or ModelError when a plant that was given as evaluation model has other channels,
        or another sampling time or delay.
        """
        model = self.evaluation
        if model is None:
            return None
        return evaluation_plant(self, model) if model.is_structure else matched(self, model)


def standard_plant(given: StandardPlant | UncertainPlant[StandardPlant] | System) -> StandardPlant:
    """Return a plant, or a system whose labels distinguish w, u, z and y, as a StandardPlant.

    All functions that take a plant call it.

    Parameters
    ----------
    given : StandardPlant, UncertainPlant, StateSpace or control.StateSpace
        The plant; for an uncertain plant its nominal plant, with its `uncertainty`.

    Raises
    ------
    LabelError
        When the labels do not distinguish w, u, z and y.
    ModelError
        When it is neither a plant nor such a system, or a `GeneralizedPlant` (use its
        `unweighted`).

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> fx.plant.standard_plant(plant) is plant
    True
    """
    return StandardPlant.of(given)


#: plants that synthesis and loops accept
AnyPlant: TypeAlias = StandardPlant | GeneralizedPlant


def plant_of(given: AnyPlant | UncertainPlant[StandardPlant] | System) -> AnyPlant:
    """Return a plant for a synthesis or a loop; a `GeneralizedPlant` is returned unchanged.

    Other values are converted as by `standard_plant`.

    Parameters
    ----------
    given : StandardPlant, GeneralizedPlant, UncertainPlant, StateSpace or control.StateSpace
        The plant, or a system whose labels distinguish w, u, z and y.

    Raises
    ------
    LabelError
        When the labels of a system do not distinguish w, u, z and y.
    ModelError
        When it is of another kind.

    Examples
    --------
    >>> import flexplant as fx
    >>> heavy = fx.testbeds.three_masses().weighted(z={"die:error": 2.0})
    >>> fx.plant.plant_of(heavy) is heavy
    True
    """
    return given if isinstance(given, GeneralizedPlant) else StandardPlant.of(given)


def assemble_plant(
    model: Structure | ModalRealisation,
    ports: Ports,
    *,
    evaluation: Any = None,
    residual: ResidualForm | None = None,
) -> StandardPlant:
    """Return the standard plant of a structure with its channels.

    The plant contains ``M q'' + D q' + K q = f`` (equation (1) of the paper, or (8) for a reduced
    model) in modal states. The forces f act at the disturbances and actuators, and the outputs are
    the motions at the POIs and sensors. The filters of the ports (shapes, dynamics) add their
    states.

    Parameters
    ----------
    model : FEModel, Modes or ReducedModel
        The structure. The `realisation` of a plant is also accepted: the modes are then not solved
        again.
    ports : Ports
        Disturbances, actuators, points of interest, sensors and references of the machine.
    evaluation : Modes, FEModel, ReducedModel or StandardPlant, optional
        Larger model of the same machine, on which results are checked, with the modes that `model`
        lacks. Every plant made from this one has it too, and every filter, controller, loop, score
        and budget accounts for it. If it is a structure, the ports are applied to it; if it is a
        plant, it must have the channels of the ports. If it is not given and `model` is a
        ReducedModel that has kept its truncated modes, the larger model consists of `model` and
        these modes.
    residual : FastStates or Feedthrough, optional
        Form of residual attachment vectors of Modes: fast modes (the default), or a compliance that
        responds at once.

    Returns
    -------
    StandardPlant
        A continuous plant. w contains disturbances, sensor noises `y1:noise` and references, and u
        the actuators. z contains POI axes `die:z`, errors `die:error` and efforts `u1:effort`, and
        y the sensors and references. The latencies of ports have an effect only after the plant is
        sampled. `plant.form` says whether A is in modal blocks.

    Raises
    ------
    LabelError
        When a place is not on the structure, an actuator and a sensor have the same name, or an
        evaluation model that is a plant has other channels.
    ModelError
        When the evaluation model is neither a structure nor a plant.

    Warns
    -----
    FlexplantWarning
        When damping couples the modes so that a block for each mode cannot represent it. The cause
        is an overdamped pair, two poles that are (nearly) equal, or a damper to ground whose pole
        in a rigid-body motion is faster than 1e-4 of the first elastic frequency. In these cases
        the plant has the dense form: its states are those of the undamped modes, which the full
        damping matrix couples. A damper with a slower pole is neglected and causes no warning,
        because rigid-body modes are undamped by convention.

    References
    ----------
    [paper]_, equations (1)-(8) and Fig. 2.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0], stiffnesses=[100.0]), count=2)
    >>> ports = fx.Ports(
    ...     u=[fx.Actuator("u1", at="1:x")],
    ...     z=[fx.Poi("die", at="2:x", axes=("x",))],
    ...     y=[fx.Sensor("y1", at="1:x", asd=1e-10)],
    ... )
    >>> fx.assemble_plant(modes, ports)
    <StandardPlant: 4 states, continuous>
      w (1) y1:noise
      u (1) u1
      z (2) die:x  u1:effort
      y (1) y1
    """
    realisation = plant_modes(model, residual)
    instance(ports, Ports, "ports", PASS_PORTS)
    judged = EvaluationModel.of(evaluation) or EvaluationModel.known_to(realisation.model)
    found = continuous_plant(StandardPlant, realisation, ports, judged)
    if judged is not None and not judged.is_structure:
        check_channels(found, standard_plant(judged.source))
    return found
