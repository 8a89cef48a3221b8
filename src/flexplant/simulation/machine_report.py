"""The report of one machine: what each stage of a pipeline found, to read and to keep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..estimation import KalmanEstimator
from ..identification import MeasuredModes
from ..loop import ClosedLoop, SpillOver
from ..store import written
from ..updating import Localisation, UpdateResult
from ..values import Value
from .response import Response
from .specification import Verdict


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
        The controller.
    left_out : SpillOver or None
        The certificate on the larger model: how the loop on the updated one stands with the modes
        left out.
    loop : ClosedLoop
        On the machine; on the larger model for a machine that was measured only.
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

    def __post_init__(self) -> None:
        self._set(row=dict(self.row), blocks=tuple(self.blocks), warned=tuple(self.warned))

    def __repr__(self) -> str:
        sections: dict[str, Sequence[Any]] = {
            "Measured": [self.measured],
            "Localised": [self.places],
            "Updated": [self.fit],
            "Observer": [self.observer],
            "Controller": self.blocks,
            "Loop on the larger model": [self.left_out and self.left_out.summary],
            "Loop that was run": [self.loop],
            "Specification": [self.verdict],
            "In numbers": [f"{name}: {_shown(value)}" for name, value in self.row.items()],
            "Warnings": self.warned,
        }
        lines = []
        for heading, parts in sections.items():
            shown = "\n".join(str(part) for part in parts if part is not None)
            if shown:
                lines += [heading, *(f"  {line}" for line in shown.splitlines()), ""]
        return "\n".join(lines[:-1])

    def write(self, path: str | Path) -> None:
        """Write the text to a file, at once or not at all; `save` keeps the values themselves.

        Parameters
        ----------
        path : str or Path
            The file, replaced when it is there.
        """
        with written(path) as file:
            file.write(f"{self!r}\n".encode())


def _shown(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)
