"""CAN frames in MDF 4 files with bus events, by asammdf (extra `mf4`).

Data, error and remote frames are groups of their own, each sorted by time; readers merge them.
Times since the file's start are written as whole nanoseconds with a factor of 1e-9. Files of other
tools can have floats, which are exact to about 1 ns in files of some days.

Source: ASAM MDF 4, associated standard "Bus Logging": CAN_DataFrame, CAN_ErrorFrame,
CAN_RemoteFrame; python-can 4.6.1, can/io/mf4.py.
"""

import heapq
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, BinaryIO, Final, final

from motorhil.traces import can_frame
from motorhil.traces.errors import TraceError
from motorhil.traces.files import MEMORY_MAX, open_content
from motorhil.traces.formats.frames import NS, Findings, Frame, bus_numbers, log_time
from motorhil.traces.schema import Direction

MAGIC: Final = b"MDF     4"
_KINDS: Final = ("CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame")
_HEAD_AT: Final = 64  # behind the identification block
_RECORDS: Final = 4096  # read at once
_TRANSMITTED: Final = (1, b"Tx", "Tx")
_LOCAL_TIME: Final = 1  # time flag of the head: the zone is not known
_UTC: Final = 2  # time flag of the head: the offset to UTC is valid
_VERSION: Final = "4.10"
_COMPRESSION: Final = 2  # transposition and DEFLATE
_HISTORY: Final = (
    "<FHcomment><TX>converted</TX><tool_id>motorhil</tool_id><tool_vendor>motorhil</tool_vendor>"
    "<tool_version/></FHcomment>"
)
_FACTOR: Final = 1e-9


def mf4_frames(path: str, findings: Findings, memory_max: int = MEMORY_MAX) -> Iterator[Frame]:
    """Yield the frames of an MDF file by time.

    Raises:
        TraceError: asammdf is not installed, or the file cannot be read.
    """
    remedy = "pip install 'motorhil[mf4]', or convert it to ASC or BLF"
    asammdf = _library(path, "is an MDF 4 file, which asammdf reads", remedy)
    with open_content(path, lambda text: findings.problem(0, text), memory_max) as content:
        if content.read(_HEAD_AT + 4)[_HEAD_AT:] != b"##HD":
            raise TraceError(path, f"is not a readable MDF 4 file: no head at byte {_HEAD_AT}")
        content.seek(0)
        try:
            mdf = asammdf.MDF(content)
        except Exception as error:  # asammdf has no common base of its errors
            told = " ".join(str(error).split()) or type(error).__name__
            raise TraceError(path, f"is not a readable MDF 4 file: {told}") from error
        try:
            start_ns = _start_ns(mdf.header)
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


def _library(path: str, what: str, remedy: str) -> Any:
    """Return the module asammdf, whose types depend on the file.

    Raises:
        TraceError: it is not installed.
    """
    try:
        import asammdf
    except ImportError:
        raise TraceError(path, what, remedy=remedy) from None
    return asammdf


def _start_ns(header: Any) -> int:
    if header.time_flags & _LOCAL_TIME:
        return max(0, round(float(header.start_time.timestamp()) * 1e6) * 1000)
    return int(header.abs_time)


def _group(mdf: Any, number: int, kind: str, start_ns: int, findings: Findings) -> Iterator[Frame]:
    count = mdf.groups[number].channel_group.cycles_nr
    for offset in range(0, count, _RECORDS):
        signal = mdf.get(kind, number, record_offset=offset, record_count=_RECORDS)
        prefix = f"{kind}."
        columns: dict[str, list[Any]] = {
            name.removeprefix(prefix): signal.samples[name].tolist()
            for name in signal.samples.dtype.names
        }
        since_ns = _since_ns(mdf, number, offset, signal.timestamps)
        for at, after_ns in enumerate(since_ns):
            row = {name: values[at] for name, values in columns.items()}
            try:
                time_ns = log_time(start_ns + after_ns)
                frame = _frame(kind, row)
            except (ValueError, KeyError) as error:
                findings.problem(offset + at + 1, f"{kind} {offset + at + 1}: {error}")
                continue
            way = Direction.UNKNOWN
            if "Dir" in row:
                sent = row["Dir"] in _TRANSMITTED
                way = Direction.TRANSMITTED if sent else Direction.RECEIVED
            bus = f"can{max(0, int(row.get('BusChannel', 1)) - 1)}"
            yield Frame(time_ns, bus, frame, way)


def _since_ns(mdf: Any, number: int, offset: int, seconds: Any) -> list[int]:
    """Return times since the start, from whole nanoseconds if the file has these."""
    at = mdf.masters_db[number]
    conversion = mdf.groups[number].channels[at].conversion
    if conversion is not None and (conversion["a"], conversion["b"]) == (_FACTOR, 0):
        raw, _ = mdf.get(
            group=number,
            index=at,
            raw=True,
            samples_only=True,
            record_offset=offset,
            record_count=_RECORDS,
        )
        if raw.dtype.kind in "iu":
            return list(raw.tolist())
    return [round(one * NS) for one in seconds.tolist()]


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


def require_writer(target: str) -> Any:
    """Return asammdf, for writing.

    Raises:
        TraceError: it is not installed.
    """
    remedy = "pip install 'motorhil[mf4]', or write blf"
    return _library(target, "cannot be written without asammdf", remedy)


def order_key(frame: Frame) -> tuple[int, int]:
    """Return the key of the order in which readers of MDF files return these frames."""
    can_id = int.from_bytes(frame.frame[:4], "little")
    return frame.time_ns, 1 if can_id & can_frame.ERR else 2 if can_id & can_frame.RTR else 0


def write_mf4(
    file: BinaryIO,
    buses: Sequence[str],
    start_ns: int,
    data_max: int,
    frames: Iterable[Frame],
) -> None:
    """Write an MDF 4 file of bus events; asammdf keeps the frames in a temporary file meanwhile.

    Args:
        file: the file, empty and seekable.
        buses: their names.
        start_ns: the earliest log time.
        data_max: the most bytes of data in a frame: 8, or 64 with CAN FD.
        frames: the frames, in the order of `order_key`.

    Raises:
        TraceError: asammdf is not installed.
    """
    asammdf = require_writer(file.name)
    from asammdf.blocks.v4_blocks import FileHistory

    mdf = asammdf.MDF(version=_VERSION)
    try:
        head = mdf.header
        head.abs_time, head.time_flags, head.tz_offset = start_ns, _UTC, 0
        head.daylight_save_time = 0
        history = FileHistory()
        history.comment, history.abs_time, history.time_flags = _HISTORY, start_ns, _UTC
        mdf.file_history.append(history)
        channels = bus_numbers(buses)
        groups = [_Group(asammdf, mdf, kind, channels, data_max) for kind in _KINDS]
        for frame in frames:
            groups[order_key(frame)[1]].add(frame, start_ns)
        for group in groups:
            group.flush()
        mdf.save(file, compression=_COMPRESSION, add_history_block=False)
    finally:
        mdf.close()


@final
class _Group:
    """The frames of one kind, as rows of one size."""

    def __init__(
        self, asammdf: Any, mdf: Any, kind: str, channels: Mapping[str, int], data_max: int
    ) -> None:
        import numpy
        from asammdf.blocks.conversion_utils import from_dict

        self._mdf = mdf
        self._number = len(mdf.groups)
        self._channels = channels
        self._times_ns: list[int] = []
        self._rows: list[bytes] = []
        bus = "B" if max(channels.values(), default=0) < 256 else "H"
        names = ("BusChannel", "ID", "IDE", "DLC", "DataLength", "Dir", "EDL", "BRS", "ESI")
        codes = (bus, *"IBBBBBBB")
        self._pack = struct.Struct(f"<{''.join(codes)}{data_max}s").pack
        self._dtype = numpy.dtype(
            [
                (f"{kind}.{name}", f"<u{struct.calcsize(code)}")
                for name, code in zip(names, codes, strict=True)
            ]
            + [(f"{kind}.DataBytes", f"({data_max},)u1")]
        )
        source = asammdf.Source(
            "CAN", "CAN", "", asammdf.Source.SOURCE_BUS, asammdf.Source.BUS_TYPE_CAN
        )
        mdf.append(asammdf.Signal(*self._taken(), name=kind, source=source))
        mdf.groups[self._number].channels[0].conversion = from_dict({"a": _FACTOR, "b": 0})

    def add(self, frame: Frame, start_ns: int) -> None:
        """Add a frame."""
        told = can_frame.fields(frame.frame)
        remote, error = told.can_id & can_frame.RTR, told.can_id & can_frame.ERR
        self._times_ns.append(frame.time_ns - start_ns)
        self._rows.append(
            self._pack(
                self._channels[frame.bus],
                told.can_id & can_frame.EFF_MASK,
                bool(told.can_id & can_frame.EFF) and not error,
                can_frame.dlc(told.length),
                0 if remote else told.length,
                frame.direction is Direction.TRANSMITTED,
                told.fd,
                bool(told.flags & can_frame.BRS),
                bool(told.flags & can_frame.ESI),
                told.data,
            )
        )
        if len(self._rows) >= _RECORDS:
            self.flush()

    def flush(self) -> None:
        """Give the frames to asammdf."""
        if self._rows:
            samples, times = self._taken()
            self._mdf.extend(self._number, [(times, None), (samples, None)])

    def _taken(self) -> tuple[Any, Any]:
        import numpy

        rows, times = b"".join(self._rows), numpy.array(self._times_ns, "<u8")
        self._rows, self._times_ns = [], []
        return numpy.frombuffer(rows, self._dtype), times
