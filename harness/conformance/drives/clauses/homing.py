"""Homing on the current position: result, home offset, bits 10, 12 and 13; refused methods."""

from typing import Final

from motorhil.harness.conformance.clause import Level, NotApplicable
from motorhil.harness.conformance.drives import objects as od
from motorhil.harness.conformance.drives.bench import DriveBench
from motorhil.harness.conformance.drives.drive import STATE_S, Drive
from motorhil.harness.conformance.drives.kit import drive_clause
from motorhil.harness.conformance.drives.objects import Mode

_HM: Final = "CiA 402-2 / IEC 61800-7-201, homing mode"
_CURRENT_POSITION: Final = (37, 35)
_RESERVED: Final = (15, 16, 31, 32)
_OFFSET: Final = 1000
_BITS: Final = od.TARGET_REACHED | od.BIT_12 | od.BIT_13


def _home(drive: Drive) -> int | None:
    """Start homing; return the statusword when it has ended, or None if it does not end."""
    drive.command(od.ENABLE)
    drive.command(od.ENABLE | od.START_HOMING)
    word = drive.until(lambda word: bool(word & (od.BIT_12 | od.BIT_13)), 2.0 * STATE_S)
    drive.command(od.ENABLE)
    return word


@drive_clause("HOME-01", Level.L1, source=f"{_HM}, methods 35 and 37, 607Ch, statusword bits")
def home_is_here(bench: DriveBench) -> None:
    """Method 37 or 35 makes the current position home: zero is 607Ch beyond it; bits 10, 12 = 1."""
    drive = bench.drive
    drive.require_mode(Mode.HM)
    method = next((one for one in _CURRENT_POSITION if _takes(drive, one)), None)
    if method is None:
        raise NotApplicable("6098h takes neither 37 nor 35")
    drive.require(od.HOME_OFFSET)
    drive.enable(Mode.HM)
    before = drive.statusword()
    what = f"6041h, before homing with method {method}"
    drive.expect(not before & (od.BIT_12 | od.BIT_13), what, "bits 12, 13 = 0", f"{before:04X}h")
    for offset in (0, _OFFSET):
        drive.set(od.HOME_OFFSET, offset)
        word = _home(drive)
        what = f"homing, method {method}, 607Ch = {offset}"
        seen = "no end" if word is None else f"6041h = {word:04X}h"
        expected = "bits 10 and 12 = 1, 13 = 0 (completed)"
        is_done = word is not None and word & _BITS == od.TARGET_REACHED | od.BIT_12
        drive.expect(is_done, what, expected, seen, "homing is not made, or bits are wrong")
        position = drive.read(od.POSITION)
        drive.expect(
            abs(position + offset) <= drive.window(),
            f"6064h after {what}",
            f"{-offset} +- {drive.window()} (home; zero is 607Ch beyond it)",
            f"{position}",
            "the opposite sign of 607Ch" if position == offset else "607Ch is ignored",
        )


@drive_clause("HOME-02", Level.L2, source=f"{_HM}, 6098h: 15, 16, 31 and 32 are reserved")
def reserved_methods(bench: DriveBench) -> None:
    """A reserved homing method is refused, or ends with homing error (bit 13)."""
    drive = bench.drive
    drive.require_mode(Mode.HM)
    drive.enable(Mode.HM)
    for method in _RESERVED:
        if _takes(drive, method):
            word = _home(drive) or drive.statusword()
            expected = "an SDO abort code, or bit 13 = 1"
            seen = f"accepted, 6041h = {word:04X}h"
            drive.expect(bool(word & od.BIT_13), f"6098h = {method}", expected, seen)


def _takes(drive: Drive, method: int) -> bool:
    return drive.refusal(od.HOMING_METHOD.index, 0, bytes((method,))) == 0
