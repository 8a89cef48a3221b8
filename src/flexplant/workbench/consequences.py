"""Results that take longer than a slider may wait: all axes, truncated modes, errors; tuning."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray
from ..errors import AssumptionError, FlexplantError, SolverError
from ..loop import ClosedLoop, LoopReport, close_loop, report_loops
from ..loop.other_machines import BANDWIDTH, MODULUS_MARGIN
from ..lti.interconnection import feedback, series
from ..lti.response_solvers import Recursion
from ..lti.sampling import discretized
from ..parallel import bars_of_thread
from ..plant import AnyPlant, StandardPlant
from ..simulation import simulate
from ..simulation.motion import SetPointProfile
from ..store import load
from ..synthesis import LoopDesign, ShapedAxis, tune_loops
from ..synthesis.laws.loop_design import axes_controller
from .evaluation import AxisLoop, BenchMachine

#: duration of a step relative to the time of a crossover, and samples at most, a power of two
_PERIODS, _SAMPLES = 8.0, 1 << 14


@dataclass(eq=False)
class Consequences:
    """The results; `missing` names those that could not be computed, with the reason."""

    report: LoopReport | None = None
    radius: str = ""
    left_out: str = ""
    left_out_fine: bool | None = None
    channel: str = ""
    rms: float = float("nan")
    unit: str = ""
    sources: Sequence[tuple[str, float]] = ()
    on_machines: Sequence[tuple[str, str]] = ()
    time: FloatArray = field(default_factory=lambda: np.zeros(0))
    error: FloatArray = field(default_factory=lambda: np.zeros(0))
    time_label: str = ""
    missing: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Question:
    """A design on a machine whose consequences are computed, with a model where there is one."""

    machine: BenchMachine
    model: BenchMachine | None
    channel: str | None
    move: SetPointProfile | None

    @property
    def plant(self) -> StandardPlant | None:
        """The machine of the model, if there is one, without weights."""
        given = None if self.model is None else self.model.given
        given = getattr(given, "nominal", given)
        return given.machine if isinstance(given, AnyPlant) else None

    def answer(self, design: LoopDesign, loop: AxisLoop) -> Consequences:
        """Return all results that take longer than a slider may wait."""
        found = Consequences()
        with warnings.catch_warnings(action="ignore"):  # the page shows their text
            steps = (self._all_axes, self._on_the_plant, self._in_time)
            for step in steps:
                try:
                    step(found, design, loop)
                except FlexplantError as error:
                    found.missing.append(str(error))
                except (ArithmeticError, np.linalg.LinAlgError) as error:
                    found.missing.append(f"no answer: {error}")
        return found

    def _all_axes(self, found: Consequences, design: LoopDesign, loop: AxisLoop) -> None:
        parts = self.machine.axes.plant, axes_controller(self.machine.axes, design.laws)
        found.report = report_loops(parts, at="y", rigid=design.rigid, unstable=design.unstable)

    def _closed(self, design: LoopDesign) -> ClosedLoop | None:
        """Return the loop of the standard plant with the controller, reading what the plant has."""
        plant = self.plant
        if plant is None:
            return None
        K = design.controller()
        owners = tuple(f"{name}:" for name in plant.y if name.endswith(":ref"))
        read = [n for n in K.inputs if n in plant.y or n.startswith(owners)]
        return close_loop(plant, K.select(inputs=read))

    def _on_the_plant(self, found: Consequences, design: LoopDesign, loop: AxisLoop) -> None:
        closed, plant = self._closed(design), self.plant
        if closed is None or plant is None:
            return
        found.radius = closed.decay
        if closed.left_out is not None:
            found.left_out, found.left_out_fine = closed.left_out.summary, closed.left_out.is_fine
        errors = [name for name in plant.z if name.endswith(":error")]
        found.channel = self.channel or (errors or list(plant.z))[0]
        if not closed.is_stable:
            return
        budget = closed.budget(found.channel)
        found.unit = plant.units.get(found.channel, "")
        found.rms = float(budget.rms)
        each = zip(budget.names, np.sqrt(np.maximum(budget.variances, 0.0)), strict=True)
        found.sources = sorted(((n, float(v)) for n, v in each), key=lambda one: -one[1])[:12]
        if plant.dt and plant.machine.machines is not None:
            names = (found.channel, MODULUS_MARGIN, BANDWIDTH)
            found.on_machines = [(name, closed.interval(name).sentence) for name in names]

    def _in_time(self, found: Consequences, design: LoopDesign, loop: AxisLoop) -> None:
        if loop.is_stable is False:
            raise AssumptionError("the loop is unstable: its error grows and is not drawn.")
        plant = self.plant
        if self.move is not None and plant is not None:
            closed = self._closed(design)
            if closed is not None and plant.dt:
                run = simulate(
                    closed, reference=self.move, duration=1.5 * self.move.duration, noise=False,
                    progress=False,
                )  # fmt: skip
                found.time, found.error = run.time, run[found.channel]
                found.time_label = f"{found.channel} of the set-point, without noise"
                return
        cross = loop.margins.crossovers
        reach = _PERIODS / cross[0] if cross else 1.0
        if self.model is not None:
            found.time, found.error = step_of_model(self.model, design, loop.name, reach)
            found.time_label = f"error of {loop.name} after a unit step, exact"
        elif loop.law.rate:
            found.time, found.error = step_of_lines(loop, reach)
            found.time_label = f"error of {loop.name} after a unit step, from the lines"


def step_of_model(
    model: BenchMachine, design: LoopDesign, name: str, duration: float
) -> tuple[FloatArray, FloatArray]:
    """Return time and error of an axis after a unit step of its reference, all axes closed."""
    axes = model.axes
    forward = series(-axes_controller(axes, design.laws), axes.plant)
    T = feedback(forward)
    a = axes.names.index(name)
    T = T.select(T.outputs[a], T.inputs[a])
    if not T.dt:
        size = np.abs(T.poles()) / (2.0 * np.pi)
        T = discretized(
            T, max(200.0 / duration, 4.0 * float(np.median(size)) if size.size else 4.0)
        )
    steps = int(np.clip(duration / T.dt, 50, _SAMPLES))
    out, _ = Recursion(T.A, T.B, T.C, T.D).run(np.ones((steps, 1)), np.zeros(T.n_states))
    return np.asarray(np.arange(steps) * T.dt), np.asarray(1.0 - out[:, 0])


def step_of_lines(loop: AxisLoop, duration: float) -> tuple[FloatArray, FloatArray]:
    """Return time and error of an axis after a unit step, by the transform of S on its lines."""
    # below the lines S falls as the loop gain grows there, above them it is 1; the samples of the
    # error are the sums of its impulse response
    rate, f = loop.law.rate, loop.freq
    grid = np.linspace(0.0, 0.5 * rate, _SAMPLES // 2 + 1)
    S = np.interp(grid, f, loop.S.real) + 1j * np.interp(grid, f, loop.S.imag)
    S[grid > f[-1]] = 1.0
    below = grid < f[0]
    slope = np.log(np.abs(loop.S[1] / loop.S[0])) / np.log(f[1] / f[0])
    S[below] = loop.S[0] * (grid[below] / f[0]) ** max(slope, 1.0)
    error = np.cumsum(np.fft.irfft(S, _SAMPLES))
    steps = int(np.clip(duration * rate, 50, _SAMPLES // 2))
    return np.asarray(np.arange(steps) / rate), np.asarray(error[:steps])


#: period of the progress reports of the process, and of looking for them [s]
PERIOD = 0.3


class Tuning:
    """A search for control laws, started with the limit of |S| and the axes of a page."""

    def __init__(self, plant: Any, design: LoopDesign, peak: float, notches: int) -> None:
        self._design = design
        self._folder = tempfile.TemporaryDirectory(prefix="flexplant-")
        folder = Path(self._folder.name)
        getattr(plant, "nominal", plant).save(folder / "plant.npz")
        design.save(folder / "design.npz")
        #: its effect, in words
        self.said = "starting"
        words = [sys.executable, "-m", __name__, self._folder.name, repr(peak), str(notches)]
        self._process = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        for line in self._process.stdout or ():
            self.said = line.strip()

    @property
    def is_running(self) -> bool:
        """Whether the search still runs."""
        return self._process.poll() is None

    def stop(self) -> None:
        """End the search without a result."""
        if self.is_running:
            self._process.kill()
        self._process.communicate()
        self._folder.cleanup()

    def result(self) -> LoopDesign:
        """Return the design that was found, or raise the error of the search."""
        _, said = self._process.communicate()
        found = Path(self._folder.name) / "found.npz"
        try:
            if not found.exists():
                lines = said.strip().splitlines()
                raise SolverError(lines[-1] if lines else "the search ended without an answer.")
            design = load(found)
        finally:
            self._folder.cleanup()
        kept = {name: axis.feedforward for name, axis in self._design.axes.items()}
        axes = {n: axis.replace(feedforward=kept[n]) for n, axis in design.axes.items()}
        return self._design.replace(axes=axes)


def search(folder: Path, peak: float, notches: int) -> None:
    """Search in the child process: it reads files and writes one."""
    plant, design = load(folder / "plant.npz"), load(folder / "design.npz")
    bars, over = bars_of_thread(), threading.Event()

    def report() -> None:
        seconds = 0.0
        while not over.wait(PERIOD):
            seconds += PERIOD
            done = bars[-1].done if bars else 0
            step = f"axis {done + 1}" if done < len(design.axes) else "all axes together"
            sys.stdout.write(f"searching, {step} of {len(design.axes)}, {seconds:.0f} s\n")
            sys.stdout.flush()

    threading.Thread(target=report, daemon=True).start()
    measured = type(plant).__name__ == "Frf"
    more: dict[str, Any] = {}
    if measured:
        more = {"rate": design.rate or None, "delay": design.delay, "hold": design.hold}
        more["rigid"] = design.rigid
    with warnings.catch_warnings(action="ignore"):
        found = tune_loops(
            plant, before=design.before, after=design.after, peak=peak, notches=notches,
            progress=False, **more,
        )  # fmt: skip
    over.set()
    axes = {name: ShapedAxis(tuple(law.factors), law.gain) for name, law in found.laws.items()}
    design.replace(axes=axes).save(folder / "found.npz")


if __name__ == "__main__":
    try:
        search(Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]))
    except FlexplantError as problem:
        sys.exit(str(problem))
