"""Rigs, virtual time, recorder, command line: the only package that sees the other three."""
