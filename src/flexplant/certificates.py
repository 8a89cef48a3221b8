"""Certificates: figures by which an answer was verified after its computation, with limits."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .arrays import ComplexArray
from .errors import aligned
from .store import Value


@dataclass(frozen=True, eq=False)
class Verified(Value):
    """One number that was computed to verify a result.

    Parameters
    ----------
    what : str
        Name of the checked quantity, with its unit in brackets if it has one: "norm", "corner
        [Hz]".
    figure : float
        Number that was found.
    route : str
        Method that computed the number. It is empty if the method is the one that gave the result.
    limit : float, optional
        Largest allowed number, or the smallest allowed number if `at_least` is true. Without a
        limit the number is only information.
    at_least : bool
        Whether the limit is a lower limit.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.loop.Verified("spectral radius", 0.97, "eigenvalues of the closed loop", limit=1.0).holds
    True
    """

    what: str
    figure: float
    route: str = ""
    limit: float | None = None
    at_least: bool = False

    @property
    def holds(self) -> bool | None:
        """Whether the number is within its limit; None if there is no limit."""
        if self.limit is None:
            return None
        return self.figure >= self.limit if self.at_least else self.figure <= self.limit

    @property
    def row(self) -> list[str]:
        """One row of a table: texts of the checked quantity, number, limit and method."""
        sign = "at least" if self.at_least else "at most"
        limit = "" if self.limit is None else f"{sign} {figure(self.what, self.limit)}"
        failed = ", not kept" if self.holds is False else ""
        return [self.what, figure(self.what, self.figure), limit + failed, self.route]


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(Value, Mapping[str, float]):
    """The numbers that verify a result, with their limits. A second method computes each of them.

    ``certificate["norm"]`` is the number that the check "norm" found. ``certificate.checks`` holds
    all checks.

    Parameters
    ----------
    checks : sequence of Verified
        Checks, each with its name, number, limit and method.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.design_kalman(fx.testbeds.three_masses()).certificate
    >>> round(found["spectral radius"], 4), found.holds
    (0.9601, True)
    """

    checks: tuple[Verified, ...] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        self._set(checks=_latest(self.checks))

    @property
    def holds(self) -> bool:
        """Whether all numbers are within their limits."""
        return all(check.holds is not False for check in self.checks)

    def __getitem__(self, what: str) -> float:
        """Return the figure of a check; KeyError where this check does not exist."""
        return {check.what: check.figure for check in self.checks}[what]

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the checks."""
        return (check.what for check in self.checks)

    def __len__(self) -> int:
        """Return the number of checks."""
        return len(self.checks)

    def __or__(self, other: Certificate) -> Certificate:
        """Return the checks of both; those of `other` replace checks of the same name."""
        if not isinstance(other, Certificate):
            return NotImplemented
        return deferred(lambda: (*self.checks, *other.checks))

    def extended(self, *checks: Verified) -> Certificate:
        """Return the certificate with further checks. They replace checks of the same name."""
        return deferred(lambda: (*self.checks, *checks))

    def __repr__(self) -> str:
        """Return a table of the checks."""
        lines = aligned(["checked", "figure", "limit", "route"], (c.row for c in self.checks))
        return "\n".join(["<Certificate", *(f"  {line}" for line in lines)]) + ">"


def deferred(computed: Callable[[], Iterable[Verified]]) -> Certificate:
    """Return a certificate whose checks are computed when they are first read, copied or saved."""
    return Certificate()._put_off(checks=lambda: _latest(computed()))


def _latest(checks: Iterable[Verified]) -> tuple[Verified, ...]:
    """Return checks without those that a later one of the same name replaces."""
    return tuple({check.what: check for check in checks}.values())


def stability_name(sampled: Any) -> str:
    """Return the name of the measure of stability: spectral radius, or largest real part."""
    return "spectral radius" if sampled else "largest real part"


def stability(poles: ComplexArray, sampled: Any) -> float:
    """Return this measure for some poles: a loop is stable below 1 (sampled) or 0."""
    size = np.abs(poles) if sampled else poles.real
    return float(np.max(size, initial=0.0 if sampled else -np.inf))


def stability_check(least: float, sampled: Any, of: str = "") -> Verified:
    """Return the check of a loop's stability, by its poles."""
    return Verified(stability_name(sampled) + of, least, "poles", 1.0 if sampled else 0.0)


def one_line(found: Mapping[str, Any]) -> str:
    """Return the numbers of a certificate as one line; those that are None are left out."""
    return ", ".join(_worded(name, value) for name, value in found.items() if value is not None)


def _worded(name: str, value: Any) -> str:
    what, _, unit = name.replace("_", " ").partition(" [")
    unit = "rad/s" if "real part" in name else unit.removesuffix("]")
    return f"{what} {figure(name, value)} {unit}".rstrip()


def figure(name: str, value: Any) -> str:
    """Return a number of a certificate: four digits, or enough to tell a radius from 1."""
    if not isinstance(value, int | float | np.number) or isinstance(value, bool):
        return str(value)
    if "radius" not in name and "radii" not in name:
        return f"{value:.4g}"
    left = abs(1.0 - float(value))
    digits = 4 if not 0.0 < left < 1.0 else int(np.clip(1 - np.floor(np.log10(left)), 4, 12))
    return f"{value:.{digits}f}"
