"""Mapping of process data: the procedure, what is refused, dummy entries."""

from collections.abc import Iterator, Sequence
from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.clauses.communication.process_data import (
    configure,
    operational,
    quiet_other_pdos,
    sync,
)
from motorhil.harness.conformance.drives.device_file import StatedObject
from motorhil.harness.conformance.drives.drive import Drive
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, State

_INVALID: Final = 0x8000_0000
_UNSUPPORTED: Final = 0x0601_0000
_ABSENT: Final = (0x0602_0000, 0x0604_0041)
_NOT_MAPPABLE: Final = 0x0604_0041
_TOO_LONG: Final = 0x0604_0042
_VALUE: Final = (0x0609_0030, 0x0609_0031, 0x0609_0032, 0x0604_0043, 0x0800_0000, _UNSUPPORTED)
_PDO_BITS: Final = 64
_RESTRICTED: Final = (  # CiA 301, table of restricted CAN identifiers
    *((0x001, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F)),
    *((0x6E0, 0x6FF), (0x701, 0x7FF)),
)
_TPDO: Final = Entry(0x1800, 1, "I", "COB-ID")
_OF_INVALID: Final = (
    Entry(0x1800, 3, "H", "inhibit time"),
    Entry(0x1800, 6, "B", "SYNC start value"),
)
"""The optional settings of a TPDO that change only while it is invalid."""
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


def _expect_own_mapping_again(drive: Drive, first: int) -> None:
    """Expect the entries that a PDO has at power-on to be taken again, if they can be written."""
    parameter, count = Entry(first, 1, "I", "COB-ID"), Entry(first + 0x200, 0, "B", "number")
    cob_id, number = drive.find(parameter), drive.find(count)
    if cob_id is None or not number:
        return
    entries = [Entry(first + 0x200, place, "I", "mapped object") for place in range(1, number + 1)]
    own = [drive.read(entry) for entry in entries]
    is_open = not drive.offer_value(parameter, cob_id | _INVALID)
    if is_open and not drive.offer_value(count, 0):
        for entry, value in zip(entries, own, strict=True):
            code = drive.offer_value(entry, value)
            expected = "accepted: it was there at power-on"
            drive.expect(not code, f"{entry} = {value:08X}h", expected, f"{code:08X}h")
        drive.write(count, number)
    if is_open:
        drive.write(parameter, cob_id)


def _expect_whole_ranges_refused(drive: Drive, parameter: Entry, cob_id: int) -> None:
    """Expect a drive that refuses identifiers within a restricted range to refuse its ends, too."""
    base = cob_id & ~(_INVALID | 0x7FF)

    def is_taken(identifier: int) -> bool:
        code = drive.offer_value(parameter, base | identifier)
        drive.write(parameter, cob_id | _INVALID)
        return not code

    for low, high in _RESTRICTED:
        middle = (low + high) // 2
        if is_taken(middle) or is_taken(middle + 1):  # CiA 301 forbids them to the host
            continue
        for end in (low, high):
            what = f"{parameter} with the restricted identifier {end:03X}h"
            expected = f"an abort, as for {middle:03X}h"
            drive.expect(not is_taken(end), what, expected, "accepted")


@drive_clause("PDO-09", Level.L0, source="CiA 301, 7.5.2.35 to 7.5.2.38, PDO mapping procedure")
def mapping_procedure(bench: DriveBench) -> None:
    """A PDO is changed only while it is invalid; entries that cannot be mapped are refused."""
    drive = bench.drive
    for first in (*range(0x1400, 0x1404), *range(0x1800, 0x1804)):
        _expect_own_mapping_again(drive, first)
    for first, mapped in ((0x1400, od.CONTROLWORD), (0x1800, od.STATUSWORD)):
        identifier = configure(drive, first, (mapped,), 255)
        parameter, kind = Entry(first, 1, "I", "COB-ID"), Entry(first, 2, "B", "type")
        count = Entry(first + 0x200, 0, "B", "number of mapped objects")
        entry = Entry(first + 0x200, 1, "I", "mapped object")
        cob_id = drive.read(parameter)
        _refused(drive, parameter, cob_id ^ 1, _VALUE, "while it is valid")
        _refused(drive, count, 0, (_UNSUPPORTED, *_VALUE), "while the PDO is valid")
        _refused(drive, entry, mapped.mapped, (_UNSUPPORTED, *_VALUE), "while the PDO is valid")
        for fixed in _OF_INVALID if first == 0x1800 else ():
            kept = drive.find(fixed)
            if kept is not None:
                codes, why = (_UNSUPPORTED, *_VALUE), "while the PDO is valid"
                _refused(drive, fixed, kept + 1, codes, why)
                drive.write(fixed, kept)
        for wrong in (241, 251):
            _refused(drive, kind, wrong, _VALUE, "a reserved type")
        if first == 0x1400:
            _refused(drive, kind, 252, _VALUE, "a type of TPDOs")
        drive.write(parameter, cob_id | _INVALID)
        _expect_whole_ranges_refused(drive, parameter, cob_id)
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


@drive_clause("PDO-12", Level.L4, source="CiA 301, 7.5.2.38; CiA 306, PDOMapping, Granularity")
def tpdo_has_its_objects(bench: DriveBench) -> None:
    """Each object that the EDS lets a TPDO map is in it, at its place, as SDO tells it."""
    drive, promised = bench.drive, bench.dictionary()
    if not promised.granularity:
        raise NotApplicable("the EDS lets no PDO be mapped")
    mapping = _mapped(drive, 0x1A00)
    identifier = configure(drive, 0x1800, (od.STATUSWORD,), 1)
    quiet_other_pdos(drive, 0x1800)
    cob_id = drive.read(_TPDO)
    operational(drive)
    sent = [one for one in promised.objects if one.sent_bits % promised.granularity == 0]
    for group in _grouped([one for one in sent if one.sent_bits], len(mapping)):
        drive.write(_TPDO, cob_id | _INVALID)
        drive.write(Entry(0x1A00, 0, "B", "number"), 0)
        for entry, one in zip(mapping, group, strict=False):
            value = one.index << 16 | one.subindex << 8 | one.sent_bits
            code = drive.offer_value(entry, value)
            expected = f"accepted: PDOMapping = 1, {one.access} in the EDS"
            drive.expect(not code, f"{entry} = {value:08X}h", expected, f"{code:08X}h")
        drive.write(Entry(0x1A00, 0, "B", "number"), len(group))
        drive.write(_TPDO, cob_id)
        _expect_values(drive, identifier, group)


def _mapped(drive: Drive, index: int) -> list[Entry]:
    """Return the entries of a mapping, which a PDO can have."""
    entries = [Entry(index, place, "I", "mapped object") for place in range(1, 65)]
    absent = (at for at, one in enumerate(entries) if drive.find(one) is None)
    return entries[: next(absent, len(entries))]


def _grouped(objects: Sequence[StatedObject], most: int) -> Iterator[list[StatedObject]]:
    """Yield as many objects as fit into a PDO, in order, until all have come."""
    group: list[StatedObject] = []
    for one in objects:
        if group and (len(group) == most or _bits(group) + one.sent_bits > _PDO_BITS):
            yield group
            group = []
        group.append(one)
    if group:
        yield group


def _bits(objects: Sequence[StatedObject]) -> int:
    return sum(one.sent_bits for one in objects)


def _expect_values(drive: Drive, identifier: int, group: Sequence[StatedObject]) -> None:
    """Expect a TPDO to have the values of these objects that do not change meanwhile."""

    def told() -> list[int]:
        read = [drive.upload(one.index, one.subindex) for one in group]
        whole = [int.from_bytes(data, "little") for data in read]
        return [value & (1 << one.sent_bits) - 1 for value, one in zip(whole, group, strict=True)]

    before, begin_ns = told(), drive.now_ns
    sync(drive)
    heard, after = drive.client.heard(identifier, begin_ns), told()
    names = ", ".join(f"{one.index:04X}h:{one.subindex:02X}" for one in group)
    what, size = f"TPDO with {names}", -(-_bits(group) // 8)
    sizes = [len(frame.data) for frame in heard]
    drive.expect(sizes == [size], what, f"one of {size} bytes at SYNC", f"{sizes}")
    payload = int.from_bytes(heard[0].data, "little")
    for one, value, later in zip(group, before, after, strict=True):
        seen = payload & (1 << one.sent_bits) - 1
        payload >>= one.sent_bits
        place = f"{one.index:04X}h:{one.subindex:02X}"
        expected = f"{value:X}h, as read by SDO"
        drive.expect(seen == value or value != later, f"{place} in {what}", expected, f"{seen:X}h")


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
