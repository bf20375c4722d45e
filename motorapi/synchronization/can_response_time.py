"""Worst-case response times on a CAN bus.

The analysis is that of Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability
analysis: Refuted, revisited and revised" (Real-Time Systems 35, 2007). A frame of message m waits
for one lower-priority frame already on the bus (blocking B). The frame also waits for
higher-priority frames that arrive before it begins, and for earlier frames of its own message.
Every instance in the busy period is examined: the first is not always the worst, which the older
analysis missed.

    t     = B + sum over hp(m) and m of ceil((t + J) / T) C         the busy period
    w(q)  = B + q C_m + sum over hp(m) of ceil((w(q) + J + tau) / T) C
    R     = max over q of J_m + w(q) - q T_m + C_m                  tau: one bit

This holds for periodic frames. A start of motors sends frames *once*, one after another;
`longest_s` has a separate bound for them.

All times are integer nanoseconds internally, rounded up. A frame has the maximum number of stuff
bits, and the 3 bits of intermission in which no frame may begin.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import groupby
from math import ceil
from typing import Final, final

from motorhil.motorapi.synchronization.bus_load import (
    CanTraffic,
    PeriodicMessage,
    rank_of,
    worst_of,
)

INTERMISSION_BITS: Final = 3
_STUFFED_BITS: Final = (34, 54)  # SOF to CRC without data, for 11 and 29 bits: may be stuffed
_PLAIN_BITS: Final = 10 + INTERMISSION_BITS  # CRC delimiter, ACK, ACK delimiter, EOF
_FD_TO_BRS_BITS: Final = (17, 36)  # CAN FD, SOF to BRS, for 11 and 29 bits
_FD_STUFF_TO_BRS: Final = (3, 8)  # maximum: a run of five cannot end with FDF, res or BRS
_FD_ESI_TO_DLC_BITS: Final = 5
_FD_CHECK_BITS: Final = (27, 32)  # stuff count, CRC-17 or CRC-21, fixed stuff bits
_FD_SHORT_CRC_BYTES: Final = 16
_FIRST_SDO_RANK: Final = rank_of(0x580)
_ROUNDS_MAX: Final = 10_000
_INSTANCES_MAX: Final = 1_000


def worst_frame_bits(length: int, *, extended: bool = False) -> int:
    """Return the length of a frame with the maximum number of stuff bits, with intermission."""
    stuffed = _STUFFED_BITS[extended] + 8 * length
    return stuffed + (stuffed - 1) // 4 + _PLAIN_BITS


def worst_frame_ns(message: PeriodicMessage, traffic: CanTraffic) -> int:
    """Return the maximum duration of a frame of `message` on the bus of `traffic` [ns].

    In CAN FD frames with a bit rate switch, only SOF to BRS and CRC delimiter to intermission use
    the nominal bit rate, with the stuff bits possible there. Source: ISO 11898-1:2015, frame
    formats. After BRS, as many dynamic stuff bits are counted as the remaining bits allow.
    """
    rate, fast = traffic.bitrate_bit_s, traffic.data_bitrate_bit_s
    if not message.fd:
        return bits_ns(worst_frame_bits(message.length, extended=message.extended), rate)
    first = _FD_TO_BRS_BITS[message.extended]
    stuffed = first + _FD_ESI_TO_DLC_BITS + 8 * message.length
    stuff = (stuffed - 1) // 4
    check = _FD_CHECK_BITS[message.length > _FD_SHORT_CRC_BYTES]
    if not message.bit_rate_switch or fast is None:
        return bits_ns(stuffed + stuff + check + _PLAIN_BITS, rate)
    early = _FD_STUFF_TO_BRS[message.extended]
    data = _FD_ESI_TO_DLC_BITS + 8 * message.length + stuff - early + check
    return bits_ns(first + early + _PLAIN_BITS, rate) + bits_ns(data, fast)


def least_frame_bits(length: int, *, extended: bool = False) -> int:
    """Return the length of a frame without stuff bits, up to its end, without intermission."""
    return _STUFFED_BITS[extended] + 8 * length + _PLAIN_BITS - INTERMISSION_BITS


def bits_ns(bits: int, bitrate_bit_s: int) -> int:
    """Return the duration of `bits` bits [ns], rounded up."""
    return -(-bits * 1_000_000_000 // bitrate_bit_s)


@final
@dataclass(frozen=True, slots=True)
class ResponseTime:
    """Worst-case response time of a message, from the time when it should be queued.

    Attributes:
        message: the message of the traffic.
        response_s: to the end of its intermission, as in the theory [s]; None: no bound, because
            messages of the same or higher priority fill the bus.
        received_s: to its last bit, when receivers have it [s].
        blocking_s: delay by one frame of lower priority [s].
        busy_s: maximum duration of a busy period of this priority [s].
        instance: index of the worst instance, from 0.
    """

    message: PeriodicMessage
    response_s: float | None
    received_s: float | None
    blocking_s: float
    busy_s: float | None
    instance: int


def response_times(traffic: CanTraffic) -> tuple[ResponseTime, ...]:
    """Return the response time of every message, in order of priority.

    Each sender transmits its frame of highest priority first.
    """
    ordered = sorted(_Timed.all_of(traffic), key=lambda one: one.rank)
    return tuple(
        _response(one, ordered[:place], ordered[place + 1 :], traffic.bitrate_bit_s)
        for place, one in enumerate(ordered)
    )


@final
@dataclass(frozen=True, slots=True)
class _Timed:
    """A message in integer nanoseconds, its period rounded down, its jitter rounded up."""

    message: PeriodicMessage
    rank: int
    takes_ns: int
    period_ns: int
    jitter_ns: int

    @classmethod
    def all_of(cls, traffic: CanTraffic) -> "list[_Timed]":
        return [
            cls(
                message,
                message.rank,
                worst_frame_ns(message, traffic),
                max(1, int(round(message.period_s * 1e12) // 1000)),
                -(-round(message.jitter_s * 1e12) // 1000),
            )
            for message in traffic.messages
        ]

    def count(self, window_ns: int) -> int:
        """Return the maximum number of frames queued in any window of this length."""
        return -(-(window_ns + self.jitter_ns) // self.period_ns)


def _response(
    one: _Timed, higher: Sequence[_Timed], lower: Sequence[_Timed], bitrate_bit_s: int
) -> ResponseTime:
    bit_ns = bits_ns(1, bitrate_bit_s)
    blocking_ns = max((other.takes_ns for other in lower), default=0)
    busy_ns = _busy_period_ns(blocking_ns, [*higher, one])
    if busy_ns is None or one.count(busy_ns) > _INSTANCES_MAX:
        return ResponseTime(one.message, None, None, blocking_ns / 1e9, None, 0)
    worst_ns, instance = 0, 0
    waited_ns = blocking_ns
    for number in range(one.count(busy_ns)):
        fixed_ns = blocking_ns + number * one.takes_ns
        waited_ns = max(waited_ns, fixed_ns)
        while True:
            again_ns = fixed_ns + sum(
                other.count(waited_ns + bit_ns) * other.takes_ns for other in higher
            )
            if again_ns <= waited_ns:
                break
            waited_ns = again_ns
        response_ns = one.jitter_ns + waited_ns - number * one.period_ns + one.takes_ns
        if response_ns > worst_ns:
            worst_ns, instance = response_ns, number
    gap_ns = INTERMISSION_BITS * 1_000_000_000 // bitrate_bit_s
    return ResponseTime(
        message=one.message,
        response_s=worst_ns / 1e9,
        received_s=(worst_ns - gap_ns) / 1e9,
        blocking_s=blocking_ns / 1e9,
        busy_s=busy_ns / 1e9,
        instance=instance,
    )


def _busy_period_ns(blocking_ns: int, level: Sequence[_Timed]) -> int | None:
    if sum(one.takes_ns / one.period_ns for one in level) >= 1.0:
        return None
    busy_ns = blocking_ns + sum(one.takes_ns for one in level)
    for _ in range(_ROUNDS_MAX):
        again_ns = blocking_ns + sum(one.count(busy_ns) * one.takes_ns for one in level)
        if again_ns <= busy_ns:
            return busy_ns
        busy_ns = again_ns
    return None


def overload_of(traffic: CanTraffic) -> str:
    """Return a description of the first message that may never be sent, or ""."""
    for found in response_times(traffic):
        if found.response_s is None:
            return f"{found.message.name} and messages of higher priority may fill the bus"
    return ""


# --- frames that are sent once -------------------------------------------------------------------


@final
@dataclass(frozen=True, slots=True)
class OneFrame:
    """A frame that is sent once.

    Attributes:
        can_id: its identifier, 11 bits.
        length: data bytes.
        mates: identifiers that may precede it in the queue of its sender, if another node sends it:
            the TPDOs and the heartbeat of a node that answers an SDO.
    """

    can_id: int
    length: int
    mates: tuple[int, ...] = ()


@final
@dataclass(frozen=True, slots=True)
class Firing:
    """The frames and delays of one trigger.

    Attributes:
        bus: the bus of its frames; None: no frames.
        traffic: the other traffic there, including that of this program and its nodes.
        frames: sent in turn, each queued when the one before it has been received.
        idle_s: maximum delay other than that of the bus [s].
        latched_after: number of frames received when the first drive latches its command; the last
            drive latches with the last frame.
    """

    bus: Hashable | None = None
    traffic: CanTraffic | None = None
    frames: tuple[OneFrame, ...] = ()
    idle_s: float = 0.0
    latched_after: int = 0

    def rest(self) -> "Firing":
        """Return the rest of the trigger after the first drive has latched its command."""
        idle_s = self.idle_s if self.latched_after < len(self.frames) else 0.0
        return Firing(self.bus, self.traffic, self.frames[self.latched_after :], idle_s)


def longest_s(firings: Sequence[Firing]) -> float | None:
    """Return the maximum total duration of all firings in turn [s], or None without a bound.

    The window runs from the queuing of the first frame to the end of the last one. In it each bus
    carries, beside the frames themselves: before each frame at most one frame of lower priority,
    already on the bus; and of each message of higher priority as many frames as can arrive in the
    window. Frames that arrived earlier count as if the window had begun earlier (the argument of
    the critical instant), except one frame of this program that armed a drive just before. This
    argument does not cover messages of lower priority than one of the frames, or than an SDO. For
    each of those messages, the frames that may arrive during its own worst-case waiting time are
    added.

    The periodic frames of this program share the same queue. Each may precede one of our frames and
    delays it until it has been sent itself, after all messages of higher priority. Frames queued
    after the last frame do not delay it.

    The argument holds for the whole window, and for each part of it. The smaller bound counts.
    """
    parts = [list(part) for _, part in groupby(firings, key=lambda one: one.bus)]
    known = [_as_one_ns(firings)]
    if len(parts) > 1:
        each_ns = [_as_one_ns(part) for part in parts]
        known.append(None if None in each_ns else sum(one for one in each_ns if one is not None))
    found = [one for one in known if one is not None]
    return min(found) / 1e9 if found else None


def _as_one_ns(firings: Sequence[Firing]) -> int | None:
    total_ns = sum(-(-round(one.idle_s * 1e12) // 1000) for one in firings)
    buses = [_Bus.of(firings, bus) for bus in dict.fromkeys(one.bus for one in firings)]
    present = [one for one in buses if one is not None]
    if sum(one.share for one in present) >= 1.0:
        return None
    now_ns = total_ns + sum(one.fixed_ns for one in present)
    for _ in range(_ROUNDS_MAX):
        again_ns = total_ns + sum(one.load_ns(now_ns) for one in present)
        if again_ns <= now_ns:
            return now_ns
        now_ns = again_ns
    return None


@final
class _Bus:
    """One bus, used by several firings."""

    def __init__(self, traffic: CanTraffic, frames: Sequence[OneFrame], *, at_once: bool) -> None:
        rate = traffic.bitrate_bit_s
        messages = _Timed.all_of(traffic)
        mates = {rank_of(can_id) for frame in frames for can_id in frame.mates}
        queued = [one for one in messages if one.rank in traffic.queued or one.rank in mates]
        last = max(rank_of(frame.can_id) for frame in frames)
        level = max([last, *(one.rank for one in queued)])
        self._before_ns = bits_ns(worst_frame_bits(8), rate) + bits_ns(1, rate)
        self._counted: list[
            tuple[_Timed, int, int]
        ] = []  # (message, number that may wait, cost of each [ns])
        ahead_ns = 0
        for one, waiting in zip(messages, _waiting(traffic), strict=True):
            if one in queued:
                cost_ns = one.takes_ns + _lower_ns(messages, one.rank)
                if at_once:  # later frames are queued behind it
                    ahead_ns += waiting * cost_ns
                else:
                    self._counted.append((one, waiting, cost_ns))
            elif one.rank < level:
                is_urgent = one.rank < last and one.rank < _FIRST_SDO_RANK
                self._counted.append((one, 0 if is_urgent else waiting, one.takes_ns))
        self.share = sum(cost_ns / one.period_ns for one, _, cost_ns in self._counted)
        self.fixed_ns = ahead_ns + sum(
            bits_ns(worst_frame_bits(frame.length), rate)
            + _lower_ns(messages, rank_of(frame.can_id))
            for frame in frames
        )

    @classmethod
    def of(cls, firings: Sequence[Firing], bus: Hashable | None) -> "_Bus | None":
        """Return the bus `bus` with the traffic of all firings there, or None without frames."""
        here = [one for one in firings if one.bus == bus and one.frames]
        known = [one.traffic for one in here if one.traffic is not None]
        if bus is None or not known:
            return None
        queued: frozenset[int] = frozenset()
        for one in known:
            queued |= one.queued
        messages = worst_of([message for one in known for message in one.messages])
        first = known[0]
        traffic = CanTraffic(first.bitrate_bit_s, messages, queued, first.data_bitrate_bit_s)
        frames = [frame for one in here for frame in one.frames]
        at_once = len(frames) == 1 and not any(one.idle_s for one in firings)
        return cls(traffic, frames, at_once=at_once)

    def load_ns(self, window_ns: int) -> int:
        """Return the maximum load of the bus in a window of this length [ns]."""
        seen_ns = window_ns + self._before_ns
        return self.fixed_ns + sum(
            (one.count(seen_ns) + waits) * cost_ns for one, waits, cost_ns in self._counted
        )


def _waiting(traffic: CanTraffic) -> list[int]:
    """Return for each message how many of its frames may wait at any time (1 without a bound)."""
    found = {one.message.rank: one.response_s for one in response_times(traffic)}
    return [
        max(1, ceil((found[message.rank] or 0.0) / message.period_s))
        for message in traffic.messages
    ]


def _lower_ns(messages: Sequence[_Timed], rank: int) -> int:
    """Return the longest frame of lower priority than `rank` [ns]."""
    return max((one.takes_ns for one in messages if one.rank > rank), default=0)
