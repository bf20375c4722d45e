"""The numbers that workers share."""

import mmap
import os
import signal

from motorhil.harness.sharing_tests.processes import Plan
from motorhil.harness.sharing_tests.workers import Desk

READS = 1_000_000
VALUES = (0x1111_1111_1111, 0x2222_2222_2222)


def test_value_being_written_is_the_old_or_the_new_one(tmp_path):
    """A worker may be paused in the middle of the write."""
    desk = Desk(tmp_path, Plan(), 0, memoryview(mmap.mmap(-1, mmap.PAGESIZE)).cast("q"), -1)
    desk.value = VALUES[0]
    writer = os.fork()
    if not writer:
        while True:
            for value in VALUES:
                desk.value = value
    try:
        assert {desk.value for _ in range(READS)} <= set(VALUES)
    finally:
        os.kill(writer, signal.SIGKILL)
        os.waitpid(writer, 0)
