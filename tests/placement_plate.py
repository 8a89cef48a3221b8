"""The plate of the tests of placement, and its modes."""

from functools import cache

from flexplant.modes import solve_modes
from flexplant.structure import ModalDamping, kirchhoff_plate

SIZE = (0.5, 0.35)


@cache
def plate_modes(count, thickness=0.02):
    """Return so many modes; all of the structure for None."""
    plate = kirchhoff_plate(
        size=SIZE,
        thickness=thickness,
        elements=(4, 4),
        density=2700,
        youngs_modulus=70e9,
        poisson_ratio=0.33,
    )
    if count is None:
        return plate
    return solve_modes(plate, count=count, damping=ModalDamping(0.03))
