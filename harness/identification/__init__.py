"""Identification: the plant of a real axis from its recording."""
