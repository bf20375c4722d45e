"""CAN frames in MDF 4 files with bus events, which asammdf reads (extra `mf4`).

Data, error and remote frames are groups of their own; they are merged by time. Times are floats
since the file's start, so they are exact to about 1 ns in files of some days.

Source: ASAM MDF 4, associated standard "Bus Logging": CAN_DataFrame, CAN_ErrorFrame,
CAN_RemoteFrame; python-can 4.6.1, can/io/mf4.py.
"""

import heapq
from collections.abc import Iterator
from typing import Any, Final

from motorhil.traces import can_frame
from motorhil.traces.errors import TraceError
from motorhil.traces.files import open_content
from motorhil.traces.formats.frames import NS, Findings, Frame
from motorhil.traces.schema import Direction

MAGIC: Final = b"MDF     4"
_KINDS: Final = ("CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame")
_HEAD_AT: Final = 64  # behind the identification block
_RECORDS: Final = 4096  # read at once
_TRANSMITTED: Final = (1, b"Tx", "Tx")


def mf4_frames(path: str, findings: Findings) -> Iterator[Frame]:
    """Yield the frames of an MDF file by time.

    Raises:
        TraceError: asammdf is not installed, or the file cannot be read.
    """
    try:
        from asammdf import MDF
    except ImportError:
        remedy = "pip install 'motorhil[mf4]', or convert it to ASC or BLF"
        raise TraceError(path, "is an MDF 4 file, which asammdf reads", remedy=remedy) from None
    with open_content(path, lambda text: findings.problem(0, text)) as content:
        if content.read(_HEAD_AT + 4)[_HEAD_AT:] != b"##HD":
            raise TraceError(path, f"is not a readable MDF 4 file: no head at byte {_HEAD_AT}")
        content.seek(0)
        try:
            # Its types depend on the file.
            mdf: Any = MDF(content)
        except Exception as error:  # asammdf has no common base of its errors
            told = " ".join(str(error).split()) or type(error).__name__
            raise TraceError(path, f"is not a readable MDF 4 file: {told}") from error
        try:
            start_ns = max(0, round(mdf.header.start_time.timestamp() * 1e6) * 1000)
            groups = [
                _group(mdf, number, kind, start_ns, findings)
                for number, group in enumerate(mdf.groups)
                for kind in _KINDS
                if any(channel.name == kind for channel in group.channels)
            ]
            if not groups:
                findings.note("it has signals, but no CAN frames (bus events)")
            yield from heapq.merge(*groups, key=lambda frame: frame.time_ns)
        finally:
            mdf.close()


def _group(mdf: Any, number: int, kind: str, start_ns: int, findings: Findings) -> Iterator[Frame]:
    count = mdf.groups[number].channel_group.cycles_nr
    for offset in range(0, count, _RECORDS):
        signal = mdf.get(kind, number, record_offset=offset, record_count=_RECORDS)
        prefix = f"{kind}."
        columns: dict[str, list[Any]] = {
            name.removeprefix(prefix): signal.samples[name].tolist()
            for name in signal.samples.dtype.names
        }
        for at, seconds in enumerate(signal.timestamps.tolist()):
            row = {name: values[at] for name, values in columns.items()}
            try:
                frame = _frame(kind, row)
            except (ValueError, KeyError) as error:
                findings.problem(offset + at + 1, f"{kind} {offset + at + 1}: {error}")
                continue
            way = Direction.UNKNOWN
            if "Dir" in row:
                sent = row["Dir"] in _TRANSMITTED
                way = Direction.TRANSMITTED if sent else Direction.RECEIVED
            bus = f"can{max(0, int(row.get('BusChannel', 1)) - 1)}"
            yield Frame(start_ns + round(seconds * NS), bus, frame, way)


def _frame(kind: str, row: dict[str, Any]) -> bytes:
    can_id = int(row.get("ID", 0)) & can_frame.EFF_MASK
    length = int(row.get("DataLength", 0))
    data = bytes(row.get("DataBytes", ()))[:length]
    if kind == "CAN_ErrorFrame":
        return can_frame.classic(can_frame.ERR | (can_id or 0x80), data[:8].ljust(8, b"\0"))
    if int(row.get("IDE", can_id > can_frame.SFF_MASK)):
        can_id |= can_frame.EFF
    if kind == "CAN_RemoteFrame":
        return can_frame.remote(can_id, int(row["DLC"]))
    if len(data) < length:
        raise ValueError(f"{len(data)} of {length} bytes")
    if int(row.get("EDL", length > 8)):
        flags = can_frame.BRS * bool(row.get("BRS")) | can_frame.ESI * bool(row.get("ESI"))
        return can_frame.flexible(can_id, flags, data)
    return can_frame.classic(can_id, data)
