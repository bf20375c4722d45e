"""Operations of a program that virtual time refuses: they block, or copy the rig."""

import os
import signal
from collections.abc import Callable
from functools import wraps
from typing import Any, Final, NoReturn

from motorhil.harness.virtual_time.stdlib.threads import (
    caller_is_outside,
    party_here,
)
from motorhil.motorapi.errors import UsageError

COPY: Final = "the new process would have its own copy of the rig, with its own time"
_SYSTEM: Final = "it blocks in the operating system, and with it all threads of the program"
_ALARM: Final = "it uses the wall clock, not the rig's clock"
THREADS: Final = "use threads (concurrent.futures.ThreadPoolExecutor)"
_TIMER: Final = "use threading.Timer"
_FUNCTIONS: Final = (
    (os.fork, "os.fork", COPY, THREADS),
    (os.forkpty, "os.forkpty", COPY, THREADS),
    (signal.alarm, "signal.alarm", _ALARM, _TIMER),
    (signal.setitimer, "signal.setitimer", _ALARM, _TIMER),
    (signal.pause, "signal.pause", _SYSTEM, "sleep until a flag is set"),
    (signal.sigwait, "signal.sigwait", _SYSTEM, "sleep until a flag is set"),
    (signal.sigwaitinfo, "signal.sigwaitinfo", _SYSTEM, "sleep until a flag is set"),
    (signal.sigtimedwait, "signal.sigtimedwait", _SYSTEM, "sleep until a flag is set"),
)


def refuse(name: str, why: str, remedy: str) -> NoReturn:
    """Raise UsageError for an operation in virtual time."""
    raise UsageError(
        f"{name} in virtual time: {why}; {remedy}, or run the program in wall time: "
        "motorhil serve RIG -- python SCRIPT"
    )


def is_meant() -> bool:
    """Return whether a party calls from the program, two levels up."""
    return party_here() is not None and not caller_is_outside(3)


def _refused(original: Callable[..., Any], name: str, why: str, remedy: str) -> Callable[..., Any]:
    """Return a stand-in that refuses calls of parties."""

    @wraps(original)
    def stand_in(*arguments: Any, **named: Any) -> Any:
        if is_meant():
            refuse(name, why, remedy)
        return original(*arguments, **named)

    return stand_in


def stand_ins() -> list[tuple[object, object]]:
    """Return (original, stand-in) for the functions that are refused."""
    return [
        (original, _refused(original, name, why, remedy))
        for original, name, why, remedy in _FUNCTIONS
    ]
