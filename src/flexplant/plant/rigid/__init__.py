"""The rigid body in a structure: its motions, decoupling, suspension, and weights for stages."""
