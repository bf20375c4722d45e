"""Ownership of a physical motor by one of several logical motors."""
