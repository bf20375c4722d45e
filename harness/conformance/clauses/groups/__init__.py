"""Clauses of groups of motors."""
