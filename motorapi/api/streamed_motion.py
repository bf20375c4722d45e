"""Motions that the host streams from the present demand, for drives without a profile generator.

Values are in units of the drive; a motion comes with its scale. A set-point begins at the demand of
the motion that it replaces, and with its rate, so that nothing jumps. A position is streamed along
the shortest trapezoid, another variable along a ramp, and a trajectory as it is.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple, final

from motorhil.motorapi.api.setpoint_stream import SendSetpoint, SetpointStream
from motorhil.motorapi.commands import ControlVariable, Setpoint
from motorhil.motorapi.errors import UnsupportedError
from motorhil.motorapi.generation import ProfileLimits, trapezoid
from motorhil.motorapi.planning.sampling import Ramps, demand_of
from motorhil.motorapi.synchronization.quality import MotionTimes
from motorhil.motorapi.trajectory import Trajectory, has_moving_ends

if TYPE_CHECKING:
    from motorhil.motorapi.api.can_drive import CanDrive
    from motorhil.motorapi.errors import MotorError
    from motorhil.motorapi.motion import Motion
    from motorhil.motorapi.runtime.can_link import Transmission as SentFrame


class Course(NamedTuple):
    """A value with two derivatives over the time since the start [s], and its duration [s]."""

    value: Callable[[float], float]
    first: Callable[[float], float]
    second: Callable[[float], float]
    duration_s: float


def can_stream(variable: ControlVariable, command: Setpoint | Trajectory) -> bool:
    """Return True for trajectories of position from rest to rest, as functions of time."""
    is_trajectory = not isinstance(command, Setpoint) and not has_moving_ends(command)
    return is_trajectory and variable is ControlVariable.POSITION


def require_time(motor: str, motion: "Motion") -> None:
    """Raise UnsupportedError for a motion whose argument is not time."""
    if motion.argument is not None:
        raise UnsupportedError(
            motor=motor, feature=f"a motion over the {motion.argument.name}", supported="time"
        )


@final
class StreamedMotion:
    """The motion of one drive, streamed by `SetpointStream`.

    Args:
        drive: the drive.
        period_s: the time between two set-points [s].
        lead_s: the time by which positions are sent ahead [s], for the lag of the drive.

    Attributes:
        variable: the control variable of the last command; None: released, or not known.
    """

    def __init__(self, drive: "CanDrive", period_s: float, lead_s: float = 0.0) -> None:
        self.variable: ControlVariable | None = None
        self._drive: Final = drive
        self._period_s: Final = period_s
        self._lead_s: Final = lead_s
        self._stream: SetpointStream | None = None
        self._started: SetpointStream | None = None  # by the last motion; a stop has its own
        self._course = _constant(0.0)
        self._began_ns = 0
        self._sampled_s = 0.0

    @property
    def is_going(self) -> bool:
        """True if more set-points will come."""
        return self._stream is not None and self._stream.is_going

    @property
    def is_under_way(self) -> bool:
        """True until the course is over, also if the caller of `slow_down` sends it."""
        return self.variable is not None and (self.is_going or self.since_end_s < 0.0)

    @property
    def is_queued(self) -> bool:
        """True until the first set-point was on the bus: it replaces what is heard before."""
        return self._stream is not None and self._stream.is_queued

    @property
    def error(self) -> "MotorError | None":
        """The error that ended the last stream early, or None."""
        return None if self._stream is None else self._stream.error

    @property
    def since_end_s(self) -> float:
        """The time since the end of the last course [s]; below 0 before it."""
        return self._elapsed_s() - self._course.duration_s

    def start(
        self, motion: "Motion", scale: float, measured: tuple[float, float], send: SendSetpoint
    ) -> "SentFrame":
        """Start a motion, and return its first frame; raise as `CanDrive.command`.

        Args:
            motion: the motion.
            scale: units of the drive per unit of the motion's variable, signed.
            measured: position and velocity now, in units of the drive.
            send: sends one set-point.
        """
        value, rate = self.now(motion.variable, measured)
        if motion.trajectory is not None:
            demand = demand_of(motion)
            began, ends = demand.initial_argument, demand.final_argument
            course = Course(
                lambda at_s: demand.value(began + at_s) * scale,
                lambda at_s: demand.first(began + at_s) * scale,
                lambda at_s: demand.second(began + at_s) * scale,
                ends - began,
            )
        elif motion.variable is ControlVariable.POSITION:
            size = abs(scale)
            most = motion.velocity * size
            limits = ProfileLimits(most, motion.acceleration * size, motion.deceleration * size)
            rate = max(-most, min(most, rate))
            profile = trapezoid(motion.target * scale, limits, initial=value, initial_velocity=rate)
            course = Course(profile.value, profile.first, profile.second, profile.duration_s)
        else:
            course = _ramp(motion, value, scale)
        sent = self._follow(motion.variable, course, send)
        self._started = self._stream
        return sent

    def stop(
        self, deceleration: float, measured: tuple[float, float], send: SendSetpoint
    ) -> "SentFrame":
        """Slow down to rest with positions, then hold; return and raise as `start`."""
        return self._follow(ControlVariable.POSITION, self._to_rest(deceleration, measured), send)

    def slow_down(self, deceleration: float, measured: tuple[float, float]) -> None:
        """As `stop`, but send nothing: the caller sends what `demand` returns."""
        self._begin(ControlVariable.POSITION, self._to_rest(deceleration, measured))

    def hold(self, measured: tuple[float, float], send: SendSetpoint) -> "SentFrame":
        """Hold the present position; return and raise as `start`."""
        position, _ = self.now(ControlVariable.POSITION, measured)
        return self._follow(ControlVariable.POSITION, _constant(position), send)

    def now(self, variable: ControlVariable, measured: tuple[float, float]) -> tuple[float, float]:
        """Return the demand of a variable and its rate now; if it has none, what is measured."""
        stream = self._stream
        if self.variable is not variable:
            value = measured[1] if variable is ControlVariable.VELOCITY else 0.0
            return measured if variable is ControlVariable.POSITION else (value, 0.0)
        is_still = variable is not ControlVariable.POSITION or not self.is_going
        if is_still and stream is not None and stream.last is not None:
            return stream.last, 0.0
        value, rate, _ = self.demand()
        return value, rate

    def demand(self) -> tuple[float, float, float]:
        """Return the demand of `variable` now, and two derivatives.

        After an error that is the last set-point, which the drive keeps; also if a user's function
        fails now, since the next set-point reports it.
        """
        stream = self._stream
        if stream is None or stream.last is None:
            return self._planned()
        if stream.error is None:
            with suppress(Exception):
                return self._planned()
        return stream.last, 0.0, 0.0

    def _planned(self) -> tuple[float, float, float]:
        at_s = min(self._elapsed_s(), self._course.duration_s)
        return self._course.value(at_s), *self._rates(at_s)

    def rates(self) -> tuple[float, float]:
        """Return two derivatives of the set-point that is being sent."""
        return self._rates(self._sampled_s)

    def times(self) -> "MotionTimes | None":
        """Return when the last motion began and ended on the bus; None: no motion yet."""
        return None if self._started is None else self._started.times()

    def cancel(self) -> None:
        """End the stream; the drive keeps the last set-point."""
        if self._stream is not None:
            self._stream.cancel()

    def forget(self) -> None:
        """End the stream, and forget the demand: the drive was released, or is not ours."""
        self.cancel()
        self.variable = self._stream = None

    def _elapsed_s(self) -> float:
        return (self._drive.runtime.now_ns() - self._began_ns) / 1e9

    def _rates(self, at_s: float) -> tuple[float, float]:
        course = self._course
        if at_s >= course.duration_s:
            return 0.0, 0.0
        return course.first(at_s), course.second(at_s)

    def _to_rest(self, deceleration: float, measured: tuple[float, float]) -> Course:
        position, velocity = self.now(ControlVariable.POSITION, measured)
        ramps = Ramps(velocity, 0.0, deceleration, deceleration)
        return Course(
            lambda at_s: ramps.integral(at_s, position),
            lambda at_s: (ramps.at(at_s) or (0.0, 0.0))[0],
            lambda at_s: (ramps.at(at_s) or (0.0, 0.0))[1],
            ramps.duration_s,
        )

    def _begin(self, variable: ControlVariable, course: Course) -> None:
        self.cancel()
        self._course, self._began_ns = course, self._drive.runtime.now_ns()
        self.variable, self._stream = variable, None

    def _follow(self, variable: ControlVariable, course: Course, send: SendSetpoint) -> "SentFrame":
        duration_s = course.duration_s
        lead_s = self._lead_s if variable is ControlVariable.POSITION else 0.0

        def value(at_s: float) -> float:
            self._sampled_s = min(at_s + lead_s, duration_s)
            return course.value(self._sampled_s)

        before = self._course, self._began_ns, self.variable, self._stream
        self._begin(variable, course)
        self._stream = SetpointStream(self._drive, value, duration_s, self._period_s, send)
        try:
            return self._stream.begin()
        except BaseException:  # a motion that is refused is not kept
            self._course, self._began_ns, self.variable, self._stream = before
            raise


def _constant(value: float) -> Course:
    return Course(lambda at_s: value, lambda at_s: 0.0, lambda at_s: 0.0, 0.0)


def _ramp(motion: "Motion", value: float, scale: float) -> Course:
    """Return the course of a set-point of velocity or current from its present value."""
    up, down = motion.slope, motion.slope
    if motion.variable is ControlVariable.VELOCITY:
        up, down = motion.acceleration, motion.deceleration
    ramps = Ramps(value / scale, motion.target, up, down)

    def at(at_s: float) -> tuple[float, float]:
        return ramps.at(at_s) or (motion.target, 0.0)

    return Course(
        lambda at_s: at(at_s)[0] * scale,
        lambda at_s: at(at_s)[1] * scale,
        lambda at_s: 0.0,
        ramps.duration_s,
    )
