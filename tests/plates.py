"""The plate of design.md, and plates like it."""

from flexplant.structure import kirchhoff_plate

PLATE = {
    "size": (0.6, 0.6),
    "thickness": 0.0272,
    "elements": (8, 8),
    "density": 2702,
    "youngs_modulus": 70e9,
    "poisson_ratio": 0.35,
}


def make_plate(**changes):
    """The plate with some numbers changed."""
    return kirchhoff_plate(**(PLATE | changes))
