"""Ctrl-C in an open rig: taken between two events, so that whoever catches it can go on."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from harness.virtual_time import VirtualRuntime


_TERMINATED = 128 + signal.SIGTERM


@contextmanager
def ends_by_signal() -> Iterator[None]:
    """Within it, SIGTERM ends the program as Ctrl-C does, by way of what cleans up behind it."""

    def handle(number: int, frame: FrameType | None) -> None:
        raise SystemExit(_TERMINATED)

    try:
        before = signal.signal(signal.SIGTERM, handle)
    except ValueError:  # another thread than the main one
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def interrupts_between_events(runtime: "VirtualRuntime") -> Iterator[None]:
    """Within it, Ctrl-C lets the event that runs come to its end; a second one does not.

    Only where Python's own handler is in place, and in the main thread: where somebody else takes
    care of Ctrl-C, it stays so.
    """

    def handle(number: int, frame: FrameType | None) -> None:
        if not runtime.interrupt():
            signal.default_int_handler(number, frame)

    placed = False
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        with suppress(ValueError):  # another thread than the main one
            signal.signal(signal.SIGINT, handle)
            placed = True
    try:
        yield
    finally:
        if placed and signal.getsignal(signal.SIGINT) is handle:
            signal.signal(signal.SIGINT, signal.default_int_handler)
