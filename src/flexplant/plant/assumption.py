"""One standard assumption of a synthesis, and what was found."""

from __future__ import annotations

from dataclasses import dataclass

from ..values import Value


@dataclass(frozen=True, eq=False)
class Assumption(Value):
    """One assumption: its key, whether it holds, what was found and what to change if not.

    Parameters
    ----------
    key : str
        `excited` (w reaches), `detectable` (y sees), `performance` (z sees), `stabilisable`
        (u reaches) every mode that does not decay by itself; `D12`, `D21` (full rank); `P12`,
        `P21` (u -> z and w -> y have no invariant zeros on the stability limit).
    holds : bool
        Whether it does.
    finding : str
        In physical words.
    remedy : str
        What to change; empty when it holds.

    Examples
    --------
    >>> import flexplant as fx
    >>> first = fx.testbeds.three_masses().check().assumptions[0]
    >>> first.holds
    True
    """

    key: str
    holds: bool
    finding: str
    remedy: str = ""
