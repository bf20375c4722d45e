"""Event queue and networks that connect controllers in one simulated time."""
