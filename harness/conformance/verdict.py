"""What is found out about a clause; and what crosses between those who check and who supervise."""

import signal
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, final

TELL_WHERE: Final = signal.SIGUSR1
"""Told to a worker: write down where every thread is."""
TIME_IS_UP: Final = signal.SIGUSR2
"""Told to a worker: end the check."""


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


def packed(verdict: Verdict) -> dict[str, Any]:
    """The verdict as JSON can hold it."""
    return {
        "clause": verdict.clause,
        "result": verdict.result.value,
        "seen": verdict.seen,
        "place": verdict.place,
        "time_ns": verdict.time_ns,
    }


def unpacked(values: Mapping[str, Any]) -> Verdict:
    """The verdict that `packed` gave."""
    return Verdict(**{**values, "result": Result(values["result"])})
