"""Exchanges between host and device, extracted from recordings."""
