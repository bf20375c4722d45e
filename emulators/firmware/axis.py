"""One axis of a drive: profile generator, servo and plant.

The axis is computed lazily and exactly. `at(now_ns)` updates the readings to the last servo tick at
or before `now_ns`. Commands take effect at the following tick. `next_event_ns` returns when to call
`at` again. The readings never depend on who calls `at`, when, or how often.

Positions are encoder increments. Tick k is at k * tick_ns.
"""

from typing import Final, final

from motorhil.emulators.firmware import nonlinear_servo, profile, servo
from motorhil.emulators.firmware.flags import (
    CURRENT_REACHED,
    IN_TARGET_WINDOW,
    IN_VELOCITY_WINDOW,
    OUTSIDE_GATE,
    PROFILE_ACTIVE,
    SPEED_ZERO,
)
from motorhil.emulators.firmware.nonlinear_tables import Conditions, extras_tables
from motorhil.emulators.firmware.servo import Windows
from motorhil.emulators.firmware.servo_tables import ServoGains, tables_of
from motorhil.emulators.firmware.timeline import RESTS, Timeline
from motorhil.emulators.plant.dc_motor import PI, MotorPlant

NEVER_NS: Final = 1 << 61  # a small int to the compiler
"""A time that never comes [ns]."""
NEVER: Final = -1.0  # end of PROFILE_ACTIVE for a profile that never sets it
NO_LIMIT: Final = 1e300  # a threshold or velocity that is never reached

_BACKWARD: Final = 1
_FORWARD: Final = 2
_OF_PROFILE: Final = IN_TARGET_WINDOW | IN_VELOCITY_WINDOW | CURRENT_REACHED  # next one clears them
_CURRENT_WINDOW: Final = 0.05  # of the plant's maximum current: the target counts as reached


def default_windows(tick_ns: int) -> Windows:
    """Return the defaults: target 10 inc, no following error, 500 and 2000 inc/s for 10 ms.

    The 500 inc/s are the speed threshold, the 2000 inc/s the velocity window.
    """
    tick_s = tick_ns / 1e9
    return (
        *(10.0, NO_LIMIT, 500.0 * tick_s, 2000.0 * tick_s),
        *(in_a_row(0, 0, tick_ns), in_a_row(0, 0, tick_ns)),
        *(in_a_row(10_000_000, 0, tick_ns), in_a_row(10_000_000, 0, tick_ns)),
        *(-NO_LIMIT, NO_LIMIT),
    )


def with_gate(windows: Windows, low: float, high: float) -> Windows:
    """Return the windows with another gate."""
    return (*windows[:8], low, high)


def in_a_row(time_ns: int | None, before: int, tick_ns: int) -> int:
    """Return the consecutive ticks for a condition of `time_ns`; None: `before`."""
    return before if time_ns is None else -(-time_ns // tick_ns) + 1


@final
class Axis:
    """One motor with its drive firmware; sans-I/O, reads no clock.

    It starts without power. Settings and commands take effect at the next tick. `Timeline`
    documents how the axis stays lazy and exact.

    `flags` (bits of the flags module) are as of the last `at`, with one exception. A command that
    starts a profile sets PROFILE_ACTIVE and clears the two target windows at once.

    Attributes:
        gear_ratio: turns of the motor per turn of the plant's output.

    Raises:
        ValueError: `current_steps` does not divide the tick, or the gains make the current loop
            unstable.
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
            raise ValueError(
                f"tick_ns = {tick_ns}: must be > 0 and divisible into {current_steps} equal steps"
            )
        self._plant: Final = plant
        self._gains: ServoGains = gains
        self._tick_ns: Final = tick_ns
        self._tick_s: Final = tick_ns / 1e9
        self._current_steps: Final = current_steps
        self._clock_rate: Final = clock_rate
        self._torque_n_m_a: Final = plant.torque_constant_n_m_a * plant.gear_ratio
        self._output_rad_inc: Final = 2.0 * PI / (plant.encoder_increments_rev * plant.gear_ratio)
        self.gear_ratio: Final = plant.gear_ratio
        self._has_extras: Final[bool] = plant.extras.is_any()
        self._load_torque_n_m = plant.load_torque_n_m
        self._current_max_a: Final = plant.current_max_a
        self._limits_a = (plant.current_max_a, plant.current_max_a)  # forwards, backwards
        self._offset_inc = 0
        self._mode = servo.OFF
        self._profile = profile.hold(float(initial_position_inc))
        self._profile_tick = 0  # the tick at which the profile's time is 0
        self._way = 0.0  # its sign is the direction of the last command
        self._barred = 0  # directions that are barred to commands
        self._bar_slower = 0.0
        self._fed_a: float = 0.0  # part of the velocity loop's integrator added by `feed_current`
        self.is_braking: bool = False  # by `brake`, until the next command
        self._is_shorted: bool = False
        self._windows: servo.Windows = default_windows(tick_ns)
        self._orders: servo.Orders = (
            *(servo.OFF, 0, NEVER, self._profile),
            *(False, 0.0, 0.0, plant.current_max_a, plant.current_max_a),
        )
        self._conditions: Conditions = (
            *(plant.load_torque_n_m / plant.gear_ratio, plant.supply_v),
            *(NO_LIMIT, -NO_LIMIT, NO_LIMIT, NO_LIMIT, NO_LIMIT, -NO_LIMIT, NO_LIMIT),
        )
        tables = tables_of(plant, gains, tick_ns, current_steps, clock_rate)
        extras = extras_tables(plant, gains, tables.tick, tick_ns, current_steps, clock_rate)
        state = servo.standing(float(initial_position_inc))
        if extras is not None:
            state = nonlinear_servo.standing(extras, float(initial_position_inc), plant.supply_v)
        self._time: Final = Timeline(
            *(tables, plant.load_torque_n_m, self._windows, self._orders, state, extras),
            self._conditions,
        )
        self.flags: int = self._time.state[servo.I_FLAGS]

    # --- time

    def at(self, now_ns: int) -> None:
        """Update readings and flags to tick now_ns // tick_ns; behaviour does not change.

        Raises:
            ValueError: now_ns is before the tick of the last `at`.
        """
        tick = now_ns // self._tick_ns
        time = self._time
        if tick == time.tick:
            return
        if tick < time.tick:
            raise ValueError(f"{now_ns} ns is before tick {time.tick}: time runs forward only")
        time.reach(tick)
        self.flags = time.state[servo.I_FLAGS]

    def next_event_ns(self, limit_ns: int | None = None) -> int | None:
        """Return when to call `at` again [ns], as seen from the last `at`.

        The time is the next tick at which the flags change, or an earlier one at which computing
        must continue. It is never later than `limit_ns`. None: the flags will never change without
        a command, and the axis comes to rest by itself.
        """
        limit = NEVER_NS if limit_ns is None else limit_ns
        next_ns = self.event_ns(limit)
        return None if next_ns >= NEVER_NS else next_ns

    def event_ns(self, limit_ns: int) -> int:
        """Return `next_event_ns`, with NEVER_NS for None."""
        next_tick = self._time.next_tick(limit_ns // self._tick_ns)
        if next_tick == RESTS:
            return NEVER_NS
        next_ns = next_tick * self._tick_ns
        return next_ns if next_ns < limit_ns else limit_ns

    def rest(self) -> int:
        """Return a number that stays the same while the axis rests; -1 in motion.

        Each command changes the number. While it stays the same, so does every reading.
        """
        return self._time.commands if self._time.resting else -1

    # --- readings, at the time of the last at()

    def stands(self) -> bool:
        """Return True if the ramp or the braking that was to stop the motor is over."""
        if self.flags & PROFILE_ACTIVE:
            return False
        return not self.is_braking or self.flags & SPEED_ZERO != 0

    def position_inc(self) -> int:
        """Return the position actual value: the encoder count plus the offset of the zero."""
        return int(self._time.state[servo.I_COUNT]) + self._offset_inc

    def count(self) -> int:
        """Return the encoder count from the output's zero; `set_position` does not change it."""
        return int(self._time.state[servo.I_COUNT])

    def output_count(self) -> int:
        """Return the output position in whole increments like `count`, as switches there see it."""
        if self._has_extras:
            return int(servo.whole(self._extra(nonlinear_servo.E_LOAD_POSITION)))
        return int(self._time.state[servo.I_COUNT])

    def count_when_output_was(self, output_count: int) -> int:
        """Return the encoder count when the output passed `output_count` within the last tick."""
        if self._has_extras:
            ahead = self._time.state[servo.I_POSITION] - self._extra(
                nonlinear_servo.E_LOAD_POSITION
            )
            return output_count + int(servo.whole(ahead))
        return output_count

    def velocity_inc_s(self) -> float:
        """Return the velocity measured with the encoder; exactly 0.0 at standstill [inc/s]."""
        return self._time.state[servo.I_VELOCITY] / self._tick_s

    def demand_inc(self) -> int:
        """Return the position demand value; the actual position if no position is controlled."""
        return int(self._time.state[servo.I_DEMAND]) + self._offset_inc

    def demand_velocity_inc_s(self) -> float:
        """Return the velocity demand [inc/s]."""
        return self._time.state[servo.I_DEMAND_VELOCITY] / self._tick_s

    def following_error_inc(self) -> int:
        """Return demand minus actual position; 0 if no position is controlled."""
        return int(self._time.state[servo.I_DEMAND] - self._time.state[servo.I_COUNT])

    def target_inc(self) -> int:
        """Return the end of the present move, ramp or hold; else the actual position."""
        if self._mode != servo.POSITION:
            return self.position_inc()
        return int(self._profile[-1][2]) + self._offset_inc

    def current_a(self) -> float:
        """Return the motor current [A]."""
        return self._time.state[servo.I_CURRENT]

    def current_demand_a(self) -> float:
        """Return the current demand of the velocity loop or `apply_current`, limited [A]."""
        return self._time.state[servo.I_WANTED]

    def torque_n_m(self) -> float:
        """Return motor torque times gear ratio, without subtracting friction and inertia [N m]."""
        return self._time.state[servo.I_CURRENT] * self._torque_n_m_a

    def winding_v(self) -> float:
        """Return the voltage at the winding for the present velocity and current [V]."""
        plant = self._plant
        speed_rad_s = self.velocity_inc_s() / plant.increments_per_rad()
        return speed_rad_s * plant.torque_constant_n_m_a + self.current_a() * plant.resistance_ohm

    def has_extras(self) -> bool:
        """Return whether the plant is not linear or has limits; see `Extras`."""
        return self._has_extras

    def output_position_rad(self) -> float:
        """Return the true output position, not quantised, independent of `set_position` [rad]."""
        if self._has_extras:
            return (self._extra(nonlinear_servo.E_LOAD_POSITION) - 0.5) * self._output_rad_inc
        return (self._time.state[servo.I_POSITION] - 0.5) * self._output_rad_inc

    def output_velocity_rad_s(self) -> float:
        """Return the true output velocity, not quantised [rad/s]."""
        if self._has_extras:
            return self._extra(nonlinear_servo.E_LOAD_SPEED) / self.gear_ratio
        return self._time.state[servo.I_SPEED] / self.gear_ratio

    def load_torque_n_m(self) -> float:
        """Return the load torque at the output, as set [N m]."""
        return self._load_torque_n_m

    def dc_link_v(self) -> float:
        """Return the DC-link voltage; without a DC link, the supply's voltage [V]."""
        if self._plant.extras.has_dc_link():
            return self._extra(nonlinear_servo.E_DC_LINK)
        return self._conditions[1]

    def winding_temperature_c(self) -> float:
        """Return the winding temperature; without a thermal model, the ambient one [degC]."""
        if self._has_extras:
            return self._extra(nonlinear_servo.E_WINDING)
        return self._plant.extras.ambient_c

    def housing_temperature_c(self) -> float:
        """Return the housing temperature; without a thermal model, the ambient one [degC]."""
        if self._has_extras:
            return self._extra(nonlinear_servo.E_HOUSING)
        return self._plant.extras.ambient_c

    def i2t_level(self) -> float:
        """Return the level of the I2t integrator, 0..1; 0 without one."""
        return self._extra(nonlinear_servo.E_I2T) if self._has_extras else 0.0

    def truth(self) -> dict[str, float]:
        """Return the values of every motor under their snapshot names; rad, N m at the output."""
        return {
            "position_rad": self.output_position_rad(),
            "velocity_rad_s": self.output_velocity_rad_s(),
            "position_inc": float(self.position_inc()),
            "demand_inc": float(self.demand_inc()),
            "current_a": self.current_a(),
            "torque_n_m": self.torque_n_m(),
        }

    def truth_of_extras(self) -> dict[str, float]:
        """Return the existing values of DC link, winding and I2t under their snapshot names."""
        extras = self._plant.extras
        truth: dict[str, float] = {}
        if extras.has_dc_link():
            truth["dc_link_v"] = self.dc_link_v()
        if extras.has_heat():
            truth["winding_temperature_c"] = self.winding_temperature_c()
        if extras.has_i2t():
            truth["i2t_level"] = self.i2t_level()
        return truth

    # --- settings, effective from the next tick on

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
        """Set the windows of the flags and their times; None leaves a value unchanged.

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
        """Set the range of the counts outside which OUTSIDE_GATE is set.

        Inside means low <= count() < high and output_low <= output_count() < output_high. The flag
        is off at the present tick, and exact from the next one on.
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
        """Set the load torque at the output [N m]; positive acts towards negative positions."""
        if torque_n_m != self._load_torque_n_m:
            self._load_torque_n_m = torque_n_m
            if self._has_extras:
                self._set_conditions((torque_n_m / self.gear_ratio, *self._conditions[1:]))
            else:
                self._time.set_load(torque_n_m)

    def set_supply(self, supply_v: float) -> None:
        """Set the supply's own voltage; this needs a nonlinear plant.

        Raises:
            ValueError: the plant has no nonlinear effects, or the voltage is not > 0.
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
        """Set the flags' thresholds of a nonlinear plant (initially: never); None keeps one.

        The flags are set and cleared at the exact tick. They are not latched and do not affect the
        motor. The voltage is compared in every tick, temperature and I2t every 20 ms. If the plant
        lacks the effect that a threshold refers to, its flag is never set.
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
        """Set the servo's gains from the next tick on, without a jump of current or voltage.

        Raises:
            ValueError: the gains make the current loop unstable; the old ones stay.
        """
        self._step_with(gains.shorted(self._plant) if self._is_shorted else gains)
        self._gains = gains

    def set_current_limit(self, current_a: float, backward_a: float | None = None) -> None:
        """Limit the current demand, at most to the plant's current_max_a.

        Args:
            current_a: forward limit [A].
            backward_a: backward limit [A]; None: the same as forward.

        Raises:
            ValueError: one of the limits is < 0.
        """
        back_a = current_a if backward_a is None else backward_a
        if not (current_a >= 0.0 and back_a >= 0.0):
            raise ValueError(f"current limits {current_a} and {back_a} A: must be >= 0")
        self._limits_a = (min(current_a, self._current_max_a), min(back_a, self._current_max_a))
        self._orders = (*self._orders[:7], *self._limits_a)
        self._time.order(self._orders, self._time.state)

    def set_position(self, position_inc: int, count: int | None = None) -> None:
        """Define the position at `count` (None: the present count) as `position_inc` (homing).

        Nothing moves.
        """
        self._time.commands += 1
        self._offset_inc = position_inc - (self.count() if count is None else count)

    # --- commands, effective from the tick after the last at()

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
                slower = square / (2.0 * left) if left > 0.0 else NO_LIMIT
        pieces = profile.ramp(position, velocity, 0.0, slower, slower)
        self._mode = servo.POSITION
        self._begin(pieces, profile.duration_ticks(pieces), True, 0.0)

    def apply_current(
        self, target_a: float, slope_a_s: float, speed_max_inc_s: float = NO_LIMIT
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
        speed_max_inc_s: float = NO_LIMIT,
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
        self._begin(pieces, NEVER, False, NO_LIMIT)

    def follow_current(
        self, current_a: float, over_ns: int, speed_max_inc_s: float = NO_LIMIT
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

    def follow_impedance(
        self,
        position_inc: float,
        velocity_inc_s: float,
        stiffness_a_inc: float,
        damping_a_s_inc: float,
        current_a: float,
    ) -> None:
        """Pull towards a position and a velocity with this stiffness and damping (MIT mode).

        The current demand is stiffness * (position - actual) + damping * (velocity - actual) +
        `current_a` in every tick, within the current limits. Barred directions have no effect.

        Raises:
            RuntimeError: power is off.
        """
        self._start()
        self._way = 0.0
        self._mode = servo.IMPEDANCE
        self._fed_a = 0.0
        pieces = profile.impedance(
            *(position_inc - self._offset_inc, velocity_inc_s * self._tick_s, stiffness_a_inc),
            *(damping_a_s_inc / self._tick_s, current_a),
        )
        self._begin(pieces, NEVER, False, -1.0)  # no window of the current

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
        self._begin(profile.hold(0.0), NEVER, False, NO_LIMIT)
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
        if self._mode >= servo.TORQUE:  # the load may drive the motor against the current
            self._way = self._time.state[servo.I_VELOCITY]
        moves = self.flags & PROFILE_ACTIVE or self._time.state[servo.I_DEMAND_VELOCITY] != 0.0
        if self._mode != servo.OFF and (self._mode != servo.POSITION or moves):
            self._is_barred()

    # --- internals

    def _extra(self, index: int) -> float:
        return self._time.state[servo.I_EXTRAS][index]

    def _set_conditions(self, conditions: Conditions) -> None:
        if conditions != self._conditions:
            self._conditions = conditions
            self._time.set_conditions(conditions)

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
        """Return position and velocity demand at the next tick, where a new profile starts."""
        if self.is_braking:
            self._end_braking()
        if self._mode == servo.OFF:
            raise RuntimeError("the power stage is off: call power(True) first")
        t = float(self._time.tick + 1 - self._profile_tick)
        position, velocity = profile.demand_at(self._profile, t)
        if self._mode >= servo.TORQUE:  # only the current has a demand
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
