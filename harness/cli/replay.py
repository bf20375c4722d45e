"""The verb `replay`: a recording stands in for devices, host, or both.

motorhil replay FILE --as device SCRIPT    an application against recorded devices
motorhil replay FILE --as host             the recorded host against a rig or real devices
motorhil replay FILE --as traffic          recorded frames on a bus, at their times
"""

import argparse
import json
import math
import shlex
import sys
import tempfile
from contextlib import ExitStack, contextmanager
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Final

from motorhil.harness.cli.main import FAILED, INTERRUPTED, NOT_JUDGED, PASSED, WRONG_USAGE
from motorhil.harness.cli.options import (
    add_eds,
    add_max_memory,
    add_seed,
    attachments_of,
    identifier,
    print_table,
    real,
    whole,
)
from motorhil.harness.cli.printable import teller
from motorhil.harness.cli.progress import StatusLine, following
from motorhil.harness.cli.times import add_span, span_in, span_of
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.virtual_time.interrupts import ends_by_signal
from motorhil.motorapi.errors import MotorError
from motorhil.traces.formats.frames import Findings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from motorhil.harness.replay.frames import Choice, Replayed, Sink, Survey
    from motorhil.harness.replay.host import HostPlayer, HostReplay, Pace
    from motorhil.harness.rig.config.rig_file import RigDescription
    from motorhil.harness.rig.rig import Rig
    from motorhil.motorapi.runtime.api import Runtime
    from motorhil.traces.formats.frames import Frame
    from motorhil.traces.semantics.diff import Difference, ObjectFidelity

_OF_MODES: Final = {
    "SCRIPT": ("script", ("device",)),
    "--on": ("on", ("host", "traffic")),
    "--bitrate": ("bitrate", ("host", "traffic")),
    "--speed": ("speed", ("host", "traffic")),
    "--max-pause": ("max_pause", ("host", "traffic")),
    "--json": ("json", ("host", "traffic")),
    "--partial": ("partial", ("device",)),
    "--reset": ("reset", ("host",)),
    "--host-node": ("host_node", ("host",)),
    "--all": ("all", ("host",)),
    "--bus": ("bus", ("traffic",)),
    "--id": ("id", ("traffic",)),
    "--node": ("node", ("traffic",)),
    "--from": ("from_at", ("traffic",)),
    "--to": ("to_at", ("traffic",)),
    "--last": ("last_ns", ("traffic",)),
    "--fd": ("fd", ("traffic",)),
}
"""Options that apply only to some modes: their attribute and these modes."""
_FACTOR: Final = real(1e-3, 1e6)
_SHOWN = 20
_NS: Final = 1_000_000_000
_SHOW_NS: Final = 250_000_000
_TRAFFIC_SHOWN: Final = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `replay`."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording of any format")
    parser.add_argument(
        *("--as",),
        required=True,
        choices=("device", "host", "traffic"),
        dest="mode",
        help="device: its devices answer SCRIPT as recorded; host: its host drives a rig, and the "
        "answers are compared; traffic: its frames are sent again at their times",
    )
    parser.add_argument("script", nargs="?", metavar="SCRIPT", help="a Python program, or -")
    parser.add_argument(
        "args", nargs="*", default=[], metavar="ARGS", help="arguments of the script"
    )
    parser.add_argument(
        "--rig", type=Path, metavar="RIG", help="a rig file (default: the recording's own rig)"
    )
    add_eds(parser)
    add_max_memory(parser)
    parser.add_argument(
        "--set-points",
        choices=("exact", "any"),
        default="exact",
        help="any: set-points in PDOs may differ (device)",
    )
    parser.add_argument(
        "--partial",
        action="store_true",
        help="SCRIPT may leave out commands of the recording, or end before it (device)",
    )
    parser.add_argument(
        "--realtime", action="store_true", help="run at most as fast as the wall clock"
    )
    add_seed(parser)
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="record to FILE (MCAP)")
    parser.add_argument(
        "--speed",
        type=_speed,
        metavar="X",
        help="pauses of the host, or all traffic, X times faster; max: traffic without pauses",
    )
    parser.add_argument(
        "--patience",
        type=real(0.0, 1e6, "s"),
        default=2.0,
        metavar="S",
        help="how much longer than recorded the host waits for an answer (default 2)",
    )
    parser.add_argument(
        "--tolerance",
        type=real(0.0, 1e9),
        default=0.01,
        metavar="X",
        help="tolerance of a quantity, as a share of its range (host; default 0.01)",
    )
    parser.add_argument("--reset", action="store_true", help="reset all nodes first (host)")
    parser.add_argument("--all", action="store_true", help="print all differences, not only 20")
    _add_host_node(parser)
    _add_traffic(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def _add_host_node(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--host-node",
        action="append",
        type=whole(1, 127),
        default=[],
        metavar="N",
        help="node-ID of the recorded host itself, whose heartbeats are not a device's (host)",
    )


def _add_traffic(parser: argparse.ArgumentParser) -> None:
    traffic = parser.add_argument_group(
        "for --as traffic; --on, --bitrate and --max-pause also for --as host"
    )
    traffic.add_argument(
        "--on",
        action="append",
        default=[],
        metavar="[BUS=]WHERE",
        help="target of a recorded bus: as in `motorhil record`, or a bus of --rig",
    )
    traffic.add_argument("--bus", action="append", metavar="NAME", help="only this bus")
    traffic.add_argument(
        "--id", action="append", type=identifier, metavar="HEX", help="only this identifier"
    )
    traffic.add_argument(
        "--node",
        action="append",
        type=whole(1, 127),
        metavar="N",
        help="only this node",
    )
    traffic.add_argument(
        "--max-pause",
        type=real(1.0, 1e9, "s"),
        metavar="S",
        help="refuse a recording with a longer pause between two frames (default: an hour)",
    )
    add_span(traffic)
    traffic.add_argument(
        "--bitrate", type=whole(1, 10**8, "bit/s"), metavar="N", help="bit rate, for python-can"
    )
    traffic.add_argument("--fd", action="store_true", help="CAN FD, for python-can")


def _speed(text: str) -> float:
    try:
        return math.inf if text == "max" else _FACTOR(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}, nor max") from None


def run(options: argparse.Namespace) -> int:
    """Replay a recording; return 0 if it passed, 1 if it differs from the recording.

    Raises:
        RigError, TraceError: a file cannot be used.
    """
    from motorhil.harness.recording.conversion import as_mcap
    from motorhil.harness.rig.config.toml import refuse_source

    if options.mode != "traffic" and options.speed == math.inf:
        print("motorhil replay: --speed max is for --as traffic; give a number", file=sys.stderr)
        return WRONG_USAGE
    idle = [
        word
        for word, (name, modes) in _OF_MODES.items()
        if options.mode not in modes and getattr(options, name)
    ]
    if idle:
        text = f"{', '.join(idle)}: not for --as {options.mode}"
        print(f"motorhil replay: {text}; leave out these options", file=sys.stderr)
        return WRONG_USAGE
    if options.output is not None:
        refuse_source(options.file, options.output)
    options.named = options.file
    tell = teller("replay")
    attachments = attachments_of(options.eds)
    with as_mcap(options.file, tell, attachments, options.max_memory) as options.file:
        try:
            status: int = _MODES[options.mode](options)
        except RigError as error:  # the user knows only the file that was converted
            if error.line is not None or error.key or Path(error.file).name != options.file.name:
                raise
            raise RigError(options.named, error.message, error.remedy) from None
    return status


def replay_as_device(options: argparse.Namespace) -> int:
    """Return the script's exit status; 1 if it raised, or its commands were not the recorded ones.

    Raises:
        RigError: the recording, the rig or the script cannot be used.
    """
    from motorhil.harness.cli.run import run_judged
    from motorhil.harness.rig.rig import Rig
    from motorhil.harness.rig.script import read_script

    words = [*options.args, *(options.rest or ())]
    script = None if options.script is None else read_script(options.script)
    rig = Rig(
        _described(options), seed=options.seed, realtime=options.realtime, record=options.output
    )
    whole = script is not None and not options.partial
    status = run_judged(rig, script, words, "replay", whole)
    if status != PASSED and script is not None:
        print(f"again: {_repeat_command(options, rig, words)}", file=sys.stderr)
    return status


def _described(options: argparse.Namespace) -> "RigDescription":
    from motorhil.harness.replay.rig import with_recorded
    from motorhil.harness.rig.reading import describe

    rig = describe(options.file if options.rig is None else options.rig)
    return with_recorded(rig, options.file, options.set_points)


def _repeat_command(options: argparse.Namespace, rig: "Rig", words: list[str]) -> str:
    command = ["motorhil", "replay", str(options.named), "--as", "device", options.script]
    command += ["--seed", str(rig.seed)]
    if options.rig is not None:
        command += ["--rig", str(options.rig)]
    for given in options.eds:
        command += ["--eds", str(given)]
    if options.partial:
        command.append("--partial")
    if options.set_points != "exact":
        command += ["--set-points", options.set_points]
    if options.realtime:
        command.append("--realtime")
    if options.output is not None:
        command += ["-o", str(options.output)]
    return shlex.join([*command, "--", *words] if words else command)


def replay_as_host(options: argparse.Namespace) -> int:
    """Return exit status 0 if the devices behaved as recorded, otherwise 1.

    Raises:
        RigError: the rig cannot be used.
        TraceError: the recording cannot be read, or the new one cannot be written.
    """
    from motorhil.harness.recording.sources import PlaceError
    from motorhil.harness.replay.frames import PAUSE_MAX_S
    from motorhil.harness.replay.host import compared, prepared
    from motorhil.harness.rig.config.buses import CAN
    from motorhil.traces.semantics.diff import Tolerance

    notes: list[str] = []
    with ends_by_signal(), ExitStack() as cleanup:
        folder = Path(cleanup.enter_context(tempfile.TemporaryDirectory(prefix="motorhil-")))
        live = options.output or folder / "live.mcap"
        try:
            buses: list[str] = []
            description = None if options.on else _described_host(options, folder)
            if description is not None:
                buses = [bus for bus, one in description.buses.items() if one.kind == CAN]
            options.file = cleanup.enter_context(
                prepared(options.file, buses, notes, options.max_pause or PAUSE_MAX_S)
            )
            if description is None:
                done = _on_buses(options, live)
            else:
                done = _on_rig(options, description, live)
        except PlaceError as error:
            print(f"motorhil replay: {error}", file=sys.stderr)
            return WRONG_USAGE
        except MotorError as error:  # a bus failed
            print(f"motorhil replay: {error}", file=sys.stderr)
            return FAILED
        found, differing = compared(
            *(options.file, live, done.player.pairs),
            *(Tolerance(share=options.tolerance), done.reading),
        )
    for note in (*notes, *done.notes):
        print(f"motorhil replay: {options.named}: {note}", file=sys.stderr)
    player = done.player
    if player.unsent:
        what = "cannot be sent on a classical bus (CAN FD, or malformed)"
        print(f"{options.named}: {player.unsent} frames of the host {what}", file=sys.stderr)
    if options.json:
        print(json.dumps(_facts(player, found, differing)))
    else:
        _print_host_result(options, player, found, differing)
    if differing or player.missed:
        return FAILED
    if not any(one.is_compared for one in found):
        print(
            f"motorhil replay: {options.named}: nothing was compared: no value of these devices "
            "can be compared; compare the new recording (-o) with 'motorhil show'",
            file=sys.stderr,
        )
        return NOT_JUDGED
    return PASSED


def _on_rig(options: argparse.Namespace, description: "RigDescription", live: Path) -> "HostReplay":
    """Drive emulated devices, in virtual time or in real time."""
    from motorhil.harness.replay.host import DrivenRig, bench_of, drive
    from motorhil.harness.rig.rig import Rig

    with Rig(
        description,
        seed=options.seed,
        realtime=options.realtime,
        record=live,
        truths=options.output is not None,  # the comparison does not need them
    ) as rig:
        for note in rig.notes:
            print(note, file=sys.stderr)
        bench = bench_of(description)
        return drive(DrivenRig(rig), options.file, _pace(options), options.host_node, bench)


def _on_buses(options: argparse.Namespace, live: Path) -> "HostReplay":
    """Drive devices on buses outside the rig, in wall time."""
    from motorhil.harness.recording.sources import PlaceError, places_of_buses
    from motorhil.harness.replay.host import drive
    from motorhil.harness.replay.real_bus import DrivenBuses
    from motorhil.traces.mcap.reader import read_trace

    if options.rig is not None:
        raise PlaceError("--on and --rig exclude each other; give one of them")
    with read_trace(options.file) as trace:
        topics = sorted({channel.topic for channel in trace.channels.values()})
    buses = [topic.removeprefix("/can/") for topic in topics if topic.startswith("/can/")]
    places = places_of_buses(options.on, buses or ["can0"])
    with DrivenBuses(places, options.bitrate, live, options.file) as driven:
        return drive(driven, options.file, _pace(options), options.host_node)


def _pace(options: argparse.Namespace) -> "Pace":
    from motorhil.harness.replay.host import Pace

    return Pace(options.speed or 1.0, round(options.patience * 1e9), options.reset)


def _described_host(options: argparse.Namespace, folder: Path) -> "RigDescription":
    """Return the named rig, or the rig of the recording."""
    from motorhil.harness.replay.rig import own_rig
    from motorhil.harness.rig.reading import describe, installed_plugins

    if options.rig is not None:
        return describe(options.rig)
    found = own_rig(options.file, installed_plugins(), folder)
    if found is None:
        raise RigError(options.file, "holds no rig file", "name a rig to drive: --rig RIG")
    return found


def _print_host_result(
    options: argparse.Namespace,
    done: "HostPlayer",
    found: "list[ObjectFidelity]",
    differing: "list[Difference]",
) -> None:
    rows = [
        (
            one.label,
            f"{one.first}",
            f"{one.second}",
            f"{100 * one.share:.1f} %" if one.is_compared else "not compared",
            "" if one.worst is None or not math.isfinite(one.worst) else f"{one.worst:g}",
            f"{one.worst_ns / 1e9:.3f}" if one.worst else "",
        )
        for one in found
    ]
    print_table(("object", "recorded", "now", "agree", "worst", "at s"), rows)
    missed = done.missed
    for one in missed[: None if options.all else _SHOWN]:
        print(
            f"{one.time_ns / 1e9:12.6f} s  waited in vain: {one.awaited.text} (recorded at "
            f"{one.awaited.time_ns / 1e9:.6f} s), before: {one.step.text}; {one.instead}"
        )
    for difference in differing[: None if options.all else _SHOWN]:
        print(f"{difference.time_ns / 1e9:12.6f} s  {difference}")
    whole = sum(one.agreeing for one in found)
    of = sum(one.of for one in found)
    compared = sum(one.is_compared for one in found)
    others = f" and {len(found) - compared} not compared" if compared < len(found) else ""
    print(
        f"\n{done.sent} frames of the host sent; {compared} objects{others}, "
        f"{100 * whole / max(1, of):.2f} % of what they tell agrees; "
        f"{len(differing)} differences, {len(missed)} times waited in vain"
    )


def _facts(
    done: "HostPlayer", found: "list[ObjectFidelity]", differing: "list[Difference]"
) -> dict[str, object]:
    return {
        "sent": done.sent,
        "unsent": done.unsent,
        "objects": [
            {
                "object": one.label,
                "recorded": one.first,
                "now": one.second,
                "share": one.share if one.is_compared else None,
                "worst": one.worst if one.worst is None or math.isfinite(one.worst) else None,
                "worst_ns": one.worst_ns,
            }
            for one in found
        ],
        "differences": [
            {"time_ns": one.time_ns, "about": one.label, "text": str(one)} for one in differing
        ],
        "missed": [
            {
                "time_ns": one.time_ns,
                "awaited": one.awaited.text,
                "recorded_ns": one.awaited.time_ns,
                "before": one.step.text,
                "instead": one.instead,
            }
            for one in done.missed
        ],
    }


def replay_traffic(options: argparse.Namespace) -> int:
    """Return the exit status: 0 all sent, 1 a bus refused, 2 not started, 130 Ctrl-C.

    Raises:
        RigError: the recording or the rig cannot be used.
        TraceError: the recording cannot be read, or has too long a pause.
    """
    from motorhil.harness.recording.sources import PlaceError
    from motorhil.harness.replay.frames import SendError, TrafficReplay, refuse_long

    choice = _choice(options)
    found = _surveyed(options, choice)
    with ExitStack() as cleanup:
        try:
            sinks, runtime = _open(options, list(found.frames), cleanup)
            refuse_long(found, sinks)
        except (PlaceError, SendError) as error:
            print(f"motorhil replay: {error}", file=sys.stderr)
            return WRONG_USAGE
        for bus, count in found.frames.items():
            if bus not in sinks:
                print(f"{options.named}: {count} frames of {bus} are not sent", file=sys.stderr)
        speed = options.speed or 1.0
        scale = None if math.isinf(speed) else Fraction(speed)
        replay = TrafficReplay(sinks, runtime, found.first_ns, scale)
        status = PASSED
        try:
            with _progress_line(found, runtime) as show:
                replay.run(_frames(options, choice), show)
        except SendError as error:
            print(f"motorhil replay: {error}", file=sys.stderr)
            status = FAILED
        except KeyboardInterrupt:
            print("motorhil replay: interrupted", file=sys.stderr)
            status = INTERRUPTED
        replay.done.ended_ns = runtime.now_ns()
        _print_traffic_result(options, replay.done, found, sinks, scale)
    return status


def _surveyed(options: argparse.Namespace, choice: "Choice") -> "Survey":
    """Return a summary of the frames to send, if they can be sent at their times."""
    from motorhil.harness.replay.frames import PAUSE_MAX_S, survey

    findings = Findings()
    with following("replay", [options.file]):
        found = survey(_frames(options, choice, findings))
    for _, problem in findings.problems[:_TRAFFIC_SHOWN]:
        print(f"{options.named}: {problem}", file=sys.stderr)
    if not found.frames:
        raise RigError(options.file, "holds no CAN frame to send", "change or drop the filters")
    if options.speed != math.inf:
        found.pauses.refuse(str(options.named), options.max_pause or PAUSE_MAX_S)
    return found


def _choice(options: argparse.Namespace) -> "Choice":
    from motorhil.harness.replay.frames import Choice

    def chosen(values: "list[str] | list[int] | None") -> "tuple[object, ...] | None":
        return None if values is None else tuple(values)

    tell = teller("replay")
    span = span_in(options.file, options)
    from_ns, to_ns = span_of(options, options.named, span, tell)
    return Choice(
        buses=chosen(options.bus),  # type: ignore[arg-type]  # argparse has made them so
        identifiers=chosen(options.id),  # type: ignore[arg-type]
        nodes=chosen(options.node),  # type: ignore[arg-type]
        from_ns=from_ns,
        to_ns=to_ns,
    )


def _frames(
    options: argparse.Namespace, choice: "Choice", findings: Findings | None = None
) -> "Iterator[Frame]":
    from motorhil.traces.formats.registry import recorded_frames
    from motorhil.traces.mcap.reader import read_trace

    with read_trace(options.file) as trace:
        yield from choice.of(recorded_frames(trace, findings or Findings()))


def _open(
    options: argparse.Namespace, buses: list[str], cleanup: ExitStack
) -> "tuple[dict[str, Sink], Runtime]":
    """Return the sink of each recorded bus, and the runtime; raise PlaceError or RigError."""
    from motorhil.harness.recording.sources import PlaceError, places_of_buses
    from motorhil.harness.replay.real_bus import RigSink, open_sink

    rig = _rig(options, cleanup) if options.rig is not None else None
    if rig is None and not options.on:
        raise PlaceError(
            f"no destination given: name a bus with --on {buses[0]}=vcan0, or a rig with --rig RIG"
        )
    interface: dict[str, object] = {"bitrate": options.bitrate} if options.bitrate else {}
    if options.fd:
        interface["fd"] = True
    note = teller("replay")
    sinks: dict[str, Sink] = {}
    for name, place in places_of_buses(options.on, buses).items():
        if rig is not None:
            sinks[name] = RigSink(rig, place.channel, note)
        else:
            sinks[name] = open_sink(place, interface, note)
        cleanup.callback(sinks[name].close)
    if rig is not None:
        if not sinks:
            known = [bus for bus in buses if bus in rig.world.bus_names()]
            sinks = {bus: RigSink(rig, bus, note) for bus in known}
        if not sinks:
            available = ", ".join(rig.world.bus_names())
            raise PlaceError(
                f"the rig has no bus {buses[0]}; write --on {buses[0]}=BUS; available: {available}"
            )
        return sinks, rig.runtime
    from motorhil.motorapi.runtime.wall import WallRuntime

    runtime = WallRuntime()
    cleanup.callback(runtime.close)
    return sinks, runtime


def _rig(options: argparse.Namespace, cleanup: ExitStack) -> "Rig":
    from motorhil.harness.rig.rig import Rig

    return cleanup.enter_context(
        Rig.open(options.rig, options.seed, options.realtime, options.output)
    )


@contextmanager
def _progress_line(
    found: "Survey", runtime: "Runtime"
) -> "Iterator[Callable[[int, int], None] | None]":
    """Provide a display of the progress, or None if stderr is not a terminal."""
    line = StatusLine()
    if not line.is_terminal:
        yield None
        return
    total = sum(found.frames.values())
    shown_ns = [0]

    def show(time_ns: int, number: int) -> None:
        if runtime.now_ns() - shown_ns[0] >= _SHOW_NS:
            shown_ns[0] = runtime.now_ns()
            at_s, of_s = (time_ns - found.first_ns) / _NS, found.span_ns / _NS
            line.show(f"{at_s:.1f} of {of_s:.1f} s, {number:,} of {total:,} frames")

    try:
        yield show
    finally:
        line.clear()


def _print_traffic_result(
    options: argparse.Namespace,
    done: "Replayed",
    found: "Survey",
    sinks: "dict[str, Sink]",
    speed: Fraction | None,
) -> None:
    took_s = (done.ended_ns - done.began_ns) / _NS
    late = done.late
    figures = {
        "median": late.quantile_ns(0.5),
        "99 %": late.quantile_ns(0.99),
        "worst": late.worst_ns,
        "at the end": late.last_ns,
    }
    if options.json:
        facts = {
            "sent": done.sent,
            "errors": done.errors,
            "not_sent": {bus: n for bus, n in found.frames.items() if bus not in sinks},
            "recorded_ns": found.span_ns,
            "took_ns": done.ended_ns - done.began_ns,
            "late_ns": dict(zip(("median", "p99", "worst", "end"), figures.values(), strict=True)),
        }
        print(json.dumps(facts))
        return
    for bus, count in done.errors.items():
        print(f"{options.named}: {count} error frames of {bus} cannot be sent", file=sys.stderr)
    each = ", ".join(f"{n} of {bus} to {sinks[bus].name}" for bus, n in done.sent.items())
    each = each.replace(" of", " frames of", 1) or "nothing"
    text = f"{each} in {took_s:.3f} s, recorded in {found.span_ns / _NS:.3f} s"
    if speed is not None:
        text += "; late: " + ", ".join(f"{name} {ns / 1e6:.3f} ms" for name, ns in figures.items())
    print(text)


_MODES: Final = {"device": replay_as_device, "host": replay_as_host, "traffic": replay_traffic}
