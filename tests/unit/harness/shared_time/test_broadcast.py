"""The broadcast manager of CAN in unmodified binaries, and frames in batches.

Expected messages follow Linux, Documentation/networking/can.rst: "Broadcast Manager protocol".
"""

import pytest

from tests.support.programs.c_programs import compiled, needs_compiler

pytestmark = [pytest.mark.wall, needs_compiler]

# In ms: count frames 10 ms apart, then one each 20 ms; a timeout 50 ms after the last frame; at
# most a change each 30 ms.
TOLD = {
    "cyclic": [
        *("0 frame 123#0A", "10 frame 123#0B", "20 expired 123 count 0", "20 frame 123#0A"),
        *("40 frame 123#0B", "60 frame 123#0C01", "80 frame 123#0D01"),
        *("85 tx status 123 count 0 123#0C01 123#0D01", "85 frame 7EE#"),
    ],
    "changes": [
        *("1 changed 123 count 0 123#0100", "21 changed 123 count 0 123#0200"),
        *("31 changed 123 count 0 123#02", "81 timeout 123 count 0"),
        "101 rx status 123 count 0 123#FF00000000000000",
        "101 changed 123 count 0 123#02",
    ],
    "throttle": [
        *("1 changed 123 count 0 123#00", "31 changed 123 count 0 123#02"),
        *("61 changed 123 count 0 123#05", "91 changed 123 count 0 123#07"),
    ],
    "multiplex": [
        *("1 changed 123 count 0 123#0111", "21 changed 123 count 0 123#0211"),
        *("31 changed 123 count 0 123#0212", "41 changed 123 count 0 123#0121"),
    ],
    "request": ["1 frame 123#0506"],
    "mistakes": [
        *("bind: Operation not supported", "connect: Transport endpoint is already connected"),
        *["write: Invalid argument"] * 3,
        *("write: Argument list too long", "write: Invalid argument", "short: Invalid argument"),
        "write: Transport endpoint is not connected",
    ],
}


@pytest.mark.parametrize("act", TOLD)
def test_broadcast_manager_acts_as_on_linux_twice_the_same(twice, tmp_path, act):
    lines = twice(a=[compiled("broadcast", tmp_path), act])
    assert lines == [f"a: {line}" for line in TOLD[act]]


def test_frames_in_batches_arrive_as_the_kernel_hands_them_out(twice, tmp_path):
    """A frame with 0 bytes has 47 bits and stuff bits: 0.1 ms at 500 kbit/s."""
    lines = twice(a=[compiled("can_batches", tmp_path)])
    assert lines == [
        "a: sent: 3",
        "a: all: 3 100/16 101/16 102/16 at 0 ms",
        "a: one: 1 200/16 at 0 ms",
        "a: limited: 1 201/16 at 0 ms",
        "a: one: 1 202/16 at 0 ms",
        "a: none: -1 EAGAIN at 0 ms",
    ]
