"""The quality of an update: correlation, identifiability, localisation, validation."""
