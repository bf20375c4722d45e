"""Signal handlers of programs, which run in a turn of the main thread.

Python calls a handler in the main thread, also while that thread waits. The handler would then act
beside the party that has the turn. Its exception would end a wait that other parties still count.
So a handler is postponed to the next turn of the main thread. The handler may wait. The interrupted
wait continues after it.
"""

import signal
from collections.abc import Callable
from typing import Any, Final

from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.harness.virtual_time.stdlib.threads import caller_is_outside, program_here

_signal = signal.signal
_getsignal = signal.getsignal
_WRAPPED: Final = "_motorhil_handler"  # the attribute of a postponed one


def _postponed(runtime: VirtualRuntime, handler: Callable[..., Any]) -> Callable[..., Any]:
    def handle(number: int, frame: object) -> None:
        if not runtime.call_in_turn(lambda: handler(number, frame)):
            handler(number, frame)

    setattr(handle, _WRAPPED, handler)
    return handle


def postpone_interrupt(runtime: VirtualRuntime) -> None:
    """Postpone the KeyboardInterrupt of SIGINT, unless the signal has another handler."""
    if _getsignal(signal.SIGINT) is signal.default_int_handler:
        _signal(signal.SIGINT, _postponed(runtime, signal.default_int_handler))


def set_handler(number: int, handler: Any) -> Any:
    """Stand in for signal.signal."""
    program = program_here()
    if program is not None and callable(handler) and not caller_is_outside(2):
        handler = _postponed(program.runtime, handler)
    before = _signal(number, handler)
    return getattr(before, _WRAPPED, before)


def handler_of(number: int) -> Any:
    """Stand in for signal.getsignal."""
    found = _getsignal(number)
    return getattr(found, _WRAPPED, found)


def stand_ins() -> list[tuple[object, object]]:
    """Return (original, stand-in) of the functions that are replaced."""
    return [(_signal, set_handler), (_getsignal, handler_of)]
