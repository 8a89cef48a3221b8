"""What `dir` and completion show of a room: its public names, not the modules behind them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType


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
