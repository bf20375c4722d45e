"""Object dictionary: mandatory objects, SDO abort codes, modes, parameter storage."""

import struct
from contextlib import suppress
from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.device_file import StatedObject
from motorhil.harness.conformance.drives.drive import ABSENT, Drive
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Entry, Mode, State

_CIA_301: Final = "CiA 301, 7.2.4.3.17, SDO abort codes"
_PROFILE: Final = 402
_EXPEDITED: Final = 4
_UNUSED_INDEX: Final = 0x5FFE  # manufacturer-specific; a drive that has it is asked for another
_UNUSED_INDICES: Final = (_UNUSED_INDEX, 0x5FFA, 0x4FF7, 0x2FFB)
_SAVE: Final = int.from_bytes(b"save", "little")
_LOAD: Final = int.from_bytes(b"load", "little")
_PERIOD_MS: Final = 50  # of a stored heartbeat
_NO_DATA: Final = (0x0601_0001, 0x0601_0000)
_NO_OBJECT: Final = 0x0602_0000
_NO_SUBINDEX: Final = 0x0609_0011
_READ_ONLY: Final = (0x0601_0002, 0x0601_0000)
_LENGTHS: Final = (0x0607_0010, 0x0607_0012, 0x0607_0013)
_VALUES: Final = (0x0609_0030, 0x0609_0031, 0x0609_0032, 0x0609_0036, 0x0800_0000, 0x0800_0020)
_COMMANDED: Final = {
    od.SHUTDOWN: State.READY_TO_SWITCH_ON,
    **dict.fromkeys((od.SWITCH_ON, od.ENABLE), State.SWITCH_ON_DISABLED),
}
"""The states that levels of 6040h command at power-on: transition 2, the others come later."""
_TARGETS: Final = {
    **dict.fromkeys((Mode.PP, Mode.CSP), od.TARGET_POSITION),
    **dict.fromkeys((Mode.PV, Mode.CSV), od.TARGET_VELOCITY),
    **dict.fromkeys((Mode.TQ, Mode.CST), od.TARGET_TORQUE),
}


def _codes(codes: tuple[int, ...]) -> str:
    return " or ".join(f"{code:08X}h" for code in codes)


@drive_clause("OD-01", Level.L0, source="CiA 301, 7.5.2.1 to 7.5.2.19; CiA 402-1, device type")
def mandatory_objects(bench: DriveBench) -> None:
    """1000h says profile 402; 1001h, 1018h:1, 6040h and 6041h can be read."""
    drive = bench.drive
    kind = drive.read(od.DEVICE_TYPE)
    drive.expect(
        kind & 0xFFFF == _PROFILE,
        f"{od.DEVICE_TYPE}",
        f"profile {_PROFILE} in the lower 16 bits",
        f"{kind & 0xFFFF}",
        "not a drive profile, or a wrong 1000h",
    )
    for entry in (od.ERROR_REGISTER, od.VENDOR, od.CONTROLWORD, od.STATUSWORD):
        drive.read(entry)


@drive_clause("OD-02", Level.L0, source=_CIA_301)
def unknown_objects(bench: DriveBench) -> None:
    """An object that does not exist is refused with 0602 0000h, a sub-index with 0609 0011h."""
    drive = bench.drive
    seen = [drive.refusal(index, 0) for index in _UNUSED_INDICES]
    absent = [code for code in seen if code]
    drive.expect(
        bool(absent) and all(code == _NO_OBJECT for code in absent),
        f"upload of {_UNUSED_INDEX:04X}h",
        f"{_NO_OBJECT:08X}h",
        _codes(tuple(seen)),
        "another abort code",
    )
    code = drive.refusal(0x1018, 0x7F)
    expected = f"{_NO_SUBINDEX:08X}h"
    drive.expect(code == _NO_SUBINDEX, "upload of 1018h:7F", expected, f"{code:08X}h")


@drive_clause("OD-03", Level.L0, source=_CIA_301)
def read_only_objects(bench: DriveBench) -> None:
    """A download to a read-only object is refused with 0601 0002h, and changes nothing."""
    drive = bench.drive
    before = drive.read(od.VENDOR)
    for entry in (od.VENDOR, od.STATUSWORD):
        data = bytes(struct.calcsize(entry.code))
        code = drive.refusal(entry.index, entry.subindex, data)
        drive.expect(
            code in _READ_ONLY,
            f"download to {entry}",
            _codes(_READ_ONLY),
            f"{code:08X}h" if code else "accepted",
            "access rights are not checked",
        )
    drive.expect(drive.read(od.VENDOR) == before, f"{od.VENDOR}", f"{before:X}h", "another value")


@drive_clause("OD-04", Level.L0, source=_CIA_301)
def wrong_lengths(bench: DriveBench) -> None:
    """A download with too many or too few bytes is refused with 0607 001xh."""
    drive = bench.drive
    for data in (b"\x01\x02\x03", b"\x01"):
        code = drive.refusal(od.CONTROLWORD.index, 0, data)
        drive.expect(
            code in _LENGTHS,
            f"download of {len(data)} bytes to {od.CONTROLWORD}",
            _codes(_LENGTHS),
            f"{code:08X}h" if code else "accepted",
            "the length is not checked",
        )


@drive_clause("OD-05", Level.L0, source="CiA 402-2, modes of operation 6060h, 6061h, 6502h")
def modes_agree(bench: DriveBench) -> None:
    """Each mode in 6502h has its target, can be selected, and is in 6061h; no other one can."""
    drive = bench.drive
    drive.require(od.MODE, od.MODE_DISPLAY)
    if drive.find(od.SUPPORTED_MODES) is None:
        _expect_some_mode(drive)
        return
    claimed = [mode for mode in Mode if drive.has_mode(mode)]
    if not claimed:
        raise NotApplicable("6502h claims no mode")
    for mode in claimed:
        drive.select(mode)
        _expect_target(drive, mode)
    last = claimed[-1]
    for mode in Mode:
        if mode in claimed:
            continue
        code = drive.refusal(od.MODE.index, 0, bytes((mode,)))
        drive.quiet()
        shown = drive.read(od.MODE_DISPLAY)
        drive.expect(
            shown == last and (not code or code in _VALUES),
            f"6060h = {mode.value} ({mode}), which 6502h does not claim",
            f"{_codes(_VALUES[:3])}, or ignored; 6061h = {last.value}",
            f"{code:08X}h; 6061h = {shown}",
            "6502h lacks a mode, or modes are not checked",
        )


def _expect_some_mode(drive: Drive) -> None:
    """Expect some standard modes to be taken: these are shown, and have their targets."""
    taken = []
    for mode in Mode:
        code = drive.refusal(od.MODE.index, 0, bytes((mode,)))
        drive.quiet()
        if not code:
            taken.append(mode)
            drive.near(od.MODE_DISPLAY, mode, 0, f"6060h = {mode.value} ({mode}), which is taken")
            _expect_target(drive, mode)
    drive.expect(bool(taken), "6060h without 6502h", "one standard mode or more", "all refused")


def _expect_target(drive: Drive, mode: Mode) -> None:
    target = _TARGETS.get(mode)
    if target is not None:
        there = drive.find(target) is not None
        drive.expect(there, f"mode {mode}", f"its target {target}", "absent")


@drive_clause("OD-07", Level.L0, source="CiA 402-2, modes of operation 6060h, 6061h; halt, bit 8")
def mode_is_selected_during_halt(bench: DriveBench) -> None:
    """A mode can be selected in any state, also while bit 8 of 6040h (halt) is 1."""
    drive = bench.drive
    drive.require(od.SUPPORTED_MODES, od.MODE, od.MODE_DISPLAY)
    claimed = [mode for mode in Mode if drive.has_mode(mode)]
    if len(claimed) < 2:
        raise NotApplicable("6502h claims one mode only")
    drive.command(od.SHUTDOWN | od.HALT)
    for mode in (*claimed[:2], claimed[0]):
        drive.select(mode)


@drive_clause("OD-06", Level.L1, source="CiA 301, 7.5.2.13 and 7.5.2.14, 1010h and 1011h")
def parameters_are_stored(bench: DriveBench) -> None:
    """1010h stores with "save" only, 1017h too; 1011h restores defaults at the next reset."""
    drive = bench.drive
    drive.require(od.STORE_ALL, od.RESTORE_ALL, od.PROFILE_VELOCITY)
    entry = od.PROFILE_VELOCITY
    default = drive.read(entry)
    for store in (od.STORE_ALL, od.RESTORE_ALL):
        code = drive.refusal(store.index, store.subindex, b"evas")
        seen = f"{code:08X}h" if code else "accepted"
        drive.expect(code >> 16 == 0x0800, f'signature "evas" to {store}', "0800 002xh", seen)
    if bench.is_real:
        raise NotApplicable("a real drive keeps what it has stored: only signatures were checked")
    drive.write(entry, default + 1)
    own_ms = drive.find(od.HEARTBEAT_PRODUCER)
    if own_ms is not None:
        drive.write(od.HEARTBEAT_PRODUCER, _PERIOD_MS)
    drive.write(od.STORE_ALL, _SAVE)
    drive.reset()
    begin_ns = drive.now_ns
    drive.quiet(5.5 * _PERIOD_MS / 1e3)
    count = len(drive.client.heard(drive.error_control_id, begin_ns))
    what = f"reset, stored 1017h = {_PERIOD_MS} ms, for {5.5 * _PERIOD_MS:g} ms"
    is_sent = own_ms is None or 4 <= count <= 7
    drive.expect(is_sent, what, "5 heartbeats, 1 or 2 more or less", f"{count}", "1017h waits")
    stored = drive.read(entry)
    expected = f"{default + 1}, which was stored"
    drive.expect(stored == default + 1, f"{entry} after reset", expected, f"{stored}", "not stored")
    drive.write(od.RESTORE_ALL, _LOAD)
    kept = drive.read(entry)
    expected = f"{default + 1} until the reset"
    drive.expect(kept == default + 1, f"{entry} after 1011h", expected, f"{kept}")
    drive.reset()
    drive.near(entry, default, 0, "after 1011h and a reset")
    if own_ms is not None:
        drive.near(od.HEARTBEAT_PRODUCER, own_ms, 0, "after 1011h and a reset")


@drive_clause(
    "OD-08", Level.L0, source="CiA 301, 7.4.7, data types; CiA 402-2, object descriptions"
)
def sizes_of_objects(bench: DriveBench) -> None:
    """Each standard object of the drive is uploaded with the size of its data type."""
    drive = bench.drive
    found = 0
    for entry in (one for one in vars(od).values() if isinstance(one, od.Entry)):
        size = drive.size_of(entry)
        if size is None:
            continue
        found += 1
        wanted = struct.calcsize(entry.code)  # an expedited answer may leave its size open
        is_right = size == wanted or size == _EXPEDITED > wanted
        drive.expect(is_right, f"upload of {entry}", f"{wanted} bytes", f"{size} bytes")
    drive.expect(found > 0, "standard objects", "some that can be read", "none")


@drive_clause(
    "OD-09", Level.L0, source="CiA 306, EDS: DataType, AccessType; CiA 301, 7.2.4.3.17, 7.4.7"
)
def dictionary_is_that_of_its_file(bench: DriveBench) -> None:
    """Each object of the drive's EDS is there, with its size, and read or written as it says."""
    drive = bench.drive
    for one in bench.dictionary().objects:
        entry = Entry(one.index, one.subindex, "I", one.name)
        code = drive.refusal(one.index, one.subindex)
        what, seen = f"upload of {entry}, {one.access} in the EDS", f"{code:08X}h"
        if one.access == "wo":
            drive.expect(code in _NO_DATA, what, _codes(_NO_DATA), seen, "it can be read")
            continue
        drive.expect(code not in ABSENT, what, "its value", seen, "it is absent")
        is_fixed = one.access in ("ro", "const")
        if not code and one.is_text and not is_fixed and not bench.is_real:
            _expect_text_again(drive, one)
        if code or not one.size:
            continue
        size = drive.size_of(entry)
        is_right = size == one.size or size == _EXPEDITED > one.size
        drive.expect(is_right, what, f"{one.size} bytes", f"{size}", "another data type")
        if is_fixed:
            code = drive.refusal(one.index, one.subindex, bytes(one.size))
            what, seen = f"download to {entry}, {one.access} in the EDS", f"{code:08X}h"
            drive.expect(code in _READ_ONLY, what, _codes(_READ_ONLY), seen, "it can be written")
        elif not bench.is_real:
            _expect_limits(drive, one)


@drive_clause("OD-10", Level.L0, source="The rig: objects; CiA 306, DefaultValue")
def objects_of_the_rig(bench: DriveBench) -> None:
    """Each object has at power-on the value that the rig states, if the drive shows it.

    The drive obeys such a value of 6040h.
    """
    stated = bench.stated.get("objects", {})
    if bench.is_real or not stated:
        raise NotApplicable("the rig states no objects of an emulated drive")
    drive = bench.drive
    for key, wanted in stated.items():
        place, _, subindex = key.partition(":")
        base = 16 if subindex[-1:] in ("h", "H") else 10
        entry = Entry(int(place[:4], 16), int(subindex.rstrip("hH") or "0", base), "I", "object")
        if not isinstance(wanted, int) or drive.size_of(entry) is None:
            continue
        data = drive.upload(entry.index, entry.subindex)
        seen = int.from_bytes(data, "little")
        is_right = not (seen ^ wanted) & (1 << 8 * len(data)) - 1
        drive.expect(is_right, f'"{key}" of the rig', f"{wanted}", f"{data.hex(' ')}")
    if any(key.startswith("6040") for key in stated):
        commanded = _COMMANDED.get(drive.find(od.CONTROLWORD) or 0)
        if commanded is not None:
            drive.await_state(commanded, "power-on, with 6040h of the rig", "as 6040h commands")


def _expect_text_again(drive: Drive, stated: StatedObject) -> None:
    """Expect a text that can be written to be taken, and to be kept."""
    place = stated.index, stated.subindex
    for wanted in (b"another", drive.upload(*place)):
        code = drive.refusal(*place, wanted)
        what = f"download of {wanted!r} to {stated.index:04X}h:{stated.subindex:02X}"
        if code and wanted == b"another":
            continue  # the drive may limit its texts
        drive.expect(not code, what, "accepted: it was there before", f"{code:08X}h")
        seen = drive.upload(*place)
        drive.expect(seen == wanted, what, f"{wanted!r}", f"{seen!r}")
        if wanted == b"another":
            _expect_whole_frame(drive, stated)


def _expect_whole_frame(drive: Drive, stated: StatedObject) -> None:
    """Expect all four bytes of an expedited download without a size (e = 1, s = 0) to be taken."""
    place = struct.pack("<HB", stated.index, stated.subindex)
    node, text = drive.node_id, b"four"
    answers = drive.client.ask(0x600 + node, b"\x22" + place + text, 0x580 + node)
    if answers and answers[0].data[:4] == b"\x60" + place:
        seen = drive.upload(stated.index, stated.subindex)
        what = f"expedited download of {text!r} to {stated.index:04X}h:{stated.subindex:02X}"
        expected = f"{text!r}: without a size, all bytes count"
        drive.expect(seen.startswith(text), what, expected, f"{seen!r}")


def _expect_limits(drive: Drive, stated: StatedObject) -> None:
    """Expect values beyond LowLimit and HighLimit to be refused, if the data type holds them."""
    for limit, step in ((stated.low, -1), (stated.high, 1)):
        if limit is None:
            continue
        with suppress(OverflowError):
            data = (limit + step).to_bytes(stated.size, "little", signed=stated.is_signed)
            code = drive.refusal(stated.index, stated.subindex, data)
            what = f"{stated.index:04X}h:{stated.subindex:02X} = {limit + step}"
            what = f"{what}, limit {limit} in the EDS"
            drive.expect(code != 0, what, "an abort code", "accepted")
