"""Foreign recording formats."""
