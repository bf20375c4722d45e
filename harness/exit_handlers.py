"""What a program registers with `atexit` runs when it ends, while its rig is still there."""

import atexit
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, final


@final
class ExitHandlers:
    """The handlers of one program.

    Those of the standard library that it imports stay what they are: the process's.
    """

    def __init__(self) -> None:
        self._calls: list[Callable[[], object]] = []
        self._functions: list[object] = []
        self._register = atexit.register
        self._unregister = atexit.unregister

    def register(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        """As atexit.register."""
        caller = sys._getframe(1).f_globals.get("__name__", "")  # noqa: SLF001 -- who registers
        if str(caller).partition(".")[0] in sys.stdlib_module_names - {"__main__"}:
            return self._register(function, *args, **kwargs)
        self._calls.append(lambda: function(*args, **kwargs))
        self._functions.append(function)
        return function

    def unregister(self, function: Callable[..., Any], /) -> None:
        """As atexit.unregister."""
        self._unregister(function)
        while function in self._functions:
            place = self._functions.index(function)
            del self._functions[place], self._calls[place]

    def run(self, tell: Callable[[Exception], None]) -> None:
        """All have run, the last one first; what one raises is told, and keeps no other from it."""
        while self._calls:
            del self._functions[-1]
            try:
                self._calls.pop()()
            except Exception as error:
                tell(error)


@contextmanager
def exit_handlers() -> Iterator[ExitHandlers]:
    """Within it, what a program registers waits here to be run."""
    handlers = ExitHandlers()
    before = atexit.register, atexit.unregister
    atexit.register, atexit.unregister = handlers.register, handlers.unregister
    try:
        yield handlers
    finally:
        atexit.register, atexit.unregister = before
