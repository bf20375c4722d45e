"""All modules of mutants, loaded."""

from tests.conformance.mutants import lost, units

MODULES = (lost, units)
