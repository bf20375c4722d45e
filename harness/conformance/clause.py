"""Clauses: promises of the motor interface, with sources and checks.

    @clause("STOP-04", Level.L2, needs={Capability.POSITION_TRAJECTORY}, bench={Ability.TRUTH},
            source="CiA 402-2, halt option code 605Dh; requirement 1 of the paper")
    def stop_ends_at_rest_short_of_target(bench: RigProtocol) -> None:
        \"\"\"A stop during a move ends at rest, short of the target, without a fault.\"\"\"
        ...
        expect(bench.motor.fault() is None, f"stop() left {bench.motor.fault()}")

The first paragraph of the docstring is the promise. The check is an ordinary function of a bench:
it uses no pytest, and no `assert`, which `python -O` removes.

A clause names the capabilities and abilities that it needs. If the motor or bench does not have
one, the clause is not applicable, and the reason is reported. A claimed capability that does not
work is a failure. A verdict says how one check ended.
"""

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, field
from enum import Enum, IntEnum
from typing import Any, Final, final

from motorhil.frozen import frozen
from motorhil.harness.conformance.bench import Ability
from motorhil.harness.rig.config.conformance import Capability

Check = Callable[[Any], None]
"""The check of a clause: a function of a bench, `RigProtocol` in the kit for adaptations."""


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
@frozen
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


Kit = dict[str, Clause]
"""The clauses of a kit, by id."""

_NUMBER: Final = re.compile(r"[-+]?\b\d[\d.]*(?:e[-+]?\d+)?\b")
_CLAUSES: Final[Kit] = {}


def clause(
    name: str,
    level: Level,
    *,
    source: str,
    needs: Collection[Capability] = (),
    bench: Collection[Ability] = (),
    kit: Kit = _CLAUSES,
) -> Callable[[Check], Check]:
    """Register the decorated function as the check of a clause of `kit`.

    Raises:
        ValueError: the name is taken, or the function has no docstring.
    """

    def register(check: Check) -> Check:
        if name in kit:
            raise ValueError(f"clause {name}: registered twice; use another id")
        promise = " ".join((check.__doc__ or "").split("\n\n")[0].split())
        if not promise:
            raise ValueError(f"clause {name}: the check has no docstring; write the promise there")
        kit[name] = Clause(
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


@final
class Result(Enum):
    """The result of a clause's check."""

    PASSED = "passed"
    FAILED = "failed"  # the promise was not kept
    NOT_APPLICABLE = "not applicable"
    CRASHED = "crashed"  # an error was raised that is not part of the motor interface
    HUNG = "hung"  # it did not end within its deadline
    LEFT_BEHIND = "left behind"  # it passed, but left resources, such as threads or an open bus

    @property
    def is_good(self) -> bool:
        """True if the adaptation is not to blame."""
        return self in (Result.PASSED, Result.NOT_APPLICABLE)


@final
@frozen
class Diagnosis:
    """The likely cause of a failure, with the evidence.

    Attributes:
        cause: the likely cause, in one line.
        key: equal for failures of one cause.
        evidence: further observations, one a line.
        curves: by "demand", "told" and "truth" of the motor's position: (time [s], position [U]).
    """

    cause: str
    key: str
    evidence: tuple[str, ...] = ()
    curves: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)


def without_numbers(text: str) -> str:
    """Return a message without its values, which differ from failure to failure."""
    return _NUMBER.sub("#", text)


@final
@frozen
class Verdict:
    """The verdict on one clause.

    Attributes:
        clause: its id.
        result: how the check ended.
        seen: the observation, or why the clause is not applicable; "" if it passed.
        place: where an error was raised, "file:line"; "" if none was.
        time_ns: the bench's time at the end [ns].
        bench: the name of the bench; "" if it was not switched on.
        diagnosis: the likely cause of a failure; None if it passed, or was not observed.
    """

    clause: str
    result: Result
    seen: str = ""
    place: str = ""
    time_ns: int = 0
    bench: str = ""
    diagnosis: Diagnosis | None = field(default=None, compare=False)


def packed(verdict: Verdict) -> dict[str, Any]:
    """Return the verdict as JSON values."""
    return {**asdict(verdict), "result": verdict.result.value}


def unpacked(values: Mapping[str, Any]) -> Verdict:
    """Return the verdict from the values of `packed`."""
    told = values["diagnosis"]
    diagnosis = None
    if told is not None:
        curves = {
            name: tuple((time_s, position) for time_s, position in curve)
            for name, curve in told["curves"].items()
        }
        diagnosis = Diagnosis(told["cause"], told["key"], tuple(told["evidence"]), curves)
    result = Result(values["result"])
    return Verdict(**{**values, "result": result, "diagnosis": diagnosis})
