"""Signals, timers and shared objects of unmodified binaries, in a rig's virtual time."""

import platform

import pytest

from motorhil.harness.rig.config.toml import RigError
from tests.support.programs.c_programs import compiled, needs_compiler

pytestmark = [pytest.mark.wall, needs_compiler]

# As the same program prints on Linux 6 with glibc 2.36 without a rig, in tenths of a second.
ON_LINUX = {
    "sleep": [
        *("signal 14 at 2", "8 left", "signal 14 at 5", "5 left"),
        *("signal 14 at 8", "2 left", "slept at 10"),
    ],
    "restart": ["signal 14 at 1", "read: 1 at 3", "sem_wait: 0 at 3"],
    "interrupt": [
        *("signal 14 at 1", "read: -1 EINTR at 1"),
        *("signal 14 at 2", "sem_wait: -1 EINTR at 2"),
    ],
    "signal": [
        *("value 7, timer 1, overrun 0", "signal 1 at 1"),
        *("value 7, timer 1, overrun 0", "signal 1 at 2"),
        *("value 7, timer 1, overrun 0", "signal 1 at 3", "3 at 5"),
    ],
    "overrun": ["signal 0 at 1", "slept at 4", "signal 0 at 4", "overrun 1", "2 at 4"],
    "thread": [*(f"call 7 at {time}, main 0" for time in (1, 2, 3)), "3 at 7"],
    "sigwait": [
        "sigtimedwait: -1, EAGAIN 1",
        *(f"0, value 7 at {time}" for time in (1, 2, 3)),
        *("sigwait: 0 at 4", "overrun 2 at 8"),
    ],
    "masks": [
        *("0 at 2", "signal 14 at 2", "signal 14 at 3"),
        *("signal 14 at 4", "ppoll: -1", "signal 14 at 5", "pselect: -1"),
        *("poll: 1", "signalfd: 14 at 6"),
    ],
    "threads": ["signal 12 at 10", *["signal 10 at 10"] * 3, "4 at 10"],
    "alarm": ["signal 14 at 20", "before 0, left 3, sleep left 3", "left 2"],
}


@pytest.mark.parametrize("act", ON_LINUX)
def test_signal_timers_act_as_on_linux_twice_the_same(twice, tmp_path, act):
    lines = twice(a=[compiled("signal_timers", tmp_path), act])
    assert lines == [f"a: {line}" for line in ON_LINUX[act]]


def test_alarm_without_handler_ends_the_program(run, tmp_path):
    _, wrong, _ = run(a=[compiled("signal_timers", tmp_path), "default"])
    assert wrong == {"a": "ended by SIGALRM"}


def test_handler_of_timer_sends_frames_at_its_times(twice, tmp_path):
    lines = twice(a=[compiled("signal_frames", tmp_path)])
    assert lines == [f"a: {ms} 1 ms" for ms in (10, 20, 30)]  # a frame takes less than 1 ms


def test_threads_meet_at_a_barrier_when_the_last_comes(twice, tmp_path):
    lines = twice(a=[compiled("shared_waits", tmp_path), "barrier"])
    assert sorted(lines[:3]) == [f"a: {thread} at 3000" for thread in (1, 2, 3)]
    assert sorted(lines[3:6]) == [f"a: {thread} at 6000" for thread in (1, 2, 3)]
    assert lines[6:] == ["a: serial: 2"]


def test_second_caller_of_pthread_once_waits_for_the_first(twice, tmp_path):
    lines = twice(a=[compiled("shared_waits", tmp_path), "once"])
    assert lines == ["a: main at 1000", "a: thread at 1000", "a: once: 1"]


@pytest.mark.parametrize("roles", [("keeper", "taker"), ("taker", "keeper")])
def test_program_waits_for_lock_of_file_of_another(twice, tmp_path, roles):
    program, file = compiled("shared_waits", tmp_path), tmp_path / "shared"
    lines = twice(**{role: [program, role, file] for role in roles})
    assert lines == ["taker: flock at 1000", "taker: lockf at 2000"]


CALLS = (
    *("nanosleep", "poll", "ppoll", "select", "pselect6"),
    *("epoll_wait", "epoll_pwait", "epoll_pwait2", "read", "clock_nanosleep"),
)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="its calls are those of x86-64")
def test_system_calls_by_number_wait_in_the_rigs_time(twice, tmp_path):
    lines = twice(a=[compiled("raw_calls", tmp_path)])
    results = {"read": 8}
    assert lines == [f"a: {call}: {results.get(call, 0)} after 100 ms" for call in CALLS]


def test_system_call_that_the_rig_has_not_is_refused_by_name(run, tmp_path):
    with pytest.raises(RigError, match="program a: ended before it joined"):
        run(a=[compiled("raw_calls", tmp_path), "timer"], lines=(lines := []))
    assert "makes the system call timer_create: not supported in the rig's time" in lines[0]


@pytest.mark.parametrize("roles", [("first", "second"), ("second", "first")])
def test_programs_wait_for_what_they_share_in_memory(twice, tmp_path, roles):
    program, file = compiled("shared_waits", tmp_path), tmp_path / "shared"
    lines = twice(**{role: [program, role, file] for role in roles})
    assert lines == ["second: semaphore at 1000", "second: mutex at 3000", "second: cond at 4000"]
