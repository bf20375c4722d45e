"""Process data: PDOs and SYNC, inhibit time, event timer, wrong lengths."""

import struct
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.clauses.communication.network import START
from motorhil.harness.conformance.drives.client import SYNC, Frame
from motorhil.harness.conformance.drives.drive import QUIET_S, STATE_S, Drive
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, State

_TYPES: Final = "CiA 301, 7.5.2.35 and 7.5.2.37, PDO transmission types"
_INVALID: Final = 0x8000_0000
_REMOTE: Final = (252, 253)  # transmission types of TPDOs that are asked for
_INHIBIT_MS: Final = 50
_TIMER_MS: Final = 40
SYNC_S: Final = 0.01
_PRE_OPERATIONAL: Final = 0x80
_LATER: Final = 0x480  # an identifier
_JITTER_MS: Final = 1.0
_FSA_WORDS: Final = (od.SHUTDOWN, od.SWITCH_ON, od.SHUTDOWN, od.DISABLE_VOLTAGE)


def configure(
    drive: Drive,
    first: int,
    entries: Sequence[Entry],
    kind: int,
    *,
    inhibit: int = 0,
    timer: int = 0,
    identifier: int = 0,
) -> int:
    """Map objects to the first PDO at 1400h or 1800h; return its identifier.

    It keeps its own identifier, if it has one, or takes `identifier`.

    Raises:
        NotApplicable: the drive does not take this mapping or type.
    """
    parameter, mapping = Entry(first, 1, "I", "COB-ID"), first + 0x200
    cob_id = drive.find(parameter)
    if cob_id is None:
        raise NotApplicable(f"the drive has no {first:04X}h")
    usual = (0x200 if first == 0x1400 else 0x180) + drive.node_id
    identifier = identifier or cob_id & 0x7FF or usual
    kept = (
        0x3FFF_F800 if kind in _REMOTE else 0x7FFF_F800
    )  # drives without RTR refuse another bit 30
    drive.set(parameter, cob_id & (kept | 0x7FF) | _INVALID)
    drive.set(Entry(mapping, 0, "B", "number of mapped objects"), 0)
    for place, one in enumerate(entries, 1):
        drive.set(Entry(mapping, place, "I", "mapped object"), one.mapped)
    drive.set(Entry(mapping, 0, "B", "number of mapped objects"), len(entries))
    drive.set(Entry(first, 2, "B", "transmission type"), kind)
    for subindex, name, value in ((3, "inhibit time", inhibit), (5, "event timer", timer)):
        entry = Entry(first, subindex, "H", name)
        if first == 0x1800 and (value or drive.find(entry) is not None):
            drive.set(entry, value)
    drive.set(parameter, cob_id & kept | identifier)
    return identifier


def quiet_other_pdos(drive: Drive, kept: int) -> None:
    """Switch the other TPDOs off."""
    for index in range(0x1800, 0x1804):
        entry = Entry(index, 1, "I", "COB-ID")
        cob_id = drive.find(entry)
        if index != kept and cob_id is not None and not cob_id & _INVALID:
            drive.set(entry, cob_id | _INVALID)


def operational(drive: Drive) -> None:
    """Start the node: its PDOs work from now on."""
    drive.client.node.nmt.send_command(START)
    drive.quiet(0.1)


def sync(drive: Drive, data: bytes = b"") -> Frame:
    """Send SYNC, and wait for one period; return the frame."""
    frame = drive.client.send(SYNC, data)
    drive.quiet(SYNC_S)
    return frame


def send_word(drive: Drive, identifier: int, word: int, tail: bytes = b"") -> int:
    """Send a controlword by RPDO; return when it was complete [ns]."""
    return drive.client.send(identifier, struct.pack("<H", word) + tail).time_ns


@drive_clause("PDO-01", Level.L4, source=f"{_TYPES}: RPDO 0 to 240")
def synchronous_rpdo(bench: DriveBench) -> None:
    """The data of an RPDO of type 1 take effect at the next SYNC, not before."""
    drive = bench.drive
    identifier = configure(drive, 0x1400, (od.CONTROLWORD,), 1)
    operational(drive)
    drive.await_state(State.SWITCH_ON_DISABLED, "power-on", "transition 1")
    send_word(drive, identifier, od.SHUTDOWN)
    drive.quiet()
    seen = drive.state()
    drive.expect(
        seen is State.SWITCH_ON_DISABLED,
        f"RPDO {identifier:03X}h of type 1 with controlword 0006h, without SYNC",
        f"switch on disabled for {QUIET_S:g} s",
        f"{seen}",
        "the RPDO takes effect at once",
    )
    drive.client.send(SYNC)
    drive.await_state(State.READY_TO_SWITCH_ON, "SYNC after the RPDO", "transition 2")


@drive_clause("PDO-02", Level.L4, source=f"{_TYPES}: RPDO 254 and 255")
def event_driven_rpdo(bench: DriveBench) -> None:
    """The data of an RPDO of type 255 take effect at once; in pre-operational they have none."""
    drive = bench.drive
    identifier = configure(drive, 0x1400, (od.CONTROLWORD,), 255)
    drive.await_state(State.SWITCH_ON_DISABLED, "power-on", "transition 1")
    send_word(drive, identifier, od.SHUTDOWN)
    drive.quiet()
    seen = drive.state()
    what = "RPDO in pre-operational"
    drive.expect(seen is State.SWITCH_ON_DISABLED, what, "no effect", f"{seen}", "NMT is ignored")
    operational(drive)
    send_word(drive, identifier, od.SHUTDOWN)
    drive.await_state(State.READY_TO_SWITCH_ON, "RPDO of type 255", "transition 2")


@drive_clause("PDO-03", Level.L4, source="CiA 301, 7.2.2.5.1; EMCY 8210h")
def short_rpdo(bench: DriveBench) -> None:
    """An RPDO that is too short is not processed, and sends EMCY 8210h."""
    drive = bench.drive
    entries = (od.CONTROLWORD, od.MODE)
    if drive.find(od.TARGET_POSITION) is not None:
        entries = (od.CONTROLWORD, od.TARGET_POSITION)
    identifier = configure(drive, 0x1400, entries, 255)
    operational(drive)
    drive.await_state(State.SWITCH_ON_DISABLED, "power-on", "transition 1")
    begin_ns = drive.now_ns
    send_word(drive, identifier, od.SHUTDOWN)
    drive.await_emergency(0x8210, begin_ns, f"RPDO {identifier:03X}h with 2 bytes of more")
    seen = drive.state()
    cause = "the RPDO is processed in spite of its length"
    expected = "no effect: switch on disabled"
    drive.expect(seen is not State.READY_TO_SWITCH_ON, "RPDO too short", expected, f"{seen}", cause)


@drive_clause("PDO-04", Level.L4, source=f"{_TYPES}: TPDO 1 to 240")
def cyclic_tpdo(bench: DriveBench) -> None:
    """A TPDO of type n is sent after every n-th SYNC, and never without one."""
    drive = bench.drive
    for kind in (1, 3):
        identifier = configure(drive, 0x1800, (od.STATUSWORD,), kind)
        quiet_other_pdos(drive, 0x1800)
        operational(drive)
        begin_ns = drive.now_ns
        for word in _FSA_WORDS:
            drive.command(word)
            drive.quiet()
        early = drive.client.heard(identifier, begin_ns)
        what = f"TPDO {identifier:03X}h of type {kind}, 6041h changes without SYNC"
        drive.expect(not early, what, "no TPDO", f"{len(early)}", "sent at the event, not at SYNC")
        sync(drive)
        begin_ns, syncs = drive.now_ns, 12
        for _ in range(syncs):
            sync(drive)
        count = len(drive.client.heard(identifier, begin_ns))
        expected = f"{syncs // kind} TPDOs"
        what = f"TPDO {identifier:03X}h of type {kind}, {syncs} SYNCs"
        drive.expect(count == syncs // kind, what, expected, f"{count}", "another type is used")
        drive.client.node.nmt.send_command(0x80)


@drive_clause("PDO-05", Level.L4, source=f"{_TYPES}: TPDO 0")
def acyclic_tpdo(bench: DriveBench) -> None:
    """A TPDO of type 0 is sent at the first SYNC after its event, and at no other."""
    drive = bench.drive
    identifier = configure(drive, 0x1800, (od.STATUSWORD,), 0)
    quiet_other_pdos(drive, 0x1800)
    operational(drive)
    sync(drive)
    sync(drive)
    begin_ns = drive.now_ns
    for _ in range(3):
        sync(drive)
    idle = len(drive.client.heard(identifier, begin_ns))
    what = f"TPDO {identifier:03X}h of type 0, 3 SYNCs without an event"
    drive.expect(idle == 0, what, "no TPDO", f"{idle}", "type 0 is treated as type 1")
    drive.become(State.READY_TO_SWITCH_ON, od.SHUTDOWN, "transition 2")
    early = drive.client.heard(identifier, begin_ns)
    what = "6041h changes without SYNC"
    drive.expect(not early, what, "no TPDO", f"{len(early)}", "sent at the event")
    for _ in range(3):
        sync(drive)
    count = len(drive.client.heard(identifier, begin_ns))
    drive.expect(count == 1, "3 SYNCs after a change of 6041h", "1 TPDO", f"{count}")


@drive_clause("PDO-06", Level.L4, source=f"{_TYPES}: TPDO 254 and 255; 1800h:3, inhibit time")
def event_driven_tpdo(bench: DriveBench) -> None:
    """A TPDO of type 255 is sent when its data change, but not within its inhibit time."""
    drive = bench.drive
    identifier = configure(drive, 0x1800, (od.STATUSWORD,), 255, inhibit=10 * _INHIBIT_MS)
    quiet_other_pdos(drive, 0x1800)
    operational(drive)
    drive.quiet(2.0 * _INHIBIT_MS / 1e3)
    begin_ns = drive.now_ns
    drive.become(State.READY_TO_SWITCH_ON, od.SHUTDOWN, "transition 2")
    for word in (od.SWITCH_ON, od.SHUTDOWN, od.SWITCH_ON, od.SHUTDOWN, od.SWITCH_ON):
        drive.command(word)
    drive.await_state(State.SWITCHED_ON, "controlword 0007h", "transition 3")
    drive.quiet(3.0 * _INHIBIT_MS / 1e3)
    heard = drive.client.heard(identifier, begin_ns)
    what = f"TPDO {identifier:03X}h of type 255, 6041h changes 6 times"
    drive.expect(len(heard) >= 2, what, "at least 2 TPDOs", f"{len(heard)}", "events are ignored")
    gaps = [(b.time_ns - a.time_ns) / 1e6 for a, b in pairwise(heard)]
    drive.expect(
        min(gaps) >= _INHIBIT_MS - _JITTER_MS,
        f"1800h:3 = {10 * _INHIBIT_MS} (inhibit time {_INHIBIT_MS} ms)",
        f"TPDOs at least {_INHIBIT_MS} ms apart (1 ms for the bus)",
        f"{min(gaps):.2f} ms",
        "the inhibit time is ignored, or is not in 100 us",
    )
    last = od.state_of(int.from_bytes(heard[-1].data[:2], "little"))
    cause = "the last change is lost within the inhibit time"
    drive.expect(last is State.SWITCHED_ON, "the last TPDO", "switched on", f"{last}", cause)
    begin_ns = drive.now_ns
    drive.quiet(0.3)
    idle = len(drive.client.heard(identifier, begin_ns))
    drive.expect(idle == 0, "no change in 0.3 s", "no TPDO", f"{idle}", "sent without an event")
    _expect_no_change_lost(drive)


def _expect_no_change_lost(drive: Drive) -> None:
    """Expect the last of two changes to be told, of which the second comes before the TPDO is out.

    The TPDO has a higher identifier than the RPDO of the second change, which goes first.
    """
    drive.become(State.SWITCH_ON_DISABLED, od.DISABLE_VOLTAGE, "transition 7")
    drive.client.node.nmt.send_command(_PRE_OPERATIONAL)
    try:
        commands = configure(drive, 0x1400, (od.CONTROLWORD,), 255)
        later = max(commands + 0x80, _LATER + drive.node_id)
        identifier = configure(drive, 0x1800, (od.STATUSWORD,), 255, identifier=later)
    except NotApplicable:
        return  # its identifiers or mappings are fixed
    operational(drive)
    begin_ns = drive.now_ns
    for word in (od.SHUTDOWN, od.SWITCH_ON):
        drive.client.send_message(commands, struct.pack("<H", word))

    def last() -> State | None:
        heard = drive.client.heard(identifier, begin_ns)
        return od.state_of(int.from_bytes(heard[-1].data[:2], "little")) if heard else None

    drive.client.wait_for(lambda: last() is State.SWITCHED_ON, STATE_S)
    seen = last()  # before any request, which may wake the drive
    if od.state_of(drive.statusword()) is not State.SWITCHED_ON:
        return  # it obeys controlwords once a cycle, and has met the second one alone
    what = f"6041h changes again while TPDO {identifier:03X}h waits for the bus"
    cause = "a change is lost while the TPDO is not sent yet"
    drive.expect(seen is State.SWITCHED_ON, what, "a TPDO with switched on", f"{seen}", cause)


@drive_clause("PDO-07", Level.L4, source="CiA 301, 7.5.2.37, 1800h:5, event timer")
def event_timer(bench: DriveBench) -> None:
    """A TPDO of type 255 is sent after its event timer, with the present values."""
    drive = bench.drive
    entries = (od.STATUSWORD, od.MODE_DISPLAY)
    identifier = configure(drive, 0x1800, entries, 255, timer=_TIMER_MS)
    quiet_other_pdos(drive, 0x1800)
    operational(drive)
    begin_ns = drive.now_ns
    drive.quiet(10.5 * _TIMER_MS / 1e3)
    heard = drive.client.heard(identifier, begin_ns)
    drive.expect(
        9 <= len(heard) <= 11,
        f"1800h:5 = {_TIMER_MS} ms, for {10.5 * _TIMER_MS:g} ms",
        "10 TPDOs, 1 more or less",
        f"{len(heard)}",
        "the event timer is ignored, or is not in ms",
    )
    data = struct.pack("<Hb", drive.read(od.STATUSWORD), drive.read(od.MODE_DISPLAY))
    seen = heard[-1].data.hex(" ")
    expected = f"{data.hex(' ')}, as read by SDO"
    drive.expect(heard[-1].data == data, "data of the TPDO", expected, seen, "wrong mapping")
