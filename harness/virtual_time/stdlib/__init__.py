"""Replacements for the standard library's clocks, threads and locks."""
