"""Adaptation for CiA 401 I/O nodes with the servo on the host."""
