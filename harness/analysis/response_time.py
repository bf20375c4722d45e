"""The longest response time of every message on a CAN bus, from when it was due.

Davis, Burns, Bril & Lukkien, "Controller Area Network (CAN) schedulability analysis: Refuted,
revisited and revised" (Real-Time Systems 35, 2007), for messages that nothing but priority orders:

    t     = E(t) + B + sum over hp(m) and m of n(t) C               the busy period
    w(q)  = E(w + C) + B + q C + sum over hp(m) of n(w + tau) C     instance q waits so long
    R     = max over q of w(q) + C - (q T - J)

B is the longest frame of lower priority, tau one bit (who becomes ready within it still takes part
in an arbitration), n(t) = ceil((t + J) / T) how many come in a time, E what errors cost. Where a
distance d between any two is known, n(t) is at most ceil(t / d), too.

A node with one queue, first in, first out, is seen as Davis, Kollmann, Pollex & Slomka do
(ECRTS 2011; Real-Time Systems 49, 2013): its messages M wait for what is more urgent than the least
urgent of them, L. Their sufficient test has one of each of M in the queue, which is right only
where all are in time. Here, instead, a frame queued at `a` of a busy period of level L waits for
all of M that are queued up to then, and each such `a` is looked at:

    w(a)  = E(w + C) + B(L) + sum over M of n[0, a] C - C + sum over hp(L) not in M of n(w + tau) C
    R     = max over a of w(a) + C - a + J

Behind others in such a queue a frame competes up to f = max over a of w(a) - a later than it was
queued: what competes in a time t was queued in t + f. f of one node depends on that of others: they
grow together until nothing changes, or one is longer than any period (then no bound is told). For
M of one message this is the theory above. What it says too much: frames of other nodes between a
message and L do not hold it up once it is the first of its queue.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, final

from harness.analysis.errors import NO_ERRORS, RECOVERY_BITS, ErrorModel
from harness.analysis.frame_length import INTERMISSION_BITS, bits_ns
from harness.analysis.message import Arrival, BusLoad, Message

_ROUNDS_MAX: Final = 100_000
_INSTANCES_MAX: Final = 20_000


@final
@dataclass(frozen=True, slots=True)
class Response:
    """How long a message takes at most.

    Attributes:
        message: of the bus.
        takes_ns: a frame of it.
        response_ns: to the end of its intermission, as the theory has it; None: there is no bound.
        received_ns: to its last bit, when receivers have it.
        blocking_ns: by one frame of lower priority that had begun.
        busy_ns: how long the bus may be busy without a break by what it waits for.
        instance: which frame of that busy period is the worst, from 0.
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
        """Whether its deadline is always met; None: it has none."""
        if self.message.deadline_ns is None:
            return None
        return self.response_ns is not None and self.response_ns <= self.message.deadline_ns


def response_times(load: BusLoad, errors: ErrorModel = NO_ERRORS) -> tuple[Response, ...]:
    """Of every message, the most urgent first."""
    levels = _levels(load, errors)
    return tuple(levels.response(flow) for flow in levels.flows)


def are_in_time(load: BusLoad, errors: ErrorModel = NO_ERRORS) -> bool:
    """Whether every message meets its deadline, if it has one."""
    levels = _levels(load, errors)
    timed = [flow for flow in levels.flows if flow.message.deadline_ns is not None]
    return all(levels.response(flow).is_in_time for flow in reversed(timed))


def response_between(
    load: BusLoad,
    higher: Iterable[Message],
    message: Message,
    lower: Iterable[Message],
    errors: ErrorModel = NO_ERRORS,
) -> Response:
    """Of one message, if these were more and those less urgent; nobody has one queue for several.

    Args:
        load: bit rates are taken from it.
        higher: more urgent.
        message: the one.
        lower: less urgent.
        errors: what may strike.
    """
    flows = [_Flow(one, 0, load.takes_ns(one), "") for one in higher]
    flows.append(own := _Flow(message, 1, load.takes_ns(message), ""))
    flows += [_Flow(one, 2, load.takes_ns(one), "") for one in lower]
    return _Levels(flows, [], errors, load).response(own)


def _levels(load: BusLoad, errors: ErrorModel) -> "_Levels":
    flows = sorted((_Flow.of(load, message) for message in load.messages), key=lambda f: f.rank)
    queues: dict[str, list[_Flow]] = {}
    for flow in flows:
        if flow.queue:
            queues.setdefault(flow.queue, []).append(flow)
    levels = _Levels(flows, [queue for queue in queues.values() if len(queue) > 1], errors, load)
    levels.settle()
    return levels


@final
@dataclass(slots=True)
class _Flow:
    """A message as an event stream; `late_ns`: behind others in its queue, None: for ever."""

    message: Message
    rank: int
    takes_ns: int
    queue: str
    late_ns: int | None = 0

    @classmethod
    def of(cls, load: BusLoad, message: Message) -> "_Flow":
        queue = message.sender if message.sender in load.fifo else ""
        return cls(message, message.rank, load.takes_ns(message), queue)

    def term(self) -> tuple[int, int, int, int, int]:
        """Period, how early, how late, distance, and what one takes: of what competes."""
        message = self.message
        late_ns = self.late_ns or 0
        early_ns = message.jitter_ns + message.irregular_ns + late_ns
        return message.period_ns, early_ns, late_ns, message.distance_ns, self.takes_ns

    def queued_by(self, at_ns: int) -> int:
        """How many may be queued from 0 to `at_ns`, both included."""
        message = self.message
        early_ns = message.jitter_ns + message.irregular_ns
        count = (at_ns + early_ns) // message.period_ns + 1
        return min(count, at_ns // message.distance_ns + 1) if message.distance_ns else count

    def queued_itself(self, at_ns: int) -> int:
        """The same where the last one is queued then, as late as it can be after it was due."""
        message = self.message
        if message.arrival is Arrival.SPORADIC:
            return self.queued_by(at_ns)
        count = (at_ns + message.irregular_ns) // message.period_ns + 1
        return min(count, at_ns // message.distance_ns + 1) if message.distance_ns else count

    def moments(self, until_ns: int, *, itself: bool) -> Iterator[int]:
        """When `queued_by` (or `queued_itself`) grows, before `until_ns`."""
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
    """All messages of a bus, and how late those in shared queues may begin to compete."""

    def __init__(
        self,
        flows: list[_Flow],
        shared: list[list[_Flow]],
        errors: ErrorModel,
        load: BusLoad,
    ) -> None:
        self._flows = flows
        self._shared = {id(flow): queue for queue in shared for flow in queue}
        self._bit_ns = bits_ns(1, load.bitrate_bit_s)
        self._errors = errors
        self._recovery_ns = bits_ns(RECOVERY_BITS, load.bitrate_bit_s)
        self._late_max_ns = max(flow.message.period_ns for flow in flows)
        self._gap_ns = INTERMISSION_BITS * 1_000_000_000 // load.bitrate_bit_s

    def settle(self) -> None:
        """Every queue's lateness is known."""
        waiting = [flow for flow in self._flows if id(flow) in self._shared]
        changed = bool(waiting)
        while changed:
            changed = False
            for flow in waiting:
                if flow.late_ns is None:
                    continue
                late_ns = self._lateness_ns(flow)
                if late_ns != flow.late_ns:
                    flow.late_ns = late_ns
                    changed = True

    def response(self, flow: _Flow) -> Response:
        """Of one message."""
        level = _Level(self, flow)
        busy_ns = level.busy_ns()
        worst_ns: int | None = None
        instance = 0
        if busy_ns is not None:
            for number, (at_ns, waited_ns) in enumerate(level.instances(busy_ns)):
                if waited_ns is None:
                    worst_ns = None
                    break
                took_ns = waited_ns + flow.takes_ns - at_ns
                if worst_ns is None or took_ns > worst_ns:
                    worst_ns, instance = took_ns, number
        if worst_ns is not None and flow.message.arrival is Arrival.PERIODIC:
            worst_ns += flow.message.jitter_ns
        return Response(
            message=flow.message,
            takes_ns=flow.takes_ns,
            response_ns=worst_ns,
            received_ns=None if worst_ns is None else worst_ns - self._gap_ns,
            blocking_ns=level.blocking_ns,
            busy_ns=None if worst_ns is None else busy_ns,
            instance=instance,
        )

    def _lateness_ns(self, flow: _Flow) -> int | None:
        level = _Level(self, flow)
        busy_ns = level.busy_ns()
        if busy_ns is None:
            return None
        late_ns = 0
        for at_ns, waited_ns in level.instances(busy_ns, alone=False):
            if waited_ns is None or waited_ns - at_ns > self._late_max_ns:
                return None
            late_ns = max(late_ns, waited_ns - at_ns)
        return late_ns

    def queue_of(self, flow: _Flow) -> list[_Flow]:
        """The messages that wait in one queue with this one; itself alone, if nobody does."""
        return self._shared.get(id(flow), [flow])

    @property
    def flows(self) -> Sequence[_Flow]:
        """All of them, the most urgent first."""
        return self._flows

    @property
    def bit_ns(self) -> int:
        """One bit."""
        return self._bit_ns

    def errors_ns(self, window_ns: int, longest_ns: int) -> int:
        """What errors cost in a window, where frames that are sent again take so long at most."""
        return self._errors.count(window_ns) * (self._recovery_ns + longest_ns)

    def errors_share(self, longest_ns: int) -> float:
        """Of the bus in the long run."""
        interval_ns = self._errors.interval_ns
        return 0.0 if interval_ns is None else (self._recovery_ns + longest_ns) / interval_ns


@final
class _Level:
    """What one message waits for."""

    def __init__(self, levels: _Levels, flow: _Flow) -> None:
        self._levels = levels
        self._flow = flow
        self._queue = levels.queue_of(flow)
        mates = {id(one) for one in self._queue}
        last = self._queue[-1].rank
        others = [one for one in levels.flows if id(one) not in mates]
        self._higher = [one for one in others if one.rank < last]
        self._terms = [one.term() for one in self._higher]
        self.blocking_ns = max((one.takes_ns for one in others if one.rank > last), default=0)
        self._longest_ns = max(one.takes_ns for one in (*self._queue, *self._higher))

    def busy_ns(self) -> int | None:
        """How long the bus may be busy with all of it; None: for ever, as far as is known."""
        level = (*self._queue, *self._higher)
        share = sum(one.takes_ns / one.message.period_ns for one in level)
        if share + self._levels.errors_share(self._longest_ns) >= 1.0:
            return None
        if any(one.late_ns is None for one in self._higher):
            return None
        busy_ns = self._flow.takes_ns
        for _ in range(_ROUNDS_MAX):
            again_ns = self._levels.errors_ns(busy_ns, self._longest_ns) + self.blocking_ns
            again_ns += self._competing_ns(busy_ns)
            again_ns += sum(one.queued_by(busy_ns - 1) * one.takes_ns for one in self._queue)
            if again_ns <= busy_ns:
                return busy_ns
            busy_ns = again_ns
        return None

    def instances(self, busy_ns: int, *, alone: bool = True) -> Iterator[tuple[int, int | None]]:
        """(when it is queued at the latest, when it begins) of each frame that may be the worst.

        `alone` False: only of frames that others of their queue are before.
        """
        flow = self._flow
        jitter_ns = flow.message.jitter_ns if flow.message.arrival is Arrival.PERIODIC else 0
        until_ns = busy_ns + jitter_ns
        moments: set[int] = set()
        for one in self._queue:
            moments.update(one.moments(until_ns, itself=one is flow))
            if len(moments) > _INSTANCES_MAX:
                yield 0, None
                return
        waited_ns: int | None = 0
        for at_ns in sorted(moments):
            before_ns = (flow.queued_itself(at_ns) - 1) * flow.takes_ns
            before_ns += sum(
                one.queued_by(min(at_ns, busy_ns)) * one.takes_ns
                for one in self._queue
                if one is not flow
            )
            assert waited_ns is not None
            waited_ns = self._waited_ns(before_ns, waited_ns)
            if alone or before_ns:
                yield at_ns, waited_ns
            if waited_ns is None:
                return

    def _competing_ns(self, window_ns: int) -> int:
        """What more urgent frames take that begin to compete in a window, its end not included."""
        total_ns = 0
        for period_ns, early_ns, late_ns, distance_ns, takes_ns in self._terms:
            count = -(-(window_ns + early_ns) // period_ns)
            if distance_ns:
                least = -(-(window_ns + late_ns) // distance_ns)
                if least < count:
                    count = least
            total_ns += count * takes_ns
        return total_ns

    def _waited_ns(self, before_ns: int, least_ns: int) -> int | None:
        """When it begins, if so much of its queue is before it and it is not before `least_ns`."""
        fixed_ns = self.blocking_ns + before_ns
        waited_ns = max(least_ns, fixed_ns)
        for _ in range(_ROUNDS_MAX):
            again_ns = fixed_ns
            again_ns += self._levels.errors_ns(waited_ns + self._flow.takes_ns, self._longest_ns)
            again_ns += self._competing_ns(waited_ns + self._levels.bit_ns)
            if again_ns <= waited_ns:
                return waited_ns
            waited_ns = again_ns
        return None
