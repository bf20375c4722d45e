"""The verb `view`: a page on loopback that shows a recording, a rig, a live bus or a campaign.

A rig and a bus are recorded as by `run` and `record`, with their option `--view`.
"""

import argparse
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Final, Protocol

from motorhil.harness.cli.main import PASSED
from motorhil.harness.cli.options import (
    add_descriptions,
    add_eds,
    add_max_memory,
    attachments_of,
)
from motorhil.harness.cli.printable import teller
from motorhil.harness.cli.processes import STOPPING
from motorhil.harness.cli.report import add_bit_rates
from motorhil.harness.cli.viewing import (
    add_foxglove,
    add_pace,
    add_paused,
    add_port,
    foxglove_words,
    record_for,
)
from motorhil.harness.rig.config.toml import RigError
from motorhil.traces.errors import TraceError

if TYPE_CHECKING:
    from collections.abc import Callable

    from motorhil.harness.view.session import Session
    from motorhil.traces.mcap.reader import Trace, TraceMessage

LOOPBACK: Final = "127.0.0.1"
_NICE: Final = 5  # a page has time, a rig may have none


class _Verb(Protocol):
    """The module of a verb."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments of the verb."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `view`."""
    parser.usage = (
        "motorhil view [-h] [options] FILE | WHERE | DIR | RIG [SCRIPT [ARGS ...]] [-- ARGS ...]"
    )
    parser.add_argument(
        "file",
        metavar="FILE | WHERE | RIG | DIR",
        help="a recording of any format (an MCAP file may still grow), a live bus as for `record "
        "--on`, a rig file (TOML), which runs as by `run`, or the folder of a campaign of `swarm`",
    )
    parser.add_argument("script", nargs="?", metavar="SCRIPT", help="the rig's program")
    parser.add_argument(
        "args", nargs="*", default=[], metavar="ARGS", help="the program's own arguments"
    )
    add_pace(parser, default=1.0)
    add_paused(parser)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="keep the record of the rig or bus"
    )
    parser.add_argument("--title", help="title of the page (default: the recording's name)")
    add_server(parser)
    parser.add_argument("--beside", action="store_true", help=argparse.SUPPRESS)
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
        default=LOOPBACK,
        metavar="ADDRESS",
        help="IP address of the page (default: 127.0.0.1, this machine only)",
    )
    add_port(parser, "--port")
    parser.add_argument(
        "--token", metavar="TEXT", help="token in the address (default: a new one each time)"
    )
    add_foxglove(parser)


def run(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C; return 0, or the status of the program or recorder.

    Raises:
        RigError: the rig cannot be used.
        TraceError: the recording cannot be read, or the port cannot be opened.
    """
    path = Path(options.file)
    is_recording = path.suffix == ".mcap" or (path.is_file() and path.suffix != ".toml")
    if options.paused and path.suffix != ".toml":
        raise RigError(path, "is not a rig file; --paused is for a rig's time", "name a rig")
    if is_recording and options.script is None:
        return _serve(options)
    if path.is_dir() and options.script is None:
        return _serve_campaign(options, path)
    if options.token is not None or options.listen != LOOPBACK:
        what = "--listen and --token are for the page of a file"
        raise RigError(path, what, "record with -o FILE, then view that file")
    if path.suffix == ".toml":
        return _run_rig(options)
    if options.script is not None:
        raise RigError(path, "is not a rig file (TOML); only a rig runs a program", "name a rig")
    return _record_bus(options)


def _run_rig(options: argparse.Namespace) -> int:
    """Run the rig as `run --view` does."""
    from motorhil.harness.cli import run as run_verb

    words = [
        options.file,
        "--view",
        "--view-port",
        str(options.port),
        "--pace",
        f"{options.pace:g}",
        *foxglove_words(options),
    ]
    words += ["--paused"] if options.paused else []
    words += [] if options.output is None else ["--output", str(options.output)]
    words += [] if options.script is None else [options.script, *options.args]
    return run_verb.run(_options_of(run_verb, words, options.rest))


def _record_bus(options: argparse.Namespace) -> int:
    """Record the bus as `record --view` does; without an output the record is deleted."""
    from motorhil.harness.cli import record as record_verb

    with record_for(options.output, is_watched=True) as target:
        words = ["--on", options.file, "--output", str(target)]
        words += ["--view", "--view-port", str(options.port), *foxglove_words(options)]
        return record_verb.run(_options_of(record_verb, words, None))


def _options_of(verb: _Verb, words: list[str], rest: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="motorhil view", allow_abbrev=False)
    verb.add_arguments(parser)
    options = parser.parse_intermixed_args(words)
    options.rest = rest
    return options


def _serve(options: argparse.Namespace) -> int:
    """Serve the page of a file."""
    from motorhil.harness.recording.conversion import open_recording
    from motorhil.harness.view.desk import Desk
    from motorhil.harness.view.page import live_page
    from motorhil.harness.view.server import ViewServer
    from motorhil.harness.view.source import Source

    attachments = attachments_of(options.eds)
    title = options.title or Path(options.file).name
    with (
        open_recording(options.file, teller("view"), attachments, options.max_memory) as trace,
        _viewers(options, title, trace) as publish,
    ):
        source = Source(trace, lambda one: _session(one, options, title), publish)
        desk = Desk(_to_rig, source.wake) if options.beside else None
        place = options.listen, options.port, options.token
        with _opened(options):
            report = partial(_report, options, title)
            server = ViewServer(source, live_page(title), report, *place, desk)
        with server:
            print(server.address, flush=True)
            if desk is not None:
                os.nice(_NICE)
                for line in sys.stdin.buffer:  # until the process that records has ended
                    desk.hear(line)
                desk.close()
            else:
                _wait()
    if source.problem:
        print(source.problem, file=sys.stderr)
    return PASSED


def _serve_campaign(options: argparse.Namespace, folder: Path) -> int:
    """Serve the page of a campaign, which another process may still write."""
    from motorhil.harness.view.campaign import CampaignServer

    with _opened(options):
        server = CampaignServer(folder, options.listen, options.port, options.token)
    with server:
        print(server.address, flush=True)
        if options.beside:
            os.nice(_NICE)
            sys.stdin.buffer.read()  # until the process of the campaign has ended
        else:
            _wait()
    return PASSED


@contextmanager
def _opened(options: argparse.Namespace) -> Iterator[None]:
    """Tell of a port that cannot be opened (TraceError)."""
    try:
        yield
    except OSError as error:
        place = f"{options.listen}:{options.port}"
        raise TraceError(place, f"cannot be opened: {error.strerror}") from None


@contextmanager
def _viewers(
    options: argparse.Namespace, title: str, trace: "Trace"
) -> Iterator["Callable[[TraceMessage], None] | None"]:
    """Serve other viewers, if that is asked for.

    Raises:
        TraceError: they cannot be served.
    """
    if options.foxglove is None:
        yield None
        return
    if trace.cut is None:
        remedy = "open the file in the viewer, or name a recording in progress"
        raise TraceError(options.file, "is complete: nothing comes to be served", remedy=remedy)
    from motorhil.harness.view.foxglove import FoxgloveServer

    with FoxgloveServer(title, options.foxglove) as server:
        print(f"foxglove: {server.address}", file=sys.stderr, flush=True)
        yield server


def _to_rig(line: bytes) -> None:
    """Pass a request of a page to the process beside which it is served."""
    sys.stdout.buffer.write(line)
    sys.stdout.buffer.flush()


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
