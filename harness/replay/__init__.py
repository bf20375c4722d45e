"""Recordings played again: as traffic, as the devices in them, as the host in them."""
