"""All clauses of the kit, in the order of their checks."""

from collections.abc import Mapping
from importlib import import_module
from typing import Final

from harness.conformance.clause import Clause, registered

_MODULES: Final = (
    "identity",
    "measuring",
    "setpoints",
    "trajectories",
    "starting",
    "ending",
    "limits",
    "stopping",
    "failing",
    "hearing",
    "access",
    "sharing",
    "owners",
    "groups",
    "parting",
    "lost",
    "disturbed",
)
"""The modules of `harness.conformance.clauses`, one for each topic."""


def all_clauses() -> Mapping[str, Clause]:
    """Return all clauses by id, ordered by level, then by module."""
    for name in _MODULES:
        import_module(f"harness.conformance.clauses.{name}")
    places = {name: place for place, name in enumerate(registered())}
    ordered = sorted(registered().values(), key=lambda one: (one.level, places[one.id]))
    return {one.id: one for one in ordered}
