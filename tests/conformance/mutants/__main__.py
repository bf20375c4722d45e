"""`make mutants`: runs all mutants against all clauses, and writes the table.

The exit status is 1 if a mutant survives, is not killed by a clause it names, or crashes: then it
was written for code that has changed since, and proves nothing. It is also 1 if a clause kills no
mutant alone, and `stays` gives no reason for it.
"""

import os
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from motorhil.harness.conformance.clause import Result
from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.conformance.run import run_clauses
from tests.conformance.mutants import MUTANTS
from tests.conformance.mutants.everyone import MODULES
from tests.conformance.mutants.stays import WHY_IT_STAYS
from tests.support.kit_benches import opener

assert MODULES
_OWN = "tests/conformance/mutants/"
PAGE = Path(__file__).with_name("KILLS.md")
Kills = dict[str, tuple[str, ...]]


def killers_of(name: str) -> tuple[str, tuple[str, ...], str]:
    """Return a mutant, the clauses that kill it, and its own first crash, or ""."""
    mutant = MUTANTS[name]
    with mutant.plant():
        verdicts = list(run_clauses(all_clauses().values(), opener(mutant.kind)))
    crashes = [one for one in verdicts if one.result is Result.CRASHED and _OWN in one.place]
    crash = f"{crashes[0].place}: {crashes[0].seen}" if crashes else ""
    return name, tuple(one.clause for one in verdicts if not one.result.is_good), crash


def killed_alone(kills: Kills) -> dict[str, list[str]]:
    """Return the mutants that only one clause kills, by clause."""
    alone: dict[str, list[str]] = {}
    for name, clauses in kills.items():
        if len(clauses) == 1:
            alone.setdefault(clauses[0], []).append(name)
    return alone


def page(kills: Kills) -> Iterator[str]:
    """Yield the lines of the kill table."""
    killed = sum(1 for clauses in kills.values() if clauses)
    alone = killed_alone(kills)
    yield "# What the kit finds out"
    yield ""
    yield "Written by `make mutants`: every mutant of this folder against every clause."
    yield ""
    yield f"{killed} of {len(kills)} mutants are killed."
    yield ""
    yield "| clause | kills | of these, no other clause does |"
    yield "| --- | --- | --- |"
    for one in all_clauses():
        count = sum(one in clauses for clauses in kills.values())
        unique = ", ".join(alone.get(one, [])) or f"none: {WHY_IT_STAYS.get(one, '?')}"
        yield f"| {one} | {count} | {unique} |"
    yield ""
    yield "| mutant | in | the mistake | killed by |"
    yield "| --- | --- | --- | --- |"
    for name, clauses in kills.items():
        mutant = MUTANTS[name]
        by = ", ".join(clauses) or "**survives**"
        yield f"| {name} | {mutant.kind} | {mutant.mistake} | {by} |"


def complaints(kills: Kills) -> Iterator[str]:
    """Yield the differences from the expectations of the mutants."""
    for name, clauses in kills.items():
        missing = [one for one in MUTANTS[name].killers if one not in clauses]
        if missing:
            yield f"{name} is let through by {', '.join(missing)}"
        elif not clauses:
            yield f"{name} survives"
    if len(kills) < len(MUTANTS):
        return
    alone = killed_alone(kills)
    for one in all_clauses():
        if (one in alone) is (one in WHY_IT_STAYS):
            yield f"{one} kills {', '.join(alone.get(one, [])) or 'nothing'} alone: see stays.py"


def main(names: Iterable[str]) -> int:
    """Run the mutants and print the table; write it if all mutants were run."""
    chosen = list(names) or list(MUTANTS)
    kills: Kills = {}
    crashed = []
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for name, clauses, crash in pool.map(killers_of, chosen):
            kills[name] = clauses
            if crash:
                crashed.append(f"{name} is out of date: {crash}")
            print(f"{name}: {', '.join(clauses) or 'SURVIVES'}", flush=True)
    text = "\n".join(page(kills)) + "\n"
    if chosen == list(MUTANTS):
        PAGE.write_text(text)
    print(text)
    wrong = [*crashed, *complaints(kills)]
    for line in wrong:
        print(line, file=sys.stderr)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
