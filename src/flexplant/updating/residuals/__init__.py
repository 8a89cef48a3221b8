"""Residuals of an update: poles, shapes, responses, antiresonances, static compliance."""
