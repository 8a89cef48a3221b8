"""What long work runs on: an executor, a bar, and a file from which it goes on when stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np

from .checkpoint import Checkpoint
from .parallel import mapped
from .values import Rng, seed_sequence

Item = TypeVar("Item")
Result = TypeVar("Result")


class Work:
    """Steps of long work: each is `mapped` on the executor, and what a file has is not repeated.

    As a context it closes the file.

    The same steps come in the same order when the work is begun again, so that results are known
    by their number.
    """

    def __init__(
        self,
        executor: Executor | None = None,
        progress: bool | None = None,
        rng: Rng = None,
        checkpoint: str | Path | None = None,
        kind: str = "work",
        header: Mapping[str, Any] | None = None,
    ) -> None:
        self.executor, self.progress = executor, progress
        source = seed_sequence(rng)
        seeds = [source.entropy, list(source.spawn_key)]
        free = ("rng",) if rng is None or isinstance(rng, np.random.Generator) else ()
        self._log = Checkpoint(checkpoint, kind, {**(header or {}), "rng": seeds}, free)
        self._done = 0

    @property
    def rng(self) -> np.random.SeedSequence:
        """Seeds of what is random."""
        entropy, key = self._log.header["rng"]
        return np.random.SeedSequence(entropy, spawn_key=tuple(key))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._log.close()

    def mapped(
        self,
        function: Callable[..., Result],
        items: Iterable[Item],
        *,
        rng: Rng = None,
        description: str = "items",
        progress: bool | None = None,
        restored: Callable[[Any], Result] | None = None,
    ) -> list[Result]:
        """Return ``[function(item) for item in items]``, without those that the file has."""
        listed = list(items)
        first, self._done = self._done, self._done + len(listed)
        rows, back = self._log.rows, restored or (lambda row: row)
        known = {i: back(rows[first + i]) for i in range(len(listed)) if first + i in rows}
        return mapped(
            function,
            listed,
            executor=self.executor,
            progress=self.progress if progress is None else progress,
            rng=rng,
            description=description,
            known=known,
            each=lambda i, result: self._log.add(first + i, result),
        )
