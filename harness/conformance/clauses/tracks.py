"""Tracks: true positions of motors over time, to compare instants and reported positions with.

Where instants of a group are compared, its members move the same distance. Then they make the same
profile, and reach each share of it at the same time. U is the unit of position, rad or m.
"""

from collections.abc import Iterable, Sequence
from math import cbrt, sqrt
from typing import Final

from motorhil.harness.conformance.bench import RigProtocol
from motorhil.harness.conformance.clause import expect
from motorhil.harness.conformance.clauses.demands import jerk_of, least_s, shortest, when_s
from motorhil.harness.conformance.clauses.helpers import FINE_S, position_of, reached
from motorhil.motorapi import Motor

BEGUN: Final = 0.05
"""The share of its distance after which a motion has begun."""
_AGE_S: Final = 0.02
"""The largest age of a measured position: two periods of a usual status message [s]."""


def positions_of(bench: RigProtocol, group: Iterable[Motor]) -> list[float]:
    """Return the positions of all members [U]."""
    return [position_of(bench, motor) for motor in group]


class GroupPositions:
    """Records the positions of a group's members from its creation; times are in ns."""

    def __init__(
        self, bench: RigProtocol, group: Iterable[Motor], period_s: float = FINE_S
    ) -> None:
        self._bench, self._group = bench, tuple(group)
        self.samples: list[tuple[int, list[float]]] = []
        self._timer = bench.runtime.every(period_s, self._sample)
        self._sample()

    def _sample(self) -> None:
        self.samples.append((self._bench.runtime.now_ns(), positions_of(self._bench, self._group)))

    def end(self) -> None:
        """Stop recording."""
        self._timer.cancel()
        self._sample()

    def when(self, member: int, share: float, way: float) -> float | None:
        """Return the interpolated time when a member had made a share of its way [ns], or None."""
        goal = share * way
        begin = self.samples[0][1][member]
        before_ns, before = self.samples[0][0], 0.0
        for now_ns, positions in self.samples:
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


def when_made_s(motor: Motor, way: float, share: float) -> float:
    """Return the time after which the shortest move has made this share of its way [s]."""
    model, size = motor.model, abs(way)
    limits = model.velocity_max, model.acceleration_max, model.deceleration, jerk_of(motor)
    return when_s(shortest(size, *limits), share * size, least_s(size, *limits))


def sampling_error_s(bench: RigProtocol, way: float, share: float) -> float:
    """Return the largest error of the difference of two times from `GroupPositions.when` [s]."""
    model, made = bench.motor.model, share * abs(way)
    slowest = min(model.acceleration_max, model.deceleration)
    speed = min(sqrt(2.0 * slowest * made), model.velocity_max)
    bent = cbrt(4.5 * jerk_of(bench.motor) * made**2)  # j t³/6 makes the share, at j t²/2
    return 2.0 * bench.facts.following / min(speed, bent) + 2.0 * FINE_S


class PositionWatch:
    """Compares reported positions of a motor with its true ones, from its creation."""

    def __init__(self, bench: RigProtocol, motor: Motor) -> None:
        self._bench, self._motor = bench, motor
        self._reported, self._true = motor.position(), bench.true_position(motor)
        self._track = GroupPositions(bench, [motor])

    def read(self, when: str) -> None:
        """Check that the reported position is a true one of the last moment."""
        bench, motor = self._bench, self._motor
        asked_ns = bench.runtime.now_ns()
        reported = motor.position() - self._reported
        oldest_ns = asked_ns - round(1e9 * (_AGE_S + max(map(abs, bench.facts.latency_s))))
        samples = self._track.samples
        older = [at for at_ns, (at,) in samples if at_ns < oldest_ns][-1:]
        true = [at for at_ns, (at,) in samples if at_ns >= oldest_ns]
        true = [at - self._true for at in (*older, *true, bench.true_position(motor))]
        spare = bench.facts.window + 2.0 * (motor.model.resolution or 0.0)
        unit = motor.model.unit
        expect(
            min(true) - spare <= reported <= max(true) + spare,
            f"{when}: position() reported {reported:.6g} {unit} from the start; in the last"
            f" {(bench.runtime.now_ns() - oldest_ns) / 1e9:.3f} s it was {min(true):.6g} to"
            f" {max(true):.6g} {unit}",
        )

    def end(self, way: float) -> None:
        """Stop comparing; the motor must have moved by this distance, or more."""
        self._track.end()
        moved = abs(self._bench.true_position(self._motor) - self._true)
        reached(moved >= way, f"a motion of {way:g} {self._motor.model.unit}")
