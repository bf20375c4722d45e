"""Listener of the drives on one bus or line: messages of their kinds, passed to the oracles.

The listener matches answers with requests, once for all oracles.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, final

from motorhil.harness.oracles.base import MS, Oracle, RecordingContext, hooks
from motorhil.traces.exchange.drive_kinds import Decode, Read, Told, readers_of

ANSWER_NS: Final = 200 * MS
"""The time for an answer [ns]."""
_ERR: Final = 0x20  # in the highest byte of an identifier
_OPEN_MAX: Final = 64
_S: Final = 1_000_000_000


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

    def ask(self, kept: dict[str, list[int]], what: str, time_ns: int) -> None:
        """Open a request among `kept`."""
        times = kept.setdefault(what, [])
        times.append(time_ns)
        del times[:-_OPEN_MAX]

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
        limit_ns = time_ns - ANSWER_NS
        for times in self.perhaps.values():
            while times and times[0] < limit_ns:
                del times[0]
        for what, times in self.sure.items():
            while times and times[0] < limit_ns:
                yield what, times.pop(0)


@final
class DriveListener:
    """Listener that passes the messages of the known drives of one bus to the oracles.

    Attributes:
        count: number of known drives.
    """

    def __init__(self, name: str, context: RecordingContext, oracles: Sequence[Oracle]) -> None:
        self._name = name
        self._on_drive = hooks(oracles, "drive")
        self._on_answer = hooks(oracles, "answer")
        self._on_unanswered = hooks(oracles, "unanswered")
        self._asked: dict[int, _Asked] = {}
        self._drives: list[tuple[int, Decode, Read]] = []
        for (bus, node), table in context.drives.items():
            known = readers_of(str(table.get("kind")), node, table) if bus == name else None
            if known is not None:
                self._drives.append((node, *known))
        self.count: Final = len(self._drives)

    def take_frame(self, time_ns: int, frame: bytes, sender: str) -> bool:
        """Take a frame of a CAN bus; return True if it concerns a known drive."""
        return not frame[3] & _ERR and self._take(time_ns, frame, sender)

    def take_bytes(self, time_ns: int, data: bytes, sender: str) -> None:
        """Take what one sender sent on a serial line without a pause."""
        self._take(time_ns, data, sender)

    def end(self, time_ns: int) -> None:
        """Examine the last requests."""
        for node, asked in self._asked.items():
            self._expire(time_ns, node, asked)

    def _match(self, time_ns: int, node: int, told: Told) -> None:
        """Match an answer with its request, and look for requests that are too old."""
        asked = self._asked.setdefault(node, _Asked())
        self._expire(time_ns, node, asked)
        if told.quiet_s:
            asked.quiet_until_ns = time_ns + round(told.quiet_s * _S)
            asked.sure.clear()
        if told.is_own:
            asked.is_heard = True
        if told.answers:
            was_asked = asked.settle(told.answers) or (False if asked.is_matched else None)
            for hook in self._on_answer:
                hook(time_ns, (self._name, node), told, was_asked)
        elif told.asks and asked.is_heard and time_ns >= asked.quiet_until_ns:
            asked.ask(asked.sure, told.asks, time_ns)
        elif told.asks or told.may_ask:
            asked.ask(asked.perhaps, told.asks or told.may_ask, time_ns)

    def _expire(self, time_ns: int, node: int, asked: _Asked) -> None:
        for what, asked_ns in asked.expired(time_ns):
            for hook in self._on_unanswered:
                hook(asked_ns, (self._name, node), what)

    def _take(self, time_ns: int, frame: bytes, sender: str) -> bool:
        is_known = False
        for node, decode, read in self._drives:
            message = decode(frame)
            if message is None:
                continue
            is_known = True
            told = read(frame, message)
            if self._on_answer:
                self._match(time_ns, node, told)
            for hook in self._on_drive:
                hook(time_ns, (self._name, node), told, sender)
        return is_known
