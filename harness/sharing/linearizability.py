"""Whether a history could have come from uses that happened one by one, each at some instant.

A history is *linearizable* if every use can be given one instant between its call and its return,
such that, one after another at those instants, they are what the sequential specification allows
(Herlihy & Wing 1990). It is so as a whole if it is so for each motor alone (their Theorem 1), so
motors are searched one by one.

The search is that of Wing & Gong (1993), with Lowe's improvements (2017): always the first return
that is left bounds who may be next, and a set of uses that was reached once with one state is not
entered again. It is exponential at worst; with n uses of which few overlap it takes some n steps.

The specification here is a motor that is owned, first come, first served, by `OwnedMotor`. A TAKE
is two uses for it: to be in the queue, and to be given the motor; so that order is judged too.
"""

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Generic, Protocol, TypeVar, final

from harness.sharing.history import (
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
    """What has a call and a return."""

    @property
    def called_ns(self) -> int:
        """Before it could have its effect."""

    @property
    def returned_ns(self) -> int:
        """After it could not any more."""


class Specification(Protocol[S, E_contra]):
    """What is allowed one by one."""

    def initial(self) -> S:
        """The state at the beginning."""

    def step(self, state: S, event: E_contra) -> Sequence[S]:
        """The states in which `event` may leave the thing; none: it could not happen there."""


@final
@dataclass(frozen=True, slots=True)
class Search(Generic[E]):
    """What came of a search.

    order: the events in an order that the specification allows; None: there is none.
    reached: the longest beginning of such an order that was found.
    stuck: what could have been next after that by its times, and was not allowed.
    state: in which state that was.
    steps: how often an event was tried.
    """

    order: tuple[E, ...] | None
    reached: tuple[E, ...]
    stuck: tuple[E, ...]
    state: object
    steps: int


class _Entry(Generic[E]):
    """A call or a return, in a list that they can be taken out of and put back into."""

    __slots__ = ("after", "before", "end", "event", "number")

    def __init__(self, event: E, number: int, end: "_Entry[E] | None") -> None:
        self.event = event
        self.number = number
        self.end = end  # of a call: its return; None: this is a return
        self.before: _Entry[E] = self
        self.after: _Entry[E] | None = None

    def lift(self) -> None:
        """A call and its return are out of the list, and remember where they were."""
        self._leave()
        if self.end is not None:
            self.end._leave()  # noqa: SLF001 -- another of its kind

    def put_back(self) -> None:
        """They are where they were; what was lifted later was put back before."""
        if self.end is not None:
            self.end._come_back()  # noqa: SLF001 -- another of its kind
        self._come_back()

    def _leave(self) -> None:
        self.before.after = self.after
        if self.after is not None:
            self.after.before = self.before

    def _come_back(self) -> None:
        self.before.after = self
        if self.after is not None:
            self.after.before = self


_Choice = tuple[_Entry[E], S, list[S], int, int]
"""An event that was taken: the state before, others that it may lead to, who was taken before."""


def _entries(events: Sequence[E]) -> _Entry[E]:
    """The head of the list of all calls and returns by time; calls first: they may overlap."""
    marks: list[tuple[int, int, int, _Entry[E]]] = []
    for number, event in enumerate(events):
        end: _Entry[E] = _Entry(event, number, None)
        marks.append((event.called_ns, 0, number, _Entry(event, number, end)))
        marks.append((event.returned_ns, 1, number, end))
    marks.sort(key=lambda mark: mark[:3])
    head: _Entry[E] = _Entry(events[0], -1, None)  # a place to begin at, whatever its event
    last = head
    for *_, entry in marks:
        last.after, entry.before = entry, last
        last = entry
    return head


def search(events: Sequence[E], specification: Specification[S, E]) -> Search[E]:
    """An order that the specification allows, or how far there is one."""
    events = sorted(events, key=lambda event: event.called_ns)
    if not events:
        return Search((), (), (), specification.initial(), 0)
    head = _entries(events)
    state = specification.initial()
    taken: list[_Choice[E, S]] = []
    seen: set[tuple[int, int, S]] = set()
    passed = ahead = steps = 0  # all before number `passed` are taken, and those in `ahead`
    furthest: Search[E] | None = None
    entry = head.after
    while entry is not None:
        if entry.end is not None:  # a call: may it be the next?
            steps += 1
            choices = list(specification.step(state, entry.event))
        else:  # a return that may not be passed: the last choice was wrong
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
    """A set of numbers with one more: all below the first, and bits from there on."""
    ahead |= 1 << (number - passed)
    while ahead & 1:
        ahead >>= 1
        passed += 1
    return passed, ahead


def _events(taken: "Sequence[_Choice[E, S]]") -> tuple[E, ...]:
    return tuple(choice[0].event for choice in taken)


def _first_calls(head: _Entry[E]) -> tuple[E, ...]:
    """Who may be next, by the times alone."""
    calls: list[E] = []
    entry = head.after
    while entry is not None and entry.end is not None:
        calls.append(entry.event)
        entry = entry.after
    return tuple(calls)


# ---- a motor that is owned ----


@final
@dataclass(frozen=True, slots=True)
class Owned:
    """A motor in between two uses: whose it is, under what token, who waits, what it does."""

    holder: str
    token: int
    queue: tuple[str, ...]
    value: int


@final
@dataclass(frozen=True, slots=True)
class Event:
    """One thing that happens at an instant between two: a use, or (`queues`) its first half."""

    use: Use
    called_ns: int
    returned_ns: int
    queues: bool = False

    def __str__(self) -> str:
        return f"in the queue: {self.use}" if self.queues else str(self.use)


@final
class OwnedMotor:
    """The specification: one owner at a time, first come, first served; who owns it commands it.

    Args:
        value: what was commanded before the first use.
    """

    def __init__(self, value: int = 0) -> None:
        self._value: Final = value

    def initial(self) -> Owned:
        """Nobody has it."""
        return Owned("", 0, (), self._value)

    def step(self, state: Owned, event: Event) -> list[Owned]:
        """See `Specification`."""
        use = event.use
        allowed = _effect(state, event)
        if use.answer is Answer.UNKNOWN and (not event.queues or use.queued_ns is None):
            without = state
            is_over = event.returned_ns < FOREVER_NS
            if use.action is Action.TAKE and not event.queues and is_over:  # he waits no more
                without = _left(state, use.who)
                if allowed is None:  # or he took it from a living one, and could not say so
                    allowed = _taken(state, replace(use, forced=True))
            return [without] if allowed is None or allowed == without else [allowed, without]
        return [] if allowed is None else [allowed]


def _effect(state: Owned, event: Event) -> Owned | None:
    """What becomes of the motor; None: that cannot happen now. Unknown answers are as if done."""
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
        return replace(_left(state, who), holder="" if is_his else state.holder)
    if use.answer in (Answer.LOST, Answer.REFUSED):
        return None if is_his else state
    if not is_his:
        return None
    if use.action is Action.GIVE:
        return replace(state, holder="")
    return replace(state, value=use.value)


def _left(state: Owned, who: str) -> Owned:
    """He waits no more."""
    if who not in state.queue:
        return state
    return replace(state, queue=tuple(one for one in state.queue if one != who))


def _taken(state: Owned, use: Use) -> Owned | None:
    who, rest = use.who, _left(state, use.who).queue
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
    """The uses of one motor as what the specification speaks of."""
    events: list[Event] = []
    for use in uses:
        if use.action is Action.TAKE and (use.queued_ns is not None or not use.forced):
            until_ns = use.returned_ns if use.queued_ns is None else use.queued_ns
            events.append(Event(use, use.called_ns, until_ns, queues=True))
        events.append(Event(use, use.called_ns, use.returned_ns))
    return events


def require_linearizable(uses: Iterable[Use], value: int = 0) -> int:
    """Every motor's uses could have happened one by one; how many steps it took to see that.

    Args:
        uses: of any number of motors; of the dead, as `History.uses` ends them.
        value: what was commanded of each before the first use.

    Raises:
        SharingViolated: they could not; names the uses that do not fit.
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
            f"{motor}: no order of its {number} uses is one of a motor that has one owner at a"
            " time, first come, first served. One by one went well at best, last of all:",
            *last,
            f"so that it was {found.state}; then one of these had to be next, and could not be:",
            *stuck,
        ]
    )
