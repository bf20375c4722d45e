"""Oracles of drives with a protocol of their own.

Each request is answered; each answer has been asked for, by one drive of its number; after a fault
nothing moves until it is reset.
"""

from typing import Final, final

from motorhil.harness.oracles.base import SETTLE_NS, Oracle, RecordingContext
from motorhil.harness.oracles.drives.listener import ANSWER_NS
from motorhil.traces.exchange.drive_kinds import Told

_Node = tuple[str, int]
_NO_DRIVE: Final = "no drive of kind mit, robstride, rmd, moteus, vesc or dynamixel is known"
_SOURCE: Final = "the protocols of the kinds, as on their pages"


class _OfRequests(Oracle):
    """A promise about requests and answers, which the listener matches."""

    needs_canopen = False
    source = _SOURCE
    needs = f"{_NO_DRIVE}, or it was asked nothing after it was first heard"


@final
class DriveAnswers(_OfRequests):
    """The oracle `drive-answered`."""

    id = "drive-answered"
    promise = "A drive that was heard answers each request that its protocol answers, within 0.2 s"

    def answer(self, time_ns: int, node: _Node, told: Told, was_asked: bool | None) -> None:
        """Count an answer in time."""
        if was_asked:
            self.examine(time_ns, node[0])

    def unanswered(self, asked_ns: int, node: _Node, what: str) -> None:
        """Report a request without an answer."""
        if self.examine(asked_ns, node[0]):
            text = f"no {what} within {ANSWER_NS / 1e9:g} s of the request"
            self.absent(self.context.violation_of(asked_ns, text, node))


@final
class OneDrive(_OfRequests):
    """The oracle `one-drive`."""

    id = "one-drive"
    promise = "Each request has one answer, and all answers of one number have one sender"

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._late: dict[tuple[_Node, str], int] = {}  # requests that were given up
        self._senders: dict[_Node, dict[str, None]] = {}

    def drive(self, time_ns: int, node: _Node, told: Told, sender: str) -> None:
        """Compare the sender of an answer with the first one."""
        if told.is_own and sender and self.examine(time_ns, node[0]):
            known = self._senders.setdefault(node, {sender: None})
            if sender not in known:
                known[sender] = None
                text = f"answers are sent by {' and by '.join(known)}"
                self.broken(self.context.violation_of(time_ns, text, node))

    def answer(self, time_ns: int, node: _Node, told: Told, was_asked: bool | None) -> None:
        """Report an answer that nothing has asked for."""
        key = node, told.answers
        if was_asked or told.is_unasked or was_asked is None:
            self.examine(time_ns, node[0])
        elif self._late.get(key, 0):
            self._late[key] -= 1
        elif self.examine(time_ns, node[0]):
            text = f"one more {told.answers} than was asked for"
            self.absent(self.context.violation_of(time_ns, text, node))

    def unanswered(self, asked_ns: int, node: _Node, what: str) -> None:
        """Expect a late answer."""
        self._late[node, what] = self._late.get((node, what), 0) + 1


@final
class FaultsHeeded(Oracle):
    """The oracle `fault-heeded`."""

    id = "fault-heeded"
    promise = "No motion is commanded later than 0.1 s after a drive told a fault, until its reset"
    source = "the manuals of the kinds: a drive in fault does not move, and may do so when reset"
    needs = f"{_NO_DRIVE} that tells its faults and was commanded to move"
    needs_canopen = False

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._faults: dict[_Node, tuple[str, int]] = {}  # the fault, and since when; "": none

    def drive(self, time_ns: int, node: _Node, told: Told, sender: str) -> None:
        """Take a fault, or examine a motion."""
        if told.clears:
            self._faults.pop(node, None)
        if told.fault is not None:
            before = self._faults.get(node, ("", 0))
            self._faults[node] = before if before[0] == told.fault else (told.fault, time_ns)
        if not told.moves or node not in self._faults or not self.examine(time_ns, node[0]):
            return
        fault, since_ns = self._faults[node]
        if fault and time_ns - since_ns > SETTLE_NS:
            text = f"a motion is commanded during {fault}, since {since_ns / 1e9:.6f} s"
            self.broken(self.context.violation_of(time_ns, text, node))


DRIVE_ORACLES: Final[tuple[type[Oracle], ...]] = (DriveAnswers, OneDrive, FaultsHeeded)
