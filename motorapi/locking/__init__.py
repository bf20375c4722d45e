"""Locks between processes, kept in files."""
