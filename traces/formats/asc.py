"""Reader and writer for Vector ASC files, classic and CAN FD.

Numbers may be decimal or hexadecimal. A time is the sum of the date in the head, taken as UTC, and
the row's time. Without a readable date it is the row's time alone. If the head says "relative",
each row's time counts from the previous row.

Source: Vector, "CAN ASC Logging Files Format Description", 1.16; rows of real files.
"""

import re
from collections.abc import Iterator, Sequence
from io import TextIOBase
from typing import Final, final

from motorhil.traces import can_frame
from motorhil.traces.formats import frames as traffic
from motorhil.traces.formats.frames import NS, Findings, Frame
from motorhil.traces.schema import Direction

_DATE: Final = re.compile(
    r"date\s+\S+\s+(\w+)\.?\s+(\d{1,2})\s+(\d{1,2}):(\d\d):(\d\d)(\.\d+)?\s*([AaPp][Mm])?\s+(\d{4})"
)
_BASE: Final = re.compile(r"base\s+(hex|dec)\s+timestamps\s+(absolute|relative)", re.IGNORECASE)
_SPELLED: Final = (
    "jan",
    "feb",
    "mar|mrz",
    "apr",
    "may|mai",
    "jun",
    "jul",
    "aug",
    "sep",
    "oct|okt",
    "nov",
    "dec|dez",
)
_MONTHS: Final = {  # English, and German where it differs
    name: number for number, names in enumerate(_SPELLED, 1) for name in names.split("|")
}
_NAMES: Final = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")
_DAYS: Final = ("Thu", "Fri", "Sat", "Sun", "Mon", "Tue", "Wed")  # 1970 began with a Thursday
_WAYS: Final = {"Rx": Direction.RECEIVED, "Tx": Direction.TRANSMITTED}
_SILENT: Final = ("//", "internal events", "no internal", "begin trigger", "end trigger")
_EVENTS: Final = ("Start of", "Statistic:", "Status:", "log ", "LIN", "SV:")
_EDL: Final = 0x1000
_BRS_FLAG: Final = 0x2000
_ESI_FLAG: Final = 0x4000
_RTR_FLAG: Final = 0x0010


def looks_like_asc(line: str) -> bool:
    """Return True if the line belongs to the head of an ASC file."""
    return line.startswith("date ") or _BASE.match(line) is not None


@final
class AscReader:
    """Reader of ASC lines; the settings of the head apply to all following rows."""

    name = "asc"

    def __init__(self) -> None:
        self._base = 16
        self._relative = False
        self._start_ns = 0
        self._before_ns = 0

    def take(self, line: str, findings: Findings) -> Sequence[Frame]:
        """Return the frame of a line. Raises ValueError with the reason if it is unreadable."""
        stripped = line.strip()
        if not stripped:
            return ()
        if not stripped[0].isdecimal():
            self._head(stripped, findings)
            return ()
        stamp, _, rest = stripped.partition(" ")
        time_ns = traffic.decimal_ns(stamp)
        if self._relative:
            time_ns += self._before_ns
            self._before_ns = time_ns
        rest = rest.strip()
        frame = self._row(rest, traffic.log_time(time_ns + self._start_ns), findings)
        return () if frame is None else (frame,)

    def _head(self, line: str, findings: Findings) -> None:
        base = _BASE.match(line)
        if base is not None:
            self._base = 16 if base[1].lower() == "hex" else 10
            self._relative = base[2].lower() == "relative"
        elif line.startswith("date "):
            self._start_ns = _date_ns(line)
            if not self._start_ns:
                findings.note(
                    f"no readable date: times count from the beginning of the recording ({line})"
                )
        elif not line.lower().startswith(_SILENT):
            raise ValueError("not a row")
        else:
            findings.comments += line.startswith("//")

    def _row(self, rest: str, time_ns: int, findings: Findings) -> Frame | None:
        parts = rest.split()
        if not parts:
            raise ValueError("ends in the middle")
        if parts[0] == "CANFD":
            return self._fd_row(parts[1:], time_ns)
        if not parts[0].isdecimal():
            if rest.startswith(_EVENTS):
                findings.comments += 1
                return None
            raise ValueError("not a frame but another event")
        bus = _bus(parts[0])
        if len(parts) > 1 and parts[1] == "ErrorFrame":
            findings.note("error frames do not state the cause; read as bus errors")
            way = _WAYS.get(parts[2], Direction.UNKNOWN) if len(parts) > 2 else Direction.UNKNOWN
            return Frame(time_ns, bus, can_frame.classic(can_frame.ERR | 0x80, bytes(8)), way)
        if len(parts) > 1 and parts[1].startswith(_EVENTS):
            findings.comments += 1
            return None
        if len(parts) < 4 or parts[2] not in (*_WAYS, "TxRq") or parts[3] not in ("d", "r"):
            raise ValueError("not a frame" if len(parts) >= 4 else "ends in the middle")
        if parts[2] == "TxRq":
            findings.note("requests to send (TxRq) are not frames, and are omitted")
            return None
        can_id, way = self._identifier(parts[1]), _WAYS[parts[2]]
        if parts[3] == "r":  # the fields behind a remote frame begin with "Length = "
            length = _length(parts[4]) if len(parts) > 4 and parts[4] != "Length" else 0
            return Frame(time_ns, bus, can_frame.remote(can_id, length), way)
        if len(parts) < 5:
            raise ValueError("ends in the middle")
        return Frame(time_ns, bus, self._data_frame(can_id, parts[4], parts[5:], findings), way)

    def _data_frame(self, can_id: int, digits: str, rest: list[str], findings: Findings) -> bytes:
        """Return the frame of a classic row; some tools write CAN FD frames in such rows."""
        length = can_frame.FD_LENGTHS[_length(digits)] if len(digits) == 1 else int(digits, 16)
        size = next((at for at, part in enumerate(rest) if len(part) > 3 or part == "="), len(rest))
        if length <= 8 or (len(digits) == 1 and size < length):
            return can_frame.classic(can_id, self._bytes(rest, min(length, 8)))
        if length not in can_frame.FD_LENGTHS:
            raise ValueError(f"not a DLC: {digits!r}")
        findings.note("some rows have more than 8 bytes; read as CAN FD, without BRS and ESI")
        return can_frame.flexible(can_id, 0, self._bytes(rest, length))

    def _fd_row(self, parts: list[str], time_ns: int) -> Frame:
        if len(parts) < 7 or parts[1] not in _WAYS:
            raise ValueError("ends in the middle" if len(parts) < 7 else "not a frame")
        if parts[2] == "ErrorFrame":
            return Frame(time_ns, _bus(parts[0]), can_frame.classic(can_frame.ERR | 0x80, bytes(8)))
        can_id, way = self._identifier(parts[2]), _WAYS[parts[1]]
        # 4: after a symbolic name
        at = 3 if parts[3] in ("0", "1") and parts[4] in ("0", "1") else 4
        if len(parts) < at + 4:
            raise ValueError("ends in the middle")
        brs, esi, _, size = parts[at : at + 4]
        if not size.isdecimal():
            raise ValueError("data length is missing")
        rest = parts[at + 4 :]
        length = int(size)
        data = self._bytes(rest, length)
        behind = rest[length : length + 3]
        flags = int(behind[2], 16) if len(behind) == 3 else _EDL
        if flags & _RTR_FLAG:
            frame = can_frame.remote(can_id, _length(parts[at + 2]))
        elif flags & _EDL:
            bits = (can_frame.BRS if brs == "1" else 0) | (can_frame.ESI if esi == "1" else 0)
            frame = can_frame.flexible(can_id, bits, data)
        else:
            frame = can_frame.classic(can_id, data)
        return Frame(time_ns, _bus(parts[0]), frame, way)

    def _identifier(self, digits: str) -> int:
        extended = digits[-1:] in ("x", "X")
        try:
            can_id = int(digits[:-1] if extended else digits, self._base)
        except ValueError:
            raise ValueError(f"not an identifier: {digits!r}") from None
        if not 0 <= can_id <= (can_frame.EFF_MASK if extended else can_frame.SFF_MASK):
            raise ValueError(f"identifier {digits} is too large")
        return can_id | can_frame.EFF if extended else can_id

    def _bytes(self, parts: list[str], length: int) -> bytes:
        if len(parts) < length:
            raise ValueError(f"{len(parts)} of {length} bytes")
        try:
            return bytes(int(part, self._base) for part in parts[:length])
        except ValueError:
            raise ValueError("the data is not a sequence of bytes") from None


def _bus(channel: str) -> str:
    if not channel.isdecimal():
        raise ValueError(f"not a channel: {channel!r}")
    return f"can{max(0, int(channel) - 1)}"


def _length(digit: str) -> int:
    """Return a DLC, which is one hexadecimal digit in any base."""
    if len(digit) != 1:
        raise ValueError(f"not a DLC: {digit!r}")
    return int(digit, 16)


def _date_ns(line: str) -> int:
    """Return the time since 1970 [ns]; 0 if it is unreadable."""
    match = _DATE.match(line)
    month = _MONTHS.get(match[1][:3].lower()) if match else None
    if match is None or month is None:
        return 0
    hours = int(match[3])
    if match[7]:
        hours = hours % 12 + (12 if match[7].lower() == "pm" else 0)
    seconds = (hours * 60 + int(match[4])) * 60 + int(match[5])
    of_day_ns = traffic.decimal_ns(f"{seconds}{match[6] or ''}")
    return max(0, traffic.date_ns(int(match[8]), month, int(match[2])) + of_day_ns)


def write_asc(
    file: TextIOBase, buses: Sequence[str], first_ns: int, places: int, frames: Iterator[Frame]
) -> None:
    """Write a file whose date is the full second of log time `first_ns`."""
    numbers = traffic.bus_numbers(buses)
    start_ns = first_ns // NS * NS
    year, month, day = traffic.date_of(start_ns)
    seconds = start_ns // NS % 86_400
    date = (
        f"{_DAYS[start_ns // NS // 86_400 % 7]} {_NAMES[month - 1]} {day:02d} "
        f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}.000 {year}"
    )
    file.write(f"date {date}\nbase hex  timestamps absolute\ninternal events logged\n")
    file.write(f"// version 9.0.0\nBegin Triggerblock {date}\n0.000000 Start of measurement\n")
    for frame in frames:
        stamp = traffic.decimal(frame.time_ns - start_ns, places)
        file.write(f"{stamp:>11} {_row(frame, numbers[frame.bus])}\n")
    file.write("End TriggerBlock\n")


def _row(frame: Frame, channel: int) -> str:
    told = can_frame.fields(frame.frame)
    way = "Tx" if frame.direction is Direction.TRANSMITTED else "Rx"
    digits = f"{told.identifier:X}{'x' if told.can_id & can_frame.EFF else ''}"
    data = told.data.hex(" ").upper()
    if told.can_id & can_frame.ERR:
        return f"{channel}  ErrorFrame"
    if told.can_id & can_frame.RTR:
        return f"{channel}  {digits:<15} {way}   r {told.length:x}"
    if not told.fd:
        return f"{channel}  {digits:<15} {way}   d {told.length:x} {data}".rstrip()
    brs, esi = told.flags & can_frame.BRS, (told.flags & can_frame.ESI) >> 1
    dlc = can_frame.dlc(told.length)
    flags = _EDL | (_BRS_FLAG if brs else 0) | (_ESI_FLAG if esi else 0)
    head = f"CANFD {channel:3d} {way} {digits:>10} {'':>33}{brs} {esi} {dlc:x} {told.length:2d}"
    # after the data: duration, length in bits, flags, CRC, bit timing; only the flags are known
    return f"{head} {data}{' ' if data else ''}       0    0 {flags:8X}        0 0 0 0 0"
