"""`python -m harness.conformance.clauses_page`: every clause of the kit on a page (Markdown)."""

import sys
from collections.abc import Iterator
from typing import Final

from harness.conformance.clause import Clause, Level
from harness.conformance.kit import all_clauses

_HEAD: Final = """\
# What an adaptation promises

Made by `make clauses` from `harness/conformance/clauses`: {count} clauses, which `motorhil conform`
checks. One is applicable where the adaptation claims what stands under *claims*, and the bench can
do what stands under *bench*; all else is promised of every motor. An id is never given twice.
"""


def page() -> str:
    """The page."""
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
