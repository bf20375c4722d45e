"""Servo of one motor on the host: counts in, current out (sans-I/O).

Velocity is controlled as position: the demand advances at the demanded velocity, so that the motor
covers the demanded distance. While the output is saturated, the integral and the error of an
unreachable velocity are frozen (anti-windup). All values are in increments of the counter, seconds
and amperes; a positive current turns the motor towards higher counts. The servo has no clock: it
runs once a cycle.

Once a cycle, the servo computes the current for the amplifier:

    current = kp e + kd de/dt + integral of ki e dt
              + velocity feed-forward * v + acceleration feed-forward * a + friction, with v's sign

e is demand minus measured position. v and a are the trajectory's demands at the time when the
output acts, one and a half cycles later. U is the motor's unit of position: rad, or m if linear.
"""

from dataclasses import dataclass
from math import inf, isfinite
from typing import Final, final

from motorhil.motorapi.adaptations.host_servo.demand import (
    CURRENT,
    POSITION,
    VELOCITY,
    Braking,
    Course,
    Moving,
)
from motorhil.motorapi.adaptations.host_servo.settings import PidGains
from motorhil.motorapi.errors import MotorError, PluginError

_AHEAD: Final = 1.5  # cycles: the output acts between the next two SYNCs
_SMOOTH: Final = 0.2  # smoothing of the reported velocity, which has the resolution of one count
_DEAD_BAND_INC: Final = 1.0  # an error at rest within it is ignored: the integral would oscillate
_STILL_INC: Final = 2.0
_NO_SPEED: Final = 1e-3  # [inc/s]
_HALF: Final = 0x8000_0000
_MASK: Final = 0xFFFF_FFFF


def difference(count: int, before: int) -> int:
    """Return the distance between two counts of a 32-bit counter [inc]."""
    return ((count - before + _HALF) & _MASK) - _HALF


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class ServoLimits:
    """The limits of the servo, and its criteria for the end of a motion.

    Attributes:
        current_max_a: the output's saturation [A].
        velocity_max: the limit of the velocity in response to a large error, beyond the demand
            [inc/s].
        following_error: the largest error; exceeding it for `following_s` stops the motor [inc];
            inf: no limit.
        stall_s: a set-point of position has no demand to follow; with such an error, it stops the
            motor after this time without approach to its target [s].
        short_s: the longest standstill beside the target, once the demand has arrived [s].
        window: a position is reached within it, for `settle_s` [inc].
        velocity_window: a velocity is reached within it, for `settle_s` [inc/s].
        deceleration: the deceleration to rest if the course fails [inc/s²].
    """

    current_max_a: float
    velocity_max: float
    following_error: float
    following_s: float
    stall_s: float
    short_s: float
    window: float
    velocity_window: float
    settle_s: float
    deceleration: float


_NO_GAINS: Final = PidGains(kp=1e-300)
_NO_LIMITS: Final = ServoLimits(
    current_max_a=0.0,
    velocity_max=0.0,
    following_error=inf,
    following_s=1.0,
    stall_s=1.0,
    short_s=1.0,
    window=0.0,
    velocity_window=0.0,
    settle_s=1.0,
    deceleration=1.0,
)


@final
class Servo:
    """Position, velocity and current control of one motor.

    Attributes:
        position: the measured position [inc]; velocity: likewise, smoothed [inc/s].
        demand, demand_velocity: the demands [inc, inc/s]; without a course, the measured values.
        current_a: the current demand of the amplifier [A].
        course: the active course; None: no control, no current.
        is_done: whether the course has come to its end, and the motor with it.
        lags: whether the following error exceeds its limit for too long, of a set-point without
            approach to its target; or the motor stands still for too long beside the target of a
            course that is over.
        error: an error of the demand itself, or None.
    """

    def __init__(self, period_s: float) -> None:
        self.position: float = 0.0
        self.velocity: float = 0.0
        self.demand: float = 0.0
        self.demand_velocity: float = 0.0
        self.current_a: float = 0.0
        self.course: Course | None = None
        self.is_done: bool = True
        self.lags: bool = False
        self.error: MotorError | None = None
        self._period_s: Final = period_s
        self._count = 0
        self._travel = 0
        self._offset = 0
        self._cycle = -1  # of the last count; -1: none yet
        self._begun = 0
        self._error = 0.0
        self._rate = 0.0
        self._integral = 0.0
        self._settled = 0
        self._still = (0.0, 0)  # position of standstill, and its duration in cycles
        self._behind = 0
        self._short = 0  # cycles of standstill beside the target of a course that is over
        self._farthest = 0.0  # error of a set-point since its last approach to the target
        self._gains = _NO_GAINS
        self._limits = _NO_LIMITS
        self._take(_NO_GAINS, _NO_LIMITS)

    def _take(self, gains: PidGains, limits: ServoLimits) -> None:
        """Set gains and limits from the next cycle on."""
        self._gains = gains
        self._limits = limits
        period_s = self._period_s
        self._alpha = period_s / (period_s + gains.derivative_filter_s)
        self._settle_cycles = max(1, round(limits.settle_s / period_s))
        self._following_cycles = max(1, round(limits.following_s / period_s))
        self._stall_cycles = max(1, round(limits.stall_s / period_s))
        self._short_cycles = max(1, round(limits.short_s / period_s))
        # A larger error is answered with velocity_max, where kd balances kp.
        self._error_max = limits.velocity_max * gains.kd / gains.kp if gains.kd > 0.0 else 1e300

    @property
    def deceleration(self) -> float:
        """The deceleration to rest if the course fails [inc/s²]."""
        return self._limits.deceleration

    # --- commands

    def begin(self, course: Course, gains: PidGains, limits: ServoLimits, cycle: int) -> None:
        """Begin a course with the count of this cycle.

        Raises:
            MotorError: the course cannot begin at the demand of that cycle.
        """
        was = self.course
        if isinstance(course, Moving):
            course.begin(self._demand_at(cycle))
        if was is None or was.kind == CURRENT:
            self._integral = 0.0 if was is None else self.current_a
            self._rate = 0.0
        if was is None or was.kind == CURRENT or was.is_step:
            self.demand = self.position
        self._take(gains, limits)
        if course.is_step:
            self.demand = course.target  # the step itself is not a velocity
        self.course = course
        self._begun = cycle
        self._settled = self._behind = self._short = 0
        self._farthest = 0.0
        self._still = (self.position, 0)
        self.is_done = self.lags = False

    def _demand_at(self, cycle: int) -> float:
        """Return the demand of the present course in this cycle [inc], the next one."""
        was = self.course
        if was is None or was.kind == CURRENT or was.is_step:
            return self.position
        if was.kind == VELOCITY:
            return self.demand + was.value * (cycle - self._cycle) * self._period_s
        if was.is_over and not was.final_velocity:
            return self.demand
        was.sample((cycle - self._begun) * self._period_s, _AHEAD * self._period_s)
        return was.value

    def brake(self, deceleration: float) -> None:
        """Bring the motor to rest at this rate [inc/s²], from the present demand, and hold it."""
        course = self.course
        if course is None:
            return
        if course.kind == CURRENT or course.is_step:
            stop = Braking(self.position, self.velocity, deceleration)
        else:
            stop = Braking(self.demand, self.demand_velocity, deceleration)
        self.begin(stop, self._gains, self._limits, self._cycle)

    def release(self) -> None:
        """End control and current."""
        self.course = None
        self.current_a = 0.0
        self.demand = self.position
        self.demand_velocity = 0.0
        self._integral = self._rate = 0.0

    def forget(self) -> None:
        """Discard the last count, as the next one does not show the distance since then."""
        self.release()
        self._cycle = -1

    def call_here(self, position: int) -> None:
        """Define the present position as `position`, without motion."""
        by = position - self._travel - self._offset
        self._offset += by
        self.position = float(position)
        self.demand += by
        self._still = (self.position, 0)
        if self.course is not None:
            self.course = Course(POSITION, self.demand)

    def restart(self, count: int) -> None:
        """Set the position to `count`, as the counter was restarted."""
        self.forget()
        self._count = self._travel = count
        self._offset = 0
        self.position = self.demand = float(count)

    def look(self, count: int) -> None:
        """Process a polled count, outside of any cycle."""
        self.measure(count, self._cycle)

    # --- once a cycle

    def measure(self, count: int, cycle: int) -> int:
        """Process the count of this cycle; return the cycles since the last one (0: the first)."""
        before = self._cycle
        self._cycle = cycle
        change = difference(count, self._count)
        self._count = count
        self._travel += change
        self.position = float(self._travel + self._offset)
        if self.course is None:
            self.demand = self.position
        if before < 0:
            self.velocity = 0.0
            self._error = 0.0
            self.demand = self.position
            return 0
        cycles = cycle - before
        if cycles <= 0:
            return 0
        speed = change / (cycles * self._period_s)
        self.velocity += (speed - self.velocity) * _SMOOTH
        if not change and -_NO_SPEED < self.velocity < _NO_SPEED:
            self.velocity = 0.0
        return cycles

    def step(self, count: int, cycle: int) -> float:
        """Process the count of this cycle, and return the current for the amplifier [A]."""
        place = self.position
        cycles = self.measure(count, cycle)
        course = self.course
        if course is None:
            return 0.0
        passed_s = cycles * self._period_s
        try:
            course.sample((cycle - self._begun) * self._period_s, _AHEAD * self._period_s)
            demanded = (course.value, course.velocity, course.acceleration)
            if not isfinite(sum(demanded)):
                raise ValueError(f"value and derivatives are {demanded}, not finite")
        except MotorError as error:
            self.error = error
            return self.current_a
        except Exception as error:  # an error of a user's argument or function
            self.error = PluginError(
                plugin=type(error).__name__, where="sampling a trajectory", problem=str(error)
            )
            return self.current_a
        if course.kind == CURRENT:
            self._error = 0.0
            self.demand = self.position
            self.demand_velocity = self.velocity
            limit = self._limits.current_max_a
            self.current_a = max(-limit, min(limit, course.value))
            self.is_done = course.is_over
            return self.current_a
        before = self.demand
        if course.kind == VELOCITY:
            self.demand = before + course.value * passed_s
        else:
            self.demand = course.value
        if cycles:
            self.demand_velocity = (self.demand - before) / passed_s
            rate = self.demand_velocity - (self.position - place) / passed_s
            self._rate += (rate - self._rate) * self._alpha
        self._control(course, passed_s)
        self._judge(course)
        return self.current_a

    def _control(self, course: Course, passed_s: float) -> None:
        """Compute PID, feed-forward, saturation and anti-windup."""
        gains = self._gains
        error = self.demand - self.position
        bound = self._error_max
        acting = max(-bound, min(bound, error))
        wanted = gains.kp * acting + gains.kd * self._rate + self._integral
        velocity = course.velocity
        if velocity or course.acceleration:
            wanted += (
                gains.acceleration_feedforward * course.acceleration
                + gains.velocity_feedforward * velocity
            )
            if velocity > 0.0:
                wanted += gains.friction_feedforward
            elif velocity < 0.0:
                wanted -= gains.friction_feedforward
        limit = self._limits.current_max_a
        if wanted > limit or wanted < -limit:
            is_high = wanted > limit
            wanted = limit if is_high else -limit
            if is_high == (error > 0.0):
                if course.kind == VELOCITY and abs(error) > abs(self._error):
                    error = self._error  # it cannot keep up: the lost distance is not recovered
                    self.demand = self.position + error
                self._error = error
                self.current_a = wanted
                return
        self._error = error
        self.current_a = wanted
        # No integration at rest within one increment, nor far behind, where kp and kd act.
        if acting == error and (velocity or abs(error) > _DEAD_BAND_INC):
            self._integral += gains.ki * error * passed_s
            self._integral = max(-limit, min(limit, self._integral))

    def _judge(self, course: Course) -> None:
        """Detect the end of the course, and a following error that lasts too long."""
        limits = self._limits
        self._judge_following(course, abs(self._error))
        still = self._stands_still()
        if self.is_done or not course.is_over:
            return
        if course.is_stop:
            self.is_done = still
            return
        if course.kind == VELOCITY:
            is_there = abs(self.velocity - course.target) <= limits.velocity_window
        elif course.final_velocity:  # it continues, at this velocity or to rest
            is_there = abs(self.velocity - course.velocity) <= limits.velocity_window
        else:
            is_there = abs(course.target - self.position) <= limits.window
        self._settled = self._settled + 1 if is_there else 0
        self.is_done = self._settled >= self._settle_cycles
        self._short = self._short + 1 if still else 0
        if self._short >= self._short_cycles:  # such as with commands that the amplifier lost
            self.lags = True

    def _judge_following(self, course: Course, error: float) -> None:
        """Detect an error above its limit for too long, in a set-point without any approach."""
        limits = self._limits
        allowed = self._following_cycles
        approaches = False
        if course.is_step:
            allowed = self._stall_cycles
            approaches = self.is_done or error < self._farthest - limits.window
            self._farthest = error if approaches else max(self._farthest, error)
        if approaches or error <= limits.following_error:
            self._behind = 0
            return
        self._behind += 1
        self.lags = self._behind >= allowed

    def _stands_still(self) -> bool:
        """Return whether the motor has not moved during the settling time."""
        place, cycles = self._still
        if abs(self.position - place) > _STILL_INC:
            self._still = (self.position, 0)
            return False
        self._still = (place, cycles + 1)
        return cycles + 1 >= self._settle_cycles
