"""Several drives on one bus, compared with a bitwise model.

`on_the_wire` builds frames bit by bit from ISO 11898-1 and shares no code with the emulator.
"""

import itertools

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from tests.support.can.frame_bits import INTERMISSION, Fields, on_the_wire
from tests.support.canopen.drive_wire import MS, US, Wire

NODES = (1, 2, 3, 4)


def bits_of(text: str) -> int:
    """Return start of frame to end of frame of "181#3706"."""
    head, _, tail = text.partition("#")
    data = bytes.fromhex(tail)
    return len(on_the_wire(Fields(int(head, 16), False, False, len(data), data)))


def csp(wire: Wire) -> None:
    """Configure every drive: RPDO 3 (6040h, 607Ah) and TPDO 3 (6041h, 6064h) of type 1 only."""
    for node in NODES:
        for number in (1, 2, 4):
            wire.set(0x1800 + number - 1, 1, 0x8000_0080 + number * 0x100 + node, 4, node)
        wire.set(0x1402, 2, 1, 1, node)
        wire.set(0x6060, 0, 8, 1, node)
    wire.tell("000#0100")
    for word in (0x06, 0x07, 0x0F):
        for node in NODES:
            wire.controlword(word, node)
    wire.run(25 * MS)


def cycle(wire: Wire, target: int) -> None:
    """Run one millisecond: targets, then SYNC, in the order of one host's queue."""
    begun = wire.now
    position = target.to_bytes(4, "little", signed=True).hex().upper()
    wire.send(*(f"{0x400 + node:03X}#0F00{position}" for node in NODES), "080#")
    wire.run_to(begun + MS)


def test_frames_never_overlap_and_load_equals_their_bits():
    wire = Wire(*({"node_id": node} for node in NODES)).boot()
    csp(wire)
    count, begun = len(wire.log), wire.now
    for number in range(50):
        cycle(wire, -7 * number)
    frames = [(time_ns, text) for time_ns, _, text in wire.log[count:]]
    assert len(frames) == 50 * 9
    for (before, _), (after, text) in itertools.pairwise(frames):
        start = after - bits_of(text) * US
        assert start >= before + INTERMISSION * US, text
    bits = sum(bits_of(text) + INTERMISSION for _, text in frames)
    assert wire.bus.statistics.load(begun, wire.now) == pytest.approx(bits / 50_000, abs=1e-12)
    assert 0.80 < bits / 50_000 < 0.98  # required: 0.8 to 0.98 ms of bus in each ms


def test_tpdos_of_sync_come_in_identifier_order():
    wire = Wire(*({"node_id": node} for node in NODES)).boot()
    wire.tell("000#0100")
    wire.run(10 * MS)
    count = len(wire.log)
    wire.tell("080#")
    wire.run(5 * MS)
    order = [text[:3] for text in wire.since(count)]
    assert order == [f"{base + node:03X}" for base in (0x380, 0x480) for node in NODES]
    times = [time_ns for time_ns, _, _ in wire.log[count + 1 :]]
    lengths = [bits_of(text) + INTERMISSION for text in wire.since(count)]
    assert [b - a for a, b in itertools.pairwise(times)] == [bits * US for bits in lengths[1:]]


def test_emergency_beats_pdos_and_sdo_response_loses():
    wire = Wire(*({"node_id": node} for node in NODES)).boot()
    wire.tell("000#0100")
    wire.run(10 * MS)
    count = len(wire.log)
    wire.send("601#4000100000000000")
    wire.run_to(wire.now + 1 * MS + 118 * US)  # just before the response of node 1 is due
    wire.send("77E#05")  # keeps the bus busy meanwhile
    wire.run(20 * US)
    for node in (4, 3):
        wire.stimulate("fault", 0x2310, node)
    wire.run(3 * MS)
    order = [text[:3] for text in wire.since(count)]
    # every node has a FIFO queue: its TPDOs wait behind its EMCY
    assert order == ["083", "084", "183", "184", "283", "284", "581"]


def test_repeated_sync_is_too_early_and_lost_one_missing():
    wire = Wire().operational()
    wire.run(10 * MS)
    wire.inject(FaultRule("twice", FaultKind.DUPLICATE, identifier=0x80, limit=1))
    count = len(wire.log)
    wire.tell("080#")
    wire.run(5 * MS)
    # sent again at once, it wins over the requested TPDOs: they are sent once, with an event
    assert [text[:3] for _, _, text in wire.log[count:]] == ["080", "080", "385", "485"]
    told = [text for _, _, _, text in wire.events if "TPDO 3 had not left the bus" in text]
    assert len(told) == 1
    wire.inject(FaultRule("lost", FaultKind.DROP, identifier=0x80, limit=1))
    count = len(wire.log)
    wire.tell("080#")
    wire.run(5 * MS)
    assert wire.since(count) == []


@pytest.mark.parametrize("bitrate", [125_000, 500_000])
def test_slower_bus_takes_proportionally_longer(bitrate):
    fast, slow = Wire().boot(), Wire(bitrate=bitrate).boot()
    for wire in (fast, slow):
        wire.ask("605#4041600000000000")
    taken = [wire.log[-1][0] - wire.log[-2][0] - MS for wire in (fast, slow)]
    assert taken[1] == taken[0] * (1_000_000 // bitrate)
