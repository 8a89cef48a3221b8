"""Seeds of random draws, and how many draws one call may make."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from .errors import ModelError, short
from .words import several

#: what seeds chance
Rng: TypeAlias = int | np.random.SeedSequence | np.random.Generator | None
#: number of refused draws in a row after which there is nothing to draw
REFUSED = 200
#: draws, runs, machines or starts in one call: days on any computer, so that more is a mistake
MOST_DRAWS = 10**7


def seed_sequence(rng: Any, name: str = "rng") -> np.random.SeedSequence:
    """Return the SeedSequence that a seed, SeedSequence, Generator or None stands for."""
    # a Generator is drawn from, so that two calls with the same one differ
    if isinstance(rng, np.random.SeedSequence):
        return rng
    if isinstance(rng, np.random.Generator):
        return np.random.SeedSequence(rng.integers(0, 2**32, size=4).tolist())
    if rng is None:
        return np.random.SeedSequence()
    numbers = [rng] if isinstance(rng, int | np.integer) else rng
    if isinstance(numbers, list | tuple | np.ndarray) and several(numbers):
        entropy = [n for n in numbers if isinstance(n, int | np.integer) and n >= 0]
        if len(entropy) == len(numbers) and not any(isinstance(n, bool) for n in numbers):
            given = [int(n) for n in entropy]
            return np.random.SeedSequence(given[0] if numbers is not rng else given)
    raise ModelError(
        f"{name} must be a seed (a whole number from 0, or several), a SeedSequence, a Generator "
        f"or None, got {short(rng)}. Pass an int to have the same draw again."
    )


def seed_of(sequence: np.random.SeedSequence) -> int | tuple[int, ...]:
    """Return the number, or numbers, that give the same draws as a SeedSequence when passed as rng.

    For a spawned SeedSequence it is a list: four words of entropy, then the key of its place.
    """
    entropy: Any = sequence.entropy
    given = entropy if isinstance(entropy, Sequence | np.ndarray) else (entropy,)
    numbers = tuple(int(number) for number in given)
    if not sequence.spawn_key:
        return numbers[0] if given is not entropy else numbers
    words = [n >> k & 0xFFFFFFFF for n in numbers for k in range(0, max(n.bit_length(), 1), 32)]
    return (*words, *(0,) * (sequence.pool_size - len(words)), *sequence.spawn_key)


def generator(rng: Any, name: str = "rng") -> np.random.Generator:
    """Return the Generator that a seed, SeedSequence, Generator or None stands for."""
    if isinstance(rng, np.random.Generator):
        return rng
    return np.random.default_rng(seed_sequence(rng, name))
