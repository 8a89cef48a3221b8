"""What the hardware says: measured poles and mode shapes."""

from .measured import MeasuredModes as MeasuredModes
