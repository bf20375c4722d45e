"""`motorhil replay FILE --as traffic`: recorded frames on a bus, at their times."""

import argparse
import json
import math
import sys
from contextlib import ExitStack
from fractions import Fraction
from typing import TYPE_CHECKING, Final

from harness.exit_status import FAILED, INTERRUPTED, PASSED, WRONG_USAGE
from harness.settings import RigError
from traces.traffic import Findings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from harness.replay.traffic import Choice, Replayed, Sink, Survey
    from harness.rig import Rig
    from motorapi.runtime import Runtime
    from traces.traffic import Frame

_NS: Final = 1_000_000_000
_TELL_NS: Final = 250_000_000
_SHOWN: Final = 3


def run(options: argparse.Namespace) -> int:
    """Return the exit status: 0 all sent, 1 a bus refused, 2 not started, 130 Ctrl-C.

    Raises:
        RigError: the recording or the rig cannot be used.
        TraceError: the recording cannot be read.
    """
    from harness.recording.places import PlaceError
    from harness.replay.traffic import SendError, TrafficReplay, refuse_long, survey

    choice = _choice(options)
    findings = Findings()
    found = survey(_frames(options, choice, findings))
    for _, problem in findings.problems[:_SHOWN]:
        print(f"{options.file}: {problem}", file=sys.stderr)
    if not found.frames:
        raise RigError(options.file, "holds no CAN frame to send", "change or drop the filters")
    with ExitStack() as cleanup:
        try:
            sinks, runtime = _open(options, list(found.frames), cleanup)
            refuse_long(found, sinks)
        except (PlaceError, SendError) as error:
            print(f"motorhil replay: {error}", file=sys.stderr)
            return WRONG_USAGE
        for bus, count in found.frames.items():
            if bus not in sinks:
                print(f"{options.file}: {count} frames of {bus} are not sent", file=sys.stderr)
        speed = options.speed or 1.0
        scale = None if math.isinf(speed) else Fraction(speed)
        replay = TrafficReplay(sinks, runtime, found.first_ns, scale)
        status = PASSED
        try:
            replay.run(_frames(options, choice), _teller(found, runtime))
        except SendError as error:
            print(f"motorhil replay: {error}", file=sys.stderr)
            status = FAILED
        except KeyboardInterrupt:
            print("motorhil replay: interrupted", file=sys.stderr)
            status = INTERRUPTED
        replay.done.ended_ns = runtime.now_ns()
        _tell(options, replay.done, found, sinks, scale)
    return status


def _choice(options: argparse.Namespace) -> "Choice":
    from harness.replay.traffic import Choice

    def chosen(values: "list[str] | list[int] | None") -> "tuple[object, ...] | None":
        return None if values is None else tuple(values)

    return Choice(
        buses=chosen(options.bus),  # type: ignore[arg-type]  # argparse has made them so
        identifiers=chosen(options.id),  # type: ignore[arg-type]
        nodes=chosen(options.node),  # type: ignore[arg-type]
        from_ns=options.from_ns,
        to_ns=options.to_ns,
    )


def _frames(
    options: argparse.Namespace, choice: "Choice", findings: Findings | None = None
) -> "Iterator[Frame]":
    from traces.reader import read_trace
    from traces.traffic_mcap import recorded_frames

    with read_trace(options.file) as trace:
        yield from choice.of(recorded_frames(trace, findings or Findings()))


def _open(
    options: argparse.Namespace, buses: list[str], cleanup: ExitStack
) -> "tuple[dict[str, Sink], Runtime]":
    """Return the sink of each recorded bus, and the runtime; raise PlaceError or RigError."""
    from harness.recording.places import PlaceError, places_of_buses
    from harness.replay.sinks import RigSink, open_sink

    rig = _rig(options, cleanup) if options.rig is not None else None
    if rig is None and not options.on:
        raise PlaceError(
            f"no destination given: name a bus with --on {buses[0]}=vcan0, or a rig with --rig RIG"
        )
    interface: dict[str, object] = {"bitrate": options.bitrate} if options.bitrate else {}
    if options.fd:
        interface["fd"] = True
    sinks: dict[str, Sink] = {}
    for name, place in places_of_buses(options.on, buses).items():
        sinks[name] = RigSink(rig, place.channel) if rig else open_sink(place, interface)
        cleanup.callback(sinks[name].close)
    if rig is not None:
        if not sinks:
            sinks = {bus: RigSink(rig, bus) for bus in buses if bus in rig.world.bus_names()}
        if not sinks:
            known = ", ".join(rig.world.bus_names())
            raise PlaceError(
                f"the rig has no bus {buses[0]}; write --on {buses[0]}=BUS; available: {known}"
            )
        return sinks, rig.runtime
    from motorapi.wall_runtime import WallRuntime

    runtime = WallRuntime()
    cleanup.callback(runtime.close)
    return sinks, runtime


def _rig(options: argparse.Namespace, cleanup: ExitStack) -> "Rig":
    from harness.rig import Rig

    return cleanup.enter_context(
        Rig.open(options.rig, options.seed, options.realtime, options.output)
    )


def _teller(found: "Survey", runtime: "Runtime") -> "Callable[[int, int], None] | None":
    """Return a display of the progress, or None if stderr is not a terminal."""
    if not sys.stderr.isatty():
        return None
    total = sum(found.frames.values())
    shown_ns = [0]

    def tell(time_ns: int, number: int) -> None:
        if runtime.now_ns() - shown_ns[0] >= _TELL_NS:
            shown_ns[0] = runtime.now_ns()
            at_s, of_s = (time_ns - found.first_ns) / _NS, found.span_ns / _NS
            sys.stderr.write(
                f"\r{at_s:.1f} of {of_s:.1f} s, {number:,} of {total:,} frames\x1b[K\r"
            )
            sys.stderr.flush()

    return tell


def _tell(
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
        print(f"{options.file}: {count} error frames of {bus} cannot be sent", file=sys.stderr)
    each = ", ".join(f"{n} of {bus} to {sinks[bus].name}" for bus, n in done.sent.items())
    each = each.replace(" of", " frames of", 1) or "nothing"
    told = f"{each} in {took_s:.3f} s, recorded in {found.span_ns / _NS:.3f} s"
    if speed is not None:
        told += "; late: " + ", ".join(f"{name} {ns / 1e6:.3f} ms" for name, ns in figures.items())
    print(told)
