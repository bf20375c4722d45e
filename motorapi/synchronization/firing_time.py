"""Longest duration of triggers that are fired in turn, on buses with other traffic.

A start of motors sends frames *once*, one after another, each queued when the one before it has
been received. The theory of periodic frames (`can_response_time`) gives only how many frames of
other messages may wait at any time. `longest_s` describes the bound.
"""

from collections.abc import Hashable, Sequence
from itertools import groupby
from math import ceil
from typing import Final, final

from motorhil.motorapi.synchronization.bus_load import CanTraffic, rank_of, worst_of
from motorhil.motorapi.synchronization.can_frame_length import bits_ns, longest
from motorhil.motorapi.synchronization.can_response_time import (
    BusLoad,
    Flow,
    response_times,
)
from motorhil.motorapi.synchronization.offer import Firing, OneFrame

_FIRST_SDO_RANK: Final = rank_of(0x580)
_ROUNDS_MAX: Final = 10_000


def overload_of(traffic: CanTraffic) -> str:
    """Return a description of the first message that may never be sent, or ""."""
    load = BusLoad.of(traffic)
    share = 0.0
    for message in sorted(load.messages, key=lambda one: one.rank):
        share += load.takes_ns(message) / message.period_ns
        if share >= 1.0:
            return f"{message.label} and messages of higher priority may fill the bus"
    return ""


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
        load = BusLoad.of(traffic)
        flows = [Flow.of(load, one) for one in load.messages]
        mates = {rank_of(can_id) for frame in frames for can_id in frame.mates}
        queued = [one for one in flows if one.rank in traffic.queued or one.rank in mates]
        last = max(frame.rank for frame in frames)
        level = max([last, *(one.rank for one in queued)])
        self._before_ns = longest(8).time_ns(rate) + bits_ns(1, rate)
        # (message, number that may wait, cost of each [ns])
        self._counted: list[tuple[Flow, int, int]] = []
        ahead_ns = 0
        for one, waiting in zip(flows, _waiting(load, traffic), strict=True):
            if one in queued:
                cost_ns = one.takes_ns + _lower_ns(flows, one.rank)
                if at_once:  # later frames are queued behind it
                    ahead_ns += waiting * cost_ns
                else:
                    self._counted.append((one, waiting, cost_ns))
            elif one.rank < level:
                is_urgent = one.rank < last and one.rank < _FIRST_SDO_RANK
                self._counted.append((one, 0 if is_urgent else waiting, one.takes_ns))
        self.share = sum(cost_ns / one.message.period_ns for one, _, cost_ns in self._counted)
        self.fixed_ns = ahead_ns + sum(
            frame.longest_ns(traffic) + _lower_ns(flows, frame.rank) for frame in frames
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
            (one.most(seen_ns) + waits) * cost_ns for one, waits, cost_ns in self._counted
        )


def _waiting(load: BusLoad, traffic: CanTraffic) -> list[int]:
    """Return for each message how many of its frames may wait at any time (1 without a bound)."""
    found = {one.message.rank: one.response_ns for one in response_times(load)}
    return [
        max(1, ceil((found[message.rank] or 0) / 1e9 / message.period_s))
        for message in traffic.messages
    ]


def _lower_ns(flows: Sequence[Flow], rank: int) -> int:
    """Return the longest frame of lower priority than `rank` [ns]."""
    return max((one.takes_ns for one in flows if one.rank > rank), default=0)
