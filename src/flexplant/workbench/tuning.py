"""Tuning: tune_loops in a process of its own, which reports how far it is and can be stopped."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import warnings
from pathlib import Path
from typing import Any

from ..errors import FlexplantError, SolverError
from ..parallel import bars_of_thread
from ..store import load
from ..synthesis import LoopDesign, ShapedAxis, tune_loops

#: how often the process says how far it is [s]
_PERIOD = 0.3


class Tuning:
    """A search for laws that began with the peak and the axes of a page."""

    def __init__(
        self, plant: Any, design: LoopDesign, peak: float, notches: int, larger: Any = None
    ) -> None:
        self._design = design
        self._folder = tempfile.TemporaryDirectory(prefix="flexplant-")
        folder = Path(self._folder.name)
        getattr(plant, "nominal", plant).save(folder / "plant.npz")
        design.save(folder / "design.npz")
        if larger is not None:
            larger.save(folder / "larger.npz")
        #: what it does, in words
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
        """Whether it still searches."""
        return self._process.poll() is None

    def stop(self) -> None:
        """End the search; nothing of it is kept."""
        if self.is_running:
            self._process.kill()
        self._process.communicate()
        self._folder.cleanup()

    def result(self) -> LoopDesign:
        """Return the design that was found; raise the message of the search where it found none."""
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
    """Search in the process: files in, a file out."""
    plant, design = load(folder / "plant.npz"), load(folder / "design.npz")
    larger = load(folder / "larger.npz") if (folder / "larger.npz").exists() else None
    bars, over = bars_of_thread(), threading.Event()

    def report() -> None:
        seconds = 0.0
        while not over.wait(_PERIOD):
            seconds += _PERIOD
            done = bars[-1].done if bars else 0
            step = f"axis {done + 1}" if done < len(design.axes) else "all axes together"
            sys.stdout.write(f"searching, {step} of {len(design.axes)}, {seconds:.0f} s\n")
            sys.stdout.flush()

    threading.Thread(target=report, daemon=True).start()
    measured = type(plant).__name__ == "Frf"
    more: dict[str, Any] = {"larger": larger}
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
