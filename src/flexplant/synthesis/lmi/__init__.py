"""H-infinity by linear matrix inequalities."""
