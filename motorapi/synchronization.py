"""How well several motors can begin and end together: what is possible, and what it was.

Starting is split in two. *Arming* brings a motor to where one more signal starts its motion, and
is over only when the hardware has confirmed it (on CAN: seen on the wire). *Firing* is that
signal. Motors whose hardware can share one signal (drives on one CAN bus: one SYNC) offer the same
trigger group and are fired by one trigger; the others one after another.
"""

from collections.abc import Hashable
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
