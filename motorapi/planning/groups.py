"""Planning of common trajectories: common duration, or common path.

*Time*: each motor keeps its own ramps, and all take as long as the slowest. *Phase*: all share one
profile, each scaled by its distance, so that at every instant each motor has covered the same
fraction. This is a straight line in joint space, with proportional velocities and equal times of
acceleration. With distances D_i and limits v_i, a_i, d_i the fastest such profile over distance 1
has

    v = min v_i / |D_i|    a = min a_i / |D_i|    d = min d_i / |D_i|

and motor i has v |D_i|, a |D_i|, d |D_i|. Limits are used as rounded by the hardware, and each
drive rounds the result once more; `motorhil.motorapi.planning.path` computes the effect on the
line.

Source: field practice (Ruckig, `Synchronization::Phase`); the closed form follows from Biagiotti &
Melchiorri (2008), ch. 3, for one profile over distance 1.
"""

from collections.abc import Sequence
from dataclasses import replace
from sys import float_info
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import LimitError, UnsupportedError, UsageError
from motorhil.motorapi.generation import shortest, stretched
from motorhil.motorapi.logical_motor import LogicalMotor
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.planning import single_axis as planning
from motorhil.motorapi.planning.limits import ROUNDING
from motorhil.motorapi.synchronization.quality import FaultReaction, Synchronization
from motorhil.motorapi.trajectory import ComplexTrajectory, has_moving_ends

_LEAST: Final = float_info.min


@final
@frozen
class Common:
    """The common properties of the motions of a group.

    Attributes:
        synchronization: of their trajectories.
        reaction: of the others to a failure.
    """

    synchronization: Synchronization = Synchronization.TIME
    reaction: FaultReaction = FaultReaction.EACH

    def check(self) -> None:
        """Check that both properties are compatible.

        Raises:
            UsageError: a stop along the path requires a common path.
        """
        together = self.reaction is FaultReaction.TOGETHER
        if together and self.synchronization is not Synchronization.PHASE:
            raise UsageError(
                "fault_reaction TOGETHER stops along the common path, and only phase-synchronised"
                f" motors have one; synchronization is {self.synchronization.name}: set it to"
                " PHASE, or fault_reaction to EACH"
            )


TIME: Final = Common()


def synchronised(
    motors: Sequence[LogicalMotor], motions: Sequence[Motion], common: Common
) -> list[Motion]:
    """Return the motions of one start with the common properties.

    Raises:
        UsageError: they cannot have these properties.
    """
    for motor, motion in zip(motors, motions, strict=True):
        if has_moving_ends(motion.trajectory):
            raise UnsupportedError(
                motor=motor.name,
                feature="a trajectory that does not begin and end at rest in a group",
                supported="it for one motor",
            )
    if common.synchronization is Synchronization.PHASE:
        return _in_phase(motors, motions, common)
    if common.synchronization is Synchronization.NONE:
        return list(motions)
    return _common_duration(motors, motions)


def _common_duration(motors: Sequence[LogicalMotor], motions: Sequence[Motion]) -> list[Motion]:
    """Give every trajectory the duration of the slowest motor, after hardware rounding."""
    timed = [place for place, motion in enumerate(motions) if motion.duration_s is not None]
    result = list(motions)
    if not timed:
        return result
    rounded = {place: motors[place].hooks.quantise(motions[place]) for place in timed}
    shortest_s = {place: planning.duration_of(rounded[place]) for place in timed}
    asked = _asked(motors, motions)
    duration_s = asked[0] if asked else max(shortest_s.values())
    for place in timed:
        motion = motions[place]
        if _fixed_duration_s(motion) is not None:
            continue  # planned for that very duration
        if shortest_s[place] == duration_s:
            continue
        if asked and shortest_s[place] > duration_s:
            raise _too_short(motors[place], asked, shortest_s[place], "")
        stretched = planning.stretch(rounded[place], duration_s)
        result[place] = replace(stretched, start=motion.start, target=motion.target)
    return result


def _asked(motors: Sequence[LogicalMotor], motions: Sequence[Motion]) -> tuple[float, str] | None:
    """Return the duration requested by trajectories [s] and the first such motor, or None."""
    asked: dict[float, str] = {}
    for motor, motion in zip(motors, motions, strict=True):
        fixed_s = _fixed_duration_s(motion)
        if fixed_s is not None:
            asked.setdefault(fixed_s, motor.name)
    if len(asked) > 1:
        several = ", ".join(f"{duration:g} s for {name}" for duration, name in asked.items())
        raise UsageError(f"motors of a group end together: durations differ ({several})")
    return next(iter(asked.items())) if asked else None


def _fixed_duration_s(motion: Motion) -> float | None:
    """Return the duration requested by its trajectory [s], or None for the shortest."""
    trajectory = motion.trajectory
    if isinstance(trajectory, ComplexTrajectory):
        return motion.duration_s
    return None if trajectory is None else trajectory.duration_s


def _too_short(
    motor: LogicalMotor, asked: tuple[float, str], shortest_s: float, why: str
) -> LimitError:
    return LimitError(
        motor=motor.name,
        quantity="duration",
        value=asked[0],
        low=shortest_s,
        high=None,
        unit="s",
        reason=f"{why}requested by the trajectory of {asked[1]}",
    )


# ---- phase ----


@final
@frozen
class Move:
    """One motor's part of a straight line: distance > 0 and limits, as magnitudes [U]."""

    way: float
    velocity: float
    acceleration: float
    deceleration: float


def proportional(
    moves: Sequence[Move], duration_s: float | None = None
) -> tuple[float, list[Move]]:
    """Return the duration [s] of the fastest common profile, and the part of each motor.

    Args:
        moves: at least one; distances and limits finite, > 0. Each has its own unit of length.
        duration_s: requested duration [s]; None, or less than possible: the shortest.
    """
    longest = max(move.way for move in moves)
    parts = [move.way / longest for move in moves]
    pairs = list(zip(moves, parts, strict=True))
    # Division by a tiny part may give inf: that motor limits nothing.
    velocity = min(_divided(move.velocity, part) for move, part in pairs)
    acceleration = min(_divided(move.acceleration, part) for move, part in pairs)
    deceleration = min(_divided(move.deceleration, part) for move, part in pairs)
    profile = shortest(longest, velocity, acceleration, deceleration)
    if duration_s is not None and duration_s > profile.duration_s:
        profile = stretched(longest, duration_s, acceleration, deceleration)
        velocity = min(velocity, profile.peak)
    made = [
        Move(
            move.way,
            max(min(velocity * part, move.velocity), _LEAST),
            max(min(acceleration * part, move.acceleration), _LEAST),
            max(min(deceleration * part, move.deceleration), _LEAST),
        )
        for move, part in pairs
    ]
    return profile.duration_s, made


def _divided(limit: float, part: float) -> float:
    return limit / part if part > _LEAST else float("inf")


def _in_phase(
    motors: Sequence[LogicalMotor], motions: Sequence[Motion], common: Common
) -> list[Motion]:
    """Put all motions on one straight line, with equal fractions covered at every instant."""
    for motor, motion in zip(motors, motions, strict=True):
        _require_line(motor, motion)
    limited: list[Motion] = []
    rounded: list[Motion] = []
    for motor, motion in zip(motors, motions, strict=True):
        bounds = planning.bounds_of(motor.model, motion)
        limited.append(
            replace(
                motion,
                velocity=bounds.velocity,
                acceleration=bounds.acceleration,
                deceleration=bounds.deceleration,
                duration_s=None,
            )
        )
        rounded.append(motor.hooks.quantise(limited[-1]))
    moving = [place for place, motion in enumerate(rounded) if motion.distance != 0.0]
    asked = _asked(motors, motions)
    result = [replace(motion, duration_s=0.0) for motion in limited]
    if not moving:
        return result
    moves = [_move_of(rounded[place]) for place in moving]
    fastest_s, _ = proportional(moves)
    if asked and asked[0] < fastest_s * (1.0 - ROUNDING):
        slowest = motors[moving[_slowest(moves)]]
        raise _too_short(slowest, asked, fastest_s, "for the whole group on a straight line; ")
    duration_s, made = proportional(moves, asked[0] if asked else None)
    for place, move in zip(moving, made, strict=True):
        result[place] = replace(
            limited[place],
            velocity=move.velocity,
            acceleration=move.acceleration,
            deceleration=move.deceleration,
            duration_s=duration_s,
            stop_deceleration=move.deceleration
            if common.reaction is FaultReaction.TOGETHER
            else rounded[place].deceleration,
        )
    return result


def _move_of(motion: Motion) -> Move:
    return Move(abs(motion.distance), motion.velocity, motion.acceleration, motion.deceleration)


def _slowest(moves: Sequence[Move]) -> int:
    """Return the index of the slowest motion."""
    durations_s = [
        shortest(move.way, move.velocity, move.acceleration, move.deceleration).duration_s
        for move in moves
    ]
    return durations_s.index(max(durations_s))


def _require_line(motor: LogicalMotor, motion: Motion) -> None:
    """Require a simple position trajectory, which phase synchronisation can scale."""
    simple = motion.mode is ControlMode.TRAJECTORY and motion.variable is ControlVariable.POSITION
    if simple and motion.function is None and motion.argument is None:
        return
    what = f"a {motion.mode.value} of {motion.variable.value}"
    if simple:
        what = "a trajectory that is a function, or has limited jerk (its own, or of the model)"
    raise UnsupportedError(
        motor=motor.name,
        feature=f"{what} in a phase-synchronised group",
        supported="simple trajectories of position with limits of the first two derivatives; or"
        " group.synchronization = Synchronization.TIME",
    )
