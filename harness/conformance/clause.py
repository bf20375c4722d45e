"""Clauses: promises of the motor interface, with sources and checks.

    @clause("STOP-04", Level.L2, needs={Capability.POSITION_TRAJECTORY}, bench={Ability.TRUTH},
            source="CiA 402-2, halt option code 605Dh; requirement 1 of the paper")
    def a_stop_ends_at_rest(bench: RigProtocol) -> None:
        \"\"\"A stop during a move ends at rest, short of the target, without a fault.\"\"\"
        ...
        expect(bench.motor.fault() is None, f"stop() left {bench.motor.fault()}")

The first paragraph of the docstring is the promise. The check is an ordinary function of a bench:
it uses no pytest, and no `assert`, which `python -O` removes.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final, final

from harness.conformance.capability import Ability, Capability

if TYPE_CHECKING:
    from harness.conformance.bench import RigProtocol

Check = Callable[["RigProtocol"], None]


@final
class Level(IntEnum):
    """The level of a promise; each level builds on those before it."""

    L0 = 0
    L1 = 1
    L2 = 2
    L3 = 3
    L4 = 4
    L5 = 5

    @property
    def about(self) -> str:
        """The topics of this level."""
        return _ABOUT[self]


_ABOUT: Final = {
    Level.L0: "identity and units",
    Level.L1: "set-points and profiles",
    Level.L2: "limits, stop, errors",
    Level.L3: "sharing",
    Level.L4: "synchronisation",
    Level.L5: "faults and loss of communication",
}


class Violated(AssertionError):  # noqa: N818 -- it says what happened, as the errors of motorapi
    """A promise was not kept; the text says what was observed."""


class NotApplicable(Exception):  # noqa: N818 -- likewise
    """The promise does not concern this motor or bench; the text says why."""


def expect(holds: bool, seen: str) -> None:
    """Raise Violated with the text `seen` if `holds` is False."""
    if not holds:
        raise Violated(seen)


@final
@dataclass(frozen=True, slots=True)
class Clause:
    """One promise of the motor interface.

    Attributes:
        id: topic and number, such as "SET-01"; never reused for another promise.
        level: the level of the promise.
        promise: the promise, in one sentence.
        source: the document and clause that make this promise.
        needs: capabilities that the adaptation must claim; the clause needs all of these.
        bench: abilities that the bench must have; the clause needs all of these.
        check: raises Violated, NotApplicable, or any error that the motor should not raise.
    """

    id: str
    level: Level
    promise: str
    source: str
    needs: tuple[Capability, ...]
    bench: tuple[Ability, ...]
    check: Check


_CLAUSES: Final[dict[str, Clause]] = {}


def clause(
    name: str,
    level: Level,
    *,
    source: str,
    needs: Collection[Capability] = (),
    bench: Collection[Ability] = (),
) -> Callable[[Check], Check]:
    """Register the decorated function as the check of a clause.

    Raises:
        ValueError: the name is taken, or the function has no docstring.
    """

    def register(check: Check) -> Check:
        if name in _CLAUSES:
            raise ValueError(f"clause {name}: registered twice; use another id")
        promise = " ".join((check.__doc__ or "").split("\n\n")[0].split())
        if not promise:
            raise ValueError(f"clause {name}: the check has no docstring; write the promise there")
        _CLAUSES[name] = Clause(
            id=name,
            level=level,
            promise=promise,
            source=source,
            needs=tuple(one for one in Capability if one in needs),
            bench=tuple(one for one in Ability if one in bench),
            check=check,
        )
        return check

    return register


def registered() -> Mapping[str, Clause]:
    """Return the clauses of all modules imported so far, by id; see `kit.all_clauses`."""
    return _CLAUSES
