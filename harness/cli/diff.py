"""The verb `diff`: compares the meaning of two recordings."""

import argparse
import json
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from motorhil.harness.cli.main import FAILED, NOT_JUDGED, PASSED
from motorhil.harness.cli.options import add_max_memory, print_table, real, whole
from motorhil.harness.cli.printable import teller
from motorhil.harness.cli.show import text_of
from motorhil.harness.recording.conversion import open_recording
from motorhil.traces.decoding.narrative import Line, Story
from motorhil.traces.digest import first_mismatch
from motorhil.traces.mcap.reader import Trace
from motorhil.traces.semantics.diff import Difference, Tolerance, differences
from motorhil.traces.semantics.model import Meaning, meaning_of

_NS = 1_000_000_000
_AROUND_NS = 2 * _NS


_NO_EVENTS: Final = "no event of known meaning; use --exact to compare bytes"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `diff`."""
    usual = Tolerance()
    parser.add_argument("first", metavar="A", help="a recording of any format")
    parser.add_argument("second", metavar="B", help="another one")
    parser.add_argument(
        "--exact", action="store_true", help="compare bytes and times of all messages"
    )
    parser.add_argument(
        "--tolerance",
        type=real(0.0, 1e9),
        default=usual.position,
        metavar="X",
        help=f"tolerance of positions, rad or m (default {usual.position:g})",
    )
    parser.add_argument(
        "--tolerance-s",
        type=real(0.0, 1e9, "s"),
        default=usual.time_ns / _NS,
        metavar="S",
        help=f"tolerance of times of motions (default {usual.time_ns / _NS:g})",
    )
    parser.add_argument(
        "--context",
        type=whole(0, 1_000_000, "lines"),
        default=3,
        metavar="N",
        help="lines of context (default 3)",
    )
    parser.add_argument(
        "--motions",
        action="store_true",
        help="tell how far apart positions, velocities and torques of each motor are",
    )
    parser.add_argument(
        "--rig",
        type=Path,
        metavar="RIG",
        help="with --motions: a rig that knows the motors' units, if a recording has none",
    )
    add_max_memory(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> int:
    """Compare two recordings; return 0 if they mean the same, 1 if not.

    Raises:
        TraceError: a recording cannot be read, or is damaged.
    """
    if options.exact:
        return _exact(options)
    if options.motions:
        return _motions(options)
    tell, limit = teller("diff"), options.max_memory
    with (
        open_recording(options.first, tell, memory_max=limit) as first,
        open_recording(options.second, tell, memory_max=limit) as second,
    ):
        return _compare(options, first, second)


def _compare(options: argparse.Namespace, first: Trace, second: Trace) -> int:
    one, other = (_meaning_of(trace, options.max_memory) for trace in (first, second))
    found = differences(one, other, Tolerance(options.tolerance, round(options.tolerance_s * _NS)))
    if options.json:
        print(json.dumps({"same": not found, "differences": [_facts(each) for each in found]}))
        return FAILED if found else PASSED
    if found:
        _print_difference((first, second), found[0], options.context)
    _summarise(one, other, found)
    return FAILED if found else PASSED


def _meaning_of(trace: Trace, memory_max: int) -> Meaning:
    """Return the meaning of a recording; report a cut or an empty one on stderr."""
    meaning = meaning_of(trace, memory_max=memory_max)
    tell = teller("diff")
    if trace.cut is not None:
        tell(f"{trace.path}: {trace.cut}")
    if not meaning.items and not meaning.motions:
        tell(f"{trace.path}: {_NO_EVENTS}")
    return meaning


def _exact(options: argparse.Namespace) -> int:
    mismatch = first_mismatch(options.first, options.second, options.max_memory)
    if options.json:
        place = None if mismatch is None else mismatch.number
        print(json.dumps({"same": mismatch is None, "message": place}))
    else:
        print("every message is the same" if mismatch is None else mismatch)
    return PASSED if mismatch is None else FAILED


def _motions(options: argparse.Namespace) -> int:
    """Tell how far apart the motions of each motor in both recordings are."""
    from motorhil.harness.identification.distance import distances
    from motorhil.harness.identification.samples import motors_in

    first, second = (motors_in(Path(one), options.rig) for one in (options.first, options.second))
    others = {motor.name: motor for motor in second}
    found = [
        (motor.name, *apart)
        for motor in first
        if motor.name in others and (apart := distances(motor, others[motor.name])) is not None
    ]
    if options.json:
        facts = [
            {
                "motor": name,
                "later_s": shift.time_s,
                "higher": shift.position,
                "distances": [asdict(one) for one in rows],
            }
            for name, shift, rows in found
        ]
        print(json.dumps({"motors": facts}))
        return PASSED if found else NOT_JUDGED
    if not found:
        teller("diff")("no motor has positions in the same unit in both recordings")
        return NOT_JUDGED
    head = ("motor", "quantity", "unit", "apart (rms)", "of its rms", "at most")
    rows = [
        (
            one.motor,
            one.quantity,
            one.unit,
            f"{one.typical:.3g}",
            f"{one.share:.1%}",
            f"{one.largest:.3g}",
        )
        for _, _, found_rows in found
        for one in found_rows
    ]
    print_table(head, rows, words=(0, 1, 2))
    for name, shift, _ in found:
        print(
            f"{name}: {options.second} is {shift.time_s:+.3f} s later, {shift.position:+.4g} higher"
        )
    return PASSED


def _print_difference(traces: tuple[Trace, Trace], difference: Difference, context: int) -> None:
    """Print the difference, with both recordings' context of the same node or motor."""
    print(f"first difference, {difference.time_ns / _NS:.6f} s: {difference}")
    for trace, item in zip(traces, (difference.first, difference.second), strict=True):
        time_ns = difference.time_ns if item is None else item.time_ns
        print(f"\n{trace.path}:")
        for line in _around(trace, difference, time_ns, context):
            mark = ">" if item is not None and line.time_ns == item.time_ns else " "
            print(f"{mark}{text_of(line)}")


def _around(trace: Trace, difference: Difference, time_ns: int, count: int) -> Sequence[Line]:
    before: deque[Line] = deque(maxlen=count)
    after: list[Line] = []
    for line in Story(trace).lines(max(0, time_ns - _AROUND_NS), time_ns + _AROUND_NS):
        if not _is_about(line, difference):
            continue
        if line.time_ns < time_ns:
            before.append(line)
        elif line.time_ns == time_ns or len(after) <= count:
            after.append(line)
    return [*before, *after]


def _is_about(line: Line, difference: Difference) -> bool:
    place, node, _ = difference.key
    if node is not None:
        return line.place == place and line.said is not None and line.said.node == node
    return line.place == place or place in line.names


def _summarise(first: Meaning, second: Meaning, found: list[Difference]) -> None:
    orders = len({**first.items, **second.items})
    quantities = len({**first.motions, **second.motions})
    compared = f"{orders} orders of events and {quantities} motions"
    counts = f"{first.messages} and {second.messages} messages"
    if not found:
        print(f"the same: {compared} compared, in {counts}")
        return
    print(f"\n{len(found)} of {compared} differ, in {counts}:")
    for one in found[:20]:
        print(f"  {one.time_ns / _NS:12.6f} s  {one}")
    if len(found) > 20:
        print(f"  and {len(found) - 20} more")


def _facts(one: Difference) -> dict[str, object]:
    facts = {
        side: None if item is None else {"time_ns": item.time_ns, "text": item.text}
        for side, item in (("first", one.first), ("second", one.second))
    }
    return {"time_ns": one.time_ns, "about": one.label, **facts}
