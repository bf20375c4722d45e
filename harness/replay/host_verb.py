"""`motorhil replay FILE --as host`: the recorded host against a rig or real devices."""

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from harness.exit_status import FAILED, PASSED, WRONG_USAGE
from harness.interrupts import ends_by_signal
from harness.settings import RigError
from harness.text_table import print_table
from motorapi.errors import MotorError

if TYPE_CHECKING:
    from harness.replay.host_player import HostPlayer
    from harness.rig_file import RigDescription
    from traces.fidelity import ObjectFidelity
    from traces.semantic_diff import Difference

_SHOWN = 20


def run(options: argparse.Namespace) -> int:
    """Return exit status 0 if the devices behaved as recorded, otherwise 1.

    Raises:
        RigError: the rig cannot be used.
        TraceError: the recording cannot be read, or the new one cannot be written.
    """
    from harness.recording.places import PlaceError
    from harness.replay.as_host import compared
    from traces.semantic_diff import Tolerance

    with ends_by_signal(), tempfile.TemporaryDirectory(prefix="motorhil-") as folder:
        live = options.output or Path(folder, "live.mcap")
        try:
            done = _on_buses(options, live) if options.on else _on_rig(options, live, Path(folder))
        except PlaceError as error:
            print(f"motorhil replay: {error}", file=sys.stderr)
            return WRONG_USAGE
        except MotorError as error:  # a bus failed
            print(f"motorhil replay: {error}", file=sys.stderr)
            return FAILED
        found, differing = compared(
            options.file, live, done.pairs, Tolerance(share=options.tolerance)
        )
    if done.unsent:
        what = "cannot be sent on a classical bus (CAN FD, or malformed)"
        print(f"{options.file}: {done.unsent} frames of the host {what}", file=sys.stderr)
    if options.json:
        print(json.dumps(_facts(done, found, differing)))
    else:
        _tell(options, done, found, differing)
    return FAILED if differing or done.missed else PASSED


def _on_rig(options: argparse.Namespace, live: Path, folder: Path) -> "HostPlayer":
    """Drive emulated devices, in virtual time or in real time."""
    from harness.replay.as_host import DrivenRig, drive
    from harness.rig import Rig

    description = _described(options, folder)
    with Rig(description, seed=options.seed, realtime=options.realtime, record=live) as rig:
        for note in rig.notes:
            print(note, file=sys.stderr)
        return drive(DrivenRig(rig), options.file, *_pace(options))


def _on_buses(options: argparse.Namespace, live: Path) -> "HostPlayer":
    """Drive devices on buses outside the rig, in wall time."""
    from harness.recording.places import PlaceError, places_of_buses
    from harness.replay.as_host import drive
    from harness.replay.real_buses import DrivenBuses
    from traces.reader import read_trace

    if options.rig is not None:
        raise PlaceError("--on and --rig exclude each other; give one of them")
    with read_trace(options.file) as trace:
        topics = sorted({channel.topic for channel in trace.channels.values()})
    buses = [topic.removeprefix("/can/") for topic in topics if topic.startswith("/can/")]
    places = places_of_buses(options.on, buses or ["can0"])
    with DrivenBuses(places, options.bitrate, live, options.file) as driven:
        return drive(driven, options.file, *_pace(options))


def _pace(options: argparse.Namespace) -> tuple[float, int, bool]:
    return options.speed or 1.0, round(options.patience * 1e9), options.reset


def _described(options: argparse.Namespace, folder: Path) -> "RigDescription":
    """Return the named rig, or the rig of the recording."""
    from harness.replay.recorded_rig import own_rig
    from harness.rig import describe, installed_plugins

    if options.rig is not None:
        return describe(options.rig)
    found = own_rig(options.file, installed_plugins(), folder)
    if found is None:
        raise RigError(options.file, "holds no rig file", "name a rig to drive: --rig RIG")
    return found


def _tell(
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
