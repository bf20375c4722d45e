"""The whole kit: every clause, in the order in which they are checked."""

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
"""The modules of `harness.conformance.clauses`, each with the clauses of one topic."""


def all_clauses() -> Mapping[str, Clause]:
    """Every clause by id: level by level, in each in the order of the modules."""
    for name in _MODULES:
        import_module(f"harness.conformance.clauses.{name}")
    places = {name: place for place, name in enumerate(registered())}
    ordered = sorted(registered().values(), key=lambda one: (one.level, places[one.id]))
    return {one.id: one for one in ordered}
