"""Ownership of motors over time, reconstructed from a recording.

    ownership = read_ownership("run.mcap")
    for tenure in ownership.tenures["pan"]:
        print(tenure)
    tenure = ownership.owner_at("pan", time_ns)

A *tenure* is one owner's time with one motor. It lasts from the message that the motor was taken to
the message that it was released, or to the next owner's tenure. Tokens put tenures in order,
whatever the order of their messages. Messages that programs send at the same time may cross, even
over several handovers. An owner had the motor no later than the first message about that owner or a
later one. So its tenure begins there at the latest, and the tenure before ends there at the latest.
`crossed_ns` is the delay from that end to the message of the release.

A recording contains only what programs announced to its recorder. Programs built on motorapi
announce ownership on a rig of their own process and on a hub. Other programs do not, so their
frames have no tenure. Times are those at which the recorder received the messages; on a hub that is
later by the message's delay. A tenure lasts for one operation, reservation or low-level access. On
a bus that other processes can join, it also lasts until the motion that it started ends.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from enum import Enum
from typing import Any, Final, final

from motorhil.frozen import frozen
from motorhil.traces.mcap.reader import Trace, read_trace
from motorhil.traces.protobuf import decode
from motorhil.traces.schema import MOTOR_LOCK, LockAction

_ACTIONS: Final[dict[object, LockAction]] = {action.value: action for action in LockAction}
_BEGINS: Final = (LockAction.TAKEN, LockAction.BROKEN, LockAction.TAKEN_OVER)
_TENURE: Final = (*_BEGINS, LockAction.RELEASED, LockAction.LOST)


@final
@frozen
class LockEvent:
    """One message of `/motor/<name>/lock`; fields that the message lacks are empty, or 0.

    Attributes:
        motor: name of the motor.
        time_ns: when the recorder received the message [ns].
        action: what happened.
        owner: who takes, waits or releases.
        holder: who has the motor, if not the owner.
        purpose: what the owner wants the motor for.
        token: fencing token of the ownership.
        pid: process of the owner.
        program: program of the owner.
        sender: name under which frames of that process are recorded.
        waited_s: waiting time of the owner [s].
        held_s: duration of the ownership [s].
        looked: True if the event was found by polling the lock file.
    """

    motor: str
    time_ns: int
    action: LockAction
    owner: str = ""
    holder: str = ""
    purpose: str = ""
    token: int = 0
    pid: int = 0
    program: str = ""
    sender: str = ""
    waited_s: float = 0.0
    held_s: float = 0.0
    looked: bool = False


@final
class Ended(Enum):
    """The end of a tenure, in words that follow "it"."""

    RELEASED = "gave it back"
    DIED = "died with it"
    TAKEN_OVER = "lost it to the next one"
    UNTOLD = "did not tell how it ended"
    NOT_YET = "had it when the record ended"


@final
@frozen
class Tenure:
    """One owner's time with one motor.

    Attributes:
        motor: name of the motor.
        token: fencing token of the ownership.
        owner, purpose, pid, program, sender: as in LockEvent.
        from_ns: start [ns].
        to_ns: end [ns]; None if the record ends before.
        ended: how the tenure ended.
        waited_s: how long the owner waited for the motor [s].
        noticed_ns: when an owner that lost the motor noticed it [ns]; None if it did not.
        crossed_ns: delay from `to_ns` to the message of the release [ns].
        skipped: number of tokens between the tenure before and this one, of owners that announced
            nothing or were not seen.
        looked: True if the tenure was found by polling the lock file.
    """

    motor: str
    token: int
    owner: str
    purpose: str
    pid: int
    program: str
    sender: str
    from_ns: int
    to_ns: int | None
    ended: Ended
    waited_s: float
    noticed_ns: int | None = None
    crossed_ns: int = 0
    skipped: int = 0
    looked: bool = False

    def has(self, time_ns: int) -> bool:
        """Return True if the motor belonged to this owner; a handover belongs to the next."""
        return self.from_ns <= time_ns and (self.to_ns is None or time_ns < self.to_ns)

    def __str__(self) -> str:
        process = f" (pid {self.pid}, {self.program})" if self.pid else ""
        purpose = f" for {self.purpose}" if self.purpose else ""
        end = "..." if self.to_ns is None else f"{self.to_ns / 1e9:.3f} s"
        return (
            f"{self.motor}: {self.from_ns / 1e9:.3f} s to {end}: {self.owner}{process}{purpose},"
            f" which {self.ended.value}"
        )


@final
@frozen
class OwnershipRecord:
    """The ownership of motors according to a recording.

    Attributes:
        events: all lock events, in the order of the record.
        tenures: tenures by motor, in order of tokens; only motors that have lock events.
        contradictions: descriptions of impossible events: one token with two owners, or a process
            with decreasing tokens. Empty for any lock that works.
    """

    events: tuple[LockEvent, ...]
    tenures: Mapping[str, tuple[Tenure, ...]]
    contradictions: tuple[str, ...]

    def owner_at(self, motor: str, time_ns: int) -> Tenure | None:
        """Return the tenure of the motor at this time, or None if none is known."""
        for tenure in reversed(self.tenures.get(motor, ())):
            if tenure.has(time_ns):
                return tenure
        return None


def read_ownership(recording: str | os.PathLike[str] | Trace) -> OwnershipRecord:
    """Read the ownership of all motors from a recording.

    Raises:
        TraceError: the recording cannot be read, or is damaged.
    """
    if not isinstance(recording, Trace):
        with read_trace(recording) as trace:
            return read_ownership(trace)
    return ownership_of(lock_events(recording))


def lock_events(trace: Trace) -> Iterator[LockEvent]:
    """Yield the messages of all `/motor/<name>/lock` topics in the order of the record."""
    motors: dict[str, str | None] = {}  # by topic
    for channel, time_ns, data in trace.messages():
        topic = channel.topic
        if topic not in motors:
            motors[topic] = motor_of(topic)
        name = motors[topic]
        if name is not None:
            yield lock_event(name, time_ns, data)


def motor_of(topic: str) -> str | None:
    """Return the motor of a lock topic, or None for another topic."""
    if topic.startswith("/motor/") and topic.endswith("/lock"):
        return topic[len("/motor/") : -len("/lock")]
    return None


def lock_event(motor: str, time_ns: int, data: bytes) -> LockEvent:
    """Decode one message of `/motor/<name>/lock`; raise ValueError if it is not one."""
    values = decode(MOTOR_LOCK, data)
    action = _ACTIONS.get(values.pop("action", 0), LockAction.UNKNOWN)  # of a later version
    # Any: the table of the message defines the types of its fields, which are LockEvent's.
    facts: dict[str, Any] = dict(values)
    return LockEvent(motor, time_ns, action, **facts)


def ownership_of(events: Iterable[LockEvent]) -> OwnershipRecord:
    """Return the ownership record of events from another source, given in their order."""
    seen = tuple(events)
    told: dict[str, list[LockEvent]] = {}
    for event in seen:
        told.setdefault(event.motor, []).append(event)
    books = {motor: _Book(events) for motor, events in told.items()}
    return OwnershipRecord(
        seen,
        {motor: tuple(book.tenures) for motor, book in books.items()},
        tuple(line for book in books.values() for line in book.contradictions),
    )


def _as_they_happened(told: Sequence[LockEvent]) -> list[LockEvent]:
    """Order the events of one motor by token, and correct times of begins that arrived late.

    The message of an owner arrives after the owner took the motor, and so do messages of later
    owners. The earliest of these messages therefore bounds the start.
    """
    ranks: list[tuple[int, int, LockEvent]] = []  # token, place
    last = 0  # without tokens, the order of the messages counts
    for place, event in enumerate(told):
        if event.action in _TENURE:
            last = event.token or last
            ranks.append((last, place, event))
    ranks.sort(key=lambda rank: rank[:2])
    happened: list[tuple[int, int, int, LockEvent]] = []
    bound_ns: int | None = None
    for token, place, event in reversed(ranks):
        time_ns = event.time_ns
        if event.action in _BEGINS:
            time_ns = bound_ns = time_ns if bound_ns is None else min(time_ns, bound_ns)
        happened.append((time_ns, token, place, event))
    happened.sort(key=lambda one: one[:3])
    return [
        event if event.time_ns == time_ns else replace(event, time_ns=time_ns)
        for time_ns, _, _, event in happened
    ]


def _falls(told: Iterable[LockEvent]) -> Iterator[str]:
    """Yield a contradiction for each process whose tokens decrease; its messages never cross."""
    last: dict[tuple[str, int], LockEvent] = {}
    for event in told:
        if event.action not in _BEGINS or not event.token:
            continue
        before = last.get((event.sender, event.pid))
        if before is not None and event.token < before.token:
            yield _contradiction(event, before.owner, before.token)
        else:
            last[event.sender, event.pid] = event


def _contradiction(event: LockEvent, owner: str, token: int) -> str:
    return (
        f"{event.motor}: at {event.time_ns / 1e9:.6f} s {event.owner} has it under token "
        f"{event.token}; {owner} had it under {token} already"
    )


@final
class _Book:
    """The tenures of one motor; the last one may be open."""

    def __init__(self, told: Sequence[LockEvent]) -> None:
        self.tenures: list[Tenure] = []
        self.contradictions: list[str] = [*_falls(told)]
        for event in _as_they_happened(told):
            self._enter(event)

    def _enter(self, event: LockEvent) -> None:
        """Update the tenures with one more event."""
        if event.action in _BEGINS:
            self._begin(event)
        elif event.action is LockAction.RELEASED:
            self._release(event)
        elif event.action is LockAction.LOST:
            self._lose(event)

    def _begin(self, event: LockEvent) -> None:
        from_ns = event.time_ns
        if event.looked:  # older than the poll, but newer than what was seen before
            from_ns = max(0, from_ns - round(event.held_s * 1e9))
        if self.tenures:
            last = self.tenures[-1]
            if event.token and event.token <= last.token:
                self._begin_again(event, last)
                return
            if event.looked:
                from_ns = max(from_ns, last.from_ns if last.to_ns is None else last.to_ns)
            if last.to_ns is None:  # ends no later than the next one begins
                self.tenures[-1] = replace(last, to_ns=from_ns, ended=_ending_by(event.action))
        before = self.tenures[-1].token if self.tenures else 0
        self.tenures.append(
            Tenure(
                *(event.motor, event.token, event.owner, event.purpose),
                *(event.pid, event.program, event.sender),
                from_ns,
                None,
                Ended.NOT_YET,
                event.waited_s,
                skipped=max(0, event.token - before - 1) if before else 0,
                looked=event.looked,
            )
        )

    def _begin_again(self, event: LockEvent, last: Tenure) -> None:
        """Handle a known token: the same owner announced twice, or a contradiction."""
        before = self.tenures[-2] if len(self.tenures) > 1 else None
        if (event.token, event.pid, event.owner) != (last.token, last.pid, last.owner):
            self.contradictions.append(_contradiction(event, last.owner, last.token))
        elif before is not None and before.ended is Ended.UNTOLD:
            self.tenures[-2] = replace(before, ended=_ending_by(event.action))

    def _release(self, event: LockEvent) -> None:
        place = self._place_of(event)
        if place is None:
            return
        tenure = self.tenures[place]
        if tenure.to_ns is None:
            tenure = replace(tenure, to_ns=event.time_ns, ended=Ended.RELEASED)
        elif tenure.ended is Ended.UNTOLD:  # the next owner's message arrived first
            crossed_ns = event.time_ns - tenure.to_ns
            tenure = replace(tenure, ended=Ended.RELEASED, crossed_ns=crossed_ns)
        self.tenures[place] = tenure

    def _lose(self, event: LockEvent) -> None:
        place = self._place_of(event)
        if place is None:
            return
        tenure = self.tenures[place]
        to_ns = event.time_ns if tenure.to_ns is None else tenure.to_ns
        self.tenures[place] = replace(
            tenure, to_ns=to_ns, ended=Ended.TAKEN_OVER, noticed_ns=event.time_ns
        )

    def _place_of(self, event: LockEvent) -> int | None:
        """Return the index of the event's tenure, searching backwards, or None."""
        for place in range(len(self.tenures) - 1, -1, -1):
            tenure = self.tenures[place]
            if (tenure.token, tenure.pid) == (event.token, event.pid):
                return place
        return None


def _ending_by(action: LockAction) -> Ended:
    """Return how the tenure before ended, derived from how the next one began."""
    endings = {LockAction.BROKEN: Ended.DIED, LockAction.TAKEN_OVER: Ended.TAKEN_OVER}
    return endings.get(action, Ended.UNTOLD)
