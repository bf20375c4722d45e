"""What all oracles know of a recording while it goes by: motors, axes, what is missing in it."""

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

# States of the PDS FSA, as traces.decode_cia402.STATES counts them.
NOT_READY, DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, REACTION, FAULT = range(8)
TARGET_REACHED: Final = 0x0400
BIT_12: Final = 0x1000
BIT_13: Final = 0x2000


@final
@dataclass(slots=True)
class Axis:
    """One axis of a node on a bus, as far as it was heard.

    Attributes: place; name (of its motor, or ""); subject (what is known of that motor); word,
    state, state_ns (the last statusword, its state, since when it is told); mode; control (the last
    controlword); objects (settings that were heard, by index and sub-index).
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
        """An object of it has this value."""
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
        """The drive begins anew."""
        self.word = self.state = self.mode = self.control = None
        self.objects.clear()


@final
class Scene:
    """Shared by all oracles.

    Attributes:
        facts: what was known beforehand.
        axes: by place; bounded by nodes and axes.
        gaps: why frames may be missing, so that what was not heard proves nothing. Empty: it is
            complete. Known for sure only at the end.
        buses: whether anything was said there that only CANopen says, by bus.
        heard: nodes that sent something, by bus and number.
        unmapped: RPDOs that were heard and whose contents are not known, by bus and node.
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
        self.gaps: dict[str, None] = {}  # in order
        self.buses: dict[str, bool] = {}
        self.heard: dict[tuple[str, int], None] = {}
        self.unmapped: dict[tuple[str, int], int] = {}
        self._from_ns = from_ns
        self._to_ns = to_ns
        self._subjects = {one.place: one for one in facts.motors.values() if one.place is not None}

    def judges(self, time_ns: int) -> bool:
        """Whether what happened at this time was asked for."""
        return (self._from_ns is None or time_ns >= self._from_ns) and (
            self._to_ns is None or time_ns < self._to_ns
        )

    def axis(self, place: Place) -> Axis:
        """The axis there."""
        found = self.axes.get(place)
        if found is None:
            subject = self._subjects.get(place)
            name = subject.name if subject is not None else self.names.nodes.get(place[:2], "")
            found = self.axes[place] = Axis(place, name, subject)
            if subject is not None:
                found.objects.update(subject.objects)
        return found

    def foreign(self) -> list[str]:
        """Buses that nothing says are CANopen."""
        return [bus for bus, is_canopen in self.buses.items() if not is_canopen]

    def controllers(self) -> Mapping[str, list[Subject]]:
        """Motors by what drives them."""
        found: dict[str, list[Subject]] = {}
        for one in self.facts.motors.values():
            if one.controller is not None:
                found.setdefault(one.controller, []).append(one)
        return found
