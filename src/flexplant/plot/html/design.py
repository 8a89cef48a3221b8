"""The values of a report, each with a name, found again by what they are."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar

from ...errors import ModelError
from ...loop import ClosedLoop
from ...plant import StandardPlant
from ...values import Value, short

Kind = TypeVar("Kind")


class Design:
    """Named values in the order in which they were given."""

    def __init__(self, parts: Sequence[Any]) -> None:
        self.named: dict[str, Any] = {}
        for name, value in _listed(parts):
            own = name or _free(type(value).__name__, self.named)
            if own in self.named:
                raise ModelError(f"two parts of the report are named {own!r}: rename one.")
            self.named[own] = value
        if not self.named:
            raise ModelError(
                "there is nothing to report: pass values, such as a closed loop and its run."
            )

    def of(self, kind: type[Kind]) -> dict[str, Kind]:
        """Return the values of a kind by name."""
        return {name: one for name, one in self.named.items() if isinstance(one, kind)}

    @property
    def plant(self) -> StandardPlant | None:
        """The plant that was given, else that of the first loop."""
        own: list[StandardPlant] = list(self.of(StandardPlant).values())
        return next(iter([*own, *(loop.plant for loop in self.of(ClosedLoop).values())]), None)


def _listed(parts: Sequence[Any]) -> Iterator[tuple[str, Any]]:
    for part in parts:
        named = isinstance(part, Mapping) and not isinstance(part, Value)
        for name, value in part.items() if named else [("", part)]:
            if not isinstance(value, Value):
                raise ModelError(
                    f"a report holds values of flexplant, got {short(value)}. Pass plants, loops, "
                    "controllers, runs and so on, or mappings of names to such."
                )
            yield str(name), value


def _free(name: str, taken: Mapping[str, Any]) -> str:
    numbers = (f" {i}" if i > 1 else "" for i in range(1, len(taken) + 2))
    return next(f"{name}{number}" for number in numbers if f"{name}{number}" not in taken)
