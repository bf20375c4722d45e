"""Readings of an axis as of its last `at`, and its next event."""

from typing import Final

from emulators.firmware import extras_servo, profile, servo
from emulators.firmware.extras_tables import Conditions
from emulators.firmware.flags import PROFILE_ACTIVE, SPEED_ZERO
from emulators.firmware.timeline import RESTS, Timeline
from emulators.plant.dc_motor import PI, MotorPlant

NEVER_NS: Final = 1 << 61  # a small int to the compiler


class AxisReadings:
    """The readings of an axis; positions are encoder increments.

    `flags` (bits of the flags module) are as of the last `at`, with one exception. A command that
    starts a profile sets PROFILE_ACTIVE and clears the two target windows at once.
    """

    def __init__(
        self,
        plant: MotorPlant,
        tick_ns: int,
        time: Timeline,
        pieces: profile.Profile,
        conditions: Conditions,
    ) -> None:
        self._plant: Final = plant
        self._tick_ns: Final = tick_ns
        self._tick_s: Final = tick_ns / 1e9
        self._torque_n_m_a: Final = plant.torque_constant_n_m_a * plant.gear_ratio
        self._output_rad_inc: Final = 2.0 * PI / (plant.encoder_increments_rev * plant.gear_ratio)
        self._gear_ratio: Final = plant.gear_ratio
        self._time: Final = time
        self._has_extras: Final[bool] = plant.extras.is_any()
        self._conditions: Conditions = conditions
        self._offset_inc = 0
        self._load_torque_n_m = plant.load_torque_n_m
        self._mode = servo.OFF
        self._profile = pieces
        self.is_braking: bool = False  # by `brake`, until the next command
        self.flags: int = time.state[servo.I_FLAGS]

    # --- time -------------------------------------------------------------------------------------

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

    # --- readings, at the time of the last at() ---------------------------------------------------

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
            return int(servo.whole(self._extra(extras_servo.E_LOAD_POSITION)))
        return int(self._time.state[servo.I_COUNT])

    def count_when_output_was(self, output_count: int) -> int:
        """Return the encoder count when the output passed `output_count` within the last tick."""
        if self._has_extras:
            ahead = self._time.state[servo.I_POSITION] - self._extra(extras_servo.E_LOAD_POSITION)
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

    def output_position_rad(self) -> float:
        """Return the true output position, not quantised, independent of `set_position` [rad]."""
        if self._has_extras:
            return (self._extra(extras_servo.E_LOAD_POSITION) - 0.5) * self._output_rad_inc
        return (self._time.state[servo.I_POSITION] - 0.5) * self._output_rad_inc

    def output_velocity_rad_s(self) -> float:
        """Return the true output velocity, not quantised [rad/s]."""
        if self._has_extras:
            return self._extra(extras_servo.E_LOAD_SPEED) / self._gear_ratio
        return self._time.state[servo.I_SPEED] / self._gear_ratio

    def load_torque_n_m(self) -> float:
        """Return the load torque at the output, as set [N m]."""
        return self._load_torque_n_m

    def dc_link_v(self) -> float:
        """Return the DC-link voltage; without a DC link, the supply's voltage [V]."""
        if self._plant.extras.has_dc_link():
            return self._extra(extras_servo.E_DC_LINK)
        return self._conditions[1]

    def winding_temperature_c(self) -> float:
        """Return the winding temperature; without a thermal model, the ambient one [degC]."""
        if self._has_extras:
            return self._extra(extras_servo.E_WINDING)
        return self._plant.extras.ambient_c

    def housing_temperature_c(self) -> float:
        """Return the housing temperature; without a thermal model, the ambient one [degC]."""
        if self._has_extras:
            return self._extra(extras_servo.E_HOUSING)
        return self._plant.extras.ambient_c

    def i2t_level(self) -> float:
        """Return the level of the I2t integrator, 0..1; 0 without one."""
        return self._extra(extras_servo.E_I2T) if self._has_extras else 0.0

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

    def _extra(self, index: int) -> float:
        return self._time.state[servo.I_EXTRAS][index]
