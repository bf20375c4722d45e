"""All modules of mutants, loaded."""

from tests.conformance.mutants import units

MODULES = (units,)
