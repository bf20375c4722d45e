"""From one format of CAN traffic to another: what was read, written, and what that lost."""

import os
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import final

from traces.errors import TraceError
from traces.formats import WRITABLE, Feature, Format, Source, Survey, open_source
from traces.modbus_pcap import captured_adus, record_adus
from traces.traffic import Findings
from traces.traffic_mcap import record_frames


@final
@dataclass(frozen=True, slots=True)
class Conversion:
    """What came of it.

    Attributes: source, target (its path), format (what was written), findings (of reading), buses,
    lost (how many frames have what the target's format does not hold).
    """

    source: Source
    target: str
    format: str
    findings: Findings
    buses: tuple[str, ...]
    lost: dict[Feature, int]


def format_named(name: str) -> Format | None:
    """The format of this name; None: our own recording.

    Raises:
        KeyError: there is none.
    """
    return None if name == "mcap" else {known.name: known for known in WRITABLE}[name]


def format_of_ending(path: str) -> str | None:
    """The format that a file name's ending stands for."""
    endings = {".mcap": "mcap"} | {known.ending: known.name for known in WRITABLE}
    return endings.get(os.path.splitext(path)[1].lower())


def convert(source_path: str, target: str, name: str, overwrite: bool = False) -> Conversion:
    """The target holds the source's frames, as far as its format can.

    Raises:
        TraceError: the source cannot be read or has no frames; the target cannot be written, or
            exists and may not be lost.
    """
    source = open_source(source_path)
    with suppress(OSError):
        if os.path.samefile(source_path, target):
            raise TraceError(target, "is the source itself", remedy="name another file")
    if os.path.exists(target) and not overwrite:
        raise TraceError(target, "exists", remedy="name another file, or say --force")
    findings = Findings()
    frames = source.frames(findings)
    first = next(frames, None)
    if first is None and source.format == "pcap":
        return _convert_modbus(source, target, name)
    if first is None:
        raise TraceError(source_path, f"no frame can be read as {source.format}")
    frames = chain((first,), frames)
    format_ = format_named(name)
    lost: dict[Feature, int] = {}
    if format_ is None:
        told = {"source": Path(source.path).name, "format": source.format}
        buses = record_frames(target, frames, {"convert": told})
    else:
        survey = Survey()
        for frame in frames:
            survey.add(frame)
        _write(target, format_, survey, source)
        buses = tuple(survey.buses)
        lost = {what: n for what, n in survey.counts.items() if what not in format_.holds}
    return Conversion(source, target, name, findings, buses, lost)


def _convert_modbus(source: Source, target: str, name: str) -> Conversion:
    """The target holds the Modbus/TCP of a capture without CAN frames."""
    findings = Findings()
    adus = captured_adus(source.path, findings)
    first = next(adus, None)
    if first is None:
        raise TraceError(source.path, "holds neither CAN frames nor Modbus/TCP")
    if name != "mcap":
        remedy = "convert it to mcap"
        raise TraceError(source.path, f"holds Modbus/TCP, which {name} cannot", remedy=remedy)
    told = {"source": Path(source.path).name, "format": "Modbus/TCP in pcap"}
    lines = record_adus(target, chain((first,), adus), {"convert": told})
    return Conversion(source, target, name, findings, lines, {})


def _write(target: str, format_: Format, survey: Survey, source: Source) -> None:
    """The file is there whole, or not at all."""
    part = f"{target}.part"
    try:
        with open(part, "wb") as file:
            format_.write(file, survey, source.frames(Findings()))
        os.replace(part, target)
    except OSError as error:
        what = f"cannot be written: {(error.strerror or str(error)).lower()}"
        raise TraceError(target, what) from error
    finally:
        with suppress(OSError):
            os.remove(part)
