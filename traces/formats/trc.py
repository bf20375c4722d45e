"""Reader for PEAK TRC files, 1.0 to 2.1, and copied rows; writer for 2.0 and 2.1.

Version 2.0 has one bus. SavvyCAN reads it, but not 2.1, and expects PCAN in the head and at least
42 characters in a row.

A time is $STARTTIME plus the row's offset. The start is days since 1899-12-30, rounded to the
resolution of its digits (1 us to 1 ms), and taken as UTC. Without it, times are the offsets.

Source: PEAK-System, "PEAK CAN TRC File Format", version 2.1.1.
"""

import re
from collections.abc import Iterator, Sequence
from functools import lru_cache
from io import TextIOBase
from typing import Final, NamedTuple, final

from motorhil.traces import can_frame
from motorhil.traces.formats import frames as traffic
from motorhil.traces.formats.frames import NS, Findings, Frame
from motorhil.traces.schema import Direction

_DAY_1970: Final = 25_569
_HEADER: Final = re.compile(r";\s*\$(\w+)=(.*)")
_ROW_1: Final = re.compile(
    r"\s*(?:Line\s+\d+:)?\s*\d+\)\s+(-?\d+(?:\.\d+)?)\s+(?:(\d{1,2})\s+)?(?:([A-Z][a-z]+)\s+)?"
    r"([0-9A-Fa-f]{8}|[0-9A-Fa-f]{4})\s+(?:-\s+)?(\d{1,2})(?:\s+(.*)|\s*)$"
)
_WAYS: Final = {"Rx": Direction.RECEIVED, "Tx": Direction.TRANSMITTED}
_KINDS: Final = {  # types of 2.x rows that are frames: (CAN FD, its flags)
    "DT": (False, 0),
    "RR": (False, 0),
    "FD": (True, 0),
    "FB": (True, can_frame.BRS),
    "FE": (True, can_frame.BRS | can_frame.ESI),
    "BI": (True, can_frame.ESI),
}
_OTHER_KINDS: Final = {
    "ST": "the state of the interface",
    "EC": "error counters",
    "ER": "an error frame in PEAK's encoding",
    "EV": "an event",
}
_NAMES: Final = {flags: name for name, (fd, flags) in _KINDS.items() if fd}


def looks_like_trc(line: str) -> bool:
    """Return True for the header of a TRC file, or a row of 1.x."""
    return line.startswith(";$FILEVERSION") or _ROW_1.match(line) is not None


@final
class TrcReader:
    """Reader of rows of all versions; the header states the version."""

    name = "trc"

    def __init__(self) -> None:
        self._start_ns = 0
        self._columns: _Columns | None = None

    def take(self, line: str, findings: Findings) -> Sequence[Frame]:
        """Return the frame of a line. Raises ValueError with the reason if it is unreadable."""
        stripped = line.strip()
        if not stripped:
            return ()
        if stripped.startswith((";", "//", "#")):
            self._header(stripped, findings)
            return ()
        if self._columns is not None:
            return (self._row_2(stripped, self._columns, findings),)
        return (_row_1(stripped, self._start_ns),)

    def _header(self, line: str, findings: Findings) -> None:
        match = _HEADER.match(line)
        if match is None:
            findings.comments += not line.startswith(";")
            return
        key, value = match[1], match[2].strip()
        if key == "STARTTIME":
            self._start_ns = _start_ns(value)
            if not self._start_ns:
                findings.note(
                    "no start time since 1970: times count from the beginning of the recording"
                )
        elif key == "COLUMNS":
            self._columns = None
            self._columns = _Columns.named([column.strip() for column in value.split(",")])

    def _row_2(self, line: str, columns: "_Columns", findings: Findings) -> Frame:
        row = line.split(None, columns.splits)
        told = len(row)
        kind = row[columns.kind] if told > columns.kind else ""
        known = _KINDS.get(kind)
        if known is None:
            raise ValueError(f"not a frame but {_OTHER_KINDS.get(kind, f'a row of type {kind!r}')}")
        if told <= columns.last_needed:
            raise ValueError("ends in the middle")
        can_id = _identifier(row[columns.identifier])
        fd, flags = known
        length = _number(row[columns.length])
        if fd and columns.is_dlc:
            if length > 15:
                raise ValueError(f"DLC {length}")
            length = can_frame.FD_LENGTHS[length]
        if kind == "RR":
            data = can_frame.remote(can_id, length)
        else:
            text = row[columns.data] if told > columns.data else ""
            if not fd and 8 < length < 16 and len(text) > 23:  # a DLC above 8 means 8 bytes
                findings.problem(findings.line, f"after 8 bytes of data there are '{text[24:]}'")
                text = text[:23]
            content = _data(text, length if fd else min(length, 8))
            data = (
                can_frame.flexible(can_id, flags, content)
                if fd
                else can_frame.classic(can_id, content)
            )
        return Frame(
            traffic.log_time(self._start_ns + traffic.decimal_ns(row[columns.offset], 6)),
            _bus(row[columns.bus]) if told > columns.bus else "can0",
            data,
            _WAYS.get(row[columns.way], Direction.UNKNOWN)
            if told > columns.way
            else Direction.UNKNOWN,
        )


_NOWHERE: Final = 1 << 16
"""The place of an absent column: beyond every row."""


class _Columns(NamedTuple):
    """Positions of the columns in a row; `is_dlc`: the length is a DLC."""

    splits: int
    kind: int
    offset: int
    identifier: int
    length: int
    is_dlc: bool
    last_needed: int
    bus: int
    way: int
    data: int

    @staticmethod
    def named(names: list[str]) -> "_Columns":
        """Find the columns by name. Raises ValueError if a mandatory one is missing."""
        at = {name: place for place, name in enumerate(names)}
        length = at.get("l", at.get("L"))
        if length is None or not {"O", "T", "I"} <= set(at):
            raise ValueError("columns without time, type, identifier or length")
        needed = (at["T"], at["O"], at["I"], length)
        others = (at.get(name, _NOWHERE) for name in "BdD")
        return _Columns(len(names) - 1, *needed, "l" not in at, max(needed), *others)


@lru_cache
def _bus(digits: str) -> str:
    return f"can{max(0, _number(digits) - 1)}"


def _row_1(line: str, start_ns: int) -> Frame:
    """Parse a row of 1.0 to 1.3; bus number, type and reserved column can be missing."""
    match = _ROW_1.match(line)
    if match is None:
        raise ValueError("not a frame")
    stamp, bus, kind, digits, count, rest = match.groups()
    if digits.upper() == "FFFFFFFF" or (kind is not None and kind not in _WAYS):
        raise ValueError("not a frame but the state of the interface")
    can_id, length, rest = _identifier(digits), _number(count), (rest or "").strip()
    if rest.startswith("RTR"):
        frame = can_frame.remote(can_id, length)
    else:
        frame = can_frame.classic(can_id, _data(rest, length))
    direction = _WAYS[kind] if kind else Direction.UNKNOWN
    time_ns = traffic.log_time(start_ns + traffic.decimal_ns(stamp, 6))
    return Frame(time_ns, f"can{int(bus or 1) - 1}", frame, direction)


@lru_cache(4096)
def _identifier(digits: str) -> int:
    """Parse an identifier; more than four digits are 29 bit, as PEAK writes it."""
    try:
        can_id = int(digits, 16)
    except ValueError:
        raise ValueError(f"not an identifier: {digits!r}") from None
    if can_id > can_frame.EFF_MASK:
        raise ValueError(f"identifier {digits} has more than 29 bits")
    return can_id | can_frame.EFF if len(digits) > 4 else can_id


def _number(digits: str) -> int:
    if not digits.isdecimal():
        raise ValueError(f"not a number: {digits!r}")
    return int(digits)


def _data(text: str, length: int) -> bytes:
    try:
        data = bytes.fromhex(text)
    except ValueError:
        raise ValueError("the data is not a sequence of bytes") from None
    if len(data) != length:
        raise ValueError(f"{len(data)} of {length} bytes")
    return data


def _start_ns(days: str) -> int:
    """Return the start since 1970 [ns]; 0 if it is unreadable or earlier."""
    whole, _, fraction = days.partition(".")
    if not whole.isdecimal() or not (fraction or "0").isdecimal():
        return 0
    day_ns = 86_400 * NS
    unit = int(10 ** len(fraction))
    round_ns = 1000  # the resolution of the digits, rounded up to a power of ten, at most 1 ms
    while round_ns < min(day_ns // unit, 1_000_000):
        round_ns *= 10
    divisor = unit * round_ns
    since_ns = (int(fraction or 0) * day_ns + divisor // 2) // divisor * round_ns
    return max(0, (int(whole) - _DAY_1970) * day_ns + since_ns)


_ROW_MIN: Final = 42
_HEAD_OF_ONE: Final = (
    ";   Number, offset [ms], type, identifier, direction, length, data",
    ";---+-- ------+------ +- --+----- +- +- +- -- -- -- -- -- -- --",
)
_HEAD_OF_MORE: Final = (
    ";   Number, offset [ms], type, bus, identifier, direction, reserved, length, data",
    ";---+-- ------+------ +- +- --+----- +- +- +--- +- -- -- -- -- -- -- --",
)


def write_trc(
    file: TextIOBase, buses: Sequence[str], first_ns: int, frames: Iterator[Frame]
) -> None:
    """Write a file that starts at the full second of log time `first_ns`.

    Its version is 2.0 if `can0` is the only bus, otherwise 2.1.
    """
    is_one = list(buses) == ["can0"]
    numbers = traffic.bus_numbers(buses)
    start_ns = first_ns // NS * NS
    days, rest_ns = divmod(start_ns, 86_400 * NS)
    # A second is 1/86400 day: 12 digits resolve 0.05 us, and are read to 1 us.
    fraction = (rest_ns // NS * 10**12 + 43_200) // 86_400
    year, month, day = traffic.date_of(start_ns)
    seconds = rest_ns // NS
    clock = f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}.000.0"
    lines = [
        f";$FILEVERSION={'2.0' if is_one else '2.1'}",
        f";$STARTTIME={days + _DAY_1970}.{fraction:012d}",
        f";$COLUMNS={'N,O,T,I,d,l,D' if is_one else 'N,O,T,B,I,d,R,l,D'}",
        ";",
        f";   Start time: {day:02d}.{month:02d}.{year} {clock}",
        ";   Generated by motorhil, in the format of PCAN-View",
        ";-------------------------------------------------------------------------------",
        *(f";   Bus {number}: {bus}" for bus, number in numbers.items()),
        *(_HEAD_OF_ONE if is_one else _HEAD_OF_MORE),
    ]
    file.writelines(line + "\r\n" for line in lines)
    number = 0
    for frame in frames:
        told = can_frame.fields(frame.frame)
        if told.can_id & can_frame.ERR:
            continue
        number += 1
        kind = "RR" if told.can_id & can_frame.RTR else _NAMES[told.flags & 3] if told.fd else "DT"
        digits = f"{told.identifier:0{8 if told.can_id & can_frame.EFF else 4}X}"
        way = "Tx" if frame.direction is Direction.TRANSMITTED else "Rx"
        offset = traffic.decimal(frame.time_ns - start_ns, 3, NS // 1000)
        data = f" {told.data.hex(' ').upper()}" if told.data else ""
        bus, reserved = ("", "") if is_one else (f"{numbers[frame.bus]:2d} ", "-  ")
        row = f"{number:7d} {offset:>13} {kind} {bus}{digits:>8} {way} {reserved}"
        row += f"{told.length:<2d}{data}"
        file.write(f"{row:<{_ROW_MIN if is_one else 0}}\r\n")
