"""The usual chain for one machine of many: measured poles, update, designs, a run, a report."""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import AssumptionError, ModelError
from ..estimation import KalmanEstimator, design_kalman
from ..loop import ClosedLoop, bandwidth
from ..modes import solve_modes
from ..plant import Ports, StandardPlant, assemble_plant, reference_errors, stage_weights
from ..reduction import ReducedModel
from ..structure import FEModel
from ..synthesis import Controller, design_hinf
from ..updating import Eigenvalues, UpdateResult, localise, update
from ..values import Value, positive, whole
from .response import Response
from .simulate import simulate
from .specification import Specification, Verdict


@dataclass(frozen=True, eq=False, repr=False)
class MachinePipeline(Value):
    """The chain measure, localise, update, plant, observer, controller, verify, for `study`.

    Called with a machine it returns a row: the parameters found, what the observer predicts, and
    what the controller reaches *on the machine*, beside the specification. A machine answers to
    ``poles(modes)`` with MeasuredModes (ideal ones, or those that `identify_modes` and `numbered`
    find in its FRFs), to ``loop(ports, *blocks)`` and to ``run(ports, *blocks, duration=,
    reference=, rng=)``, as `fx.testbeds.WaferStage` does.

    Parameters
    ----------
    model : ReducedModel
        Of the drawing.
    full : FEModel
        The drawing itself, whose further modes count in the observer and in the check of the loop.
    parameters : sequence
        What is updated on each machine.
    ports : Ports
        Channels of every machine, with a reference for its POI.
    rate : float [Hz]
        Of the controller.
    delay : int [samples]
        From measurement to actuation.
    modes : sequence of int
        Numbers of the modes whose poles are measured.
    starts : int, optional
        From how many places each update searches, for parameters with bounds: poles alone may be
        explained nearly as well by masses elsewhere.
    candidates : sequence
        Parameters of which `localise` chooses those that join the update.
    bandwidth : float or sequence of float [Hz]
        Of the H-infinity design on the updated model: the first of them, from the highest on,
        whose loop has `margin` with the modes left out; the lowest where none has.
    margin : float
        Modulus margin at u that a design must have there.
    blocks : sequence, optional
        A controller for all machines (StateSpaces or Controllers), in place of a design for each.
    specification : Specification, optional
        What the loop on the machine is checked against.
    reference : SetPoint, array or mapping, optional
        Of the run on the machine.
    duration : float [s]
        Of that run.
    larger : int
        Modes of the updated full structure that are known beyond the reduced model's.
    folder : path, optional
        Where one report for each machine is written, a text file.

    Raises
    ------
    ModelError
        When a value is of another kind or out of range.
    """

    model: ReducedModel
    full: FEModel
    parameters: Sequence[Any]
    ports: Ports
    rate: float
    delay: int
    modes: Sequence[int]
    starts: int | None = None
    candidates: Sequence[Any] = ()
    bandwidth: float | Sequence[float] = 50.0
    margin: float = 0.4
    blocks: Sequence[Any] | None = None
    specification: Specification | None = None
    reference: Any = None
    duration: float = 1.0
    larger: int = 80
    folder: str | None = None

    def __post_init__(self) -> None:
        for name, kind in (("model", ReducedModel), ("full", FEModel), ("ports", Ports)):
            if not isinstance(getattr(self, name), kind):
                raise ModelError(f"{name} must be of type {kind.__name__}. Give one of that type.")
        if not self.ports.references:
            raise ModelError("the ports need a reference for the POI: references=[Reference(...)].")
        self._set(
            parameters=tuple(self.parameters),
            rate=positive(self.rate, "rate"),
            delay=whole(self.delay, "delay", minimum=0),
            modes=tuple(self.modes),
            candidates=tuple(self.candidates),
            bandwidth=tuple(sorted(map(_hertz, np.atleast_1d(self.bandwidth)), reverse=True)),
            margin=positive(self.margin, "margin"),
            blocks=None if self.blocks is None else tuple(self.blocks),
            duration=positive(self.duration, "duration"),
            larger=whole(self.larger, "larger"),
            folder=None if self.folder is None else str(self.folder),
        )

    def __repr__(self) -> str:
        tried = ", ".join(f"{one:g}" for one in np.atleast_1d(self.bandwidth))
        control = "one controller for all" if self.blocks else f"H-infinity, {tried} Hz"
        return f"<MachinePipeline: {len(self.parameters)} parameters updated, {control}>"

    @property
    def error(self) -> str:
        """The error channel of the POI, the first that has a reference."""
        return f"{self.ports.references[0].poi}:error"

    def __call__(self, machine: Any, rng: Any = None) -> dict[str, Any]:
        """Return the row of one machine.

        Parameters
        ----------
        machine : object
            Answers to what is named above.
        rng : numpy.random.Generator, optional
            Of the noise of its run.
        """
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            fit = self._updated(machine)
            many = solve_modes(fit.applied_to(self.full), count=self.larger)
            plant = assemble_plant(fit.model, self.ports).discretized(self.rate, delay=self.delay)
            observer = design_kalman(plant, larger=many)
            blocks = self._designed(plant, many) if self.blocks is None else self.blocks
            loop = machine.loop(self.ports, *blocks)
            run = simulate(
                loop,
                duration=self.duration,
                reference=self.reference,
                rng=None if rng is None else rng.spawn(1)[0],
            )
            verdict = None if self.specification is None else self.specification.check(loop, run)
        row = self._row(fit, observer, loop, run, verdict)
        row["warnings"] = len(said)
        if self.folder is not None:
            parts = (fit, plant, observer, *blocks, loop, verdict or "no specification")
            lines = [*map(repr, parts), *(str(one.message) for one in said)]
            row["report"] = _written(Path(self.folder), "\n\n".join(lines) + "\n")
        return row

    def _updated(self, machine: Any) -> UpdateResult:
        residuals = [Eigenvalues(machine.poles(self.modes))]
        chosen = []
        if self.candidates:
            places = localise(
                self.model, residuals, self.candidates, nuisance=list(self.parameters)
            )
            chosen = [one for one in self.candidates if one.name in places.chosen]
        return update(self.model, [*self.parameters, *chosen], residuals, starts=self.starts)

    def _designed(self, plant: StandardPlant, many: Any) -> tuple[Any, Controller]:
        """Return the errors that the H-infinity controller reads, and the controller."""
        errors = reference_errors(plant)
        for wanted in np.atleast_1d(self.bandwidth):
            weights = stage_weights(plant, float(wanted))
            weighted = plant.through(errors).weighted(z=weights.z, w=weights.w)
            found = design_hinf(weighted, larger=many)
            if found.left_out is not None and found.left_out.modulus_margin >= self.margin:
                break
        return errors, found

    def _row(
        self,
        fit: UpdateResult,
        observer: KalmanEstimator,
        loop: ClosedLoop,
        run: Response,
        verdict: Verdict | None,
    ) -> dict[str, Any]:
        row: dict[str, Any] = {one.name: 0.0 for one in self.candidates}
        row |= {one.name: float(p) for one, p in zip(fit.unknowns, fit.values, strict=True)}
        row["estimate rms"] = observer.rms(self.error.replace(":error", ":z"))
        row["stable"] = loop.is_stable
        row["spectral radius"] = loop.spectral_radius
        row["modulus margin"] = loop.modulus_margin
        try:
            row["bandwidth"] = bandwidth(loop)
        except AssumptionError:  # not stable, or |S| is nowhere below 0 dB
            row["bandwidth"] = float("nan")
        steady = float(np.max(run.rms(self.error, start=0.5 * self.duration)))
        row["error rms"] = steady if loop.is_stable else float("nan")
        if verdict is not None:
            row |= {name: verdict[name] for name in verdict.names if name not in row}
            row["passed"] = verdict.passed
        return row


def _hertz(value: Any) -> float:
    return positive(value, "bandwidth")


def _written(folder: Path, text: str) -> str:
    """Write a report, named by its content, at once or not at all; return the file's name."""
    name = f"machine-{hashlib.sha256(text.encode()).hexdigest()[:12]}.txt"
    folder.mkdir(parents=True, exist_ok=True)
    part = folder / f".{name}.{os.getpid()}"
    part.write_text(text)
    part.replace(folder / name)
    return name
