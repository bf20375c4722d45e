"""Unmodified programs for hardware, run in a rig's virtual time.

    with Rig.open("rig.toml") as rig, in_virtual_time(rig):
        main_of_the_program()

Inside the block `time`, `threading`, `queue`, `sched` and thread pools use the rig's clock. Each
thread is a party, which runs while the others wait. Operations that cannot use the rig's clock
raise UsageError.
"""

import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from harness.virtual_program.stand_ins import standard_library_replaced
from harness.virtual_program.threads import end_threads, join_executors
from harness.virtual_program.turn import program_on
from motorapi.errors import UsageError

if TYPE_CHECKING:
    from harness.rig import Rig

__all__ = ["in_virtual_time", "join_executors"]


@contextmanager
def in_virtual_time(rig: "Rig") -> Iterator[None]:
    """Run a program in the rig's virtual time: this thread and those that it starts.

    `random` is seeded from the rig's seed. At the end of the block everything is restored, and
    threads that still run are ended in their current wait.

    Raises:
        UsageError: another program is in virtual time already, or this thread is not a party of the
            rig because it did not open the rig.
    """
    if rig.runtime.party_of_thread() is None:
        raise UsageError(
            f"thread {threading.current_thread().name!r} is not a party of this rig; enter "
            "in_virtual_time in the thread that opened the rig"
        )
    with program_on(rig.runtime) as program, _seeded(rig.seed), standard_library_replaced():
        try:
            yield
        finally:
            end_threads(program)


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    before = random.getstate()
    random.seed(f"{seed}:program")
    try:
        yield
    finally:
        random.setstate(before)
