"""Base of oracles: a promise with a source, fed with events.

An oracle receives decoded events in the order of the recording, with their times. It counts the
cases that it examined, and reports a finding. An oracle knows no file, bus or clock. All oracles
share one context: motors, axes and gaps of the recording. Memory is bounded by nodes, axes and
motors, never by time.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import ClassVar, Final, TypeVar, final

from motorhil.frozen import frozen
from motorhil.harness.oracles.facts import Facts, Subject
from motorhil.traces.decoding.attached_rig import RecordedNames
from motorhil.traces.decoding.can_errors import BusError
from motorhil.traces.decoding.cia402 import state_number
from motorhil.traces.decoding.events import DecodedEvent
from motorhil.traces.decoding.narrative import BusMessage
from motorhil.traces.exchange.drive_kinds import Told
from motorhil.traces.schema import LockAction

MS: Final = 1_000_000
SETTLE_NS: Final = 100 * MS
"""A sample may be older than the word beside it by a PDO's waiting time, and a servo settles."""
_S: Final = 1_000_000_000
STATUSWORD: Final = 0x6041
CONTROLWORD: Final = 0x6040
MODE: Final = 0x6060
MODE_DISPLAY: Final = 0x6061
# States of the PDS FSA, with the numbers of `motorhil.traces.decoding.cia402.STATES`.
NOT_READY, DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, REACTION, FAULT = range(8)
TARGET_REACHED: Final = 0x0400
BIT_12: Final = 0x1000
BIT_13: Final = 0x2000


@final
class Verdict(Enum):
    """The verdict of an oracle; HELD requires that something was examined."""

    HELD = "held"
    BROKEN = "broken"
    NOT_JUDGED = "could not judge"


@final
@frozen
class Violation:
    """One violation of a promise.

    Attributes:
        time_ns: log time [ns].
        text: the description.
        bus, node, axis, motor: the place as far as known; otherwise 0 or "".
        value, limit: [unit]; None if no number is concerned.
    """

    time_ns: int
    text: str
    bus: str = ""
    node: int = 0
    axis: int = 1
    motor: str = ""
    value: float | None = None
    limit: float | None = None
    unit: str = ""

    def __str__(self) -> str:
        time = f"{self.time_ns // _S}.{self.time_ns % _S:09d} s"
        place = f"{self.bus} node {self.node}" if self.node else self.bus
        if self.axis > 1:
            place += f" axis {self.axis}"
        subject = " ".join(part for part in (place, self.motor and f"({self.motor})") if part)
        numbers = ""
        if self.value is not None:
            numbers = f": {self.value:g} {self.unit}".rstrip()
            if self.limit is not None:
                numbers += f", limit {self.limit:g} {self.unit}".rstrip()
        return (
            f"{time} {subject}: {self.text}{numbers}"
            if subject
            else f"{time}: {self.text}{numbers}"
        )


@final
@frozen
class Finding:
    """The result of one oracle for one recording.

    Attributes:
        oracle: its id.
        promise, source: the rule as a sentence, and its source.
        verdict: the verdict.
        looked: number of examined cases.
        first: the first violation of a broken promise. If the verdict is NOT_JUDGED: the first
            violation that would count if the recording were complete.
        further: number of violations (or doubts) after the first one.
        reason: why it could not be judged; "" if it was.
        messages: the messages in the frames at the place and time of `first`, by another
            description than CANopen, if one is given.
    """

    oracle: str
    promise: str
    source: str
    verdict: Verdict
    looked: int = 0
    first: Violation | None = None
    further: int = 0
    reason: str = ""
    messages: tuple[BusMessage, ...] = ()

    def as_table(self) -> dict[str, object]:
        """Return the finding as a table for JSON."""
        table = asdict(self)
        table["messages"] = [one.as_table() for one in self.messages]
        table["verdict"] = self.verdict.value
        return table


Place = tuple[str, int, int]
KeyT = TypeVar("KeyT", bound=tuple[object, ...])
ValueT = TypeVar("ValueT")


def forget(kept: "dict[KeyT, ValueT]", bus: str, node: int | None) -> None:
    """Remove the entries of a node, or of all nodes of the bus (None); keys begin with both."""
    for key in [key for key in kept if key[0] == bus and node in (None, key[1])]:
        del kept[key]


"""Bus, node, axis from 1."""


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

    def take(self, time_ns: int, index: int, subindex: int, value: int, is_written: bool) -> None:
        """Take a value of an object."""
        if index == STATUSWORD:
            state = state_number(value)
            if state != self.state:
                self.state, self.state_ns = state, time_ns
            self.word = value
        elif index == CONTROLWORD:
            if is_written:
                self.control = value
        elif index == MODE_DISPLAY:
            self.mode, self.has_display = value, True
        elif index == MODE:
            if not self.has_display:
                self.mode = value
        else:
            self.objects[index, subindex] = value

    def violation(
        self,
        time_ns: int,
        text: str,
        value: float | None = None,
        limit: float | None = None,
        unit: str = "",
    ) -> Violation:
        """Return a violation by this axis; for the numbers see `Violation`."""
        return Violation(time_ns, text, *self.place, self.name, value, limit, unit)

    def forget(self) -> None:
        """Forget the state and the settings after a restart of the drive."""
        self.word = self.state = self.mode = self.control = None
        self.objects.clear()


@final
class RecordingContext:
    """Recording context shared by all oracles.

    Attributes:
        facts: the facts known beforehand.
        axes: by place; bounded by nodes and axes.
        gaps: reasons why frames may be missing, so that absence proves nothing. Empty: the
            recording is complete. Final only at the end.
        buses: by bus, True if it had a message that only CANopen has.
        seen_nodes: nodes that sent something, by bus and node-ID.
        unmapped: RPDOs heard without a known mapping, by bus and node.
        drives: the controllers' tables of the rig, by bus and node.
    """

    def __init__(
        self,
        facts: Facts,
        names: RecordedNames,
        from_ns: int | None = None,
        to_ns: int | None = None,
        drives: Mapping[tuple[str, int], Mapping[str, object]] | None = None,
    ) -> None:
        self.facts = facts
        self.drives: Mapping[tuple[str, int], Mapping[str, object]] = drives or {}
        self.names = names
        self.axes: dict[Place, Axis] = {}
        self.gaps: dict[str, None] = {}  # an ordered set
        self.buses: dict[str, bool] = {}
        self.seen_nodes: dict[tuple[str, int], None] = {}
        self.unmapped: dict[tuple[str, int], int] = {}
        self._devices: set[tuple[str, int]] = set(names.nodes)
        self._from_ns = from_ns
        self._to_ns = to_ns
        self._subjects = {one.place: one for one in facts.motors.values() if one.place is not None}

    def judges(self, time_ns: int) -> bool:
        """Return True if this time is to be judged."""
        return (self._from_ns is None or time_ns >= self._from_ns) and (
            self._to_ns is None or time_ns < self._to_ns
        )

    def saw(self, bus: str, node: int, is_device: bool = True) -> None:
        """Note a message of a node; heartbeats alone do not make it a device."""
        self.seen_nodes[bus, node] = None
        if is_device:
            self._devices.add((bus, node))

    def is_program(self, bus: str, node: int) -> bool:
        """Return True for a node that sent nothing but heartbeats so far, as a host's program."""
        return (bus, node) not in self._devices

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

    def violation_of(
        self,
        time_ns: int,
        text: str,
        node: tuple[str, int],
        value: float | None = None,
        limit: float | None = None,
        unit: str = "",
    ) -> Violation:
        """Return a violation by a node (bus, node-ID); for the numbers see `Violation`."""
        name = self.names.nodes.get(node, "")
        return Violation(time_ns, text, *node, 1, name, value, limit, unit)

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


@final
class Tally:
    """The counts for one bus, or ("") for events without a bus."""

    __slots__ = (
        *("absent", "broken", "doubts", "first", "first_absent", "first_doubt", "looked", "why"),
    )

    def __init__(self) -> None:
        self.looked = 0
        self.broken = 0
        self.first: Violation | None = None
        self.absent = 0
        self.first_absent: Violation | None = None
        self.doubts = 0
        self.first_doubt: Violation | None = None
        self.why = ""


class Oracle:
    """One promise; a subclass overrides the hooks that it needs.

    Attributes:
        id: its name on the command line.
        promise: the rule.
        source: the source of the rule.
        needs: why a recording may be insufficient for a judgement.
        objects: the indices it needs (of the first axis, CiA 402), and True if signed.
        needs_canopen: True if it ignores buses without a sign of CANopen.
    """

    id: ClassVar[str] = ""
    promise: ClassVar[str] = ""
    source: ClassVar[str] = ""
    needs: ClassVar[str] = ""
    objects: ClassVar[Mapping[int, bool]] = {}
    needs_canopen: ClassVar[bool] = True

    def __init__(self, context: RecordingContext) -> None:
        self.context: Final = context
        self._tallies: dict[str, Tally] = {}
        self._reasons: dict[str, None] = {}

    # ------------------------------------------------------------------- hooks

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Handle an object's value, written to the node or sent by it; the axis has it already."""

    def sync(self, time_ns: int, bus: str, identifier: int) -> None:
        """Handle a SYNC."""

    def tpdo(self, time_ns: int, bus: str, node: int, number: int) -> None:
        """Handle a TPDO with an identifier of its own; its values come separately."""

    def heartbeat(self, time_ns: int, bus: str, node: int, state: int) -> None:
        """Handle a heartbeat other than a boot-up."""

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """Handle a boot-up; the axes of the node are reset afterwards."""

    def nmt(self, time_ns: int, bus: str, node: int | None, command: int) -> None:
        """Handle an NMT command; None: to all nodes."""

    def emergency(self, time_ns: int, bus: str, node: int, code: int, register: int) -> None:
        """Handle an EMCY."""

    def sdo(self, time_ns: int, bus: str, event: DecodedEvent, data: bytes) -> None:
        """Handle a frame of an SDO transfer."""

    def drive(self, time_ns: int, node: tuple[str, int], told: Told, sender: str) -> None:
        """Handle a message to or from a drive (bus, node) with a protocol of its own."""

    def answer(
        self, time_ns: int, node: tuple[str, int], told: Told, was_asked: bool | None
    ) -> None:
        """Handle an answer of such a drive, before `drive`.

        `was_asked` is None while none of the drive's answers had a request in the recording.
        """

    def unanswered(self, asked_ns: int, node: tuple[str, int], what: str) -> None:
        """Handle a request to such a drive that had no answer in time."""

    def sender(self, time_ns: int, bus: str, identifier: int, before: str, now: str) -> None:
        """Handle a change of an identifier's sender."""

    def error(self, time_ns: int, bus: str, sender: str, error: BusError) -> None:
        """Handle an error message of this node's CAN controller; "": unknown node."""

    def sent_while_off(self, time_ns: int, bus: str, sender: str, identifier: int) -> None:
        """Handle a frame from a node whose CAN controller has reported bus-off."""

    def truth(self, time_ns: int, controller: str, values: Mapping[str, float]) -> None:
        """Handle a controller's snapshot."""

    def motion(self, time_ns: int, motor: str, values: Mapping[str, float]) -> None:
        """Handle the motor state known to the application: position, velocity, effort."""

    def lock(self, time_ns: int, motor: str, action: LockAction) -> None:
        """Handle an ownership event of a motor."""

    def group(self, time_ns: int, motors: Sequence[str], is_start: bool) -> None:
        """Handle the start or the end of a group motion."""

    def end(self, time_ns: int) -> None:
        """Handle the end of the recording."""

    # --------------------------------------------------------------------- results

    def examine(self, time_ns: int, bus: str = "") -> bool:
        """Count a case to examine; return False if it is outside the judged time."""
        if not self.context.judges(time_ns):
            return False
        self._tally(bus).looked += 1
        return True

    def broken(self, violation: Violation) -> None:
        """Count a violation that holds even if frames are missing."""
        if self.context.judges(violation.time_ns):
            tally = self._tally(violation.bus)
            tally.broken += 1
            if tally.first is None:
                tally.first = violation

    def absent(self, violation: Violation) -> None:
        """Count a missing event, a violation if the recording is complete."""
        if self.context.judges(violation.time_ns):
            tally = self._tally(violation.bus)
            tally.absent += 1
            if tally.first_absent is None:
                tally.first_absent = violation

    def doubt(self, violation: Violation, why: str) -> None:
        """Count an uncertain violation, with the reason of the uncertainty."""
        if self.context.judges(violation.time_ns):
            tally = self._tally(violation.bus)
            tally.doubts += 1
            if tally.first_doubt is None:
                tally.first_doubt, tally.why = violation, why

    def cannot(self, reason: str) -> None:
        """Note a reason why something was not judged, reported if nothing was."""
        if len(self._reasons) < 4:
            self._reasons[reason] = None

    def _tally(self, bus: str) -> Tally:
        found = self._tallies.get(bus)
        if found is None:
            found = self._tallies[bus] = Tally()
        return found

    def finding(self) -> Finding:
        """Return the result after the last event; buses without CANopen are left out."""
        gaps = "; ".join(self.context.gaps)
        total, why = Tally(), ""
        for bus, tally in self._tallies.items():
            if self.needs_canopen and bus in self.context.foreign():
                continue
            total.looked += tally.looked
            total.broken, total.first = _sum(total.broken, total.first, tally.broken, tally.first)
            if tally.first_absent is not None and not gaps:
                total.broken, total.first = _sum(
                    total.broken, total.first, tally.absent, tally.first_absent
                )
            for count, first, reason in (
                (tally.doubts, tally.first_doubt, tally.why),
                (tally.absent if gaps else 0, tally.first_absent if gaps else None, gaps),
            ):
                if first is not None and total.first_doubt is None:
                    why = reason
                total.doubts, total.first_doubt = _sum(
                    total.doubts, total.first_doubt, count, first
                )
        head = (self.id, self.promise, self.source)
        if total.first is not None:
            return Finding(*head, Verdict.BROKEN, total.looked, total.first, total.broken - 1)
        if total.first_doubt is not None:
            return Finding(
                *(*head, Verdict.NOT_JUDGED, total.looked),
                *(total.first_doubt, total.doubts - 1, why),
            )
        if total.looked:
            return Finding(*head, Verdict.HELD, total.looked)
        return Finding(*head, Verdict.NOT_JUDGED, reason="; ".join(self._reasons) or self.needs)


def hooks(oracles: Sequence[Oracle], name: str) -> Sequence[Callable[..., None]]:
    """Return the hooks of those oracles that override this method."""
    base = getattr(Oracle, name)
    return [getattr(one, name) for one in oracles if getattr(type(one), name) is not base]


def _sum(
    count: int, first: Violation | None, more: int, other: Violation | None
) -> tuple[int, Violation | None]:
    """Return the sum of both counts, and the earlier violation."""
    if other is None:
        return count, first
    if first is None or other.time_ns < first.time_ns:
        first = other
    return count + more, first
