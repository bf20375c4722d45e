"""Verdicts on clauses, and the signals from supervisors to workers."""

import signal
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, final

TELL_WHERE: Final = signal.SIGUSR1
"""Signal to a worker: dump the stacks of all threads."""
TIME_IS_UP: Final = signal.SIGUSR2
"""Signal to a worker: end the check."""


@final
class Result(Enum):
    """The result of a clause's check."""

    PASSED = "passed"
    FAILED = "failed"  # the promise was not kept
    NOT_APPLICABLE = "not applicable"
    CRASHED = "crashed"  # an error was raised that is not part of the motor interface
    HUNG = "hung"  # it did not end within its deadline
    LEFT_BEHIND = (
        "left behind"  # the check passed, but left resources behind, such as threads or an open bus
    )

    @property
    def is_good(self) -> bool:
        """True if the adaptation is not to blame."""
        return self in (Result.PASSED, Result.NOT_APPLICABLE)


@final
@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on one clause.

    Attributes:
        clause: its id.
        result: how the check ended.
        seen: the observation, or why the clause is not applicable; "" if it passed.
        place: where an error was raised, "file:line"; "" if none was.
        time_ns: the bench's time at the end [ns].
    """

    clause: str
    result: Result
    seen: str = ""
    place: str = ""
    time_ns: int = 0


def packed(verdict: Verdict) -> dict[str, Any]:
    """Return the verdict as JSON values."""
    return {
        "clause": verdict.clause,
        "result": verdict.result.value,
        "seen": verdict.seen,
        "place": verdict.place,
        "time_ns": verdict.time_ns,
    }


def unpacked(values: Mapping[str, Any]) -> Verdict:
    """Return the verdict from the values of `packed`."""
    return Verdict(**{**values, "result": Result(values["result"])})
