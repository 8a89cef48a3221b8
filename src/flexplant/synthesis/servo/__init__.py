"""Rigid-body decoupled servos: their loop, and the search for a bandwidth."""
