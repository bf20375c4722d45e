"""Predicted skew: bounds on how far apart motors begin and end, from what their hardware offers.

Three figures, each resting on the one before it:

- *command skew*: between the instants at which the first and the last drive latch their commands.
  One signal for all: 0. Several triggers, fired one after another: what the later ones take on the
  bus, at most (`motorapi.bus_timing.longest_s`), from when the first drive has latched.
- *start skew*: and between the latch and the start of motion each drive waits for its own profile
  tick, at most one.
- *end skew*: and each motion takes a little longer or shorter than the others: rounded to the
  hardware's units, and timed by a clock that is off by some ppm; and it ends at a profile tick.

Where something is not known there is no bound, and the reason is told.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Final, final

from motorapi.bus_timing import Firing, longest_s
from motorapi.synchronization import SyncOffer

_PPM: Final = 1e-6
_FULL: Final = "what is more urgent on the bus, or waits with it, may hold the start up for ever"


@final
@dataclass(frozen=True, slots=True)
class Bound:
    """A time that is not exceeded [s]; or None, and why there is none."""

    value_s: float | None
    reason: str = ""


@final
@dataclass(frozen=True, slots=True)
class Member:
    """One motor of a group.

    Attributes:
        name: of the motor.
        offer: of its hardware.
        duration_s: of its motion, as the hardware makes it [s]; None: it has no end of its own.
    """

    name: str
    offer: SyncOffer
    duration_s: float | None = None


def command_bound(members: Sequence[Member]) -> Bound:
    """Between the first and the last latch."""
    if len(members) < 2:
        return Bound(0.0)
    triggers = _triggers(members)
    straddling = _straddling(triggers)
    if len(triggers) > 1:  # whatever latches does so before the last trigger has been fired
        return _sum(_one_after_another(triggers), straddling)
    return _sum(straddling, _signals(members))


def start_bound(members: Sequence[Member], command: Bound) -> Bound:
    """Between the first and the last start of motion."""
    if len(members) < 2:
        return Bound(0.0)
    known = [one.offer.latency_s for one in members if one.offer.latency_s is not None]
    if len(known) < len(members):
        return _none(members, lambda one: one.latency_s is None, lambda one: one.no_start_bound)
    longest = max(latency_s[1] for latency_s in known)
    return _sum(command, Bound(longest - min(latency_s[0] for latency_s in known)))


def end_bound(members: Sequence[Member], start: Bound) -> Bound:
    """Between the first and the last end, of those that come to one by themselves."""
    ending = [one for one in members if one.duration_s is not None]
    if len(ending) < 2:
        return Bound(0.0)
    if start.value_s is None:
        return start
    earliest_s: list[float] = []
    latest_s: list[float] = []
    for one in ending:
        ppm, end_s = one.offer.oscillator_ppm, one.offer.end_s
        if ppm is None or end_s is None:
            return _none(
                ending,
                lambda one: one.oscillator_ppm is None or one.end_s is None,
                lambda one: one.no_end_bound,
            )
        assert one.duration_s is not None
        earliest_s.append(one.duration_s / (1.0 + ppm * _PPM) + end_s[0])
        latest_s.append(one.duration_s / (1.0 - ppm * _PPM) + end_s[1])
    return _sum(start, Bound(max(latest_s) - min(earliest_s)))


def _triggers(members: Sequence[Member]) -> list[list[Member]]:
    """The members of each trigger, in the order in which triggers are fired."""
    triggers: dict[object, list[Member]] = {}
    for one in members:
        triggers.setdefault(one.offer.group, []).append(one)
    return list(triggers.values())


def _one_after_another(triggers: Sequence[Sequence[Member]]) -> Bound:
    firings: list[Firing] = []
    for sharing in triggers:
        offers = [one.offer for one in sharing]
        known = [offer.firing for offer in offers if offer.firing is not None]
        if len(known) < len(offers):
            return _none(sharing, lambda one: one.firing is None, lambda one: one.no_firing_bound)
        firing = max(known, key=lambda one: (one.idle_s, len(one.frames)))
        frames = tuple(offer.burst for offer in offers if offer.burst is not None)
        firings.append(replace(firing, frames=(*frames, *firing.frames)))
    took_s = longest_s([firings[0].rest(), *firings[1:]])
    if took_s is None:
        return Bound(
            None, "what is more urgent on the bus, or waits with it, may hold the start up for ever"
        )
    return Bound(took_s)


def _straddling(triggers: Sequence[Sequence[Member]]) -> Bound:
    """A signal may come between the frames of a burst, unless they surely pass in a period."""
    worst_s = 0.0
    for sharing in triggers:
        burst = [one.offer for one in sharing if one.offer.burst is not None]
        if len(burst) < 2:
            continue
        firing, period_s = burst[0].firing, burst[0].period_s
        if firing is None or period_s is None:
            return _none(sharing, lambda one: one.firing is None, lambda one: one.no_firing_bound)
        frames = tuple(offer.burst for offer in burst if offer.burst is not None)
        takes_s = longest_s([Firing(firing.bus, firing.traffic, frames)])
        waits_s = longest_s([Firing(firing.bus, firing.traffic, firing.frames[-1:])])
        if takes_s is None or waits_s is None:
            return Bound(None, _FULL)
        waits_s += _jitter_s(firing)  # the next signal comes so much sooner after a late one
        straddling = ceil((takes_s + waits_s) / period_s) - 1
        if straddling:
            worst_s = max(worst_s, straddling * period_s + waits_s)
    return Bound(worst_s)


def _jitter_s(firing: Firing) -> float:
    """Of the signal's producer, where it is declared [s]."""
    known = () if firing.traffic is None else firing.traffic.messages
    signals = {frame.can_id for frame in firing.frames[-1:]}
    return max((one.jitter_s for one in known if one.can_id in signals), default=0.0)


def _signals(members: Sequence[Member]) -> Bound:
    """Not all latch by the first signal of their trigger."""
    if len({one.offer.signals for one in members}) == 1:
        return Bound(0.0)
    known = [one.offer.signal_s for one in members if one.offer.signal_s is not None]
    if len(known) < len(members):
        return _none(members, lambda one: one.signal_s is None, lambda one: one.no_firing_bound)
    return Bound(max(late for _, late in known) - min(early for early, _ in known))


def _sum(*bounds: Bound) -> Bound:
    total_s = 0.0
    for one in bounds:
        if one.value_s is None:
            return one
        total_s += one.value_s
    return Bound(total_s)


def _none(
    members: Sequence[Member],
    lacks: Callable[[SyncOffer], bool],
    why: Callable[[SyncOffer], str],
) -> Bound:
    first = next(one for one in members if lacks(one.offer))
    reason = why(first.offer) or "its hardware does not tell how long that takes"
    return Bound(None, f"{first.name}: {reason}")
