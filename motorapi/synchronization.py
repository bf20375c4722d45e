"""How well several motors can begin and end together: what is possible, and what it was.

Starting is split in two. *Arming* brings a motor to where one more signal starts its motion, and
is over only when the hardware has confirmed it (on CAN: seen on the wire). *Firing* is that
signal. Motors whose hardware can share one signal (drives on one CAN bus: one SYNC) offer the same
trigger group and are fired by one trigger; the others one after another.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol, final


@final
class SyncLevel(IntEnum):
    """What makes motors begin together, weakest first."""

    SEQUENTIAL = 0  # a start command for each, one after another
    TRIGGERED = 1  # one signal starts all of them
    CYCLIC = 2  # set-points at a common rate, latched by one signal


class Trigger(Protocol):
    """Starts every motion that was armed for it. Triggers that are equal are fired once."""

    def fire(self) -> None:
        """The armed motions of this trigger begin; returns when the signal was transmitted."""

    def __eq__(self, other: object, /) -> bool: ...

    def __hash__(self) -> int: ...


@final
@dataclass(frozen=True, slots=True)
class SyncOffer:
    """What one motor's hardware offers for starting together with others.

    Attributes:
        level: what it can do.
        group: motors whose offers name an equal group (a bus) are fired by one trigger.
        latency_s: shortest and longest time from `Trigger.fire` to the start of motion [s];
            None if no bound is known.
        reason: why it is not better, in words ("RPDO 1 has transmission type 255").
    """

    level: SyncLevel
    group: Hashable
    latency_s: tuple[float, float] | None
    reason: str


@final
@dataclass(frozen=True, slots=True)
class MotionTimes:
    """When a motion began and ended, as the hardware told it [ns]; None: not (yet) told."""

    started_ns: int | None
    ended_ns: int | None
    source: str
    """Where it was measured ("set-point acknowledge and target reached in TPDO 1")."""


@final
@dataclass(frozen=True, slots=True)
class SyncCapability:
    """How well a group can begin and end together, before it moves.

    Attributes:
        level: what starts it; that of the weakest member.
        start_skew_s: bound on the time between the first and the last motor's start [s]; None if
            no bound is known.
        end_skew_s: predicted time between the first and the last end [s] for the trajectories set
            now: what rounding to the hardware's units does. None if none can be started now.
        weakest: the member that keeps it from being better.
        reason: why, in words.
    """

    level: SyncLevel
    start_skew_s: float | None
    end_skew_s: float | None
    weakest: str
    reason: str


@final
@dataclass(frozen=True, slots=True)
class SyncQuality:
    """How well a group did begin and end together.

    Attributes:
        predicted_end_skew_s: from the profiles as the hardware rounded them [s].
        start_skew_s: between the first and the last motor's start as measured [s]; None until all
            of them told. A motor that has no way to go does not count.
        end_skew_s: likewise for the ends.
        times: for each motor its name, and when it began and ended and where that was measured
            (None: it does not tell).
    """

    predicted_end_skew_s: float
    start_skew_s: float | None
    end_skew_s: float | None
    times: tuple[tuple[str, MotionTimes | None], ...]


def predicted_start_skew_s(offers: Sequence[SyncOffer]) -> float | None:
    """The bound on start skew of motors fired by one trigger [s]; None if there is none.

    With several triggers one is fired after another, and how long that takes nobody promises.
    """
    if any(offer.group != offers[0].group for offer in offers):
        return None
    earliest_s: list[float] = []
    latest_s: list[float] = []
    for offer in offers:
        if offer.latency_s is None:
            return None
        earliest_s.append(offer.latency_s[0])
        latest_s.append(offer.latency_s[1])
    return max(latest_s) - min(earliest_s)


def spread_s(times_ns: Sequence[int | None]) -> float | None:
    """Between the first and the last of these [s]; None if one is missing, or there is none."""
    known = [time_ns for time_ns in times_ns if time_ns is not None]
    if not known or len(known) < len(times_ns):
        return None
    return (max(known) - min(known)) / 1e9
