"""Programs written for hardware, in a rig's virtual time, unchanged.

    with Rig.open("rig.toml") as rig, in_virtual_time(rig):
        somebody_elses_program()

Within it `time`, `threading`, `queue`, `sched` and thread pools go by the rig's clock; each thread
is a party, and has its turn while the others wait. What cannot be so is refused by name.
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
    """Within it, this thread and those that it starts run a program in the rig's virtual time.

    `random` is seeded by the rig's seed. All is as before when it is left, however it is left;
    threads that are still there then end in the wait that they are in.

    Raises:
        UsageError: another program is in virtual time already, or this thread is no party of the
            rig: it did not open it.
    """
    if rig.runtime.party_of_thread() is None:
        raise UsageError(
            f"thread {threading.current_thread().name!r} is no party of this rig: enter "
            "in_virtual_time in the thread that opened it"
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
