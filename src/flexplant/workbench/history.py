"""DesignHistory: the designs of a tab, to go back and forward; one number moved is one step."""

from __future__ import annotations

from collections.abc import Hashable

from ..synthesis import LoopDesign

#: designs that are kept
_MOST = 400


class DesignHistory:
    """Designs one after the other."""

    def __init__(self, first: LoopDesign) -> None:
        self._designs = [first]
        self._at = 0
        self._key: Hashable = None

    @property
    def now(self) -> LoopDesign:
        """The design as it is."""
        return self._designs[self._at]

    def add(self, design: LoopDesign, key: Hashable = None) -> None:
        """Take a design; of changes with one key, not None, only the last is kept."""
        if key is not None and key == self._key and self._at == len(self._designs) - 1 and self._at:
            self._designs[self._at] = design
            return
        self._designs = [*self._designs[: self._at + 1], design][-_MOST:]
        self._at = len(self._designs) - 1
        self._key = key

    def back(self) -> LoopDesign:
        """Return the design before, which is now the design; the first stays."""
        self._at, self._key = max(0, self._at - 1), None
        return self.now

    def forward(self) -> LoopDesign:
        """Return the design after; the last stays."""
        self._at, self._key = min(len(self._designs) - 1, self._at + 1), None
        return self.now
