"""All modules of mutants, loaded."""

from tests.conformance.mutants import (
    access,
    commands,
    ends,
    failures,
    groups,
    lost,
    refusals,
    sharing,
    stops,
    units,
)

MODULES = (access, commands, ends, failures, groups, lost, refusals, sharing, stops, units)
