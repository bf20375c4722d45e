"""The verb `record`: records live CAN buses, and shows its progress."""

import argparse
import json
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from motorhil.harness.cli.main import FAILED, PASSED, WRONG_USAGE
from motorhil.harness.cli.options import real, whole
from motorhil.harness.cli.progress import StatusLine
from motorhil.harness.cli.viewing import CHUNK_S, add_foxglove, add_view, foxglove_words, page_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from motorhil.harness.recording.loop import RecordingLoop
    from motorhil.harness.recording.sources import Tap
    from motorhil.harness.recording.writer import Pump, Series

_NS: Final = 1_000_000_000
_MIB: Final = 1 << 20
PERIOD_NS: Final = 250_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `record`."""
    parser.add_argument(
        "--on",
        action="append",
        required=True,
        metavar="[NAME=]WHERE",
        help="a SocketCAN interface (vcan0), the socket of `motorhil serve --socket` (a path, or "
        "PATH#BUS), or interface:channel of python-can; may be repeated",
    )
    parser.add_argument(
        "-o", "--output", required=True, metavar="FILE", help="file to write (MCAP)"
    )
    parser.add_argument(
        "--duration", type=real(1e-9, 1e9, "s"), metavar="S", help="stop after S seconds"
    )
    parser.add_argument(
        "--rotate-mib",
        type=real(1e-6, 1e9, "MiB"),
        metavar="N",
        help="begin a new file after N MiB: FILE-0001.mcap, FILE-0002.mcap, ...",
    )
    parser.add_argument(
        "--rotate-s",
        type=real(1e-9, 1e9, "s"),
        metavar="S",
        help="begin a new file after S seconds",
    )
    parser.add_argument(
        "--bitrate",
        type=whole(1, 10**8, "bit/s"),
        metavar="N",
        help="bit rate, for python-can interfaces that need it",
    )
    parser.add_argument(
        "--fd", action="store_true", help="CAN FD, for python-can interfaces that need this option"
    )
    parser.add_argument(
        "--compact", action="store_true", help="a third of the size; not readable by Foxglove"
    )
    add_view(parser)
    add_foxglove(parser)
    parser.add_argument("--force", action="store_true", help="overwrite existing recordings")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.epilog = "Ctrl-C ends the recording; the file is readable, however it ends."


def run(options: argparse.Namespace) -> int:
    """Record; return 0, or 1 if a bus ended by itself, or 2 if recording could not begin.

    Raises:
        TraceError: the recording cannot be written.
    """
    from motorhil.harness.recording.sources import PlaceError

    if options.view and (options.rotate_mib or options.rotate_s):
        text = "--view shows one file; omit --rotate-mib and --rotate-s"
        print(f"motorhil record: {text}", file=sys.stderr)
        return WRONG_USAGE
    with ExitStack() as cleanup:
        try:
            taps, names, own_times = _open(options, cleanup)
        except PlaceError as error:
            print(f"motorhil record: {error}", file=sys.stderr)
            return WRONG_USAGE
        return _record(options, taps, names, own_times, cleanup)


def _open(options: argparse.Namespace, cleanup: ExitStack) -> "tuple[list[Tap], list[str], bool]":
    """Open the buses; return taps, names, and whether a hub gives the times.

    Raises:
        PlaceError: a bus cannot be opened, or is named twice.
    """
    from motorhil.harness.recording.sources import (
        HubClocks,
        HubTap,
        Kind,
        PlaceError,
        parse_place,
        refuse_twice,
    )

    places = [parse_place(text) for text in options.on]
    clocks = HubClocks(places)
    interface = {"bitrate": options.bitrate} if options.bitrate else {}
    if options.fd:
        interface["fd"] = True
    taps: list[Tap] = []
    for place in places:
        tap: Tap
        if any(p.kind is place.kind and p.channel == place.channel for p in places[: len(taps)]):
            raise PlaceError(f"--on {place.text}: is named twice; name each bus once")
        if place.kind is Kind.SOCKETCAN:
            from motorhil.harness.recording.socketcan import SocketCanTap

            tap = SocketCanTap(place)
        elif place.kind is Kind.HUB:
            tap = HubTap(place, clocks)
        else:
            from motorhil.harness.recording.sources import PythonCanTap

            tap = PythonCanTap(place, interface)
        cleanup.callback(tap.close)
        tap.source = 2 * len(taps)
        taps.append(tap)
    names = [place.name or tap.default_name for place, tap in zip(places, taps, strict=True)]
    refuse_twice(names, places)
    return taps, names, clocks.keeps


def _record(
    options: argparse.Namespace,
    taps: "list[Tap]",
    names: list[str],
    own_times: bool,
    cleanup: ExitStack,
) -> int:
    from motorhil.harness.cli.processes import StopSignals
    from motorhil.harness.recording.loop import RecordingLoop
    from motorhil.harness.recording.writer import Pump, Series, opener

    metadata = _metadata(options, taps, names)
    series = Series(
        options.output,
        opener(names, metadata, options.compact),
        rotate_bytes=_scaled(options.rotate_mib, _MIB),
        rotate_ns=_scaled(options.rotate_s, _NS),
        overwrite=options.force,
    )
    if options.view:
        cleanup.enter_context(
            page_of(
                Path(options.output),
                ", ".join(options.on),
                options.view_port,
                stays=False,
                more=foxglove_words(options),
            )
        )
        pump = Pump(names, series, round(CHUNK_S * _NS))
        loop = RecordingLoop(taps, pump, own_times, _report, CHUNK_S)
    else:
        pump = Pump(names, series)
        loop = RecordingLoop(taps, pump, own_times, _report)
    signals = cleanup.enter_context(StopSignals(loop))
    buses = ", ".join(f"{name} ({text})" for name, text in zip(names, options.on, strict=True))
    print(f"recording {buses}; Ctrl-C ends it", file=sys.stderr, flush=True)
    try:
        loop.run(lambda: signals.number is not None, options.duration, _progress_line(pump, series))
    finally:
        if sys.stderr.isatty():
            print(file=sys.stderr)
        frames = {name: str(count) for name, count in zip(names, pump.frames, strict=True)}
        lost = {name: str(count) for name, count in zip(names, pump.dropped, strict=True)}
        clocks = {name: tap.clock for name, tap in zip(names, taps, strict=True)}
        pump.close({"frames": frames, "lost": lost, "clocks": clocks})
    _summarize(options, names, pump, series, loop)
    return FAILED if loop.ended else PASSED


def _metadata(
    options: argparse.Namespace, taps: "list[Tap]", names: list[str]
) -> dict[str, dict[str, str]]:
    from motorhil.harness.version import version, version_of

    places = {f"{name}_from": text for name, text in zip(names, options.on, strict=True)}
    clocks = {f"{name}_clock": tap.clock for name, tap in zip(names, taps, strict=True)}
    versions = {name: version_of(name) or "absent" for name in ("python-can", "zstandard")}
    return {"record": {**places, **clocks}, "versions": {"motorhil": version(), **versions}}


def _progress_line(pump: "Pump", series: "Series") -> "Callable[[int], None]":
    """Return a callback that shows the progress on a terminal."""
    progress: list[Progress] = []
    status = StatusLine()

    def show(now_ns: int) -> None:
        if not status.is_terminal:
            return
        if not progress:
            progress.append(Progress(now_ns))
        line = progress[0].line(now_ns, sum(pump.frames), sum(pump.dropped), series.bytes)
        if line is not None:
            status.show(line)

    return show


def _report(text: str) -> None:
    before = "\r\x1b[K" if sys.stderr.isatty() else ""  # replaces the progress line
    print(f"{before}motorhil record: {text}", file=sys.stderr, flush=True)


def _summarize(
    options: argparse.Namespace,
    names: list[str],
    pump: "Pump",
    series: "Series",
    loop: "RecordingLoop",
) -> None:
    span_ns = (pump.last_ns or 0) - (pump.first_ns or 0)
    if options.json:
        counts = zip(names, pump.frames, pump.dropped, strict=True)
        facts = {
            "files": series.paths,
            "bytes": series.bytes,
            "span_ns": span_ns,
            "buses": {name: {"frames": count, "lost": lost} for name, count, lost in counts},
            "problems": loop.problems,
        }
        print(json.dumps(facts), flush=True)
        return
    files = series.paths[0] + (f" to {series.paths[-1]}" if len(series.paths) > 1 else "")
    each = ", ".join(f"{n} of {name}" for name, n in zip(names, pump.frames, strict=True))
    each = each.replace(" of", " frames of", 1)
    lost = sum(pump.dropped)
    print(f"{files}: {each} in {span_ns / _NS:.3f} s, {lost or 'none'} lost", flush=True)


def _scaled(value: float | None, unit: int) -> int | None:
    return None if value is None else max(1, round(value * unit))


@final
class Progress:
    """Progress line, updated four times a second; the caller passes the time."""

    def __init__(self, now_ns: int) -> None:
        """Start at `now_ns` [ns]."""
        self._begin_ns = now_ns
        self._last_ns = now_ns
        self._last_frames = 0

    def line(self, now_ns: int, frames: int, dropped: int, size: int) -> str | None:
        """Return the progress line, or None before the next update is due.

        Args:
            now_ns: monotonic time [ns].
            frames: number of frames recorded so far.
            dropped: number of frames lost so far.
            size: size of the files [bytes].
        """
        passed_ns = now_ns - self._last_ns
        if passed_ns < PERIOD_NS:
            return None
        rate = round((frames - self._last_frames) * _NS / passed_ns)
        self._last_ns, self._last_frames = now_ns, frames
        return (
            f"{(now_ns - self._begin_ns) / _NS:8.1f} s  {frames:,} frames  {rate:,} frames/s  "
            f"{dropped:,} lost  {size / 2**20:.1f} MiB"
        )
