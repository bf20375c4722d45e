"""Outcome and progress of a motion, and the callback at its end.

The event that ends a motion may be a received frame, a missing heartbeat, or a call of another
logical motor. The callback runs inside this event. So it must not wait or start anything that
waits; it may set a flag that another thread waits for. Its exceptions must not break the event:
they become a `PluginError`, which is logged and raised where that motor is next awaited or
examined.
"""

import logging
from collections.abc import Callable
from enum import Enum
from typing import TYPE_CHECKING, Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.errors import MotionInterrupted, MotorError, PluginError
from motorhil.motorapi.runtime.api import LOOK_PERIOD_S

if TYPE_CHECKING:
    from motorhil.motorapi.ownership.physical_motor import PhysicalMotor
    from motorhil.motorapi.runtime.api import Registration, Runtime

_LOG: Final = logging.getLogger("motorapi")


@final
class Ending(Enum):
    """The kinds of end of a motion."""

    DONE = "done"  # as commanded; a velocity, torque or current: reached
    INTERRUPTED = "interrupted"  # stopped, replaced or switched off before its end
    FAILED = "failed"  # by a fault, a lost link, a failed homing


@final
@frozen(repr=False)
class Outcome:
    """The outcome of one motion, true if it ended as commanded.

    Attributes:
        motor: the name of the logical motor that commanded it.
        operation: its name, as in "start() of left".
        ending: the kind of end.
        time_ns: time at which the end was known [ns], by the runtime.
        error: the error that `wait_until_done` raises; None if it was done.
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
    """Return the ending of a motion whose examination raises `error`."""
    return Ending.INTERRUPTED if isinstance(error, MotionInterrupted) else Ending.FAILED


@final
@frozen(repr=False)
class Progress:
    """The progress of a motion. U is rad, or m if the motor is linear.

    Attributes:
        operation: the active operation, as in "start() of left".
        elapsed_s: time since its begin [s], as reported by the hardware if it does.
        expected_s: duration of the commanded profile [s]; None: unknown (homing, a stop, an
            argument other than time).
        remaining_s: remaining part of that [s], 0 if it is late.
        fraction: 0 to 1: of the distance, for a direct position motion, else of the expected time;
            None: both unknown.
        position: the last position received [U].
        target: its target, in the unit of its control variable, or None if unknown.
    """

    operation: str
    elapsed_s: float
    expected_s: float | None
    remaining_s: float | None
    fraction: float | None
    position: float | None
    target: float | None

    def __repr__(self) -> str:
        text = f"<Progress of {self.operation}: {self.elapsed_s:.3f} s"
        if self.expected_s is not None:
            text += f" of {self.expected_s:.3f} s"
        if self.fraction is not None:
            text += f", {self.fraction:.1%}"
        if self.position is not None and self.target is not None:
            text += f", at {self.position:g} on the way to {self.target:g}"
        return f"{text}>"


@final
class DoneNotice:
    """One callback for the outcome of one motion. A `Registration`.

    Args:
        look: returns the outcome, or None while there is none; neither waits nor sends.
        callback: the callback of the application.
        failed: called with the error of the callback.
        where: place in that error, as in "on_done of left".
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

    def begin(self, runtime: "Runtime", physical: "PhysicalMotor", *, polls: bool) -> None:
        """Examine the motion at every change from now on, and now: it may have ended already.

        With `polls`, or if nothing counts the changes, it is also examined periodically.
        """
        if polls or physical.news is None:
            self._timer = runtime.every(LOOK_PERIOD_S, self.look)
        self._listeners = physical.bell.listeners
        self._listeners.append(self.look)
        self.look()

    def look(self) -> None:
        """Call the callback if the motion has ended."""
        outcome = self._look_at()
        if outcome is None or not self._claim():
            return
        try:
            self._callback(outcome)
        except Exception as error:
            self._failed(callback_failed(self._callback, self._where, error))

    def cancel(self) -> None:
        """Cancel the notification; cancelling again does nothing."""
        self._claim()

    def _claim(self) -> bool:
        """Return True for the first caller that ends it: two threads may get here at once."""
        try:
            self._listeners.remove(self.look)
        except ValueError:
            return False
        if self._timer is not None:
            self._timer.cancel()
        return True


def callback_failed(callback: object, where: str, error: Exception) -> PluginError:
    """Log and return the error for a callback that raised."""
    name = getattr(callback, "__qualname__", None) or repr(callback)
    failed = PluginError(plugin=str(name), where=where, problem=repr(error))
    failed.__cause__ = error
    _LOG.error("%s", failed, exc_info=error)
    return failed
