"""Mapping of process data: the procedure, what is refused, dummy entries."""

from collections.abc import Sequence
from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.clauses.communication.process_data import (
    configure,
    operational,
)
from motorhil.harness.conformance.drives.drive import Drive
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, State

_INVALID: Final = 0x8000_0000
_UNSUPPORTED: Final = 0x0601_0000
_ABSENT: Final = (0x0602_0000, 0x0604_0041)
_NOT_MAPPABLE: Final = 0x0604_0041
_TOO_LONG: Final = 0x0604_0042
_VALUE: Final = (0x0609_0030, 0x0609_0031, 0x0609_0032, 0x0604_0043, 0x0800_0000, _UNSUPPORTED)
_BOOLEAN: Final = 0x0001
_BIT: Final = 0x0001_0001  # a dummy of one bit
_BITS: Final = 4
_DUMMY_BYTE: Final = 0x0005_0008


def _refused(drive: Drive, entry: Entry, value: int, codes: Sequence[int], why: str) -> None:
    """Expect an abort with one of these codes, and the value unchanged."""
    before = drive.read(entry)
    code = drive.offer_value(entry, value)
    expected = "an abort with " + " or ".join(f"{one:08X}h" for one in codes)
    seen = f"{code:08X}h" if code else "accepted"
    drive.expect(code in codes, f"{entry} = {value:X}h, {why}", expected, seen)
    drive.near(entry, before, 0, f"{entry} = {value:X}h, refused")


@drive_clause("PDO-09", Level.L0, source="CiA 301, 7.5.2.35 to 7.5.2.38, PDO mapping procedure")
def mapping_procedure(bench: DriveBench) -> None:
    """A PDO is changed only while it is invalid; entries that cannot be mapped are refused."""
    drive = bench.drive
    for first, mapped in ((0x1400, od.CONTROLWORD), (0x1800, od.STATUSWORD)):
        identifier = configure(drive, first, (mapped,), 255)
        parameter, kind = Entry(first, 1, "I", "COB-ID"), Entry(first, 2, "B", "type")
        count = Entry(first + 0x200, 0, "B", "number of mapped objects")
        entry = Entry(first + 0x200, 1, "I", "mapped object")
        cob_id = drive.read(parameter)
        _refused(drive, parameter, cob_id ^ 1, _VALUE, "while it is valid")
        _refused(drive, count, 0, (_UNSUPPORTED, *_VALUE), "while the PDO is valid")
        _refused(drive, entry, mapped.mapped, (_UNSUPPORTED, *_VALUE), "while the PDO is valid")
        inhibit = Entry(first, 3, "H", "inhibit time")
        kept = drive.find(inhibit) if first == 0x1800 else None
        if kept is not None:
            _refused(drive, inhibit, kept + 1, (_UNSUPPORTED, *_VALUE), "while the PDO is valid")
            drive.write(inhibit, kept)
        for wrong in (241, 251):
            _refused(drive, kind, wrong, _VALUE, "a reserved type")
        if first == 0x1400:
            _refused(drive, kind, 252, _VALUE, "a type of TPDOs")
        drive.write(parameter, cob_id | _INVALID)
        _refused(drive, entry, mapped.mapped, (_UNSUPPORTED, *_VALUE), "with a mapping")
        drive.write(count, 0)
        _refused(drive, entry, 0x5FFF_0008, _ABSENT, "an absent object")
        own = Entry(0x1018, 1, "I", "vendor-ID")
        _refused(drive, entry, own.mapped, (_NOT_MAPPABLE,), "an object that is not for PDOs")
        wrong = mapped.mapped ^ 0x18  # 8 bits of 16
        _refused(drive, entry, wrong, (_NOT_MAPPABLE,), "with another length")
        if first == 0x1800:
            _refused(drive, entry, _DUMMY_BYTE, _ABSENT, "a dummy, which only RPDOs have")
        drive.write(entry, mapped.mapped)
        wide = od.TARGET_POSITION if first == 0x1400 else od.POSITION
        if drive.find(wide) is not None:
            for place in (2, 3):
                drive.set(Entry(first + 0x200, place, "I", "mapped object"), wide.mapped)
            _refused(drive, count, 3, (_TOO_LONG,), "80 bits of 64")
        drive.write(count, 1)
        drive.write(parameter, cob_id)
        seen = drive.read(parameter) & 0x7FF
        drive.expect(seen == identifier, "the PDO again", f"{identifier:03X}h", f"{seen:03X}h")


@drive_clause("PDO-10", Level.L4, source="CiA 301, 7.4.7.3 and 7.5.2.36: dummy mapping entries")
def dummy_entries(bench: DriveBench) -> None:
    """A dummy entry of an RPDO fills space: what comes after it is taken from its own place."""
    drive = bench.drive
    identifier = configure(drive, 0x1400, (od.CONTROLWORD,), 255)
    parameter = Entry(0x1400, 1, "I", "COB-ID")
    count, first = Entry(0x1600, 0, "B", "number"), Entry(0x1600, 1, "I", "mapped object")
    cob_id = drive.read(parameter)
    for dummies in ((_DUMMY_BYTE,), (0x0007_0020,), (0x0002_0008, 0x0006_0010)):
        drive.write(parameter, cob_id | _INVALID)
        drive.write(count, 0)
        entries = (*dummies, od.CONTROLWORD.mapped)
        for place, entry in enumerate(entries, first.subindex):
            drive.set(Entry(0x1600, place, "I", "mapped object"), entry)
        drive.write(count, len(entries))
        drive.write(parameter, cob_id)
        operational(drive)
        drive.become(State.SWITCH_ON_DISABLED, od.DISABLE_VOLTAGE, "transition 7")
        space = sum(one & 0xFF for one in dummies) // 8
        drive.client.send(identifier, b"\x06" * space + b"\x00\x00")
        drive.quiet()
        seen = drive.state()
        what = f"RPDO with {space} bytes of dummies, 06h, and controlword 0000h"
        drive.expect(seen is State.SWITCH_ON_DISABLED, what, "switch on disabled", f"{seen}")
        drive.client.send(identifier, b"\x00" * space + b"\x06\x00")
        drive.await_state(State.READY_TO_SWITCH_ON, what.replace("0000h", "0006h"), "transition 2")
    _refuse_odd_dummy(drive, parameter, count, first)
    _expect_promised_bits(bench, identifier, cob_id)


def _refuse_odd_dummy(drive: Drive, parameter: Entry, count: Entry, first: Entry) -> None:
    drive.write(parameter, drive.read(parameter) | _INVALID)
    drive.write(count, 0)
    for odd in (0x0005_0010, 0x0005_0108):
        code = drive.offer_value(first, odd)
        seen = f"{code:08X}h" if code else "accepted"
        drive.expect(code != 0, f"dummy entry {odd:08X}h", "an abort: no such dummy", seen)


def _expect_promised_bits(bench: DriveBench, identifier: int, cob_id: int) -> None:
    """Expect dummies of one bit, if the EDS of the drive allows them and places between bytes."""
    drive = bench.drive
    try:
        promised = bench.dictionary()
    except NotApplicable:
        return
    if promised.granularity != 1 or _BOOLEAN not in promised.dummies:
        return
    for place, entry in enumerate((*[_BIT] * _BITS, od.CONTROLWORD.mapped), 1):
        mapped = Entry(0x1600, place, "I", "mapped object")
        code = drive.offer_value(mapped, entry)
        seen, what = f"{code:08X}h", f"{mapped} = {entry:08X}h"
        drive.expect(not code, what, "accepted: Dummy0001 = 1, Granularity = 1", seen)
    drive.write(Entry(0x1600, 0, "B", "number"), _BITS + 1)
    drive.write(Entry(0x1400, 1, "I", "COB-ID"), cob_id)
    operational(drive)
    for word, state in ((0x00, State.SWITCH_ON_DISABLED), (0x06, State.READY_TO_SWITCH_ON)):
        drive.client.send(identifier, (word << _BITS | 0x06).to_bytes(3, "little"))
        what = f"RPDO with {_BITS} bits of dummies, and controlword {word:04X}h"
        drive.await_state(state, what, "the EDS promises such places")
