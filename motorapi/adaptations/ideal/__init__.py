"""Adaptation for ideal motors, without any bus."""
