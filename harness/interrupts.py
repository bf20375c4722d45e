"""Ctrl-C and SIGTERM in an open rig.

Ctrl-C takes effect between two events, so that the rig remains usable after it is caught.
"""

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
    """Let SIGTERM end the program as Ctrl-C does, with all its cleanup."""

    def handle(number: int, frame: FrameType | None) -> None:
        raise SystemExit(_TERMINATED)

    try:
        before = signal.signal(signal.SIGTERM, handle)
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def interrupts_between_events(runtime: "VirtualRuntime") -> Iterator[None]:
    """Let the current event finish on the first Ctrl-C, but not on a second one.

    Applies only in the main thread, and only if Python's own handler is installed; another handler
    stays in place.
    """

    def handle(number: int, frame: FrameType | None) -> None:
        if not runtime.interrupt():
            signal.default_int_handler(number, frame)

    placed = False
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        with suppress(ValueError):  # not in the main thread
            signal.signal(signal.SIGINT, handle)
            placed = True
    try:
        yield
    finally:
        if placed and signal.getsignal(signal.SIGINT) is handle:
            signal.signal(signal.SIGINT, signal.default_int_handler)
