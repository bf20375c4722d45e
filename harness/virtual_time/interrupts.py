"""Ctrl-C, SIGTERM and exit handlers in an open rig.

Ctrl-C takes effect between two events, so that the rig remains usable after it is caught. Handlers
that a program registers with `atexit` run when the program ends, while its rig is still open.
"""

import atexit
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TYPE_CHECKING, Any, final

if TYPE_CHECKING:
    from motorhil.harness.virtual_time.runtime import VirtualRuntime

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


@final
class ExitHandlers:
    """The exit handlers of one program.

    Handlers registered by standard-library modules remain the process's own.
    """

    def __init__(self) -> None:
        self._calls: list[Callable[[], object]] = []
        self._functions: list[object] = []
        self._register = atexit.register
        self._unregister = atexit.unregister

    def register(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        """Register a handler, as atexit.register does."""
        caller = sys._getframe(1).f_globals.get("__name__", "")  # noqa: SLF001 -- who registers
        if str(caller).partition(".")[0] in sys.stdlib_module_names - {"__main__"}:
            return self._register(function, *args, **kwargs)
        self._calls.append(lambda: function(*args, **kwargs))
        self._functions.append(function)
        return function

    def unregister(self, function: Callable[..., Any], /) -> None:
        """Remove a handler, as atexit.unregister does."""
        self._unregister(function)
        while function in self._functions:
            place = self._functions.index(function)
            del self._functions[place], self._calls[place]

    def run(self, report: Callable[[Exception], None]) -> None:
        """Run all handlers, last one first; pass exceptions to `tell` and continue."""
        while self._calls:
            del self._functions[-1]
            try:
                self._calls.pop()()
            except Exception as error:
                report(error)


@contextmanager
def exit_handlers() -> Iterator[ExitHandlers]:
    """Collect the exit handlers that a program registers, for the duration of the context."""
    handlers = ExitHandlers()
    before = atexit.register, atexit.unregister
    atexit.register, atexit.unregister = handlers.register, handlers.unregister
    try:
        yield handlers
    finally:
        atexit.register, atexit.unregister = before
