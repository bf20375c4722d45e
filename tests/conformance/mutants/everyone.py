"""Imports all modules of mutants."""

from tests.conformance.mutants import (
    access,
    commands,
    disturbed,
    ends,
    failures,
    groups,
    lost,
    refusals,
    sharing,
    stops,
    units,
)

MODULES = (
    access,
    commands,
    disturbed,
    ends,
    failures,
    groups,
    lost,
    refusals,
    sharing,
    stops,
    units,
)
