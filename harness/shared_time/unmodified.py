"""An unmodified Python program in the time of a rig that runs in another process."""

import atexit
import os
import sys
import threading
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Final

from motorhil.harness.python_can.hardware_names import bus_settings
from motorhil.harness.shared_time.remote_rig import join
from motorhil.harness.virtual_time.stdlib.children import take_parents_pipes
from motorhil.harness.virtual_time.stdlib.install import in_virtual_time
from motorhil.harness.virtual_time.stdlib.signals import postpone_interrupt
from motorhil.harness.virtual_time.stdlib.threads import join_executors
from motorhil.motorapi.errors import UsageError

_REFUSED: Final = 3


def enter() -> None:
    """Join the rig; let the standard library wait in its time until the program ends."""
    try:
        rig = join()
    except UsageError as error:
        print(f"motorhil: {error}", file=sys.stderr, flush=True)
        os._exit(_REFUSED)  # Python's start would tell of an exception by a fatal error
    stack = ExitStack()
    stack.callback(rig.close)
    stack.enter_context(bus_settings(rig.description.buses))
    stack.enter_context(in_virtual_time(rig, rig.children))
    take_parents_pipes()
    postpone_interrupt(rig.runtime)
    atexit.register(stack.close)
    sys.excepthook = _print_error
    register: Any = threading._register_atexit  # type: ignore[attr-defined]  # noqa: SLF001 -- before Python joins its threads, which would not wait in the rig's time
    register(_join_threads)


def _print_error(
    kind: type[BaseException], error: BaseException, place: TracebackType | None
) -> None:
    """Print a traceback as Python does, except for the end of the run, which is no error."""
    if kind is not KeyboardInterrupt:
        sys.__excepthook__(kind, error, place)


def _join_threads() -> None:
    join_executors()
    for thread in threading.enumerate():
        if thread is not threading.main_thread() and not thread.daemon:
            thread.join()
