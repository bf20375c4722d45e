"""What every oracle is: a promise with a source, told what goes by, counting what it looked at.

An oracle is told decoded things in the order of the recording, with their times; it knows no file,
no bus, no clock. What it keeps is bounded by nodes, axes and motors, never by time.
"""

from collections.abc import Mapping, Sequence
from typing import ClassVar, Final, final

from harness.oracles.finding import Finding, Verdict, Violation
from harness.oracles.scene import Axis, Scene
from traces.bus_errors import BusError
from traces.said import Said
from traces.schema import LockAction

MS: Final = 1_000_000
SETTLE_NS: Final = 100 * MS
"""A sample may be older than the word beside it by what a PDO waits; a servo settles."""


@final
class Tally:
    """What was found on one bus, or ("") elsewhere."""

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
    """One promise. Whoever is one overrides what it wants to be told.

    Attributes:
        id: its name on the command line.
        promise: what should hold.
        source: who says so.
        needs: what must be in a recording for it to judge anything.
        objects: indices it is told of (of the first axis, CiA 402), and whether they are signed.
        needs_canopen: it judges nothing on a bus that nothing says is CANopen.
    """

    id: ClassVar[str] = ""
    promise: ClassVar[str] = ""
    source: ClassVar[str] = ""
    needs: ClassVar[str] = ""
    objects: ClassVar[Mapping[int, bool]] = {}
    needs_canopen: ClassVar[bool] = True

    def __init__(self, scene: Scene) -> None:
        self.scene: Final = scene
        self._tallies: dict[str, Tally] = {}
        self._reasons: dict[str, None] = {}

    # ------------------------------------------------------------------- what it may be told

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, told_to: bool
    ) -> None:
        """An object has this value: told to the node, or by it. The axis knows it already."""

    def sync(self, time_ns: int, bus: str, identifier: int) -> None:
        """A SYNC."""

    def heartbeat(self, time_ns: int, bus: str, node: int, state: int) -> None:
        """A heartbeat that is no boot-up."""

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """A boot-up. What was known of the node's axes is forgotten afterwards."""

    def nmt(self, time_ns: int, bus: str, node: int | None, command: int) -> None:
        """An NMT command; None: to all."""

    def emergency(self, time_ns: int, bus: str, node: int, code: int) -> None:
        """An EMCY."""

    def sdo(self, time_ns: int, bus: str, said: Said, data: bytes) -> None:
        """A frame of an SDO transfer."""

    def sender(self, time_ns: int, bus: str, identifier: int, before: str, now: str) -> None:
        """An identifier is sent by another one than before."""

    def error(self, time_ns: int, bus: str, sender: str, told: BusError) -> None:
        """An error message of this node's CAN controller; "": nobody tells whose."""

    def sent_while_off(self, time_ns: int, bus: str, sender: str, identifier: int) -> None:
        """A frame of a node whose CAN controller has told bus-off, and nothing since."""

    def truth(self, time_ns: int, controller: str, values: Mapping[str, float]) -> None:
        """A controller's snapshot."""

    def motion(self, time_ns: int, motor: str, values: Mapping[str, float]) -> None:
        """What the application knows of a motor: position, velocity, effort."""

    def lock(self, time_ns: int, motor: str, action: LockAction) -> None:
        """Something happened to the ownership of a motor."""

    def group(self, time_ns: int, motors: Sequence[str], is_start: bool) -> None:
        """A group has begun a motion together, or ended it."""

    def end(self, time_ns: int) -> None:
        """Nothing more will come."""

    # --------------------------------------------------------------------- what it has found

    def look(self, time_ns: int, bus: str = "") -> bool:
        """There is something to judge; False: but not at this time."""
        if not self.scene.judges(time_ns):
            return False
        self._tally(bus).looked += 1
        return True

    def broken(self, violation: Violation) -> None:
        """The promise was not kept, whatever else the recording may lack."""
        if self.scene.judges(violation.time_ns):
            tally = self._tally(violation.bus)
            tally.broken += 1
            if tally.first is None:
                tally.first = violation

    def absent(self, violation: Violation) -> None:
        """Something was not heard: the promise was not kept, if the recording has every frame."""
        if self.scene.judges(violation.time_ns):
            tally = self._tally(violation.bus)
            tally.absent += 1
            if tally.first_absent is None:
                tally.first_absent = violation

    def doubt(self, violation: Violation, why: str) -> None:
        """Perhaps it was not kept; why it is not certain."""
        if self.scene.judges(violation.time_ns):
            tally = self._tally(violation.bus)
            tally.doubts += 1
            if tally.first_doubt is None:
                tally.first_doubt, tally.why = violation, why

    def cannot(self, reason: str) -> None:
        """This is why something was not judged; told if nothing was."""
        if len(self._reasons) < 4:
            self._reasons[reason] = None

    def _tally(self, bus: str) -> Tally:
        found = self._tallies.get(bus)
        if found is None:
            found = self._tallies[bus] = Tally()
        return found

    def finding(self) -> Finding:
        """What it says, when all was told. A bus that is not CANopen has told it nothing."""
        gaps = "; ".join(self.scene.gaps)
        total, why = Tally(), ""
        for bus, tally in self._tallies.items():
            if self.needs_canopen and bus in self.scene.foreign():
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


def _sum(
    count: int, first: Violation | None, more: int, other: Violation | None
) -> tuple[int, Violation | None]:
    """Both counts together, and the earlier of the two."""
    if other is None:
        return count, first
    if first is None or other.time_ns < first.time_ns:
        first = other
    return count + more, first
