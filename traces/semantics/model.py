"""Meaning of a recording: commands and reports in order, and motion.

Times and repetitions are ignored: a frame that repeats known values adds nothing. Each node, motor
and source of events has an order of its own, so frames of unrelated nodes can change places.
Commands to one node keep their order.
"""

import math
from array import array
from collections.abc import Callable, MutableSequence
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.traces.decoding.attached_rig import RecordedNames
from motorhil.traces.decoding.events import PERIODIC, DecodedEvent, Kind, Value
from motorhil.traces.decoding.narrative import BusMessage, Describe, Line, Story
from motorhil.traces.decoding.objects import axis_of
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.reader import Trace, TraceMessage
from motorhil.traces.schema import JOINT_STATE, DoublesDecoder

Key = tuple[str, int | None, str]
"""Bus, line, motor or group; node (None: none); subject."""

COMMANDS: Final = "commands"
_ALWAYS: Final = ("emergency", "NMT command")
_ALWAYS_AT_END: Final = ("aborted", "refused")
"""Reports that count each time: their subjects, or the ends of these."""
_QUANTITIES: Final = (0x6062, 0x6064, 0x607A, 0x60FF, 0x6071, 0x60C1)
"""Motion that is compared: positions and set-points, but not measured velocities and currents."""
POSITION_UNITS: Final = ("rad", "deg", "rev", "count", "pulses")
"""Units of described signals that are compared as motion; those of other units are measured."""
_COUNTERS: Final = (  # measured, without a unit: of a VESC, of a Dynamixel
    *("erpm", "tachometer"),
    *("Present_PWM", "Present_Current"),
)

_ITEM_BYTES: Final = 250
_SAMPLE_BYTES: Final = 20
_SHARED_MAX: Final = 1 << 14

Series = tuple[MutableSequence[int], MutableSequence[float]]
"""Times [ns] and values of a quantity."""


@final
@frozen
class Item:
    """One command or report, in order: time, value for comparison, and words."""

    time_ns: int
    what: tuple[object, ...]
    text: str


@final
class Meaning:
    """The meaning of a recording.

    Attributes:
        items: commands and reports by key, in order.
        motions: (times [ns], values) of quantities, by key.
        unheeded: number of reports of measured quantities that are not compared, by key.
        labels: names of keys, which depend on the names in the recording.
        messages: number of messages read.
        kept_bytes: about the memory of items and motions.
    """

    def __init__(self, of_devices: bool = False) -> None:
        """Start empty; `of_devices` leaves out commands to nodes."""
        self._of_devices = of_devices
        self.items: dict[Key, list[Item]] = {}
        self.motions: dict[Key, Series] = {}
        self.unheeded: dict[Key, int] = {}
        self.labels: dict[Key, str] = {}
        self.messages = 0
        self.kept_bytes: int = 0
        self._shared: dict[tuple[object, ...], tuple[tuple[object, ...], str]] = {}
        # By place, node, True for a command, and subject.
        self._last: dict[tuple[str, int | None, bool, str], Value] = {}

    def take(self, line: Line, names: dict[tuple[str, int], str]) -> None:
        """Take a line of the story."""
        if line.message is not None and line.message.node is not None:
            self._take_message(line, line.message, names)
            return
        if line.said is not None:
            self._take_said(line, line.said, names)
            return
        what = tuple(
            (name, tuple(value) if isinstance(value, list) else value)
            for name, value in line.values
            if name in _TELLING
        )
        if line.topic == "/events":
            key: Key = ("events", None, line.names[0] if line.names else "")
        else:
            key = (line.place, None, line.topic.rpartition("/")[2])
        if key not in self.labels:
            self.labels[key] = " ".join(str(part) for part in (key[0], key[2]) if part)
        self._add(key, line.time_ns, what or (line.text,), line.text)

    def take_state(self, time_ns: int, motor: str, position: float) -> None:
        """Take the position of a motor."""
        key: Key = (motor, None, "position")
        if key not in self.labels:
            self.labels[key] = f"motor {motor}, position"
        self._move(key, time_ns, position)

    def _take_message(
        self, line: Line, message: BusMessage, names: dict[tuple[str, int], str]
    ) -> None:
        """Take the signals of a device's message: positions as motion, states in order."""
        place, node = line.place, message.node
        assert node is not None
        name = names.get((place, node))
        who = f"{place}, node {node}" + (f" ({name})" if name else "")
        for signal, value, unit in message.signals:
            subject = f"{message.name} {signal}" + (f" [{unit}]" if unit else "")
            key: Key = (place, node, subject)
            self.labels.setdefault(key, f"{who}, {subject}")
            if isinstance(value, float) and math.isnan(value):
                continue  # it has no value now
            if unit in POSITION_UNITS and not isinstance(value, str):
                self._move(key, line.time_ns, float(value))
            elif unit or isinstance(value, float) or signal in _COUNTERS:
                self.unheeded[key] = self.unheeded.get(key, 0) + 1
            elif self._is_news((place, node, False, subject), value, Kind.OTHER):
                self._add(key, line.time_ns, (subject, str(value)), f"{subject} = {value}")
        if message.problem:
            subject = f"{message.name}: {message.problem}"
            self.labels.setdefault((place, node, subject), f"{who}, {subject}")
            self._add((place, node, subject), line.time_ns, (subject,), subject)

    def _take_said(self, line: Line, said: DecodedEvent, names: dict[tuple[str, int], str]) -> None:
        place, node = line.place, said.node
        for fact in said.facts:
            subject, value, told_to = fact.subject, fact.value, fact.told_to
            if told_to and self._of_devices:
                continue
            if fact.motion:
                key: Key = (place, node, subject)
                if key not in self.labels:
                    self.labels[key] = _label(key, line, said, names)
                if isinstance(value, str | bytes) or not (key in self.motions or _is_compared(key)):
                    self.unheeded[key] = self.unheeded.get(key, 0) + (not told_to)
                else:
                    self._move(key, line.time_ns, float(value))
            elif self._is_news((place, node, told_to, subject), value, said.kind):
                key = (place, node, COMMANDS if told_to else subject)
                if key not in self.labels:
                    self.labels[key] = _label(key, line, said, names)
                self._add(key, line.time_ns, (subject, value), f"{subject} = {fact.text}")

    def _is_news(self, place: tuple[str, int | None, bool, str], value: Value, kind: Kind) -> bool:
        """Return True if a fact is new or has changed; always for a command by SDO or NMT."""
        if self._last.get(place) != value:
            _, _, _, subject = place
            if subject not in _ALWAYS and not subject.endswith(_ALWAYS_AT_END):
                self._last[place] = value
            return True
        return kind is Kind.BOOT or (place[2] and kind not in PERIODIC)

    def _add(self, key: Key, time_ns: int, what: tuple[object, ...], text: str) -> None:
        if len(self._shared) >= _SHARED_MAX:
            self._shared.clear()
        what, text = self._shared.setdefault((what, text), (what, text))
        self.items.setdefault(key, []).append(Item(time_ns, what, text))
        self.kept_bytes += _ITEM_BYTES

    def _move(self, key: Key, time_ns: int, value: float) -> None:
        series = self.motions.get(key)
        if series is None:
            series = self.motions[key] = (array("Q"), array("d"))
        series[0].append(time_ns)
        series[1].append(value)
        self.kept_bytes += _SAMPLE_BYTES


def _is_compared(key: Key) -> bool:
    """Return True for the motion of an object that is compared."""
    return axis_of(int(key[2][:4], 16))[1] in _QUANTITIES


def _label(key: Key, line: Line, said: DecodedEvent, names: dict[tuple[str, int], str]) -> str:
    """Return a key of traffic in words."""
    place, node, subject = key
    who = "all nodes"
    if node is not None:
        number = "unit" if line.topic.startswith("/modbus/") else "node"
        name = names.get((place, node))
        who = f"{number} {node}" + (f" ({name})" if name else "")
    elif said.kind in (Kind.OTHER, Kind.BUS_ERROR):
        who = ""
    return ", ".join(part for part in (place, who, subject) if part)


_TELLING: Final = ("action", "owner", "holder", "phase", "motor", "method", "level", "message")
"""Fields of locks, groups and events that are not times and do not vary from run to run."""


def meaning_of(
    trace: Trace,
    names: RecordedNames | None = None,
    is_report: Callable[[Line], bool] | None = None,
    memory_max: int | None = None,
    describe: Describe | None = None,
) -> Meaning:
    """Return the meaning of a recording; of a cut one, as far as it goes.

    Args:
        trace: the recording.
        names: names and objects of its nodes; None: those in the recording.
        is_report: returns True for the lines to take, and the result has only the reports in them;
            None: all lines, with commands.
        memory_max: the most bytes of its events and motion; None: any.
        describe: returns the message in a frame of another protocol than CANopen.

    Raises:
        TraceError: the recording is damaged, or has more events and motion.
    """
    story = Story(trace, names, describe)
    meaning = Meaning(of_devices=is_report is not None)
    states = DoublesDecoder(JOINT_STATE)
    for message in trace.messages():
        meaning.messages += 1
        if message[0].topic.endswith("/state"):
            _take_state(meaning, message, states)
            continue
        line = story.line(message)
        if line is not None and (is_report is None or is_report(line)):
            meaning.take(line, story.names.nodes)
        if memory_max is not None and meaning.kept_bytes > memory_max:
            what = f"its events and motion need more than {memory_max >> 20} MiB"
            remedy = "say --max-memory MIB for more, or compare the bytes with --exact"
            raise TraceError(trace.path, what, remedy=remedy)
    return meaning


def _take_state(meaning: Meaning, message: TraceMessage, states: DoublesDecoder) -> None:
    channel, time_ns, payload = message
    if channel.schema is None or channel.schema.name != JOINT_STATE.name:
        return
    try:
        position = states.decode(payload).get("position")
    except ValueError:
        return
    if position is not None:
        meaning.take_state(time_ns, channel.topic.split("/")[2], position)
