"""The verb `view`: a page on loopback that shows a recording while it grows."""

import argparse
import signal
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from motorhil.harness.cli.main import PASSED
from motorhil.harness.cli.options import (
    add_descriptions,
    add_eds,
    add_max_memory,
    attachments_of,
    whole,
)
from motorhil.harness.cli.printable import teller
from motorhil.harness.cli.processes import STOPPING
from motorhil.harness.cli.report import add_bit_rates
from motorhil.traces.errors import TraceError

if TYPE_CHECKING:
    from motorhil.harness.view.session import Session
    from motorhil.traces.mcap.reader import Trace

_PORT_MAX = 65_535


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `view`."""
    parser.add_argument(
        "file", metavar="FILE", help="a recording of any format; an MCAP file may still grow"
    )
    parser.add_argument("--title", help="title of the page (default: the recording's name)")
    add_server(parser)
    add_bit_rates(parser, "bit rate of a CAN bus, if the recording lacks it, such as can0=500k")
    add_eds(parser)
    add_descriptions(parser)
    add_max_memory(parser)
    parser.epilog = (
        "Ctrl-C ends it. The address has a token in it: only who knows it sees the page."
    )


def add_server(parser: argparse.ArgumentParser) -> None:
    """Add the options of the page's server."""
    parser.add_argument(
        "--listen",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="IP address of the page (default: 127.0.0.1, this machine only)",
    )
    parser.add_argument(
        "--port",
        type=whole(0, _PORT_MAX),
        default=0,
        metavar="N",
        help="port of the page (default: any free one)",
    )
    parser.add_argument(
        "--token", metavar="TEXT", help="token in the address (default: a new one each time)"
    )


def run(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C; return 0.

    Raises:
        TraceError: the recording cannot be read, or the port cannot be opened.
    """
    from motorhil.harness.recording.conversion import open_recording
    from motorhil.harness.view.page import live_page
    from motorhil.harness.view.server import ViewServer
    from motorhil.harness.view.source import Source

    attachments = attachments_of(options.eds)
    title = options.title or Path(options.file).name
    with open_recording(options.file, teller("view"), attachments, options.max_memory) as trace:
        source = Source(trace, lambda one: _session(one, options, title))
        try:
            server = ViewServer(
                source,
                live_page(title),
                lambda: _report(options, title),
                options.listen,
                options.port,
                options.token,
            )
        except OSError as error:
            place = f"{options.listen}:{options.port}"
            raise TraceError(place, f"cannot be opened: {error.strerror}") from None
        with server:
            print(server.address, flush=True)
            _wait()
    if source.problem:
        print(source.problem, file=sys.stderr)
    return PASSED


def _wait() -> None:
    """Wait for Ctrl-C or SIGTERM, also where a shell made the process ignore Ctrl-C."""
    before = {number: signal.signal(number, _stop) for number in STOPPING}
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        return
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _stop(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _session(trace: "Trace", options: argparse.Namespace, title: str) -> "Session":
    """Return the session of a recording whose first messages are there."""
    from motorhil.harness.recording.decoders import description_for
    from motorhil.harness.view.session import Session, Subject

    span = trace.span_ns() or (0, 0)
    describe = description_for(trace.attachments, options.dbc, options.decoder, teller("view"))
    run = trace.metadata.get("run", {})
    facts = tuple((key, run[key]) for key in ("seed", "command_line") if run.get(key))
    subject = Subject(
        title,
        trace.attachments,
        span[0],
        trace.cut is None and span[0] == span[1],
        dict(options.bitrate),
        dict(options.data_bitrate),
        describe,
        facts,
    )
    return Session(subject)


def _report(options: argparse.Namespace, title: str) -> str:
    """Return the report of all that is in the file now."""
    from motorhil.harness.recording.conversion import open_recording
    from motorhil.harness.recording.decoders import description_for
    from motorhil.harness.report.collect import collect
    from motorhil.harness.report.document import document_of
    from motorhil.harness.report.page import render

    attachments = attachments_of(options.eds)
    with open_recording(options.file, None, attachments, options.max_memory) as trace:
        describe = description_for(trace.attachments, options.dbc, options.decoder, teller("view"))
        found = collect(trace, dict(options.bitrate), dict(options.data_bitrate), describe)
        return render(*document_of(trace, found, title))
