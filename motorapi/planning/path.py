"""The straight line of phase-synchronised motors, and deviations from it.

The line leads from the common start to the common target. At any instant the group is at a point in
joint space, and should be at the nearest point of the line. The offset of each motor from there is
its deviation, independent of time: a common delay is not a deviation. "Nearest" needs a measure
common to rotary and linear motors: the time that each needs at its own maximum velocity. With D_i
the distance, x_i the distance covered and v_i the maximum velocity of motor i:

    fraction of the line    s = (sum D_i x_i / v_i²) / (sum D_i² / v_i²)
    deviation of motor i    x_i - s D_i
"""

from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.errors import MotorError
from motorhil.motorapi.execution import Started
from motorhil.motorapi.generation import Trapezoid, shortest
from motorhil.motorapi.logical_motor import LogicalMotor
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.runtime.api import Registration
from motorhil.motorapi.state import MotorState
from motorhil.motorapi.synchronization.quality import PathDeviation

LOOK_PERIOD_S: Final = 0.005
"""The period of the check for new measurements [s]."""

_KEPT: Final = 8


@final
@frozen
class Line:
    """A straight line in joint space, for motors with a distance to cover.

    Attributes:
        starts: initial position of each motor [U].
        ways: distance of each motor, signed, not 0 [U].
        speeds: maximum velocity of each motor [U/s]: the measure of nearness.
    """

    starts: tuple[float, ...]
    ways: tuple[float, ...]
    speeds: tuple[float, ...]

    def deviations(self, positions: Sequence[float]) -> list[float]:
        """Return the offset of each motor from the nearest point of the line, signed [U]."""
        scaled = [way / speed for way, speed in zip(self.ways, self.speeds, strict=True)]
        longest = max(abs(way) for way in scaled)
        weights = [way / longest for way in scaled]  # so that no square vanishes or overflows
        made = [position - start for position, start in zip(positions, self.starts, strict=True)]
        times = [way / speed / longest for way, speed in zip(made, self.speeds, strict=True)]
        total = sum(weight * weight for weight in weights)
        part = sum(weight * time for weight, time in zip(weights, times, strict=True)) / total
        return [way - part * whole for way, whole in zip(made, self.ways, strict=True)]

    def without(self, place: int) -> "Line":
        """Return the line of the other motors."""
        return Line(
            self.starts[:place] + self.starts[place + 1 :],
            self.ways[:place] + self.ways[place + 1 :],
            self.speeds[:place] + self.speeds[place + 1 :],
        )


def line_of(started: Sequence[Started]) -> Line:
    """Return the line of the quantised motions, all with a distance to cover."""
    return Line(
        tuple(one.quantised.start for one in started),
        tuple(one.quantised.distance for one in started),
        tuple(one.motor.model.velocity_max for one in started),
    )


def moving(started: Sequence[Started]) -> list[Started]:
    """Return the motors with a distance to cover, within the resolution of the hardware."""
    return [one for one in started if one.quantised.distance != 0.0]


def predicted(started: Sequence[Started]) -> list[float]:
    """Return the maximum deviation of each motor by rounding to hardware units [U].

    The result is exact: between the corners of all profiles the deviations are parabolas with known
    extrema. Effects of servos, clocks and different start times are not included.

    Args:
        started: phase-synchronised, all with a distance to cover.
    """
    profiles = [_profile(one) for one in started]
    line = line_of(started)

    def at(time_s: float) -> list[float]:
        made = [profile.position(time_s) for profile in profiles]
        return line.deviations([start + way for start, way in zip(line.starts, made, strict=True)])

    corners: set[float] = {0.0}
    for profile in profiles:
        corners |= {profile.ramp_up_s, profile.ramp_down_s, profile.duration_s}
    ordered = sorted(corners)
    worst = [0.0] * len(started)
    for begin, end in pairwise(ordered):
        first, half, last = at(begin), at(0.5 * (begin + end)), at(end)
        for place, highest in enumerate(worst):
            worst[place] = max(highest, _highest(first[place], half[place], last[place]))
    return worst


def predicted_path(
    motors: Sequence[LogicalMotor], motions: Sequence[Motion]
) -> tuple[PathDeviation, ...]:
    """Return the deviation by rounding of each motor with a distance to cover."""
    started = moving(
        [
            Started(motor, motion, motor.hooks.quantise(motion))
            for motor, motion in zip(motors, motions, strict=True)
        ]
    )
    return tuple(
        PathDeviation(one.motor.name, None, "not begun yet", predicted=most)
        for one, most in zip(started, predicted(started), strict=True)
    )


def _profile(one: "Started") -> Trapezoid:
    motion = one.quantised
    return shortest(motion.distance, motion.velocity, motion.acceleration, motion.deceleration)


def _highest(first: float, half: float, last: float) -> float:
    """Return the largest magnitude, on [0, 1], of the parabola through values at 0, 1/2 and 1."""
    highest = max(abs(first), abs(last))
    square = 2.0 * (first - 2.0 * half + last)
    slope = last - first - square
    if square != 0.0:
        top = -0.5 * slope / square
        if 0.0 < top < 1.0:
            highest = max(highest, abs(first + (slope + square * top) * top))
    return highest


@final
class PathWatch:
    """Watch over the motors of one start, which keeps their largest deviations.

    Positions of different motors are compared at one instant: that of the last sample of the motor
    with the oldest one. The others are interpolated between two of their samples. The time of a
    sample is that of its reception: its transmission delay, times the velocity, is part of the
    deviation (0.3 ms in the queue of a bus at 2 rad/s: 0.6 mrad between two motors).

    Args:
        started: phase-synchronised.
        looked: called after each check.
    """

    def __init__(self, started: Sequence[Started], looked: Callable[[], None]) -> None:
        self._started = started
        self._looked = looked
        self._members = moving(started)
        self._line = line_of(self._members)
        self._predicted = predicted(self._members)
        self._kept: list[deque[tuple[int, float]]] = [deque(maxlen=_KEPT) for _ in self._members]
        self._worst: dict[str, float] = {}
        self._age_ns: dict[str, int] = {}
        self._compared_ns = -1
        self._timer: Registration | None = None

    def begin(self) -> None:
        """Begin the periodic checks."""
        if len(self._members) > 1:
            self._timer = self._members[0].motor.runtime.every(LOOK_PERIOD_S, self._look_again)
            self.look()

    def end(self) -> None:
        """End the checks; ending again does nothing."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def leave(self, motor: LogicalMotor) -> None:
        """Remove a motor that has left the line."""
        for place, one in enumerate(self._members):
            if one.motor is motor:
                self._members = [*self._members[:place], *self._members[place + 1 :]]
                del self._kept[place]
                self._line = self._line.without(place)
                break
        if len(self._members) < 2:
            self.end()

    def _look_again(self) -> None:
        self.look()
        self._looked()

    def look(self) -> None:
        """Compare new measurements of the motors with the line."""
        for one, kept in zip(self._members, self._kept, strict=True):
            try:
                latest = one.motor.hooks.latest()
            except MotorError:  # the motor is gone: its failure is reported elsewhere
                continue
            if latest is None or latest.position is None:
                continue
            if latest.state is not MotorState.ENABLED:
                continue  # the motor has left the line; its failure is reported elsewhere
            if not kept or latest.time_ns > kept[-1][0]:
                kept.append((latest.time_ns, latest.position))
        if not self._kept or not all(self._kept):
            return
        at_ns = min(kept[-1][0] for kept in self._kept)
        if at_ns > self._compared_ns:
            self._compare(at_ns)

    def _compare(self, at_ns: int) -> None:
        found = [_interpolated(kept, at_ns) for kept in self._kept]
        positions = [sample[0] for sample in found if sample is not None]
        if len(positions) < len(found):
            return  # one motor has no earlier sample
        self._compared_ns = at_ns
        deviations = self._line.deviations(positions)
        for one, off, sample in zip(self._members, deviations, found, strict=True):
            name = one.motor.name
            self._worst[name] = max(self._worst.get(name, 0.0), abs(off))
            if sample is not None:
                self._age_ns[name] = max(self._age_ns.get(name, 0), sample[1])

    def told(self) -> tuple[PathDeviation, ...]:
        """Return the deviation of each motor, in the order of the group."""
        bound = {
            one.motor.name: most
            for one, most in zip(moving(self._started), self._predicted, strict=True)
        }
        return tuple(self._of(one.motor, bound.get(one.motor.name)) for one in self._started)

    def _of(self, motor: LogicalMotor, most: float | None) -> PathDeviation:
        if most is None:
            return PathDeviation(motor.name, None, "it has no way to go", predicted=0.0)
        source = motor.hooks.position_source()
        age_ns = self._age_ns.get(motor.name)
        return PathDeviation(
            motor.name,
            self._worst.get(motor.name),
            source,
            None if age_ns is None else age_ns / 1e9,
            predicted=most,
        )


def _interpolated(kept: deque[tuple[int, float]], at_ns: int) -> tuple[float, int] | None:
    """Return the position at an instant, and its distance to the nearer of two samples [ns]."""
    later: tuple[int, float] | None = None
    for sample in reversed(kept):
        if sample[0] <= at_ns:
            if later is None or sample[0] == at_ns:
                return sample[1], at_ns - sample[0]
            part = (at_ns - sample[0]) / (later[0] - sample[0])
            away_ns = min(at_ns - sample[0], later[0] - at_ns)
            return sample[1] + part * (later[1] - sample[1]), away_ns
        later = sample
    return None
