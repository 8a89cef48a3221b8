"""Plants that are known up to real Deltas on their modes and a weight on the modes they lack."""
