"""Imports all modules of mutants."""

from importlib import import_module

NAMES = (
    *("access", "commands", "disturbed", "ends", "failures", "groups"),
    *("lost", "refusals", "sharing", "stops", "units"),
)
MODULES = tuple(import_module(f"tests.conformance.mutants.{name}") for name in NAMES)
