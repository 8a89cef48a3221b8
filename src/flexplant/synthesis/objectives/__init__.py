"""Several objectives for one controller: specifications as values, and their LMIs."""
