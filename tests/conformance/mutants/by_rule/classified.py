"""Classified survivors: `equivalent.toml`, read by people, with the reason for each.

`known.toml` has some mutants of which the verdict is known; `make test` tries each twelfth one, and
`make nightly` all.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.conformance.mutants.by_rule.sources import Mutant, mutant_of, mutants_in

KNOWN: Final = Path(__file__).with_name("known.toml")
FILE: Final = Path(__file__).with_name("equivalent.toml")
HARMLESS: Final = ("equivalent", "unobservable", "defensive", "speed")
CLASSES: Final = (*HARMLESS, "elsewhere", "open")
"""No user can see the change; the kit cannot, by what it may know; it matters only if something
else is wrong, too; it costs time alone; another test than the kit has to see it; a clause should
see it, and none does yet."""


@dataclass(frozen=True, slots=True)
class Reason:
    """Why no clause finds a mutant.

    Attributes:
        function, change: of the mutant.
        kind: one of `CLASSES`.
        reason: in one line.
    """

    function: str
    change: str
    kind: str
    reason: str

    @property
    def is_harmless(self) -> bool:
        """True if the mutant does no harm that a user can see."""
        return self.kind in HARMLESS

    @property
    def is_closed(self) -> bool:
        """True if no clause should find the mutant."""
        return self.kind != "open"

    @property
    def is_outdated(self) -> bool:
        """True if the sources do not have this mutant any more."""
        file, _, scope = self.function.partition(" ")
        return all(one.change != self.change for one in mutants_in(file, scope))


def read(path: Path = FILE) -> dict[tuple[str, str], Reason]:
    """Return all reasons by function and change.

    Raises:
        ValueError: an entry is of no known class, or comes twice.
    """
    found: dict[tuple[str, str], Reason] = {}
    for one in tomllib.loads(path.read_text()).get("survivor", []):
        reason = Reason(**one)
        key = reason.function, reason.change
        if reason.kind not in CLASSES or key in found:
            raise ValueError(f"{path.name}: {' '.join(key)}: unknown kind, or a second entry")
        found[key] = reason
    return found


def reason_of(mutant: Mutant, reasons: dict[tuple[str, str], Reason]) -> Reason | None:
    """Return why no clause finds this mutant, or None if nobody has read it."""
    return reasons.get((mutant.function, mutant.change))


@dataclass(frozen=True, slots=True)
class Known:
    """A mutant of which the verdict is known.

    Attributes:
        function, change: of the mutant.
        clause, bench: what executes it.
        outcome: how the trial ends.
        is_early: whether it takes effect while modules are imported, though it is in a function.
    """

    function: str
    change: str
    clause: str
    bench: str
    outcome: str
    is_early: bool = False

    def mutant(self) -> Mutant:
        """Return the mutant.

        Raises:
            LookupError: the sources do not have it any more; take another one.
        """
        return mutant_of(self.function, self.change)


def known() -> list[Known]:
    """Return all mutants of which the verdict is known."""
    return [Known(**one) for one in tomllib.loads(KNOWN.read_text())["mutant"]]
