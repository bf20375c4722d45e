"""A clause: one promise of the motor interface, where it stands, and how it is checked.

    @clause("STOP-04", Level.L2, needs={Capability.POSITION_TRAJECTORY}, bench={Ability.TRUTH},
            source="CiA 402-2, halt option code 605Dh; requirement 1 of the paper")
    def a_stop_ends_at_rest(bench: RigProtocol) -> None:
        \"\"\"A stop during a move ends at rest, short of the target, without a fault.\"\"\"
        ...
        expect(bench.motor.fault() is None, f"stop() left {bench.motor.fault()}")

The first sentence of the docstring is the promise. The check is an ordinary function over a bench:
no pytest, no `assert` (which `python -O` removes).
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
    """How far the promises reach; each level rests on those before it."""

    L0 = 0
    L1 = 1
    L2 = 2
    L3 = 3
    L4 = 4
    L5 = 5

    @property
    def about(self) -> str:
        """What it adds."""
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
    """A promise was not kept; the text says what was seen."""


class NotApplicable(Exception):  # noqa: N818 -- likewise
    """The promise does not concern this motor or bench; the text says why."""


def expect(holds: bool, seen: str) -> None:
    """Raises Violated with what was seen if `holds` is False."""
    if not holds:
        raise Violated(seen)


@final
@dataclass(frozen=True, slots=True)
class Clause:
    """One promise.

    Attributes:
        id: "SET-01": topic and number; never given to another promise.
        level: of the kit.
        promise: one sentence.
        source: where it stands.
        needs: what the adaptation must claim for it to be applicable; all of these.
        bench: what the bench must be able to do; all of these.
        check: raises Violated, NotApplicable, or whatever the motor raises and should not.
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
    """The function below is the check of a clause of the kit.

    Raises:
        ValueError: the name is taken, or the function has no docstring.
    """

    def register(check: Check) -> Check:
        if name in _CLAUSES:
            raise ValueError(f"two clauses {name}")
        promise = " ".join((check.__doc__ or "").split("\n\n")[0].split())
        if not promise:
            raise ValueError(f"clause {name} promises nothing: its check has no docstring")
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
    """The clauses of the modules imported so far, by id; `harness.conformance.kit` has all."""
    return _CLAUSES
