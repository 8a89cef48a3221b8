"""Laws made of elements, by hand or by a search over all axes."""
