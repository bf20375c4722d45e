"""Oracles of drives with a protocol of their own.

Each request is answered; each answer has been asked for, by one drive of its number; after a fault
nothing moves until it is reset.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, final

from motorhil.harness.oracles.base import MS, SETTLE_NS, Oracle, RecordingContext
from motorhil.traces.exchange.drive_kinds import Told

_Node = tuple[str, int]
_NO_DRIVE: Final = "no drive of kind mit, robstride, rmd, moteus, vesc or dynamixel is known"
_ANSWER_NS: Final = 200 * MS
_OPEN_MAX: Final = 64
_S: Final = 1_000_000_000
_SOURCE: Final = "the protocols of the kinds, as on their pages"


@final
@dataclass(slots=True)
class _Asked:
    """The open requests of one drive.

    Attributes:
        sure: times of requests that must be answered, by what was asked; the oldest first.
        perhaps: the same of requests that some drives do not answer.
        quiet_until_ns: until then it need not answer.
        is_heard: True once it sent something.
        is_matched: True once an answer had a request, so that the recording has both.
    """

    sure: dict[str, list[int]] = field(default_factory=dict)
    perhaps: dict[str, list[int]] = field(default_factory=dict)
    quiet_until_ns: int = 0
    is_heard: bool = False
    is_matched: bool = False

    def settle(self, what: str) -> bool:
        """Close the newest request; return False if there is none.

        A request whose answer is missing stays open with its own time.
        """
        sure, perhaps = self.sure.get(what, []), self.perhaps.get(what, [])
        times = sure if sure and (not perhaps or sure[-1] >= perhaps[-1]) else perhaps
        if not times:
            return False
        times.pop()
        self.is_matched = True
        return True

    def expired(self, time_ns: int) -> Iterator[tuple[str, int]]:
        """Take out the requests that are too old; yield those that had to be answered."""
        limit_ns = time_ns - _ANSWER_NS
        for times in self.perhaps.values():
            while times and times[0] < limit_ns:
                del times[0]
        for what, times in self.sure.items():
            while times and times[0] < limit_ns:
                yield what, times.pop(0)


class _Matching(Oracle):
    """Requests and answers of each drive."""

    needs_canopen = False
    source = _SOURCE
    needs = f"{_NO_DRIVE}, or it was asked nothing after it was first heard"

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._asked: dict[_Node, _Asked] = {}

    def drive(self, time_ns: int, node: _Node, told: Told, sender: str) -> None:
        """Match an answer with its request, and look for requests that are too old."""
        asked = self._asked.setdefault(node, _Asked())
        self._expire(time_ns, node, asked)
        if told.quiet_s:
            asked.quiet_until_ns = time_ns + round(told.quiet_s * _S)
            asked.sure.clear()
        if told.is_own:
            asked.is_heard = True
        if told.answers:
            self._answered(time_ns, node, told, asked.settle(told.answers))
        elif told.asks and asked.is_heard and time_ns >= asked.quiet_until_ns:
            _add(asked.sure, told.asks, time_ns)
        elif told.asks or told.may_ask:
            _add(asked.perhaps, told.asks or told.may_ask, time_ns)

    def end(self, time_ns: int) -> None:
        """Examine the last requests."""
        for node, asked in self._asked.items():
            self._expire(time_ns, node, asked)

    def _expire(self, time_ns: int, node: _Node, asked: _Asked) -> None:
        for what, asked_ns in asked.expired(time_ns):
            self._missed(asked_ns, node, what)

    def _answered(self, time_ns: int, node: _Node, told: Told, was_asked: bool) -> None:
        """Handle an answer."""

    def _missed(self, asked_ns: int, node: _Node, what: str) -> None:
        """Handle a request without an answer."""


@final
class DriveAnswers(_Matching):
    """The oracle `drive-answered`."""

    id = "drive-answered"
    promise = "A drive that was heard answers each request that its protocol answers, within 0.2 s"

    def _answered(self, time_ns: int, node: _Node, told: Told, was_asked: bool) -> None:
        if was_asked:
            self.examine(time_ns, node[0])

    def _missed(self, asked_ns: int, node: _Node, what: str) -> None:
        if self.examine(asked_ns, node[0]):
            text = f"no {what} within {_ANSWER_NS / 1e9:g} s of the request"
            self.absent(self.context.violation_of(asked_ns, text, node))


@final
class OneDrive(_Matching):
    """The oracle `one-drive`."""

    id = "one-drive"
    promise = "Each request has one answer, and all answers of one number have one sender"

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._late: dict[tuple[_Node, str], int] = {}  # requests that were given up
        self._senders: dict[_Node, dict[str, None]] = {}

    def drive(self, time_ns: int, node: _Node, told: Told, sender: str) -> None:
        """Match an answer with its request, and compare its sender with the first one."""
        super().drive(time_ns, node, told, sender)
        if told.is_own and sender and self.examine(time_ns, node[0]):
            known = self._senders.setdefault(node, {sender: None})
            if sender not in known:
                known[sender] = None
                text = f"answers are sent by {' and by '.join(known)}"
                self.broken(self.context.violation_of(time_ns, text, node))

    def _answered(self, time_ns: int, node: _Node, told: Told, was_asked: bool) -> None:
        key = node, told.answers
        if was_asked or told.is_unasked or not self._asked[node].is_matched:
            self.examine(time_ns, node[0])
        elif self._late.get(key, 0):
            self._late[key] -= 1
        elif self.examine(time_ns, node[0]):
            text = f"one more {told.answers} than was asked for"
            self.absent(self.context.violation_of(time_ns, text, node))

    def _missed(self, asked_ns: int, node: _Node, what: str) -> None:
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


def _add(kept: dict[str, list[int]], what: str, time_ns: int) -> None:
    times = kept.setdefault(what, [])
    times.append(time_ns)
    del times[:-_OPEN_MAX]


DRIVE_ORACLES: Final[tuple[type[Oracle], ...]] = (DriveAnswers, OneDrive, FaultsHeeded)
