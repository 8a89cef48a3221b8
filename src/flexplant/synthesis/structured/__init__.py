"""Controllers of a given structure: their parameters, and the search for them."""
