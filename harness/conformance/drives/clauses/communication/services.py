"""Further services of a node: node guarding, two hosts, EMCY's identifier and inhibit time, LSS."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.clauses.communication.network import (
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    START,
    STOP,
)
from motorhil.harness.conformance.drives.drive import BOOT_S, STATE_S, Drive
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, Mode, State

_GUARD_TIME: Final = Entry(0x100C, 0, "H", "guard time")
_LIFE_FACTOR: Final = Entry(0x100D, 0, "B", "life time factor")
_EMCY_ID: Final = Entry(0x1014, 0, "I", "COB-ID EMCY")
_EMCY_INHIBIT: Final = Entry(0x1015, 0, "H", "inhibit time EMCY")
_SECOND_CONSUMER: Final = Entry(0x1016, 2, "I", "consumer heartbeat time")
_GUARD_MS, _FACTOR = 100, 4
_LOST: Final = 0x8130
_HOSTS: Final = (0x7C, 0x7B)  # node-IDs that no other node of a bench uses
_PERIODS_MS: Final = (100, 300)
_INVALID: Final = 1 << 31
_INHIBIT_MS: Final = 40
_INCOMPATIBLE: Final = 0x0604_0043
_LSS_REQUEST, _LSS_ANSWER = 0x7E5, 0x7E4
_NUMBERS: Final = tuple(
    Entry(0x1018, place, "I", name)
    for place, name in enumerate(("vendor-ID", "product code", "revision", "serial number"), 1)
)


def _mode(drive: Drive) -> Mode:
    return next((one for one in Mode if drive.has_mode(one)), Mode.PP)


def _without_heartbeat(drive: Drive) -> None:
    """Reset communication, so that no poll was heard yet, and end the heartbeat."""
    drive.client.node.nmt.send_command(RESET_COMMUNICATION)
    drive.quiet(0.1)
    drive.boot()
    if drive.find(od.HEARTBEAT_PRODUCER):
        drive.write(od.HEARTBEAT_PRODUCER, 0)


def _guard(drive: Drive) -> int | None:
    """Poll the node by a remote frame; return its answer."""
    identifier = drive.error_control_id
    heard = drive.client.ask(identifier, b"", identifier, remote=True)
    return heard[0].data[0] if heard and heard[0].data else None


@drive_clause("GUARD-01", Level.L0, source="CiA 301, 7.2.8.2.1, node guarding protocol")
def guarded(bench: DriveBench) -> None:
    """A remote frame on 700h + node-ID is answered with the NMT state and an alternating bit 7."""
    drive = bench.drive
    drive.require(_GUARD_TIME, _LIFE_FACTOR)
    _without_heartbeat(drive)
    toggle = 0
    for command, state in ((PRE_OPERATIONAL, 0x7F), (START, 0x05), (STOP, 0x04), (START, 0x05)):
        drive.client.node.nmt.send_command(command)
        drive.quiet()
        for _ in range(2):
            seen = _guard(drive)
            drive.expect(
                seen == state | toggle,
                f"remote frame {drive.error_control_id:03X}h after NMT {command:02X}h",
                f"{state | toggle:02X}h (NMT state, toggle bit from 0 on)",
                "nothing" if seen is None else f"{seen:02X}h",
                "no node guarding, or the toggle bit does not alternate",
            )
            toggle ^= 0x80
    drive.write(od.HEARTBEAT_PRODUCER, 1000)
    begin_ns = drive.now_ns
    drive.quiet()
    identifier = drive.error_control_id
    for _ in range(2):  # with either toggle bit: one looks like a heartbeat
        drive.client.ask(identifier, b"", identifier, remote=True)
    heard = drive.client.heard(identifier, begin_ns)
    seen_text = ", ".join(one.data.hex() for one in heard) or "nothing"
    expected = "heartbeats only: a node uses one of the two protocols"
    drive.expect(all(one.data == b"\x05" for one in heard), "1017h = 1000", expected, seen_text)
    drive.write(od.HEARTBEAT_PRODUCER, 0)


@drive_clause("GUARD-02", Level.L5, source="CiA 301, 7.2.8.2.1, life guarding; 100Ch, 100Dh")
def guard_lost(bench: DriveBench) -> None:
    """After 100Ch times 100Dh without a poll the drive sends EMCY 8130h, and reacts by 6007h."""
    drive = bench.drive
    drive.require(_GUARD_TIME, _LIFE_FACTOR, od.ABORT_CONNECTION)
    life_ms = _GUARD_MS * _FACTOR
    for option, state in ((2, State.SWITCH_ON_DISABLED), (1, State.FAULT)):
        _without_heartbeat(drive)
        drive.set(od.ABORT_CONNECTION, option)
        drive.enable(_mode(drive))
        drive.set(_GUARD_TIME, _GUARD_MS)
        drive.set(_LIFE_FACTOR, _FACTOR)
        begin_ns = drive.now_ns
        drive.quiet(1.5 * life_ms / 1e3)
        what = f"100Ch = {_GUARD_MS}, 100Dh = {_FACTOR}"
        seen = drive.state()
        expected = "operation enabled: the master has not begun to poll"
        drive.expect(seen is State.OPERATION_ENABLED, what, expected, f"{seen}")
        for _ in range(4):
            last_ns = drive.now_ns
            _guard(drive)
            drive.quiet(0.6 * life_ms / 1e3)
        early = drive.count_emergencies(_LOST, begin_ns)
        cause = "another time than 100Ch x 100Dh"
        drive.expect(not early, what, "no EMCY 8130h", f"{early}", cause)
        frame = drive.await_emergency(_LOST, begin_ns, f"{what}, no poll")
        late_ms = (frame.time_ns - last_ns) / 1e6
        expected = f"EMCY 8130h {life_ms} ms + 20 ms after the last poll"
        is_right = life_ms - 10.0 <= late_ms <= life_ms + 20.0
        drive.expect(is_right, f"{what}, no poll", expected, f"{late_ms:.0f} ms")
        drive.await_state(state, f"{what}, no poll, 6007h = {option}", "reaction of 6007h")
        begin_ns = drive.now_ns
        _guard(drive)
        drive.await_emergency(0x0000, begin_ns, f"{what}, polled again")
        drive.write(_GUARD_TIME, 0)
        begin_ns = drive.now_ns
        _guard(drive)
        drive.quiet(1.5 * life_ms / 1e3)
        late = drive.count_emergencies(_LOST, begin_ns)
        drive.expect(not late, "100Ch = 0", "no life guarding", f"{late} EMCY")


@drive_clause("NMT-06", Level.L5, source="CiA 301, 7.5.2.15, consumer heartbeat time 1016h")
def two_hosts(bench: DriveBench) -> None:
    """Each entry of 1016h watches its node with its own time, from the node's first heartbeat."""
    drive = bench.drive
    drive.require(od.HEARTBEAT_CONSUMER, _SECOND_CONSUMER)
    entries = (od.HEARTBEAT_CONSUMER, _SECOND_CONSUMER)
    begin_ns = drive.now_ns
    for entry, host, period_ms in zip(entries, _HOSTS, _PERIODS_MS, strict=True):
        drive.set(entry, host << 16 | period_ms)
    refused = drive.offer_value(_SECOND_CONSUMER, _HOSTS[0] << 16 | 7)
    seen = f"{refused:08X}h" if refused else "accepted"
    what = f"{_SECOND_CONSUMER}: the node-ID of the first entry"
    drive.expect(refused == _INCOMPATIBLE, what, f"{_INCOMPATIBLE:08X}h", seen)
    drive.quiet(2.0 * _PERIODS_MS[1] / 1e3)
    early = drive.count_emergencies(_LOST, begin_ns)
    drive.expect(not early, "no heartbeat yet", "no EMCY 8130h", f"{early}", "watched before")
    for host in _HOSTS:
        drive.client.send(0x700 + host, b"\x00" if host == _HOSTS[0] else b"\x05")
    first_ns = drive.now_ns
    drive.client.send(0x700 + 0x7A, b"\x05")  # of a node that is not watched
    frame = drive.await_emergency(_LOST, begin_ns, "two hosts, heartbeats end", 1.0)
    drive.quiet(1.5 * _PERIODS_MS[1] / 1e3)
    losses = [one for one in drive.emergencies(begin_ns) if one.data[:2] == b"\x30\x81"]
    times_ms = [(one.time_ns - first_ns) / 1e6 for one in losses]
    is_right = len(losses) == 2 and all(
        0.9 * wanted <= seen_ms <= 1.1 * wanted + 20.0
        for wanted, seen_ms in zip(_PERIODS_MS, times_ms, strict=True)
    )
    expected = f"8130h after {_PERIODS_MS[0]} ms and {_PERIODS_MS[1]} ms, +- 10 %, once each"
    seen = ", ".join(f"{one:.0f} ms" for one in times_ms)
    drive.expect(is_right, "two hosts, heartbeats end", expected, seen, "one time for both")
    register = frame.data[2]
    expected = "bits 0 and 4 (communication) in its third byte"
    drive.expect(register & 0x11 == 0x11, "EMCY 8130h", expected, f"{register:02X}h")
    for host, left in zip(_HOSTS, (1, 0), strict=True):
        begin_ns = drive.now_ns
        drive.client.send(0x700 + host, b"\x05")
        frame = drive.await_emergency(0x0000, begin_ns, f"heartbeat of {host:02X}h again")
        is_told = bool(frame.data[2] & 0x10) is bool(left)
        expected = f"1001h bit 4 = {left}: {left} host is lost"
        drive.expect(is_told, "EMCY 0000h", expected, f"{frame.data[2]:02X}h")
    for host in _HOSTS:
        drive.client.send(0x700 + host, b"\x05")
    drive.client.node.nmt.send_command(RESET_COMMUNICATION)
    drive.quiet(0.1)
    drive.boot()
    begin_ns = drive.now_ns
    drive.quiet(2.0 * _PERIODS_MS[1] / 1e3)
    late = drive.count_emergencies(_LOST, begin_ns)
    expected = "no EMCY 8130h: no heartbeat since the reset"
    drive.expect(not late, "reset communication", expected, f"{late}", "watched as before")
    for entry in entries:
        drive.write(entry, 0)


@drive_clause("EMCY-01", Level.L5, source="CiA 301, 7.5.2.17 and 7.5.2.18, 1014h and 1015h")
def emergency_identifier(bench: DriveBench) -> None:
    """EMCY has the identifier of 1014h, none with bit 31, and the inhibit time of 1015h."""
    drive = bench.drive
    drive.require(_EMCY_ID, _EMCY_INHIBIT, od.HEARTBEAT_CONSUMER)
    own, other = drive.read(_EMCY_ID), 0x6D0
    refused = drive.offer_value(_EMCY_ID, other)
    seen = "accepted" if not refused else f"{refused:08X}h"
    drive.expect(refused != 0, f"{_EMCY_ID} = {other:03X}h while it is valid", "an abort", seen)
    for identifier in (other, None, own & 0x7FF):
        drive.write(_EMCY_ID, own | _INVALID)
        if identifier is not None:
            drive.set(_EMCY_ID, identifier)
        begin_ns = drive.now_ns
        _lose_host(drive)
        heard = {one: drive.client.heard(one, begin_ns) for one in (other, own & 0x7FF)}
        what = f"an error, {_EMCY_ID} = " + ("80000000h" if identifier is None else "valid")
        for one, frames in heard.items():
            count = 1 if one == identifier else 0
            is_right = sum(frame.data[:2] == b"\x30\x81" for frame in frames) == count
            expected = f"{count} EMCY 8130h on {one:03X}h"
            drive.expect(is_right, what, expected, f"{len(frames)} frames", "1014h is ignored")
        drive.write(od.HEARTBEAT_CONSUMER, 0)
    drive.set(_EMCY_INHIBIT, 10 * _INHIBIT_MS)
    drive.quiet(2.0 * _INHIBIT_MS / 1e3)
    begin_ns = drive.now_ns
    for _ in range(2):
        _lose_host(drive, 5)
        drive.write(od.HEARTBEAT_CONSUMER, 0)
    drive.quiet(6.0 * _INHIBIT_MS / 1e3)
    frames = drive.emergencies(begin_ns)
    codes = [one.data[:2].hex() for one in frames]
    wanted = ["3081", "0000"] * 2
    drive.expect(codes == wanted, "4 EMCYs at once", "all of them, in order", ", ".join(codes))
    gaps_ms = [(b.time_ns - a.time_ns) / 1e6 for a, b in pairwise(frames)]
    drive.expect(
        all(_INHIBIT_MS - 1.0 <= one <= _INHIBIT_MS + 20.0 for one in gaps_ms),
        f"1015h = {10 * _INHIBIT_MS} (inhibit time {_INHIBIT_MS} ms)",
        f"EMCYs {_INHIBIT_MS} ms apart, 20 ms more at most",
        ", ".join(f"{one:.1f} ms" for one in gaps_ms),
        "the inhibit time is ignored, or is not in 100 us",
    )
    drive.write(_EMCY_INHIBIT, 0)


def _lose_host(drive: Drive, period_ms: int = 50) -> None:
    drive.set(od.HEARTBEAT_CONSUMER, _HOSTS[0] << 16 | period_ms)
    drive.client.send(0x700 + _HOSTS[0], b"\x05")
    drive.quiet(2.0 * period_ms / 1e3)


# --- LSS


def _lss(drive: Drive, *request: int, count: int = 1) -> list[bytes]:
    data = bytes(request).ljust(8, b"\0")
    heard = drive.client.ask(_LSS_REQUEST, data, _LSS_ANSWER, count=count)
    return [one.data for one in heard]


def _number(value: int) -> bytes:
    return value.to_bytes(4, "little")


def _answered(drive: Drive, request: bytes, answer: bytes | None, what: str) -> None:
    """Expect the answer to the LSS request, filled up with zeros, or None: no answer."""
    seen = _lss(drive, *request)
    wanted = [] if answer is None else [answer.ljust(8, b"\0")]
    expected = "no answer" if answer is None else wanted[0].hex(" ")
    text = ", ".join(one.hex(" ") for one in seen) or "nothing"
    drive.expect(seen == wanted, f"LSS {request.hex(' ')}: {what}", expected, text)


def _select(drive: Drive, numbers: list[int], *, is_meant: bool = True) -> None:
    for place, value in enumerate(numbers):
        is_last = place == 3 and is_meant
        request = bytes((0x40 + place,)) + _number(value)
        _answered(drive, request, b"\x44" if is_last else None, "switch state selective")


@contextmanager
def _configuring(drive: Drive) -> Iterator[list[int]]:
    """Switch the drive to LSS configuration within the block; yield its LSS address.

    Raises:
        NotApplicable: the drive has no LSS, or others on its bus have it, too: CiA 305 configures
            one device at a time.
    """
    drive.require(*_NUMBERS)
    numbers = [drive.read(entry) for entry in _NUMBERS]
    _lss(drive, 0x04, 1)
    try:
        answers = _lss(drive, 0x5E, count=2)
        if not answers:
            raise NotApplicable("the drive does not answer LSS")
        if len(answers) > 1:
            raise NotApplicable("another device on the bus answers LSS, too; try the drive alone")
        yield numbers
    finally:
        _lss(drive, 0x04, 0)


@drive_clause("LSS-01", Level.L0, source="CiA 305, switch state, inquire and identify services")
def lss_identity(bench: DriveBench) -> None:
    """By LSS a drive is selected, identified and asked by the four numbers of 1018h alone."""
    drive = bench.drive
    with _configuring(drive) as numbers:
        for place, value in enumerate(numbers):
            request = bytes((0x5A + place,))
            _answered(drive, request, request + _number(value), f"inquire {_NUMBERS[place]}")
        _answered(drive, b"\x5e", bytes((0x5E, drive.node_id)), "inquire node-ID")
        _answered(drive, b"\x51" + bytes(4) + b"\x80\0\0", None, "fastscan with a node-ID")
    _answered(drive, b"\x5e", None, "inquire node-ID in LSS waiting")
    _answered(drive, b"\x11\x05", None, "configure node-ID in LSS waiting")
    for place in range(4):
        others = [value ^ (place == at) for at, value in enumerate(numbers)]
        _select(drive, others, is_meant=False)
        _answered(drive, b"\x5e", None, f"not selected: {_NUMBERS[place]} differs")
    _select(drive, numbers)
    _answered(drive, b"\x5e", bytes((0x5E, drive.node_id)), "selected")
    _lss(drive, 0x04, 0)
    vendor, product, revision, serial = numbers
    right = [vendor, product, revision, revision, serial, serial]
    for place in (None, *range(6)):
        asked = list(right)
        if place is not None:
            asked[place] += -1 if place in (3, 5) else 1
        if min(asked) < 0:
            continue
        for at, value in enumerate(asked):
            is_last = at == 5 and place is None
            request = bytes((0x46 + at,)) + _number(value)
            _answered(drive, request, b"\x4f" if is_last else None, "identify remote slave")
    _answered(drive, b"\x4c", None, "identify non-configured, by a drive with a node-ID")


@drive_clause("LSS-02", Level.L0, source="CiA 305, configure and store services; fastscan")
def lss_node_id(bench: DriveBench) -> None:
    """A node-ID of LSS is active after the next reset; fastscan finds a drive without one."""
    drive = bench.drive
    if bench.is_real:
        raise NotApplicable("a real drive keeps its node-ID")
    with _configuring(drive) as numbers:
        for wrong in (0, 128, 254):
            _answered(drive, bytes((0x11, wrong)), b"\x11\x01", "a node-ID out of range")
        _answered(drive, b"\x13\x01\x02", b"\x13\x01", "an unknown table of bit timings")
        _answered(drive, b"\x13\x00\x05", b"\x13\x01", "a reserved bit timing")
        _answered(drive, b"\x11\xff", b"\x11\x00", "no node-ID from the next reset on")
        _answered(drive, b"\x5e", bytes((0x5E, drive.node_id)), "the node-ID before the reset")
    begin_ns = drive.now_ns
    drive.client.node.nmt.send_command(RESET_COMMUNICATION)
    drive.quiet(0.5)
    booted = drive.client.heard(drive.error_control_id, begin_ns)
    drive.expect(not booted, "reset without a node-ID", "no boot-up", f"{len(booted)}")
    _answered(drive, b"\x4c", b"\x50", "identify non-configured")
    _scan(drive, numbers)
    _answered(drive, b"\x5e", b"\x5e\xff", "found by fastscan: in configuration")
    _answered(drive, b"\x13\x00\x02", b"\x13\x00", "bit timing 500 kbit/s")
    _answered(drive, bytes((0x11, drive.node_id)), b"\x11\x00", "its former node-ID")
    _answered(drive, b"\x17", b"\x17\x00", "store")
    begin_ns = drive.now_ns
    _lss(drive, 0x04, 0)

    def has_booted() -> bool:
        heard = drive.client.heard(drive.error_control_id, begin_ns)
        return any(one.data == b"\0" for one in heard)

    drive.client.wait_for(has_booted, BOOT_S)
    drive.expect(has_booted(), "LSS waiting, with a node-ID now", "boot-up", "none")
    drive.reset()
    seen = drive.state()
    expected = "switch on disabled, under the stored node-ID"
    drive.await_state(State.SWITCH_ON_DISABLED, "reset node", expected, STATE_S)
    drive.expect(seen is not None, "reset node", expected, f"{seen}")


def _scan(drive: Drive, numbers: list[int]) -> None:
    """Find the drive by fastscan, bit by bit."""

    def scan(number: int, bit: int, place: int, following: int) -> bool:
        request = b"\x51" + _number(number) + bytes((bit, place, following))
        return bool(_lss(drive, *request))

    drive.expect(scan(0, 0x80, 0, 0), "fastscan, confirmation", "an answer", "none")
    for place, wanted in enumerate(numbers):
        found = 0
        for bit in range(31, -1, -1):
            if not scan(found, bit, place, place):
                found |= 1 << bit
        what = f"fastscan, {_NUMBERS[place]}"
        drive.expect(found == wanted, what, f"{wanted:08X}h", f"{found:08X}h")
        is_wrong = scan(found ^ 1, 0, place, (place + 1) % 4)
        drive.expect(not is_wrong, what, "no answer to another number", "an answer")
        following = (place + 1) % 4
        drive.expect(scan(found, 0, place, following), what, "an answer", "none")
