"""All clauses of the kit, in the order of their checks.

The table of all clauses in Markdown: `python -m motorhil.harness.conformance.kit`.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import Final

from motorhil.harness.conformance.clause import Clause, Level, registered

_MODULES: Final = (
    "identity",
    "messages",
    "settings",
    "rig_settings",
    "motion.measurements",
    "motion.setpoints",
    "motion.trajectories",
    "motion.profiles",
    "motion.starting",
    "motion.limits",
    "motion.stopping",
    "failures.faults",
    "low_level",
    "parameters",
    "sharing",
    "processes",
    "programs",
    "groups.starts",
    "groups.lines",
    "groups.failing_members",
    "groups.coordination",
    "traffic",
    "failures.interference",
    "failures.communication_loss",
    "failures.bus_errors",
    "failures.connections",
)
"""The modules of `motorhil.harness.conformance.clauses`, one for each topic."""
_HEAD: Final = """\
# What an adaptation promises

Made by `make clauses` from `harness/conformance/clauses`: {count} clauses, which `motorhil conform`
checks. A clause is applicable if the adaptation claims the capabilities under *claims*, and the
bench has the abilities under *bench*. All other clauses apply to every motor. An id is never
reused.
"""


def all_clauses() -> Mapping[str, Clause]:
    """Return all clauses by id, ordered by level, then by module."""
    modules = [f"motorhil.harness.conformance.clauses.{name}" for name in _MODULES]
    for name in modules:
        import_module(name)
    return in_order(registered(), modules)


def in_order(clauses: Mapping[str, Clause], modules: Sequence[str]) -> Mapping[str, Clause]:
    """Return the clauses by id, ordered by level, then by module, in whatever order they came."""
    place = {name: number for number, name in enumerate(modules)}

    def rank(one: Clause) -> tuple[Level, int]:
        return one.level, place.get(one.check.__module__, len(place))

    return {one.id: one for one in sorted(clauses.values(), key=rank)}


def page() -> str:
    """Return the page with all clauses."""
    clauses = list(all_clauses().values())
    lines = [_HEAD.format(count=len(clauses))]
    for level in Level:
        of_level = [one for one in clauses if one.level is level]
        if of_level:
            lines += [f"## {level.name}: {level.about}", "", *_table(of_level), ""]
    return "\n".join(lines)


def _table(clauses: list[Clause]) -> Iterator[str]:
    yield "| clause | promise | source | claims | bench |"
    yield "| --- | --- | --- | --- | --- |"
    for one in clauses:
        claims = ", ".join(capability.value for capability in one.needs)
        bench = ", ".join(ability.value for ability in one.bench)
        cells = (one.id, one.promise, one.source, claims, bench)
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


if __name__ == "__main__":
    sys.stdout.write(page())
