"""Readers for the logs of two analysers: BUSMASTER, and IXXAT's MiniMon.

BUSMASTER's head says if numbers are decimal or hexadecimal, and if times count from midnight
(system), from the beginning (absolute) or from the row before (relative). A fraction of a time has
four digits, in units of 100 us:

  ***BUSMASTER Ver 2.4.0***
  ***START DATE AND TIME 8:8:2014 11:49:7:965***
  ***HEX***
  ***SYSTEM MODE***
  11:49:12:9420 Rx 1 0x023 s 1 40

MiniMon's time counts from the start; separators are commas or semicolons:

  ASCII Trace IXXAT MiniMon V3  Version: 1.1.4.4533
  Date: 5/9/2024
  Start time: 2:37:37 PM
  "Time","Identifier (hex)","Format","Flags","Data (hex)"
  "00:30:06.866","184","Std","","00 06 00 16 75 EE 00 3C"

Source: BUSMASTER, LogObjectCAN.cpp; SavvyCAN, framefileio.cpp (tshark 4.0 reads the same); rows
of canopen-message-interpreter.
"""

import re
from collections.abc import Sequence
from typing import Final, final

from motorhil.traces import can_frame
from motorhil.traces.formats import frames as traffic
from motorhil.traces.formats.frames import NS, Findings, Frame
from motorhil.traces.schema import Direction

_UNIT_NS: Final = 100_000
_DAY_NS: Final = 86_400 * NS
_WAYS: Final = {"Rx": Direction.RECEIVED, "Tx": Direction.TRANSMITTED}
_START: Final = re.compile(
    r"\*\*\*START DATE AND TIME (\d+):(\d+):(\d{4}) (\d+):(\d+):(\d+):(\d+)\*\*\*"
)
_ROW: Final = re.compile(
    r"(\d+):(\d\d?):(\d\d?):(\d{1,4})\s+(Rx|Tx|RX|TX)\s+(\d+)\s+(\S+)\s+([sSxX])([rR])?"
    r"(?:-(\w+))?\s+(\d+)(?:\s+(.*)|\s*)$"
)
_MINIMON: Final = re.compile(
    r'"?(\d+):(\d+):(\d+)[.,](\d+)"?[,;]"?([0-9A-Fa-f]+)"?[,;]"?(Std|Ext)"?[,;]"?([^",;]*)"?[,;]'
    r'"?([^"]*)"?$'
)
_REQUEST: Final = re.compile(r"Remote request\s*DLC\s*=\s*(\d)")


def looks_like_busmaster(line: str) -> bool:
    """Return True for the first line of a log of BUSMASTER."""
    return line.startswith("***BUSMASTER Ver")


def looks_like_minimon(line: str) -> bool:
    """Return True for the first line of a trace of IXXAT's MiniMon."""
    return line.startswith("ASCII Trace IXXAT")


def _clock_ns(hours: str, minutes: str, seconds: str) -> int:
    return ((int(hours) * 60 + int(minutes)) * 60 + int(seconds)) * NS


@final
class BusmasterReader:
    """Reader of BUSMASTER's rows; a later head in the same file begins another session."""

    name = "busmaster"

    def __init__(self) -> None:
        self._base = 16
        self._mode = "SYSTEM"
        self._day_ns = 0
        self._start_ns = 0
        self._before_ns = 0

    def take(self, line: str, findings: Findings) -> Sequence[Frame]:
        """Return the frame of a line. Raises ValueError with the reason if it is unreadable."""
        stripped = line.strip()
        if stripped.startswith("***"):
            self._head(stripped)
            return ()
        if not stripped:
            return ()
        match = _ROW.match(stripped)
        if match is None:
            raise ValueError("not a frame")
        return (self._framed(match, self._frame(match)),)

    def _head(self, line: str) -> None:
        start = _START.match(line)
        if start is not None:
            day, month, year = (int(start[at]) for at in (1, 2, 3))
            self._day_ns = max(0, traffic.date_ns(year, month, day))
            clock_ns = _clock_ns(start[4], start[5], start[6]) + int(start[7]) * 1_000_000
            self._start_ns = self._before_ns = self._day_ns + clock_ns
        elif line in ("***HEX***", "***DEC***"):
            self._base = 16 if line == "***HEX***" else 10
        elif line.endswith(" MODE***"):
            self._mode = line.strip("*").partition(" ")[0]

    def _framed(self, match: re.Match[str], frame: bytes) -> Frame:
        told_ns = _clock_ns(match[1], match[2], match[3]) + int(match[4]) * _UNIT_NS
        if self._mode == "RELATIVE":
            time_ns = self._before_ns + told_ns
        elif self._mode == "ABSOLUTE":
            time_ns = self._start_ns + told_ns
        else:  # a time before the last one by more than half a day is one of the next day
            time_ns = self._day_ns + told_ns
            if time_ns < self._before_ns - _DAY_NS // 2:
                self._day_ns += _DAY_NS
                time_ns += _DAY_NS
        self._before_ns = traffic.log_time(time_ns)
        way = _WAYS[match[5].capitalize()]
        return Frame(time_ns, f"can{max(0, int(match[6]) - 1)}", frame, way)

    def _frame(self, match: re.Match[str]) -> bytes:
        digits, kind, remote, more, count, rest = match.groups()[6:]
        length, parts = int(count), (rest or "").split()
        try:
            can_id = int(digits.removeprefix("0x").removeprefix("0X"), self._base)
            data = bytes(int(part, self._base) for part in parts)
        except ValueError:
            raise ValueError("an identifier or byte is not a number") from None
        if can_id > (can_frame.SFF_MASK if kind in "sS" else can_frame.EFF_MASK):
            raise ValueError(f"identifier {digits} is too large")
        can_id |= 0 if kind in "sS" else can_frame.EFF
        if remote:
            return can_frame.remote(can_id, length)
        if len(data) != length:
            raise ValueError(f"{len(data)} of {length} bytes")
        if more is None and length <= 8:
            return can_frame.classic(can_id, data)
        return can_frame.flexible(can_id, 0, data)


@final
class MinimonReader:
    """Reader of MiniMon's rows."""

    name = "minimon"

    def __init__(self) -> None:
        self._day_ns = 0

    def take(self, line: str, findings: Findings) -> Sequence[Frame]:
        """Return the frame of a line. Raises ValueError with the reason if it is unreadable."""
        stripped = line.strip()
        match = _MINIMON.match(stripped)
        if match is None:
            if not stripped or not stripped[:2].strip('"')[:1].isdecimal():
                return ()  # the head, and the names of the columns
            raise ValueError("not a frame")
        hours, minutes, seconds, part, digits, form, flags, rest = match.groups()
        time_ns = _clock_ns(hours, minutes, seconds) + int(part[:9].ljust(9, "0"))
        findings.note("times count from the beginning of the recording")
        can_id = int(digits, 16)
        if can_id > (can_frame.SFF_MASK if form == "Std" else can_frame.EFF_MASK):
            raise ValueError(f"identifier {digits} is too large")
        can_id |= 0 if form == "Std" else can_frame.EFF
        way = Direction.TRANSMITTED if "Self" in flags else Direction.UNKNOWN
        request = _REQUEST.match(rest)
        if "Rtr" in flags or request is not None:
            frame = can_frame.remote(can_id, int(request[1]) if request else 0)
        else:
            try:
                data = bytes.fromhex(rest)
            except ValueError:
                raise ValueError("the data is not a sequence of bytes") from None
            fd = len(data) > 8 or "Edl" in flags or "Fdf" in flags
            frame = can_frame.flexible(can_id, 0, data) if fd else can_frame.classic(can_id, data)
        return (Frame(time_ns, "can0", frame, way),)
