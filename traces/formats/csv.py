"""CSV formats: ours (complete frames), python-can's and SavvyCAN's.

  time_s,bus,id,extended,kind,brs,esi,direction,sender,length,data
  12.000000001,can0,181,0,data,0,0,received,left,2,0102

Columns are found by name, so additional columns are allowed.

Source: python-can 4.6.1, can/io/csv.py; SavvyCAN, framefileio.cpp (GVRET logs, times in us).
"""

import base64
import binascii
import csv
from collections.abc import Callable, Iterator, Sequence
from io import StringIO, TextIOBase
from typing import Final, final

from motorhil.traces import can_frame
from motorhil.traces.formats import frames as traffic
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.schema import Direction

COLUMNS: Final = (
    "time_s bus id extended kind brs esi direction sender length data".split()  # noqa: SIM905
)
_PYTHON_CAN: Final = ("timestamp", "arbitration_id", "extended", "remote", "error", "dlc", "data")
_SAVVYCAN: Final = ("time stamp", "id", "extended", "bus", "len")
_WAYS: Final = {
    "": Direction.UNKNOWN,
    "unknown": Direction.UNKNOWN,
    "received": Direction.RECEIVED,
    "transmitted": Direction.TRANSMITTED,
}
_SAVVY_WAYS: Final = {"rx": Direction.RECEIVED, "tx": Direction.TRANSMITTED}
_YES: Final = {"0": False, "1": True, "false": False, "true": True}
Row = dict[str, str]


def _dialect(line: str) -> tuple[list[str], Callable[[Row], Frame]] | None:
    """Return column names and row reader for a table's head; None if the table is unknown."""
    columns = [name.strip().lower() for name in line.strip().lstrip("\ufeff").split(",")]
    for needed, take in ((COLUMNS, _ours), (_PYTHON_CAN, _python_can), (_SAVVYCAN, _savvycan)):
        if set(needed) <= set(columns):
            return columns, take
    return None


def looks_like_csv(line: str) -> bool:
    """Return True for the head of a known table."""
    return _dialect(line) is not None


@final
class CsvReader:
    """Reader of a table's head and rows."""

    name = "csv"

    def __init__(self) -> None:
        self._columns: list[str] = []
        self._take: Callable[[Row], Frame] = _ours

    def take(self, line: str, findings: Findings) -> Sequence[Frame]:
        """Return the frame of a line. Raises ValueError with the reason if it is unreadable."""
        if not line.strip():
            return ()
        if not self._columns:
            found = _dialect(line)
            if found is None:
                raise ValueError("not the head of a known table")
            self._columns, self._take = found
            return ()
        try:
            parts = next(csv.reader([line.rstrip("\r\n")], strict=True))
        except csv.Error as error:
            raise ValueError(str(error)) from None
        row = {
            name: part if name == "sender" else part.strip()
            for name, part in zip(self._columns, parts, strict=False)
        }
        try:
            return (self._take(row),)
        except KeyError as missing:
            name = str(missing.args[0])
            what = "ends in the middle" if name in self._columns else f"invalid value: {name!r}"
            raise ValueError(what) from None


def _hexadecimal(text: str) -> int:
    try:
        return int(text, 16)
    except ValueError:
        raise ValueError(f"not an identifier: {text!r}") from None


def _can_id(text: str, extended: bool) -> int:
    can_id = _hexadecimal(text)
    if not 0 <= can_id <= (can_frame.EFF_MASK if extended else can_frame.SFF_MASK):
        raise ValueError(f"identifier {text} is too large")
    return can_id | can_frame.EFF if extended else can_id


def _number(text: str) -> int:
    if not text.isdecimal():
        raise ValueError(f"not a number: {text!r}")
    return int(text)


def _ours(row: Row) -> Frame:
    kind, direction = row["kind"], _WAYS[row["direction"]]
    time_ns = traffic.decimal_ns(row["time_s"])
    bus, sender = row["bus"].removeprefix("'"), row["sender"].removeprefix("'")
    if kind == "error":
        can_id = _can_id(row["id"], True) & ~can_frame.EFF | can_frame.ERR
    else:
        can_id = _can_id(row["id"], _YES[row["extended"]])
    length = _number(row["length"])
    try:
        data = bytes.fromhex(row["data"])
    except ValueError:
        raise ValueError("the data is not a sequence of bytes") from None
    if kind != "remote" and len(data) != length:
        raise ValueError(f"{len(data)} of {length} bytes")
    flags = (can_frame.BRS if _YES[row["brs"]] else 0) | (can_frame.ESI if _YES[row["esi"]] else 0)
    if kind == "remote":
        frame = can_frame.remote(can_id, length)
    elif kind == "fd":
        frame = can_frame.flexible(can_id, flags, data)
    elif kind in ("data", "error"):
        frame = can_frame.classic(can_id, data)
    else:
        raise ValueError(f"not a kind of frame: {kind!r}")
    return Frame(time_ns, bus, frame, direction, sender)


def _python_can(row: Row) -> Frame:
    try:
        data = base64.b64decode(row["data"], validate=True)
    except binascii.Error:
        raise ValueError("the data is not base64") from None
    can_id = _can_id(row["arbitration_id"], _YES[row["extended"].lower()])
    if _YES[row["error"].lower()]:
        frame = can_frame.classic(can_frame.ERR | can_id & can_frame.EFF_MASK, data.ljust(8, b"\0"))
    elif _YES[row["remote"].lower()]:
        frame = can_frame.remote(can_id, _number(row["dlc"]))
    elif len(data) > 8:
        frame = can_frame.flexible(can_id, 0, data)
    else:
        frame = can_frame.classic(can_id, data)
    return Frame(traffic.decimal_ns(row["timestamp"]), "can0", frame)


def _savvycan(row: Row) -> Frame:
    length = _number(row["len"])
    data = bytes(_byte(row[f"d{n}"]) for n in range(1, length + 1))
    if _hexadecimal(row["id"]) & ~can_frame.EFF_MASK == can_frame.ERR:  # of SocketCAN
        frame = can_frame.classic(_hexadecimal(row["id"]), data.ljust(8, b"\0"))
    else:
        can_id = _can_id(row["id"], _YES[row["extended"].lower()])
        frame = (
            can_frame.classic(can_id, data) if length <= 8 else can_frame.flexible(can_id, 0, data)
        )
    direction = _SAVVY_WAYS.get(row.get("dir", "").lower(), Direction.UNKNOWN)
    bus = f"can{_number(row['bus'])}"
    return Frame(traffic.decimal_ns(row["time stamp"], 3), bus, frame, direction)


def _byte(text: str) -> int:
    value = _hexadecimal(text)
    if not 0 <= value <= 255:
        raise ValueError(f"not a byte: {text}")
    return value


def _text(cell: str) -> str:
    """Return a name as a cell that a spreadsheet does not take for a formula.

    The mark is a leading apostrophe, which names that begin with one get, too.
    """
    return f"'{cell}" if cell.startswith(("=", "+", "-", "@", "'", "\t", "\r")) else cell


def write_csv(file: TextIOBase, places: int, frames: Iterator[Frame]) -> None:
    """Write our own table."""
    buffer = StringIO()
    rows = csv.writer(buffer, lineterminator="\n")
    file.write(",".join(COLUMNS) + "\n")
    for frame in frames:
        told = can_frame.fields(frame.frame)
        kind = "fd" if told.fd else "data"
        if told.can_id & can_frame.ERR:
            kind = "error"
        elif told.can_id & can_frame.RTR:
            kind = "remote"
        rows.writerow(
            (
                traffic.decimal(frame.time_ns, places),
                _text(traffic.one_word(frame.bus)),
                f"{told.identifier:X}",
                int(told.can_id & can_frame.EFF != 0),
                kind,
                int(told.flags & can_frame.BRS != 0),
                int(told.flags & can_frame.ESI != 0),
                frame.direction.name.lower(),
                _text(frame.sender),
                told.length,
                told.data.hex(),
            )
        )
        file.write(buffer.getvalue())
        buffer.seek(0)
        buffer.truncate()
