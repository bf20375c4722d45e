"""Suites that judge how motors are shared."""
