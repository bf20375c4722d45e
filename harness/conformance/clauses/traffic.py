"""L4: response times of declared traffic, by the theory and on the emulated bus.

The bounds on a common start are made of these. The theory is computed here once more, step by step
and without any shortcut: Davis, Burns, Bril & Lukkien 2007, and Davis et al. 2013 for FIFO queues.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, permutations, product
from math import ceil
from random import Random
from typing import Any, Final, final

from motorhil.harness.conformance.bench import Ability, RigProtocol
from motorhil.harness.conformance.clause import Level, NotApplicable, clause, expect
from motorhil.harness.conformance.clauses.helpers import (
    elapsed_s,
    expect_raises,
    long_move,
    move,
    rest_for,
)
from motorhil.harness.rig.config.buses import ADDRESS_KEYS
from motorhil.harness.rig.config.conformance import Capability
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi import UsageError
from motorhil.motorapi.synchronization.bus_load import (
    FD_LENGTHS,
    CanTraffic,
    NodeTraffic,
    PeriodicMessage,
    declare_traffic,
    own_traffic,
    rank_of,
    worst_of,
)
from motorhil.motorapi.synchronization.can_frame_length import Bits, longest, shortest
from motorhil.motorapi.synchronization.can_response_time import (
    Arrival,
    BusLoad,
    Effort,
    ErrorModel,
    Message,
    Response,
    are_in_time,
    response_between,
    response_times,
)
from motorhil.motorapi.synchronization.firing_time import longest_s, overload_of
from motorhil.motorapi.synchronization.offer import Firing, OneFrame, SyncOffer
from motorhil.motorapi.synchronization.quality import SyncLevel
from motorhil.motorapi.synchronization.skew import (
    Bound,
    Member,
    command_bound,
    end_bound,
    start_bound,
)

_RATES: Final = (125_000, 500_000, 1_000_000)
_LOADS: Final = 60
_BURSTS: Final = 6
_RECOVERY_BITS: Final = 31
_INTERMISSION_BITS: Final = 3
_HEAD: Final = {(False, False): 34, (False, True): 54, (True, False): 22, (True, True): 41}
"""Bits subject to stuffing without data, by (FD, extended): up to the CRC, of FD up to the DLC."""
_TAIL: Final = 13  # delimiters, ACK, end of frame, intermission
_FD_CRC: Final = (27, 32)  # stuff count, CRC and fixed stuff bits; of up to 16 bytes, and of more
_FD_SHORT: Final = 16
_FD_NOMINAL: Final = (17, 36)  # up to BRS
_FD_STUFF: Final = (3, 8)  # stuff bits that can come before BRS
_ROUNDING_S: Final = 1e-12
_NEAR_S: Final = 2e-9
_HOST: Final = "host_"  # begins the names of numbers of the host
_IDENTIFIER: Final = 0x1FFF_FFFF
_EXTENDED: Final = 0x8000_0000
_REMOTE: Final = 0x4000_0000
_CLASSICAL: Final = "CAN_20"  # of can.CanProtocol
_OFTEN: Final = 2.0  # as often as declared: also when something else asks for a frame
_MORE: Final = 3
_BEFORE_S: Final = 0.2
_EFFORTS: Final = tuple(round(1.1**number) for number in range(24, 80))  # steps, until most suffice
_HURRIED: Final = 8
_UNDECLARED_HZ: Final = 50.0  # of a drive that is asked now and then


@final
@dataclass(slots=True)
class _Stream:
    """A message as the theory has it: its frames in a window; `late_ns` from its FIFO queue."""

    message: Message
    takes_ns: int
    late_ns: int = 0

    def competing(self, window_ns: int) -> int:
        """Return the frames that may begin to compete in a window."""
        one = self.message
        early_ns = one.jitter_ns + one.irregular_ns + self.late_ns
        count = -(-(window_ns + early_ns) // one.period_ns)
        if one.distance_ns:
            count = min(count, -(-(window_ns + self.late_ns) // one.distance_ns))
        return count

    def queued(self, at_ns: int, jitter_ns: int | None = None) -> int:
        """Return the frames queued from 0 to `at_ns`, both included."""
        one = self.message
        early_ns = (one.jitter_ns if jitter_ns is None else jitter_ns) + one.irregular_ns
        count = (at_ns + early_ns) // one.period_ns + 1
        return min(count, at_ns // one.distance_ns + 1) if one.distance_ns else count

    @property
    def own_delay_ns(self) -> int:
        """The delay from the due time that is part of its response time."""
        return self.message.jitter_ns if self.message.arrival is Arrival.PERIODIC else 0


@final
class _Theory:
    """Worst cases of a bus load, from the formulas."""

    def __init__(self, load: BusLoad, errors: ErrorModel) -> None:
        self._errors = errors
        self._bit_ns = -(-1_000_000_000 // load.bitrate_bit_s)
        self._recovery_ns = -(-_RECOVERY_BITS * 1_000_000_000 // load.bitrate_bit_s)
        ordered = sorted(load.messages, key=lambda one: one.rank)
        self.streams = [_Stream(one, load.takes_ns(one)) for one in ordered]
        self._queues = {
            id(one): [
                other
                for other in self.streams
                if other is one
                or (one.message.sender in load.fifo and other.message.sender == one.message.sender)
            ]
            for one in self.streams
        }
        hindering = [
            one
            for one in self.streams
            if any(one in self._level(other)[1] for other in self.streams)
        ]  # the lateness of others delays nobody
        self.is_bounded = changed = True
        longest_ns = max(one.period_ns for one in ordered)
        while changed and self.is_bounded:
            changed = False
            for one in hindering:
                waits = [w - at for at, w, first in self._waits(one) if not first]
                late_ns = max(waits, default=0) if len(self._queues[id(one)]) > 1 else 0
                changed = changed or late_ns != one.late_ns
                one.late_ns = late_ns
                self.is_bounded = self.is_bounded and late_ns <= longest_ns

    def _level(self, one: _Stream) -> tuple[list[_Stream], list[_Stream], int]:
        """Return the queue of a message, what is more urgent than its last one, and blocking."""
        queue = self._queues[id(one)]
        place = self.streams.index(queue[-1])
        higher = [other for other in self.streams[:place] if other not in queue]
        lower = self.streams[place + 1 :]
        return queue, higher, max((other.takes_ns for other in lower), default=0)

    def _error_ns(self, window_ns: int, level: Sequence[_Stream]) -> int:
        errors = self._errors
        count = errors.burst
        if errors.interval_ns is not None:
            count += max(0, -(-window_ns // errors.interval_ns) - 1)
        return count * (self._recovery_ns + max(other.takes_ns for other in level))

    def busy_ns(self, one: _Stream) -> int:
        """Return the longest busy period of a message's level."""
        queue, higher, blocking_ns = self._level(one)
        busy_ns, again_ns = 0, sum(other.takes_ns for other in queue)
        while again_ns > busy_ns:
            busy_ns = again_ns
            again_ns = self._error_ns(busy_ns, [*queue, *higher]) + blocking_ns
            again_ns += sum(other.competing(busy_ns) * other.takes_ns for other in higher)
            again_ns += sum(other.queued(busy_ns - 1) * other.takes_ns for other in queue)
        return busy_ns

    def _waits(self, one: _Stream) -> Iterator[tuple[int, int, bool]]:
        """Yield time of queueing, wait until the start, and whether nothing is queued before."""
        queue, higher, blocking_ns = self._level(one)
        busy_ns = self.busy_ns(one)
        for at_ns in self._moments(one, queue, busy_ns + one.own_delay_ns):
            until_ns = min(at_ns, busy_ns)
            before_ns = sum(
                other.queued(until_ns) * other.takes_ns for other in queue if other is not one
            )
            own_jitter_ns = one.message.jitter_ns - one.own_delay_ns
            before_ns += (one.queued(at_ns, own_jitter_ns) - 1) * one.takes_ns
            wait_ns, again_ns = -1, blocking_ns + before_ns
            while again_ns > wait_ns:
                wait_ns = again_ns
                window_ns = wait_ns + self._bit_ns
                again_ns = blocking_ns + before_ns
                again_ns += self._error_ns(wait_ns + one.takes_ns, [*queue, *higher])
                again_ns += sum(other.competing(window_ns) * other.takes_ns for other in higher)
            yield at_ns, wait_ns, before_ns == 0

    @staticmethod
    def _moments(one: _Stream, queue: Sequence[_Stream], until_ns: int) -> list[int]:
        """Return the times at which a frame of the queue may arrive, in order."""
        found = {0}
        for other in queue:
            sent = other.message
            early_ns = sent.jitter_ns + sent.irregular_ns
            if other is one:
                early_ns -= one.own_delay_ns
            number, at_ns = 1, 0
            while at_ns < until_ns:
                found.add(at_ns)
                at_ns = max(number * sent.period_ns - early_ns, number * sent.distance_ns)
                number += 1
        return sorted(found)

    def worst(self, one: _Stream) -> tuple[int, int, int]:
        """Return the response time, its instance and the blocking of a message."""
        cases = [wait_ns + one.takes_ns - at_ns for at_ns, wait_ns, _ in self._waits(one)]
        worst_ns = max(cases)
        return worst_ns + one.own_delay_ns, cases.index(worst_ns), self._level(one)[2]


def _loads(seed: int) -> Iterator[tuple[BusLoad, ErrorModel]]:
    """Yield random loads that can be sent, with errors or without."""
    random = Random(seed)
    periods = zip((0x10, 0x20, 0x30), (2_500_000, 3_500_000, 3_500_000), strict=True)
    refuting = tuple(Message(identifier, 7, period_ns) for identifier, period_ns in periods)
    yield BusLoad("Davis et al. 2007, table 2", 125_000, refuting), ErrorModel(0)
    for number in range(_LOADS):
        rate = random.choice(_RATES)
        base_ns = 100 * 1_000_000_000 // rate  # somewhat less than a long frame
        messages = []
        for identifier in random.sample(range(0x700), random.randint(3, 8)):
            period_ns = random.randint(3, 9) * base_ns * (1 + number % 3)
            messages.append(
                Message(
                    identifier,
                    random.randint(0, 8),
                    period_ns,
                    jitter_ns=random.choice((0, period_ns // 5)),
                    irregular_ns=random.choice((0, 0, period_ns // 9)),
                    distance_ns=random.choice((0, period_ns // 3)),
                    extended=random.random() < 0.2,
                    sender=random.choice(("", "a", "a", "b", "b")),
                    arrival=random.choice((Arrival.PERIODIC, Arrival.PERIODIC, Arrival.SPORADIC)),
                )
            )
        fifo = frozenset(("a", "b")[: 1 + number % 3]) if number % 2 else frozenset()
        interval_ns = None if number % 4 < 2 else 8 * base_ns
        errors = ErrorModel(number // 4 % 2, interval_ns)
        load = BusLoad("bus", rate, tuple(messages), fifo=fifo)
        if load.utilisation() < (0.65 if errors.interval_ns else 0.97):
            yield load, errors
    for number in range(_BURSTS):
        yield _burst(random, number), ErrorModel(0)


def _burst(random: Random, number: int) -> BusLoad:
    """Return a load with bursts in a FIFO queue: frames that a distance alone keeps apart."""
    period_ns = random.randint(8, 12) * 1_000_000
    distance_ns = period_ns // random.randint(2, 4)
    often = Message(0x10, 8, period_ns, jitter_ns=2 * period_ns, distance_ns=distance_ns)
    mate = Message(0x40, 8, (2 + number % 3) * period_ns, jitter_ns=period_ns // 5)
    others = [Message(0x100 + 0x100 * n, random.randint(1, 8), 3 * period_ns) for n in range(3)]
    queue = [replace(one, sender="a") for one in (often, mate)]
    return BusLoad("bursts", random.choice(_RATES), (*queue, *others), fifo=frozenset("a"))


@clause(
    "TIME-01",
    Level.L4,
    source="Davis et al. 2007 and 2013; Tindell, Burns & Wellings 1995; requirement 5",
)
def response_times_are_those_of_theory(bench: RigProtocol) -> None:
    """Response times of declared messages, with FIFO queues and errors, are as in the theory."""
    for load, errors in _loads(bench.seed):
        theory = _Theory(load, errors)
        told = response_times(load, errors)
        expect(
            [one.message for one in told] == [one.message for one in theory.streams],
            f"{load}: not every message has a response time, the most urgent first",
        )
        if not theory.is_bounded:
            expect(
                any(one.response_ns is None for one in told),
                f"{load}: a bound, although a frame waits longer in its queue than any period",
            )
            continue
        gap_ns = _INTERMISSION_BITS * 1_000_000_000 // load.bitrate_bit_s
        for stream, found in zip(theory.streams, told, strict=True):
            worst_ns, instance, blocking_ns = theory.worst(stream)
            _expect_equal(
                found,
                Response(
                    *(stream.message, stream.takes_ns, worst_ns, worst_ns - gap_ns),
                    *(blocking_ns, theory.busy_ns(stream), instance),
                ),
            )
        _expect_verdicts(load, errors, told)
        _expect_worst_of_late(load, errors, told)
    expect(ErrorModel() == ErrorModel(1), f"errors if none are stated: {ErrorModel()}")
    queued = (one for one in _loads(bench.seed) if one[0].fifo)
    for load, errors in islice(queued, _HURRIED):
        timed = tuple(replace(one, deadline_ns=one.period_ns) for one in load.messages)
        dated = replace(load, messages=timed)
        is_in_time = are_in_time(dated, errors)
        for steps in _EFFORTS:
            is_found = are_in_time(dated, errors, Effort(steps))
            expect(is_found <= is_in_time, f"{load}: in time with {steps} steps, and not with more")


def _expect_equal(found: Response, wanted: Response) -> None:
    expect(found == wanted, f"{found.message.label}: {found}; the theory has {wanted}")


def _expect_worst_of_late(load: BusLoad, errors: ErrorModel, told: Sequence[Response]) -> None:
    """Check that deadlines that cannot be met change no response time."""
    late = tuple(replace(one, deadline_ns=1) for one in load.messages)
    found = [one.response_ns for one in response_times(replace(load, messages=late), errors)]
    wanted = [one.response_ns for one in told]
    expect(found == wanted, f"{load}, all too late: response times {found}; expected {wanted}")


def _expect_verdicts(load: BusLoad, errors: ErrorModel, told: Sequence[Response]) -> None:
    """Check the verdicts on deadlines, of which each is exact; and a single message."""
    for spare_ns, is_wanted in ((0, True), (-1, False)):
        for place, late in enumerate(told):
            timed = [
                replace(one.message, deadline_ns=(one.response_ns or 0) + spare)
                for one, spare in ((one, spare_ns if one is late else 0) for one in told)
            ]
            dated = replace(load, messages=tuple(timed))
            for doubtful in ((), (late.message.rank,)):
                expect(
                    are_in_time(dated, errors, doubtful=doubtful) is is_wanted,
                    f"{late.message.label}: deadline missed by {-spare_ns} ns, and in time:"
                    f" {not is_wanted}",
                )
            verdict = response_times(dated, errors, asked=(late.message.rank,))
            expect(
                [one.is_in_time for one in verdict] == [is_wanted],
                f"{late.message.label}: alone, in time: {not is_wanted}",
            )
            if not load.fifo:
                ordered = [one.message for one in told]
                one = response_between(
                    load, ordered[:place], ordered[place], ordered[place + 1 :], errors
                )
                _expect_equal(one, late)
    known: dict[int, int | None] = {}
    response_times(load, ErrorModel(0), lateness=known)
    expect(
        list(response_times(load, errors, lateness=known)) == list(told),
        "response times with known lateness differ from those without",
    )


@clause("TIME-02", Level.L4, source="ISO 11898-1: frames, bit stuffing; ISO 11898-1:2015, CAN FD")
def frame_lengths_are_those_of_fields(_: RigProtocol) -> None:
    """Bounds of the lengths of CAN frames are sums of their fields, without or with stuffing."""
    for extended, fd, switched in product((False, True), repeat=3):
        if switched and not fd:
            continue
        for length in FD_LENGTHS if fd else range(9):
            head = _HEAD[fd, extended]
            stuffed = head + 8 * length
            stuff = (stuffed - 1) // 4
            crc = 0
            if fd:
                crc = _FD_CRC[0] if length <= _FD_SHORT else _FD_CRC[1]
            for bound, most in ((longest, True), (shortest, False)):
                found = bound(length, extended=extended, fd=fd, switched=switched)
                wanted = (stuffed + crc + _TAIL + (stuff if most else 0), 0)
                if switched:
                    nominal = _FD_NOMINAL[extended] + _TAIL
                    nominal += _FD_STUFF[extended] if most else 0
                    wanted = (nominal, wanted[0] - nominal)
                what = f"{bound.__name__}({length}), {extended=}, {fd=}, {switched=}"
                told = (found.nominal, found.data)
                expect(told == wanted, f"{what}: {told} bits; expected {wanted}")
                _expect_times(found)


def _expect_times(bits: Bits) -> None:
    for rate, data_rate in ((500_000, None), (333_000, 2_000_000)):
        whole = bits.nominal + (0 if data_rate else bits.data)
        wanted_ns = ceil(whole * 10**9 / rate)
        if data_rate is not None:
            wanted_ns += ceil(bits.data * 10**9 / data_rate)
        takes_ns = bits.time_ns(rate, data_rate)
        expect(takes_ns == wanted_ns, f"{bits} take {takes_ns} ns; expected {wanted_ns} ns")


@clause("TIME-03", Level.L4, source="Davis et al. 2007: one sender an identifier, least period")
def declared_traffic_is_worst_of_all(bench: RigProtocol) -> None:
    """Traffic that is declared twice, or sent by several, counts with its worst properties."""
    node = PeriodicMessage(0x181, 8, 0.1, 0.02)
    other = replace(node, length=4, period_s=0.05, jitter_s=0.03)
    alone = PeriodicMessage(0x17, 1, 1.0, extended=True)
    sent = NodeTraffic(
        (node,), (replace(alone, can_id=0x18),), (other,), (replace(other, can_id=0x201),)
    )
    traffic = CanTraffic(500_000, (alone, replace(other, length=2)), frozenset((1,)), 2_000_000)
    for period_s in (None, 0.01):
        found = traffic.with_own((sent, sent), period_s, (PeriodicMessage(0x300, 6, 0.02),))
        wanted = {
            0x17: alone,
            0x18: replace(alone, can_id=0x18),
            0x181: replace(node, period_s=0.05, jitter_s=0.03),
            0x300: PeriodicMessage(0x300, 6, 0.02),
        }
        if period_s is not None:
            wanted[0x181] = replace(node, period_s=0.01, jitter_s=0.03)
            wanted[0x201] = replace(other, can_id=0x201, period_s=0.01, jitter_s=0.006)
            wanted[0x80] = PeriodicMessage(0x80, 0, 0.01)
        ordered = sorted(wanted.values(), key=lambda one: one.rank)
        what = f"with SYNC every {period_s} s: {found}; expected {ordered}"
        expect(len(found.messages) == len(ordered), what)
        for has, wants in zip(found.messages, ordered, strict=True):
            expect(replace(has, jitter_s=wants.jitter_s) == wants, what)
            expect(abs(has.jitter_s - wants.jitter_s) < _ROUNDING_S, what)
        ours = {0x18, 0x300} | ({0x201, 0x80} if period_s else set())
        expect(found.queued == {1} | {wanted[one].rank for one in ours}, what)
        expect((found.bitrate_bit_s, found.data_bitrate_bit_s) == (500_000, 2_000_000), what)
    _expect_ranks()
    fd = PeriodicMessage(0x10, 12, 0.1, fd=True, bit_rate_switch=True)
    (worst,) = worst_of([fd, replace(fd, bit_rate_switch=False, length=8), fd])
    expect(worst == replace(fd, bit_rate_switch=False), f"the worst of two is {worst}")
    for both in permutations((replace(fd, length=8), PeriodicMessage(0x10, 8, 0.1))):
        (worst,) = worst_of(both)
        wanted_fd = replace(fd, length=8, bit_rate_switch=False)
        expect(worst == wanted_fd, f"of a frame with and without FD, the worst is {worst}")
    for values in _IMPOSSIBLE:
        expect_raises(UsageError, partial(PeriodicMessage, **values), f"{values} was accepted")
    for arguments in ((999,), (1_000_001,), (True,), (500_000, (fd, fd)), (500_000, (1,))):
        expect_raises(UsageError, partial(CanTraffic, *arguments), f"{arguments} was accepted")
    declare: Any = declare_traffic
    for wrong in (fd, "traffic", 500_000):
        refused = partial(declare, bench, wrong)
        expect_raises(UsageError, refused, f"{wrong!r} was declared as traffic")
    for fast in (499_999, 20_000_001):
        made = partial(CanTraffic, 500_000, data_bitrate_bit_s=fast)
        expect_raises(UsageError, made, f"a data bit rate of {fast} bit/s was accepted")
    for values in _POSSIBLE:
        PeriodicMessage(**values)
    CanTraffic(1_000, data_bitrate_bit_s=1_000)
    CanTraffic(1_000_000, data_bitrate_bit_s=20_000_000)


def _expect_ranks() -> None:
    """Check that ranks have the order of arbitration."""
    senders = [(one, False) for one in (0, 1, 0x7F, 0x7FF)]
    senders += [(one, True) for one in (0, 1, (1 << 18) - 1, 1 << 18, 0x7F << 18 | 5, 0x1FFF_FFFF)]
    by_bus = sorted(senders, key=lambda one: _arbitration(*one))
    by_rank = sorted(senders, key=lambda one: rank_of(one[0], extended=one[1]))
    expect(by_rank == by_bus, f"the order of identifiers is {by_rank}; on the bus {by_bus}")


def _arbitration(identifier: int, extended: bool) -> str:
    """Return the bits of arbitration: identifier, RTR or SRR, IDE, rest of the identifier."""
    if extended:
        return f"{identifier >> 18:011b}11{identifier & 0x3FFFF:018b}"
    return f"{identifier:011b}00"


_MESSAGE: Final[dict[str, Any]] = {"can_id": 0x7FF, "length": 8, "period_s": 0.1}
_FD_LENGTHS: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)  # ISO 11898-1


def _fd_of(lengths: Sequence[int]) -> tuple[dict[str, Any], ...]:
    return tuple({**_MESSAGE, "length": one, "fd": True} for one in lengths)


_OTHER_LENGTHS: Final = sorted({*range(66)} - {*_FD_LENGTHS})
_IMPOSSIBLE: Final[tuple[dict[str, Any], ...]] = _fd_of(_OTHER_LENGTHS) + tuple(
    {**_MESSAGE, **one}
    for one in (
        *({"can_id": -1}, {"can_id": 0x800}, {"can_id": 1 << 29, "extended": True}),
        *({"can_id": 1.5}, {"can_id": True}, {"length": 9}, {"length": -1}, {"length": None}),
        {"bit_rate_switch": True},
        *({"period_s": 0.0}, {"period_s": 0.9e-6}, {"period_s": 1.1e6}, {"period_s": "1"}),
        *({"jitter_s": -1e-9}, {"jitter_s": 1.1e6}, {"jitter_s": float("nan")}, {"jitter_s": True}),
    )
)
_POSSIBLE: Final[tuple[dict[str, Any], ...]] = _fd_of(_FD_LENGTHS) + tuple(
    {**_MESSAGE, **one}
    for one in (
        *({"can_id": 0}, {"length": 0}, {"period_s": 1e-6, "jitter_s": 1e6}, {"period_s": 1e6}),
        *({"can_id": 0x1FFF_FFFF, "extended": True}, {"period_s": 1}),
    )
)


_FRAME: Final = OneFrame(0x201, 8)
_WIRE: Final = CanTraffic(500_000)
_FRAME_S: Final = 135 / 500_000  # the longest frame of 8 bytes, with its intermission
_SEEN_S: Final = 136 / 500_000  # and a bit: a frame may have begun this long before
_OFFER: Final = SyncOffer(
    *(SyncLevel.SEQUENTIAL, "a", (0.001, 0.003), "in turn"),
    firing=Firing("can0", _WIRE, (_FRAME,), idle_s=0.01),
    oscillator_ppm=100.0,
    end_s=(0.0, 0.002),
)


@clause("TIME-04", Level.L4, source="requirement 5 of the paper; SyncCapability: the bounds")
def bounds_of_start_are_sums_of_parts(_: RigProtocol) -> None:
    """Bounds on skews are those of frames, latencies, clocks and ticks, or have a reason."""
    one = Member("left", _OFFER, 2.0)
    other = Member("right", replace(_OFFER, latency_s=(0.002, 0.004)), 1.0)
    apart = replace(other, offer=replace(other.offer, group="b"))
    for members, command_s, start_s, end_s in (
        ((one,), 0.0, 0.0, 0.0),
        ((one, other), 0.0, 0.003, 0.003 + 1.002 + 300e-6),
        ((one, apart), 0.02 + 2.0 * _FRAME_S, 0.023 + 2.0 * _FRAME_S, None),
        ((one, replace(other, duration_s=None)), 0.0, 0.003, 0.0),
    ):
        command = command_bound(members)
        start = start_bound(members, command)
        end = end_bound(members, start)
        found = [bound.value_s for bound in (command, start, end)]
        for told, wanted in zip(found, (command_s, start_s, end_s), strict=True):
            expect(
                wanted is None or (told is not None and abs(told - wanted) < 1e-6),
                f"bounds of {members}: {found}; expected {(command_s, start_s, end_s)}",
            )
    signals = [
        replace(one, offer=replace(_OFFER, signals=n, signal_s=(n, n + 0.25))) for n in (0, 2)
    ]
    told = command_bound(signals).value_s
    expect(told == 2.25, f"latched by signals at 0 to 0.25 s and 2 to 2.25 s: {told} s apart")
    told = command_bound((one, signals[1])).value_s
    expect(told == 2.25, f"latched at once, and by a signal at 2 to 2.25 s: {told} s apart")
    _expect_reasons(one, apart)
    unbounded = Bound(None, "why")
    for bounded in (start_bound((one, other), unbounded), end_bound((one, other), unbounded)):
        expect(bounded == unbounded, f"{bounded} of {unbounded}")
    _expect_firing()
    _expect_straddling()


def _expect_reasons(one: Member, apart: Member) -> None:
    """Check that each unknown time is the reason for the bound that it makes impossible."""
    for name, why, of in (
        ("firing", "no_firing_bound", command_bound),
        ("latency_s", "no_start_bound", partial(start_bound, command=Bound(0.0))),
        ("oscillator_ppm", "no_end_bound", partial(end_bound, start=Bound(0.0))),
        ("end_s", "no_end_bound", partial(end_bound, start=Bound(0.0))),
    ):
        for told, reason in (("why", "why"), ("", "its hardware does not specify that time")):
            lacks: dict[str, Any] = {name: None, why: told}
            unknown = replace(apart, offer=replace(apart.offer, **lacks))
            found, wanted = of((one, unknown)), Bound(None, f"right: {reason}")
            expect(found == wanted, f"without {name}: {found}; expected {wanted}")


def _expect_firing() -> None:
    """Check the longest time of a frame among others, and of one on a bus without room."""
    urgent = PeriodicMessage(0x101, 8, 0.001, 0.0001)
    lower = PeriodicMessage(0x301, 4, 0.5)
    for message, more_s in (
        *((urgent, 0.0), (replace(urgent, jitter_s=0.0008), 0.0)),
        (lower, 95 / 500_000),
    ):
        traffic = CanTraffic(500_000, (message,))
        fixed_s = _FRAME_S + more_s
        wanted_s, again_s = 0.0, fixed_s
        while again_s > wanted_s:
            wanted_s, again_s = again_s, fixed_s
            if message is not lower:
                again_s += ceil((wanted_s + _SEEN_S + message.jitter_s) / 0.001) * _FRAME_S
        told_s = longest_s([Firing("can0", traffic, (_FRAME,))])
        expect(
            told_s is not None and abs(told_s - wanted_s) < _NEAR_S,
            f"a frame beside {message} takes {told_s} s; expected {wanted_s} s",
        )
    behind = CanTraffic(500_000, (lower,), frozenset((lower.rank,)))
    told_s = longest_s([Firing("can0", behind, (_FRAME,))])
    least_s, most_s = (_FRAME_S + frames * 95 / 500_000 for frames in (1, 2))
    expect(
        told_s is not None and least_s - _NEAR_S <= told_s <= most_s + _NEAR_S,
        f"a frame queued behind one of {behind} takes {told_s} s; expected {least_s} to {most_s} s",
    )
    apart = [Firing("can0", _WIRE, (_FRAME,)), Firing("can1", _WIRE, (_FRAME,), idle_s=0.5)]
    told_s = longest_s(apart)
    expect(told_s == 0.5 + 2.0 * _FRAME_S, f"frames on two buses take {told_s} s")
    expect(longest_s([Firing(idle_s=0.25)]) == 0.25, "a firing without frames takes its idle time")
    full = CanTraffic(500_000, (replace(urgent, period_s=0.00027), lower))
    expect(longest_s([Firing("can0", full, (_FRAME,))]) is None, "a frame on a full bus is bounded")
    expect(overload_of(full).startswith("101h and "), f"a full bus: {overload_of(full)!r}")
    expect(overload_of(_WIRE) == "", f"an empty bus: {overload_of(_WIRE)!r}")
    load = BusLoad.of(CanTraffic(500_000, (urgent, replace(lower, can_id=0x12, extended=True))))
    labels = [message.label for message in load.messages]
    expect(labels == ["101h", "00000012h"], f"labels {labels}")
    times = [(message.period_ns, message.jitter_ns) for message in load.messages]
    expect(times == [(1_000_000, 100_000), (500_000_000, 0)], f"periods and jitters {times}")
    used = (load.utilisation(), load.utilisation_unstuffed())
    wanted = (0.27 + 240e-6 / 0.5, 0.222 + 198e-6 / 0.5)
    near = all(abs(has - wants) < 1e-5 for has, wants in zip(used, wanted, strict=True))
    expect(near, f"shares of the bus {used}; expected {wanted}")


def _expect_straddling() -> None:
    """Check the bound for frames that a signal may separate."""
    late = PeriodicMessage(_FRAME.can_id, 8, 0.0005, 0.0001)  # the signal, at times late
    late_firing = Firing("can0", CanTraffic(500_000, (late,)), (_FRAME,))
    for period_s, firing, wanted_s in (
        (0.01, _OFFER.firing, 0.0),
        (0.0005, _OFFER.firing, 0.0005 + _FRAME_S),
        (0.0005, late_firing, 0.0005 + _FRAME_S + 0.0001),
    ):
        offer = replace(_OFFER, burst=_FRAME, period_s=period_s, firing=firing)
        told_s = command_bound((Member("left", offer), Member("right", offer))).value_s
        expect(
            told_s is not None and abs(told_s - wanted_s) < _NEAR_S,
            f"frames between signals every {period_s} s: {told_s} s; expected {wanted_s} s",
        )


def _frames_of(
    bench: RigProtocol, action: Callable[[], None]
) -> dict[tuple[int, bool], tuple[int, int]]:
    """Return the frames on the motor's bus meanwhile, by rank and sender: how many, how long."""
    seen: dict[tuple[int, bool], tuple[int, int]] = {}

    def on_frame(frame: bytes, time_ns: int, is_own: bool) -> None:
        word = int.from_bytes(frame[:4], "little")  # as struct can_frame of Linux
        rank = rank_of(word & _IDENTIFIER, extended=bool(word & _EXTENDED))
        count, longest = seen.get((rank, is_own), (0, 0))
        length = 0 if word & _REMOTE else frame[4]
        seen[rank, is_own] = count + 1, max(longest, length)

    protocol = getattr(getattr(bench.link, "protocol", None), "name", _CLASSICAL)
    listening = bench.runtime.listen(bench.link, on_frame, fd=protocol != _CLASSICAL)
    action()
    listening.cancel()
    return seen


@clause(
    "TIME-06",
    Level.L4,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.SETTINGS, Ability.ONE_KIND},
    source="ISO 11898-1, arbitration: one sender of an identifier; OPT-01",
)
def identifiers_have_one_sender(bench: RigProtocol) -> None:
    """No identifier has two senders; a number of the host with which one had two is refused."""
    stated = bench.stated()
    if stated is None:
        raise NotApplicable("the adaptation declares no settings")
    _expect_one_sender(bench, "as it is")
    address = next((stated.values[key] for key in ADDRESS_KEYS if key in stated.values), None)
    for key in stated.declaration.names(bench.motor.model.unit):
        if key.startswith(_HOST) and isinstance(address, int):
            with suppress(RigError), bench.altered({key: address}, {}):
                _expect_one_sender(bench, f"with {key} = {address}, the address of the drive")


def _expect_one_sender(bench: RigProtocol, what: str) -> None:
    """Expect a move without identifiers that both the host and a drive send, or its refusal."""
    motor = bench.motor
    try:
        motor.enable()
    except UsageError:
        return
    seen = _frames_of(bench, lambda: move(bench, motor, 0.2 * long_move(bench)))
    both = [  # remote frames, without data, ask for what the drive sends
        rank
        for (rank, is_own), (_, longest) in seen.items()
        if is_own and longest and (rank, False) in seen
    ]
    ranks = ", ".join(f"{one:X}h" for one in both)
    expect(not both, f"{what}: frames of one identifier from host and drive, of ranks {ranks}")


def _expect_declared(
    nodes: Sequence[NodeTraffic], new: dict[tuple[int, bool], int], lasted_s: float
) -> None:
    """Expect all that drives send by themselves, not as answers, to be declared."""
    declared = {one.rank for node in nodes for one in (*node.sent, *node.sent_at_sync)}
    ours = {one.rank for node in nodes for one in (*node.ours, *node.ours_at_sync)}
    asked = sum(count for (rank, is_own), count in new.items() if is_own and rank not in ours)
    others = {rank: n for (rank, is_own), n in new.items() if not is_own and rank not in declared}
    unasked = sum(others.values()) - asked
    expect(
        unasked <= _UNDECLARED_HZ * lasted_s,
        f"{unasked} frames of drives in {lasted_s:g} s are not declared, are no answers, and came"
        f" only since the motors were enabled: ranks {', '.join(f'{one:X}h' for one in others)}",
    )


@clause(
    "TIME-05",
    Level.L4,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.SETTINGS, Ability.ONE_KIND},
    source="requirement 5; NodeTraffic, CanDrive.note_frames: the traffic of a motor on its bus",
)
def frames_on_bus_are_as_declared(bench: RigProtocol) -> None:
    """The periodic frames of a motor are as declared: no others, no longer, and no more often."""
    motor, link = bench.motor, bench.link
    before = _frames_of(bench, lambda: rest_for(bench, _BEFORE_S))
    for each in bench.motors:  # the drive of another one may have begun to send since
        each.enable()
    begun_ns = bench.runtime.now_ns()
    seen = _frames_of(bench, lambda: move(bench, motor, long_move(bench)))
    lasted_s = elapsed_s(bench, begun_ns)
    nodes = own_traffic(link)
    often = max((count for count, _ in seen.values()), default=0)
    expect(
        bool(nodes) or often <= _UNDECLARED_HZ * lasted_s,
        f"no frame is declared, although one came {often} times in {lasted_s:g} s",
    )
    if nodes and not any(node.unknown for node in nodes):
        new = {key: count for key, (count, _) in seen.items() if key not in before}
        _expect_declared(nodes, new, lasted_s)
    for node in nodes:
        for messages, is_own in ((node.sent, False), (node.ours, True)):
            whose = "the host's" if is_own else "the drive's"
            found = [one for one in messages if (one.rank, is_own) in seen]
            names = ", ".join(one.name for one in messages)
            expect(bool(found) or not messages, f"none of {whose} declared frames came: {names}")
            for one in found:
                count, longest = seen[one.rank, is_own]
                allowed = _OFTEN * (lasted_s + one.jitter_s) / one.period_s + _MORE
                text = f"{one.name}, {whose}, declared every {one.period_s:g} s"
                expect(count <= allowed, f"{text}: {count} times in {lasted_s:g} s")
                expect(longest <= one.length, f"{text} with {one.length} bytes: {longest} bytes")
