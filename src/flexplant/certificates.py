"""Certificates in words: what was verified after an answer was computed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .arrays import ComplexArray
from .store import Value


class Certificate(Value):
    """The base of certificates with fields; prints them as a line of words and numbers."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {one_line(self._fields())}>"


def stability_name(sampled: Any) -> str:
    """Return what stability is measured by: the spectral radius, or the largest real part."""
    return "spectral radius" if sampled else "largest real part"


def stability(poles: ComplexArray, sampled: Any) -> float:
    """Return that number of poles: a loop is stable below 1 (sampled) or 0."""
    size = np.abs(poles) if sampled else poles.real
    return float(np.max(size, initial=0.0 if sampled else -np.inf))


def one_line(found: Mapping[str, Any]) -> str:
    """Return the numbers of a certificate as one line; what is None is left out."""
    return ", ".join(_worded(name, value) for name, value in found.items() if value is not None)


def _worded(name: str, value: Any) -> str:
    what, _, unit = name.replace("_", " ").partition(" [")
    unit = "rad/s" if "real part" in name else unit.removesuffix("]")
    return f"{what} {figure(name, value)} {unit}".rstrip()


def figure(name: str, value: Any) -> str:
    """Return a number of a certificate in words: four digits, of a radius what is left to 1."""
    if not isinstance(value, int | float | np.number) or isinstance(value, bool):
        return str(value)
    if "radius" not in name and "radii" not in name:
        return f"{value:.4g}"
    left = abs(1.0 - float(value))
    digits = 4 if not 0.0 < left < 1.0 else int(np.clip(1 - np.floor(np.log10(left)), 4, 12))
    return f"{value:.{digits}f}"
