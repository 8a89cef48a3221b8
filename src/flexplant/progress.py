"""A bar for long work, where somebody sees it: on a terminal and in a notebook."""

from __future__ import annotations

import sys
import threading
from types import TracebackType
from typing import Any, Self

#: shorter work than this shows no bar [s]
PATIENCE = 2.0
#: a bar that nothing advances is drawn anew after this long, for the time it shows [s]
_AGAIN = 1.0
#: the bars that a thread is inside of
_open = threading.local()


class Progress:
    """A bar for long work: after two seconds, on a terminal or in a notebook, unless forced.

    Work inside of other work shows none of its own, neither here nor in the process of a pool.
    """

    def __init__(
        self, total: int | None, description: str, *, progress: bool | None = None
    ) -> None:
        self.bar: Any = None
        #: items counted
        self.done = 0
        self.description = description
        self._over = threading.Event()
        self._forced = bool(progress)
        stream = watched() if progress is None and not _inside() else None
        if progress or stream is not None:
            from tqdm import tqdm

            self.bar = tqdm(
                total=total,
                desc=description,
                bar_format=None if total != 0 else "{desc}: {elapsed}",
                delay=0.0 if progress else PATIENCE,
                leave=bool(progress),
                file=stream or sys.stderr,
            )

    def __enter__(self) -> Self:
        _inside().append(self)
        if self.bar is not None and not self._forced:
            threading.Thread(target=self._shown, daemon=True).start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        _inside().remove(self)
        if self.bar is not None:
            self.bar.close()

    def advance(self, items: int = 1) -> None:
        """Count some items as done."""
        self.done += items
        if self.bar is not None:
            self.bar.update(items)

    def _shown(self) -> None:
        """Draw the bar while the first item, or any later one, takes its time."""
        wait = PATIENCE
        while not self._over.wait(wait):
            self.bar.refresh()
            wait = _AGAIN


def tick(description: str) -> None:
    """Count an item of the innermost work, where that is its description.

    For loops far below the function that shows the bar; without such a bar it does nothing.
    """
    bars = _inside()
    if bars and bars[-1].description == description:
        bars[-1].advance()


def watched() -> Any:
    """Return the stream of a terminal or notebook that somebody sees; None in pipes and files."""
    if sys.stderr is not None and sys.stderr.isatty():
        return sys.stderr
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return sys.stdout if type(shell).__name__ == "ZMQInteractiveShell" else None


def _inside() -> list[Progress]:
    if not hasattr(_open, "bars"):
        _open.bars = []
    bars: list[Progress] = _open.bars
    return bars
