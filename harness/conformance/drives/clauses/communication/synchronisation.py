"""SYNC with a counter, a window, and from the drive; TIME; remote requests; watched RPDOs."""

import struct
from itertools import pairwise
from typing import Final

from motorhil.harness.conformance.clause import Level
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.clauses.communication.network import PRE_OPERATIONAL, STOP
from motorhil.harness.conformance.drives.clauses.communication.process_data import (
    configure,
    operational,
    quiet_other_pdos,
    send_word,
    sync,
)
from motorhil.harness.conformance.drives.client import SYNC
from motorhil.harness.conformance.drives.drive import Drive
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, State

_SYNC_ID: Final = Entry(0x1005, 0, "I", "COB-ID SYNC")
_CYCLE: Final = Entry(0x1006, 0, "I", "communication cycle period")
_WINDOW: Final = Entry(0x1007, 0, "I", "synchronous window length")
_OVERFLOW: Final = Entry(0x1019, 0, "B", "synchronous counter overflow value")
_SYNC_START: Final = Entry(0x1800, 6, "B", "SYNC start value")
_TIME_ID: Final = Entry(0x1012, 0, "I", "COB-ID TIME")
_TIME, _OTHER_TIME = 0x100, 0x6A0
_CONSUMES: Final = 1 << 31
_29_BITS: Final = 1 << 29
_RPDO_TIMER: Final = Entry(0x1400, 5, "H", "event timer")
_COUNTS, _START_AT, _EVERY = 4, 3, 2
_PERIOD_US, _WINDOW_US = 20_000, 5_000
_PRESENT_STATE: Final = 0x0800_0022  # an abort: not in the present device state
_PRODUCES: Final = 1 << 30
_INVALID: Final = 1 << 31
_NO_REMOTE: Final = 1 << 30
_TIMER_MS: Final = 60
_ODD_SYNC: Final = 0x8240
_PDO_TOO_LONG: Final = 0x8220
_PDO_MISSING: Final = 0x8250


@drive_clause("SYN-01", Level.L4, source="CiA 301, 7.5.2.22, 1019h; 1800h:6; EMCY 8240h")
def counted_sync(bench: DriveBench) -> None:
    """With 1019h, SYNC has a counter: others are ignored with one EMCY 8240h; 1800h:6 waits."""
    drive = bench.drive
    drive.require(_OVERFLOW, _SYNC_START)
    for wrong in (1, 241):
        refused = drive.offer_value(_OVERFLOW, wrong)
        drive.expect(refused != 0, f"{_OVERFLOW} = {wrong}", "an abort", "accepted")
    rpdo = configure(drive, 0x1400, (od.CONTROLWORD,), 1)
    parameter = Entry(0x1800, 1, "I", "COB-ID")
    _set_counter(drive)
    drive.set(parameter, drive.read(parameter) | _INVALID)
    drive.set(_SYNC_START, _START_AT)
    tpdo = configure(drive, 0x1800, (od.STATUSWORD,), _EVERY)
    quiet_other_pdos(drive, 0x1800)
    operational(drive)
    for odd, right in ((b"", b"\x01"), (b"\x01\x00", b"\x02")):
        drive.become(State.SWITCH_ON_DISABLED, od.DISABLE_VOLTAGE, "transition 7")
        begin_ns = drive.now_ns
        send_word(drive, rpdo, od.SHUTDOWN)
        for _ in range(2):
            sync(drive, odd)
        seen = drive.state()
        what = f"SYNC with {len(odd)} bytes, 1019h = {_COUNTS}"
        drive.expect(seen is State.SWITCH_ON_DISABLED, what, "it is ignored", f"{seen}")
        count = drive.count_emergencies(_ODD_SYNC, begin_ns)
        drive.expect(count == 1, f"{what}, twice", "one EMCY 8240h", f"{count}")
        sync(drive, right)
        drive.await_state(State.READY_TO_SWITCH_ON, "SYNC with a counter", "transition 2")
        drive.await_emergency(0x0000, begin_ns, "SYNC with a counter again")
    _expect_watch_in_pre_operational(drive)
    operational(drive)
    begin_ns = drive.now_ns
    counters = [(number + 1) % _COUNTS + 1 for number in range(3 * _COUNTS)]  # from 2 on
    sent: list[int] = []
    for counter in counters:
        before = len(drive.client.heard(tpdo, begin_ns))
        sync(drive, bytes((counter,)))
        if len(drive.client.heard(tpdo, begin_ns)) > before:
            sent.append(counter)
    first = counters.index(_START_AT)
    wanted = counters[first::_EVERY]
    what = f"TPDO of type {_EVERY}, 1800h:6 = {_START_AT}, SYNC counters from {counters[0]}"
    drive.expect(sent == wanted, what, f"sent at {wanted}", f"{sent}", "1800h:6 is ignored")
    drive.set(_OVERFLOW, 0)
    begin_ns = drive.now_ns
    sync(drive, b"\x01")
    drive.await_emergency(_ODD_SYNC, begin_ns, "SYNC with a counter, 1019h = 0")
    sync(drive)
    drive.await_emergency(0x0000, begin_ns, "SYNC without a counter, 1019h = 0")
    drive.client.node.nmt.send_command(PRE_OPERATIONAL)
    drive.quiet()
    operational(drive)
    begin_ns = drive.now_ns
    for _ in range(2 * _EVERY):
        sync(drive)
    count = len(drive.client.heard(tpdo, begin_ns))
    what = f"TPDO of type {_EVERY}, {2 * _EVERY} SYNCs, 1019h = 0"
    drive.expect(count == 2, what, "2 TPDOs: no counter to wait for", f"{count}")


def _set_counter(drive: Drive) -> None:
    """Set 1019h, which the state of the drive does not forbid while 1006h is 0 or absent."""
    if not drive.find(_CYCLE):
        refused = drive.offer_value(_OVERFLOW, _COUNTS)
        expected = f"accepted, or refused by its value: {_CYCLE} is 0 or absent"
        is_right = refused != _PRESENT_STATE
        drive.expect(is_right, f"{_OVERFLOW} = {_COUNTS}", expected, f"{refused:08X}h")
    drive.set(_OVERFLOW, _COUNTS)


def _expect_watch_in_pre_operational(drive: Drive) -> None:
    """Enter pre-operational; expect a wrong SYNC to be reported there too."""
    drive.client.node.nmt.send_command(PRE_OPERATIONAL)
    drive.quiet()
    begin_ns = drive.now_ns
    sync(drive)
    drive.await_emergency(_ODD_SYNC, begin_ns, "SYNC without a counter in pre-operational")
    sync(drive, b"\x01")
    drive.await_emergency(0x0000, begin_ns, "SYNC with a counter in pre-operational")


@drive_clause("SYN-02", Level.L4, source="CiA 301, 7.5.2.5, 1005h bit 30; 7.5.2.6, 1006h")
def produced_sync(bench: DriveBench) -> None:
    """With bit 30 of 1005h the drive sends SYNC each 1006h, counts by 1019h, and obeys itself."""
    drive = bench.drive
    drive.require(_SYNC_ID, _CYCLE, _OVERFLOW)
    tpdo = configure(drive, 0x1800, (od.STATUSWORD,), 1)
    quiet_other_pdos(drive, 0x1800)
    drive.set(_OVERFLOW, _COUNTS)
    drive.set(_CYCLE, _PERIOD_US)
    refused = drive.offer_value(_OVERFLOW, 0)
    drive.expect(refused != 0, f"{_OVERFLOW} while 1006h is not 0", "an abort", "accepted")
    drive.set(_SYNC_ID, SYNC | _PRODUCES)
    refused = drive.offer_value(_SYNC_ID, SYNC + 1 | _PRODUCES)
    what = f"{_SYNC_ID}: another identifier, bit 30 = 1"
    drive.expect(refused != 0, what, "an abort", "accepted")
    drive.quiet(0.1)
    operational(drive)
    begin_ns = drive.now_ns
    drive.quiet(10.5 * _PERIOD_US / 1e6)
    heard = drive.client.heard(SYNC, begin_ns)
    gaps_us = [(b.time_ns - a.time_ns) / 1e3 for a, b in pairwise(heard)]
    drive.expect(
        9 <= len(heard) <= 12 and all(abs(one - _PERIOD_US) <= 2_000.0 for one in gaps_us),
        f"1005h bit 30 = 1, 1006h = {_PERIOD_US}",
        f"SYNC every {_PERIOD_US / 1e3:g} ms +- 2 ms",
        f"{len(heard)} in {10.5 * _PERIOD_US / 1e6:g} s",
        "1006h is ignored, or is not in us",
    )
    counters = [one.data[0] if len(one.data) == 1 else -1 for one in heard]
    wanted = [(counters[0] - 1 + number) % _COUNTS + 1 for number in range(len(heard))]
    expected = f"counters {wanted} (1019h = {_COUNTS})"
    drive.expect(counters == wanted, "SYNC of the drive", expected, f"{counters}")
    answers = drive.client.heard(tpdo, begin_ns)
    is_each = abs(len(answers) - len(heard)) <= 1
    drive.expect(is_each, "own SYNC", f"{len(heard)} TPDOs of type 1", f"{len(answers)}")
    for command, count in ((STOP, 0), (PRE_OPERATIONAL, 5)):
        drive.client.node.nmt.send_command(command)
        drive.quiet(_PERIOD_US / 1e6)
        begin_ns = drive.now_ns
        drive.quiet(5.5 * _PERIOD_US / 1e6)
        seen = len(drive.client.heard(SYNC, begin_ns))
        is_right = count - 1 <= seen <= count + 1 if count else seen == 0
        drive.expect(is_right, f"NMT {command:02X}h", f"{count} SYNCs", f"{seen}")
    drive.set(_SYNC_ID, SYNC)
    begin_ns = drive.now_ns
    drive.quiet(3.0 * _PERIOD_US / 1e6)
    seen = len(drive.client.heard(SYNC, begin_ns))
    drive.expect(not seen, "1005h bit 30 = 0", "no SYNC of the drive", f"{seen}")
    drive.set(_CYCLE, 0)
    drive.set(_OVERFLOW, 0)


@drive_clause("SYN-03", Level.L4, source="CiA 301, 7.5.2.7, synchronous window length 1007h")
def sync_window(bench: DriveBench) -> None:
    """A synchronous RPDO that comes later than 1007h after SYNC is discarded."""
    drive = bench.drive
    drive.require(_WINDOW)
    rpdo = configure(drive, 0x1400, (od.CONTROLWORD,), 1)
    drive.set(_WINDOW, _WINDOW_US)
    operational(drive)
    before, after = State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON
    for late_s, state in ((0.002, after), (0.008, before), (0.004, after)):
        drive.become(before, od.DISABLE_VOLTAGE, "transition 7")
        sync_ns = drive.client.send(SYNC).time_ns
        drive.quiet(late_s - 0.0005)
        late_ms = (send_word(drive, rpdo, od.SHUTDOWN) - sync_ns) / 1e6
        sync(drive)
        drive.quiet()
        what = f"RPDO {late_ms:.1f} ms after SYNC, 1007h = {_WINDOW_US} us"
        expected = "discarded" if state is before else "processed at the next SYNC"
        seen = drive.state()
        drive.expect(seen is state, what, f"{expected}: {state}", f"{seen}", "1007h is ignored")
    drive.set(_WINDOW, 0)


@drive_clause("TIME-01", Level.L4, source="CiA 301, 7.5.2.10, COB-ID time stamp object 1012h")
def identifier_of_time(bench: DriveBench) -> None:
    """1012h takes an identifier of 11 bits, which is kept while the drive listens by bit 31."""
    drive = bench.drive
    drive.require(_TIME_ID)
    for wrong, why in (
        (_TIME | _29_BITS, "bit 29, but no identifier of 29 bits"),
        (0x601, "the identifier of an SDO"),
    ):
        refused = drive.offer_value(_TIME_ID, wrong)
        drive.expect(refused != 0, f"{_TIME_ID} = {wrong:08X}h, {why}", "an abort", "accepted")
    drive.set(_TIME_ID, _TIME)
    drive.set(_TIME_ID, _OTHER_TIME)
    drive.set(_TIME_ID, _TIME)
    drive.write(_TIME_ID, _CONSUMES | _TIME)
    refused = drive.offer_value(_TIME_ID, _CONSUMES | _OTHER_TIME)
    drive.expect(
        refused != 0, f"{_TIME_ID}: another identifier, bit 31 = 1", "an abort", "accepted"
    )
    drive.near(_TIME_ID, _CONSUMES | _TIME, 0, "after a refused identifier")
    for same in (_CONSUMES | _TIME, _TIME, _OTHER_TIME, _CONSUMES | _OTHER_TIME):
        drive.write(_TIME_ID, same)
    drive.write(_TIME_ID, _TIME)


@drive_clause("PDO-08", Level.L4, source="CiA 301, 7.5.2.37: TPDO 252 and 253, bit 30 of 1800h:1")
def requested_tpdo(bench: DriveBench) -> None:
    """A TPDO of type 253 is sent at a remote frame, and of type 252 as it was at the last SYNC."""
    drive = bench.drive
    parameter = Entry(0x1800, 1, "I", "COB-ID")
    for kind in (253, 252, 255, 1):
        identifier = configure(drive, 0x1800, (od.STATUSWORD,), kind)
        quiet_other_pdos(drive, 0x1800)
        operational(drive)
        drive.become(State.SWITCH_ON_DISABLED, od.DISABLE_VOLTAGE, "transition 7")
        sync(drive)
        old = drive.statusword()
        begin_ns = drive.now_ns
        drive.become(State.READY_TO_SWITCH_ON, od.SHUTDOWN, "transition 2")
        drive.quiet()
        early = len(drive.client.heard(identifier, begin_ns))
        what = f"6041h changes, TPDO of type {kind}"
        is_right = early > 0 if kind == 255 else early == 0
        expected = "a TPDO" if kind == 255 else "no TPDO without a request"
        drive.expect(is_right, what, expected, f"{early}")
        wanted = old if kind == 252 else drive.statusword()
        for _ in range(2):
            heard = drive.client.ask(identifier, b"", identifier, remote=True)
            seen = ", ".join(one.data.hex(" ") for one in heard) or "nothing"
            data = struct.pack("<H", wanted)
            is_right = len(heard) == 1 and heard[0].data == data
            what = f"remote frame {identifier:03X}h, type {kind}"
            expected = f"{data.hex(' ')} ({'at the last SYNC' if kind == 252 else 'now'})"
            drive.expect(is_right, what, expected, seen, "remote frames are ignored")
        drive.client.node.nmt.send_command(PRE_OPERATIONAL)
        drive.quiet()
        heard = drive.client.ask(identifier, b"", identifier, remote=True)
        drive.expect(not heard, "remote frame in pre-operational", "no TPDO", f"{len(heard)}")
    cob_id = drive.read(parameter)
    drive.set(parameter, cob_id | _INVALID)
    drive.set(parameter, cob_id | _NO_REMOTE)
    operational(drive)
    drive.quiet()
    heard = drive.client.ask(identifier, b"", identifier, remote=True)
    drive.expect(not heard, "remote frame, bit 30 of 1800h:1 = 1", "no TPDO", f"{len(heard)}")


@drive_clause("PDO-11", Level.L4, source="CiA 301, 7.2.2.5.1; EMCY 8220h; 1400h:5, EMCY 8250h")
def watched_rpdo(bench: DriveBench) -> None:
    """An RPDO that is too long is processed with one EMCY 8220h, and a missing one sends 8250h."""
    drive = bench.drive
    identifier = configure(drive, 0x1400, (od.CONTROLWORD,), 255)
    operational(drive)
    drive.await_state(State.SWITCH_ON_DISABLED, "power-on", "transition 1")
    begin_ns = drive.now_ns
    for _ in range(2):
        send_word(drive, identifier, od.SHUTDOWN, b"\x55")
    drive.await_state(State.READY_TO_SWITCH_ON, "RPDO with 3 bytes of 2", "its first bytes count")
    count = drive.count_emergencies(_PDO_TOO_LONG, begin_ns)
    drive.expect(count == 1, "RPDO with 3 bytes of 2, twice", "one EMCY 8220h", f"{count}")
    send_word(drive, identifier, od.SHUTDOWN)
    drive.await_emergency(0x0000, begin_ns, "RPDO of the right length again")
    drive.require(_RPDO_TIMER)
    drive.set(_RPDO_TIMER, _TIMER_MS)
    begin_ns = drive.now_ns
    drive.quiet(2.0 * _TIMER_MS / 1e3)
    early = drive.count_emergencies(_PDO_MISSING, begin_ns)
    drive.expect(not early, "1400h:5, no RPDO yet", "no EMCY", f"{early}")
    for _ in range(2):
        for _ in range(3):
            last_ns = send_word(drive, identifier, od.SHUTDOWN)
            drive.quiet(0.7 * _TIMER_MS / 1e3)
        early = drive.count_emergencies(_PDO_MISSING, begin_ns)
        what = f"1400h:5 = {_TIMER_MS}, an RPDO each {0.7 * _TIMER_MS:g} ms"
        drive.expect(not early, what, "no EMCY 8250h", f"{early}", "another time is used")
        frame = drive.await_emergency(_PDO_MISSING, begin_ns, f"{what}, then none")
        late_ms = (frame.time_ns - last_ns) / 1e6
        expected = f"{_TIMER_MS} ms + 10 ms after the last RPDO"
        is_right = _TIMER_MS - 1.0 <= late_ms <= _TIMER_MS + 10.0
        drive.expect(is_right, f"{what}, then none", expected, f"{late_ms:.1f} ms")
        drive.quiet(2.0 * _TIMER_MS / 1e3)
        count = drive.count_emergencies(_PDO_MISSING, begin_ns)
        drive.expect(count == 1, f"{what}, then none", "one EMCY 8250h", f"{count}")
        begin_ns = drive.now_ns
        send_word(drive, identifier, od.SHUTDOWN)
        drive.await_emergency(0x0000, begin_ns, "an RPDO again")
    drive.client.node.nmt.send_command(PRE_OPERATIONAL)
    begin_ns = drive.now_ns
    drive.quiet(2.0 * _TIMER_MS / 1e3)
    late = drive.count_emergencies(_PDO_MISSING, begin_ns)
    what = f"1400h:5 = {_TIMER_MS}, pre-operational"
    drive.expect(not late, what, "no EMCY 8250h: it has no PDOs", f"{late}")
    operational(drive)
    drive.set(_RPDO_TIMER, 0)
    begin_ns = drive.now_ns
    send_word(drive, identifier, od.SHUTDOWN)
    drive.quiet(2.0 * _TIMER_MS / 1e3)
    late = drive.count_emergencies(_PDO_MISSING, begin_ns)
    drive.expect(not late, "1400h:5 = 0", "no EMCY 8250h", f"{late}")
