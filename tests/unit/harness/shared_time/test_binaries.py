"""Unmodified binaries as programs of a rig, in its virtual time."""

import os
import re
import shutil
import sys
from functools import partial
from random import Random

import pytest

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.shared_time import binaries
from tests.support.checkout import CHECKOUT
from tests.support.programs.c_programs import compiled, needs_compiler

pytestmark = [pytest.mark.wall, needs_compiler]

DRIVE = """
[bus.can0]
bitrate_bit_s = 1_000_000

[controller.left]
kind = "cia402"
bus = "can0"
node_id = 1
plant = { preset = "wheel_60w" }
"""
SLEPT = [  # each look at a clock takes 1 us
    "a: 100000.000001000 0.000002 0",
    "a: 103600.000005000 3600.000006 3600",
]
# CiA 301, SDO upload of 1000h: expedited answer of four bytes (43h), device type 20192h: device
# profile 402 (192h), servo drive (2).
QUESTION = "40 00 10 00 00 00 00 00"
REQUEST = "601#" + QUESTION.replace(" ", "")
ANSWER = "43 00 10 00 92 01 02 00"
needs_can_utils = pytest.mark.skipif(
    shutil.which("candump") is None or shutil.which("cansend") is None, reason="needs can-utils"
)


@pytest.mark.timeout(60)  # of the wall
def test_c_program_sleeps_an_hour_at_once(twice, tmp_path):
    lines = twice(a=[compiled("sleeper", tmp_path)])
    assert lines == SLEPT


def test_c_program_has_answer_of_drive_by_sdo_twice_the_same(twice, tmp_path):
    lines = twice(DRIVE, a=[compiled("sdo_client", tmp_path)])
    assert lines == [f"a: 581: {ANSWER} within 5 ms", "a: -1, 2 s"]


def test_c_program_hears_frames_of_its_sleep_after_300_sockets(run, tmp_path):
    lines, wrong, _ = run(a=[compiled("sockets", tmp_path)])
    assert wrong == {}, lines
    assert lines == ["a: other: 1 2 3", "a: sender:", "a: sender: 4"]


@needs_can_utils
def test_candump_shows_frames_of_cansend_and_drive_twice_the_same(twice):
    commands = {
        "dump": ["candump", "-ta", "-T", "1000", "can0,581:7FF,601:7FF"],
        "send": ["sh", "-c", f"exec cansend can0 {REQUEST}"],
        "ask": ["sh", "-c", f"exec cangen -g 500 -n 3 -I 601 -L 8 -D {REQUEST[4:]} can0"],
    }
    lines = twice(DRIVE, **commands)
    frames = [line.split("can0")[1].split() for line in lines]
    request, answer = ["601", "[8]", *QUESTION.split()], ["581", "[8]", *ANSWER.split()]
    assert frames == [request, request, request, answer, request, answer]  # it boots for 0.3 s


LOG = """\
(1700000000.500000) can1 601#4000100000000000
(1700000000.750000) can1 123#
(1700000001.000000) can1 601#4000100000000000
"""


@needs_can_utils
def test_canplayer_repeats_gaps_of_its_log_twice_the_same(twice, tmp_path):
    """Check a player that looks each millisecond at what is due; the drive boots for 0.3 s."""
    (tmp_path / "log.txt").write_text(LOG)
    lines = twice(
        DRIVE,
        dump=["candump", "-ta", "-T", "1000", "can0,581:7FF,601:7FF,123:7FF"],
        play=["canplayer", "-I", "log.txt", "can0=can1"],
    )
    found = [(float(line.split()[1][1:-1]), line.split()[3]) for line in lines]
    assert [(int(1000 * time_s), name) for time_s, name in found] == [
        *((1, "601"), (250, "123"), (500, "601"), (501, "581")),
    ]


@needs_can_utils
def test_random_frames_of_cangen_are_twice_the_same(twice):
    """Its chance comes from the clock."""
    lines = twice(
        dump=["candump", "-T", "1000", "can0"],
        one=["cangen", "can0", "-g", "2", "-n", "20"],
        two=["cangen", "can0", "-g", "3", "-n", "20", "-e"],
    )
    assert len(lines) == 40
    assert len({line.split("can0")[1] for line in lines}) > 30


WAITS = "cmwsknaplxf123"  # each ends at its own deadline: see waiters.c
TIMERS = "123"
ENDED = "CSFR"  # each is ended by another thread


def random_cases(count):
    """Return cases of four waits: (kind, end [ms]) by thread. Ends are equal now and then."""
    random = Random(21)
    cases = []
    for _ in range(count):
        if random.random() < 0.5:
            cases.append([(random.choice(WAITS), random.randint(1, 6)) for _ in range(4)])
        else:
            ends = random.sample(range(1, 3_000), 4)
            cases.append([(random.choice(WAITS + ENDED), end) for end in ends])
    return cases


def order_of_waking(case):
    """Return (thread, end [ms]) in order: events before timeouts, then the wait begun first."""
    waits = [(end, kind not in TIMERS, thread) for thread, (kind, end) in enumerate(case)]
    return [(thread, end) for end, _, thread in sorted(waits)]


def require_model(run, tmp_path, count):
    cases = random_cases(count)
    assert {kind for case in cases for kind, _ in case} == set(WAITS + ENDED)
    text = "\n".join(" ".join(f"{kind}:{end}" for kind, end in case) for case in cases)
    (tmp_path / "cases.txt").write_text(text)
    program = compiled("waiters", tmp_path)
    lines, wrong, record = run(a=[program, tmp_path / "cases.txt"])
    assert wrong == {}, lines[-3:]
    assert len(lines) == count
    for number, (case, line) in enumerate(zip(cases, lines, strict=True)):
        woken = [tuple(map(int, pair.split(":"))) for pair in line.split()[1:]]
        assert woken == order_of_waking(case), f"case {number}: {case}"
    return record


def test_random_waits_of_four_threads_end_in_order_of_model(run, tmp_path):
    digests = {require_model(run, tmp_path, 200) for _ in range(2)}
    assert len(digests) == 1


@pytest.mark.nightly
@pytest.mark.timeout(1_200)
def test_10000_random_waits_end_in_order_of_model(run, tmp_path):
    require_model(run, tmp_path, 10_000)


def test_threads_that_wait_for_one_thing_have_it_in_order_of_waits(twice, tmp_path):
    lines = twice(a=[compiled("queues", tmp_path)])
    assert lines == [
        "a: cond: 2, 1, 0,",
        "a: semaphore: 2, 1, 0,",
        "a: futex: 1, 0,, 2",  # the third waits for another bit
        "a: mutex:,,, 2 1 0",
        "a: rwlock:,,, 2 1 0",
        "a: eventfd: 2, 1, 0,",
        "a: 1 1 cancelled 1",
        "a: 1 4 s",
    ]


def test_waits_of_cpp_library_end_in_virtual_time(twice, tmp_path):
    lines = twice(a=[compiled("cpp_waits", tmp_path)])
    waits = ["sleep_for", "wait_for", "wait_until", "future", "promise", "timed_mutex", "async"]
    assert lines == [f"a: {wait} {100 * number}" for number, wait in enumerate(waits, 1)]


def test_threads_of_c11_end_in_virtual_time(twice, tmp_path):
    lines = twice(a=[compiled("c11_waits", tmp_path)])
    assert lines == ["a: woken at 3 s", "a: ended at 3 s"]


def test_question_for_can_interface_by_netlink_is_answered(run, tmp_path):
    lines, wrong, _ = run(a=[compiled("netlink_query", tmp_path)])
    assert wrong == {}
    assert lines == ["a: type CAN", "a: name can0", "a: MTU 16", "a: kind can", "a: error 0"]


def test_event_loop_with_timer_and_can_sockets_twice_the_same(twice, tmp_path):
    lines = twice(a=[compiled("can_loop", tmp_path)])
    frames = [
        [f"a: all can0 80 {ms}", f"a: own can0 80 {ms} own local"] for ms in (5, 15, 25)
    ]  # a message has left the bus less than 1 ms after the timer
    assert lines == [*frames[0], *frames[1], "a: next in 10 ms", *frames[2]]


@pytest.mark.parametrize("first", ["server", "client"])
def test_programs_talk_by_unix_socket_twice_the_same(twice, tmp_path, first):
    program = compiled("neighbours", tmp_path)
    names = ["server", "client"] if first == "server" else ["client", "server"]
    lines = twice(**{name: [program, name, "door"] for name in names})
    assert lines == [
        "server: accepted at 3 ms",
        "client: abc at 53 ms",
        "client: abc at 303 ms",
        "server: closed at 503 ms",
    ]


@needs_can_utils
def test_rig_of_how_to_prints_its_answer(run):
    page = (CHECKOUT / "docs" / "how-to" / "run-several-programs.md").read_text()
    binaries_of_page = page.partition("\n## Binaries\n")[2]
    rig, answer = (binaries_of_page.partition(f"```{kind}\n")[2] for kind in ("toml", "text"))
    lines, wrong, _ = run(rig.partition("```")[0])
    assert wrong == {}
    assert "\n".join(lines) == answer.partition("\n```")[0]


SENT = ["100", "101", "103", "80000103", "40000100"]


@pytest.mark.parametrize(
    ("filters", "joins", "heard"),
    [  # Linux, Documentation/networking/can.rst: id & mask == filter id & mask; 20000000h inverts
        ("0:0", 0, SENT),
        ("100:7FF", 0, ["100", "40000100"]),
        ("100:C00007FF", 0, ["100"]),
        ("80000103:9FFFFFFF", 0, ["80000103"]),
        ("20000103:7FF", 0, ["100", "101", "40000100"]),
        ("100:7FC,101:7FF", 0, SENT),
        ("100:7FC,20000101:7FF", 1, ["100", "103", "80000103", "40000100"]),
        (",", 0, []),  # none
    ],
)
def test_filters_of_can_socket_select_as_linux_does(run, tmp_path, filters, joins, heard):
    program = compiled("can_filters", tmp_path)
    lines, wrong, _ = run(a=[program, joins, 0, filters, *SENT])
    assert wrong == {}
    assert lines == ["a: " + "".join(f" {one}" for one in heard)]


UNSUPPORTED = "not supported in the rig's time; expected"


@pytest.mark.parametrize(
    ("act", "end", "told"),
    [
        ("spin-clock", None, ["polls without sleeping; each poll takes 10 us", "0 at 20 s"]),
        ("spin-yield", None, ["1 at 0 s"]),
        ("spin-trylock", None, ["polls without sleeping", "0 at 2 s"]),
        ("spin", "ended by SIGKILL", ["has kept the turn for 1 s of wall time", "has left"]),
        ("exit-in-thread", "exit status 5", []),
        ("exit-main-thread", None, ["slept"]),
        ("kill", "ended by SIGKILL", ["has left the rig: its connection has ended"]),
        ("many-threads", None, ["200 at 0 s"]),
        ("short-threads", None, ["1500 at 1 s"]),
        ("cancel", None, ["0 at 2 s"]),
        ("close-all", None, ["0 at 2 s"]),
        ("close-all-raw", "exit status 3", ["the rig has ended", "has left the rig"]),
        ("handler", "exit status 3", ["'a' waits in the handler of a signal from outside"]),
        ("handler-sends", "exit status 3", ["'a' sends a frame in a signal handler"]),
        ("fork", None, ["a forked child of program 'a' has the time of the wall", "0 at 2 s"]),
        ("fork-can", None, ["a forked child of program 'a' uses its CAN socket", "child: 3"]),
        ("popen", None, ["a pipe of another process, which has the time of the wall", "poll: 0"]),
        ("no-sender", None, ["1000001 at 11 s"]),
        ("spin-pipe", None, ["1 at 0 s"]),
        ("full-pipe", None, ["written: 400000"]),
        ("full-socket", None, ["written: 400000"]),
        (
            *("signals", None),
            ["poll: -1, interrupted: 1, signals: 1", "sleep: 9 s left", "2 at 2 s"],
        ),
        ("socket-timeout", None, ["recv: -1, timeout: 1", "0 at 2 s"]),
        ("exec", "its connection has ended", ["has left the rig"]),
        ("leave-at-once", "its connection has ended", ["has left the rig"]),
        ("isotp", None, ["CAN_ISOTP (6): not supported", "Protocol not supported", "0 at 1 s"]),
    ],
)
def test_hostile_program_is_told_by_name_and_ends(run, tmp_path, act, end, told):
    lines, wrong, _ = run(a=[compiled("hostile", tmp_path), act], stall_s=1)
    assert wrong == ({} if end is None else {"a": end})
    for part in told:
        assert any(part in line for line in lines), lines


@pytest.mark.parametrize(
    ("act", "told"),
    [
        ("msgsnd", f"calls msgsnd(): {UNSUPPORTED}"),
        ("cpu-timer", f"calls timer_create() with clock 2: {UNSUPPORTED}"),
        ("cpu-itimer", f"calls setitimer() with a clock of the processor: {UNSUPPORTED}"),
        (
            "shared-barrier",
            f"calls pthread_barrier_init() for an object that processes share: {UNSUPPORTED}",
        ),
    ],
)
def test_unsupported_call_before_joining_ends_the_run(run, tmp_path, act, told):
    lines = []
    with pytest.raises(RigError, match="program a: ended before it joined"):
        run(a=[compiled("hostile", tmp_path), act], lines=lines)
    assert told in lines[0]


def test_second_process_of_program_is_told_and_fails(run, tmp_path):
    sleeper = compiled("sleeper", tmp_path)
    lines, wrong, _ = run(a=["sh", "-c", f"{sleeper}; {sleeper}"])
    assert wrong == {"a": "exit status 3"}
    assert lines[:2] == SLEPT
    assert "has joined the rig already, in another process; expected one process" in lines[2]


def test_deadlock_of_threads_names_them(run, tmp_path):
    lines, wrong, _ = run(a=[compiled("hostile", tmp_path), "deadlock"])
    assert wrong == {"a": "exit status 3"}
    assert any("(waiting: main, a, a/thread 1)" in line for line in lines)


def test_other_program_goes_on_beside_hostile_one(run, tmp_path):
    sleeper = compiled("sleeper", tmp_path)
    lines, wrong, _ = run(a=[compiled("hostile", tmp_path), "kill"], b=[sleeper])
    assert wrong == {"a": "ended by SIGKILL"}
    assert lines[-1] == "b: 103600.000005000 3600.000006 3600"


def test_static_program_is_refused_before_start(run, tmp_path):
    program = compiled("sleeper", tmp_path, "-static")
    with pytest.raises(RigError, match=rf"rig.toml:\d+: .*{program} is statically linked; link it"):
        run(a=[program])


def test_program_for_other_machine_is_refused_before_start(run, tmp_path):
    program = compiled("sleeper", tmp_path)
    image = bytearray(program.read_bytes())
    image[18] = 183 if image[18] != 183 else 62  # e_machine, ELF specification: AArch64, x86-64
    program.write_bytes(image)
    with pytest.raises(RigError, match=r"sleeper is for (AArch64|x86-64); expected one for this"):
        run(a=[program])


def test_program_of_go_or_musl_is_refused_before_start(run, tmp_path):
    """By the marks that Go's linker and musl's loader leave, in a program that has neither."""
    program = compiled("sleeper", tmp_path)
    image = program.read_bytes()
    program.write_bytes(image + b"\xff Go buildinf:")
    with pytest.raises(RigError, match=r"sleeper is a Go program, which waits without the C lib"):
        run(a=[program])
    loader = re.search(rb"/lib[^\0]*/ld-linux[^\0]*", image)[0]
    other = b"/lib/ld-musl-x86_64.so.1".ljust(len(loader), b"\0")
    program.write_bytes(image.replace(loader, other))
    with pytest.raises(RigError, match=r"sleeper uses another C library; build it with glibc"):
        run(a=[program])


def test_without_compiler_the_run_is_refused_in_one_line(run, tmp_path, monkeypatch):
    program = compiled("sleeper", tmp_path)
    monkeypatch.setenv("CC", "no-such-compiler")
    monkeypatch.setattr(binaries, "library", partial(binaries.build, tmp_path / "build" / "x.so"))
    with pytest.raises(
        RigError, match=r"cannot be built: .*no-such-compiler.*; install a C"
    ) as told:
        run(a=[program])
    assert "\n" not in str(told.value)


def test_path_that_preload_cannot_name_is_refused(run, tmp_path, monkeypatch):
    monkeypatch.setattr(binaries, "library", lambda: tmp_path / "a b" / "library.so")
    with pytest.raises(RigError, match="cannot name a path with a space or colon; install it"):
        run(a=[compiled("sleeper", tmp_path)])


def test_python_programs_need_no_library(tmp_path):
    script = tmp_path / "script"
    script.write_text("#!/usr/bin/env python3\n")
    assert binaries.preload("python3", tmp_path, os.environ) == ""
    assert binaries.preload(sys.executable, tmp_path, os.environ) == ""
    assert binaries.preload("./script", tmp_path, os.environ) == ""
    assert binaries.preload("no-such-program", tmp_path, os.environ) == ""
    shell = binaries.preload("sh", tmp_path, {**os.environ, "LD_PRELOAD": "other.so"})
    assert shell == f"{binaries.library()}:other.so"
