"""Clauses on motors and buses that fail."""
