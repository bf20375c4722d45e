"""Decoders from recorded bytes to events."""
