"""What a loop keeps on every machine within an uncertainty: structured singular values."""
