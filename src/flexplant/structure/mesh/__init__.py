"""Meshes that the library makes itself: plates, beams, chains, blocks, and their ribs."""
