"""What an axis shows of itself, at the time of its last `at`, and when to look again."""

from typing import Final

from emulators.firmware import extras_servo, profile, servo
from emulators.firmware.extras_tables import Conditions
from emulators.firmware.flags import PROFILE_ACTIVE, SPEED_ZERO
from emulators.firmware.timeline import RESTS, Timeline
from emulators.plant.dc_motor import PI, MotorPlant

NEVER_NS: Final = 1 << 61  # a small int to the compiler


class AxisReadings:
    """The readings of an axis; positions are increments of its encoder.

    `flags` (see emulators.firmware.flags) are those at the last `at`, except that a command which
    starts a profile shows at once: PROFILE_ACTIVE comes, the two target windows go.
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
        """Readings and flags are now those of tick now_ns // tick_ns. Changes no behaviour.

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
        """When to call `at` and look again [ns], counted from the last `at`.

        It is the next tick at which the flags change, or an earlier time at which work must go on,
        never later than `limit_ns`; None: the flags will never change without a command, and the
        axis comes to rest by itself.
        """
        limit = NEVER_NS if limit_ns is None else limit_ns
        next_ns = self.event_ns(limit)
        return None if next_ns >= NEVER_NS else next_ns

    def event_ns(self, limit_ns: int) -> int:
        """As `next_event_ns`, with NEVER_NS for None."""
        next_tick = self._time.next_tick(limit_ns // self._tick_ns)
        if next_tick == RESTS:
            return NEVER_NS
        next_ns = next_tick * self._tick_ns
        return next_ns if next_ns < limit_ns else limit_ns

    def rest(self) -> int:
        """A number while the axis rests, another one after each command; -1 in motion.

        As long as it stays the same, so does every reading.
        """
        return self._time.commands if self._time.resting else -1

    # --- readings, at the time of the last at() ---------------------------------------------------

    def stands(self) -> bool:
        """Whether the ramp, or the braking, that was to stop the motor is over."""
        if self.flags & PROFILE_ACTIVE:
            return False
        return not self.is_braking or self.flags & SPEED_ZERO != 0

    def position_inc(self) -> int:
        """What the encoder counts, from the zero that was set."""
        return int(self._time.state[servo.I_COUNT]) + self._offset_inc

    def count(self) -> int:
        """What the encoder counts from the output's zero; `set_position` does not change it."""
        return int(self._time.state[servo.I_COUNT])

    def output_count(self) -> int:
        """Where the output is, in whole increments as `count`: what switches there feel."""
        if self._has_extras:
            return int(servo.whole(self._extra(extras_servo.E_LOAD_POSITION)))
        return int(self._time.state[servo.I_COUNT])

    def count_when_output_was(self, output_count: int) -> int:
        """What the encoder counted when, within the last tick, the output passed this place."""
        if self._has_extras:
            ahead = self._time.state[servo.I_POSITION] - self._extra(extras_servo.E_LOAD_POSITION)
            return output_count + int(servo.whole(ahead))
        return output_count

    def velocity_inc_s(self) -> float:
        """Velocity as measured by the firmware from the encoder; exactly 0.0 at standstill."""
        return self._time.state[servo.I_VELOCITY] / self._tick_s

    def demand_inc(self) -> int:
        """Where the axis should be now; the actual position where no position is controlled."""
        return int(self._time.state[servo.I_DEMAND]) + self._offset_inc

    def demand_velocity_inc_s(self) -> float:
        """How fast the axis should be now."""
        return self._time.state[servo.I_DEMAND_VELOCITY] / self._tick_s

    def following_error_inc(self) -> int:
        """Demand minus actual position; 0 where no position is controlled."""
        return int(self._time.state[servo.I_DEMAND] - self._time.state[servo.I_COUNT])

    def target_inc(self) -> int:
        """Where the present move, ramp or hold ends; the actual position where there is no end."""
        if self._mode != servo.POSITION:
            return self.position_inc()
        return int(self._profile[-1][2]) + self._offset_inc

    def current_a(self) -> float:
        """Motor current."""
        return self._time.state[servo.I_CURRENT]

    def current_demand_a(self) -> float:
        """Current asked for by the velocity loop or `apply_current`, after the limit."""
        return self._time.state[servo.I_WANTED]

    def torque_n_m(self) -> float:
        """Torque of the motor times the gear ratio: friction and inertia not taken off."""
        return self._time.state[servo.I_CURRENT] * self._torque_n_m_a

    def output_position_rad(self) -> float:
        """The truth behind the gear, not quantised; `set_position` does not change it."""
        if self._has_extras:
            return (self._extra(extras_servo.E_LOAD_POSITION) - 0.5) * self._output_rad_inc
        return (self._time.state[servo.I_POSITION] - 0.5) * self._output_rad_inc

    def output_velocity_rad_s(self) -> float:
        """The truth behind the gear, not quantised."""
        if self._has_extras:
            return self._extra(extras_servo.E_LOAD_SPEED) / self._gear_ratio
        return self._time.state[servo.I_SPEED] / self._gear_ratio

    def load_torque_n_m(self) -> float:
        """The load's torque at the output, as set."""
        return self._load_torque_n_m

    def dc_link_v(self) -> float:
        """Voltage that the power stage has; the supply's, where it does not depend on the load."""
        if self._plant.extras.has_dc_link():
            return self._extra(extras_servo.E_DC_LINK)
        return self._conditions[1]

    def winding_temperature_c(self) -> float:
        """Temperature of the winding; the air's, where the plant has no thermal model."""
        if self._has_extras:
            return self._extra(extras_servo.E_WINDING)
        return self._plant.extras.ambient_c

    def housing_temperature_c(self) -> float:
        """Temperature of the motor's housing, likewise."""
        if self._has_extras:
            return self._extra(extras_servo.E_HOUSING)
        return self._plant.extras.ambient_c

    def i2t_level(self) -> float:
        """How full the I2t integrator is, 0..1; 0 without one."""
        return self._extra(extras_servo.E_I2T) if self._has_extras else 0.0

    def truth_of_extras(self) -> dict[str, float]:
        """Of DC link, winding and I2t what the plant has, by the names of a snapshot."""
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
