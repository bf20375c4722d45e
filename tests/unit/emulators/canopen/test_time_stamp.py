"""TIME consumer (CiA 301, 7.2.6 and 1012h): reception and stored value."""

import struct

import canopen
import pytest

from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary
from tests.support.canopen.client_loop import Loop
from tests.support.canopen.node_bench import UNSIGNED32, Bench, dictionary, put

CONSUME, PRODUCE = 0x8000_0000, 0x4000_0000


def with_time(cob_id: int = CONSUME | 0x100) -> ObjectDictionary:
    od = dictionary()
    put(od, 0x1012, 0, UNSIGNED32, cob_id)
    put(od, 0x2012, 0, DataType.TIME_OF_DAY, 0, "ro")
    return od


def test_node_keeps_time_of_canopen_producer():
    bench = Bench(with_time()).boot()
    Loop(bench).time.transmit(1_795_361_400.25)  # 22 November 2026, 15:30:00.25 UTC
    # 1 January 1984 is day 0: 42 years with 11 leap days, and 325 days
    days = 42 * 365 + 11 + 325
    milliseconds = (15 * 3600 + 30 * 60) * 1000 + 250
    assert bench.od.integer(0x2012, 0, 0) == days << 32 | milliseconds
    remote = Loop(bench).remote
    assert remote.sdo.upload(0x2012, 0) == struct.pack("<IH", milliseconds, days)
    (told,) = bench.node.take_events()
    assert told == ("info", f"TIME: day {days} since 1984, 55800.250 s after midnight")
    assert issubclass(Loop, canopen.Network)


def test_unused_bits_and_running_clock_give_no_event():
    bench = Bench(with_time()).boot()
    bench.tell(0x100, "E8 03 00 F0 02 00")
    assert bench.od.integer(0x2012, 0, 0) == 2 << 32 | 1000
    bench.wait(5_000_000_000)
    bench.tell(0x100, "70 17 00 00 02 00")  # 5 s later by its clock too
    assert len(bench.node.take_events()) == 1
    bench.tell(0x100, "70 17 00 00 03 00")
    assert len(bench.node.take_events()) == 1


@pytest.mark.parametrize(
    ("cob_id", "frame"),
    [
        (0x100, "E8 03 00 00 02 00"),  # bit 31 clear: it does not listen
        (CONSUME | 0x100, "E8 03 00 00 02"),
        (CONSUME | 0x100, "E8 03 00 00 02 00 00"),
        (CONSUME | 0x0FF, "E8 03 00 00 02 00"),
    ],
)
def test_foreign_time_message_is_ignored(cob_id, frame):
    bench = Bench(with_time(cob_id)).boot()
    bench.tell(0x100, frame)
    assert bench.od.integer(0x2012, 0, -1) == 0


@pytest.mark.parametrize(
    ("cob_id", "code"),
    [
        (0x100, ""),
        (CONSUME | 0x100, ""),
        (CONSUME | 0x0A0, "0609 0030"),  # another identifier while it listens
        (0x0A0, ""),
        (PRODUCE | 0x100, "0609 0030"),  # it sends none
        (0x2000_0100, "0609 0030"),  # 29 bits
        (0x0000_0701, "0609 0030"),  # taken
    ],
)
def test_1012h_refuses_invalid_values(cob_id, code):
    bench = Bench(with_time()).boot()
    assert bench.download(0x1012, 0, cob_id, 4) == code


def test_node_without_1012h_does_not_listen():
    bench = Bench().boot()
    assert 0x100 not in bench.node.identifiers()
