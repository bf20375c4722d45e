"""Base of oracles: a promise with a source, fed with events, counting examined cases.

An oracle receives decoded events in the order of the recording, with their times. An oracle knows
no file, bus or clock. Its memory is bounded by nodes, axes and motors, never by time.
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
"""A sample may be older than the word beside it by a PDO's waiting time, and a servo settles."""


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

    def __init__(self, scene: Scene) -> None:
        self.scene: Final = scene
        self._tallies: dict[str, Tally] = {}
        self._reasons: dict[str, None] = {}

    # ------------------------------------------------------------------- hooks

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, told_to: bool
    ) -> None:
        """Handle an object's value, written to the node or sent by it; the axis has it already."""

    def sync(self, time_ns: int, bus: str, identifier: int) -> None:
        """Handle a SYNC."""

    def heartbeat(self, time_ns: int, bus: str, node: int, state: int) -> None:
        """Handle a heartbeat other than a boot-up."""

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """Handle a boot-up; the axes of the node are reset afterwards."""

    def nmt(self, time_ns: int, bus: str, node: int | None, command: int) -> None:
        """Handle an NMT command; None: to all nodes."""

    def emergency(self, time_ns: int, bus: str, node: int, code: int) -> None:
        """Handle an EMCY."""

    def sdo(self, time_ns: int, bus: str, said: Said, data: bytes) -> None:
        """Handle a frame of an SDO transfer."""

    def sender(self, time_ns: int, bus: str, identifier: int, before: str, now: str) -> None:
        """Handle a change of an identifier's sender."""

    def error(self, time_ns: int, bus: str, sender: str, told: BusError) -> None:
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

    def look(self, time_ns: int, bus: str = "") -> bool:
        """Count a case to examine; return False if it is outside the judged time."""
        if not self.scene.judges(time_ns):
            return False
        self._tally(bus).looked += 1
        return True

    def broken(self, violation: Violation) -> None:
        """Count a violation that holds even if frames are missing."""
        if self.scene.judges(violation.time_ns):
            tally = self._tally(violation.bus)
            tally.broken += 1
            if tally.first is None:
                tally.first = violation

    def absent(self, violation: Violation) -> None:
        """Count a missing event, a violation if the recording is complete."""
        if self.scene.judges(violation.time_ns):
            tally = self._tally(violation.bus)
            tally.absent += 1
            if tally.first_absent is None:
                tally.first_absent = violation

    def doubt(self, violation: Violation, why: str) -> None:
        """Count an uncertain violation, with the reason of the uncertainty."""
        if self.scene.judges(violation.time_ns):
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
    """Return the sum of both counts, and the earlier violation."""
    if other is None:
        return count, first
    if first is None or other.time_ns < first.time_ns:
        first = other
    return count + more, first
