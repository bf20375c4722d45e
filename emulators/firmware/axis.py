"""One axis of a drive: profile generator, servo and plant, advanced lazily and exactly.

Nothing here runs by itself. `at(now_ns)` makes the readings those of the last servo tick at or
before `now_ns`; commands take effect at the tick after it; `next_event_ns` says when to come back.
What the readings are never depends on who looked, or when, or how often.

Positions are increments of the encoder. Tick k is at k * tick_ns.
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
_OF_PROFILE: Final = IN_TARGET_WINDOW | IN_VELOCITY_WINDOW | CURRENT_REACHED  # gone with the next
_CURRENT_WINDOW: Final = 0.05  # of the plant's current: as near as it must come to be reached

_NO_SPEED: Final = 1e300  # a velocity that no motor has


@final
class Axis(AxisSettings):
    """One motor with everything a drive's firmware does to it; sans-I/O, no clock.

    What it shows, and when, is told in emulators.firmware.axis_readings; how it stays lazy and
    exact, in emulators.firmware.timeline.
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
        self._profile_tick = 0  # at which the profile's time is 0
        self._way = 0.0  # its sign says where the last command leads
        self._barred = 0  # ways in which no command may lead
        self._bar_slower = 0.0
        self._fed_a: float = 0.0  # of the velocity loop's integrator, what `feed_current` put there

    # --- commands, from the tick after the last at() ----------------------------------------------

    def power(self, on: bool) -> None:
        """On: the position is held where it is. Off: no current flows, the motor coasts.

        Without effect where it is so already.
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
        """Come to rest at the target by a trapezoid, from the present demand.

        With an end velocity > 0 the axis passes the target at that speed and goes on; the profile
        is over when it has this speed. With velocity 0 the axis ramps to rest where it is, and the
        profile stays active.

        Raises:
            ValueError: velocity < 0, or acceleration or deceleration <= 0.
            RuntimeError: power is off.
        """
        position, velocity = self._start()
        speed_max = velocity_inc_s * self._tick_s
        faster = self._per_tick2(acceleration_inc_s2)
        slower = self._per_tick2(deceleration_inc_s2)
        if not speed_max >= 0.0:
            raise ValueError(f"velocity {velocity_inc_s} inc/s: must be >= 0")
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
        """Reach this velocity and keep it, by the velocity loop alone.

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
        """Brake along a ramp, then hold where it ends (quick stop, halt); in position control.

        Where a position is controlled and is `within_inc`, the ramp ends there too: it is steeper
        if it must be, down to none where no way is left.

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
        """Ramp the current from its present demand to this one and keep it, whatever moves.

        The first step of the ramp is in the next tick. No loop but the current's is closed; what
        would carry the motor beyond `speed_max_inc_s` either way is held back.

        Raises:
            ValueError: the slope is not > 0 (it may be infinite), or the target is no number.
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

    # --- cyclic demands: no profiles, so PROFILE_ACTIVE and the target windows stay off;
    # --- RuntimeError where power is off

    def follow(
        self,
        position_inc: int,
        over_ns: int,
        fed_velocity_inc_s: float = 0.0,
        has_target: bool = False,
        speed_max_inc_s: float = _NO_SPEED,
    ) -> int:
        """Go evenly from the present demand to this one in `over_ns`, then hold (csp).

        No faster than `speed_max_inc_s`, but then for longer: for so many ticks, else 0.
        `fed_velocity_inc_s` is fed forward besides what the gains say of the demand's own. With
        `has_target` IN_TARGET_WINDOW is about this position.
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
        """Go evenly from the present velocity demand to this one, then keep it (csv)."""
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
        """Go evenly from the present current demand to this one, then keep it (cst)."""
        self._start()
        self._way = current_a
        if self._barred and self._is_barred():
            return
        start_a = self._time.state[servo.I_WANTED]
        if self._mode == servo.TORQUE:  # where the last one ends: its next tick's demand
            t = float(self._time.tick + 1 - self._profile_tick)
            start_a = profile.demand_at(self._profile, t)[0]
        speed_max = speed_max_inc_s * self._tick_s
        pieces = profile.current_line(start_a, current_a, over_ns / self._tick_ns, speed_max)
        self._mode = servo.TORQUE
        self._fed_a = 0.0
        self._begin(pieces, NEVER, False, 0.0)

    def feed_current(self, current_a: float) -> None:
        """From the next tick on the velocity loop's current is more by this; 0.0 ends it.

        It goes into the loop's integrator, which is what a constant more makes of it.
        """
        if current_a == self._fed_a:
            return
        state = self._time.state
        hold_a = state[servo.I_HELD] + (current_a - self._fed_a)
        self._fed_a = current_a
        self._time.order(self._orders, (*state[:5], hold_a, *state[6:]))

    def brake(self, shorted: bool) -> None:
        """Stop as hard as the current's limits allow, or as if the motor were shorted.

        `stands` says when; until the next command the velocity loop then keeps it there.
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
        """Stand at the present demand at once, without a ramp.

        Raises:
            RuntimeError: power is off.
        """
        position, _ = self._start()
        self._mode = servo.POSITION
        self._hold((position + 0.5) // 1.0)

    def bar(self, backward: bool, forward: bool, deceleration_inc_s2: float) -> None:
        """Motion that leads into a barred way ends now, on a ramp; new commands into it only brake.

        Where it ends is held, and is no target: IN_TARGET_WINDOW stays off.

        Raises:
            ValueError: deceleration <= 0.
        """
        self._bar_slower = self._per_tick2(deceleration_inc_s2)
        self._barred = (_BACKWARD if backward else 0) | (_FORWARD if forward else 0)
        if self._mode == servo.TORQUE:  # the load may lead where the current does not
            self._way = self._time.state[servo.I_VELOCITY]
        moves = self.flags & PROFILE_ACTIVE or self._time.state[servo.I_DEMAND_VELOCITY] != 0.0
        if self._mode != servo.OFF and (self._mode != servo.POSITION or moves):
            self._is_barred()

    # --- inside ----------------------------------------------------------------------------------

    def _end_braking(self) -> None:
        self.is_braking = False
        if self._is_shorted:
            self._is_shorted = False
            self._step_with(self._gains)

    def _start(self) -> tuple[float, float]:
        """Position and velocity demand at the next tick, where a new profile takes over."""
        if self.is_braking:
            self._end_braking()
        if self._mode == servo.OFF:
            raise RuntimeError("the power stage is off: call power(True) first")
        t = float(self._time.tick + 1 - self._profile_tick)
        position, velocity = profile.demand_at(self._profile, t)
        if self._mode == servo.TORQUE:  # there is no demand but that of the current
            velocity = self._time.state[servo.I_VELOCITY]
        if self._mode != servo.POSITION:
            position = self._time.state[servo.I_COUNT] + velocity
        return position, velocity

    def _is_barred(self) -> bool:
        """Whether a command leads into a barred way; then it brakes instead."""
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
        """From the next tick on these are the orders, and the flags tell so at once."""
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
            raise ValueError(f"acceleration or deceleration {size_inc_s2} inc/s^2: must be > 0")
        return size_inc_s2 * self._tick_s * self._tick_s
