"""A call in a forked process tells how it ended, and leaves nothing behind."""

import os
import signal
import subprocess
import sys

import pytest

from motorhil.harness.swarm.child import CLOSED, call_forked
from tests.support.command_line import has_ended

LATE_S = 0.2  # long enough to begin, for children that never end
LONG_S = 60.0


def leave(status):
    os._exit(status)


def kill(number):
    os.kill(os.getpid(), number)
    signal.pause()


def close_all():
    os.closerange(0, 64)
    return "never heard"


def close_all_and_stay():
    os.closerange(0, 64)
    while True:
        signal.pause()


def fork_and_leave_a_copy():
    if os.fork() == 0:
        while True:
            signal.pause()
    return "the parent"


def raise_an_error():
    raise ValueError


def test_answer_of_any_length_arrives():
    ended = call_forked(lambda: "x" * 300_000, LONG_S)
    assert (ended.text, ended.is_late) == (b"x" * 300_000, False)


def test_child_that_leaves_its_process_tells_its_status():
    ended = call_forked(lambda: leave(3), LONG_S)
    assert ended.text is None
    assert os.waitstatus_to_exitcode(ended.status) == 3


@pytest.mark.parametrize("number", [signal.SIGSEGV, signal.SIGKILL, signal.SIGABRT])
def test_child_that_is_killed_tells_the_signal(number):
    ended = call_forked(lambda: kill(number), LONG_S)
    assert ended.text is None
    assert os.waitstatus_to_exitcode(ended.status) == -number


def test_child_that_hangs_is_late():
    ended = call_forked(lambda: signal.pause() or "woken", LATE_S)
    assert ended.is_late


@pytest.mark.parametrize("call", [close_all, raise_an_error])
def test_child_without_an_answer_has_its_own_status(call):
    ended = call_forked(call, LONG_S)
    assert ended.text is None
    assert not ended.is_late
    assert os.waitstatus_to_exitcode(ended.status) == CLOSED


def test_child_that_closes_all_files_and_hangs_is_late():
    assert call_forked(close_all_and_stay, LATE_S).is_late


def test_copy_of_a_child_does_not_delay_its_answer():
    ended = call_forked(fork_and_leave_a_copy, LONG_S)
    assert ended.text == b"the parent"


def test_process_that_a_child_leaves_is_ended():
    command = [sys.executable, "-c", "import signal; signal.pause()"]
    ended = call_forked(lambda: str(subprocess.Popen(command).pid), LONG_S)
    assert has_ended(int(ended.text))


def test_child_reads_nothing_and_has_no_files_of_its_parent():
    reading, writing = os.pipe()
    os.set_inheritable(writing, True)

    def look():
        names = sorted(map(int, os.listdir("/proc/self/fd")))
        return f"{sys.stdin.read()!r} {writing in names}"

    try:
        assert call_forked(look, LONG_S).text == b"'' False"
    finally:
        os.close(reading)
        os.close(writing)
