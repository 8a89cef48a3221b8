"""What an update compares: poles, shapes, responses, antiresonances, static compliance."""
