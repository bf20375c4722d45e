"""One axis of a drive: profile generator, servo and plant.

The axis is computed lazily and exactly. `at(now_ns)` updates the readings to the last servo tick at
or before `now_ns`. Commands take effect at the following tick. `next_event_ns` returns when to call
`at` again. The readings never depend on who calls `at`, when, or how often.

Positions are encoder increments. Tick k is at k * tick_ns.
"""

from typing import Final, final

from emulators.firmware import profile, servo
from emulators.firmware.axis_settings import NEVER, AxisSettings
from emulators.firmware.flags import (
    CURRENT_REACHED,
    IN_TARGET_WINDOW,
    IN_VELOCITY_WINDOW,
    PROFILE_ACTIVE,
)
from emulators.firmware.gains import ServoGains
from emulators.plant.dc_motor import MotorPlant

_BACKWARD: Final = 1
_FORWARD: Final = 2
_OF_PROFILE: Final = IN_TARGET_WINDOW | IN_VELOCITY_WINDOW | CURRENT_REACHED
"""Flags cleared by the next profile."""
_CURRENT_WINDOW: Final = (
    0.05  # share of the plant's maximum current within which the target counts as reached
)

_NO_SPEED: Final = 1e300  # a velocity above any motor's


@final
class Axis(AxisSettings):
    """One motor with its drive firmware; sans-I/O, reads no clock.

    `AxisReadings` documents the readings and when they change. `Timeline` documents how the axis
    stays lazy and exact.
    """

    def __init__(
        self,
        plant: MotorPlant,
        gains: ServoGains,
        tick_ns: int = 1_000_000,
        current_steps: int = 10,
        initial_position_inc: int = 0,
        clock_rate: float = 1.0,
    ) -> None:
        super().__init__(plant, gains, tick_ns, current_steps, initial_position_inc, clock_rate)
        self._profile_tick = 0  # the tick at which the profile's time is 0
        self._way = 0.0  # its sign is the direction of the last command
        self._barred = 0  # directions that are barred to commands
        self._bar_slower = 0.0
        self._fed_a: float = 0.0  # part of the velocity loop's integrator added by `feed_current`

    # --- commands, effective from the tick after the last at() ------------------------------------

    def power(self, on: bool) -> None:
        """Switch the power stage on or off; no effect if it is in that state already.

        On: the axis holds its present position. Off: no current flows, and the motor coasts.
        """
        if on == (self._mode != servo.OFF):
            return
        if self.is_braking:
            self._end_braking()
        self._mode = servo.POSITION if on else servo.OFF
        self._fed_a = 0.0
        self._hold(self._time.state[servo.I_COUNT])

    def move_to(
        self,
        target_inc: int,
        velocity_inc_s: float,
        acceleration_inc_s2: float,
        deceleration_inc_s2: float,
        end_velocity_inc_s: float = 0.0,
    ) -> None:
        """Move to the target on a trapezoidal profile, starting from the present demand.

        With an end velocity > 0 the axis passes the target at that speed and continues. The profile
        then ends when this speed is reached. With velocity 0 the axis ramps to rest where it is,
        and the profile stays active.

        Raises:
            ValueError: velocity < 0, or acceleration or deceleration <= 0.
            RuntimeError: power is off.
        """
        position, velocity = self._start()
        speed_max = velocity_inc_s * self._tick_s
        faster = self._per_tick2(acceleration_inc_s2)
        slower = self._per_tick2(deceleration_inc_s2)
        if not speed_max >= 0.0:
            raise ValueError(f"velocity: {velocity_inc_s} inc/s; must be >= 0")
        self._mode = servo.POSITION
        if speed_max == 0.0:
            pieces = profile.ramp(position, velocity, 0.0, slower, slower)
            self._begin(pieces, profile.FOREVER, True, 0.0)
            return
        target = float(target_inc - self._offset_inc)
        self._way = target - position
        if self._barred and self._is_barred():
            return
        if end_velocity_inc_s > 0.0:
            pieces = profile.move_through(
                *(position, velocity, target, speed_max, faster, slower),
                end_velocity_inc_s * self._tick_s,
            )
            self._begin(pieces, profile.duration_ticks(pieces), False, 0.0)
            return
        pieces = profile.move(position, velocity, target, speed_max, faster, slower)
        self._begin(pieces, profile.duration_ticks(pieces), True, 0.0)

    def run_at(
        self, velocity_inc_s: float, acceleration_inc_s2: float, deceleration_inc_s2: float
    ) -> None:
        """Ramp to this velocity and keep it, with the velocity loop only.

        Raises:
            ValueError: acceleration or deceleration <= 0.
            RuntimeError: power is off.
        """
        position, velocity = self._start()
        faster = self._per_tick2(acceleration_inc_s2)
        slower = self._per_tick2(deceleration_inc_s2)
        wanted = velocity_inc_s * self._tick_s
        self._way = wanted
        if self._barred and self._is_barred():
            return
        pieces = profile.ramp(position, velocity, wanted, faster, slower)
        self._mode = servo.VELOCITY
        self._begin(pieces, profile.duration_ticks(pieces), False, wanted)

    def ramp_to_rest(
        self, deceleration_inc_s2: float, within_inc: tuple[int, int] | None = None
    ) -> None:
        """Brake along a ramp, then hold the end position (quick stop, halt).

        The axis brakes in position control. In position mode, from inside `within_inc`, the ramp
        ends within that range: it is as steep as necessary, and immediate where no distance is
        left.

        Raises:
            ValueError: deceleration <= 0.
            RuntimeError: power is off.
        """
        position, velocity = self._start()
        slower = self._per_tick2(deceleration_inc_s2)
        self._way = velocity
        if within_inc is not None and self._mode == servo.POSITION:
            end = within_inc[1 if velocity > 0.0 else 0] - self._offset_inc
            left = end - position if velocity > 0.0 else position - end
            square = velocity * velocity
            if left >= 0.0 and square > 2.0 * slower * left:
                slower = square / (2.0 * left) if left > 0.0 else _NO_SPEED
        pieces = profile.ramp(position, velocity, 0.0, slower, slower)
        self._mode = servo.POSITION
        self._begin(pieces, profile.duration_ticks(pieces), True, 0.0)

    def apply_current(
        self, target_a: float, slope_a_s: float, speed_max_inc_s: float = _NO_SPEED
    ) -> None:
        """Ramp the current from its present demand to `target_a` and keep it.

        The first step of the ramp is in the next tick. Only the current loop is closed. Current
        that would drive the motor beyond `speed_max_inc_s` in either direction is withheld.

        Raises:
            ValueError: the slope is not > 0 (it may be infinite), or the target is not a number.
            RuntimeError: power is off.
        """
        self._start()
        if not slope_a_s > 0.0 or target_a != target_a:
            raise ValueError(f"current {target_a} A at {slope_a_s} A/s: the slope must be > 0")
        self._way = target_a
        if self._barred and self._is_barred():
            return
        start_a = self._time.state[servo.I_WANTED]
        pieces = profile.current(
            start_a, target_a, slope_a_s * self._tick_s, speed_max_inc_s * self._tick_s
        )
        near_a = _CURRENT_WINDOW * self._current_max_a
        self._mode = servo.TORQUE
        self._fed_a = 0.0
        self._begin(pieces, profile.duration_ticks(pieces), False, near_a)

    # --- cyclic demands: without profiles, so PROFILE_ACTIVE and the target windows stay off;
    # --- RuntimeError if power is off

    def follow(
        self,
        position_inc: int,
        over_ns: int,
        fed_velocity_inc_s: float = 0.0,
        has_target: bool = False,
        speed_max_inc_s: float = _NO_SPEED,
    ) -> int:
        """Move linearly from the present demand to `position_inc` in `over_ns`, then hold (csp).

        The speed is limited to `speed_max_inc_s`, and the move then takes longer.
        `fed_velocity_inc_s` is fed forward in addition to the demand's own velocity times its gain.
        With `has_target`, IN_TARGET_WINDOW refers to this position.

        Returns:
            The duration in ticks if the speed was limited, else 0.
        """
        position, _ = self._start()
        target = float(position_inc - self._offset_inc)
        way = target - position
        self._way = way
        if self._barred and self._is_barred():
            return 0
        ticks = over_ns / self._tick_ns
        if ticks < 1.0:
            ticks = 1.0
        farthest = speed_max_inc_s * self._tick_s * ticks
        is_cut = way > farthest or -way > farthest
        if is_cut:
            ticks *= (way if way > 0.0 else -way) / farthest
        pieces = profile.line(position, target, ticks)
        self._mode = servo.POSITION
        self._begin(pieces, NEVER, has_target, 0.0)
        if fed_velocity_inc_s != 0.0:
            fed = profile.fed(
                pieces, self._gains.velocity_feedforward, fed_velocity_inc_s * self._tick_s
            )
            self._orders = (servo.FED, *self._orders[1:3], fed, *self._orders[4:])
            self._time.order(self._orders, self._time.state)
        return int(-(-ticks // 1.0)) if is_cut else 0

    def follow_velocity(self, velocity_inc_s: float, over_ns: int) -> None:
        """Change the velocity demand linearly to this one in `over_ns`, then keep it (csv)."""
        _, velocity = self._start()
        wanted = velocity_inc_s * self._tick_s
        self._way = wanted
        if self._barred and self._is_barred():
            return
        pieces = profile.velocity_line(velocity, wanted, over_ns / self._tick_ns)
        self._mode = servo.VELOCITY
        self._begin(pieces, NEVER, False, _NO_SPEED)

    def follow_current(
        self, current_a: float, over_ns: int, speed_max_inc_s: float = _NO_SPEED
    ) -> None:
        """Change the current demand linearly to this one in `over_ns`, then keep it (cst)."""
        self._start()
        self._way = current_a
        if self._barred and self._is_barred():
            return
        start_a = self._time.state[servo.I_WANTED]
        if self._mode == servo.TORQUE:  # the last demand's end: the value of its next tick
            t = float(self._time.tick + 1 - self._profile_tick)
            start_a = profile.demand_at(self._profile, t)[0]
        speed_max = speed_max_inc_s * self._tick_s
        pieces = profile.current_line(start_a, current_a, over_ns / self._tick_ns, speed_max)
        self._mode = servo.TORQUE
        self._fed_a = 0.0
        self._begin(pieces, NEVER, False, 0.0)

    def feed_current(self, current_a: float) -> None:
        """Add this current to the velocity loop's output from the next tick on; 0.0 ends it.

        The value is added to the loop's integrator, which has the effect of a constant offset.
        """
        if current_a == self._fed_a:
            return
        state = self._time.state
        hold_a = state[servo.I_HELD] + (current_a - self._fed_a)
        self._fed_a = current_a
        self._time.order(self._orders, (*state[:5], hold_a, *state[6:]))

    def brake(self, shorted: bool) -> None:
        """Stop as hard as the current limits allow, or as if the motor were shorted.

        `stands` is True once the motor has stopped. The velocity loop then holds it until the next
        command.
        """
        self._start()
        self._way = 0.0
        self._mode = servo.VELOCITY
        self._begin(profile.hold(0.0), NEVER, False, _NO_SPEED)
        state = self._time.state
        self._fed_a = 0.0
        self._time.order(self._orders, (*state[:5], 0.0, *state[6:]))
        self.is_braking = True
        if shorted:
            self._is_shorted = True
            self._step_with(self._gains.shorted(self._plant))

    def hold(self) -> None:
        """Hold the present demand at once, without a ramp.

        Raises:
            RuntimeError: power is off.
        """
        position, _ = self._start()
        self._mode = servo.POSITION
        self._hold((position + 0.5) // 1.0)

    def bar(self, backward: bool, forward: bool, deceleration_inc_s2: float) -> None:
        """Bar directions of motion; motion into them, present or new, is braked on a ramp.

        The axis holds the end position, which is not a target: IN_TARGET_WINDOW stays off.

        Raises:
            ValueError: deceleration <= 0.
        """
        self._bar_slower = self._per_tick2(deceleration_inc_s2)
        self._barred = (_BACKWARD if backward else 0) | (_FORWARD if forward else 0)
        if self._mode == servo.TORQUE:  # the load may drive the motor against the current
            self._way = self._time.state[servo.I_VELOCITY]
        moves = self.flags & PROFILE_ACTIVE or self._time.state[servo.I_DEMAND_VELOCITY] != 0.0
        if self._mode != servo.OFF and (self._mode != servo.POSITION or moves):
            self._is_barred()

    # --- internals -------------------------------------------------------------------------------

    def _end_braking(self) -> None:
        self.is_braking = False
        if self._is_shorted:
            self._is_shorted = False
            self._step_with(self._gains)

    def _start(self) -> tuple[float, float]:
        """Return position and velocity demand at the next tick, where a new profile starts."""
        if self.is_braking:
            self._end_braking()
        if self._mode == servo.OFF:
            raise RuntimeError("the power stage is off: call power(True) first")
        t = float(self._time.tick + 1 - self._profile_tick)
        position, velocity = profile.demand_at(self._profile, t)
        if self._mode == servo.TORQUE:  # only the current has a demand
            velocity = self._time.state[servo.I_VELOCITY]
        if self._mode != servo.POSITION:
            position = self._time.state[servo.I_COUNT] + velocity
        return position, velocity

    def _is_barred(self) -> bool:
        """Brake and return True if the present command leads into a barred direction."""
        way = self._way
        if not self._barred & (_FORWARD if way > 0.0 else _BACKWARD if way < 0.0 else 0):
            return False
        position, velocity = self._start()
        pieces = profile.ramp(position, velocity, 0.0, self._bar_slower, self._bar_slower)
        self._mode = servo.POSITION
        self._begin(pieces, profile.duration_ticks(pieces), False, 0.0)
        return True

    def _hold(self, position: float) -> None:
        self._begin(profile.hold(position), NEVER, True, 0.0)

    def _begin(
        self, pieces: profile.Profile, active: float, has_target: bool, run_velocity: float
    ) -> None:
        """Give new orders from the next tick on; update the profile flags at once."""
        self._profile = pieces
        self._profile_tick = self._time.tick + 1
        limits_a = self._limits_a
        # fmt: off
        self._orders = (self._mode, self._profile_tick, active, pieces, has_target, pieces[-1][2],
                        run_velocity, limits_a[0], limits_a[1])
        # fmt: on
        state = self._time.state
        flags = state[servo.I_FLAGS] & ~(_OF_PROFILE | PROFILE_ACTIVE)
        if active >= 0.0:
            flags |= PROFILE_ACTIVE
        if flags != state[servo.I_FLAGS] or state[15] or state[18]:
            state = (*state[:14], flags, 0, state[16], state[17], 0, state[19])
        self._time.order(self._orders, state)
        self.flags = flags

    def _per_tick2(self, size_inc_s2: float) -> float:
        if not size_inc_s2 > 0.0:
            raise ValueError(f"acceleration or deceleration: {size_inc_s2} inc/s^2; must be > 0")
        return size_inc_s2 * self._tick_s * self._tick_s
