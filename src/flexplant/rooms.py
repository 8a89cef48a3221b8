"""What a room shows: its public names, not the modules behind them; its functions as `calls` has.

Functions are replaced in the module that defines them too, where pickling looks for them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import FunctionType, ModuleType
from typing import Any

from .calls import answering


def public_names(room: str) -> Callable[[], list[str]]:
    """Return the `__dir__` of a package, the names that it re-exports; its functions answer."""
    for name, item in [*vars(sys.modules[room]).items()]:
        if not isinstance(item, FunctionType) or name.startswith("_"):
            continue
        module, made = sys.modules[item.__module__], answering(item)
        setattr(sys.modules[room], name, made)
        if vars(module).get(name) is item:
            setattr(module, name, made)

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
