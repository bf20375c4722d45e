"""All modules of mutants, loaded."""

from tests.conformance.mutants import groups, lost, units

MODULES = (groups, lost, units)
