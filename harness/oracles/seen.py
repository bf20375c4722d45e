"""Faults, limits and alarms in a recording, beside the verdict of the oracles.

A drive that reports its fault by the rules keeps every promise: the recording is sound, and yet
something was wrong. Equal incidents of one place are counted, so memory does not grow with time.

Source: CiA 301, EMCY; CiA 402-2, statusword 6041h (fault; bit 11, internal limit active), 6072h,
max torque, and 6077h, torque actual value.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Final, final

from motorhil.harness.oracles.base import (
    FAULT,
    REACTION,
    STATUSWORD,
    Axis,
    Oracle,
    Place,
    RecordingContext,
)
from motorhil.traces.decoding.canopen import emergency_text
from motorhil.traces.exchange.drive_kinds import Told

_LIMIT_ACTIVE: Final = 0x0800  # bit 11
_MAX_TORQUE: Final = 0x6072
_TORQUE: Final = 0x6077
_NO_MODE: Final = (None, 0, 6)  # in homing, bit 11 has no meaning


@final
@dataclass(slots=True)
class Incident:
    """Something that happened, as often as it did.

    Attributes:
        place: bus and node, or the source of an event, and the motor's name.
        text: what happened.
        first_ns: log time of the first [ns].
        times: how often.
    """

    place: str
    text: str
    first_ns: int
    times: int = 1

    def __str__(self) -> str:
        often = f", {self.times} times, first" if self.times > 1 else ""
        return f"{self.place}: {self.text}{often} at {self.first_ns / 1e9:.6f} s"


@final
@dataclass(slots=True)
class Seen:
    """The facts that a judgement saw, filled by `judge`.

    Attributes:
        incidents: in the order of their first time.
        places: bus and node-ID of each node that sent something.
        motors: names of motors that the recording has.
    """

    incidents: list[Incident] = field(default_factory=list)
    places: set[tuple[str, int]] = field(default_factory=set)
    motors: set[str] = field(default_factory=set)


@final
class Incidents(Oracle):
    """A listener for faults and limits, which judges nothing."""

    needs_canopen = False
    objects: ClassVar[Mapping[int, bool]] = {STATUSWORD: False, _TORQUE: True, _MAX_TORQUE: False}

    def __init__(self, context: RecordingContext) -> None:
        """Set up the listener; see `Oracle`."""
        super().__init__(context)
        self._found: dict[tuple[str, str], Incident] = {}
        self._states: dict[Place, int | None] = {}
        self._limited: set[tuple[Place, int]] = set()
        self._told: dict[tuple[str, int], str] = {}
        self._starved: set[tuple[str, int]] = set()
        self._moved: set[tuple[str, int]] = set()  # drives that were told to move

    def incidents(self) -> list[Incident]:
        """Return all incidents in the order of their first time."""
        return sorted(self._found.values(), key=lambda one: one.first_ns)

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Note a fault of the state machine, an active limit, or torque at its limit."""
        if is_written:
            return
        place = axis.place
        if index == STATUSWORD:
            before, self._states[place] = self._states.get(place), axis.state
            if axis.state in (REACTION, FAULT) and before not in (REACTION, FAULT):
                self._note(time_ns, _named(axis), "fault (6041h)")
            active = bool(value & _LIMIT_ACTIVE) and axis.mode not in _NO_MODE
            self._limit(time_ns, axis, index, active, "internal limit active (6041h bit 11)")
        elif index == _TORQUE:
            limit = axis.objects.get((_MAX_TORQUE, 0))
            active = limit is not None and 0 < limit <= abs(value)
            self._limit(time_ns, axis, index, active, f"torque limited: 6077h at 6072h = {limit}")

    def emergency(self, time_ns: int, bus: str, node: int, code: int, register: int) -> None:
        """Note an EMCY with an error code."""
        if code:
            axis = self.context.axes.get((bus, node, 1))
            name = axis.name if axis else self.context.names.nodes.get((bus, node), "")
            place = f"{bus} node {node}" + (f" ({name})" if name else "")
            self._note(time_ns, place, f"EMCY {code:04X}h {emergency_text(code)}")

    def drive(self, time_ns: int, node: tuple[str, int], told: Told, sender: str) -> None:
        """Note what a drive with a protocol of its own tells: a fault, or no commands in time."""
        if told.is_own:
            self.context.saw(*node)
        name = self.context.names.nodes.get(node, "")
        place = f"{node[0]} node {node[1]}" + (f" ({name})" if name else "")
        if told.fault is not None and told.fault != self._told.get(node, ""):
            self._told[node] = told.fault
            if told.fault:
                self._note(time_ns, place, f"fault: {told.fault}")
        if told.moves:
            self._moved.add(node)
        elif told.rests:
            self._moved.discard(node)
        if told.is_starved is not None and told.is_starved != (node in self._starved):
            (self._starved.add if told.is_starved else self._starved.discard)(node)
            if told.is_starved and node in self._moved:
                self._note(time_ns, place, "watchdog: no commands in time")

    def event(self, time_ns: int, name: str, text: str) -> None:
        """Note an event of the level error."""
        self._note(time_ns, name or "event", text)

    def _limit(self, time_ns: int, axis: Axis, index: int, active: bool, text: str) -> None:
        key = (axis.place, index)
        if active and key not in self._limited:
            self._limited.add(key)
            self._note(time_ns, _named(axis), text)
        elif not active:
            self._limited.discard(key)

    def _note(self, time_ns: int, place: str, text: str) -> None:
        if not self.context.judges(time_ns):
            return
        known = self._found.get((place, text))
        if known is None:
            self._found[place, text] = Incident(place, text, time_ns)
        else:
            known.times += 1


def _named(axis: Axis) -> str:
    bus, node, number = axis.place
    place = f"{bus} node {node}" + (f" axis {number}" if number > 1 else "")
    return f"{place} ({axis.name})" if axis.name else place
