"""Rig files: reading, checking, defaults."""
