"""Groups of two motors, and the true times of each member's motion.

Where instants are compared, both distances have the same length. Then both motors make the same
profile, and reach each share of it at the same time.
"""

from collections.abc import Sequence
from math import sqrt
from typing import Final

from harness.conformance.bench import RigProtocol
from harness.conformance.clause import expect
from harness.conformance.motions import SAMPLE_S, long_move, place, rest_for
from motorapi import ControlMode, Motor, MotorGroup, TrapezoidalTrajectory

FINE_S: Final = 0.001
BEGUN: Final = 0.05  # share of the distance
_PATIENCE_S: Final = 10.0


def pair_of(bench: RigProtocol, *ways: float) -> MotorGroup:
    """Return a group of the bench's first motors, with a trajectory set for each distance."""
    group = MotorGroup(*bench.motors[: len(ways)])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(*(TrapezoidalTrajectory(way) for way in ways))
    return group


def places(bench: RigProtocol, group: MotorGroup) -> list[float]:
    """Return the positions of all members [U]."""
    return [place(bench, motor) for motor in group]


class Course:
    """Records the positions of a group's members from its creation; times are in ns."""

    def __init__(self, bench: RigProtocol, group: MotorGroup, period_s: float = FINE_S) -> None:
        self._bench, self._group = bench, group
        self.seen: list[tuple[int, list[float]]] = []
        self._timer = bench.runtime.every(period_s, self._look)
        self._look()

    def _look(self) -> None:
        self.seen.append((self._bench.runtime.now_ns(), places(self._bench, self._group)))

    def end(self) -> None:
        """Stop recording."""
        self._timer.cancel()
        self._look()

    def when(self, member: int, share: float, way: float) -> float | None:
        """Return the interpolated time when a member had made a share of its way [ns], or None."""
        goal = share * way
        begin = self.seen[0][1][member]
        before_ns, before = self.seen[0][0], 0.0
        for now_ns, positions in self.seen:
            made = positions[member] - begin
            if (made - goal) * (1.0 if way > 0.0 else -1.0) >= 0.0:
                part = 1.0 if made == before else (goal - before) / (made - before)
                return before_ns + part * (now_ns - before_ns)
            before_ns, before = now_ns, made
        return None

    def skew_s(self, share: float, ways: Sequence[float]) -> float | None:
        """Return the time between the first and the last member at this share of its way [s]."""
        times = [self.when(member, share, way) for member, way in enumerate(ways)]
        known = [time for time in times if time is not None]
        return (max(known) - min(known)) / 1e9 if len(known) == len(times) else None


def looking_error_s(bench: RigProtocol, way: float, share: float) -> float:
    """Return the largest error of the difference of two times from `Course.when` [s]."""
    model = bench.motor.model
    slowest = min(model.acceleration_max, model.deceleration)
    speed = min(sqrt(2.0 * slowest * share * abs(way)), model.velocity_max)
    return 2.0 * bench.facts.following / speed + 2.0 * FINE_S


def run_to_the_end(bench: RigProtocol, group: MotorGroup) -> None:
    """Wait until the group is done, and until the motors have settled."""
    group.wait_until_done(_PATIENCE_S)
    rest_for(bench, 10.0 * SAMPLE_S)


def half(bench: RigProtocol) -> float:
    """Return half the distance of a long move [U]."""
    return 0.5 * long_move(bench)


def ways_of(*ways: float) -> list[TrapezoidalTrajectory]:
    """Return a trajectory for each distance."""
    return [TrapezoidalTrajectory(way) for way in ways]


def expect_made(
    bench: RigProtocol,
    group: MotorGroup,
    before: list[float],
    ways: tuple[float, ...],
    what: str,
) -> None:
    """Check that each member has moved by its distance."""
    for motor, was, way in zip(group, before, ways, strict=True):
        moved, unit = place(bench, motor) - was, motor.model.unit
        expect(
            abs(moved - way) <= bench.facts.window,
            f"{what}: {motor.name} moved {moved:g} {unit} of {way:g} {unit}",
        )
