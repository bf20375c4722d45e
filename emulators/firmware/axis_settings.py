"""Settings of an axis: limits, gains, windows, gate, load, supply and zero."""

from typing import Final

from emulators.firmware import extras_servo, profile, servo
from emulators.firmware.axis_readings import AxisReadings
from emulators.firmware.extras_tables import Conditions, extras_tables
from emulators.firmware.flags import OUTSIDE_GATE
from emulators.firmware.gains import ServoGains
from emulators.firmware.servo_tables import tables_of
from emulators.firmware.timeline import Timeline
from emulators.firmware.windows import default_windows, in_a_row, with_gate
from emulators.plant.dc_motor import MotorPlant

NEVER: Final = -1.0  # end of PROFILE_ACTIVE for a profile that never sets it
_NONE: Final = 1e300  # a threshold that is never reached


class AxisSettings(AxisReadings):
    """The settings of an axis, effective from the next tick on; it starts without power.

    Raises:
        ValueError: `current_steps` does not divide the tick, or the gains make the current loop
            unstable.
    """

    def __init__(
        self,
        plant: MotorPlant,
        gains: ServoGains,
        tick_ns: int,
        current_steps: int,
        initial_position_inc: int,
        clock_rate: float,
    ) -> None:
        if tick_ns < 1 or current_steps < 1 or tick_ns % current_steps:
            raise ValueError(
                f"tick_ns = {tick_ns}: must be > 0 and divisible into {current_steps} equal steps"
            )
        self._gains: ServoGains = gains
        self._current_steps: Final = current_steps
        self._clock_rate: Final = clock_rate
        self._current_max_a: Final = plant.current_max_a
        self._limits_a = (plant.current_max_a, plant.current_max_a)  # forwards, backwards
        self._windows: servo.Windows = default_windows(tick_ns)
        standing: servo.Orders = (
            *(servo.OFF, 0, NEVER, profile.hold(float(initial_position_inc))),
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
        self._is_shorted: bool = False

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
                self._set_conditions((torque_n_m / self._gear_ratio, *self._conditions[1:]))
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
