"""Connections from emulated buses to the outside, in wall time."""
