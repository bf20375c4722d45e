"""How well several motors can begin and end together: what is possible, and what it was.

Starting is split in two. *Arming* brings a motor to where one more signal starts its motion, and
is over only when the hardware has confirmed it (on CAN: seen on the wire). *Firing* is that
signal. Motors whose hardware can share one signal (drives on one CAN bus: one SYNC) offer the same
trigger group and are fired by one trigger; the others one after another.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Protocol, final

from motorapi.bus_timing import Firing, OneFrame


@final
class SyncLevel(IntEnum):
    """What makes motors begin together, weakest first."""

    SEQUENTIAL = 0  # a start command for each, one after another
    TRIGGERED = 1  # one signal starts all of them
    CYCLIC = 2  # set-points at a common rate, latched by one signal


@final
class Synchronization(Enum):
    """What the trajectories of a group have in common."""

    TIME = "time"  # they begin and end together
    PHASE = "phase"  # and at every instant each has gone the same part of its way
    NONE = "none"  # they begin together; each is as fast as it can be


@final
class FaultReaction(Enum):
    """What becomes of the others when one motor of a group fails."""

    TOGETHER = "together"  # they slow down along the path, and come to rest together
    EACH = "each"  # each slows down as fast as it may
    NONE = "none"  # they go on


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
        latency_s: shortest and longest time from the instant at which the drive has latched its
            command to the start of motion [s]; None if no bound is known.
        reason: why it is not better, in words ("RPDO 1 has transmission type 255").
        firing: what `Trigger.fire` takes; None if no bound is known.
        signals: how many signals after the trigger's first one the command is latched by: a
            streamed set-point's first step by the second SYNC, 1.
        signal_s: shortest and longest time from the trigger's first signal to that one [s]; None
            if no bound is known. Of motors with one trigger and equal `signals` it is the same.
        burst: the frame that goes out with those of the others just after a signal, where signals
            come every `period_s` [s] and cannot be waited with; None: it was armed before.
        oscillator_ppm: how far the drive's clock may be off, either way [1e-6]; None: not told.
        end_s: shortest and longest time from the end of the motion as planned, by the drive's own
            clock, to its end [s]; None if no bound is known.
        no_firing_bound: why there is no bound on `firing` or `signal_s`, in words; else "".
        no_start_bound: likewise, of `latency_s`.
        no_end_bound: likewise, of `oscillator_ppm` and `end_s`.
    """

    level: SyncLevel
    group: Hashable
    latency_s: tuple[float, float] | None
    reason: str
    firing: Firing | None = None
    signals: int = 0
    signal_s: tuple[float, float] | None = (0.0, 0.0)
    burst: OneFrame | None = None
    period_s: float | None = None
    oscillator_ppm: float | None = None
    end_s: tuple[float, float] | None = None
    no_firing_bound: str = ""
    no_start_bound: str = ""
    no_end_bound: str = ""


@final
@dataclass(frozen=True, slots=True)
class MotionTimes:
    """When a motion began and ended, as the hardware told it.

    Attributes:
        started_ns: when it began [ns]; None: not (yet) told.
        ended_ns: when it ended [ns]; None: not (yet) told.
        source: where it was measured ("set-point acknowledge and target reached in TPDO 1").
        latched_ns: when the signal that started it was on the wire [ns]; None: not known.
        straddles: how many signals came between what should have gone between two of them.
    """

    started_ns: int | None
    ended_ns: int | None
    source: str
    latched_ns: int | None = None
    straddles: int = 0


@final
@dataclass(frozen=True, slots=True)
class PathDeviation:
    """How far one motor was from where the group's common path had it.

    Attributes:
        motor: its name.
        deviation: the largest found, either way [rad or m]; None: nothing was measured.
        source: where it was measured ("position in TPDO 1, 183h").
        age_s: how far from the instant of comparing such a sample was at most [s]: positions in
            between are interpolated; None: nothing was measured.
        predicted: what rounding to the hardware's units alone makes of it, at most [rad or m].
    """

    motor: str
    deviation: float | None
    source: str
    age_s: float | None = None
    predicted: float | None = None


@final
@dataclass(frozen=True, slots=True)
class SyncCapability:
    """How well a group can begin and end together, before it moves.

    A bound that is None is no bound at all; the text beside it says why.

    Attributes:
        level: what starts it; that of the weakest member.
        command_skew_s: bound on the time between the instants at which the first and the last
            motor latch their commands [s]; 0 where one signal starts all.
        start_skew_s: bound on the time between the first and the last motor's start of motion [s].
        end_skew_s: bound on the time between the first and the last end [s], for what is set now:
            start skew, error of the drives' clocks in that time, rounding and profile ticks.
        weakest: the member that keeps it from being better.
        reason: why, in words.
        no_command_bound: why `command_skew_s` is None; else "".
        no_start_bound: why `start_skew_s` is None; else "".
        no_end_bound: why `end_skew_s` is None; else "".
        path: of phase-synchronised motors with a way to go, how far rounding takes each from the
            straight line; else empty.
    """

    level: SyncLevel
    command_skew_s: float | None
    start_skew_s: float | None
    end_skew_s: float | None
    weakest: str
    reason: str
    no_command_bound: str = ""
    no_start_bound: str = ""
    no_end_bound: str = ""
    path: tuple[PathDeviation, ...] = ()


@final
@dataclass(frozen=True, slots=True)
class SyncQuality:
    """How well a group did begin and end together.

    Attributes:
        predicted_start_skew_s: bound on it, as `SyncCapability` has it, of those motors that have a
            way to go [s]; None: there is none.
        predicted_end_skew_s: from the profiles as the hardware rounded them [s].
        start_skew_s: between the first and the last motor's start as measured [s]; None until all
            of them told. A motor that has no way to go does not count.
        end_skew_s: likewise for the ends.
        times: for each motor its name, and when it began and ended and where that was measured
            (None: it does not tell).
        command_skew_s: between the instants at which the signals that started them were on the
            wire [s]; None until all of them told.
        path: for each motor how far it was from the common path; empty: only phase-synchronised
            motors have one.
        straddles: how many signals came between what should have gone between two of them.
    """

    predicted_start_skew_s: float | None
    predicted_end_skew_s: float
    start_skew_s: float | None
    end_skew_s: float | None
    times: tuple[tuple[str, MotionTimes | None], ...]
    command_skew_s: float | None = None
    path: tuple[PathDeviation, ...] = ()
    straddles: int = 0


def spread_s(times_ns: Sequence[int | None]) -> float | None:
    """Between the first and the last of these [s]; None if one is missing, or there is none."""
    known = [time_ns for time_ns in times_ns if time_ns is not None]
    if not known or len(known) < len(times_ns):
        return None
    return (max(known) - min(known)) / 1e9
