"""What no controller reaches: each bound of several objectives by itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ...errors import FlexplantError, InfeasibleError
from ...lti.interconnection import lft
from ...lti.norms import peak_gain
from ...plant import StandardPlant
from ..h2 import design_h2
from ..hinf import design_hinf
from ..hinf_riccati import Riccati
from .specifications import H2, Hinf

#: relative: bounds so close to the least value are left to the search
_NEAR = 1e-3
#: part of an H2 norm, found with noise or effort added, that no controller reaches either
_CERTAIN = 0.5


def require_reachable(plant: StandardPlant, subject_to: Sequence[Any]) -> None:
    """Raise InfeasibleError when a bound is below what any controller reaches for it alone.

    H2 by two Riccati equations, H-infinity by its lower bound; bounds on peaks and regions of
    poles are not judged, nor what has no optimum.
    """
    for spec in subject_to:
        if not isinstance(spec, H2 | Hinf) or spec.below is None:
            continue
        w, z = spec.chosen(plant)
        alone = StandardPlant.from_statespace(
            plant.system.select([*z, *plant.y], [*w, *plant.u]), u=plant.u, y=plant.y
        )
        try:
            best = design_h2(alone) if isinstance(spec, H2) else design_hinf(alone, Riccati())
        except FlexplantError:
            continue
        gamma = float(best.gamma or 0.0)
        # a singular H2 problem has an infimum, which noise and effort added miss by a few per cent
        proved = best.lower is not None
        least = best.lower if best.lower is not None else _CERTAIN * gamma
        if least <= spec.below * (1.0 + _NEAR):
            continue
        freq = peak_gain(lft(alone.system, best.system))[1]
        raise InfeasibleError(
            f"{spec!r} is beyond every controller: from {', '.join(w)} to {', '.join(z)} none "
            f"reaches less than {f'{least:.4g}' if proved else f'about {gamma:.4g}'}, even "
            f"without the other objectives (the best loop peaks at {freq:.4g} Hz). Raise below, "
            "take lighter weights there, or name fewer w and z."
        )
