"""The usual chain for one machine of many: measured poles, update, designs, a run, a report."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import positive, real_array, whole
from ..errors import AssumptionError, FlexplantError, InfeasibleError, ModelError, counted, short
from ..estimation import ConsistencyReport, KalmanEstimator, consistency, design_kalman
from ..identification import MeasuredModes, identify_modes, numbered
from ..loop import ClosedLoop, SpillOver, bandwidth, close_loop
from ..lti.frequency import Frf
from ..modes import MeshError, Modes, solve_modes
from ..plant import Ports, StandardPlant, UncertainPlant, assemble_plant
from ..reduction import ModalTruncation, ReducedModel, reduce
from ..seeds import generator
from ..store import Value, checked, written
from ..structure import Damping, FEModel
from ..synthesis import design_stage
from ..updating import Eigenvalues, Localisation, UpdateResult, localise, update
from ..words import instance, several
from .response import Response
from .sampled_runs import simulate
from .specification import Specification, Verdict

#: times that measured modes are paired with those of a model, at most
_PAIRINGS = 5
#: a mode of the full structure this far from the measured one, relative, is another one
_SAME = 0.05
_TYPE = "Give one of that type."


def _listed(values: Any, name: str) -> tuple[Any, ...]:
    return tuple(instance(values, Iterable, name, "Pass a list."))


def _mode_numbers(values: Any, name: str) -> tuple[int, ...]:
    return tuple(whole(n, "mode") for n in (values if several(values) else [values]))


def _falling(values: Any, name: str) -> tuple[float, ...] | None:
    """Return frequencies from the highest on; None stays."""
    if values is None:
        return None
    found = [positive(one, name) for one in real_array(values, name).ravel()]
    return tuple(sorted(found, reverse=True))


@dataclass(frozen=True, eq=False, repr=False)
class MachinePipeline(Value):
    """The chain identify, localise, update, plant, observer, controller, verify, for `study`.

    The updated model is calibrated with the measured poles, and the controller tolerates what
    `UpdateResult.uncertainty` leaves open of its frequencies (`design_stage`). Called with a
    machine it returns a row: the parameters found, what the observer predicts, what the controller
    reaches with the modes left out, and what it reaches *on the machine*, beside the
    specification. A machine is

    - an `Frf` that was measured: its modes are identified, and paired by frequency and shape with
      those of the model, then of the updated model until the pairs stay. The loop runs on the
      evaluation model, the updated full structure;
    - `MeasuredModes` with the numbers of the model's modes, in place of an FRF;
    - a virtual one, which answers to ``loop(ports, *blocks)``, on which the loop runs, and to
      ``poles(modes)``, or to ``measure_frf(ports, **measurement)``, as `fx.testbeds.WaferStage`
      does.

    Parameters
    ----------
    model : ReducedModel
        Of the drawing.
    full : FEModel, Modes or ReducedModel
        The drawing itself, whose further modes count in the observer and in the check of the loop.
        An FEModel is updated and solved again; Modes, say of a model of more DOFs than damping
        fits in a matrix for, are updated in their own coordinates, and so is a reduced model with
        the modes that it left out.
    parameters : sequence
        What is updated on each machine.
    ports : Ports
        Channels of every machine, with a reference for its POI; the outputs of an FRF are sensors
        of these, or DOFs of the model.
    rate : float [Hz]
        Of the controller.
    delay : float [samples]
        From measurement to actuation, any fraction.
    modes : sequence of int, optional
        Numbers of the modes whose poles are used; all that were identified when not given.
    deviation : float
        Of the errors of poles that a virtual machine is measured with, relative to their size.
    measurement : mapping, optional
        Options of `measure_frf` (period, amplitude, ...) of virtual machines, which are then
        identified from FRFs.
    band : (low, high) [Hz], optional
        In which modes are identified; all frequencies of the FRF when not given.
    hold : float [Hz], optional
        Rate of the zero-order hold through which FRFs were measured.
    starts : int, optional
        From how many places each update searches, for parameters with bounds: poles alone may be
        explained nearly as well by masses elsewhere.
    candidates : sequence
        Parameters of which `localise` chooses those that join the update.
    bandwidth : float or sequence of float [Hz], optional
        Of the controller: the first of them, from the highest on, at which `design_stage` holds.
        None: the highest that it finds, in some 20 s for 24 modes.
    margin : float
        Modulus margin at u that a design must have.
    mesh : MeshError, optional
        Of the drawing's modes, ``modes.mesh_error(finer)``: part of what is not known.
    blocks : sequence, optional
        A controller for all machines (StateSpaces or Controllers), in place of a design for each.
    specification : Specification, optional
        What the loop that is run is checked against.
    reference : SetPointProfile, array or mapping, optional
        Of the run.
    duration : float [s]
        Of that run.
    evaluation_modes : int
        Modes of the updated full structure that are known, those of the reduced model included; at
        most all. Of Modes and of a reduced model all count.
    folder : path, optional
        Where the report of each machine is written, a text file; the table names it.
    damping : Damping, optional
        Of an FEModel in place of its D, for models of any size: a `ModalDamping`, say. Parameters
        of damping are not in it; give Modes to have them.

    Examples
    --------
    >>> import flexplant as fx
    >>> chain = fx.chain(masses=[1.0] * 3, stiffnesses=[4e5] * 2)
    >>> drawing = chain.with_damping(fx.ModalDamping(0.02))
    >>> rom = fx.reduce(fx.solve_modes(drawing, count=3), fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> ports = fx.testbeds.three_masses().assembled.ports
    >>> fx.simulation.MachinePipeline(rom, drawing, [fx.AddedMass("3:x")], ports, rate=2e3, delay=1)
    <MachinePipeline: 1 parameter updated, H-infinity, 50 Hz>
    """

    model: ReducedModel = field(metadata=checked(instance, kind=ReducedModel, hint=_TYPE))
    full: FEModel | Modes | ReducedModel = field(
        metadata=checked(instance, kind=FEModel | Modes | ReducedModel, hint=_TYPE)
    )
    parameters: Sequence[Any] = field(metadata=checked(_listed))
    ports: Ports = field(metadata=checked(instance, kind=Ports, hint=_TYPE))
    rate: float = field(metadata=checked(positive))
    delay: float = field(metadata=checked(positive, zero=True))
    modes: Sequence[int] | None = field(default=None, metadata=checked(_mode_numbers))
    deviation: float = field(default=0.0, metadata=checked(positive, zero=True))
    measurement: Mapping[str, Any] | None = field(
        default=None,
        metadata=checked(instance, kind=Mapping, hint="Give {'period': 0.5}, say, or {}."),
    )
    band: tuple[float, float] | None = None
    hold: float | None = None
    starts: int | None = None
    candidates: Sequence[Any] = field(default=(), metadata=checked(_listed))
    bandwidth: float | Sequence[float] | None = field(default=50.0, metadata=checked(_falling))
    margin: float = field(default=0.4, metadata=checked(positive))
    mesh: MeshError | None = None
    blocks: Sequence[Any] | None = field(default=None, metadata=checked(_listed))
    specification: Specification | None = None
    reference: Any = None
    duration: float = field(default=1.0, metadata=checked(positive))
    evaluation_modes: int = field(default=80, metadata=checked(whole))
    folder: str | None = None
    damping: Damping | None = field(
        default=None,
        metadata=checked(instance, kind=Damping, hint="Pass ModalDamping(0.01) for 1 %."),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.damping is not None:
            hint = "Leave damping= out: modes and reduced models have theirs."
            instance(self.full, FEModel, "with damping=, full", hint)
        if not self.ports.references:
            raise ModelError("the ports need a reference for the POI: references=[Reference(...)].")
        self._set(folder=None if self.folder is None else str(self.folder))

    def __repr__(self) -> str:
        tried = ", ".join(f"{one:g}" for one in self._tried if one is not None) or "highest"
        control = "one controller for all" if self.blocks else f"H-infinity, {tried} Hz"
        return f"<MachinePipeline: {counted(len(self.parameters), 'parameter')} updated, {control}>"

    @property
    def _tried(self) -> tuple[float | None, ...]:
        given: Any = self.bandwidth
        return (None,) if given is None else given

    @property
    def error(self) -> str:
        """The error channel of the POI, the first that has a reference."""
        poi, axis = self.ports.followed[0]
        return poi.derived(axis, "error")

    def __call__(self, machine: Any, rng: Any = None) -> dict[str, Any]:
        """Return the row of one machine, and write its report where there is a folder."""
        report = self.report(machine, rng)
        row = dict(report.row)
        if self.folder is not None:
            name = hashlib.sha256(repr(report).encode()).hexdigest()[:12]
            row["report"] = f"machine-{name}.txt"
            Path(self.folder).mkdir(parents=True, exist_ok=True)
            report.write(Path(self.folder) / row["report"])
        return row

    def report(self, machine: Any, rng: Any = None) -> MachineReport:
        """Return all that is found for one machine; arguments as for a call."""
        of_run, of_measurement = (None, None) if rng is None else generator(rng).spawn(2)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            measured, places, fit = self._fitted(self._measured(machine, of_measurement))
            many = self._evaluation(fit, measured)
            model = fit.calibrated(measured)
            plant = assemble_plant(model, self.ports, evaluation=many)
            plant = plant.discretized(self.rate, delay=self.delay)
            observer = design_kalman(plant)
            if self.blocks is None:
                off = fit.uncertainty(measured, mesh=self.mesh)
                blocks, left_out = self._designed(plant.uncertain(off))
            else:
                blocks = tuple(self.blocks)
                left_out = close_loop(plant, *blocks).left_out
            loop = self._loop(machine, plant, blocks)
            run = simulate(loop, duration=self.duration, reference=self.reference, rng=of_run)
            check = self.specification
            verdict = None if check is None else check.check(loop, run)
            stages = measured, fit, observer, blocks, left_out, loop, run, verdict, places
            report = MachineReport({}, *stages)
            row = self._row(report)
        row["warnings"] = len(said)
        return report.replace(row=row, warned=tuple(str(one.message) for one in said))

    def _measured(self, machine: Any, rng: Any) -> MeasuredModes:
        """Return the modes of a machine; those of an FRF without numbers."""
        if isinstance(machine, MeasuredModes):
            return machine
        if isinstance(machine, Frf):
            return identify_modes(machine, band=self.band, hold=self.hold)
        if self.measurement is not None:
            frf = machine.measure_frf(self.ports, **self.measurement, rng=rng)
            return identify_modes(frf, band=self.band, hold=self.hold)
        if self.modes is None:
            raise ModelError(
                f"the machine {short(machine)} is no FRF, and it is not said what to measure on "
                "it. Give modes= (numbers, for its poles) or measurement= (options of its "
                "measure_frf, or {})."
            )
        errors = {"deviation": self.deviation, "rng": rng} if self.deviation else {}
        poles: MeasuredModes = machine.poles(self.modes, **errors)
        return poles

    def _fitted(
        self, found: MeasuredModes
    ) -> tuple[MeasuredModes, Localisation | None, UpdateResult]:
        """Return the modes that are used, the places of a change, and the update."""
        # modes without numbers are paired with those of the drawing, then with those of the updated
        # model, until the pairs stay: a change that is not small turns the shapes of close modes
        known = self._numbered(found, self.model)
        for _ in range(_PAIRINGS):
            places, fit = self._updated(known)
            used, known = known, self._numbered(found, fit.model)
            if known.modes == used.modes:
                break
        return used, places, fit

    def _numbered(self, found: MeasuredModes, model: ReducedModel) -> MeasuredModes:
        if found.modes is not None:
            return found
        at = {sensor.name: sensor.at for sensor in self.ports.y}
        known = numbered(found, model, at=at, partial=True)
        if self.modes is None:
            return known
        return known.select([i for i, mode in enumerate(known.modes or ()) if mode in self.modes])

    def _updated(self, measured: MeasuredModes) -> tuple[Localisation | None, UpdateResult]:
        residuals, unknowns, places = [Eigenvalues(measured)], list(self.parameters), None
        if self.candidates:
            places = localise(self.model, self.candidates, residuals, nuisance=unknowns)
            chosen = [one for one in self.candidates if one.name in places.chosen]
            unknowns = [*unknowns, *chosen]
        return places, update(self.model, unknowns, residuals, starts=self.starts)

    def _evaluation(self, fit: UpdateResult, measured: MeasuredModes) -> Modes:
        """Return the modes of the updated full structure, calibrated unless damping couples them.

        Its numbers are the reduced model's, or it is left as it is where its order differs.
        """
        known = self.full
        if isinstance(known, FEModel):
            count = min(self.evaluation_modes, known.n_dof)
            many = solve_modes(fit.applied_to(known), count=count, damping=self.damping)
        else:
            if isinstance(known, Modes):  # their attachment vectors count among the modes left out
                known = reduce(known, ModalTruncation(known.n_modes))
            many = fit.applied_to(known.completed()).modes()
        numbers = np.array(measured.modes) - 1
        if np.iscomplexobj(many.phi) or numbers.max() >= many.n_modes:
            return many
        near = np.abs(many.omega[numbers] / np.abs(measured.poles) - 1.0) < _SAME
        return many.calibrated(measured) if near.all() else many

    def _designed(self, plant: UncertainPlant[Any]) -> tuple[tuple[Any, ...], SpillOver | None]:
        """Return the fastest controller that tolerates what is not known, and how it holds."""
        for wanted in self._tried:
            try:
                found = design_stage(plant, bandwidth=wanted, margin=self.margin)
                break
            except InfeasibleError:
                if wanted == self._tried[-1]:
                    raise
        return (found,), found.left_out

    def _loop(self, machine: Any, plant: StandardPlant, blocks: Sequence[Any]) -> ClosedLoop:
        """Return the loop on a virtual machine, else on the evaluation model."""
        if hasattr(machine, "loop"):
            own: ClosedLoop = machine.loop(self.ports, *blocks)
            return own
        return close_loop(plant.evaluation_plant or plant, *blocks)

    def _row(self, found: MachineReport) -> dict[str, Any]:
        fit, loop = found.fit, found.loop
        row: dict[str, Any] = {one.name: 0.0 for one in self.candidates}
        row |= {one.name: float(p) for one, p in zip(fit.unknowns, fit.values, strict=True)}
        row["modes measured"] = len(found.measured)
        row["p value"] = np.nan if fit.p_value is None else fit.p_value
        poi, axis = self.ports.followed[0]
        row["estimate rms"] = found.observer.rms(poi.channel(axis))
        row["margin expected"] = np.nan if found.left_out is None else found.left_out.modulus_margin
        row["stable"] = loop.is_stable
        row["spectral radius"] = loop.spectral_radius
        row["modulus margin"] = loop.modulus_margin
        try:
            row["bandwidth"] = bandwidth(loop)
        except AssumptionError:  # not stable, or |S| is nowhere below 0 dB
            row["bandwidth"] = np.nan
        steady = float(np.max(found.run.rms(self.error, start=0.5 * self.duration)))
        row["error rms"] = steady if loop.is_stable else np.nan
        if found.verdict is not None:
            row |= {n: found.verdict[n] for n in found.verdict.names if n not in row}
            row["passed"] = found.verdict.passed
        return row


@dataclass(frozen=True, eq=False, repr=False)
class MachineReport(Value):
    """All stages of a `MachinePipeline` for one machine; prints as a text of some forty lines.

    Parameters
    ----------
    row : mapping {column: number, truth or text}
        Its line in the table of a study.
    measured : MeasuredModes
        Identified, or as they were given.
    fit : UpdateResult
        The update of the model.
    observer : KalmanEstimator
        Of the POI, with the modes left out as noise.
    blocks : tuple of StateSpace or Controller
    left_out : SpillOver or None
        The certificate on the evaluation model: how the loop stands with the modes left out.
    loop : ClosedLoop
        On the machine; on the evaluation model for a machine that was measured only.
    run : Response
        Of that loop.
    verdict : Verdict, optional
        Beside the specification.
    places : Localisation, optional
        Which candidates joined the update.
    warned : tuple of str
        What was warned of on the way.
    """

    row: Mapping[str, Any]
    measured: MeasuredModes
    fit: UpdateResult
    observer: KalmanEstimator
    blocks: tuple[Any, ...]
    left_out: SpillOver | None
    loop: ClosedLoop
    run: Response
    verdict: Verdict | None = None
    places: Localisation | None = None
    warned: tuple[str, ...] = ()

    @cached_property
    def agreement(self) -> ConsistencyReport:
        """The run beside the model: which modes are elsewhere on the machine, by how much."""
        return consistency(self.observer, self.run)

    def __repr__(self) -> str:
        numbers = [
            f"{name}: {value:.5g}" if isinstance(value, float) else f"{name}: {value}"
            for name, value in self.row.items()
        ]
        sections: dict[str, Sequence[Any]] = {
            "Measured": [self.measured],
            "Localised": [self.places],
            "Updated": [self.fit],
            "Observer": [self.observer],
            "Controller": self.blocks,
            "Loop on the evaluation model": [self.left_out and self.left_out.summary],
            "Loop that was run": [self.loop],
            "The run beside the model": [self._judged()],
            "Specification": [self.verdict],
            "In numbers": numbers,
            "Warnings": self.warned,
        }
        lines = []
        for heading, parts in sections.items():
            shown = "\n".join(str(part) for part in parts if part is not None)
            if shown:
                lines += [heading, *(f"  {line}" for line in shown.splitlines()), ""]
        return "\n".join(lines[:-1])

    def _judged(self) -> ConsistencyReport | str:
        """Return how the run agrees with the model, or why that cannot be said."""
        try:
            return self.agreement
        except FlexplantError as error:
            return f"not judged: {error}"

    def write(self, path: str | Path) -> None:
        """Write the text to a file, at once or not at all; `save` keeps the values themselves."""
        with written(path) as file:
            file.write(f"{self!r}\n".encode())
