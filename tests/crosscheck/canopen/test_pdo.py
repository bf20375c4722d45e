"""PDOs on the wire: remapping, transmission types, timers, wrong lengths, SYNC.

Expected: CiA 301, 7.2.2 (PDO), 7.5.2.35 to 7.5.2.38 (parameters and mapping), 7.2.5 (SYNC).
"""

import itertools

import pytest

from tests.support.canopen.drive_wire import MS, US, Wire


def tpdo(wire: Wire, number: int, type_: int, inhibit_100us: int = 0, event_ms: int = 0) -> None:
    index = 0x1800 + number - 1
    wire.set(index, 1, 0x8000_0000 | 0x80 + number * 0x100 + 5, 4)
    wire.set(index, 2, type_, 1)
    wire.set(index, 3, inhibit_100us, 2)
    wire.set(index, 5, event_ms, 2)
    wire.set(index, 1, 0x80 + number * 0x100 + 5, 4)


def only(wire: Wire, number: int) -> None:
    """Make all TPDOs except this one invalid."""
    for other in (1, 2, 3, 4):
        if other != number:
            wire.set(0x1800 + other - 1, 1, 0x8000_0000 | 0x80 + other * 0x100 + 5, 4)


def syncs(wire: Wire, count: int) -> list[str]:
    """Return the drive's frames after each SYNC, 10 ms apart."""
    said = []
    for _ in range(count):
        seen = len(wire.log)
        wire.tell("080#")
        wire.run(10 * MS)
        said.append(" ".join(text[:3] for text in wire.since(seen)))
    return said


@pytest.mark.parametrize("every", [1, 2, 3, 240])
def test_type_n_is_sent_at_every_nth_sync(wire, every):
    only(wire, 3)
    tpdo(wire, 3, every)
    wire.operational()
    expected = ["385" if number % every == 0 else "" for number in range(1, 2 * every + 2)]
    assert syncs(wire, 2 * every + 1) == expected


def test_type_0_is_sent_at_sync_after_event_only(wire):
    only(wire, 1)
    tpdo(wire, 1, 0)
    wire.operational()
    assert syncs(wire, 3) == ["185", "", ""]  # entering OPERATIONAL is an event
    count = len(wire.log)
    wire.controlword(0x06)
    wire.run(5 * MS)
    assert wire.since(count) == []
    assert syncs(wire, 2) == ["185", ""]


@pytest.mark.parametrize("type_", [254, 255])
def test_event_driven_tpdo_is_sent_at_event_without_sync(wire, type_):
    only(wire, 1)
    tpdo(wire, 1, type_)
    wire.operational()
    wire.run(5 * MS)
    assert syncs(wire, 2) == ["", ""]
    count = len(wire.log)
    wire.controlword(0x06)
    wire.run(1 * MS)
    assert wire.since(count) == ["185#3102"]


def test_event_timer_repeats_and_is_restarted_by_event(wire):
    only(wire, 1)
    tpdo(wire, 1, 255, event_ms=10)
    wire.operational()
    wire.run(35 * MS)
    times = wire.times(0x185)
    # the first one, triggered at the end of the NMT frame, waits for the intermission of 3 bits
    assert [b - a for a, b in itertools.pairwise(times)] == [9_997 * US, 10 * MS, 10 * MS]
    wire.run(4 * MS)
    wire.controlword(0x06)
    event = wire.now
    wire.run(25 * MS)
    after = [time - event for time in wire.times(0x185) if time > event]
    assert 0 < after[0] < 100 * US
    assert [b - a for a, b in itertools.pairwise(after)] == [9_997 * US, 10 * MS]


def test_inhibit_time_separates_events_without_loss(wire):
    only(wire, 1)
    tpdo(wire, 1, 255, inhibit_100us=100)
    wire.operational()
    wire.run(1 * MS)
    for word in ("0600", "0700", "0600", "0700"):
        wire.tell(f"205#{word}")
    wire.run(50 * MS)
    times = wire.times(0x185)
    assert len(times) == 2
    # CiA 301 counts from invocation to invocation; the first waited for the intermission of 3 bits
    assert times[1] - times[0] + 3 * US + US >= 10 * MS
    assert wire.since()[-1] == "185#3302"  # the last state: switched on


def test_canopen_remaps_tpdo_and_reads_it_at_sync(connected):
    wire, network, node = connected
    node.tpdo.read()
    node.tpdo[4].clear()
    for index in (0x6064, 0x6061, 0x603F, 0x1001):
        node.tpdo[4].add_variable(index)
    node.tpdo[4].trans_type = 1
    node.tpdo[4].enabled = True
    node.tpdo[4].save()
    node.nmt.state = "OPERATIONAL"
    network.send_message(0x80, b"")
    network.pump(2 * MS)
    assert wire.since()[-1] == "485#0000000001000000"
    assert node.tpdo[4]["Modes of operation display"].raw == 1
    assert wire.read(0x1A03, 3) == 0x603F_0010


def test_canopen_maps_rpdo_with_dummy_for_sync(connected):
    wire, _network, node = connected
    node.rpdo.read()
    pdo = node.rpdo[3]
    pdo.clear()
    pdo.add_variable(0x0005)  # UNSIGNED8 dummy: one byte skipped
    pdo.add_variable(0x607A)
    pdo.trans_type = 0
    pdo.enabled = True
    pdo.save()
    node.nmt.state = "OPERATIONAL"
    wire.tell("405#FF10270000")
    assert wire.read(0x607A) == 0
    wire.tell("080#")
    assert wire.read(0x607A) == 10_000
    wire.tell("405#FF00000000", "405#FF2A000000", "080#", "080#")
    assert wire.read(0x607A) == 42  # the last of two before one SYNC


@pytest.mark.parametrize("type_", [0, 1, 240])
def test_synchronous_rpdo_is_written_at_next_sync(wire, type_):
    wire.set(0x1400, 2, type_, 1)
    wire.operational()
    wire.tell("205#0600")
    wire.run(5 * MS)
    assert wire.statusword() & 0x6F == 0x40
    wire.tell("080#")
    assert wire.statusword() & 0x6F == 0x21


def test_short_rpdo_is_ignored_and_reported_once(wire):
    wire.operational()
    wire.run(1 * MS)
    count = len(wire.log)
    wire.tell("205#06", "205#", "205#06")
    wire.run(1 * MS)
    # CiA 301: 8210h, PDO not processed due to length error; 1001h: generic and communication
    assert wire.since(count) == ["085#1082110101020000"]
    assert (wire.read(0x1001), wire.read(0x1003, 0), wire.read(0x1003, 1) & 0xFFFF) == (
        0x11,
        1,
        0x8210,
    )
    assert wire.statusword() & 0x6F == 0x40
    count = len(wire.log)
    wire.controlword(0x06)
    wire.run(6 * MS)
    assert wire.since(count)[0] == "085#0000000000000000"  # repaired
    assert wire.read(0x1001) == 0
    assert wire.statusword() & 0x6F == 0x21


def test_long_rpdo_uses_first_bytes_and_is_reported_once(wire):
    wire.operational()
    wire.run(1 * MS)
    count = len(wire.log)
    wire.tell("205#0600FFFFFFFFFFFF", "205#0600FFFFFFFFFFFF")
    wire.run(1 * MS)
    assert [text for text in wire.since(count) if text[:3] == "085"] == ["085#2082110108020000"]
    assert wire.statusword() & 0x6F == 0x21


def test_remote_and_29_bit_frames_are_not_pdos(wire):
    wire.operational()
    wire.run(6 * MS)
    count = len(wire.log)
    wire.tell("205#R2", "00000205#0600", "385#R6")
    wire.run(2 * MS)
    assert wire.since(count) == []
    assert wire.statusword() & 0x6F == 0x40


def test_sync_counter_is_required_or_reported_by_1019h(wire):
    wire.operational()
    wire.run(6 * MS)
    count = len(wire.log)
    wire.tell("080#01")
    wire.run(2 * MS)
    assert wire.since(count) == ["085#4082110100000000"]  # CiA 301: unexpected SYNC data length
    wire.set(0x1019, 0, 2, 1)
    count = len(wire.log)
    wire.tell("080#01")
    wire.run(2 * MS)
    assert [text[:3] for text in wire.since(count)] == ["085", "385", "485"]


def test_tpdo_of_eight_objects_is_full(wire):
    only(wire, 4)
    wire.set(0x1803, 1, 0x8000_0485, 4)
    wire.set(0x1A03, 0, 0, 1)
    for sub in range(1, 9):
        wire.set(0x1A03, sub, 0x6061_0008, 4)
    wire.set(0x1A03, 0, 8, 1)
    wire.set(0x1803, 1, 0x485, 4)
    wire.operational()
    wire.tell("080#")
    wire.run(1 * MS)
    assert wire.since()[-1] == "485#0101010101010101"
    wire.set(0x1803, 1, 0x8000_0485, 4)
    wire.set(0x1A03, 0, 0, 1)
    wire.set(0x1A03, 8, 0x6041_0010, 4)
    assert wire.write(0x1A03, 0, 8, 1) == 0x0604_0042
    assert wire.write(0x1A03, 0, 9, 1) in (0x0604_0042, 0x0609_0031)  # eight entries are possible
    assert wire.write(0x1A03, 8, 0x6041_0008, 4) == 0x0604_0041  # 16 bits, not 8
    assert wire.write(0x1A03, 8, 0x6008_0008, 4) == 0x0602_0000
    assert wire.write(0x1A03, 8, 0x1018_0120, 4) == 0x0604_0041  # not mappable


def test_changed_identifier_is_used_at_once(wire):
    wire.operational()
    wire.set(0x1400, 1, 0x8000_0205, 4)
    wire.set(0x1400, 1, 0x222, 4)
    wire.tell("205#0600")
    assert wire.statusword() & 0x6F == 0x40
    wire.tell("222#0600")
    assert wire.statusword() & 0x6F == 0x21


@pytest.mark.parametrize("can_id", [0x000, 0x07F, 0x101, 0x180, 0x581, 0x5FF, 0x601, 0x701, 0x7FF])
def test_restricted_identifier_is_refused(wire, can_id):
    wire.set(0x1400, 1, 0x8000_0205, 4)
    assert wire.write(0x1400, 1, can_id, 4) == 0x0609_0030


def test_tpdos_refuse_remote_frames_by_bit_30(connected):
    """CiA 301, 7.5.2.37: bit 30 of the COB-ID is set where no RTR is allowed."""
    wire, network, node = connected
    node.tpdo.read()
    assert [pdo.rtr_allowed for pdo in node.tpdo.values()] == [False] * 4
    node.nmt.state = "OPERATIONAL"
    network.pump(10 * MS)
    count = len(wire.log)
    node.tpdo[3].remote_request()
    wire.tell("385#R6")
    network.pump(10 * MS)
    assert wire.since(count) == []
