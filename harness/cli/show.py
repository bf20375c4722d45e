"""The verb `show`: prints selected events of a recording as sentences."""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Final, final

from motorhil.harness.cli.main import PASSED
from motorhil.harness.cli.options import (
    NODE_MAX,
    add_descriptions,
    add_eds,
    add_max_memory,
    attachments_of,
    identifier,
    whole,
)
from motorhil.harness.cli.printable import print_as_is, teller
from motorhil.harness.cli.times import add_span, span_of
from motorhil.harness.recording.conversion import open_recording
from motorhil.harness.recording.decoders import description_for
from motorhil.harness.rig.config.toml import one_line
from motorhil.harness.rig.fragment import read_fragment
from motorhil.traces.decoding.events import PERIODIC, Fact, Kind
from motorhil.traces.decoding.narrative import Line, Story
from motorhil.traces.mcap.reader import Trace
from motorhil.traces.protobuf import Value

_NS: Final = 1_000_000_000
_POLL_S: Final = 0.2  # a recorder writes once a second


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `show`."""
    parser.add_argument("file", metavar="FILE", help="a recording of any format")
    add_span(parser)
    add_max_memory(parser)
    parser.add_argument(
        "--bus", action="append", metavar="NAME", help="only this bus or line; may be repeated"
    )
    parser.add_argument(
        "--id",
        action="append",
        type=identifier,
        metavar="HEX",
        help="only CAN frames with this identifier",
    )
    parser.add_argument(
        "--node",
        action="append",
        type=whole(0, NODE_MAX),
        metavar="N",
        help="only this node or Modbus unit",
    )
    parser.add_argument("--motor", action="append", metavar="NAME", help="only this motor")
    add_eds(parser)
    add_descriptions(parser)
    parser.add_argument(
        "--brief",
        action="store_true",
        help="leave out SYNC, and heartbeats and PDOs without news other than motion",
    )
    parser.add_argument(
        "--follow",
        action="store_true",
        help="follow a recording in progress until it is complete, or Ctrl-C",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object per line")
    parser.add_argument(
        "--hands",
        action="store_true",
        help="print the acts by hand instead, as a fragment for `run --world`",
    )


def run(options: argparse.Namespace) -> int:
    """Print the selected lines; return 0.

    Raises:
        TraceError: the file cannot be read, or is damaged.
        RigError: the recording has no acts by hand.
    """
    if options.hands:
        print_as_is(read_fragment(Path(options.file)).text.rstrip("\n"))
        return PASSED
    tell = teller("show")
    attachments = attachments_of(options.eds)
    with open_recording(options.file, tell, attachments, options.max_memory) as trace:
        told = trace.attachments, options.dbc, options.decoder
        story = Story(trace, describe=description_for(*told, tell))
        wanted = _Filter(options, story)
        outside: list[str] = []
        from_ns, to_ns = span_of(options, trace.path, trace.span_ns(), outside.append)
        lines = story.lines(from_ns, to_ns)
        if options.follow:
            lines = followed(trace, story, from_ns, to_ns, _wait)
        shown = seen = 0
        with suppress(KeyboardInterrupt) if options.follow else nullcontext():
            for line in lines:
                seen += 1
                if wanted.takes(line):
                    shown += 1
                    print_as_is(json.dumps(facts_of(line)) if options.json else text_of(line))
        _warn(trace)
        if not shown:
            tell(outside[0] if outside else f"{trace.path}: {_nothing(trace, seen)}")
        for name in options.motor or ():
            if name not in wanted.met:
                print(f"motorhil show: no events of motor {name}", file=sys.stderr)
    return PASSED


def followed(
    trace: Trace,
    story: Story,
    from_ns: int | None,
    to_ns: int | None,
    wait: Callable[[], None],
) -> Iterator[Line]:
    """Yield the lines of a growing recording as they come; call `wait` in between.

    Raises:
        TraceError: the file is damaged, or was overwritten.
    """
    while True:
        yield from story.more_lines(from_ns, to_ns)
        if trace.cut is None:
            return
        while not trace.grow():
            wait()


def _wait() -> None:
    sys.stdout.flush()
    time.sleep(_POLL_S)


def text_of(line: Line) -> str:
    """Return a line as printable text: time [s], place, sentence."""
    text = f"{line.time_ns // _NS:5d}.{line.time_ns % _NS:09d}  {line.place:<8}  {line.text}"
    return text if text.isprintable() else one_line(text)


def facts_of(line: Line) -> dict[str, object]:
    """Return a line as JSON values."""
    table: dict[str, object] = {
        "time_ns": line.time_ns,
        "topic": line.topic,
        "text": line.text,
        "names": list(line.names),
    }
    if line.identifier is not None:
        table["id"] = line.identifier
    event = line.said
    if event is not None:
        table |= {"kind": event.kind.value, "node": line.node}
        if event.index is not None:
            table |= {"index": event.index, "subindex": event.subindex}
        table["facts"] = [
            {
                "subject": fact.subject,
                "value": _plain(fact.value),
                "text": fact.text,
                "told_to": fact.told_to,
            }
            for fact in event.facts
        ]
        if line.message is not None:
            table["message"] = line.message.as_table()
    elif line.values:
        table["values"] = {name: _plain(value) for name, value in line.values}
    return table


@final
class _Filter:
    """Selects lines by the options.

    Traffic has to pass every filter that is given. Locks and groups pass with their motors. Events
    always pass, except those that name other motors than --motor.
    """

    def __init__(self, options: argparse.Namespace, story: Story) -> None:
        self.met: set[str] = set()
        self._buses: list[str] | None = options.bus
        self._ids: list[int] | None = options.id
        self._nodes: list[int] | None = options.node
        self._motors: list[str] | None = options.motor
        self._brief: bool = options.brief
        given = (options.bus, options.id, options.node, options.motor)
        self._is_given: bool = self._brief or any(one is not None for one in given)
        self._story = story
        self._known: dict[tuple[str, int | None, Kind, str], object] = {}

    def takes(self, line: Line) -> bool:
        """Return whether a line is selected."""
        if not self._is_given:
            return True
        if not self._is_wanted(line):
            return False
        self.met.update(line.names)
        return not self._brief or self._has_changed(line)

    def _is_wanted(self, line: Line) -> bool:
        if line.topic == "/events":
            return self._motors is None or not line.names or self._has_motor(line)
        if line.topic.startswith(("/can/", "/modbus/", "/serial/")):
            return self._takes_traffic(line)
        if self._ids is not None:
            return False
        places = [self._story.names.motors.get(name) for name in line.names]
        return (
            (self._motors is None or self._has_motor(line))
            and (self._buses is None or any(p is None or p[0] in self._buses for p in places))
            and (self._nodes is None or any(p is None or p[1] in self._nodes for p in places))
        )

    def _takes_traffic(self, line: Line) -> bool:
        if self._buses is not None and line.place not in self._buses:
            return False
        if self._ids is not None and line.identifier not in self._ids:
            return False
        event = line.said
        to_all = event is not None and event.kind is Kind.NMT and event.node is None
        if self._nodes is not None and line.node not in self._nodes and not to_all:
            return False
        return self._motors is None or self._has_motor(line) or to_all

    def _has_motor(self, line: Line) -> bool:
        return any(name in (self._motors or ()) for name in line.names)

    def _has_changed(self, line: Line) -> bool:
        event = line.said
        if event is None or event.kind not in PERIODIC:
            return True
        if line.message is not None:
            place = (line.place, line.node, event.kind, line.message.name)
            is_new = self._known.get(place) != line.message
            self._known[place] = line.message
            return is_new
        changed = False
        for fact in event.facts:
            if fact.motion:
                continue
            key = (line.place, event.node, event.kind, fact.subject)
            if self._known.get(key) != fact.value:
                self._known[key] = fact.value
                changed = True
        return changed


def _nothing(trace: Trace, seen: int) -> str:
    """Return why no line was printed."""
    if seen:
        return f"none of {seen} lines matches the options"
    topics = ", ".join(sorted({channel.topic for channel in trace.channels.values()}))
    return f"no events at that time; topics: {topics or 'none'}"


def _warn(trace: Trace) -> None:
    if trace.cut is not None:
        more = f", {trace.salvaged} messages of its last chunk were read" if trace.salvaged else ""
        print(f"motorhil show: {trace.path}: {trace.cut}{more}", file=sys.stderr)


def _plain(value: "Value | Fact") -> object:
    return value.hex() if isinstance(value, bytes) else value
