"""Who had which motor when, by a recording alone.

    ownership = read_ownership("run.mcap")
    for tenure in ownership.tenures["pan"]:
        print(tenure)
    tenure = ownership.owner_at("pan", time_ns)

A *tenure* is one owner's time with one motor, from the message that it was taken to the one that it
was given back, or to the next owner's. Tokens put tenures in order, whatever was heard first: what
programs tell at the same time may cross, by several handovers too. Nobody had it later than it was
heard that he, or anybody after him, had it: his time begins there, and the one's before ends there
at the latest. `crossed_ns` tells how much later than that it was heard that it was given back.

What a recording can prove is what was told to its recorder. Programs built on motorapi tell it on a
rig of their own process and on a hub; others do not, and their frames have no tenure. Times are
those at which the recorder heard of it: on a hub later than it happened, by the time the message
took. A tenure lasts for the operation, the reservation or low-level access it was taken for; on a
bus that other processes can join also as long as the motion that was begun goes on.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Final, final

from traces.protobuf import decode
from traces.reader import Trace, read_trace
from traces.schema import MOTOR_LOCK, LockAction

_ACTIONS: Final[dict[object, LockAction]] = {action.value: action for action in LockAction}
_BEGINS: Final = (LockAction.TAKEN, LockAction.BROKEN, LockAction.TAKEN_OVER)
_TENURE: Final = (*_BEGINS, LockAction.RELEASED, LockAction.LOST)


@final
@dataclass(frozen=True, slots=True)
class LockEvent:
    """One message of `/motor/<name>/lock`; what was not told is empty, or 0.

    Attributes: motor; time_ns (when the recorder heard of it); action; owner (who takes, waits or
    gives back); holder (who has it, if not the owner); purpose; token; pid; program; sender (what
    the frames of that process are recorded under); waited_s; held_s; looked (seen from outside).
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
    """How a tenure ended, in words that follow "it"."""

    RELEASED = "gave it back"
    DIED = "died with it"
    TAKEN_OVER = "lost it to the next one"
    UNTOLD = "did not tell how it ended"
    NOT_YET = "had it when the record ended"


@final
@dataclass(frozen=True, slots=True)
class Tenure:
    """One owner's time with one motor.

    Attributes: motor; token; owner, purpose, pid, program, sender (as in LockEvent); from_ns, to_ns
    (None: the record ends before); ended; waited_s (for its turn); noticed_ns (when one who lost it
    noticed, if it did); crossed_ns (how much later than `to_ns` it was told that it was given
    back); skipped (tokens between the one before and this one: of owners who did not tell, or were
    not seen); looked (seen from outside).
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
        """Whether the motor was its own at this time; of a handover, the later one's."""
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
@dataclass(frozen=True, slots=True)
class OwnershipRecord:
    """What a recording tells of the ownership of motors.

    Attributes:
        events: all of them, in the order of the record.
        tenures: by motor, in order of tokens; motors of which nothing was told are not in it.
        contradictions: what cannot have been so, in words: one token taken by two, or a process
            whose tokens fall. Empty in any recording of a lock that works.
    """

    events: tuple[LockEvent, ...]
    tenures: Mapping[str, tuple[Tenure, ...]]
    contradictions: tuple[str, ...]

    def owner_at(self, motor: str, time_ns: int) -> Tenure | None:
        """Whose the motor was; None: nobody's, as far as was told."""
        for tenure in reversed(self.tenures.get(motor, ())):
            if tenure.has(time_ns):
                return tenure
        return None


def read_ownership(recording: str | os.PathLike[str] | Trace) -> OwnershipRecord:
    """What the recording tells of ownership, all motors together.

    Raises:
        TraceError: it cannot be read, or is damaged.
    """
    if not isinstance(recording, Trace):
        with read_trace(recording) as trace:
            return read_ownership(trace)
    return ownership_of(lock_events(recording))


def lock_events(trace: Trace) -> Iterator[LockEvent]:
    """The messages of all `/motor/<name>/lock`, in the order of the record."""
    for channel, time_ns, data in trace.messages():
        name = motor_of(channel.topic)
        if name is not None:
            yield _event(name, time_ns, data)


def motor_of(topic: str) -> str | None:
    """The motor whose lock this topic tells of; None: it is another topic."""
    if topic.startswith("/motor/") and topic.endswith("/lock"):
        return topic[len("/motor/") : -len("/lock")]
    return None


def _event(motor: str, time_ns: int, data: bytes) -> LockEvent:
    values = decode(MOTOR_LOCK, data)
    action = _ACTIONS.get(values.pop("action", 0), LockAction.UNKNOWN)  # of a later version
    # Any: protobuf's fields are of the kinds that the table says, those of LockEvent's.
    facts: dict[str, Any] = dict(values)
    return LockEvent(motor, time_ns, action, **facts)


def ownership_of(events: Iterable[LockEvent]) -> OwnershipRecord:
    """The same of events that were heard otherwise, in their order."""
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
    """What was told of one motor's handovers, by tokens; what began is told no later than it did.

    Who took it is heard after he took it, and so is everybody after him: the first that is heard of
    any of them is the latest that he can have begun.
    """
    ranks: list[tuple[int, int, LockEvent]] = []  # token, place
    last = 0  # where there are no tokens, the order is that of the messages
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
    """What one process tells is heard in the order in which it told it: its tokens never fall."""
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
        f"{event.motor}: at {event.time_ns / 1e9:.6f} s {event.owner} has it under token"
        f" {event.token}; {owner} had it under {token} already"
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
        """One event more."""
        if event.action in _BEGINS:
            self._begin(event)
        elif event.action is LockAction.RELEASED:
            self._release(event)
        elif event.action is LockAction.LOST:
            self._lose(event)

    def _begin(self, event: LockEvent) -> None:
        from_ns = event.time_ns
        if event.looked:  # it is older than the look, but no older than what was seen before
            from_ns = max(0, from_ns - round(event.held_s * 1e9))
        if self.tenures:
            last = self.tenures[-1]
            if event.token and event.token <= last.token:
                self._begin_again(event, last)
                return
            if event.looked:
                from_ns = max(from_ns, last.from_ns if last.to_ns is None else last.to_ns)
            if last.to_ns is None:  # over at the latest where the next one begins
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
        """A token that is not new: one owner's taking told in two messages, or a contradiction."""
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
        elif tenure.ended is Ended.UNTOLD:  # the next one's word was heard first
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
        """Which tenure the event is of, looking from the last one backwards."""
        for place in range(len(self.tenures) - 1, -1, -1):
            tenure = self.tenures[place]
            if (tenure.token, tenure.pid) == (event.token, event.pid):
                return place
        return None


def _ending_by(action: LockAction) -> Ended:
    """How the one before ended, by how the next one took it."""
    endings = {LockAction.BROKEN: Ended.DIED, LockAction.TAKEN_OVER: Ended.TAKEN_OVER}
    return endings.get(action, Ended.UNTOLD)
