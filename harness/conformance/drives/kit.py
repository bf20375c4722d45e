"""All clauses for drives, in the order of their checks.

The table of all clauses in Markdown: `python -m motorhil.harness.conformance.drives.kit`.
"""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Final

from motorhil.harness.conformance.clause import Check, Clause, Kit, Level, clause
from motorhil.harness.conformance.kit import in_order

_MODULES: Final = (
    "dictionary",
    "communication.transfers",
    "communication.network",
    "communication.services",
    "power",
    "positioning",
    "velocity",
    "supervision",
    "plant",
    "stopping",
    "homing",
    "inputs",
    "torque",
    "factors",
    "communication.process_data",
    "communication.mapping",
    "communication.synchronisation",
    "cyclic",
    "errors",
)
"""The modules of `motorhil.harness.conformance.drives.clauses`, one for each topic."""
_CLAUSES: Final[Kit] = {}
_HEAD: Final = """\
# What a drive promises

Made by `make clauses` from `harness/conformance/drives/clauses`: {count} clauses, which
`motorhil conform --controller` checks. A clause is applicable if the drive has the objects, and
6502h claims the mode. Otherwise the verdict names what is missing. An id is never reused.
"""


def drive_clause(name: str, level: Level, *, source: str) -> Callable[[Check], Check]:
    """Register the decorated function of a `DriveBench` as the check of a clause for drives."""
    return clause(name, level, source=source, kit=_CLAUSES)


def drive_clauses() -> Mapping[str, Clause]:
    """Return all clauses for drives by id, ordered by level, then by module."""
    modules = [f"motorhil.harness.conformance.drives.clauses.{name}" for name in _MODULES]
    for name in modules:
        import_module(name)
    return in_order(_CLAUSES, modules)


def page() -> str:
    """Return the page with all clauses for drives."""
    clauses = drive_clauses().values()
    lines = [_HEAD.format(count=len(clauses)), "| clause | level | promise | source |"]
    lines.append("| --- | --- | --- | --- |")
    for one in clauses:
        lines.append(f"| {one.id} | {one.level.name} | {one.promise} | {one.source} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    from motorhil.harness.conformance.drives import kit

    sys.stdout.write(kit.page())  # the clauses are registered there, not in __main__
