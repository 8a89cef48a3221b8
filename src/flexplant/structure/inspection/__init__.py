"""The check of a model: its facts, and the lines of the report on them."""
