"""Formats of CAN traffic: detection by content, reading, writing, and features.

File endings are ignored on reading, because people keep candump's rows in .txt and .log alike. Our
own recordings are one of the formats.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from enum import Flag, auto
from io import TextIOBase, TextIOWrapper
from typing import BinaryIO, Final, final

from motorhil.frozen import frozen
from motorhil.traces.can_frame import ERR, RTR
from motorhil.traces.errors import TraceError
from motorhil.traces.files import (
    COPY_AGAIN,
    MEMORY_MAX,
    head_of,
    open_content,
    refuse_pipe,
    stranger,
    unreadable,
)
from motorhil.traces.formats import analyser_logs, asc, blf, candump, csv, mf4, pcap_can, trc
from motorhil.traces.formats.frames import (
    Findings,
    Frame,
    LineReader,
    bus_number,
    one_word,
    read_lines,
)
from motorhil.traces.mcap.chunk import Entry
from motorhil.traces.mcap.reader import Trace, read_trace
from motorhil.traces.mcap.records import MAGIC, Attachment
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, Direction, FrameDecoder, Schema

_PREFIX: Final = "/can/"
_BATCH: Final = 8192
_HEAD_BYTES: Final = 1 << 16
_HEAD_LINES: Final = 200


def recorded_frames(
    trace: Trace, findings: Findings, from_ns: int | None = None, to_ns: int | None = None
) -> Iterator[Frame]:
    """Yield the CAN frames of a recording in written order; other messages become notes.

    Args:
        trace: the recording.
        findings: notes and problems are added to it.
        from_ns: the begin of the span [ns]; None: that of the recording.
        to_ns: the end of the span [ns]; None: that of the recording.

    Raises:
        TraceError: a chunk is damaged.
    """
    left_out: dict[str, int] = {}
    known: dict[int, str | None] = {}
    decode = FrameDecoder().decode
    for number, (channel, time_ns, payload) in enumerate(trace.messages(None, from_ns, to_ns), 1):
        bus = known.get(channel.number, "")
        if bus == "":
            ours = channel.schema is not None and channel.schema.name == CAN_FRAME.name
            bus = channel.topic.removeprefix(_PREFIX) if ours else None
            known[channel.number] = bus
        if bus is None:
            left_out[channel.topic] = left_out.get(channel.topic, 0) + 1
            continue
        try:
            frame, direction, sender = decode(payload)
        except ValueError as error:
            findings.problem(number, f"{channel.topic}: {error}")
            continue
        yield Frame(time_ns, bus, frame, direction, sender)
    for topic, count in left_out.items():
        findings.note(f"{topic}: {count} messages are not CAN frames, and are omitted")
    if trace.cut is not None and trace.cut.messages_missing:
        findings.problem(0, str(trace.cut))


def record_frames(
    target: str | os.PathLike[str] | BinaryIO,
    frames: Iterable[Frame],
    metadata: dict[str, dict[str, str]],
    attachments: Iterable[Attachment] = (),
) -> tuple[str, ...]:
    """Record these frames in this order, after the attachments; return the buses.

    Raises:
        TraceError: the recording cannot be written.
    """
    with TraceWriter(target, metadata) as writer:
        for one in attachments:
            writer.attach(one.name, one.data, one.media_type)
        channels: dict[str, int] = {}
        sources: dict[tuple[str, str, Direction], int] = {}
        entries: list[Entry] = []
        schema = Schema.of(CAN_FRAME)
        for time_ns, bus, frame, direction, sender in frames:
            key = (bus, sender, direction)
            source = sources.get(key)
            if source is None:
                if bus not in channels:
                    channels[bus] = writer.channel(_PREFIX + bus, schema)
                source = sources[key] = writer.source(channels[bus], sender, direction)
            entries.append((source, time_ns, frame))
            if len(entries) >= _BATCH:
                writer.extend(entries)
                entries = []
        writer.extend(entries)
    return tuple(channels)


@final
class Feature(Flag):
    """A feature of a recording that a format may be unable to store."""

    NANOSECONDS = auto()  # stamps finer than a microsecond
    BUS_NAMES = auto()  # names other than can0, can1, ...
    BLANKS = auto()  # blanks and unprintable characters in bus names
    DIRECTION = auto()  # sent or received
    UNDIRECTED = auto()  # an unknown direction
    SENDER = auto()
    REMOTE = auto()  # and the number of bytes requested
    FD = auto()  # with BRS and ESI
    ORDER = auto()  # that of writing, where it is not the order of time, or stamps are equal
    ERROR_FRAMES = auto()  # and their contents


IN_WORDS: Final = {
    Feature.NANOSECONDS: "what is below 1 us in a stamp",
    Feature.BUS_NAMES: "bus names other than canN",
    Feature.BLANKS: "blanks in bus names",
    Feature.DIRECTION: "which frames were sent or received",
    Feature.UNDIRECTED: "that a direction is not known",
    Feature.SENDER: "who sent a frame",
    Feature.REMOTE: "remote frames",
    Feature.FD: "CAN FD",
    Feature.ORDER: "the order of frames whose times step back or are equal",
    Feature.ERROR_FRAMES: "what error frames tell",
}
_ALL: Final = ~Feature(0)


@final
@frozen
class Format:
    """A format that can be written.

    Attributes:
        name: its name.
        ending: the ending of file names; "" if it has to be named.
        holds: the features it can store.
        write: its writer.
        require: called with the target's path before reading; raises TraceError if a library that
            the writer needs is not installed.
    """

    name: str
    ending: str
    holds: Feature
    write: "Write"
    require: Callable[[str], object] = str


@final
class Survey:
    """Features, buses and first times of frames, collected in one pass."""

    def __init__(self) -> None:
        self.buses: list[str] = []
        self.first_ns: int = 0
        self.lowest_ns: int = 0
        self.frames: int = 0
        self.counts: dict[Feature, int] = {}
        self._last = (0, 0)

    @property
    def places(self) -> int:
        """Decimal places of a second: 6, or 9 if necessary."""
        return 9 if Feature.NANOSECONDS in self.counts else 6

    def add(self, frame: Frame) -> None:
        """Include this frame."""
        time_ns, bus, data, direction, sender = frame
        if not self.frames:
            self.first_ns = self.lowest_ns = time_ns
        self.frames += 1
        self.lowest_ns = min(self.lowest_ns, time_ns)
        if bus not in self.buses:
            self.buses.append(bus)
        can_id = int.from_bytes(data[:4], "little")
        if time_ns % 1000:
            self._count(Feature.NANOSECONDS)
        if bus_number(bus) is None:
            self._count(Feature.BUS_NAMES)
            if one_word(bus) != bus:
                self._count(Feature.BLANKS)
        self._count(Feature.DIRECTION if direction else Feature.UNDIRECTED)
        if sender:
            self._count(Feature.SENDER)
        if can_id & RTR:
            self._count(Feature.REMOTE)
        if len(data) > 16:
            self._count(Feature.FD)
        if can_id & ERR:
            self._count(Feature.ERROR_FRAMES)
        place = mf4.order_key(frame)
        if place < self._last:
            self._count(Feature.ORDER)
        self._last = place

    def _count(self, feature: Feature) -> None:
        self.counts[feature] = self.counts.get(feature, 0) + 1


Write = Callable[[BinaryIO, Survey, Iterator[Frame]], None]
"""A writer of these frames, which were surveyed before."""


def _as_text(write: "Callable[[TextIOBase, Survey, Iterator[Frame]], None]") -> "Write":
    """Return the writer of a text format as one of bytes."""

    def write_bytes(file: BinaryIO, survey: Survey, frames: Iterator[Frame]) -> None:
        text = TextIOWrapper(file, encoding="utf-8", newline="")
        write(text, survey, frames)
        text.flush()
        text.detach()

    return write_bytes


def _rows(row: Callable[[Frame, int], str]) -> "Write":
    """Return the writer of a format with a row per frame."""

    def write(text: TextIOBase, survey: Survey, frames: Iterator[Frame]) -> None:
        places = survey.places
        text.writelines(row(one, places) for one in frames)

    return _as_text(write)


_NAMES: Final = Feature.BUS_NAMES | Feature.BLANKS
_NUMBERED: Final = _NAMES | Feature.UNDIRECTED | Feature.SENDER | Feature.ERROR_FRAMES
_NOT_PLAIN: Final = Feature.SENDER | Feature.BLANKS | Feature.UNDIRECTED
_MARKED: Final = _ALL & ~Feature.SENDER & ~Feature.BLANKS
WRITABLE: Final = (
    Format("candump", ".log", _MARKED & ~Feature.DIRECTION, _rows(candump.log_row)),
    Format("candump-x", "", _MARKED, _rows(candump.marked_row)),
    Format("candump-plain", ".txt", _ALL & ~_NOT_PLAIN, _rows(candump.plain_row)),
    Format(
        *("trc", ".trc", _ALL & ~_NUMBERED & ~Feature.NANOSECONDS),
        _as_text(
            lambda file, seen, frames: trc.write_trc(file, seen.buses, seen.lowest_ns, frames)
        ),
    ),
    Format(
        *("asc", ".asc", _ALL & ~_NUMBERED),
        _as_text(
            lambda file, seen, frames: asc.write_asc(
                file, seen.buses, seen.lowest_ns, seen.places, frames
            )
        ),
    ),
    Format(
        *("blf", ".blf", _ALL & ~_NUMBERED | Feature.ERROR_FRAMES),
        lambda file, seen, frames: blf.write_blf(file, seen.buses, seen.lowest_ns, frames),
    ),
    Format(
        *("csv", ".csv", _ALL & ~Feature.BLANKS),
        _as_text(lambda file, seen, frames: csv.write_csv(file, seen.places, frames)),
    ),
    Format(
        *("pcapng", ".pcapng", _ALL),
        lambda file, seen, frames: pcap_can.write_pcapng(file, seen.buses, frames),
    ),
    Format(
        *("mf4", ".mf4", _ALL & ~_NUMBERED & ~Feature.ORDER | Feature.ERROR_FRAMES),
        lambda file, seen, frames: mf4.write_mf4(
            file,
            seen.buses,
            seen.lowest_ns,
            64 if Feature.FD in seen.counts else 8,
            sorted(frames, key=mf4.order_key) if Feature.ORDER in seen.counts else frames,
        ),
        mf4.require_writer,
    ),
)


@final
@frozen
class Source:
    """A file of CAN traffic.

    Attributes:
        path: the file.
        format: the name of its format.
        memory_max: the most bytes that are made of one compressed piece of it.
        encoding: of a text format.
    """

    path: str
    format: str
    memory_max: int = MEMORY_MAX
    encoding: str = "utf-8"

    def frames(self, findings: Findings) -> Iterator[Frame]:
        """Yield the frames in file order; unreadable parts are added to `findings`.

        Raises:
            TraceError: the file cannot be read, or not to its end.
        """
        return findings.watched(self._frames(findings))

    def _frames(self, findings: Findings) -> Iterator[Frame]:
        if self.format == "mcap":
            with read_trace(self.path, self.memory_max) as trace:
                yield from recorded_frames(trace, findings)
            return
        if self.format == "blf":
            yield from blf.blf_frames(self.path, findings, self.memory_max)
            return
        if self.format == "mf4":
            yield from mf4.mf4_frames(self.path, findings, self.memory_max)
            return
        if self.format == "pcap":
            yield from pcap_can.captured_frames(self.path, findings, self.memory_max)
            return
        content = open_content(
            self.path, lambda text: findings.problem(findings.line, text), self.memory_max
        )
        with TextIOWrapper(content, self.encoding, "replace", "\n") as file:
            try:
                yield from read_lines(file, _LINE_READERS[self.format](), findings)
            except OSError as error:
                raise unreadable(self.path, error) from error


_LINE_READERS: Final[dict[str, Callable[[], LineReader]]] = {
    "candump": candump.CandumpReader,
    "trc": trc.TrcReader,
    "asc": asc.AscReader,
    "csv": csv.CsvReader,
    "sd-rows": candump.SdRowReader,
    "busmaster": analyser_logs.BusmasterReader,
    "minimon": analyser_logs.MinimonReader,
}
_LOOKS: Final[tuple[tuple[str, Callable[[str], bool]], ...]] = (
    ("trc", trc.looks_like_trc),
    ("asc", asc.looks_like_asc),
    ("csv", csv.looks_like_csv),
    ("sd-rows", candump.looks_like_sd_rows),
    ("busmaster", analyser_logs.looks_like_busmaster),
    ("minimon", analyser_logs.looks_like_minimon),
    ("candump", candump.looks_like_log),
    ("candump", candump.looks_plain),
)


_MARKS: Final = (  # byte order marks
    *((b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"), (b"\xef\xbb\xbf", "utf-8-sig")),
)


def open_source(path: str | os.PathLike[str], memory_max: int = MEMORY_MAX) -> Source:
    """Open a file, and detect its format by its content; `memory_max` as of `Source`.

    Raises:
        TraceError: the file cannot be read, or its format is unknown.
    """
    name = os.fspath(path)
    refuse_pipe(name)
    head = head_of(name, _HEAD_BYTES)
    if head.startswith(MAGIC[:5]):
        return Source(name, "mcap", memory_max)
    if head.startswith(blf.MAGIC):
        return Source(name, "blf", memory_max)
    if head.startswith(mf4.MAGIC):
        return Source(name, "mf4", memory_max)
    if pcap_can.is_capture(head):
        return Source(name, "pcap", memory_max)
    encoding = next((name for mark, name in _MARKS if head.startswith(mark)), "utf-8")
    lines = head.decode(encoding, errors="replace").splitlines()[:_HEAD_LINES]
    for line in lines:
        for format_name, looks in _LOOKS:
            if looks(line):
                return Source(name, format_name, memory_max, encoding)
    known = ", ".join(["mcap", "blf", "mf4", "pcap", *_LINE_READERS])
    damage: list[str] = []
    open_content(name, damage.append, memory_max).close()
    if damage:
        raise TraceError(name, damage[0], remedy=COPY_AGAIN)
    what, remedy = stranger(head) or ("holds no CAN traffic in a format known here", "")
    raise TraceError(name, what, remedy=remedy or f"formats are {known}")
