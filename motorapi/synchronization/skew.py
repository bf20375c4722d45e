"""Predicted skew: bounds on the time between begins and ends of motors.

There are three figures, each based on the one before it:

- *Command skew*: between the instants at which the first and the last drive latch their commands.
  One signal for all: 0. Several triggers, fired in turn: the maximum time of the later ones on the
  bus (`motorhil.motorapi.synchronization.firing_time.longest_s`), from the latch of the
  first drive.
- *Start skew*: also, between the latch and the start of motion, each drive waits for its own
  profile tick, at most one.
- *End skew*: also, motions differ slightly in duration: they are rounded to hardware units, and
  timed by a clock with an error of some ppm; each ends at a profile tick.

If a value is unknown there is no bound, and the reason is reported.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import ceil
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.synchronization.firing_time import longest_s
from motorhil.motorapi.synchronization.offer import Firing, SyncOffer

_PPM: Final = 1e-6
_FULL: Final = "higher priority traffic, or frames queued with it, may delay the start for ever"


@final
@frozen
class Bound:
    """An upper bound on a time [s]; or None, with the reason."""

    value_s: float | None
    reason: str = ""


@final
@frozen
class Member:
    """One motor of a group.

    Attributes:
        name: name of the motor.
        offer: capability of its hardware.
        duration_s: duration of its quantised motion [s]; None: it does not end by itself.
    """

    name: str
    offer: SyncOffer
    duration_s: float | None = None


def command_bound(members: Sequence[Member]) -> Bound:
    """Return a bound on the time between the first and the last latch."""
    if len(members) < 2:
        return Bound(0.0)
    triggers = _triggers(members)
    straddling = _straddling(triggers)
    if len(triggers) > 1:  # all latches happen before the last trigger has been fired
        return _sum(_one_after_another(triggers), straddling)
    return _sum(straddling, _signals(members))


def start_bound(members: Sequence[Member], command: Bound) -> Bound:
    """Return a bound on the time between the first and the last start of motion."""
    if len(members) < 2:
        return Bound(0.0)
    known = [one.offer.latency_s for one in members if one.offer.latency_s is not None]
    if len(known) < len(members):
        return _none(members, lambda one: one.latency_s is None, lambda one: one.no_start_bound)
    longest = max(latency_s[1] for latency_s in known)
    return _sum(command, Bound(longest - min(latency_s[0] for latency_s in known)))


def end_bound(members: Sequence[Member], start: Bound) -> Bound:
    """Return a bound on the time between the first and the last end of motions that end."""
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
    """Return the members of each trigger, in the order of firing."""
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
            None, "higher priority traffic, or frames queued with it, may delay the start for ever"
        )
    return Bound(took_s)


def _straddling(triggers: Sequence[Sequence[Member]]) -> Bound:
    """Bound the delay by a signal between the frames of a burst."""
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
        waits_s += _jitter_s(firing)  # the next signal may come this much sooner after a late one
        straddling = ceil((takes_s + waits_s) / period_s) - 1
        if straddling:
            worst_s = max(worst_s, straddling * period_s + waits_s)
    return Bound(worst_s)


def _jitter_s(firing: Firing) -> float:
    """Return the declared jitter of the producer of the signal [s]."""
    known = () if firing.traffic is None else firing.traffic.messages
    signals = {frame.can_id for frame in firing.frames[-1:]}
    return max((one.jitter_s for one in known if one.can_id in signals), default=0.0)


def _signals(members: Sequence[Member]) -> Bound:
    """Bound the delay between motors that latch by different signals of their trigger."""
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
    reason = why(first.offer) or "its hardware does not specify that time"
    return Bound(None, f"{first.name}: {reason}")
