"""The check of a design on the plant with the modes that it left out."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

from ..errors import FlexplantWarning, warn
from ..loop import SpillOver, close_loop
from ..lti.statespace import StateSpace
from ..plant import StandardPlant, larger_plant
from ..structure import FEModel
from .controller import Controller

#: what a high peak means
CLOSE = ", and one that differs a little from the model may be unstable"


def spill_over(plant: StandardPlant, blocks: Sequence[Any], larger: Any) -> SpillOver | None:
    """Return the check of a design's loop with the modes left out; None: they are not known."""
    whole = larger_plant(plant, larger)
    if whole is None:
        return None
    plain, reading = plant.unweighted, plant.origin.reading
    before = [] if reading is None else [reading]
    with warnings.catch_warnings():  # one warning is enough, where the user called from
        warnings.simplefilter("ignore", FlexplantWarning)
        found = close_loop(plain, *before, *blocks, larger=whole).left_out
    if found is not None and not found.is_fine:
        warn(
            f"with the modes that the plant left out the loop is {found.summary}. The machine has "
            f"these modes{CLOSE if found.is_high else ''}: choose less bandwidth, keep them in "
            "the plant, or weight the efforts (or roll the controller off) before them."
        )
    return found


def with_left_out(
    answer: Controller, plant: StandardPlant, larger: Any, block: StateSpace | None = None
) -> Controller:
    """Return an answer with its check on the modes left out, or the note that none are known.

    The block is its part from the plant's y to u, unless all of its system is.
    """
    found = spill_over(plant, [answer.system if block is None else block], larger)
    if found is None:
        return answer.replace(notes=(*answer.notes, *unchecked(plant)))
    certificate = dict(answer.certificate or {}) | found.certificate
    return answer.replace(certificate=certificate, left_out=found)


def unchecked(plant: StandardPlant) -> tuple[str, ...]:
    """Return a note that no modes left out are known, for a plant that may have left out some."""
    if not plant.is_assembled or isinstance(plant.model, FEModel):
        return ()
    return ("modes left out of the plant: none known, none checked; larger= gives them",)
