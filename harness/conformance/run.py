"""Clauses are checked on a bench, one after another, each on a bench of its own.

Here in this process, where nothing can be done about a check that never ends, or that takes the
process with it: `harness.conformance.supervision` sees to those.
"""

import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Protocol, final

from harness.conformance.claims import Claims, claims_of
from harness.conformance.clause import Clause, NotApplicable, Violated
from harness.conformance.rig_bench import TimeIsUp
from motorapi import MotorError, PluginError

if TYPE_CHECKING:
    from harness.conformance.bench import RigProtocol


@final
class Result(Enum):
    """How the check of a clause ended."""

    PASSED = "passed"
    FAILED = "failed"  # the promise was not kept
    NOT_APPLICABLE = "not applicable"
    CRASHED = "crashed"  # something was raised that is no error of the motor interface
    HUNG = "hung"  # it did not end within its deadline
    LEFT_BEHIND = "left behind"  # it passed, and left threads or an open bus

    @property
    def is_good(self) -> bool:
        """Whether the adaptation is not to blame."""
        return self in (Result.PASSED, Result.NOT_APPLICABLE)


@final
@dataclass(frozen=True, slots=True)
class Verdict:
    """What came of one clause.

    Attributes:
        clause: its id.
        result: how it ended.
        seen: what was seen, or why it is not applicable; "" where it passed.
        place: where something was raised, "file:line"; "" where nothing was.
        time_ns: of the bench, when it was over [ns].
    """

    clause: str
    result: Result
    seen: str = ""
    place: str = ""
    time_ns: int = 0


class Opener(Protocol):
    """What switches a bench on, as often as it is called."""

    def __call__(self) -> "AbstractContextManager[RigProtocol]":
        """A bench that is on inside the block."""


def run_clauses(clauses: Iterable[Clause], open_bench: Opener) -> Iterator[Verdict]:
    """The verdict of each clause, as soon as there is one."""
    claims: Claims | None = None
    for one in clauses:
        verdict, claims = _judged(one, open_bench, claims)
        yield verdict


def run_clause(one: Clause, open_bench: Opener) -> Verdict:
    """The verdict of one clause."""
    return _judged(one, open_bench, None)[0]


def _judged(
    one: Clause, open_bench: Opener, claims: Claims | None
) -> tuple[Verdict, Claims | None]:
    """Its verdict; and what the motor claims, once that is known."""
    before = set(threading.enumerate())
    try:
        with open_bench() as bench:
            now_ns: Callable[[], int] = bench.runtime.now_ns
            try:
                if claims is None:
                    claims = claims_of(bench.motor, bench.facts)
                _require_applicable(one, bench, claims)
                one.check(bench)
                verdict = Verdict(one.id, Result.PASSED)
            except BaseException as error:
                verdict = _verdict_of(one, error)
            time_ns = now_ns()
    except BaseException as error:  # while it was switched on, or off
        verdict, time_ns = _verdict_of(one, error), 0
    left = [thread.name for thread in threading.enumerate() if thread not in before]
    if left and verdict.result is Result.PASSED:
        seen = f"threads that run on after everything was closed: {', '.join(left)}"
        verdict = Verdict(one.id, Result.LEFT_BEHIND, seen)
    return Verdict(verdict.clause, verdict.result, verdict.seen, verdict.place, time_ns), claims


def _require_applicable(one: Clause, bench: "RigProtocol", claims: Claims) -> None:
    for capability in one.needs:
        if not claims.has(capability):
            raise NotApplicable(claims.why_not[capability])
    for ability in one.bench:
        if ability not in bench.abilities:
            raise NotApplicable(f"the bench cannot {ability.value}")


def _verdict_of(one: Clause, error: BaseException) -> Verdict:
    """What an error that ended a check says of the clause.

    Raises:
        KeyboardInterrupt: the error itself.
    """
    if isinstance(error, KeyboardInterrupt):
        raise error
    if isinstance(error, NotApplicable):
        return Verdict(one.id, Result.NOT_APPLICABLE, f"{error}")
    if isinstance(error, Violated):
        return Verdict(one.id, Result.FAILED, f"{error}", _place_of(error))
    if isinstance(error, TimeIsUp):
        return Verdict(one.id, Result.HUNG, f"{error}", _place_of(error))
    told = f"{type(error).__name__}: {error}"
    if isinstance(error, MotorError) and not isinstance(error, PluginError):
        return Verdict(one.id, Result.FAILED, f"raised {told}", _place_of(error))
    return Verdict(one.id, Result.CRASHED, told, _place_of(error))


def _place_of(error: BaseException) -> str:
    """The innermost line at which it, or what caused it, was raised."""
    while error.__cause__ is not None:
        error = error.__cause__
    frames = traceback.extract_tb(error.__traceback__)
    return f"{frames[-1].filename}:{frames[-1].lineno}" if frames else ""
