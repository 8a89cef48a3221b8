"""H-infinity by Riccati equations: design, bounds, singular problems and loop shaping."""
