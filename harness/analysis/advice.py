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

Margins of a bus: tolerated errors, and helpful bit rates and queues.
"""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from math import exp, expm1, lgamma, log, log1p
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.synchronization.bus_load import rank_of
from motorhil.motorapi.synchronization.can_response_time import (
    NO_ERRORS,
    BusLoad,
    Effort,
    ErrorModel,
    Lateness,
    Message,
    are_in_time,
    response_between,
    response_times,
)

_SFF_MAX: Final = 0x7FF
_EFF_MAX: Final = 0x1FFF_FFFF
_WORK_MAX: Final = 10_000  # total number of messages examined, over all moves
_MOVES_MIN: Final = 100

Reserved = Callable[[int, bool], bool]
"""Predicate: True if an identifier (extended or not) must not be assigned to a message."""


@final
@frozen
class Change:
    """A new identifier of the same format for a message."""

    message: Message
    identifier: int

    @property
    def label(self) -> str:
        """The new identifier in the form of `Message.label`."""
        return replace(self.message, identifier=self.identifier).label


@final
@frozen
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


_ENDED: Final = "the search was ended after too many steps; other changes may help"


def propose(
    load: BusLoad, errors: ErrorModel, is_reserved: Reserved, effort: Effort | None = None
) -> Proposal:
    """Propose changes after which every message is in time; none if all are in time now."""
    effort = Effort() if effort is None else effort
    if are_in_time(load, errors, effort):
        return Proposal(())
    queues = _has_queues(load)
    order = None if queues else best_order(load, errors, effort)
    if effort.is_over():
        return Proposal(None, reason=_ENDED)
    if order is None and not queues:
        return Proposal(
            None, is_impossible=True, reason="no order of identifiers helps (proved level by level)"
        )
    late = [
        one.message.rank for one in response_times(load, errors, effort) if one.is_in_time is False
    ]
    moves = _moves(load, is_reserved)
    if not queues:
        moves = (move for move in moves if _may_help(move, late))
    for change in islice(moves, max(_MOVES_MIN, _WORK_MAX // len(load.messages))):
        changed = with_changes(load, (change,))
        if are_in_time(changed, errors, effort, _ranks_after(change, late)):
            return Proposal((change,))
        if effort.is_over():
            return Proposal(None, reason=_ENDED)
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


def best_order(
    load: BusLoad, errors: ErrorModel = NO_ERRORS, effort: Effort | None = None
) -> tuple[Message, ...] | None:
    """Return a feasible order close to the present one, most urgent first, or None.

    Every node must send its messages by priority.
    """
    effort = Effort() if effort is None else effort
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
            if response_between(load, rest, one, below, errors, effort).is_in_time is not False:
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


def _ranks_after(move: Change, ranks: Sequence[int]) -> frozenset[int]:
    """Return the ranks of the same messages after a move."""
    old = move.message.rank
    new = rank_of(move.identifier, extended=move.message.extended)
    return frozenset(new if rank == old else rank for rank in ranks)


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


USUAL_BIT_S: Final = (
    *(10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000),
)
_INTERVAL_MAX_NS: Final = 100_000_000_000
_STEP_NS: Final = 1_000
ERRORS_MAX: Final = 99  # upper limit of the search
_MEAN_CERTAIN: Final = 1_000.0  # so many errors on average are more than ERRORS_MAX, by 1 - 1e-200


def shortest_error_interval_ns(
    load: BusLoad, burst: int = 1, effort: Effort | None = None
) -> int | None:
    """Return the shortest error interval, after a burst, that makes no message late [ns].

    The result is accurate to 1 us or 1/1000, whichever is more, and never too short. None: the
    burst alone makes a message late.
    """
    effort = Effort() if effort is None else effort
    lateness: Lateness = {}  # of the shortest interval that is tolerated

    def is_tolerated(interval_ns: int | None) -> bool:
        errors = ErrorModel(burst, interval_ns)
        return are_in_time(load, errors, effort, lateness=lateness)

    low, high = 0, _INTERVAL_MAX_NS // _STEP_NS  # not tolerated, tolerated
    if not is_tolerated(None) or not is_tolerated(high * _STEP_NS):
        return None
    while high - low > max(1, low // 1_000):
        middle = (low + high) // 2
        if is_tolerated(middle * _STEP_NS):
            high = middle
        else:
            low = middle
    return high * _STEP_NS


def more_errors_probability(errors: int, bits: int, bit_error_rate: float) -> float:
    """Bound the probability of more than `errors` independent bit errors in `bits` bits.

    The number of errors is binomial. A Poisson variable of mean -bits ln(1 - rate) is
    stochastically at least as large, and its tail is returned. Source: Broster, Burns &
    Rodriguez-Navas, Probabilistic analysis of CAN with faults (2002), for the idea.
    """
    mean = -bits * log1p(-bit_error_rate)
    if mean == 0.0:
        return 0.0
    if mean > _MEAN_CERTAIN and errors <= ERRORS_MAX:
        return 1.0
    if errors == 0:
        return -expm1(-mean)
    total = 0.0
    count = errors + 1
    while True:
        part = exp(count * log(mean) - mean - lgamma(count + 1))
        total += part
        if count > mean and part <= total * 1e-12:
            return min(1.0, total)
        count += 1


@final
@frozen
class Tolerance:
    """The number of errors that a message tolerates.

    Attributes:
        message: a message with a deadline.
        errors: the largest tolerated number of errors in a busy period, up to ERRORS_MAX; None: the
            message is late even without errors.
        window_bits: the longest busy period with that many errors [bit].
    """

    message: Message
    errors: int | None
    window_bits: int

    def late_probability(self, bit_error_rate: float) -> float:
        """Bound the probability that a frame is late at this bit error rate.

        A late frame has seen more errors in its busy period than it tolerates.
        """
        if self.errors is None:
            return 1.0
        return more_errors_probability(self.errors, self.window_bits, bit_error_rate)


def tolerances(load: BusLoad, effort: Effort | None = None) -> tuple[Tolerance, ...]:
    """Return the tolerance of every message with a deadline, the most urgent first."""
    effort = Effort() if effort is None else effort
    found: dict[int, Tolerance] = {}
    timed = [one for one in load.messages if one.deadline_ns is not None]
    low: dict[int, int] = {one.rank: -1 for one in timed}  # tolerated
    high: dict[int, int] = {one.rank: ERRORS_MAX + 1 for one in timed}  # not tolerated
    asked: dict[int, Lateness] = {}
    while True:
        open_ranks = [rank for rank in low if high[rank] - low[rank] > 1]
        if not open_ranks:
            break
        errors = _next_burst(low[open_ranks[0]], high[open_ranks[0]])
        assert errors not in asked
        fewer = max((number for number in asked if number < errors), default=None)
        lateness = asked[errors] = {} if fewer is None else dict(asked[fewer])
        for one in response_times(load, ErrorModel(errors), effort, lateness, open_ranks):
            rank = one.message.rank
            if one.is_in_time and errors > low.get(rank, errors):
                low[rank] = errors
                assert one.busy_ns is not None
                bits = -(-one.busy_ns * load.bitrate_bit_s // 1_000_000_000)
                found[rank] = Tolerance(one.message, errors, bits)
            elif one.is_in_time is False and errors < high[rank]:
                high[rank] = errors
    return tuple(
        found.get(one.rank, Tolerance(one, None, 0))
        for one in sorted(timed, key=lambda one: one.rank)
    )


def _next_burst(low: int, high: int) -> int:
    """Return the next burst to try; small numbers first, since few buses tolerate many."""
    if low < 0:
        return 0
    return min(max(1, 2 * low), (low + high) // 2) if 2 * low < high else (low + high) // 2


def rate_that_helps(
    load: BusLoad, errors: ErrorModel = NO_ERRORS, effort: Effort | None = None
) -> int | None:
    """Return the lowest usual bit rate above the present one that brings all in time, or None."""
    effort = Effort() if effort is None else effort
    for rate in USUAL_BIT_S:
        if rate > load.bitrate_bit_s and are_in_time(at_rate(load, rate), errors, effort):
            return rate
    return None


def at_rate(load: BusLoad, bitrate_bit_s: int) -> BusLoad:
    """Return the load at another nominal bit rate; a lower data rate rises to it."""
    data = load.data_bitrate_bit_s
    return replace(
        load,
        bitrate_bit_s=bitrate_bit_s,
        data_bitrate_bit_s=None if data is None else max(data, bitrate_bit_s),
    )


def queues_that_help(
    load: BusLoad, errors: ErrorModel = NO_ERRORS, effort: Effort | None = None
) -> tuple[str, ...] | None:
    """Return the senders that must send by priority to bring all in time; None: no help.

    A single sender is returned if one is sufficient, otherwise all of them.
    """
    effort = Effort() if effort is None else effort
    for sender in sorted(load.fifo):
        if are_in_time(replace(load, fifo=load.fifo - {sender}), errors, effort):
            return (sender,)
    if load.fifo and are_in_time(replace(load, fifo=frozenset()), errors, effort):
        return tuple(sorted(load.fifo))
    return None
