"""Conversion of recorded traffic between formats, with an account of losses."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import BinaryIO, Final, cast, final

from motorhil.frozen import frozen
from motorhil.traces.errors import TraceError
from motorhil.traces.files import MEMORY_MAX, head_of, refuse_others, whole_file
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.modbus import RecordedAdu, all_adus
from motorhil.traces.formats.pcap_modbus import AduFeature, ModbusExport, captured_adus, record_adus
from motorhil.traces.formats.registry import (
    WRITABLE,
    Feature,
    Format,
    Source,
    Survey,
    open_source,
    record_frames,
)
from motorhil.traces.mcap.reader import Trace, read_trace
from motorhil.traces.mcap.records import MAGIC, Attachment
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import Schema

MODBUS_PCAPNG: Final = "modbus-pcapng"
_WITH_MODBUS: Final = ("mcap", "pcap")


@final
@frozen
class Conversion:
    """The result of a conversion.

    Attributes:
        source: the source that was read.
        target: path of the file that was written.
        format: format that was written.
        findings: problems found while reading.
        buses: names of the buses.
        lost: number of frames or ADUs per feature that the target's format cannot hold.
        is_modbus: True if ADUs were read, not frames.
    """

    source: Source
    target: str
    format: str
    findings: Findings
    buses: tuple[str, ...]
    lost: Mapping[Feature, int] | Mapping[AduFeature, int]
    is_modbus: bool = False


def format_named(name: str) -> Format | None:
    """Return the format of this name; None stands for motorhil's own recording.

    Raises:
        KeyError: the name is unknown.
    """
    return None if name == "mcap" else {known.name: known for known in WRITABLE}[name]


def format_of_ending(path: str) -> str | None:
    """Return the name of the format for a file name's extension, or None if it is unknown."""
    endings = {".mcap": "mcap"} | {known.ending: known.name for known in WRITABLE if known.ending}
    return endings.get(os.path.splitext(path)[1].lower())


def convert(
    source_path: str,
    target: str,
    name: str,
    overwrite: bool = False,
    attachments: Iterable[Attachment] = (),
    memory_max: int = MEMORY_MAX,
) -> Conversion:
    """Write the source's frames to the target, as far as its format can hold them.

    If there are no frames, or the format is `MODBUS_PCAPNG`, write the ADUs of Modbus lines.

    Args:
        source_path: the file to read.
        target: the file to write.
        name: the format of the target.
        overwrite: True to replace an existing target.
        attachments: files for a target in MCAP; ignored by other formats.
        memory_max: the most bytes that are made of one compressed piece of the source.

    Raises:
        TraceError: the source cannot be read or has no frames; or the target cannot be written, or
            exists and `overwrite` is False.
    """
    source = open_source(source_path, memory_max)
    with suppress(OSError):
        if os.path.samefile(source_path, target):
            raise TraceError(target, "is the source itself", remedy="name another file")
    if os.path.exists(target) and not overwrite:
        raise TraceError(target, "exists", remedy="name another file, or say --force")
    if name == MODBUS_PCAPNG:
        return _convert_modbus(source, target, name)
    format_ = format_named(name)
    if format_ is not None:
        format_.require(target)
    findings = Findings()
    frames = source.frames(findings)
    first = next(frames, None)
    if first is None and source.format in _WITH_MODBUS:
        return _convert_modbus(source, target, name)
    if first is None:
        raise _nothing_in(source, findings)
    frames = chain((first,), frames)
    lost: dict[Feature, int] = {}
    if format_ is None:
        told = {"source": Path(source.path).name, "format": source.format}
        refuse_others(target, MAGIC)
        with whole_file(target) as file:
            buses = record_frames(file, frames, {"convert": told}, attachments)
    else:
        survey = Survey()
        for frame in frames:
            survey.add(frame)
        with whole_file(target) as file:
            format_.write(file, survey, source.frames(again := Findings()))
            if again.frames != findings.frames:
                what = f"changed while it was read: {findings.frames} frames, then {again.frames}"
                raise TraceError(source_path, what, remedy="convert it again, or a copy of it")
        buses = tuple(survey.buses)
        lost = {what: n for what, n in survey.counts.items() if what not in format_.holds}
    return Conversion(source, target, name, findings, buses, lost)


def open_recording(
    path: str | os.PathLike[str],
    note: Callable[[str], None] | None = None,
    attachments: Sequence[Attachment] = (),
    memory_max: int = MEMORY_MAX,
) -> Trace:
    """Open a recording of any format; one that is not MCAP is converted in an unnamed file.

    Args:
        path: the file.
        note: called with what was read as which format, if it was converted.
        attachments: files beside those of the recording.
        memory_max: the most bytes that are made of one compressed piece of it.

    Raises:
        TraceError: the file cannot be read, is damaged, or has no frames.
    """
    name = os.fspath(path)
    if _is_mcap_or_nothing(name):
        trace = read_trace(path, memory_max)
        trace.attachments.extend(attachments)
        return trace
    source = open_source(path, memory_max)
    findings = Findings()
    unit = "frames"
    file = TemporaryFile()  # noqa: SIM115 -- the Trace closes it
    try:
        told = {"convert": {"source": Path(name).name, "format": source.format}}
        with os.fdopen(os.dup(file.fileno()), "wb") as target:
            is_read = bool(record_frames(target, source.frames(findings), told, attachments))
        if not is_read and source.format in _WITH_MODBUS:
            unit = "ADUs"
            file.truncate(0)
            with os.fdopen(os.dup(file.fileno()), "wb") as target:
                target.seek(0)
                is_read = bool(record_adus(target, _adus(source, findings), told))
        if not is_read:
            raise _nothing_in(source, findings)
        if note is not None:
            unread = f", {len(findings.problems)} not readable" if findings.problems else ""
            note(f"{name}: {findings.frames} {unit}, read as {source.format}{unread}")
        return Trace(name, cast("BinaryIO", file))
    except BaseException:
        file.close()
        raise


@contextmanager
def as_mcap(
    path: Path,
    note: Callable[[str], None],
    attachments: Sequence[Attachment] = (),
    memory_max: int = MEMORY_MAX,
) -> Iterator[Path]:
    """Provide a recording of any format as an MCAP file, in a temporary folder if it is another.

    Args:
        path: the file.
        note: called with what was read as which format, if it was converted.
        attachments: files beside those of the recording; an MCAP file is then copied with them.
        memory_max: the most bytes that are made of one compressed piece of it; an MCAP file is
            copied in small pieces if this is not the usual bound.

    Raises:
        TraceError: as `convert`; an error of the temporary file names the user's.
    """
    is_mcap = _is_mcap_or_nothing(str(path))
    if is_mcap and not attachments and memory_max == MEMORY_MAX:
        yield path
        return
    with TemporaryDirectory(prefix="motorhil-") as folder:
        target = Path(folder) / f"{path.name}.mcap"
        if is_mcap:
            _copy_with(path, target, attachments, memory_max)
        else:
            done = convert(str(path), str(target), "mcap", False, attachments, memory_max)
            found = done.findings
            unread = f", {len(found.problems)} not readable" if found.problems else ""
            unit = "ADUs" if done.is_modbus else "frames"
            note(f"{path}: {found.frames} {unit}, read as {done.source.format}{unread}")
        try:
            yield target
        except TraceError as error:
            if error.path != str(target):
                raise
            named = TraceError(str(path), error.what, remedy=error.remedy, offset=error.offset)
            raise named from error


def _copy_with(
    path: Path, target: Path, attachments: Sequence[Attachment], memory_max: int
) -> None:
    """Copy a recording with more attachments."""
    with read_trace(path, memory_max) as trace, TraceWriter(target, trace.metadata) as writer:
        for one in (*trace.attachments, *attachments):
            writer.attach(one.name, one.data, one.media_type, one.log_time_ns)
        channels: dict[int, int] = {}
        for channel, time_ns, payload in trace.messages():
            if channel.number not in channels:
                schema = channel.schema or Schema("", b"", "")
                channels[channel.number] = writer.channel(channel.topic, schema, channel.metadata)
            writer.write(channels[channel.number], time_ns, payload)


def _is_mcap_or_nothing(name: str) -> bool:
    """Return whether the reader of MCAP files should report what is wrong with this file."""
    try:
        if not os.path.isfile(name):
            return True
        head = head_of(name, len(MAGIC))
    except TraceError:
        return True
    return not head or MAGIC.startswith(head[:5])


def _convert_modbus(source: Source, target: str, name: str) -> Conversion:
    """Convert the Modbus of a capture or recording without CAN frames."""
    findings = Findings()
    adus = _adus(source, findings)
    first = next(adus, None)
    if first is None:
        if name == MODBUS_PCAPNG:
            raise TraceError(source.path, "holds no Modbus")
        findings = Findings()
        deque(source.frames(findings), 0)
        raise _nothing_in(source, findings)
    adus = chain((first,), adus)
    if name == "mcap":
        told = {"source": Path(source.path).name, "format": f"Modbus in {source.format}"}
        refuse_others(target, MAGIC)
        with whole_file(target) as file:
            lines = record_adus(file, adus, {"convert": told})
        return Conversion(source, target, name, findings, lines, {}, True)
    if name not in ("pcapng", MODBUS_PCAPNG):
        remedy = "convert it to mcap or pcapng"
        raise TraceError(source.path, f"holds Modbus, which {name} cannot", remedy=remedy)
    with whole_file(target) as file:
        export = ModbusExport(file, findings)
        export.add(adus)
    return Conversion(source, target, MODBUS_PCAPNG, findings, export.lines, export.lost, True)


def _nothing_in(source: Source, findings: Findings) -> TraceError:
    """Return the error for a source without traffic, with the first thing that was found."""
    found = [problem.text for problem in findings.problems] + findings.notes
    remedy = found[0] if found else "record again: it has no traffic"
    if source.format in _WITH_MODBUS:
        return TraceError(source.path, "holds neither CAN frames nor Modbus", remedy=remedy)
    return TraceError(source.path, f"no frame can be read as {source.format}", remedy=remedy)


def _adus(source: Source, findings: Findings) -> Iterator[RecordedAdu]:
    if source.format == "pcap":
        yield from captured_adus(source.path, findings, source.memory_max)
    elif source.format == "mcap":
        with read_trace(source.path, source.memory_max) as trace:
            for adu in all_adus(trace):
                findings.frames += 1
                yield adu
            if trace.cut is not None and trace.cut.messages_missing:
                findings.problem(0, str(trace.cut))
