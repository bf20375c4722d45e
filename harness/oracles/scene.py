"""Context shared by all oracles: motors, axes, gaps of the recording."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, final

from harness.oracles.facts import Facts, Subject
from traces.decode_cia402 import state_number
from traces.recorded_names import RecordedNames

Place = tuple[str, int, int]
"""Bus, node, axis from 1."""

STATUSWORD: Final = 0x6041
CONTROLWORD: Final = 0x6040
MODE: Final = 0x6060
MODE_DISPLAY: Final = 0x6061

# States of the PDS FSA, with the numbers of `traces.decode_cia402.STATES`.
NOT_READY, DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, REACTION, FAULT = range(8)
TARGET_REACHED: Final = 0x0400
BIT_12: Final = 0x1000
BIT_13: Final = 0x2000


@final
@dataclass(slots=True)
class Axis:
    """One axis of a node on a bus, as far as known from its frames.

    Attributes:
        place: bus, node, axis.
        name: the name of its motor, or "".
        subject: the known facts of that motor.
        word, state, state_ns: the last statusword, its state, and since when [ns].
        mode: the mode of operation.
        control: the last controlword.
        objects: the settings heard, by index and sub-index.
    """

    place: Place
    name: str = ""
    subject: Subject | None = None
    word: int | None = None
    state: int | None = None
    state_ns: int = 0
    mode: int | None = None
    control: int | None = None
    has_display: bool = False
    objects: dict[tuple[int, int], int] = field(default_factory=dict)

    def take(self, time_ns: int, index: int, subindex: int, value: int, told_to: bool) -> None:
        """Take a value of an object."""
        if index == STATUSWORD:
            state = state_number(value)
            if state != self.state:
                self.state, self.state_ns = state, time_ns
            self.word = value
        elif index == CONTROLWORD:
            if told_to:
                self.control = value
        elif index == MODE_DISPLAY:
            self.mode, self.has_display = value, True
        elif index == MODE:
            if not self.has_display:
                self.mode = value
        else:
            self.objects[index, subindex] = value

    def forget(self) -> None:
        """Forget the state and the settings after a restart of the drive."""
        self.word = self.state = self.mode = self.control = None
        self.objects.clear()


@final
class Scene:
    """Recording context shared by all oracles.

    Attributes:
        facts: the facts known beforehand.
        axes: by place; bounded by nodes and axes.
        gaps: reasons why frames may be missing, so that absence proves nothing. Empty: the
            recording is complete. Final only at the end.
        buses: by bus, True if it had a message that only CANopen has.
        heard: nodes that sent something, by bus and node-ID.
        unmapped: RPDOs heard without a known mapping, by bus and node.
    """

    def __init__(
        self,
        facts: Facts,
        names: RecordedNames,
        from_ns: int | None = None,
        to_ns: int | None = None,
    ) -> None:
        self.facts = facts
        self.names = names
        self.axes: dict[Place, Axis] = {}
        self.gaps: dict[str, None] = {}  # an ordered set
        self.buses: dict[str, bool] = {}
        self.heard: dict[tuple[str, int], None] = {}
        self.unmapped: dict[tuple[str, int], int] = {}
        self._from_ns = from_ns
        self._to_ns = to_ns
        self._subjects = {one.place: one for one in facts.motors.values() if one.place is not None}

    def judges(self, time_ns: int) -> bool:
        """Return True if this time is to be judged."""
        return (self._from_ns is None or time_ns >= self._from_ns) and (
            self._to_ns is None or time_ns < self._to_ns
        )

    def axis(self, place: Place) -> Axis:
        """Return the axis at a place, created if necessary."""
        found = self.axes.get(place)
        if found is None:
            subject = self._subjects.get(place)
            name = subject.name if subject is not None else self.names.nodes.get(place[:2], "")
            found = self.axes[place] = Axis(place, name, subject)
            if subject is not None:
                found.objects.update(subject.objects)
        return found

    def foreign(self) -> list[str]:
        """Return the buses without a sign of CANopen."""
        return [bus for bus, is_canopen in self.buses.items() if not is_canopen]

    def controllers(self) -> Mapping[str, list[Subject]]:
        """Return the motors by controller."""
        found: dict[str, list[Subject]] = {}
        for one in self.facts.motors.values():
            if one.controller is not None:
                found.setdefault(one.controller, []).append(one)
        return found
