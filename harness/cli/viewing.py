"""The option `--view`: a live page beside a verb that records.

The page is served by a process of its own, `motorhil view`, which reads the recording as it is
written. So it shares nothing with the rig or the recorder but the file, and cannot delay them. Two
pipes carry requests of hands and their answers; a rig reads them between two of its events.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, final

import motorhil
from motorhil.frozen import frozen
from motorhil.harness.cli.options import whole
from motorhil.harness.rig.config.toml import RigError
from motorhil.traces.mcap.writer import CHUNK_NS

_PORT_MAX: Final = 65_535
CHUNK_S: Final = 0.05
"""Longest time after which a watched recording is written [s of wall time]."""
_UNPACED_NS: Final = 500_000_000
_NS: Final = 1_000_000_000


def add_view(parser: argparse.ArgumentParser) -> None:
    """Add `--view`."""
    parser.add_argument(
        "--view", action="store_true", help="show a live page; its address goes to stderr"
    )
    add_port(parser, "--view-port")


def add_foxglove(parser: argparse.ArgumentParser) -> None:
    """Add `--foxglove`, which implies `--view`."""
    parser.add_argument(
        "--foxglove",
        action=_WithView,
        type=whole(0, _PORT_MAX),
        metavar="PORT",
        help="serve Foxglove, Lichtblick and PlotJuggler as well, at this port (they expect 8765)",
    )


class _WithView(argparse.Action):
    """An option that implies `--view`."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        """Store the value."""
        setattr(namespace, self.dest, values)
        namespace.view = True


def foxglove_words(options: argparse.Namespace) -> list[str]:
    """Return the option again, for another command line."""
    return [] if options.foxglove is None else ["--foxglove", str(options.foxglove)]


def add_port(parser: argparse.ArgumentParser, flag: str) -> None:
    """Add the port of the page under this flag; 0 by default."""
    parser.add_argument(
        flag,
        type=whole(0, _PORT_MAX),
        default=0,
        metavar="N",
        help="port of the page (default: any free one)",
    )


def add_pace(parser: argparse.ArgumentParser, default: float | None = None) -> None:
    """Add `--pace`; None: no limit by default."""
    usual = "no limit" if default is None else f"{default:g}"
    parser.add_argument(
        "--pace",
        type=_pace,
        default=default,
        metavar="X",
        help=f"let at most X seconds of the rig pass in one second (default: {usual})",
    )


def _pace(text: str) -> float:
    """Read a pace, such as 10 or 10x, for argparse's `type`."""
    try:
        pace = float(text.removesuffix("x"))
    except ValueError:
        pace = 0.0
    if not 1e-3 <= pace <= 1e6:
        raise argparse.ArgumentTypeError(f"{text!r} is not a pace; say 0.001 to 1e6, such as 10")
    return pace


def add_paused(parser: argparse.ArgumentParser) -> None:
    """Add `--paused`."""
    parser.add_argument(
        "--paused", action="store_true", help="begin with time at a standstill; the page ends it"
    )


def chunk_ns(pace: float | None, is_watched: bool = True) -> int:
    """Return the longest time in one chunk of a recorded rig, by the rig's time [ns]."""
    if not is_watched:
        return CHUNK_NS
    return _UNPACED_NS if pace is None else min(_NS, max(1, round(CHUNK_S * pace * _NS)))


@contextmanager
def record_for(output: Path | None, is_watched: bool) -> Iterator[Path | None]:
    """Return the file to record to: `output`, or for a page without one a file that is deleted."""
    if output is not None or not is_watched:
        yield output
        return
    with TemporaryDirectory(prefix="motorhil-view-") as folder:
        yield Path(folder) / "live.mcap"


@final
@frozen
class Beside:
    """The process of a page beside this one.

    Attributes:
        requests, answers: file descriptors, of requests that a page sends and for answers to them.
        stay: keeps the page until Ctrl-C.
    """

    requests: int
    answers: int
    stay: Callable[[], None]


@contextmanager
def page_of(
    recording: Path, title: str, port: int, stays: bool, more: Sequence[str] = ()
) -> Iterator[Beside]:
    """Serve the page of a recording in progress, or of a campaign, while the context is open.

    Args:
        recording: the file, whose head must be written; or the folder of a campaign.
        title: title of the page.
        port: its port; 0: any free one.
        stays: True to keep the page after the end of the context, until Ctrl-C.
        more: further options of `motorhil view`.

    Raises:
        RigError: the page cannot be served.
    """
    root = str(Path(motorhil.__file__).parent.parent)
    others = [path for path in (os.environ.get("PYTHONPATH"),) if path]
    words = ["view", str(recording), "--title", title, "--port", str(port), "--beside", *more]
    server = subprocess.Popen(
        [sys.executable, "-m", "motorhil", *words],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([root, *others])},
        stdin=subprocess.PIPE,  # it ends with this process
        stdout=subprocess.PIPE,
        bufsize=0,
        process_group=0,  # Ctrl-C ends the rig first
    )
    try:
        assert server.stdin is not None
        assert server.stdout is not None
        address = server.stdout.readline().decode().strip()
        if not address:
            raise RigError(recording, "its page cannot be served", "see the message above")
        print(f"page: {address}", file=sys.stderr, flush=True)
        beside = Beside(server.stdout.fileno(), server.stdin.fileno(), partial(_stay, server))
        yield beside
        if stays:
            beside.stay()
    finally:
        server.terminate()
        server.wait()
        for pipe in (server.stdin, server.stdout):
            if pipe is not None:
                pipe.close()


def _stay(server: "subprocess.Popen[bytes]") -> None:
    with suppress(KeyboardInterrupt):
        print("the run is over; its page stays until Ctrl-C", file=sys.stderr, flush=True)
        server.wait()
