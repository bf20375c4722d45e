"""Linearizability of histories, and the specification of an owned motor.

In a *linearizable* history every use can be assigned one instant between its call and its return.
The sequential specification must allow the uses in the order of these instants (Herlihy & Wing
1990). A history is linearizable if the history of each motor is (their Theorem 1). The motors are
therefore searched one by one.

The search is that of Wing & Gong (1993), with Lowe's improvements (2017). The first remaining
return bounds the candidates for the next use. A set of uses that was reached once with one state is
not entered again. The search is exponential in the worst case. For n uses with few overlaps it
takes about n steps.

The specification `OwnedMotor` is a motor with one owner at a time, first come, first served. A TAKE
is split into two events, entering the queue and being granted the motor, so that the order is
judged as well.
"""

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Generic, Protocol, TypeVar, final

from motorhil.harness.sharing_tests.history import (
    FOREVER_NS,
    Action,
    Answer,
    SharingViolated,
    Use,
    per_motor,
)

S = TypeVar("S", bound=Hashable)
E = TypeVar("E", bound="Interval")
E_contra = TypeVar("E_contra", contravariant=True)


class Interval(Protocol):
    """An event with a call and a return."""

    @property
    def called_ns(self) -> int:
        """A time before its effect [ns]."""

    @property
    def returned_ns(self) -> int:
        """A time after its effect [ns]."""


class Specification(Protocol[S, E_contra]):
    """The allowed sequences of events."""

    def initial(self) -> S:
        """Return the initial state."""

    def step(self, state: S, event: E_contra) -> Sequence[S]:
        """Return the possible states after `event`; none if the event is not allowed."""


@final
@dataclass(frozen=True, slots=True)
class Search(Generic[E]):
    """The result of a search.

    Attributes:
        order: the events in an allowed order; None: there is none.
        reached: the longest start of such an order that was found.
        stuck: the events that could follow by their times, but were not allowed.
        state: the state at that point.
        steps: number of tried events.
    """

    order: tuple[E, ...] | None
    reached: tuple[E, ...]
    stuck: tuple[E, ...]
    state: object
    steps: int


class _Entry(Generic[E]):
    """A call or a return, in a linked list that supports removal and reinsertion."""

    __slots__ = ("after", "before", "end", "event", "number")

    def __init__(self, event: E, number: int, end: "_Entry[E] | None") -> None:
        self.event = event
        self.number = number
        self.end = end  # of a call: its return; None: this is a return
        self.before: _Entry[E] = self
        self.after: _Entry[E] | None = None

    def lift(self) -> None:
        """Remove a call and its return from the list, keeping their positions."""
        self.unlink()
        if self.end is not None:
            self.end.unlink()

    def put_back(self) -> None:
        """Reinsert them at their positions, in the reverse order of removal."""
        if self.end is not None:
            self.end.relink()
        self.relink()

    def unlink(self) -> None:
        """Remove this entry from the list."""
        self.before.after = self.after
        if self.after is not None:
            self.after.before = self.before

    def relink(self) -> None:
        """Reinsert this entry at its position."""
        self.before.after = self
        if self.after is not None:
            self.after.before = self


_Choice = tuple[_Entry[E], S, list[S], int, int]
"""A chosen event: entry, state before, alternative states, and the set chosen before."""


def _entries(events: Sequence[E]) -> _Entry[E]:
    """Return the head of the list of all calls and returns by time; calls first."""
    marks: list[tuple[int, int, int, _Entry[E]]] = []
    for number, event in enumerate(events):
        end: _Entry[E] = _Entry(event, number, None)
        marks.append((event.called_ns, 0, number, _Entry(event, number, end)))
        marks.append((event.returned_ns, 1, number, end))
    marks.sort(key=lambda mark: mark[:3])
    head: _Entry[E] = _Entry(events[0], -1, None)  # a sentinel; its event is not used
    last = head
    for *_, entry in marks:
        last.after, entry.before = entry, last
        last = entry
    return head


def search(events: Sequence[E], specification: Specification[S, E]) -> Search[E]:
    """Search for an order that the specification allows, or the longest start of one."""
    events = sorted(events, key=lambda event: event.called_ns)
    if not events:
        return Search((), (), (), specification.initial(), 0)
    head = _entries(events)
    state = specification.initial()
    taken: list[_Choice[E, S]] = []
    seen: set[tuple[int, int, S]] = set()
    passed = ahead = steps = 0  # all before number `passed` are chosen, and those in `ahead`
    furthest: Search[E] | None = None
    entry = head.after
    while entry is not None:
        if entry.end is not None:  # a call: a candidate for the next event
            steps += 1
            choices = list(specification.step(state, entry.event))
        else:  # a return that must not be passed: the last choice was wrong
            if furthest is None or len(taken) > len(furthest.reached):
                furthest = Search(None, _events(taken), _first_calls(head), state, steps)
            if not taken:
                return replace(furthest, steps=steps)
            entry, state, choices, passed, ahead = taken.pop()
            entry.put_back()
        reached = _with(passed, ahead, entry.number)
        while choices and (*reached, choices[-1]) in seen:
            choices.pop()
        if not choices:
            entry = entry.after
            continue
        after = choices.pop()
        taken.append((entry, state, choices, passed, ahead))
        seen.add((*reached, after))
        (passed, ahead), state = reached, after
        entry.lift()
        entry = head.after
    order = _events(taken)
    return Search(order, order, (), state, steps)


def _with(passed: int, ahead: int, number: int) -> tuple[int, int]:
    """Add a number to a set: all numbers below the first, and bits from there on."""
    ahead |= 1 << (number - passed)
    while ahead & 1:
        ahead >>= 1
        passed += 1
    return passed, ahead


def _events(taken: "Sequence[_Choice[E, S]]") -> tuple[E, ...]:
    return tuple(choice[0].event for choice in taken)


def _first_calls(head: _Entry[E]) -> tuple[E, ...]:
    """Return the events that may be next by their times."""
    calls: list[E] = []
    entry = head.after
    while entry is not None and entry.end is not None:
        calls.append(entry.event)
        entry = entry.after
    return tuple(calls)


# ---- an owned motor ----


@final
@dataclass(frozen=True, slots=True)
class Owned:
    """The state of a motor between two uses: owner, token, queue, and last command."""

    holder: str
    token: int
    queue: tuple[str, ...]
    value: int


@final
@dataclass(frozen=True, slots=True)
class Event:
    """One event: a use, or (`queues`) the first half of a TAKE."""

    use: Use
    called_ns: int
    returned_ns: int
    queues: bool = False

    def __str__(self) -> str:
        return f"in the queue: {self.use}" if self.queues else str(self.use)


@final
class OwnedMotor:
    """The specification: one owner at a time, first come, first served; only it commands.

    Args:
        value: the command before the first use.
    """

    def __init__(self, value: int = 0) -> None:
        self._value: Final = value

    def initial(self) -> Owned:
        """Return the state without an owner."""
        return Owned("", 0, (), self._value)

    def step(self, state: Owned, event: Event) -> list[Owned]:
        """Return the possible next states; see `Specification.step`."""
        use = event.use
        allowed = _effect(state, event)
        if use.answer is Answer.UNKNOWN and (not event.queues or use.queued_ns is None):
            without = state
            is_over = event.returned_ns < FOREVER_NS
            if use.action is Action.TAKE and not event.queues and is_over:  # no longer waiting
                without = _without(state, use.who)
                if allowed is None:  # or taken from a living owner without a report
                    allowed = _taken(state, replace(use, forced=True))
            return [without] if allowed is None or allowed == without else [allowed, without]
        return [] if allowed is None else [allowed]


def _effect(state: Owned, event: Event) -> Owned | None:
    """Return the next state, or None if impossible now; unknown answers count as done."""
    use, who = event.use, event.use.who
    is_his = state.holder == who
    if event.queues:
        return None if who in state.queue else replace(state, queue=(*state.queue, who))
    if use.action is Action.TAKE:
        return _taken(state, use)
    if use.action is Action.READ:
        is_known = use.answer is Answer.DONE
        return None if is_known and use.value != state.value else state
    if use.action is Action.DIE:
        return replace(_without(state, who), holder="" if is_his else state.holder)
    if use.answer in (Answer.LOST, Answer.REFUSED):
        return None if is_his else state
    if not is_his:
        return None
    if use.action is Action.GIVE:
        return replace(state, holder="")
    return replace(state, value=use.value)


def _without(state: Owned, who: str) -> Owned:
    """Return the state without `who` in the queue."""
    if who not in state.queue:
        return state
    return replace(state, queue=tuple(one for one in state.queue if one != who))


def _taken(state: Owned, use: Use) -> Owned | None:
    who, rest = use.who, _without(state, use.who).queue
    waits = use.queued_ns is not None or not use.forced
    is_first = bool(state.queue) and state.queue[0] == who
    if use.answer is Answer.REFUSED:
        is_possible = not waits or (who in state.queue and bool(state.holder or not is_first))
        return replace(state, queue=rest) if is_possible else None
    if (waits and not is_first) or (state.holder and not use.forced) or state.holder == who:
        return None
    if use.token and use.token <= state.token:
        return None
    return Owned(who, use.token or state.token, rest, state.value)


def events_of(uses: Iterable[Use]) -> list[Event]:
    """Return the uses of one motor as events of the specification."""
    events: list[Event] = []
    for use in uses:
        if use.action is Action.TAKE and (use.queued_ns is not None or not use.forced):
            until_ns = use.returned_ns if use.queued_ns is None else use.queued_ns
            events.append(Event(use, use.called_ns, until_ns, queues=True))
        events.append(Event(use, use.called_ns, use.returned_ns))
    return events


def require_linearizable(uses: Iterable[Use], value: int = 0) -> int:
    """Check that every motor's history is linearizable, and return the number of steps.

    Args:
        uses: of any number of motors; those of the dead as in `History.uses`.
        value: the command of each motor before the first use.

    Raises:
        SharingViolated: a history is not linearizable; the message names the uses in conflict.
    """
    steps = 0
    for motor, of_motor in per_motor(uses).items():
        found = search(events_of(of_motor), OwnedMotor(value))
        steps += found.steps
        if found.order is None:
            raise SharingViolated(_complaint(motor, found, len(of_motor)))
    return steps


def _complaint(motor: str, found: Search[Event], number: int) -> str:
    last = [f"    {event}" for event in found.reached[-6:]] or ["    nothing"]
    stuck = [f"    {event}" for event in found.stuck]
    return "\n".join(
        [
            f"{motor}: no order of its {number} uses fits a motor with one owner at a time, "
            "first come, first served. The longest possible order ends with:",
            *last,
            f"The state is then {found.state}; one of these had to be next, but is not allowed:",
            *stuck,
        ]
    )
