"""Controllers by linear matrix inequalities: H-infinity, and several objectives at once."""
