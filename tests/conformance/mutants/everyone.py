"""Imports all modules of mutants."""

from importlib import import_module

NAMES = (
    *("access", "commands", "disturbed", "ends", "failures", "groups", "interference"),
    *("lost", "programs", "refusals", "sharing", "stops", "units", "values"),
)
MODULES = tuple(import_module(f"tests.conformance.mutants.{name}") for name in NAMES)
