"""Signals that end a loop in wall time."""

import os
import signal
from collections.abc import Sequence
from types import FrameType
from typing import Final, Protocol, Self, final

STOPPING: Final = (signal.SIGINT, signal.SIGTERM)


class Wakeable(Protocol):
    """A loop that descriptors can wake."""

    def wake_on(self, descriptor: int) -> None:
        """Wake the loop also when this descriptor becomes readable."""

    def forget(self, descriptor: int) -> None:
        """Stop waking the loop for this descriptor."""


@final
class StopSignals:
    """A context in which a terminating signal wakes the loop instead, and is kept.

    Attributes:
        number: the first signal received, or None.
    """

    def __init__(self, loop: Wakeable, numbers: Sequence[signal.Signals] = STOPPING) -> None:
        self.number: int | None = None
        self._loop = loop
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        loop.wake_on(self._reader)
        self._old_wakeup = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._old_handlers = {
            number: signal.signal(number, self._come)
            for number in numbers
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN  # nohup
        }

    def _come(self, number: int, frame: FrameType | None) -> None:
        if self.number is None:
            self.number = number

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the former signal handlers."""
        for number, handler in self._old_handlers.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._old_wakeup)
        self._loop.forget(self._reader)
        os.close(self._writer)
        os.close(self._reader)
