"""One axis of a drive: profile generator, servo and plant, advanced lazily and exactly.

Nothing here runs by itself. `at(now_ns)` makes the readings those of the last servo tick at or
before `now_ns`; commands take effect at the tick after it; `next_event_ns` says when to come back.
What the readings are never depends on who looked, or when, or how often.

Positions are increments of the encoder. Tick k is at k * tick_ns.

One module, and long, because everything that can be done to an axis is on one page.
"""

from typing import Final, final

from emulators.firmware import extras_servo, profile, servo
from emulators.firmware.axis_readings import AxisReadings
from emulators.firmware.extras_tables import Conditions, extras_tables
from emulators.firmware.flags import (
    CURRENT_REACHED,
    IN_TARGET_WINDOW,
    IN_VELOCITY_WINDOW,
    OUTSIDE_GATE,
    PROFILE_ACTIVE,
)
from emulators.firmware.gains import ServoGains
from emulators.firmware.servo_tables import tables_of
from emulators.firmware.timeline import Timeline
from emulators.firmware.windows import default_windows, in_a_row, with_gate
from emulators.plant.dc_motor import MotorPlant

_NEVER: Final = -1.0
_NONE: Final = 1e300  # a threshold that is never reached
_CURRENT_WINDOW: Final = 0.05  # of the plant's current: as near as it must come to be reached

_NO_SPEED: Final = 1e300  # a velocity that no motor has


@final
class Axis(AxisReadings):
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
        if tick_ns < 1 or current_steps < 1 or tick_ns % current_steps:
            raise ValueError(f"tick_ns = {tick_ns} does not hold {current_steps} equal steps")
        self._current_steps: Final = current_steps
        self._clock_rate: Final = clock_rate
        self._current_max_a: Final = plant.current_max_a
        self._limits_a = (plant.current_max_a, plant.current_max_a)  # forwards, backwards
        self._windows: servo.Windows = default_windows(tick_ns)
        self._profile_tick = 0  # at which the profile's time is 0
        standing: servo.Orders = (
            *(servo.OFF, 0, _NEVER, profile.hold(float(initial_position_inc))),
            *(False, 0.0, 0.0, plant.current_max_a, plant.current_max_a),
        )
        self._orders: servo.Orders = standing
        tables = tables_of(plant, gains, tick_ns, current_steps, clock_rate)
        extras = extras_tables(plant, gains, tables.tick, tick_ns, current_steps, clock_rate)
        state = servo.standing(float(initial_position_inc))
        if extras is not None:
            state = extras_servo.standing(extras, float(initial_position_inc), plant.supply_v)
        conditions: Conditions = (
            *(plant.load_torque_n_m / plant.gear_ratio, plant.supply_v),
            *(_NONE, -_NONE, _NONE, _NONE, _NONE, -_NONE, _NONE),
        )
        time = Timeline(
            *(tables, plant.load_torque_n_m, self._windows, standing, state, extras, conditions)
        )
        super().__init__(plant, tick_ns, time, standing[3], conditions)
        self._gains: ServoGains = gains
        self._is_shorted: bool = False
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
    ) -> None:
        """Come to rest at the target by a trapezoid, from the present demand.

        With velocity 0 the axis ramps to rest where it is, and the profile stays active.

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
        pieces = profile.ramp(position, velocity, wanted, faster, slower)
        self._mode = servo.VELOCITY
        self._begin(pieces, profile.duration_ticks(pieces), False, wanted)

    def ramp_to_rest(self, deceleration_inc_s2: float) -> None:
        """Brake along a ramp, then hold where it ends (quick stop, halt); in position control.

        Raises:
            ValueError: deceleration <= 0.
            RuntimeError: power is off.
        """
        position, velocity = self._start()
        slower = self._per_tick2(deceleration_inc_s2)
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
    ) -> None:
        """Go evenly from the present demand to this one in `over_ns`, then hold (csp).

        `fed_velocity_inc_s` is fed forward besides what the gains say of the demand's own. With
        `has_target` IN_TARGET_WINDOW is about this position.
        """
        position, _ = self._start()
        target = float(position_inc - self._offset_inc)
        pieces = profile.line(position, target, over_ns / self._tick_ns)
        self._mode = servo.POSITION
        self._begin(pieces, _NEVER, has_target, 0.0)
        if fed_velocity_inc_s != 0.0:
            fed = profile.fed(
                pieces, self._gains.velocity_feedforward, fed_velocity_inc_s * self._tick_s
            )
            self._orders = (servo.FED, *self._orders[1:3], fed, *self._orders[4:])
            self._time.order(self._orders, self._time.state)

    def follow_velocity(self, velocity_inc_s: float, over_ns: int) -> None:
        """Go evenly from the present velocity demand to this one, then keep it (csv)."""
        _, velocity = self._start()
        wanted = velocity_inc_s * self._tick_s
        pieces = profile.velocity_line(velocity, wanted, over_ns / self._tick_ns)
        self._mode = servo.VELOCITY
        self._begin(pieces, _NEVER, False, _NO_SPEED)

    def follow_current(
        self, current_a: float, over_ns: int, speed_max_inc_s: float = _NO_SPEED
    ) -> None:
        """Go evenly from the present current demand to this one, then keep it (cst)."""
        self._start()
        start_a = self._time.state[servo.I_WANTED]
        if self._mode == servo.TORQUE:  # where the last one ends: its next tick's demand
            t = float(self._time.tick + 1 - self._profile_tick)
            start_a = profile.demand_at(self._profile, t)[0]
        speed_max = speed_max_inc_s * self._tick_s
        pieces = profile.current_line(start_a, current_a, over_ns / self._tick_ns, speed_max)
        self._mode = servo.TORQUE
        self._fed_a = 0.0
        self._begin(pieces, _NEVER, False, 0.0)

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
        self._mode = servo.VELOCITY
        self._begin(profile.hold(0.0), _NEVER, False, _NO_SPEED)
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

    def set_windows(
        self,
        *,
        target_window_inc: int | None = None,
        target_window_ns: int | None = None,
        following_window_inc: int | None = None,
        following_window_ns: int | None = None,
        velocity_window_inc_s: float | None = None,
        velocity_window_ns: int | None = None,
        velocity_threshold_inc_s: float | None = None,
        velocity_threshold_ns: int | None = None,
    ) -> None:
        """The flags' windows and how long they must hold; None leaves one as it was.

        A flag changes at the first tick at which its condition has held for the time. To switch a
        window off, make it huge.
        """
        w = self._windows
        tick_ns, tick_s = self._tick_ns, self._tick_s
        windows = (
            w[0] if target_window_inc is None else float(target_window_inc),
            w[1] if following_window_inc is None else float(following_window_inc),
            w[2] if velocity_threshold_inc_s is None else velocity_threshold_inc_s * tick_s,
            w[3] if velocity_window_inc_s is None else velocity_window_inc_s * tick_s,
            in_a_row(target_window_ns, w[4], tick_ns),
            in_a_row(following_window_ns, w[5], tick_ns),
            in_a_row(velocity_threshold_ns, w[6], tick_ns),
            in_a_row(velocity_window_ns, w[7], tick_ns),
            *w[8:],
        )
        if windows != w:
            self._windows = windows
            self._time.set_windows(windows)

    def set_gate(self, low: float, high: float, output_low: float, output_high: float) -> None:
        """From now on OUTSIDE_GATE says that a count has left its range, and at which tick.

        Inside is low <= count() < high together with output_low <= output_count() < output_high.
        At the present tick the flag is off; it is exact from the next one on.
        """
        time = self._time
        conditions = self._conditions
        if self._has_extras:
            windows = with_gate(self._windows, low, high)
            conditions = (*conditions[:7], output_low, output_high)
        else:
            windows = with_gate(self._windows, max(low, output_low), min(high, output_high))
        if (
            windows == self._windows
            and conditions == self._conditions
            and not self.flags & OUTSIDE_GATE
        ):
            return
        self._set_conditions(conditions)
        self._windows = windows
        time.set_windows(windows)
        self.flags &= ~OUTSIDE_GATE
        time.order(self._orders, (*time.state[:14], self.flags, *time.state[15:]))

    def set_load(self, torque_n_m: float) -> None:
        """The load's torque at the output; positive turns towards negative positions."""
        if torque_n_m != self._load_torque_n_m:
            self._load_torque_n_m = torque_n_m
            if self._has_extras:
                self._set_conditions((torque_n_m / self._gear_ratio, *self._conditions[1:]))
            else:
                self._time.set_load(torque_n_m)

    def set_supply(self, supply_v: float) -> None:
        """The supply's own voltage from now on; it needs a plant with extras.

        Raises:
            ValueError: the plant has none, or the voltage is not > 0.
        """
        if not self._has_extras or not supply_v > 0.0:
            raise ValueError(
                f"supply_v = {supply_v} V: must be > 0, and the plant's source_resistance_ohm too"
            )
        self._set_conditions((self._conditions[0], supply_v, *self._conditions[2:]))

    def set_thresholds(
        self,
        *,
        over_voltage_v: float | None = None,
        under_voltage_v: float | None = None,
        over_temperature_c: float | None = None,
        temperature_warning_c: float | None = None,
        i2t_warning: float | None = None,
    ) -> None:
        """Where the flags of a plant with extras come; None leaves one as it was (first: never).

        They come and go at the tick at which it is so; nothing is latched, and nothing happens to
        the motor. Voltage is looked at in every tick, heat and I2t every 20 ms. Without the part of
        the plant that a threshold is about its flag never comes.
        """
        c = self._conditions
        self._set_conditions(
            (
                *(c[0], c[1]),
                c[2] if over_voltage_v is None else over_voltage_v,
                c[3] if under_voltage_v is None else under_voltage_v,
                c[4] if over_temperature_c is None else over_temperature_c,
                c[5] if temperature_warning_c is None else temperature_warning_c,
                c[6] if i2t_warning is None else i2t_warning,
                *(c[7], c[8]),
            )
        )

    def set_gains(self, gains: ServoGains) -> None:
        """The servo's gains from the next tick on; currents and voltages go on without a jump.

        Raises:
            ValueError: the gains make the current loop unstable; the old ones stay.
        """
        self._step_with(gains.shorted(self._plant) if self._is_shorted else gains)
        self._gains = gains

    def set_current_limit(self, current_a: float, backward_a: float | None = None) -> None:
        """No loop asks for more than this (None: either way), nor than the plant's current_max_a.

        Raises:
            ValueError: one is < 0.
        """
        back_a = current_a if backward_a is None else backward_a
        if not (current_a >= 0.0 and back_a >= 0.0):
            raise ValueError(f"current limits {current_a} and {back_a} A: must be >= 0")
        self._limits_a = (min(current_a, self._current_max_a), min(back_a, self._current_max_a))
        self._orders = (*self._orders[:7], *self._limits_a)
        self._time.order(self._orders, self._time.state)

    def set_position(self, position_inc: int, count: int | None = None) -> None:
        """This count (None: the present one) is called `position_inc` from now on (homing).

        Nothing moves.
        """
        self._time.commands += 1
        self._offset_inc = position_inc - (self.count() if count is None else count)

    # --- inside ----------------------------------------------------------------------------------

    def _step_with(self, gains: ServoGains) -> None:
        tables = tables_of(self._plant, gains, self._tick_ns, self._current_steps, self._clock_rate)
        extras = extras_tables(
            *(self._plant, gains, tables.tick, self._tick_ns, self._current_steps),
            self._clock_rate,
        )
        self._time.set_tables(tables, self._load_torque_n_m, extras)

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

    def _hold(self, position: float) -> None:
        self._begin(profile.hold(position), _NEVER, True, 0.0)

    def _begin(
        self, pieces: profile.Profile, active: float, has_target: bool, run_velocity: float
    ) -> None:
        """From the next tick on these are the orders, and the flags tell so at once."""
        self._profile = pieces
        self._profile_tick = self._time.tick + 1
        self._orders = (
            *(self._mode, self._profile_tick, active, pieces, has_target, pieces[-1][2]),
            *(run_velocity, self._limits_a[0], self._limits_a[1]),
        )
        state = self._time.state
        flags = state[servo.I_FLAGS] & ~(IN_TARGET_WINDOW | IN_VELOCITY_WINDOW | CURRENT_REACHED)
        if active >= 0.0:
            flags |= PROFILE_ACTIVE
        else:
            flags &= ~PROFILE_ACTIVE
        state = (*state[:14], flags, 0, state[16], state[17], 0, state[19])
        self._time.order(self._orders, state)
        self.flags = flags

    def _set_conditions(self, conditions: Conditions) -> None:
        if conditions != self._conditions:
            self._conditions = conditions
            self._time.set_conditions(conditions)

    def _per_tick2(self, size_inc_s2: float) -> float:
        if not size_inc_s2 > 0.0:
            raise ValueError(f"acceleration or deceleration {size_inc_s2} inc/s^2: must be > 0")
        return size_inc_s2 * self._tick_s * self._tick_s
