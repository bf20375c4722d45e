"""An unmodified Python program in the time of a rig that runs in another process."""

import atexit
import sys
import threading
from contextlib import ExitStack
from typing import Any, Final

from motorhil.harness.cli.run import bus_settings
from motorhil.harness.shared_time.remote_rig import join
from motorhil.harness.virtual_time.stdlib.install import in_virtual_time
from motorhil.harness.virtual_time.stdlib.threads import join_executors
from motorhil.motorapi.errors import UsageError

_REFUSED: Final = 3


def enter() -> None:
    """Join the rig; let the standard library wait in its time until the program ends."""
    try:
        rig = join()
    except UsageError as error:
        print(f"motorhil: {error}", file=sys.stderr)
        raise SystemExit(_REFUSED) from None
    stack = ExitStack()
    stack.callback(rig.close)
    stack.enter_context(bus_settings(rig))
    stack.enter_context(in_virtual_time(rig))
    atexit.register(stack.close)
    register: Any = threading._register_atexit  # type: ignore[attr-defined]  # noqa: SLF001 -- before Python joins its threads, which would not wait in the rig's time
    register(_join_threads)


def _join_threads() -> None:
    join_executors()
    for thread in threading.enumerate():
        if thread is not threading.main_thread() and not thread.daemon:
            thread.join()
