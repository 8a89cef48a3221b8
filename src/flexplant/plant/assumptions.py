"""Which standard assumptions hold for a plant, in physical words, rigid-body modes first."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from ..errors import AssumptionError, unknown_label
from ..values import Value
from .aliased_modes import aliased_modes
from .assumption import Assumption
from .partition import Partition
from .rank_conditions import full_ranks, no_zeros
from .reach_and_sight import reach_and_sight
from .visibility import WEAK, ModeVisibility, mode_visibility


@dataclass(frozen=True, eq=False, repr=False)
class AssumptionReport(Value):
    """The standard assumptions of a plant; each is tested when it is first read.

    Parameters
    ----------
    plant : StandardPlant
        The plant, weighted or not.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.testbeds.three_masses().check().ok
    True
    """

    plant: Partition

    @cached_property
    def assumptions(self) -> tuple[Assumption, ...]:
        """All assumptions, in the order in which they matter."""
        return (*self._modal, *self._ranks, *self._zeros)

    @cached_property
    def _modal(self) -> tuple[Assumption, ...]:
        return tuple(reach_and_sight(self.plant))

    @cached_property
    def _ranks(self) -> tuple[Assumption, ...]:
        return tuple(full_ranks(self.plant))

    @cached_property
    def _zeros(self) -> tuple[Assumption, ...]:
        return tuple(no_zeros(self.plant))

    @cached_property
    def modes(self) -> tuple[ModeVisibility, ...]:
        """How well each elastic mode is reached and seen, and by which channel: information."""
        return mode_visibility(self.plant)

    @property
    def ok(self) -> bool:
        """Whether all hold."""
        return all(item.holds for item in self.assumptions)

    def __getitem__(self, key: str) -> Assumption:
        for group in ("_modal", "_ranks", "_zeros"):
            for item in getattr(self, group):
                if item.key == key:
                    found: Assumption = item
                    return found
        raise unknown_label("assumption", key, [item.key for item in self.assumptions])

    def __repr__(self) -> str:
        lines = [f"<AssumptionReport: {'all hold' if self.ok else 'NOT all hold'}>"]
        lines += _lines(self.assumptions)
        if self.plant.form.startswith("dense"):
            lines.append(f"  note the plant is {self.plant.form}")
        if self.plant.unstable_modes:
            listed = self.plant.unstable_text
            lines.append(
                f"  note negative stiffness makes rigid-body motion unstable: {listed}; only a "
                "controller holds it"
            )
        folded = aliased_modes(self.plant)
        lines += [f"  note {folded}"] if folded else []
        weak = [text for mode in self.modes for text in mode.weak]
        lines += [f"  note {text}" for text in weak[:4]]
        if len(weak) > 4:
            lines.append(f"  note {len(weak) - 4} more below {100 * WEAK:g} %: see .modes")
        return "\n".join(lines)

    def require(self, keys: tuple[str, ...], purpose: str) -> None:
        """Raise AssumptionError unless the assumptions of these keys hold.

        Parameters
        ----------
        keys : sequence of str
            What the design needs; a key that does not apply to this plant holds.
        purpose : str
            What it is needed for, for the message.

        Raises
        ------
        AssumptionError
            When one fails; the message says what to change, and holds the report.
        """
        known = (*self._modal, *self._ranks)
        if {"P12", "P21"} & set(keys):
            known = self.assumptions
        failed = [item for item in known if item.key in keys and not item.holds]
        if failed:
            said = " ".join(f"{item.finding} {item.remedy}" for item in failed)
            # what was said is not said again
            short = [item.replace(finding="as said.", remedy="") for item in failed]
            listed = tuple(short[failed.index(i)] if i in failed else i for i in known)
            table = "\n".join(["The plant's assumptions:", *_lines(listed)])
            raise AssumptionError(f"{purpose} is not possible: {said}\n{table}")


def _lines(items: tuple[Assumption, ...]) -> list[str]:
    return [
        f"  {'yes' if item.holds else 'NO '} {item.key}: {item.finding}"
        + (f" {item.remedy}" if item.remedy else "")
        for item in items
    ]
