"""Ends of frames and wires: last bits, intermission, partial shorts."""

import random

import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule, FrameError, WireLevel
from tests.support.can.deliveries import BIT, confirmed, expire_all, heard, run, traffic
from tests.support.can.faulty_bus import HEARTBEAT, HOST, LEFT, RIGHT, STATUS, SYNC, bus_with


def test_error_in_last_bit_duplicates_frame_and_counts():
    """By hand: STATUS is bits 0 to 62.

    Left reads 62 dominant, its flag is 63 to 68. The others read the first bit of intermission
    dominant, their overload flags are 64 to 69; delimiter to 77, intermission to 80, and the frame
    again from 81 on. A DUPLICATE takes as long.
    """
    bus = bus_with(FaultRule("strike", FaultKind.ERROR, error=FrameError.LAST, limit=1))
    deliveries = run(bus, [(0, LEFT, STATUS)])
    assert heard(deliveries, HOST) == [(63 * BIT, STATUS), ((81 + 63) * BIT, STATUS)]
    assert confirmed(deliveries, LEFT) == [((81 + 63) * BIT, STATUS)]
    assert [bus.node(port).confinement.tec for port in (LEFT, RIGHT, HOST)] == [7, 0, 0]
    stand_in = bus_with(FaultRule("strike", FaultKind.DUPLICATE, limit=1))
    assert heard(run(stand_in, [(0, LEFT, STATUS)]), HOST) == heard(deliveries, HOST)


def test_receiver_with_error_in_last_but_one_bit_hears_it_once():
    """Right refuses it in bit 61, with a flag of 62 to 67; left fails in 62, host has it."""
    strike = FaultRule("strike", FaultKind.ERROR, error=FrameError.LAST, ports=("right",), limit=1)
    bus = bus_with(strike)
    deliveries = run(bus, [(0, LEFT, STATUS)])
    assert [len(heard(deliveries, port)) for port in (RIGHT, HOST)] == [1, 2]
    assert bus.node(LEFT).confinement.tec == 7


@pytest.mark.parametrize(
    ("shorted", "quiet"), [((), "host"), (("host",), "host"), (("left",), "left")]
)
def test_short_affects_one_part_of_split_bus(shorted, quiet):
    names = ("left", "right", "host", "ear")
    split = FaultRule("cable", FaultKind.SPLIT, ports=("left", "right"))
    short = FaultRule("short", FaultKind.SHORT, level=WireLevel.DOMINANT, ports=shorted)
    bus = CanBus("can0", faults=FaultPlan([split, short], random.Random(1).random))
    for name in names:
        bus.attach(name)
    deliveries = run(bus, [(0, 0, STATUS), (0, 2, SYNC)], until_ns=10**9)
    got = {names[port] for port in range(4) if confirmed(deliveries, port)}
    assert got == {"left", "host"} - {quiet}
    bus.lift("cable", 10**9)  # now they are one shorted wire
    bus.submit(1, HEARTBEAT, 10**9)
    assert traffic(expire_all(bus, 2 * 10**9)) == []


def test_dominant_third_intermission_bit_starts_other_frame():
    """STATUS is bits 0 to 62, its intermission 63 to 65.

    A dominant 65 is a start of frame to all. Right has HEARTBEAT pending, and continues with its
    identifier (55 bits from 65 on).
    """
    strike = FaultRule("strike", FaultKind.ERROR, identifier=0x181, bit=65, limit=1)
    bus = bus_with(strike)
    deliveries = run(bus, [(0, LEFT, STATUS), (0, RIGHT, HEARTBEAT)])
    assert heard(deliveries, HOST) == [(63 * BIT, STATUS), ((65 + 55) * BIT, HEARTBEAT)]
    assert heard(deliveries, LEFT) == [((65 + 55) * BIT, HEARTBEAT)]
    assert confirmed(deliveries, RIGHT) == [((65 + 55) * BIT, HEARTBEAT)]
    assert bus.statistics.counts() == {0x181: 1, 0x701: 1}
    assert bus.node(LEFT).errors == bus.node(RIGHT).errors == 0
