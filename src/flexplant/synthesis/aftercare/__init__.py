"""Controllers after their design: fewer states, samples, limits, sections and C."""
