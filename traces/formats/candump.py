"""Reader and writer for the output of `candump`; reader for rows of car loggers.

candump's rows are read with and without `-L`, as people keep them: without time stamps, with dates,
without an interface, with comments after the rows or a command line before them, with two rows in
one line, or cut in the middle of a row.

Some car loggers write milliseconds, "x", identifier and data, all in hexadecimal. Only the value of
an identifier shows if it has 11 or 29 bits:

  000000ADx089A0C020000000000000000

Source: can-utils, candump.c and lib.c (`sprint_canframe`, `sprint_long_canframe`); recordings of UW
Formula Motorsports.
"""

import re
from collections.abc import Sequence
from typing import Final, final

from motorhil.traces import can_frame
from motorhil.traces.formats import frames as traffic
from motorhil.traces.formats.frames import Findings, Frame, shown
from motorhil.traces.schema import Direction

_BUS: Final = "can0"  # default without an interface
_LOG: Final = re.compile(
    r"\s*\((\d+(?:\.\d*)?)\)\s+(\S+)\s+([0-9A-Fa-f]+)#([^\s(]*)(?:\s+([RT])(?=\s|$))?\s*(.*)"
)
_PLAIN: Final = re.compile(
    r"\s*(?:\(([^()]*)\)\s+)?(?:(\S+)\s+)?(?:(RX|TX)\s+([-B])\s+([-E])\s+)?"
    r"([0-9A-Fa-f]{1,8})\s+\[(\d+)\](?:\s+(.*)|\s*)$"
)
_DATE: Final = re.compile(r"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)(\.\d+)?")
_BYTE: Final = re.compile(r"([0-9A-Fa-f]{2})(?:\s+|$)")
_ROW_BEHIND: Final = re.compile(r"(?:\(|\S+\s+[0-9A-Fa-f]{3,8}\s+\[\d)")
_REMOTE: Final = re.compile(r"([0-8])?(?:_([9A-Fa-f]))?$")
_SD_ROW: Final = re.compile(r"([0-9A-Fa-f]{8})x([0-9A-Fa-f]{8})((?:[0-9A-Fa-f]{2}){0,8})$")
_COMMENT: Final = ("#", "//", ";")
_WAYS: Final = {"R": Direction.RECEIVED, "T": Direction.TRANSMITTED}


def looks_like_log(line: str) -> bool:
    """Return True for a row of `candump -L`."""
    return _LOG.match(line) is not None


def looks_plain(line: str) -> bool:
    """Return True for a row of `candump`."""
    return _PLAIN.match(line) is not None


@final
class CandumpReader:
    """Reader of candump's rows of both kinds, also mixed."""

    name = "candump"

    def __init__(self) -> None:
        self._after_error = False

    def take(self, line: str, findings: Findings) -> Sequence[Frame]:
        """Return the frames of a line. Raises ValueError with the reason if it is unreadable."""
        stripped = line.strip()
        if not stripped or stripped.startswith(_COMMENT):
            findings.comments += bool(stripped)
            return ()
        if self._after_error and line.startswith("\t"):
            return ()  # candump -e: the error frame's meaning in words
        match = _LOG.match(line)
        if match is not None:
            frame, rest = self._log_row(match), match[6]
            return self._with_rest([frame], rest, findings)
        match = _PLAIN.match(line)
        if match is None:
            raise ValueError("not a frame")
        return self._plain_row(match, findings)

    def _with_rest(self, found: list[Frame], rest: str, findings: Findings) -> list[Frame]:
        """Handle the text after a row: nothing, a comment, or another row."""
        self._after_error = bool(can_frame.fields(found[-1].frame).can_id & can_frame.ERR)
        if not rest or rest in ("ERRORFRAME",) or rest.startswith("'"):
            return found
        if _ROW_BEHIND.match(rest):
            try:
                behind = self.take(rest, findings)
            except ValueError as error:
                findings.problem(
                    findings.line, f"{error}, in a second row on the line: {shown(rest)}"
                )
            else:
                findings.note("some lines hold more than one row")
                found.extend(behind)
            return found
        findings.comments += 1
        return found

    def _log_row(self, match: re.Match[str]) -> Frame:
        stamp, bus, digits, body, way, _ = match.groups()
        if len(digits) not in (3, 8):
            raise ValueError(f"an identifier of {len(digits)} digits, not 3 or 8")
        can_id = traffic.identifier(digits)
        time_ns = traffic.decimal_ns(stamp)
        return Frame(time_ns, bus, _log_frame(can_id, body), _WAYS.get(way, Direction.UNKNOWN))

    def _plain_row(self, match: re.Match[str], findings: Findings) -> list[Frame]:
        stamp, bus, way, brs, esi, digits, count, rest = match.groups()
        can_id, length, rest = traffic.identifier(digits), int(count), rest or ""
        fd = len(count) > 1
        if rest.startswith("remote request"):
            frame, rest = can_frame.remote(can_id, length), rest[len("remote request") :].strip()
        else:
            data, rest = _bytes(rest, length)
            flags = (can_frame.BRS if brs == "B" else 0) | (can_frame.ESI if esi == "E" else 0)
            frame = (
                can_frame.flexible(can_id, flags, data) if fd else can_frame.classic(can_id, data)
            )
            if fd and brs is None:
                findings.note("BRS and ESI of CAN FD frames are not stated; read as not set")
        time_ns = _stamp_ns(stamp) if stamp else 0
        if not stamp:
            findings.unstamped += 1
        direction = _WAYS[way[0]] if way else Direction.UNKNOWN
        return self._with_rest([Frame(time_ns, bus or _BUS, frame, direction)], rest, findings)


def _bytes(text: str, length: int) -> tuple[bytes, str]:
    """Return `length` bytes, and the text after them."""
    if length > 64:
        raise ValueError(f"{length} bytes in a frame")
    if len(text.rstrip()) == 3 * length - 1:  # fast path for most rows
        try:
            data = bytes.fromhex(text)
        except ValueError:
            data = b""
        if len(data) == length:
            return data, ""
    out, at = bytearray(), 0
    while len(out) < length:
        match = _BYTE.match(text, at)
        if match is None:
            raise ValueError(f"{len(out)} of {length} bytes")
        out.append(int(match[1], 16))
        at = match.end()
    rest = text[at:].strip()
    if _BYTE.match(rest):
        raise ValueError(f"more than {length} bytes")
    return bytes(out), rest


def _stamp_ns(text: str) -> int:
    match = _DATE.fullmatch(text.strip())
    if match is None:
        return traffic.decimal_ns(text.strip())
    year, month, day, hours, minutes, seconds = (int(match[n]) for n in range(1, 7))
    whole = (hours * 60 + minutes) * 60 + seconds
    day_ns = traffic.date_ns(year, month, day)
    if day_ns < 0:
        raise ValueError("a time before 1970")
    return day_ns + traffic.decimal_ns(f"{whole}{match[7] or ''}")


def _log_frame(can_id: int, body: str) -> bytes:
    """Return the frame described by the text after "#"."""
    if body.startswith("#"):
        if len(body) < 2:
            raise ValueError("a CAN FD frame without flags")
        return can_frame.flexible(can_id, int(body[1], 16), _packed(body[2:]))
    if body[:1] in ("R", "r"):
        match = _REMOTE.match(body[1:])
        if match is None:
            raise ValueError("a remote frame with an invalid length")
        return can_frame.remote(can_id, int(match[1] or 0))
    if ":" in body:
        raise ValueError("a CAN XL frame")
    return can_frame.classic(can_id, _packed(body.partition("_")[0]))


def _packed(digits: str) -> bytes:
    try:
        return bytes.fromhex(digits.replace(".", ""))
    except ValueError:
        raise ValueError("an incomplete byte") from None


def plain_row(frame: Frame, places: int = 6) -> str:
    """Return a row of `candump -t a -x`; an unknown direction becomes RX."""
    told = can_frame.fields(frame.frame)
    fd = told.fd
    way = "TX" if frame.direction is Direction.TRANSMITTED else "RX"
    brs = "B" if fd and told.flags & can_frame.BRS else "-"
    esi = "E" if fd and told.flags & can_frame.ESI else "-"
    count = f"{told.length:02d}" if fd else str(told.length)
    data = "remote request" if told.can_id & can_frame.RTR else told.data.hex(" ").upper()
    if told.can_id & can_frame.ERR:
        data += "   ERRORFRAME"
    bus = traffic.one_word(frame.bus)
    head = f" ({_stamp(frame.time_ns, places)})  {bus}  {way} {brs} {esi}  {_digits(told)}"
    return f"{head}   [{count}]  {data}".rstrip() + "\n"


def _digits(told: can_frame.Fields) -> str:
    if told.can_id & can_frame.ERR:
        return f"{told.identifier | can_frame.ERR:08X}"
    return f"{told.identifier:0{8 if told.can_id & can_frame.EFF else 3}X}"


def _stamp(time_ns: int, places: int) -> str:
    whole, _, fraction = traffic.decimal(time_ns, places).partition(".")
    return f"{whole:0>10}.{fraction}"


def marked_row(frame: Frame, places: int = 6) -> str:
    """Return a row of `candump -L -x`, whose mark of direction other programs may not read."""
    way = {Direction.RECEIVED: " R", Direction.TRANSMITTED: " T"}.get(frame.direction, "")
    return f"{log_row(frame, places)[:-1]}{way}\n"


def log_row(frame: Frame, places: int = 6) -> str:
    """Return a row of `candump -L`, with microseconds, or with nanoseconds like -N."""
    told = can_frame.fields(frame.frame)
    can_id = told.can_id
    if can_id & can_frame.RTR:
        body = f"R{told.length}" if told.length else "R"
    elif told.fd:
        body = f"#{told.flags & 3:X}{told.data.hex().upper()}"
    else:
        body = told.data.hex().upper()
    bus = traffic.one_word(frame.bus)
    return f"({_stamp(frame.time_ns, places)}) {bus} {_digits(told)}#{body}\n"


def looks_like_sd_rows(line: str) -> bool:
    """Return True for a row of a car logger."""
    return _SD_ROW.match(line.strip()) is not None


@final
class SdRowReader:
    """Reader of rows of car loggers."""

    name = "sd-rows"

    def take(self, line: str, findings: Findings) -> Sequence[Frame]:
        """Return the frame of a line. Raises ValueError with the reason if it is unreadable."""
        stripped = line.strip()
        if not stripped:
            return ()
        match = _SD_ROW.match(stripped)
        if match is None:
            raise ValueError("not a frame")
        findings.note(
            "identifiers up to 7FFh are read as 11 bits; the rows do not state the format"
        )
        can_id = int(match[2], 16)
        if can_id > can_frame.EFF_MASK:
            raise ValueError(f"identifier {match[2]} has more than 29 bits")
        if can_id > can_frame.SFF_MASK:
            can_id |= can_frame.EFF
        frame = can_frame.classic(can_id, bytes.fromhex(match[3]))
        return (Frame(int(match[1], 16) * 1_000_000, "can0", frame),)
