"""Plugins for python-can and for serial lines."""
