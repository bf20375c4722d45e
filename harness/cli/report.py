"""The verb `report`: a recording as one self-contained HTML page."""

import argparse
import json
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from motorhil.harness.cli.main import PASSED
from motorhil.harness.cli.options import add_descriptions, add_eds, add_max_memory, attachments_of
from motorhil.harness.cli.printable import teller
from motorhil.traces.errors import TraceError
from motorhil.traces.files import whole_file

_KILO: Final = {"k": 1_000, "M": 1_000_000}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `report`."""
    parser.add_argument("file", metavar="FILE", help="a recording of any format")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="PAGE",
        help="the page (default: FILE with the ending .html)",
    )
    parser.add_argument("--title", help="title of the page (default: the recording's name)")
    add_bit_rates(parser, "bit rate of a CAN bus, if the recording lacks it, such as can0=500k")
    add_eds(parser)
    add_descriptions(parser)
    parser.add_argument(
        "--foxglove-layout",
        type=Path,
        metavar="JSON",
        help="also write a layout for Foxglove with the motors and controllers of this recording",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    add_max_memory(parser)


def run(options: argparse.Namespace) -> int:
    """Write the page; return 0.

    Raises:
        TraceError: the recording cannot be read, is damaged, or the page cannot be written.
    """
    from motorhil.harness.recording.conversion import open_recording
    from motorhil.harness.recording.decoders import description_for
    from motorhil.harness.report.collect import collect
    from motorhil.harness.report.document import document_of
    from motorhil.harness.report.foxglove import layout_of
    from motorhil.harness.report.page import render

    target = options.output or Path(options.file).with_suffix(".html")
    tell = teller("report")
    attachments = attachments_of(options.eds)
    with open_recording(options.file, tell, attachments, options.max_memory) as trace:
        _refuse_lost(options.file, target, options.foxglove_layout)
        rates, data_rates = dict(options.bitrate), dict(options.data_bitrate)
        describe = description_for(trace.attachments, options.dbc, options.decoder, tell)
        found = collect(trace, rates, data_rates, describe)
        title = options.title or Path(options.file).name
        document, packed = document_of(trace, found, title)
        page = render(document, packed)
        _write(target, page)
        messages = sum(found.messages.values())
        layout = options.foxglove_layout
        if layout is not None:
            _write(layout, json.dumps(layout_of(trace), indent=2) + "\n")
    size = target.stat().st_size
    facts = {"page": str(target), "messages": messages, "bytes": size}
    if options.json:
        print(json.dumps({**facts, "layout": None if layout is None else str(layout)}))
    else:
        print(f"{target}: {messages} messages, {size / 1e6:.1f} MB")
        if layout is not None:
            print(f"{layout}: a layout for Foxglove")
    for name in sorted({*rates, *data_rates} - set(found.buses)):
        print(f"motorhil report: the recording has no CAN bus {name}", file=sys.stderr)
    return PASSED


def _refuse_lost(source: str, page: Path, layout: Path | None) -> None:
    if layout is not None and os.path.realpath(page) == os.path.realpath(layout):
        raise TraceError(str(layout), "is the page already", remedy="name another file")
    for target in (page, layout):
        with suppress(OSError):
            if target is not None and os.path.samefile(source, target):
                raise TraceError(str(target), "is the recording itself", remedy="name another file")


def _write(target: Path, text: str) -> None:
    with whole_file(str(target)) as file:
        file.write(text.encode(errors="backslashreplace"))  # a name that is not UTF-8


def add_bit_rates(parser: argparse.ArgumentParser, help_text: str) -> None:
    """Add options for nominal bit rates (with this help text) and data bit rates of CAN FD."""
    data = "bit rate of the data phase of CAN FD"
    for option, text in (("--bitrate", help_text), ("--data-bitrate", data)):
        parser.add_argument(
            option, action="append", type=bus_rate, default=[], metavar="BUS=RATE", help=text
        )


def bus_rate(text: str) -> tuple[str, int]:
    """Parse a bus and its bit rate.

    Raises:
        argparse.ArgumentTypeError: the text does not have the form BUS=RATE.
    """
    name, sign, rate = text.partition("=")
    factor = _KILO.get(rate[-1:], 1)
    number = rate.removesuffix(rate[-1:]) if factor > 1 else rate
    if not name or not sign or not number.isdecimal() or not 0 < int(number) * factor <= 10**8:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not BUS=RATE with a rate of 1 bit/s to 100M, as can0=500k"
        )
    return name, int(number) * factor
