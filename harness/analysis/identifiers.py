"""Proposal of new identifiers that bring every message in time, with few changes.

First a single message is moved to each other priority where its format has a free identifier. The
shortest moves come first, and large sets are not searched completely. If no move helps, a complete
order is built from the bottom. Each level takes the message that is least urgent now and meets its
deadline there.

Audsley's argument holds for CAN (Davis et al. 2007, section 7): the response time of a message
depends on the set of more urgent messages, not on their order. If no message fits a level, no order
exists.

Messages that cannot move keep their order. As many others as possible keep their identifiers; the
number of changes is not proved to be minimal. Where the gaps between kept identifiers are too
small, messages exchange their identifiers.

A node with one FIFO queue breaks Audsley's argument, since a message delays more urgent ones behind
it. In that case only single moves are tried.
"""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Final, final

from harness.analysis.errors import NO_ERRORS, ErrorModel
from harness.analysis.message import BusLoad, Message, rank_of
from harness.analysis.response_time import are_in_time, response_between, response_times

_SFF_MAX: Final = 0x7FF
_EFF_MAX: Final = 0x1FFF_FFFF
_WORK_MAX: Final = 10_000  # total number of messages examined, over all moves
_MOVES_MIN: Final = 100

Reserved = Callable[[int, bool], bool]
"""Predicate: True if an identifier (extended or not) must not be assigned to a message."""


@final
@dataclass(frozen=True, slots=True)
class Change:
    """A new identifier of the same format for a message."""

    message: Message
    identifier: int

    @property
    def label(self) -> str:
        """The new identifier in the form of `Message.label`."""
        return replace(self.message, identifier=self.identifier).label


@final
@dataclass(frozen=True, slots=True)
class Proposal:
    """A proposal of identifier changes.

    Attributes:
        changes: the changes; None if none were found.
        is_impossible: True if no identifiers help, as proved.
        reason: why no changes were found.
    """

    changes: tuple[Change, ...] | None
    is_impossible: bool = False
    reason: str = ""


_NO_ROOM: Final = "another order helps, but too few identifiers are free between those that stay"


def propose(load: BusLoad, errors: ErrorModel, is_reserved: Reserved) -> Proposal:
    """Propose changes after which every message is in time; none if all are in time now."""
    if are_in_time(load, errors):
        return Proposal(())
    queues = _has_queues(load)
    order = None if queues else best_order(load, errors)
    if order is None and not queues:
        return Proposal(
            None, is_impossible=True, reason="no order of identifiers helps (proved level by level)"
        )
    late = [one.message.rank for one in response_times(load, errors) if one.is_in_time is False]
    moves = _moves(load, is_reserved)
    if not queues:
        moves = (move for move in moves if _may_help(move, late))
    for change in islice(moves, max(_MOVES_MIN, _WORK_MAX // len(load.messages))):
        if are_in_time(with_changes(load, (change,)), errors):
            return Proposal((change,))
    if order is None:
        return Proposal(
            None,
            reason="no single change helps; with FIFO queues only single changes are tried",
        )
    changes = _renamed(load, order, is_reserved) or _exchanged(order)
    if changes is None:
        return Proposal(None, reason=_NO_ROOM)
    return Proposal(changes)


def with_changes(load: BusLoad, changes: Sequence[Change]) -> BusLoad:
    """Return the bus load after the changes."""
    new = {change.message.rank: change.identifier for change in changes}
    return replace(
        load,
        messages=tuple(
            replace(one, identifier=new[one.rank]) if one.rank in new else one
            for one in load.messages
        ),
    )


def best_order(load: BusLoad, errors: ErrorModel = NO_ERRORS) -> tuple[Message, ...] | None:
    """Return a feasible order close to the present one, most urgent first, or None.

    Every node must send its messages by priority.
    """
    left = sorted(load.messages, key=lambda one: one.rank)
    below: list[Message] = []
    while left:
        fixed_seen = False
        for place in range(len(left) - 1, -1, -1):
            one = left[place]
            if not one.movable and fixed_seen:
                continue
            fixed_seen = fixed_seen or not one.movable
            rest = left[:place] + left[place + 1 :]
            if response_between(load, rest, one, below, errors).is_in_time is not False:
                below.insert(0, one)
                left = rest
                break
        else:
            return None
    return tuple(below)


def _has_queues(load: BusLoad) -> bool:
    senders = [one.sender for one in load.messages if one.sender in load.fifo]
    return len(senders) > len(set(senders))


def _moves(load: BusLoad, is_reserved: Reserved) -> Iterator[Change]:
    """Yield the moves of every message to every other place, short moves first."""
    order = sorted(load.messages, key=lambda one: one.rank)
    used = frozenset((one.identifier, one.extended) for one in order)
    for step in range(1, len(order)):
        for place, one in enumerate(order):
            for to in (place - step, place + step):
                if not one.movable or not 0 <= to < len(order):
                    continue
                others = order[:place] + order[place + 1 :]
                low = others[to - 1].rank if to else -1
                high = others[to].rank if to < len(others) else 1 << 40
                free = _free(low, high, one.extended, used, is_reserved, upward=to > place)
                identifier = next(free, None)
                if identifier is not None:
                    yield Change(one, identifier)


def _may_help(move: Change, late: Sequence[int]) -> bool:
    """Return True if each late message moves up, or is no longer preceded by the moved one."""
    old = move.message.rank
    new = rank_of(move.identifier, extended=move.message.extended)
    return all(new < old if rank == old else old < rank < new for rank in late)


def _free(
    low: int,
    high: int,
    extended: bool,
    used: frozenset[tuple[int, bool]],
    is_reserved: Reserved,
    *,
    upward: bool,
) -> Iterator[int]:
    """Yield free identifiers between two ranks (exclusive); `upward`: the lowest first."""
    last = _EFF_MAX if extended else _SFF_MAX
    numbers = range(last + 1)
    begin = bisect_left(numbers, low + 1, key=lambda n: rank_of(n, extended=extended))
    end = bisect_left(numbers, high, key=lambda n: rank_of(n, extended=extended))
    for number in range(begin, end) if upward else range(end - 1, begin - 1, -1):
        if (number, extended) not in used and not is_reserved(number, extended):
            yield number


def _renamed(
    load: BusLoad, order: Sequence[Message], is_reserved: Reserved
) -> tuple[Change, ...] | None:
    """Return the changes for this order with as many kept identifiers as possible, or None."""
    kept = _longest_kept(order)
    used = frozenset((one.identifier, one.extended) for one in load.messages)
    changes: list[Change] = []
    low = -1
    for place, one in enumerate(order):
        if one.rank in kept:
            low = one.rank
            continue
        high = next((later.rank for later in order[place:] if later.rank in kept), 1 << 40)
        identifier = next(_free(low, high, one.extended, used, is_reserved, upward=True), None)
        if identifier is None:
            return None
        used |= {(identifier, one.extended)}
        low = rank_of(identifier, extended=one.extended)
        changes.append(Change(one, identifier))
    return tuple(changes)


def _exchanged(order: Sequence[Message]) -> tuple[Change, ...] | None:
    """Return this order by exchange of the existing identifiers; None if that is not possible."""
    changes: list[Change] = []
    for one, place in zip(order, sorted(order, key=lambda each: each.rank), strict=True):
        if one is place:
            continue
        if not one.movable or one.extended != place.extended:
            return None
        changes.append(Change(one, place.identifier))
    return tuple(changes)


def _longest_kept(order: Sequence[Message]) -> frozenset[int]:
    """Return the ranks of a longest subset in the present order that has all fixed messages."""
    best: list[tuple[int, tuple[int, ...]]] = []
    for one in order:
        before = [
            found for found, earlier in zip(best, order, strict=False) if earlier.rank < one.rank
        ]
        weight, ranks = max(before, default=(0, ()), key=lambda found: found[0])
        best.append((weight + (1 if one.movable else len(order) + 1), (*ranks, one.rank)))
    return frozenset(max(best, default=(0, ()), key=lambda found: found[0])[1])
