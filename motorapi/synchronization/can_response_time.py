"""Worst-case response time of every message on a CAN bus.

Davis, Burns, Bril & Lukkien, "Controller Area Network (CAN) schedulability analysis: Refuted,
revisited and revised" (Real-Time Systems 35, 2007), for nodes that send by priority:

    t     = E(t) + B + sum over hp(m) and m of n(t) C               the busy period
    w(q)  = E(w + C) + B + q C + sum over hp(m) of n(w + tau) C     waiting time of instance q
    R     = max over q of w(q) + C - (q T - J)

B is the longest frame of lower priority. tau is one bit: a frame queued within it still takes part
in the arbitration. n(t) = ceil((t + J) / T) is the number of frames in a time t. E is the cost of
errors. With a known minimum distance d, n(t) is also at most ceil(t / d).

A node with one FIFO queue follows Davis, Kollmann, Pollex & Slomka (ECRTS 2011; Real-Time Systems
49, 2013). Its messages M wait for everything more urgent than L, the least urgent of them. Their
sufficient test has one frame of each of M in the queue, which is correct only if all are in time.
Here a frame queued at `a` in a busy period of level L waits for all of M queued until then, and
each such `a` is examined:

    w(a)  = E(w + C) + B(L) + sum over M of n[0, a] C - C + sum over hp(L) not in M of n(w + tau) C
    R     = max over a of w(a) + C - a + J

Behind others in such a queue, a frame starts to compete up to f = max over a of w(a) - a after it
was queued. Frames that compete in a time t were thus queued in t + f. The f of one node depends on
that of others. They grow together until nothing changes, or one exceeds every period (then no bound
is given). For M of one message this is the theory above. The bound is pessimistic: frames of other
nodes between a message and L do not delay it once it is first in its queue.

The error model is a burst, then a minimum distance. Each error costs the longest error frame and
one retransmission, of the longest frame that can interfere. Source: Tindell, Burns & Wellings,
Calculating Controller Area Network (CAN) message response times (1995), section 5: (n + ceil(t / T)
- 1) (31 bits + C). The 31 bits are two consecutive flags of six bits, a delimiter of eight, and an
intermission of three. The last eight are the suspended transmission of an error passive sender.

All times are integer nanoseconds, rounded up. A frame has the maximum number of stuff bits, and the
3 bits of intermission in which no frame may begin.
"""

from bisect import bisect_left
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from heapq import heapify, heapreplace
from itertools import islice
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.synchronization.bus_load import CanTraffic, PeriodicMessage, rank_of
from motorhil.motorapi.synchronization.can_frame_length import (
    INTERMISSION_BITS,
    Bits,
    bits_ns,
    longest,
    shortest,
)

RECOVERY_BITS: Final = 31
_ROUNDS_MAX: Final = 100_000
_INSTANCES_MAX: Final = 20_000
_ENDS_MAX: Final = 1 << 16
_STEPS_A_ROUND: Final = 4
_STEPS_AN_END: Final = 2
STEPS_MAX: Final = 4_000_000


@final
class Effort:
    """The steps that an analysis may still take, about a million in a second.

    A step looks at one competing message. Jitters and periods that no message has, as in a damaged
    recording, would take for ever. What is not computed in time has no known bound.

    Attributes:
        left: the remaining steps; 0 or less: the analysis was ended.
    """

    def __init__(self, steps: int = STEPS_MAX) -> None:
        self.left: int = steps

    def allows(self, steps: int) -> bool:
        """Take some steps; return False if the analysis is to end."""
        self.left -= steps
        return self.left > 0

    def is_over(self) -> bool:
        """Return True if the analysis was ended, and a result was not computed."""
        return self.left <= 0


class Arrival(Enum):
    """The arrival pattern of a message."""

    PERIODIC = "periodic"  # once a period, delayed by its jitter at most
    SPORADIC = "sporadic"  # limited in frequency only


@final
@frozen
class Message:
    """Frames with one identifier, from one sender.

    Attributes:
        identifier, extended: 29 bits if extended.
        length: maximum number of data bytes.
        period_ns: distance between two frames, apart from the jitter [ns].
        jitter_ns: maximum delay from the due time to queueing; for a sporadic message, how far a
            burst runs ahead of the period [ns].
        irregular_ns: how much closer than period and jitter allow some frames came [ns]; jitter for
            other messages, but no delay of this one.
        distance_ns: minimum distance between frames [ns]; 0: unknown.
        deadline_ns: maximum response time from the due time (sporadic: from queueing) [ns]; None:
            no deadline.
        name: a description; "": unknown.
        sender: the sending node; "": a node that sends nothing else.
        fd, switched: a CAN FD frame; with a bit rate switch.
        arrival: the arrival pattern.
        movable: True if another identifier can be assigned to it.
        source: the origin of these values, as a text.
        bits: an upper bound of the length if payloads are known; None: the longest possible.
    """

    identifier: int
    length: int
    period_ns: int
    jitter_ns: int = 0
    irregular_ns: int = 0
    distance_ns: int = 0
    deadline_ns: int | None = None
    extended: bool = False
    name: str = ""
    sender: str = ""
    fd: bool = False
    switched: bool = False
    arrival: Arrival = Arrival.PERIODIC
    movable: bool = True
    source: str = ""
    bits: Bits | None = None

    @classmethod
    def of(cls, message: PeriodicMessage) -> "Message":
        """Return this traffic as input of the analysis; the period rounded down, the jitter up."""
        return cls(
            identifier=message.can_id,
            length=message.length,
            period_ns=max(1, floor_ns(message.period_s)),
            jitter_ns=-floor_ns(-message.jitter_s),
            extended=message.extended,
            fd=message.fd,
            switched=message.bit_rate_switch,
        )

    @property
    def label(self) -> str:
        """Its identifier as a text."""
        return f"{self.identifier:08X}h" if self.extended else f"{self.identifier:03X}h"

    @property
    def rank(self) -> int:
        """Its priority; the lower wins (ISO 11898-1: the 11-bit one of equal base identifiers)."""
        return rank_of(self.identifier, extended=self.extended)

    @property
    def longest(self) -> Bits:
        """Its maximum length."""
        if self.bits is not None:
            return self.bits
        return longest(self.length, extended=self.extended, fd=self.fd, switched=self.switched)

    @property
    def shortest(self) -> Bits:
        """Its minimum length with all of its data."""
        return shortest(self.length, extended=self.extended, fd=self.fd, switched=self.switched)


def floor_ns(time_s: float) -> int:
    """Return the time rounded down to whole ns [ns], tolerating floating-point errors."""
    return int(round(time_s * 1e12) // 1000)


@final
@frozen
class BusLoad:
    """All messages on one bus.

    Attributes:
        name: name of the bus.
        bitrate_bit_s: the nominal bit rate [bit/s].
        data_bitrate_bit_s: the bit rate of CAN FD data [bit/s]; None: the nominal one.
        messages: messages with distinct identifiers.
        fifo: senders with one FIFO queue; all others send their most urgent message first.
    """

    name: str
    bitrate_bit_s: int
    messages: tuple[Message, ...]
    data_bitrate_bit_s: int | None = None
    fifo: frozenset[str] = frozenset()

    @classmethod
    def of(cls, traffic: CanTraffic) -> "BusLoad":
        """Return this traffic as input of the analysis."""
        messages = tuple([Message.of(one) for one in traffic.messages])
        return cls("", traffic.bitrate_bit_s, messages, traffic.data_bitrate_bit_s)

    def takes_ns(self, message: Message) -> int:
        """Return the maximum duration of a frame [ns]."""
        return message.longest.time_ns(self.bitrate_bit_s, self.data_bitrate_bit_s)

    def utilisation(self) -> float:
        """Return the bus utilisation (0 to 1 and more) with the most stuff bits."""
        return sum(self.takes_ns(one) / one.period_ns for one in self.messages)

    def utilisation_unstuffed(self) -> float:
        """Return the bus utilisation without stuff bits."""
        rates = self.bitrate_bit_s, self.data_bitrate_bit_s
        return sum(one.shortest.time_ns(*rates) / one.period_ns for one in self.messages)


@final
@frozen
class ErrorModel:
    """Bound on the number of errors.

    Attributes:
        burst: number of simultaneous errors.
        interval_ns: minimum distance between later errors [ns]; None: no errors after the burst.
    """

    burst: int = 1
    interval_ns: int | None = None

    def count(self, window_ns: int) -> int:
        """Return the maximum number of errors in a window of this length."""
        if self.interval_ns is None:
            return self.burst
        return self.burst + max(0, -(-window_ns // self.interval_ns) - 1)


NO_ERRORS: Final = ErrorModel(burst=0)


@final
@frozen
class Response:
    """The worst case of a message.

    Attributes:
        message: the message.
        takes_ns: duration of a frame [ns].
        response_ns: response time to the end of the intermission, as in the theory [ns]; None:
            unbounded.
        received_ns: response time to the last bit, when receivers have the frame [ns].
        blocking_ns: blocking by one frame of lower priority that has started [ns].
        busy_ns: the longest busy period of its level [ns].
        instance: index of the worst frame in that busy period, from 0.
    """

    message: Message
    takes_ns: int
    response_ns: int | None
    received_ns: int | None
    blocking_ns: int
    busy_ns: int | None
    instance: int

    @property
    def is_in_time(self) -> bool | None:
        """True if its deadline is always met; None if it has no deadline."""
        if self.message.deadline_ns is None:
            return None
        return self.response_ns is not None and self.response_ns <= self.message.deadline_ns


Lateness = dict[int, int | None]
"""Delay in a shared queue by rank [ns]; None: unbounded.

That of few errors is a lower bound of that of more errors: there the search begins.
"""


def response_times(
    load: BusLoad,
    errors: ErrorModel = NO_ERRORS,
    effort: Effort | None = None,
    lateness: Lateness | None = None,
    asked: Collection[int] | None = None,
) -> tuple[Response, ...]:
    """Return the worst case of every message, the most urgent first.

    Args:
        load: the messages.
        errors: the error model.
        effort: the steps that it may take; None: `STEPS_MAX`.
        lateness: the result for fewer errors, or empty; updated with that for these errors.
        asked: ranks of messages of which only the verdict is needed; of a late one, the case is the
            first that is late. None: all messages, with their worst case.
    """
    levels = _levels(load, errors, effort, lateness)
    levels.settle()
    levels.tell(lateness)
    if asked is None:
        return tuple(levels.response(flow) for flow in levels.flows)
    flows = (flow for flow in levels.flows if flow.rank in asked)
    return tuple(levels.response(flow, is_worst=False) for flow in flows)


def are_in_time(
    load: BusLoad,
    errors: ErrorModel = NO_ERRORS,
    effort: Effort | None = None,
    doubtful: Collection[int] = (),
    lateness: Lateness | None = None,
) -> bool:
    """Return True if every message with a deadline is known to meet it.

    Args:
        load: the messages.
        errors: the error model.
        effort: the steps that it may take; None: `STEPS_MAX`.
        doubtful: ranks of messages to examine first, since they are likely to be late.
        lateness: the result for fewer errors, or empty; updated if all are in time.
    """
    levels = _levels(load, errors, effort, lateness)
    timed = [flow for flow in reversed(levels.flows) if flow.message.deadline_ns is not None]
    timed.sort(key=lambda flow: flow.rank not in doubtful)

    def are_on_time(flows: list[Flow]) -> bool:
        return all(levels.response(flow, is_worst=False).is_in_time for flow in flows)

    # Shared queues only add to these times: a message that is late before all is settled stays so.
    if levels.has_queues and not are_on_time(timed):
        return False
    doubted = [flow for flow in timed if flow.rank in doubtful]
    while levels.settle_further():
        if any(flow.is_late() for flow in timed) or not are_on_time(doubted):
            return False
    if not are_on_time(timed):
        return False
    levels.tell(lateness)
    return True


def response_between(
    load: BusLoad,
    higher: Iterable[Message],
    message: Message,
    lower: Iterable[Message],
    errors: ErrorModel = NO_ERRORS,
    effort: Effort | None = None,
) -> Response:
    """Return the worst case of one message between these others, without FIFO queues.

    Args:
        load: provides the bit rates.
        higher: the more urgent messages.
        message: the message itself.
        lower: the less urgent messages.
        errors: the error model.
        effort: the steps that it may take; None: `STEPS_MAX`.
    """
    flows = [Flow(one, 0, load.takes_ns(one)) for one in higher]
    flows.append(own := Flow(message, 1, load.takes_ns(message)))
    flows += [Flow(one, 2, load.takes_ns(one)) for one in lower]
    return _Levels(flows, [], errors, load, effort).response(own)


def _levels(
    load: BusLoad, errors: ErrorModel, effort: Effort | None, lateness: Lateness | None
) -> "_Levels":
    flows = sorted((Flow.of(load, message) for message in load.messages), key=lambda f: f.rank)
    queues: dict[str, list[Flow]] = {}
    for flow in flows:
        sender = flow.message.sender
        if sender and sender in load.fifo:
            queues.setdefault(sender, []).append(flow)
            if lateness:
                flow.late_ns = lateness[flow.rank]
    shared = [queue for queue in queues.values() if len(queue) > 1]
    return _Levels(flows, shared, errors, load, effort)


@final
@dataclass(slots=True)
class Flow:
    """A message as an event stream; `late_ns`: its delay in a shared queue, None: unbounded."""

    message: Message
    rank: int
    takes_ns: int
    late_ns: int | None = 0

    @classmethod
    def of(cls, load: BusLoad, message: Message) -> "Flow":
        """Return the message as it is sent on this bus."""
        return cls(message, message.rank, load.takes_ns(message))

    def is_late(self) -> bool:
        """Return True if its delay in a shared queue alone exceeds its deadline."""
        deadline_ns = self.message.deadline_ns
        if deadline_ns is None or self.late_ns is None:
            return False
        return self.late_ns + self.takes_ns > deadline_ns

    def most(self, window_ns: int) -> int:
        """Return the maximum number of frames queued in any window of this length."""
        message = self.message
        return -(-(window_ns + message.jitter_ns + message.irregular_ns) // message.period_ns)

    def term(self) -> tuple[int, int, int, int, int]:
        """Return period, earliness, lateness, distance and duration of a competing message."""
        message = self.message
        late_ns = self.late_ns or 0
        early_ns = message.jitter_ns + message.irregular_ns + late_ns
        return message.period_ns, early_ns, late_ns, message.distance_ns, self.takes_ns

    def queued_by(self, at_ns: int) -> int:
        """Return the maximum number queued from 0 to `at_ns`, both inclusive."""
        message = self.message
        early_ns = message.jitter_ns + message.irregular_ns
        count = (at_ns + early_ns) // message.period_ns + 1
        return min(count, at_ns // message.distance_ns + 1) if message.distance_ns else count

    def queued_itself(self, at_ns: int) -> int:
        """Return the same number if the last frame is queued at `at_ns`, with its full jitter."""
        message = self.message
        if message.arrival is Arrival.SPORADIC:
            return self.queued_by(at_ns)
        count = (at_ns + message.irregular_ns) // message.period_ns + 1
        return min(count, at_ns // message.distance_ns + 1) if message.distance_ns else count

    def moments(self, until_ns: int, *, itself: bool) -> Iterator[int]:
        """Yield the times before `until_ns` at which `queued_by` (or `queued_itself`) grows."""
        message = self.message
        late_ns = message.jitter_ns if itself and message.arrival is Arrival.PERIODIC else 0
        early_ns = message.jitter_ns + message.irregular_ns - late_ns
        at_ns, number = 0, 0
        while at_ns < until_ns:
            yield at_ns
            number += 1
            at_ns = max(number * message.period_ns - early_ns, number * message.distance_ns)


@final
class _Levels:
    """All messages of a bus, with the lateness caused by shared queues."""

    def __init__(
        self,
        flows: list[Flow],
        shared: list[list[Flow]],
        errors: ErrorModel,
        load: BusLoad,
        effort: Effort | None,
    ) -> None:
        self.effort: Final = Effort() if effort is None else effort
        self.flows: Final = flows
        self.has_queues: Final = bool(shared)
        self.has_intervals: Final = errors.interval_ns is not None
        self._shared = {id(flow): queue for queue in shared for flow in queue}
        self._known: dict[int, _Level] = {}  # by the identity of a queue's last message
        self.bit_ns: Final = bits_ns(1, load.bitrate_bit_s)
        self._errors = errors
        self._recovery_ns = bits_ns(RECOVERY_BITS, load.bitrate_bit_s)
        self._late_max_ns = max((flow.message.period_ns for flow in flows), default=0)
        self._gap_ns = INTERMISSION_BITS * 1_000_000_000 // load.bitrate_bit_s

    def settle(self) -> None:
        """Compute the lateness of every shared queue, to a fixed point."""
        while self.settle_further():
            pass

    def tell(self, lateness: Lateness | None) -> None:
        """Put the lateness of every message into this table, if it is settled."""
        if lateness is not None and not self.effort.is_over():
            lateness.update((flow.rank, flow.late_ns) for flow in self.flows)

    def settle_further(self) -> bool:
        """Compute the lateness of every shared queue once; return True if one has changed."""
        changed = False
        for flow in self.flows if self._shared else ():
            if id(flow) not in self._shared or flow.late_ns is None:
                continue
            if self.effort.is_over() or self._level(flow).has_changed_for(flow):
                late_ns = self._lateness_ns(flow)
                if late_ns != flow.late_ns:
                    flow.late_ns = late_ns
                    changed = True
        return changed

    def response(self, flow: Flow, *, is_worst: bool = True) -> Response:
        """Return the worst case of one message; without a bound if the effort is over.

        `is_worst` False: the first case that is late, if there is one.
        """
        if self.effort.is_over():
            return Response(flow.message, flow.takes_ns, None, None, 0, None, 0)
        level = self._level(flow)
        busy_ns = level.busy_ns()
        worst_ns: int | None = None
        is_periodic = flow.message.arrival is Arrival.PERIODIC
        delay_ns = flow.message.jitter_ns if is_periodic else 0
        last_ns = None if is_worst else flow.message.deadline_ns
        instance = 0
        if busy_ns is not None:
            for number, (at_ns, waited_ns) in enumerate(level.instances(flow, busy_ns)):
                if waited_ns is None:
                    worst_ns = None
                    break
                took_ns = waited_ns + flow.takes_ns - at_ns
                if worst_ns is None or took_ns > worst_ns:
                    worst_ns, instance = took_ns, number
                    if last_ns is not None and took_ns + delay_ns > last_ns:
                        break
        if worst_ns is not None:
            worst_ns += delay_ns
        return Response(
            message=flow.message,
            takes_ns=flow.takes_ns,
            response_ns=worst_ns,
            received_ns=None if worst_ns is None else worst_ns - self._gap_ns,
            blocking_ns=level.blocking_ns,
            busy_ns=None if worst_ns is None else busy_ns,
            instance=instance,
        )

    def _lateness_ns(self, flow: Flow) -> int | None:
        if self.effort.is_over():
            return None
        level = self._level(flow)
        busy_ns = level.busy_ns()
        if busy_ns is None:
            return None
        late_ns = 0
        for at_ns, waited_ns in level.instances(flow, busy_ns, alone=False):
            if waited_ns is None or waited_ns - at_ns > self._late_max_ns:
                return None
            late_ns = max(late_ns, waited_ns - at_ns)
        return late_ns

    def _level(self, flow: Flow) -> "_Level":
        """Return the level of this message, which it shares with its queue, as it is now."""
        queue = self._shared.get(id(flow))
        if queue is None:  # used once or twice only, and one each would be much
            return _Level(self, [flow])
        level = self._known.get(id(queue[-1]))
        if level is None:
            level = self._known[id(queue[-1])] = _Level(self, queue)
        else:
            level.renew()
        return level

    def errors_ns(self, window_ns: int, longest_ns: int) -> int:
        """Return the cost of errors in a window, where retransmissions take `longest_ns` [ns]."""
        return self._errors.count(window_ns) * (self._recovery_ns + longest_ns)

    def errors_share(self, longest_ns: int) -> float:
        """Return the long-term share of the bus that errors take."""
        interval_ns = self._errors.interval_ns
        return 0.0 if interval_ns is None else (self._recovery_ns + longest_ns) / interval_ns


@final
class _Competitors:
    """The more urgent frames that start to compete in a window, as a function of its length.

    The function is a staircase. Its steps are found once, as far as they are needed.
    """

    def __init__(self, effort: Effort, terms: list[tuple[int, int, int, int, int]]) -> None:
        self._effort = effort
        self._terms = terms
        self._ends_ns: list[int] = []  # one more frame competes in any longer window
        self._sums_ns: list[int] | None = None  # duration of the frames before each end
        self._next: list[tuple[int, int, int]] = []  # heap: end, number of the term, its frames

    def take_ns(self, window_ns: int) -> int:
        """Return the duration of the frames that start to compete in a half-open window [ns]."""
        if self._sums_ns is None:
            self._sums_ns = [self._begin()]
        ends_ns, sums_ns, coming = self._ends_ns, self._sums_ns, self._next
        known = len(ends_ns)
        while coming and coming[0][0] < window_ns:
            if len(ends_ns) >= _ENDS_MAX:
                self._effort.allows(len(self._terms))
                return sum(_count(term, window_ns) * term[-1] for term in self._terms)
            end_ns, number, count = coming[0]
            period_ns, early_ns, late_ns, distance_ns, takes_ns = self._terms[number]
            ends_ns.append(end_ns)
            sums_ns.append(sums_ns[-1] + takes_ns)
            count += 1
            end_ns = count * period_ns - early_ns
            if distance_ns:
                end_ns = max(end_ns, count * distance_ns - late_ns)
            heapreplace(coming, (end_ns, number, count))
        if len(ends_ns) > known:
            self._effort.allows(_STEPS_AN_END * (len(ends_ns) - known))
            return sums_ns[-1]
        return sums_ns[bisect_left(ends_ns, window_ns)]

    def _begin(self) -> int:
        """Find the first end of each message; return the duration of all frames before it [ns]."""
        self._effort.allows(len(self._terms))
        total_ns = 0
        for number, term in enumerate(self._terms):
            period_ns, early_ns, late_ns, distance_ns, takes_ns = term
            count = _count(term, 0)
            end_ns = count * period_ns - early_ns
            if distance_ns:
                end_ns = max(end_ns, count * distance_ns - late_ns)
            self._next.append((end_ns, number, count))
            total_ns += count * takes_ns
        heapify(self._next)
        return total_ns


def _count(term: tuple[int, int, int, int, int], window_ns: int) -> int:
    """Return the number of frames of a message that start to compete in a window."""
    period_ns, early_ns, late_ns, distance_ns, _ = term
    count = -(-(window_ns + early_ns) // period_ns)
    return min(count, -(-(window_ns + late_ns) // distance_ns)) if distance_ns else count


@final
class _Level:
    """Everything that the messages of one queue wait for.

    Waiting times are kept, since messages of a queue often have the same work before them, until a
    competing message is later than before.
    """

    def __init__(self, levels: _Levels, queue: list[Flow]) -> None:
        self._levels = levels
        self._queue = queue
        levels.effort.allows(len(levels.flows))
        mates = {id(one) for one in queue}
        last = queue[-1].rank
        others = [one for one in levels.flows if id(one) not in mates]
        self._higher = [one for one in others if one.rank < last]
        self._terms = [one.term() for one in self._higher]
        self._competitors = _Competitors(levels.effort, self._terms)
        self.blocking_ns = max((one.takes_ns for one in others if one.rank > last), default=0)
        self._longest_ns = max(one.takes_ns for one in (*queue, *self._higher))
        self._busy_ns: int | None = None
        self._waits: dict[tuple[int, int], int | None] = {}
        self._waited: dict[tuple[int, int], int | None] = {}  # the same with less lateness
        self._queued_ns: dict[int, int] = {}  # the work of the queue, by time
        self._done: set[int] = set()  # identities of messages whose lateness is up to date

    def renew(self) -> None:
        """Forget the times if a competing message has become later."""
        terms = [one.term() for one in self._higher]
        if terms != self._terms:
            self._terms = terms
            self._competitors = _Competitors(self._levels.effort, terms)
            self._busy_ns = None
            self._waited |= self._waits
            self._waits.clear()
            self._done.clear()

    def has_changed_for(self, flow: Flow) -> bool:
        """Return True at the first call for a message since the times changed."""
        if id(flow) in self._done:
            return False
        self._done.add(id(flow))
        return True

    def busy_ns(self) -> int | None:
        """Return the longest busy period of this level [ns]; None: no bound is known."""
        if self._levels.effort.is_over() or any(one.late_ns is None for one in self._higher):
            return None
        if self._busy_ns is None:
            self._busy_ns = self._longest_busy_ns()
        return self._busy_ns

    def _longest_busy_ns(self) -> int | None:
        level = (*self._queue, *self._higher)
        share = sum(one.takes_ns / one.message.period_ns for one in level)
        if share + self._levels.errors_share(self._longest_ns) >= 1.0:
            return None
        busy_ns = sum(one.takes_ns for one in self._queue)  # each is queued once at least
        for _ in range(_ROUNDS_MAX):
            if not self._levels.effort.allows(len(self._queue) + _STEPS_A_ROUND):
                return None
            again_ns = self._levels.errors_ns(busy_ns, self._longest_ns) + self.blocking_ns
            again_ns += self._competitors.take_ns(busy_ns)
            again_ns += sum(one.queued_by(busy_ns - 1) * one.takes_ns for one in self._queue)
            if again_ns <= busy_ns:
                return busy_ns
            busy_ns = again_ns
        return None

    def instances(
        self, flow: Flow, busy_ns: int, *, alone: bool = True
    ) -> Iterator[tuple[int, int | None]]:
        """Yield (latest queueing time, start time) of each frame that may be the worst [ns].

        `alone` False: only frames that have others of their queue before them.
        """
        jitter_ns = flow.message.jitter_ns if flow.message.arrival is Arrival.PERIODIC else 0
        until_ns = busy_ns + jitter_ns
        moments: set[int] = set()
        for one in self._queue:
            some = islice(one.moments(until_ns, itself=one is flow), _INSTANCES_MAX + 1)
            moments.update(some)
            if len(moments) > _INSTANCES_MAX:
                yield 0, None
                return
        waited_ns: int | None = 0
        if not self._levels.effort.allows(len(moments)):
            yield 0, None
            return
        for at_ns in sorted(moments):
            until_ns = min(at_ns, busy_ns)
            others_ns = self._work_ns(until_ns) - flow.queued_by(until_ns) * flow.takes_ns
            before_ns = others_ns + (flow.queued_itself(at_ns) - 1) * flow.takes_ns
            assert waited_ns is not None
            waited_ns = self._waited_ns(flow.takes_ns, before_ns, waited_ns)
            if alone or before_ns:
                yield at_ns, waited_ns
            if waited_ns is None:
                return

    def _work_ns(self, at_ns: int) -> int:
        """Return the duration of all messages of the queue that are queued from 0 to `at_ns`."""
        found = self._queued_ns.get(at_ns)
        if found is None:
            found = sum(one.queued_by(at_ns) * one.takes_ns for one in self._queue)
            self._queued_ns[at_ns] = found
        return found

    def _waited_ns(self, takes_ns: int, before_ns: int, least_ns: int) -> int | None:
        """Return the start time of a frame after `before_ns` of its queue; None: no bound.

        It is known not to be before `least_ns`.
        """
        key = (takes_ns if self._levels.has_intervals else 0, before_ns)
        if key not in self._waits:
            least_ns = max(least_ns, self._waited.get(key) or 0)
            self._waits[key] = self._first_start_ns(takes_ns, before_ns, least_ns)
        return self._waits[key]

    def _first_start_ns(self, takes_ns: int, before_ns: int, least_ns: int) -> int | None:
        fixed_ns = self.blocking_ns + before_ns
        waited_ns = max(least_ns, fixed_ns)
        for _ in range(_ROUNDS_MAX):
            if not self._levels.effort.allows(_STEPS_A_ROUND):
                return None
            again_ns = fixed_ns
            again_ns += self._levels.errors_ns(waited_ns + takes_ns, self._longest_ns)
            again_ns += self._competitors.take_ns(waited_ns + self._levels.bit_ns)
            if again_ns <= waited_ns:
                return waited_ns
            waited_ns = again_ns
        return None
