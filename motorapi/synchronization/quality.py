"""Synchronization of several motors: capability before, quality after a start."""

from collections.abc import Sequence
from enum import Enum, IntEnum
from typing import final

from motorhil.frozen import frozen
from motorhil.motorapi.commands import as_number
from motorhil.motorapi.errors import UsageError


@final
class SyncLevel(IntEnum):
    """The means of a common start, weakest first."""

    SEQUENTIAL = 0  # a start command for each motor, in turn
    TRIGGERED = 1  # one signal starts all motors
    CYCLIC = 2  # set-points at a common rate, latched by one signal


@final
class Synchronization(Enum):
    """The common property of the trajectories of a group."""

    TIME = "time"  # they begin and end together
    PHASE = "phase"  # also, at every instant each has covered the same fraction of its distance
    NONE = "none"  # they begin together; each is as fast as possible


@final
class FaultReaction(Enum):
    """The reaction of the other motors when one motor of a group fails."""

    TOGETHER = "together"  # they slow down along the path, and come to rest together
    EACH = "each"  # each slows down as fast as its limits allow
    NONE = "none"  # they continue


@final
@frozen
class MotionTimes:
    """Begin and end of a motion, as reported by the hardware.

    Attributes:
        started_ns: time of its begin [ns]; None: not (yet) reported.
        ended_ns: time of its end [ns]; None: not (yet) reported.
        source: origin of the times ("set-point acknowledge and target reached in TPDO 1").
        latched_ns: time of its start signal on the wire [ns]; None: unknown.
        straddles: number of signals that separated frames which belong between two signals.
    """

    started_ns: int | None
    ended_ns: int | None
    source: str
    latched_ns: int | None = None
    straddles: int = 0


@final
@frozen
class PathDeviation:
    """The deviation of one motor from the common path of its group.

    Attributes:
        motor: its name.
        deviation: largest deviation found, either way [rad or m]; None: not measured.
        source: origin of the positions ("position in TPDO 1, 183h").
        age_s: maximum time between the instant of comparison and the nearer sample [s], because
            positions are interpolated; None: not measured.
        predicted: maximum deviation by rounding to hardware units alone [rad or m].
    """

    motor: str
    deviation: float | None
    source: str
    age_s: float | None = None
    predicted: float | None = None


@final
@frozen
class SyncCapability:
    """The synchronization capability of a group, before it moves.

    If a bound is None, the matching text gives the reason.

    Attributes:
        level: the means of the start; that of the weakest member.
        command_skew_s: bound on the time between the instants at which the first and the last motor
            latch their commands [s]; 0 if one signal starts all.
        start_skew_s: bound on the time between the first and the last start of motion [s].
        end_skew_s: bound on the time between the first and the last end [s], with the present
            settings: start skew, error of the drives' clocks in that time, rounding and profile
            ticks.
        weakest: the member that limits the level.
        reason: its reason, in words.
        no_command_bound: reason if `command_skew_s` is None; else "".
        no_start_bound: reason if `start_skew_s` is None; else "".
        no_end_bound: reason if `end_skew_s` is None; else "".
        path: for phase-synchronised motors with a distance to cover, the deviation of each from the
            straight line by rounding; else empty.
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
@frozen
class SyncQuality:
    """The synchronization quality of a group after a start.

    Attributes:
        predicted_start_skew_s: bound on the start skew, as in `SyncCapability`, for motors with a
            distance to cover [s]; None without a bound.
        predicted_end_skew_s: from the profiles as rounded by the hardware [s].
        start_skew_s: measured time between the first and the last start [s]; None until all are
            reported. Motors without a distance to cover do not count.
        end_skew_s: measured time between the first and the last end [s], likewise.
        times: for each motor its name, and begin and end of its motion with their origin (None: not
            reported).
        command_skew_s: time between the start signals on the wire [s]; None until all are reported.
        path: for each motor its deviation from the common path; empty unless phase-synchronised.
        straddles: number of signals that separated frames which belong between two signals.
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
    """Return the time between the first and the last [s]; None if one, or all, are missing."""
    known = [time_ns for time_ns in times_ns if time_ns is not None]
    if not known or len(known) < len(times_ns):
        return None
    return (max(known) - min(known)) / 1e9


@final
class SynchronizationError(UsageError):
    """A group that cannot begin as closely together as its start requested.

    Attributes: capability (`SyncCapability`: what is possible, and the reason), asked (the request,
    in words).
    """

    def __init__(self, *, capability: SyncCapability, asked: str, found: str) -> None:
        self.capability = capability
        self.asked = asked
        super().__init__(f"start refused: {asked} was requested, {found}")


def check_asked(require: object, max_skew_s: object) -> None:
    """Raise UsageError if a condition is not valid."""
    if require is not None and not isinstance(require, SyncLevel):
        raise UsageError(f"require = {require!r}: give a SyncLevel, or None")
    if max_skew_s is not None and not as_number(max_skew_s) >= 0.0:
        raise UsageError(f"max_skew_s = {max_skew_s!r}: must be a number of seconds >= 0")


def require_synchronised(
    capability: SyncCapability, require: SyncLevel | None, max_skew_s: float | None
) -> None:
    """Require that a start can meet the conditions.

    Raises:
        SynchronizationError: it cannot, or no bound is known.
    """
    whose = f"because of {capability.weakest}: {capability.reason}"
    if require is not None and capability.level < require:
        raise SynchronizationError(
            capability=capability,
            asked=f"a start that is at least {require.name}",
            found=f"and it is {capability.level.name} {whose}",
        )
    if max_skew_s is None:
        return
    asked = f"a start skew of at most {max_skew_s:g} s"
    if capability.start_skew_s is None:
        why = capability.no_start_bound or whose
        raise SynchronizationError(
            capability=capability, asked=asked, found=f"and there is no bound: {why}"
        )
    if capability.start_skew_s > max_skew_s:
        raise SynchronizationError(
            capability=capability,
            asked=asked,
            found=f"and it may be {capability.start_skew_s:g} s {whose}",
        )
