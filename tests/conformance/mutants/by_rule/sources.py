"""The sources that mutants are made of, and samples of their mutants.

A sample is uniform over functions, then over the changes of a function. It is ordered by digests of
names and seed, so that an edit of one function leaves the mutants of the others in the sample.
"""

import ast
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from itertools import groupby
from pathlib import Path
from typing import Final

from tests.conformance.mutants.by_rule.rules import Edit, edits
from tests.support.checkout import CHECKOUT

PATTERNS: Final = (
    *("motorapi/*.py", "motorapi/planning/*.py", "motorapi/synchronization/*.py"),
    *("motorapi/ownership/*.py", "motorapi/api/*.py", "motorapi/adaptations/*/*.py"),
    *("emulators/motor_drive.py", "emulators/cia402/*.py", "emulators/cia402/*/*.py"),
    *("emulators/firmware/*.py", "emulators/canopen/*.py"),
)
"""Sources of mutants: whatever motors and the emulated CiA 402 drive, a CANopen node, do."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of one source.

    Attributes:
        file: its path, such as "motorapi/motor.py".
        scope: the function, such as "Motor.start"; a class, or "<module>".
        change: the text before and after; with " #2" for the second one in that scope.
        rule: the name of the rule.
        line: the line, as the source is today.
        number: the place in the list of the file's edits.
        statement: the number of its statement, see `statements`.
        is_in_function: False if the change takes effect while the module is imported.
    """

    file: str
    scope: str
    change: str
    rule: str
    line: int
    number: int
    statement: int
    is_in_function: bool

    @property
    def function(self) -> str:
        """The file and the function."""
        return f"{self.file} {self.scope}"

    @property
    def room(self) -> str:
        """The folder of the file."""
        return self.file.rpartition("/")[0]


def files() -> list[str]:
    """Return the sources of mutants."""
    found = {path for pattern in PATTERNS for path in CHECKOUT.glob(pattern)}
    return sorted(path.relative_to(CHECKOUT).as_posix() for path in found)


def parsed(file: str) -> ast.Module:
    """Return the syntax tree of a source."""
    return ast.parse((CHECKOUT / file).read_text())


def module_of(file: str) -> str:
    """Return the name under which a source is imported."""
    return ".".join(("motorhil", *Path(file).with_suffix("").parts)).removesuffix(".__init__")


def statements(tree: ast.Module) -> dict[ast.stmt, int]:
    """Return the number of each statement, which it has in every tree of the same source."""
    found = (node for node in ast.walk(tree) if isinstance(node, ast.stmt))
    return {node: number for number, node in enumerate(found)}


@cache
def _edits_by_scope(file: str) -> dict[str, list[tuple[int, Edit]]]:
    numbered = sorted(enumerate(edits(parsed(file))), key=lambda one: one[1].scope)
    return {scope: list(some) for scope, some in groupby(numbered, key=lambda one: one[1].scope)}


@cache
def _numbers(file: str) -> dict[tuple[int, int], int]:
    """Return the numbers of statements by their places; no two begin at the same place."""
    return {(one.lineno, one.col_offset): n for one, n in statements(parsed(file)).items()}


def functions() -> list[tuple[str, str]]:
    """Return all functions with mutants, as file and scope."""
    return [(file, scope) for file in files() for scope in _edits_by_scope(file)]


def mutants_in(file: str, scope: str) -> Iterator[Mutant]:
    """Yield all mutants of a function."""
    seen: Counter[str] = Counter()
    for number, edit in _edits_by_scope(file).get(scope, ()):
        change = edit.change()
        seen[change] += 1
        if seen[change] > 1:
            change += f" #{seen[change]}"
        at = edit.statement
        yield Mutant(
            file=file,
            scope=scope,
            change=change,
            rule=edit.rule,
            line=getattr(edit.owner, "lineno", at.lineno),
            number=number,
            statement=_numbers(file)[at.lineno, at.col_offset],
            is_in_function=edit.function is not None,
        )


def mutant_of(function: str, change: str) -> Mutant:
    """Return the mutant of this function with this change.

    Raises:
        LookupError: the sources do not have it any more.
    """
    file, _, scope = function.partition(" ")
    for one in mutants_in(file, scope):
        if one.change == change:
            return one
    raise LookupError(f"{function}: {change}: not in the sources")


def sample(seed: int, count: int, only: str = "") -> list[Mutant]:
    """Return `count` mutants, or all that there are, of functions whose names contain `only`."""
    chosen = [one for one in functions() if only in " ".join(one)]
    chosen.sort(key=lambda one: _digest(seed, *one))
    found: list[Mutant] = []
    turn = 0
    while len(found) < count:
        before = len(found)
        for file, scope in chosen:
            if len(found) == count:
                break
            some = sorted(mutants_in(file, scope), key=lambda one: _digest(seed, one.change))
            found.extend(some[turn : turn + 1])
        if len(found) == before:
            break
        turn += 1
    return found


def _digest(seed: int, *words: str) -> bytes:
    return blake2b("\n".join((str(seed), *words)).encode(), digest_size=8).digest()
