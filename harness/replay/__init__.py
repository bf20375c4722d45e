"""Replay of recordings as traffic, as devices, or as a host."""
