"""How a motion ended, and telling whoever asked to be told: once, from the event that ended it.

The event may be a frame heard, a heartbeat that failed to come, or a call of another logical motor;
the callback runs inside it. So it may neither wait nor start anything that waits (it sets a flag
that a party waits for), and what it raises must not break what runs it: that becomes a
`PluginError`, which is logged and raised where that motor is waited for or looked at next.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final, final

from motorapi.errors import MotionInterrupted, MotorError, PluginError
from motorapi.waiting import LOOK_PERIOD_S

if TYPE_CHECKING:
    from motorapi.runtime import Registration, Runtime
    from motorapi.sharing import PhysicalMotor

_LOG: Final = logging.getLogger("motorapi")


@final
class Ending(Enum):
    """How a motion can end."""

    DONE = "done"  # as commanded; a velocity, torque or current: reached
    INTERRUPTED = "interrupted"  # stopped, replaced or switched off, short of that
    FAILED = "failed"  # by a fault, a lost link, a failed homing


@final
@dataclass(frozen=True, slots=True, repr=False)
class Outcome:
    """How one motion ended. It is true if that was as commanded.

    Attributes:
        motor: the name of the logical motor that commanded it.
        operation: what it was, as in "start() of left".
        ending: how it ended.
        time_ns: when that was known, of the runtime's time.
        error: what `wait_until_done` raises; None if it was done.
    """

    motor: str
    operation: str
    ending: Ending
    time_ns: int
    error: MotorError | None = None

    def __bool__(self) -> bool:
        return self.ending is Ending.DONE

    def __repr__(self) -> str:
        return f"<Outcome of {self}>"

    def __str__(self) -> str:
        text = f"{self.operation}: {self.ending.value} at {self.time_ns / 1e9:.6f} s"
        return text if self.error is None else f"{text}: {self.error}"


def ending_of(error: MotorError) -> Ending:
    """How a motion ended of which looking at it raises this."""
    return Ending.INTERRUPTED if isinstance(error, MotionInterrupted) else Ending.FAILED


@final
class DoneNotice:
    """One callback that is to be told the outcome of one run. A `Registration`.

    Args:
        look: the outcome, None while there is none; neither waits nor sends.
        callback: the application's.
        failed: is given what the callback raised.
        where: for that error, as in "on_done of left".
    """

    def __init__(
        self,
        look: Callable[[], Outcome | None],
        callback: Callable[[Outcome], object],
        failed: Callable[[PluginError], None],
        where: str,
    ) -> None:
        self._look_at = look
        self._callback = callback
        self._failed = failed
        self._where = where
        self._listeners: list[Callable[[], None]] = []
        self._timer: Registration | None = None

    def begin(self, runtime: "Runtime", physical: "PhysicalMotor") -> None:
        """It looks at every news from now on; now, too: it may be over already."""
        if physical.news is None:
            self._timer = runtime.every(LOOK_PERIOD_S, self.look)
        self._listeners = physical.bell.listeners
        self._listeners.append(self.look)
        self.look()

    def look(self) -> None:
        """The callback was called if the run is over."""
        outcome = self._look_at()
        if outcome is None or not self._claim():
            return
        try:
            self._callback(outcome)
        except Exception as error:
            self._failed(callback_failed(self._callback, self._where, error))

    def cancel(self) -> None:
        """It will not be called any more; cancelling again does nothing."""
        self._claim()

    def _claim(self) -> bool:
        """Whether the caller is the first to end it: two threads may come to that at once."""
        try:
            self._listeners.remove(self.look)
        except ValueError:
            return False
        if self._timer is not None:
            self._timer.cancel()
        return True


def callback_failed(callback: object, where: str, error: Exception) -> PluginError:
    """The error to be told of a callback that raised; it is logged as well."""
    name = getattr(callback, "__qualname__", None) or repr(callback)
    failed = PluginError(plugin=str(name), where=where, problem=repr(error))
    failed.__cause__ = error
    _LOG.error("%s", failed, exc_info=error)
    return failed
