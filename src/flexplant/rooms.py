"""What `dir` and completion show of a room: its public names, not the modules behind them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


def public_names(room: str) -> Callable[[], list[str]]:
    """Return the `__dir__` of a package: the names that it re-exports."""

    def names() -> list[str]:
        shown = vars(sys.modules[room]).items()
        return [
            name
            for name, item in shown
            if not name.startswith("_") and not isinstance(item, ModuleType)
        ]

    return names


class _CalledRoom(ModuleType):
    """A room with one main function, whose name it has: `flexplant.workbench(...)` calls that."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        """Call the function."""
        return getattr(self, self.__name__.rpartition(".")[2])(*args, **options)


def called_names(room: str) -> Callable[[], list[str]]:
    """Return the `__dir__` of a package that is called itself, by its function of that name."""
    sys.modules[room].__class__ = _CalledRoom
    return public_names(room)
